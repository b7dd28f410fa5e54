"""What plain devices would obey, of the bytes on their line.

Rules. A device obeys whole messages to its address, or to all (Scan, SetId), whose numbers lie within
`codec.LIMITS`, and ignores everything else.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols.frames import Frame
from protocols.messages import Command, Nanos, Request
from protocols.plain import codec
from protocols.plugin import Device


class PlainDecoder:
    """Decodes what plain devices would obey. Stateless about modes: a motor in fault receives a command
    too, and its firmware does not obey it."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._stream = codec.Stream()
        self._names = {d.address: d.name for d in devices}
        self._motors = [d.name for d in devices if d.options.kind == "motor"]

    def follow(self, device: Device) -> None:
        """Use this device's new address."""
        self._names = {a: name for a, name in self._names.items() if name != device.name}
        self._names[device.address] = device.name

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:
        """Return the commands and requests in the messages that this frame completes."""
        if not isinstance(frame, bytes):
            return []
        decoded = [self._decode(t, body) for body in self._stream.feed(frame)]
        return [message for message in decoded if message is not None]

    def _decode(self, t: Nanos, body: bytes) -> Command | Request | None:
        name = self._names.get(body[0], "")
        message = codec.decode(body, t, name)
        if isinstance(message, codec.BroadcastRequest):
            return message if body[0] == codec.BROADCAST else None
        if name in self._motors and isinstance(message, Command | codec.MotorRequest):
            return message
        return None
