"""A program of a user: every joint a spring, with a set-point of its own at every step; what that costs.

    springs ROBOT.toml RATE SECONDS BUS=INTERFACE …

It runs as a `Program` of these tests. It counts from `SETTLED` on, and then prints when that was and when it
ended, by the system's clock as candump's stamps are; the steps made and missed meanwhile; processor time."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, replace
from pathlib import Path

from gateway.config import load_robot, with_interfaces
from gateway.core.clock import processor_time
from gateway.core.robot import Robot
from gateway.runtime.session import Session, open_session
from protocols.messages import SECOND, Impedance, Nanos

ROBOTS = Path(__file__).with_name("robots")
SETTLED = 3 * SECOND // 2
"""Time to find the motors, set them up and arm them."""
AMPLITUDE, FREQUENCY = 0.2, 0.5
"""rad and Hz, of the set-points."""
STIFFNESS, DAMPING = 1.0, 0.05
"""N·m/rad and N·m·s/rad"""


@dataclass(frozen=True, slots=True)
class Mark:
    """What has been counted up to a moment."""

    at: Nanos
    """By the system's clock."""
    steps: int
    missed: int
    processor: Nanos


def mark(session: Session) -> Mark:
    return Mark(time.time_ns(), session.stats.ticks, session.stats.missed, processor_time())


def springs(robot: Robot, now: Nanos) -> list[Impedance]:
    """The set-points of a moment: each joint's own."""
    phase = 2.0 * math.pi * FREQUENCY * now / SECOND
    angles = {name: phase + number for number, name in enumerate(robot.motors)}
    return [
        Impedance(name, AMPLITUDE * math.sin(angle), 0.0, 0.0, STIFFNESS, DAMPING)
        for name, angle in angles.items()
    ]


def main(arguments: Sequence[str]) -> int:
    """Run, and print both moments and what was counted between them."""
    path, rate, seconds, *buses = arguments
    robot = with_interfaces(load_robot(Path(path)), dict(one.split("=", 1) for one in buses))
    with open_session(replace(robot, period=round(SECOND / float(rate)))) as session:
        began = None
        with closing(session.run(poll=lambda: springs(robot, session.clock.now()))) as ticks:
            for tick in ticks:
                if began is None and tick.now >= SETTLED:
                    began, ends = mark(session), tick.now + round(float(seconds) * SECOND)
                    print("counting", flush=True)
                elif began is not None and tick.now >= ends:
                    ended = mark(session)
                    counted = [b - a for a, b in zip(astuple(began)[1:], astuple(ended)[1:], strict=True)]
                    print("counted", began.at, ended.at, *counted, flush=True)
                    break
    return 0
