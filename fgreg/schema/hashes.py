"""The kind of a mapping of SHA-256 hashes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fgreg.schema.kinds import JsonSchema, Kind
from fgreg.schema.problems import FieldError, shown

_SHA256 = "[0-9a-f]{64}"


@dataclass(frozen=True, slots=True)
class Hashes(Kind):
    """A mapping of names to SHA-256 hashes; one hash alone is that of ``events.jsonl``."""

    def read(self, value: object, _folder: Path | None = None, /) -> dict[str, str]:
        if isinstance(value, str):
            value = {"events.jsonl": value}
        if not isinstance(value, Mapping) or not value:
            raise FieldError.of(shown(value), self.expected)
        for name, entry in value.items():
            if not isinstance(entry, str) or not re.fullmatch(_SHA256, entry):
                raise FieldError.of(shown(entry), "a SHA-256, 64 hexadecimal digits", str(name))
        return {str(name): entry for name, entry in value.items()}

    def write(self, value: Any, _folder: Path | None = None, /) -> dict[str, str]:
        return dict(value)

    @property
    def expected(self) -> str:
        return "SHA-256 hashes by name"

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        one = {"type": "string", "pattern": f"^{_SHA256}$"}
        return {"anyOf": [one, {"type": "object", "minProperties": 1, "additionalProperties": one}]}
