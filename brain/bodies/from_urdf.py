"""Where a URDF has the wheels of a base, and how large they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from brain.bodies import urdf

ALIKE = 1e-6
"""m by which the radii of wheels may differ"""


class WheelPlace(NamedTuple):
    """m, in the frame of the root link."""

    x: float
    y: float
    radius: float


def wheels(
    text: str, joints: Mapping[str, str], table: Mapping[str, Any], keys: Sequence[str], *wanted: str
) -> list[WheelPlace]:
    """Return the wheel that each of these keys of a body's table names the motor of, in their order; none if
    the table lacks nothing that is wanted, or names no motors.

    Raises ValueError if a motor moves no wheel, or the wheels are not alike."""
    from brain.bodies.chain import at_rest  # numpy: where a URDF is read only

    motors = [table.get(key) for key in keys]
    if all(key in table for key in wanted) or not all(isinstance(motor, str) for motor in motors):
        return []
    model, found = urdf.parse(text), []
    for motor in motors:
        if motor not in joints:
            raise ValueError(f"{motor!r} moves no joint of it")
        link = model.links[model.joints[joints[str(motor)]].child]
        round_ = [shape.size[0] for shape in link.shapes if shape.kind in ("cylinder", "sphere")]
        if not round_:
            raise ValueError(f"its link {link.name!r} has no cylinder or sphere: the radius is not known")
        x, y, _ = at_rest(model, link.name)[1].tolist()
        found.append(WheelPlace(x, y, max(round_)))
    if max(one.radius for one in found) - min(one.radius for one in found) > ALIKE:
        raise ValueError("its wheels differ in radius")
    return found
