"""The host's end of an fdcanusb, as an interface of python-can, which has none for it.

Rules. Replies are not waited for: they come in order, and each kind of error is logged once. Checksums as the
vendor's client has them (package moteus 1.1.1): off on an adapter known by its USB ids, on elsewhere (a UART,
a pty); beyond that they follow the errors of the other end. A line with a wrong checksum is bad and changes
nothing; so is one without, once the other end has used them. Bit rates are the adapter's own configuration:
they are read where it can be asked, and a difference is logged.
"""

from __future__ import annotations

import logging
from collections import deque
from pathlib import Path

from serial.tools.list_ports import comports

from gateway.buses.adapters.fdcanusb import (
    LONGEST,
    decode_received,
    encode_send,
    split_checksum,
    with_checksum,
)
from gateway.buses.adapters.lines import LineSplitter
from gateway.buses.adapters.port import AdapterInterface
from protocols.frames import CanFrame

log = logging.getLogger("gateway")

BAUDRATE = 921_600
"""Of a moteus on a UART; an adapter on USB ignores it."""
KNOWN = ((0x0483, 0x5740), (0x1209, 0x2323))
"""USB vendor and product ids of the adapters (package moteus 1.1.1, FDCANUSB_IDS)."""
FIELDS = 3
"""Spaces in a `rcv` line, which has flags behind its data: without any, and a checksum, it was cut."""
NOT_ON, NO_FLAG = "ERR not in BusOn state", "ERR unknown flag"
"""The adapter's replies to a command before `can on`, and to a checksum if it has none."""


class FdcanusbInterface(AdapterInterface):
    """An open adapter."""

    def __init__(self, channel: str, bitrate: int, data_bitrate: int = 0) -> None:
        """Open the port exclusively. Raises OSError or ValueError."""
        super().__init__(channel, BAUDRATE, b"\n")
        self._protected = not _is_known(channel)
        """Whether our lines have checksums."""
        self._checked = False
        """Whether the other end has used them."""
        self._splitter = LineSplitter(LONGEST)
        self._lines: deque[bytes | None] = deque()
        """Received, not yet handled."""
        self._logged: set[str] = set()
        self._asked: deque[tuple[str, int]] = deque()
        """Configuration that was asked for: name, and the expected value."""
        self.channel_info = f"fdcanusb {channel}"
        if not self._protected:  # a device on a UART has no bit rates of its own
            rates = (("can.bitrate", bitrate), ("can.fd_bitrate", data_bitrate))
            self._asked.extend((key, rate) for key, rate in rates if rate)
            self.port.write(b"".join(b"conf get %s\n" % key.encode() for key, _ in self._asked))

    def turn_off(self) -> None:
        """Leave the bus."""
        self.port.write(self._line("can off"))

    def turn_on(self) -> None:
        """Join the bus again."""
        self.port.write(self._line("can on"))

    def _encode(self, frame: CanFrame) -> bytes:
        return self._line(encode_send(frame))

    def _line(self, text: str) -> bytes:
        line = text.encode()
        return (with_checksum(line) if self._protected else line) + b"\n"

    def _feed(self, data: bytes) -> None:
        self._lines.extend(self._splitter.feed(data))

    def _next_frame(self) -> CanFrame | None:
        """Handle lines until one is a frame."""
        while self._lines:
            line = self._lines.popleft()
            if line is None:
                raise ValueError("a line too long")
            if line and (frame := self._handle(line)) is not None:
                return frame
        return None

    def _handle(self, line: bytes) -> CanFrame | None:
        """Return the frame of a `rcv` line; handle any other line. Raises ValueError for a bad one."""
        content, valid = split_checksum(line)
        text = content.decode("latin-1")
        if valid is False or (valid is None and self._checked):
            raise ValueError("a checksum is wrong or missing")
        self._checked = bool(valid)
        if text.startswith("rcv "):
            frame = decode_received(text)
            cut = valid is None and text.count(" ") < FIELDS
            if frame is None or cut:
                raise ValueError(f"no frame: {text!r}")
            return frame
        if text.startswith("ERR"):
            self._on_error(text)
        elif text.isdecimal() and self._asked:
            self._compare(*self._asked.popleft(), int(text))
        elif text != "OK":
            raise ValueError(f"no line of an fdcanusb: {text!r}")
        return None

    def _on_error(self, text: str) -> None:
        """Do what an error calls for, or log it, once."""
        self.refusals.refused += 1
        if text == NO_FLAG and self._protected and not self._checked:
            self._protected = False  # it has taken our checksum for a flag
        elif "checksum" in text.lower():
            self._protected = True
        elif text == NOT_ON:
            self.port.write(self._line("can on"))
        elif text not in self._logged and len(self._logged) < 16:
            self._logged.add(text)
            log.warning("%s replies: %s", self.channel_info, text)

    def _compare(self, key: str, wanted: int, found: int) -> None:
        if found != wanted:
            log.error(
                "%s has a %s of %d bit/s, the robot file has %d; to change the adapter, send it: "
                "conf set %s %d, conf write, can off, can on",
                *(self.channel_info, key, found, wanted, key, wanted),
            )


def _is_known(path: str) -> bool:
    """True if a port is an adapter by its USB ids."""
    real = str(Path(path).resolve())
    return any(port.device == real and (port.vid, port.pid) in KNOWN for port in comports())
