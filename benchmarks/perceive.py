"""What perception costs: one measurement of the filter, one scan of the map.

Rules. The robot goes along a circle in a hall with pillars; wheels and lidar measure exactly that. Rivals
get the same numbers. Ours does more (see `brain.perception`): it puts measurements in order of time, gates
them and keeps what it takes to do so, knows how sure the map is of each cell and from which side it was seen.
"""

from __future__ import annotations

from itertools import cycle
from math import cos, inf, sin, sqrt, tau

import numpy as np

from benchmarks.measure import Call, Effort, in_turn, rival
from benchmarks.rivals import BareFilterpy, BresenhamLoop, PlainNumpy
from benchmarks.rows import Beside, Row, against
from brain.belief import Floats, Pose
from brain.perception.body_scan import BodyScan, to_body, to_world
from brain.perception.ekf import Ekf
from brain.perception.ekf_settings import EkfSettings
from brain.perception.map import Map, MapSettings
from brain.perception.measurement import wheels
from brain.perception.motion_model import SIZE, V, W, jacobian, process_noise, propagate
from brain.perception.mount import Mount
from protocols.messages import MILLISECOND, LaserScan, Nanos, seconds

EKF, GRID = (
    "one predict and update of the filter (7 states, 2 measured)",
    "one scan of 360 beams into the map",
)
PERIOD: Nanos = 5 * MILLISECOND
SPEED, TURN = 0.5, 0.4
NOISE = np.diag([0.02**2, 0.05**2])
BEAMS = 360
SURE = np.diag([1e-6, 1e-6, 1e-8])
"""Covariance of the poses"""
HALL = (9.0, 6.0)
"""m from the middle to the walls, along x and y"""
PILLARS = ((3.0, 2.0, 0.3), (-4.0, 1.0, 0.4), (1.0, -3.0, 0.3), (-2.0, -4.0, 0.5), (5.0, -2.0, 0.25))
"""x, y, radius [m]"""
PLACES = 24


def perceive(effort: Effort) -> list[Row]:
    """Both."""
    return [_filter(effort), _map(effort)]


# -- the filter -----------------------------------------------------------------------------------


def _filter(effort: Effort) -> Row:
    package = rival("filterpy", "filterpy")
    ours = OurFilter()
    H, z = np.eye(SIZE)[[V, W]], np.array([SPEED, TURN])
    start = ours.ekf.state, ours.ekf.covariance
    given = model(ours.ekf.state)
    bare = BareFilterpy(*start, H, NOISE, lambda _: given)
    same = BareFilterpy(*start, H, NOISE, model)
    plain = PlainNumpy(*start, H, NOISE, model)
    names = (f"{package.name}, this model", f"{package.name}, F and Q given", "plain numpy, this model")
    steps = (lambda: same.step(z), lambda: bare.step(z), lambda: plain.step(z))
    contestants: dict[str, Call] = {"ours": ours.step, **dict(zip(names, steps, strict=True))}
    found = in_turn(contestants, effort.of(2000, 100))
    return Row(EKF, "speeds from the encoders of both wheels", found["ours"], against(found, *names))


def model(state: Floats) -> tuple[Floats, Floats, Floats]:
    """How the brain's filter believes that a state moves within a period."""
    dt = seconds(PERIOD)
    return propagate(state, dt), jacobian(state, dt), process_noise(state, dt, EkfSettings())


class OurFilter:
    """The filter of the brain, on a circle."""

    def __init__(self) -> None:
        self.ekf = Ekf(EkfSettings())
        self._t: Nanos = 0

    def step(self) -> None:
        """A period later, the next measurement."""
        self._t += PERIOD
        self.ekf.observe(wheels("wheels", self._t, SPEED, TURN, NOISE))


# -- the map --------------------------------------------------------------------------------------


def _map(effort: Effort) -> Row:
    settings = MapSettings(width=24.0, height=24.0)
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
    top, left, bottom, right = chart.extent()
    what = (
        f"{right - left} × {bottom - top} cells of {settings.resolution:g} m, beams of up to {longest:.0f} m"
    )
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
    chosen, (top, left, bottom, right) = chart.settings, chart.extent()
    shape = bottom - top, right - left
    return BresenhamLoop(shape, chosen.hit, chosen.miss, chosen.low, chosen.high)


def cells_of(chart: Map, pose: Pose, swept: BodyScan) -> tuple[tuple[int, int], list[tuple[int, int]]]:
    """Where (row, column) in the rival's array the beams of a scan start and end."""
    top, left, *_ = chart.extent()
    points = np.concatenate([[(pose.x, pose.y)], to_world(swept.ends, pose)])
    start, *ends = [(row - top, column - left) for column, row in chart.cells(points).tolist()]
    return start, ends
