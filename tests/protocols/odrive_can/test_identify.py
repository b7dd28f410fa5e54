"""Telling firmware lines apart: by asking, never by silence alone, never misread; nothing moves before."""

from __future__ import annotations

import itertools
from typing import Literal

import pytest

from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, ClearFault, Done, Fault, Feedback, Mode, State, Velocity
from protocols.odrive_can import plugin
from protocols.odrive_can.codec import decode_from_device, encode
from protocols.odrive_can.faults import WRONG_FIRMWARE, Error
from protocols.odrive_can.faults05 import AxisError
from protocols.odrive_can.identify import line_by_form
from protocols.odrive_can.messages import Address, GetVersion, Heartbeat, Heartbeat05, UnidentifiedHeartbeat
from protocols.odrive_can.options import Options, Settings
from protocols.plugin import Device
from tests.protocols.helpers import modes, of
from tests.protocols.odrive_can.helpers import Bench, device

Expected = Literal["auto", "0.5", "0.6"]
NEWEST = {"0.5": "0.5.6", "0.6": "0.6.10"}


def made(line: str, expected: Expected = "auto", name: str = "left", address: int = 1) -> Device:
    """A device of a line, and what the robot file says of it."""
    return device(name, address, Settings(firmware=NEWEST[line]), Options(firmware=expected))


@pytest.mark.parametrize("line", ["0.5", "0.6"])
def test_auto_speaks_what_it_finds_and_moves_nothing_before(line: str) -> None:
    bench = Bench([made(line)])
    while not bench.driver.axes[1].identity.line:
        bench.run(1, Velocity("left", 5.0))
        assert all(frame.remote for _, frame in bench.sent)
        assert bench.now < 1500 * MILLISECOND
    assert bench.driver.axes[1].identity.line == line
    bench.run(600, Velocity("left", 5.0))
    assert bench.twins[0].axis.armed
    assert bench.shaft.velocity == pytest.approx(5.0, abs=0.5)
    assert of(Fault, bench.events) == []


@pytest.mark.parametrize("line", ["0.5", "0.6"])
def test_a_line_that_is_named_and_right_is_spoken(line: Expected) -> None:
    bench = Bench([made(line, line)])
    bench.run(900, Velocity("left", 5.0))
    assert bench.twins[0].axis.armed
    assert of(Fault, bench.events) == []


@pytest.mark.parametrize(
    ("line", "expected", "name", "says"),
    [
        ("0.5", "0.6", "firmware 0.5.x", 'firmware = "0.5"'),
        ("0.6", "0.5", "firmware 0.6.10", 'firmware = "0.6"'),
    ],
)
def test_a_line_that_is_named_and_wrong_is_a_fault_and_nothing_but_questions_goes_out(
    line: str, expected: Expected, name: str, says: str
) -> None:
    bench = Bench([made(line, expected)])
    bench.run(3000, Velocity("left", 5.0))
    (fault,) = of(Fault, bench.events)
    assert (fault.code, fault.name) == (WRONG_FIRMWARE, name)
    assert fault.cause
    assert says in fault.remedy
    assert of(State, bench.events)[-1].mode is Mode.FAULT
    assert all(frame.remote for _, frame in bench.sent)
    assert {frame.id for _, frame in bench.sent} <= plugin.spec(bench.devices[0]).sends
    assert all(plugin.spec(bench.devices[0]).read_only(frame) for _, frame in bench.sent)
    assert bench.driver.axes[1].identity.line == line


def test_a_fault_of_the_wrong_line_is_found_anew_after_it_was_cleared() -> None:
    bench = Bench([made("0.5", "0.6")])
    bench.run(1500, Velocity("left", 5.0))
    events = bench.ask(ClearFault("left"), 1500)
    assert [fault.code for fault in of(Fault, events)] == [WRONG_FIRMWARE]
    assert not bench.twins[0].axis.armed


@pytest.mark.parametrize("expected", ["auto", "0.5", "0.6"])
@pytest.mark.parametrize("line", ["0.5", "0.6"])
def test_where_our_frames_do_not_arrive_nothing_is_concluded_but_a_fault(
    line: str, expected: Expected
) -> None:
    bench = Bench([made(line, expected)])
    bench.to_device = lambda frame: False
    bench.run(4000, Velocity("left", 5.0))
    assert bench.driver.axes[1].identity.line == ""
    (fault,) = of(Fault, bench.events)
    assert (fault.code, fault.name) == (WRONG_FIRMWARE, "firmware unknown")
    assert "frames" in fault.cause
    assert bench.said() == []


