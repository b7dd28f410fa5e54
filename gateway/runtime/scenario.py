"""Running a scenario: what happens to the robot is done at its time, and what must hold is judged.

Rules. The judge trusts no report where the world is simulated: motion, touches and distances are the world's.
A real joint's motion is what it measures. What happens goes by `ask` and by `gateway.buses.virtual` alone, so
that the robot cannot tell a scenario from an accident. Where every bus is a twin it runs in simulated time,
and repeats exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from brain.belief import Belief, BrainState
from gateway.buses.virtual.bus import TwinWorld
from gateway.buses.virtual.faults import CAUSES, Site
from gateway.buses.virtual.tamper import Tamper, composed
from gateway.core.robot import TWIN
from gateway.core.tick import Tick
from gateway.runtime.scenario_file import (
    LOOP,
    ROBOT,
    Ask,
    FaultEvent,
    LoadStep,
    MustReach,
    MustStand,
    MustTell,
    MustTurn,
    Requirement,
    Scenario,
)
from gateway.runtime.session import Session, open_session
from protocols.conformance.random import Random
from protocols.messages import MILLISECOND, SECOND, Instruction, Nanos

STANDS, STANDS_TURNING, STANDS_BASE = 0.3, 0.1, 0.02
"""rad/s of a shaft, rad/s and m/s of a base: what is slower stands."""
LOOK: Nanos = 20 * MILLISECOND
"""Time between two looks at distances."""
KEPT = 10_000
"""Reports that are kept."""


@dataclass(frozen=True, slots=True)
class JudgedRequirement:
    """One thing that had to hold."""

    name: str
    """As in the file: "must.tell.silence", "never.touches\""""
    holds: bool
    text: str
    """What was found"""


@dataclass(frozen=True, slots=True)
class ScenarioResult:
    """What came of a scenario."""

    scenario: Scenario
    verdicts: tuple[JudgedRequirement, ...]
    latencies: tuple[str, ...] = ()
    """Of its real devices, a table in lines"""

    @property
    def passed(self) -> bool:
        """Whether all held."""
        return all(one.holds for one in self.verdicts)

    @property
    def line(self) -> str:
        """What it came to, in a line."""
        failed = sum(not one.holds for one in self.verdicts)
        what = f"FAILED, {failed} of {len(self.verdicts)}" if failed else "ok"
        return f"{self.scenario.path.name}: {self.scenario.file.name}: {what}"

    @property
    def details(self) -> list[str]:
        """What was found of each thing that did not hold."""
        return [f"{one.name}: {one.text}" for one in self.verdicts if not one.holds]


def run_scenario(scenario: Scenario, record: Path | None = None) -> ScenarioResult:
    """Run a scenario, on the robot's buses as they are.

    Args:
        scenario: what `load_scenario` returns.
        record: the recording to write, which must not exist yet.

    Raises:
        GatewayError: what `open_session` raises.
    """
    simulated = all(bus.interface == TWIN for bus in scenario.robot.buses.values())
    seed = scenario.file.seed
    with open_session(
        scenario.robot, simulated=simulated, record=record, seed=seed, world=scenario.world
    ) as session:
        return ScenarioResult(scenario, verdicts(scenario, session), tuple(session.latencies.lines()))


def verdicts(scenario: Scenario, session: Session) -> tuple[JudgedRequirement, ...]:
    """Run a scenario in a session of its robot that has not run yet; return what held."""
    judge, accidents = ScenarioJudge(scenario, session), Accidents(scenario, session)
    session.watch(judge.take)
    with closing(session.run(scenario.file.seconds, poll=accidents.poll)) as ticks:
        for _ in ticks:
            pass
    return judge.verdicts()


