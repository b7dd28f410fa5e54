"""The driver against its twins, of both firmware lines: arming, driving, disarming, faults, restarts, boards.

What goes out frame by frame is in the conversations (`test_vectors_*.py`); what every driver must do is in
the contract (`protocols.conformance`). Here is that driver and twin do it together, and the rest.
"""

from __future__ import annotations

import copy
import math

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Mode
from protocols.odrive_can import plugin
from protocols.odrive_can.codec import encode
from protocols.odrive_can.dialect import LINE05
from protocols.odrive_can.faults import Error
from protocols.odrive_can.faults05 import (
    AxisError,
    ControllerError,
    EncoderError,
    MotorError,
    SensorlessError,
)
from protocols.odrive_can.messages import (
    Address,
    ClearErrors,
    ControlMode,
    Estop,
    GetEncoderEstimates,
    Heartbeat,
    Reboot,
    SetControllerMode,
    SetInputPos,
    SetInputVel,
)
from protocols.odrive_can.options import Options, Settings
from tests.protocols.helpers import modes, of
from tests.protocols.odrive_can.conversation import DBCS
from tests.protocols.odrive_can.helpers import CLOSED, IDLE, V05, Bench, device, ready


def test_only_remote_frames_are_sent_before_a_command() -> None:
    bench = Bench([device("left", 1), device("right", 2)])
    bench.run(2000, msg.Idle("left"), msg.Idle("right"))
    assert len(bench.sent) > 20
    assert all(frame.remote for _, frame in bench.sent)
    assert {event.mode for event in of(msg.State, bench.events)} == {Mode.READY}


def test_the_first_frame_of_a_device_counts() -> None:
    bench = Bench([device()])
    events = bench.driver.receive(0, encode(1, GetEncoderEstimates(0.5, 0.0)))
    assert events == [msg.Feedback("left", 0, position=math.pi, velocity=0.0)]


@pytest.mark.parametrize("options", [Options(), V05], ids=["0.6", "0.5"])
def test_velocity_position_and_torque_are_reached_and_idle_disarms(options: Options) -> None:
    bench = ready(device(options=options))
    bench.run(500, msg.Velocity("left", 50.0))
    assert bench.shaft.velocity == pytest.approx(50.0, abs=1.0)
    bench.run(1500, msg.Position("left", 30.0))
    assert bench.shaft.position == pytest.approx(30.0, abs=0.05)
    bench.shaft.locked = True
    bench.run(300, msg.Torque("left", 0.2))
    assert bench.twins[0].servo.torque() == pytest.approx(0.2, abs=1e-3)
    bench.run(300, msg.Idle("left"))
    assert not bench.twins[0].axis.armed
    assert modes(bench.events)[-2:] == ["armed", "ready"]


def test_idle_is_sent_to_an_armed_device_at_once_and_until_it_is_confirmed() -> None:
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
    times = [t for t, f in bench.sent if t >= start and f.id == 0x27]
    assert times[0] == start
    assert 3 <= len(times) <= 8
    assert not bench.twin.axis.armed
    assert bench.sent_to(node=2) == []
    after = bench.now
    bench.run(500)
    assert bench.sent_to(since=after) == []


def test_a_running_device_is_taken_over_without_dropping_its_load() -> None:
    bench = Bench([device()])
    for message in (SetControllerMode(ControlMode.VELOCITY, 1), SetInputVel(5.0, 0.0), CLOSED):
        bench.twin.receive(0, encode(1, message))
    bench.run(500, msg.Idle("left"))
    assert bench.sent_to() == []
    assert modes(bench.events) == ["armed"]
    assert bench.shaft.velocity > 25.0
    bench.run(300, msg.Velocity("left", 31.4))
    assert bench.twin.axis.armed
    assert {type(m) for m in bench.sent_to()} == {SetInputVel, SetControllerMode}
    bench.run(300, msg.Idle("left"))
    assert not bench.twin.axis.armed


def test_an_extended_axis_is_driven_beside_a_standard_one_of_that_address() -> None:
    extended = Options(firmware="0.5", is_extended=True)
    bench = ready(
        device("far", 0xFEDCBA, options=extended),
        device("left", 1, options=V05),
        device("same", 1, options=extended),
    )
    bench.run(600, msg.Velocity("far", 5.0), msg.Velocity("left", 6.0), msg.Velocity("same", -7.0))
    assert [shaft.velocity for shaft in bench.shafts] == pytest.approx([5.0, 6.0, -7.0], abs=0.5)
    assert bench.driver.counters.malformed == bench.driver.counters.ignored == 0
    assert of(msg.Fault, bench.events) == []
    spec = plugin.spec(bench.devices[0])
    far = {frame.id for _, frame in bench.sent if frame.extended and frame.id >> 5 == 0xFEDCBA}
    assert far
    assert far <= spec.sends
    assert not spec.read_only(CanFrame(0xFEDCBA << 5 | 0x09, remote=True))
    assert spec.read_only(CanFrame(0xFEDCBA << 5 | 0x09, remote=True, extended=True))


# -- faults ---------------------------------------------------------------------------------------


def test_a_fault_stays_until_it_is_cleared_and_nothing_clears_it_unasked() -> None:
    bench = ready()
    bench.run(300, msg.Velocity("left", 10.0))
    bench.twin.receive(bench.now, encode(1, Estop()))
    events = bench.run(1000)
    assert [fault.name for fault in of(msg.Fault, events)] == ["ESTOP_REQUESTED"]
    for command in (
        msg.Velocity("left", 5.0),
        msg.Position("left", 0.0),
        msg.Hold("left"),
        msg.Idle("left"),
        msg.Torque("left", 0.0),
    ):
        bench.run(300, command)
    assert ClearErrors(0) not in bench.sent_to()
    assert bench.twin.errors == Error.ESTOP_REQUESTED
    events = bench.ask(msg.ClearFault("left"), 300)
    assert len(of(msg.Done, events)) == 1
    assert not bench.twin.errors
    assert of(msg.Fault, events) == []
    bench.run(400, msg.Velocity("left", 10.0))
    assert bench.twin.axis.armed


