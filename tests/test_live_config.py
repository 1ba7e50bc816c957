"""CONFIG.yaml of a live session: each mistake is one line before any device is opened; what is read is what runs."""

from __future__ import annotations

import importlib.util
import inspect
import math
import socket
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from fgreg.drivers.base import DriverContext
from fgreg.drivers.options import RecordedMotionOptions
from fgreg.drivers.registry import ENTRIES, Role, load
from fgreg.errors import InputError, MissingExtraError
from fgreg.live.config import LiveConfig, read_config
from fgreg.live.config_keys import RoomOptions, example_config, example_line
from fgreg.live.scope_holder import HolderSettings
from fgreg.model.time_sync import Latencies
from fgreg.session.setup_reader import read_setup
from fgreg.session.yaml_loader import parse_yaml
from fgreg.simulation.room import BUMP_EVERY_S
from fgreg.stage.limits import MotionLimits
from tests import live_configs, session_files
from tests.network_peers import free_port
from tests.session_files import ABSENT, change
from tests.test_camera_calibrations import LEVEL, info

pytest.importorskip("pyigtl", reason="pyigtl is not installed: pip install 'fgreg[igtl]'")
pytest.importorskip("serial", reason="pyserial is not installed: pip install 'fgreg[stage]'")


def error_of(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_config(path)
    text = str(caught.value)
    assert text.isprintable()
    assert len(text) < 450
    return text


CASES: list[tuple[str, Any, str, str, str]] = [
    # path, value, place, found, expected (parts of them)
    ("format", ABSENT, "format", "nothing", "fgreg-live/1"),
    ("format", "fgreg-live/2", "format (line 1)", "'fgreg-live/2'", "fgreg-live/1"),
    ("session", ABSENT, "session", "nothing", "a path"),
    ("session", "elsewhere.yaml", "session (line 2)", "nothing at", "relative to this file's folder"),
    ("session", 3, "session (line 2)", "3", "a path"),
    ("session", "a\0", "session (line 2)", "nothing at", "a path"),
    ("colour", "red", "colour", "an unknown key", "one of format, session"),
    ("camra", {}, "camra", "an unknown key", "one of format"),
    ("camera", ABSENT, "camera", "nothing", "a mapping with driver"),
    ("camera", None, "camera (line 3)", "null", "a mapping with driver"),
    ("camera", [{"driver": "endoscope"}], "camera (line 3)", "a list of 1", "a mapping with driver"),
    ("camera.driver", ABSENT, "camera.driver", "nothing", "one of endoscope, recorded, ros2, simulated"),
    ("camera.driver", "endoscop", "camera.driver (line 4)", "'endoscop'", "(did you mean endoscope?)"),
    ("camera.driver", ["endoscope"], "camera.driver (line 4)", "['endoscope']", "one of endoscope"),
    ("camera.left", ABSENT, "camera.left", "nothing", "a video device"),
    ("camera.left", -1, "camera.left (line 5)", "-1", "a video device"),
    ("camera.left", 10**30, "camera.left (line 5)", "'1000", "a video device"),
    ("camera.left", True, "camera.left (line 5)", "true", "a video device"),
    ("camera.left", "left.mp4", "camera.left (line 5)", "'left.mp4'", "relative to this file's folder"),
    ("camera.left", "left/*.png", "camera.left (line 5)", "'left/*.png'", "a folder of pictures"),
    ("camera.layout", "side-by-side", "camera (line 3)", "with two inputs", "values that do"),
    ("camera.right", ABSENT, "", "", ""),
    ("camera.swap", True, "camera (line 3)", "swap is for frames that hold both views", "values that do"),
    ("camera.fps", 0, "camera.fps (line 7)", "0", "> 0 and <= 1000"),
    ("camera.fourcc", "MJPEG", "camera.fourcc (line 8)", "'MJPEG'", "four characters such as MJPG"),
    ("camera.fields", "odd", "camera.fields", "'odd'", "one of whole, top, bottom, both"),
    ("camera.path", "bag", "camera.path", "a key of another driver", "one of endoscope's: left, right"),
    ("camera.heigth", 3, "camera.heigth", "an unknown key", "(did you mean height?)"),
    ("photoacoustic", ABSENT, "photoacoustic", "nothing", "a mapping with driver"),
    ("photoacoustic.driver", "bk", "photoacoustic.driver", "'bk'", "one of igtl, simulated"),
    ("photoacoustic.port", 70000, "photoacoustic.port", "70000", "an integer from 1 to 65535"),
    ("photoacoustic.port", "18944", "photoacoustic.port", "'18944'", "an integer from 1"),
    ("photoacoustic.host", "a b", "photoacoustic.host", "'a b'", "a host name or an IP address"),
    ("photoacoustic.device", "ImageOfTheProbeInUse1", "photoacoustic.device", "'ImageOfTheProbeInUse1'", "1 to 20"),
    ("photoacoustic.silent_s", 0, "photoacoustic.silent_s", "0", "> 0"),
    ("stage.driver", "PRM1Z8", "stage.driver", "'PRM1Z8'", "one of thorlabs, ros2, simulated, stand-in"),
    ("stage.limits", [1], "stage.limits", "[1]", "a mapping with sweep_deg"),
    ("stage.limits.home_speed_deg_s", 31, "stage.limits.home_speed_deg_s", "31", "<= 30 deg/s"),
    ("stage.limits.home_speed_deg_s", 0, "stage.limits.home_speed_deg_s", "0", "> 0"),
    ("stage.limits.marker_age_s", 0.5, "stage.limits.marker_age_s", "0.5", "<= 0.2 s"),
    ("stage.limits.sweep_deg", [30, -40], "stage.limits.sweep_deg", "[30.0, -40.0]", "the lower end"),
    ("stage.limits.sweep_deg", [-40, 130], "stage.limits", "leaves the stage's limits", "session.yaml"),
    ("stage.limits.heartbeat_s", 5, "stage.limits.heartbeat_s", "an unknown key", "one of sweep_deg, home_speed"),
    ("stage.homed", True, "stage.homed", "a key of another driver", "one of thorlabs's: port"),
    ("motion.device", "", "motion.device", "''", "at most 20 characters"),
    ("motion.silent_s", False, "motion.silent_s", "false", "> 0"),
    ("bmode.host", ABSENT, "bmode.host", "nothing", "name or address of the scanner"),
    ("bmode.rate_hz", 10.0, "bmode.rate_hz", "10.0", "an integer from 1 to 100"),
    ("sinks", {"driver": "igtl"}, "sinks", "a mapping with 1 keys", "a list of mappings"),
    ("sinks", [], "sinks", "[]", "a list of mappings"),
    ("sinks.1.registration", "CameraToTransrectalUltrasound", "sinks[1].registration", "'Camera", "1 to 20"),
    ("sinks.1.header_version", 3, "sinks[1].header_version", "3", "an integer from 1 to 2"),
    ("sinks.1", {"driver": "igtl"}, "sinks[1]", "port 18945 again", "a port besides"),
    ("operator", "keyboard", "operator", "'keyboard'", "a mapping with driver"),
    ("operator", [], "operator", "[]", "a list of mappings"),
    ("operator.0.port", 3, "operator[0].port", "a key of another driver", "keyboard alone"),
    ("operator.1.driver", "mouse", "operator[1].driver", "'mouse'", "one of keyboard, igtl, ros2, simulated"),
    ("operator.0.driver", "simulated", "camera", "endoscope, and operator of the simulated room", "all simulated"),
    ("camera", {"driver": "simulated"}, "photoacoustic", "igtl, and camera of the simulated room", "all simulated"),
    ("room", {"seed": 1}, "room", "a room of which no device is used", "drivers called simulated"),
    ("settings", ABSENT, "settings", "nothing", "a mapping with aims"),
    ("settings.hearing_threshold", ABSENT, "settings.hearing_threshold", "nothing", "> 0"),
    ("settings.hearing_threshold", 0, "settings.hearing_threshold", "0", "> 0"),
    ("settings.most_pms", 4, "settings", "pms from 1 to most_pms", "values that do"),
    ("settings.aims", 2.5, "settings.aims", "2.5", "an integer from 0"),
    ("settings.camera_latency_s", -0.1, "settings.camera_latency_s", "-0.1", "0"),
    ("settings.holder_sigma_mm", 0, "settings.holder_sigma_mm", "0", "> 0"),
    ("settings.limit_mm", math.nan, "settings.limit_mm", "nan", "> 0"),
    ("calibration", {"left": "session.yaml"}, "calibration", "and a camera in the session.yaml", "one of the two"),
]


@pytest.mark.parametrize(("path", "value", "place", "found", "expected"), CASES)
def test_one_mistake_is_one_line_with_its_place(
    tmp_path: Path, path: str, value: Any, place: str, found: str, expected: str
) -> None:
    data = live_configs.config()
    change(data, path, value)
    file = live_configs.write(tmp_path, data)
    if not expected:
        read_config(file)
        return
    text = error_of(file)
    assert text.startswith(f"live.yaml: {place}")
    assert found in text.split(": found ")[1].split(", expected ")[0]
    assert expected in text.split(", expected ")[1]


def test_the_file_that_the_mistakes_are_made_in_is_read_as_it_says(tmp_path: Path) -> None:
    config = read_config(live_configs.write(tmp_path))
    assert config.setup == (tmp_path / "session.yaml").read_text()
    left, right = (getattr(config.devices[Role.CAMERA][0].options, key) for key in ("left", "right"))
    assert (left, right) == ("/dev/video90", "91")
    assert config.devices[Role.MOTION][0].options.silent_s is None
    assert config.devices[Role.PHOTOACOUSTIC][0].options.silent_s == 0.8
    assert [sink.options.port for sink in config.devices[Role.SINKS]] == [18945, 18946]
    assert [one.entry.name for one in config.devices[Role.OPERATOR]] == ["keyboard", "igtl"]
    assert (config.settings.hearing_threshold, config.settings.aims, config.solve.limit_mm) == (12.5, 6, 2.0)
    limits = MotionLimits.of_session(config.model.stage, **config.stage_limits)
    assert limits.sweep_rad == pytest.approx((math.radians(-40), math.radians(30.5)))
    assert (limits.search_speed_rad_s, limits.home_speed_rad_s) == pytest.approx((math.radians(20), math.radians(10)))
    assert limits.track_sigma_rad == pytest.approx(math.radians(1.5))
    with ExitStack() as stack:
        stage = config.live_setup(stack, lambda _: None).stage
    assert stage is not None
    assert (stage.driver, stage.options["port"]) == ("fgreg.drivers.thorlabs_stage:open_stage", "/dev/ttyUSB9")


def test_latencies_and_the_holder_are_read_with_their_units(tmp_path: Path) -> None:
    data = live_configs.config()
    data["settings"] |= {"camera_latency_s": 0.08, "pulse_latency_s": 0.01}
    data["settings"] |= {"holder_sigma_mm": 0.5, "holder_sigma_deg": 0.3, "holder_least_mm": 0.7}
    config = read_config(live_configs.write(tmp_path, data))
    assert config.latencies == Latencies(0.08, 0.01, 0.0)
    assert config.holder == HolderSettings(0.5, math.radians(0.3), 0.7)
    with ExitStack() as stack:
        setup = config.live_setup(stack, lambda _line: None)
    assert (setup.latencies, setup.holder) == (config.latencies, config.holder)


def test_without_an_operator_it_is_the_keyboard_and_without_a_stage_nothing_turns(tmp_path: Path) -> None:
    data = live_configs.config()
    for key in ("operator", "stage", "motion", "bmode", "sinks"):
        del data[key]
    config = read_config(live_configs.write(tmp_path, data))
    assert config.devices[Role.OPERATOR][0].entry.name == "keyboard"
    with ExitStack() as stack:
        assert config.live_setup(stack, lambda _: None).stage is None


def test_the_gate_uses_the_deceleration_that_the_stage_is_set_to(tmp_path: Path) -> None:
    data = live_configs.config()
    data["stage"]["acceleration_deg_s2"] = 5
    with ExitStack() as stack:
        setup = read_config(live_configs.write(tmp_path, data)).live_setup(stack, lambda _: None).stage
    assert setup is not None
    assert setup.limits["deceleration_rad_s2"] == pytest.approx(math.radians(5.0))
    assert setup.limits["search_speed_rad_s"] == pytest.approx(math.radians(20.0))


SESSIONS: list[tuple[str, str, str]] = [
    ("board", "a session.yaml without board", "settings.aims: 0"),
    ("marker", "a session.yaml without marker", "one with marker"),
    ("camera", "a session.yaml without camera", "or calibration files here"),
]


@pytest.mark.parametrize(("missing", "found", "expected"), SESSIONS)
def test_a_session_that_lacks_what_live_needs_is_refused(
    tmp_path: Path, missing: str, found: str, expected: str
) -> None:
    session = session_files.setup()
    del session[missing]
    text = error_of(live_configs.write(tmp_path, session=session))
    assert text.startswith("live.yaml: session (line 2): found ")
    assert found in text
    assert expected in text


def test_without_aims_no_board_is_needed_and_a_probe_needs_channels_or_an_image(tmp_path: Path) -> None:
    session, data = session_files.setup(), live_configs.config()
    del session["board"]
    data["settings"]["aims"] = 0
    assert read_config(live_configs.write(tmp_path, data, session)).settings.aims == 0
    del session["probe"]["channels"], session["probe"]["image"]
    assert "without probe.channels and probe.image" in error_of(live_configs.write(tmp_path, data, session))


def test_two_views_need_two_calibrated_cameras(tmp_path: Path) -> None:
    session = session_files.setup()
    del session["camera"]["right"], session["camera"]["right_T_left"]
    text = error_of(live_configs.write(tmp_path, session=session))
    assert text.startswith("live.yaml: camera (line 3): found the layout separate where one camera is calibrated")


def test_a_mistake_in_the_session_is_reported_with_its_own_file_and_line(tmp_path: Path) -> None:
    session = session_files.setup()
    session["probe"]["pitch_mm"] = -1
    text = error_of(live_configs.write(tmp_path, session=session))
    assert text.startswith("session.yaml: probe.pitch_mm (line 5): found -1")


def test_paths_are_relative_to_the_file_and_a_session_may_be_a_folder(tmp_path: Path) -> None:
    data = live_configs.config()
    data["session"], data["camera"] = "set-up", {"driver": "endoscope", "left": "pictures/*.png", "layout": "mono"}
    file = live_configs.write(tmp_path, data)
    session_files.write(tmp_path / "set-up")
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "1.png").write_bytes(session_files.png(640, 480))
    config = read_config(file)
    assert config.devices[Role.CAMERA][0].options.left == str(tmp_path / "pictures/*.png")
    assert config.model.name == "phantom-01"


