"""Tables of vectors: frames of package canopen, whole, cut, and with other first bytes, and what they mean.

Rules. Pure functions of the language on every edge of what can reach them; a line for each. `kept` in
conversations.txt beside the conversations; what canopen knows itself (states, abort codes, lengths) the tests
compare with canopen.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from protocols.cia402 import (
    arming,
    codec,
    faults,
    machine,
    mapping,
    objects,
    pdo,
    plugin,
    profile,
    sdo,
    startup,
    units,
)
from protocols.cia402 import objects as o
from protocols.cia402.dictionary import Dictionary
from protocols.cia402.mapping import Pdo
from protocols.cia402.options import Options, Settings
from protocols.cia402.pdo import Entry
from protocols.cia402.profile import Demand, PowerState
from protocols.plugin import Device
from protocols.wire import CanFrame
from tests.protocols.cia402.vectors import VECTORS

NODE = 2
PARSED = (
    "6083",
    "0x6083",
    "608F:01",
    "608Fsub1",
    " 608f Sub 02 ",
    "0X1018:4",
    "1018:ff",
    "1018:100",
    "1018:-1",
    "60830",
    "608",
    "-608",
    "6083:",
    "nonsense",
    "6083:xx",
    "0x",
    "Position actual value",
    " target TORQUE",
    "+608",
    "6_83",
    "6083 0x",
    "5FFF",
)
CODES = (
    0,
    1,
    0x0FFF,
    0x1000,
    0x10FF,
    0x2310,
    0x2400,
    0x3110,
    0x3FFF,
    0x4210,
    0x5000,
    0x6320,
    0x7305,
    0x8000,
    0x80FF,
    0x8130,
    0x8210,
    0x8311,
    0x8400,
    0x8611,
    0x8700,
    0x9000,
    0xA000,
    0xF001,
    0xFF00,
    0xFFFF,
    0x1FFFF,
)
FORMS = ((16,), (8, 8), (1, 7), (4, 12, 16), (3, 5, 24, 32), (64,), (40, 24), (33,), (65,), (0,), (8,) * 9)
CHANGES: tuple[dict[str, Any], ...] = (
    {},
    {"cob": 0x80000182},
    {"cob": 0x40000182},
    {"cob": 0x20000182},
    {"cob": 0x183},
    {"cob": 0xC0000182},
    {"transmission": 0},
    {"transmission": 1},
    {"transmission": 10},
    {"transmission": 240},
    {"transmission": 241},
    {"transmission": 255, "event_ms": 0},
    {"event_ms": 9},
    {"event_ms": 10},
    {"event_ms": 11},
    {"event_ms": 65535},
    {"entries": ()},
    {"entries": (Entry(0x6041, 0, 16),)},
    {"entries": (Entry(0x6064, 0, 32),)},
    {"entries": (Entry(0x6064, 0, 16), Entry(0x6041, 0, 16))},
    {"entries": (Entry(5, 0, 8), Entry(0x6041, 0, 16), Entry(0x6064, 0, 32))},
    {"entries": (Entry(0x2000, 1, 8),)},
    {"entries": (Entry(1, 0, 8), Entry(0x6040, 0, 16), Entry(0x607A, 0, 32))},
    {"entries": (Entry(8, 0, 8),)},
    {"entries": (Entry(0x6040, 0, 16), Entry(0x60FF, 0, 32))},
    {"entries": (Entry(0x607A, 0, 32),)},
    {"entries": (Entry(0x60FF, 0, 32), Entry(0x6071, 0, 16))},
    {"entries": (Entry(0x6081, 0, 32),)},
)


def frames() -> list[CanFrame]:
    """The vectors, each also cut short and one byte longer."""
    found: dict[CanFrame, None] = {}
    for vector in VECTORS:
        wire = vector.wire
        assert isinstance(wire, CanFrame)
        for data in (wire.data, wire.data[:-1], wire.data + b"\x05", b"", wire.data[:1]):
            found[CanFrame(wire.id, data)] = None
    odd = [
        CanFrame(id_, bytes(size))
        for id_ in (0x700, 0x701, 0x77F, 0x080, 0x081, 0x580)
        for size in (0, 1, 2, 8, 9)
    ]
    return [*found, *odd, CanFrame(0, b"\x01\x80"), CanFrame(0, b"\x01\x7f"), CanFrame(0x702, b"\x06")]


def messages() -> Iterator[str]:
    """What each frame means, and that it is said alike."""
    for frame in frames():
        message = codec.decode(frame)
        yield f"{frame} {message}"
        if message is not None:
            yield f"  {codec.encode(message)}"
    for frame in (CanFrame(0x80, b"", extended=True), CanFrame(0x80, fd=True), CanFrame(0x80, remote=True)):
        yield f"{codec.decode(frame)} {codec.is_classic(frame)}"


def transfers() -> Iterator[str]:
    """SDO: every first byte, before the bytes of vectors."""
    for tail in ("64600011223344", "ff60007f000000"):
        for command in range(0x100):
            data = bytes((command,)) + bytes.fromhex(tail)
            request, answer = sdo.decode_request(data), sdo.decode_answer(data)
            said = [_said(each) for each in (request, answer)]
            yield f"{data.hex()} {request} {answer} {said}"
    for size in (0, 7, 9):
        yield f"{sdo.decode_request(bytes(size))} {sdo.decode_answer(bytes(size))}"
    for data in (b"", b"1", b"1234", b"12345", b"1234567", b"12345678"):
        said = [_said(sdo.Download(1, 2, data)), _said(sdo.Uploaded(1, 2, data))]
        yield f"{data!r} {said} {_said(sdo.UploadedSegment(True, data, False))}"
    for start in (sdo.DownloadStart(0x1008, 0, None), sdo.UploadStart(0x1008, 0, None)):
        yield str(_said(start))


def _said(message: sdo.Request | sdo.Answer | None) -> str:
    try:
        return "-" if message is None else sdo.encode(message).hex()
    except ValueError as error:
        return str(error)


def pieces() -> Iterator[str]:
    """Transfers in segments: what comes twice, too early, in a wrong order, and too short."""
    answers: tuple[sdo.Answer, ...] = (
        sdo.UploadedSegment(False, b"early", True),
        sdo.UploadStart(0x1008, 0, 9),
        sdo.UploadStart(0x1008, 0, 9),
        sdo.SegmentDownloaded(False),
        sdo.UploadedSegment(True, b"wrong", False),
        sdo.Uploaded(0x1008, 0, b"late"),
        sdo.UploadedSegment(False, b"twin40", False),
        sdo.UploadedSegment(False, b"twin40", False),
        sdo.Abort(0x1009, 0, 1),
        sdo.UploadedSegment(True, b"2!!", True),
        sdo.UploadStart(0x1008, 0, 9),
    )
    written: tuple[sdo.Answer, ...] = (
        sdo.SegmentDownloaded(False),
        sdo.Uploaded(0x1008, 0, b"x"),
        sdo.Downloaded(0x1008, 1),
        sdo.Downloaded(0x1008, 0),
        sdo.Downloaded(0x1008, 0),
        sdo.SegmentDownloaded(True),
        sdo.SegmentDownloaded(False),
        sdo.SegmentDownloaded(False),
        sdo.SegmentDownloaded(True),
        sdo.SegmentDownloaded(False),
        sdo.Abort(0x1008, 0, 0x06010002),
    )
    for size in (9, 8, None):
        transfer = sdo.Transfer(0x1008, 0)
        yield f"{transfer.first()}"
        for answer in answers:
            heard = sdo.UploadStart(0x1008, 0, size) if isinstance(answer, sdo.UploadStart) else answer
            yield f"{heard} {transfer.hear(heard)} {transfer}"
        yield f"{transfer.first()} {transfer}"
    for data in (b"", b"1234", b"12345", b"1234567", b"123456789012345"):
        transfer = sdo.Transfer(0x1008, 0, data)
        yield f"{transfer.first()}"
        for answer in written:
            yield f"{answer} {transfer.hear(answer)} {transfer}"


def states() -> Iterator[str]:
    """Statuswords, controlwords, and what every demand leads to."""
    for word in [*range(0x80), 0x237, 0x1637, 0x8237, 0x218]:
        yield f"{word:#06x} {profile.state_of(word)}"
    for word in range(0, 0x3800, 0x400):
        yield f"{word:#06x} {profile.homing_of(word)} {profile.homing_of(word | 0x237)}"
    for before in (0, 0x80, 0x8F, 0x0F):
        yield " ".join(
            str(profile.demand_of(word, before)) for word in (*range(0x10), 0x80, 0x8F, 0x1F, 0x106)
        )
    for state in PowerState:
        for demand in (None, *Demand):
            after = [machine.obey(state, demand, option).name for option in range(-1, 9)]
            yield f"{state.name} {demand} {after}"
        for option in range(-1, 9):
            yield f"{arming.upward(state, option, placed=True)} {arming.upward(state, option, placed=False)}"
    for late in (False, True):
        yield str(arming.downward(late=late))
    for row in [
        (a, h, t, g) for a in (False, True) for h in (False, True) for t in (5, 6) for g in (None, 5)
    ]:
        yield f"{row} {arming.handshake(*row)}"
    for mode in profile.Mode:
        known = [
            profile.supports(value, mode) for value in (0, 1, 4, 8, 0x20, 0x40, 0x80, 0x100, 0x200, 0x3ED)
        ]
        yield f"{mode!r} {profile.mode_bit(mode)} {startup.mode_name(mode)} {known}"
    yield startup.mode_name(99)


def things() -> Iterator[str]:
    """Objects, their names and addresses, faults and their registers, reasons of aborts."""
    for row in objects.OBJECTS.values():
        yield f"{row} {row.bits} {objects.title(row.key)}"
    for text in PARSED:
        yield f"{text!r} {objects.parse(text)} {objects.find(text)}"
    for code in CODES:
        yield f"{code:#x} {faults.complaint(code)} {faults.register_of(code):#x}"
    for code in sorted([*sdo.ABORTS, 1]):
        yield sdo.abort_text(code)
    for kind in o.Type:
        for value in (
            -(1 << 31) - 1,
            -(1 << 31),
            -32769,
            -32768,
            -129,
            -128,
            -1,
            0,
            127,
            128,
            255,
            256,
            65536,
            1 << 32,
        ):
            yield f"{kind} {value} {o.fits(kind, value)} {_bytes(kind, value)}"
        for size in range(6):
            yield f"{kind} {o.from_bytes(kind, bytes(range(250, 250 + size)))}"
    for size in range(10):
        for key in ((0x2000, 1), o.DEVICE_NAME, o.STATUSWORD, o.POSITION, o.DEVICE_TYPE):
            yield f"{key} {size} {startup.value_of(key, bytes(range(1, size + 1)))}"


def _bytes(kind: o.Type, value: int) -> str:
    try:
        return o.to_bytes(kind, value).hex()
    except (ValueError, OverflowError) as error:
        return type(error).__name__


def packings() -> Iterator[str]:
    """PDOs: packed and unpacked, entries of all lengths."""
    data = bytes.fromhex("0f0008c01dfeff81")
    for form in FORMS:
        for index in (0x2000, 0x6064):
            entries = [Entry(index, sub, bits) for sub, bits in enumerate(form)]
            yield f"{form} {_packed(entries, data)} {[hex(pdo.word_of(one)) for one in entries]}"
    for keys in ((o.CONTROLWORD, o.MODE, o.TARGET_POSITION), (o.STATUSWORD, o.MODE_DISPLAY, o.TORQUE)):
        made = pdo.packing(pdo.mapping(*keys))
        told = [made.unpack(data[:size]) for size in (8, made.size - 1, made.size)]
        yield f"{made} {told}"
        for value in (-1, 0, 127, 128, 65535, 65536):
            yield " ".join(_pack(made, row) for row in ([value] * 3, [1, value, 1], [1, 1, value]))
    for kind in (0, 1, 239, 240, 241, 254, 255):
        yield f"{kind} {pdo.is_synchronous(kind)} {pdo.entry_of(0x60640020 + kind)}"
        yield str(pdo.node_of_cob(0x180 + kind))


def _packed(entries: list[Entry], data: bytes) -> str:
    try:
        made = pdo.packing(entries)
    except ValueError as error:
        return str(error)
    values = made.unpack(data)
    again = _pack(made, list(values or ()))
    most = [(1 << one.bits) for one in entries]
    return (
        f"{made} {values} {again} {_pack(made, most)} {_pack(made, [-1] * len(entries))} {made.unpack(b'')}"
    )


def _pack(made: pdo.Packing, values: list[int]) -> str:
    try:
        return made.pack(values).hex()
    except ValueError as error:
        return str(error)


def mappings() -> Iterator[str]:
    """PDOs of a device: which can be worked with, which fit, what is written."""
    ways: tuple[tuple[mapping.Way, int], ...] = (("from", 0x182), ("to", 0x202))
    for way, cob in ways:
        for change in CHANGES:
            plain: dict[str, Any] = {
                "cob": cob,
                "transmission": 255,
                "event_ms": 10,
                "entries": pdo.mapping(o.STATUSWORD, o.POSITION),
            }
            values = plain | change
            if way == "to":
                values["cob"] = values["cob"] & ~0x80 | 0x200 if "cob" in change else cob
            one = Pdo(way, 1, **values)
            other = Pdo(way, 1, **plain)
            able = [mapping.usable(one, NODE, synced) for synced in (False, True)]
            fits = [
                mapping.feedback_fits([one], sync, most)
                for sync in (0, 10_000_000)
                for most in (10_000_000, 100_000_000)
            ]
            steers = [
                mapping.commands_fit([one], targets)
                for targets in ((), (o.TARGET_POSITION,), (o.TARGET_VELOCITY,))
            ]
            yield f"{one} {one.keys} {one.id:x} {one.period(0)} {one.period(7)} {mapping.same(one, other)}"
            yield f"{able} {fits} {steers}"
            for before in (0, 0x4000_0000):
                said = mapping.writes(one, before)
                yield " ".join(f"{key[0]:x}:{key[1]}={data.hex()}" for key, data in said)
    yield f"{mapping.same(None, other)}"
    for options in (
        Options(),
        Options(modes="profile"),
        Options(feedback="event", feedback_ms=900, offline_ms=3000),
        Options(feedback="sdo"),
    ):
        for synced in (False, True):
            for absent in (
                (),
                (o.TORQUE_OFFSET, o.VELOCITY_OFFSET, o.CURRENT),
                (o.CURRENT, o.DC_VOLTAGE, o.ERROR_CODE),
            ):
                yield str(mapping.wanted(NODE, options, synced, absent))
    yield from _read()


def _read() -> Iterator[str]:
    """What is read of PDOs, step by step, off a dictionary."""
    for settings in (Settings(), Settings(pdos="usual")):
        values = dict(Dictionary(settings, NODE).values)
        values |= {
            (0x1A02, 0): 65,
            (0x1802, 1): 0x382,
            (0x1A03, 0): 2,
            (0x1803, 1): 0x482,
            (0x1603, 0): 1,
            (0x1403, 1): 0x502,
        }
        for lacking in ((), ((0x1800, 1), (0x1A01, 1), (0x1802, 2), (0x1803, 5), (0x1603, 1))):
            read: dict[o.Key, int] = {}
            absent: set[o.Key] = set()
            while (key := startup.next_key(read, absent, named=len(read) > 20)) is not None:
                yield f"{key[0]:x}:{key[1]} {startup.units_known(read, absent)}"
                if key in lacking or key not in values:
                    absent.add(key)
                else:
                    read[key] = values[key]
            for way in startup.WAYS:
                for number in (1, 2, 3, 4):
                    yield str(mapping.pdo_of(number, way, read))
            yield f"{startup.known_of(read, Options())}"


def counted() -> Iterator[str]:
    """Units: what a drive tells of itself, and values through them."""
    tells: tuple[dict[o.Key, int], ...] = (
        {},
        {o.ENCODER_INCREMENTS: 4000},
        {o.RATED_CURRENT: 2000, o.RATED_TORQUE: 700},
        {o.ENCODER_INCREMENTS: 1},
        {o.ENCODER_INCREMENTS: 4000, o.ENCODER_REVOLUTIONS: 2},
        {o.ENCODER_INCREMENTS: 4000, o.ENCODER_REVOLUTIONS: 0},
        {o.ENCODER_INCREMENTS: 4000, o.GEAR_MOTOR: 5},
        {
            o.ENCODER_INCREMENTS: 4000,
            o.GEAR_MOTOR: 5,
            o.GEAR_SHAFT: 2,
            o.RATED_TORQUE: 300,
            o.RATED_CURRENT: 2500,
        },
        {o.ENCODER_INCREMENTS: 4000, o.GEAR_MOTOR: 0, o.FEED: 0},
        {o.FEED: 360},
        {o.FEED: 1, o.FEED_SHAFT: 1},
        {o.FEED: 360_000, o.FEED_SHAFT: 3, o.ENCODER_INCREMENTS: 7, o.RATED_TORQUE: 1, o.RATED_CURRENT: 1},
    )
    for told in tells:
        made = units.units_of(told)
        yield f"{made}"
        for options in (Options(), Options(counts_per_turn=500.0, rated_torque=0.25)):
            yield f"{startup.units_from(told, options)}"
            for absent in ((), (o.STATUSWORD,), (o.POSITION,)):
                for profile_number in (0, 402, 0x30192):
                    yield startup.wrong_with({**told, o.DEVICE_TYPE: profile_number}, absent, options)
        if made is None:
            continue
        for value in (-1000, 1, 32767):
            yield " ".join(
                repr(way(value)) for way in (made.position, made.velocity, made.torque, made.current)
            )
        for wanted in (-1.0, 0.0, 1e-9, 0.3, 1e5, 1e9, math.inf):
            ways = (made.to_position, made.to_velocity, made.to_unsigned, made.to_torque)
            yield " ".join(_tried(way, wanted) for way in ways)


def _tried(way: object, value: float) -> str:
    try:
        return repr(way(value))  # type: ignore[operator]  # one of four methods
    except (ValueError, OverflowError) as error:
        return str(error)


DISAGREEING: tuple[dict[str, Any], ...] = (
    {},
    {"sync_ms": 5},
    {"host_id": 3},
    {"watchdog_ms": 700},
    {"feedback": "event"},
    {"feedback": "sdo", "sync_ms": 7, "host_id": 5},
    {"mapping": "keep", "modes": "profile"},
)


def agreements() -> Iterator[str]:
    """Drives of one bus: what must be the same for all, and what of an identifier taken twice."""
    for one in DISAGREEING:
        for other in DISAGREEING:
            for addresses in ((1, 2, 3), (5, 2, 5), (1, 127, 3)):
                devices = [
                    Device(name, address, Options(**options), Settings())
                    for name, address, options in zip("abc", addresses, (one, other, {}), strict=True)
                ]
                try:
                    plugin.driver(devices)
                    yield "agreed"
                except ValueError as error:
                    yield str(error)


TABLES = {
    "table, messages": messages,
    "table, transfers": transfers,
    "table, pieces": pieces,
    "table, states": states,
    "table, things": things,
    "table, packings": packings,
    "table, mappings": mappings,
    "table, units": counted,
    "table, agreements": agreements,
}
