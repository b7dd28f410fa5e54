"""The driver against twins of firmware 0.5.x: arming, faults by parts, requests, boards, watchdog."""

from __future__ import annotations

import copy
import math
from enum import IntFlag

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Event, Mode, Request
from protocols.odrive_can import plugin
from protocols.odrive_can.codec import encode, radians
from protocols.odrive_can.dialect import LINE05, READABLE05
from protocols.odrive_can.faults import DUPLICATE_NODE, Error
from protocols.odrive_can.faults05 import (
    AXIS_BASE,
    CONTROLLER_BASE,
    ENCODER_BASE,
    MOTOR_BASE,
    SENSORLESS_BASE,
    AxisError,
    ControllerError,
    EncoderError,
    MotorError,
    SensorlessError,
)
from protocols.odrive_can.messages import (
    AxisState,
    ClearErrors05,
    ControlMode,
    GetControllerError,
    GetEncoderError,
    GetMotorError,
    GetSensorlessError,
    Heartbeat05,
    Message,
    Reboot05,
    SetAxisState,
    SetControllerMode,
    SetInputPos,
    SetInputVel,
    SetLinearCount,
)
from protocols.odrive_can.options import Options, Settings
from protocols.odrive_can.requests import SAVE
from protocols.plugin import Device
from tests.protocols.helpers import modes, of
from tests.protocols.odrive_can.helpers import Bench, device

CLOSED = SetAxisState(AxisState.CLOSED_LOOP_CONTROL)


def axis(
    name: str = "left", address: int = 1, settings: Settings | None = None, extended: bool = False
) -> Device:
    return device(name, address, settings, Options(firmware="0.5", is_extended=extended))


def ready(*devices: Device) -> Bench:
    bench = Bench(devices or (axis(),))
    bench.run(500)
    assert all(node.identity.line == "0.5" for node in bench.driver.axes.values())
    return bench


def ends(events: list[Event]) -> list[msg.Done | msg.Refused]:
    return [event for event in events if isinstance(event, msg.Done | msg.Refused)]


# -- arming and steering ------------------------------------------------------------------------------


def test_arming_steering_and_letting_go() -> None:
    bench = ready()
    start = bench.now
    bench.run(5, msg.Velocity("left", 50.0))
    first = bench.said(since=start, line="0.5")[:3]
    assert first == [SetControllerMode(ControlMode.VELOCITY, 1), SetInputVel(0.0, 0.0), CLOSED]
    bench.run(500, msg.Velocity("left", 50.0))
    assert bench.shaft.velocity == pytest.approx(50.0, abs=1.0)
    bench.run(1500, msg.Position("left", 30.0))
    assert bench.shaft.position == pytest.approx(30.0, abs=0.05)
    bench.shaft.held = True
    bench.run(300, msg.Torque("left", 0.2))
    assert bench.twin05.servo.torque() == pytest.approx(0.2, abs=1e-3)
    bench.run(300, msg.Idle("left"))
    assert not bench.twin05.axis.armed
    assert modes(bench.events)[-2:] == ["armed", "ready"]
    assert ClearErrors05() not in bench.said(line="0.5")


def test_hold_is_where_the_shaft_is() -> None:
    bench = ready()
    bench.shaft.position = radians(7.125)
    bench.run(50)
    bench.run(300, msg.Hold("left"))
    targets = {m.position for m in bench.said(line="0.5") if isinstance(m, SetInputPos)}
    assert [round(target, 3) for target in targets] == [7.125]


def test_an_extended_axis_is_driven_with_extended_identifiers_beside_a_standard_one_of_that_address() -> None:
    bench = ready(axis("far", 0xFEDCBA, extended=True), axis("left", 1), axis("double", 1, extended=True))
    bench.run(600, msg.Velocity("far", 5.0), msg.Velocity("left", 6.0), msg.Velocity("double", -7.0))
    assert [shaft.velocity for shaft in bench.shafts] == pytest.approx([5.0, 6.0, -7.0], abs=0.5)
    assert bench.driver.counters.malformed == bench.driver.counters.ignored == 0
    assert of(msg.Fault, bench.events) == []
    spec = plugin.spec(bench.devices[0])
    far = {frame.id for _, frame in bench.sent if frame.extended and frame.id >> 5 == 0xFEDCBA}
    assert far
    assert far <= spec.sends
    assert not spec.read_only(CanFrame(0xFEDCBA << 5 | 0x09, remote=True))
    assert spec.read_only(CanFrame(0xFEDCBA << 5 | 0x09, remote=True, extended=True))