def stereo_calibration(folder: Path) -> None:
    info(folder, "left", r=LEVEL)
    info(folder, "right", r=LEVEL, p3=-700.0 * 0.005)


def test_calibration_files_bring_the_camera_and_halve_it_for_fields(tmp_path: Path) -> None:
    session, data = session_files.setup(), live_configs.config()
    del session["camera"]
    stereo_calibration(tmp_path)
    data["calibration"] = {"left": "left.yaml", "right": "right.yaml"}
    config = read_config(live_configs.write(tmp_path, data, session))
    assert config.model.camera is not None
    assert config.model.camera.left.matrix[1] == pytest.approx([0.0, 810.0, 240.25])
    assert config.model.camera.right_T_left is not None
    assert config.model.camera.right_T_left[:3, 3] == pytest.approx([-5.0, 0.0, 0.0])
    problems: list[InputError] = []
    again = read_setup(parse_yaml(config.setup, "s"), "s", "s", problems)  # what the new session's folder gets
    assert not problems
    assert config.warnings == ()
    info(tmp_path, "right", r=LEVEL, p3=700.0 * 0.005)
    (warning,) = read_config(live_configs.write(tmp_path, data, session)).warnings
    assert "are the two swapped?" in warning
    info(tmp_path, "right", r=LEVEL, p3=-700.0 * 0.005)
    assert again.camera is not None
    assert np.array_equal(again.camera.left.distortion, [-0.25, 0.125, 0.001, -0.002, 0.5])
    data["camera"]["fields"] = "both"
    halved = read_config(live_configs.write(tmp_path, data, session)).model.camera
    assert halved is not None
    assert halved.left.image_size == (640, 240)
    assert halved.left.matrix[1] == pytest.approx([0.0, 405.0, 120.125])


