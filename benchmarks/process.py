"""What the program costs as a process: until it answers, until its first frame is on the bus, its memory.

Rules. The gateway runs as a user starts it, in a process of its own. To see its first frame come out at the
far end of the wire, its CAN buses are put on adapters of ours (slcan on ptys) and its serial lines on ptys;
nobody answers there, and no simulated world is part of it. The clock starts before Python does. Memory is the
kernel's own high-water mark of that process (VmHWM), read while it lives. Contestants take turns.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

from benchmarks.measure import Effort, Figures, NotMeasured, figures
from benchmarks.rows import Beside, Row, Target
from gateway import config
from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.buses.adapters.pty import SerialPty
from gateway.core.clock import WallClock, stopwatch
from gateway.core.robot import BusSettings
from protocols.messages import MILLISECOND, SECOND, Nanos

START, MEMORY = "start-up, from nothing", "memory at the most"
BARE, LIBRARIES = "python -c pass", 'python -c "import can, numpy, serial"'
PASS, IMPORTS = ("-c", "pass"), ("-c", "import can, numpy, serial")
HELP, WORLD = "gateway --help", "gateway run diffbot --fast --seconds 10"
UNREPORTED, LEFT_OUT = "the kernel does not tell it (/proc/PID/status)", "left out by --quick"
ROBOTS = ("bench", "diffbot")
PATIENCE: Nanos = 60 * SECOND
GLANCE: Nanos = MILLISECOND
"""How often it is looked whether a frame has come."""

Frame: TypeAlias = AdapterPty | SerialPty


def processes(effort: Effort) -> list[Row]:
    """Start-up and memory."""
    took: dict[str, list[float]] = {}
    held: dict[str, list[float]] = {}
    for _ in range(effort.of(5, 1)):
        for name, arguments in ((BARE, PASS), (LIBRARIES, IMPORTS), (HELP, ("-m", *HELP.split()))):
            took.setdefault(name, []).append(until_done(arguments))
        held.setdefault(LIBRARIES, []).append(peak_until_done(IMPORTS))
        for robot in ROBOTS:
            first, most = until_first_frame(robot, effort.of(2, 0) * SECOND)
            took.setdefault(robot, []).append(first)
            held.setdefault(robot, []).append(most)
    if not effort.quick:
        held[WORLD] = [peak_until_done(("-m", *WORLD.split()))]
    return [*_start({name: figures(times) for name, times in took.items()}), *_memory(held)]


def _start(took: Mapping[str, Figures]) -> list[Row]:
    libraries = (Beside(LIBRARIES, took[LIBRARIES]),)
    limit = Target(at_most=3.0 * SECOND)
    frames = [
        Row(START, f"gateway run {robot}: first frame out", took[robot], libraries, limit) for robot in ROBOTS
    ]
    help_limit = Target(at_most=0.3 * SECOND)
    return [Row(START, HELP, took[HELP], (Beside(BARE, took[BARE]),), help_limit), *frames]


def _memory(held: Mapping[str, Sequence[float]]) -> list[Row]:
    peaks = {name: figures(found, "B") for name, found in held.items() if all(found)}
    libraries = (Beside(LIBRARIES, peaks.get(LIBRARIES), "" if LIBRARIES in peaks else UNREPORTED),)
    names = {robot: f"gateway run {robot}, on its buses" for robot in ROBOTS} | {WORLD: WORLD}
    return [
        Row(MEMORY, what, peaks[name], libraries)
        if name in peaks
        else Row(MEMORY, what, None, not_run=UNREPORTED if name in held else LEFT_OUT)
        for name, what in names.items()
    ]


# -- processes ------------------------------------------------------------------------------------


def until_done(arguments: Sequence[str]) -> Nanos:
    """How long a Python process takes from its start to its end. Raises NotMeasured if it fails."""
    began = stopwatch()
    done = subprocess.run([sys.executable, *arguments], capture_output=True, check=False)
    took = stopwatch() - began
    if done.returncode:
        raise NotMeasured(f"{' '.join(arguments)}: {done.stderr.decode(errors='replace').strip()}")
    return took


def peak_until_done(arguments: Sequence[str]) -> int:
    """The most memory [B] that a Python process has held by its end; 0 where it is not told."""
    clock, most = WallClock(), 0
    with _process(arguments) as process:
        while process.poll() is None and clock.now() < PATIENCE:
            most = max(most, peak(process.pid))
            clock.wait(clock.now() + GLANCE)
    if process.returncode:
        raise NotMeasured(f"{' '.join(arguments)} ended with {process.returncode}")
    return most


def until_first_frame(robot: str, stay: Nanos) -> tuple[Nanos, int]:
    """How long `gateway run` takes until its first CAN frame comes out, and the most memory [B] that it has
    held when it has run for `stay` beyond that. Raises NotMeasured if no frame comes."""
    clock = WallClock()
    with _frames(robot) as frames:
        buses = [word for frame in frames for word in ("--bus", f"{frame.name}={_address(frame)}")]
        with _process(("-m", "gateway", "run", robot, *buses)) as process:
            first: Nanos | None = None
            while clock.now() < (PATIENCE if first is None else first + stay) and process.poll() is None:
                received = [
                    frame for frame in frames if frame.read(clock.now())[1] and isinstance(frame, AdapterPty)
                ]
                if received and first is None:
                    first = clock.now()
                clock.wait(clock.now() + GLANCE)
            most = peak(process.pid)
            if first is None or process.poll() is not None:
                process.terminate()
                said = process.communicate()[1].decode(errors="replace").strip()
                raise NotMeasured(f"gateway run {robot} put no frame on its bus: {said}")
    return first, most


def peak(process: int) -> int:
    """The kernel's high-water mark of a living process's memory [B]; 0 where it is not told."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), 0)


@contextmanager
def _process(arguments: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A Python process, told to leave at the end. Its operator's socket is in nobody's way."""
    with TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env={**os.environ, "XDG_RUNTIME_DIR": folder},
        )
        with process:
            try:
                yield process
            finally:
                process.terminate()
                try:
                    process.wait(10.0)
                except subprocess.TimeoutExpired:
                    process.kill()


@contextmanager
def _frames(robot: str) -> Iterator[list[Frame]]:
    """The far ends of a robot's buses."""
    buses = config.load_robot(robot).buses
    made: list[Frame] = []
    try:
        made.extend(_frame(settings) for settings in buses.values())
        yield made
    finally:
        for frame in made:
            frame.close()


def _frame(settings: BusSettings) -> Frame:
    return SerialPty(settings) if settings.kind == "serial" else AdapterPty(settings)


def _address(frame: Frame) -> str:
    return f"slcan:{frame.paths[0]}" if isinstance(frame, AdapterPty) else f"serial:{frame.pty.path}"
