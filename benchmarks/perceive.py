"""What perception costs: one measurement of the filter, one scan of the map.

Rules. The robot goes along a circle in a hall with pillars; wheels and lidar measure exactly that. Rivals
get the same numbers. Ours does more (see `brain.perception`): it puts measurements in order of time, gates
them and keeps what it takes to do so, knows how sure the map is of each cell and from which side it was seen.
"""

from __future__ import annotations

from itertools import cycle
from math import cos, inf, sin, sqrt, tau
from typing import Literal

import numpy as np

from benchmarks.measure import Call, Effort, in_turn, rival
from benchmarks.rivals import BareFilterpy, BresenhamLoop, PlainNumpy
from benchmarks.rows import Beside, Row, against
from brain.belief import Pose
from brain.bodies.differential import Differential
from brain.bodies.plane import Twist
from brain.perception import engine
from brain.perception.body_scan import BodyScan, to_body, to_world
from brain.perception.engine import SIZE, MoveErrors
from brain.perception.filter import Filter
from brain.perception.filter_inputs import GyroRate, WheelAngle
from brain.perception.filter_settings import FilterSettings
from brain.perception.map import Map, MapSettings
from brain.perception.mount import Mount
from protocols.messages import MILLISECOND, LaserScan, Nanos, seconds

EKF, GRID = (
    "both wheels and the gyro into the filter (8 states, 1 measured)",
    "one scan of 360 beams into the map",
)
PERIOD: Nanos = 5 * MILLISECOND
SPEED, TURN = 0.5, 0.4
NOISE = np.array([[1e-9]])
BODY = Differential(
    left="left",
    right="right",
    wheel_radius=0.05,
    wheel_separation=0.22,
    radius=0.24,
    max_linear=0.6,
    max_angular=2.0,
    max_linear_acceleration=0.8,
    max_angular_acceleration=4.0,
)
BEAMS = 360
SURE = np.diag([1e-6, 1e-6, 1e-8])
"""Covariance of the poses"""
HALL = (9.0, 6.0)
"""m from the middle to the walls, along x and y"""
PILLARS = ((3.0, 2.0, 0.3), (-4.0, 1.0, 0.4), (1.0, -3.0, 0.3), (-2.0, -4.0, 0.5), (5.0, -2.0, 0.25))
"""x, y, radius [m]"""
PLACES = 24
AROUND = 256
"""Cells of a rival's array to each side of the origin"""


def perceive(effort: Effort) -> list[Row]:
    """Both."""
    return [_filter(effort), _map(effort)]


# -- the filter -----------------------------------------------------------------------------------


def _filter(effort: Effort) -> Row:
    package = rival("filterpy", "filterpy")
    ours, same = OurFilter("structured"), OurFilter("filterpy")
    for _ in range(20):  # the first travels only wait for the other sensor
        ours.step()
        same.step()
    z = np.zeros(1)
    bare, plain = BareFilterpy(*RIVALS), PlainNumpy(*RIVALS)
    names = (f"{package.name} as its engine", f"{package.name}, F and Q given", "plain numpy, F and Q given")
    steps = (same.step, lambda: bare.step(z), lambda: plain.step(z))
    contestants: dict[str, Call] = {"ours": ours.step, **dict(zip(names, steps, strict=True))}
    found = in_turn(contestants, effort.of(2000, 100))
    return Row(EKF, "one predict and update, gated", found["ours"], against(found, *names))


MOVE = MoveErrors(
    -1e-3, 2e-3, -2e-3, -1e-3, 1e-3, 2e-3, -0.01, 0.01, 5e-3, 0.99, 0.99,
    4e-8, 0.0, 2e-8, 5e-11, 2e-9, 1e-6, 1e-6, 2e-10, 1e-10,
)  # fmt: skip
"""Some travel of the wheels"""
MATRICES = engine.matrices(MOVE)
RIVALS = (
    np.zeros(SIZE), np.eye(SIZE) * 1e-4, np.eye(SIZE)[[engine.TURN]], NOISE, lambda x: (x, *MATRICES)
)  # fmt: skip
"""Of the rivals: start, covariance, measurement of the turn, its noise, model of that travel"""


