"""The loops on a clock: live (our end, on real buses or on twins) and serve (the devices' end).

The third loop that drives the same step is replay; it needs neither clock nor bus (`gateway.replay.compare`).

Rules. These loops own what the step must not: buses, clock, recorder, operator, signals. They are generators
that yield what happened, so that a caller can watch, stop, or run two of them face to face; wrap them in
`contextlib.closing`, since leaving one is what says the safe word. Deadlines are absolute; a moment that was
missed is counted and told, never caught up. Whatever the reason for leaving, the safe word goes out first.
"""

from __future__ import annotations

import gc
import logging
import os
import signal
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import TypeAlias

from brain.belief import Belief
from gateway.buses import Bus
from gateway.buses.frame_time import frame_time
from gateway.core.clock import Clock
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Note, Tick
from protocols.frames import BusState, Packet
from protocols.messages import MILLISECOND, SECOND, Asked, Leave, Nanos

log = logging.getLogger("gateway")

FAREWELL = 200 * MILLISECOND
"""How long leaving waits for the devices to say that they are disarmed, when they have braked."""
LEAST_STEP = MILLISECOND
"""A driver that is due between two periods gets a step of its own, but not more often than this."""
STALE = SECOND // 2
"""A serving loop that was away for longer does not make up for it."""


Keep: TypeAlias = Callable[[Tick, Belief], None]
"""Where ticks go. Never raises, and never waits for a disk in real time."""


@dataclass(slots=True)
class LoopStats:
    """What a live loop counts."""

    ticks: int = 0
    missed: int = 0
    """Moments that were due while a step was still at work."""
    longest_step: Nanos = 0
    first_frame: Nanos | None = None
    """When the first frame went out."""
    sent: int = 0
    received: int = 0
    busy: dict[str, Nanos] = field(default_factory=dict)
    """How long each bus carried what we heard and said, at most (bits stuffed as badly as can be)."""


def no_questions() -> Sequence[Asked]:
    """For a run that nobody talks to."""
    return ()


def live(
    gateway: Gateway,
    buses: Mapping[str, Bus],
    clock: Clock,
    *,
    ask: Callable[[], Sequence[Asked]] = no_questions,
    keep: Keep | None = None,
    until: Nanos | None = None,
    account: LoopStats | None = None,
    dry: bool = False,
) -> Generator[Tick]:
    """Step the gateway at its period, and when a driver is due, until `until` or until it is closed.

    `ask` is polled for what a person wants. With `dry`, everything is done but writing to the buses.
    """
    account = account if account is not None else LoopStats()
    number = 0
    leaving = False

    def tick(now: Nanos, asked: Sequence[Asked]) -> Tick:
        nonlocal number
        inputs = _gather(buses, now, asked)
        outputs = gateway.step(now, inputs)
        if not dry:
            _write(buses, now, outputs.packets)
        made = Tick(number, now, inputs, outputs)
        number += 1
        if keep is not None:
            keep(made, gateway.belief())
        _report(outputs.notes, leaving)
        _count(account, gateway.robot, made, clock.now() - now)
        return made

    broken = True
    try:
        for now in moments(clock, gateway.robot.period, gateway.due, account):
            if until is not None and now >= until:
                break
            yield tick(now, ask())
        broken = False
    except GeneratorExit:
        broken = False
        raise
    finally:
        if broken:
            # The step itself failed: nothing of it can be trusted but the joints and the drivers.
            if not dry:
                _write(buses, clock.now(), gateway.leave(clock.now()))
        else:
            leaving = True
            _farewell(gateway, clock, tick)


def _farewell(gateway: Gateway, clock: Clock, tick: Callable[[Nanos, Sequence[Asked]], Tick]) -> None:
    """The safe word at once, and a moment of listening until the devices say that they are disarmed."""
    start = clock.now()
    tick(start, (Leave("the run ends"),))
    patience = FAREWELL + max(joint.braking_time for joint in gateway.joints.values())
    while gateway.still_armed() and clock.now() - start < patience:
        clock.wait(clock.now() + gateway.robot.period)
        tick(clock.now(), ())
    if still := gateway.still_armed():
        log.error("%s did not say that it is disarmed: cut its supply", ", ".join(still))


def moments(
    clock: Clock, period: Nanos, due: Callable[[], Nanos | None], account: LoopStats
) -> Iterator[Nanos]:
    """The moments to step at: absolute deadlines, and a driver's own moments between them."""
    deadline = last = clock.now()
    while True:
        now = clock.now()
        if now >= deadline:
            late = (now - deadline) // period
            account.missed += late
            deadline += (late + 1) * period
        last = now
        yield now
        own = due()
        between = deadline if own is None else max(own, last + LEAST_STEP)
        clock.wait(min(deadline, between) if between + LEAST_STEP <= deadline else deadline)


@dataclass(slots=True)
class ServeStats:
    """What a serving loop counts."""

    received: int = 0
    said: int = 0
    late: Nanos = 0
    """The longest that the world had to catch up in one go."""
    lost: Nanos = 0
    """How long the world stood still because this process did."""
    unreceived: int = 0
    """Packets that came meanwhile."""


@dataclass(frozen=True, slots=True)
class ServeTick:
    """One moment of a serving loop."""

    now: Nanos
    states: tuple[tuple[str, BusState], ...]
    """What the outer buses told of themselves."""
    received: tuple[Packet, ...]
    said: tuple[Packet, ...]
    stalled_for: Nanos = 0
    """How long the world stood still just before; what came meanwhile was not heard."""


