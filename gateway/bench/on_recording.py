"""Faults put upon the recorded inputs of a run: what would have been told, had these frames been lost?

Rules. The causes are those of the simulated world (`gateway.buses.virtual.faults`), as far as they act on
what is received: frames lost, doubled, late, damaged, or with wrong stamps; a bus away; a device silent. What
acts on the world itself is refused: recorded devices do not answer to it. All else is as it was recorded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

from gateway.bench.again import DrivenAgain, Told
from gateway.buses.virtual.faults import CAUSES, Site
from gateway.buses.virtual.medium import Transmission
from gateway.buses.virtual.tamper import Arriving, Tamper, composed
from gateway.core.clock import SimulatedClock
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from gateway.errors import UserError
from gateway.replay.input_log import MADE_FROM, Given, InputLog, run, write_run
from gateway.report.watcher import Watcher
from gateway.runtime.scenario import ScenarioJudge
from gateway.runtime.scenario_file import Scenario
from gateway.runtime.timing import LoopStats, StepTiming
from protocols.conformance.random import Random
from protocols.frames import BusState, CanFrame, Packet, any_matches
from protocols.messages import SECOND, Nanos


@dataclass(slots=True)
class _Bus:
    """A bus of a recording, as causes know it."""

    gone: bool = False
    states: list[BusState] = field(default_factory=list)

    def lose(self, state: BusState = BusState.GONE) -> None:
        """Receive nothing more."""
        self.gone = True
        self.states.append(state)

    def restore(self) -> None:
        """Receive again."""
        self.gone = False
        self.states.append(BusState.BACK)


class _World:
    """What causes know of the world: only what acts on what is received."""

    def __init__(self, robot: Robot) -> None:
        self.tamper = Tamper()
        self.buses = {name: _Bus() for name in robot.buses}
        self._devices = {one.name: one for one in robot.devices()}
        self._silent: set[str] = set()

    def disconnect(self, name: str) -> None:
        """Let a device be silent."""
        self._silent.add(name)

    def reconnect(self, name: str) -> None:
        """Let it be heard again."""
        self._silent.discard(name)

    def hears(self, packet: Packet) -> bool:
        """True unless its bus is gone, or its device is silent."""
        if self.buses[packet.bus].gone:
            return False
        for one in (self._devices[name] for name in self._silent):
            of_it = not isinstance(packet.frame, CanFrame) or any_matches(one.spec.expects, packet.frame)
            if one.bus == packet.bus and of_it:
                return False
        return True


def spoilt(log: InputLog, scenario: Scenario) -> InputLog:
    """Return the inputs with the faults of a scenario upon them.

    Raises UserError for a cause that acts on the world itself."""
    if scenario.file.loads or scenario.file.walls:
        raise UserError(f"{scenario.path}: loads and walls need a world that answers: leave --recorded away")
    world, random = _World(log.robot), Random(scenario.file.seed)
    start = log.ticks[0].now if log.ticks else 0
    coming = sorted(scenario.file.faults.items(), key=lambda each: each[1].at)
    going: list[tuple[Site, Tamper, float, str]] = []
    acts: dict[str, bool] = {}
    """By fault upon frames of which some came: whether it changed one"""
    late: list[Packet] = []
    found: list[Given] = []
    busy: Nanos = 0
    """Until when a slow step takes; what comes by then is read after it"""
    held = Inputs()
    for place, (now, inputs) in enumerate(log.ticks, 1):
        while coming and coming[0][1].at * SECOND <= now - start:
            name, event = coming.pop(0)
            lasts = math.inf if event.seconds is None else event.seconds
            world.tamper = own = Tamper()
            site = Site(log.robot, cast("Any", world), event.on, random, now, lasts)
            try:
                CAUSES[event.cause].inject(site)
            except AttributeError:
                own.measured = lambda _motor, true: true
            if any((own.measured, own.torques, own.reading, own.error)):
                raise _needs_world(scenario, name)
            if own.transmission is not None:
                own.transmission = _noting(own.transmission, site.bus, name, acts)
            going.append((site, own, now + lasts * SECOND, name))
        if now < busy and place < len(log.ticks):
            held = joined(held, inputs)
            continue
        inputs, held = joined(held, inputs), Inputs()
        for site, _, _, name in going:
            try:
                site.each(now)
            except AttributeError:
                raise _needs_world(scenario, name) from None
        for over in [one for one in going if now >= one[2]]:
            going.remove(over)
            CAUSES[scenario.file.faults[over[3]].cause].end(over[0])
        world.tamper = composed([one[1] for one in going])
        if world.tamper.takes is not None:
            busy = now + world.tamper.takes(now)
        packets, late = _arrived(now, [*late, *_changed(world, inputs.packets)])
        if (stamp := world.tamper.stamp) is not None:
            packets = tuple(replace(packet, t=stamp(packet.t)) for packet in packets)
        states = [(bus, state) for bus, one in world.buses.items() for state in one.states]
        for one in world.buses.values():
            one.states.clear()
        found.append(Given(now, Inputs((*inputs.states, *states), packets, inputs.instructions)))
    if idle := [name for name, changed in acts.items() if not changed]:  # such as commands that come late
        raise _needs_world(scenario, idle[0])
    return log.with_ticks(found)


def joined(one: Inputs, two: Inputs) -> Inputs:
    """Return the inputs of two steps as those of one."""
    states, packets = (*one.states, *two.states), (*one.packets, *two.packets)
    return Inputs(states, packets, (*one.instructions, *two.instructions))


def _needs_world(scenario: Scenario, name: str) -> UserError:
    cause = scenario.file.faults[name].cause
    text = f"faults.{name}: {cause!r} acts on the world, which a recording has not"
    return UserError(f"{scenario.path}: {text}: leave --recorded away")


def _noting(change: Arriving, on: str, name: str, acts: dict[str, bool]) -> Arriving:
    """Return the same change, which notes whether it changes anything on a bus."""

    def noted(bus: str, one: Transmission) -> Sequence[Transmission]:
        arrived = tuple(change(bus, one))
        if bus == on:
            acts[name] = acts.get(name, False) or arrived != (one,)
        return arrived

    return noted


def _changed(world: _World, packets: Sequence[Packet]) -> list[Packet]:
    """Return what is received of what was."""
    change = world.tamper.transmission
    heard = [packet for packet in packets if world.hears(packet)]
    if change is None:
        return heard
    return [
        replace(packet, t=one.t, frame=one.frame)
        for packet in heard
        for one in change(packet.bus, Transmission(packet.t, "a device", packet.frame))
    ]


def _arrived(now: Nanos, packets: Sequence[Packet]) -> tuple[tuple[Packet, ...], list[Packet]]:
    """Return what has come by now, in order of time, and what comes later."""
    there = sorted((packet for packet in packets if packet.t <= now), key=lambda packet: packet.t)
    return tuple(there), [packet for packet in packets if packet.t > now]


@dataclass(frozen=True, slots=True)
class _Replayed:
    """What a judge of scenarios asks of a session."""

    gateway: Gateway
    stats: LoopStats
    twins: None = None
    reasons: tuple[str, ...] = ()

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.gateway.robot

    @property
    def joints(self) -> Any:  # noqa: ANN401 -- as a session has them
        """Its joints."""
        return self.gateway.joints


def run_spoilt(log: InputLog, scenario: Scenario, record: Path | None = None) -> DrivenAgain:
    """Run recorded inputs with faults upon them by the code of today.

    Args:
        log: of the recording.
        scenario: what happens, and what must hold (`parse_faults`).
        record: a recording to write, which must not exist yet.

    Raises:
        GatewayError: a cause needs a world, or the recording cannot be written.
    """
    log = spoilt(log, scenario)
    stats, clock, period = LoopStats(), SimulatedClock(), log.robot.period
    clock.wait(log.ticks[0].now if log.ticks else 0)
    timing = StepTiming(stats, period, clock)
    made: list[tuple[Watcher, ScenarioJudge]] = []

    def watch(gateway: Gateway) -> None:
        replayed = _Replayed(gateway, stats)
        made.append((Watcher(gateway), ScenarioJudge(scenario, cast("Any", replayed))))

    told, before = Told(), log.ticks[0].now if log.ticks else 0
    for tick, belief in run(log, watch):
        clock.wait(tick.now)
        timing.begin()
        stats.missed += max(0, (tick.now - before) // period - 1)
        timing.end(before)
        before = tick.now
        for one in made[0]:
            one.take(tick, belief)
        told.take(tick, belief)
    if record is not None:
        write_run(record, log, {MADE_FROM: f"a recording, with the faults of {scenario.path.name}"})
    watcher, judge = made[0]
    return DrivenAgain(watcher.figures(), watcher.digests(), judge.verdicts(), told.lines)
