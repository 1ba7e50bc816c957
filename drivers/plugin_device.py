"""A device whose driver is of another package: whatever its driver raises is a loss of this device, never a crash."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from fgreg.drivers.base import (
    BmodeFrame,
    CommandKind,
    DeviceLost,
    MotionSample,
    OperatorCommand,
    OverlayPicture,
    PaFrame,
    RefusedWord,
    Registration,
    StereoFrame,
)
from fgreg.drivers.registry import Role
from fgreg.errors import one_line

ITEMS: Mapping[Role, type] = {
    Role.CAMERA: StereoFrame,
    Role.PHOTOACOUSTIC: PaFrame,
    Role.MOTION: MotionSample,
    Role.BMODE: BmodeFrame,
    Role.OPERATOR: OperatorCommand,
}
"""What ``poll`` gives, by role."""

T = TypeVar("T")


def is_item(role: Role, item: object) -> bool:
    """Whether ``poll`` may give this; an operator's may also give words that its driver refuses."""
    return isinstance(item, ITEMS[role]) or (role is Role.OPERATOR and isinstance(item, RefusedWord))


class PluginDevice:
    """Fits the protocol of its role (fgreg.drivers.base), whatever its driver does."""

    def __init__(self, role: Role, driver: str, device: Any) -> None:
        self._role, self._driver, self._device = role, driver, device
        self._unreported: DeviceLost | None = None

    @property
    def name(self) -> str:
        """Name shown to the user."""
        try:
            return one_line(str(self._device.name), 80)
        except Exception:
            return self._driver

    @property
    def connected(self) -> bool:
        """Whether the device says so."""
        try:
            return bool(self._device.connected)
        except Exception:
            return False

    @property
    def dropped(self) -> int:
        """As the device counts; 0 where it does not."""
        try:
            return int(self._device.dropped)
        except Exception:
            return 0

    def poll(self) -> list[Any]:
        """Items since the last call. Raises DeviceLost."""
        if self._unreported is not None:
            unreported, self._unreported = self._unreported, None
            raise unreported
        items = self._called(lambda: list(self._device.poll()))
        wrong = next((item for item in items if not is_item(self._role, item)), None)
        if wrong is not None:
            raise DeviceLost(f"{self._driver}: gave a {type(wrong).__name__}, expected {ITEMS[self._role].__name__}")
        return items

    def send(self, what: Registration | OverlayPicture) -> None:
        """Send the registration, or a picture. Raises DeviceLost."""
        self._called(lambda: self._device.send(what))

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:
        """Show a message; an error is reported by the next ``poll``."""
        try:
            self._called(lambda: self._device.tell(text, done=done, wants=wants))
        except DeviceLost as error:
            self._unreported = error

    def close(self) -> None:
        """Release the device."""
        with contextlib.suppress(Exception):
            self._device.close()

    def _called(self, call: Callable[[], T]) -> T:
        try:
            return call()
        except DeviceLost:
            raise
        except Exception as error:  # also another error of fgreg: the loop knows of losses only
            why = one_line(f"{type(error).__name__}: {error}", 200)
            raise DeviceLost(f"{self._driver}: an error of its driver: {why}") from error