def serve(
    world_buses: Mapping[str, Bus],
    buses: Mapping[str, Bus],
    clock: Clock,
    period: Nanos = MILLISECOND,
    *,
    until: Nanos | None = None,
    account: ServeStats | None = None,
    age: Nanos | None = None,
) -> Generator[ServeTick]:
    """Be the devices: carry what the outer buses bring to the world of twins, and back.

    The world keeps pace with the clock: what a late moment has missed it makes up for, and what came in is
    heard at its own time, as far as that is known. Only if this process stood still for longer than `STALE`,
    the world has stood still with it, and what has come in meanwhile is not heard: devices that were off obey
    no old commands. `age` is the world's own time now, if it has lived already."""
    account = account if account is not None else ServeStats()
    last = clock.now()
    behind = 0 if age is None else last - age
    for now in moments(clock, period, lambda: None, LoopStats()):
        if until is not None and now >= until:
            return
        states, packets = _take(buses, now)
        stalled_for = now - last if now - last > STALE else 0
        if stalled_for:
            behind += stalled_for
            account.lost += stalled_for
            account.unreceived += len(packets)
            packets = []
        account.late = max(account.late, now - last - stalled_for)
        for t, packet in _arrivals(packets, last, now):
            world_buses[packet.bus].write(t - behind, (packet.frame,))
        _, said = _take(world_buses, now - behind)
        _write(buses, now, said)
        account.received += len(packets)
        account.said += len(said)
        last = now
        yield ServeTick(now, tuple(states), tuple(packets), tuple(said), stalled_for)


def _arrivals(packets: Sequence[Packet], last: Nanos, now: Nanos) -> list[tuple[Nanos, Packet]]:
    """When packets have come, in order: after the moment before this one, at their own time if they have one.

    Those of a bus without stamps (they say now) have come evenly since then."""
    unknown: dict[str, int] = {}
    for packet in packets:
        unknown[packet.bus] = unknown.get(packet.bus, 0) + (packet.t >= now)
    timed: list[tuple[Nanos, Packet]] = []
    met = dict.fromkeys(unknown, 0)
    for packet in packets:
        t = max(packet.t, last)
        if packet.t >= now:
            met[packet.bus] += 1
            t = last + (now - last) * met[packet.bus] // (unknown[packet.bus] + 1)
        timed.append((t, packet))
    timed.sort(key=lambda one: one[0])
    return timed


def _take(buses: Mapping[str, Bus], now: Nanos) -> tuple[list[tuple[str, BusState]], list[Packet]]:
    """What has changed and what has come in, of all buses, in order of time.

    What came at the same moment stays in the order of the robot file's buses."""
    states: list[tuple[str, BusState]] = []
    packets: list[Packet] = []
    for name, bus in buses.items():
        changes, arrived = bus.read(now)
        states += [(name, state) for state in changes]
        packets += arrived
    packets.sort(key=lambda packet: packet.t)
    return states, packets


def _gather(buses: Mapping[str, Bus], now: Nanos, asked: Sequence[Asked]) -> Inputs:
    states, packets = _take(buses, now)
    return Inputs(tuple(states), tuple(packets), tuple(asked))


def _write(buses: Mapping[str, Bus], now: Nanos, packets: Sequence[Packet]) -> None:
    if not packets:
        return
    for name, bus in buses.items():
        frames = [p.frame for p in packets if p.bus == name]
        if frames:
            bus.write(now, frames)


_LEVELS = {"info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}


def _report(notes: Sequence[Note], leaving: bool) -> None:
    """To the log. On the way out, that all stops is no news."""
    for note in notes:
        log.log(logging.DEBUG if leaving else _LEVELS[note.level], "%s: %s", note.about, note.text)


def _count(account: LoopStats, robot: Robot, tick: Tick, took: Nanos) -> None:
    account.ticks += 1
    account.longest_step = max(account.longest_step, took)
    account.sent += len(tick.outputs.packets)
    account.received += len(tick.inputs.packets)
    if account.first_frame is None and tick.outputs.packets:
        account.first_frame = tick.now
    for packet in (*tick.inputs.packets, *tick.outputs.packets):
        bus = robot.buses[packet.bus]
        time = frame_time(packet.frame, bus.baudrate or bus.bitrate, bus.data_bitrate)
        account.busy[packet.bus] = account.busy.get(packet.bus, 0) + time


# -- what a process needs around a live loop ------------------------------------------------------


@contextmanager
def signals(stop: Callable[[str], None]) -> Iterator[None]:
    """While inside, SIGINT, SIGTERM, SIGHUP call `stop` with their name; a second one is a plain interrupt.

    A terminal that is closed (SIGHUP) must not leave motors turning; under nohup it is ignored, as asked."""
    seen: list[int] = []

    def handler(number: int, _frame: object) -> None:
        if seen:
            raise KeyboardInterrupt
        seen.append(number)
        stop(signal.Signals(number).name)

    with ExitStack() as stack:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number is signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue
            before = signal.signal(number, handler)
            stack.callback(signal.signal, number, before)
        yield


@contextmanager
def quiet_collector() -> Iterator[None]:
    """Keep the garbage collector out of the way of what was made before the loop began."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def real_time(priority: int) -> str:
    """Ask for real-time priority (SCHED_FIFO); "" if it was given, else why not and what to do."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return (
            f"real-time priority {priority} was not allowed: run with CAP_SYS_NICE, or add "
            f"'@realtime - rtprio {priority}' to /etc/security/limits.conf for your group"
        )
    except OSError as error:
        return f"real-time priority {priority} was not given: {error}"
    return ""
