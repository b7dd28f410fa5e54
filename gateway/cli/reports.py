"""The report of a run: `--report FILE`, collected while it runs and written when it has ended."""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from os import W_OK, access
from pathlib import Path
from typing import TYPE_CHECKING

from brain.belief import Pose
from brain.bodies.plane import seen_from
from gateway.core.clock import date
from gateway.core.step import LEFT_ARMED
from gateway.errors import UserError
from protocols.messages import MILLISECOND

if TYPE_CHECKING:
    from gateway.runtime.session import Session
    from gateway.sim.world import World


def add_report(parser: ArgumentParser) -> None:
    """Add --report."""
    parser.add_argument(
        "--report",
        type=Path,
        metavar="FILE",
        help="write a report (HTML: map, plots, figures, log), which opens in a browser without a network",
    )


def check_report(file: Path) -> None:
    """Raise UserError if a report cannot be written there: a long run must not end in this surprise."""
    if file.is_dir() or not access(file if file.exists() else file.parent, W_OK):
        raise UserError(f"--report {file}: cannot be written; name a file in a folder that takes files")
    if file.is_symlink():
        raise UserError(f"--report {file}: is a link: name the file itself")


@dataclass(slots=True)
class Ending:
    """What the command adds to a report when the run has ended."""

    ok: bool = False
    figures: tuple[str, ...] = ()
    walls: tuple[tuple[tuple[float, float], ...], ...] = ()
    """In the frame "map"."""


@contextmanager
def reported(session: Session, file: Path | None, what: str) -> Iterator[Ending]:
    """Collect a run while inside, and write its report at the end, also if it ends by an error.

    Raises UserError if the file cannot be written, where that can be known before the run."""
    ending = Ending()
    if file is None:
        yield ending
        return
    check_report(file)
    from gateway.recording import environment
    from gateway.report import Collector, Facts, versions, write

    world = session.twins.world if session.twins is not None else None
    truth = partial(_truth, world, world.truth()) if world is not None else None
    collector = Collector(session.gateway, truth, session.stats.transmission_times())
    session.watch(collector.take)
    error = ""
    try:
        yield ending
    except Exception as raised:
        error = f"ended by an error: {raised}"
        raise
    finally:
        if collector.ticks:
            stats = session.stats
            rows = [
                ("date", date()),
                ("steps", f"{stats.missed} missed, the longest {stats.longest_step / MILLISECOND:.1f} ms"),
                *([("recording", str(session.recorder.path))] if session.recorder else []),
                *versions(environment.facts()),
            ]
            result = error or _result(session)
            write(file, collector, Facts(what, ending.ok, result, tuple(rows), ending.figures, ending.walls))


def _truth(world: World, start: Pose) -> Pose:
    """Return the true pose in the frame "map"."""
    return seen_from(start, world.truth())


def _result(session: Session) -> str:
    """Return how a run ended, in a sentence or some."""
    belief, faults = session.belief, session.gateway.in_fault()
    left = [f"{motor}: {LEFT_ARMED}" for motor in session.gateway.still_armed()]
    if belief.mission is not None:
        why = f": {belief.mission.reason}" if belief.mission.reason else ""
        left.append(f"mission {belief.mission.name}: {belief.mission.phase}{why}")
    if faults:
        left.append(f"left in fault: {faults}")
    if belief.estimate is not None:
        left.append(f"goals reached: {belief.reached}")
    return "\n".join(left or ["ended without a fault"])
