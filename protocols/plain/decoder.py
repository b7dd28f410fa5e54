"""What plain devices would obey, of the bytes on their line.

Rules. A device obeys whole messages to its address, or to all (Scan, SetId), whose numbers lie within
`codec.LIMITS`, and ignores everything else.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols.frames import Frame
from protocols.messages import Arm, Command, Idle, Nanos, Obeyed
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

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return the commands and requests in the messages that this frame completes."""
        if not isinstance(frame, bytes):
            return []
        return [obeyed for body in self._stream.feed(frame) for obeyed in self._decode(t, body)]

    def _decode(self, t: Nanos, body: bytes) -> Sequence[Obeyed]:
        name = self._names.get(body[0], "")
        message = codec.decode(body, t, name)
        if isinstance(message, codec.BroadcastRequest):
            return (message,) if body[0] == codec.BROADCAST else ()
        if name not in self._motors or not isinstance(message, Command | codec.MotorRequest):
            return ()
        arms = isinstance(message, Command) and not isinstance(message, Idle)
        return (Arm(name), message) if arms else (message,)
