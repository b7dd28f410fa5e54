"""The twin of 0.6.x alone: the firmware's behaviour, point by point, as in the table of the plugin's
README."""

from __future__ import annotations

import math
import struct
from itertools import pairwise
from typing import Literal

import pytest

from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Event, Feedback
from protocols.odrive_can.codec import BROADCAST, TABLES, cmd_of, decode_from_device, encode, radians, turns
from protocols.odrive_can.faults import Error, Result
from protocols.odrive_can.messages import (
    Address,
    AxisState,
    ClearErrors,
    ControlMode,
    EnterDfuMode,
    Estop,
    GetBusVoltageCurrent,
    GetError,
    GetPowers,
    GetTemperature,
    GetTorques,
    Heartbeat,
    InputMode,
    Message,
    Reboot,
    SetAxisState,
    SetControllerMode,
    SetInputPos,
    SetInputTorque,
    SetInputVel,
    SetLimits,
    SetPosGain,
    SetTrajAccelLimits,
    SetTrajVelLimit,
)
from protocols.odrive_can.options import Options, Settings
from protocols.odrive_can.twin06 import Twin06
from tests.protocols.odrive_can.helpers import CLOSED, IDLE, V05, TwinRig, device

TX_SDO = {"0.5": set[int](), "0.6": {0x05}}
"""It replies to RxSdo only, which the twin does not know."""

# -- states -------------------------------------------------------------------------------------------


def test_arming_shows_closed_loop_and_busy() -> None:
    beat = TwinRig().armed().heartbeat()
    assert (beat.error, beat.state, beat.result) == (0, AxisState.CLOSED_LOOP_CONTROL, Result.BUSY)


def test_idle_disarms_without_an_error() -> None:
    rig = TwinRig().armed()
    rig.send(IDLE)
    beat = rig.heartbeat()
    assert (beat.error, beat.state, beat.result) == (0, AxisState.IDLE, Result.SUCCESS)


@pytest.mark.parametrize(
    ("state", "result"),
    [
        (AxisState.HOMING, Result.HOMING_WITHOUT_ENDSTOP),
        (AxisState.MOTOR_CALIBRATION, Result.INVALID_STATE),
        (5, Result.INVALID_STATE),
        (99, Result.INVALID_STATE),
        (0xFFFFFFFF, Result.INVALID_STATE),
    ],
)
def test_a_state_that_is_not_possible_leaves_the_axis_idle(state: int, result: Result) -> None:
    rig = TwinRig().armed()
    rig.send(SetAxisState(state))
    beat = rig.heartbeat()
    assert (beat.state, beat.result) == (AxisState.IDLE, result)


def test_state_zero_is_no_request() -> None:
    rig = TwinRig().armed()
    rig.send(SetAxisState(0))
    assert rig.heartbeat().state == AxisState.CLOSED_LOOP_CONTROL


def test_an_uncalibrated_axis_does_not_arm() -> None:
    rig = TwinRig(Settings(calibrated=False))
    rig.send(CLOSED)
    beat = rig.heartbeat()
    assert (beat.error, beat.state, beat.result) == (0, AxisState.IDLE, Result.NOT_CALIBRATED)


def test_an_axis_in_fault_does_not_arm_until_cleared() -> None:
    rig = TwinRig().armed()
    rig.send(Estop())
    beat = rig.heartbeat()
    assert (beat.error, beat.state, beat.result) == (Error.ESTOP_REQUESTED, AxisState.IDLE, Result.DISARMED)
    rig.send(CLOSED)
    assert rig.heartbeat().state == AxisState.IDLE
    rig.send(ClearErrors(0), CLOSED)
    beat = rig.heartbeat()
    assert (beat.error, beat.state) == (0, AxisState.CLOSED_LOOP_CONTROL)


def test_the_disarm_reason_is_reported_until_cleared() -> None:
    rig = TwinRig().armed()
    rig.send(Estop())
    assert rig.reply(0x03) == GetError(Error.ESTOP_REQUESTED, Error.ESTOP_REQUESTED)
    rig.send(ClearErrors(0))
    assert rig.reply(0x03) == GetError(0, 0)


