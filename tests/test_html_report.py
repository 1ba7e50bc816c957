"""The report of a session: the same bytes each time, nothing from a network, no text of a session as HTML."""

from __future__ import annotations

import base64
import gzip
import json
import math
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import yaml

from fgreg.cli.main import main
from fgreg.html_report.contents import Source, contents
from fgreg.html_report.render import render
from fgreg.html_report.viewer_3d import viewer_of
from fgreg.html_report.words import ANSWER, PERMITS
from fgreg.model.estimate import (
    AimEstimate,
    PairEstimate,
    PointEstimate,
    SessionEstimate,
    SettingsUsed,
    TargetEstimate,
    TrackEstimate,
    Verdict,
)
from fgreg.model.events import MarkerRecord, PairEvent, TrusRecord
from fgreg.pipeline.html_report import ReportRequest, report_session
from fgreg.pipeline.solve import SolveRequest, solve_session
from fgreg.session.result_file import read_result
from fgreg.viewer.recording_file import recording_id
from tests.test_report_summary import make_answer

HOSTILE = "</title></style><script>alert(1)</script><img src=x onerror=alert(2)> & \"'"
Run = Callable[..., tuple[int, str]]


class Page(HTMLParser):
    """Tags, attributes and texts of a page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.texts: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


@pytest.fixture(scope="module")
def solved(_raw_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A solved session of 8 pairs with frames, whose texts are hostile."""
    folder = Path(shutil.copytree(_raw_session, tmp_path_factory.mktemp("report") / "session"))
    setup = yaml.safe_load((folder / "session.yaml").read_text())
    setup.pop("targets_mm", None)
    points = {"apex": [0, 0, 45], f"base {HOSTILE}": [-15, -12, 34], "urethra": [3, 4, 30]}
    setup |= {"name": HOSTILE, "targets": [{"name": name, "trus_p_mm": p} for name, p in points.items()]}
    (folder / "session.yaml").write_text(yaml.safe_dump(setup))
    with (folder / "events.jsonl").open("a") as events:
        for event in (
            {"type": "stage", "t": 1e4, "command": "emergency stop", "reason": HOSTILE},
            {"type": "note", "t": 1e4, "text": HOSTILE},
        ):
            events.write(json.dumps(event) + "\n")
    solve_session(SolveRequest(folder))
    return folder


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """``fgreg report`` with these words: exit status and standard error."""

    def command(*words: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["fgreg", "report", *map(str, words)])
        with pytest.raises(SystemExit) as exit_:
            main()
        return int(str(exit_.value.code)), capsys.readouterr().err

    return command


def a_source(verdict: Verdict) -> Source:
    model, estimate, _ = make_answer(verdict=verdict, reasons=("take 3 more",))
    at_targets = tuple(
        TargetEstimate(name, point, 0.7, 1.4, 1.1, 0.9)
        for name, point in zip(model.target_names, model.targets_mm, strict=True)
    )
    epochs = tuple(replace(epoch, targets=at_targets) for epoch in estimate.epochs)
    estimate = replace(estimate, epochs=epochs, pairs=())
    return Source("phantom", model, (), estimate, SettingsUsed(3.0), {}, {}, "1.0")


def test_two_reports_of_one_session_are_the_same_wherever_it_is(solved: Path, tmp_path: Path) -> None:
    elsewhere = Path(shutil.copytree(solved, tmp_path / solved.name))
    first = report_session(ReportRequest(solved, tmp_path / "a.html"))
    report_session(ReportRequest(elsewhere, tmp_path / "b.html"))
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert first.size == (tmp_path / "a.html").stat().st_size
    assert 30 / 8 * first.size < 5e6  # of 8 pairs; the limit is for 30


def test_nothing_is_loaded_and_no_text_of_a_session_is_html(solved: Path, tmp_path: Path) -> None:
    report_session(ReportRequest(solved, tmp_path / "a.html"))
    html = (tmp_path / "a.html").read_text(encoding="utf-8")
    page = Page(html)
    assert not {"script", "img", "link", "iframe", "object", "base"} & set(page.tags)
    assert not [name for name, _ in page.attributes if name.startswith("on")]
    addresses = [value for name, value in page.attributes if name in ("href", "src", "action", "data", "xlink:href")]
    assert all(value.startswith(("#", "data:image/jpeg;base64,")) for value in addresses)
    assert sum(value.startswith("data:") for value in addresses) == 16  # left camera and probe of 8 pairs
    assert "url(" not in html
    assert "@import" not in html
    assert any(
        name == "content" and value.startswith("default-src 'none'; img-src data:;") for name, value in page.attributes
    )
    assert page.texts.count(HOSTILE) >= 4  # heading, stage log, note, settings
    assert page.tags.count("title") == 1 + page.tags.count("svg")


