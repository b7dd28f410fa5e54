"""What a real drive costs: its ticks, its replay, its recording.

Rules. The bench drives the robot "diffbot" through its simulated office for a while, always the same way, and
records that. Steps and replays are timed over what came in then, with fresh gateways, not with the world
beside them. What recording costs is measured at the robot's own pace, 200 ticks a second, for only then do
loop and writer share the processor as they do on a robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.measure import Effort, Figures, NotMeasured, figures
from benchmarks.rows import Row, Target, span
from benchmarks.steps import TICK, figures_by_step, timed
from gateway import config
from gateway.core.clock import WallClock, processor_time, stopwatch, thread_time
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.recording import Recorder, read_recording
from gateway.replay import replay_recording
from gateway.runtime.process import quiet_collector
from gateway.runtime.session import open_session
from protocols.messages import SECOND, Goal, Imu, LaserScan, Nanos

STEPS = "a step of the gateway (diffbot: 2 motors, IMU, lidar; whole brain, driving to a goal)"
REPLAY = "replay of the drive"
RECORDING = "recording the drive, per tick, at 200 ticks a second"
REAL_TIME = "real time"
WINDOW = 20
"""Ticks over which the writer's work is gathered: it writes by chunks."""
NO_WORLD = "the world needs MuJoCo: install motor-gateway[sim]"


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive that was recorded."""

    robot: Robot
    ticks: Sequence[Tick]
    file: Path

    @property
    def span(self) -> Nanos:
        """From its first tick to its last."""
        return self.ticks[-1].now - self.ticks[0].now


def driving(effort: Effort) -> list[Row]:
    """All of it, or where there is no world: that it was not run."""
    from gateway.sim.load import WorldError

    with TemporaryDirectory() as folder:
        try:
            made = drive(Path(folder), effort.of(10, 2))
        except WorldError:
            names = [(STEPS, kind) for kind in KINDS] + [(REPLAY, how) for how in REPLAYS]
            names += [(RECORDING, part) for part in PARTS]
            return [Row(group, what, None, not_run=NO_WORLD) for group, what in names]
        return [*_steps(made, effort), *_replays(made, effort), *_recording(made, effort, Path(folder))]


def drive(folder: Path, seconds: int) -> Drive:
    """Drive towards the first goals of the office's tour, and record it."""
    robot = config.load_robot("diffbot")
    file = folder / "drive.mcap"
    with open_session(robot, simulated=True, record=file) as made:
        tour = iter(made.tour())
        waiting = [next(tour)]

        def ask() -> Sequence[Goal]:
            if len(waiting) == made.gateway.belief().reached:
                waiting.append(next(tour))
                return (waiting[-1],)
            return (waiting[0],) if made.clock.now() == 0 else ()

        until = seconds * SECOND
        with closing(made.run(poll=ask)) as ticks:
            return Drive(robot, list(takewhile(lambda tick: tick.now < until, ticks)), file)


# -- steps ----------------------------------------------------------------------------------------

KINDS = ("with encoders and IMU", "with a scan", "all steps")


def _steps(made: Drive, effort: Effort) -> list[Row]:
    """Only from where it drives on: there its map is made and its motors are armed."""
    runs = [timed(made.robot, made.ticks) for _ in range(effort.of(5, 1))]
    begun = made.ticks[0].now + SECOND
    driven = [tick for tick in made.ticks if tick.now >= begun]
    scans = {tick.number for tick in driven if any(isinstance(e, LaserScan) for e in tick.outputs.events)}
    moved = {tick.number for tick in driven if any(isinstance(e, Imu) for e in tick.outputs.events)} - scans
    chosen = (moved, scans, {tick.number for tick in driven})
    rows = zip(KINDS, chosen, strict=True)
    period = made.robot.period
    return [Row(STEPS, kind, figures_by_step(runs, which), (span(TICK, period),)) for kind, which in rows]


# -- replay ---------------------------------------------------------------------------------------

REPLAYS = ("the whole brain", "protocols only", "gateway replay: read, step, compare")


def _replays(made: Drive, effort: Effort) -> list[Row]:
    took: dict[str, list[float]] = {how: [] for how in REPLAYS}
    for _ in range(effort.of(5, 1)):
        for how, run in zip(REPLAYS, (_whole, _protocols, _judged), strict=True):
            with quiet_collector():
                began = stopwatch()
                run(made)
                took[how].append(stopwatch() - began)
    return [Row(REPLAY, how, figures(took[how]), (span(REAL_TIME, made.span),)) for how in REPLAYS]


def _whole(made: Drive) -> None:
    gateway = Gateway(made.robot)
    for tick in made.ticks:
        gateway.step(tick.now, tick.inputs)


def _protocols(made: Drive) -> None:
    """What the drivers make of all that came in, and nothing else."""
    drivers = {
        bus: [plugin.driver(devices) for plugin, devices in made.robot.by_protocol(bus)]
        for bus in made.robot.buses
    }
    for tick in made.ticks:
        for packet in tick.inputs.packets:
            for driver in drivers[packet.bus]:
                driver.receive(packet.t, packet.frame)


def _judged(made: Drive) -> None:
    """Replay as `gateway replay` does. Raises NotMeasured if the replay differs."""
    comparison = replay_recording(read_recording(made.file), made.robot)
    if not comparison.ok:
        raise NotMeasured(f"the replay of the benchmark's own drive differs: {comparison.text()}")


# -- recording ------------------------------------------------------------------------------------

PARTS = ("in the loop", "processor time of the writer's thread", "processor time of both")


def _recording(made: Drive, effort: Effort, folder: Path) -> list[Row]:
    found = recording_cost(made, folder / "again.mcap", effort.of(1500, 200))
    target = {PARTS[-1]: Target(at_most=0.05 * made.robot.period)}
    tick = (span(TICK, made.robot.period),)
    return [Row(RECORDING, part, found[part], tick, target.get(part)) for part in PARTS]


def recording_cost(made: Drive, file: Path, most: int) -> dict[str, Figures]:
    """Nanoseconds a tick, by part, at the robot's pace. NotMeasured if a tick was lost on the way."""
    mounts = {name: sensor.mount for name, sensor in made.robot.sensors.items()}
    loop: list[float] = []
    writer: list[float] = []
    both: list[float] = []
    with Recorder(file, made.robot.text, {}, mounts) as recorder, quiet_collector():
        begun = processor_time(), thread_time()
        in_loop = 0
        for number, (took, work) in enumerate(_paced(made, recorder, most), start=1):
            loop.append(took)
            in_loop += work
            if number % WINDOW == 0:
                now = processor_time(), thread_time()
                others = (now[0] - begun[0]) - (now[1] - begun[1])
                writer.append(others / WINDOW)
                both.append((others + in_loop) / WINDOW)
                begun, in_loop = now, 0
    if recorder.lost or recorder.trouble:
        raise NotMeasured(f"the bench's recording lost {recorder.lost} ticks: {recorder.trouble}")
    return dict(zip(PARTS, map(figures, (loop, writer, both)), strict=True))


def _paced(made: Drive, recorder: Recorder, most: int) -> Iterator[tuple[Nanos, Nanos]]:
    """Step and record at the robot's pace, as the live loop does: how long it took to believe and hand over,
    and how much work that was."""
    gateway, clock = Gateway(made.robot), WallClock()
    for number, tick in enumerate(made.ticks[:most]):
        clock.wait(number * made.robot.period)
        gateway.step(tick.now, tick.inputs)
        work = thread_time()
        began = stopwatch()
        recorder.record(tick, gateway.belief())
        took = stopwatch() - began
        yield took, thread_time() - work