def test_one_lost_answer_does_not_make_another_line() -> None:
    """A device of 0.6 whose answers get lost now and then is still one of 0.6."""
    bench = Bench([made("0.6")])
    lost = iter([True, True, True, False])
    bench.from_device = lambda frame: not (frame.id & 0x1F == 0 and next(lost, False))
    bench.run(1000)
    assert bench.driver.axes[1].identity.line == "0.6"
    assert of(Fault, bench.events) == []


def test_who_answers_the_roll_call_is_no_0_5() -> None:
    bench = Bench([made("0.6")])
    bench.from_device = lambda frame: frame.id & 0x1F != 0
    bench.run(3000, Velocity("left", 5.0))
    assert bench.driver.axes[1].identity.line == ""
    assert [fault.name for fault in of(Fault, bench.events)] == ["firmware unknown"]
    assert bench.said() == []


def test_a_0_5_that_suddenly_answers_get_version_is_a_fault() -> None:
    bench = Bench([made("0.5")])
    bench.run(900, Velocity("left", 5.0))
    assert bench.twins[0].axis.armed
    version = encode(1, GetVersion(2, 5, 1, 0, 0, 6, 10, 0))
    events = list(bench.driver.receive(bench.now, version))
    (fault,) = of(Fault, events)
    assert (fault.code, fault.name) == (WRONG_FIRMWARE, "firmware 0.6.10")
    assert "two" in fault.cause
    assert modes(events) == ["fault"]


def test_a_device_that_came_back_is_asked_again() -> None:
    """It may have been replaced by one of the other line while it was silent."""
    bench = Bench([made("0.6")])
    bench.run(900, Velocity("left", 5.0))
    bench.from_device = lambda frame: False
    bench.run(400, Velocity("left", 0.0))
    bench.twins[0] = Bench([made("0.5")]).twins[0]
    bench.from_device = lambda frame: True
    start = bench.now
    while not bench.driver.axes[1].identity.line:
        bench.run(1, Velocity("left", 5.0))
    assert bench.driver.axes[1].identity.line == "0.5"
    assert bench.said(since=start) == []


def test_both_lines_share_a_bus() -> None:
    bench = Bench([made("0.6"), made("0.5", name="right", address=2), made("0.5", name="third", address=3)])
    words = [Velocity("left", 4.0), Velocity("right", 5.0), Velocity("third", 6.0)]
    bench.run(1500, *words)
    lines = {node.name: node.identity.line for node in bench.driver.axes.values()}
    assert lines == {"left": "0.6", "right": "0.5", "third": "0.5"}
    assert [shaft.velocity for shaft in bench.shafts] == pytest.approx([4.0, 5.0, 6.0], abs=0.5)
    assert of(Fault, bench.events) == []
    assert bench.driver.counters.malformed == 0
    assert {event.motor for event in of(Feedback, bench.events) if event.temperature is not None} == {"left"}
    reported = [event.motor for event in of(Feedback, bench.events) if event.current is not None]
    assert set(reported) == {"left", "right", "third"}


def test_only_questions_that_no_line_obeys_go_out_before_it_is_known() -> None:
    """0.5 obeys remote frames: one of 0x06 would change its node id, one of 0x16 restart it."""
    for line, expected in itertools.product(("0.5", "0.6"), ("auto", "0.5", "0.6")):
        bench = Bench([made(line, expected)])  # type: ignore[arg-type]  # product widens the Literal
        bench.run(1500)
        spec = plugin.spec(bench.devices[0])
        frames = {frame for _, frame in bench.sent if frame.id != 0x7E6}
        assert frames
        assert all(spec.read_only(frame) for frame in frames), (line, expected)
        assert not {frame.id & 0x1F for frame in frames} & {0x02, 0x06, 0x07, 0x16, 0x18, 0x1B}
        assert bench.twins[0].axis.node == 1


def test_a_bus_of_0_5_alone_is_never_asked_on_the_broadcast_node() -> None:
    bench = Bench([made("0.5", "0.5")])
    bench.run(6000)
    assert 0x7E6 not in {frame.id for _, frame in bench.sent}


