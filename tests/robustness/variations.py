"""The table of variations, and cases drawn at random over the same quantities."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from brain.belief import Pose
from tests.robustness.judge import Case, Expected, Then, in_odom
from tests.robustness.plant import Base, Figures, Person, rectangle

GOALS = ((1.6, 0.6), (5.6, 1.0), (3.4, -2.2))
"""m, in the office: two rooms, through the doorway"""
WORLDS = ("office", "maze", "hall", "corridor")
FAST = 0.45
"""m/s, at which what appears ahead is met"""


def office(name: str, **changes: Any) -> Case:
    """Return a case in the office; figures by their names, other changes as of Case."""
    own = {key: changes.pop(key) for key in list(changes) if key in Figures.__dataclass_fields__}
    return Case(**{"name": name, "goals": GOALS, "figures": Figures(**own), **changes})


def started(x: float, y: float, yaw: float) -> dict[str, Any]:
    """Return a start and the goals from there."""
    start = Pose(x, y, yaw)
    odom = [in_odom(start, Pose(*goal, 0.0)) for goal in GOALS]
    return {"start": start, "goals": tuple((pose.x, pose.y) for pose in odom)}


def moved(**boxes: tuple[float, float]) -> Callable[[Base], None]:
    """Return an arrangement with boxes elsewhere, each by dx and dy."""

    def arrange(base: Base) -> None:
        for name, (dx, dy) in boxes.items():
            base.shift(name, dx, dy)

    return arrange


def door(width: float) -> Callable[[Base], None]:
    """Return an arrangement with a doorway of this width."""
    middle, length = 1.75 + width / 2.0, 2.5 - width
    return lambda base: base.add("divider_north", rectangle(2.6, middle, math.pi / 2.0, length, 0.1))


def close(base: Base) -> None:
    """Close the doorway."""
    base.add("door", rectangle(2.6, 1.05, math.pi / 2.0, 1.1, 0.05))


def appears(
    distance: float, width: float, bearing: float = 0.0, depth: float = 0.05
) -> Callable[[Base], None]:
    """Return the appearance of a box or screen."""
    return lambda base: base.put("screen", distance, width, bearing, depth)


def passing(
    distance: float, width: float, at: float = 1.5, bearing: float = 0.0, sides: float = 0.0
) -> tuple[Then, ...]:
    """Return a screen that appears before the moving base, others so far at its sides, all gone 8 s later."""

    def appear(base: Base) -> None:
        base.put("screen", distance, width, bearing)
        for name, turn in (("left", math.pi / 2.0), ("right", -math.pi / 2.0)):
            if sides:
                base.put(name, sides, 2.0 * distance, turn)

    def vanish(base: Base) -> None:
        for name in {"screen", "left", "right"} & base.solids.keys():
            base.remove(name)

    return Then(at, appear, FAST), Then(at + 8.0, vanish)


def through_the_door(base: Base) -> None:
    """A person comes through the doorway towards the base."""
    base.people["person"] = Person(4.6, 1.05, -0.5, 0.0)


def goal(name: str, x: float, y: float, **changes: Any) -> Case:
    """Return a case with one goal in the office that cannot be reached."""
    return office(f"goal {name}", **{"goals": ((x, y),), "expect": "refused", "limit": 120.0, **changes})


def happens(name: str, at: float, what: Callable[[Base], None], moving: float = 0.0, **changes: Any) -> Case:
    """Return a case in the office with one event."""
    return office(name, then=(Then(at, what, moving),), **changes)


def short(length: float) -> Callable[[Base], None]:
    """Return an arrangement with a corridor of this length."""
    return lambda base: base.add("east", rectangle(length - 1.0, 0.0, 0.0, 0.1, 1.9))


FOUND: Expected = "found"
TABLE: tuple[Case, ...] = (
    *(office(f"base {number}") for number in range(6)),
    *(office(f"slip {sigma:.0%}", slip=sigma) for sigma in (0.03, 0.06, 0.10, 0.15)),
    office("slip 10% over 5 m", slip=0.10, slip_length=5.0),
    *(office(f"gyro bias {bias:+.2f}", gyro_bias=bias) for bias in (0.02, 0.05, -0.05)),
    office("gyro noise x10", gyro_noise=0.03),
    *(office(f"encoder {counts} counts", counts=counts) for counts in (512, 64)),
    *(office(f"lidar noise {noise:.2f} m", range_noise=noise) for noise in (0.02, 0.03, 0.05)),
    *(office(f"lidar dropouts {share:.0%}", dropout=share) for share in (0.1, 0.4)),
    *(office(f"lidar range {far:.0f} m", range=far) for far in (5.0, 3.0)),
    office("lidar 90 beams at 5 Hz", beams=90, scan_hz=5.0),
    *(office(f"wheel radius {error:+.0%}", radius_errors=(error, error)) for error in (0.05, -0.05)),
    *(office(f"wheel radii {e:.0%} apart", radius_errors=(e / 2.0, -e / 2.0)) for e in (0.03, 0.05)),
    *(office(f"wheel separation {error:+.0%}", separation_error=error) for error in (0.1, -0.1)),
    office("start in the east room", **started(5.6, 1.0, 2.0)),
    office("start in a corner", **started(-0.9, -2.4, 0.8)),
    office("start in the doorway", **started(2.6, 1.05, math.pi)),
    office("boxes moved 1", arrange=moved(desk=(0.3, -0.4), table=(0.3, 0.2), crate=(-0.3, 0.3))),
    office("boxes moved 2", arrange=moved(desk=(-0.7, -0.2), table=(0.5, 0.2), pillar=(0.4, -0.3))),
    office("boxes moved 3", arrange=moved(desk=(0.5, 0.5), table=(-0.6, -0.1), cabinet=(0.2, -2.0))),
    Case(name="hall, north", world="hall", goals=((8.0, 3.5),)),
    Case(name="hall, south", world="hall", goals=((9.0, -7.2),)),
    office("glass: east wall", glass=frozenset({"east"})),
    office("glass: east and north walls", glass=frozenset({"east", "north"})),
    office("glass: table", glass=frozenset({"table"}), goals=(*GOALS[:2], (0.2, 1.8))),
    *(
        office(f"lidar mounting stated {d}° wrong", mount_yaw=math.radians(d), expect="named", word="mount")
        for d in (2, 5)
    ),
    office("spinning lidar", sweep=True),
    office("spinning lidar, duration not stated", sweep=True, stated=False),
    *(
        Case(name=f"maze, lidar {far:.0f} m", world="maze", figures=Figures(range=far), goals=((5.6, 4.2),))
        for far in (10.0, 4.0)
    ),
    *(
        Case(
            name=f"corridor 13 m, lidar {far:.0f} m",
            world="corridor",
            figures=Figures(range=far),
            goals=((10.5, 0.2),),
            arrange=short(13.0),
        )
        for far in (10.0, 4.0)
    ),
    Case(name="corridor 25 m", world="corridor"),
    *(office(f"door {width:.2f} m", arrange=door(width)) for width in (0.8, 0.7, 0.65, 0.6)),
    office("door closed for 20 s", arrange=close, then=(Then(20.0, lambda base: base.remove("door")),)),
    happens("door closed for good", 2.0, close, goals=((5.6, 1.0),), expect="refused", limit=120.0),
    goal("in a box", 1.2, -1.3),
    goal("in a wall", 2.6, -1.5),
    goal("near a wall", -1.35, 0.2),
    goal("outside", 8.0, 0.0),
    goal("off the map", 40.0, 0.0),
    goal("in a closed room", 5.6, 1.0, arrange=close),
    happens("lidar dies", 6.0, lambda base: base.silence("lidar"), expect="stops", limit=60.0),
    happens("IMU dies", 6.0, lambda base: base.silence("imu")),
    happens("lidar gone for 2 s", 6.0, lambda base: base.silence("lidar", 2.0)),
    happens("moved 0.14 m, 6°", 3.0, lambda base: base.move(0.14, math.radians(6.0)), expect=FOUND),
    happens("moved 0.5 m", 3.0, lambda base: base.carry(0.5, 0.0), FAST, expect=FOUND),
    happens("turned 30°", 3.0, lambda base: base.move(0.0, math.radians(30.0)), FAST, expect=FOUND),
    happens("moved 2 m", 3.0, lambda base: base.carry(2.0, 0.0), FAST, expect=FOUND),
    *(
        Case(name=name, world="hall", goals=((8.0, 3.5),), then=(Then(1.0, what, FAST),))
        for name, what in (
            ("box appears 0.8 m ahead", appears(0.8, 0.4, 0.0, 0.4)),
            ("box appears 1.2 m ahead", appears(1.2, 0.4, 0.0, 0.4)),
            ("wall of 3 m appears 1.2 m ahead", appears(1.2, 3.0)),
        )
    ),
    *(
        office(f"screens {far} m ahead and beside", then=passing(far, 2.0, sides=0.6), expect="safe")
        for far in (0.8, 1.0, 1.5)
    ),
    happens("person 0.3 m/s across", 1.5, lambda base: base.cross(1.7, 0.9, 0.3), FAST),
    happens("person 1.0 m/s across", 1.5, lambda base: base.cross(1.5, 1.6, 1.0), FAST),
    happens("person 0.5 m/s through the door", 3.0, through_the_door),
)
"""The 79 variations of the first survey, run by run."""

MORE: tuple[Case, ...] = (
    office("without IMU", imu=False),
    office("lidar turned by 180°", mount_yaw=math.pi, goals=((1.0, 0.0),), expect="named", word="lidar"),
    office("gyro lies by 0.1 rad/s while moving", gyro_lie=0.1, expect="named", word="imu", limit=60.0),
    *(
        office(f"by hand against a wall, {v} m/s", drive=(v, 0.0), expect="stops", limit=15.0)
        for v in (0.2, 0.5)
    ),
    office("by hand against a screen", drive=(0.5, 0.0), then=passing(0.8, 1.0, 1.0), limit=15.0),
)
"""What the survey did not have."""


def screen(seed: int) -> Case:
    """Draw a screen before the moving base: 0.8, 1.0 or 1.5 m off, ahead or to a side."""
    random = np.random.Generator(np.random.PCG64([1, seed]))
    distance, side = (0.8, 1.0, 1.5)[seed % 3], (0.0, 25.0, -25.0, 50.0, -50.0)[seed // 3 % 5]
    width, at = float(random.uniform(0.4, 2.0)), float(random.uniform(1.0, 8.0))
    then = passing(distance, width, at, math.radians(side), 0.6 * (seed % 2))
    return office(f"screen {distance} m {side:+.0f}° {width:.2f} m wide", then=then, expect="safe")


def carried(seed: int) -> Case:
    """Draw a move by at least 0.3 m or 15°, while driving."""
    random = np.random.Generator(np.random.PCG64([2, seed]))
    far, yaw = float(random.uniform(0.3, 2.5)), float(random.uniform(15.0, 180.0) * random.choice([-1, 1]))
    far, yaw = ((far, 0.0), (0.0, yaw), (far, yaw))[seed % 3]
    at = float(random.uniform(4.0, 12.0))
    name = f"carried {far:.2f} m, turned {yaw:.0f}°"
    then = (Then(at, lambda base: base.carry(far, math.radians(yaw)), 0.2),)
    return office(name, then=then, expect=FOUND, limit=30.0)


def drawn(seed: int) -> Case:
    """Draw figures, boxes, and at times a screen, over the quantities of the table."""
    random = np.random.Generator(np.random.PCG64([3, seed]))

    def within(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    figures = {
        "slip": within(0.0, 0.1), "slip_length": within(0.1, 3.0), "counts": int(2 ** within(8, 17)),
        "radius_errors": (within(-0.04, 0.04), within(-0.04, 0.04)), "separation_error": within(-0.1, 0.1),
        "gyro_bias": within(-0.05, 0.05), "gyro_noise": within(0.001, 0.03), "dropout": within(0.0, 0.3),
        "range_noise": within(0.002, 0.03), "range": within(4.0, 12.0), "beams": int(within(120, 720)),
    }  # fmt: skip
    boxes = {name: (within(-0.3, 0.3), within(-0.3, 0.3)) for name in ("desk", "table", "pillar")}
    then = passing(within(0.8, 2.0), within(0.3, 1.2), within(1.0, 10.0)) if random.random() < 0.3 else ()
    return office(f"drawn {seed}", arrange=moved(**boxes), then=then, **figures)


def world(name: str, sweep: bool = True) -> Case:
    """Return the tour of a world, with the world's own figures."""
    return Case(name=f"{name}{'' if sweep else ', instant'}", world=name, figures=Figures(sweep=sweep))
