"""``fgreg devices``: data of each device of a configuration, silent devices; no stage is touched."""

from __future__ import annotations

import importlib.util
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgreg.cli.main import main
from fgreg.drivers import endoscope, thorlabs_identify, thorlabs_stage
from fgreg.drivers.thorlabs_identify import identify
from fgreg.live.config import read_config
from fgreg.live.device_check import DeviceReport, configured, cubes, extras, video
from fgreg.stage.interface import StageError, StageLost
from tests import live_configs, session_files
from tests.cube_emulator import CubeEmulator
from tests.igtl_bytes import image_body, message
from tests.network_peers import free_port, serve

pytest.importorskip("pyigtl", reason="pyigtl is not installed: pip install 'fgreg[igtl]'")

PULSE = np.zeros((1, 128, 16), dtype=np.int16)


@contextmanager
def scanner(pixels: Any = PULSE, rate_hz: float = 20.0) -> Iterator[int]:
    """A server of OpenIGTLink that sends images by a clock of its own; gives its port."""
    server, port = serve()
    stop = threading.Event()

    def run() -> None:
        peer, _ = server.accept()
        with peer:
            for number in range(1000):
                if stop.wait(1.0 / rate_hz):
                    return
                try:
                    peer.sendall(message("IMAGE", "Image_Pa", image_body(pixels), sent_s=500.0 + number / rate_hz))
                except OSError:
                    return

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield port
    finally:
        stop.set()
        server.close()
        thread.join(5.0)


@contextmanager
def cube(**options: Any) -> Iterator[CubeEmulator]:
    emulated = CubeEmulator(**options)
    try:
        yield emulated
    finally:
        emulated.close()


def pictures(folder: Path, width: int = 640, height: int = 480) -> None:
    for side in ("left", "right"):
        (folder / side).mkdir()
        for number in range(20):
            (folder / side / f"{number}.png").write_bytes(session_files.png(width, height))


def room(folder: Path, pa_port: int, stage_port: str, **more: Any) -> Path:
    """A CONFIG.yaml of a camera from pictures, a scanner, a cube and a sink."""
    data = {
        "format": "fgreg-live/1",
        "session": "session.yaml",
        "camera": {"driver": "endoscope", "left": "left", "right": "right", "fps": 50, "loop": True},
        "photoacoustic": {"driver": "igtl", "port": pa_port, "device": "Image_Pa"},
        "stage": {"driver": "thorlabs", "port": stage_port},
        "sinks": [{"driver": "igtl", "port": free_port()}],
        "settings": {"hearing_threshold": 1.0},
        **more,
    }
    return live_configs.write(folder, data)


