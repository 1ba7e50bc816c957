"""Peers of the network: who may say what, signatures, keys, and the example of the documentation."""

from __future__ import annotations

import os
import re
import stat
import time
from pathlib import Path

import pytest

from fgreg.drivers.base import CommandKind, OperatorCommand, RefusedWord
from fgreg.drivers.operator_words import MOST_AGE_S, MOTIONS
from fgreg.drivers.options import IgtlOperatorOptions
from fgreg.drivers.peer_words import PeerWords, check_operator
from fgreg.drivers.word_keys import read_key, sign
from fgreg.errors import InputError
from fgreg.schema.problems import FieldError

KEY = b"0123456789abcdef0123456789abcdef"
NOW = 1_764_501_234.5
DEVICES = Path(__file__).parents[1] / "docs" / "devices.md"


def refusal(peer: PeerWords, line: str, now_s: float = NOW) -> str:
    """Why a line is refused; empty if it counts."""
    found = peer.take(line, "peer", 10.0, now_s)
    assert not isinstance(found, str)
    return found.reason if isinstance(found, RefusedWord) else ""


@pytest.mark.parametrize("kind", [kind for kind in CommandKind if kind in MOTIONS])
def test_what_lets_the_stage_move_needs_a_key(kind: CommandKind) -> None:
    assert "a peer with a key" in refusal(PeerWords(), kind)
    assert refusal(PeerWords(key=KEY), kind) == "it is not signed"
    assert refusal(PeerWords(key=KEY), sign(kind, KEY, 1, NOW)) == ""
    assert "a peer with a key" in refusal(PeerWords(), sign(kind, KEY, 1, NOW))


def test_a_stop_is_anyones_also_badly_signed_or_not_among_the_words() -> None:
    for peer in (PeerWords(), PeerWords([], KEY), PeerWords([CommandKind.NEXT])):
        for line in ("stop", "x", "", "stop;1;2;3", sign("stop", b"wrong", 0, 0.0), "home;1;5;0 stop"):
            assert peer.take(line, "p", 10.0, NOW) == OperatorCommand(CommandKind.STOP)


def test_the_configuration_names_the_words_and_with_a_key_all_are_signed() -> None:
    peer = PeerWords([CommandKind.NEXT])
    assert refusal(peer, "next") == ""
    assert "not among the words" in refusal(peer, "moved")
    assert refusal(PeerWords(key=KEY), "next") == "it is not signed"
    assert isinstance(peer.take("nxt", "p", 10.0, NOW), str)


def test_a_signed_word_counts_once_in_time_and_unchanged() -> None:
    peer = PeerWords(key=KEY)
    line = sign("follow", KEY, 7, NOW - 0.2)
    found = peer.take(line, "peer", 10.0, NOW)
    assert found == OperatorCommand(CommandKind.FOLLOW)
    assert isinstance(found, OperatorCommand)
    assert found.peer == "peer"
    assert found.said_s == pytest.approx(9.8)
    assert "was used before" in refusal(peer, line)
    assert "was used before" in refusal(peer, sign("home", KEY, 6, NOW))
    assert "was used before" not in refusal(PeerWords(key=KEY), line)
    assert "0.6 s behind" in refusal(PeerWords(key=KEY), line, NOW + 0.4)  # as after a restart of fgreg
    fresh = sign("follow", KEY, 7, NOW - 0.2)
    assert "before this session began" in refusal(PeerWords(key=KEY, began_s=NOW - 0.1), fresh)
    assert "0.7 s ahead of" in refusal(peer, sign("home", KEY, 8, NOW + 0.7))
    for wrong in (line.replace("follow", "search"), line.replace(";7;", ";8;"), sign("follow", KEY + b".", 8, NOW)):
        assert "its signature is wrong" in refusal(peer, wrong)
    assert refusal(peer, sign("home", KEY, 8, NOW)) == ""  # refused words use no counter up


def test_the_signature_is_that_of_openssl_over_all_before_the_last_semicolon() -> None:
    """By printf WORD;COUNTER;TIME | openssl dgst -sha256 -hmac KEY."""
    signature = "6b997905cdadda7dc510f123c5412b66cfb60f1f2dada1b2fd380c17f9545907"
    assert sign("home", KEY, 17, NOW) == f"home;17;1764501234.500000;{signature}"


def key_file(folder: Path, data: bytes, mode: int = 0o600) -> Path:
    path = folder / "operator.key"
    path.write_bytes(data)
    path.chmod(mode)
    return path


@pytest.mark.parametrize(
    ("data", "mode", "found"),
    [
        (KEY, 0o640, "others can read (mode 640)"),
        (KEY, 0o604, "others can read (mode 604)"),
        (KEY[:31], 0o600, "a key of 31 bytes"),
        (KEY[:31] + b"\n", 0o600, "a key of 31 bytes"),
        (b"", 0o600, "a key of 0 bytes"),
        (b"k" * 64, 0o600, "hardly any different characters"),
        (KEY * 200, 0o600, "a longer one"),
    ],
)
def test_a_key_that_protects_nothing_is_one_line(tmp_path: Path, data: bytes, mode: int, found: str) -> None:
    with pytest.raises(InputError, match=re.escape(found)) as error:
        check_operator(IgtlOperatorOptions(key=key_file(tmp_path, data, mode)))
    assert "\n" not in str(error.value)
    assert "openssl rand -hex 32" in str(error.value)


def test_a_key_is_the_file_without_its_newline(tmp_path: Path) -> None:
    for end in (b"", b"\n", b"\r\n"):
        assert read_key(key_file(tmp_path, KEY + end)) == KEY
    with pytest.raises(InputError, match="directory"):
        read_key(tmp_path)
    with pytest.raises(InputError, match="No such file"):
        read_key(tmp_path / "none.key")
    os.mkfifo(tmp_path / "pipe.key", 0o600)  # no one writes to it
    with pytest.raises(InputError, match="no ordinary file"):
        read_key(tmp_path / "pipe.key")


def test_a_word_that_counted_before_a_restart_counts_in_no_later_session(tmp_path: Path) -> None:
    now = time.time()
    ahead = sign("home", KEY, 7, now + 0.9 * MOST_AGE_S)  # of a clock that is ahead
    assert refusal(PeerWords(key=KEY), ahead, now) == ""
    begun = PeerWords.of(None, key_file(tmp_path, KEY), None)
    assert "before this session began" in refusal(begun, ahead, now + 0.1)


def test_words_that_need_a_key_are_refused_without_one(tmp_path: Path) -> None:
    with pytest.raises(FieldError, match="home without a key"):
        check_operator(IgtlOperatorOptions(words=("next", "home")))
    check_operator(IgtlOperatorOptions(words=("next", "home"), key=key_file(tmp_path, KEY)))
    check_operator(IgtlOperatorOptions(words=("next", "stop")))


def test_the_example_of_the_documentation_signs_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = next(code for code in re.findall(r"```python\n(.*?)```", DEVICES.read_text(), re.DOTALL) if "hmac" in code)
    path = key_file(tmp_path, os.urandom(48).hex().encode() + b"\n")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(code, names)
    peer = PeerWords(key=read_key(path))
    signed_line = names["signed"]
    assert callable(signed_line)
    for word in ("home", "search", "aim 3 2"):
        found = peer.take(signed_line(word), "p", 10.0, time.time())
        assert isinstance(found, OperatorCommand)
        assert found.kind == word.split()[0]