class Accidents:
    """What happens, at its time."""

    def __init__(self, scenario: Scenario, session: Session) -> None:
        self._scenario, self._session = scenario, session
        self._began: Nanos | None = None
        self._random = Random(scenario.file.seed)
        events = [(round(one.at * SECOND), name, one) for _, name, one in scenario.file.events()]
        self._coming = sorted(
            ((at, name, one) for at, name, one in events if not hasattr(one, "wall")),
            key=lambda each: each[0],
        )
        """Walls come by themselves: they are the world's."""
        self._going: list[PresentFault] = []

    def poll(self) -> Sequence[Instruction]:
        """Do what is to happen now; return what a person asks."""
        now = self._session.clock.now()
        self._began = now if self._began is None else self._began
        asked: list[Instruction] = []
        while self._coming and self._coming[0][0] <= now - self._began:
            _, name, event = self._coming.pop(0)
            if isinstance(event, Ask):
                asked.append(self._scenario.asks[name])
            elif (world := self._session.twins) is not None:
                self._begin(now, world, event)
        for one in self._going:
            if one.site is not None:
                asked += one.site.each(now)
        for one in [one for one in self._going if now >= one.until]:
            self._end(one)
        takes = self._session.twins.tamper.takes if self._session.twins is not None else None
        if takes is not None and (late := takes(now)):
            self._session.clock.wait(now + late)
        return asked

    def _begin(self, now: Nanos, world: TwinWorld, event: FaultEvent | LoadStep) -> None:
        lasts = math.inf if event.seconds is None else event.seconds
        going = PresentFault(Tamper(), now + lasts * SECOND)
        if isinstance(event, FaultEvent):
            going.site = Site(self._scenario.robot, world, event.on, self._random, now, lasts)
            going.end = CAUSES[event.cause].end
            world.tamper = going.tamper
            CAUSES[event.cause].inject(going.site)
        else:
            on, more = event.on, event.torque
            going.tamper.torques = lambda given: given | {on: given.get(on, 0.0) + more}
        self._going.append(going)
        world.tamper = composed([one.tamper for one in self._going])

    def _end(self, going: PresentFault) -> None:
        self._going.remove(going)
        world = self._session.twins
        if world is not None:
            if going.site is not None:
                going.end(going.site)
            world.tamper = composed([one.tamper for one in self._going])


@dataclass(slots=True, eq=False)
class PresentFault:
    """A fault or load that is there."""

    tamper: Tamper
    until: float
    """When it is over [ns]; infinite if it stays"""
    site: Site | None = None
    end: Callable[[Site], None] = lambda _site: None


