"""What falsifies the simulated world: functions that a test, or a campaign of faults, puts in its way.

Rules. Each function stands between the truth and one receiver, gets what is true, and returns what is
received instead; where it is None all is as it is. TwinWorld calls them, and nothing else: no twin, driver or
gateway can distinguish a falsified world from one that has such a fault. Their state is the caller's.

    world.tamper.measured = lambda motor, true: replace(true, velocity=0.0)       # an encoder without speed
    world.tamper.torques = lambda torques: torques | {"left": 0.0}                # a motor without torque
    world.tamper.reading = lambda scan: replace(scan, ranges=(0.0,) * 360)        # a lidar behind a cover
    world.tamper.transmission = lambda bus, one: () if one.sender == HOST else (one,)  # nothing gets out
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from gateway.buses.virtual.medium import Transmission
from protocols.messages import Feedback, Measurement, Nanos

Measured: TypeAlias = Callable[[str, Feedback], Feedback]
Torques: TypeAlias = Callable[[dict[str, float]], dict[str, float]]
Reading: TypeAlias = Callable[[Measurement], Measurement | None]
Destroyed: TypeAlias = Callable[[str, Transmission], int]
Arriving: TypeAlias = Callable[[str, Transmission], Iterable[Transmission]]
Timed: TypeAlias = Callable[[Nanos], Nanos]


@dataclass(slots=True)
class Tamper:
    """The functions in force."""

    measured: Measured | None = None
    """From a motor's name and the true motion of its device's shaft: what the device measures."""
    torques: Torques | None = None
    """From the torques [N·m] that the motors give at their output shafts, by name: what the world gets."""
    reading: Reading | None = None
    """From what a sensor measures: what its firmware gets; None: nothing."""
    error: Destroyed | None = None
    """From a bus's name and a CAN frame that is being sent: after how many bits an error destroys it, so that
    it is sent again; 0: none does."""
    transmission: Arriving | None = None
    """From a bus's name and a frame that has arrived: what arrives instead, at each one's own `t`, which may
    be later."""
    stamp: Timed | None = None
    """From when the host received something: the stamp that it is given of that."""
    takes: Timed | None = None
    """From when the host begins a step: how long that takes. The world goes on meanwhile."""


def composed(parts: Sequence[Tamper]) -> Tamper:
    """Return what several falsify one after the other."""
    made = Tamper()
    for part in parts:
        made.measured = _after(made.measured, part.measured)
        made.torques = _torques(made.torques, part.torques)
        made.reading = _reading(made.reading, part.reading)
        made.error = _either(made.error, part.error)
        made.transmission = _each(made.transmission, part.transmission)
        made.stamp = _stamp(made.stamp, part.stamp)
        made.takes = _longer(made.takes, part.takes)
    return made


def _after(one: Measured | None, other: Measured | None) -> Measured | None:
    if one is None or other is None:
        return other or one
    return lambda motor, true: other(motor, one(motor, true))


def _torques(one: Torques | None, other: Torques | None) -> Torques | None:
    if one is None or other is None:
        return other or one
    return lambda given: other(one(given))


def _reading(one: Reading | None, other: Reading | None) -> Reading | None:
    if one is None or other is None:
        return other or one
    return lambda true: None if (made := one(true)) is None else other(made)


def _either(one: Destroyed | None, other: Destroyed | None) -> Destroyed | None:
    if one is None or other is None:
        return other or one
    return lambda bus, sent: one(bus, sent) or other(bus, sent)


def _each(one: Arriving | None, other: Arriving | None) -> Arriving | None:
    if one is None or other is None:
        return other or one
    return lambda bus, sent: [last for first in one(bus, sent) for last in other(bus, first)]


def _stamp(one: Timed | None, other: Timed | None) -> Timed | None:
    if one is None or other is None:
        return other or one
    return lambda t: other(one(t))


def _longer(one: Timed | None, other: Timed | None) -> Timed | None:
    if one is None or other is None:
        return other or one
    return lambda now: max(one(now), other(now))
