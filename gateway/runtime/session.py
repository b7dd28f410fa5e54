"""A session: everything that a live run needs, opened in order and closed in the opposite one.

Rules. Buses are opened before anything is armed, and closed after the stop action was sent. From before the
first is opened until the last is closed, a signal is a reason to leave, and raises nothing. The simulated
world is made only for buses whose interface is "twin". What cannot be opened raises `BusError` before
anything has moved.
"""

from __future__ import annotations

import atexit
import logging
import os
from collections import deque
from collections.abc import AsyncGenerator, Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from inspect import GEN_RUNNING, getgeneratorstate
from pathlib import Path
from typing import TYPE_CHECKING, Self, TypeVar

from brain.belief import Belief, Pose
from gateway import config
from gateway.buses import Bus, open_bus
from gateway.core.clock import Clock, PacedClock, SimulatedClock, WallClock, date
from gateway.core.joint import Joint
from gateway.core.robot import TWIN, Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.errors import UserError, expect
from gateway.monitor.lines import LineTroubles
from gateway.monitor.silence import Silence
from gateway.runtime import loop
from gateway.runtime.drive_doctor import DriveDoctor
from gateway.runtime.process import fine_timers, quiet_collector, signals
from gateway.runtime.real_devices import (
    Dynamometer,
    FollowingWorld,
    Latencies,
    cannot_load,
    real_names,
)
from gateway.runtime.timing import LoopStats
from gateway.runtime.watchdog import WatchdogProcess, covered
from protocols.messages import SECOND, Goal, Instruction, Release

if TYPE_CHECKING:
    from gateway.buses.virtual.bus import TwinWorld
    from gateway.recording import Recorder
    from gateway.replay import SignalLog
    from gateway.runtime.live_view import SessionView
    from gateway.runtime.ros_bridge import SessionBridge
    from gateway.runtime.rotation import Rotation
    from gateway.sim.files import WorldFile

log = logging.getLogger("gateway")
_Result = TypeVar("_Result")

NO_WATCHDOG = "no watchdog process, and if this one dies, none stops the motors: %s"
MAX_STALE_READS = 100
_DRIVING = "why it does not drive as it should"
"""Of one bus, before a run begins."""


