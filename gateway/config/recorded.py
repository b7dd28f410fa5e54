"""The robot file of a recording: a body and the table [bag], with no bus, motor or sensor of its own.

Rules. Such a file says how another robot's recording is to be read, and can be run on nothing. `body` may
stand at the top, in place of a table [brain]. The body's own table may be left out, or any part of it: what
was recorded is the motion of the base, so that the stand-ins for wheels and limits cancel. Who names its
joints, since their angles were recorded, states their geometry. A body whose steered wheels or legs are left
out moves as its stand-in does.
"""

from __future__ import annotations

from dataclasses import MISSING
from functools import cache
from types import MappingProxyType
from typing import Any

from brain.bodies.body import Base, Body
from brain.bodies.plane import Twist
from gateway.config.bodies import load_body, names
from gateway.config.errors import Mistakes
from gateway.config.sections import Table
from gateway.errors import UserError
from protocols.bounds import bounds_of, hints, keys

NOT_ITS_OWN = ("buses", "motors", "sensors", "limbs", "defaults", "world", "plant", "urdf", "map")
FOR_RECORDINGS = (
    "this file is for recordings alone (a table [bag], and no bus): `gateway replay FILE --robot ROBOT` "
    "reads them; to run a robot, expected tables [buses.NAME] and [motors.NAME]"
)
STAND_INS = MappingProxyType(
    {
        "left": "left",
        "right": "right",
        "front_left": "front_left",
        "front_right": "front_right",
        "rear_left": "rear_left",
        "rear_right": "rear_right",
        "wheel_radius": 0.1,
        "wheel_separation": 0.4,
        "effective_separation": 0.4,
        "wheelbase": 0.4,
        "radius": 0.3,
    }
)
"""By key of a body's table"""
LIMITS = ("max_linear", "max_angular", "max_linear_acceleration", "max_angular_acceleration")
"""As far as each may go at all: they limit nothing."""


def is_recorded(table: Table) -> bool:
    """Whether a robot file is one of a recording."""
    return "bag" in table and not {"buses", "motors"} & table.keys()


def completed(table: Table, mistakes: Mistakes) -> tuple[Table, tuple[str, ...]]:
    """Return a robot file of a recording with what its body lacks, and the names of the body's joints."""
    for key in NOT_ITS_OWN:
        if key in table:
            remedy = "a file of a recording has no such table; where a sensor is, [bag.mounts.NAME] says"
            mistakes.add((key,), remedy)
    table = {**table}
    if "body" in table and isinstance(table.get("brain", {}), dict):  # the one key of [brain] that it needs
        table["brain"] = {"body": table.pop("body"), **table.get("brain", {})}
    brain = table.get("brain")
    table.setdefault("name", "recording")
    if not isinstance(brain, dict) or not isinstance(brain.get("body"), str):
        return table, ()
    try:
        own = brain.get(brain["body"])
        kind = load_body(brain["body"])
        if own is None and issubclass(kind, Base) and not _rolls(kind):
            kind = load_body(stand_in(sideways=kind.moves_sideways is not Base.moves_sideways))
    except UserError:
        return table, ()  # reported where the body is read
    if not issubclass(kind, Base) or not isinstance(own, dict | None):
        return table, ()
    named = any(key in (own or {}) for key in kind.motor_keys())
    filled = {**_stand_ins(kind, joints=not named), **(own or {})}
    joints = [name for key in kind.motor_keys() for name in _names(filled.get(key))]
    return {**table, "brain": {**brain, "body": kind.kind, kind.kind: filled}}, tuple(joints)


@cache
def stand_in(*, sideways: bool) -> str:
    """Return the name of a body that any motion turns the wheels of: also to the side, or not."""
    found = (name for name in names() if _rolls(load_body(name), sideways=sideways))
    return next(found, "")


def _rolls(kind: type[Body], *, sideways: bool | None = None) -> bool:
    """Whether a body of which nothing is stated can be completed, and goes by wheels that do not steer."""
    if not issubclass(kind, Base):
        return False
    try:
        values: dict[str, Any] = {k: _frozen(one) for k, one in _stand_ins(kind, joints=True).items()}
        made = kind(**values)
        setpoints = made.inverse(Twist(1.0, 1.0, 0.0), [None] * len(made.joints))
    except (TypeError, ValueError):
        return False
    rolls = made.turning_radius == 0.0 and all(one.velocity is not None for one in setpoints)
    return rolls and sideways in (None, made.moves_sideways)


def _frozen(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _stand_ins(kind: type[Base], *, joints: bool) -> dict[str, Any]:
    """Return values for the required keys of a body's table, as far as there are any. `joints`: also for the
    joints and their geometry, which those who name joints have to state."""
    found: dict[str, Any] = {}
    for key, field in keys(kind).items():
        if field.default is not MISSING or field.default_factory is not MISSING:
            continue
        hint = hints(kind)[field.name]
        bounds = bounds_of(hint)
        if key in LIMITS and bounds is not None:
            found[key] = bounds.most
        elif key in STAND_INS and (joints or key == "radius"):
            several = "tuple" in str(hint)
            found[key] = [STAND_INS[key]] if several else STAND_INS[key]
    return found


def _names(value: object) -> list[str]:
    if isinstance(value, str):
        return [value]
    return [one for one in value if isinstance(one, str)] if isinstance(value, list) else []