def test_its_figures_are_those_of_the_result(solved: Path, tmp_path: Path) -> None:
    report_session(ReportRequest(solved, tmp_path / "a.html"))
    texts = Page((tmp_path / "a.html").read_text(encoding="utf-8")).texts
    estimate = read_result(solved / "result.yaml")
    (epoch,) = estimate.epochs
    assert epoch.predicted_tre is not None
    worst = max(target.p95_mm for target in epoch.targets)
    assert worst == epoch.predicted_tre.worst_mm
    for figure in (worst, epoch.targets[0].random_mm, epoch.targets[1].systematic_mm):
        assert f"{figure:.2f}" in texts
    assert [pair.nis_dof for pair in estimate.pairs] == [2] * 8
    assert all(f"{pair.influence_mm:.2f}" in texts for pair in estimate.pairs)
    assert "emergency stop" in texts
    assert "2 entries, 1 stop." in "".join(texts)


@pytest.mark.parametrize("verdict", Verdict)
def test_the_verdict_says_whether_the_probe_may_be_turned(verdict: Verdict) -> None:
    source = a_source(verdict)
    answered, unanswered = source.estimate.tracks
    source = replace(source, estimate=replace(source.estimate, tracks=(unanswered, answered)))
    text = " ".join(" ".join(Page(render(contents(source))).texts).split())
    assert f"Turn the probe by this angle, to -12.3 deg? {'✓!✕'[verdict.severity]} {ANSWER[verdict]}" in text
    assert [ANSWER[each] for each in Verdict] == ["Yes", "Look first", "No"]
    assert PERMITS[verdict] in text
    assert ("not to be used" in text) == (verdict is Verdict.REFUSED)
    assert "take 3 more" in text
    assert "no tissue surface is known yet" in text


def test_it_says_of_which_camera_epoch_its_figures_are_and_numbers_the_aims() -> None:
    source = a_source(Verdict.WARNING)
    (epoch,) = source.estimate.epochs
    moved = replace(epoch, index=1, start_s=50.0, verdict=Verdict.OK)
    aims = (AimEstimate(2.5, used=True), AimEstimate(7.5, used=False, reason="left out by hand"))
    said = []
    for epochs in ((epoch,), (epoch, moved)):
        estimate = replace(source.estimate, epochs=epochs, aims=aims)
        said.append(" ".join(" ".join(Page(render(contents(replace(source, estimate=estimate)))).texts).split()))
    assert "camera epoch 1" not in said[0]
    assert "in camera epoch 1, 95 % bound" in said[1]
    assert "All of camera epoch 1, the last one" in said[1]
    assert "Yes" not in said[1]  # an epoch's own verdict does not answer whether the probe may be turned
    assert "1 7.5 \u2013 \u2013 \u2013 not used left out by hand" in said[1]


def test_it_shows_known_points_and_how_far_visible_spots_are_from_their_pms() -> None:
    source = a_source(Verdict.WARNING)
    assert "known point" not in render(contents(source))
    far = np.array([12.0, -0.5, 0.0])
    points = (
        PointEstimate(3.0, 0, used=True, error_mm=far / 30.0, nis=2.1),
        PointEstimate(4.0, 0, used=True, error_mm=far, nis=140.0),
        PointEstimate(5.0, 0, used=False, reason="left out by hand: the echo of a clip"),
    )
    pairs = (
        PairEstimate(1.0, 7, 0, used=False, reason="outlier", spot_error_mm=far / 4.0),
        PairEstimate(2.0, 8, 0, used=False),
    )
    trus = TrusRecord(0.0, 0.0, 30.0)
    events = tuple(PairEvent(pair.t, 0, pair.pm, MarkerRecord(np.eye(4)), trus) for pair in pairs)
    estimate = replace(source.estimate, points=points, pairs=pairs)
    html = render(contents(replace(source, estimate=estimate, events=events)))
    text = " ".join(" ".join(Page(html).texts).split())
    assert "2 of 3 known points are used" in text
    assert "0 3.0 (0.40, -0.02, 0.00) 0.40 2.1 used" in text
    assert "1 4.0 (12.00, -0.50, 0.00) 12.01 140.0 used, contradicts the others" in text
    assert "2 5.0 \u2013 \u2013 \u2013 not used left out by hand: the echo of a clip" in text
    assert "where the PM is, less where the camera sees it" in text
    assert "(3.0, -0.1, 0.0)" in text


def test_without_a_registration_it_says_so() -> None:
    empty = SessionEstimate("empty", Verdict.REFUSED, ("no pairs: take at least 6",), None, (), (), ())
    text = "".join(Page(render(contents(replace(a_source(Verdict.REFUSED), estimate=empty)))).texts)
    assert "no pairs: take at least 6" in text
    assert "No registration could be computed." in text
    assert "There is no tracking query in this session." in text