class OurFilter:
    """The filter of the brain, on a circle."""

    def __init__(self, engine: Literal["structured", "filterpy"]) -> None:
        self.belief = Filter(BODY, FilterSettings(engine=engine))
        self._t: Nanos = 0

    def step(self) -> None:
        """A period later, the next measurements."""
        self._t += PERIOD
        left, right = ((one.velocity or 0.0) * seconds(self._t) for one in BODY.inverse(Twist(SPEED, TURN)))
        wheels = WheelAngle("left", self._t, left), WheelAngle("right", self._t, right)
        self.belief.observe((GyroRate("imu", self._t, TURN, 0.003), *wheels))


# -- the map --------------------------------------------------------------------------------------


def _map(effort: Effort) -> Row:
    settings = MapSettings()
    drawing = rival("skimage.draw", "scikit-image")
    scans = [(pose, to_body(scan_at(pose), Mount(), settings.farthest)) for pose in places()]
    chart = Map(settings)
    loop, lines = loop_over(chart), loop_over(chart)
    cells = [cells_of(chart, pose, swept) for pose, swept in scans]
    ours, naive, drawn = cycle(scans), cycle(cells), cycle(cells)
    contestants: dict[str, Call] = {
        "ours": lambda: chart.add(*next(ours), SURE),
        "Bresenham in a Python loop": lambda: loop.add(*next(naive)),
    }
    if not drawing.why_not:
        contestants[drawing.name] = lambda: lines.add_by(drawing.module.line, *next(drawn))
    for pose, swept in scans:  # what is measured is a map that knows the hall, not the first look at it
        chart.add(pose, swept, SURE)
    found = in_turn(contestants, effort.of(60, 3))
    beside: tuple[Beside, ...] = against(
        found, "Bresenham in a Python loop", drawing.name, missing=(drawing,)
    )
    longest = max(float(np.max(swept.ranges)) for _, swept in scans)
    what = f"cells of {settings.resolution:g} m, beams of up to {longest:.0f} m"
    return Row(GRID, what, found["ours"], beside)


def places() -> list[Pose]:
    """Along a circle of 1.25 m, looking ahead."""
    radius = SPEED / TURN
    return [Pose(radius * sin(a), -radius * cos(a), a) for a in (tau * i / PLACES for i in range(PLACES))]


def scan_at(pose: Pose) -> LaserScan:
    """What a lidar in the middle of the robot sees of the hall."""
    ranges = tuple(reach(pose.x, pose.y, pose.yaw + tau * i / BEAMS) for i in range(BEAMS))
    return LaserScan("lidar", 0, 0.0, tau / BEAMS, 0.1, 25.0, ranges)


def reach(x: float, y: float, heading: float) -> float:
    """How far [m] it is from a place within the hall to what stands in that direction."""
    c, s = cos(heading), sin(heading)
    walls = [
        (side * size - at) / along
        for at, along, size in ((x, c, HALL[0]), (y, s, HALL[1]))
        for side in (-1, 1)
        if along
    ]
    nearest = min((wall for wall in walls if wall > 0.0), default=inf)
    for px, py, radius in PILLARS:
        along, aside = c * (px - x) + s * (py - y), c * (py - y) - s * (px - x)
        if along > 0.0 and abs(aside) < radius:
            nearest = min(nearest, along - sqrt(radius * radius - aside * aside))
    return nearest


def loop_over(chart: Map) -> BresenhamLoop:
    """A rival of the size and with the sensor model of a map."""
    chosen, side = chart.settings, 2 * AROUND
    return BresenhamLoop((side, side), chosen.hit, chosen.miss, chosen.low, chosen.high)


def cells_of(chart: Map, pose: Pose, swept: BodyScan) -> tuple[tuple[int, int], list[tuple[int, int]]]:
    """Where (row, column) in the rival's array the beams of a scan start and end."""
    points = np.concatenate([[(pose.x, pose.y)], to_world(swept.ends, pose)])
    start, *ends = [(row + AROUND, column + AROUND) for column, row in chart.cells(points).tolist()]
    return start, ends