def test_the_identify_flag_of_clear_errors() -> None:
    rig = TwinRig()
    rig.send(ClearErrors(1), node=BROADCAST)
    assert rig.twin.identify
    rig.send(ClearErrors(0), node=BROADCAST)
    assert not rig.twin.identify


# -- messages -----------------------------------------------------------------------------------------


def test_cyclic_messages_keep_their_rates() -> None:
    rig = TwinRig(Settings(heartbeat_msg_rate_ms=50, encoder_msg_rate_ms=20, iq_msg_rate_ms=100))
    rig.run(1000)
    for cmd, period in ((0x01, 50), (0x09, 20), (0x14, 100)):
        times = [t for t, _ in rig.sent(cmd)]
        assert {b - a for a, b in pairwise(times)} == {period * MILLISECOND}
        assert len(times) == 1000 // period
    assert rig.sent(0x17) == []


@pytest.mark.parametrize("options", [Options(), V05], ids=["0.6", "0.5"])
def test_the_default_rates_are_heartbeat_100_ms_and_estimates_10_ms(options: Options) -> None:
    rig = TwinRig(options=options)
    rig.run(1000)
    assert len(rig.sent(0x01)) == 10
    assert len(rig.sent(0x09)) == 100
    assert {frame.id for _, frame in rig.frames} == {0x21, 0x29}


@pytest.mark.parametrize("remote", [True, False], ids=["RTR", "DLC 0"])
@pytest.mark.parametrize(
    ("line", "cmd"),
    [(line, cmd) for line in ("0.5", "0.6") for cmd in sorted(TABLES[line].requestable - TX_SDO[line])],
)
def test_every_message_is_sent_on_request(line: Literal["0.5", "0.6"], cmd: int, remote: bool) -> None:
    silent = Settings(heartbeat_msg_rate_ms=0, encoder_msg_rate_ms=0)
    rig = TwinRig(silent, Options(firmware=line))
    rig.run(5)
    assert type(rig.reply(cmd, CanFrame(0x20 | cmd, remote=remote))) is TABLES[line].from_device[cmd].message
    ((_, frame),) = rig.frames
    assert frame.id == 0x20 | cmd
    assert len(frame.data) == 8


def test_what_is_not_for_it_changes_nothing() -> None:
    rig = TwinRig().armed()
    rig.send(SetInputVel(1.0, 0.0))
    before = (
        repr(rig.twin.axis),
        repr(rig.twin.servo.gains),
    )
    state = encode(1, IDLE)
    frames: list[Frame] = [
        CanFrame(state.id, state.data, extended=True),
        CanFrame(state.id, state.data, fd=True),
        CanFrame(state.id, remote=True),
        encode(2, IDLE),
        encode(BROADCAST, IDLE),
        encode(BROADCAST, SetInputVel(9.0, 0.0)),
        CanFrame(0x28, bytes(8)),
        CanFrame(0x30, bytes(8)),
        CanFrame(0x2A, bytes(8)),
        CanFrame(0x3E, bytes(8)),
        CanFrame(0x2D, struct.pack("<ff", math.nan, 0.0)),
        CanFrame(0x2C, struct.pack("<fhh", math.inf, 0, 0)),
        CanFrame(0x27, state.data + b"\0"),
        b"\x00\x01",
    ]
    for frame in frames:
        rig.receive(frame)
    assert (repr(rig.twin.axis), repr(rig.twin.servo.gains)) == before


# -- discovery ----------------------------------------------------------------------------------------


def test_discovery_is_answered_on_its_own_node_id() -> None:
    rig = TwinRig(Settings(serial_number=0x0102030405))
    rig.run(1)
    rig.frames.clear()
    rig.receive(CanFrame(0x7E6, remote=True))
    rig.run(1)
    answers = [f for _, f in rig.frames if f.id == 0x26]
    assert [f.data.hex() for f in answers] == ["01" + "0504030201" + "00" + "00"]


