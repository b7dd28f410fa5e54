"""The ASCII lines of an fdcanusb, a CAN FD adapter on a serial line: both directions, and the adapter's end.

Rules. Pure: bytes in, frames and answers out; no port, no clock. A line ends with LF or CR; empty ones say
nothing. Each command is answered by `OK`, `ERR …` or what was asked for; behind an ERR nothing has happened.
Nothing raises, on any bytes, cut anywhere. With checksums a line ends in ` *XX`: CRC-8, polynomial 0x97, over
all before the asterisk. Once a command came with one, every line must have one, in both directions.
Sources: mjbots/fdcanusb@8aa23ef `fw/can_manager.cc` (commands, answers, `rcv` lines), README.md
(flags); mjbots/moteus@21fe5bd `docs/integration/uart.md` (checksums; once is always); package moteus 1.1.1
`fdcanusb_device.py` (what a client says and takes). Narrower than the adapter: what it would send cut or
truncated (an id or a length that cannot be, CAN FD on a bus of classic CAN) is an ERR here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from gateway.buses.adapters.slcan import HEX
from gateway.buses.lengths import padded
from protocols.frames import CanFrame
from protocols.messages import Nanos

OK = "OK"
END = b"\r\n"
ENDS = re.compile(rb"[\r\n]")
LONGEST = 256
"""Characters of a line; the longest that means anything has 160."""
SEAL = re.compile(rb"(.*)\*([0-9A-Fa-f]{2})", re.DOTALL)
RCV = re.compile(r"rcv ([0-9A-Fa-f]{1,8}) ((?:[0-9A-Fa-f]{2})*)((?: [A-Za-z][0-9A-Za-z-]*)*) *")


def _crc_of_byte(byte: int) -> int:
    for _ in range(8):
        byte = byte << 1 ^ (0x197 if byte & 0x80 else 0)
    return byte


_CRC = bytes(map(_crc_of_byte, range(256)))


def checksum(data: bytes) -> int:
    """CRC-8, polynomial 0x97, beginning with 0."""
    crc = 0
    for byte in data:
        crc = _CRC[crc ^ byte]
    return crc


def sealed(line: bytes) -> bytes:
    """A line with its checksum."""
    return b"%s *%02X" % (line, checksum(line + b" "))


def unprotected(line: bytes) -> tuple[bytes, bool | None]:
    """A line without its checksum, and whether that was right; None if it had none."""
    found = SEAL.fullmatch(line)
    if found is None:
        return line, None
    return found[1].rstrip(b" "), checksum(found[1]) == int(found[2], 16)


# -- lines ---------------------------------------------------------------------------------------------


def command_of(frame: CanFrame) -> str:
    """The command that sends a frame: `can send`, or `can ext` where the id alone would not say it.

    A remote frame asks for one byte, since the adapter takes no command without data."""
    verb = "ext" if frame.extended and frame.id <= 0x7FF else "send"
    data = "00" if frame.remote else frame.data.hex().upper()
    flags = ("B" if frame.fd and frame.brs else "b") + ("F" if frame.fd else "f") + "R" * frame.remote
    return f"can {verb} {frame.id:04x} {data} {flags}"


def told_of(frame: CanFrame) -> str:
    """What the adapter says of a frame that it has heard."""
    pairs = (("E", frame.extended), ("B", frame.fd and frame.brs), ("F", frame.fd), ("R", frame.remote))
    flags = " ".join(letter if on else letter.lower() for letter, on in pairs)
    digits = f"{frame.id:X}"
    return f"rcv {digits.zfill(len(digits) + len(digits) % 2)} {frame.data.hex().upper()} {flags} f-1"


def heard_of(line: str) -> CanFrame | None:
    """The frame that a `rcv` line tells of; None if it is none, or one that cannot be."""
    found = RCV.fullmatch(line)
    if found is None:
        return None
    number, data, flags = int(found[1], 16), bytes.fromhex(found[2]), found[3].split()
    extended, remote, fd = "E" in flags or number > 0x7FF, "R" in flags, "F" in flags
    if number > 0x1FFFFFFF or len(data) > 64 or (len(data) > 8 and not fd) or (fd and remote):
        return None
    return CanFrame(number, b"" if remote else data, extended, remote, fd, fd and "B" in flags)


# -- the adapter's end ---------------------------------------------------------------------------------


class _Refusal(Exception):
    """What stands behind ERR."""


@dataclass(slots=True)
class Adapter:
    """One adapter on a bus of these rates, configured for it; `data_bitrate` 0 is a bus of classic CAN."""

    bitrate: int
    data_bitrate: int = 0
    open: bool = True
    """Whether it is on the bus, as it is from its first moment (its `can.autostart`)."""
    overrun: bool = False
    """Frames were lost because the other end did not read. An fdcanusb never says so."""
    sealed: bool = False
    """Whether lines bear checksums."""
    refused: int = 0
    """Lines answered with ERR."""
    bad_checksums: int = 0
    """Those among them whose checksum was wrong, or missing where there must be one."""
    config: dict[str, int] = field(default_factory=dict)
    """`can.bitrate` …: what is asked for the next time that it goes on the bus."""
    _rates: tuple[int, int] = (0, 0)
    _rest: bytearray = field(default_factory=bytearray)
    _skipping: bool = False
    """The line has become too long; its end will be answered with ERR."""

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
        """Whether it was set to another rate than the bus has: then it neither hears nor is heard."""
        return self._rates != (self.bitrate, self.data_bitrate or self._rates[1])

    def feed(self, data: bytes) -> tuple[list[CanFrame], bytes]:
        """Bytes from the serial line: the frames that go onto the bus, and the answers."""
        frames: list[CanFrame] = []
        answers = bytearray()
        *lines, rest = ENDS.split(self._rest + data)
        for line in lines:
            if line or self._skipping:
                answers += self._line(self._answer(line, frames))
            self._skipping = False
        self._skipping = self._skipping or len(rest) > LONGEST
        self._rest = bytearray() if self._skipping else bytearray(rest)
        return frames, bytes(answers)

    def report(self, t: Nanos, frame: CanFrame) -> bytes:  # noqa: ARG002 -- an adapter may stamp; this one does not
        """What the serial line gets of a frame on the bus; nothing if the adapter does not hear it."""
        return self._line(told_of(frame)) if self.open and not self.wrong_rate else b""

    def _line(self, text: str) -> bytes:
        line = text.encode("latin-1")
        return (sealed(line) if self.sealed else line) + END

    def _answer(self, line: bytes, frames: list[CanFrame]) -> str:
        try:
            return self._obey(self._content(bytes(line)), frames)
        except _Refusal as refusal:
            self.refused += 1
            return f"ERR {refusal}"

    def _content(self, line: bytes) -> str:
        """What a line says, if it is whole."""
        if self._skipping or len(line) > LONGEST:
            raise _Refusal("line too long")
        content, right = unprotected(line)
        if right is False or (right is None and self.sealed):
            self.bad_checksums += 1
            raise _Refusal("checksum missing" if right is None else "checksum mismatch")
        self.sealed = self.sealed or right is True
        return content.decode("latin-1")

    def _obey(self, line: str, frames: list[CanFrame]) -> str:
        group, _, rest = line.partition(" ")
        word, _, rest = rest.partition(" ")
        match group, word:
            case "can", "send" | "std" | "ext":
                frames += self._transmit(word, rest)
            case "can", "on":
                if self.open:
                    raise _Refusal("already in BusOn")
                self._start()
            case "can", "off":
                self._need_bus("already in BusOff")
                self.open = False
            case "can", "status":
                self._need_bus("not in BusOn")
                return "lec=0 dlec=0 err=0 warn=0 busoff=0 pexc=0 tdc=0"
            case "conf", "get" | "set":
                return self._configure(word, rest)
            case _:
                raise _Refusal("unknown subcommand" if group in ("can", "conf") else "unknown command")
        return OK

    def _start(self) -> None:
        self.open = True
        self._rates = self.config["can.bitrate"], self.config["can.fd_bitrate"]

    def _need_bus(self, refusal: str) -> None:
        if not self.open:
            raise _Refusal(refusal)

    def _transmit(self, verb: str, rest: str) -> list[CanFrame]:
        """The frame that goes onto the bus; none, without a word, at another bit rate than the bus has."""
        self._need_bus("not in BusOn state")
        digits, _, rest = rest.partition(" ")
        data, _, flags = rest.partition(" ")
        if not data:
            raise _Refusal("insufficient options")
        if not set(flags) <= set("BbFfRr "):
            raise _Refusal("unknown flag")
        if not digits or len(digits) > 8 or not HEX.fullmatch(digits):
            raise _Refusal("bad id")
        frame = CanFrame(int(digits, 16), _bytes_of(data), *self._kind(verb, int(digits, 16), flags))
        _check(frame, verb)
        if frame.fd and not self.data_bitrate:
            raise _Refusal("this bus carries classic CAN alone")
        return [] if self.wrong_rate else [_bare(frame) if frame.remote else padded(frame)]

    def _kind(self, verb: str, number: int, flags: str) -> tuple[bool, bool, bool, bool]:
        """Extended, remote, fd, brs. What no flag says is as configured; the last flag of a kind counts."""
        said = {letter.upper(): letter.isupper() for letter in flags if letter != " "}
        remote = said.get("R", False)
        fd = said.get("F", bool(self.config["can.fdcan_frame"])) and not remote
        brs = fd and said.get("B", bool(self.config["can.bitrate_switch"]))
        return verb == "ext" or (verb == "send" and number > 0x7FF), remote, fd, brs

    def _configure(self, word: str, rest: str) -> str:
        key, _, value = rest.partition(" ")
        if key not in self.config:
            raise _Refusal("unknown name")
        if word == "get":
            return str(self.config[key])
        if not re.fullmatch(r"[0-9]{1,9}", value):
            raise _Refusal("error setting")
        self.config[key] = int(value)
        return OK


def _bytes_of(digits: str) -> bytes:
    if len(digits) % 2 or len(digits) > 128:
        raise _Refusal("data invalid length")
    if not HEX.fullmatch(digits):
        raise _Refusal("invalid data")
    return bytes.fromhex(digits)


def _check(frame: CanFrame, verb: str) -> None:
    if frame.id > (0x7FF if verb == "std" else 0x1FFFFFFF):
        raise _Refusal("bad id")
    if len(frame.data) > 8 and not frame.fd:
        raise _Refusal("data invalid length")


def _bare(frame: CanFrame) -> CanFrame:
    """A remote frame carries nothing, whatever length it asks for."""
    return CanFrame(frame.id, b"", frame.extended, remote=True)
