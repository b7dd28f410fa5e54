"""Ticks as bytes: one ROS 2 message per tick, with digests that reveal any later change.

Rules. The bytes are CDR (little endian, as ROS 2 writes it) of the definition below, which is part of every
recording: any ROS 2 tool can read them. `decode(encode(tick))` is the tick, exactly. Instructions and events
are encoded by `protocols.message_codec`. Each packet has its own checksum, each tick two chained digests,
over all inputs and over all outputs since the start; each digest is made from the one written before it, so
that one damaged tick is named and the ticks after it are still good.

Encoded by `struct`, because this runs at every step: several times faster than a general serialiser. A test
compares it with the general one, byte for byte.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from typing import Literal, cast

from gateway.core.tick import Inputs, Note, Outputs, Tick
from protocols.frames import BusState, CanFrame, Packet
from protocols.message_codec import kind_in, pack, unpack
from protocols.messages import Event, Instruction, Message

TYPE = "motor_gateway_msgs/msg/Tick"
TOPIC = "/gateway/tick"
DEFINITION = f"""\
# One step of the gateway: its inputs and its outputs.
uint64 number             # increments by one
int64 now                 # ns, the clock of all time stamps in here
BusState[] states         # inputs: state changes of buses,
Packet[] received         #   frames received, in order,
Message[] instructions    #   requests, tasks and commands of an operator or a tool
Packet[] sent             # outputs: frames to send, in order,
Message[] events          #   events decoded by the drivers,
Note[] notes              #   messages for the operator
uint8[16] input_digest    # BLAKE2b of the digest before it and the bytes from number to instructions
uint8[16] output_digest   # BLAKE2b of the digest before it and the bytes from sent to notes
{"=" * 80}
MSG: motor_gateway_msgs/BusState
string bus
string state
{"=" * 80}
MSG: motor_gateway_msgs/Packet
int64 t                   # ns; of a received frame: its time of reception
uint32 id                 # CAN identifier; 0 if serial
uint8 kind                # 0 serial bytes, 1 CAN frame
uint8 flags               # CAN: 1 extended identifier, 2 remote, 4 FD, 8 bit-rate switch, 16 * requested
string bus
uint8[] data
uint32 crc                # CRC-32 of the bytes of this packet before it
{"=" * 80}
MSG: motor_gateway_msgs/Message
uint8[] data              # an instruction or event, encoded by protocols.message_codec
{"=" * 80}
MSG: motor_gateway_msgs/Note
string level              # info, warning, error
string source
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
_REQUESTED = 4
"""The bit at which the number begins that a remote frame asks for."""
_LEVELS = ("info", "warning", "error")


class TickCodecError(ValueError):
    """The bytes are not a tick."""


class UnknownKind(TickCodecError):
    """A reading of a kind of sensor that is not installed here, or is broken."""

    def __init__(self, kind: str) -> None:
        super().__init__(f"a reading of the unknown kind of sensor {kind!r}")
        self.kind = kind


@dataclass(frozen=True, slots=True)
class DigestChain:
    """The two chained digests after a tick."""

    inputs: bytes
    outputs: bytes


CHAIN_START = DigestChain(bytes(_DIGEST), bytes(_DIGEST))
"""Before the first tick."""


@dataclass(frozen=True, slots=True)
class TickEntry:
    """A decoded tick, with the digests to verify it."""

    tick: Tick
    written: DigestChain
    """The digests in the message."""
    computed: DigestChain
    """The digests that follow from the bytes and the chain before it."""
    bad_packets: tuple[tuple[str, Packet], ...]
    """Packets that do not match their own checksum, each with "input" or "output"."""

    def damage(self) -> tuple[str, ...]:
        """Return what does not match, in words; empty if nothing was changed since it was written."""
        damage = []
        for side, computed, written in (
            ("input", self.computed.inputs, self.written.inputs),
            ("output", self.computed.outputs, self.written.outputs),
        ):
            packets = [p for s, p in self.bad_packets if s == side]
            proof = "does not match the digest written with it"
            damage += [f"the recorded {side} on bus {p.bus}, {packet_text(p)}, {proof}" for p in packets]
            if computed != written and not packets:
                damage.append(
                    f"the recorded {side}s do not match the digest written with them, although each packet "
                    f"does: something else in the tick was changed, or the tick before it is missing"
                )
        return tuple(damage)


def packet_text(packet: Packet) -> str:
    """Return a packet's frame as text: a CAN frame in the notation of candump, or bytes in hexadecimal."""
    if isinstance(packet.frame, CanFrame):
        return f"frame {packet.frame}"
    return f"bytes {packet.frame.hex(' ').upper()}"


# -- encode ------------------------------------------------------------------------------------


def encode(tick: Tick, before: DigestChain) -> tuple[bytes, DigestChain]:
    """Return the tick as a message, and the digest chain for the next one."""
    out = bytearray(_ENCAPSULATION)
    out += _START.pack(tick.number, tick.now)
    _count(out, tick.inputs.states)
    for bus, state in tick.inputs.states:
        _string(out, bus)
        _string(out, state.value)
    _put_packets(out, tick.inputs.packets)
    _put_messages(out, tick.inputs.instructions)
    half = len(out)
    _put_packets(out, tick.outputs.packets)
    _put_messages(out, tick.outputs.events)
    _count(out, tick.outputs.notes)
    for note in tick.outputs.notes:
        _string(out, note.level)
        _string(out, note.source)
        _string(out, note.text)
    chain = _chained(out, half, len(out), before)
    out += chain.inputs
    out += chain.outputs
    return bytes(out), chain


