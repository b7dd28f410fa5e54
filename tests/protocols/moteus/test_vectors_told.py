"""Bytes of a device, and what the driver tells and asks then: by length, register and moment."""

from __future__ import annotations

import math
from math import tau

import pytest

from protocols.moteus import RANGES
from protocols.moteus.codec import decode, reply_id, single
from protocols.moteus.driver import MoteusDriver
from protocols.moteus.faults import FAULTS
from protocols.moteus.options import Options, serial_of
from protocols.wire import BusState, CanFrame, Wire
from protocols.words import (
    MILLISECOND,
    SECOND,
    ClearFault,
    Command,
    Done,
    Event,
    Fault,
    Feedback,
    Found,
    Hold,
    Idle,
    Mode,
    Nanos,
    Position,
    ReadParameter,
    Refused,
    Release,
    Request,
    Scan,
    SetId,
    State,
    Stop,
    Torque,
    Velocity,
    Zero,
)
from tests.protocols.moteus.from_package import UUID
from tests.protocols.moteus.helpers import device
from tests.protocols.moteus.test_vectors import AT, VECTORS, Talk
from tests.protocols.moteus.test_vectors_heard import talk, told

QUARTER = ("0000803e", 0.25 * tau)


def frame(data: str, identifier: int = 0x500) -> CanFrame:
    plain = bytes.fromhex(data)
    size = min(n for n in (*range(9), 12, 16, 20, 24, 32, 48, 64) if n >= len(plain))
    return CanFrame(identifier, plain.ljust(size, b"\x50"), identifier > 0x7FF, False, True, True)


def plain(it: Talk, data: str) -> Feedback:
    """The one measurement in an answer."""
    (event,) = it.hear(frame(data))
    assert isinstance(event, Feedback)
    return event


@pytest.mark.parametrize(
    ("data", "fields"),
    [
        ("2d01" + "0000803e", {"position": 0.25 * tau}),
        ("2d02" + "0000c0bf", {"velocity": -1.5 * tau}),
        ("2d03" + "0000003e", {"torque": 0.125}),
        ("2f01" + "0000803e" + "0000c0bf" + "0000003e",
         {"position": 0.25 * tau, "velocity": -1.5 * tau, "torque": 0.125}),
        ("2d0d" + "0000c441", {"voltage": 24.5}),
        ("230d" + "31" + "29" + "00", {"voltage": 24.5, "temperature": 41.0}),
        ("250e" + "9d01", {"temperature": 41.3}),
        ("250a" + "f500", {"temperature": 24.5}),
        ("250a" + "f500" + "250e" + "9d01", {"temperature": 41.3}),
        ("250a" + "9d01" + "250e" + "f500", {"temperature": 41.3}),
        ("2d04" + "00002041" + "2d0d" + "0000c441", {"current": 10.0, "voltage": 24.5}),
        ("2503" + "0d00", {"torque": 0.13}),
        ("2501" + "c409", {"position": 0.25 * tau}),
        ("2901" + "a8610000", {"position": 0.25 * tau}),
        ("2101" + "19", {"position": 0.25 * tau}),
        ("2d01" + "00000080", {"position": 0.0}),
        ("2d01" + "ffff7f00", {"position": 0.0}),  # less than the least normal number
        ("2d01" + "00008000", {"position": 2.0**-126 * tau}),
        ("2d01" + "ffff7f80", {"position": 0.0}),
    ],
)  # fmt: skip
def test_measurements_beside_vectors(data: str, fields: dict[str, float]) -> None:
    it = talk()
    event = plain(it, data)
    names = ("position", "velocity", "torque", "current", "voltage", "temperature")
    for name in names:
        value, expected = getattr(event, name), fields.get(name)
        assert value == (None if expected is None else pytest.approx(expected, rel=1e-7, abs=0.0))
    assert (event.motor, event.t) == ("left", it.now)


@pytest.mark.parametrize("data", ["2d04" + "00002041", "2d01" + "0000c07f", "210c01", "", "50", "41010161"])
def test_answers_without_a_measurement_beside_vectors(data: str) -> None:
    it = talk()
    before = it.driver.tally.heard
    assert it.hear(frame(data)) == []
    assert it.driver.tally.heard == before + 1


