"""Values ↔ bytes, both ways: those of public libraries."""

from __future__ import annotations

import math
from dataclasses import astuple, replace
from typing import Any

import pytest

from protocols import messages as msg
from protocols.cubemars import plugin
from protocols.cubemars.options import Options, Settings
from protocols.cubemars.table import MIT, SERVO, mit_table
from protocols.frames import CanFrame
from protocols.messages import Feedback, Obeyed
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from tests.protocols.helpers import acts

SERVO_MOTOR = Device("m", 1, Options(pole_pairs=21, gear=9.0, torque_constant=0.5), Settings(supply=24.0))
MIT_MOTOR = replace(SERVO_MOTOR, options=Options(mode="mit"))
ERPM = math.tau / 60.0 / 21.0 / 9.0
VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
SENT: dict[str, tuple[str, dict[str, float], Obeyed]] = {
    "servo_set_duty_0.1": ("SET_DUTY", {"value": 0.1}, msg.Velocity("m", 4.8)),
    "servo_set_current_-2.5A": ("SET_CURRENT", {"value": -2.5}, msg.Torque("m", -1.25)),
    "servo_set_brake_1A": ("SET_CURRENT_BRAKE", {"value": 1.0}, msg.Velocity("m", 0.0)),
    "servo_set_erpm_5000": ("SET_RPM", {"value": 5000}, msg.Velocity("m", 5000 * ERPM)),
    "servo_set_pos_180deg": ("SET_POS", {"value": 180.0}, msg.Position("m", math.pi)),
    # Its author sends speed and acceleration without the manual's tenth: in the manual's unit they are these.
    "servo_pos_spd_180deg_5000_30000": (
        "SET_POS_SPD",
        {"value": 180.0, "fastest": 50_000.0, "ramp": 300_000.0},
        msg.Position("m", math.pi),
    ),
    "servo_pos_spd_-90deg_5000erpm_30000": (
        "SET_POS_SPD",
        {"value": -90.0, "fastest": 5000.0, "ramp": 30_000.0},
        msg.Position("m", -math.pi / 2),
    ),
}
"""Message, numbers, and what the motor obeys after it is armed."""
PLAIN = {"enter_motor_mode": "enter", "exit_motor_mode": "exit", "set_zero": "set zero"}
FIVE = {"position": 1.0, "velocity": -2.0, "stiffness": 50.0, "damping": 1.5, "torque": 3.0}
CONTROL = {
    "ak80-6v2_mit_p1_v-2_kp50_kd1.5_t3": ("AK80-6", 0),
    "ak80-9_mit_p1_v-2_kp50_kd1.5_t3": ("AK80-9", 1),
    "ak60-6_mit_p1_v-2_kp50_kd1.5_t3": ("AK60-6", 1),
    "ak45-36_mit_p1_v-2_kp50_kd1.5_t3": ("AK45-36", 1),
}
"""Model, and by how many steps the source differs: this one has 2ⁿ of them, the firmware 2ⁿ − 1."""


def numbers(message: Any) -> list[float]:
    """The numbers of a message, those that are not given as NaN."""
    return [math.nan if value is None else value for value in astuple(message)[1:]]


def frame_of(name: str) -> CanFrame:
    frame = VECTORS[name].frame
    assert isinstance(frame, CanFrame)
    return frame


def test_no_vector_is_left_out() -> None:
    others = {"servo_set_origin_temp", "ak80-6v2_reply6", "servo_status_pos90.5deg_-1200erpm_-2.5A_41C"}
    third = {"v3_mit_p1_v-2_kp50_kd1.5_t3", "v3_set_origin_8_bytes"}
    assert VECTORS.keys() == SENT.keys() | PLAIN.keys() | CONTROL.keys() | others | third


@pytest.mark.parametrize("name", SENT)
def test_set_points_of_servo_mode(name: str) -> None:
    message, values, does = SENT[name]
    frame = frame_of(name)
    assert SERVO.encode(message, 1, **values) == frame
    arms, obeyed = acts(plugin.decoder([SERVO_MOTOR]).decode(0, frame))
    assert arms == msg.Arm("m")
    assert type(obeyed) is type(does)
    assert numbers(obeyed) == pytest.approx(numbers(does))
    for other in (MIT_MOTOR, replace(SERVO_MOTOR, address=2)):
        assert plugin.decoder([other]).decode(0, frame) == []


@pytest.mark.parametrize("name", PLAIN)
def test_words_of_mit_mode(name: str) -> None:
    assert MIT.encode(PLAIN[name], 1) == frame_of(name)


