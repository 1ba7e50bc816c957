"""OpenCV FileStorage files (YAML, XML, JSON) as plain names and arrays; ``yaml.safe_load`` cannot read them.

OpenCV's parser ends the process at deep nesting, and some damaged files make it abort or loop for ever. So this module
is also a program that reads one file from standard input, within limits, and prints what it has found.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

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
    data = read_bounded(path, name, SETUP_BYTES)
    command = [sys.executable, "-P", "-m", "fgreg.drivers.opencv_storage"]
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
        found = f"something that OpenCV cannot read ({answer})"
        raise InputError(name, found, "a file of cv2.FileStorage (YAML, XML, JSON)")
    return {key: np.array(value) if isinstance(value, list) else value for key, value in answer.items()}


def _parse(data: bytes) -> dict[str, object]:
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


def main() -> None:
    """Print the top level of the file at standard input as JSON, or why it cannot be read."""
    confine()
    try:
        answer: object = _parse(sys.stdin.buffer.read())
    except (cv2.error, SystemError, ValueError, MemoryError) as error:
        answer = " ".join(str(error).split())[-120:]
    json.dump(answer, sys.stdout)


if __name__ == "__main__":
    main()