def run(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    monkeypatch.setattr(sys, "argv", ["fgreg", "devices", *(str(word) for word in words)])
    with open(os.devnull) as nothing:  # noqa: PTH123
        monkeypatch.setattr(sys, "stdin", nothing)
        with pytest.raises(SystemExit) as exit_:
            main()
    assert isinstance(exit_.value.code, int)
    return exit_.value.code


def test_each_device_is_described_and_the_stage_is_not_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures(tmp_path)
    with scanner() as port, cube(device_deg=12.0) as stage:
        assert run(monkeypatch, room(tmp_path, port, stage.port), "--json") == 0
        assert (stage.orders, stage.complaints, stage.enabled, stage.device_deg) == ([], [], False, 12.0)
    answers = {one["what"]: one for one in json.loads(capsys.readouterr().out)["devices"]}
    assert list(answers) == ["camera", "photoacoustic", "stage", "sinks 1", "operator"]
    assert all(one["answers"] for one in answers.values())
    rate, rest = answers["camera"]["says"].split(" a second, ")
    assert 45.0 < float(rate) < 55.0
    assert rest == "640 x 480 px, colour, stereo, its own clock" or rest.startswith("640 x 480 px, grey, stereo")
    rate, rest = answers["photoacoustic"]["says"].split(" a second, ")
    assert float(rate) == pytest.approx(20.0, abs=0.1)  # by the sender's clock, which is exact
    assert rest == "128 x 16 int16, its own clock"
    assert answers["stage"]["says"] == f"KDC101 no. 27000001 at {stage.port}, 0.0 deg, has to find its zero position"
    assert answers["sinks 1"]["says"].startswith("no one connected within 2 s")
    assert answers["operator"]["says"] == "standard input, not a terminal"


def test_silent_devices_are_named_and_the_status_is_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures(tmp_path)
    gone = tmp_path / "ttyUSB7"
    config = room(tmp_path, free_port(), str(gone), camera={"driver": "endoscope", "left": "left", "loop": True})
    began = time.monotonic()
    assert run(monkeypatch, config) == 1
    assert time.monotonic() - began < 12.0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    marks = {line[1]: line[0] for line in lines if line and line[0] in ("+", "-")}
    assert [marks[what] for what in ("camera", "photoacoustic", "stage", "sinks", "operator")] == list("+--++")
    text = {line[1]: " ".join(line) for line in lines if len(line) > 2}
    assert "nothing came within 2 s: photoacoustic source" in text["photoacoustic"]
    assert f"stage at {gone} cannot be opened" in text["stage"]


def answers_of(config: Path, listen_s: float = 0.8) -> dict[str, DeviceReport]:
    return {answer.what: answer for answer in configured(read_config(config), listen_s)}


def test_what_session_yaml_says_otherwise_does_not_count_as_an_answer(tmp_path: Path) -> None:
    pictures(tmp_path, 320, 240)
    with scanner(np.zeros((1, 64, 16), dtype=np.int16)) as port, cube() as stage:
        session = session_files.setup()
        del session["probe"]["image"]
        config = room(tmp_path, port, stage.port)
        session_files.write(tmp_path, session)
        found = answers_of(config)
    assert not found["camera"].answers
    assert "320 x 240 px" in found["camera"].says
    assert found["camera"].says.endswith("session.yaml has 640 x 480 px")
    assert not found["photoacoustic"].answers
    assert found["photoacoustic"].says.endswith("session.yaml has channel data: 128 x samples, float32 or int16")


def test_one_of_two_inputs_without_frames_does_not_pass(tmp_path: Path) -> None:
    pictures(tmp_path)
    camera = {"driver": "endoscope", "left": "left", "right": "/dev/video99", "fps": 50, "loop": True}
    with cube() as stage:
        found = answers_of(room(tmp_path, free_port(), stage.port, camera=camera), 1.2)["camera"]
    assert not found.answers
    assert "/dev/video99" in found.says


def test_a_connected_scanner_without_pulses_is_distinguished_from_none(tmp_path: Path) -> None:
    pictures(tmp_path)
    with scanner(rate_hz=0.01) as port, cube() as stage:
        pa = {"driver": "igtl", "port": port, "device": "Image_Pa", "silent_s": None}
        found = answers_of(room(tmp_path, 1, stage.port, photoacoustic=pa), 0.4)["photoacoustic"]
    assert (found.answers, found.says) == (False, "nothing came within 0.4 s, but it is connected")


def test_a_bad_config_is_one_line_and_status_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = live_configs.write(tmp_path, "format: fgreg-live/1\ncamera: {driver: kamera}\n")
    assert run(monkeypatch, config) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("fgreg: error: live.yaml: camera.driver (line 2): found 'kamera'")
    assert captured.err.count("\n") == 1
    assert run(monkeypatch, tmp_path / "none.yaml") == 2


def test_without_a_config_the_machine_is_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(endoscope, "video_devices", lambda: [])
    with cube() as stage:
        monkeypatch.setattr(thorlabs_stage, "find_ports", lambda: [stage.port, str(tmp_path / "tty")])
        assert run(monkeypatch, "--json") == 0
        assert (stage.orders, stage.enabled) == ([], False)
    document = json.loads(capsys.readouterr().out)
    assert {one["name"] for one in document["extras"]} == {"igtl", "stage", "ros", "ros2", "plots"}
    assert document["video_devices"] == []
    first, second = document["thorlabs_cubes"]
    assert first["answers"]
    assert first["says"].startswith("KDC101 no. 27000001")
    assert not second["answers"]
    assert "cannot be opened" in second["says"]


def test_video_devices_are_opened_or_only_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures(tmp_path)
    listed = [("/dev/video98", "a grabber"), (str(tmp_path / "left"), "")]
    monkeypatch.setattr(endoscope, "video_devices", lambda: listed)
    silent, there = video(0.4)
    assert not silent.answers
    assert silent.says.startswith("a grabber: nothing came within 0.4 s")
    assert there.answers
    assert "640 x 480 px" in there.says
    assert [one.says for one in video(0)] == ["a grabber", ""]


def test_a_missing_library_is_said_with_the_extra_that_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    said = {one.name: one.says for one in extras()}
    assert said["stage"].endswith("pip install 'fgreg[stage]'")
    assert said["stage"].startswith("pyserial is missing")
    assert not any(one.answers for one in extras())
    monkeypatch.setitem(sys.modules, "serial.tools", None)
    assert list(cubes()) == []


@pytest.mark.parametrize(("trouble", "error"), [({"model": b"KST101\0\0"}, StageError), ({"drop": 1}, StageLost)])
def test_a_device_that_is_no_cube_or_does_not_answer_is_reported(
    trouble: dict[str, Any], error: type[StageError], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(thorlabs_identify, "ANSWER_S", 0.4)
    drop = trouble.pop("drop", 0)
    with cube(**trouble) as stage:
        stage.drop = drop
        with pytest.raises(error, match=stage.port):
            identify(stage.port)
        assert stage.orders == []


def test_a_cube_is_identified_through_garbage_and_lost_replies() -> None:
    with cube(device_deg=0.0) as stage:
        stage.drop, stage.garbage, stage.homed = 2, b"\x64\x04\x01", True
        found = identify(stage.port)
    assert (found.model, found.serial, found.homed) == ("KDC101", 27000001, True)
    assert found.device_deg == pytest.approx(0.0, abs=1e-9)


def test_the_simulated_room_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, live_configs.write(tmp_path, live_configs.room())) == 0
    out = capsys.readouterr().out
    assert (
        "+ camera         simulated  simulated camera: 30.0 a second, 320 x 180 px, grey, stereo, its own clock" in out
    )
    assert "+ stage          simulated  of the simulated room: stands at" in out
    assert "+ operator       simulated  simulated operator: connected" in out


def test_a_port_in_use_is_reported(tmp_path: Path) -> None:
    pictures(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as holder, cube() as stage:
        taken = holder.getsockname()[1]
        config = room(tmp_path, free_port(), stage.port, sinks=[{"driver": "igtl", "port": taken}])
        found = answers_of(config, 0.1)["sinks 1"]
    assert not found.answers
    assert f"listening on 127.0.0.1:{taken}" in found.says
