"""Mappings of a document as dataclasses: the ``Annotated`` type of a field says what the file has for it.

    @dataclass(frozen=True, slots=True)
    class StageModel:
        step_rad: Annotated[float, Key("sweep increment", Number(0.0, 180.0, above=True, unit="deg", degrees=True))]
        direction: Annotated[int, Key("-1 where the device turns the other way", Integer(allowed=(1, -1)))] = 1

reads ``{step_deg: 2.0}``. A field without a :class:`Key` is not in the file: who reads gives its value. Rules between
fields are checked where the object is made: ``__post_init__`` raises :class:`FieldError` with the key's name. Those
that JSON Schema can say, too, are a class's ``JSON_RULES``.
"""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.schema.kinds import JsonSchema, Kind, ListOf, Number, Numbers, Text, Truth
from fgreg.schema.problems import FieldError, Problem, nearest, shown


@dataclass(frozen=True, slots=True)
class Key:
    """Description of a dataclass field in a file.

    Attributes:
        help: one line for tables and examples.
        kind: of its value; None: from the field's type (truth values, texts, described dataclasses, tuples of these).
        name: in the file; empty: the field's, with ``_deg`` for ``_rad`` where the kind converts. ``a.b`` is the key
            ``b`` of a mapping ``a`` of its own.
        default: for tables, where the default is not the field's own; the key may then be absent, and who reads gives
            the value.
        required: whether the key has to be there, where that is not so because the field has no default.
        null: ``null`` may be written for None.
        brief: left out by writers where it has its default.
        requires: another key of the same mapping, without which it means nothing.
        required_if: a key and a value: where that key has that value this one has to be there.
        example: what an example shows where there is no default.
    """

    help: str
    kind: Kind | None = None
    name: str = ""
    default: str = ""
    required: bool | None = None
    null: bool = False
    brief: bool = False
    requires: str = ""
    required_if: tuple[str, object] | None = None
    example: str = ""


@dataclass(frozen=True, slots=True)
class NotStored:
    """Marks a field that is not in the file, with the value it gets on reading."""

    value: object


class Inline:
    """Marks a field whose own keys are in the same mapping: an object made of some of the mapping's keys."""


@dataclass(frozen=True, slots=True)
class Field:
    """A key of a mapping: its name there, the attribute that it becomes (of ``part``, where that is an object made of
    some of the mapping's keys), and whether it has to be there."""

    name: str
    attribute: str
    kind: Kind
    required: bool
    default: Any
    key: Key
    part: str = ""