@dataclass(slots=True)
class Session:
    """A robot with its buses open. Made by `open_session`; `run` steps it."""

    robot: Robot
    gateway: Gateway
    clock: Clock
    buses: dict[str, Bus]
    twins: TwinWorld | None
    """The simulated world behind the buses whose interface is "twin"; None if there is none."""
    recorder: Recorder | None = None
    stats: LoopStats = field(default_factory=LoopStats)
    reasons: list[str] = field(default_factory=list)
    """Why the run is to end before its time: `leave`."""
    watchdog: WatchdogProcess | None = None
    """The process that sends the stop action if this one dies; None if there is none."""
    driving: DriveDoctor | None = field(init=False)
    """Says why it does not drive as it should; None once that has failed."""
    latencies: Latencies = field(init=False)
    """How long the devices take that are real."""
    _observers: dict[str, loop.Record] = field(init=False)
    """Who looks at each tick, by what for; who fails is left out from then on."""
    _watchers: list[loop.Record] = field(default_factory=list)
    _view: SessionView | None = None
    _ros: SessionBridge | None = None
    _recorders: list[Recorder] = field(default_factory=list)
    """All that were opened, and are not written to their end."""
    _submitted: deque[Instruction] = field(default_factory=deque)
    """Another thread may add to it while the robot is stepped: it is never replaced."""
    _belief: Belief | None = None
    """After the last tick; None before the first."""
    _ticks: Generator[Tick] | None = None
    _stopped: bool = False
    """Whether a stop of the operator was in force at the last tick of a run."""
    opened: ExitStack = field(default_factory=ExitStack)
    """What is closed with it, after its run, its view and its recordings."""

    def __post_init__(self) -> None:
        silence, troubles = Silence(self.gateway, self.buses), LineTroubles(self.gateway, self.buses)
        self.driving = driving = DriveDoctor(self.robot)
        self._observers = {
            "why a device is silent": lambda tick, _: silence.take(tick),
            "what does not go as it should on a serial line": lambda tick, _: troubles.take(tick),
            _DRIVING: driving.take,
        }
        self.latencies = Latencies(self.robot, real_names(self.robot))
        self._observers["how long real devices take"] = self.latencies.take
        if self.twins is not None and self.twins.followed:
            self.watch(FollowingWorld(self.twins, self.joints).take)

    def submit(self, *instructions: Instruction) -> None:
        """Ask for something at the next step.

        Args:
            instructions: tasks (`Goal`, `Drive`), requests (`Stop`, `ClearFault`, …) or, for bare joints,
                commands (`Velocity("left", 2.0)`). They are part of the tick, hence recorded and replayed.

        Raises:
            UserError: the robot cannot do one of them, whatever happens; none is submitted.
        """
        for one in instructions:
            expect("instructions", one, Instruction, "a task, request or command, such as Goal(1.5, 0.5)")
            if wrong := config.cannot(one, self.robot):
                raise UserError(f"{type(one).__name__}: {wrong}")
        self._submitted += instructions

    def leave(self, reason: str) -> None:
        """End the run before its time, as a signal does: with the stop action. The second time hurries, a
        third within a second of it lets go of the motors at once.

        Args:
            reason: for the log. What comes within one period counts once.
        """
        self.reasons.append(reason)

    def watch(self, take: loop.Record) -> None:
        """Have a function called with each tick and the belief after it, also those in which a run ends.

        Args:
            take: must be quick: it is a part of the step.
        """
        self._watchers.append(take)

    def run(
        self,
        seconds: float | None = None,
        *,
        poll: Callable[[], Sequence[Instruction]] = loop.no_instructions,
        dry_run: bool = False,
    ) -> Generator[Tick]:
        """Step the robot at its period and yield each tick; send every joint's stop action at the end.

        Args:
            seconds: how long, in the session's own time; None: until the caller leaves the loop, a signal
                comes, or `leave` is called.
            poll: returns more instructions before each step.
            dry_run: do everything but write to the buses.

        Yields:
            Tick: what went into each step, and what came out of it.
        """
        expect("seconds", seconds, float | int | None, "a number of seconds")
        if seconds is not None and not 0.0 <= seconds < 1e9:
            raise UserError(f"seconds: found {seconds}, expected a number from 0 to 1e9")
        if self._ticks is not None:
            self._ticks.close()
        if self.gateway.stopped == loop.LEFT and not self._stopped:  # by the end of the run before this one
            self._submitted.appendleft(Release())
        self._ticks = self._run(seconds, poll, dry_run)
        return self._ticks

    def _run(
        self, seconds: float | None, poll: Callable[[], Sequence[Instruction]], dry_run: bool
    ) -> Generator[Tick]:
        until = None if seconds is None else self.clock.now() + round(seconds * SECOND)

        def instructions() -> Sequence[Instruction]:
            seen = self._guarded(lambda view: view.poll()) or ()
            submitted = [*self._take_submitted(), *poll(), *seen]
            graph = self._with_graph(lambda ros: ros.poll(submitted)) or ()
            return [*submitted, *graph, *self._take_submitted()]

        ticks = loop.live(
            self.gateway,
            self.buses,
            self.clock,
            poll=instructions,
            record=self._record,
            until=until,
            stats=self.stats,
            dry_run=dry_run,
            reasons=self.reasons,
            watchdog=self.watchdog,
        )
        try:
            with closing(ticks):
                for tick in ticks:
                    self._stopped = bool(self.gateway.stopped)
                    yield tick
        finally:  # the run's end has ended what was held
            self._guarded(lambda view: view.ends())
            self._with_graph(lambda ros: ros.ends())

    def _take_submitted(self) -> list[Instruction]:
        return [self._submitted.popleft() for _ in range(len(self._submitted))]

    async def run_async(
        self,
        seconds: float | None = None,
        *,
        poll: Callable[[], Sequence[Instruction]] = loop.no_instructions,
        dry_run: bool = False,
    ) -> AsyncGenerator[Tick]:
        """Step the robot as `run` does, in a thread, and yield each tick to an asynchronous program.

        The next step begins when the one before was taken: who takes long delays the robot, as with `run`.
        When it is left or cancelled, it waits until the stop actions are sent; leave it by
        `contextlib.aclosing`, since Python ends an abandoned asynchronous generator only some time later.

        Args:
            seconds: as of `run`; so are the others.
            poll: called in the thread.
            dry_run: as of `run`.

        Yields:
            Tick: what went into each step, and what came out of it.
        """
        from gateway.runtime.asynchronous import in_a_thread

        async for tick in in_a_thread(self.run(seconds, poll=poll, dry_run=dry_run)):
            yield tick

    def load(self, motor: str, brake: str) -> None:
        """Put the simulated world's torques on a real motor's shaft, by another real motor on that shaft: a
        dynamometer. It begins with the next step, and pauses while the robot is stopped.

        Args:
            motor: the real motor that the world follows.
            brake: the real motor that is coupled to its output shaft: a joint of its own, which takes a
                torque. What `gear` and `sign` say of both makes them turn alike.

        Raises:
            UserError: one of them cannot be this.
        """
        if (wrong := cannot_load(self.robot, self.twins, motor, brake)) or self.twins is None:
            raise UserError(wrong)
        self.watch(Dynamometer(self.gateway, self.twins, motor, brake, self.submit).take)

    def log(self, rows: int = 0) -> SignalLog:
        """Return the signals of the robot from its next step on, as numbers; it grows while the session runs.

        Args:
            rows: how many ticks it keeps; 0: 200,000. Beyond, the oldest are left out, and counted.

        Raises:
            UserError: another number of rows.
        """
        from gateway.replay.signal_log import ROWS, SignalLog

        made = SignalLog(self.gateway, rows or ROWS)
        self.watch(made.take)
        return made

    def start_recording(self, path: Path | str) -> None:
        """Record from the next step on. A recording that does not begin with the run shows what happened; a
        replay of it cannot be compared.

        Args:
            path: an MCAP file that must not exist yet.

        Raises:
            RecordingError: it cannot be written.
            UserError: it exists, or a link of its name. The recording so far goes on.
        """
        from gateway.recording import Recorder

        _check_new(path)
        mounts = {name: sensor.mount for name, sensor in self.robot.sensors.items()}
        recorder = Recorder(Path(path), self.robot.text, {"date": date()}, mounts)
        self.stop_recording()
        self.recorder = recorder
        self._recorders = [*(one for one in self._recorders if not one.over), recorder]

    def rotate_recording(self, rotation: Rotation) -> None:
        """Go on in another file after a time or a size: FILE, FILE-0002, …; and keep all, or a ring.

        Args:
            rotation: when, and what stays. What is in the ring when a note is an error stays in any case.

        Raises:
            UserError: nothing is recorded.
        """
        from gateway.runtime.rotation import Rotator

        if self.recorder is None:
            raise UserError("nothing is recorded: there is nothing to rotate")
        self.watch(Rotator(self, rotation).take)

    def stop_recording(self) -> None:
        """End the recording, if there is one. Does not wait for the disk."""
        if self.recorder is not None:
            self.recorder.end()
        self.recorder = None

    def view(
        self,
        address: str = "",
        *,
        steer: bool = False,
        token: str = "",
        origins: Sequence[str] = (),
    ) -> str:
        """Open a live view: a page for a browser, and for Foxglove, while the session runs.

        Args:
            address: HOST:PORT, HOST or PORT; "": 127.0.0.1:8765. Port 0: one that is free.
            steer: whether who looks may do more than look and stop.
            token: what a client must bring; needed where other machines can reach the address.
            origins: foreign pages that may connect, such as "https://app.foxglove.dev".

        Returns:
            str: the address to open.

        Raises:
            UserError: the address cannot be opened, or needs a token.
        """
        from gateway.runtime.live_view import SessionView
        from gateway.view import place

        where, access = place(address, token, origins)
        self.close_view()
        self._view = SessionView(self, where, access, steer=steer)
        return self._view.url

    @property
    def view_url(self) -> str:
        """The address of the live view; "" without one."""
        return self._view.url if self._view is not None else ""

    def close_view(self) -> None:
        """Close the live view, if there is one. What is held there ends with the next step."""
        view, self._view = self._view, None
        if view is not None:
            self._submitted += view.ends()
            view.close()

    def ros(self, network: str = "", *, domain: int | None = None) -> str:
        """Put the robot into ROS 2's graph, while the session runs: topics, services, parameters, actions.

        Args:
            network: "": this machine alone. Else our interface to a network, by its name or IPv4 address:
                then whoever is there can drive the robot. "zenoh", or "zenoh:ENDPOINT" of its router, for who
                uses rmw_zenoh: needs the extra `ros`.
            domain: of DDS; None: the robot file's.

        Returns:
            str: the node's name in the graph, and where it listens.

        Raises:
            UserError: there is no such interface, or its ports are taken.
        """
        from gateway.ros.network import parse_network
        from gateway.runtime.cameras import cameras_of
        from gateway.runtime.ros_bridge import SessionBridge

        address = parse_network(network)
        self.close_ros()
        number = self.robot.ros.domain if domain is None else domain
        cameras = cameras_of(self.robot, self.buses, self.twins)
        self._ros = SessionBridge(self, address, number, cameras)
        return self._ros.name

    def close_ros(self) -> None:
        """Leave ROS 2's graph. What is held there ends with the next step."""
        ros, self._ros = self._ros, None
        if ros is not None:
            self._submitted += ros.ends()
            ros.close()

    def _with_graph(self, use: Callable[[SessionBridge], _Result]) -> _Result | None:
        """Return what something does with ROS 2's graph; None without one. One that fails is left, and keeps
        nothing from the robot."""
        if self._ros is None:
            return None
        try:
            return use(self._ros)
        except Exception:
            log.exception("ROS 2's graph is left")
            try:
                self.close_ros()
            except Exception:
                log.exception("ROS 2's graph could not be left in order")
            return None

    def _guarded(self, use: Callable[[SessionView], _Result]) -> _Result | None:
        """Return what something does with the view; None without one. A view that fails is closed, and
        keeps nothing from the robot."""
        if self._view is None:
            return None
        try:
            return use(self._view)
        except Exception:
            log.exception("the live view has failed, and is closed")
            try:
                self.close_view()
            except Exception:  # what was held has its end already
                log.exception("the live view could not be closed")
            return None

    def __enter__(self) -> Self:
        """Return the session, which is open already."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """End a run that was not ended, as `run` does, and close all that is open; again: nothing. Who
        forgets it has it closed when the program ends.

        Raises:
            UserError: another thread steps it at this moment: that run is asked to end, and nothing is closed
                under it.
        """
        if self._ticks is not None and getgeneratorstate(self._ticks) == GEN_RUNNING:
            self.leave("closed")
            raise UserError("another thread steps this session: its run ends now; close it after that")
        with self.opened:
            atexit.unregister(self.close)

    def end(self) -> None:
        """End the run, the view and the recordings; the buses stay open."""
        if self._ticks is not None:
            self._ticks.close()
        self.close_view()
        self.close_ros()
        for recorder in self._recorders:
            recorder.close()

    @property
    def joints(self) -> Mapping[str, Joint]:
        """The joints by motor name: mode, latched faults, and `feedback` at the output shaft."""
        return self.gateway.joints

    @property
    def belief(self) -> Belief:
        """What the brain believes: state and reason, pose with covariance, map, path, goal."""
        return self._belief if self._belief is not None else self.gateway.belief()

    @property
    def pose(self) -> Pose | None:
        """The believed pose in the frame "map" (x, y in m, yaw in rad); None for a body without one."""
        estimate = self.belief.estimate
        return estimate.pose if estimate is not None else None

    def tour(self) -> list[Goal]:
        """Return the goals of the world's own tour; none where there is no world."""
        return [Goal(x, y) for x, y in self.twins.world.tour] if self.twins is not None else []

    def _observe(self, tick: Tick, belief: Belief) -> None:
        """Have the observers look; one that fails ends no run, and keeps no tick from the recording."""
        for purpose, take in tuple(self._observers.items()):
            try:
                take(tick, belief)
            except Exception:
                log.exception("it is no longer looked %s", purpose)
                del self._observers[purpose]
                self.driving = self.driving if _DRIVING in self._observers else None

    def _record(self, tick: Tick, belief: Belief) -> None:
        self._belief = belief
        for take in self._watchers:
            take(tick, belief)
        self._guarded(lambda view: view.take(tick, belief))
        self._with_graph(lambda ros: ros.take(tick, belief))
        self._observe(tick, belief)
        if self.recorder is not None:
            self.recorder.record(tick, belief, patient=isinstance(self.clock, SimulatedClock))