def _chained(data: bytes | bytearray, half: int, end: int, before: DigestChain) -> DigestChain:
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
        if isinstance(frame, CanFrame):
            flags = frame.extended | frame.remote << 1 | frame.fd << 2 | frame.brs << 3
            number, kind, flags, data = frame.id, _CAN, flags | frame.requested << _REQUESTED, frame.data
        else:
            number, kind, flags, data = 0, _SERIAL, 0, frame
        pack, bus = _packet_layout(packet.bus, len(data))
        packed = pack(packet.t, number, kind, flags, len(bus), bus, len(data), data)
        out += _PAD8[len(out) & 7]
        out += packed
        out += _U32.pack(zlib.crc32(packed))


@lru_cache(maxsize=1024)
def _packet_layout(bus: str, size: int) -> tuple[Callable[..., bytes], bytes]:
    """Return how a packet on a bus, with so much data, is packed up to its checksum; and the bus as it is
    packed."""
    name = bus.encode(errors="backslashreplace") + b"\0"
    layout = f"{_PACKET.format}{len(name)}s{-len(name) % 4}xI{size}s{-size % 4}x"
    return struct.Struct(layout).pack, name


def _put_messages(out: bytearray, messages: Sequence[Message]) -> None:
    _count(out, messages)
    for message in messages:
        _bytes(out, pack(message))


# -- decode ------------------------------------------------------------------------------------


def decode(data: bytes, before: DigestChain) -> TickEntry:
    """Return the tick in a message; `before` is the chain written with the tick before it.

    Raises TickCodecError if the bytes are not a tick. Whether a tick was changed is in `TickEntry.damage`."""
    try:
        return _decode(data, before)
    except UnknownKind:
        raise
    except (struct.error, IndexError, UnicodeDecodeError, ValueError, TypeError) as error:
        raise TickCodecError(f"not the bytes of a tick: {error}") from error


def _decode(data: bytes, before: DigestChain) -> TickEntry:
    reader = _Reader(data)
    if data[:_BODY] != _ENCAPSULATION:
        raise TickCodecError(f"it starts with {data[:_BODY].hex(' ')}, not with {_ENCAPSULATION.hex(' ')}")
    number, now = cast(tuple[int, int], reader.take(_START))
    states = tuple((reader.string(), BusState(reader.string())) for _ in range(reader.count()))
    received = reader.packets()
    instructions = cast(tuple[Instruction, ...], reader.messages())
    half = reader.at
    sent = reader.packets()
    events = cast(tuple[Event, ...], reader.messages())
    notes = tuple(Note(reader.level(), reader.string(), reader.string()) for _ in range(reader.count()))
    end = reader.at
    if len(data) != end + 2 * _DIGEST:
        raise TickCodecError(f"{len(data) - end} bytes after the last note, expected {2 * _DIGEST}")
    bad_packets = [("input", p) for p, good in received if not good]
    bad_packets += [("output", p) for p, good in sent if not good]
    return TickEntry(
        Tick(
            number,
            now,
            Inputs(states, tuple(p for p, _ in received), instructions),
            Outputs(tuple(p for p, _ in sent), events, notes),
        ),
        DigestChain(data[end : end + _DIGEST], data[end + _DIGEST :]),
        _chained(data, half, end, before),
        tuple(bad_packets),
    )


class _Reader:
    """A position in the bytes of a message."""

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
            raise TickCodecError(f"{count} items do not fit in {len(self.data)} bytes")
        return count

    def bytes(self, size: int) -> bytes:
        if size > len(self.data) - self.at:
            raise TickCodecError(f"{size} bytes wanted, {len(self.data) - self.at} left")
        self.at += size
        return self.data[self.at - size : self.at]

    def string(self) -> str:
        data = self.bytes(self.count())
        if data[-1:] != b"\0":
            raise TickCodecError("a string without its terminator")
        return data[:-1].decode()

    def level(self) -> Literal["info", "warning", "error"]:
        level = self.string()
        if level not in _LEVELS:
            raise TickCodecError(f"a note of level {level!r}")
        return cast(Literal["info", "warning", "error"], level)

    def messages(self) -> tuple[Message, ...]:
        return tuple(self._message() for _ in range(self.count()))

    def _message(self) -> Message:
        data = self.bytes(self.count())
        message = unpack(data)
        if message is None:
            if kind := kind_in(data):
                raise UnknownKind(kind)
            raise TickCodecError("a message of an unknown kind")
        return message

    def packets(self) -> list[tuple[Packet, bool]]:
        return [self._packet() for _ in range(self.count())]

    def _packet(self) -> tuple[Packet, bool]:
        whole, start = self.data, self.at + (_BODY - self.at) % 8
        t, id_, kind, flags, size = _PACKET.unpack_from(whole, start)
        at = start + _PACKET.size
        bus = whole[at : at + size - 1].decode()
        at += size + -size % 4
        (size,) = _U32.unpack_from(whole, at)
        at += _U32.size
        data = whole[at : at + size]
        at += size + -size % 4
        good = zlib.crc32(whole[start:at]) == _U32.unpack_from(whole, at)[0]
        self.at = at + _U32.size
        if kind > _CAN:
            raise TickCodecError(f"a packet of kind {kind}")
        if kind == _SERIAL:
            return Packet(t, bus, data), good
        extended, remote, fd, brs = (bool(flags & bit) for bit in (_EXTENDED, _REMOTE, _FD, _BRS))
        frame = CanFrame(id_, data, extended, remote, fd, brs, flags >> _REQUESTED)
        return Packet(t, bus, frame), good
