"""`gateway watch`: listen to buses or to a recording, and print what is received, decoded by its protocols.

Rules. Nothing is ever sent: a source (`gateway.monitor.sources`) can be read and closed only, and no driver
is asked what it would send. On a terminal, a page is refreshed; otherwise lines are printed, and then the
last page. A recording gives its last page. With --lines there are lines only.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

from gateway import config
from gateway.buses.log_file import is_log, logged, summary
from gateway.cli import arguments
from gateway.cli.terminal.screen import screen
from gateway.core.clock import WallClock
from gateway.core.message_text import escaped, message_text
from gateway.core.robot import BusSettings
from gateway.core.tick import Tick
from gateway.errors import UserError
from gateway.monitor import render
from gateway.monitor.candidates import of_plugins, of_robot
from gateway.monitor.dbc import DbcSignals
from gateway.monitor.decoder import BusMonitor
from gateway.monitor.heard import places as places_of
from gateway.monitor.sources import DEFAULT_BITRATE, WatchSession, open_all, usable_plugins
from gateway.monitor.state import DecodedPacket
from gateway.recording import read_recording
from gateway.runtime.process import signals
from protocols.frames import BusState, Packet
from protocols.messages import MILLISECOND, SECOND, Nanos

READ_PERIOD: Nanos = 5 * MILLISECOND
REFRESH_PERIOD: Nanos = 250 * MILLISECOND


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "what",
        nargs="?",
        metavar="ROBOT|FILE|INTERFACE:CHANNEL",
        help="a robot file or its name, a recording, a log of CAN (candump .log, .asc, .blf, .trc, .csv, "
        "also .gz), or socketcan:can0, slcan:PORT, serial:PORT … "
        "(default: every CAN interface of this machine)",
    )
    arguments.add_bus(parser, "where a bus of the robot file is: can0=socketcan:vcan0")
    parser.add_argument("--robot", default="", help="of a log: whose devices were on its buses")
    text = "decode frames by this DBC file (extra dbc): of a log by it alone, unless --robot is given"
    parser.add_argument("--dbc", type=Path, metavar="FILE", help=text)
    parser.add_argument("--lines", action="store_true", help="print a line per packet, not a page")
    arguments.add_seconds(parser)
    rate = arguments.integer("a rate in bit/s", 1)
    parser.add_argument(
        "--bitrate", type=rate, default=0, metavar="N", help="of INTERFACE:CHANNEL (default: 1000000)"
    )
    parser.add_argument(
        "--data-bitrate", type=rate, default=0, metavar="N", help="of INTERFACE:CHANNEL, if it is CAN FD"
    )
    parser.add_argument("--baudrate", type=rate, default=115_200, metavar="N", help="of serial:PORT")


def run(options: Namespace) -> int:
    """Listen until a signal, for a time, or to the end of a recording."""
    if options.robot and not (options.what and is_log(Path(options.what))):
        raise UserError("--robot is for a log of CAN; a robot file itself is the first argument")
    dbc = None if options.dbc is None else DbcSignals(options.dbc)
    if options.what is not None and is_recording(options.what) and is_log(Path(options.what)):
        _watch_log(Path(options.what), options, dbc)
        return 0
    if options.what is not None and is_recording(options.what):
        _watch_recording(Path(options.what), dbc, lines=options.lines, seconds=options.seconds)
        return 0
    with ExitStack() as stack:
        session = open_all(options, WallClock(), stack)
        stack.enter_context(signals(lambda name: setattr(session, "leaving", name)))
        until = None if options.seconds is None else session.began + round(options.seconds * SECOND)
        if options.lines or not sys.stdout.isatty():
            for batch in lines(session, until, dbc):
                print("\n".join(map(escaped, batch)), flush=True)
            print(end="" if options.lines else "\n")
        else:
            with screen(sys.stdout) as draw:
                refresh(session, until, draw, dbc)
        if not options.lines:
            print("\n".join(map(escaped, page(session, dbc))))
    return 0


# -- live -----------------------------------------------------------------------------------------


def received(
    session: WatchSession, until: Nanos | None
) -> Iterator[tuple[Nanos, list[tuple[str, BusState]], list[Packet]]]:
    """Yield what each read of the buses gives, until then or until a signal."""
    while not session.leaving:
        now = session.clock.now()
        states: list[tuple[str, BusState]] = []
        packets: list[Packet] = []
        for name, source in session.sources.items():
            changes, arrived = source.read(now)
            states += [(name, state) for state in changes]
            packets += arrived
        packets.sort(key=attrgetter("t"))
        for name, state in states:
            session.monitor.on_state(now, name, state)
        yield now, states, packets
        if until is not None and now >= until:
            return
        session.clock.wait(now + READ_PERIOD)


def lines(session: WatchSession, until: Nanos | None, dbc: DbcSignals | None = None) -> Iterator[list[str]]:
    """Yield the lines of each read: changes of buses, then packets."""
    for now, states, packets in received(session, until):
        batch = [_state_line(now, bus, state) for bus, state in states]
        batch += [_line(session.monitor.decode(packet), dbc) for packet in packets]
        if batch:
            yield batch


def refresh(
    session: WatchSession,
    until: Nanos | None,
    draw: Callable[[list[str]], None],
    dbc: DbcSignals | None = None,
) -> None:
    """Draw the page at its period."""
    next_page: Nanos = session.clock.now()
    for now, _, packets in received(session, until):
        for packet in packets:
            _take(session.monitor.decode(packet), dbc)
        if now >= next_page:
            next_page = now + REFRESH_PERIOD
            draw(page(session, dbc))


def page(session: WatchSession, dbc: DbcSignals | None = None) -> list[str]:
    """Return what is known now."""
    now = session.clock.now()
    seconds = (now - session.began) / SECOND
    shown = render.page(session.monitor, now, f"{session.title}: {seconds:.1f} s, listening only")
    return shown + _by_dbc(dbc, seconds)


def _take(decoded: DecodedPacket, dbc: DbcSignals | None) -> str:
    """Return what a file says of a frame, which counts it."""
    return dbc.take(decoded.packet) if dbc is not None else ""


def _line(decoded: DecodedPacket, dbc: DbcSignals | None) -> str:
    """Return the line of a frame, with what the file says of it."""
    return f"{render.line(decoded)}  {_take(decoded, dbc)}".rstrip()


def _by_dbc(dbc: DbcSignals | None, seconds: float) -> list[str]:
    return ["", *dbc.page(seconds)] if dbc is not None else []


def _state_line(now: Nanos, bus: str, state: BusState) -> str:
    return f"{render.time_text(now)} {bus} is {state}"


# -- a recording ----------------------------------------------------------------------------------


def is_recording(what: str) -> bool:
    """True if this names a file that is neither a robot file nor an interface."""
    path = Path(what)
    return path.suffix == ".mcap" or (path.is_file() and path.suffix != ".toml")


def _watch_recording(path: Path, dbc: DbcSignals | None, *, lines: bool, seconds: float | None) -> None:
    """Print the lines or the last page of a recording, or of its first seconds."""
    recording = read_recording(path)
    robot = config.parse_robot(recording.robot_text, f"{path}: robot.toml")
    monitor: BusMonitor | None = None
    began = now = 0
    for tick in recording.ticks:
        if monitor is None:
            began = tick.now
            variants = of_robot(robot, list(robot.buses))
            monitor = BusMonitor(robot.buses, variants, began, known=True, window=None)
        if seconds is not None and tick.now - began > seconds * SECOND:
            break
        now = tick.now
        received, sent = _decode(monitor, tick)
        if not lines:
            for decoded in (*received, *sent):
                _take(decoded, dbc)
        if lines and (texts := _tick_lines(tick, received, sent, dbc)):
            print("\n".join(map(escaped, texts)))
    if monitor is None:
        raise UserError(f"{path}: it contains no tick")
    if not lines:
        cut = "" if recording.whole else ", cut short"
        title = f"{path}: {robot.name}, {(now - began) / SECOND:.1f} s{cut}"
        shown = render.page(monitor, now, title) + _by_dbc(dbc, (now - began) / SECOND)
        print("\n".join(map(escaped, shown)))


def _watch_log(path: Path, options: Namespace, dbc: DbcSignals | None) -> None:
    """Print the lines or the last page of another program's log of CAN, or of its first seconds."""
    log = summary(path)
    bitrate = options.bitrate or DEFAULT_BITRATE
    buses = {
        name: BusSettings(name, "canfd" if fd else "can", "", bitrate, options.data_bitrate)
        for name, fd in log.fd.items()
    }
    if options.robot:
        robot = config.load_robot(options.robot)
        places = places_of(robot, log, path)
        variants = of_robot(robot, list(places.values()))
        buses = {bus: robot.buses[bus] for bus in places.values()}
    else:
        places = {name: name for name in buses}
        plugins = usable_plugins() if dbc is None else []
        variants = [each for bus in buses.values() for each in of_plugins(bus, plugins)]
    monitor = BusMonitor(buses, variants, log.began, known=bool(options.robot), window=None)
    now = log.began
    with suppress(UserError):  # it was told by the summary
        for packet, sent in logged(path):
            if options.seconds is not None and packet.t - log.began > options.seconds * SECOND:
                break
            if packet.bus not in places:
                continue
            now = packet.t
            decoded = monitor.decode(replace(packet, bus=places[packet.bus]), sent=sent or None)
            if options.lines:
                print(escaped(_line(decoded, dbc)))
            else:
                _take(decoded, dbc)
    if log.error:
        print(f"cut short: {log.error}", file=sys.stderr)
    if not options.lines:
        seconds = (now - log.began) / SECOND
        shown = render.page(monitor, now, f"{path}: {seconds:.1f} s") + _by_dbc(dbc, seconds)
        print("\n".join(map(escaped, shown)))


def _decode(monitor: BusMonitor, tick: Tick) -> tuple[list[DecodedPacket], list[DecodedPacket]]:
    """Return what the host received, and what it sent, on the buses of the robot file."""
    for bus, state in tick.inputs.states:
        if bus in monitor.buses:
            monitor.on_state(tick.now, bus, state)
    received, sent = (
        [monitor.decode(packet, sent=sent) for packet in packets if packet.bus in monitor.buses]
        for sent, packets in ((False, tick.inputs.packets), (True, tick.outputs.packets))
    )
    return received, sent


def _tick_lines(
    tick: Tick, received: Sequence[DecodedPacket], sent: Sequence[DecodedPacket], dbc: DbcSignals | None
) -> list[str]:
    """Return a tick in the order of its step: bus states, packets, instructions, notes, packets sent."""
    time = render.time_text(tick.now)
    return [
        *(_state_line(tick.now, bus, state) for bus, state in tick.inputs.states),
        *(_line(packet, dbc) for packet in received),
        *(f"{time} instruction: {message_text(message)}" for message in tick.inputs.instructions),
        *(f"{time} {note.level}: {note.source}: {note.text}" for note in tick.outputs.notes),
        *(_line(packet, dbc) for packet in sent),
    ]
