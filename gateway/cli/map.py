"""`gateway map`: the map and the path of recordings, this gateway's or another program's, as files."""

from __future__ import annotations

import gc
from argparse import ArgumentParser, Namespace
from dataclasses import replace
from itertools import count
from pathlib import Path

from brain.belief import Belief
from brain.brain import Brain
from brain.perception.consistency import Trust
from brain.perception.perception import Perception
from brain.perception.saved_map import Start
from gateway.bench.driven import of_file
from gateway.cli import arguments
from gateway.cli.replay import add_foreign, foreign
from gateway.cli.terminal.progress import progress
from gateway.config import load_robot
from gateway.config.keyframes_file import keyframes_file
from gateway.config.map_file import load_map, saved_map
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.errors import RecordingError, UserError
from gateway.recording import read_recording
from gateway.recording.new_file import EXISTS, create_with
from gateway.replay import Observe, replay_recording
from gateway.rosbag import is_bag
from gateway.rosbag.drawn import Drawn, csv, tum
from gateway.rosbag.evaluate import NOT_PLACED, Trace, evaluate_file
from gateway.rosbag.survey import EXPECTED
from protocols.bounds import Invalid
from protocols.messages import LaserScan

IMAGE, KEYFRAMES = "map.pgm", "map.keyframes"
MAP, PATHS = (IMAGE, "map.png", "map.yaml", KEYFRAMES), ("path{}.tum", "path{}.csv")


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "file",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="a recording, a bag of ROS 1 or 2, or a CARMEN log; several: each in the map of those before it",
    )
    add_foreign(parser)
    arguments.add_map(parser)
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="a folder for the files, made if it is not there",
    )


def run(options: Namespace) -> int:
    """Return as `gateway replay` does, of several recordings the largest status; the files are written in any
    case, but that a recording was not found in the map of those before it."""
    files: list[Path] = options.file
    if absent := next((file for file in files if not file.exists()), None):
        raise UserError(f"{absent}: there is no such file or folder")
    if options.at is not None and not options.map:
        raise UserError("--at is a place in a map: name its file by --map")
    numbers = ["", *(f"-{number}" for number in range(2, len(files) + 1))]
    paths = [name.format(number) for number in numbers for name in PATHS]
    if there := next((one for one in map(options.out.joinpath, (*MAP, *paths)) if one.exists()), None):
        raise UserError(f"{there}: {EXISTS}; name another folder with --out")
    gc.set_threshold(10_000)
    made = _Made(options)
    status = max([made.add(file) for file in files])
    folder: Path = options.out
    written = made.files | dict(zip(paths, made.paths(), strict=True))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in written.items():
            create_with(folder / name, data)
    except OSError as error:
        raise UserError(
            f"{error.filename or folder}: cannot be written: {error.strerror or error}"
        ) from error
    poses = " and ".join(str(len(trace.path)) for trace in made.traces)
    print(f"written to {folder}: {', '.join(written)} ({made.size}, {poses} poses)")
    return status


