"""OpenCV FileStorage files (YAML, XML, JSON) as plain names and arrays; ``yaml.safe_load`` cannot read them."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import cv2
import numpy as np

from fgreg.errors import InputError

Storage = dict[str, object]
"""Top-level names: arrays of doubles (matrices, lists of numbers), floats, texts; other values are left out."""


def is_storage(data: bytes) -> bool:
    """Whether a file is OpenCV's: the YAML version line or the types that only it writes, its XML root, or its JSON."""
    head = data.lstrip(b"\xef\xbb\xbf")
    if head.startswith(b"%YAML") or b"!!opencv-matrix" in head:
        return True
    if b"<opencv_storage>" in head[:4096]:
        return True
    if head.lstrip().startswith(b"{") and b"opencv-matrix" in head:
        with contextlib.suppress(ValueError):
            return isinstance(json.loads(head), dict)
    return False


def read_storage(path: Path, name: str) -> Storage:
    """The file's top level.

    Args:
        path: a regular file.
        name: how messages name it.

    Raises:
        InputError: OpenCV cannot read it.
    """
    expected = "a file of cv2.FileStorage (YAML, XML, JSON)"
    try:
        # From memory, so that OpenCV takes the format from the content and not from the file's name.
        text = path.read_bytes().decode("utf-8-sig")
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, UnicodeDecodeError, SystemError, ValueError) as error:
        raise InputError(name, f"something that OpenCV cannot read ({_first_words(error)})", expected) from None
    out: Storage = {}
    try:
        root = storage.root()
        for key in root.keys():  # noqa: SIM118  (a FileNode is no mapping)
            node = root.getNode(key)
            value = _value(node)
            if value is not None:
                out[key] = value
    except (cv2.error, SystemError) as error:
        raise InputError(name, f"something that OpenCV cannot read ({_first_words(error)})", expected) from None
    finally:
        storage.release()
    return out


def _value(node: cv2.FileNode) -> object:
    if node.isInt() or node.isReal():
        return float(node.real())
    if node.isString():
        return node.string()
    if node.isMap():
        try:
            return np.asarray(node.mat(), dtype=np.float64)
        except (cv2.error, SystemError, TypeError, ValueError):
            return None  # a mapping of another kind
    if node.isSeq():
        entries = [node.at(i) for i in range(node.size())]
        if entries and all(entry.isInt() or entry.isReal() for entry in entries):
            return np.array([entry.real() for entry in entries])
    return None


def _first_words(error: BaseException) -> str:
    return " ".join(str(error).split())[-120:]
