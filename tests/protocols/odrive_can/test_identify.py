"""Identification of the firmware line: by requests, never by silence alone; nothing moves before."""

from __future__ import annotations

import itertools
from typing import Literal

import pytest

from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, ClearFault, Fault, Feedback, Mode, State, Velocity
from protocols.odrive_can import plugin
from protocols.odrive_can.codec import decode_from_device, encode
from protocols.odrive_can.faults import WRONG_FIRMWARE, Error
from protocols.odrive_can.faults05 import AxisError
from protocols.odrive_can.identify import line_by_form
from protocols.odrive_can.messages import Address, Heartbeat, Heartbeat05, Message, UnidentifiedHeartbeat
from protocols.odrive_can.options import Options, Settings
from protocols.plugin import Device
from tests.protocols.helpers import modes, of
from tests.protocols.odrive_can.helpers import Bench, device

Line = Literal["0.5", "0.6"]
Expected = Literal["auto", "0.5", "0.6"]
NEWEST = {"0.5": "0.5.6", "0.6": "0.6.10"}


def make(line: str, expected: Expected = "auto", name: str = "left", address: int = 1) -> Device:
    """A device of a line, and the line that the robot file states."""
    return device(name, address, Settings(firmware=NEWEST[line]), Options(firmware=expected))


def only_reads(bench: Bench) -> bool:
    """True if nothing was sent but remote frames that no line obeys.

    0.5 obeys remote frames: one of 0x06 would change its node id, one of 0x16 restart it."""
    spec = plugin.spec(bench.devices[0])
    cmds = {frame.id & 0x1F for _, frame in bench.sent if frame.id != 0x7E6}
    allowed = all(spec.read_only(frame) and frame.id in spec.sends for _, frame in bench.sent)
    return allowed and bool(cmds) and not cmds & {0x02, 0x06, 0x07, 0x16, 0x18, 0x1B}


@pytest.mark.parametrize(
    ("line", "expected"), [("0.5", "auto"), ("0.5", "0.5"), ("0.6", "auto"), ("0.6", "0.6")]
)
def test_a_device_is_identified_and_then_driven_and_not_moved_before(line: Line, expected: Expected) -> None:
    bench = Bench([make(line, expected)])
    while not bench.driver.axes[1].identity.line:
        assert only_reads(bench) or not bench.sent
        assert bench.now < 1500 * MILLISECOND
        bench.run(1, Velocity("left", 5.0))
    assert bench.driver.axes[1].identity.line == line
    bench.run(600, Velocity("left", 5.0))
    assert bench.twins[0].axis.armed
    assert bench.twins[0].axis.node == 1
    assert bench.shaft.velocity == pytest.approx(5.0, abs=0.5)
    assert of(Fault, bench.events) == []


@pytest.mark.parametrize(
    ("line", "expected", "name", "remedy"),
    [
        ("0.5", "0.6", "firmware 0.5.x", 'firmware = "0.5"'),
        ("0.6", "0.5", "firmware 0.6.10", 'firmware = "0.6"'),
    ],
)
def test_another_line_than_stated_is_a_fault_and_only_requests_are_sent(
    line: Line, expected: Expected, name: str, remedy: str
) -> None:
    bench = Bench([make(line, expected)])
    bench.run(3000, Velocity("left", 5.0))
    (fault,) = of(Fault, bench.events)
    assert (fault.code, fault.name) == (WRONG_FIRMWARE, name)
    assert fault.cause
    assert remedy in fault.remedy
    assert of(State, bench.events)[-1].mode is Mode.FAULT
    assert only_reads(bench)
    assert bench.driver.axes[1].identity.line == line
    events = bench.ask(ClearFault("left"), 1500)
    assert [fault.code for fault in of(Fault, events)] == [WRONG_FIRMWARE]
    assert not bench.twins[0].axis.armed


@pytest.mark.parametrize("expected", ["auto", "0.5", "0.6"])
@pytest.mark.parametrize("line", ["0.5", "0.6"])
def test_where_our_frames_do_not_arrive_there_is_a_fault_and_no_conclusion(
    line: Line, expected: Expected
) -> None:
    bench = Bench([make(line, expected)])
    bench.to_device = lambda frame: False
    bench.run(4000, Velocity("left", 5.0))
    assert bench.driver.axes[1].identity.line == ""
    (fault,) = of(Fault, bench.events)
    assert (fault.code, fault.name) == (WRONG_FIRMWARE, "firmware unknown")
    assert "frames" in fault.cause
    assert bench.sent_to() == []


