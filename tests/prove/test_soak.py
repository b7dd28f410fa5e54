"""A day of virtual time with recording: memory, file and step stay as declared.

    SOAK_HOURS=24 ./go prove -k "soak and bench"      in one process, since what grows grows with the time

Every hour prints its figures; the numbers of `docs/recording.md` are the bounds. The robot is kept busy:
motions or goals, stops, requests, a device that restarts.
"""

from __future__ import annotations

import gc
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import NamedTuple

import pytest

from gateway.core.tick import Tick
from gateway.recording import read_recording
from gateway.runtime.session import Session, open_session
from protocols import messages as msg
from protocols.messages import SECOND
from tests.protocols.hostile import resident

HOUR = 3600
ACTION = 5
"""s between two actions of the operator"""
FILE, INDEX = {"bench": 700, "diffbot": 1500}, {"bench": 12, "diffbot": 20}
"""MB per hour: of the file, and of the memory for its index (docs/recording.md, with a margin)."""
WARM = 2
"""Hours until every buffer has its size,"""
SLACK = 40
"""and what memory may grow by after that beside the index [MB],"""
OBJECTS = 20_000
"""and the number of objects: up to 1024 ticks are queued for the recorder."""


class Hour(NamedTuple):
    """State at the end of an hour."""

    memory: float
    """MB"""
    objects: int
    file: float
    """MB"""
    ticks: int


def actions(name: str, random: Random) -> Iterator[tuple[msg.Instruction, ...]]:
    """Yield what an operator asks, without end: mostly motions, sometimes a stop and its release."""
    while True:
        for _ in range(random.randrange(20, 100)):
            if name == "bench":
                motor = random.choice(("left", "right"))
                kind = random.choice((msg.Velocity, msg.Torque, msg.Position))
                yield (kind(motor, random.uniform(-3.0, 3.0) * (0.1 if kind is msg.Torque else 1.0)),)
            else:
                yield (msg.Goal(random.uniform(-4.0, 4.0), random.uniform(-3.0, 3.0)),)
        yield (msg.Stop("soak"),)
        yield (msg.ReadParameter("left", "no such parameter"), msg.ClearFault("all"))
        yield (msg.Release(),)


def hours(session: Session, count: int, act: Callable[[int], None]) -> Iterator[Hour]:
    """Run, with an action at each `ACTION`; yield the state after each hour."""
    assert session.recorder is not None
    second = 0
    last: Tick | None = None
    with closing(session.run(count * HOUR + 1.0)) as ticks:
        for last in ticks:
            if last.now < second * SECOND:
                continue
            if second and second % HOUR == 0:
                gc.collect()
                size = session.recorder.path.stat().st_size
                yield Hour(resident(), len(gc.get_objects()), size / 1e6, session.stats.ticks)
            if second % ACTION == 0:
                act(second)
            second += 1
    assert last is not None


@pytest.mark.prove
@pytest.mark.parametrize("name", ["bench", "diffbot"])
def test_soak(name: str, tmp_path: Path) -> None:
    count, seed = int(os.environ.get("SOAK_HOURS", "24")), int(os.environ.get("PROVE_SEED", "1"))
    path, random = tmp_path / "soak.mcap", Random(seed)
    free = shutil.disk_usage(tmp_path).free / 1e6
    assert free > count * FILE[name], f"{free:.0f} MB free: set SOAK_HOURS or --basetemp"
    found: list[Hour] = []
    with open_session(name, simulated=True, record=path, seed=seed) as session:
        script = actions(name, random)

        def act(second: int) -> None:
            session.submit(*next(script))
            if session.twins is not None and second % (HOUR // 4) == HOUR // 8:
                session.twins.reset("left")

        for hour in hours(session, count, act):
            found.append(hour)
            print(f"{name} {len(found)} h:", *(f"{k} {v:.0f}" for k, v in hour._asdict().items()), flush=True)
    assert session.recorder is not None
    assert (session.recorder.lost, session.recorder.trouble) == (0, "")
    for before, after in pairwise(found):
        assert after.file - before.file < FILE[name]
        assert after.ticks - before.ticks == pytest.approx(HOUR * SECOND / session.robot.period, rel=0.5)
    warm = found[min(WARM, len(found)) - 1]
    for since, hour in enumerate(found[WARM:], 1):
        assert hour.memory - warm.memory < SLACK + since * INDEX[name], f"memory grew: {found}"
        assert hour.objects - warm.objects < OBJECTS, f"objects are collected: {found}"
    made = read_recording(path)
    assert made.whole
    assert made.indexed == session.stats.ticks
    path.unlink()