@dataclass(slots=True)
class ScenarioJudge:
    """Sees each tick, and says at the end what held."""

    scenario: Scenario
    session: Session
    now: float = 0.0
    """s since the beginning"""
    fastest: float = 0.0
    nearest: float = math.inf
    _began: Nanos | None = None
    _looked: Nanos = -LOOK
    _reached: list[float] = field(default_factory=list)
    """When each goal was."""
    _reports: list[tuple[float, str, str]] = field(default_factory=list)
    """When, of what, and what was told."""
    _state: str = ""
    _timing: str = ""
    _faults: set[tuple[str, int, str, Nanos]] = field(default_factory=set)
    _wrong: dict[str, float] = field(default_factory=dict)
    """When each requirement that is to stay so was last not so,"""
    _seen: dict[str, str] = field(default_factory=dict)
    """and how it was."""

    def take(self, tick: Tick, belief: Belief) -> None:
        """See what a step has brought."""
        self._began = tick.now if self._began is None else self._began
        since = (tick.now - self._began) / SECOND
        if since > self.scenario.file.seconds:
            return  # the stop action at the end
        self.now = since
        self._reached += [self.now] * (belief.reached - len(self._reached))
        self._listen(tick, belief)
        self.fastest = max(self.fastest, abs(self._speed(belief)[0]))
        twins, least = self.session.twins, self.scenario.file.never.nearer
        if twins is not None and least is not None and tick.now - self._looked >= LOOK:
            self._looked = tick.now
            self.nearest = min(self.nearest, twins.world.clearance())
        for name, one in self.scenario.file.must.all().items():
            if isinstance(one, MustStand | MustTurn) and (seen := self._moves(one, belief)):
                self._wrong[name], self._seen[name] = self.now, seen

    def _listen(self, tick: Tick, belief: Belief) -> None:
        found = [(note.source, note.text) for note in tick.outputs.notes if note.level != "info"]
        for name, joint in self.session.joints.items():
            for fault in joint.faults.values():
                key = name, fault.code, fault.name, fault.t
                if key not in self._faults:
                    self._faults.add(key)
                    found.append((name, f"{fault.name}: {fault.cause}"))
        state = belief.reason if belief.state in (BrainState.DEGRADED, BrainState.STOPPED) else ""
        if state and state != self._state:
            found.append(("brain", state))
        self._state = state
        timing = self.session.stats.trouble
        if timing and not self._timing:
            found.append((LOOP, timing))
        self._timing = timing
        room = KEPT - len(self._reports)
        self._reports += [(self.now, *each) for each in found[:room]]

    def _speed(self, belief: Belief) -> tuple[float, float]:
        """Return how fast the base moves [m/s], and turns [rad/s]."""
        twins = self.session.twins
        if twins is not None and twins.world.scene is not None:
            forward, left, turning = twins.world.twist()
            return math.hypot(forward, left), turning
        if (estimate := belief.estimate) is None:
            return 0.0, 0.0
        return math.hypot(estimate.linear, estimate.lateral), estimate.angular

    def _velocity(self, motor: str) -> float:
        """Return the velocity [rad/s] of an output shaft; NaN if nothing tells it."""
        twins = self.session.twins
        if twins is not None and twins.simulates(motor):
            return twins.world.shaft(motor)[1]
        feedback = self.session.joints[motor].feedback
        return math.nan if feedback is None or feedback.velocity is None else feedback.velocity

    def _moves(self, one: MustStand | MustTurn, belief: Belief) -> str:
        """Return how something is not as it is to stay; "" if it is."""
        if isinstance(one, MustTurn):
            velocity = self._velocity(one.on)
            return "" if abs(velocity - one.velocity) <= one.tolerance else f"{velocity:.2f} rad/s"
        if one.on != ROBOT:
            velocity = self._velocity(one.on)
            return "" if abs(velocity) <= STANDS else f"{velocity:.2f} rad/s"
        if self.session.robot.brain.abilities(self.session.robot.motors).base is not None:
            speed, turning = self._speed(belief)
            stands = speed <= STANDS_BASE and abs(turning) <= STANDS_TURNING
            return "" if stands else f"{speed:.2f} m/s, {turning:.2f} rad/s"
        moving = {name: self._velocity(name) for name in self.session.joints}
        shown = [f"{name} {one:.2f} rad/s" for name, one in moving.items() if not abs(one) <= STANDS]
        return ", ".join(shown)

    # -- at the end -----------------------------------------------------------------------------------

    def verdicts(self) -> tuple[JudgedRequirement, ...]:
        """Return what held, and what did not."""
        file = self.scenario.file
        judged = [self._judged(name, one) for name, one in file.must.all().items()]
        if self.session.reasons:
            text = f"it ended after {self.now:.2f} of {file.seconds:g} s: {self.session.reasons[0]}"
            judged.append(JudgedRequirement("seconds", holds=False, text=text))
        return (*judged, *self._never())

    def _judged(self, name: str, one: Requirement) -> JudgedRequirement:
        since = self.scenario.moment(one.after)
        until = since + one.within
        about = f"within {one.within:g} s" + (f" after {one.after!r}" if one.after else "")
        holds, found = False, ""
        if isinstance(one, MustReach):
            done = sum(t <= until for t in self._reached)
            holds, found = done >= one.goals, f"{done} of {one.goals} goals reached {about}"
        elif isinstance(one, MustTell):
            times = [t for t, on, text in self._reports if t >= since and self._is_about(one, on, text)]
            when = f"told after {times[0] - since:.2f} s" if times else "not told"
            heard = [f"{on}: {text}" for t, on, text in self._reports if t >= since][:3]
            other = f"; what was told: {' | '.join(heard) or 'nothing'}" if not times else ""
            holds = bool(times) and times[0] <= until
            found = f"{one.text!r} of {one.on}: {when}, expected {about}{other}"
        else:
            last = self._wrong.get(name, -math.inf)
            holds = last <= until
            seen = self._seen.get(name, "as asked")
            found = f"{seen} at {max(last, 0.0):.2f} s, expected to be as asked {about}"
        return JudgedRequirement(f"must.{name}", holds, found)

    @staticmethod
    def _is_about(one: MustTell, on: str, text: str) -> bool:
        named = on == one.on or (on == "brain" and one.on in text.replace(":", " ").replace(",", " ").split())
        return named and one.text.lower() in text.lower()

    def _never(self) -> list[JudgedRequirement]:
        never, twins = self.scenario.file.never, self.session.twins
        found: list[JudgedRequirement] = []
        if never.faster is not None:
            text = f"{self.fastest:.3f} m/s, expected at most {never.faster:g}"
            found.append(JudgedRequirement("never.faster", self.fastest <= never.faster, text))
        if never.nearer is not None:
            text = f"{self.nearest:.3f} m, expected at least {never.nearer:g}"
            found.append(JudgedRequirement("never.nearer", self.nearest >= never.nearer, text))
        if never.touches is not None:
            touches = math.inf if twins is None else twins.world.contacts()
            text = f"{touches:g} touches, expected at most {never.touches}"
            found.append(JudgedRequirement("never.touches", touches <= never.touches, text))
        return found
