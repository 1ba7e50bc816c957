"""The tool that counts layers and import circles."""

from __future__ import annotations

from pathlib import Path

from structure import measure


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
