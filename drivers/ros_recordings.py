"""ROS recordings read without ROS, by ``rosbags`` (extra ``[ros]``): rosbag2 folders, MCAP, SQLite and ROS 1 files."""

from __future__ import annotations

import functools
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from fgreg.drivers.ros_limits import bound_chunks, check_tables
from fgreg.drivers.ros_messages import IMAGE_TYPES, POSE_TYPES
from fgreg.errors import InputError, MissingExtraError

STORAGE_SUFFIXES = (".mcap", ".db3", ".bag")
ECM_POSE = "ECM/measured_cp"
"""CRTK's topic of the endoscope holder's pose, in any namespace but the setup joints' and ``local``."""
_OLD_ECM_POSE = "ECM/position_cartesian_current"
"""The same in versions of the dVRK before CRTK."""
_ZSTD = b"\x28\xb5\x2f\xfd"

_EXPECTED = "a ROS recording: a rosbag2 folder, .mcap, .db3, or .bag of ROS 1"


def is_recording(path: Path) -> bool:
    """Whether a path looks like a ROS recording."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in STORAGE_SUFFIXES


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a recording: message type such as ``sensor_msgs/msg/Image``, number of messages."""

    kind: str
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """One message: when it was recorded (ns, recorder's clock), and its bytes."""

    topic: str
    kind: str
    bag_ns: int
    raw: bytes | memoryview


