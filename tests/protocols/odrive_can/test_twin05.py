"""The twin of firmware 0.5.x alone: its habits, one by one (the table in the plugin's README names these)."""

from __future__ import annotations

from itertools import pairwise

import pytest

from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, ClearFault, Feedback, Nanos
from protocols.messages import Reboot as RebootWord
from protocols.odrive_can import twin as made
from protocols.odrive_can.codec import EXTENDED, TABLES, decode_from_device, encode, radians, turns
from protocols.odrive_can.decoder import OdriveDecoder
from protocols.odrive_can.faults import Error
from protocols.odrive_can.faults05 import AxisError, ControllerError, MotorError
from protocols.odrive_can.messages import (
    AxisState,
    ClearErrors05,
    ControlMode,
    Estop,
    GetAdcVoltage,
    GetControllerError,
    GetEncoderCount,
    GetEncoderEstimates,
    GetMotorError,
    Heartbeat05,
    Message,
    Reboot05,
    RequestAdcVoltage,
    SetAxisNodeId,
    SetAxisState,
    SetControllerMode,
    SetInputPos,
    SetInputVel,
    SetLimits,
    SetLinearCount,
    SetPosGain,
)
from protocols.odrive_can.options import Options, Settings
from protocols.odrive_can.twin05 import Twin05
from tests.protocols.odrive_can.helpers import device, free_shaft

CLOSED, IDLE = SetAxisState(AxisState.CLOSED_LOOP_CONTROL), SetAxisState(AxisState.IDLE)
V05 = Options(firmware="0.5")


class Stand:
    """One axis, one shaft, and what it said."""

    def __init__(self, settings: Settings | None = None, options: Options = V05) -> None:
        twin = made(device(settings=settings, options=options), 0)
        assert isinstance(twin, Twin05)
        self.twin = twin
        self.node = twin.axis.node
        self.shaft = free_shaft()
        self.now: Nanos = 0
        self.frames: list[tuple[Nanos, CanFrame]] = []

    def say(self, *messages: Message, node: int | None = None) -> None:
        for message in messages:
            self.handle(encode(self.node if node is None else node, message))

    def handle(self, frame: Frame) -> None:
        self.twin.receive(self.now, frame)

    def run(self, milliseconds: int) -> None:
        for _ in range(milliseconds):
            truth = Feedback("left", self.now, position=self.shaft.position, velocity=self.shaft.velocity)
            torques, frames = self.twin.step(self.now, [truth])
            self.frames += [(self.now, frame) for frame in frames if isinstance(frame, CanFrame)]
            self.shaft.step(torques[0].torque)
            self.now += MILLISECOND

    def armed(self, mode: int = ControlMode.VELOCITY) -> Stand:
        self.run(5)
        self.say(SetControllerMode(mode, 1), CLOSED)
        self.run(5)
        assert self.twin.axis.armed
        return self

    def beat(self) -> Heartbeat05:
        """The next heartbeat."""
        before = len(self.reported(0x01))
        while len(self.reported(0x01)) == before:
            self.run(1)
        reported = decode_from_device(self.reported(0x01)[-1][1], "0.5")
        assert isinstance(reported, Heartbeat05)
        return reported

    def errors(self) -> int:
        """The axis' error bits."""
        return int(self.twin.errors)

    def reported(self, cmd: int) -> list[tuple[Nanos, CanFrame]]:
        return [(t, frame) for t, frame in self.frames if frame.id & 0x1F == cmd]

    def asked(self, cmd: int, frame: CanFrame | None = None) -> Message | None:
        """The answer to a remote frame (or another one) of this command."""
        before = len(self.reported(cmd))
        self.handle(frame or CanFrame(0x20 | cmd, remote=True))
        self.run(1)
        new = self.reported(cmd)[before:]
        return decode_from_device(new[-1][1], "0.5") if new else None


# -- states and errors --------------------------------------------------------------------------------


def test_closed_loop_and_idle_are_told_without_a_result() -> None:
    stand = Stand().armed()
    assert stand.beat() == Heartbeat05(0, AxisState.CLOSED_LOOP_CONTROL, 0, 0, 0, 1)
    stand.say(IDLE)
    assert stand.beat() == Heartbeat05(0, AxisState.IDLE, 0, 0, 0, 1)


