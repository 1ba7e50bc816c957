"""The report's text: the template filled in. All that is not ``Markup`` is escaped."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from fgreg.errors import one_line
from fgreg.output.atomic_file import FileKind

if TYPE_CHECKING:
    from fgreg.html_report.viewer_3d import Viewer3D

HERE = Path(__file__).parent
HTML_REPORT = FileKind("a report", (b"<!doctype html>\n<!-- fgreg report -->",))


def _shown(value: object) -> object:
    """Texts of a session without line breaks, control characters and marks that turn the direction of writing."""
    return value if isinstance(value, Markup) or not isinstance(value, str) else one_line(value)


def render(parts: dict[str, Any], viewer: Viewer3D | None = None) -> str:
    """The report as HTML. ``parts``: of :func:`fgreg.html_report.contents.contents`; ``viewer``: to be put into it."""
    environment = Environment(
        loader=FileSystemLoader(HERE),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    style = Markup((HERE / "report.css").read_text(encoding="utf-8"))
    return environment.get_template("report.html").render(**parts, style=style, viewer=viewer)