class Recording:
    """An open recording. Use as a context manager, or close it.

    Raises:
        MissingExtraError: ``rosbags`` is not installed.
        InputError: no recording, or a damaged one.
    """

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.highlevel import AnyReader
        except ImportError:
            raise MissingExtraError("rosbags", "ros") from None
        self.path = path
        if not path.exists():
            raise InputError(str(path), "nothing", _EXPECTED)
        if not is_recording(path):
            raise InputError(
                str(path), "a folder without metadata.yaml" if path.is_dir() else "another file", _EXPECTED
            )
        bound_chunks()
        check_tables(path)
        self._reader: Any = None
        self._usual: set[str] = set()  # types whose definitions in the file were compared with ROS's own
        try:
            reader: Any = AnyReader([path], default_typestore=_common_types())
            reader.open()
            own = reader.typestore.fielddefs
            if any(c.msgtype not in own for c in reader.connections):  # in the file without a definition: ROS 2's
                common = _common_types().fielddefs
                reader.typestore.register({name: fields for name, fields in common.items() if name not in own})
        except Exception as error:  # on a damaged file the underlying parsers may raise anything
            raise self._damaged(error) from None
        self._reader = reader
        connections: list[Any] = reader.connections
        self.topics: Mapping[str, Topic] = {
            name: Topic(
                # A topic with messages of two types has neither.
                " and ".join(sorted({str(c.msgtype) for c in connections if c.topic == name})),
                sum(int(c.msgcount) for c in connections if c.topic == name),
            )
            for name in sorted({c.topic for c in connections})
        }
        self.start_ns: int = int(reader.start_time) if reader.message_count else 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the files; may be called twice."""
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """Messages of some topics in the order of recording.

        Raises:
            InputError: a damaged file.
        """
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        try:
            for connection, bag_ns, raw in self._reader.messages(connections=connections):
                yield Recorded(connection.topic, connection.msgtype, int(bag_ns), raw)
        except GeneratorExit:
            raise
        except Exception as error:
            raise self._damaged(error) from None

    def decode(self, recorded: Recorded) -> Any:
        """The message as an object with ROS's fields.

        Raises:
            InputError: its bytes do not fit its type.
        """
        where = f"{self.path.name}: {recorded.topic}"
        if bytes(recorded.raw[:4]) == _ZSTD:
            expected = "the whole folder with its metadata.yaml, which says so"
            raise InputError(where, "messages that are compressed one by one (zstd)", expected)
        if recorded.kind not in self._reader.typestore.fielddefs:
            expected = "its definition in the file, or a type of ROS 2's common ones"
            raise InputError(where, f"{recorded.kind} without a definition", expected)
        if recorded.kind not in self._usual:
            odd = _other_field(recorded.kind, self._reader.typestore.fielddefs)
            if odd:
                raise InputError(where, f"{recorded.kind} defined without the usual {odd}", "ROS's own definition")
            self._usual.add(recorded.kind)
        try:
            return self._reader.deserialize(recorded.raw, recorded.kind)
        except Exception as error:
            raise InputError(where, f"a message that cannot be read ({_words(error)})", recorded.kind) from None

    def topic(self, name: str, kinds: Collection[str], what: str) -> str:
        """Check that a topic exists and has one of some types.

        Raises:
            InputError: no such topic (with those that exist), or another type.
        """
        found = self.topics.get(name)
        where = f"{self.path.name}: {name}"
        if found is None:
            near = ", ".join(n for n, t in self.topics.items() if t.kind in kinds) or "none of its type"
            raise InputError(where, "no such topic", f"{what}; there is {near}")
        if found.kind not in kinds:
            raise InputError(where, found.kind, f"{what}: {' or '.join(sorted(kinds))}")
        return name

    def image_topic(self, side: str) -> str | None:
        """The topic of one camera's images by its name, or None; unrectified before others, raw before compressed.

        Args:
            side: ``left`` or ``right``.

        Raises:
            InputError: several topics match.
        """
        word = re.compile(rf"(?:^|[/_]){side}(?=[/_]|$)", re.IGNORECASE)
        found = [n for n, t in self.topics.items() if t.kind in IMAGE_TYPES and t.count and word.search(n)]
        if not found:
            return None
        ranked = sorted((("rect" in name, "compressed" in name.lower()), name) for name in found)
        best = [name for rank, name in ranked if rank == ranked[0][0]]
        if len(best) > 1:
            raise InputError(f"{self.path.name}: {side} camera", ", ".join(best), "one, named in the mapping (topics)")
        return best[0]

    def endoscope_pose_topic(self) -> tuple[str | None, str]:
        """The topic of the endoscope holder's pose (CRTK), or None, and what has to be said about that.

        The setup joints' pose (``SUJ/ECM``) does not have the arm's own motion, ``local`` ones do not have theirs.

        Raises:
            InputError: several topics match.
        """
        poses = [name for name, topic in self.topics.items() if topic.kind in POSE_TYPES]
        fixed = [name for name in poses if not {"SUJ", "local"} & set(name.split("/"))]
        for ending in (ECM_POSE, _OLD_ECM_POSE):
            found = [name for name in fixed if f"/{name}".endswith(f"/{ending}")]
            if len(found) > 1:
                where = f"{self.path.name}: the endoscope's pose"
                raise InputError(where, ", ".join(found), "one, named (in a mapping: topics.ecm)")
            if found:
                old = ending != ECM_POSE
                return found[0], f"camera moves are taken from {found[0]}, the older name of measured_cp" if old else ""
        other = [
            name for name in self.topics if ("ECM" in name.split("/") and "_cp" in name) or "ECM/position_c" in name
        ]
        if not other:
            return None, ""
        return None, f"camera moves are not known: there is no {ECM_POSE}, and of the ECM only {', '.join(other)}"

    def _damaged(self, error: Exception) -> InputError:
        mend = {".mcap": "mcap recover", ".bag": "rosbag reindex"}.get(self.path.suffix.lower())
        hint = f"; of a recorder that was cut off, {mend} makes one" if mend else ""
        return InputError(str(self.path), f"a recording that cannot be read ({_words(error)})", f"a whole one{hint}")


def _other_field(kind: str, own: Mapping[str, Any]) -> str:
    """A field of ROS's definition of a type, or of a type within it, that the file's own has not; '' if it has all.

    ROS 1 has further fields, and the capitals D, K, R and P. Types that are not ROS's common ones are not compared.
    """
    common = _common_types().fielddefs
    waiting, seen = [kind], set[str]()
    while waiting:
        name = waiting.pop()
        if name in seen or name not in common:
            continue
        seen.add(name)
        found = {field if len(field) > 1 else field.lower(): what for field, what in own.get(name, ((), ()))[1]}
        for field, what in common[name][1]:
            if found.get(field) != what:
                return f"{name}.{field}"
            waiting += [word for word in _type_words(what) if word in common]
    return ""


def _type_words(what: Any) -> Iterator[str]:
    """The names within a field's description, a tree of tuples."""
    for part in what[1] if isinstance(what[1], tuple) else (what[1],):
        if isinstance(part, tuple):
            yield from _type_words(part)
        elif isinstance(part, str):
            yield part


@functools.cache
def _common_types() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _words(error: BaseException) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:160]
