"""`gateway view`: a running robot in a browser, or a recording, or two beside each other."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from gateway.buses.log_file import is_log
from gateway.cli.live import add_origin, domain_of, token_for
from gateway.config import load_robot
from gateway.core.clock import WallClock
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.operator import ask, socket_path
from gateway.recording import read_recording
from gateway.replay.player import Player
from gateway.runtime.log_recording import record_log
from gateway.runtime.process import signals
from gateway.runtime.replay_view import ReplayView
from gateway.view import place

if TYPE_CHECKING:
    from gateway.runtime.ros_bridge import ShownBridge
    from gateway.view import Scene


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "what",
        nargs="+",
        metavar="NAME|FILE",
        help="the name of a running robot; or a recording, or two to compare; or a log of CAN, with --robot",
    )
    parser.add_argument(
        "--at",
        default="",
        metavar="HOST:PORT",
        help="where to listen (default: 127.0.0.1:8765, or the next free port)",
    )
    add_origin(parser)
    parser.add_argument("--steer", action="store_true", help="let who looks steer the running robot, too")
    parser.add_argument(
        "--robot",
        metavar="ROBOT",
        help="play with this robot file instead of the recorded one; of a log of CAN: whose devices it has",
    )


def run(options: Namespace) -> int:
    """Return 0; the view of a recording lasts until a signal, that of a robot until it ends."""
    files = [Path(one) for one in options.what if Path(one).is_file()]
    if not files and len(options.what) == 1:
        return _view_robot(options)
    if len(files) != len(options.what) or len(files) > 2:
        missing = [one for one in options.what if Path(one) not in files]
        raise UserError(f"{missing[0]}: there is no such file" if missing else "two recordings at most")
    if options.steer:
        raise UserError("a recording cannot be steered: --steer is for a running robot")
    return show_recordings(files, options.at, tuple(options.origin), options.robot)


def _view_robot(options: Namespace) -> int:
    """Ask a running robot to open its view."""
    if options.origin or options.robot:
        raise UserError(
            f"{options.what[0]}: there is no such file, and --origin and --robot are for recordings: "
            "a robot gets its origins from `run --view`"
        )
    line = " ".join(["view", *([options.at] if options.at else []), *["steer"] * options.steer])
    answer = ask(socket_path(options.what[0]), line)
    print(answer)
    return 0 if "http://" in answer else 1


def show_recordings(
    files: list[Path], at: str, origins: tuple[str, ...], robot: str | None, ros: str | None = None
) -> int:
    """Show recordings until a signal, the first in ROS 2's graph, too, if a network is named."""
    where, access = place(at, token_for(at), origins)
    clock, reasons = WallClock(), list[str]()
    with ExitStack() as stack:
        stack.enter_context(signals(reasons.append, suspend=False))
        loaded = None if robot is None else load_robot(robot)
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="motor-gateway-")))
        readable = [_readable(file, loaded, folder / f"{at}.mcap") for at, file in enumerate(files)]
        players = [stack.enter_context(Player(read_recording(file), loaded)) for file in readable]
        graph = None if ros is None else partial(_graph, ros, clock)
        view = ReplayView(players, where, access, graph)
        stack.callback(view.close)
        print(f"{' and '.join(map(str, files))}: {view.url} (end with Ctrl-C)", flush=True)
        if view.graph:
            print(f"ROS 2: {view.graph}", flush=True)
        while not reasons:
            clock.wait(view.slice(clock.now()))
    return 0


def _readable(file: Path, robot: Robot | None, made: Path) -> Path:
    """Return a file as a recording of ours: a log of CAN becomes one."""
    if not is_log(file):
        return file
    if robot is None:
        raise UserError(f"{file} is a log of CAN: --robot ROBOT says whose devices were on its buses")
    print(f"{file}: read …", flush=True)
    record_log(file, robot, made)
    return made


def _graph(network: str, clock: WallClock, scene: Scene) -> ShownBridge:
    """Return a scene's place in ROS 2's graph."""
    from gateway.ros.network import parse_network
    from gateway.runtime.ros_bridge import ShownBridge

    return ShownBridge(scene, parse_network(network), domain_of(scene.robot), clock)
