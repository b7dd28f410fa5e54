"""The ASCII lines of an fdcanusb, a CAN FD adapter on a serial line: both directions, and an emulated
adapter.

Rules. Pure: bytes in, frames and replies out; no port, no clock. A line ends with LF or CR; empty ones are
ignored. Each command is answered by `OK`, `ERR …` or the value asked for; after an ERR nothing has changed.
Nothing raises, on any bytes, cut anywhere. With checksums a line ends in ` *XX`: CRC-8, polynomial 0x97, over
all before the asterisk. Once a command came with one, every line must have one, in both directions. Sources:
mjbots/fdcanusb@8aa23ef `fw/can_manager.cc` (commands, replies, `rcv` lines), README.md (flags);
mjbots/moteus@21fe5bd `docs/integration/uart.md` (checksums; once is always); package moteus 1.1.1
`fdcanusb_device.py` (what a client sends and accepts). Narrower than the adapter: what it would send cut or
truncated (an invalid id or length, CAN FD on a bus of classic CAN) is an ERR here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace

from gateway.buses.adapters.lines import HEX, LineSplitter
from gateway.buses.frame_time import padded
from protocols.frames import CanFrame
from protocols.messages import Nanos

OK = "OK"
END = b"\r\n"
LONGEST = 256
"""Characters of a line; the longest valid one has 160."""
CHECKSUM = re.compile(rb"(.*)\*([0-9A-Fa-f]{2})", re.DOTALL)
RCV = re.compile(r"rcv ([0-9A-Fa-f]{1,8}) ((?:[0-9A-Fa-f]{2})*)((?: [A-Za-z][0-9A-Za-z-]*)*) *")


def _crc_of_byte(byte: int) -> int:
    for _ in range(8):
        byte = byte << 1 ^ (0x197 if byte & 0x80 else 0)
    return byte


_CRC = bytes(map(_crc_of_byte, range(256)))


def checksum(data: bytes) -> int:
    """Return the CRC-8, polynomial 0x97, initial value 0."""
    crc = 0
    for byte in data:
        crc = _CRC[crc ^ byte]
    return crc


def with_checksum(line: bytes) -> bytes:
    """Return a line with its checksum appended."""
    return b"%s *%02X" % (line, checksum(line + b" "))


def split_checksum(line: bytes) -> tuple[bytes, bool | None]:
    """Return a line without its checksum, and whether that was valid; None if it had none."""
    found = CHECKSUM.fullmatch(line)
    if found is None:
        return line, None
    return found[1].rstrip(b" "), checksum(found[1]) == int(found[2], 16)


# -- lines ---------------------------------------------------------------------------------------------


def encode_send(frame: CanFrame) -> str:
    """Encode the command that sends a frame: `can send`, or `can ext` where the id alone does not imply it.

    A remote frame asks for one byte at least, since the adapter accepts no command without data."""
    verb = "ext" if frame.extended and frame.id <= 0x7FF else "send"
    data = "00" * max(1, frame.requested) if frame.remote else frame.data.hex().upper()
    flags = ("B" if frame.fd and frame.brs else "b") + ("F" if frame.fd else "f") + "R" * frame.remote
    return f"can {verb} {frame.id:04x} {data} {flags}"


def encode_received(frame: CanFrame) -> str:
    """Encode the `rcv` line by which the adapter reports a received frame."""
    pairs = (("E", frame.extended), ("B", frame.fd and frame.brs), ("F", frame.fd), ("R", frame.remote))
    flags = " ".join(letter if on else letter.lower() for letter, on in pairs)
    digits, data = f"{frame.id:X}", frame.data or bytes(frame.requested)
    return f"rcv {digits.zfill(len(digits) + len(digits) % 2)} {data.hex().upper()} {flags} f-1"


def decode_received(line: str) -> CanFrame | None:
    """Decode a `rcv` line; None if it is no valid one."""
    found = RCV.fullmatch(line)
    if found is None:
        return None
    number, data, flags = int(found[1], 16), bytes.fromhex(found[2]), found[3].split()
    extended, remote, fd = "E" in flags or number > 0x7FF, "R" in flags, "F" in flags
    if number > 0x1FFFFFFF or len(data) > 64 or (len(data) > 8 and not fd) or (fd and remote):
        return None
    if remote:
        return CanFrame(number, b"", extended, True, requested=len(data))
    return CanFrame(number, data, extended, False, fd, fd and "B" in flags)


# -- an emulated adapter -------------------------------------------------------------------------------


class _CommandError(Exception):
    """What follows ERR."""


@dataclass(slots=True)
class EmulatedAdapter:
    """An emulated adapter on a bus of these bit rates, configured for it; `data_bitrate` 0 is classic CAN."""

    bitrate: int
    data_bitrate: int = 0
    open: bool = True
    """Whether it is on the bus, as it is from the start (its `can.autostart`)."""
    overrun: bool = False
    """Frames were lost because the other end did not read. An fdcanusb never reports it."""
    protected: bool = False
    """Whether lines have checksums."""
    refused: int = 0
    """Lines answered with ERR."""
    bad_checksums: int = 0
    """Those among them whose checksum was wrong, or missing where one is required."""
    config: dict[str, int] = field(default_factory=dict)
    """`can.bitrate` …: takes effect the next time that it goes on the bus."""
    _rates: tuple[int, int] = (0, 0)
    _splitter: LineSplitter = field(default_factory=lambda: LineSplitter(LONGEST))

    def __post_init__(self) -> None:
        fd = int(bool(self.data_bitrate))
        self.config = {
            "can.bitrate": self.bitrate,
            "can.fd_bitrate": self.data_bitrate or self.bitrate,
            "can.fdcan_frame": fd,
            "can.bitrate_switch": fd,
        }
        self._start()

    @property
    def wrong_rate(self) -> bool:
        """True if it was set to another bit rate than the bus has: then it neither sends nor receives."""
        return self._rates != (self.bitrate, self.data_bitrate or self._rates[1])

    def feed(self, data: bytes) -> tuple[list[CanFrame], bytes]:
        """Take bytes from the serial line; return the frames that go onto the bus, and the replies."""
        frames: list[CanFrame] = []
        replies = b"".join(
            self._line(self._reply(line, frames)) for line in self._splitter.feed(data) if line != b""
        )
        return frames, replies

    def report(self, t: Nanos, frame: CanFrame) -> bytes:  # noqa: ARG002 -- slcan timestamps; an fdcanusb does not
        """Return the line for a frame on the bus; nothing if the adapter does not receive it."""
        return self._line(encode_received(frame)) if self.open and not self.wrong_rate else b""

    def _line(self, text: str) -> bytes:
        line = text.encode("latin-1")
        return (with_checksum(line) if self.protected else line) + END

    def _reply(self, line: bytes | None, frames: list[CanFrame]) -> str:
        try:
            return self._execute(self._content(line), frames)
        except _CommandError as error:
            self.refused += 1
            return f"ERR {error}"

    def _content(self, line: bytes | None) -> str:
        """Return a line's text, if it is complete and its checksum is valid."""
        if line is None:
            raise _CommandError("line too long")
        content, valid = split_checksum(line)
        if valid is False or (valid is None and self.protected):
            self.bad_checksums += 1
            raise _CommandError("checksum missing" if valid is None else "checksum mismatch")
        self.protected = self.protected or valid is True
        return content.decode("latin-1")

    def _execute(self, line: str, frames: list[CanFrame]) -> str:
        group, _, rest = line.partition(" ")
        verb, _, rest = rest.partition(" ")
        match group, verb:
            case "can", "send" | "std" | "ext":
                frames += self._transmit(verb, rest)
            case "can", "on":
                if self.open:
                    raise _CommandError("already in BusOn")
                self._start()
            case "can", "off":
                self._need_bus("already in BusOff")
                self.open = False
            case "can", "status":
                self._need_bus("not in BusOn")
                return "lec=0 dlec=0 err=0 warn=0 busoff=0 pexc=0 tdc=0"
            case "conf", "get" | "set":
                return self._configure(verb, rest)
            case _:
                raise _CommandError("unknown subcommand" if group in ("can", "conf") else "unknown command")
        return OK

    def _start(self) -> None:
        self.open = True
        self._rates = self.config["can.bitrate"], self.config["can.fd_bitrate"]

    def _need_bus(self, error: str) -> None:
        if not self.open:
            raise _CommandError(error)

    def _transmit(self, verb: str, rest: str) -> list[CanFrame]:
        """Return the frame that goes onto the bus; none, and no error, at another bit rate than the bus
        has."""
        self._need_bus("not in BusOn state")
        digits, _, rest = rest.partition(" ")
        data, _, flags = rest.partition(" ")
        if not data:
            raise _CommandError("insufficient options")
        if not set(flags) <= set("BbFfRr "):
            raise _CommandError("unknown flag")
        if not digits or len(digits) > 8 or not HEX.fullmatch(digits):
            raise _CommandError("bad id")
        frame = CanFrame(int(digits, 16), _bytes_of(data), *self._kind(verb, int(digits, 16), flags))
        if frame.id > (0x7FF if verb == "std" else 0x1FFFFFFF):
            raise _CommandError("bad id")
        if len(frame.data) > 8 and not frame.fd:
            raise _CommandError("data invalid length")
        if frame.fd and not self.data_bitrate:
            raise _CommandError("this bus carries classic CAN only")
        if self.wrong_rate:
            return []
        return [replace(frame, data=b"", requested=len(frame.data)) if frame.remote else padded(frame)]

    def _kind(self, verb: str, number: int, flags: str) -> tuple[bool, bool, bool, bool]:
        """Return extended, remote, fd, brs. Without a flag it is as configured; the last flag of a kind
        counts."""
        given = {letter.upper(): letter.isupper() for letter in flags if letter != " "}
        remote = given.get("R", False)
        fd = given.get("F", bool(self.config["can.fdcan_frame"])) and not remote
        brs = fd and given.get("B", bool(self.config["can.bitrate_switch"]))
        return verb == "ext" or (verb == "send" and number > 0x7FF), remote, fd, brs

    def _configure(self, verb: str, rest: str) -> str:
        key, _, value = rest.partition(" ")
        if key not in self.config:
            raise _CommandError("unknown name")
        if verb == "get":
            return str(self.config[key])
        if not re.fullmatch(r"[0-9]{1,9}", value):
            raise _CommandError("error setting")
        self.config[key] = int(value)
        return OK


def _bytes_of(digits: str) -> bytes:
    if len(digits) % 2 or len(digits) > 128:
        raise _CommandError("data invalid length")
    if not HEX.fullmatch(digits):
        raise _CommandError("invalid data")
    return bytes.fromhex(digits)
