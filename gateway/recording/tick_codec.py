"""Ticks as bytes: one ROS 2 message of ours per tick, sealed so that no later change goes unseen.

Rules. The bytes are CDR (little endian, as ROS 2 writes it) of the definition below, which stands in every
recording: any ROS 2 tool can read them without us. `decode(encode(tick))` is the tick, exactly. Words (what
was asked, what was heard) are bytes of the language `plain`. Each packet carries a checksum of itself, each
tick two rolling digests, over all inputs and over all outputs since the start; each digest is made from the
one written before it, so that one damaged tick is named and the ticks after it are still good.

Written by hand with `struct`, because this runs at every step: several times faster than a general
serialiser. A test holds it to the general one, byte for byte.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Literal, cast

from gateway.core.tick import Inputs, Note, Outputs, Tick
from protocols.frames import BusState, CanFrame, Packet
from protocols.message_codec import pack, unpack
from protocols.messages import Event, Instruction, Message

TYPE = "motor_gateway_msgs/msg/Tick"
TOPIC = "/gateway/tick"
DEFINITION = f"""\
# One step of the gateway: all that went into it, and all that came out.
uint64 number             # counts up by one
int64 now                 # ns, the clock of every stamp in here
BusState[] states         # inputs: changes of buses,
Packet[] received         #   what was read from the buses, in order,
Word[] asked              #   what a person or a tool asked for
Packet[] sent             # outputs: what was to be written, in order,
Word[] events             #   what the drivers heard,
Note[] notes              #   sentences for a person
uint8[16] input_digest    # BLAKE2b of the digest before it and the bytes from number to asked
uint8[16] output_digest   # BLAKE2b of the digest before it and the bytes from sent to notes
{"=" * 80}
MSG: motor_gateway_msgs/BusState
string bus
string state
{"=" * 80}
MSG: motor_gateway_msgs/Packet
int64 t                   # ns; of what was received: stamped by its bus
uint32 id                 # CAN identifier; 0 if serial
uint8 kind                # 0 serial bytes, 1 CAN frame
uint8 flags               # CAN: 1 extended identifier, 2 remote, 4 FD, 8 bit-rate switch
string bus
uint8[] data
uint32 crc                # CRC-32 of the bytes of this packet before it
{"=" * 80}
MSG: motor_gateway_msgs/Word
uint8[] data              # a word in the language plain
{"=" * 80}
MSG: motor_gateway_msgs/Note
string level              # info, warning, error
string about
string text
"""

_ENCAPSULATION = b"\x00\x01\x00\x00"
_BODY = len(_ENCAPSULATION)
_DIGEST = 16
_PAD4 = tuple(bytes(-n % 4) for n in range(4))
# A bytearray's length counts the 4 bytes of encapsulation, which CDR does not align by.
_PAD8 = tuple(bytes((_BODY - n) % 8) for n in range(8))
_U32 = struct.Struct("<I")
_START = struct.Struct("<Qq")
_PACKET = struct.Struct("<qIBBxxI")
_SERIAL, _CAN = 0, 1
_EXTENDED, _REMOTE, _FD, _BRS = 1, 2, 4, 8
_LEVELS = ("info", "warning", "error")


class JournalError(ValueError):
    """These bytes are no tick."""


@dataclass(frozen=True, slots=True)
class DigestChain:
    """The two rolling digests after a tick."""

    inputs: bytes
    outputs: bytes


UNPROTECTED = DigestChain(bytes(_DIGEST), bytes(_DIGEST))
"""Before the first tick."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A tick read back, with what was written to prove it."""

    tick: Tick
    seals: DigestChain
    """As written."""
    made: DigestChain
    """As they follow from the bytes and the seals before it."""
    spoilt: tuple[tuple[str, Packet], ...]
    """Packets that do not match their own checksum, each "input" or "output"."""

    def damage(self) -> tuple[str, ...]:
        """What does not match, in words; empty if nothing was changed since it was written."""
        said = []
        for side, made, written in (
            ("input", self.made.inputs, self.seals.inputs),
            ("output", self.made.outputs, self.seals.outputs),
        ):
            packets = [p for s, p in self.spoilt if s == side]
            said += [
                f"the recorded {side} on bus {p.bus}, {show(p)}, does not match the digest written with it"
                for p in packets
            ]
            if made != written and not packets:
                said.append(
                    f"the recorded {side}s do not match the digest written with them, although each packet "
                    f"does: something else in the tick was changed, or the tick before it is missing"
                )
        return tuple(said)


