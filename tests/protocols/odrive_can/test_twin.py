"""The twin of 0.6.x alone: the firmware's behaviour, point by point, as in the table of the plugin's
README."""

from __future__ import annotations

import math
import struct
from typing import Literal

import pytest

from protocols.frames import CanFrame
from protocols.messages import MILLISECOND
from protocols.odrive_can import table
from protocols.odrive_can.options import Options, Settings
from protocols.odrive_can.table import BROADCAST, ControlMode, InputMode
from tests.protocols.odrive_can.helpers import (
    CLOSED,
    ERROR,
    V05,
    Message,
    TwinRig,
    encode,
    fields,
    to,
)

# -- states -------------------------------------------------------------------------------------------


def test_arming_shows_closed_loop_and_busy() -> None:
    assert TwinRig().armed().outcome() == (0, table.CLOSED_LOOP, "BUSY")


@pytest.mark.parametrize(
    ("state", "result"),
    [
        (table.HOMING, "HOMING_WITHOUT_ENDSTOP"),
        (5, "INVALID_STATE"),
        (99, "INVALID_STATE"),
        (0xFFFFFFFF, "INVALID_STATE"),
    ],
)
def test_a_state_that_is_not_possible_leaves_the_axis_idle(state: int, result: str) -> None:
    rig = TwinRig().armed()
    rig.send(to("Set_Axis_State", state))
    assert rig.outcome() == (0, table.IDLE, result)


def test_an_uncalibrated_axis_does_not_arm() -> None:
    rig = TwinRig(Settings(calibrated=False))
    rig.send(CLOSED)
    assert rig.outcome() == (0, table.IDLE, "NOT_CALIBRATED")


def test_an_axis_in_fault_does_not_arm_until_cleared() -> None:
    rig = TwinRig().armed()
    rig.send(to("Estop"))
    assert rig.outcome() == (ERROR["ESTOP_REQUESTED"], table.IDLE, "DISARMED")
    rig.send(CLOSED)
    assert rig.heartbeat()["Axis_State"] == table.IDLE
    assert rig.reply(0x03) == fields("Get_Error", ERROR["ESTOP_REQUESTED"], ERROR["ESTOP_REQUESTED"])
    rig.send(to("Clear_Errors", 0))
    assert rig.reply(0x03) == fields("Get_Error", 0, 0)
    rig.send(CLOSED)
    assert rig.outcome() == (0, table.CLOSED_LOOP, "BUSY")


# -- messages -----------------------------------------------------------------------------------------


REQUESTABLE = {
    "0.5": (0x03, 0x04, 0x05, 0x09, 0x0A, 0x14, 0x15, 0x17, 0x1D),
    "0.6": (0x00, 0x01, 0x03, 0x06, 0x09, 0x14, 0x15, 0x17, 0x1C, 0x1D),
}


@pytest.mark.parametrize("remote", [True, False], ids=["RTR", "DLC 0"])
@pytest.mark.parametrize(("line", "cmd"), [(line, cmd) for line in REQUESTABLE for cmd in REQUESTABLE[line]])
def test_every_message_is_sent_on_request(line: Literal["0.5", "0.6"], cmd: int, remote: bool) -> None:
    silent = Settings(heartbeat_msg_rate_ms=0, encoder_msg_rate_ms=0)
    rig = TwinRig(silent, Options(firmware=line))
    assert rig.reply(cmd, CanFrame(0x20 | cmd, remote=remote))
    ((_, frame),) = rig.frames
    assert (frame.id, len(frame.data)) == (0x20 | cmd, 8)


# -- discovery ----------------------------------------------------------------------------------------


def test_discovery_is_answered_on_its_own_node_id() -> None:
    rig = TwinRig(Settings(serial_number=0x0102030405))
    rig.run(1)
    rig.frames.clear()
    rig.receive(CanFrame(0x7E6, remote=True))
    rig.run(1)
    answers = [f for _, f in rig.frames if f.id == 0x26]
    assert [f.data.hex() for f in answers] == ["01" + "0504030201" + "00" + "00"]


