"""The session.yaml that ``fgreg setup`` writes: the declared one with what was found, a comment on every line."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.errors import InputError
from fgreg.geometry.transforms import as_float_array
from fgreg.model.probe_model import ProbeModel, SensitivityModel
from fgreg.model.session_model import SESSION, SessionModel, default_targets_mm
from fgreg.model.systematic import NONE
from fgreg.output.atomic_file import FileKind, check_output, write_file
from fgreg.pipeline.setup import Compared, SetupConfig
from fgreg.schema.kinds import Converted, Kind
from fgreg.schema.record import Record, Section
from fgreg.schema.yaml_writer import yaml_text
from fgreg.session.session_reader import SETUP_FILE
from fgreg.session.setup_reader import read_setup
from fgreg.session.yaml_loader import parse_yaml

SAME_DEPTH_MM = 1.0
"""Sweeps past PMs that are no farther apart in depth are one entry of the window's table."""
_FLOW = ("tags", "charuco", "left", "right", "targets")
_ANY_SESSION = FileKind("a session.yaml", (b"",), (b"fgreg-session/1",), SETUP_FILE)


def check_setup_output(path: Path, *, force: bool) -> None:
    """Whether the file can be written: to be asked before the work begins.

    Raises:
        InputError: it exists and ``force`` is not given, or something else is in its place.
    """
    check_output(path, _ANY_SESSION)
    if path.exists() and not force:
        raise InputError(str(path), "a file", "a new name, or --force")


def write_setup(path: Path, config: SetupConfig, found: Sequence[Compared]) -> None:
    """Write the set-up with what was found; :func:`check_setup_output` first.

    Raises:
        InputError: the file cannot be written.
    """
    write_file(path, setup_yaml(config, found), _ANY_SESSION)


def setup_yaml(config: SetupConfig, found: Sequence[Compared]) -> str:
    """Text of the session.yaml."""
    taken = [one for one in found if one.taken]
    model, comments = _with_probe(config.model, taken)
    for one in found:  # what the recordings say less well than the declaration
        if one.found.name.startswith(("probe.radius", "stage.", "probe.flip")) and not one.taken:
            comments[one.found.name] = f"kept: these recordings say {_said(one)}, less well"
    if model.systematic.declared:
        model, of_systematic = _with_systematic(model, taken)
        comments |= of_systematic
    rig = config.model.rig_file
    model = replace(model, rig_file=None, rig=None)
    document = _plain(SESSION.write(model))
    default = default_targets_mm(config.model.probe.radius_mm)
    if config.model.targets or np.array_equal(config.model.targets_mm, default):
        document.pop("targets_mm", None)  # they have names, or move with the radius
    helps = dict(_helps(SESSION, ""))
    lines = [f"# fgreg setup: {config.label} with what its recordings say. All sigmas are 1 sigma."]
    if rig is not None:
        lines.append(f"# rig: {rig.name} is left out: its values count from the former ones. Commission again.")
    lines += _commented(yaml_text(document, _FLOW).splitlines(), comments, helps, config.label)
    lines += yaml_text(config.own, _FLOW).splitlines()
    settings = [*_settings(found)]
    if settings:
        lines += ["", "# Of the CONFIG.yaml of fgreg live, under settings:", *(f"#   {line}" for line in settings)]
    text = "\n".join(lines) + "\n"
    problems: list[InputError] = []
    read_setup(parse_yaml(text, SETUP_FILE), SETUP_FILE, model.name, problems)
    if problems:
        raise problems[0]
    return text


def _plain(value: Any) -> Any:
    """A document without the last digits that conversions from radians leave."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return float(f"{value:.12g}") if isinstance(value, float) else value


def figure(one: Compared) -> str:
    """A constant's value with its sigma."""
    found = one.found
    if found.sigma is None:
        return str(found.value).lower() + ("" if found.z is None else f", at {found.z:.0f} sigmas")
    digits = max(0, 1 - math.floor(math.log10(max(found.sigma, 1e-9))))
    unit = f" {found.unit}" if found.unit else ""
    return f"{float(found.value):.{digits}f} +- {found.sigma:.{digits}f}{unit}"


