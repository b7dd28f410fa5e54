"""A boom: an arm whose joints are moved by cylinders, as those of an excavator or a crane.

Rules. The position of a joint with a cylinder is the cylinder's length [m], which is what its motor moves and
measures: plans, limits and missions have it. Angles are within: geometry, gravity and searches are those of
the chain of the URDF. The curvature of the triangle is left out of the forces of a motion.

    [brain.boom.axes.lift]        velocity, acceleration and jerk as of an arm, in m/s …
    [brain.boom.cylinders.lift]   base, rod, angle, sign: where the cylinder of this motor is mounted
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from brain.bodies.arm import SerialArm
from brain.bodies.body import Placement, Search
from brain.bodies.cylinder import Cylinder
from protocols.bounds import Invalid


@dataclass(frozen=True, slots=True, kw_only=True)
class Boom(SerialArm):
    """Its joints are in the order of the URDF; those without a cylinder are as those of an arm."""

    kind: ClassVar[str] = "boom"
    cylinders: dict[str, Cylinder]
    """By motor."""

    def __post_init__(self) -> None:
        SerialArm.__post_init__(self)
        ends = zip(self.chain.low.tolist(), self.chain.high.tolist(), strict=True)
        angles = dict(zip(self.joints, ends, strict=True))
        for motor, cylinder in self.cylinders.items():
            if motor not in angles:
                text = f"no axis has a motor {motor!r}; there is {', '.join(self.axes)}"
                raise Invalid((f"cylinders.{motor}", f"cylinders: {text}"))
            try:
                cylinder.check_range(*angles[motor])
            except Invalid as invalid:
                raise Invalid((f"cylinders.{motor}.angle", str(invalid))) from invalid

    @property
    def _in_order(self) -> tuple[Cylinder | None, ...]:
        return tuple(map(self.cylinders.get, self.joints))

    def angles(self, positions: Sequence[float]) -> tuple[float, ...]:
        """Return the joint angles [rad] of lengths [m]."""
        pairs = zip(self._in_order, positions, strict=True)
        return tuple(each if one is None else one.position(each) for one, each in pairs)

    def lengths(self, angles: Sequence[float]) -> tuple[float, ...]:
        """Return the lengths [m] of joint angles [rad]."""
        pairs = zip(self._in_order, angles, strict=True)
        return tuple(each if one is None else one.length(each) for one, each in pairs)

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """The strokes of the cylinders, by the ranges of the URDF."""
        low, high = self.chain.low.tolist(), self.chain.high.tolist()
        ends = zip(self.lengths(low), self.lengths(high), strict=True)
        return tuple((min(pair), max(pair)) for pair in ends)

    def points(self, positions: Sequence[float]) -> tuple[tuple[float, float, float], ...]:
        """Return the joints that move the tip, between the base and the tip."""
        return SerialArm.points(self, self.angles(positions))

    def torques(
        self, positions: Sequence[float], velocities: Sequence[float], accelerations: Sequence[float]
    ) -> tuple[float, ...]:
        """Return the forces [N] of the cylinders for a motion."""
        angles = self.angles(positions)
        pairs = zip(self._in_order, angles, strict=True)
        levers = [1.0 if one is None else one.lever(each) for one, each in pairs]
        turning = [each / lever for each, lever in zip(velocities, levers, strict=True)]
        gaining = [each / lever for each, lever in zip(accelerations, levers, strict=True)]
        found = self.chain.torques(angles, turning, gaining).tolist()
        return tuple(each / lever for each, lever in zip(found, levers, strict=True))

    def gravity(self, positions: Sequence[float]) -> tuple[float, ...]:
        """Return the forces [N] that hold it."""
        return self.torques(positions, (0.0,) * len(positions), (0.0,) * len(positions))

    def search(self, positions: Sequence[float], place: Placement) -> Search:
        """Return a search among the joint angles, for lengths."""
        return LengthSearch(self, SerialArm.search(self, self.angles(positions), place))


@dataclass(slots=True)
class LengthSearch:
    """A search for lengths, by one for angles. Plain data."""

    boom: Boom
    inner: Search
    done: bool = False
    found: tuple[float, ...] | None = None
    """The lengths [m], once it has found some."""
    why: str = ""

    def advance(self, iterations: int) -> bool:
        """Do some of the work; return whether it is done."""
        self.done, self.why = self.inner.advance(iterations), self.inner.why
        if self.inner.found is not None:
            self.found = self.boom.lengths(self.inner.found)
        return self.done
