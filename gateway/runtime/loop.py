"""The live loop: step the gateway at its period, on real buses or on twins, and leave safely.

Rules. The loop owns what the step must not: buses, clock, recorder, operator. It is a generator of ticks, so
that a caller can watch and stop it; wrap it in `contextlib.closing`, since closing it sends the stop action.
Deadlines are absolute; one that was missed is counted and reported, never caught up. Whatever the reason for
leaving, the stop action of every commanded joint goes out first.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
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
from protocols.messages import MILLISECOND, Instruction, Leave, Nanos

log = logging.getLogger("gateway")

LEFT = "the run ends"
"""Why the gateway is stopped once a run has ended."""
DISARM_TIMEOUT = 200 * MILLISECOND
"""How long leaving waits, after the braking time, for the devices to report that they are disarmed."""
MIN_STEP = MILLISECOND
"""A driver that is due between two periods gets a step of its own, but no sooner than this after the last."""

Record: TypeAlias = Callable[[Tick, Belief], None]
"""Where ticks go. Never raises, and never waits for a disk in real time."""


@dataclass(slots=True)
class LoopStats:
    """What a live loop counts."""

    ticks: int = 0
    missed: int = 0
    """Deadlines that passed while a step was still running."""
    longest_step: Nanos = 0
    sent: int = 0
    """Packets"""
    received: int = 0
    """Packets"""
    busy: dict[str, Nanos] = field(default_factory=dict)
    """By bus: transmission time of everything sent and received, with worst-case bit stuffing."""


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
) -> Generator[Tick]:
    """Step the gateway at its period, and when a driver is due, until `until` or until closed.

    `poll` returns what an operator has asked for since the last step. With `dry_run`, everything is done but
    writing to the buses. Ticks are numbered on from `stats.ticks`."""
    stats = stats if stats is not None else LoopStats()
    leaving = False

    def tick(now: Nanos, instructions: Sequence[Instruction]) -> Tick:
        states, packets = read(buses, now)
        inputs = Inputs(tuple(states), tuple(packets), tuple(instructions))
        outputs = gateway.step(now, inputs)
        if not dry_run:
            write(buses, now, outputs.packets)
        made = Tick(stats.ticks, now, inputs, outputs)
        if record is not None:
            record(made, gateway.belief())
        _log_notes(outputs.notes, leaving)
        _count(stats, gateway.robot, made, clock.now() - now)
        return made

    failed = True
    try:
        for now in moments(clock, gateway.robot.period, gateway.due, stats):
            if until is not None and now >= until:
                break
            yield tick(now, poll())
        failed = False
    except GeneratorExit:
        failed = False
        raise
    finally:
        if failed:
            # The step itself raised: nothing of it can be trusted but the joints and the drivers.
            if not dry_run:
                write(buses, clock.now(), gateway.leave(clock.now()))
        else:
            leaving = True
            _stop_and_wait(gateway, clock, tick)


def _stop_and_wait(
    gateway: Gateway, clock: Clock, tick: Callable[[Nanos, Sequence[Instruction]], Tick]
) -> None:
    """Send the stop action at once, and step on until the devices report that they are disarmed."""
    start = clock.now()
    tick(start, (Leave(LEFT),))
    timeout = DISARM_TIMEOUT + max(joint.braking_time for joint in gateway.joints.values())
    while gateway.still_armed() and clock.now() - start < timeout:
        clock.wait(clock.now() + gateway.robot.period)
        tick(clock.now(), ())
    if still := gateway.still_armed():
        log.error("%s: not reported as disarmed: cut the supply", ", ".join(still))


def moments(
    clock: Clock, period: Nanos, due: Callable[[], Nanos | None], stats: LoopStats
) -> Iterator[Nanos]:
    """Yield the moments to step at: absolute deadlines, and a driver's own moments between them."""
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
        between = deadline if own is None else max(own, last + MIN_STEP)
        clock.wait(min(deadline, between) if between + MIN_STEP <= deadline else deadline)


def read(buses: Mapping[str, Bus], now: Nanos) -> tuple[list[tuple[str, BusState]], list[Packet]]:
    """Return the state changes and the packets of all buses: packets by time, then by order of the buses."""
    states: list[tuple[str, BusState]] = []
    packets: list[Packet] = []
    for name, bus in buses.items():
        changes, arrived = bus.read(now)
        states += [(name, state) for state in changes]
        packets += arrived
    packets.sort(key=lambda packet: packet.t)
    return states, packets


def write(buses: Mapping[str, Bus], now: Nanos, packets: Sequence[Packet]) -> None:
    """Hand each bus its frames, in order."""
    if not packets:
        return
    for name, bus in buses.items():
        frames = [p.frame for p in packets if p.bus == name]
        if frames:
            bus.write(now, frames)


_LEVELS = {"info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}


def _log_notes(notes: Sequence[Note], leaving: bool) -> None:
    """Log the notes of a step. While leaving, that everything stops is no news."""
    for note in notes:
        log.log(logging.DEBUG if leaving else _LEVELS[note.level], "%s: %s", note.source, note.text)


def _count(stats: LoopStats, robot: Robot, tick: Tick, took: Nanos) -> None:
    stats.ticks += 1
    stats.longest_step = max(stats.longest_step, took)
    stats.sent += len(tick.outputs.packets)
    stats.received += len(tick.inputs.packets)
    for packet in (*tick.inputs.packets, *tick.outputs.packets):
        bus = robot.buses[packet.bus]
        time = frame_time(packet.frame, bus.baudrate or bus.bitrate, bus.data_bitrate)
        stats.busy[packet.bus] = stats.busy.get(packet.bus, 0) + time
