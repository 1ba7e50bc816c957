"""Bytes changed, cut out or put in at random: a file is read, or refused in one line; there is no other outcome."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from fgreg.convert.bag import read_bag
from fgreg.convert.mapping import RecordingMapping
from fgreg.convert.plus import read_plus
from fgreg.convert.table import read_table
from fgreg.drivers.calibration_files import read_calibration
from fgreg.errors import FgregError
from tests import (
    bags,
    test_camera_calibration_texts,
    test_camera_calibrations,
    test_convert_bags,
    test_convert_plus_sequences,
    test_convert_ros1_and_tf,
    test_convert_tables,
)

MAPPING = RecordingMapping()
THROUGH_TF = RecordingMapping(tf={"marker": ("optical", "marker"), "scan": ("holder", "probe")})


def damaged(data: bytes, chance: random.Random) -> bytes:
    out = bytearray(data)
    if chance.random() < 0.3:
        return bytes(out[: chance.randrange(len(out))])
    for _ in range(chance.choice([1, 1, 3, 20])):
        at, what = chance.randrange(len(out)), chance.random()
        if what < 0.5:
            out[at] = chance.randrange(256)
        elif what < 0.75 and len(out) > 40:
            del out[at : at + chance.randrange(1, 20)]
        else:
            out[at:at] = chance.randbytes(chance.randrange(1, 9))
    return bytes(out)


def sequence(folder: Path) -> Path:
    return test_convert_plus_sequences.by_hand(folder / "a.mha", test_convert_plus_sequences.three(), compressed=True)


def table(folder: Path) -> Path:
    row = f"1,{test_convert_tables.POSE},2,3,30,0\n"
    return test_convert_tables.table(folder, test_convert_tables.ROW + 3 * row)


def opencv(folder: Path) -> Path:
    c = test_camera_calibrations
    return c.storage(folder / "s.xml", M1=c.M1, D1=c.D1, M2=c.M2, D2=c.D2, R=c.R, T=c.T, image_size=(640, 240))


def kalibr(folder: Path) -> Path:
    path = folder / "k.yaml"
    path.write_text(yaml.safe_dump(test_camera_calibrations.kalibr()), encoding="utf-8")
    return path


def ost(folder: Path) -> Path:
    return test_camera_calibration_texts.text(folder / "ost.txt", test_camera_calibration_texts.LEFT)


def matlab(folder: Path) -> Path:
    return test_camera_calibration_texts.written(folder, test_camera_calibration_texts.matlab())


def nrrd_sequence(folder: Path) -> Path:
    module = pytest.importorskip("tests.test_convert_nrrd_sequences")
    made: Path = module.as_plus(folder / "a.nrrd", test_convert_plus_sequences.three(), encoding="gzip")
    return made


def ros1(folder: Path) -> Path:
    return bags.write_ros1_bag(folder / "a.bag", test_convert_ros1_and_tf.tree())


def recording(folder: Path) -> Path:
    return next(bags.write_bag(folder / "bag", test_convert_bags.room(), mcap=True).glob("*.mcap"))


@pytest.mark.parametrize(
    ("make", "read", "count"),
    [
        (sequence, lambda path: read_plus(path, MAPPING), 150),
        (table, lambda path: read_table(path, MAPPING), 150),
        (opencv, lambda path: read_calibration([path]), 6),
        (kalibr, lambda path: read_calibration([path]), 100),
        (ost, lambda path: read_calibration([path]), 100),
        (matlab, lambda path: read_calibration([path]), 100),
        (recording, lambda path: read_bag(path, MAPPING), 40),
        (ros1, lambda path: read_bag(path, THROUGH_TF), 20),
        (nrrd_sequence, lambda path: read_plus(path, MAPPING), 50),
    ],
    ids=["plus", "csv", "opencv", "kalibr", "ost", "matlab", "mcap", "ros1", "nrrd"],
)
def test_a_damaged_file_is_read_or_refused_in_one_line(
    tmp_path: Path, make: Callable[[Path], Path], read: Callable[[Path], object], count: int
) -> None:
    path = make(tmp_path)
    whole, chance, messages = path.read_bytes(), random.Random(7), list[str]()
    for _ in range(count):
        path.write_bytes(damaged(whole, chance))
        try:
            read(path)
        except FgregError as error:
            messages.append(str(error))
    assert all(message.isprintable() for message in messages)
    assert len(messages) > count // 4