def declared_text(one: Compared) -> str:
    """What is declared of a constant, with its sigma."""
    if one.declared is None:
        return "nothing"
    if isinstance(one.declared, bool) or one.found.sigma is None:
        return str(one.declared).lower()
    unit = f" {one.found.unit}" if one.found.unit else ""
    sigma = "" if one.declared_sigma is None else f" +- {one.declared_sigma:.2g}"
    return f"{one.declared:g}{sigma}{unit}"


def _rounded_up(sigma: float) -> float:
    """Two digits of a standard deviation, never less than it is."""
    unit = 10.0 ** (math.floor(math.log10(sigma)) - 1)
    return float(f"{math.ceil(round(sigma / unit, 6)) * unit:.10g}")


def _round(value: float, sigma: float) -> float:
    """A value to a tenth of its standard deviation."""
    return round(value, max(0, 1 - math.floor(math.log10(max(sigma, 1e-9)))))


def _with_probe(model: SessionModel, taken: Sequence[Compared]) -> tuple[SessionModel, dict[str, str]]:
    comments: dict[str, str] = {}
    probe, stage = model.probe, model.stage
    for one in taken:
        found = one.found
        text = f"found: {_said(one)}; how: {found.how}; was {_shown(one.declared)}"
        if found.name == "probe.radius_mm":
            probe = replace(probe, radius_mm=_round(float(found.value), found.sigma or 1e-3))
        elif found.name == "probe.flip":
            probe = replace(probe, flip=bool(found.value))
        elif found.name == "stage.direction":
            stage = replace(stage, direction=int(found.value))
        elif found.name == "range_offset_mm":
            probe, key = _with_offset(probe, float(found.value))
            comments[key] = text if key != "probe" else f"range offset {text}: no key has it, so add it to your ranges"
            continue
        else:
            continue
        comments[found.name] = text
    window, of_window = _window(probe.sensitivity, taken)
    return replace(model, probe=replace(probe, sensitivity=window), stage=stage), comments | of_window


def _with_offset(probe: ProbeModel, offset_mm: float) -> tuple[ProbeModel, str]:
    """A probe whose ranges are longer by an offset, and the key that says so."""
    offset_mm = round(offset_mm, 3)
    if probe.channels is not None:
        t0_us = round(probe.channels.t0_us + offset_mm / (1e-3 * probe.sound_speed_m_s), 4)
        probe = replace(probe, channels=replace(probe.channels, t0_us=t0_us))
    if probe.image is not None:
        z0, x0 = probe.image.origin_mm
        probe = replace(probe, image=replace(probe.image, origin_mm=(round(z0 + offset_mm, 4), x0)))
    if probe.channels is not None:
        return probe, "probe.channels.t0_us"
    return probe, "probe.image.origin_mm" if probe.image is not None else "probe"


def _window(window: SensitivityModel, taken: Sequence[Compared]) -> tuple[SensitivityModel, dict[str, str]]:
    """The window's table by the sweeps."""
    widths = sorted(
        (
            (one.found.depth_mm or 0.0, float(one.found.value), one.found.sigma or 0.0)
            for one in taken
            if _is_width(one)
        ),
    )
    if not widths:
        return window, {}
    groups: list[list[tuple[float, float, float]]] = []
    for width in widths:
        if groups and width[0] - groups[-1][0][0] <= SAME_DEPTH_MM:
            groups[-1].append(width)
        else:
            groups.append([width])
    depth, half, sigma = [], [], []
    for group in groups:
        d, w, s = np.array(group).T
        weight = 1.0 / s**2
        depth.append(round(float(weight @ d / weight.sum()), 1))
        sigma.append(float(1.0 / math.sqrt(weight.sum())))
        half.append(_round(float(weight @ w / weight.sum()), sigma[-1]))
    edge = _rounded_up(max(sigma))
    passes = f"{len(widths)} sweep{'s' * (len(widths) > 1)}"
    texts = ", ".join(f"{w:g} +- {s:.2f} deg at {d:g} mm" for d, w, s in zip(depth, half, sigma, strict=True))
    return (
        replace(
            window,
            depth_mm=as_float_array(depth),
            half_width_rad=as_float_array(np.radians(half)),
            edge_sigma_rad=math.radians(edge),
        ),
        {
            "probe.sensitivity.depth_mm": f"found: depths of the PMs of {passes}",
            "probe.sensitivity.half_width_deg": f"found: {texts} (1 sigma), by {passes} past a PM",
            "probe.sensitivity.edge_sigma_deg": "found: the largest sigma of these",
        },
    )


