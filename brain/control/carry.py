"""The pose by which a path is followed: a path planned in the frame "map" is carried into "odom".

Rules. In "odom" the base moves without leaps; where a path of the map lies there follows from the base's
poses in both. When that in the map is corrected (a match, a fix, another place found), the path moves to
where it should be, so gently that the base follows it at a small error: at most at a share of the base's
speed, turning at most at `TURN`, and both gained and lost within a bound. At rest, and for a new path, which
begins where the base is believed to be, it is there at once. Since following needs only where the base is
from the path, what is kept is a pose of the base in the map: its motion in "odom" continues it, on its way
to the one believed.
"""

from __future__ import annotations

from math import hypot, sqrt

from brain.belief import Pose
from brain.bodies.plane import REST, Twist, moved, seen_from, wrap

SHARE, LEAST, GAIN = 0.3, 0.03, 1.0
"""Of the speed, m/s, m/s²: how fast a path moves"""
TURN, TURN_GAIN = 0.3, 2.0
"""rad/s, rad/s²: how fast it turns"""


class Carry:
    """The pose by which a path is followed. Plain data."""

    def __init__(self) -> None:
        self._pose: Pose | None = None
        self._odom: Pose | None = None
        """The newest, in the map and in "odom" """
        self._rates = 0.0, 0.0
        """m/s and rad/s at which the path moves"""
        self.settled = False
        """It is the pose believed."""

    def begin(self) -> None:
        """Take the next pose as it is believed: a new path begins there."""
        self._pose = None

    def pose(self, believed: Pose, odom: Pose, twist: Twist, dt: float) -> Pose:
        """Return the pose in the map by which to steer: `dt` [s] after the last one, at this twist."""
        before, was, self._odom = self._pose, self._odom, odom
        if before is None or was is None or twist == REST:
            self._pose, self._rates, self.settled = believed, (0.0, 0.0), True
            return believed
        before = moved(before, seen_from(was, odom))
        dx, dy, turn = believed.x - before.x, believed.y - before.y, wrap(believed.yaw - before.yaw)
        far, rate = hypot(dx, dy), self._rates[0]
        rate = _rate(far, rate, max(SHARE * twist.speed, LEAST), GAIN, dt)
        turning = _rate(abs(turn), self._rates[1], TURN, TURN_GAIN, dt)
        share, by = rate * dt / max(far, 1e-9), turning * dt / max(abs(turn), 1e-9)
        left = max(far - rate * dt, abs(turn) - turning * dt)
        self._rates, self.settled = (rate, turning), left < 1e-6
        self._pose = Pose(before.x + share * dx, before.y + share * dy, wrap(before.yaw + by * turn))
        return self._pose


def _rate(left: float, before: float, most: float, gain: float, dt: float) -> float:
    """Return the rate at which to cover what is left: gained and lost within a bound."""
    return min(before + gain * dt, most, sqrt(2.0 * gain * left), left / dt)
