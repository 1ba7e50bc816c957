"""The study of the certificate: what it counts, on scenes made by hand, and one scene of its own."""

from __future__ import annotations

from collections.abc import Iterator

from study_certificate import Scene, scene, scenes


def test_scenes_count_what_they_say_and_an_interruption_loses_none() -> None:
    good = Scene(1, "window", 5, (20.0, 40.0), (True, False), by_multistart=True)
    wrong = Scene(2, "window", 5, (20.0, 40.0), (False, True))
    two_minima = Scene(3, "window", 5, (20.0, 25.0), (True, False))

    def coming() -> Iterator[Scene]:
        yield from (good, wrong, two_minima, Scene(4, "window", 5))
        raise KeyboardInterrupt

    assert scenes(coming()) == {
        "scenes": 3,
        "minima": 6,
        "no registration, or outliers": 1,
        "best known is the multi-start's": 1,
        "ambiguous": 1,
        "best and not ambiguous": 2,
        "certified, best known": 2,
        "certified, wrong": 1,
        "certified, of ambiguous scenes": 1,
        "to_look_at": [wrong.text, two_minima.text],
    }


def test_a_scene_has_its_minima_best_first_and_certifies_the_best() -> None:
    found = scene(5002, starts=20, budget=100_000)
    assert list(found.costs) == sorted(found.costs)
    assert found.by_multistart
    assert found.certified[0]
    assert not any(found.certified[1:])
