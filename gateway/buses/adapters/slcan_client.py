"""The host's end of an slcan adapter, as an interface of python-can.

Rules. Frames are parsed as strictly as the adapter's end does (`slcan`); what is neither frame nor answer is
malformed. Answers are not waited for; BELL is a refusal, and counted. python-can's own is not used: it
reads byte by byte, waits for each line sent to drain, and takes what is cut or too long for frames.
"""

from __future__ import annotations

import re
from collections import deque
from contextlib import suppress

import can

from gateway.buses.adapters.lines import LineSplitter
from gateway.buses.adapters.port import AdapterInterface
from gateway.buses.adapters.slcan import BELL, CLOSING, END, KINDS, LONGEST, line_of, opening, received_frame
from protocols.frames import CanFrame

BAUDRATE = 115_200
"""Of an adapter on a UART, unless its port is given as PORT@BAUDRATE; one on USB ignores it."""
ANSWER = re.compile(r"[zZ]|[VvNF][ -~]*")
"""A frame was sent; the value asked for."""
STAMP = 4
"""Digits of a timestamp."""


class SlcanInterface(AdapterInterface):
    """An open adapter."""

    def __init__(
        self, channel: str, bitrate: int, data_bitrate: int = 0, *, listen_only: bool = False
    ) -> None:
        """Open the port exclusively, set the bit rates, open the channel (with L if `listen_only`).

        Raises OSError, or ValueError for a rate that the protocol has no command for."""
        self._opening = opening(bitrate, data_bitrate, listen_only=listen_only)
        path, _, baudrate = channel.partition("@")
        super().__init__(path, int(baudrate or BAUDRATE), END)
        self._splitter = LineSplitter(LONGEST + STAMP)
        self._lines: deque[bytes | None] = deque()
        """Received, not yet handled."""
        self.channel_info = f"slcan {channel}"
        self.turn_on()

    def turn_on(self) -> None:
        """Set the bit rates, and open the channel."""
        self.port.write(self._opening)

    def turn_off(self) -> None:
        """Close the channel. A line that was cut ends before."""
        self.port.write(CLOSING)

    def shutdown(self) -> None:
        """Close the channel and the port."""
        with suppress(can.CanError):  # an adapter that has gone is closed
            self.port.write(CLOSING)
        super().shutdown()

    def _encode(self, frame: CanFrame) -> bytes:
        return line_of(frame).encode() + END

    def _feed(self, data: bytes) -> None:
        self.refusals.refused += data.count(BELL)
        self._lines.extend(self._splitter.feed(data.replace(BELL, END)))

    def _next_frame(self) -> CanFrame | None:
        while self._lines:
            line = self._lines.popleft()
            if line is None:
                raise ValueError("a line too long")
            text = line.decode("latin-1")
            if text[:1] in KINDS:
                if (frame := received_frame(text)) is None:
                    raise ValueError(f"no frame: {text!r}")
                return frame
            if text and not ANSWER.fullmatch(text):
                raise ValueError(f"no line of slcan: {text!r}")
        return None
