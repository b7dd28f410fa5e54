"""Values ↔ bytes, both ways: the examples of the vendor's manual."""

from __future__ import annotations

import math
from dataclasses import astuple
from typing import Any

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import Feedback, Obeyed
from protocols.myactuator import plugin
from protocols.myactuator.options import Options, Settings
from protocols.myactuator.table import ANY
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from tests.protocols.helpers import acts

DEVICE = Device("left", 1, Options(torque_constant=2.0), Settings())
VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
TURN = 2.0 * math.pi
MOTION = {"position": 10.0, "velocity": 1.0, "torque": 10.0, "stiffness": 10.0, "damping": 1.0}
SENT: dict[str, tuple[str, dict[str, Any], Obeyed | None]] = {
    "shutdown": ("shutdown", {}, msg.Idle("left")),
    "stop": ("stop", {}, msg.Hold("left")),
    "torque_1A": ("torque", {"value": 1.0}, msg.Torque("left", 2.0)),
    "torque_-1A": ("torque", {"value": -1.0}, msg.Torque("left", -2.0)),
    "speed_100dps": ("speed", {"value": 100.0}, msg.Velocity("left", math.radians(100.0))),
    "speed_-100dps": ("speed", {"value": -100.0}, msg.Velocity("left", -math.radians(100.0))),
    "position_360deg_500dps": ("position", {"fastest": 500, "position": 360.0}, msg.Position("left", TURN)),
    "position_-360deg_500dps": (
        "position",
        {"fastest": 500, "position": -360.0},
        msg.Position("left", -TURN),
    ),
    "single_turn_360deg_counterclockwise": (
        "single turn",
        {"direction": 1, "fastest": 500, "position": 360.0},
        msg.Position("left", TURN),
    ),
    "increment_-360deg": ("increment", {"fastest": 500, "position": -360.0}, msg.Position("left", -TURN)),
    "reset": ("reset", {}, msg.ClearFault("left")),
    "release_brake": ("release brake", {}, None),
    "lock_brake": ("lock brake", {}, None),
    "set_timeout_1000ms": ("set timeout", {"value": 1000}, None),
    **{
        f"read_{name}": (f"read {name.replace('s_', 's ')}", {}, None)
        for name in ("angle", "status_1", "status_2", "runtime", "version")
    },
}
"""Message, numbers, and what the motor obeys."""
STATUS = {"temperature": 50, "current": 1.0, "velocity": 500, "angle": 45}
NEGATIVE = {"temperature": 50, "current": -1.0, "velocity": -500, "angle": -45}
MOVING = Feedback("left", 0, None, math.radians(500.0), 2.0, 1.0, temperature=50.0)
BACKWARDS = Feedback("left", 0, None, -math.radians(500.0), -2.0, -1.0, temperature=50.0)
REPORTED: dict[str, tuple[str, dict[str, float], Feedback | None]] = {
    **{f"{n}_reply": (f"{n} reply", STATUS, MOVING) for n in ("torque", "speed", "position", "increment")},
    **{
        f"{n}_reply_negative": (f"{n} reply", NEGATIVE, BACKWARDS)
        for n in ("torque", "speed", "position", "increment")
    },
    "single_turn_reply": ("single turn reply", {**STATUS, "angle": 1000}, MOVING),  # of the encoder
    "shutdown_reply": ("shutdown reply", {}, None),
    "angle_360deg": ("angle", {"position": 360.0}, Feedback("left", 0, TURN)),
    "status_1_low_voltage": (
        "status 1",
        {"temperature": 50, "released": 1, "voltage": 48.5, "errors": 4},
        Feedback("left", 0, voltage=48.5, temperature=50.0),
    ),
    "status_2": ("status 2", STATUS, MOVING),
    "runtime": ("runtime", {"ms": 268435456}, None),
    "version_20220206": ("version", {"date": 20220206}, None),
    "set_timeout_reply_off": ("set timeout reply", {"value": 0}, None),
}


def numbers(message: object) -> list[float]:
    """The numbers of a message, those that are not given as NaN."""
    return [math.nan if value is None else value for value in astuple(message)[1:]]  # type: ignore[call-overload]


def test_no_vector_is_left_out() -> None:
    assert VECTORS.keys() == SENT.keys() | REPORTED.keys() | {"motion_10rad", "motion_reply"}


@pytest.mark.parametrize("name", SENT)
def test_what_a_host_sends_and_a_motor_obeys(name: str) -> None:
    message, values, does = SENT[name]
    frame = VECTORS[name].frame
    assert isinstance(frame, CanFrame)
    assert ANY.encode(message, 1, **values) == frame
    obeyed = acts(plugin.decoder([DEVICE]).decode(0, frame))
    moves = isinstance(does, msg.Hold | msg.Torque | msg.Velocity | msg.Position)
    assert isinstance(obeyed[0], msg.Arm) if moves else not any(isinstance(one, msg.Arm) for one in obeyed)
    assert type(obeyed[-1]) is type(does) if does else not obeyed
    assert numbers(obeyed[-1]) == pytest.approx(numbers(does)) if does else True
    assert plugin.decoder([Device("left", 2, Options(), Settings())]).decode(0, frame) == []


@pytest.mark.parametrize("name", REPORTED)
def test_what_a_motor_reports(name: str) -> None:
    message, values, feedback = REPORTED[name]
    frame = VECTORS[name].frame
    assert ANY.encode(message, 1, **values) == frame
    events = plugin.driver([DEVICE]).receive(0, frame)
    reported = [numbers(event) for event in events if isinstance(event, Feedback)]
    assert len(reported) == (feedback is not None)
    for each in reported:
        assert each == pytest.approx(numbers(feedback), nan_ok=True)


@pytest.mark.parametrize(
    ("name", "direction"), [("motion_10rad", "to_device"), ("motion_reply", "from_device")]
)
def test_the_motion_mode(name: str, direction: Any) -> None:
    """The manual's numbers are rounded up and down: each is within a step and a half."""
    frame = VECTORS[name].frame
    decoded = ANY.decode(frame, direction)
    assert decoded is not None
    values = {key: value for key, value in decoded.values.items() if key in MOTION}
    assert len(values) == (5 if direction == "to_device" else 3)
    for key, value in values.items():
        row = ANY.row(decoded.name)
        assert value == pytest.approx(MOTION[key], abs=1.5 * row.field(key).step)
    assert ANY.encode(decoded.name, 1, **decoded.values) == frame