def open_session(
    robot: Robot | str | Path,
    *,
    simulated: bool = False,
    record: Path | str | None = None,
    seed: int | None = None,
    world: WorldFile | None = None,
) -> Session:
    """Open a robot's buses, or the simulated world in their place, and its recorder.

    Args:
        robot: a `Robot`, or what `load_robot` takes.
        simulated: run in simulated time, as fast as the machine can; every bus must be a twin. Otherwise in
            real time; where every bus is a twin, in slow motion if the machine cannot keep up.
        record: the recording to write (an MCAP file that must not exist yet).
        seed: of the simulated world's noise; None: the robot file's.
        world: the simulated world, as `gateway.sim.load.load_world` returns it; None: the robot file's.

    Returns:
        Session: ready to `run`. Nothing is armed yet. `with` closes it at the end, or `close`.

    Raises:
        ConfigError: the robot file or its world is wrong.
        BusError: an interface cannot be opened.
        RecordingError: the recording cannot be written.
        UserError: the robot does not exist, `record` exists, `simulated` with a real interface, or an
            argument of another type.
    """
    expect("robot", robot, Robot | str | Path, "a Robot, its name or the path of its file")
    expect("record", record, Path | str | None, "the path of a file")
    expect("seed", seed, int | None, "an integer")
    if world is not None:
        from gateway.sim.files import BenchFile, SceneFile

        expect("world", world, SceneFile | BenchFile, "a world, as load_world returns it")
    if not isinstance(robot, Robot):
        robot = config.load_robot(robot)
    real = [bus.name for bus in robot.buses.values() if bus.interface != TWIN]
    if simulated and real:
        raise UserError(f"simulated time needs a simulated world: {', '.join(real)} is on a real interface")
    if absent := [one.name for one in robot.devices() if one.name in robot.real and one.bus not in real]:
        wired = dict.fromkeys(one.bus for one in robot.devices() if one.name in absent)
        text = f"to be real: {', '.join(absent)}; but the interface of {', '.join(wired)} is {TWIN!r}"
        how = " ".join(f"--bus {bus}=INTERFACE:CHANNEL" for bus in wired)
        raise UserError(f"{text}; say where that is connected: {how}")
    if record is not None:
        _check_new(record)
    clock: Clock = SimulatedClock() if simulated else WallClock() if real else PacedClock()
    reasons: list[str] = []
    with ExitStack() as stack:
        stack.enter_context(signals(reasons.append, suspend=False))
        watchdog = _start_watchdog(robot, clock, stack)
        buses, twins = _open_buses(robot, clock, seed, world, stack)
        if watchdog is not None and (why := watchdog.ready()):
            log.warning(NO_WATCHDOG, why)
            watchdog = None
        session = Session(robot, Gateway(robot), clock, buses, twins, reasons=reasons, watchdog=watchdog)
        stack.callback(session.end)
        if record is not None:
            session.start_recording(record)
        for caution in config.cautions(robot):
            log.warning("%s", caution)
        stack.enter_context(quiet_collector(paced=not simulated))
        if real and session.gateway.lines:
            fine_timers()
        _discard_stale(robot, buses, clock)
        session.opened = stack.pop_all()
    atexit.register(session.close)
    return session