def _is_width(one: Compared) -> bool:
    return one.found.name == "probe.sensitivity.half_width_deg"


def _with_systematic(model: SessionModel, taken: Sequence[Compared]) -> tuple[SessionModel, dict[str, str]]:
    assert model.systematic != NONE
    systematic, comments = model.systematic, {}
    for one in taken:
        found = one.found
        sigma = _rounded_up(max(found.sigma or 0.0, 1e-4))
        if found.name == "probe.radius_mm":
            systematic = replace(systematic, radius_mm=sigma)
            comments["systematic.radius_mm"] = "found: sigma of the radius above"
        elif found.name == "range_offset_mm":
            if model.probe.channels is None and model.probe.image is None:  # it is in no key
                sigma = _rounded_up(math.hypot(float(found.value), sigma))
            systematic = replace(systematic, range_offset_mm=sigma)
            comments["systematic.range_offset_mm"] = f"found: {_said(one)}"
        elif found.name == "backlash_deg":
            largest = _rounded_up(math.hypot(float(found.value), found.sigma or 0.0))
            systematic = replace(systematic, backlash_rad=math.radians(largest))
            comments["systematic.backlash_deg"] = f"found: a backlash of {_said(one)}; how: {found.how}"
    return replace(model, systematic=systematic), comments


def _settings(found: Sequence[Compared]) -> Iterator[str]:
    """Lines of CONFIG.yaml."""
    for one in found:
        value, sigma = one.found.value, one.found.sigma or 0.0
        said = f"found: {_said(one)}; how: {one.found.how}"
        if one.found.name == "settings.hearing_threshold":
            yield f"hearing_threshold: {_round(float(value), sigma):g}  # {said}"
        elif one.found.name == "camera_less_pulse_latency_s":
            later = "camera_latency_s" if value > 0.0 else "pulse_latency_s"
            yield f"{later}: {_round(abs(float(value)), sigma):g}  # and the other one 0; camera less pulse {said}"


def _said(one: Compared) -> str:
    return figure(one) + ("" if one.found.sigma is None else " (1 sigma)")


def _shown(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) or value is None else f"{value:g}"


def _helps(record: Record, prefix: str) -> Iterator[tuple[str, str]]:
    """What each key is, by its dotted name."""
    for field in record.fields:
        name = f"{prefix}{field.name}"
        yield name, field.key.help
        kind: Kind | None = field.kind
        kind = kind.stored if isinstance(kind, Converted) else kind
        if isinstance(kind, Record | Section):
            yield from _helps(kind, f"{name}.")


def _commented(
    lines: Sequence[str], comments: Mapping[str, str], helps: Mapping[str, Any], label: str
) -> Iterator[str]:
    """Lines of YAML, each key with its comment: what was found, or that it is as declared."""
    path: list[str] = []
    for line in lines:
        text = line.lstrip()
        key, colon, value = text.partition(":")
        if text.startswith("-") or not colon or key.strip('"') != key:
            yield line
            continue
        path[(len(line) - len(text)) // 2 :] = [key]
        name = ".".join(path)
        if name in comments:
            yield f"{line}  # {comments[name]}"
        elif name in helps and (value.strip() or name in ("targets_mm", "targets")):
            yield f"{line}  # as in {label}: {helps[name]}" if helps[name] else f"{line}  # as in {label}"
        else:
            yield line