@pytest.mark.parametrize(
    "data",
    [
        "2d01" + "0000807f",
        "2d01" + "000080ff",
        "2e01" + "0000803e" + "0000807f",
        "2f01" + "0000803e" * 2,  # cut off
        "010000",
        "0d01" + "0000803e",
        "1101",
        "40010161",
        "420130",
        "60",
        "2000" + "ff" * 5,
        "21000a" + "2f01" + "0000807f" + "00000000" * 2 + "210f00",
        "21000a" + "2f01" + "00000000" + "0000807f" + "00000000" + "210f00",
        "21000a" + "2f01" + "00000000" * 2 + "000080ff" + "210f00",
    ],
)
def test_answers_that_are_none_beside_vectors(data: str) -> None:
    it = talk()
    before = (it.driver.tally.bad, it.driver.tally.heard)
    assert it.hear(frame(data)) == []
    assert (it.driver.tally.bad, it.driver.tally.heard) == (before[0] + 1, before[1])


@pytest.mark.parametrize("size", range(65))
def test_lengths_of_answers_beside_vectors(size: int) -> None:
    sizes = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
    assert (decode(b"\x50" * size) is not None) == (size in sizes)


FAST = "21000a" + "2f01" + "0000803e" + "0000c0bf" + "0000003e" + "210f00"
FULL = (
    "21000a" + "2c0401" + "0000803e" + "0000c0bf" + "0000003e" + "00002041"
    "24060a" + "2701" + "0100" + "0200" + "f500" + "9d01" + "0300" + "50" * 11
)
SHAPES: list[tuple[str, int, str, dict[int, float | None] | None]] = [
    # an answer, from which byte on, what stands there instead, which registers are told then; None: none
    (FAST, 2, "80", {0: None}),
    (FAST, 2, "ff", {0: -1}),
    (FAST, 2, "7f", {0: 127}),
    (FAST, 19, "80", {0x0F: None}),
    (FAST, 19, "26", {0x0F: 38}),
    (FAST, 5, "0000c07f", {1: None}),
    (FAST, 9, "0000c0ff", {2: None}),
    (FAST, 13, "0100807f", {3: None}),
    (FAST, 13, "0000807f", None),
    (FAST, 13, "ffff7f7f", {3: 3.4028234663852886e38}),
    (FAST, 5, "01000000" * 3, {1: 0.0, 2: 0.0, 3: 0.0}),
    (FULL, 2, "80", {0: None}),
    (FULL, 6, "0000c07f", {1: None}),
    (FULL, 10, "0000c07f", {2: None}),
    (FULL, 14, "0000c07f", {3: None}),
    (FULL, 18, "0000c07f", {4: None}),
    (FULL, 18, "0000807f", None),
    (FULL, 6, "01000000" * 4, {1: 0.0, 2: 0.0, 3: 0.0, 4: 0.0}),
    (FULL, 25, "0080" * 6, dict.fromkeys(range(0x0A, 0x10))),
    (FULL, 25, "ff7f" * 2, {0x0A: 3276.7, 0x0B: 32767}),
    (FULL, 25, "0080", {0x0A: None}),
]