def show(packet: Packet) -> str:
    """A packet's wire for a person: a frame in the notation of candump, or bytes in hexadecimal."""
    if isinstance(packet.frame, CanFrame):
        return f"frame {packet.frame}"
    return f"bytes {packet.frame.hex(' ').upper()}"


# -- out ---------------------------------------------------------------------------------------


def encode(tick: Tick, before: DigestChain) -> tuple[bytes, DigestChain]:
    """The tick as a message, and the seals for the next one."""
    out = bytearray(_ENCAPSULATION)
    out += _START.pack(tick.number, tick.now)
    _count(out, tick.inputs.states)
    for bus, state in tick.inputs.states:
        _string(out, bus)
        _string(out, state.value)
    _put_packets(out, tick.inputs.packets)
    _put_words(out, tick.inputs.instructions)
    half = len(out)
    _put_packets(out, tick.outputs.packets)
    _put_words(out, tick.outputs.events)
    _count(out, tick.outputs.notes)
    for note in tick.outputs.notes:
        _string(out, note.level)
        _string(out, note.source)
        _string(out, note.text)
    seals = _seal(out, half, len(out), before)
    out += seals.inputs
    out += seals.outputs
    return bytes(out), seals


def _seal(data: bytes | bytearray, half: int, end: int, before: DigestChain) -> DigestChain:
    return DigestChain(
        blake2b(before.inputs + data[_BODY:half], digest_size=_DIGEST).digest(),
        blake2b(before.outputs + data[half:end], digest_size=_DIGEST).digest(),
    )


def _count(out: bytearray, items: Sequence[object]) -> None:
    out += _PAD4[len(out) & 3]
    out += _U32.pack(len(items))


def _string(out: bytearray, text: str) -> None:
    data = text.encode(errors="backslashreplace")
    out += _PAD4[len(out) & 3]
    out += _U32.pack(len(data) + 1)
    out += data
    out += b"\0"


def _bytes(out: bytearray, data: bytes) -> None:
    out += _PAD4[len(out) & 3]
    out += _U32.pack(len(data))
    out += data


def _put_packets(out: bytearray, packets: Sequence[Packet]) -> None:
    _count(out, packets)
    for packet in packets:
        frame = packet.frame
        bus = packet.bus.encode(errors="backslashreplace")
        out += _PAD8[len(out) & 7]
        start = len(out)
        if isinstance(frame, CanFrame):
            flags = frame.extended | frame.remote << 1 | frame.fd << 2 | frame.brs << 3
            out += _PACKET.pack(packet.t, frame.id, _CAN, flags, len(bus) + 1)
            data = frame.data
        else:
            out += _PACKET.pack(packet.t, 0, _SERIAL, 0, len(bus) + 1)
            data = frame
        out += bus
        out += b"\0"
        _bytes(out, data)
        out += _PAD4[len(out) & 3]
        out += _U32.pack(zlib.crc32(out[start:]))


def _put_words(out: bytearray, words: Sequence[Message]) -> None:
    _count(out, words)
    for word in words:
        _bytes(out, pack(word))


# -- in ----------------------------------------------------------------------------------------


def decode(data: bytes, before: DigestChain) -> Entry:
    """The tick in a message; `before` are the seals written with the tick before it.

    Raises JournalError if these bytes are no tick. A tick that was changed is told by `Entry.damage`."""
    try:
        return _decode(data, before)
    except (struct.error, IndexError, UnicodeDecodeError, ValueError, TypeError) as error:
        raise JournalError(f"not the bytes of a tick: {error}") from error


