"""The driver against its twin: claiming, arming, steering, letting go, silence, faults, buses, doubles."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable

import pytest

from protocols import messages as msg
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Mode
from protocols.odrive_can.codec import encode, turns
from protocols.odrive_can.faults import DUPLICATE_NODE, NOT_ARMED, PROCEDURE, WRONG_FIRMWARE, Error, Result
from protocols.odrive_can.messages import (
    Address,
    AxisState,
    ClearErrors,
    ControlMode,
    Estop,
    GetEncoderEstimates,
    GetVersion,
    Heartbeat,
    Reboot,
    SetAxisState,
    SetControllerMode,
    SetInputPos,
    SetInputTorque,
    SetInputVel,
)
from protocols.odrive_can.options import Options, Settings
from protocols.odrive_can.twin06 import Twin06
from tests.protocols.helpers import modes, of
from tests.protocols.odrive_can.helpers import Bench, device, ready

CLOSED, IDLE = SetAxisState(AxisState.CLOSED_LOOP_CONTROL), SetAxisState(AxisState.IDLE)


def test_unclaimed_means_remote_frames_only() -> None:
    bench = Bench([device("left", 1), device("right", 2)])
    bench.run(2000, msg.Idle("left"), msg.Idle("right"))
    assert len(bench.sent) > 20
    assert all(frame.remote for _, frame in bench.sent)
    assert {event.mode for event in of(msg.State, bench.events)} == {Mode.READY}


def test_the_first_frame_of_a_device_is_heard() -> None:
    bench = Bench([device()])
    events = bench.driver.receive(0, encode(1, GetEncoderEstimates(0.5, 0.0)))
    assert events == [msg.Feedback("left", 0, position=math.pi, velocity=0.0)]


@pytest.mark.parametrize(
    ("command", "mode", "still"),
    [
        (msg.Velocity("left", 50.0), ControlMode.VELOCITY, SetInputVel(0.0, 0.0)),
        (msg.Torque("left", 0.01), ControlMode.TORQUE, SetInputTorque(0.0)),
        (msg.Position("left", 30.0), ControlMode.POSITION, None),
        (msg.Hold("left"), ControlMode.POSITION, None),
    ],
)
def test_arming_is_mode_then_standstill_then_state(
    command: Command, mode: ControlMode, still: SetInputVel | SetInputTorque | None
) -> None:
    bench = ready()
    bench.shaft.position = 12.3
    bench.run(50)
    start = bench.now
    bench.run(5, command)
    said = bench.said(since=start)[:3]
    assert said[0] == SetControllerMode(mode, 1)
    if still is None:
        assert isinstance(said[1], SetInputPos)
        assert said[1].position == pytest.approx(turns(12.3), abs=1e-4)
        assert (said[1].velocity, said[1].torque) == (0.0, 0.0)
    else:
        assert said[1] == still
    assert said[2] == CLOSED
    assert modes(bench.run(200, command)) == ["armed"]
    assert ClearErrors(0) not in bench.said()


def test_no_setpoint_but_standstill_goes_out_before_closed_loop_is_heard() -> None:
    bench = ready()
    start = bench.now
    bench.from_device = lambda frame: frame.id & 0x1F != 0x01
    bench.run(90, msg.Velocity("left", 50.0))
    assert {type(m) for m in bench.said(since=start)} == {SetControllerMode, SetInputVel, SetAxisState}
    assert {m for m in bench.said(since=start) if isinstance(m, SetInputVel)} == {SetInputVel(0.0, 0.0)}


def test_velocity_is_tracked_with_the_firmware_s_default_gains() -> None:
    bench = ready()
    bench.run(500, msg.Velocity("left", 100.0))
    assert bench.shaft.velocity == pytest.approx(100.0, abs=1.0)
    bench.run(500, msg.Velocity("left", -100.0))
    assert bench.shaft.velocity == pytest.approx(-100.0, abs=1.0)
    bench.run(1000, msg.Velocity("left", 3.0))
    assert bench.shaft.velocity == pytest.approx(3.0, abs=0.1)


def test_position_is_reached_and_torque_is_given() -> None:
    bench = ready()
    bench.run(1500, msg.Position("left", 40.0))
    assert bench.shaft.position == pytest.approx(40.0, abs=0.02)
    bench.shaft.held = True
    bench.run(300, msg.Torque("left", 0.2))
    assert bench.twin.servo.torque() == pytest.approx(0.2, abs=1e-3)


def test_hold_keeps_the_place_where_it_was_first_said() -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 20.0))
    bench.run(1000, msg.Velocity("left", 0.0))
    start = bench.shaft.position
    bench.run(500, msg.Hold("left"))
    bench.shaft.load = 0.1
    bench.run(500, msg.Hold("left"))
    targets = {m.position for m in bench.said() if isinstance(m, SetInputPos)}
    assert len(targets) == 1
    bench.shaft.load = 0.0
    bench.run(3000, msg.Hold("left"))
    assert bench.shaft.position == pytest.approx(start, abs=0.01)


def test_a_mode_change_sends_no_stale_input_and_clears_nothing() -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 40.0))
    start = bench.now
    bench.run(5, msg.Position("left", bench.shaft.position))
    said = bench.said(since=start)
    target = said[0]
    assert isinstance(target, SetInputPos)
    assert said[:3] == [target, SetControllerMode(ControlMode.POSITION, 1), target]
    assert IDLE not in bench.said()
    assert ClearErrors(0) not in bench.said()


def test_setpoints_are_said_again_at_every_send() -> None:
    bench = ready()
    bench.run(300, msg.Velocity("left", 10.0))
    start = bench.now
    bench.run(100, msg.Velocity("left", 10.0))
    assert len([m for m in bench.said(since=start) if isinstance(m, SetInputVel)]) >= 20


def test_idle_goes_to_what_we_armed_at_once_and_until_it_is_confirmed() -> None:
    bench = ready(device("left", 1), device("right", 2))
    bench.run(400, msg.Velocity("left", 10.0), msg.Idle("right"))
    start = bench.now
    lost = 2

    def lossy(frame: CanFrame) -> bool:
        nonlocal lost
        lost -= (frame.id, frame.data) == (0x27, encode(1, IDLE).data)
        return lost < 0

    bench.to_device = lossy
    bench.run(600, msg.Idle("left"), msg.Idle("right"))
    said = [t for t, f in bench.sent if t >= start and f.id == 0x27]
    assert said[0] == start
    assert 3 <= len(said) <= 8
    assert not bench.twin.axis.armed
    assert bench.said(node=2) == []
    after = bench.now
    bench.run(500)
    assert bench.said(since=after) == []


def test_a_device_that_runs_already_is_taken_over_without_dropping_its_load() -> None:
    bench = Bench([device()])
    bench.twin.receive(0, encode(1, SetControllerMode(ControlMode.VELOCITY, 1)))
    bench.twin.receive(0, encode(1, SetInputVel(5.0, 0.0)))
    bench.twin.receive(0, encode(1, CLOSED))
    bench.run(500, msg.Idle("left"))
    assert bench.said() == []
    assert modes(bench.events) == ["armed"]
    assert bench.shaft.velocity > 25.0
    bench.run(300, msg.Velocity("left", 31.4))
    assert bench.twin.axis.armed
    assert {type(m) for m in bench.said()} == {SetInputVel, SetControllerMode}
    bench.run(300, msg.Idle("left"))
    assert not bench.twin.axis.armed


# -- what it refuses to say -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "make",
    [
        lambda x: msg.Velocity("left", x),
        lambda x: msg.Velocity("left", 1.0, x),
        lambda x: msg.Position("left", x),
        lambda x: msg.Position("left", 1.0, x),
        lambda x: msg.Position("left", 1.0, 0.0, x),
        lambda x: msg.Torque("left", x),
    ],
)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e12])
def test_what_is_not_finite_or_out_of_range_puts_no_frame_on_the_wire(
    make: Callable[[float], Command], bad: float
) -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 1.0))
    start = bench.now
    events = bench.run(50, make(bad))
    assert bench.said(since=start) == []
    assert [type(event) for event in events if not isinstance(event, msg.Feedback)] == [msg.Refused]
    bench.run(50, msg.Velocity("left", 1.0))
    assert len(bench.said(since=start)) >= 10


def test_impedance_and_unknown_motors_are_refused() -> None:
    bench = ready()
    events = bench.run(20, msg.Impedance("left", 0.0, 0.0, 0.0, 1.0, 1.0), msg.Velocity("nobody", 1.0))
    assert [(r.request, r.name) for r in of(msg.Refused, events)] == [
        ("Impedance", "left"),
        ("Velocity", "nobody"),
    ]
    assert bench.said() == []


# -- faults ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", list(Error), ids=lambda error: error.name)
def test_every_error_bit_is_told_in_the_vendor_s_words(error: Error) -> None:
    bench = ready()
    events = bench.driver.receive(bench.now, encode(1, Heartbeat(error, 1, 0, 0)))
    if error is Error.INITIALIZING:
        assert of(msg.Fault, events) == []
        assert modes(events) == ["initialising"]
        return
    (fault,) = of(msg.Fault, events)
    assert (fault.code, fault.name) == (error, error.name)
    assert fault.cause
    assert fault.remedy
    assert modes(events) == ["fault"]
    again = bench.driver.receive(bench.now + 1, encode(1, Heartbeat(error, 1, 0, 0)))
    assert of(msg.Fault, again) == []


def test_an_unknown_error_bit_is_told_by_its_number() -> None:
    bench = ready()
    events = bench.driver.receive(bench.now, encode(1, Heartbeat(0x80, 1, 0, 0)))
    assert [fault.name for fault in of(msg.Fault, events)] == ["error bit 0x80"]


def test_a_fault_stays_until_it_is_cleared_and_nothing_clears_it_unasked() -> None:
    bench = ready()
    bench.run(300, msg.Velocity("left", 10.0))
    bench.twin.receive(bench.now, encode(1, Estop()))
    events = bench.run(1000)
    assert [fault.name for fault in of(msg.Fault, events)] == ["ESTOP_REQUESTED"]
    for words in (
        msg.Velocity("left", 5.0),
        msg.Position("left", 0.0),
        msg.Hold("left"),
        msg.Idle("left"),
        msg.Torque("left", 0.0),
    ):
        bench.run(300, words)
    assert ClearErrors(0) not in bench.said()
    assert bench.twin.errors == Error.ESTOP_REQUESTED
    events = bench.ask(msg.ClearFault("left"), 300)
    assert len(of(msg.Done, events)) == 1
    assert not bench.twin.errors
    assert of(msg.Fault, events) == []
    bench.run(400, msg.Velocity("left", 10.0))
    assert bench.twin.axis.armed


def test_a_device_found_in_fault_is_told_nothing() -> None:
    bench = Bench([device()])
    bench.twin.errors = Error.DRV_FAULT
    events = bench.run(1000, msg.Velocity("left", 5.0))
    assert bench.said() == []
    assert [fault.name for fault in of(msg.Fault, events)] == ["DRV_FAULT"]
    assert modes(events) == ["fault"]


def test_the_disarm_reason_is_asked_for_and_told() -> None:
    bench = ready()
    bench.run(300, msg.Velocity("left", 10.0))
    # A fault that clears by itself: only Get_Error still knows it.
    bench.twin.trip(Error.DC_BUS_UNDER_VOLTAGE)
    bench.twin.errors = Error(0)
    events = bench.run(120, msg.Velocity("left", 10.0))
    assert "left closed loop by itself" in of(msg.State, events)[0].detail
    assert [(f.name, f.cause.split(":")[0]) for f in of(msg.Fault, events)] == [
        ("DC_BUS_UNDER_VOLTAGE", "it disarmed the axis")
    ]


def test_an_uncalibrated_device_says_why_it_does_not_arm() -> None:
    bench = ready(device(settings=Settings(calibrated=False)))
    events = bench.run(1500, msg.Velocity("left", 5.0))
    (fault,) = of(msg.Fault, events)
    assert (fault.code, fault.name) == (PROCEDURE + Result.NOT_CALIBRATED, "NOT_CALIBRATED")
    start = bench.now
    bench.run(500)
    assert bench.said(since=start) == []


def test_a_device_that_ignores_the_request_is_a_fault_after_some_tries_at_a_bounded_rate() -> None:
    bench = ready()
    bench.to_device = lambda frame: frame.id & 0x1F != 0x07
    events = bench.run(3000, msg.Velocity("left", 5.0))
    (fault,) = of(msg.Fault, events)
    assert fault.code == NOT_ARMED
    tries = [t for t, f in bench.sent if f.id == 0x27]
    assert len(tries) == 5
    assert min(b - a for a, b in itertools.pairwise(tries)) >= 250 * MILLISECOND
    bench.to_device = lambda frame: True
    bench.ask(msg.ClearFault("left"), 500)
    assert bench.twin.axis.armed


# -- restarts, silence, buses ------------------------------------------------------------------------


def test_a_reboot_is_noticed_and_only_a_fresh_sequence_arms_again() -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 30.0))
    bench.twin.receive(bench.now, encode(1, Reboot(0)))
    start = bench.now
    events = bench.run(1400, msg.Velocity("left", 30.0))
    assert modes(events)[:2] == ["offline", "initialising"]
    assert "ready" in modes(events)
    back = next(state.t for state in of(msg.State, events) if state.mode is Mode.READY)
    # Set-points may go out until the silence is noticed, then nothing until the device is heard ready.
    assert bench.said(since=start + 260 * MILLISECOND)[0] == SetControllerMode(ControlMode.VELOCITY, 1)
    fresh = bench.said(since=back)
    assert fresh[:3] == [SetControllerMode(ControlMode.VELOCITY, 1), SetInputVel(0.0, 0.0), CLOSED]


def test_state_falling_to_idle_without_error_is_told_and_rearmed_by_a_sequence() -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 30.0))
    bench.twin.receive(bench.now, encode(1, IDLE))
    start = bench.now
    events = bench.run(400, msg.Velocity("left", 30.0))
    states = of(msg.State, events)
    assert states[0].mode is Mode.READY
    assert "left closed loop by itself" in states[0].detail
    said = bench.said(
        since=states[0].t + 1
    )  # what was sent in that very millisecond was sent before it was heard
    assert said[:3] == [SetControllerMode(ControlMode.VELOCITY, 1), SetInputVel(0.0, 0.0), CLOSED]
    assert IDLE not in bench.said(since=start)


def test_a_silent_device_is_offline_in_the_declared_time_and_idle_still_goes_out() -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 30.0))
    silent = bench.now
    bench.from_device = lambda frame: False
    events = bench.run(300, msg.Velocity("left", 30.0))
    (state,) = of(msg.State, events)
    assert state.mode is Mode.OFFLINE
    assert state.t - silent <= Options().offline_ms * MILLISECOND
    start = bench.now
    bench.run(300, msg.Velocity("left", 30.0))
    assert bench.said(since=start) == []
    bench.run(300, msg.Idle("left"))
    assert not bench.twin.axis.armed


def test_a_device_that_was_never_there_is_offline_and_asked_at_a_bounded_rate() -> None:
    bench = Bench([device()])
    bench.to_device = bench.from_device = lambda frame: False
    bench.run(2000, msg.Velocity("left", 1.0))
    assert modes(bench.events) == ["offline"]
    assert bench.said() == []
    assert len(bench.sent) <= 2000 / 100 * 3 + 5


@pytest.mark.parametrize("state", [BusState.GONE, BusState.OFF, BusState.BACK])
def test_after_trouble_of_the_bus_arming_starts_afresh(state: BusState) -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 30.0))
    bench.twin.axis.armed = False
    bench.driver.bus(bench.now, state)
    start = bench.now
    bench.run(400, msg.Velocity("left", 30.0))
    assert bench.said(since=start)[:3] == [
        SetControllerMode(ControlMode.VELOCITY, 1),
        SetInputVel(0.0, 0.0),
        CLOSED,
    ]
    assert bench.twin.axis.armed


def test_requests_end_when_the_bus_goes() -> None:
    bench = ready()
    bench.to_device = lambda frame: False
    bench.ask(msg.ClearFault("left"))
    bench.driver.bus(bench.now, BusState.GONE)
    events = bench.run(10, msg.Idle("left"))
    assert [(r.request, r.reason) for r in of(msg.Refused, events)] == [("ClearFault", "the bus is gone")]


def test_after_a_full_queue_the_mode_is_said_again() -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 30.0))
    bench.driver.bus(bench.now, BusState.FULL)
    start = bench.now
    bench.run(10, msg.Velocity("left", 30.0))
    assert SetControllerMode(ControlMode.VELOCITY, 1) in bench.said(since=start)
    assert bench.twin.axis.armed


# -- other firmware, cyclic messages off, doubles ------------------------------------------------------


def test_a_firmware_line_that_nobody_knows_is_told_and_never_armed() -> None:
    bench = Bench([device()])
    bench.from_device = lambda frame: frame.id & 0x1F != 0
    bench.run(1)
    reported = list(bench.driver.receive(bench.now, encode(1, GetVersion(2, 5, 1, 0, 0, 7, 1, 0))))
    events = reported + bench.run(1000, msg.Velocity("left", 1.0))
    (fault,) = of(msg.Fault, events)
    assert (fault.code, fault.name) == (WRONG_FIRMWARE, "firmware 0.7.1")
    assert of(msg.State, events)[-1].mode is Mode.FAULT
    assert bench.said() == []


def test_a_device_that_does_not_know_get_version_is_told() -> None:
    bench = Bench([device()])
    bench.from_device = lambda frame: frame.id & 0x1F != 0
    events = bench.run(2000, msg.Velocity("left", 1.0))
    (fault,) = of(msg.Fault, events)
    assert (fault.code, fault.name) == (WRONG_FIRMWARE, "firmware unknown")
    assert bench.said() == []


def test_a_device_without_cyclic_estimates_is_asked_for_them() -> None:
    bench = ready(device(settings=Settings(encoder_msg_rate_ms=0)))
    events = bench.run(1000)
    assert len([e for e in of(msg.Feedback, events) if e.position is not None]) >= 80
    bench.run(400, msg.Velocity("left", 30.0))
    assert bench.twin.axis.armed


def test_a_device_without_cyclic_heartbeats_is_asked_for_them() -> None:
    bench = Bench([device(settings=Settings(heartbeat_msg_rate_ms=0))])
    bench.run(3000, msg.Velocity("left", 30.0))
    assert bench.twin.axis.armed
    assert "armed" in modes(bench.events)


def test_a_device_with_cyclic_estimates_is_not_asked_for_them() -> None:
    bench = ready()
    start = bench.now
    bench.run(1000)
    assert [f for t, f in bench.sent if t >= start and f.id == 0x29] == []


def test_current_voltage_temperature_and_torque_are_polled_slowly() -> None:
    bench = ready()
    bench.shaft.held = True
    bench.run(300, msg.Torque("left", 0.1))
    start = bench.now
    events = of(msg.Feedback, bench.run(1000, msg.Torque("left", 0.1)))
    for name, value in (
        ("torque", 0.1),
        ("current", 0.1 * 270 / 8.27),
        ("voltage", 24.0),
        ("temperature", 25.0),
    ):
        reported = [getattr(e, name) for e in events if getattr(e, name) is not None]
        assert 4 <= len(reported) <= 6, name
        assert reported[-1] == pytest.approx(value, rel=0.02), name
    assert len([1 for t, f in bench.sent if t >= start and f.remote]) <= 24


def test_polling_can_be_switched_off_and_cyclic_messages_are_not_polled() -> None:
    bench = ready(device(options=Options(poll_ms=0)))
    bench.run(1000)
    assert not {f.id & 0x1F for _, f in bench.sent} & {0x14, 0x15, 0x17, 0x1C}
    bench = ready(device(settings=Settings(iq_msg_rate_ms=50)))
    bench.run(1000)
    assert [f for t, f in bench.sent if f.id == 0x34 and t > 300 * MILLISECOND] == []


def test_two_devices_with_one_node_id_are_noticed_by_their_serial_numbers() -> None:
    bench = ready()
    bench.devices = [*bench.devices, device()]
    bench.twins.append(Twin06(device(settings=Settings(serial_number=0xABCDEF)), 7))
    bench.shafts.append(copy.deepcopy(bench.shaft))
    events = bench.run(6000)
    (fault,) = of(msg.Fault, events)
    assert (fault.code, fault.motor) == (DUPLICATE_NODE, "left")
    assert "000000ABCDEF" in fault.cause
    assert len([found for found in of(msg.Found, events) if found.duplicate_address]) == 2


def test_heartbeats_that_contradict_each_other_in_turn_are_noticed() -> None:
    bench = ready()
    faults: list[msg.Fault] = []
    for index in range(6):
        beat = encode(1, Heartbeat(0, 8 if index % 2 else 1, 0, 0))
        faults += of(msg.Fault, bench.driver.receive(bench.now + index * 50 * MILLISECOND, beat))
    assert [fault.code for fault in faults] == [DUPLICATE_NODE]


def test_one_silent_device_does_not_hinder_the_other() -> None:
    bench = ready(device("left", 1), device("right", 2))
    bench.from_device = lambda frame: frame.id >> 5 != 1
    bench.run(600, msg.Velocity("left", 20.0), msg.Velocity("right", 20.0))
    assert bench.shafts[1].velocity == pytest.approx(20.0, abs=0.5)


# -- what is counted, and state as plain data -----------------------------------------------------------


def test_every_wire_is_counted_once() -> None:
    bench = Bench([device()])
    good = encode(1, Heartbeat(0, 1, 0, 0))
    cases: list[tuple[Frame, str]] = [
        (good, "accepted"),
        (encode(9, Address(9, 5, 0)), "accepted"),
        (CanFrame(good.id, good.data[:6]), "malformed"),
        (CanFrame(0x29, b"\xff" * 8), "malformed"),
        (CanFrame(good.id, good.data + b"\0"), "malformed"),
        (encode(2, Heartbeat(0, 1, 0, 0)), "ignored"),
        (CanFrame(good.id, good.data, extended=True), "ignored"),
        (CanFrame(good.id, good.data, fd=True), "ignored"),
        (CanFrame(0x29, remote=True), "ignored"),
        (CanFrame(0x29), "ignored"),
        (encode(1, CLOSED), "ignored"),
        (encode(0x3F, Address(4, 77)), "ignored"),
        (CanFrame(0x28, bytes(8)), "ignored"),
        (b"serial", "ignored"),
    ]
    for frame, count in cases:
        before = copy.deepcopy(bench.driver.counters)
        bench.driver.receive(5, frame)
        after = bench.driver.counters
        rose = [n for n in ("accepted", "malformed", "ignored") if getattr(after, n) != getattr(before, n)]
        assert rose == [count], frame


def test_what_a_host_sends_changes_no_state() -> None:
    bench = ready()
    before = copy.deepcopy(vars(bench.driver.axes[1]))
    host = (
        CLOSED,
        SetInputVel(3.0, 0.0),
        SetControllerMode(3, 1),
        Estop(),
        ClearErrors(0),
        SetInputPos(1, 0, 0),
    )
    for message in host:
        assert bench.driver.receive(bench.now, encode(1, message)) == []
    assert vars(bench.driver.axes[1]) == before


def test_a_copied_driver_goes_on_as_the_original_does() -> None:
    bench = ready()
    bench.run(123, msg.Velocity("left", 12.0))
    twin = copy.deepcopy(bench)
    assert bench.run(700, msg.Velocity("left", 8.0)) == twin.run(700, msg.Velocity("left", 8.0))
    assert bench.sent == twin.sent
    assert bench.received == twin.received


def test_due_is_always_ahead_after_send() -> None:
    bench = Bench([device()])
    for _ in range(3000):
        bench.tick([msg.Velocity("left", 5.0)] if bench.now > 700 * MILLISECOND else [msg.Idle("left")])
        bench.driver.send(bench.now, [])
        due = bench.driver.due()
        assert due is not None
        assert due > bench.now