class Record(Kind):
    """A mapping that becomes an object of a described dataclass. Names that start with ``x_`` are the user's own.

    Attributes:
        cls: the dataclass.
        constants: keys that always have one value: ``format``, ``type``.
        fields: the others, in order; those of a section of their own are in that section's record.
        names: of all keys that the mapping may have.
    """

    def __init__(self, cls: type, constants: Mapping[str, str] | None = None, fields: tuple[Field, ...] = ()) -> None:
        self.cls = cls
        self.constants = dict(constants or {})
        self.fields = fields or tuple(_fields(cls))
        self.names = (*self.constants, *(field.name for field in self.fields))
        self._known = frozenset(self.names)
        self._required = tuple(field for field in self.fields if field.required)
        self._related = tuple(field for field in self.fields if field.key.requires or field.key.required_if)
        self._parts: dict[str, Record] = {}
        self._not_stored: dict[str, object] = {}
        for field, hint, metadata in () if fields else _metadata(cls):
            for entry in metadata:
                if isinstance(entry, Inline):
                    self._parts[field.name] = record(hint)
                elif isinstance(entry, NotStored):
                    self._not_stored[field.name] = entry.value

    def read(self, value: object, folder: Path | None = None, /, **given: object) -> Any:
        """The object; ``given`` are the fields that are not in the file."""
        values = self.values(value, folder)
        problems: list[Problem] = []
        made = None
        try:
            parts = {name: part.make(values.pop(name, {})) for name, part in self._parts.items()}
            made = self.make({**values, **parts, **self._not_stored, **given})
        except FieldError as error:
            problems += error.problems
        if isinstance(value, Mapping):
            for field in self._related:
                problems += self._relations(field, value)
        if problems:
            raise FieldError(problems, values)
        return made

    def make(self, values: Mapping[str, Any]) -> Any:
        """The object of values by attribute. Raises FieldError where they do not fit together."""
        try:
            return self.cls(**values)
        except FieldError:
            raise
        except ValueError as error:
            raise FieldError.of(f"values that do not fit together ({error})", "values that do") from None

    def values(self, value: object, folder: Path | None = None, /) -> dict[str, Any]:
        """The values of the present keys, by attribute. Raises FieldError with all problems."""
        if not isinstance(value, Mapping):
            raise FieldError.of(shown(value), self.expected)
        problems = [] if self._known >= value.keys() else list(self._unknown(value))
        misspelt = {problem.meant for problem in problems}
        texts = getattr(value, "texts", None)
        out: dict[str, Any] = {}
        for name, constant in self.constants.items():
            found = value.get(name)
            if found != constant and name not in misspelt:
                problems.append(Problem((name,), shown(found) if name in value else "nothing", constant))
        for field in self.fields:
            name = field.name
            if name not in value:
                if field.required and name not in misspelt:
                    problems.append(Problem((name,), "nothing", field.kind.expected))
                continue
            entry = value[name]
            if texts and field.kind.takes_text:
                entry = texts.get(name, entry)
            try:
                read = None if entry is None and field.key.null else field.kind.read(entry, folder)
            except FieldError as error:
                problems += error.below(name)
            else:
                if not field.attribute:
                    out.update(read or {})
                elif field.part:
                    out.setdefault(field.part, {})[field.attribute] = read
                else:
                    out[field.attribute] = read
        if problems:
            raise FieldError(problems, out)
        return out

    def _unknown(self, value: Mapping[str, object]) -> Iterator[Problem]:
        """Problems of unknown keys, each with the most similar absent key."""
        for key in value:
            if key in self._known or key.startswith("x_"):
                continue
            meant = nearest(key, [name for name in self.names if name not in value])
            every = f"one of {', '.join(self.names)}, or a name that starts with x_"
            yield Problem((key,), "an unknown key", f"a known one (did you mean {meant}?)" if meant else every, meant)

    def _relations(self, field: Field, value: Mapping[str, object]) -> Iterator[Problem]:
        requires, condition = field.key.requires, field.key.required_if
        if requires and field.name in value and requires not in value:
            yield Problem((field.name,), f"it without {requires}", "both or none")
        if condition and field.name not in value and self._holds(condition, value):
            yield Problem((field.name,), "nothing", field.kind.expected)

    @staticmethod
    def _holds(condition: tuple[str, object], value: Mapping[str, object]) -> bool:
        return condition[0] in value and value[condition[0]] is condition[1]

    def write(self, value: Any, folder: Path | None = None, /) -> dict[str, Any]:
        out: dict[str, Any] = dict(self.constants)
        for field in self.fields:
            if not field.attribute and isinstance(field.kind, Section):
                if section := field.kind.write(value, folder):
                    out[field.name] = section
                continue
            entry = getattr(getattr(value, field.part) if field.part else value, field.attribute)
            condition = field.key.required_if
            if entry is None:
                if field.key.null and (condition is None or self._holds(condition, out)):
                    out[field.name] = None
            elif not (field.key.brief and np.array_equal(entry, field.default)):
                try:
                    out[field.name] = field.kind.write(entry, folder)
                except FieldError as error:
                    raise FieldError(error.below(field.name)) from None
        return out

    @property
    def expected(self) -> str:
        return f"a mapping with {', '.join(self.names)}"

    @property
    def name(self) -> str:
        """Name of its JSON Schema."""
        tags = [value for key, value in self.constants.items() if key != "format"]
        return ".".join([self.cls.__name__.removeprefix("_"), *tags])

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        if self.name not in definitions:
            definitions[self.name] = {}  # keeps the order, and ends a recursion
            definitions[self.name] = self._json_schema(definitions)
        return {"$ref": f"#/$defs/{self.name}"}

    def _json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        properties: JsonSchema = {name: {"const": constant} for name, constant in self.constants.items()}
        for field in self.fields:
            schema = field.kind.json_schema(definitions)
            schema = {"anyOf": [schema, {"type": "null"}]} if field.key.null else schema
            properties[field.name] = {**schema, "description": field.key.help} if field.key.help else schema
        out: JsonSchema = {
            "type": "object",
            "properties": properties,
            "required": [*self.constants, *(field.name for field in self._required)],
            "patternProperties": {"^x_": {}},
            "additionalProperties": False,
        }
        if needs := {field.name: [field.key.requires] for field in self.fields if field.key.requires}:
            out["dependentRequired"] = needs
        conditions = [
            {
                "if": {"properties": {field.key.required_if[0]: {"const": field.key.required_if[1]}}},
                "then": {"required": [field.name]},
            }
            for field in self.fields
            if field.key.required_if
        ]
        rules = [*conditions, *getattr(self.cls, "JSON_RULES", ())]
        return {**out, "allOf": rules} if rules else out


