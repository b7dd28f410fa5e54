"""Robot bodies, one file each: exact kinematics both ways, limits, footprint.

Exports: `body.Body` and `body.Base`, which the brain knows; `plane`, poses and twists; `joint_profile`,
the fastest motion of a joint within its limits; `bare`. The bodies themselves are found by their entry
points, and named nowhere else.
Must not import: perception, planning, control, nor numpy where a twist is computed at every step.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from brain.bodies.body import Body


def bare(motors: Iterable[str]) -> Body:
    """Return a body of independent motors."""
    from brain.bodies.joints import Joints

    return Joints(motors=tuple(motors))
