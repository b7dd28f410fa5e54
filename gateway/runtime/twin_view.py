"""Simulated devices in the live view: the true pose, shafts and walls, which are in no frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from brain.belief import Belief, Estimate
from gateway.buses.virtual import TwinWorld
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs, Tick
from gateway.runtime.ros_bridge import ShownBridge
from gateway.runtime.twin_process import Devices
from gateway.sim.world import World
from gateway.view import Access, Address, Scene, View
from gateway.view.scene import Json
from protocols.messages import MILLISECOND, SECOND, Feedback, Nanos

PERIOD: Nanos = 5 * MILLISECOND
"""Between two polls."""
EXACT = np.zeros((3, 3))
"""Covariance of the true pose."""


@dataclass(slots=True)
class TwinScene(Scene):
    """The simulated world behind the devices. Its gateway is never stepped: it holds what the robot is."""

    twins: TwinWorld | None = None

    def present(self) -> Tick:
        """Return a tick that brings the true position and velocity of every shaft at the joint."""
        shafts = {name: self._world.shaft(name) for name in self.robot.motors}
        events = tuple(Feedback(name, self.now, *shaft) for name, shaft in shafts.items())
        return Tick(0, self.now, Inputs(), Outputs(events=events))

    def truth(self) -> Belief:
        """Return the true pose as what is believed; none on a bench."""
        if self._world.scene is None:
            return self.belief
        linear, lateral, angular = self._world.twist()
        true = self._world.truth()
        estimate = Estimate(self.now, true, linear, angular, EXACT, lateral, odom=true)
        return replace(self.belief, estimate=estimate)

    def hello(self) -> Json:
        """Return what does not change, and the walls in the world's frame."""
        return Scene.hello(self) | {"walls": [list(wall) for wall in self._world.outlines()]}

    def settings(self) -> list[Json]:
        """Return nothing: devices are configured by their host."""
        return []

    def joints(self) -> Json:
        """Return the true position and velocity of every shaft at the joint."""
        motors = self.robot.motors
        at = {name: self._world.shaft(name)[0] for name in motors}
        rows = [self._shaft(name) for name in motors]
        return {"t": self.now / SECOND, "rows": rows, "figure": self.figure.stands(self.robot, at)}

    def _shaft(self, name: str) -> list[Any]:
        position, velocity = self._world.shaft(name)
        return ["simulated", False, "", None, round(position, 5), round(velocity, 5), *[None] * 5, 0]

    def state(self) -> Json:
        """Return what else changes: the true pose."""
        return Scene.state(self) | {"state": "simulated", "systems": [], "reason": "what is true"}

    @property
    def _world(self) -> World:
        assert self.twins is not None
        return self.twins.world


class TwinBridge:
    """Simulated devices in ROS 2's graph: what is true. `watch` is called as that of a view is.

    Raises UserError if the network cannot be opened."""

    def __init__(self, made: Devices, address: str, domain: int) -> None:
        self._last = -PERIOD
        self._scene = TwinScene(Gateway(made.robot), "twin", dict, twins=made.twins)
        self._bridge = ShownBridge(self._scene, address, domain, made.clock, made.twins.world.cameras())
        self.name, self.close = self._bridge.name, self._bridge.close

    def watch(self, now: Nanos) -> None:
        """Publish the world. Never waits."""
        if now - self._last >= PERIOD:
            self._last = self._scene.now = now
            self._bridge.take(self._scene.present(), self._scene.truth(), self._scene.gateway)


class TwinView:
    """A view of simulated devices; `watch` is called at every iteration of the serving loop.

    Raises UserError if the address cannot be opened."""

    def __init__(self, made: Devices, address: Address, access: Access) -> None:
        self._stats, self._last = made.stats, -PERIOD
        self._scene = TwinScene(
            Gateway(made.robot), "twin", self._facts, made.twins.world.images, twins=made.twins
        )
        self._view = View([self._scene], address, access)
        self.url = self._view.url
        self.close = self._view.close

    def watch(self, now: Nanos) -> None:
        """Answer pages, and show them the world. Never waits."""
        if now - self._last < PERIOD:
            return
        self._last = self._scene.now = now
        self._view.poll(now)  # simulated devices take no instructions
        self._view.take(self._scene.present(), self._scene.truth())
        self._view.show(now)

    def _facts(self) -> Json:
        return {"ticks": 0, "sent": self._stats.sent, "longest": self._stats.late / MILLISECOND}