class _Made:
    """The map so far, and the paths of the recordings in it."""

    def __init__(self, options: Namespace) -> None:
        self._options = options
        self.traces: list[Trace] = []
        self.files: dict[str, bytes] = {}
        """Of the map, by name"""
        self.size = ""
        """In words"""

    def add(self, file: Path) -> int:
        """Map a recording, in the map of those before it; print what there is to say, and return its status.
        Raises UserError: no map comes of it."""
        trace, options = Trace(), self._options
        if is_bag(file):
            robot, truth = foreign(file, options)
            robot = self._in_map(robot, file)
            with progress("map, events", None) as shown:
                done = evaluate_file(file, robot, options.at_most, truth, shown.update, trace)
            status, text = done.status, done.text()
        elif self.traces or options.map:
            status, text = self._followed(file, trace)
        else:
            status, text = _replayed(file, options.robot, trace)
        print(text)
        if not trace.is_placed:
            raise UserError(f"{file}: {NOT_PLACED}: no map is made of it")
        if trace.map is None or not trace.path:
            raise UserError(f"{file}: nothing was estimated: there is no map, and no path")
        self.traces.append(trace)
        self._draw(file, trace)
        return status

    def paths(self) -> list[bytes]:
        """Return the path of each recording in the map, as TUM has it, then as a table."""
        return [form(trace.path).encode() for trace in self.traces for form in (tum, csv)]

    def _draw(self, file: Path, newest: Trace) -> None:
        """Make the files of the newest map; correct the paths in it by its keyframes."""
        if newest.keyframes is not None:
            for trace in self.traces[:-1]:
                trace.correct(newest.keyframes)
        assert newest.map is not None, "it was looked at"
        try:
            drawn = Drawn(newest.map, [pose for trace in self.traces for pose in trace.path])
        except ValueError as error:
            raise UserError(f"{file}: {error}") from error
        image = drawn.pgm()
        kept = {} if newest.keyframes is None else {KEYFRAMES: keyframes_file(newest.keyframes, image)}
        text = drawn.yaml("".join(kept))
        self.files = {IMAGE: image, "map.png": drawn.png(), "map.yaml": text.encode(), **kept}
        height, width = drawn.pixels.shape
        self.size = f"{width * drawn.resolution:.1f} m x {height * drawn.resolution:.1f} m"

    def _in_map(self, robot: Robot, file: Path) -> Robot:
        """Return a robot that begins in the map so far, or in the one that was named."""
        settings, options = robot.brain.perception.map, self._options
        if self.traces:
            try:
                saved = saved_map(self.files["map.yaml"].decode(), self.files, settings, None)
            except Invalid as error:
                raise UserError(f"{file}: the map before it: {error}") from error
        elif options.map:
            at = None if options.at is None else Start(*options.at)
            saved = load_map(Path(options.map), settings, at)
        else:
            return robot
        return replace(robot, brain=replace(robot.brain, saved=saved))

    def _followed(self, file: Path, trace: Trace) -> tuple[int, str]:
        """Fill the trace by what a recording of this gateway's motors and sensors told, in a map that it did
        not begin in; return the status (1: it was cut) and what there is to say."""
        driven = of_file(file, self._options.robot)
        robot = self._in_map(driven.robot, file)
        brain = robot.brain
        perception = Perception(
            driven.body, driven.mounts, brain.perception, brain.stop.self_seen, brain.saved
        )
        scans = lost = 0
        with progress("map, events", None) as shown:
            for number, event in enumerate(driven.events(), 1):
                perception.observe(event.t, [event])
                perception.finish(event.t)
                if (now := perception.estimate) is not None:
                    trace.add(now.t, now.pose, perception)
                if isinstance(event, LaserScan):
                    scans, lost = scans + 1, lost + (perception.verdict.trust is Trust.LOST)
                shown.update(number)
        trace.end(perception)
        notes = [f"  {note}" for note in (*[driven.remark] * bool(driven.remark), *perception.take_notes())]
        text = "\n".join([f"{file.name}: {scans} scans, of which {lost} came while it was lost", *notes])
        return int(bool(driven.remark)), text


def _replayed(file: Path, robot_file: str | None, trace: Trace) -> tuple[int, str]:
    """Fill the trace by a recording of this gateway, as it was driven; likewise."""
    try:
        recording = read_recording(file)
    except RecordingError as error:
        raise RecordingError(f"{error}; {EXPECTED}") from error
    robot = None if robot_file is None else load_robot(robot_file)
    with progress("map, ticks", recording.indexed) as shown:
        perceptions: list[Perception] = []

        def watch(gateway: Gateway) -> Observe:
            ticks = count(1)
            base = gateway.brain.base if isinstance(gateway.brain, Brain) else None
            if base is not None and not base.perception.settings.given:
                perceptions.append(base.perception)

            def observe(_: Tick, belief: Belief) -> None:
                trace.map = belief.map or trace.map
                if (now := belief.estimate) is not None:
                    trace.add(now.t, now.pose, perceptions[0] if perceptions else None)
                shown.update(next(ticks))

            return observe

        comparison = replay_recording(recording, robot, watch)
    if perceptions:
        trace.end(perceptions[0])
    return 0 if comparison.ok else 1, comparison.text()