def test_an_error_word_that_is_never_sent_does_not_prevent_arming_for_ever() -> None:
    bench = ready(device(options=V05))
    bench.from_device = lambda frame: frame.id & 0x1F != 0x03
    bench.twin05.trip(Error.CURRENT_LIMIT_VIOLATION)
    bench.run(1500)
    assert len([1 for _, frame in bench.sent if frame.id == 0x23]) == 5
    bench.ask(msg.ClearFault("left"), 300)
    bench.run(400, msg.Velocity("left", 5.0))
    assert bench.twin05.axis.armed


def test_the_faults_of_0_5_are_those_of_the_vendor_s_dbc_all_of_them() -> None:
    tables = [LINE05.axis_faults, *(table for _, table in LINE05.component_faults.values())]
    signals = [
        ("Axis_Error", "Heartbeat", AxisError),
        ("Motor_Error", "Get_Motor_Error", MotorError),
        ("Encoder_Error", "Get_Encoder_Error", EncoderError),
        ("Controller_Error", "Get_Controller_Error", ControllerError),
        ("Sensorless_Error", "Get_Sensorless_Error", SensorlessError),
    ]
    for table, (name, message, bits) in zip(tables, signals, strict=True):
        signal = DBCS["0.5"].get_message_by_name(f"Axis3_{message}").get_signal_by_name(name)
        theirs = {int(value): str(choice) for value, choice in signal.choices.items() if value}
        assert theirs == {int(bit): bit.name for bit in bits}, name
        assert {bit: info.name.split()[-1] for bit, info in table.items()} == theirs, name


def test_clearing_one_axis_clears_the_board_and_done_states_that() -> None:
    left, right = Settings(other_axis=2), Settings(other_axis=1)
    bench = ready(device("left", 1, left, V05), device("right", 2, right, V05))
    for twin in bench.twins:
        twin.trip(Error.ESTOP_REQUESTED)
    bench.run(200)
    (done,) = of(msg.Done, bench.ask(msg.ClearFault("left"), 300))
    assert "every axis of its board" in done.detail
    assert modes(bench.events)[-1] == modes(bench.events, "right")[-1] == "ready"


# -- restarts, silence, polling -------------------------------------------------------------------


def test_a_reboot_is_noticed_and_only_a_new_sequence_arms_again() -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 30.0))
    bench.twin.receive(bench.now, encode(1, Reboot(0)))
    start = bench.now
    events = bench.run(1400, msg.Velocity("left", 30.0))
    assert modes(events)[:2] == ["offline", "initialising"]
    assert "ready" in modes(events)
    back = next(state.t for state in of(msg.State, events) if state.mode is Mode.READY)
    # Set-points may be sent until the silence is noticed, then nothing until the device reports ready.
    assert bench.sent_to(since=start + 260 * MILLISECOND)[0] == SetControllerMode(ControlMode.VELOCITY, 1)
    sequence = [SetControllerMode(ControlMode.VELOCITY, 1), SetInputVel(0.0, 0.0), CLOSED]
    assert bench.sent_to(since=back)[:3] == sequence


def test_a_silent_device_is_offline_in_the_declared_time_and_idle_is_still_sent() -> None:
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
    assert bench.sent_to(since=start) == []
    bench.run(300, msg.Idle("left"))
    assert not bench.twin.axis.armed


@pytest.mark.parametrize("settings", [Settings(encoder_msg_rate_ms=0), Settings(heartbeat_msg_rate_ms=0)])
def test_a_device_without_cyclic_estimates_or_heartbeats_is_polled_and_driven(settings: Settings) -> None:
    bench = Bench([device(settings=settings)])
    bench.run(3000, msg.Velocity("left", 30.0))
    assert bench.twin.axis.armed
    assert "armed" in modes(bench.events)
    assert len([e for e in of(msg.Feedback, bench.run(1000)) if e.position is not None]) >= 80


def test_polling_of_an_idle_host_feeds_the_watchdog_of_0_5() -> None:
    bench = ready(device(settings=Settings(enable_watchdog=True, watchdog_timeout=0.25), options=V05))
    bench.run(3000)
    assert bench.twin05.errors == 0
    assert all(frame.remote for _, frame in bench.sent)


def test_one_silent_device_does_not_hinder_the_other() -> None:
    bench = ready(device("left", 1), device("right", 2))
    bench.from_device = lambda frame: frame.id >> 5 != 1
    bench.run(600, msg.Velocity("left", 20.0), msg.Velocity("right", 20.0))
    assert bench.shafts[1].velocity == pytest.approx(20.0, abs=0.5)


# -- received frames ------------------------------------------------------------------------------


def test_every_frame_is_counted_once() -> None:
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


def test_a_host_s_frames_change_no_state() -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 20.0))
    before = copy.deepcopy(vars(bench.driver.axes[1]))
    host = (
        CLOSED,
        SetInputVel(3.0, 0.0),
        SetControllerMode(3, 1),
        Estop(),
        ClearErrors(0),
        SetInputPos(1, 0, 0),
    )
    for frame in [encode(1, message) for message in host] + [frame for _, frame in bench.sent]:
        assert bench.driver.receive(bench.now, frame) == []
    assert vars(bench.driver.axes[1]) == before