def test_pictures_are_rectified_where_that_is_asked_and_possible(tmp_path: Path) -> None:
    session, data = session_files.setup(), live_configs.config()
    del session["camera"]
    stereo_calibration(tmp_path)
    data["calibration"] = {"left": "left.yaml", "right": "right.yaml", "pictures": "rectify"}
    config = read_config(live_configs.write(tmp_path, data, session))
    assert config.rectified is not None
    assert config.model.camera is not None
    assert not config.model.camera.left.distortion.any()
    data["calibration"]["right"] = None
    assert "two cameras, to rectify" in error_of(live_configs.write(tmp_path, data, session))


CALIBRATIONS: list[tuple[dict[str, Any], str, str]] = [
    ({}, "calibration.left (line 49): found nothing", "a path"),
    ({"left": "no.yaml"}, "calibration.left (line", "a path, relative"),
    ({"left": "left.yaml", "unit": "cm"}, "calibration.unit (line", "one of m, mm"),
    ({"left": "left.yaml", "pictures": "flat"}, "calibration.pictures (line", "one of raw, rectified, rectify"),
    ({"left": "live.yaml"}, "live.yaml: found no camera_matrix", "a calibration: ROS"),
]


@pytest.mark.parametrize(("calibration", "where", "expected"), CALIBRATIONS)
def test_a_mistake_in_the_calibration_is_one_line(
    tmp_path: Path, calibration: dict[str, Any], where: str, expected: str
) -> None:
    session, data = session_files.setup(), live_configs.config()
    del session["camera"]
    stereo_calibration(tmp_path)
    data["calibration"] = calibration
    text = error_of(live_configs.write(tmp_path, data, session))
    assert where in text
    assert expected in text