@pytest.mark.parametrize("state", [5, 42, 0xFFFFFFFF, AxisState.MOTOR_CALIBRATION])
def test_an_illegal_state_is_invalid_state_and_idle_and_the_next_request_takes_it_back(state: int) -> None:
    stand = Stand().armed()
    stand.say(SetAxisState(state))
    beat = stand.beat()
    assert (beat.error, beat.state) == (AxisError.INVALID_STATE, AxisState.IDLE)
    stand.say(IDLE)
    assert stand.beat().error == 0
    stand.say(SetAxisState(state), CLOSED)
    assert stand.beat() == Heartbeat05(0, AxisState.CLOSED_LOOP_CONTROL, 0, 0, 0, 1)


def test_an_illegal_state_adds_to_other_errors() -> None:
    stand = Stand()
    stand.run(5)
    stand.say(Estop(), SetAxisState(42))
    assert stand.beat().error == AxisError.ESTOP_REQUESTED | AxisError.INVALID_STATE
    stand.say(ClearErrors05())
    assert stand.beat().error == 0


def test_an_uncalibrated_axis_says_invalid_state() -> None:
    stand = Stand(Settings(calibrated=False))
    stand.run(5)
    stand.say(CLOSED)
    beat = stand.beat()
    assert (beat.error, beat.state) == (AxisError.INVALID_STATE, AxisState.IDLE)


def test_homing_without_end_stop_and_state_zero_and_start_up() -> None:
    stand = Stand().armed()
    stand.say(SetAxisState(0))
    assert stand.beat().state == AxisState.CLOSED_LOOP_CONTROL
    stand.say(SetAxisState(AxisState.STARTUP_SEQUENCE))
    assert (stand.beat().error, stand.beat().state) == (0, AxisState.IDLE)
    stand.say(SetAxisState(AxisState.HOMING))
    assert stand.beat().error == AxisError.HOMING_WITHOUT_ENDSTOP


def test_an_axis_with_errors_does_not_stay_armed_until_cleared() -> None:
    stand = Stand().armed()
    stand.say(Estop())
    assert stand.beat() == Heartbeat05(AxisError.ESTOP_REQUESTED, AxisState.IDLE, 0, 0, 0, 1)
    stand.say(CLOSED)
    assert stand.beat().state == AxisState.IDLE
    stand.say(ClearErrors05(), CLOSED)
    assert stand.beat().state == AxisState.CLOSED_LOOP_CONTROL


@pytest.mark.parametrize(
    ("trip", "axis", "motor", "controller"),
    [
        (Error.VELOCITY_LIMIT_VIOLATION, AxisError.CONTROLLER_FAILED, 0, ControllerError.OVERSPEED),
        (Error.SPINOUT_DETECTED, AxisError.CONTROLLER_FAILED, 0, ControllerError.SPINOUT_DETECTED),
        (
            Error.CURRENT_LIMIT_VIOLATION,
            AxisError.MOTOR_FAILED,
            MotorError.CURRENT_LIMIT_VIOLATION,
            0,
        ),
        (Error.MOTOR_OVER_TEMP, AxisError.MOTOR_FAILED, MotorError.MOTOR_THERMISTOR_OVER_TEMP, 0),
        (Error.INVERTER_OVER_TEMP, AxisError.MOTOR_FAILED, MotorError.FET_THERMISTOR_OVER_TEMP, 0),
        (Error.DC_BUS_UNDER_VOLTAGE, AxisError.MOTOR_FAILED, MotorError.SYSTEM_LEVEL, 0),
        (Error.DC_BUS_OVER_VOLTAGE, AxisError.MOTOR_FAILED, MotorError.SYSTEM_LEVEL, 0),
        (Error.DC_BUS_OVER_CURRENT, AxisError.MOTOR_FAILED, MotorError.SYSTEM_LEVEL, 0),
        (Error.DC_BUS_OVER_REGEN_CURRENT, AxisError.MOTOR_FAILED, MotorError.SYSTEM_LEVEL, 0),
    ],
    ids=lambda value: value.name if isinstance(value, Error) else "",
)
def test_errors_stand_in_the_part_that_they_are_of(
    trip: Error, axis: int, motor: int, controller: int
) -> None:
    stand = Stand().armed()
    stand.twin.trip(trip)
    assert stand.beat() == Heartbeat05(axis, AxisState.IDLE, int(motor > 0), 0, int(controller > 0), 1)
    assert stand.asked(0x03) == GetMotorError(motor)
    assert stand.asked(0x1D) == GetControllerError(controller)
    stand.say(ClearErrors05())
    assert stand.beat() == Heartbeat05(0, AxisState.IDLE, 0, 0, 0, 1)


