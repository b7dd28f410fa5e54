"""The quadruped through its motors' language and the whole brain: three metres, a stop, a curve."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing

import pytest

from gateway.config import load_robot
from gateway.core.tick import Tick
from gateway.runtime.session import Session, open_session
from gateway.sim.linked import Linked
from protocols.messages import Goal, Mode, Release, Stop

pytestmark = pytest.mark.prove

STEP = 0.005
"""s, of the robot"""
STEADY = math.radians(3.0)
"""Largest roll and pitch while it walks."""


class Watch:
    """What the trunk does while a session runs."""

    def __init__(self, session: Session, ticks: Iterator[Tick]) -> None:
        assert session.twins is not None
        scene = session.twins.world.scene
        assert isinstance(scene, Linked)
        self.session, self.scene, self._ticks = session, scene, ticks
        self.tilt = 0.0
        """rad, largest roll or pitch of the last `run`"""
        self.heights: list[float] = []
        """m, in it"""

    def run(self, seconds: float, reached: int | None = None) -> float:
        """Run for a time [s], or until so many goals are reached; return how long it took."""
        self.tilt, self.heights = 0.0, []
        for _ in range(round(seconds / STEP)):
            next(self._ticks)
            roll, pitch, height = self.scene.attitude()
            self.tilt = max(self.tilt, abs(roll), abs(pitch))
            self.heights.append(height)
            if reached is not None and self.session.belief.reached >= reached:
                break
        return len(self.heights) * STEP

    def modes(self) -> set[Mode | None]:
        return {joint.mode for joint in self.session.joints.values()}


def test_three_metres_a_stop_and_a_curve() -> None:
    with open_session(load_robot("quadruped"), simulated=True, seed=1) as session:
        with closing(session.run()) as ticks:
            watch = Watch(session, ticks)
            watch.run(1.0)
            assert watch.modes() == {Mode.READY}, "nothing arms it before there is a task"
            assert max(watch.heights) < 0.12
            session.submit(Goal(3.0, 0.0))
            watch.run(2.0)
            took = 2.0 + watch.run(20.0, reached=1)
            true = watch.scene.pose()
            print(f"3 m in {took:.1f} s, to ({true.x:.3f}, {true.y:.3f}); roll, pitch ≤ {watch.tilt:.3f} rad")
            print(f"height {min(watch.heights):.3f} to {max(watch.heights):.3f} m")
            assert math.hypot(true.x - 3.0, true.y) < 0.06
            assert watch.tilt < STEADY
            assert 0.29 < min(watch.heights) < max(watch.heights) < 0.31
            watch.run(2.0)
            watch.run(2.0)
            assert max(watch.heights) - min(watch.heights) < 1e-3, "it stands"
            assert watch.modes() == {Mode.ARMED}

            session.submit(Goal(3.0, 1.5))
            watch.run(3.0)
            session.submit(Stop("a test"))
            watch.run(2.0)
            place = watch.scene.pose()
            watch.run(2.0)
            assert watch.modes() == {Mode.ARMED}
            assert watch.tilt < math.radians(12.0), "it stands on the feet that were on the floor"
            assert min(watch.heights) > 0.25
            session.submit(Release())
            watch.run(2.0)
            still = watch.scene.pose()
            assert math.hypot(still.x - place.x, still.y - place.y) < 0.15, "nothing resumes by itself"
            session.submit(Goal(1.0, 0.8))
            watch.run(40.0, reached=2)
            true = watch.scene.pose()
            print(f"then to ({true.x:.3f}, {true.y:.3f})")
            assert math.hypot(true.x - 1.0, true.y - 0.8) < 0.1
            assert watch.scene.touches == 0
        assert not session.gateway.still_armed()