def test_a_result_of_other_files_has_no_report(run: Run, solved: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(solved, tmp_path / "changed"))
    with (folder / "events.jsonl").open("a") as events:
        events.write(json.dumps({"type": "note", "t": 2e4, "text": "one more"}) + "\n")
    status, error = run(folder)
    assert status == 2
    assert "found a result of other files: events.jsonl changed, expected" in error
    result = folder / "result.yaml"
    result.write_text(result.read_text().replace("\n  - {pm: 1,", "\n  # {pm: 1,"))  # of the same files, a look less
    shutil.copy(solved / "events.jsonl", folder)
    assert "pairs: found 7, expected 8, one per pair event of the session" in run(folder)[1]
    assert "--out: found a name that ends in .txt, expected one in .html" in run(folder, "--out", "a.txt")[1]
    result.unlink()
    status, error = run(folder)
    assert (status, error.count("\n")) == (2, 1)
    assert "expected the result of the session: fgreg solve changed" in error
    assert not (folder / "report.html").exists()


def test_printing_needs_a_browser_and_leaves_no_date(
    run: Run, solved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    words = (solved, "--out", tmp_path / "a.html", "--pdf", tmp_path / "a.pdf")
    status, error = run(*words)
    assert status == 2
    assert error.startswith("fgreg: error: --pdf: found no Chromium on this machine, expected one of chromium")
    browser = tmp_path / "chromium"
    browser.write_text(
        f"#!{sys.executable}\nimport sys\n"
        "out = next(word[15:] for word in sys.argv if word.startswith('--print-to-pdf='))\n"
        "open(out, 'wb').write(b'%PDF-1.4 /Title (fgreg report: x) /CreationDate (D:20991231235959+00)')\n"
    )
    browser.chmod(0o755)
    assert run(*words, "--quiet")[0] == 0
    assert b"(D:20000101000000+00)" in (tmp_path / "a.pdf").read_bytes()


def test_a_recording_is_packed_with_the_viewer_that_shows_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    static = tmp_path / "packages" / "rerun_notebook" / "static"
    static.mkdir(parents=True)
    (static.parent / "__init__.py").write_text("raise AssertionError('not to be imported')")
    (static / "widget.js").write_text("a;\n//!<INLINE-MARKER-OPEN>\nfetch(url);\n//!<INLINE-MARKER-CLOSE>\nb;")
    (static / "re_viewer_bg.wasm").write_bytes(b"\0asm")
    monkeypatch.syspath_prepend(static.parents[1])
    monkeypatch.delitem(sys.modules, "rerun_notebook", raising=False)
    inputs = {"events.jsonl": "1" * 64}
    recording = tmp_path / "a.rrd"
    recording.write_bytes(b"RRF2 fgreg " + recording_id(inputs).encode() + b" RRF2FOOT....")
    viewer = viewer_of(recording, inputs)
    unpacked = [gzip.decompress(base64.b64decode(part)) for part in (viewer.script, viewer.assembly, viewer.recording)]
    assert unpacked[0].split(b"\n") == [
        *(b"a;", b"//!<INLINE-MARKER-OPEN>", b"return globalThis.fgregAssembly();"),
        *(b"//!<INLINE-MARKER-CLOSE>", b"b;"),
    ]
    assert unpacked[1:] == [b"\0asm", recording.read_bytes()]
    html = render(contents(a_source(Verdict.OK)), viewer)
    assert html.count(viewer.assembly) == 1
    with pytest.raises(Exception, match="a recording of other files, expected that of this session"):
        viewer_of(recording, {"events.jsonl": "2" * 64})


def test_an_angle_that_is_known_too_badly_is_not_to_be_turned_to_without_a_look() -> None:
    source = a_source(Verdict.OK)
    sharp = TrackEstimate(9.0, math.radians(10.0), math.radians(0.5), 20.0, causal=False)
    loose = TrackEstimate(10.0, math.radians(10.0), math.radians(2.1), 20.0, causal=False)
    assert np.linalg.norm(source.model.targets_mm[:, 1:], axis=1).max() > 40.0  # 2.1 deg are 3 mm and more there
    found = contents(replace(source, estimate=replace(source.estimate, tracks=(sharp, loose))))
    assert [row["answer"] for row in found["tracks"]["rows"]] == ["Yes", "Look first"]
    assert found["verdict"]["answer"] == "Look first"
    assert found["verdict"]["reasons"][-1].startswith("the newest angle: its 95 % bound is ")
    found = contents(replace(source, estimate=replace(source.estimate, tracks=(loose, sharp))))
    assert found["verdict"]["answer"] == "Yes"
