"""The public names: content and imports of ``import fgreg``, and the documented Python, which needs nothing else."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, assert_type

import pytest

import fgreg

CHECKOUT = Path(__file__).resolve().parent.parent
LIBRARIES = ("numpy", "scipy", "cv2", "gtsam", "rerun", "typer", "yaml", "rich", "fgreg.errors", "fgreg.api")


def public(names: list[str]) -> set[str]:
    return {name for name in names if not name.startswith("_")}


def test_importing_the_package_loads_no_library() -> None:
    program = "import sys, fgreg; fgreg.__all__; dir(fgreg); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout.split()
    assert "fgreg" in loaded
    assert sorted(set(loaded) & set(LIBRARIES)) == []


@pytest.mark.parametrize("name", fgreg.__all__)
def test_a_public_name_is_documented_and_typed(name: str) -> None:
    value = getattr(fgreg, name)
    assert (value.__doc__ or "").strip()
    functions = [value]
    if inspect.isclass(value):
        functions = [own for key, own in vars(value).items() if not key.startswith("_") and inspect.isroutine(own)]
    for function in functions:
        assert function.__doc__, function
        signature = inspect.signature(getattr(function, "__func__", function))
        unnamed = ("self", "cls")
        for parameter in signature.parameters.values():
            assert parameter.name in unnamed or parameter.annotation is not inspect.Parameter.empty, function
        assert signature.return_annotation is not inspect.Signature.empty, function


def test_public_names_are_those_of_the_api_module() -> None:
    """``__all__`` and fgreg/api.py say the same; nothing else is public but packages and the version."""
    exported = []
    for statement in ast.parse((CHECKOUT / "fgreg" / "api.py").read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.ImportFrom):
            exported += [alias.asname for alias in statement.names if alias.asname == alias.name]
        elif isinstance(statement, ast.FunctionDef | ast.ClassDef):
            exported.append(statement.name)
    assert sorted(public([str(name) for name in exported])) == sorted(fgreg.__all__)
    other = public(list(vars(fgreg))) - {*fgreg.__all__, "TYPE_CHECKING", "Any"}
    assert [name for name in sorted(other) if importlib.util.find_spec(f"fgreg.{name}") is None] == []
    assert set(fgreg.__all__) <= set(dir(fgreg))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'sovle'"):
        fgreg.sovle  # type: ignore[attr-defined]  # noqa: B018


def test_type_checkers_see_the_names() -> None:
    """Mypy checks the types below; were they ``Any``, it would complain."""
    assert_type(fgreg.Verdict.OK.severity, int)
    assert_type(fgreg.SolveConfig().limit_mm, float)
    assert fgreg.Verdict.OK.severity < fgreg.Verdict.REFUSED.severity


def test_measurements_are_solved_as_in_their_session(pose_session: Path) -> None:
    report = fgreg.solve(str(pose_session), fgreg.SolveConfig(limit_mm=3.0), out=pose_session / "own.yaml")
    assert (pose_session / "own.yaml").is_file()
    assert not (pose_session / "result.yaml").exists()
    extracted = report.extracted
    estimate = fgreg.solve_measurements(extracted.measurements, report.session.model, tracks=extracted.tracks)
    assert estimate.verdict is report.estimate.verdict
    assert estimate.verdict is not fgreg.Verdict.REFUSED
    ours, theirs = estimate.epochs[0].predicted_tre, report.estimate.epochs[0].predicted_tre
    assert ours is not None
    assert theirs is not None
    assert ours.worst_mm == pytest.approx(theirs.worst_mm, rel=1e-6)
    assert [track.stage_rad for track in estimate.tracks] == [track.stage_rad for track in report.estimate.tracks]


def test_the_readme_s_python_runs_with_public_names_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages = (CHECKOUT / "README.md", CHECKOUT / "docs" / "python.md")
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    program = "\n".join(part.split("```")[0] for part in text.split("```python\n")[1:])
    tree = ast.parse(program)
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    assert [ast.unparse(node) for node in imports] == ["import fgreg"]
    used = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)]
    assert {node.attr for node in used if ast.unparse(node.value) == "fgreg"} <= {*fgreg.__all__}

    shutil.copytree(CHECKOUT / "sessions" / "paper", tmp_path / "sessions" / "paper")
    (tmp_path / "my-session").mkdir()
    shutil.copy(CHECKOUT / "sessions" / "paper" / "session.yaml", tmp_path / "my-session")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(tree, "README.md", "exec"), names)
    solved, online = names["report"].estimate, names["now"]
    assert solved.verdict is not fgreg.Verdict.REFUSED
    assert online.trus_T_camera == pytest.approx(solved.epochs[0].trus_T_camera, abs=0.5)
    assert names["answer"].stage_rad is None
    assert len((tmp_path / "my-session" / "events.jsonl").read_text(encoding="utf-8").splitlines()) == 2