def test_what_its_servo_finds_trips_it_too() -> None:
    stand = Stand(Settings(vel_limit=5.0)).armed()
    stand.shaft.load = 1.5
    stand.run(500)
    assert stand.twin.controller_errors == ControllerError.OVERSPEED
    assert not stand.twin.axis.armed
    stand = Stand(Settings(bus_voltage=9.0))
    stand.run(5)
    assert stand.twin.motor_errors == MotorError.SYSTEM_LEVEL


def test_asking_for_closed_loop_again_starts_position_control_afresh() -> None:
    stand = Stand().armed(ControlMode.POSITION)
    stand.say(SetInputPos(3.0, 0.0, 0.0), CLOSED)
    stand.run(300)
    assert abs(turns(stand.shaft.position)) < 0.05


# -- messages -----------------------------------------------------------------------------------------


def test_the_default_rates_are_heartbeat_100_ms_and_estimates_10_ms() -> None:
    stand = Stand()
    stand.run(1000)
    assert len(stand.reported(0x01)) == 10
    assert len(stand.reported(0x09)) == 100
    assert {frame.id for _, frame in stand.frames} == {0x21, 0x29}


def test_the_cyclic_messages_of_the_line_keep_their_rates() -> None:
    settings = Settings(
        heartbeat_msg_rate_ms=50,
        encoder_msg_rate_ms=20,
        iq_msg_rate_ms=25,
        bus_voltage_msg_rate_ms=40,
        motor_error_rate_ms=100,
        encoder_error_rate_ms=125,
        controller_error_rate_ms=200,
        sensorless_error_rate_ms=250,
        encoder_count_rate_ms=10,
        sensorless_rate_ms=500,
        version_msg_rate_ms=10,
        temperature_msg_rate_ms=10,
    )
    periods = {0x01: 50, 0x09: 20, 0x14: 25, 0x17: 40, 0x03: 100, 0x04: 125, 0x1D: 200, 0x05: 250, 0x0A: 10}
    stand = Stand(settings)
    stand.run(1000)
    for cmd, period in (periods | {0x15: 500}).items():
        times = [t for t, _ in stand.reported(cmd)]
        assert len(times) == 1000 // period, cmd
        assert {b - a for a, b in pairwise(times)} <= {period * MILLISECOND}
    assert stand.reported(0x00) == []


@pytest.mark.parametrize("remote", [True, False], ids=["RTR", "DLC 0"])
@pytest.mark.parametrize("cmd", sorted(TABLES["0.5"].requestable))
def test_every_message_but_the_heartbeat_is_told_when_asked(cmd: int, remote: bool) -> None:
    stand = Stand(Settings(heartbeat_msg_rate_ms=0, encoder_msg_rate_ms=0))
    stand.run(5)
    reported = stand.asked(cmd, CanFrame(0x20 | cmd, remote=remote))
    assert type(reported) is TABLES["0.5"].from_device[cmd].message
    assert len(stand.frames) == 1
    assert len(stand.frames[0][1].data) == 8


@pytest.mark.parametrize("cmd", [0x00, 0x01])
def test_get_version_and_the_heartbeat_are_not_told_when_asked(cmd: int) -> None:
    stand = Stand(Settings(heartbeat_msg_rate_ms=0, encoder_msg_rate_ms=0))
    stand.run(5)
    assert stand.asked(cmd) is None
    assert stand.frames == []


def test_the_roll_call_of_0_6_is_not_answered() -> None:
    stand = Stand()
    stand.run(1)
    stand.frames.clear()
    stand.handle(CanFrame(0x7E6, remote=True))
    stand.run(5)
    assert {frame.id & 0x1F for _, frame in stand.frames} <= {0x01, 0x09}


