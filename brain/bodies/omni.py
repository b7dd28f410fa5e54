"""A base on three or more omni wheels, at any places and angles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

from brain.bodies.parts import Wheel
from brain.bodies.wheels import FixedWheels, Row, roller_row
from protocols.bounds import Bounds, Invalid

MOST_WHEELS = 16
FARTHEST = 10.0
"""m, of a wheel from the origin"""


def check_places(places: tuple[tuple[float, float], ...], motors: int) -> None:
    """Raise Invalid unless there is a place for each of the motors, and few enough of them."""
    if len(places) != motors or motors > MOST_WHEELS:
        raise Invalid(
            ("places", f"places must be those of the wheels, at most {MOST_WHEELS}, not {len(places)}")
        )
    if not all(math.hypot(*place) <= FARTHEST for place in places):
        raise Invalid(("places", f"places must lie within {FARTHEST:g} m of the origin"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Omni(FixedWheels):
    """Its origin is where the wheels' places are measured from. The lists are in the order of `wheels`."""

    kind: ClassVar[str] = "omni"
    wheels: tuple[str, ...]
    """Motors"""
    places: tuple[tuple[float, float], ...]
    """m: x and y of each wheel's point of contact"""
    directions: tuple[Annotated[float, Bounds(-2.0 * math.pi, 2.0 * math.pi, "rad")], ...]
    """rad, counter-clockwise from forward: where each wheel rolls when its angle grows"""
    roller: Annotated[float, Bounds(-1.4, 1.4, "rad")] = 0.0
    """rad, from across a wheel to where its rollers let it move freely; 0: an omni wheel"""

    def __post_init__(self) -> None:
        check_places(self.places, len(self.wheels))
        if len(self.directions) != len(self.wheels):
            raise Invalid(("directions", f"directions must be those of the {len(self.wheels)} wheels"))
        FixedWheels.__post_init__(self)

    @classmethod
    def motor_keys(cls) -> tuple[str, ...]:
        """Return the key of the list of wheels."""
        return ("wheels",)

    @property
    def joints(self) -> tuple[str, ...]:
        """The wheels."""
        return self.wheels

    @property
    def moves_sideways(self) -> bool:
        """It does."""
        return True

    @property
    def stands_on(self) -> tuple[Wheel, ...]:
        """All of them."""
        each = zip(self.places, self.wheels, self.directions, strict=True)
        return tuple(Wheel(*at, self.wheel_radius, motor, "", turned) for at, motor, turned in each)

    @property
    def rows(self) -> tuple[Row, ...]:
        """Each wheel moves freely across its rollers."""
        pairs = zip(self.places, self.directions, strict=True)
        return tuple(roller_row(x, y, direction, self.roller) for (x, y), direction in pairs)