def test_the_simulated_room_brings_its_own_set_up(tmp_path: Path) -> None:
    config = read_config(live_configs.write(tmp_path, live_configs.room()))
    assert config.warnings == ()
    assert config.room == RoomOptions(3, BUMP_EVERY_S, 320)
    assert config.model.camera is not None
    assert config.model.camera.left.image_size[0] == 320
    assert config.settings.aims == 3
    data = live_configs.room()
    data["session"] = "session.yaml"
    assert "it, and the simulated room" in error_of(live_configs.write(tmp_path, data))
    data = live_configs.room()
    del data["operator"]
    assert "no one tells the room's surgeon" in read_config(live_configs.write(tmp_path, data)).warnings[0]
    data = live_configs.room()
    data["stage"] = {"driver": "stand-in"}
    assert "stand-in, and camera of the simulated room" in error_of(live_configs.write(tmp_path, data))


def test_a_missing_library_is_one_line_that_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = live_configs.write(tmp_path)
    find = importlib.util.find_spec
    for module, package, extra in (("pyigtl", "pyigtl", "igtl"), ("serial", "pyserial", "stage")):
        with monkeypatch.context() as patch:
            patch.setattr(
                importlib.util,
                "find_spec",
                lambda name, hidden=module: None if name == hidden else find(name),
            )
            with pytest.raises(MissingExtraError) as caught:
                read_config(file)
            assert str(caught.value) == f"{package} is not installed; install it with: pip install 'fgreg[{extra}]'"