def test_a_node_id_is_taken_by_serial_number_and_vacated_for_another() -> None:
    rig = TwinRig(Settings(serial_number=77))
    rig.send(Address(9, 77), node=BROADCAST)
    assert rig.twin.axis.node == 9
    rig.send(Address(5, 78), node=BROADCAST)
    assert rig.twin.axis.node == 9
    rig.send(Address(9, 78), node=BROADCAST)
    assert rig.twin.axis.node == BROADCAST
    rig.run(300)
    assert {f.id >> 5 for t, f in rig.frames if t > 5 * MILLISECOND} == set()
    rig.receive(CanFrame(0x7E6, remote=True))
    rig.run(1)
    assert rig.frames[-1][1].id == 0x7E6
    assert rig.frames[-1][1].data[0] == BROADCAST


@pytest.mark.parametrize("address", [1, 300])
def test_an_axis_with_extended_identifiers_has_no_node_id_to_reply(address: int) -> None:
    """No device of 0.6.x has them, but settings and options together can state one; it must not raise."""
    far = Options(firmware="0.5", is_extended=True)
    twin = Twin06(device(address=address, settings=Settings(firmware="0.6.10"), options=far), 0)
    twin.step(0, [])
    for frame in (CanFrame(0x7E6, remote=True), CanFrame(address << 5 | 0x06, remote=True, extended=True)):
        twin.receive(1, frame)
        assert twin.step(2, [])[1] == ()
    twin.receive(3, encode(BROADCAST, Address(9, twin.axis.serial)))
    assert twin.step(4, [])[1] == (encode(9, Address(9, twin.axis.serial, 0)),)


# -- watchdog, reboot ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("message", "feeds"),
    [
        (SetInputVel(1.0, 0.0), True),
        (SetInputPos(1.0, 0.0, 0.0), True),
        (SetInputTorque(0.0), True),
        (CLOSED, True),
        (SetPosGain(20.0), False),
    ],
)
def test_the_watchdog_is_fed_by_setpoints_and_state_requests(message: Message, feeds: bool) -> None:
    rig = TwinRig(Settings(enable_watchdog=True, watchdog_timeout=0.1)).armed()
    for _ in range(6):
        rig.send(message)
        rig.run(50)
    assert rig.twin.axis.armed == feeds
    assert (rig.twin.errors == Error.WATCHDOG_TIMER_EXPIRED) != feeds


def test_an_expired_watchdog_disarms_and_heartbeats_go_on_with_the_error() -> None:
    rig = TwinRig(Settings(enable_watchdog=True, watchdog_timeout=0.1)).armed()
    rig.send(SetInputVel(5.0, 0.0))
    rig.run(98)
    assert rig.heartbeat().state == AxisState.CLOSED_LOOP_CONTROL
    rig.run(5)
    beat = rig.heartbeat()
    assert encode(3, beat).data.hex()[:12] == "000000010103"
    rig.run(300)
    assert rig.sent(0x01)[-1][0] >= rig.now - 101 * MILLISECOND


def test_the_watchdog_is_off_by_default_and_sleeps_while_idle() -> None:
    rig = TwinRig().armed()
    rig.send(SetInputVel(5.0, 0.0))
    rig.run(3000)
    assert rig.twin.axis.armed
    rig = TwinRig(Settings(enable_watchdog=True, watchdog_timeout=0.1))
    rig.run(1000)
    assert not rig.twin.errors