# -- watchdog, reboot ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("message", "feeds"),
    [
        (to("Set_Input_Vel", 1.0, 0.0), True),
        (to("Set_Input_Pos", 1.0, 0.0, 0.0), True),
        (to("Set_Input_Torque", 0.0), True),
        (CLOSED, True),
        (to("Set_Pos_Gain", 20.0), False),
    ],
)
def test_the_watchdog_is_fed_by_setpoints_and_state_requests(message: Message, feeds: bool) -> None:
    rig = TwinRig(Settings(enable_watchdog=True, watchdog_timeout=0.1)).armed()
    for _ in range(6):
        rig.send(message)
        rig.run(50)
    assert rig.twin.memory.armed == feeds
    assert (rig.twin.active() == ERROR["WATCHDOG_TIMER_EXPIRED"]) != feeds


def test_a_reboot_is_silent_then_initializing_and_knows_its_position_within_a_turn() -> None:
    rig = TwinRig(Settings(reboot_ms=400, initializing_ms=200)).armed()
    rig.send(to("Set_Input_Vel", 10.0, 0.0))
    rig.run(500)
    start = rig.now
    rig.send(to("Reboot", 0))
    rig.run(1000)
    assert not [t for t, _ in rig.frames if start < t < start + 400 * MILLISECOND]
    errors = [rig.decoded(f)["Axis_Error"] for t, f in rig.frames if f.id == 0x21 and t > start]
    assert errors[:2] == [ERROR["INITIALIZING"], ERROR["INITIALIZING"]]
    assert errors[-1] == 0
    assert not rig.twin.memory.armed
    assert rig.twin.servo.encoder.offset >= 3


def test_a_broadcast_reboots_and_an_erased_device_has_no_node_id() -> None:
    rig = TwinRig()
    rig.run(10)
    rig.send(to("Reboot", 2), node=BROADCAST)
    rig.run(2000)
    assert rig.twin.memory.node == BROADCAST


# -- loops --------------------------------------------------------------------------------------------


def test_the_default_gains_track_velocity_of_a_geared_wheel() -> None:
    rig = TwinRig().armed()
    rig.send(to("Set_Input_Vel", 15.0, 0.0))
    rig.run(60)
    assert rig.shaft.velocity == pytest.approx(15.0 * math.tau, rel=0.06)
    rig.run(1000)
    assert rig.shaft.velocity == pytest.approx(15.0 * math.tau, rel=0.005)


def test_a_load_is_integrated_away() -> None:
    rig = TwinRig().armed()
    rig.shaft.load = -0.2
    rig.send(to("Set_Input_Vel", 5.0, 0.0))
    rig.run(4000)
    assert rig.shaft.velocity == pytest.approx(5.0 * math.tau, rel=0.02)


def test_torque_is_limited_by_the_current_limit_and_the_torque_constant() -> None:
    rig = TwinRig().armed(ControlMode.TORQUE)
    rig.shaft.locked = True
    rig.send(to("Set_Input_Torque", 5.0))
    rig.run(50)
    limit = 30.0 * 8.27 / 270
    assert rig.twin.servo.stage.torque == pytest.approx(limit, rel=1e-6)
    rig.send(to("Set_Limits", 40.0, 10.0))
    rig.run(50)
    assert rig.twin.servo.stage.current == pytest.approx(10.0, rel=1e-6)


def test_a_stalled_motor_pulls_with_its_limit_and_the_integrator_does_not_wind_up() -> None:
    rig = TwinRig().armed()
    rig.shaft.locked = True
    rig.send(to("Set_Input_Vel", 20.0, 0.0))
    rig.run(1000)
    assert rig.twin.servo.stage.current == pytest.approx(30.0, rel=1e-3)
    assert abs(rig.twin.servo.integrator) < 0.01


def test_velocity_is_clipped_to_its_limit_in_position_and_torque_control() -> None:
    rig = TwinRig(Settings(vel_limit=5.0)).armed(ControlMode.POSITION)
    rig.send(to("Set_Input_Pos", 50.0, 0.0, 0.0))
    rig.run(1500)
    assert (rig.shaft.velocity / math.tau) == pytest.approx(5.0, abs=0.1)
    rig = TwinRig(Settings(vel_limit=5.0)).armed(ControlMode.TORQUE)
    rig.send(to("Set_Input_Torque", 0.3))
    rig.run(2000)
    assert (rig.shaft.velocity / math.tau) <= 5.05
    assert rig.twin.memory.armed


