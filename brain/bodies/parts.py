"""What a robot looks like: rigid parts, each carried by an earlier one, and the motors that move them.

Rules. For who looks at it, in a picture; no step of the brain asks for it. A URDF says it (`of_urdf`); a body
without one says it by its own dimensions (`Body.parts`), and what these leave out (how high a base is) is
drawn flat. Frames: x forward, y to the left, z up; m and rad.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import pi
from typing import NamedTuple

from brain.bodies.urdf import Geometry, Origin, UrdfModel, Vector

UP: Vector = (0.0, 0.0, 1.0)
UPRIGHT = Origin()
WIDTH = 0.4
"""Of a wheel, in radii."""


class Part(NamedTuple):
    """Something rigid, and what moves it."""

    carrier: int
    """Index of the part that carries it, which is before it; -1: the robot's frame"""
    origin: Origin
    """Its frame in that of its carrier, with its joint at 0"""
    shapes: tuple[Geometry, ...] = ()
    """In its frame"""
    motor: str = ""
    """What turns it about `axis`, or slides it along; "": it does not move"""
    axis: Vector = UP
    """In its frame, of length 1"""
    slides: bool = False
    rest: float = 0.0
    """rad or m of its joint where its motor's position is not known, or it has none"""


class Wheel(NamedTuple):
    """A wheel on the floor."""

    x: float
    """m, of its point of contact"""
    y: float
    radius: float
    motor: str = ""
    steering: str = ""
    """The motor that turns it about the vertical; "": none"""
    direction: float = 0.0
    """rad, from forward: where it rolls"""


def of_urdf(model: UrdfModel, motors: Mapping[str, str], at: Origin, first: int = 0) -> list[Part]:
    """Return the links of a URDF, in its order.

    Args:
        model: the URDF.
        motors: what moves its joints, by the joints' names; what has none stands at 0, or at the end of its
            range that is nearest.
        at: where its root is, in the robot's frame.
        first: the index that the first part gets.
    """
    index = {model.root: first}
    parts = [Part(-1, at, model.links[model.root].looks)]
    for joint in model.joints.values():
        index[joint.child] = first + len(parts)
        low, high = joint.range or (0.0, 0.0)
        rest, motor = max(low, min(high, 0.0)), motors.get(joint.name, "")
        shapes, slides = model.links[joint.child].looks, joint.kind == "prismatic"
        parts.append(Part(index[joint.parent], joint.origin, shapes, motor, joint.axis, slides, rest))
    return parts


def of_base(outline: Iterable[tuple[float, float]], wheels: Iterable[Wheel]) -> list[Part]:
    """Return a base as its outline, made a plate, and its wheels."""
    stands, corners = list(wheels), [one for corner in outline for one in corner]
    tall = max((one.radius for one in stands), default=0.0)
    thick = 0.15 * max(map(abs, corners))
    plate = Geometry("prism", (thick, *corners), Origin((0.0, 0.0, 0.7 * tall)))
    parts = [Part(-1, UPRIGHT, (plate,))]
    for one in stands:
        centre = Origin((one.x, one.y, one.radius), (0.0, 0.0, one.direction))
        parts.append(Part(0, centre, motor=one.steering))
        tyre = Geometry("cylinder", (one.radius, WIDTH * one.radius), Origin(rpy=(pi / 2.0, 0.0, 0.0)))
        spoke = Geometry(
            "box", (1.2 * one.radius, 1.1 * WIDTH * one.radius, 0.15 * one.radius), Origin(), SPOKE
        )
        parts.append(Part(len(parts) - 1, UPRIGHT, (tyre, spoke), one.motor, (0.0, 1.0, 0.0)))
    return parts


SPOKE = (0.95, 0.75, 0.2)
"""Red, green, blue: by it a wheel is seen to turn."""


def carried(parts: Iterable[Part], at: Origin, first: int) -> list[Part]:
    """Return parts in another frame, with the indices that they get behind others."""
    return [Part(-1, at), *(part._replace(carrier=first + 1 + part.carrier) for part in parts)]