def test_a_reboot_is_silent_then_initializing_and_forgets_what_was_not_saved() -> None:
    rig = TwinRig(Settings(reboot_ms=400, initializing_ms=200)).armed()
    rig.send(SetPosGain(5.0), SetInputVel(10.0, 0.0))
    rig.run(500)
    turned = turns(rig.shaft.position)
    assert turned > 3
    start = rig.now
    rig.send(Reboot(0))
    rig.run(1000)
    quiet = [t for t, _ in rig.frames if start < t < start + 400 * MILLISECOND]
    assert quiet == []
    beats = [decode_from_device(f) for t, f in rig.frames if f.id == 0x21 and t > start]
    errors = [beat.error for beat in beats if isinstance(beat, Heartbeat)]
    assert errors[:2] == [Error.INITIALIZING, Error.INITIALIZING]
    assert errors[-1] == 0
    assert not rig.twin.axis.armed
    assert rig.twin.servo.gains.pos_gain == 20.0
    assert 0.0 <= rig.twin.servo.position < 20.0
    assert rig.twin.servo.offset >= 3


def test_a_broadcast_reboots_and_an_erased_device_has_no_node_id() -> None:
    rig = TwinRig()
    rig.run(10)
    rig.send(Reboot(2), node=BROADCAST)
    rig.run(2000)
    assert rig.twin.axis.node == BROADCAST


def test_the_boot_loader_is_silent() -> None:
    rig = TwinRig()
    rig.run(10)
    rig.send(EnterDfuMode())
    rig.frames.clear()
    rig.run(5000)
    assert rig.frames == []


# -- loops --------------------------------------------------------------------------------------------


def test_the_default_gains_track_velocity_of_a_geared_wheel() -> None:
    rig = TwinRig().armed()
    rig.send(SetInputVel(15.0, 0.0))
    rig.run(60)
    assert rig.shaft.velocity == pytest.approx(radians(15.0), rel=0.06)
    rig.run(1000)
    assert rig.shaft.velocity == pytest.approx(radians(15.0), rel=0.005)


def test_a_load_is_integrated_away() -> None:
    rig = TwinRig().armed()
    rig.shaft.load = -0.2
    rig.send(SetInputVel(5.0, 0.0))
    rig.run(4000)
    assert rig.shaft.velocity == pytest.approx(radians(5.0), rel=0.02)


def test_torque_is_limited_by_the_current_limit_and_the_torque_constant() -> None:
    rig = TwinRig().armed(ControlMode.TORQUE)
    rig.shaft.locked = True
    rig.send(SetInputTorque(5.0))
    rig.run(50)
    limit = 30.0 * 8.27 / 270
    assert rig.twin.servo.torque() == pytest.approx(limit, rel=1e-6)
    rig.send(SetLimits(40.0, 10.0))
    rig.run(50)
    assert rig.twin.servo.iq == pytest.approx(10.0, rel=1e-6)


def test_a_stalled_motor_pulls_with_its_limit_and_the_integrator_does_not_wind_up() -> None:
    rig = TwinRig().armed()
    rig.shaft.locked = True
    rig.send(SetInputVel(20.0, 0.0))
    rig.run(1000)
    assert rig.twin.servo.iq == pytest.approx(30.0, rel=1e-3)
    assert abs(rig.twin.servo.integrator) < 0.01


def test_velocity_is_clipped_to_its_limit_in_position_and_torque_control() -> None:
    rig = TwinRig(Settings(vel_limit=5.0)).armed(ControlMode.POSITION)
    rig.send(SetInputPos(50.0, 0.0, 0.0))
    rig.run(1500)
    assert turns(rig.shaft.velocity) == pytest.approx(5.0, abs=0.1)
    rig = TwinRig(Settings(vel_limit=5.0)).armed(ControlMode.TORQUE)
    rig.send(SetInputTorque(0.3))
    rig.run(2000)
    assert turns(rig.shaft.velocity) <= 5.05
    assert rig.twin.axis.armed


def test_overspeed_is_a_velocity_limit_violation() -> None:
    rig = TwinRig(Settings(vel_limit=5.0)).armed()
    rig.shaft.load = 1.5
    rig.run(500)
    assert rig.twin.errors == Error.VELOCITY_LIMIT_VIOLATION
    assert not rig.twin.axis.armed


