"""The command ``fgreg schema``."""

from __future__ import annotations

import importlib
import json
from enum import StrEnum
from typing import Annotated

import typer


class Document(StrEnum):
    """Documents that have a JSON Schema."""

    SESSION = "session"
    EVENTS = "events"
    RESULT = "result"
    RIG = "rig"
    LIVE = "live"
    RECORDING = "recording"


DESCRIPTIONS = {
    Document.SESSION: ("fgreg.model.session_model:SESSION", "session.yaml: how a session was set up"),
    Document.EVENTS: ("fgreg.model.events:EVENTS", "a line of events.jsonl: what happened in a session"),
    Document.RESULT: ("fgreg.model.estimate:RESULT", "result.yaml: the result of a session"),
    Document.RIG: ("fgreg.model.commissioned_rig:RIG", "rig.yaml: the constants of a commissioned rig"),
    Document.LIVE: ("fgreg.live.config_keys:LIVE", "CONFIG.yaml: devices of a live session"),
    Document.RECORDING: (
        "fgreg.model.setup_recording:SETUP_LINES",
        "a line of a set-up recording: what fgreg setup finds signs and constants from",
    ),
}
"""Module and name of each description, and its title."""


def add_schema(app: typer.Typer) -> None:
    """Register the command."""

    @app.command()
    def schema(
        document: Annotated[
            Document, typer.Argument(metavar="DOCUMENT", help="session, events, result, rig, live or recording.")
        ],
    ) -> None:
        """Print the JSON Schema (draft 2020-12) of a document: for editors, and for programs that write sessions.

        A schema checks keys, types and bounds. `fgreg check` knows more: rigid matrices, covariances, and what an event
        needs of its session. Of events and recordings, each line is one document.
        """
        typer.echo(json.dumps(document_schema(document), indent=2, ensure_ascii=False))


def document_schema(document: Document) -> dict[str, object]:
    """A document's JSON Schema."""
    from fgreg.schema.kinds import JsonSchema

    place, title = DESCRIPTIONS[document]
    module, _, name = place.partition(":")
    definitions: dict[str, JsonSchema] = {}
    top = getattr(importlib.import_module(module), name).json_schema(definitions)
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, "title": title, **top, "$defs": definitions}
