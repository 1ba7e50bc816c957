"""Drivers of other packages: the one of docs/drivers.md, options, what devices says of them, mistakes in one line."""

from __future__ import annotations

import importlib
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml

from fgreg.cli.main import main
from fgreg.cli.schema import Document, document_schema
from fgreg.drivers.base import DeviceLost, DriverContext
from fgreg.drivers.plugin_device import PluginDevice
from fgreg.drivers.registry import Role
from fgreg.errors import FgregError, InputError
from fgreg.live.config import read_config
from fgreg.live.device_check import configured, other_drivers
from fgreg.model.session_model import StageModel
from fgreg.stage.client import StageLink
from fgreg.stage.interface import StageError
from fgreg.stage.limits import MotionLimits
from fgreg.testing import drivers as kit
from tests import live_configs

jsonschema = pytest.importorskip("jsonschema")

PAGE = Path(__file__).resolve().parents[1] / "docs" / "drivers.md"
LAB = '''
"""Drivers that the tests name."""
import math, time
from pathlib import Path
from typing import Annotated, Literal
from fgreg.drivers.simulated_stage import SimulatedStage
from fgreg.schema.kinds import Number
from fgreg.schema.record import Key

class Stage(SimulatedStage):
    """A stage of the lab."""
    def __init__(self, model, port: str, gear: Annotated[float, Key("ratio", Number(1.0, 9.0))] = 2.0):
        if port == "gone":
            raise OSError("no such port")
        super().__init__(model, device_rad=math.radians(12.0), homed=True)

class Sink:
    """Writes the registration to a file."""
    connected, dropped, name = True, 0, "a file"
    def __init__(self, context, path: Path, mode: Literal["new", "append"] = "new", digits: int | None = None,
                 scale: tuple[float, ...] = (1.0,)):
        self.given = (context, path, mode, digits, scale)
    def send(self, registration):
        raise KeyError("an error of the lab")
    def close(self):
        raise KeyError("another one")

class Motion:
    """Gives something else than it should."""
    connected, dropped, name = True, 0, "motion"
    def poll(self):
        return ["here"]
    def close(self): ...

class Operator:
    """Raises where it may not."""
    def poll(self):
        return []
    def tell(self, text, *, done=False, wants=None):
        raise KeyError("no display")
    def close(self): ...

class NoPoll:
    def close(self): ...

class Untyped:
    def __init__(self, gain=1.0): ...
    def poll(self): ...
    def close(self): ...

number = 3
'''


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of installed packages: that of the page, and the lab's."""
    folder = tmp_path_factory.mktemp("site")
    toml, module, test = (
        PAGE.read_text(encoding="utf-8").split(f"```{kind}\n")[number].split("```")[0]
        for kind, number in (("toml", 1), ("python", 1), ("python", 2))
    )
    (folder / "fgreg_acme.py").write_text(module, encoding="utf-8")
    (folder / "test_fgreg_acme.py").write_text(test, encoding="utf-8")
    (folder / "fgreg_lab.py").write_text(LAB, encoding="utf-8")
    (folder / "fgreg_broken.py").write_text("import no_such_library\n", encoding="utf-8")
    project = tomllib.loads(toml)["project"]
    more = {"camera.endoscope": "fgreg_acme:Camera", "motion.broken": "fgreg_broken:Motion", "nothing": "a:b"}
    info = folder / "fgreg_acme-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    points = "".join(f"{k} = {v}\n" for k, v in {**project["entry-points"]["fgreg.drivers"], **more}.items())
    (info / "entry_points.txt").write_text(f"[fgreg.drivers]\n{points}")
    return folder


@pytest.fixture(autouse=True)
def installed(site: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(site))
    vars(importlib.import_module("fgreg_acme")).update(RETRY_S=0.02, SILENT_S=0.1)
    yield
    for name in ("fgreg_acme", "fgreg_lab", "test_fgreg_acme"):
        sys.modules.pop(name, None)


def config(folder: Path, **roles: Any) -> Path:
    data = live_configs.config()
    for role in ("motion", "bmode", "sinks"):
        del data[role]
    return live_configs.write(folder, {**data, **roles})


