"""`gateway watch`: listen to buses or to a recording, and say what is heard in the devices' own languages.

Rules. Nothing is ever sent: what is opened (`gateway.monitor.sources`) can be read and closed and nothing else, and
no driver is asked what it would say. A terminal gets a page that is refreshed, anything else lines and then
the last page; a recording gets its last page. With --lines there are lines and nothing else.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from operator import attrgetter
from pathlib import Path

from gateway import config
from gateway.cli.terminal.screen import Screen
from gateway.core.clock import WallClock
from gateway.core.tick import Tick
from gateway.errors import UserError
from gateway.monitor import render
from gateway.monitor.candidates import of_robot
from gateway.monitor.decoder import Listener
from gateway.monitor.sources import Watching, open_all
from gateway.monitor.state import Heard
from gateway.replay.diff import say
from gateway.runtime.process import signals
from protocols.frames import BusState, Packet
from protocols.messages import MILLISECOND, SECOND, Nanos

STEP: Nanos = 5 * MILLISECOND
"""How often buses are read."""
REFRESH: Nanos = 250 * MILLISECOND
"""How often the page is drawn."""


def watch(options: Namespace) -> int:
    """Listen until a signal, for so long, or to the end of a recording."""
    if options.what is not None and is_recording(options.what):
        return _recording(Path(options.what), lines=options.lines, seconds=options.seconds)
    with ExitStack() as stack:
        watching = open_all(options, WallClock(), stack)
        stack.enter_context(signals(lambda name: setattr(watching, "leaving", name)))
        until = None if options.seconds is None else watching.began + round(options.seconds * SECOND)
        if options.lines or not sys.stdout.isatty():
            for some in lines(watching, until):
                print("\n".join(some), flush=True)
            print(end="" if options.lines else "\n")
        else:
            with Screen(sys.stdout) as screen:
                pages(watching, until, screen.draw)
        if not options.lines:
            print("\n".join(page(watching)))
    return 0


# -- live -----------------------------------------------------------------------------------------


def moments(
    watching: Watching, until: Nanos | None
) -> Iterator[tuple[Nanos, list[tuple[str, BusState]], list[Packet]]]:
    """What is heard, moment by moment, until then or until a signal."""
    while not watching.leaving:
        now = watching.clock.now()
        states: list[tuple[str, BusState]] = []
        packets: list[Packet] = []
        for name, source in watching.sources.items():
            changes, arrived = source.read(now)
            states += [(name, state) for state in changes]
            packets += arrived
        packets.sort(key=attrgetter("t"))
        for name, state in states:
            watching.listener.state(now, name, state)
        yield now, states, packets
        if until is not None and now >= until:
            return
        watching.clock.wait(now + STEP)


def lines(watching: Watching, until: Nanos | None) -> Iterator[list[str]]:
    """Every change of a bus and every packet; what comes at one moment together."""
    for now, states, packets in moments(watching, until):
        reported = [_change(now, bus, state) for bus, state in states]
        if reported := reported + [render.line(watching.listener.handle(packet)) for packet in packets]:
            yield reported


def pages(watching: Watching, until: Nanos | None, draw: Callable[[list[str]], None]) -> None:
    """The page, drawn again and again."""
    next_page: Nanos = watching.clock.now()
    for now, _, packets in moments(watching, until):
        for packet in packets:
            watching.listener.handle(packet)
        if now >= next_page:
            next_page = now + REFRESH
            draw(page(watching))


def page(watching: Watching) -> list[str]:
    """What is known now."""
    now = watching.clock.now()
    took = (now - watching.began) / SECOND
    return render.page(watching.listener, now, f"{watching.title}: {took:.1f} s, listening only")


def _change(now: Nanos, bus: str, state: BusState) -> str:
    return f"{render.stamp(now)} {bus} is {state}"


# -- a recording ----------------------------------------------------------------------------------


def is_recording(what: str) -> bool:
    """Whether this names a file of ticks, and not a robot file or an interface."""
    path = Path(what)
    return path.suffix == ".mcap" or (path.is_file() and path.suffix != ".toml")


def _recording(path: Path, *, lines: bool, seconds: float | None) -> int:
    """All of a recording, or its first seconds, as fast as it can be read."""
    from gateway.recording import read

    recording = read(path)
    robot = config.parse_robot(recording.robot_text, f"{path}: robot.toml")
    tongues = of_robot(robot, list(robot.buses))
    listener: Listener | None = None
    began = now = 0
    for tick in recording.ticks:
        if listener is None:
            began = tick.now
            listener = Listener(robot.buses, tongues, began, known=True, window=None)
        if seconds is not None and tick.now - began > seconds * SECOND:
            break
        now = tick.now
        received = on_tick(listener, tick)
        if lines and (reported := tick_lines(tick, received)):
            print("\n".join(reported))
    if listener is None:
        raise UserError(f"{path}: there is no tick in it")
    if not lines:
        cut = "" if recording.whole else ", cut short"
        print(
            "\n".join(
                render.page(listener, now, f"{path}: {robot.name}, {(now - began) / SECOND:.1f} s{cut}")
            )
        )
    return 0


def on_tick(listener: Listener, tick: Tick) -> list[Heard]:
    """What the host received, then what it sent."""
    for bus, state in tick.inputs.states:
        listener.state(tick.now, bus, state)
    received = [listener.handle(packet, sent=False) for packet in tick.inputs.packets]
    return received + [listener.handle(packet, sent=True) for packet in tick.outputs.packets]


def tick_lines(tick: Tick, received: Sequence[Heard]) -> list[str]:
    """A tick in the order of its step: buses, what came in, what was asked and noted, what went out."""
    came = len(tick.inputs.packets)
    reported = [_change(tick.now, bus, state) for bus, state in tick.inputs.states]
    reported += [render.line(one) for one in received[:came]]
    reported += [f"{render.stamp(tick.now)} asked: {say(word)}" for word in tick.inputs.instructions]
    reported += [
        f"{render.stamp(tick.now)} {note.level}: {note.source}: {note.text}" for note in tick.outputs.notes
    ]
    return reported + [render.line(one) for one in received[came:]]