def test_an_uncalibrated_axis_says_why_it_does_not_arm_and_is_not_asked_again() -> None:
    bench = ready(axis(settings=Settings(calibrated=False)))
    events = bench.run(2000, msg.Velocity("left", 5.0))
    assert [fault.name for fault in of(msg.Fault, events)] == ["INVALID_STATE"]
    assert "calibrat" in of(msg.Fault, events)[0].cause
    assert len([m for m in bench.said(line="0.5") if m == CLOSED]) == 1
    assert modes(events)[-1] == "fault"


# -- faults -------------------------------------------------------------------------------------------

WORDS: list[tuple[type[IntFlag], int, type | None, int]] = [
    (AxisError, AXIS_BASE, None, 0),
    (MotorError, MOTOR_BASE, GetMotorError, AxisError.MOTOR_FAILED),
    (EncoderError, ENCODER_BASE, GetEncoderError, AxisError.ENCODER_FAILED),
    (ControllerError, CONTROLLER_BASE, GetControllerError, AxisError.CONTROLLER_FAILED),
    (SensorlessError, SENSORLESS_BASE, GetSensorlessError, AxisError.SENSORLESS_ESTIMATOR_FAILED),
]


@pytest.mark.parametrize(
    ("bit", "base", "message", "axis_bit"),
    [(bit, base, kind, of_axis) for flags, base, kind, of_axis in WORDS for bit in flags],
    ids=lambda value: f"{type(value).__name__}.{value.name}" if isinstance(value, IntFlag) else "",
)
def test_every_bit_of_every_word_is_told_once_with_cause_and_cure(
    bit: IntFlag, base: int, message: type | None, axis_bit: int
) -> None:
    bench = ready()
    bench.from_device = lambda frame: False
    motor, encoder, controller = (int(base == of) for of in (MOTOR_BASE, ENCODER_BASE, CONTROLLER_BASE))
    beat = encode(1, Heartbeat05(axis_bit if message else int(bit), 1, motor, encoder, controller, 0))
    events: list[Event] = []
    for turn in range(3):
        events += bench.driver.receive(bench.now + turn, beat)
        if message:
            events += bench.driver.receive(bench.now + turn, encode(1, message(int(bit))))
    faults = of(msg.Fault, events)
    reported = {fault.code: fault for fault in faults}
    assert len(reported) == len(faults) == (2 if message else 1)
    fault = reported[base + int(bit)]
    assert str(bit.name) in fault.name
    assert fault.cause
    assert fault.remedy
    assert modes(events)[-1] == "fault"


def test_the_texts_are_those_of_the_vendor_s_dbc_all_of_them() -> None:
    from odrive_can.utils import get_dbc

    dbc = get_dbc("odrive-cansimple-0.5.6")
    signals = {
        "Axis_Error": ("Heartbeat", AxisError),
        "Motor_Error": ("Get_Motor_Error", MotorError),
        "Encoder_Error": ("Get_Encoder_Error", EncoderError),
        "Controller_Error": ("Get_Controller_Error", ControllerError),
        "Sensorless_Error": ("Get_Sensorless_Error", SensorlessError),
    }
    texts = [LINE05.axis_faults, *(table for _, table in LINE05.component_faults.values())]
    flags = [AxisError, MotorError, EncoderError, ControllerError, SensorlessError]
    for name, (message, kind) in signals.items():
        signal = dbc.get_message_by_name(f"Axis3_{message}").get_signal_by_name(name)
        theirs = {int(value): str(choice) for value, choice in signal.choices.items() if value}
        assert theirs == {int(bit): bit.name for bit in kind}, name
        table = texts[flags.index(kind)]
        assert {bit: text.name.split()[-1] for bit, text in table.items()} == theirs, name


