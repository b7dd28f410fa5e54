"""Following errors: whether a joint does what it is commanded, and whether its feedback agrees with itself.

Rules. Only an armed device that is commanded is judged. The measured quantity must lie in a band: that of the
set-points, each side of which follows them with a lag (`LAG`), and a bound about it. The bounds are shares of
the robot file's limits; what is beyond them for its time is a fault of the joint, and the device is disarmed,
whatever its stop action: a loop that does not obey cannot brake or hold. A gap in the reports begins the
judgement anew (lost feedback has a fault of its own). State is plain data.

    quantity             beyond the band by                                  for              fault
    velocity (Velocity,  2.5 % of the limit, and `following_share`           following_time   NOT_FOLLOWED
      Hold: a ramp to 0) of the set-point
                           and the position has not changed by one bit       half of it       NOT_FOLLOWED
                         20 % of the limit, faster or backwards              60 ms            RUNS_AWAY
    position (Position)  what 2.5 % of the limit of velocity does in 0.3 s   following_time   NOT_FOLLOWED
    velocity (all)       20 % of the limit, beyond the limit; 60 %, where    60 ms            RUNS_AWAY
                           a torque is commanded (old reports: it overshoots)
    torque (Torque)      10 % of the limit, and half of the set-point        following_time   NO_TORQUE
                           (it may be less where it drives a shaft at its limit of velocity)
    position less the    as of position, and 50 ms of the velocity, more     40 ms            INCONSISTENT
      velocity's integral  where reports came late (with a memory of 1 s)

`NOTICED_WITHIN` has the time of each fault. What cannot be noticed in the joint alone:

    scaled encoder       position and velocity agree, and the device's loop follows them: the base's motion
                         (gyro, lidar) shows it; scaled in the position only, it is inconsistent
    weak motor           as long as it follows, such as at half of its torque; a torque that the device only
                         calculates shows nothing
    late commands        as long as the set-points stay as they are: it does what it should. Once they change
                         it does not follow; a device that only replies falls silent
    no torque in Torque  if the device reports what it should give: a shaft that stands may be blocked
    slow motion          below 2.5 % of the limit of velocity, and moves of position below its bound
    two motors swapped   each follows its own set-points: the base's motion shows it
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from gateway.core.faults import INCONSISTENT, NO_TORQUE, NOT_FOLLOWED, RUNS_AWAY, Finding
from gateway.core.limits import Limits, toward
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Hold, Nanos, Position, Torque, Velocity
from protocols.plugin import Spec

FLOOR = 0.025
"""Share of a limit of velocity within which a velocity is followed."""
FAST, FAST_FREE = 0.2, 0.6
"""Share of the limit of velocity by which a shaft that is faster than commanded runs away; if a torque is."""
HOLDING = 0.25
"""Share of the limit of acceleration with which a shaft comes to hold."""
TORQUE_FLOOR, TORQUE_SHARE = 0.1, 0.5
AT_LIMIT = 0.9
"""Share of the limit of velocity from which on a device may give less than a torque that drives it on."""
LAG = 0.1
"""s, of a device and its reports behind the set-points."""
SLACK = 0.3
"""s of FLOOR: the bound of a position."""
JITTER = 0.05
"""s by which the stamps of reports may be wrong against each other."""
MEMORY = 1.0
"""s"""
RUNAWAY_TIME: Nanos = 60 * MILLISECOND
INCONSISTENT_TIME: Nanos = 40 * MILLISECOND
LONGEST_STEP: Nanos = 20 * MILLISECOND
"""What one step counts at most: a single look shows nothing that lasts."""
GAP: Nanos = 100 * MILLISECOND
"""Without a report, or three of the device's own periods, if that is longer."""
LATEST = 0.5
"""s by which reports that came late have their stamps wrong, at most."""

NOTICED_WITHIN: dict[str, Nanos] = {
    "stuck encoder": 500 * MILLISECOND,
    "frozen feedback": 500 * MILLISECOND,
    "jumping encoder": 450 * MILLISECOND,
    "scaled position": 500 * MILLISECOND,
    "reversed encoder": 400 * MILLISECOND,
    "no torque": 1500 * MILLISECOND,
    "runaway": 300 * MILLISECOND,
}
"""The declared times, by fault, at a following time of 0.3 s: from when the motor is commanded to turn at a
tenth of its limit or more (no torque: it may coast for a while as fast as it should)."""