def test_position_control_takes_the_present_position_when_it_arms() -> None:
    rig = TwinRig()
    rig.run(5)
    rig.send(SetControllerMode(ControlMode.POSITION, 1), SetInputPos(100.0, 0.0, 0.0), CLOSED)
    rig.run(200)
    assert abs(rig.shaft.position) < 0.01
    rig.send(SetInputPos(1.0, 0.0, 0.0))
    rig.run(1000)
    assert turns(rig.shaft.position) == pytest.approx(1.0, abs=0.005)


def test_velocity_ramp_trapezoid_filter_and_torque_ramp() -> None:
    rig = TwinRig().armed(ControlMode.VELOCITY, InputMode.VEL_RAMP)
    rig.send(SetInputVel(10.0, 0.0))
    rig.run(500)
    assert turns(rig.shaft.velocity) == pytest.approx(5.0, abs=0.3)

    rig = TwinRig().armed(ControlMode.POSITION, InputMode.TRAP_TRAJ)
    rig.send(SetTrajVelLimit(4.0), SetTrajAccelLimits(8.0, 8.0), SetInputPos(6.0, 0.0, 0.0))
    fastest = 0.0
    for _ in range(1900):
        rig.run(1)
        fastest = max(fastest, turns(rig.shaft.velocity))
    assert fastest == pytest.approx(4.0, abs=0.2)
    assert rig.heartbeat().trajectory_done == 0
    rig.run(400)
    assert rig.heartbeat().trajectory_done == 1
    assert turns(rig.shaft.position) == pytest.approx(6.0, abs=0.02)

    rig = TwinRig().armed(ControlMode.POSITION, InputMode.POS_FILTER)
    rig.send(SetInputPos(1.0, 0.0, 0.0))
    rig.run(100)
    assert 0.2 < turns(rig.shaft.position) < 0.9
    rig.run(900)
    assert turns(rig.shaft.position) == pytest.approx(1.0, abs=0.01)

    rig = TwinRig().armed(ControlMode.TORQUE, InputMode.TORQUE_RAMP)
    rig.shaft.locked = True
    rig.send(SetInputTorque(0.5))
    rig.run(200)
    assert rig.twin.servo.torque() == pytest.approx(0.2, abs=0.01)


def test_an_inactive_input_is_not_followed() -> None:
    rig = TwinRig().armed(ControlMode.VELOCITY, InputMode.INACTIVE)
    rig.send(SetInputVel(10.0, 0.0))
    rig.run(300)
    assert rig.shaft.velocity == pytest.approx(0.0, abs=0.01)


def test_the_encoder_counts() -> None:
    rig = TwinRig(Settings(encoder_cpr=100))
    rig.shaft.position = radians(0.1234)
    rig.run(5)
    assert rig.twin.servo.position == pytest.approx(0.12)


# -- power and heat -----------------------------------------------------------------------------------


def test_the_supply_sags_with_power_and_rises_with_braking() -> None:
    rig = TwinRig().armed()
    rig.shaft.load = -0.5
    rig.send(SetInputVel(20.0, 0.0))
    rig.run(3000)
    power, supply, torques = (
        rig.reply(cmd_of(kind)) for kind in (GetPowers, GetBusVoltageCurrent, GetTorques)
    )
    assert power.mechanical == pytest.approx(0.51 * radians(20.0), rel=0.05)
    assert power.electrical > power.mechanical
    assert supply.current == pytest.approx(power.electrical / supply.voltage, rel=0.01)
    assert supply.voltage == pytest.approx(24.0 - 0.05 * supply.current, rel=1e-4)
    assert torques.estimate == pytest.approx(torques.target, rel=0.02)
    rig.shaft.load = 0.5
    rig.run(500)
    braking = rig.reply(cmd_of(GetBusVoltageCurrent))
    assert braking.current < 0 < braking.voltage - 24.0