def test_the_part_s_error_is_asked_for_once_and_told_and_nothing_is_armed_or_cleared() -> None:
    bench = ready()
    bench.run(300, msg.Velocity("left", 10.0))
    bench.twin05.trip(Error.CURRENT_LIMIT_VIOLATION)
    start = bench.now
    events = bench.run(1000, msg.Velocity("left", 10.0))
    assert [fault.name for fault in of(msg.Fault, events)] == [
        "MOTOR_FAILED",
        "motor CURRENT_LIMIT_VIOLATION",
    ]
    asked = [frame for t, frame in bench.sent if t >= start and frame.id == 0x23]
    assert len(asked) == 1
    back = next(state.t for state in of(msg.State, events) if state.mode is Mode.FAULT)
    assert bench.said(since=back + 5 * MILLISECOND, line="0.5") == []
    assert bench.twin05.motor_errors


def test_a_fault_is_cleared_by_an_operator_only_and_then_told_anew_if_it_comes_again() -> None:
    bench = ready()
    bench.run(300, msg.Velocity("left", 10.0))
    bench.twin05.trip(Error.SPINOUT_DETECTED)
    for words in (msg.Velocity("left", 5.0), msg.Hold("left"), msg.Idle("left"), msg.Torque("left", 0.0)):
        bench.run(300, words)
    assert ControllerError.SPINOUT_DETECTED in bench.twin05.controller_errors
    (end,) = ends(bench.ask(msg.ClearFault("left"), 300))
    assert isinstance(end, msg.Done)
    assert "board" in end.detail
    assert int(bench.twin05.controller_errors) == 0
    bench.run(600, msg.Velocity("left", 5.0))
    assert bench.twin05.axis.armed
    bench.twin05.trip(Error.SPINOUT_DETECTED)
    names = [fault.name for fault in of(msg.Fault, bench.run(300))]
    assert names == ["CONTROLLER_FAILED", "controller SPINOUT_DETECTED"]


def test_what_does_not_go_away_is_told_again_with_all_its_words() -> None:
    bench = Bench([axis(settings=Settings(bus_voltage=9.0))])
    bench.run(600)
    names = ["MOTOR_FAILED", "motor SYSTEM_LEVEL"]
    assert [fault.name for fault in of(msg.Fault, bench.events)] == names
    events = bench.ask(msg.ClearFault("left"), 1200)
    (end,) = ends(events)
    assert isinstance(end, msg.Refused)
    assert "MOTOR_FAILED" in end.reason
    assert sorted({fault.name for fault in of(msg.Fault, events)}) == sorted(names)


def test_a_part_that_does_not_tell_its_error_holds_nothing_up_for_ever() -> None:
    bench = ready()
    bench.from_device = lambda frame: frame.id & 0x1F != 0x03
    bench.twin05.trip(Error.CURRENT_LIMIT_VIOLATION)
    bench.run(1500)
    assert len([1 for _, frame in bench.sent if frame.id == 0x23]) == 5
    bench.ask(msg.ClearFault("left"), 300)
    bench.run(400, msg.Velocity("left", 5.0))
    assert bench.twin05.axis.armed


def test_one_node_id_for_two_axes_is_noticed_by_heartbeats_that_contradict_each_other() -> None:
    bench = ready()
    faults: list[msg.Fault] = []
    for index in range(6):
        beat = encode(1, Heartbeat05(0, 8 if index % 2 else 1, 0, 0, 0, 1))
        faults += of(msg.Fault, bench.driver.receive(bench.now + index * 50 * MILLISECOND, beat))
    assert [fault.code for fault in faults] == [DUPLICATE_NODE]


# -- requests -----------------------------------------------------------------------------------------

ALL: tuple[Request, ...] = (
    msg.ClearFault("left"),
    msg.Estop("left"),
    msg.Scan("can0"),
    msg.Zero("left"),
    msg.ReadParameter("left", "Bus_Voltage"),
    msg.WriteParameter("left", "Pos_Gain", 10.0),
    msg.Reboot("left"),
)


