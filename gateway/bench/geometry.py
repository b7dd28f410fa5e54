"""Which numbers of a body's table make up for factors on its motion, whatever the body.

Rules. No body is named. Each number of the table is asked what it does to the motion of some turns of the
joints; the change that makes up for the factors is the one that changes the numbers least, in proportion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import TypeAlias

import numpy as np

from brain.belief import Floats
from brain.bodies.body import Base
from brain.bodies.plane import Twist
from gateway.bench.wheel_path import Factors

TRIED = 1e-4
"""Share by which a number is changed to see what it does"""
STEPS = 20
SPAN = 0.1
"""s of the motions that are looked at"""
_Turned: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]


def corrected(body: Base, factors: Factors) -> Mapping[str, float]:
    """Return the numbers of a body's table with which its motion is by these factors longer, by their keys;
    {} where none do that."""
    wanted = np.log([abs(factors.distance), abs(factors.turn)])
    curve = 0.8 * body.max_linear / body.turning_radius if body.turning_radius else body.max_angular
    moves = (
        _turned(body, Twist(body.max_linear)),
        _turned(body, Twist(body.max_linear if body.turning_radius else 0.0, curve)),
    )

    def motion(one: Base) -> Floats:
        """Return the logarithms of a way straight ahead and of a turn, of the same turns of the joints."""
        ahead, turn = one.travel(*moves[0]).distance, one.travel(*moves[1]).turn
        found: Floats = np.log(np.maximum(np.abs([ahead, turn]), 1e-12))
        return found

    def slope(one: Base, key: str) -> Floats:
        try:
            return (motion(replace(one, **{key: getattr(one, key) * (1.0 + TRIED)})) - motion(one)) / TRIED
        except ValueError:  # a number that may not be larger is no measure of the wheels
            return np.zeros(2)

    keys = [one.name for one in fields(body) if isinstance(getattr(body, one.name), float)]
    keys = [key for key in keys if np.any(np.abs(slope(body, key)) > 1e-3)]
    now, goal = body, motion(body) + wanted
    for _ in range(STEPS):
        left = goal - motion(now)
        if not keys or float(np.abs(left).max()) < 1e-9:
            break
        columns = np.column_stack([slope(now, key) for key in keys])
        change = np.clip(np.linalg.lstsq(columns, left, rcond=1e-6)[0], -0.7, 0.7).tolist()
        try:
            now = replace(
                now, **{k: getattr(now, k) * math.exp(c) for k, c in zip(keys, change, strict=True)}
            )
        except ValueError:
            return {}
    if float(np.abs(goal - motion(now)).max()) > TRIED:
        return {}
    return {key: getattr(now, key) for key in keys}


def _turned(body: Base, twist: Twist) -> _Turned:
    """Return positions of the joints at the beginning and the end of a motion."""
    ends = body.inverse(twist, (0.0,) * len(body.joints))
    before = tuple(one.position or 0.0 for one in ends)
    moved = zip(before, ends, strict=True)
    return before, tuple(at + SPAN * (one.velocity or 0.0) for at, one in moved)
