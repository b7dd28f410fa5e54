"""What the program costs as a process: until it answers, until its first frame is on the bus, its memory.

Rules. The gateway runs as a user starts it, in a process of its own. To see its first frame come out at the
far end, its CAN buses are put on adapters of ours (slcan on ptys) and its serial lines on ptys; nothing
answers there, and no simulated world is part of it. The clock starts before Python does. Memory is the
kernel's own high-water mark of that process (VmHWM), read while it lives. Contestants take turns.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

from benchmarks.measure import Effort, Figures, NotMeasured, figures
from benchmarks.rows import Beside, Row, Target, span
from gateway import config
from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.buses.adapters.pty import SerialPty
from gateway.core.clock import WallClock, stopwatch
from gateway.core.robot import BusSettings
from protocols.messages import MILLISECOND, SECOND, Nanos

START, MEMORY = "start-up, from nothing", "memory at the most"
IDLE = "idle: processor time in a second of the robot, with the twins in it"
NOTHING = "gateway run bench"
BARE, LIBRARIES = "python -c pass", 'python -c "import can, numpy, serial"'
PASS, IMPORTS = ("-c", "pass"), ("-c", "import can, numpy, serial")
HELP, WORLD = "gateway --help", "gateway run diffbot --fast --seconds 10"
UNREPORTED, LEFT_OUT = "the kernel does not report it (/proc/PID/status)", "left out by --quick"
NO_TIMES = "the kernel does not report it (/proc/PID/task/*/schedstat)"
ROBOTS = ("bench", "diffbot")
TIMEOUT: Nanos = 60 * SECOND
POLL_PERIOD: Nanos = MILLISECOND
"""Period of looking for a frame."""

FarEnd: TypeAlias = AdapterPty | SerialPty


def processes(effort: Effort) -> list[Row]:
    """Measure start-up and memory."""
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
    start = _start({name: figures(times) for name, times in took.items()})
    return [*start, *_memory(held), _idle([while_idle(effort.of(4, 2)) for _ in range(effort.of(3, 1))])]


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


def _idle(found: Sequence[float]) -> Row:
    target, second = Target(at_most=0.03 * SECOND), (span("a second", SECOND),)
    if not all(found):
        return Row(IDLE, NOTHING, None, target=target, not_run=NO_TIMES)
    return Row(IDLE, NOTHING, figures(found), second, target)


# -- processes ------------------------------------------------------------------------------------


def until_done(arguments: Sequence[str]) -> Nanos:
    """Return how long a Python process takes from start to end. Raises NotMeasured if it fails."""
    began = stopwatch()
    done = subprocess.run([sys.executable, *arguments], capture_output=True, check=False)
    took = stopwatch() - began
    if done.returncode:
        raise NotMeasured(f"{' '.join(arguments)}: {done.stderr.decode(errors='replace').strip()}")
    return took


def peak_until_done(arguments: Sequence[str]) -> int:
    """Return the peak memory [B] of a Python process; 0 where the kernel does not report it."""
    clock, most = WallClock(), 0
    with _process(arguments) as process:
        while process.poll() is None and clock.now() < TIMEOUT:
            most = max(most, peak(process.pid))
            clock.wait(clock.now() + POLL_PERIOD)
    if process.returncode:
        raise NotMeasured(f"{' '.join(arguments)} ended with {process.returncode}")
    return most


def until_first_frame(robot: str, stay: Nanos) -> tuple[Nanos, int]:
    """Return how long `gateway run` takes until its first CAN frame is out, and its peak memory [B] after
    `stay` more. Raises NotMeasured if no frame comes."""
    clock = WallClock()
    with _far_ends(robot) as ends:
        buses = [part for end in ends for part in ("--bus", f"{end.name}={_address(end)}")]
        with _process(("-m", "gateway", "run", robot, *buses)) as process:
            first: Nanos | None = None
            while clock.now() < (TIMEOUT if first is None else first + stay) and process.poll() is None:
                received = [end for end in ends if end.read(clock.now())[1] and isinstance(end, AdapterPty)]
                if received and first is None:
                    first = clock.now()
                clock.wait(clock.now() + POLL_PERIOD)
            most = peak(process.pid)
            if first is None or process.poll() is not None:
                process.terminate()
                output = process.communicate()[1].decode(errors="replace").strip()
                raise NotMeasured(f"gateway run {robot} put no frame on its bus: {output}")
    return first, most


def while_idle(seconds: int) -> Nanos:
    """Return the processor time of `gateway run bench`, to which nobody says anything, in a second of its own
    time: in slow motion that is longer than one of the machine's. 0 where the kernel does not report it."""
    with _process(("-m", *NOTHING.split(), "--seconds", str(seconds)), stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        if b"is running" not in process.stdout.readline():
            process.terminate()
            raise NotMeasured(f"{NOTHING}: {process.communicate()[1].decode(errors='replace').strip()}")
        started, before = processor_time_of(process.pid), _of_children()
        process.wait()
        return (_of_children() - before - started) // seconds if started else 0


def _of_children() -> Nanos:
    """Return the processor time of all processes that were started here and have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return round((used.ru_utime + used.ru_stime) * SECOND)


def processor_time_of(process: int) -> Nanos:
    """Return the processor time of a live process, all threads together; 0 where it is not reported."""
    try:
        tasks = [each.read_text().split() for each in Path(f"/proc/{process}/task").glob("*/schedstat")]
    except OSError:
        return 0
    return sum(int(ran) for ran, *_ in tasks)


def peak(process: int) -> int:
    """Return the kernel's high-water mark of a live process's memory [B]; 0 where it is not reported."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), 0)


@contextmanager
def _process(arguments: Sequence[str], stdout: int = subprocess.DEVNULL) -> Iterator[subprocess.Popen[bytes]]:
    """Run a Python process, terminated at the end, with a folder of its own for the operator's socket."""
    with TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.PIPE,
            stdout=stdout,
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
def _far_ends(robot: str) -> Iterator[list[FarEnd]]:
    """The far ends of a robot's buses."""
    buses = config.load_robot(robot).buses
    made: list[FarEnd] = []
    try:
        made.extend(_far_end(settings) for settings in buses.values())
        yield made
    finally:
        for end in made:
            end.close()


def _far_end(settings: BusSettings) -> FarEnd:
    return SerialPty(settings) if settings.kind == "serial" else AdapterPty(settings)


def _address(end: FarEnd) -> str:
    return f"slcan:{end.paths[0]}" if isinstance(end, AdapterPty) else f"serial:{end.pty.path}"