def test_the_controller_s_error_is_told_for_any_frame_of_its_number() -> None:
    stand = Stand()
    assert stand.asked(0x1D, CanFrame(0x3D, bytes(8))) == GetControllerError(0)


def test_an_adc_s_voltage_is_told_for_a_gpio_that_there_is() -> None:
    stand = Stand()
    assert stand.asked(0x1C, encode(1, RequestAdcVoltage(3))) == GetAdcVoltage(0.0)
    assert stand.asked(0x1C) == GetAdcVoltage(0.0)
    assert stand.asked(0x1C, encode(1, RequestAdcVoltage(17))) is None


def test_counts_are_signed_and_wrap_and_are_set() -> None:
    stand = Stand(Settings(encoder_cpr=8192))
    stand.shaft.position = radians(-1.25)
    stand.run(5)
    assert stand.asked(0x0A) == GetEncoderCount(-10240, 6144)
    stand.say(SetLinearCount(-5))
    assert stand.asked(0x0A) == GetEncoderCount(-5, 6144)
    reported = stand.asked(0x09)
    assert isinstance(reported, GetEncoderEstimates)
    assert reported.position == pytest.approx(-5 / 8192, abs=1e-7)
    stand.say(SetLinearCount(2**31 - 1))
    stand.shaft.position = radians(-1.0)
    stand.run(5)
    assert stand.asked(0x0A) == GetEncoderCount(-(2**31) + 2047, 0)


def test_gains_and_limits_are_taken_as_in_the_other_line() -> None:
    stand = Stand()
    stand.say(SetLimits(7.0, 12.0), SetPosGain(3.0))
    gains = stand.twin.servo.gains
    assert (gains.vel_limit, gains.current_soft_max, gains.pos_gain) == (7.0, 12.0, 3.0)


# -- addresses and boards -----------------------------------------------------------------------------


def test_a_node_id_is_taken_at_once_and_lost_at_the_next_restart() -> None:
    stand = Stand(Settings(reboot_ms=100))
    stand.run(5)
    stand.say(SetAxisNodeId(21))
    stand.frames.clear()
    stand.run(200)
    assert {frame.id >> 5 for _, frame in stand.frames} == {21}
    stand.say(SetInputVel(1.0, 0.0))
    assert stand.twin.axis.velocity == 0.0
    stand.say(Reboot05(), node=21)
    stand.frames.clear()
    stand.run(400)
    assert {frame.id >> 5 for _, frame in stand.frames} == {1}


@pytest.mark.parametrize("address", [1, 0xFEDCBA])
def test_an_extended_axis_hears_and_speaks_extended_identifiers_only(address: int) -> None:
    options = Options(firmware="0.5", is_extended=True)
    twin = made(device(address=address, options=options), 0)
    twin.step(0, [])
    state = encode(address | EXTENDED, CLOSED)
    assert state.id == address << 5 | 7
    for frame in (CanFrame(state.id & 0x7FF, state.data), CanFrame(state.id, state.data)):
        twin.receive(1, frame)
        assert not twin.axis.armed
    twin.receive(1, state)
    assert twin.axis.armed
    _, frames = twin.step(200 * MILLISECOND, [])
    assert {(raw.id >> 5, raw.extended) for raw in frames if isinstance(raw, CanFrame)} == {(address, True)}


def test_a_standard_axis_does_not_hear_extended_identifiers() -> None:
    stand = Stand()
    stand.run(5)
    stand.handle(encode(1 | EXTENDED, Estop()))
    assert stand.beat().error == 0


def test_what_clears_or_restarts_a_board_reaches_both_axes_and_nothing_else_does() -> None:
    stand = Stand(Settings(other_axis=2)).armed()
    stand.say(IDLE, SetInputVel(9.0, 0.0), node=2)
    assert stand.twin.axis.armed
    stand.twin.trip(Error.ESTOP_REQUESTED)
    stand.say(ClearErrors05(), node=3)
    assert stand.errors()
    stand.say(ClearErrors05(), node=2)
    assert not stand.errors()
    stand.say(SetAxisNodeId(30), node=2)
    stand.twin.trip(Error.ESTOP_REQUESTED)
    stand.say(ClearErrors05(), node=2)
    assert stand.errors()
    stand.say(ClearErrors05(), node=30)
    assert not stand.errors()
    stand.say(CLOSED, SetInputVel(3.0, 0.0))
    stand.say(Reboot05(), node=30)
    assert stand.twin.axis.velocity == 0.0
    assert stand.now < stand.twin.silent_until


