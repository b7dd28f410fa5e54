"""What the device would obey: bytes → words.

Rules. It knows what the device remembers of what it was told (here nothing), and touches nothing else. What a
driver says must be heard as it was meant: the clause "commands" tells.

FILL IN whatever makes the real device obey or not: its mode, a mapping, a sequence that it wants.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols.frames import Frame
from protocols.messages import ClearFault, Command, Idle, Nanos, Request, Velocity
from protocols.plugin import Device

from . import codec
from .codec import Order
from .framing import COMMAND, MAX_ADDRESS, Reader


class MotorDecoder:
    """What the devices of this language on one bus would obey."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._names = {device.address: device.name for device in devices}
        self._reader = Reader(COMMAND, tuple(self._names))

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:  # noqa: ARG002 -- nothing here ages
        """The words in this wire."""
        words: list[Command | Request] = []
        for address, payload in self._reader.read(frame):
            read = codec.read_command(payload)
            if read is not None:
                words.append(_word(self._names[address], *read))
        return words


def messages(frame: Frame) -> Sequence[str]:
    """The names of the messages to a device in this wire."""
    reader = Reader(COMMAND, range(1, MAX_ADDRESS + 1))
    found = [codec.read_command(payload) for _, payload in reader.read(frame)]
    return [read[0].name.lower() for read in found if read]


def _word(name: str, order: Order, velocity: float) -> Command | Request:
    match order:
        case Order.STOP:
            return Idle(name)
        case Order.RUN:
            return Velocity(name, velocity)
        case Order.CLEAR:
            return ClearFault(name)