def test_the_drivers_of_the_page_pass_their_own_test(monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module("test_fgreg_acme")
    monkeypatch.setattr(kit, "QUIET_S", 0.02)
    assert {name for name in vars(module) if name.startswith("test_")} == {"test_camera", "test_pulses"}
    module.test_camera()
    module.test_pulses()


def test_devices_describes_them_as_it_does_ours(tmp_path: Path) -> None:
    emulator = importlib.import_module("test_fgreg_acme").Device
    camera, pulses = emulator(480, 640), emulator(128, 16)
    file = config(
        tmp_path,
        camera={"driver": "acme", "port": camera.port, "delay_s": 0.02},
        photoacoustic={"driver": "fgreg_acme:Pulses", "port": pulses.port},
        stage={"driver": "fgreg_lab:Stage", "port": "COM3"},
        operator={"driver": "keyboard"},
    )
    end = threading.Event()

    def send() -> None:
        while not end.wait(0.01):
            camera.send()
            pulses.send()

    thread = threading.Thread(target=send)
    thread.start()
    try:
        found = {answer.what: answer for answer in configured(read_config(file), 0.15)}
    finally:
        end.set()
        thread.join()
        camera.unplug()
        pulses.unplug()
    assert all(found[role].answers for role in ("camera", "photoacoustic", "stage"))
    assert found["camera"].driver == "acme"
    assert found["camera"].name == f"acme at 127.0.0.1:{camera.port}"
    assert found["camera"].says == "30.0 a second, 640 x 480 px, grey, stereo, its own clock"
    assert found["photoacoustic"].says == "30.0 a second, 128 x 16 int16, its own clock"
    assert found["stage"].says.endswith("deg by its own account, knows its zero position")
    assert set(PluginDevice.__dict__) >= {"poll", "send", "tell", "name", "connected", "dropped", "close"}


@pytest.mark.parametrize("error", [InputError("port", "closed", "open"), FgregError("no such thing"), KeyError("x")])
def test_whatever_another_packages_driver_raises_is_a_loss_of_its_device(error: Exception) -> None:
    class Broken:
        name, connected, dropped = "broken", True, 0

        def poll(self) -> list[object]:
            raise error

        def send(self, _what: object) -> None:
            raise error

        def tell(self, _text: str, **_more: object) -> None:
            raise error

    device = PluginDevice(Role.OPERATOR, "fgreg_lab:Broken", Broken())
    device.tell("a message")
    calls: list[Callable[[], object]] = [device.poll, device.poll, lambda: device.send(None)]  # type: ignore[arg-type]
    for call in calls:
        with pytest.raises(DeviceLost, match=type(error).__name__):
            call()


def test_drivers_of_other_packages_are_listed_with_their_keys() -> None:
    found = {one.name: one for one in other_drivers() if "fgreg-acme" in one.says or "broken" in one.name}
    assert found["camera.acme"].answers
    assert found["camera.acme"].says == "fgreg_acme:Camera of fgreg-acme 1.0; keys host, port, delay_s"
    assert not found["camera.endoscope"].answers
    assert "fgreg has one of this name" in found["camera.endoscope"].says
    assert not found["motion.broken"].answers
    assert "No module named 'no_such_library'" in found["motion.broken"].says


def test_options_come_as_their_types_say_and_schemas_take_them(tmp_path: Path) -> None:
    sink = {"driver": "fgreg_lab:Sink", "path": "live.yaml", "digits": None, "scale": [1, 2.5]}
    lab = {role: {"driver": f"fgreg_lab:{role.capitalize()}"} for role in ("motion", "operator")}
    file = config(tmp_path, sinks=[sink], **lab)
    read = read_config(file)
    context = DriverContext(lambda _: None)
    (chosen,) = read.devices[Role.SINKS]
    device = chosen.open(context)
    assert device._device.given == (context, tmp_path / "live.yaml", "new", None, (1.0, 2.5))
    with pytest.raises(DeviceLost, match="fgreg_lab:Sink: an error of its driver: KeyError: 'an error of the lab'"):
        device.send(None)
    device.close()
    with pytest.raises(DeviceLost, match="gave a str, expected MotionSample"):
        read.devices[Role.MOTION][0].open(context).poll()
    operator = read.devices[Role.OPERATOR][0].open(context)
    operator.tell("go on")
    with pytest.raises(DeviceLost, match="KeyError: 'no display'"):
        operator.poll()
    assert (operator.poll(), operator.name) == ([], "fgreg_lab:Operator")
    assert (operator.connected, operator.dropped) == (False, 0)
    named = {**yaml.safe_load(file.read_text()), "camera": {"driver": "acme"}}
    for data in (yaml.safe_load(file.read_text()), named):
        jsonschema.Draft202012Validator(document_schema(Document.LIVE)).validate(data)


def test_the_watchdog_opens_a_stage_from_where_it_was_found(tmp_path: Path) -> None:
    read = read_config(config(tmp_path, stage={"driver": "fgreg_lab:Stage", "port": "COM3", "limits": {}}))
    limits = MotionLimits.of_session(StageModel(0.03, (-0.8, 1.2)))
    with ExitStack() as stack:
        setup = read.stage_setup(read.context(stack, lambda _: None))
        assert setup is not None
        link = stack.enter_context(StageLink.open(setup.driver, setup.options, limits, lambda _: None))
        link.beat()
    options = {**setup.options, "options": {"port": "gone"}}
    with pytest.raises(StageError, match="OSError: no such port"):
        StageLink.open(setup.driver, options, limits, lambda _: None)
    gone = read_config(config(tmp_path, stage={"driver": "fgreg_lab:Stage", "port": "gone"}))
    chosen = gone.devices[Role.STAGE][0]
    with pytest.raises(FgregError, match="stage fgreg_lab:Stage: its driver failed: OSError: no such port"):
        chosen.entry.described(DriverContext(lambda _: None), chosen.options, limits.stage)


MISTAKES: list[tuple[dict[str, Any], str, str, str]] = [
    ({"camera": {"driver": "acne"}}, "camera.driver (line", "'acne'", "(did you mean acme?), or package.module:Class"),
    ({"camera": {"driver": "no_such:Camera"}}, "camera.driver", "(ModuleNotFoundError: No module", "installed package"),
    ({"camera": {"driver": "fgreg_broken:A"}}, "camera.driver", "No module named 'no_such_library'", "installed"),
    ({"motion": {"driver": "broken"}}, "motion.driver", "'broken', fgreg_broken:Motion, which cannot be", "installed"),
    ({"camera": {"driver": "fgreg_acme:Camara"}}, "camera.driver", "has no attribute 'Camara'", "package.module:Class"),
    ({"camera": {"driver": "../acme.py:Camera"}}, "camera.driver", "'../acme.py:Camera'", "package.module:Class"),
    ({"camera": {"driver": ".x:Camera"}}, "camera.driver", "'.x:Camera'", "package.module:Class"),
    (
        {"camera": {"driver": "fgreg_lab:NoPoll"}},
        "camera.driver",
        "a class without poll",
        "a driver of the role camera",
    ),
    ({"camera": {"driver": "fgreg_lab:number"}}, "camera.driver", "no class", "a driver of the role camera"),
    ({"camera": {"driver": "fgreg_lab:Untyped"}}, "camera.driver", "gain has no type", "parameters with types"),
    ({"camera": {"driver": "acme", "port": 70000}}, "camera.port (line", "70000", "an integer from 1 to 65535"),
    ({"camera": {"driver": "acme", "prot": 7}}, "camera.prot", "an unknown key", "(did you mean port?)"),
    ({"camera": {"driver": "acme", "delay_s": 3}}, "camera.delay_s", "3", "within +-1 s"),
    ({"camera": {"driver": "acme", "left": 0}}, "camera.left", "a key of another driver", "acme's: host, port"),
    ({"stage": {"driver": "fgreg_lab:Stage"}}, "stage.port", "nothing", "a text"),
    ({"stage": {"driver": "fgreg_lab:Stage", "port": "a", "gear": 12}}, "stage.gear", "12", "<= 9"),
    ({"sinks": [{"driver": "fgreg_lab:Sink", "path": "no"}]}, "sinks[0].path", "nothing at", "relative to this file's"),
]


@pytest.mark.parametrize(("roles", "place", "found", "expected"), MISTAKES)
def test_a_mistake_is_one_line(tmp_path: Path, roles: dict[str, Any], place: str, found: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        read_config(config(tmp_path, **roles))
    text = str(caught.value)
    assert text.startswith(f"live.yaml: {place}")
    assert found in text.split(": found ")[1].split(", expected ")[0]
    assert expected in text.split(", expected ")[1]


def test_no_module_or_entry_point_is_taken_from_the_folder_of_the_file_or_from_where_one_works(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for place in (tmp_path, tmp_path / "elsewhere"):
        place.mkdir(exist_ok=True)
        (place / "fgreg_evil.py").write_text("raise SystemExit('imported')\n")
        info = place / "evil-1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1\n")
        (info / "entry_points.txt").write_text("[fgreg.drivers]\ncamera.evil = fgreg_evil:Camera\n")
    monkeypatch.chdir(tmp_path / "elsewhere")
    for entry in ("", str(tmp_path)):
        monkeypatch.syspath_prepend(entry)
    for name, found in (("fgreg_evil:Camera", "No module named 'fgreg_evil'"), ("evil", "found 'evil'")):
        file = config(tmp_path, camera={"driver": name})
        monkeypatch.setattr(sys, "argv", ["fgreg", "devices", str(file)])
        with pytest.raises(SystemExit) as done:
            main()
        said = capsys.readouterr()
        assert (done.value.code, said.out, said.err.count("\n")) == (2, "", 1)
        assert said.err.startswith("fgreg: error: live.yaml: camera.driver (line ")
        assert found in said.err
    assert sys.path[:2] == [str(tmp_path), ""]
