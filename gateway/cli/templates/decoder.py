"""What the device would obey: bytes → commands and requests.

Rules. It knows what the device remembers of its commands (here nothing), and touches nothing else. What a
driver sends must be decoded as it was meant: the clause "commands" checks that.

FILL IN whatever decides whether the real device obeys: its mode, a mapping, a required sequence.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols.frames import Frame
from protocols.messages import Arm, ClearFault, Idle, Nanos, Obeyed, Velocity
from protocols.plugin import Device

from . import codec
from .codec import Order
from .framing import COMMAND, MAX_ADDRESS, Reader


class MotorDecoder:
    """Decodes what the devices of this protocol on one bus would obey."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._names = {device.address: device.name for device in devices}
        self._reader = Reader(COMMAND, tuple(self._names))

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:  # noqa: ARG002 -- nothing here ages
        """Return the commands and requests that this frame completes."""
        messages: list[Obeyed] = []
        for address, payload in self._reader.read(frame):
            decoded = codec.decode_command(payload)
            if decoded is not None:
                messages += _messages(self._names[address], *decoded)
        return messages


def message_names(frame: Frame) -> Sequence[str]:
    """Return the names of the messages to a device in this frame."""
    reader = Reader(COMMAND, range(1, MAX_ADDRESS + 1))
    decoded = [codec.decode_command(payload) for _, payload in reader.read(frame)]
    return [each[0].name.lower() for each in decoded if each]


def _messages(name: str, order: Order, velocity: float) -> Sequence[Obeyed]:
    match order:
        case Order.STOP:
            return (Idle(name),)
        case Order.RUN:
            return Arm(name), Velocity(name, velocity)
        case Order.CLEAR:
            return (ClearFault(name),)
