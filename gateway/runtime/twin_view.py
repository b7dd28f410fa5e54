"""Simulated devices in the live view: the true pose, shafts and walls, which no frame tells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gateway.buses.virtual import TwinWorld
from gateway.core.clock import stopwatch
from gateway.core.step import Gateway
from gateway.runtime.twin_process import Devices
from gateway.view import Access, Address, Scene, View
from gateway.view.scene import Json
from protocols.messages import MILLISECOND, SECOND, Nanos

PERIOD: Nanos = 5 * MILLISECOND
"""Between two polls."""


@dataclass(slots=True)
class TwinScene(Scene):
    """The simulated world behind the devices. Its gateway is never stepped: it says what the robot is."""

    twins: TwinWorld | None = None

    def at(self, now: Nanos) -> None:
        """Show the world as it is at a time."""
        self.now = now

    def hello(self) -> Json:
        """Return what does not change, and the walls in the world's frame."""
        walls = [list(wall) for wall in self._world().world.outlines()]
        return Scene.hello(self) | {"mode": "twin", "walls": walls}

    def settings(self) -> list[Json]:
        """Return nothing: devices are configured by their host."""
        return []

    def joints(self) -> Json:
        """Return the true position and velocity of every shaft at the joint."""
        return {"t": self.now / SECOND, "rows": [self._shaft(name) for name in self.robot.motors]}

    def _shaft(self, name: str) -> list[Any]:
        position, velocity = self._world().world.shaft(name)
        return ["simulated", False, "", None, round(position, 5), round(velocity, 5), *[None] * 5, 0]

    def state(self) -> Json:
        """Return the true pose."""
        pose = self._world().world.truth()
        base = {"pose": [pose.x, pose.y, pose.yaw]} if self.robot.brain.body.joints else {}
        return Scene.state(self) | {"state": "simulated", "systems": [], "reason": "the true pose"} | base

    def _world(self) -> TwinWorld:
        assert self.twins is not None
        return self.twins


class TwinView:
    """A view of simulated devices; `watch` is called at every iteration of the serving loop.

    Raises UserError if the address cannot be opened."""

    def __init__(self, made: Devices, address: Address, access: Access) -> None:
        self._stats, self._last = made.stats, -PERIOD
        self._scene = TwinScene(Gateway(made.robot), "live", self._facts, twins=made.twins)
        self._view = View([self._scene], address, access)
        self.url = self._view.url
        self.close = self._view.close

    def watch(self, now: Nanos) -> None:
        """Answer pages, and show them the world. Never waits."""
        if now - self._last < PERIOD:
            return
        self._last = now
        self._scene.at(now)
        self._view.poll(stopwatch())  # simulated devices take no instructions
        self._view.show(stopwatch())

    def _facts(self) -> Json:
        return {"ticks": 0, "sent": self._stats.sent, "longest": self._stats.late / MILLISECOND}
