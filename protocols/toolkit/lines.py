"""The adapter of devices on a serial line: what comes answers what was asked, or nobody asked for it.

Rules. A framing finds the messages that nobody asked for: those of a device that reports by itself, or a
late answer. Without one nothing is known of such bytes: they are counted once, until an answer comes.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols.frames import Frame
from protocols.messages import Nanos
from protocols.toolkit.host import Own, Report
from protocols.toolkit.motor_driver import Adapter, MotorDriver, Rx
from protocols.toolkit.serial import FrameReader, Stream


class LineAdapter(Adapter[Own]):
    """What a protocol on a serial line adds to `MotorDriver`."""

    def __init__(self, framing: FrameReader | None = None) -> None:
        self._stream = None if framing is None else Stream(framing)
        self._skipping = False
        """What nobody asked for goes on."""

    def unasked(self, t: Nanos, message: bytes, driver: MotorDriver[Own]) -> Sequence[Report[Own] | Rx]:
        """Return what a message reports that nobody asked for."""
        return (Rx.IGNORED,)

    def answered(self) -> None:
        """Note that an answer has come: what nobody asks for behind it counts anew."""
        self._skipping = False

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Own]) -> Sequence[Report[Own] | Rx]:
        if not isinstance(frame, bytes):
            return (Rx.IGNORED,)
        if self._stream is None:
            before, self._skipping = self._skipping, True
            return () if before else (Rx.IGNORED,)
        found: list[Report[Own] | Rx] = []
        for one in self._stream.feed(frame):
            found += (one,) if isinstance(one, Rx) else self.unasked(t, one, driver)
        return found

    def interrupted(self) -> None:
        if self._stream is not None:
            self._stream.drop()
