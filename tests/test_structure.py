"""The package's layout: few layers, no import circles, few modules outside the packages."""

from __future__ import annotations

from pathlib import Path

import pytest

from structure import Structure, measure

CHECKOUT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def structure() -> Structure:
    return measure(CHECKOUT)


def test_no_files_import_each_other_in_a_circle(structure: Structure) -> None:
    assert structure.file_circles == ()
    assert structure.package_circles == ()


def test_layers_are_at_most_twelve(structure: Structure) -> None:
    assert structure.layers <= 12


def test_modules_beside_the_packages_are_few(structure: Structure) -> None:
    assert set(structure.flat) <= {"__init__", "__main__", "api", "errors", "version"}


def test_a_circle_is_found(tmp_path: Path) -> None:
    package = tmp_path / "fgreg"
    for name, text in {
        "__init__": "",
        "a/__init__": "",
        "a/first": "from fgreg.b import second\n",
        "b/__init__": "",
        "b/second": "def later() -> None:\n    from fgreg.a import first\n",
        "flat": "from fgreg.a import first\n",
    }.items():
        path = package / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    found = measure(tmp_path)
    assert found.package_circles == (("a", "b"),)
    assert found.file_circles == (("fgreg.a.first", "fgreg.b.second"),)
    assert found.layers == 2
    assert found.flat == ("__init__", "flat")
