"""Files of OpenCV (FileStorage: YAML, XML, JSON) and MATLAB (``.mat`` before v7.3) as plain names and arrays.

Their parsers end the process at deep nesting or on damaged files, or loop for ever. So this module is also a program
that reads one file from standard input, within limits, and prints what it has found.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fgreg.errors import InputError
from fgreg.schema.limits import CONFINED_SECONDS, SETUP_BYTES, confine
from fgreg.session.yaml_loader import read_bounded
from fgreg.workers.threads import NAMES

Storage = dict[str, object]
"""Top-level names: arrays of doubles (matrices, lists of numbers), floats, texts; other values are left out."""


def is_storage(data: bytes) -> bool:
    """Whether a file is OpenCV's: the YAML version line or the types that only it writes, its XML root, or its JSON."""
    head = data.lstrip(b"\xef\xbb\xbf")
    if head.startswith(b"%YAML") or b"!!opencv-matrix" in head:
        return True
    if b"<opencv_storage>" in head[:4096]:
        return True
    return head.lstrip().startswith(b"{") and b'"opencv-matrix"' in head


def read_storage(path: Path, name: str) -> Storage:
    """The file's top level.

    Args:
        path: a regular file.
        name: how messages name it.

    Raises:
        InputError: OpenCV cannot read it.
    """
    answer = _confined("opencv", path, name, "OpenCV", "a file of cv2.FileStorage (YAML, XML, JSON)")
    return {key: np.array(value) if isinstance(value, list) else value for key, value in answer.items()}


def read_mat(path: Path, name: str) -> dict[str, object]:
    """The variables of a ``.mat`` file: structs as mappings, arrays as lists of rows, char as text.

    Args:
        path: a regular file.
        name: how messages name it.

    Raises:
        InputError: scipy cannot read it, or finds objects in it.
    """
    return _confined("mat", path, name, "scipy", "structs in a .mat file before v7.3")


def _confined(parser: str, path: Path, name: str, library: str, expected: str) -> dict[str, Any]:
    """What this module, run as a program, finds in a file.

    Raises:
        InputError: nothing that the library can read.
    """
    data = read_bounded(path, name, SETUP_BYTES)
    command = [sys.executable, "-P", "-m", "fgreg.drivers.confined_parsers", parser]
    try:
        done = subprocess.run(
            command,
            input=data,
            capture_output=True,
            timeout=4 * CONFINED_SECONDS,
            check=False,
            env={**os.environ, **dict.fromkeys(NAMES, "1"), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        answer = json.loads(done.stdout) if done.returncode == 0 else f"its parser ended by signal {-done.returncode}"
    except subprocess.TimeoutExpired:
        answer = f"not within {4 * CONFINED_SECONDS} s"
    if isinstance(answer, str):
        raise InputError(name, f"something that {library} cannot read ({answer})", expected)
    found: dict[str, Any] = answer
    return found


def _parse_storage(data: bytes) -> dict[str, object]:
    """The file's top level, arrays as lists. Raises what OpenCV raises; may end the process."""
    # From memory, so that OpenCV takes the format from the content and not from the file's name.
    storage = cv2.FileStorage(data.decode("utf-8-sig"), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    root = storage.root()
    found = {key: _value(root.getNode(key)) for key in root.keys()}  # noqa: SIM118  (a FileNode is no mapping)
    return {key: value for key, value in found.items() if value is not None}


def _value(node: cv2.FileNode) -> object:
    if node.isInt() or node.isReal():
        return float(node.real())
    if node.isString():
        return node.string()
    if node.isMap():
        try:
            return np.asarray(node.mat(), dtype=np.float64).tolist()
        except (cv2.error, SystemError, TypeError, ValueError):
            return None  # a mapping of another kind
    if node.isSeq():
        entries = [node.at(i) for i in range(node.size())]
        if entries and all(entry.isInt() or entry.isReal() for entry in entries):
            return [entry.real() for entry in entries]
    return None


def _parse_mat(data: bytes) -> dict[str, object]:
    """The file's variables. Raises anything on a damaged file; may end the process."""
    from scipy.io import loadmat, matlab

    stream: Any = io.BytesIO(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        stored = loadmat(stream, simplify_cells=True)

    def plain(value: Any) -> object:
        if isinstance(value, Mapping):
            return {str(key): plain(entry) for key, entry in value.items()}
        if isinstance(value, matlab.MatlabOpaque | matlab.MatlabFunction):
            raise ValueError("an object, not its struct")
        return value.tolist() if isinstance(value, np.ndarray | np.generic) else value

    return {key: plain(value) for key, value in stored.items() if not key.startswith("__")}


_PARSERS: dict[str, Callable[[bytes], dict[str, object]]] = {"opencv": _parse_storage, "mat": _parse_mat}


def main() -> None:
    """Print what is in the file at standard input as JSON, or why it cannot be read."""
    confine()
    try:
        answer = json.dumps(_PARSERS[sys.argv[1]](sys.stdin.buffer.read()))
    except Exception as error:  # on a damaged file a parser may raise anything
        answer = json.dumps(" ".join(str(error).split())[-120:] or type(error).__name__)
    sys.stdout.write(answer)


if __name__ == "__main__":
    main()
