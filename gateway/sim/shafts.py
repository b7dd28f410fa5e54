"""Bare motor shafts: inertia, damping, dry friction, a constant load, hard stops. Scalars only.

Rules. Every shaft starts at rest at 0 and is independent of the others. Motion is integrated with the
semi-implicit Euler method; damping is implicit, and dry friction may stop a shaft but never reverse it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from gateway.sim.files import STEP, BenchFile, ShaftFile
from gateway.sim.plant_files import PlantFile
from protocols.messages import seconds

DT = seconds(STEP)


class Shaft:
    """One joint's output shaft."""

    def __init__(self, file: ShaftFile) -> None:
        self.file = file
        self.position = 0.0
        """rad"""
        self.velocity = 0.0
        """rad/s"""
        self.touches = 0
        """How often it reached a hard stop."""
        self.given: tuple[float, float] | None = None
        """Its angle [rad] and velocity [rad/s], where these are given and no torque moves it"""
        self._at_stop = False
        self._load = 0.0, 0.0
        """Position and velocity of what is beyond the backlash"""

    def step(self, torque: float) -> None:
        """Advance by one time step under a torque [N·m]."""
        file = self.file
        if self.given is not None:
            self.position, self.velocity = self.given
            self.given = self.position + self.velocity * DT, self.velocity
            return
        if file.backlash:
            self._step_apart(torque)
            return
        velocity = self._faster(self.velocity, torque + file.load, 1.0)
        self.position += velocity * DT
        self.velocity = velocity
        if file.stops:
            self._hold_within(*file.stops)

    @property
    def resistance(self) -> float:
        """The torque [N·m] of load, damping and friction as it turns; at rest friction is none."""
        file, moves = self.file, (self.velocity > 0.0) - (self.velocity < 0.0)
        return file.load - file.damping * self.velocity - file.friction * moves

    def _faster(self, velocity: float, torque: float, share: float) -> float:
        """Return the velocity after a time step of a share of the shaft."""
        file, inertia = self.file, share * self.file.inertia
        velocity += torque * DT / inertia
        velocity /= 1.0 + file.damping * DT / file.inertia
        brake = file.friction * DT / file.inertia
        return max(0.0, velocity - brake) if velocity > 0.0 else min(0.0, velocity + brake)

    def _step_apart(self, torque: float) -> None:
        """Advance motor and load, each by itself while the gear has play, together where it pushes: an
        impact without rebound."""
        file, half = self.file, self.file.backlash / 2.0
        own, (at, speed) = file.rotor, self._load
        play = self.position - at
        alone = self._faster(self.velocity, torque, own)
        load = self._faster(speed, file.load, 1.0 - own)
        # Where a flank pushes the load, both are one shaft; else each is by itself.
        if abs(play) >= half - 1e-12 and self.velocity == speed and play * (alone - load) > 0.0:
            self.velocity = speed = self._faster(self.velocity, torque + file.load, 1.0)
        else:
            self.velocity, speed = alone, load
        self.position += self.velocity * DT
        at += speed * DT
        if abs(self.position - at) > half:  # they meet
            both = own * self.velocity + (1.0 - own) * speed
            if (self.position - at) * (self.velocity - speed) > 0.0:
                self.velocity = speed = both
            at = self.position - (half if self.position > at else -half)
        self._load = at, speed

    def _hold_within(self, low: float, high: float) -> None:
        """Apply the stops: they are rigid and take all of the shaft's motion."""
        touching = not low < self.position < high
        if touching:
            self.position = min(high, max(low, self.position))
            self.velocity = 0.0
            self.touches += not self._at_stop
        self._at_stop = touching


class Shafts:
    """Independent shafts, one for each of these motors."""

    def __init__(self, file: BenchFile | PlantFile, motors: Iterable[str]) -> None:
        self._shafts = {name: Shaft(file.shafts.get(name, file.shaft)) for name in motors}

    def step(self, torques: Mapping[str, float]) -> None:
        """Advance by one time step; a motor that is not named gives no torque."""
        for name, shaft in self._shafts.items():
            shaft.step(torques.get(name, 0.0))

    def shaft(self, motor: str) -> tuple[float, float]:
        """Return position [rad] and velocity [rad/s]."""
        shaft = self._shafts[motor]
        return shaft.position, shaft.velocity

    def give(self, motor: str, motion: tuple[float, float] | None) -> None:
        """Give a shaft its angle and velocity from now on; None: torques move it again."""
        self._shafts[motor].given = motion

    def resistance(self, motor: str) -> float:
        """Return the torque [N·m] that the world puts on a shaft."""
        return self._shafts[motor].resistance

    @property
    def touches(self) -> int:
        """How often shafts reached their hard stops."""
        return sum(shaft.touches for shaft in self._shafts.values())