@dataclass(slots=True)
class Band:
    """Where a quantity may be that follows its set-points with a lag."""

    low: float
    high: float

    def follow(self, setpoint: float, share: float) -> None:
        """Let both sides follow by a share of their distance; neither leaves the set-point outside."""
        high = self.high + (setpoint - self.high) * share
        low = self.low + (setpoint - self.low) * share
        self.high = high if high > setpoint else setpoint
        self.low = low if low < setpoint else setpoint

    def distance(self, measured: float) -> float:
        """Return how far a value is outside."""
        if measured > self.high:
            return measured - self.high
        return self.low - measured if measured < self.low else 0.0


class Following:
    """The judgement of one joint. All at the output shaft."""

    def __init__(self, limits: Limits, spec: Spec, gear: float, time: Nanos, share: float) -> None:
        self._limits = limits
        self._time, self._share = time, share
        period = spec.feedback_period
        self._gap, self._lag = max(GAP, 3 * period), LAG + period / SECOND
        self._jitter = JITTER + 0.25 * period / SECOND
        place = spec.ranges.get("Feedback.position")
        self._span = (place.high - place.low) / gear if place else inf
        """A position that wraps jumps by this."""
        self._slack = FLOOR * limits.velocity * SLACK + (2.0 * place.resolution / gear if place else 0.0)
        self._at: Nanos = 0
        self._period = period
        self._reported_at: Nanos | None = None
        self._late = 0.0
        """s by which reports came late, as remembered: on a busy machine those that follow catch up, with the
        times at which they are read."""
        self.restart()

    def restart(self) -> None:
        """Forget what was before: the joint is not commanded."""
        self._kind: type[Command] | None = None
        self._band = Band(0.0, 0.0)
        self._rest = 0.0
        """The speed at which a shaft that comes to hold may still turn."""
        self._since: dict[int, Nanos] = {}
        """For how long each quantity has been out of bounds."""
        self.forget_motion()

    def forget_motion(self) -> None:
        """Forget what was measured: the position was given another value."""
        self._found: Finding | None = None
        self._moved_at: Nanos | None = None
        self._velocity = self._travel = self._fastest = 0.0
        self._position: float | None = None
        self._position_at: Nanos = 0
        self._changed_at: Nanos = 0
        """When the position was last another one."""
        self._offset: float | None = None
        """Position less the velocity's integral, as remembered."""
        self._wrong_since: Nanos | None = None
        self._new_velocity: tuple[Nanos, float] | None = None
        """The newest of this step, with its time."""
        self._new_position: tuple[Nanos, float] | None = None

    # -- the feedback against itself -------------------------------------------------------------------

    def on_motion(self, t: Nanos, position: float | None, velocity: float | None) -> None:
        """Note what was measured at `t`; None: not in this report.

        Only the newest of a step is compared: reports without stamps that were read late have one time, and
        different positions."""
        if velocity is not None:
            self._new_velocity = (t, velocity)
            if self._reported_at is not None and t > self._reported_at:
                span = t - self._reported_at
                late = min(LATEST, (span - self._period) / SECOND)
                self._late = max(late, self._late * (1.0 - min(1.0, span / SECOND / MEMORY)))
            self._reported_at = t
        if position is not None:
            self._new_position = (t, position)

    def _take_new(self) -> None:
        """Compare the newest reports of this step."""
        (moved, velocity), self._new_velocity = self._new_velocity or (0, None), None
        (placed, position), self._new_position = self._new_position or (0, None), None
        if velocity is not None:
            self._on_velocity(moved, velocity)
        if position is not None and self._moved_at is not None:
            self._compare(
                placed, position, self._travel + self._velocity * (placed - self._moved_at) / SECOND
            )

    def _on_velocity(self, t: Nanos, velocity: float) -> None:
        last = self._moved_at
        if last is not None and not 0 <= t - last <= self._gap:
            self.forget_motion()
            last = None
        if last is not None:
            span = (t - last) / SECOND
            self._travel += 0.5 * (self._velocity + velocity) * span
            self._fastest *= max(0.0, 1.0 - span / (4.0 * LAG))
        if abs(velocity) > self._fastest:
            self._fastest = abs(velocity)
        self._moved_at, self._velocity = t, velocity

    def _compare(self, t: Nanos, position: float, travel: float) -> None:
        offset, before = self._offset, self._position
        if offset is None or before is None or abs(position - before) > 0.5 * self._span:
            self._offset, self._position, self._position_at = position - travel, position, t
            self._changed_at = t
            return
        if position != before:
            self._changed_at = t
        wrong = position - travel - offset
        self._offset = offset + wrong * min(1.0, (t - self._position_at) / SECOND / MEMORY)
        self._position, self._position_at = position, t
        if abs(wrong) <= self._slack + (self._jitter + self._late) * self._fastest:
            self._wrong_since = None
        elif self._wrong_since is None:
            self._wrong_since = t
        elif t - self._wrong_since >= INCONSISTENT_TIME and self._found is None:
            self._found = INCONSISTENT, f"{wrong:.2g} rad apart"

    # -- the feedback against the command --------------------------------------------------------------

    def judge(self, now: Nanos, sent: Command, measured: Feedback, age: Nanos) -> Finding | None:
        """Return what is wrong with the motion under the command that was last sent; None if nothing is.

        `age`: of what was measured."""
        dt = min(now - self._at, LONGEST_STEP)
        self._at = now
        if age > self._gap:
            self.restart()
            return None
        if self._kind is not type(sent):
            self._begin(sent, measured)
        self._take_new()
        limit, speed, band = self._limits.velocity, measured.velocity or 0.0, self._band
        fast, margin, code, turning = abs(speed) - limit, FAST, NOT_FOLLOWED, False
        share, floor, part, actual = min(1.0, dt / SECOND / self._lag), self._slack, 0.0, measured.position
        if isinstance(sent, Position):
            setpoint = sent.position
        elif isinstance(sent, (Velocity, Hold)):
            floor, part, actual, turning = FLOOR * limit, self._share, measured.velocity, True
            setpoint = sent.velocity if isinstance(sent, Velocity) else self._slow_down(dt)
        else:  # an Impedance is followed by no quantity of its own
            setpoint, actual = (sent.torque, measured.torque) if isinstance(sent, Torque) else (0.0, None)
            floor, part, code, margin = TORQUE_FLOOR * self._limits.torque, TORQUE_SHARE, NO_TORQUE, FAST_FREE
        found = self._found
        if actual is not None:
            band.follow(setpoint, share)
            beyond = band.distance(actual) > floor + part * max(-band.low, band.high)
            if beyond and isinstance(sent, Torque) and speed * setpoint > 0.0:
                beyond = abs(speed) < AT_LIMIT * limit
            still = self._moved_at is not None and self._moved_at - self._changed_at > self._time // 3
            if self._lasts(code, beyond, dt, self._time // 2 if still else self._time):
                found = found or (code, f"{setpoint:.3g} commanded, {actual:.3g} measured")
            if turning:
                fast = max(fast, speed - max(band.high, 0.0), min(band.low, 0.0) - speed)
        if self._lasts(RUNS_AWAY, fast > margin * limit, dt, RUNAWAY_TIME):
            found = RUNS_AWAY, f"{speed:.3g} rad/s measured"
        return found

    def _slow_down(self, dt: Nanos) -> float:
        """Let the band of a shaft that comes to hold end at a slow ramp; return its set-point.

        It may turn back as fast, to where it was when Hold was given."""
        self._rest = toward(self._rest, 0.0, HOLDING * self._limits.acceleration * dt / SECOND)
        self._band.low, self._band.high = -self._rest, self._rest
        return 0.0

    def _begin(self, sent: Command, measured: Feedback) -> None:
        """Begin with another kind of command: the band includes what is measured."""
        if self._kind is None:
            self.forget_motion()
        self._kind = type(sent)
        self._since.clear()
        actual: float | None = measured.velocity
        self._rest = abs(actual or 0.0)
        if isinstance(sent, Position):
            actual = measured.position
        elif isinstance(sent, Torque):
            actual = measured.torque
        self._band = Band(actual or 0.0, actual or 0.0)

    def _lasts(self, code: int, beyond: bool, dt: Nanos, time: Nanos) -> bool:
        """True if a bound has been exceeded for a time; within it, that time runs back at half speed."""
        since = self._since.get(code, 0)
        if not since and not beyond:
            return False
        self._since[code] = since = since + dt if beyond else max(0, since - dt // 2)
        return since > time
