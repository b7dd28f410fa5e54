"""A rig for tests of the gateway: a robot, its world, and the live loop, in simulated time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing

from gateway import config
from gateway.buses.virtual.bus import TwinWorld, open_world
from gateway.core.clock import SimulatedClock
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Note, Tick
from gateway.runtime.loop import LoopStats, live
from protocols.messages import SECOND, Command, Instruction, Nanos

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


class Rig:
    """One robot on twins. `run` goes on where the last one ended."""

    def __init__(self, text: str = BENCH) -> None:
        self.robot: Robot = config.parse_robot(text)
        self.clock = SimulatedClock()
        self.world: TwinWorld = open_world(self.robot, self.robot.seed)
        self.gateway = Gateway(self.robot)
        self.stats = LoopStats()
        self.ticks: list[Tick] = []
        self._waiting: list[Instruction] = []
        self._live = live(
            self.gateway,
            self.world.buses,
            self.clock,
            poll=self._ask,
            record=lambda tick, _belief: self.ticks.append(tick),
            stats=self.stats,
        )

    def _ask(self) -> Sequence[Instruction]:
        asked, self._waiting = self._waiting, []
        return asked

    def run(
        self, seconds: float, *asked: Instruction, at: Callable[[Tick], None] | None = None
    ) -> list[Tick]:
        """Some seconds of the robot's time, beginning with what is asked; its ticks."""
        self._waiting += asked
        until: Nanos = self.clock.now() + round(seconds * SECOND)
        begun = len(self.ticks)
        for tick in self._live:
            if at is not None:
                at(tick)
            if tick.now >= until:
                break
        return self.ticks[begun:]

    def leave(self) -> list[Tick]:
        """End the loop; the ticks of the farewell."""
        begun = len(self.ticks)
        with closing(self._live):
            pass
        return self.ticks[begun:]

    def velocity(self, motor: str) -> float:
        """rad/s, true, at the output shaft."""
        assert self.world.world is not None
        return self.world.world.shaft(motor)[1]


def reported(ticks: Sequence[Tick], *about: str) -> list[Note]:
    """What was said to a person, of everything or of some."""
    return [note for tick in ticks for note in tick.outputs.notes if not about or note.source in about]


def said(rig: Rig, ticks: Sequence[Tick], bus: str = "can0") -> list[tuple[Nanos, Command]]:
    """What the devices of a bus would obey of what was sent, by an ear of their own language."""
    from gateway.core.step import decoder_of

    decoder = decoder_of(rig.robot, bus)
    return [
        (tick.now, word)
        for tick in ticks
        for packet in tick.outputs.packets
        if packet.bus == bus
        for word in decoder.decode(packet.t, packet.frame)
        if isinstance(word, Command)
    ]
