"""Operators besides the keyboard: texts over OpenIGTLink, and several operators combined."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from fgreg.drivers.base import CommandKind, DeviceLost, Operator, OperatorCommand
from fgreg.drivers.igtl import IgtlReceiver, endpoint
from fgreg.drivers.igtl_messages import Text, check_name, pack_text
from fgreg.drivers.operator_words import asked, understand
from fgreg.drivers.tcp_link import Endpoint

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext
    from fgreg.drivers.options import IgtlOperatorOptions


class IgtlOperator(IgtlReceiver):
    """An Operator whose commands are STRING messages of a device: a foot switch, a button in 3D Slicer.

    Messages to the operator, and replies to commands that are not understood, go back as STRING messages; for a slow
    receiver only the newest is kept.

    Args:
        endpoint: the sender, or where it connects.
        device: name of the device that sends commands.
        answers: name of the device for messages to the operator.
        corners: columns and rows of the board's inner corners; aims at others are rejected with a message.
    """

    _role = "operator"

    def __init__(
        self,
        endpoint: Endpoint,
        device: str = "Operator",
        answers: str = "OperatorTold",
        corners: tuple[int, int] | None = None,
    ) -> None:
        self._answers, self._corners = check_name(answers), corners
        super().__init__(endpoint, [("STRING", check_name(device))])

    def poll(self) -> list[OperatorCommand]:  # type: ignore[override]
        """Commands since the last call. Raises DeviceLost."""
        commands = []
        for message in self._messages():
            if not isinstance(message.content, Text):
                continue
            command = understand(message.content.text, self._corners)
            if isinstance(command, str):
                self._leave_out(message, command)
                self._offer(command)
            else:
                commands.append(command)
        return commands

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:  # noqa: ARG002
        """Send a message."""
        self._offer(asked(text, wants))

    def _offer(self, text: str) -> None:
        self._link.offer(pack_text(self._answers, text, time.time(), {}, 2))


class Operators:
    """Several operators combined: commands come from any of them, messages go to all."""

    def __init__(self, operators: Sequence[Operator]) -> None:
        self._operators = tuple(operators)
        self._losses: list[DeviceLost] = []
        self._held: list[OperatorCommand] = []

    @property
    def name(self) -> str:
        """Their names."""
        return " and ".join(operator.name for operator in self._operators)

    @property
    def connected(self) -> bool:
        """Whether all are there."""
        return all(operator.connected for operator in self._operators)

    @property
    def dropped(self) -> int:
        """Number of commands that were not fetched in time."""
        return sum(operator.dropped for operator in self._operators)

    def poll(self) -> list[OperatorCommand]:
        """Commands of all operators since the last call; none is dropped when a loss is raised.

        Raises:
            DeviceLost: one of them is lost; once for each loss.
        """
        for operator in self._operators:
            try:
                self._held += operator.poll()
            except DeviceLost as error:
                self._losses.append(error)
        if self._held:  # commands first: a stop must not wait for a loss to be raised
            commands, self._held = self._held, []
            return commands
        if self._losses:
            raise self._losses.pop(0)
        return []

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:
        """Send a message to all operators."""
        for operator in self._operators:
            operator.tell(text, done=done, wants=wants)

    def close(self) -> None:
        """Close all operators."""
        for operator in self._operators:
            operator.close()


def open_operator(context: DriverContext, options: IgtlOperatorOptions) -> Operator:
    """Texts over OpenIGTLink."""
    return IgtlOperator(endpoint(options), options.device, options.answers, context.corners)