@pytest.mark.parametrize(("data", "at", "instead", "differ"), SHAPES)
def test_answers_that_come_all_the_time_beside_vectors(
    data: str, at: int, instead: str, differ: dict[int, float | None] | None
) -> None:
    whole = bytes.fromhex(data)
    changed = whole[:at] + bytes.fromhex(instead) + whole[at + len(instead) // 2 :]
    was, now = decode(whole), decode(changed)
    assert was is not None
    if differ is None:
        assert now is None
        return
    assert now is not None
    expected = dict(was.values) | differ
    assert list(now.values) == list(expected)
    for register, value in expected.items():
        assert now.values[register] == (None if value is None else pytest.approx(value, rel=1e-12, abs=0.0))
    assert (now.errors, now.console) == ((), b"")
    for value in now.values.values():
        assert value is None or math.copysign(1.0, value) == 1.0 or value != 0.0


def test_what_an_answer_of_another_shape_tells_beside_vectors() -> None:
    for shape, at in ((FAST, 0), (FAST, 3), (FAST, 17), (FULL, 0), (FULL, 3), (FULL, 22)):
        other = bytearray(bytes.fromhex(shape))
        other[at] = 0x60
        assert decode(bytes(other)) is None
    moved = decode(bytes.fromhex(FAST.replace("210f00", "210c01")))
    assert moved is not None
    assert dict(moved.values) == {0: 10, 1: 0.25, 2: -1.5, 3: 0.125, 0x0C: 1}
    more = decode(bytes.fromhex(FULL[: -2 * 11] + "31d00201" + "50" * 7))
    assert more is not None
    assert (len(more.values), len(more.errors)) == (11, 1)
    told_ = decode(bytes.fromhex("41010568656c6c6f" + "41010121" + "50505050"))
    assert told_ is not None
    assert (told_.console, dict(told_.values), told_.errors) == (b"hello!", {}, ())
    complaint = decode(bytes.fromhex("300f02" + "31d00201" + "50"))
    assert complaint is not None
    assert [(e.code, e.register, e.number) for e in complaint.errors] == [(0x30, 15, 2), (0x31, 0x150, 1)]


def test_numbers_at_the_end_of_binary32_beside_vectors() -> None:
    most = 3.4028234663852886e38
    assert [single(x) for x in (most, -most, 1e39, -1e39)] == [most, -most, most, -most]
    assert [single(x) for x in (2.0**-126, -(2.0**-126), 2.0**-127, -(2.0**-127))] == [
        2.0**-126,
        -(2.0**-126),
        0.0,
        0.0,
    ]


# -- silence and questions -----------------------------------------------------------------------------


def moments(
    options: Options, hears: bool, *, milliseconds: int, start: Nanos = 1000 * SECOND
) -> tuple[list[tuple[int, str]], list[Event]]:
    """When a driver asks what by itself, sending whenever it is due."""
    driver = MoteusDriver([device(address=5, options=options)], RANGES)
    now = start
    asked, events = list[tuple[int, str]](), list[Event]()
    while now < start + milliseconds * MILLISECOND:
        told_, wires = driver.send(now, ())
        events += told_
        asked += [((now - start) // MILLISECOND, w.data.hex()) for w in wires if isinstance(w, CanFrame)]
        if hears and wires:
            events += driver.receive(now, VECTORS["reply_stopped"])
        due = driver.due()
        assert due is not None
        assert due > now
        now = due
    return asked, events


FAST_ASKED, FULL_ASKED = "11001f01110f", "11001c040114060a"


def test_a_device_is_asked_as_in_vectors_when_it_is_due() -> None:
    options = Options(feedback_ms=20, details_ms=100, offline_ms=200)
    asked, _ = moments(options, hears=True, milliseconds=400)
    questions = [(at, what) for at, what in asked if what in (FAST_ASKED, FULL_ASKED)]
    assert questions == [(20 * i, FAST_ASKED if i % 5 else FULL_ASKED) for i in range(20)]
    identify = VECTORS["identify"]
    assert isinstance(identify, CanFrame)
    assert [at for at, what in asked if what == identify.data.hex()] == [20, 120, 220, 320]


@pytest.mark.parametrize("start", [0, 1000 * SECOND])
def test_silence_is_told_once_and_asked_after_beside_vectors(start: Nanos) -> None:
    options = Options(feedback_ms=20, details_ms=1000, offline_ms=90)
    asked, events = moments(options, hears=False, milliseconds=300, start=start)
    offline = State("left", start + 90 * MILLISECOND, Mode.OFFLINE, "nothing heard")
    assert events == [offline]
    assert [at for at, _ in asked] == [0, 20, 40, 60, 80, 130, 180, 230, 280]
    assert MoteusDriver([], RANGES).due() is None
    assert MoteusDriver([device(address=5)], RANGES).due() == 0


def test_silence_after_a_vector_forgets_who_is_armed() -> None:
    it = Talk().running()
    it.say(Hold("left"))
    heard = it.now
    it.hear(AT)
    events: list[Event] = []
    while not events:
        it.now += MILLISECOND
        told_, wires = it.driver.send(it.now, [Hold("left")])
        events += told_
        commands = [w for w in wires if getattr(w, "data", b"")[:3] == b"\x01\x00\x0a"]
        assert bool(commands) != bool(events)
    assert events == [State("left", heard + 200 * MILLISECOND, Mode.OFFLINE, "nothing heard")]
    assert [w for w in it.say(Hold("left")) if w.data[:1] == b"\x01"] == []
    assert told(it, "reply_stopped") == [State("left", it.now, Mode.READY, "stopped")]
    assert [w.data[:3] for w in it.say(Hold("left"))][:1] == [b"\x01\x00\x0a"]


def test_who_it_is_is_asked_again_when_it_comes_back_as_in_vectors() -> None:
    for state in (BusState.BACK, BusState.GONE, BusState.OFF):
        it = talk()
        assert VECTORS["identify"] not in it.say()
        it.driver.bus(it.now, state)
        it.hear(VECTORS["reply_stopped"])
        assert VECTORS["identify"] in it.say()
    it = talk()
    it.driver.bus(it.now, BusState.FULL)
    it.hear(VECTORS["reply_stopped"])
    assert VECTORS["identify"] not in it.say()


def test_requests_outlive_a_bus_that_comes_back_or_is_full_beside_vectors() -> None:
    for state in (BusState.BACK, BusState.FULL):
        it = talk()
        it.say(ReadParameter("left", "power"))
        it.driver.bus(it.now, state)
        assert [type(event).__name__ for event in told(it, "reply_power")] == ["Parameter"]
    it = talk()
    it.say(ReadParameter("left", "power"))
    it.driver.bus(it.now, BusState.OFF)
    at = it.now
    assert it.driver.send(it.now + 1, ())[0] == [Refused(at, "ReadParameter", "left", "the bus is off")]


# -- modes and faults ----------------------------------------------------------------------------------

NAMES = [
    "stopped",
    "fault",
    "enabling",
    "calibrating",
    "calibration_complete",
    "pwm",
    "voltage",
    "voltage_foc",
    "voltage_dq",
    "current",
    "position",
    "timeout",
    "zero_velocity",
    "stay_within",
    "measure_ind",
    "brake",
    "mode_16",
]


@pytest.mark.parametrize("number", range(17))
def test_the_mode_that_a_vector_tells(number: int) -> None:
    it = Talk()
    data = AT.replace("21000a", f"2100{number:02x}", 1)
    events = [event for event in it.hear(data) if isinstance(event, State)]
    ready = number in (0, 2, 3, 4)
    mode = Mode.FAULT if number in (1, 11) else Mode.READY if ready else Mode.ARMED
    assert events == [State("left", it.now, mode, NAMES[number].replace("_", " "))]
    assert [event for event in it.hear(data) if not isinstance(event, Feedback)] == []
    if number in (1, 11):
        stopped = f"{NAMES[0]}, not cleared yet"
        assert told(it, "reply_stopped") == [State("left", it.now, Mode.FAULT, stopped)]


@pytest.mark.parametrize("code", [code for code in FAULTS if code < 0x100 and code != 11])
def test_a_fault_of_a_vector_is_told_with_its_code(code: int) -> None:
    it = talk()
    text = FAULTS[code]
    data = "210001" + "2f01" + "00000000" * 3 + f"210f{code:02x}"
    fault = Fault("left", it.now, code, text.name, text.cause, text.cure)
    events = [event for event in it.hear(data) if not isinstance(event, Feedback)]
    assert events == [fault, State("left", it.now, Mode.FAULT, "fault")]


def test_a_fault_whose_code_no_vector_has_told_waits_for_it() -> None:
    it = talk()
    assert it.hear(frame("210001")) == [State("left", it.now, Mode.FAULT, "fault")]
    assert [f for _ in range(9) for f in it.say(Hold("left")) if f.data[:1] == b"\x01"] == []
    (fault,) = it.hear(frame("210001210f26"))
    assert isinstance(fault, Fault)
    assert fault.code == 38
    assert it.hear(frame("210001")) == []
    (other,) = it.hear(frame("210001210f21"))
    assert isinstance(other, Fault)
    assert other.code == 33
    timeout, state = talk().hear(frame("21000b"))
    assert isinstance(timeout, Fault)
    assert isinstance(state, State)
    assert (timeout.code, state.mode, state.detail) == (11, Mode.FAULT, "timeout")


def test_a_fault_ends_what_was_going_on_beside_vectors() -> None:
    it = Talk().running()
    it.say(Velocity("left", 1.0))
    it.hear(VECTORS["reply_fast_fault"])
    for _ in range(9):
        assert [f for f in it.say(Velocity("left", 1.0)) if f.data[:1] == b"\x01"] == []
        it.hear(VECTORS["reply_fast_fault"])
    it.say(ClearFault("left"))
    ended = told(it, "reply_stopped")
    assert ended[-1] == Done(it.now, "ClearFault", "left")
    first = it.say(Velocity("left", 1.0))[0]
    assert first.data.hex().startswith("01000a0f200000803e0000000000000000")  # where the shaft is, at rest


def test_clear_is_refused_with_the_fault_that_stays_as_in_the_vector() -> None:
    it = talk()
    told(it, "reply_fast_fault")
    it.say(ClearFault("left"))
    events: list[Event] = []
    for _ in range(119):
        it.now += 5 * MILLISECOND
        events += it.driver.send(it.now, ())[0]
        events += told(it, "reply_fast_fault")
    assert events == []
    it.now += 5 * MILLISECOND
    (refused,) = it.driver.send(it.now, ())[0]
    assert refused == Refused(it.now, "ClearFault", "left", "still in fault: over temperature")
    again = told(it, "reply_fast_fault")
    assert [type(event) for event in again] == [Fault, State]
    it.say(ClearFault("left"))
    start = it.now
    mute = [e for _ in range(125) for e in _later(it) if isinstance(e, Refused)]
    assert mute == [Refused(start + 600 * MILLISECOND, "ClearFault", "left", "no answer of the device")]


def _later(it: Talk) -> list[Event]:
    it.now += 5 * MILLISECOND
    return list(it.driver.send(it.now, ())[0])


# -- arming, set-points and stops ----------------------------------------------------------------------

MOVE = "01000a0f20"


def command(it: Talk, word: Command) -> str:
    """The first frame that goes out, without its question."""
    return it.say(word)[0].data.hex()


@pytest.mark.parametrize(
    ("word", "first", "then"),
    [
        (Hold("left"), MOVE + "0000803e" + "00000000" * 2, MOVE + "0000803e" + "00000000" * 2),
        (Position("left", tau, -tau, 0.5), MOVE + "0000803e" + "00000000" * 2,
         MOVE + "0000803f" + "000080bf" + "0000003f"),
        (Velocity("left", tau, 0.5), MOVE + "0000803e" + "00000000" * 2,
         MOVE + "0000c07f" + "0000803f" + "0000003f"),
        (Torque("left", 0.5), "01000a0c0520" + "0000803e" + "00000000" * 4,
         "01000a0c0520" + "0000803e" + "00000000" + "0000003f" + "00000000" * 2),
    ],
)  # fmt: skip
def test_arming_as_in_vectors(word: Command, first: str, then: str) -> None:
    it = talk()
    for vector in ("reply_stopped", "reply_stopped", "reply_enabling", "reply_enabling"):
        assert command(it, word).startswith(first)
        it.hear(VECTORS[vector])
    assert command(it, word).startswith(first)
    it.hear(AT)
    assert command(it, word).startswith(then)
    it.hear(AT)
    assert command(it, word).startswith(then)


def test_a_hold_stays_where_the_vector_had_it_first() -> None:
    it = Talk().running()
    held = MOVE + "0000803e" + "00000000" * 2
    assert command(it, Hold("left")).startswith(held)
    it.hear(AT.replace("0000803e", "0000003f", 1))
    assert command(it, Hold("left")).startswith(held)
    it.say(Position("left", tau))
    assert command(it, Hold("left")).startswith(MOVE + "0000003f" + "00000000" * 2)
    it.hear(AT)
    it.say(Idle("left"))
    assert command(it, Hold("left")).startswith(held)


def test_a_velocity_starts_at_the_shaft_after_anything_else_beside_vectors() -> None:
    placed, free = MOVE + "0000803e" + "0000803f", MOVE + "0000c07f" + "0000803f"
    others: tuple[Command, ...] = (Hold("left"), Position("left", 1.0), Torque("left", 0.5), Idle("left"))
    for other in others:
        it = Talk().running()
        for _ in range(5):
            it.say(Velocity("left", tau))
            it.hear(AT)
        assert command(it, Velocity("left", tau)).startswith(free)
        it.say(other)
        it.hear(AT)
        for _ in range(3):
            assert command(it, Velocity("left", tau)).startswith(placed)
            it.hear(AT)
        assert command(it, Velocity("left", tau)).startswith(free)
    it.driver.bus(it.now, BusState.FULL)
    assert command(it, Velocity("left", tau)).startswith(placed)


def stops(it: Talk, steps: int, word: Command | Request, *, hears: str = "") -> list[int]:
    """In which steps of 5 ms a stop goes out."""
    found = []
    for at in range(steps):
        sent = it.say(word)
        found += [at for f in sent if f.data[:3] == b"\x01\x00\x00"]
        if hears:
            it.hear(VECTORS[hears])
    return found


def test_stops_are_repeated_until_vectors_confirm_them() -> None:
    it = Talk().running()
    it.say(Hold("left"))
    assert stops(it, 20, Idle("left")) == [0, 4, 8, 12, 16]
    assert stops(it, 9, Idle("left"), hears="reply_stopped") == [0]
    it = Talk().running()
    assert stops(it, 9, Idle("left")) == []  # nobody has commanded it
    it.say(Hold("left"))
    it.say(Idle("left"))
    it.hear(VECTORS["reply_timeout"])
    assert stops(it, 20, Idle("left")) == []
    it = Talk().running()
    it.say(Hold("left"))
    it.say(Idle("left"))
    it.driver.bus(it.now, BusState.FULL)
    assert stops(it, 3, Idle("left")) == [0]


def test_an_operator_s_stop_reaches_what_we_did_not_arm_beside_vectors() -> None:
    it = Talk().running()
    it.now += 5 * MILLISECOND
    events, wires = it.driver.send(it.now, [Stop("now"), Idle("left")])
    assert events == []
    assert VECTORS["stop_with_query"] in wires
    it = Talk().running()
    assert stops(it, 3, Idle("left")) == []


# -- scan and ids --------------------------------------------------------------------------------------


def test_a_uuid_without_more_is_as_good_as_the_vector() -> None:
    it = talk()
    it.say(Scan("can0"))
    printed = "01234567-89ab-cdef-fedc-ba9876543210"
    words = "2804d002" + UUID.hex()
    assert it.hear(frame(words, 0x900)) == [Found(it.now, "moteus", 9, serial_of(UUID), f"UUID {printed}")]
    assert it.hear(frame(words + "21d80200", 0xA00)) == []  # all zero bytes, perhaps: not to be told apart
    assert it.hear(frame("2803d002" + UUID[:12].hex(), 0xB00)) == []
    none = "31d00201" + "31d80201"
    assert it.hear(frame(none, 0xC00)) == [
        Found(it.now, "moteus", 12, None, "it has no UUID: older firmware")
    ]
    assert it.hear(frame("300f02", 0xD00)) == []
    twice = f"UUID {'-'.join(('10325476', '98ba', 'dcfe', 'efcd', 'ab8967452301'))}; id 9 is held twice"
    assert it.hear(frame("2804d002" + UUID[::-1].hex(), 0x900)) == [
        Found(it.now, "moteus", 9, serial_of(UUID[::-1]), twice, True)
    ]


@pytest.mark.parametrize("identifier", [0x901, 0x8900, 0x980, 0x1_0900, 0x1ABC_0900, 0x87F], ids=hex)
def test_answers_to_others_are_not_found_beside_vectors(identifier: int) -> None:
    it = talk()
    it.say(Scan("can0"))
    assert it.hear(frame("2804d002" + UUID.hex() + "21d80201", identifier)) == []


def test_when_a_scan_asks_and_ends_beside_vectors() -> None:
    it = talk()
    times, events, start = list[int](), list[Event](), it.now + 5 * MILLISECOND
    for at in range(170):
        it.now += 5 * MILLISECOND
        said, wires = it.driver.send(it.now, [Scan("can0")] if not at else [])
        events += said
        times += [
            (it.now - start) // MILLISECOND for wire in wires if wire == VECTORS["discover_broadcast_0x7f"]
        ]
        it.hear(VECTORS["reply_stopped"])
    assert times == [0, 200, 400, 600]
    assert events == [Done(start + 800 * MILLISECOND, "Scan", "can0", "0 devices")]
    it.say(Scan("can0"))
    told(it, "reply_uuid")
    ends = [e for _ in range(170) for e in _later(it) if isinstance(e, Done)]
    assert [e.detail for e in ends] == ["1 device"]


def test_when_an_id_is_given_beside_vectors() -> None:
    it = talk()
    times, events, start = list[int](), list[Event](), it.now + 5 * MILLISECOND
    for at in range(320):
        it.now += 5 * MILLISECOND
        said, wires = it.driver.send(it.now, [SetId("can0", serial_of(UUID), 9)] if not at else [])
        events += said
        times += [(it.now - start) // MILLISECOND for wire in wires if wire == VECTORS["discover_by_uuid"]]
        it.hear(VECTORS["reply_stopped"])
    assert times == [150 * i for i in range(10)]
    reason = "no device with serial number 0123456789ABCDEF took the id"
    assert events == [Refused(start + 1500 * MILLISECOND, "SetId", "can0", reason)]


def test_a_uuid_that_was_heard_long_ago_is_no_second_device_beside_vectors() -> None:
    for late, twice in ((10 * SECOND, True), (10 * SECOND + 1, False)):
        it = talk()
        it.now += late
        events = told(it, "reply_uuid_other")
        assert any(isinstance(event, Found) for event in events) == twice


def test_all_prefixes_in_use_are_asked_beside_vectors() -> None:
    options = Options(can_prefix=0x1ABC, host_id=3)
    driver = MoteusDriver([device("left", 5), device("far", 6, options=options), device("n", 7)], RANGES)
    wires = driver.send(1, [Scan("can0")])[1]
    data = bytes.fromhex("1804d00211d802")
    assert [w.id for w in wires if isinstance(w, CanFrame) and w.data == data] == [0x807F, 0x1ABC837F]
    found = driver.receive(2, frame("2804d002" + UUID.hex(), 0x1ABC0903))
    assert [type(event) for event in found] == [Found]
    assert reply_id(9, 3, 0x1ABC) == 0x1ABC0903


# -- zero ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "near"),
    [("0ad7233b", True), ("0ad723bb", True), ("0ad7233c", True), ("cdcccc3d", False), ("cdccccbd", False),
     ("0000c07f", False)],
)  # fmt: skip
def test_a_zero_is_near_enough_beside_vectors(place: str, near: bool) -> None:
    it = talk()
    it.say(Zero("left"))
    assert it.hear(frame("2d01" + "00000000")) != []  # from before: a measurement, and no more
    it.hear(frame("31b10201"))
    events = it.hear(frame("2d01" + place))
    assert [type(e) for e in events if not isinstance(e, Feedback)] == ([Done] if near else [])


# -- the wire ------------------------------------------------------------------------------------------


def test_what_is_foreign_beside_vectors() -> None:
    it = talk()
    good = VECTORS["reply_fast"]
    assert isinstance(good, CanFrame)
    others: list[Wire] = [
        good.data,
        CanFrame(0x500, good.data[:8], False, False, False),
        CanFrame(0x500, b"", False, True, False),
        CanFrame(0x500, good.data, True, False, True, True),
        CanFrame(0x600, good.data, False, False, True, True),
        CanFrame(0x8500, good.data, True, False, True, True),
    ]
    for at, wire in enumerate(others, 1):
        assert it.hear(wire) == []
        assert it.driver.tally.foreign == at
    far = Talk(Options(can_prefix=1))
    wide = CanFrame(0x1_0500, good.data, True, False, True, True)
    assert len(far.hear(wide)) == 2
    assert (far.driver.tally.heard, far.driver.tally.foreign) == (1, 0)


def test_a_release_asks_nothing_beside_vectors() -> None:
    it = Talk().running()
    it.now += 5 * MILLISECOND
    events, _ = it.driver.send(it.now, [Release()])
    assert [type(event) for event in events] == [Refused]
