"""A recording's requests asked again, of its robot in the simulated world: figures of what comes of it.

Rules. What persons and programs asked comes at the times at which it came, counted from the first tick; all
else is new: the world answers what the robot does now. Every device is a twin. With the robot file, the world
and the seed of a recording that was simulated itself, every byte is the recorded one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from math import hypot, inf
from pathlib import Path

from brain.belief import Belief, MapView, Pose
from gateway.config import with_interfaces
from gateway.core.robot import TWIN, Robot
from gateway.core.tick import Tick
from gateway.errors import UserError
from gateway.replay.input_log import InputLog, run
from gateway.report.condition import told
from gateway.report.watcher import Figure, Watcher
from gateway.runtime.scenario import Accidents, JudgedRequirement, ScenarioJudge
from gateway.runtime.scenario_file import Scenario
from gateway.runtime.session import Session, open_session
from gateway.sim import SceneFile
from gateway.sim.from_map import grid_of, place_of
from protocols.messages import SECOND, Instruction, Leave, Nanos

SHOWN = 20
"""Things that are told of a run"""
LOOK: Nanos = 20_000_000
"""Time between two looks at distances"""


@dataclass(frozen=True, slots=True)
class DrivenAgain:
    """What came of it."""

    figures: Mapping[str, Figure]
    """Those of `gateway judge`, and what only the world knows"""
    digests: Mapping[str, Sequence[str]]
    """By bus, of what was sent in each second"""
    verdicts: Sequence[JudgedRequirement]
    """On what must hold"""
    told: Sequence[str]
    """Warnings and errors, each when it came first"""

    @property
    def passed(self) -> bool:
        """Whether all held that must."""
        return all(one.holds for one in self.verdicts)


def simulated(robot: Robot) -> Robot:
    """Return the robot with every device simulated."""
    return replace(with_interfaces(robot, dict.fromkeys(robot.buses, TWIN)), real=())


def asked(log: InputLog) -> list[tuple[Nanos, Sequence[Instruction]]]:
    """Return what was asked, and when, since the first tick; without what ended the run."""
    start = log.ticks[0].now if log.ticks else 0
    found = ((now - start, inputs.instructions) for now, inputs in log.ticks if inputs.instructions)
    return [(at, asks) for at, asks in found if not any(isinstance(one, Leave) for one in asks)]


def lasts(log: InputLog) -> float:
    """Return how long it ran until it was to end [s]."""
    if not log.ticks:
        return 0.0
    ends = (now for now, inputs in log.ticks if any(isinstance(one, Leave) for one in inputs.instructions))
    return (next(ends, log.ticks[-1].now) - log.ticks[0].now) / SECOND


def recorded_world(log: InputLog) -> SceneFile:
    """Return what was mapped in a recording as a place, in which the robot begins where it began there.

    Raises UserError if nothing was mapped, or more than can be simulated."""
    begins: Pose | None = None
    view: MapView | None = None
    for _, belief in run(log):
        view = belief.map or view
        if begins is None and belief.estimate is not None:
            begins = belief.estimate.pose
    base = log.robot.brain.base
    if view is None or begins is None or base is None:
        raise UserError("nothing was mapped in the recording: there is no world to be made of it")
    return place_of(grid_of(view), "recorded", begins, base.radius)


def drive_again(
    log: InputLog, scenario: Scenario, record: Path | None = None, seed: int | None = None
) -> DrivenAgain:
    """Ask a robot again what a recording asks of it.

    Args:
        log: of the recording.
        scenario: the robot, simulated, and what happens meanwhile (`parse_faults`).
        record: a recording to write, which must not exist yet.
        seed: of the simulated world's noise; None: the robot file's.

    Raises:
        GatewayError: what `open_session` raises.
    """
    with open_session(
        scenario.robot, simulated=True, record=record, seed=seed, world=scenario.world
    ) as session:
        judge, accidents = ScenarioJudge(scenario, session), Accidents(scenario, session)
        watched = _Watched(session)
        session.watch(judge.take)
        session.watch(watched.take)
        requests = _Requests(asked(log), session)
        poll = requests.poll

        def both() -> Sequence[Instruction]:
            return [*poll(), *accidents.poll()]

        with closing(session.run(scenario.file.seconds, poll=both)) as ticks:
            for _ in ticks:
                pass
        return DrivenAgain(watched.figures(), watched.watcher.digests(), judge.verdicts(), watched.told.lines)


class _Requests:
    """What was asked, at its time."""

    def __init__(self, coming: list[tuple[Nanos, Sequence[Instruction]]], session: Session) -> None:
        self._coming, self._session = coming, session
        self._began: Nanos | None = None

    def poll(self) -> Iterator[Instruction]:
        """Yield what is asked now."""
        now = self._session.clock.now()
        self._began = now if self._began is None else self._began
        while self._coming and self._coming[0][0] <= now - self._began:
            yield from self._coming.pop(0)[1]


class Told:
    """Warnings and errors of a run, each when it came first."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._began: Nanos | None = None
        self._said: set[str] = set()

    def take(self, tick: Tick, belief: Belief) -> None:
        """Take a tick, and the belief after it."""
        self._began = tick.now if self._began is None else self._began
        since = (tick.now - self._began) / SECOND
        for line in told(tick, belief):
            if line not in self._said and len(self.lines) < SHOWN:
                self._said.add(line)
                self.lines.append(f"{since:.2f} s: {line}")


class _Watched:
    """What is seen of a run, from outside too."""

    def __init__(self, session: Session) -> None:
        self.watcher = Watcher(session.gateway)
        self.told = Told()
        self._session = session
        self._looked: Nanos = -LOOK
        self._nearest = self._worst = 0.0

    def take(self, tick: Tick, belief: Belief) -> None:
        """Take a tick, and the belief after it."""
        self.watcher.take(tick, belief)
        self.told.take(tick, belief)
        twins = self._session.twins
        if twins is None or twins.world.scene is None or tick.now - self._looked < LOOK:
            return
        self._nearest = min(inf if self._looked < 0 else self._nearest, twins.world.clearance())
        self._looked = tick.now
        if belief.estimate is not None:
            true, pose = twins.world.truth(), belief.estimate.pose
            self._worst = max(self._worst, hypot(true.x - pose.x, true.y - pose.y))

    def figures(self) -> dict[str, Figure]:
        """Return the figures of the run."""
        found, twins = self.watcher.figures(), self._session.twins
        if twins is not None and twins.world.scene is not None:
            found["error of the believed place, most"] = Figure(self._worst, 0.02, "m")
            found["nearest to anything"] = Figure(self._nearest, 0.02, "m")
        if twins is not None:
            found["touches"] = Figure(twins.world.contacts(), 0)
        return found