def test_ramps_of_velocity_and_torque_and_the_end_of_a_trajectory() -> None:
    rig = TwinRig().armed(ControlMode.VELOCITY, InputMode.VEL_RAMP)
    rig.send(to("Set_Input_Vel", 10.0, 0.0))
    rig.run(500)
    assert (rig.shaft.velocity / math.tau) == pytest.approx(5.0, abs=0.3)

    rig = TwinRig().armed(ControlMode.POSITION, InputMode.TRAP_TRAJ)
    rig.send(to("Set_Input_Pos", 6.0, 0.0, 0.0))
    rig.run(500)
    assert rig.heartbeat()["Trajectory_Done_Flag"] == 0
    rig.run(1500)
    assert rig.heartbeat()["Trajectory_Done_Flag"] == 1

    rig = TwinRig().armed(ControlMode.TORQUE, InputMode.TORQUE_RAMP)
    rig.shaft.locked = True
    rig.send(to("Set_Input_Torque", 0.5))
    rig.run(200)
    assert rig.twin.servo.stage.torque == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize(
    ("options", "error"),
    [(Options(), ERROR["BAD_CONFIG"]), (V05, 0)],
    ids=["0.6", "0.5"],
)
def test_inputs_that_are_no_numbers_and_modes_that_there_are_not_disarm(options: Options, error: int) -> None:
    nan = math.nan
    frames = [
        ("MODULATION_IS_NAN", CanFrame(0x2D, struct.pack("<ff", 1.0, nan))),
        ("MODULATION_IS_NAN", CanFrame(0x2D, struct.pack("<f", nan))),
        ("INVALID_INPUT_MODE", encode(1, to("Set_Controller_Mode", 2, 4))),
        ("INVALID_MIRROR_AXIS", encode(1, to("Set_Controller_Mode", 2, 7))),
    ]
    for name, frame in frames:
        rig = TwinRig(options=options).armed()
        rig.receive(frame)
        assert rig.twin.memory.armed is False
        assert rig.twin.raised[name] in rig.twin.faults
        word = rig.twin.raised[name] >> 48
        assert rig.twin.words[word << 48] == rig.twin.raised[name] - (word << 48)
        if error:
            assert rig.outcome() == (error, table.IDLE, "DISARMED")
            rig.send(to("Clear_Errors", 0), CLOSED)  # the input is still the same
            assert rig.outcome()[1] == table.IDLE


def test_an_input_that_is_no_number_waits_until_it_is_used_and_an_infinite_one_is_limited() -> None:
    rig = TwinRig(Settings(vel_limit=5.0))
    rig.receive(CanFrame(0x2D, struct.pack("<ff", math.nan, 0.0)))
    assert rig.outcome() == (0, table.IDLE, "SUCCESS")
    rig.send(CLOSED)
    assert rig.outcome() == (ERROR["BAD_CONFIG"], table.IDLE, "DISARMED")
    rig.receive(CanFrame(0x2D, struct.pack("<ff", -math.inf, 0.0)))
    rig.send(to("Clear_Errors", 0), CLOSED)
    rig.run(1000)
    assert rig.shaft.velocity / math.tau == pytest.approx(-5.0, abs=0.1)


@pytest.mark.parametrize("control_mode", [ControlMode.POSITION, 4, 0xFFFFFFFF])
def test_position_control_again_takes_the_present_position(control_mode: int) -> None:
    rig = TwinRig().armed(control_mode)
    rig.send(to("Set_Input_Pos", 3.0, 0.0, 0.0))
    rig.run(40)
    stopped = rig.shaft.position
    assert stopped > 0.1
    rig.send(to("Set_Controller_Mode", control_mode, InputMode.PASSTHROUGH))
    rig.run(1500)
    assert rig.shaft.position == pytest.approx(stopped, abs=1.0)
    assert rig.shaft.velocity == pytest.approx(0.0, abs=0.1)


def test_voltage_control_is_torque_control_and_tuning_without_amplitude_passes_through() -> None:
    rig = TwinRig().armed(ControlMode.VOLTAGE, InputMode.TUNING)
    rig.shaft.locked = True
    rig.send(to("Set_Input_Torque", 0.2))
    rig.run(50)
    assert rig.twin.servo.stage.torque == pytest.approx(0.2, abs=0.001)


def test_an_inactive_input_is_not_followed() -> None:
    rig = TwinRig().armed(ControlMode.VELOCITY, InputMode.INACTIVE)
    rig.send(to("Set_Input_Vel", 10.0, 0.0))
    rig.run(300)
    assert rig.shaft.velocity == pytest.approx(0.0, abs=0.01)