# -- who only listens ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "line"),
    [
        (encode(1, Heartbeat(0, 8, 1, 0)), "0.6"),  # closed loop and busy
        (encode(1, Heartbeat(0, 1, 0, 1)), "0.6"),  # trajectory done
        (encode(1, Heartbeat(Error.WATCHDOG_TIMER_EXPIRED, 1, 3, 0)), "0.6"),
        (encode(1, Heartbeat(0, 1, 14, 0)), "0.6"),
        (encode(1, Heartbeat05(0, 1, 0, 0, 0, 1)), "0.5"),  # trajectory done
        (encode(1, Heartbeat05(0, 8, 0, 0, 0, 1)), "0.5"),
        (encode(1, Heartbeat05(AxisError.MOTOR_FAILED, 1, 1, 0, 0, 1)), "0.5"),
        (encode(1, Heartbeat05(AxisError.CONTROLLER_FAILED, 1, 0, 0, 1, 0)), "0.5"),
        (encode(1, Heartbeat05(AxisError.OVER_TEMP, 1, 0, 0, 0, 0)), "0.5"),
        (encode(1, Heartbeat(0, 1, 0, 0)), ""),
        (encode(1, Heartbeat05(0, 8, 0, 0, 0, 0)), ""),
        (encode(1, Heartbeat05(AxisError.ENCODER_FAILED, 1, 0, 1, 0, 0)), ""),
        (CanFrame(0x21, bytes.fromhex("0000000101ffffff")), ""),
    ],
    ids=lambda value: str(value),
)
def test_the_shape_of_a_heartbeat(frame: CanFrame, line: str) -> None:
    beacon = decode_from_device(frame, "")
    assert isinstance(beacon, UnidentifiedHeartbeat)
    assert line_by_form(beacon) == line


def test_no_heartbeat_that_a_line_can_send_looks_like_the_other_s() -> None:
    """Every combination of one error bit, state, result and flags; those that a line never sends left out."""
    parts = {"motor": AxisError.MOTOR_FAILED, "encoder": AxisError.ENCODER_FAILED}
    for error, state, result, done in itertools.product((0, *Error), (1, 8), range(16), (0, 1)):
        if state == 8 and (error or result != 1):
            continue
        beacon = decode_from_device(encode(1, Heartbeat(error, state, result, done)), "")
        assert isinstance(beacon, UnidentifiedHeartbeat)
        assert line_by_form(beacon) != "0.5", (error, state, result, done)
    for error, state, motor, encoder, done in itertools.product(
        (0, *AxisError), (1, 8), (0, 1), (0, 1), (0, 1)
    ):
        needed = motor * parts["motor"] | encoder * parts["encoder"]
        if state == 8 and (error or motor or encoder):
            continue
        beat = Heartbeat05(error | needed, state, motor, encoder, 0, done)
        beacon = decode_from_device(encode(1, beat), "")
        assert isinstance(beacon, UnidentifiedHeartbeat)
        assert line_by_form(beacon) != "0.6", beat


@pytest.mark.parametrize("line", ["0.5", "0.6"])
def test_a_listener_reads_states_and_faults_of_a_device_that_another_host_drives(line: str) -> None:
    bench = Bench([made(line)])
    bench.run(1500, Velocity("left", 5.0))
    listener = plugin.driver([made(line)])
    bench.received.clear()
    bench.run(300, Velocity("left", 5.0))
    bench.twins[0].trip(Error.ESTOP_REQUESTED)
    bench.run(300, Velocity("left", 5.0))
    frames = [(t, f) for t, f in bench.received if f.id != 0x20]  # no answer to Get_Version among them
    events = [event for t, frame in frames for event in listener.receive(t, frame)]
    assert modes(events)[0] == "armed"
    assert modes(events)[-1] == "fault"
    assert "ESTOP_REQUESTED" in {fault.name for fault in of(Fault, events)}
    _, outgoing = listener.send(bench.now, [Velocity("left", 5.0)])
    assert all(isinstance(raw, CanFrame) and raw.remote for raw in outgoing)


def test_an_operator_s_clear_waits_until_the_line_is_known() -> None:
    bench = Bench([made("0.5")])
    bench.twins[0].trip(Error.ESTOP_REQUESTED)
    bench.run(150)
    bench.to_device = lambda frame: True
    events = bench.ask(ClearFault("left"), 700)
    assert [done.request for done in of(Done, events)] == ["ClearFault"]
    clears = [frame for _, frame in bench.sent if frame.id & 0x1F == 0x18]
    assert clears
    assert {frame.data for frame in clears} == {b""}


def test_an_address_that_is_given_out_is_no_answer_to_the_roll_call() -> None:
    bench = Bench([made("0.5")])
    bench.driver.receive(0, encode(0x3F, Address(1, 77)))
    bench.run(900)
    assert bench.driver.axes[1].identity.line == "0.5"