def _start_watchdog(robot: Robot, clock: Clock, stack: ExitStack) -> WatchdogProcess | None:
    """Start the watchdog process, if it can stop a motor. It begins while the rest is opened."""
    if not covered(robot):
        return None
    try:
        watchdog = WatchdogProcess(robot, clock)
    except OSError as error:
        log.warning(NO_WATCHDOG, error)
        return None
    stack.callback(watchdog.close)
    return watchdog


def _check_new(path: Path | str) -> None:
    if os.path.lexists(path):
        raise UserError(f"{path}: exists already; it is never overwritten")


def _discard_stale(robot: Robot, buses: Mapping[str, Bus], clock: Clock) -> None:
    """Discard what was received while everything was opened: its age is not known."""
    for name, bus in buses.items():
        for _ in range(MAX_STALE_READS if robot.buses[name].interface != TWIN else 0):
            states, packets = bus.read(clock.now())
            for state in states:
                log.warning("%s: %s", name, state)
            if not packets:
                break


def _open_buses(
    robot: Robot, clock: Clock, seed: int | None, world: WorldFile | None, stack: ExitStack
) -> tuple[dict[str, Bus], TwinWorld | None]:
    twins, simulated = None, dict[str, Bus]()
    if any(bus.interface == TWIN for bus in robot.buses.values()):
        from gateway.buses.virtual import beside_real, open_world

        twins = open_world(robot, robot.seed if seed is None else seed, world)
        simulated = beside_real.buses(twins) if isinstance(clock, WallClock) else {**twins.buses}
    buses: dict[str, Bus] = {}
    for name, settings in robot.buses.items():
        buses[name] = simulated[name] if name in simulated else open_bus(settings, clock)
        stack.callback(buses[name].close)
    return buses, twins
