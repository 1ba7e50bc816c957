"""The command ``fgreg devices``."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fgreg.cli.options import warn

if TYPE_CHECKING:
    from fgreg.live.device_check import DeviceReport

EXIT_SILENT = 1


def add_devices(app: typer.Typer) -> None:
    """Register the command."""

    @app.command()
    def devices(
        config: Annotated[
            Path | None, typer.Argument(metavar="CONFIG", help="A CONFIG.yaml of fgreg live: asks its devices.")
        ] = None,
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.")] = False,
    ) -> None:
        """List the devices and whether they answer. No stage moves.

        Without CONFIG: libraries, drivers of other packages, video devices, Thorlabs cubes. With CONFIG, each of its
        devices is opened for at most 2 s: its data, their rate, their clock, and whether they agree with session.yaml.
        Exit status 1 where one of them does not answer.

        \b
          fgreg live --example-config > room.yaml  a CONFIG with every key to choose
          fgreg devices room.yaml                  asks each of its devices
          fgreg live room.yaml                     a session with them
        """
        from fgreg.live import device_check
        from fgreg.live.config import read_config

        read = None if config is None else read_config(config)
        for warning in () if read is None else read.warnings:
            warn(warning)
        show = _Shown(as_json)
        show.section("extras", device_check.extras())
        folder = None if config is None else config.parent
        show.section("drivers of other packages", device_check.other_drivers(folder), "other_drivers")
        show.section("video devices", device_check.video(0 if read is not None else device_check.LISTEN_S))
        if read is None:
            show.section("Thorlabs cubes", device_check.cubes())
        else:
            show.section(str(config), device_check.configured(read), "devices")
        show.end()
        if not all(answer.answers for answer in show.sections.get("devices", ())):
            raise typer.Exit(EXIT_SILENT)


class _Shown:
    """Prints the answers one by one, or as one document at the end."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self.sections: dict[str, list[DeviceReport]] = {}

    def section(self, title: str, answers: Any, key: str = "") -> None:
        """Print a heading and its answers."""
        found = self.sections.setdefault(key or title.replace(" ", "_").lower(), [])
        if not self._as_json:
            typer.echo(title)
        for answer in answers:
            found.append(answer)
            if not self._as_json:
                typer.echo(_line(answer))
        if not found and not self._as_json:
            typer.echo("  none")

    def end(self) -> None:
        """Print the document, if wanted."""
        if self._as_json:
            document = {key: [asdict(answer) for answer in answers] for key, answers in self.sections.items()}
            typer.echo(json.dumps(document, indent=2))


def _line(answer: "DeviceReport") -> str:
    mark = "+" if answer.answers else "-"
    if not answer.driver:
        return f"  {mark} {answer.name:<16} {answer.says}"
    return f"  {mark} {answer.what:<14} {answer.driver:<10} {answer.name}: {answer.says}"