def test_the_ear_knows_the_board() -> None:
    pair = [
        device("left", 1, Settings(other_axis=2), V05),
        device("right", 2, Settings(other_axis=1), V05),
        device("other", 3, Settings(), V05),
    ]
    decoder = OdriveDecoder(pair)
    assert list(decoder.decode(0, encode(1, ClearErrors05()))) == [ClearFault("left"), ClearFault("right")]
    assert list(decoder.decode(0, encode(2, Reboot05()))) == [RebootWord("left"), RebootWord("right")]
    assert list(decoder.decode(0, encode(3, ClearErrors05()))) == [ClearFault("other")]


# -- watchdog, reboot ---------------------------------------------------------------------------------

WATCHED = Settings(enable_watchdog=True, watchdog_timeout=0.1)


@pytest.mark.parametrize(
    "frame",
    [
        encode(1, SetInputVel(0.0, 0.0)),
        encode(1, SetPosGain(20.0)),
        CanFrame(0x20, remote=True),
        CanFrame(0x34, remote=True),
        CanFrame(0x28, bytes(3)),
        CanFrame(0x2D, b"\xff" * 8),
    ],
    ids=str,
)
def test_any_frame_to_the_axis_feeds_its_watchdog(frame: CanFrame) -> None:
    stand = Stand(WATCHED).armed()
    for _ in range(6):
        stand.handle(frame)
        stand.run(80)
    assert stand.twin.axis.armed


def test_frames_to_others_do_not_feed_it_and_expiry_is_0x800_and_idle_with_heartbeats_going_on() -> None:
    stand = Stand(WATCHED).armed()
    for _ in range(6):
        stand.say(SetInputVel(0.0, 0.0), node=2)
        stand.handle(encode(1 | EXTENDED, SetInputVel(0.0, 0.0)))
        stand.run(50)
    assert stand.beat() == Heartbeat05(0x800, AxisState.IDLE, 0, 0, 0, 1)
    before = len(stand.reported(0x01))
    stand.run(1000)
    assert len(stand.reported(0x01)) - before == 10


def test_the_watchdog_runs_while_idle_too() -> None:
    stand = Stand(WATCHED)
    stand.run(90)
    assert not stand.errors()
    stand.run(20)
    assert stand.errors() == AxisError.WATCHDOG_TIMER_EXPIRED
    stand.say(ClearErrors05())
    stand.run(90)
    assert not stand.errors()
    stand.run(20)
    assert stand.errors() == AxisError.WATCHDOG_TIMER_EXPIRED


def test_the_watchdog_is_off_by_default_and_due_tells_when_it_expires() -> None:
    stand = Stand().armed()
    stand.run(3000)
    assert stand.twin.axis.armed
    settings = Settings(
        enable_watchdog=True, watchdog_timeout=0.25, heartbeat_msg_rate_ms=0, encoder_msg_rate_ms=0
    )
    stand = Stand(settings)
    stand.run(1)
    assert stand.twin.due() == 250 * MILLISECOND + 1


def test_a_restart_is_silent_and_comes_back_idle_without_saying_that_it_starts() -> None:
    stand = Stand(Settings(reboot_ms=400)).armed()
    stand.say(SetPosGain(5.0), SetInputVel(10.0, 0.0))
    stand.run(300)
    stand.twin.trip(Error.ESTOP_REQUESTED)
    start = stand.now
    stand.say(Reboot05())
    stand.run(1000)
    times = [t for t, _ in stand.frames if t > start]
    assert min(times) >= start + 400 * MILLISECOND
    assert stand.beat() == Heartbeat05(0, AxisState.IDLE, 0, 0, 0, 1)
    assert stand.twin.servo.gains.pos_gain == 20.0
    assert (stand.twin.axis.velocity, stand.twin.axis.armed) == (0.0, False)
