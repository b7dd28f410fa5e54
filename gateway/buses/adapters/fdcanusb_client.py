"""Our end of an fdcanusb, as an interface of python-can, which has none for it. It never waits.

Rules. Reading takes what is there, writing hands over what the port takes, and a line that has partly gone
out is finished before another one begins. Answers are not waited for: they come in their turn, and complaints
are told once each. Checksums as the vendor's client has them (package moteus 1.1.1): off on an adapter known
by its USB ids, on elsewhere (a UART, a pty); beyond that they follow what the other end complains of. A line
with a wrong checksum is bad and changes nothing; so is one without, once the other end has used them. Bit
rates are the adapter's own configuration: they are asked for where it can be asked, and a difference is told.
"""

from __future__ import annotations

import logging
import os
import select
from collections import deque
from pathlib import Path

import can
import serial
from serial.tools.list_ports import comports

from gateway.buses.adapters.fdcanusb import ENDS, LONGEST, command_of, heard_of, sealed, unprotected
from protocols.frames import CanFrame

log = logging.getLogger("gateway")

BAUDRATE = 921_600
"""Of a moteus on a UART; an adapter on USB does not care."""
KNOWN = ((0x0483, 0x5740), (0x1209, 0x2323))
"""USB vendor and product of the adapters (package moteus 1.1.1, FDCANUSB_IDS)."""
MOST_READ = 65536
"""Bytes taken in at once."""
NOT_ON, NO_FLAG = "ERR not in BusOn state", "ERR unknown flag"
"""What the adapter says of a command before `can on`, and of a checksum that it does not know."""


class FdcanusbInterface(can.BusABC):
    """An open adapter. Raises as python-can does: CanTimeoutError if it takes no more for now."""

    def __init__(self, channel: str, bitrate: int, data_bitrate: int = 0) -> None:
        """Open the port for us alone. Raises OSError or ValueError."""
        self._port = serial.Serial(channel, BAUDRATE, timeout=0, write_timeout=0, exclusive=True)
        self._sealed = not _is_known(channel)
        """Whether our lines bear checksums."""
        self._seals = False
        """Whether the other end has used them."""
        self._out = bytearray()
        self._in = bytearray()
        self._skipping = False
        self._complained: set[str] = set()
        self._asked: deque[tuple[str, int]] = deque()
        self.channel_info = f"fdcanusb {channel}"
        super().__init__(channel)
        if not self._sealed:  # a device on a UART has no bit rates of its own
            rates = (("can.bitrate", bitrate), ("can.fd_bitrate", data_bitrate))
            self._asked.extend((key, rate) for key, rate in rates if rate)
            self._out += b"".join(b"conf get %s\n" % key.encode() for key, _ in self._asked)

    def shutdown(self) -> None:
        """Close the port."""
        super().shutdown()
        self._port.close()

    def fileno(self) -> int:
        """Of the port."""
        return int(self._port.fileno())

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 -- it never waits
        """Hand a frame over, whole or not at all."""
        self._push()
        if self._out:
            raise can.CanTimeoutError("the adapter takes no more")
        frame = CanFrame(
            msg.arbitration_id,
            bytes(msg.data),
            msg.is_extended_id,
            msg.is_remote_frame,
            msg.is_fd,
            msg.bitrate_switch,
        )
        self._say(command_of(frame))

    # -- out ----------------------------------------------------------------------------------

    def _say(self, text: str) -> None:
        line = text.encode()
        self._out += (sealed(line) if self._sealed else line) + b"\n"
        self._push()

    def _push(self) -> None:
        if not self._out:
            return
        try:
            del self._out[: os.write(self.fileno(), self._out)]
        except BlockingIOError:
            return
        except OSError as error:
            raise can.CanOperationError(f"the adapter is gone: {error}") from error

    # -- in -----------------------------------------------------------------------------------

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """The next frame; None if there is none within the timeout. ValueError for a line that is bad."""
        self._push()
        frame = self._next_frame()
        if frame is None:
            ready, _, _ = select.select([self.fileno()], [], [], timeout)
            if ready:
                self._take()
                frame = self._next_frame()
        return (None if frame is None else _message(frame)), False

    def _take(self) -> None:
        try:
            data = os.read(self.fileno(), MOST_READ)
        except BlockingIOError:
            return
        except OSError as error:
            raise can.CanOperationError(f"the adapter is gone: {error}") from error
        if not data:
            raise can.CanOperationError("the adapter is gone: the port has hung up")
        self._in += data

    def _next_frame(self) -> CanFrame | None:
        """Cut lines from what has come in until one is a frame."""
        while (end := ENDS.search(self._in)) is not None:
            line = bytes(self._in[: end.start()])
            del self._in[: end.end()]
            skipped, self._skipping = self._skipping, False
            if skipped or len(line) > LONGEST:
                raise ValueError("a line too long")
            if line and (frame := self._handle(line)) is not None:
                return frame
        if len(self._in) > LONGEST:
            self._in.clear()
            self._skipping = True
        return None

    def _handle(self, line: bytes) -> CanFrame | None:
        """A frame that a line tells of; what else it says is heeded. Raises ValueError for a bad one."""
        content, right = unprotected(line)
        text = content.decode("latin-1")
        if right is False or (right is None and self._seals):
            raise ValueError("a checksum is wrong or missing")
        self._seals = bool(right)
        if text.startswith("rcv "):
            frame = heard_of(text)
            if frame is None:
                raise ValueError(f"no frame: {text!r}")
            return frame
        if text.startswith("ERR"):
            self._heed(text)
        elif text.isdecimal() and self._asked:
            self._compare(*self._asked.popleft(), int(text))
        elif text != "OK":
            raise ValueError(f"not said by an fdcanusb: {text!r}")
        return None

    def _heed(self, complaint: str) -> None:
        """Do about a complaint what can be done; tell it once."""
        if complaint == NO_FLAG and self._sealed and not self._seals:
            self._sealed = False  # it has taken our checksum for a flag
        elif "checksum" in complaint.lower():
            self._sealed = True
        elif complaint == NOT_ON:
            self._say("can on")
        elif complaint not in self._complained and len(self._complained) < 16:
            self._complained.add(complaint)
            log.warning("%s answers: %s", self.channel_info, complaint)

    def _compare(self, key: str, wanted: int, found: int) -> None:
        if found != wanted:
            log.error(
                "%s has a %s of %d bit/s, the robot file says %d; to change the adapter, say to it: "
                "conf set %s %d, conf write, can off, can on",
                *(self.channel_info, key, found, wanted, key, wanted),
            )


def _message(frame: CanFrame) -> can.Message:
    return can.Message(
        arbitration_id=frame.id,
        data=frame.data,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        is_fd=frame.fd,
        bitrate_switch=frame.brs,
    )


def _is_known(path: str) -> bool:
    """Whether a port is an adapter by its USB ids."""
    real = str(Path(path).resolve())
    return any(port.device == real and (port.vid, port.pid) in KNOWN for port in comports())
