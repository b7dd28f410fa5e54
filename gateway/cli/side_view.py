"""A robot of links from its side: its links at several moments, the way of its tip, and of boxes."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot
from typing import Any

import numpy as np

from brain.belief import Floats
from brain.bodies.body import Linkage
from brain.bodies.limbs import LimbPlace
from gateway.cli.tour import Tour

APART = 0.12
"""m that the tip moves between two drawings of the links."""
LINKS, TIP, BOXES = "#1f4fa8", "#d95f02", ("#1b9e77", "#c2185b", "#7b5ea7")


def draw_arms(axes: Any, arms: Sequence[tuple[Linkage, LimbPlace]], tour: Tour) -> None:  # noqa: ANN401 -- matplotlib's
    """Draw them: distance from the robot's upright axis, to the right, and height; and the ways of boxes."""
    for number, (body, at) in enumerate(arms):
        _draw(axes, body, at, tour, first=number == 0)
    for name, colour in zip(tour.boxes[0] if tour.boxes else (), BOXES, strict=False):
        way = np.array([boxes[name] for boxes in tour.boxes])
        axes.plot(*_flat(way), color=colour, lw=2.0, label=f"{name}: from ○ to ●")
        for place, face in ((way[0], "white"), (way[-1], colour)):
            axes.plot(*_flat(place[None]), "o", color=colour, mfc=face, ms=8)
    axes.axhline(0.0, color="black", lw=0.8)
    axes.set_aspect("equal")
    axes.set_xlabel("distance from the upright axis, negative behind it [m]")
    axes.set_ylabel("height [m]")
    axes.legend(loc="upper right")


def _draw(axes: Any, body: Linkage, at: LimbPlace, tour: Tour, *, first: bool) -> None:  # noqa: ANN401 -- matplotlib's
    order = [tour.motors.index(motor) for motor in body.joints]
    moments = [
        np.array([at.outward(*point) for point in body.points([shafts[i] for i in order])])
        for shafts in tour.shafts
    ]
    tips = np.array([points[-1] for points in moments])
    last = tips[0] + APART
    shown = []
    for number, points in enumerate(moments):
        if np.linalg.norm(points[-1] - last) >= APART or number == len(moments) - 1:
            last = points[-1]
            shown.append(number)
    for rank, number in enumerate(shown):
        across, height = _flat(moments[number])
        shade = 0.15 + 0.75 * (rank + 1) / len(shown)
        axes.plot(across, height, "o-", color=LINKS, alpha=shade, lw=2.5, ms=4)
    axes.plot(*_flat(tips), color=TIP, lw=1.0, label="tip" if first else None)


def _flat(points: Floats) -> tuple[Floats, Floats]:
    """Return the distances of points from the upright axis, negative behind it, and their heights."""
    across = [hypot(x, y) * (-1.0 if x < -abs(y) else 1.0) for x, y, _ in points]
    return np.array(across), points[:, 2]