def test_reading_a_config_imports_no_device_library_and_opens_nothing(tmp_path: Path) -> None:
    file = live_configs.write(tmp_path)
    script = (
        "import sys, threading\n"
        "from pathlib import Path\n"
        "from fgreg.live.config import read_config\n"
        f"read_config(Path({str(file)!r}))\n"
        "print([m for m in ('pyigtl', 'serial', 'rosbags', 'rerun') if m in sys.modules], threading.active_count())\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[] 1\n"


def test_the_example_reads_back_and_its_commented_defaults_are_the_defaults(tmp_path: Path) -> None:
    text = example_config()
    example = read_config(live_configs.write(tmp_path, text))
    whole = []
    for line in text.splitlines():
        body = line.strip()
        optional = ("layout", "width", "height", "fps", "fourcc", "port: /dev", "sweep_deg")
        nested = line.startswith(" ") and body.startswith("# ") and not body[2:].startswith(optional)
        whole.append(line.replace("# ", "", 1) if nested else line)
    spelled = read_config(live_configs.write(tmp_path, "\n".join(whole)))
    assert sum(a != b for a, b in zip(whole, text.splitlines(), strict=True)) > 25
    for role, chosen in example.devices.items():
        ours, theirs = ([asdict(one.options) for one in several] for several in (spelled.devices[role], chosen))
        for options in (*ours, *theirs):
            options.pop("limits", None)
        assert ours == theirs
    first, second = (MotionLimits.of_session(one.model.stage, **one.stage_limits) for one in (spelled, example))
    assert (spelled.settings, first) == (example.settings, second)
    assert (spelled.solve, spelled.warnings) == (example.solve, ())


def test_the_example_has_every_driver_and_every_key() -> None:
    text = example_config()
    blocks = [line.strip("# ").split("  #")[0] for line in text.splitlines()]
    for entry in ENTRIES:
        assert any(line.removeprefix("- ") == f"driver: {entry.name}" for line in blocks)
        for key in entry.record.fields:
            assert any(line.startswith(f"{key.name}:") for line in blocks), (entry.name, key.name)
    assert max(len(line) for line in text.splitlines()) <= 140


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: f"{entry.role}-{entry.name}")
def test_every_driver_of_the_example_is_one_that_can_be_named_and_has_its_factory(entry: Any) -> None:
    for place in (entry.factory, entry.check, entry.ask):
        if place is None:
            continue
        *_, last = inspect.signature(load(place)).parameters.values()
        if (entry.role, place) != (Role.STAGE, entry.factory):  # which is called with the options' own keys
            assert last.annotation in {kind.__name__ for kind in entry.options.__mro__}
    keys = [key for key in entry.record.fields if key.name != "limits"]
    assert set(yaml.safe_load("\n".join(map(example_line, keys))) or {}) == {key.name for key in keys}


