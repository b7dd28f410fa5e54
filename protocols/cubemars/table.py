"""The messages, models and faults of CubeMars AK actuators, of both modes, in the vendor's units.

Sources: TMotorCANControl 1.2.6 (`mit_can.py`, `servo_can.py`); mini-cheetah-motor-driver-socketcan 0.4.3
(`canmotorlib.py`); sam0rr/cubemars_servo_can@c6ac663; AK Series Actuator Driver Manual V1.0.8, §5; of
firmware V3 epicallypowerful 1.0.7 (`cubemars_v3.py`, `motor_data.py`). The five numbers of a set-point are
scaled by the ends of the model's ranges, so each model has a table of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache

from protocols.frames import CanFrame, Frame
from protocols.plugin import FaultInfo
from protocols.toolkit.mit import numbers, words
from protocols.toolkit.table import Direction, Field, Row, Table, const, sint, span, uint

ADDRESSES = range(1, 256)
MODELS: Mapping[str, tuple[float, float, float]] = {
    "AK10-9": (12.5, 50.0, 65.0),
    "AK40-10": (12.5, 45.5, 5.0),
    "AK45-10": (12.5, 20.0, 8.0),
    "AK45-36": (12.5, 6.0, 34.0),
    "AK60-6": (12.5, 45.0, 15.0),
    "AK70-10": (12.5, 50.0, 25.0),
    "AK80-6": (12.5, 76.0, 12.0),
    "AK80-6 V1.0": (95.5, 45.0, 18.0),
    "AK80-6 V1.1": (12.5, 22.5, 12.0),
    "AK80-8": (12.5, 37.5, 32.0),
    "AK80-9": (12.5, 50.0, 18.0),
    "AK80-9 V1.1": (12.5, 22.5, 18.0),
    "AK80-9 V2": (12.5, 25.64, 18.0),
    "AK80-64": (12.5, 8.0, 144.0),
}
"""rad, rad/s and N·m at the ends of the ranges in MIT mode,"""
V3_MODELS: Mapping[str, tuple[float, float, float]] = {
    "AK10-9": (12.56, 28.0, 54.0),
    "AK60-6": (12.56, 60.0, 12.0),
    "AK70-9": (12.56, 30.0, 32.0),
    "AK80-9": (12.56, 65.0, 18.0),
    "AKE60-8": (12.56, 40.0, 15.0),
    "AKE80-8": (12.56, 20.0, 35.0),
}
"""and those of firmware V3."""
REPLY_LENGTH = 8
"""Bytes of a reply; older firmware sends 6, without temperature and error."""
SPECIAL = {"enter": 0xFC, "exit": 0xFD, "set zero": 0xFE}
"""Last byte, after seven of FF."""
SPECIAL_DATA = frozenset(b"\xff" * 7 + bytes((last,)) for last in SPECIAL.values())


@cache
def mit_table(position: float, velocity: float, torque: float) -> Table:
    """Return the messages of MIT mode; the arguments are the ends of its ranges."""
    own = (uint("address", 11),)
    five, measured = numbers(position, velocity, torque)
    reply = (uint("motor"), *measured, span("temperature", 8, -40.0, 215.0, floor=False), uint("error"))
    return Table(
        (
            *words(own, SPECIAL),
            Row("control", own, tuple(five), order="big"),
            Row("reply", (const(0, 11),), reply, "from_device", "big", fewest=6),
        )
    )


STATUS = 0x2900
"""Id of a motor's reports in servo mode, without its address."""


def _servo(name: str, number: int, *fields: Field, direction: Direction = "to_device") -> Row:
    fewest = sum(field.bits for field in fields) // 8  # some hosts pad all they send to 8 bytes
    return Row(
        name, (const(number, 21), uint("address")), fields, direction, "big", fewest=fewest, extended=True
    )


_MOTION = sint("position", 16, 0.1), sint("velocity", 16, 10.0), sint("current", 16, 0.01)
_SERVO = (
    _servo("SET_DUTY", 0, sint("value", 32, 1e-5)),
    _servo("SET_CURRENT", 1, sint("value", 32, 1e-3)),
    _servo("SET_CURRENT_BRAKE", 2, sint("value", 32, 1e-3)),
    _servo("SET_RPM", 3, sint("value", 32)),
    # 1e-6 in older firmware. Never sent here.
    _servo("SET_POS", 4, sint("value", 32, 1e-4)),
    _servo("SET_ORIGIN_HERE", 5, uint("value")),
    _servo("SET_POS_SPD", 6, sint("value", 32, 1e-4), sint("fastest", 16, 10.0), sint("ramp", 16, 10.0)),
    _servo("status", STATUS >> 8, *_MOTION, sint("temperature", 8), uint("error"), direction="from_device"),
)
SERVO = Table(_SERVO)
"""The messages of servo mode: share of the voltage, A, electrical rpm and its change in a second, degrees of
the output shaft."""


@cache
def v3_table(position: float, velocity: float, torque: float) -> Table:
    """Return the messages of firmware V3: those of servo mode, and set-points of five numbers."""
    (where, speed, *gains, push), _ = numbers(position, velocity, torque)
    return Table((*_SERVO, _servo("SET_MIT", 8, *gains, where, speed, push)))


SENT = frozenset({"SET_CURRENT", "SET_RPM"})
"""Set-points that are sent here, beside SET_POS_SPD."""
MIT, V3 = mit_table(*MODELS["AK80-9"]), v3_table(*V3_MODELS["AK80-9"])
"""For what is the same in all models."""
DEGREE = math.pi / 180.0
MAX_ERPM, LAST_DEGREES = 100_000.0, 3200.0
"""The largest of SET_RPM, and the ends of a reported position, by the manual."""
LAST_ERPM = 327_660.0
"""The largest reported velocity: a larger one may be cut off."""


def names(frame: Frame) -> tuple[str, ...]:
    """Return the names of the messages to a device in a frame, as `Plugin.messages` does."""
    return (V3 if isinstance(frame, CanFrame) and frame.extended else MIT).names(frame)


def asks(frame: Frame) -> bool:
    """Return whether a frame changes nothing, for a host that is the only one."""
    return names(frame) == ("exit",)


def _info(name: str, cause: str, remedy: str) -> FaultInfo:
    return FaultInfo(name, cause, remedy, latching=False)


UNKNOWN = 0xFF
FAULTS: Mapping[int, FaultInfo] = {
    1: _info("over temperature", "too much torque for too long", "let it cool; lower the torque"),
    2: _info("over-current", "a blocked shaft, or a shorted phase", "free it, check the phases"),
    3: _info("over-voltage", "braking feeds back more than the supply takes", "brake more slowly"),
    4: _info("under-voltage", "the supply sags or is off", "check supply and cables"),
    5: _info("encoder", "its magnet, cable or calibration", "calibrate it with the vendor's tool"),
    6: _info(
        "phase unbalance", "a damaged phase; in later firmware a hot MOSFET", "let it cool, check the phases"
    ),
    7: _info("stall", "the shaft is blocked", "free it, lower the torque"),
    UNKNOWN: _info("unknown fault", "it is of later firmware", "read it with the vendor's tool"),
}
"""By the code that is reported. Which firmware has which is uncertain for 6 and 7."""
DUPLICATE = 0x100
"""A fault that the driver finds."""
ALL_FAULTS: Mapping[int, FaultInfo] = {
    **FAULTS,
    DUPLICATE: FaultInfo("duplicate address", "two motors report with one id", "change one of them"),
}
