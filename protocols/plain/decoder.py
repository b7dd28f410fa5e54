"""What plain devices would obey, of what stands on their line.

Rules. A device obeys whole messages to its address, or to everyone (Scan, SetId), whose numbers lie within
`line.LIMITS`; all else it does not hear.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols.frames import Frame
from protocols.messages import Command, Nanos, Request
from protocols.plain import codec
from protocols.plugin import Device


class PlainDecoder:
    """What plain devices would obey. A motor in fault hears a command too, and does not obey it."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._stream = codec.Stream()
        self._names = {d.address: d.name for d in devices}
        self._motors = [d.name for d in devices if d.options.kind == "motor"]

    def follow(self, device: Device) -> None:
        """This device has a new address."""
        self._names = {a: name for a, name in self._names.items() if name != device.name}
        self._names[device.address] = device.name

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:
        """The words in the messages that are complete with this wire."""
        if not isinstance(frame, bytes):
            return []
        received = [self._read(t, body) for body in self._stream.feed(frame)]
        return [word for word in received if word is not None]

    def _read(self, t: Nanos, body: bytes) -> Command | Request | None:
        name = self._names.get(body[0], "")
        word = codec.read(body, t, name)
        if isinstance(word, codec.LineRequest):
            return word if body[0] == codec.EVERYONE else None
        if name in self._motors and isinstance(word, Command | codec.MotorRequest):
            return word
        return None