def opened(config: LiveConfig, stack: ExitStack) -> Any:
    return config.live_setup(stack, lambda _: None).open_devices(stack, config.model)


def test_devices_are_those_of_the_config_and_closed_with_the_stack(tmp_path: Path) -> None:
    data = live_configs.config()
    data["photoacoustic"] |= {"host": "127.0.0.1", "port": free_port()}
    data["motion"] = {"driver": "igtl", "port": free_port(), "listen": True}
    data["operator"] = [{"driver": "keyboard"}, {"driver": "igtl", "port": free_port(), "listen": True}]
    data["sinks"] = [{"driver": "igtl", "port": free_port()}, {"driver": "igtl", "port": free_port()}]
    config = read_config(live_configs.write(tmp_path, data))
    ports = [sink["port"] for sink in data["sinks"]]
    with ExitStack() as stack:
        devices = opened(config, stack)
        assert devices.camera.name == "/dev/video90 and /dev/video91"
        assert devices.probe.name == f"127.0.0.1:{data['photoacoustic']['port']}"
        assert devices.operator.name.startswith("keyboard and listening on")
        assert list(devices.roles()) == ["camera", "probe", "operator", "motion", "bmode", "sink 1", "sink 2"]
        for port in ports:
            socket.create_connection(("127.0.0.1", port), timeout=2.0).close()
    for port in ports:
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.1", port), timeout=2.0)


