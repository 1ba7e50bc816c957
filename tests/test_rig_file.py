"""rig.yaml: written and read back, what a session takes from it, and rigs that do not fit."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.errors import InputError
from fgreg.geometry.rig import COUNT, Constant
from fgreg.graph.packing import pack
from fgreg.live.launch import make_folder
from fgreg.model.commissioned_rig import CommissionedRig
from fgreg.model.solve_config import SolveConfig
from fgreg.pipeline.commission import check_session_against
from fgreg.registration.register import register
from fgreg.registration.solve import distance_to_explicit
from fgreg.session.rig_file import read_rig, section_hashes, write_rig
from fgreg.session.session_reader import read_session
from tests import rigs, session_files

CONSTANTS = (Constant.RADIUS, Constant.TILT_RADIAL, Constant.TAG_SIZE)
VALUE = np.array([0.2, np.radians(0.5), -0.01])
COVARIANCE = np.diag([0.1, np.radians(0.1), 0.001]) @ (
    np.array([[1.0, 0.6, -0.3], [0.6, 1.0, 0.1], [-0.3, 0.1, 1.0]]) @ np.diag([0.1, np.radians(0.1), 0.001])
)


def rig(**changes: Any) -> CommissionedRig:
    made = CommissionedRig.of(
        CONSTANTS, VALUE, COVARIANCE, np.array([0.2, np.radians(0.2), 0.003]), ({"events.jsonl": 64 * "a"},), "today"
    )
    return replace(made, **changes)


def taken_up(folder: Path, of: CommissionedRig) -> Path:
    write_rig(of, folder / "rig.yaml")
    with (folder / "session.yaml").open("a") as file:
        file.write("rig: rig.yaml\n")
    return folder


def test_it_is_written_in_the_units_of_session_yaml_and_read_back(tmp_path: Path) -> None:
    write_rig(rig(), tmp_path / "rig.yaml")
    document = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    assert document["format"] == "fgreg-rig/1"
    assert document["names"] == ["radius_mm", "array_tilt_deg[1]", "tag_size"]
    assert document["values"] == pytest.approx([0.2, 0.5, -0.01])
    assert document["covariance"][0][1] == pytest.approx(0.6 * 0.1 * 0.1)
    assert document["prior_sigmas"] == pytest.approx([0.2, 0.2, 0.003])
    again = read_rig(tmp_path / "rig.yaml")
    assert again.constants == CONSTANTS
    assert again.value == pytest.approx(VALUE)
    assert again.covariance == pytest.approx(COVARIANCE)
    assert again.sessions == rig().sessions


def test_names_may_be_in_any_order(tmp_path: Path) -> None:
    write_rig(rig(), tmp_path / "rig.yaml")
    document = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    for key in ("names", "values", "prior_sigmas", "covariance"):
        document[key] = document[key][::-1]
    document["covariance"] = [row[::-1] for row in document["covariance"]]
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(document))
    again = read_rig(tmp_path / "rig.yaml")
    assert again.names == rig().names
    assert again.value == pytest.approx(VALUE)
    assert again.covariance == pytest.approx(COVARIANCE)
    assert again.prior_sigmas == pytest.approx(rig().prior_sigmas)


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"names": ["radius_mm", "tilt", "tag_size"]}, "names[1]"),
        ({"names": ["radius_mm", "radius_mm", "tag_size"]}, "names"),
        ({"values": [0.2, 0.5]}, "values"),
        ({"covariance": [[0.01, 0.0, 0.0], [0.0, 0.01, 0.0]]}, "covariance"),
        ({"covariance": [[0.01, 0.02, 0.0], [0.02, 0.01, 0.0], [0.0, 0.0, 1e-6]]}, "covariance"),
        ({"sessions": [{"events.jsonl": "abc"}]}, "sessions[0]"),
        ({"format": "fgreg-rig/2"}, "format"),
    ],
)
def test_a_bad_rig_is_one_error_that_names_the_key(tmp_path: Path, change: dict[str, Any], where: str) -> None:
    write_rig(rig(), tmp_path / "rig.yaml")
    document = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump({**document, **change}))
    with pytest.raises(InputError) as error:
        read_rig(tmp_path / "rig.yaml")
    assert where in error.value.where


def test_a_session_takes_means_and_full_covariance_from_it(tmp_path: Path) -> None:
    folder = taken_up(rigs.write(tmp_path / "s", 1), rig())
    model = read_session(folder).model
    assert model.rig is not None
    means = np.zeros(COUNT)
    means[list(CONSTANTS)] = VALUE
    assert model.constant_means == pytest.approx(means)
    assert model.constant_sigmas[list(CONSTANTS)] == pytest.approx(np.sqrt(np.diag(COVARIANCE)))
    assert model.constant_sigmas[Constant.SOUND_SPEED] == 0.01  # not in the rig: as in systematic
    measurements = extract_measurements(read_session(folder).events, model).measurements
    prior = pack(measurements, model).prior
    columns = pack(measurements, model).columns.constants
    at = [columns.index(constant) for constant in CONSTANTS]
    covariance = np.linalg.inv(prior.information)
    scale = np.sqrt(np.diag(COVARIANCE))
    assert covariance[np.ix_(at, at)] / np.outer(scale, scale) == pytest.approx(
        COVARIANCE / np.outer(scale, scale), abs=1e-6
    )
    assert prior.mean[at] == pytest.approx(VALUE, abs=1e-9)
    # One that is made less certain depends on no other one.
    sigmas = model.constant_sigmas
    sigmas[Constant.RADIUS] = 5.0
    free = np.linalg.inv(pack(measurements, model, sigmas=sigmas).prior.information)
    assert free[at[0], at[0]] == pytest.approx(25.0, rel=1e-6)
    assert free[at[0], at[1]] == pytest.approx(0.0, abs=1e-9)


def test_the_rig_brings_the_registration_to_its_values_in_both_graphs(tmp_path: Path) -> None:
    """A rig that knows the true constants well: they stay, and the explicit graph has the same optimum."""
    constants = tuple(rigs.OFF)
    order = tuple(sorted(constants))
    value = rigs.truth(order)
    exact = CommissionedRig.of(order, value, np.diag((0.02 * np.abs(value)) ** 2), np.abs(value), (), "today")
    session = read_session(taken_up(rigs.write(tmp_path / "s", 2), exact))
    registration = register(
        extract_measurements(session.events, session.model).measurements, session.model, SolveConfig()
    )
    assert registration.optimum.state.constants[0, list(order)] == pytest.approx(value, rel=0.06)
    assert distance_to_explicit(registration) < 0.01


def test_a_session_with_another_probe_camera_or_print_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    session_files.write(folder)
    hashes = section_hashes(read_session(folder).model)
    assert set(hashes) == {"probe", "camera", "marker", "board"}
    taken_up(folder, rig(sessions=(hashes,)))
    assert read_session(folder).model.rig is not None
    document = yaml.safe_load((folder / "session.yaml").read_text())
    for section, key, value in (
        ("probe", "radius_mm", 11.0),
        ("camera", "right_T_left", session_files.IDENTITY),
        ("marker", "dictionary", "DICT_4X4_100"),
        ("board", "square_mm", 12.0),
    ):
        changed = {**document, section: {**document[section], key: value}}
        (folder / "session.yaml").write_text(yaml.safe_dump(changed))
        with pytest.raises(InputError, match=f"session.yaml: {section}: found another one"):
            read_session(folder)
    (folder / "session.yaml").write_text(yaml.safe_dump({**document, "name": "another-name", "noise": {}}))
    read_session(folder)


def test_the_rig_has_to_be_in_the_sessions_folder(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    session_files.write(folder)
    write_rig(rig(), tmp_path / "rig.yaml")
    text = (folder / "session.yaml").read_text()
    for name, found in (("../rig.yaml", "rig.yaml"), ("absent.yaml", "absent.yaml"), ("[1]", "rig")):
        (folder / "session.yaml").write_text(f"{text}rig: {name}\n")
        with pytest.raises(InputError, match=found):
            read_session(folder)


def test_a_live_session_gets_its_rig(tmp_path: Path) -> None:
    session_files.write(tmp_path / "from")
    taken_up(tmp_path / "from", rig())
    model = read_session(tmp_path / "from").model
    text = (tmp_path / "from" / "session.yaml").read_text()
    make_folder(tmp_path / "to", text, model.rig_file)
    shutil.rmtree(tmp_path / "from")
    assert (tmp_path / "to" / "rig.yaml").is_file()
    (tmp_path / "to" / "events.jsonl").touch()
    assert read_session(tmp_path / "to").model.rig is not None


def test_values_that_no_rig_has_are_doubted_by_file_and_key(tmp_path: Path) -> None:
    absurd = rig(stored_values=np.array([1540.0, 0.5, 0.4]), prior_sigmas=np.array([0.2, 40.0, 0.003]))
    radius, tag, prior = read_session(taken_up(rigs.write(tmp_path / "s", 1), absurd)).warnings
    assert radius.startswith("rig.yaml: values, radius_mm: 1540 mm is hardly the difference of a constant from what is")
    assert tag.startswith("rig.yaml: values, tag_size: 0.4 is hardly")
    assert prior == "rig.yaml: prior_sigmas, array_tilt_deg[1]: 40 deg is hardly a standard deviation (0 to 10 deg)"
    assert read_session(taken_up(rigs.write(tmp_path / "t", 1), rig())).warnings == ()


def test_a_rig_beside_systematic_none_is_an_error(tmp_path: Path) -> None:
    """One says that all constants are exact, the other how exact."""
    folder = taken_up(rigs.write(tmp_path / "s", 1), rig())
    document = yaml.safe_load((folder / "session.yaml").read_text())
    (folder / "session.yaml").write_text(yaml.safe_dump({**document, "systematic": "none"}))
    with pytest.raises(InputError, match="found none beside a rig, expected one of the two"):
        read_session(folder)


def test_a_rig_that_was_made_from_the_session_is_an_error(tmp_path: Path) -> None:
    folder = rigs.write(tmp_path / "s", 1)
    digest = hashlib.sha256((folder / "events.jsonl").read_bytes()).hexdigest()
    made = rig(sessions=({"events.jsonl": digest},))
    with pytest.raises(InputError, match="found a rig that was made from this session, expected one of other sessions"):
        check_session_against(made, folder)
    with pytest.raises(InputError, match=r"session\.yaml: rig: found a rig that was made from this session"):
        read_session(taken_up(folder, made))
    with (folder / "events.jsonl").open("a") as file:  # another session now
        file.write('{"type": "note", "t": 1e6, "text": "more"}\n')
    assert read_session(folder).model.rig is not None
