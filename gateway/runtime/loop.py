"""The live loop: step the gateway at its period, on real buses or on twins, and leave safely.

Rules. The loop owns what the step must not: buses, clock, recorder, operator. It is a generator of ticks, so
that a caller can watch and stop it; wrap it in `contextlib.closing`, since closing it takes the way out.
Deadlines are absolute; one that was missed is counted and reported, never caught up; on a paced clock none
is missed. Between them there is a step when a driver is due, or when an answer comes that it awaits.

The way out (`_leave`) is the same whatever the reason: a signal, a caller that is done or raises, an
exception in the step, a bus, the recorder or the operator. First the stop action, for the joints' braking
time at most; then Idle; then motors that still report being armed are noted and logged. Lines go on between
the periods, and until what disarms is out. Nothing interrupts it: a second reason hurries
(`Joint.hurried_braking_time`), and is never worse than one; only a third, within a second of the second, ends
the time to brake. What fails in it is logged, and does not keep the frames from the rest. After a failed
step, joints and drivers alone give the frames.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from brain.belief import Belief
from gateway.buses import Bus, WakingBus
from gateway.buses.frame_time import frame_time
from gateway.core.arming import DISARMING
from gateway.core.clock import Clock
from gateway.core.robot import Robot
from gateway.core.step import LEFT_ARMED, Gateway
from gateway.core.tick import Inputs, Note, Tick
from gateway.runtime.timing import LoopStats, StepTiming
from gateway.runtime.watchdog import WatchdogProcess
from protocols.frames import BusState, Packet
from protocols.messages import MILLISECOND, SECOND, Instruction, Leave, Nanos

log = logging.getLogger("gateway")

LEFT = "the run ends"
"""Why the gateway is stopped once a run has ended."""
LONGEST_BRAKING: Nanos = 3 * SECOND
"""Bound of the time to brake, whatever the joints ask for."""
DISARM_TIMEOUT: Nanos = DISARMING
"""How long leaving waits, after the time to brake, for the devices to report that they are disarmed."""
IMPATIENCE: Nanos = SECOND
"""A reason to leave that comes this soon after the one before, if that was not the first, is meant."""
SETTLING: Nanos = 150 * MILLISECOND
"""Motors that have been commanded are watched for this time at least: one may be about to arm."""
MIN_STEP = MILLISECOND
"""A driver that is due between two periods gets a step of its own, but no sooner than this after the last."""
FINE = 100_000
"""The same where a line waits for answers,"""
MANY = 16
"""and the pieces in which one may come before they are collected for twice this time."""

Record: TypeAlias = Callable[[Tick, Belief], None]
"""Where ticks go. Never waits for a disk in real time."""


def no_instructions() -> Sequence[Instruction]:
    """Return none: for a run without an operator."""
    return ()


def live(
    gateway: Gateway,
    buses: Mapping[str, Bus],
    clock: Clock,
    *,
    poll: Callable[[], Sequence[Instruction]] = no_instructions,
    record: Record | None = None,
    until: Nanos | None = None,
    stats: LoopStats | None = None,
    dry_run: bool = False,
    reasons: Sequence[str] = (),
    watchdog: WatchdogProcess | None = None,
) -> Generator[Tick]:
    """Step the gateway at its period, and when a driver is due, until `until`, a reason, or until closed.

    `poll` returns what an operator has asked for since the last step. With `dry_run`, everything is done but
    writing to the buses. Ticks are numbered on from `stats.ticks`. `reasons` to leave may be added at any
    time, also by a signal: the first takes the way out, the second hurries, and a third soon after ends the
    time to brake. `watchdog` is told at every step that the loop goes on, and when it has left."""
    stats = stats if stats is not None else LoopStats()
    run = _Run(gateway, buses, clock, record, stats, dry_run, None if dry_run else watchdog)
    timing = StepTiming(run.stats, gateway.robot.period, clock)
    try:
        for now in moments(
            clock,
            gateway.robot.period,
            gateway.due,
            run.stats,
            run.reader.wait,
            run.reader.least,
        ):
            if reasons or (until is not None and now >= until):
                break
            timing.begin()
            made = run.tick(now, poll())
            for error in run.errors.values():
                raise error
            if trouble := timing.end(now):
                log.warning("%s", trouble)
            if stats.stalled:
                log.error("%s", stats.stalled)
                break
            yield made
    finally:
        _leave(run, reasons)
        if run.watchdog is not None:
            run.watchdog.rest()
        if trouble := timing.summary():
            log.warning("in this run: %s", trouble)


@dataclass(slots=True)
class Reader:
    """What is read for a gateway: at its steps, and between two while it awaits an answer."""

    gateway: Gateway
    buses: Mapping[str, Bus]
    clock: Clock
    errors: dict[str, Exception] | None = None
    """As in `read`."""
    states: list[tuple[str, BusState]] = field(default_factory=list)
    packets: list[Packet] = field(default_factory=list)
    """Read since the last step."""
    _fresh: bool = False
    """What ended the wait was read just now."""
    _waking: dict[str, WakingBus] = field(init=False)

    def __post_init__(self) -> None:
        self._waking = {name: bus for name, bus in self.buses.items() if isinstance(bus, WakingBus)}

    @property
    def least(self) -> Nanos:
        """Least time between two steps."""
        return FINE if self.gateway.lines else MIN_STEP

    def wait(self, until: Nanos) -> None:
        """Wait until then, or until there is what a driver awaits."""
        if self.gateway.lines:
            self._wait_on_lines(until)
            return
        while self.clock.now() + 2 * MIN_STEP <= until and self._answered() is not None:
            self.clock.wait(self.clock.now() + MIN_STEP)
            if self._answered():
                return
        self.clock.wait(until)

    def _answered(self) -> bool | None:
        """Read the buses; True if something has come while an answer is awaited, None if none is."""
        if not self.gateway.awaiting():
            return None
        self._read(self.clock.now())
        return bool(self.packets)

    def _wait_on_lines(self, until: Nanos) -> None:
        """The same, with answers on lines: each bus tells when there may be something to read."""
        looks = 0
        polled, asked = self.gateway.awaiting(), self.gateway.asked()  # as they are until the next step
        while (now := self.clock.now()) < until:
            files, look = self._wakes(now, asked)
            looks += 1
            if polled:
                look = min(look, now + MIN_STEP)
            if looks > MANY:  # it babbles: many pieces are read as one
                look, files = now + 2 * FINE, []
            self.clock.wait(min(look, until), files)
            if not (polled or asked):
                return
            self._read(self.clock.now())
            if self.states or (self.packets and polled) or self.gateway.completes(self.packets):
                self._fresh = True
                return

    def _wakes(self, now: Nanos, asked: Sequence[str]) -> tuple[list[int], Nanos]:
        """Return the files of these buses, and when to look at the others. An answer that has begun is read
        when it can be complete, not piece by piece."""
        files: list[int] = []
        look: Nanos = 1 << 62
        for name in asked:
            bus = self._waking.get(name)
            own, at = bus.wakes(now) if bus is not None else ((), now + FINE)
            soonest = self.gateway.earliest_answer(name, self.packets) if own else 0
            if soonest > now:
                look = min(look, soonest)
                continue
            files += own
            look = look if at is None else min(look, at)
        return files, look

    def _read(self, now: Nanos) -> None:
        states, packets = read(self.buses, now, self.errors)
        self.states += states
        self.packets += packets

    def inputs(self, now: Nanos, instructions: Sequence[Instruction] = ()) -> Inputs:
        """Read the buses, unless that ended the wait; return all that has come since the last step."""
        if not self._fresh:
            self._read(now)
        self._fresh = False
        inputs = Inputs(tuple(self.states), tuple(self.packets), tuple(instructions))
        self.states, self.packets = [], []
        return inputs


@dataclass(slots=True)
class _Run:
    """A gateway with all that a tick of it needs."""

    gateway: Gateway
    buses: Mapping[str, Bus]
    clock: Clock
    record: Record | None
    """None after it has raised."""
    stats: LoopStats
    dry_run: bool
    watchdog: WatchdogProcess | None = None
    leaving: bool = False
    step_failed: bool = False
    """Whether the last step has raised: nothing of it can be trusted but joints and drivers."""
    errors: dict[str, Exception] = field(default_factory=dict)
    """The first exception of each bus."""
    reader: Reader = field(init=False)

    def __post_init__(self) -> None:
        self.reader = Reader(self.gateway, self.buses, self.clock, self.errors)

    def tick(self, now: Nanos, instructions: Sequence[Instruction]) -> Tick:
        """Read, step, write, record. What a bus raises is kept in `errors`."""
        inputs = self.reader.inputs(now, instructions)
        self.step_failed = True
        outputs = self.gateway.step(now, inputs)
        self.step_failed = False
        self._write(now, outputs.packets)
        made = Tick(self.stats.ticks, now, inputs, outputs)
        self.stats.ticks += 1
        record, self.record = self.record, None
        if record is not None:
            record(made, self.gateway.belief())
        self.record = record
        _log_notes(outputs.notes, self.leaving)
        _count(self.stats, self.gateway.robot, made)
        return made

    def last_frames(self, now: Nanos) -> None:
        """Read and write as `tick` does, without a step."""
        self._write(now, self.gateway.leave(now, self.reader.inputs(now)))

    def _write(self, now: Nanos, packets: Sequence[Packet]) -> None:
        if not self.dry_run:
            write(self.buses, now, packets, self.errors)
        if self.watchdog is not None:
            self.stats.stalled = self.watchdog.beat(self.gateway) or self.stats.stalled


@dataclass(slots=True)
class _Urgency:
    """How often a run was asked to end. What comes within one period counts once: a terminal that closes and
    its shell both send SIGHUP, and a supervisor SIGTERM besides."""

    reasons: Sequence[str]
    period: Nanos
    began: Nanos
    times: list[Nanos] = field(default_factory=list)
    _seen: int = 0
    _looks: int = -1

    def rises(self, now: Nanos) -> bool:
        """Look at the reasons, once in each period; True if there is a new one."""
        number, before = (now - self.began) // self.period, self._looks
        self._looks = number
        new = number > before and len(self.reasons) > self._seen
        if new:
            self._seen = len(self.reasons)
            self.times.append(now)
        return new

    @property
    def hurried(self) -> bool:
        return len(self.times) > 1

    @property
    def at_once(self) -> bool:
        return len(self.times) > 2 and self.times[-1] - self.times[-2] <= IMPATIENCE


def _leave(run: _Run, reasons: Sequence[str]) -> None:
    """Take the way out, as the rules of this file describe it."""
    gateway, clock, known = run.gateway, run.clock, set(run.errors)
    joints = gateway.joints.values()
    braking = min(LONGEST_BRAKING, max((joint.braking_time for joint in joints), default=0))
    settled = clock.now() + (SETTLING if any(joint.owned for joint in joints) else 0)
    steps = _moments_of_leaving(run)
    urgency = _Urgency(reasons, gateway.robot.period, next(steps))
    urgency.rises(urgency.began)
    done = False
    for at_once, longest in ((False, braking), (True, DISARM_TIMEOUT)):
        end = clock.now() + longest
        instructions: tuple[Instruction, ...] = (Leave(LEFT, at_once=at_once),)
        while not done and (at_once or not urgency.at_once) and (instructions or clock.now() < end):
            first, run.leaving = not run.leaving, True
            _tick_of_leaving(run, instructions)
            instructions = ()
            if reasons and first:
                log.warning("leaving: %s", reasons[0])
            done = not (gateway.still_armed() or gateway.releasing()) and clock.now() >= settled
            now = clock.now() if done else next(steps)
            if urgency.rises(now) and urgency.hurried and not at_once:
                left = max((joint.hurried_braking_time for joint in joints), default=0)
                end = min(end, now + left)
                log.warning(_URGENCY[urgency.at_once], reasons[-1])
    if still := gateway.still_armed():
        _tick_of_leaving(run, (Leave(LEFT, at_once=True, last=True),))
    for name in still:
        log.critical("%s: %s", name, LEFT_ARMED)
    for name in run.errors.keys() - known:
        log.error("%s: %r", name, run.errors[name])


def _moments_of_leaving(run: _Run) -> Iterator[Nanos]:
    """Yield the moments to step at: at each period, and while there are lines, as they need it."""
    clock, period, reader, stats = run.clock, run.gateway.robot.period, run.reader, LoopStats()
    if not run.gateway.lines:
        return moments(clock, period, lambda: None, stats)
    return moments(clock, period, run.gateway.due, stats, reader.wait, reader.least)


_URGENCY = {
    False: "leaving sooner: %s; once more within a second lets go of the motors at once",
    True: "leaving at once: %s",
}


def _tick_of_leaving(run: _Run, instructions: Sequence[Instruction]) -> None:
    """Make a tick, or give the last frames if the step has failed; log what raises."""
    now = run.clock.now()
    try:
        if not run.step_failed:
            run.tick(now, instructions)
    except Exception as error:  # noqa: BLE001 -- whatever it is, the motors come first
        log.error("while leaving: %r", error)
    try:
        if run.step_failed:
            run.last_frames(now)
    except Exception as error:  # noqa: BLE001 -- the same; one frame more is sent in the next period
        log.error("while leaving: %r", error)


def moments(
    clock: Clock,
    period: Nanos,
    due: Callable[[], Nanos | None],
    stats: LoopStats,
    wait: Callable[[Nanos], None] | None = None,
    least: Nanos = MIN_STEP,
) -> Iterator[Nanos]:
    """Yield the moments to step at: absolute deadlines, and between them a driver's own moments, no sooner
    than `least` after another. `wait`: until then, or until there is what is awaited; None: as the clock."""
    wait = wait if wait is not None else clock.wait
    deadline = last = clock.now()
    while True:
        now = clock.now()
        if now >= deadline:
            late = (now - deadline) // period
            stats.missed += late
            deadline += (late + 1) * period
        last = now
        yield now
        own = due()
        between = deadline if own is None else max(own, last + least)
        wait(min(deadline, between) if between + least <= deadline else deadline)


def read(
    buses: Mapping[str, Bus], now: Nanos, errors: dict[str, Exception] | None = None
) -> tuple[list[tuple[str, BusState]], list[Packet]]:
    """Return the state changes and the packets of all buses: packets by time, then by order of the buses.

    With `errors`, what a bus raises is kept there, and keeps nothing from the others."""
    states: list[tuple[str, BusState]] = []
    packets: list[Packet] = []
    for name, bus in buses.items():
        try:
            changes, arrived = bus.read(now)
            states += [(name, state) for state in changes]
            packets += arrived
        except Exception as error:  # noqa: BLE001 -- whatever it is, it keeps nothing from the others
            _keep(errors, name, error)
    packets.sort(key=lambda packet: packet.t)
    return states, packets


def write(
    buses: Mapping[str, Bus],
    now: Nanos,
    packets: Sequence[Packet],
    errors: dict[str, Exception] | None = None,
) -> None:
    """Hand each bus its frames, in order. `errors`: as in `read`."""
    if not packets:
        return
    for name, bus in buses.items():
        frames = [p.frame for p in packets if p.bus == name]
        if frames:
            try:
                bus.write(now, frames)
            except Exception as error:  # noqa: BLE001 -- the same
                _keep(errors, name, error)


def _keep(errors: dict[str, Exception] | None, bus: str, error: Exception) -> None:
    """Keep the first exception of a bus, if there is a place for it."""
    if errors is None:
        raise error
    error.add_note(f"bus {bus}")
    errors.setdefault(bus, error)


_LEVELS = {"info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}


def _log_notes(notes: Sequence[Note], leaving: bool) -> None:
    """Log the notes of a step. While leaving, that everything stops is no news."""
    for note in notes:
        log.log(logging.DEBUG if leaving else _LEVELS[note.level], "%s: %s", note.source, note.text)


def _count(stats: LoopStats, robot: Robot, tick: Tick) -> None:
    stats.sent += len(tick.outputs.packets)
    stats.received += len(tick.inputs.packets)
    if stats.busy is None:
        return
    for packet in (*tick.inputs.packets, *tick.outputs.packets):
        bus = robot.buses[packet.bus]
        time = frame_time(packet.frame, bus.baudrate or bus.bitrate, bus.data_bitrate)
        stats.busy[packet.bus] = stats.busy.get(packet.bus, 0) + time