def test_a_port_that_is_taken_is_one_line_and_leaves_nothing_open(tmp_path: Path) -> None:
    first, second = free_port(), free_port()
    data = live_configs.config()
    data["sinks"] = [{"driver": "igtl", "port": first}, {"driver": "igtl", "port": second}]
    config = read_config(live_configs.write(tmp_path, data))
    with socket.create_server(("127.0.0.1", second)):
        with pytest.raises(InputError, match=f"listening on 127.0.0.1:{second}"), ExitStack() as stack:
            opened(config, stack)
        socket.create_server(("127.0.0.1", first)).close()


def test_two_operators_have_two_keys(tmp_path: Path) -> None:
    pytest.importorskip("pyigtl", reason="pyigtl is not installed: pip install 'fgreg[igtl]'")
    key, data = tmp_path / "a.key", live_configs.config()
    key.write_text(bytes(range(48)).hex())
    data["operator"] = [{"driver": "igtl", "port": port, "key": "a.key"} for port in (18946, 18947)]
    key.chmod(0o644)
    assert "operator[0] (line" in (error := error_of(live_configs.write(tmp_path, data)))
    assert "a key that others can read (mode 644)" in error
    key.chmod(0o600)
    assert "operator[1]" in (error := error_of(live_configs.write(tmp_path, data)))
    assert "the key a.key again, expected another key than live.yaml: operator[0]" in error
    (tmp_path / "b.key").write_bytes(key.read_bytes() + b"\n")  # a copy is no other key
    (tmp_path / "b.key").chmod(0o600)
    data["operator"][1]["key"] = "b.key"
    assert "the key b.key again, expected another key than live.yaml: operator[0]" in error_of(
        live_configs.write(tmp_path, data)
    )
    data["operator"] = {"driver": "igtl", "words": ["next", "home"]}
    assert "found home without a key, expected a key beside it" in error_of(live_configs.write(tmp_path, data))


def test_listening_beyond_this_machine_gives_a_warning(tmp_path: Path) -> None:
    data = live_configs.config()
    data["sinks"][0]["host"] = "0.0.0.0"
    (warning,) = read_config(live_configs.write(tmp_path, data)).warnings
    assert warning.startswith("live.yaml: sinks[0]")
    assert "other machines can connect" in warning


def test_devices_that_play_one_recording_share_its_time(tmp_path: Path) -> None:
    bags = pytest.importorskip("tests.bags")
    path = tmp_path / "bag"
    bags.write_bag(path, [("/ECM/measured_cp", t / 10, bags.pose_stamped(t / 10, (0.0, 0.0, 0.1))) for t in range(5)])
    context = DriverContext(lambda _: None)
    entry = next(entry for entry in ENTRIES if (entry.role, entry.name) == (Role.MOTION, "recorded"))
    options = RecordedMotionOptions(path=path)
    entry.checked(options)
    devices = [entry.open(context, options) for _ in range(2)]
    assert len(context.paces) == 1
    for device in devices:
        device.close()
    with pytest.raises(InputError, match="no such topic"):
        entry.checked(replace(options, topic="/other"))


def test_the_page_of_devices_shows_a_config_that_reads(tmp_path: Path) -> None:
    page = (Path(__file__).parents[1] / "docs" / "devices.md").read_text(encoding="utf-8")
    (block,) = [part.split("```")[0] for part in page.split("```yaml\n")[1:] if part.startswith("format: fgreg-live")]
    config = read_config(live_configs.write(tmp_path, block))
    assert {role.value for role in config.devices} == {"camera", "photoacoustic", "stage", "sinks", "operator"}


@pytest.mark.parametrize("seen", [True, False])
def test_a_scanner_for_overlay_is_opened_only_for_a_display(tmp_path: Path, seen: bool) -> None:
    scanner = {"driver": "bk", "host": "127.0.0.1", "port": free_port()}
    config = read_config(live_configs.write(tmp_path, live_configs.room() | {"bmode": scanner}))
    with ExitStack() as stack:
        live = config.live_setup(stack, lambda _: None, seen=seen)
        devices = live.open_devices(stack, config.model)
        assert ("bmode" in devices.roles()) == seen
        assert (None if devices.bmode is None else devices.bmode.name) == (
            f"127.0.0.1:{scanner['port']}" if seen else None
        )
