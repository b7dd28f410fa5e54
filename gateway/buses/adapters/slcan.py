"""Lawicel's ASCII protocol of a CAN adapter (slcan): its lines, and an emulated adapter.

Rules. Pure: bytes in, frames and replies out; no port, no clock. A line ends with CR, and where a program or
a firmware prints lines, with CR LF or LF; the reply is CR (preceded by the value asked for) or BELL, after
which nothing has changed. A line is a frame if every character of it is as it should be, in both directions;
one that is too short or too long is none. Nothing raises, on any bytes, cut anywhere. Sources: Lawicel CAN232
manual, version 3 (commands, answers, flags, timestamps, BTR of an SJA1000 at 16 MHz); python-can 4.6.1
`can/interfaces/slcan.py` (FD frames d D b B and rates Y2 Y5, after the firmware of CANable 2.0). Wider than
the manual, because python-can opens with `C S8 <empty> O O`: closing what is closed, opening what is open,
and an empty line are no errors; without S the bus's own rate is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.buses.adapters.lines import HEX, LineSplitter
from gateway.buses.frame_time import LENGTHS, padded
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Nanos

OK, BELL, END = b"\r", b"\a", b"\r"
CLOSING = END + b"C" + END
LONGEST = 1 + 8 + 1 + 128
"""Characters of the longest line: an extended FD frame."""
RATES: dict[str, tuple[int, ...]] = {
    "0": (10_000,),
    "1": (20_000,),
    "2": (50_000,),
    "3": (100_000,),
    "4": (125_000,),
    "5": (250_000,),
    "6": (500_000,),
    "7": (750_000, 800_000),  # python-can's and Lawicel's
    "8": (1_000_000,),
    "9": (83_300, 83_333),  # python-can's
}
DATA_RATES = {"2": (2_000_000,), "5": (5_000_000,)}
VERSION, SERIAL = b"V1001", b"NTWIN"
MINUTE = 60_000
"""A timestamp is in ms and wraps after a minute."""


class Kind(NamedTuple):
    """The frame type that the first letter of a line encodes."""

    extended: bool
    remote: bool = False
    fd: bool = False
    brs: bool = False


KINDS = {
    "t": Kind(extended=False),
    "T": Kind(extended=True),
    "r": Kind(extended=False, remote=True),
    "R": Kind(extended=True, remote=True),
    "d": Kind(extended=False, fd=True),
    "D": Kind(extended=True, fd=True),
    "b": Kind(extended=False, fd=True, brs=True),
    "B": Kind(extended=True, fd=True, brs=True),
}
LETTERS = {kind: letter for letter, kind in KINDS.items()}


def line_of(frame: CanFrame) -> str:
    """Encode a frame as a line, without its end. CAN FD data is zero-padded to a valid length."""
    kind = Kind(frame.extended, frame.remote, frame.fd, frame.fd and frame.brs)
    data = padded(frame).data
    head = f"{frame.id:08X}" if frame.extended else f"{frame.id:03X}"
    length = frame.requested or len(data)
    return f"{LETTERS[kind]}{head}{LENGTHS.index(length):X}{data.hex().upper()}"


def frame_of(line: str) -> CanFrame | None:
    """Decode a line; None if it is no valid frame."""
    kind = KINDS.get(line[:1])
    digits = 8 if kind and kind.extended else 3
    head, code, data = line[1 : 1 + digits], line[1 + digits : 2 + digits], line[2 + digits :]
    if kind is None or not code or not HEX.fullmatch(line[1:]):
        return None
    number, length = int(head, 16), LENGTHS[int(code, 16)]
    if number > (0x1FFFFFFF if kind.extended else 0x7FF) or (length > 8 and not kind.fd):
        return None
    if len(data) != (0 if kind.remote else 2 * length):
        return None
    return CanFrame(number, bytes.fromhex(data), *kind, length if kind.remote else 0)


def received_frame(line: str) -> CanFrame | None:
    """Decode a line from an adapter, which may end with a timestamp; None if it is no valid frame.

    A line has a timestamp if it has four digits more than its length asks for."""
    stamped = HEX.fullmatch(line[-4:])
    return frame_of(line) or (frame_of(line[:-4]) if stamped else None)


def opening(bitrate: int, data_bitrate: int = 0, *, listen_only: bool = False) -> bytes:
    """Encode what opens the channel at these bit rates, whatever state the adapter is in.

    Raises ValueError for a rate that the protocol has no command for."""
    lines = [f"S{_code(RATES, bitrate, 'bitrate')}"]
    lines += [f"Y{_code(DATA_RATES, data_bitrate, 'data_bitrate')}"] if data_bitrate else []
    return CLOSING + END.join(line.encode() for line in (*lines, "L" if listen_only else "O", ""))


def _code(rates: Mapping[str, tuple[int, ...]], rate: int, name: str) -> str:
    for code, same in rates.items():
        if rate in same:
            return code
    raise ValueError(
        f"no {name} of slcan is {rate}; there is {', '.join(str(one) for one, *_ in rates.values())}"
    )


def rate_of(btr: str) -> int | None:
    """Return the bit rate of an SJA1000 at 16 MHz with these two bus timing registers, as xxyy in hex."""
    if len(btr) != 4 or not HEX.fullmatch(btr):
        return None
    first, second = bytes.fromhex(btr)
    prescaler, one, two = (first & 0x3F) + 1, (second & 0xF) + 1, (second >> 4 & 0x7) + 1
    return 8_000_000 // (prescaler * (1 + one + two))


@dataclass(slots=True)
class EmulatedAdapter:
    """An emulated adapter on a bus of these bit rates; `data_bitrate` 0 is classic CAN."""

    bitrate: int
    data_bitrate: int = 0
    open: bool = False
    listen_only: bool = False
    overrun: bool = False
    """Frames were lost because the other end did not read; the reply to the next F reports it."""
    _rates: tuple[int, ...] = ()
    """Set with S or s; empty: the bus's own bit rate. No frame passes at another one."""
    _data_rates: tuple[int, ...] = ()
    _timestamps: bool = False
    _splitter: LineSplitter = field(default_factory=lambda: LineSplitter(LONGEST))

    @property
    def wrong_rate(self) -> bool:
        """True if it was set to another bit rate than the bus has: then it neither sends nor receives."""
        return bool(self._rates and self.bitrate not in self._rates) or bool(
            self._data_rates and self.data_bitrate not in self._data_rates
        )

    def feed(self, data: bytes) -> tuple[list[CanFrame], bytes]:
        """Take bytes from the serial line; return the frames that go onto the bus, and the replies."""
        frames: list[CanFrame] = []
        replies = b"".join(
            BELL if line is None else self._execute(line.decode("latin-1"), frames)
            for line in self._splitter.feed(data)
        )
        return frames, replies

    def report(self, t: Nanos, frame: CanFrame) -> bytes:
        """Return the line for a frame on the bus; nothing if the adapter does not receive it."""
        if not self.open or self.wrong_rate:
            return b""
        timestamp = f"{t // MILLISECOND % MINUTE:04X}" if self._timestamps else ""
        return (line_of(frame) + timestamp).encode() + END

    def _execute(self, line: str, frames: list[CanFrame]) -> bytes:
        letter, rest = line[:1], line[1:]
        if letter in KINDS:
            return self._transmit(line, frames)
        match letter:
            case "":
                return OK
            case "V" if not rest:
                return VERSION + END
            case "N" if not rest:
                return SERIAL + END
            case "O" | "L" if not rest:
                self.open, self.listen_only = True, letter == "L"
                return OK
            case "C" if not rest:
                self.open = False
                return OK
            case "F" if not rest and self.open:
                return self._flags()
        return OK if not self.open and self._configure(letter, rest) else BELL

    def _transmit(self, line: str, frames: list[CanFrame]) -> bytes:
        frame = frame_of(line)
        blocked = not self.open or self.listen_only or self.wrong_rate
        if blocked or frame is None or (frame.fd and not self.data_bitrate):
            return BELL
        frames.append(frame)
        return (b"Z" if frame.extended else b"z") + END

    def _configure(self, letter: str, rest: str) -> bool:
        """Execute a command for a closed channel; False if it is invalid."""
        match letter:
            case "S" if rest in RATES:
                self._rates = RATES[rest]
            case "s" if rate := rate_of(rest):
                self._rates = (rate,)
            case "Y" if rest in DATA_RATES:
                self._data_rates = DATA_RATES[rest]
            case "Z" if rest in ("0", "1"):
                self._timestamps = rest == "1"
            case _:
                return False
        return True

    def _flags(self) -> bytes:
        """Return Lawicel's status byte: bit 3 data overrun (once), bit 5 error-passive, bit 7 bus error."""
        flags = 0x08 * self.overrun | 0xA0 * self.wrong_rate
        self.overrun = False
        return f"F{flags:02X}".encode() + END