@pytest.mark.parametrize(
    ("settings", "load", "error"),
    [
        (Settings(bus_voltage=10.0), 0.0, Error.DC_BUS_UNDER_VOLTAGE),
        (Settings(bus_voltage=60.0), 0.0, Error.DC_BUS_OVER_VOLTAGE),
        (Settings(dc_max_positive_current=1.0), -0.5, Error.DC_BUS_OVER_CURRENT),
        (Settings(dc_max_negative_current=-0.5), 0.5, Error.DC_BUS_OVER_REGEN_CURRENT),
        (Settings(current_hard_max=5.0), -0.5, Error.CURRENT_LIMIT_VIOLATION),
        (Settings(ambient=106.0), 0.0, Error.MOTOR_OVER_TEMP | Error.INVERTER_OVER_TEMP),
    ],
    ids=lambda value: str(value)[:30] if isinstance(value, Error) else None,
)
def test_limits_of_the_supply_and_of_the_motor_trip(settings: Settings, load: float, error: Error) -> None:
    rig = TwinRig(settings)
    rig.run(5)
    rig.send(SetControllerMode(ControlMode.VELOCITY, 1), SetInputVel(15.0, 0.0), CLOSED)
    rig.shaft.velocity = radians(15.0)
    rig.shaft.load = load
    rig.run(400)
    assert rig.twin.errors == error
    assert not rig.twin.axis.armed


def test_a_hot_motor_gets_less_current() -> None:
    rig = TwinRig(Settings(ambient=90.0, fet_temp_limit_lower=120.0, fet_temp_limit_upper=130.0))
    rig.armed(ControlMode.TORQUE)
    rig.shaft.locked = True
    rig.send(SetInputTorque(5.0))
    rig.run(20)
    assert rig.twin.servo.iq == pytest.approx(15.0, rel=0.01)


def test_a_loaded_motor_warms_up() -> None:
    rig = TwinRig(Settings(motor_thermal_capacity=0.5)).armed(ControlMode.TORQUE)
    rig.shaft.locked = True
    rig.send(SetInputTorque(0.3))
    rig.run(8000)
    warm = rig.reply(cmd_of(GetTemperature))
    loss = 1.5 * (0.3 * 270 / 8.27) ** 2 * 0.05
    assert warm.motor == pytest.approx(25.0 + 2.0 * loss, rel=0.01)
    assert 25.0 < warm.fet < warm.motor


def test_a_slipping_encoder_is_a_spinout() -> None:
    settings = Settings(spinout_electrical_power_threshold=10.0, spinout_mechanical_power_threshold=-10.0)
    rig = TwinRig(settings).armed()
    rig.send(SetInputVel(10.0, 0.0))
    for _ in range(400):  # the encoder runs backwards although the motor pulls forwards
        rig.shaft.velocity = radians(-4.0)
        rig.run(1)
    assert rig.twin.errors == Error.SPINOUT_DETECTED


# -- the twin as data -----------------------------------------------------------------------------------


def test_the_seed_moves_the_phase_of_cyclic_messages_only() -> None:
    phases = set()
    for seed in range(5):
        rig = TwinRig(seed=seed)
        rig.run(300)
        phases.add(rig.sent(0x01)[0][0])
        assert len(rig.sent(0x01)) == 3
    assert len(phases) > 1


def test_truth_that_is_not_finite_or_not_of_its_shaft_is_not_believed() -> None:
    rig = TwinRig()
    rig.run(5)
    nonsense: list[Event] = [
        Feedback("left", 0, position=math.nan, velocity=1.0),
        Feedback("right", 0, position=9.0, velocity=1.0),
    ]
    rig.twin.step(rig.now, nonsense)
    assert rig.twin.servo.position == 0.0


def test_due_is_when_it_next_sends() -> None:
    rig = TwinRig()
    rig.run(1)
    for _ in range(20):
        due = rig.twin.due()
        assert due is not None
        before = len(rig.frames)
        rig.run(max(0, -(-(due - rig.now) // MILLISECOND)))
        assert len(rig.frames) == before
        rig.run(1)
        assert len(rig.frames) > before
