"""A rig for tests of the gateway: a robot, its world, and the live loop, in simulated time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import closing

from brain.belief import Belief
from gateway import config
from gateway.buses.virtual.bus import TwinWorld, open_world
from gateway.core.clock import SimulatedClock
from gateway.core.guard import decoder_of
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Note, Tick
from gateway.runtime.loop import Record, live
from gateway.runtime.timing import LoopStats
from protocols.messages import SECOND, Command, Instruction, Nanos
from tests.runs import kept

BENCH = """
name = "rig"
rate_hz = 200
world = "bench"
[buses.can0]
kind = "can"
bitrate = 1_000_000
interface = "twin"
[defaults.motors]
protocol = "odrive_can"
bus = "can0"
gear = 8.0
limits = { velocity = 20.0, acceleration = 60.0, torque = 2.0 }
options = { watchdog = "acknowledged" }
[motors.left]
address = 1
[motors.right]
address = 2
on_fault = "continue"
[brain]
body = "joints"
[brain.joints]
motors = ["left", "right"]
"""
WATCHED = BENCH.replace(
    'options = { watchdog = "acknowledged" }', "settings = { enable_watchdog = true, watchdog_timeout = 0.2 }"
)
"""The same, with the devices' watchdogs on."""


class Rig:
    """One robot on twins. `run` goes on where the last one ended."""

    def __init__(self, of: str | Robot = BENCH, before: Rig | None = None) -> None:
        """`of`: the text of a robot file, or what it says. `before`: a rig that is not stepped any more, in
        whose world this one goes on."""
        self.robot: Robot = config.parse_robot(of) if isinstance(of, str) else of
        self.clock: SimulatedClock = before.clock if before else SimulatedClock()
        self.world: TwinWorld = before.world if before else open_world(self.robot, self.robot.seed)
        self.gateway = Gateway(self.robot)
        self.stats = LoopStats()
        self.ticks: list[Tick] = []
        self.record: Record = lambda _tick, _belief: None
        """Gets each tick, too."""
        self.reasons: list[str] = []
        """To leave; may be added at any time."""
        self._queued: list[Instruction] = []
        self._live = kept(
            live(
                self.gateway,
                self.world.buses,
                self.clock,
                poll=lambda: self.poll(),
                record=self._record,
                stats=self.stats,
                reasons=self.reasons,
            )
        )

    def _record(self, tick: Tick, belief: Belief) -> None:
        self.ticks.append(tick)
        self.record(tick, belief)

    def poll(self) -> Sequence[Instruction]:
        instructions, self._queued = self._queued, []
        return instructions

    def run(
        self, seconds: float, *instructions: Instruction, at: Callable[[Tick], None] | None = None
    ) -> list[Tick]:
        """Run for some seconds of the robot's time, beginning with the instructions; return the ticks."""
        self._queued += instructions
        until: Nanos = self.clock.now() + round(seconds * SECOND)
        begun = len(self.ticks)
        for tick in self._live:
            if at is not None:
                at(tick)
            if tick.now >= until:
                break
        return self.ticks[begun:]

    def leave(self) -> list[Tick]:
        """End the loop; return its last ticks."""
        begun = len(self.ticks)
        with closing(self._live):
            pass
        return self.ticks[begun:]

    def velocity(self, motor: str) -> float:
        """Return the true velocity at the output shaft, rad/s."""
        assert self.world.world is not None
        return self.world.world.shaft(motor)[1]


def notes_in(ticks: Sequence[Tick], *sources: str) -> list[Note]:
    """Return the notes of some sources, or of all."""
    return [note for tick in ticks for note in tick.outputs.notes if not sources or note.source in sources]


def sent_commands(robot: Robot, ticks: Iterable[Tick], bus: str = "can0") -> list[tuple[Nanos, Command]]:
    """Return what a robot's devices on a bus would obey of what was sent, with the times."""
    decoder = decoder_of(robot, bus)
    return [
        (tick.now, message)
        for tick in ticks
        for packet in tick.outputs.packets
        if packet.bus == bus
        for message in decoder.decode(packet.t, packet.frame)
        if isinstance(message, Command)
    ]
