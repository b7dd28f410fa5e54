"""What a way costs to plan, by the size of the ground and the rate of the ticks.

Rules. A navigator is given a goal in the opposite corner of ground that is all known, but of which nothing is
drawn yet; it is stepped at its rate until it has a path, or knows that there is none. The same place at
another rate must have the same answer: a path is compared point by point, and a difference raises.
`python -m benchmarks.plans` prints the table.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from benchmarks.measure import Effort, NotMeasured, figures
from benchmarks.paths import Mask, Picture
from benchmarks.rows import Beside, Row, Target, span
from brain.bodies.differential import Differential
from brain.planning.costmap import PlannerSettings
from brain.planning.navigator import Navigator
from brain.planning.planner import Path
from brain.planning.polyline import Point, Polyline
from gateway.core.clock import processor_time
from gateway.runtime.process import quiet_collector
from protocols.messages import SECOND, Goal, Nanos, seconds

GROUP = (
    "a way across all of a place, of which nothing is drawn yet: processor time of all its steps at 500 Hz"
)
AT_MOST = float(SECOND)
RATES = (50, 100, 200, 500)
SIZES = (25, 50, 100, 200)
"""m along each side"""
RESOLUTION = 0.1
"""m per cell, as they are printed; finer ones are a matter of `--resolution`"""
SEED = 3
INSET = 1.0
"""m of start and goal from two opposite corners"""
MOST: Nanos = 300 * SECOND
"""Simulated, after which it would not end"""


def serpentine(size: float, resolution: float) -> Mask:
    """Walls all 4 m, with a gap of 2 m at one end and then at the other."""
    cells, apart, gap = (round(length / resolution) for length in (size, 4.0, 2.0))
    occupied = _walled(cells)
    for number, column in enumerate(range(apart, cells - apart // 2, apart)):
        occupied[:, column] = True
        opening = slice(cells - 1 - gap, cells - 1) if number % 2 == 0 else slice(1, 1 + gap)
        occupied[opening, column] = False
    return occupied


def clutter(size: float, resolution: float) -> Mask:
    """A pillar of 0.2 m on every 3 m²."""
    cells, pillar, clear = (round(length / resolution) for length in (size, 0.2, 2.0 * INSET))
    random = np.random.Generator(np.random.PCG64(SEED))
    occupied = _walled(cells)
    for row, column in random.integers(0, cells - pillar, (round(0.3 * size * size), 2)).tolist():
        occupied[row : row + pillar, column : column + pillar] = True
    occupied[1:clear, 1:clear] = occupied[-clear:-1, -clear:-1] = False
    return occupied


def closed(size: float, resolution: float) -> Mask:
    """Clutter, and the goal in a room of 3 m without a door."""
    occupied, room = clutter(size, resolution), round(3.0 / resolution)
    occupied[-room, -room:] = occupied[-room:, -room] = True
    return occupied


def halved(size: float, resolution: float) -> Mask:
    """Clutter, and a wall across all of it."""
    occupied = clutter(size, resolution)
    occupied[len(occupied) // 2] = True
    return occupied


PLACES: dict[str, Callable[[float, float], Mask]] = {
    "serpentine": serpentine,
    "clutter": clutter,
    "goal in a closed room": closed,
    "a wall across": halved,
}


def _walled(cells: int) -> Mask:
    occupied = np.zeros((cells, cells), np.bool_)
    occupied[[0, -1], :] = occupied[:, [0, -1]] = True
    return occupied


BODY = Differential(
    left="left",
    right="right",
    wheel_radius=0.05,
    wheel_separation=0.3,
    radius=0.25,
    max_linear=0.6,
    max_angular=2.0,
    max_linear_acceleration=0.8,
    max_angular_acceleration=4.0,
)


@dataclass(frozen=True, slots=True)
class Answer:
    """What a navigator has found."""

    points: tuple[Point, ...]
    """Of the path; none if there is none"""
    words: str
    """The path's length, or why there is none"""
    took: Nanos
    """Simulated"""
    processor: tuple[Nanos, ...]
    """Processor time of each step"""


def ask(place: Picture, size: float, rate: int, settings: PlannerSettings | None = None) -> Answer:
    """Send one goal, and step until there is an answer. Raises NotMeasured if there is none."""
    navigator, now, took = Navigator(BODY, settings or PlannerSettings()), 0, list[Nanos]()
    navigator.accept(now, Goal(size - INSET, size - INSET))
    while navigator.path is None and not navigator.no_path_reason:
        began = processor_time()
        navigator.step(now, (INSET, INSET), place)
        took.append(processor_time() - began)
        now += SECOND // rate
        if now > MOST or not navigator.busy:
            raise NotMeasured(f"no answer after {seconds(now):g} s: {navigator.goals.given_up}")
    if isinstance(navigator.path, Path):
        points = navigator.path.points
        return Answer(points, f"{Polyline(points).length:.1f} m", now, tuple(took))
    return Answer((), navigator.no_path_reason or "unknown ground", now, tuple(took))


def answers(
    name: str, size: float, rates: tuple[int, ...], resolution: float = RESOLUTION
) -> Iterator[tuple[int, Answer]]:
    """Ask at each rate. Raises NotMeasured if the answers differ."""
    place = Picture(PLACES[name](size, resolution), resolution)
    first: Answer | None = None
    for rate in rates:
        with quiet_collector():
            found = ask(place, size, rate)
        first = first or found
        if (found.points, found.words) != (first.points, first.words):
            raise NotMeasured(
                f"{name} of {size:g} m: {found.words} at {rate} Hz, {first.words} at {rates[0]} Hz"
            )
        yield rate, found


def plans(effort: Effort) -> list[Row]:
    """The largest size at the slowest and the quickest rate; in short runs, the smallest."""
    size, rows = effort.of(SIZES[-1], SIZES[0]), list[Row]()
    for name in PLACES:
        (_, slow), (_, quick) = answers(name, size, (RATES[0], RATES[-1]))
        whole, other = (figures([float(sum(found.processor))]) for found in (quick, slow))
        rows.append(
            Row(GROUP, f"{name}, {size} m", whole, (Beside(f"at {RATES[0]} Hz", other),), Target(AT_MOST))
        )
        for rate, found in zip((RATES[0], RATES[-1]), (slow, quick), strict=True):
            longest, tick = figures([float(max(found.processor))]), span("the tick", SECOND / rate)
            rows.append(Row(GROUP, f"{name}, {size} m: longest step at {rate} Hz", longest, (tick,)))
    return rows


def what(size: int) -> list[str]:
    """Return the rows' names."""
    each = ("", *(f": longest step at {rate} Hz" for rate in (RATES[0], RATES[-1])))
    return [f"{name}, {size} m{part}" for name in PLACES for part in each]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.plans", description=__doc__)
    parser.add_argument("--resolution", type=float, default=RESOLUTION, help="m per cell")
    parser.add_argument("--sizes", type=float, nargs="+", default=SIZES, help="m")
    options = parser.parse_args()
    print("place                  size m   Hz  waits s  processor s  longest step ms  answer")
    for name, size in product(PLACES, options.sizes):
        for rate, found in answers(name, size, RATES, options.resolution):
            whole, longest = sum(found.processor) / SECOND, max(found.processor) / 1e6
            head = f"{name:21} {size:7g} {rate:4} {seconds(found.took):8.2f} {whole:12.3f} {longest:16.2f}"
            print(f"{head}  {found.words}", flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