def test_the_encoder_counts() -> None:
    rig = TwinRig(Settings(encoder_cpr=100))
    rig.shaft.position = 0.1234 * math.tau
    rig.run(5)
    assert rig.twin.servo.encoder.position == pytest.approx(0.12)


# -- power and heat -----------------------------------------------------------------------------------


def test_the_supply_sags_with_power_and_rises_with_braking() -> None:
    rig = TwinRig().armed()
    rig.shaft.load = -0.5
    rig.send(to("Set_Input_Vel", 20.0, 0.0))
    rig.run(3000)
    power, supply, torques = (rig.reply(cmd) for cmd in (0x1D, 0x17, 0x1C))
    assert power["Mechanical_Power"] == pytest.approx(0.51 * 20.0 * math.tau, rel=0.05)
    assert power["Electrical_Power"] > power["Mechanical_Power"]
    assert supply["Bus_Current"] == pytest.approx(power["Electrical_Power"] / supply["Bus_Voltage"], rel=0.01)
    assert supply["Bus_Voltage"] == pytest.approx(24.0 - 0.05 * supply["Bus_Current"], rel=1e-4)
    assert torques["Torque_Estimate"] == pytest.approx(torques["Torque_Target"], rel=0.02)
    rig.shaft.load = 0.5
    rig.run(500)
    braking = rig.reply(0x17)
    assert braking["Bus_Current"] < 0 < braking["Bus_Voltage"] - 24.0


@pytest.mark.parametrize(
    ("settings", "load", "error"),
    [
        (Settings(bus_voltage=10.0), 0.0, ERROR["DC_BUS_UNDER_VOLTAGE"]),
        (Settings(bus_voltage=60.0), 0.0, ERROR["DC_BUS_OVER_VOLTAGE"]),
        (Settings(dc_max_positive_current=1.0), -0.5, ERROR["DC_BUS_OVER_CURRENT"]),
        (Settings(dc_max_negative_current=-0.5), 0.5, ERROR["DC_BUS_OVER_REGEN_CURRENT"]),
        (Settings(current_hard_max=5.0), -0.5, ERROR["CURRENT_LIMIT_VIOLATION"]),
        (Settings(ambient=106.0), 0.0, ERROR["MOTOR_OVER_TEMP"] | ERROR["INVERTER_OVER_TEMP"]),
    ],
)
def test_limits_of_the_supply_and_of_the_motor_trip(settings: Settings, load: float, error: int) -> None:
    rig = TwinRig(settings)
    rig.run(5)
    rig.send(to("Set_Controller_Mode", ControlMode.VELOCITY, 1), to("Set_Input_Vel", 15.0, 0.0), CLOSED)
    rig.shaft.velocity = 15.0 * math.tau
    rig.shaft.load = load
    rig.run(400)
    assert rig.twin.active() == error
    assert not rig.twin.memory.armed


def test_a_hot_motor_gets_less_current() -> None:
    rig = TwinRig(Settings(ambient=90.0, fet_temp_limit_lower=120.0, fet_temp_limit_upper=130.0))
    rig.armed(ControlMode.TORQUE)
    rig.shaft.locked = True
    rig.send(to("Set_Input_Torque", 5.0))
    rig.run(20)
    assert rig.twin.servo.stage.current == pytest.approx(15.0, rel=0.01)


def test_a_loaded_motor_warms_up() -> None:
    rig = TwinRig(Settings(motor_thermal_capacity=0.5)).armed(ControlMode.TORQUE)
    rig.shaft.locked = True
    rig.send(to("Set_Input_Torque", 0.3))
    rig.run(8000)
    warm = rig.reply(0x15)
    loss = 1.5 * (0.3 * 270 / 8.27) ** 2 * 0.05
    assert warm["Motor_Temperature"] == pytest.approx(25.0 + 2.0 * loss, rel=0.01)
    assert 25.0 < warm["FET_Temperature"] < warm["Motor_Temperature"]


def test_a_slipping_encoder_is_a_spinout() -> None:
    settings = Settings(spinout_electrical_power_threshold=10.0, spinout_mechanical_power_threshold=-10.0)
    rig = TwinRig(settings).armed()
    rig.send(to("Set_Input_Vel", 10.0, 0.0))
    for _ in range(400):  # the encoder runs backwards although the motor pulls forwards
        rig.shaft.velocity = -4.0 * math.tau
        rig.run(1)
    assert rig.twin.active() == ERROR["SPINOUT_DETECTED"]


# -- the twin as data -----------------------------------------------------------------------------------