def test_a_device_of_0_6_whose_replies_are_lost_now_and_then_is_still_of_0_6() -> None:
    bench = Bench([make("0.6")])
    lost = iter([True, True, True, False])
    bench.from_device = lambda frame: not (frame.id & 0x1F == 0 and next(lost, False))
    bench.run(1000)
    assert bench.driver.axes[1].identity.line == "0.6"
    assert of(Fault, bench.events) == []


def test_an_assignment_of_an_address_is_no_reply_to_discovery() -> None:
    bench = Bench([make("0.5")])
    bench.driver.receive(0, encode(0x3F, Address(1, 77)))
    bench.run(900)
    assert bench.driver.axes[1].identity.line == "0.5"


def test_both_lines_share_a_bus() -> None:
    bench = Bench([make("0.6"), make("0.5", name="right", address=2), make("0.5", name="third", address=3)])
    bench.run(1500, Velocity("left", 4.0), Velocity("right", 5.0), Velocity("third", 6.0))
    lines = {axis.name: axis.identity.line for axis in bench.driver.axes.values()}
    assert lines == {"left": "0.6", "right": "0.5", "third": "0.5"}
    assert [shaft.velocity for shaft in bench.shafts] == pytest.approx([4.0, 5.0, 6.0], abs=0.5)
    assert of(Fault, bench.events) == []
    assert bench.driver.counters.malformed == 0
    assert {event.motor for event in of(Feedback, bench.events) if event.temperature is not None} == {"left"}
    reported = [event.motor for event in of(Feedback, bench.events) if event.current is not None]
    assert set(reported) == {"left", "right", "third"}


# -- a host that only listens -------------------------------------------------------------------------


def form(message: Message) -> str:
    """The line that the form of a heartbeat implies."""
    heartbeat = decode_from_device(encode(1, message), "")
    assert isinstance(heartbeat, UnidentifiedHeartbeat)
    return line_by_form(heartbeat)


def test_no_heartbeat_that_a_line_can_send_has_the_form_of_the_other() -> None:
    """Every combination of one error bit, state, result and flags; those that a line never sends left out."""
    for error, state, result, done in itertools.product((0, *Error), (1, 8), range(16), (0, 1)):
        if state == 8 and (error or result != 1):
            continue
        heartbeat = Heartbeat(error, state, result, done)
        assert form(heartbeat) != "0.5", heartbeat
    flags = (0, 1)
    for error, state, motor, encoder, done in itertools.product((0, *AxisError), (1, 8), flags, flags, flags):
        if state == 8 and (error or motor or encoder):
            continue
        failed = motor * AxisError.MOTOR_FAILED | encoder * AxisError.ENCODER_FAILED
        heartbeat05 = Heartbeat05(error | failed, state, motor, encoder, 0, done)
        assert form(heartbeat05) != "0.6", heartbeat05


@pytest.mark.parametrize("line", ["0.5", "0.6"])
def test_a_listener_decodes_states_and_faults_of_a_device_that_another_host_drives(line: Line) -> None:
    bench = Bench([make(line)])
    bench.run(1500, Velocity("left", 5.0))
    listener = plugin.driver([make(line)])
    bench.received.clear()
    bench.run(300, Velocity("left", 5.0))
    bench.twins[0].trip(Error.ESTOP_REQUESTED)
    bench.run(300, Velocity("left", 5.0))
    frames = [(t, f) for t, f in bench.received if f.id != 0x20]  # no reply to Get_Version among them
    events = [event for t, frame in frames for event in listener.receive(t, frame)]
    assert modes(events)[0] == "armed"
    assert modes(events)[-1] == "fault"
    assert "ESTOP_REQUESTED" in {fault.name for fault in of(Fault, events)}
    _, outgoing = listener.send(bench.now, [Velocity("left", 5.0)])
    assert all(isinstance(raw, CanFrame) and raw.remote for raw in outgoing)