def _decode(data: bytes, before: DigestChain) -> Entry:
    reader = _Reader(data)
    if data[:_BODY] != _ENCAPSULATION:
        raise JournalError(f"it starts with {data[:_BODY].hex(' ')}, not with {_ENCAPSULATION.hex(' ')}")
    number, now = cast(tuple[int, int], reader.take(_START))
    states = tuple((reader.string(), BusState(reader.string())) for _ in range(reader.count()))
    received = reader.packets()
    asked = cast(tuple[Instruction, ...], reader.words())
    half = reader.at
    sent = reader.packets()
    events = cast(tuple[Event, ...], reader.words())
    notes = tuple(Note(reader.level(), reader.string(), reader.string()) for _ in range(reader.count()))
    end = reader.at
    if len(data) != end + 2 * _DIGEST:
        raise JournalError(f"{len(data) - end} bytes after the last note, expected {2 * _DIGEST}")
    spoilt = [("input", p) for p, good in received if not good]
    spoilt += [("output", p) for p, good in sent if not good]
    return Entry(
        Tick(
            number,
            now,
            Inputs(states, tuple(p for p, _ in received), asked),
            Outputs(tuple(p for p, _ in sent), events, notes),
        ),
        DigestChain(data[end : end + _DIGEST], data[end + _DIGEST :]),
        _seal(data, half, end, before),
        tuple(spoilt),
    )


class _Reader:
    """A place in the bytes of a message."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = _BODY

    def take(self, layout: struct.Struct) -> tuple[object, ...]:
        values = layout.unpack_from(self.data, self.at)
        self.at += layout.size
        return values

    def count(self) -> int:
        self.at += -self.at % 4
        count = int(_U32.unpack_from(self.data, self.at)[0])
        self.at += 4
        if count > len(self.data):
            raise JournalError(f"{count} items cannot stand in {len(self.data)} bytes")
        return count

    def bytes(self, size: int) -> bytes:
        if size > len(self.data) - self.at:
            raise JournalError(f"{size} bytes wanted, {len(self.data) - self.at} left")
        self.at += size
        return self.data[self.at - size : self.at]

    def string(self) -> str:
        data = self.bytes(self.count())
        if data[-1:] != b"\0":
            raise JournalError("a string without an end")
        return data[:-1].decode()

    def level(self) -> Literal["info", "warning", "error"]:
        level = self.string()
        if level not in _LEVELS:
            raise JournalError(f"a note of level {level!r}")
        return cast(Literal["info", "warning", "error"], level)

    def words(self) -> tuple[Message, ...]:
        return tuple(self._word() for _ in range(self.count()))

    def _word(self) -> Message:
        word = unpack(self.bytes(self.count()))
        if word is None:
            raise JournalError("a word that the language plain does not know")
        return word

    def packets(self) -> list[tuple[Packet, bool]]:
        return [self._packet() for _ in range(self.count())]

    def _packet(self) -> tuple[Packet, bool]:
        self.at += (_BODY - self.at) % 8
        start = self.at
        t, id_, kind, flags, size = cast(tuple[int, int, int, int, int], self.take(_PACKET))
        bus = self.bytes(size)[:-1].decode()
        data = self.bytes(self.count())
        self.at += -self.at % 4
        good = zlib.crc32(self.data[start : self.at]) == _U32.unpack_from(self.data, self.at)[0]
        self.at += 4
        if kind > _CAN:
            raise JournalError(f"a packet of kind {kind}")
        if kind == _SERIAL:
            return Packet(t, bus, data), good
        return Packet(t, bus, _frame(id_, flags, data)), good


def _frame(id_: int, flags: int, data: bytes) -> CanFrame:
    return CanFrame(
        id_,
        data,
        extended=bool(flags & _EXTENDED),
        remote=bool(flags & _REMOTE),
        fd=bool(flags & _FD),
        brs=bool(flags & _BRS),
    )
