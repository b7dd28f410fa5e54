"""The twin of 0.5.x alone: the firmware's behaviour, point by point, as in the table of the plugin's
README."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from protocols.frames import CanFrame
from protocols.messages import MILLISECOND
from protocols.odrive_can import errors, table
from protocols.odrive_can.options import Settings
from tests.protocols.odrive_can.helpers import (
    AXIS,
    CLOSED,
    CONTROLLER,
    IDLE,
    MOTOR,
    V05,
    TwinRig,
    encode,
    fields,
    to,
)


def beat05(error: int, state: int, motor: int, encoder: int, controller: int, done: int) -> dict[str, int]:
    return fields("Heartbeat", error, state, motor, encoder, controller, done, line="0.5")


def rig05(settings: Settings | None = None) -> TwinRig:
    return TwinRig(settings, V05)


# -- states and errors --------------------------------------------------------------------------------


def test_closed_loop_and_idle_are_reported_without_a_result() -> None:
    rig = rig05().armed()
    assert rig.heartbeat() == beat05(0, table.CLOSED_LOOP, 0, 0, 0, 1)
    rig.send(IDLE)
    assert rig.heartbeat() == beat05(0, table.IDLE, 0, 0, 0, 1)


@pytest.mark.parametrize("state", [5, 14, 42, 0xFFFFFFFF])
def test_an_illegal_state_is_invalid_state_and_idle_and_the_next_request_clears_it(state: int) -> None:
    rig = rig05().armed()
    rig.send(to("Set_Axis_State", state))
    beat = rig.heartbeat()
    assert (beat["Axis_Error"], beat["Axis_State"]) == (AXIS["INVALID_STATE"], table.IDLE)
    rig.send(IDLE)
    assert rig.heartbeat()["Axis_Error"] == 0
    rig.send(to("Set_Axis_State", state), CLOSED)
    assert rig.heartbeat() == beat05(0, table.CLOSED_LOOP, 0, 0, 0, 1)


def test_an_uncalibrated_axis_reports_invalid_state() -> None:
    rig = rig05(Settings(calibrated=False))
    rig.run(5)
    rig.send(CLOSED)
    beat = rig.heartbeat()
    assert (beat["Axis_Error"], beat["Axis_State"]) == (AXIS["INVALID_STATE"], table.IDLE)


def test_homing_without_end_stop_and_state_zero_and_start_up() -> None:
    rig = rig05().armed()
    rig.send(to("Set_Axis_State", 0))
    assert rig.heartbeat()["Axis_State"] == table.CLOSED_LOOP
    rig.send(to("Set_Axis_State", table.STARTUP))
    assert (rig.heartbeat()["Axis_Error"], rig.heartbeat()["Axis_State"]) == (0, table.IDLE)
    rig.send(to("Set_Axis_State", table.HOMING))
    assert rig.heartbeat()["Axis_Error"] == AXIS["HOMING_WITHOUT_ENDSTOP"]


def test_an_axis_with_errors_does_not_stay_armed_until_cleared() -> None:
    rig = rig05().armed()
    rig.send(to("Estop"))
    assert rig.heartbeat() == beat05(AXIS["ESTOP_REQUESTED"], table.IDLE, 0, 0, 0, 1)
    rig.send(CLOSED)
    assert rig.heartbeat()["Axis_State"] == table.IDLE
    rig.send(to("Clear_Errors (0.5.x)"), CLOSED)
    assert rig.heartbeat()["Axis_State"] == table.CLOSED_LOOP


@pytest.mark.parametrize(
    ("trip", "name"),
    [
        ("VELOCITY_LIMIT_VIOLATION", "OVERSPEED"),
        ("SPINOUT_DETECTED", "SPINOUT_DETECTED"),
        ("CURRENT_LIMIT_VIOLATION", "CURRENT_LIMIT_VIOLATION"),
        ("MOTOR_OVER_TEMP", "MOTOR_THERMISTOR_OVER_TEMP"),
        ("INVERTER_OVER_TEMP", "FET_THERMISTOR_OVER_TEMP"),
        ("DC_BUS_UNDER_VOLTAGE", "SYSTEM_LEVEL"),
    ],
)
def test_errors_are_in_the_word_of_their_component(trip: str, name: str) -> None:
    rig = rig05().armed()
    rig.twin.trip(rig.twin.raised[trip])
    motor, controller = MOTOR.get(name, 0), CONTROLLER.get(name, 0)
    axis = AXIS["MOTOR_FAILED" if motor else "CONTROLLER_FAILED"]
    assert rig.heartbeat() == beat05(axis, table.IDLE, int(motor > 0), 0, int(controller > 0), 1)
    assert rig.reply(0x03) == fields("Get_Motor_Error", motor, line="0.5")
    assert rig.reply(0x1D) == fields("Get_Controller_Error", controller, line="0.5")
    rig.send(to("Clear_Errors (0.5.x)"))
    assert rig.heartbeat() == beat05(0, table.IDLE, 0, 0, 0, 1)


def test_errors_of_the_servo_trip_it_too() -> None:
    rig = rig05(Settings(vel_limit=5.0)).armed()
    rig.shaft.load = 1.5
    rig.run(500)
    assert rig.twin.word(errors.CONTROLLER) == CONTROLLER["OVERSPEED"]
    assert not rig.twin.memory.armed
    rig = rig05(Settings(bus_voltage=9.0))
    rig.run(5)
    assert rig.twin.word(errors.MOTOR) == MOTOR["SYSTEM_LEVEL"]


# -- messages -----------------------------------------------------------------------------------------


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
    rig = rig05(settings)
    rig.run(999)
    for cmd, period in (periods | {0x15: 500}).items():
        times = [t for t, _ in rig.sent(cmd)]
        assert len(times) == 1000 // period, cmd
        assert {b - a for a, b in pairwise(times)} <= {period * MILLISECOND}
    assert rig.sent(0x00) == []


@pytest.mark.parametrize("cmd", [0x00, 0x01])
def test_get_version_and_the_heartbeat_are_not_sent_on_request(cmd: int) -> None:
    rig = rig05(Settings(heartbeat_msg_rate_ms=0, encoder_msg_rate_ms=0))
    rig.run(5)
    assert rig.reply(cmd) is None
    assert rig.frames == []


def test_the_controller_s_error_is_sent_for_any_frame_of_its_number() -> None:
    rig = rig05()
    assert rig.reply(0x1D, CanFrame(0x3D, bytes(8))) == fields("Get_Controller_Error", 0, line="0.5")


def test_an_adc_s_voltage_is_sent_for_a_gpio_that_exists() -> None:
    rig = rig05()
    assert rig.reply(0x1C, encode(1, to("Ask_ADC_Voltage", 3))) == fields("Get_ADC_Voltage", 0.0, line="0.5")
    assert rig.reply(0x1C) == fields("Get_ADC_Voltage", 0.0, line="0.5")
    assert rig.reply(0x1C, encode(1, to("Ask_ADC_Voltage", 17))) is None


def test_counts_are_signed_and_wrap_and_are_set() -> None:
    rig = rig05(Settings(encoder_cpr=8192))
    rig.shaft.position = -1.25 * math.tau
    rig.run(5)
    assert rig.reply(0x0A) == fields("Get_Encoder_Count", -10240, 6144, line="0.5")
    rig.send(to("Set_Linear_Count", -5))
    assert rig.reply(0x0A) == fields("Get_Encoder_Count", -5, 6144, line="0.5")
    reported = rig.reply(0x09)
    assert reported is not None
    assert reported["Pos_Estimate"] == pytest.approx(-5 / 8192, abs=1e-7)
    rig.send(to("Set_Linear_Count", 2**31 - 1))
    rig.shaft.position = -1.0 * math.tau
    rig.run(5)
    assert rig.reply(0x0A) == fields("Get_Encoder_Count", -(2**31) + 2047, 0, line="0.5")


# -- addresses and boards -----------------------------------------------------------------------------


def test_what_clears_or_restarts_a_board_reaches_both_axes() -> None:
    rig = rig05(Settings(other_axis=2)).armed()
    rig.send(to("Set_Input_Vel", 3.0, 0.0), to("Set_Axis_Node_ID", 30))
    rig.send(to("Set_Axis_Node_ID", 31), node=2)
    rig.twin.trip(rig.twin.raised["ESTOP_REQUESTED"])
    rig.send(to("Clear_Errors (0.5.x)"), node=2)
    assert rig.twin.word(errors.AXIS)
    rig.send(to("Clear_Errors (0.5.x)"), node=31)
    assert not rig.twin.word(errors.AXIS)
    rig.send(to("Reboot (0.5.x)"), node=31)
    assert (rig.twin.memory.velocity, rig.twin.memory.node) == (0.0, 1)
    assert rig.now < rig.twin.silent_until


# -- watchdog, reboot ---------------------------------------------------------------------------------

WATCHED = Settings(enable_watchdog=True, watchdog_timeout=0.1)


@pytest.mark.parametrize(
    "frame",
    [
        encode(1, to("Set_Input_Vel", 0.0, 0.0)),
        encode(1, to("Set_Pos_Gain", 20.0)),
        CanFrame(0x20, remote=True),
        CanFrame(0x34, remote=True),
        CanFrame(0x28, bytes(3)),
        CanFrame(0x2F, b"\xff" * 8),
    ],
    ids=str,
)
def test_any_frame_to_the_axis_feeds_its_watchdog(frame: CanFrame) -> None:
    rig = rig05(WATCHED).armed()
    for _ in range(6):
        rig.receive(frame)
        rig.run(80)
    assert rig.twin.memory.armed


def test_frames_to_others_do_not_feed_it_and_expiry_is_0x800_and_idle_with_heartbeats_going_on() -> None:
    rig = rig05(WATCHED).armed()
    for _ in range(6):
        rig.send(to("Set_Input_Vel", 0.0, 0.0), node=2)
        rig.receive(encode(1, to("Set_Input_Vel", 0.0, 0.0), extended=True))
        rig.run(50)
    assert rig.heartbeat() == beat05(0x800, table.IDLE, 0, 0, 0, 1)
    before = len(rig.sent(0x01))
    rig.run(1000)
    assert len(rig.sent(0x01)) - before == 10


def test_the_watchdog_runs_while_idle_too() -> None:
    rig = rig05(WATCHED)
    rig.run(90)
    assert not rig.twin.word(errors.AXIS)
    rig.run(20)
    assert rig.twin.word(errors.AXIS) == AXIS["WATCHDOG_TIMER_EXPIRED"]
    rig.send(to("Clear_Errors (0.5.x)"))
    rig.run(90)
    assert not rig.twin.word(errors.AXIS)
    rig.run(20)
    assert rig.twin.word(errors.AXIS) == AXIS["WATCHDOG_TIMER_EXPIRED"]