@pytest.mark.parametrize("request_", ALL, ids=lambda r: type(r).__name__)
def test_every_request_is_carried_out(request_: Request) -> None:
    bench = ready()
    (end,) = ends(bench.ask(request_, 3000))
    assert isinstance(end, msg.Done), end
    assert end.request == type(request_).__name__


@pytest.mark.parametrize("request_", ALL, ids=lambda r: type(r).__name__)
def test_every_request_ends_although_the_device_is_silent(request_: Request) -> None:
    bench = ready()
    bench.from_device = lambda frame: False
    (end,) = ends(bench.ask(request_, 9000))
    assert isinstance(end, msg.Done if isinstance(request_, msg.Scan) else msg.Refused)


def test_requests_are_the_spec_s() -> None:
    assert plugin.spec(axis()).requests == {type(request_) for request_ in ALL}
    assert plugin.spec(device()).requests == {type(request_) for request_ in ALL} | {msg.SetId}


def test_what_this_line_cannot_do_over_can_is_refused_with_the_reason() -> None:
    bench = ready()
    cases: list[tuple[Request, str]] = [
        (msg.SetId("can0", 77, 9), "serial numbers"),
        (msg.WriteParameter("left", SAVE, 1.0), "firmware 0.5.x cannot"),
        (msg.ReadParameter("left", "FET_Temperature"), "Motor_Error"),
    ]
    for request_, reason in cases:
        (end,) = ends(bench.ask(request_))
        assert isinstance(end, msg.Refused)
        assert reason in end.reason
    assert bench.said(line="0.5") == []


def test_zero_is_said_in_counts_and_not_while_armed() -> None:
    bench = ready()
    bench.shaft.position = radians(3.5)
    bench.run(50)
    assert isinstance(ends(bench.ask(msg.Zero("left"), 100))[0], msg.Done)
    assert SetLinearCount(0) in bench.said(line="0.5")
    assert bench.driver.axes[1].position == pytest.approx(0.0, abs=1e-4)
    bench.run(400, msg.Velocity("left", 5.0))
    assert isinstance(ends(bench.ask(msg.Zero("left")))[0], msg.Refused)


@pytest.mark.parametrize("parameter", list(READABLE05))
def test_every_readable_parameter_is_read_or_waited_for(parameter: str) -> None:
    bench = ready()
    bench.shaft.position = radians(-0.5)
    bench.run(50)
    events = bench.ask(msg.ReadParameter("left", parameter), 250)
    (reported,) = of(msg.Parameter, events)
    assert isinstance(ends(events)[-1], msg.Done)
    assert math.isfinite(reported.value)
    expected = {"Bus_Voltage": 24.0, "Axis_State": 1, "Shadow_Count": -8192, "Count_in_CPR": 8192}
    if parameter in expected:
        assert reported.value == pytest.approx(expected[parameter], rel=1e-3)


def test_a_scan_of_a_bus_of_this_line_sends_nothing_and_names_what_it_hears() -> None:
    bench = ready(axis("left", 1), axis("far", 300, extended=True))
    start = bench.now
    bench.ask(msg.Scan("can0"))
    for turn in range(3):
        stranger = CanFrame(12 << 5 | 1, bytes.fromhex("0000000001000080"))
        bench.driver.receive(bench.now + turn, stranger)
    found = {f.address: f.detail for f in of(msg.Found, bench.run(2500))}
    assert set(found) == {1, 12, 300}
    assert found[1] == "left, firmware 0.5.x"
    assert "0.5.x?" in found[12]
    asked = {frame.id & 0x1F for t, frame in bench.sent if t >= start}
    assert asked <= {0x00, 0x14, 0x17}


# -- boards and the watchdog --------------------------------------------------------------------------


def board() -> Bench:
    return ready(axis("left", 1, Settings(other_axis=2)), axis("right", 2, Settings(other_axis=1)))


def test_clearing_one_axis_clears_the_board_and_says_so() -> None:
    bench = board()
    for twin in bench.twins:
        twin.trip(Error.ESTOP_REQUESTED)
    bench.run(200)
    (end,) = ends(bench.ask(msg.ClearFault("left"), 300))
    assert isinstance(end, msg.Done)
    assert "every axis of its board" in end.detail
    assert {state.motor: state.mode for state in of(msg.State, bench.events)} == {
        "left": Mode.READY,
        "right": Mode.READY,
    }