@pytest.mark.parametrize("name", CONTROL)
def test_set_points_of_mit_mode_are_obeyed_once_it_is_entered(name: str) -> None:
    model, steps = CONTROL[name]
    options = replace(MIT_MOTOR.options, model=model)
    device, frame = replace(MIT_MOTOR, options=options), frame_of(name)
    row = options.table.row("control")
    ours = options.table.decode(options.table.encode("control", 1, **FIVE), "to_device")
    theirs = options.table.decode(frame, "to_device")
    assert ours is not None
    assert theirs is not None
    for number, value in ours.values.items():
        assert theirs.values[number] == pytest.approx(value, abs=(steps + 0.01) * row.field(number).step)
    decoder = plugin.decoder([device])
    assert acts(decoder.decode(0, frame)) == []
    assert decoder.decode(0, frame_of("enter_motor_mode")) == [msg.Arm("m"), msg.Torque("m", 0.0)]
    (obeyed,) = decoder.decode(0, frame)
    assert isinstance(obeyed, msg.Impedance)
    assert numbers(obeyed) == pytest.approx(
        [theirs.values[n] for n in ("position", "velocity", "torque", "stiffness", "damping")]
    )
    assert decoder.decode(0, frame_of("set_zero")) == [msg.Zero("m")]
    assert decoder.decode(0, frame_of("exit_motor_mode")) == [msg.Idle("m")]
    assert acts(decoder.decode(0, frame)) == []


def test_set_points_of_firmware_v3() -> None:
    device = replace(MIT_MOTOR, options=Options(mode="mit_v3"))
    frame = frame_of("v3_mit_p1_v-2_kp50_kd1.5_t3")
    assert device.options.table.encode("SET_MIT", 1, **FIVE) == frame
    arms, obeyed = plugin.decoder([device]).decode(0, frame)
    assert (arms, type(obeyed)) == (msg.Arm("m"), msg.Impedance)
    row = device.options.table.row("SET_MIT")
    for number, value in FIVE.items():
        assert getattr(obeyed, number) == pytest.approx(value, abs=1.01 * row.field(number).step)
    assert plugin.decoder([device]).decode(0, frame_of("v3_set_origin_8_bytes")) == [msg.Zero("m")]
    for other in (MIT_MOTOR, SERVO_MOTOR, replace(device, address=2)):
        assert plugin.decoder([other]).decode(0, frame) == []


def test_a_set_point_is_never_a_word() -> None:
    """All numbers at their ends but one step of torque: the torque must not make it "exit"."""
    table = mit_table(12.5, 50.0, 18.0)
    word = table.decode(CanFrame(1, b"\xff" * 8), "to_device")
    assert word is not None
    torque = word.values["torque"] - 2.0 * table.row("control").field("torque").step
    driver = plugin.driver([MIT_MOTOR])
    command = msg.Impedance("m", 12.5, 50.0, torque, 500.0, 5.0)
    driver.send(0, [command])
    driver.receive(1, replace(frame_of("ak80-6v2_reply6"), data=bytes.fromhex("01 8000 8008 00 1e 00")))
    (frame,) = driver.send(2, [command])[1]
    assert frame == CanFrame(1, bytes.fromhex("fffe ffff ffff fffd"))


def test_what_a_motor_reports() -> None:
    name = "servo_status_pos90.5deg_-1200erpm_-2.5A_41C"
    assert SERVO.encode(
        "status", 1, position=90.5, velocity=-1200, current=-2.5, temperature=41, error=0
    ) == frame_of(name)
    events = plugin.driver([SERVO_MOTOR]).receive(0, frame_of(name))
    (feedback,) = [event for event in events if isinstance(event, Feedback)]
    expected = Feedback("m", 0, math.radians(90.5), -1200 * ERPM, -1.25, -2.5, None, 41.0)
    assert numbers(feedback) == pytest.approx(numbers(expected), nan_ok=True)


def test_what_a_motor_replies_with_and_without_temperature_and_error() -> None:
    device = replace(MIT_MOTOR, options=Options(mode="mit", model="AK80-6"))
    six = frame_of("ak80-6v2_reply6")
    for frame, temperature in ((six, None), (replace(six, data=six.data + b"\x1e\x00"), -10.0)):
        events = plugin.driver([device]).receive(0, frame)
        (feedback,) = [event for event in events if isinstance(event, Feedback)]
        # as mini-cheetah-motor-driver-socketcan 0.4.3 decodes it
        measured = 0.4999237048905165, -1.503296703296698, 0.7472527472527464
        assert (feedback.position, feedback.velocity, feedback.torque) == pytest.approx(measured)
        assert feedback.temperature == temperature
