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

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from gateway.buses.virtual.medium import Transmission
from protocols.messages import Feedback, Measurement


@dataclass(slots=True)
class Tamper:
    """The functions in force."""

    measured: Callable[[str, Feedback], Feedback] | None = None
    """From a motor's name and the true motion of its device's shaft: what the device measures."""
    torques: Callable[[dict[str, float]], dict[str, float]] | None = None
    """From the torques [N·m] that the motors give at their output shafts, by name: what the world gets."""
    reading: Callable[[Measurement], Measurement | None] | None = None
    """From what a sensor measures: what its firmware gets; None: nothing."""
    error: Callable[[str, Transmission], int] | None = None
    """From a bus's name and a CAN frame that is being sent: after how many bits an error destroys it, so that
    it is sent again; 0: none does."""
    transmission: Callable[[str, Transmission], Iterable[Transmission]] | None = None
    """From a bus's name and a frame that has arrived: what arrives instead, at each one's own `t`, which may
    be later."""