def test_a_restart_is_refused_while_any_axis_that_may_be_on_the_board_is_armed() -> None:
    bench = board()
    bench.run(400, msg.Velocity("right", 5.0))
    (end,) = ends(bench.ask(msg.Reboot("left")))
    assert isinstance(end, msg.Refused)
    assert "right" in end.reason
    assert not [m for m in said_all(bench) if isinstance(m, Reboot05)]
    bench.run(400, msg.Idle("right"))
    (end,) = ends(bench.ask(msg.Reboot("left"), 3000))
    assert isinstance(end, msg.Done)
    assert [state.mode for state in of(msg.State, bench.events)].count(Mode.OFFLINE) == 2


def test_an_axis_that_is_armed_itself_is_told_so() -> None:
    bench = board()
    bench.run(500, msg.Hold("left"), msg.Idle("right"))
    (end,) = ends(bench.ask(msg.Reboot("left"), 300))
    assert isinstance(end, msg.Refused)
    assert end.reason == "it is armed and would drop its load: command idle first"


def test_a_restart_is_refused_while_somebody_else_runs_the_other_axis() -> None:
    bench = board()
    other = bench.twins[1]
    for message in (SetControllerMode(ControlMode.VELOCITY, 1), CLOSED):
        other.receive(bench.now, encode(2, message))
    bench.run(300)
    assert not bench.driver.axes[2].owned
    (end,) = ends(bench.ask(msg.Reboot("left"), 300))
    assert isinstance(end, msg.Refused)
    assert "right, which is armed" in end.reason
    assert modes(bench.events, "right")[-1] == "armed"
    other.receive(bench.now, encode(2, SetAxisState(AxisState.IDLE)))
    bench.run(300)
    (end,) = ends(bench.ask(msg.Reboot("left"), 3000))
    assert isinstance(end, msg.Done)


def said_all(bench: Bench) -> list[Message]:
    return bench.said(1, line="0.5") + bench.said(2, line="0.5")


def test_the_questions_of_an_idle_host_keep_the_watchdog_fed() -> None:
    watched = Settings(enable_watchdog=True, watchdog_timeout=0.25)
    bench = ready(axis(settings=watched))
    bench.run(3000)
    assert bench.twin05.errors == 0
    assert all(frame.remote for _, frame in bench.sent)


def test_a_dead_host_trips_the_watchdog_and_it_is_told_afterwards() -> None:
    watched = Settings(enable_watchdog=True, watchdog_timeout=0.25)
    bench = ready(axis(settings=watched))
    bench.run(400, msg.Velocity("left", 20.0))
    bench.to_device = lambda frame: False
    events = bench.run(600)
    assert bench.twin05.errors == AxisError.WATCHDOG_TIMER_EXPIRED
    assert [fault.name for fault in of(msg.Fault, events)] == ["WATCHDOG_TIMER_EXPIRED"]
    assert not bench.twin05.axis.armed


def test_what_is_measured_comes_up() -> None:
    bench = ready()
    bench.shaft.held = True
    bench.run(300, msg.Torque("left", 0.1))
    events = of(msg.Feedback, bench.run(1000, msg.Torque("left", 0.1)))
    assert [e.current for e in events if e.current is not None][-1] == pytest.approx(
        0.1 * 270 / 8.27, rel=0.02
    )
    assert [e.voltage for e in events if e.voltage is not None][-1] == pytest.approx(24.0, rel=0.02)
    assert all(e.temperature is None and e.torque is None for e in events)
    assert 4 <= len([e for e in events if e.current is not None]) <= 6


def test_a_copied_driver_goes_on_as_the_original_does() -> None:
    bench = ready()
    bench.run(123, msg.Velocity("left", 12.0))
    twin = copy.deepcopy(bench)
    assert bench.run(700, msg.Velocity("left", 8.0)) == twin.run(700, msg.Velocity("left", 8.0))
    assert bench.sent == twin.sent
    assert bench.received == twin.received
