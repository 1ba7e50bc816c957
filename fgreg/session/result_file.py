"""``result.yaml``: written atomically; every field is checked on reading (see fgreg.model.estimate)."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from fgreg.errors import InputError
from fgreg.model.estimate import RESULT, SessionEstimate
from fgreg.model.session_model import SessionModel
from fgreg.schema.limits import RESULT_BYTES, RESULT_NODES
from fgreg.schema.problems import FieldError, input_error
from fgreg.schema.yaml_writer import yaml_text
from fgreg.session.atomic_file import why_refused, write_atomically
from fgreg.session.yaml_loader import load_yaml

RESULT_FILE = "result.yaml"

_SESSION_FILES = frozenset({"session.yaml", "events.jsonl", "ground_truth.yaml"})
_ONE_LINE = frozenset({"predicted_tre_mm", "checks", "pairs", "tracks", "add", "track"})

_FORMAT_LINE = b"format: fgreg-result/"


def remove_result(path: Path) -> None:
    """Remove an older result before work starts, so that it does not remain after a failure.

    Raises:
        InputError: the folder is absent or cannot be written to, or the path is not an older result.
    """
    if path.name in _SESSION_FILES:
        raise InputError(str(path), "the name of a session's own file", "another name for the result")
    if not path.parent.is_dir():
        raise InputError(str(path.parent), "no such folder", f"a folder to write {path.name} to")
    if path.is_dir() and not path.is_symlink():
        raise InputError(str(path), "a folder", "a file name for the result")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(str(path.parent), "a folder that cannot be written to", f"one to write {path.name} to")
    try:
        if os.path.lexists(path) and not _is_result(path):
            raise InputError(str(path), "a file that is not a result", "a new name, or that of an older result")
        path.unlink(missing_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(
            str(path), f"a file that cannot be removed ({why_refused(error)})", "an older result"
        ) from None


def _is_result(path: Path) -> bool:
    """Whether a file is a result, by its name in a session's folder or by its first line: nothing else is removed."""
    if path.is_symlink() or not path.is_file():
        return False
    if path.name == RESULT_FILE:
        return True
    with path.open("rb") as file:
        return file.read(len(_FORMAT_LINE)) == _FORMAT_LINE


def write_result(estimate: SessionEstimate, model: SessionModel, path: Path, version: str) -> None:
    """Write a result to a temporary file in the same folder, which is then renamed.

    Args:
        estimate: the result.
        model: of the session; its name is written.
        path: the file, replaced where it exists.
        version: of this package.

    Raises:
        InputError: the file cannot be written.
        ValueError: a transform of the estimate is not rigid, or an array not finite (a defect of the estimate).
    """
    document = RESULT.write(replace(estimate, session=model.name, version=version))
    # The format line comes first and unquoted: _is_result recognises an older result by it.
    text = f"format: {document.pop('format')}\n" + yaml_text(document, _ONE_LINE)
    write_atomically(path, text)


def read_result(path: Path) -> SessionEstimate:
    """Read a result and check every field.

    Times of the looks are not in the file: ``t`` of each pair is NaN; nor are the calibration shots. A predicted error
    that is ``null`` reads as infinite.

    Raises:
        InputError: the first problem of the file.
    """
    data = load_yaml(path, path.name, max_bytes=RESULT_BYTES, max_nodes=RESULT_NODES)
    try:
        estimate: SessionEstimate = RESULT.read(data)
        _check_indices(estimate)
    except FieldError as error:
        raise input_error(error.problems[0], path.name, data) from None
    return estimate


def _check_indices(estimate: SessionEstimate) -> None:
    """Raises FieldError where an epoch is not at its place in the list, or a look's is not in it."""
    for i, epoch in enumerate(estimate.epochs):
        if epoch.index != i:
            raise FieldError.of(str(epoch.index), f"{i}, the epoch's place in the list", "epochs", i, "index")
    last = max(0, len(estimate.epochs) - 1)
    for i, pair in enumerate(estimate.pairs):
        if pair.epoch > last:
            raise FieldError.of(str(pair.epoch), f"an integer from 0 to {last}", "pairs", i, "epoch")
