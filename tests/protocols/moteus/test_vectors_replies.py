"""Bytes of a device, and the events of the driver: measurements, modes, faults, by length and register."""

from __future__ import annotations

import math
from math import tau

import pytest

from protocols import messages as msg
from protocols.messages import MILLISECOND, Mode
from protocols.moteus.reply import decode
from tests.protocols.moteus.helpers import frame
from tests.protocols.moteus.test_vectors import AT, VECTORS, Talk
from tests.protocols.moteus.test_vectors_requests import reported, talk, waits


def plain(it: Talk, data: str) -> msg.Feedback:
    """The one measurement in an answer."""
    (event,) = it.handle(frame(data))
    assert isinstance(event, msg.Feedback)
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
def test_measurements_in_replies(data: str, fields: dict[str, float]) -> None:
    it = talk()
    event = plain(it, data)
    names = ("position", "velocity", "torque", "current", "voltage", "temperature")
    for name in names:
        value, expected = getattr(event, name), fields.get(name)
        assert value == (None if expected is None else pytest.approx(expected, rel=1e-7, abs=0.0))
    assert (event.motor, event.t) == ("left", it.now)


@pytest.mark.parametrize("data", ["2d04" + "00002041", "2d01" + "0000c07f", "210c01", "", "50", "41010161"])
def test_replies_without_a_measurement(data: str) -> None:
    it = talk()
    before = it.driver.counters.accepted
    assert it.handle(frame(data)) == []
    assert it.driver.counters.accepted == before + 1


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
def test_malformed_replies(data: str) -> None:
    it = talk()
    before = (it.driver.counters.malformed, it.driver.counters.accepted)
    assert it.handle(frame(data)) == []
    assert (it.driver.counters.malformed, it.driver.counters.accepted) == (before[0] + 1, before[1])


@pytest.mark.parametrize("size", range(65))
def test_lengths_of_replies(size: int) -> None:
    sizes = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
    assert (decode(b"\x50" * size) is not None) == (size in sizes)


FAST = "21000a" + "2f01" + "0000803e" + "0000c0bf" + "0000003e" + "210f00"
FULL = (
    "21000a" + "2c0401" + "0000803e" + "0000c0bf" + "0000003e" + "00002041"
    "24060a" + "2701" + "0100" + "0200" + "f500" + "9d01" + "0300" + "50" * 11
)
SHAPES: list[tuple[str, int, str, dict[int, float | None] | None]] = [
    # a reply, an offset, the bytes that replace those at it, the registers that change; None: malformed
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
def test_replies_of_the_usual_layouts(
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


def test_replies_of_another_layout() -> None:
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
    own = decode(bytes.fromhex("41010568656c6c6f" + "41010121" + "50505050"))
    assert own is not None
    assert (own.console, dict(own.values), own.errors) == (b"hello!", {}, ())
    errors = decode(bytes.fromhex("300f02" + "31d00201" + "50"))
    assert errors is not None
    assert [(e.code, e.register, e.number) for e in errors.errors] == [(0x30, 15, 2), (0x31, 0x150, 1)]


# -- modes and faults --------------------------------------------------------------------------------

NAMES = (
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
)


@pytest.mark.parametrize("number", range(17))
def test_the_state_of_each_mode(number: int) -> None:
    it = Talk()
    data = AT.replace("21000a", f"2100{number:02x}", 1)
    events = [event for event in it.handle(data) if isinstance(event, msg.State)]
    ready = number in (0, 2, 3, 4)
    mode = Mode.FAULT if number in (1, 11) else Mode.READY if ready else Mode.ARMED
    assert events == [msg.State("left", it.now, mode, NAMES[number].replace("_", " "))]
    assert [event for event in it.handle(data) if not isinstance(event, msg.Feedback)] == []
    if number in (1, 11):
        stopped = f"{NAMES[0]}, not cleared yet"
        assert reported(it, "reply_stopped") == [msg.State("left", it.now, Mode.FAULT, stopped)]
        assert [f for f in it.send(msg.Hold("left")) if f.data[:1] == b"\x01"] == []


def test_an_unknown_fault_is_reported_by_its_number() -> None:
    fault = talk().handle(frame("210001210f7e"))[0]
    assert isinstance(fault, msg.Fault)
    assert (fault.code, fault.name) == (126, "fault 126")
    assert fault.cause == "a code that this driver does not know: newer firmware?"
    assert fault.remedy == "look it up in the vendor's register reference, then clear"


def test_a_fault_without_its_code_is_reported_when_the_code_comes() -> None:
    it = talk()
    assert it.handle(frame("210001")) == [msg.State("left", it.now, Mode.FAULT, "fault")]
    assert [f for _ in range(9) for f in it.send(msg.Hold("left")) if f.data[:1] == b"\x01"] == []
    (fault,) = it.handle(frame("210001210f26"))
    assert isinstance(fault, msg.Fault)
    assert fault.code == 38
    assert it.handle(frame("210001")) == []
    (other,) = it.handle(frame("210001210f21"))
    assert isinstance(other, msg.Fault)
    assert other.code == 33
    timeout, state = talk().handle(frame("21000b"))
    assert isinstance(timeout, msg.Fault)
    assert isinstance(state, msg.State)
    assert (timeout.code, state.mode, state.detail) == (11, Mode.FAULT, "timeout")


def test_a_fault_ends_what_was_going_on() -> None:
    it = Talk().running()
    it.send(msg.Velocity("left", 1.0))
    it.handle(VECTORS["reply_fast_fault"])
    for _ in range(9):
        assert [f for f in it.send(msg.Velocity("left", 1.0)) if f.data[:1] == b"\x01"] == []
        it.handle(VECTORS["reply_fast_fault"])
    it.send(msg.ClearFault("left"))
    ended = reported(it, "reply_stopped")
    assert ended[-1] == msg.Done(it.now, "ClearFault", "left")
    first = it.send(msg.Velocity("left", 1.0))[0]
    assert first.data.hex().startswith("01000a0f200000803e0000000000000000")  # where the shaft is, at rest


def test_clear_is_refused_with_the_fault_that_stays() -> None:
    it = talk()
    reported(it, "reply_fast_fault")
    it.send(msg.ClearFault("left"))
    assert waits(it, 595, "reply_fast_fault") == []
    (refused,) = it.step()[0]
    assert refused == msg.Refused(it.now, "ClearFault", "left", "still in fault: over temperature")
    again = reported(it, "reply_fast_fault")
    assert [type(event) for event in again] == [msg.Fault, msg.State]
    it.send(msg.ClearFault("left"))
    start = it.now
    mute = [e for _ in range(125) for e in it.step()[0] if isinstance(e, msg.Refused)]
    assert mute == [msg.Refused(start + 600 * MILLISECOND, "ClearFault", "left", "no reply of the device")]


# -- zero --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "near"),
    [("0ad7233b", True), ("0ad723bb", True), ("0ad7233c", True), ("cdcccc3d", False), ("cdccccbd", False),
     ("0000c07f", False)],
)  # fmt: skip
def test_a_zero_is_near_enough(place: str, near: bool) -> None:
    it = talk()
    it.send(msg.Zero("left"))
    assert it.handle(frame("2d01" + "00000000")) != []  # from before: a measurement, and no more
    it.handle(frame("31b10201"))
    events = it.handle(frame("2d01" + place))
    assert [type(e) for e in events if not isinstance(e, msg.Feedback)] == ([msg.Done] if near else [])


# -- the bus -----------------------------------------------------------------------------------------


def test_release_is_refused() -> None:
    events, _ = Talk().running().step(msg.Release())
    assert [type(event) for event in events] == [msg.Refused]
