"""ROS 2's graph and a session: the robot as it runs, with the times of the calendar."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gateway.core.clock import Clock, PacedClock, WallClock, stopwatch
from gateway.core.tick import Tick
from gateway.ros.bridge import Bridge, open_bridge
from gateway.ros.graph import node_name
from gateway.ros.images import Camera
from gateway.view.scene import Scene
from protocols.messages import Instruction, Nanos

if TYPE_CHECKING:
    from brain.belief import Belief
    from gateway.core.step import Gateway
    from gateway.runtime.live_view import Viewed


class SessionBridge:
    """A session's place in the graph. Raises UserError if the network cannot be opened."""

    def __init__(self, session: Viewed, address: str, domain: int, cameras: Sequence[Camera] = ()) -> None:
        """`cameras`: whose images are shown."""
        clock = session.clock
        self._now = clock.machine.now if isinstance(clock, PacedClock) else stopwatch
        scene = Scene(session.gateway, "live", dict)
        self._bridge = open_bridge(scene, address, domain, epoch(clock), cameras)
        robot = session.robot
        node = f"{robot.ros.namespace}/{node_name(robot)}"
        self.name = f"{node} in domain {domain}, at {self._bridge.where}"
        self.ends, self.close = self._bridge.ends, self._bridge.close

    def poll(self, others: Sequence[Instruction]) -> list[Instruction]:
        """Return what the graph asks of the robot. Never waits."""
        return self._bridge.poll(self._now(), others)

    def take(self, tick: Tick, belief: Belief) -> None:
        """Publish a tick."""
        self._bridge.take(tick, belief)
        self._bridge.show(self._now())


class ShownBridge:
    """The place in the graph of what is only shown: a recording, or simulated devices. One that fails is
    left, and keeps nothing from the rest.

    Raises UserError if the network cannot be opened."""

    def __init__(
        self, scene: Scene, address: str, domain: int, clock: Clock, cameras: Sequence[Camera] = ()
    ) -> None:
        """`cameras`: whose images are shown."""
        self._clock = clock
        self._bridge: Bridge | None = open_bridge(scene, address, domain, epoch(clock), cameras)
        self.name = f"/{node_name(scene.robot)} in domain {domain}, at {self._bridge.where}"

    def take(self, tick: Tick, belief: Belief, gateway: Gateway) -> None:
        """Publish a tick of a gateway, which may be another one after a jump."""
        bridge = self._bridge
        if bridge is None:
            return
        if bridge.scene.gateway is not gateway:
            bridge.scene.adopt(gateway)
        try:
            now = self._clock.now()
            bridge.poll(now)
            bridge.take(tick, belief)
            bridge.show(now)
        except Exception:
            logging.getLogger("gateway").exception("ROS 2's graph is left")
            self.close()

    def close(self) -> None:
        """Leave the graph."""
        bridge, self._bridge = self._bridge, None
        if bridge is not None:
            bridge.close()


def epoch(clock: Clock) -> Nanos:
    """Return the calendar's time, since 1970, at a clock's zero."""
    wall = clock.machine if isinstance(clock, PacedClock) else clock
    machine = wall if isinstance(wall, WallClock) else WallClock()
    return machine.system_offset() + machine.now() - clock.now()
