"""``result.yaml``: written atomically; every field is checked on reading (see fgreg.model.estimate)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fgreg.model.estimate import RESULT, SessionEstimate
from fgreg.model.session_model import SessionModel
from fgreg.output.atomic_file import FileKind, write_file
from fgreg.schema.limits import RESULT_BYTES, RESULT_NODES
from fgreg.schema.problems import FieldError, input_error
from fgreg.schema.yaml_writer import yaml_text
from fgreg.session.yaml_loader import load_yaml

RESULT_FILE = "result.yaml"

_ONE_LINE = frozenset(
    {
        "predicted_tre_mm",
        "excluded",
        "checks",
        "pairs",
        "tracks",
        "add",
        "track",
        "aims",
        "target_errors_mm",
        "settings",
    }
)

RESULT_KIND = FileKind("a result", (b"format: fgreg-result/",), file_name=RESULT_FILE)


def write_result(estimate: SessionEstimate, model: SessionModel, path: Path, version: str) -> None:
    """Write a result to a temporary file in the same folder, which is then renamed.

    Args:
        estimate: the result.
        model: of the session; its name is written.
        path: the file; an older result is replaced.
        version: of this package.

    Raises:
        InputError: the file cannot be written, or there is one that is not a result.
        ValueError: a transform of the estimate is not rigid, or an array not finite (a defect of the estimate).
    """
    document = RESULT.write(replace(estimate, session=model.name, version=version))
    # The format line comes first and unquoted: an older result is recognised by it.
    text = f"format: {document.pop('format')}\n" + yaml_text(document, _ONE_LINE)
    write_file(path, text, RESULT_KIND)


def read_result(path: Path) -> SessionEstimate:
    """Read a result and check every field.

    Times of the looks are not in the file: ``t`` of each pair is NaN. A predicted error that is ``null`` reads as
    infinite.

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