class Section(Record):
    """A mapping that stays one: of its values by attribute.

    Such are the parts of a file whose keys are fields of the object that holds them (``initial`` of a session).
    """

    def __init__(self, name: str, fields: tuple[Field, ...]) -> None:
        super().__init__(dict, None, fields)
        self._name = name

    def read(self, value: object, folder: Path | None = None, /, **_given: object) -> dict[str, Any]:
        return self.values(value, folder)

    @property
    def name(self) -> str:
        return self._name


class Tagged(Kind):
    """A mapping of one of several kinds; the key ``tag`` says which.

    Attributes:
        tag: the key.
        records: of each value of it.
    """

    def __init__(self, tag: str, classes: Mapping[str, type]) -> None:
        self.tag = tag
        self.records = {name: record(cls, (tag, name)) for name, cls in classes.items()}
        self.names = {cls: name for name, cls in classes.items()}
        self._tag = Text(self.expected, tuple(self.records))

    def read(self, value: object, folder: Path | None = None, /, **given: object) -> Any:
        """As :meth:`Record.read`."""
        if not isinstance(value, Mapping):
            raise FieldError.of(shown(value), f"a mapping with {self.tag}")
        name = value.get(self.tag)
        if not isinstance(name, str) or name not in self.records:
            if self.tag not in value:
                raise FieldError.of("nothing", self.expected, self.tag)
            try:
                self._tag.read(name)
            except FieldError as error:
                raise FieldError(error.below(self.tag)) from None
        return self.records[str(name)].read(value, folder, **given)

    def write(self, value: Any, folder: Path | None = None, /) -> dict[str, Any]:
        return self.records[self.names[type(value)]].write(value, folder)

    @property
    def expected(self) -> str:
        return f"one of {', '.join(self.records)}"

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"oneOf": [entry.json_schema(definitions) for entry in self.records.values()]}


@functools.cache
def record(cls: type, constant: tuple[str, str] | None = None) -> Record:
    """The record of a described dataclass, with ``constant`` (key and value) where it is the top of a document."""
    return Record(cls, dict([constant]) if constant else None)


def _fields(cls: type) -> Iterator[Field]:
    """The described fields of a dataclass; those of a section together, where the first of them is."""
    sections: dict[str, list[Field]] = {}
    order: list[Field | str] = []
    for field, hint, metadata in _metadata(cls):
        if any(isinstance(entry, Inline) for entry in metadata):
            order += [dataclasses.replace(entry, part=field.name) for entry in record(hint).fields]
            continue
        key = next((entry for entry in metadata if isinstance(entry, Key)), None)
        if key is None:
            continue
        kind = key.kind or kind_of(hint)
        converted = isinstance(kind, Number | Numbers) and (kind if isinstance(kind, Number) else kind.each).degrees
        name = key.name or (field.name.removesuffix("_rad") + "_deg" if converted else field.name)
        if field.default is not dataclasses.MISSING:
            default = field.default
        elif field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        else:
            default = dataclasses.MISSING
        section, _, inner = name.rpartition(".")
        required = key.required
        if required is None:
            required = default is dataclasses.MISSING and not key.default
        made = Field(inner, field.name, kind, required, default, key)
        if section:
            if section not in sections:
                order.append(section)
            sections.setdefault(section, []).append(made)
        else:
            order.append(made)
    for entry in order:
        if isinstance(entry, str):
            parts = tuple(sections[entry])
            entry = Field(entry, "", Section(f"{cls.__name__}.{entry}", parts), False, None, Key(""))
        yield entry


def _metadata(cls: type) -> Iterator[tuple[dataclasses.Field[Any], Any, tuple[object, ...]]]:
    """Each field with its type and what its ``Annotated`` says. Modules of described classes do not postpone the
    evaluation of annotations, which would be compiled again here."""
    for field in dataclasses.fields(cls):
        if isinstance(field.type, str):
            raise TypeError(f"annotations of {cls.__module__} are texts: they must not be postponed")
        yield field, getattr(field.type, "__origin__", field.type), getattr(field.type, "__metadata__", ())


def kind_of(hint: Any) -> Kind:
    """The kind of a type: truth values, texts, described dataclasses, and tuples of these."""
    if isinstance(hint, types.UnionType):
        (hint,) = (entry for entry in typing.get_args(hint) if entry is not types.NoneType)
    if hint is bool:
        return Truth()
    if hint is str:
        return Text()
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return record(hint)
    if typing.get_origin(hint) is tuple:
        return ListOf(kind_of(typing.get_args(hint)[0]))
    raise TypeError(f"{hint} needs a kind")
