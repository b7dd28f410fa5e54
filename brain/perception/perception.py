"""Perception: from the body's events to estimate, map, and how far to trust them.

Rules. Every event is processed once; each measurement applies at its own time, whatever the order of arrival.
Wheels, gyro and fixes go to the filter. A scan waits until the filter has reached its end; then, one part of
the work in each step: it is freed from the motion during the sweep; placed among the keyframes and matched
with the map (`placing`), which corrects the filter; drawn, if nothing speaks against the pose; compared with
the scans before; and kept, if it is the next keyframe. Where the scans show that the pose is wrong, nothing
is drawn, and the map is searched for the place. What is not used is counted in `anomalies`, by name and
reason.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import Annotated, NamedTuple

import numpy as np

from brain.belief import Estimate, Floats, Pose
from brain.bodies.body import Base
from brain.bodies.plane import moved, seen_from, wrap
from brain.perception.beams import Beams
from brain.perception.body_scan import BodyScan, Bools, to_body
from brain.perception.consistency import (
    LEAST_KNOWN,
    LEAST_SCANS,
    LITTLE,
    POOR,
    RECOGNISED_SCANS,
    Agreement,
    Consistency,
    Verdict,
)
from brain.perception.engine import pose_part
from brain.perception.filter import Filter
from brain.perception.filter_inputs import GateResult, GyroRate, Input, Nis, ScanEnd, WheelAngle
from brain.perception.filter_settings import FilterSettings
from brain.perception.filter_state import FilterState
from brain.perception.fixes import Fixes, FixSettings, is_possible
from brain.perception.keyframes import KeyframeSettings, Placed
from brain.perception.lag import Lag
from brain.perception.loops import LoopSettings
from brain.perception.map import Map, MapSettings
from brain.perception.markers import Markers, MarkerSettings
from brain.perception.markers import is_possible as is_possible_marker
from brain.perception.match import MatchSettings
from brain.perception.motion_check import Contradiction, MotionCheck
from brain.perception.mount import Mount
from brain.perception.movers import Movers, Moving
from brain.perception.percept import Sight, extrapolated
from brain.perception.placing import Placing, is_covered
from brain.perception.redraw import Redraw, correction
from brain.perception.relocalise import PoseFound, PoseSearch, PoseSearching, RelocaliseSettings
from brain.perception.saved_keyframes import SavedKeyframes
from brain.perception.saved_map import SavedMap
from protocols import messages as msg
from protocols.bounds import Bounds, Duration, check
from protocols.messages import MILLISECOND, SECOND, Event, Feedback, Fix, Imu, LaserScan, Nanos, PoseReading


@dataclass(frozen=True, slots=True)
class PerceptionSettings:
    """All settings of perception."""

    filter: FilterSettings = field(default_factory=FilterSettings)
    gyro_sigma: Annotated[float, Bounds(1e-6, 1.0, "rad/s")] = 0.01
    """rad/s: standard deviation of one reading"""
    map: MapSettings = field(default_factory=MapSettings)
    match: MatchSettings = field(default_factory=MatchSettings)
    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)
    loops: LoopSettings = field(default_factory=LoopSettings)
    relocalise: RelocaliseSettings = field(default_factory=RelocaliseSettings)
    fixes: FixSettings = field(default_factory=FixSettings)
    markers: MarkerSettings = field(default_factory=MarkerSettings)
    given: bool = False
    """Another program perceives: it sends the grid that is planned on, and tells where the robot is (ROS 2's
    `map` and `initialpose`). Meanwhile that follows wheels and IMU alone."""
    matching: bool = True
    """Match scans against the map; if not, they are only added to it."""
    scan_wait: Annotated[Duration, Bounds(0.0, 1000.0)] = 500 * MILLISECOND
    """Time that a scan waits for the wheels and the gyro."""
    least_returns: Annotated[float, Bounds(0.0, 1.0)] = 0.15
    """A scan with returns from less than this share of its rays counts as none. 0: in open ground, where no
    return is to be expected; such a scan is no proof of free space, either, and is not added to the map."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def matches(self) -> bool:
        """Whether scans correct where the robot is."""
        return self.matching and not self.given


CONSTANT = "every value is as before: it does not measure"
CONSTANT_COUNT, CONSTANT_FOR = 20, 200 * MILLISECOND
"""An IMU measures nothing if so many readings over that time equal each other in all six numbers: noise alone
changes the last digit of one of them. A scan does if it equals the one before."""
FASTEST = 1e3
"""rad/s: no gyro reads more."""
MAX_BEAMS = 10_000
"""Of a scan."""
SCANS_WAITING = 32
"""Most scans that wait for the filter."""
LONGEST_SWEEP: Nanos = SECOND
ASTRAY = 0.5
"""Of what a lost robot has driven, by which it may be off: it was not carried meanwhile"""
FAR, FAR_YAW = 1.0, 0.6
"""m, rad: who is found farther off was carried there; two scans must say so"""
NO_PLACE = "lost: it has just begun, and where it is in the saved map was not stated"
ADRIFT = "its place in the map is doubtful"
GOES_ON = "the map does not have this ground, and goes on from where the wheels have taken the robot since"
DRAWS = 1
"""Slices more that a keyframe drawn again counts for"""
BEGINNING: Nanos = 5 * SECOND
"""Who is lost so soon, and has hardly moved, began its map with somebody who has gone"""
MOST_MOVING = 0.1
"""Share of the hits that may be of what moves; if there are more, it is the estimate that moves."""


class _Work(Enum):
    """What one step does for a scan, after it was freed from the motion."""

    MATCH = auto()
    DRAW = auto()
    COMPARE = auto()
    KEEP = auto()


@dataclass(frozen=True, slots=True)
class _Part:
    """A scan on its way."""

    name: str
    t: Nanos
    """Its end"""
    scan: BodyScan
    static: Bools
    """Of each beam, whether it ends at what does not move: what moves leaves no trace in the map"""
    draw: bool = True
    """It may be added to the map,"""
    keep: bool = True
    """and to the keyframes"""
    placed: Placed | None = None
    """Where it was placed among those"""


class Anchor(NamedTuple):
    """Where the robot was, as it can be told later, too."""

    keyframe: int
    """The newest then"""
    pose: Pose
    """In its frame"""


class _Search(NamedTuple):
    """A search for the place."""

    work: PoseSearch
    scan: BodyScan
    believed: Pose
    """When the scan was taken"""


@dataclass(slots=True)
class _NewGround:
    """Ground that the map does not have, on which a lost robot drives."""

    unknown: int = 0
    """Scans in a row that show it"""
    first: int | None = None
    """Keyframe with which the map is begun anew; None: it is not, so far"""
    began: float = 0.0
    """m driven then"""
    agreeing: int = 0
    """Scans in a row that agree with the keyframes since then"""

    def on_scan(self, one: Agreement, driven: float) -> bool:
        """Take what a scan agrees with, m driven while lost; return whether to begin with new keyframes."""
        if self.first is None:
            self.unknown = self.unknown + 1 if one.seen is not None and one.seen.known < LEAST_KNOWN else 0
            return self.unknown >= LEAST_SCANS and driven > FAR
        agrees = one.share is not None and one.share > POOR and not one.disagrees
        self.agreeing = self.agreeing + 1 if agrees else 0
        return one.share is not None and one.share < LITTLE

    def begin(self, first: int, driven: float) -> None:
        """Begin with this keyframe."""
        self.first, self.began, self.agreeing = first, driven, 0

    def goes_on(self, driven: float) -> bool:
        """Whether scans agree with what was seen since it began."""
        return self.agreeing >= RECOGNISED_SCANS and driven - self.began > FAR


class Perception:
    """Estimate, map and verdict. Plain data: a deep copy continues exactly as the original."""

    def __init__(
        self,
        body: Base,
        mounts: Mapping[str, Mount],
        settings: PerceptionSettings,
        self_seen: float = 0.0,
        saved: SavedMap | None = None,
    ) -> None:
        """`self_seen`: m about the footprint, within which a beam ends at the robot's own body; `saved`: the
        map that it begins in."""
        self.body = body
        self.settings = settings
        self.map = Map(settings.map, saved)
        self._saved, self._begun = saved, saved is None
        self.is_placed = saved is None
        """Whether it has known where it is in the map that it began in: before, what it believes is no place
        there, and says nothing of where it may be"""
        self.rejected: dict[str, int] = dict.fromkeys((*body.joints, *mounts), 0)
        """Number of measurements rejected by the chi-square gate, by motor or sensor."""
        self.anomalies: dict[str, dict[str, int]] = {name: {} for name in self.rejected}
        """Number of measurements not used, or used against the gate, by motor or sensor, then by reason."""
        self.absent: dict[str, str] = {}
        """Why the newest reading of a sensor shows nothing, by sensor; it counts as none."""
        self.verdict = Verdict()
        """How far to trust the estimate, and why not more."""
        self.estimate: Estimate | None = None
        """The filter's state at its newest measurement; None before all joints have reported."""
        self._filter = Filter(body, settings.filter)
        self.mounts = dict(mounts)
        """Where the sensors are: a lidar whose mounting differs from the stated one is corrected."""
        self._vertical = {name: mount.rotation()[2] for name, mount in mounts.items()}
        self._last_scan: dict[str, tuple[Nanos, Floats]] = {}
        """Time and ranges of the newest scan."""
        self._self_seen = self_seen
        self._beams: dict[str, Beams] = {}
        self._last_imu: dict[str, tuple[Imu, int]] = {}
        """First reading of a row of equal ones, and how many they are."""
        self._scans: deque[LaserScan] = deque()
        self._todo: deque[tuple[_Work, _Part]] = deque()
        """What is left to do for the scan before those."""
        self._map_began: Pose | None = None
        self._map_began_at: Nanos = 0
        self._consistency = Consistency()
        self._placing = Placing(settings.match, settings.keyframes, settings.loops, saved)
        self._sure: dict[str, float] = {}
        """Variance of the position [m²] after the newest scan of each lidar that showed a place"""
        self._fixes = Fixes(settings.fixes)
        self.markers = Markers(settings.markers)
        self._outside: set[str] = set()
        """Sensors that have measured the pose."""
        self._check = MotionCheck(body)
        self._movers = Movers()
        self._lag = Lag()
        self._joints = frozenset(body.joints)
        self._compared: FilterState | None = None
        """Up to which the wheels' motion was compared."""
        self._notes: list[str] = []
        self._redraw = Redraw()
        self._credit = 0
        """Slices of the loops' work that are left to be done"""
        self._search: _Search | None = None
        self._new_ground: _NewGround | None = None
        """Where a lost robot goes on"""
        self._found: tuple[Pose, Pose] | None = None
        """Where a lost robot was found by the search before, and where it was believed to be then"""

    @property
    def raw(self) -> Pose:
        """Dead reckoning by the wheels alone, for comparison."""
        x, y, yaw = self._filter.state.raw
        return Pose(x, y, wrap(yaw))

    def moving(self, there: Pose, *, doubts: bool = False) -> tuple[Moving, ...]:
        """Return what moves, as it is at the estimate's time, in a frame in which the robot then is `there`:
        `raw`, or the estimate's pose. `doubts`: also what may move."""
        now = self.estimate
        return () if now is None else self._movers.moving(now.t, now.pose, there, doubts=doubts)

    def sight(self, now: Nanos) -> Sight:
        """Return what is known now."""
        estimate, raw = self.estimate, self.raw
        pose = None if estimate is None else extrapolated(estimate, estimate.pose, now)
        return Sight(
            estimate,
            pose,
            None if estimate is None else extrapolated(estimate, estimate.odom, now),
            raw,
            self.map,
            () if pose is None else self.moving(pose),
            self.moving(raw, doubts=True),
            self.marker,
            self.verdict,
            tuple(self.contradictions()),
            self.rejected,
            self.absent,
            self.helpful,
        )

    def anchor(self, pose: Pose) -> Anchor | None:
        """Return a pose in the map, as it is known now, relative to the newest keyframe; None before the
        first."""
        keyframes = self._placing.keyframes
        if not keyframes.count:
            return None
        newest = keyframes.count - 1
        return Anchor(newest, seen_from(keyframes.pose(newest), pose))

    def anchored(self, anchor: Anchor) -> Pose:
        """Return where the robot was, as it is known now."""
        return moved(self._placing.keyframes.pose(anchor.keyframe), anchor.pose)

    def saved_keyframes(self) -> SavedKeyframes:
        """Return what the map can be drawn again from, and gone on from, later."""
        return self._placing.saved()

    @property
    def lags(self) -> Mapping[str, float]:
        """By how much the stamps of lidars are late [s], where that was found."""
        return self._lag.found

    @property
    def closed(self) -> int:
        """Number of loops that count."""
        return self._placing.loops.closed

    @property
    def loops(self) -> str:
        """The keyframes and loops, in words."""
        return f"{len(self._placing.keyframes.kept)} keyframes, {self.closed} loops"

    @property
    def gyro_bias(self) -> float:
        """Estimated gyro bias [rad/s]."""
        return self._filter.bias

    @property
    def slip(self) -> float:
        """Estimated slip: the share of the wheels' travel that the base does not move."""
        return self._filter.scale

    @property
    def nis(self) -> Mapping[str, Nis]:
        """Normalised innovations squared, by sensor."""
        return self._filter.nis

    @property
    def helpful(self) -> frozenset[str]:
        """The sensors that are not needed: all but lidars, where wheels and a lidar suffice."""
        return frozenset(self.mounts.keys() - self._last_scan.keys() if self._last_scan else ())

    def contradictions(self) -> list[Contradiction]:
        """Return what the sources show that cannot all be true."""
        return self._check.contradictions()

    def explanations(self) -> list[str]:
        """Return what, if it was wrong, would make the sources agree; it stays told."""
        return [one.told for one in self._check.explanations.values() if one.told]

    def take_notes(self) -> list[str]:
        """Return the notes for the operator since the last call."""
        notes, self._notes = self._notes, []
        return notes

    def observe(self, now: Nanos, events: Sequence[Event]) -> None:
        """Process the events since the last call, and the next part of the scans' work."""
        inputs: list[Input] = []
        for event in events:
            if isinstance(event, Feedback):
                if event.motor in self._joints and event.position is not None:
                    inputs.append(WheelAngle(event.motor, event.t, event.position))
            elif isinstance(event, Imu):
                inputs += self._on_imu(event)
            elif isinstance(event, LaserScan):
                if self._on_scan(event):
                    inputs.append(ScanEnd(_end(event)))
            elif isinstance(event, Fix | PoseReading) and event.sensor in self.mounts:
                inputs += self._on_fix(event)
            elif isinstance(event, msg.Marker) and event.sensor in self.mounts:
                inputs += self._on_marker(event)
        if inputs:
            self._apply(inputs)
        if not self._begun and self.estimate is not None:
            self._begun = True
            self._begin(self.estimate)
        self._work(now)

    def _begin(self, estimate: Estimate) -> None:
        """Begin in a saved map: where that was stated, or by looking for the place."""
        saved = self._saved
        assert saved is not None, "there is one"
        if (start := saved.start) is None:
            self._consistency.lose(NO_PLACE)
            at = "the place is looked for"
        else:
            self._relocate(estimate.t, start.pose, start.covariance, "began in a saved map")
            at = f"at ({start.x:.2f}, {start.y:.2f}), {math.degrees(start.yaw):.0f}°"
        self._set_verdict()
        self._notes.append(f"began in a saved map of {saved.text}: {at}")
        self._notes += filter(None, [saved.remark])

    def locate(self, pose: Pose, sigma: float, sigma_yaw: float) -> bool:
        """Believe that the robot is at a pose now, as sure as that [m, rad]; return False before the first
        estimate. What scans show decides from then on, as ever."""
        estimate = self.estimate
        if estimate is None:
            return False
        believed, off = estimate.pose, math.dist((estimate.pose.x, estimate.pose.y), (pose.x, pose.y))
        turn = abs(math.degrees(wrap(pose.yaw - believed.yaw)))
        self._search = self._found = None
        self._relocate(estimate.t, pose, np.diag([sigma**2, sigma**2, sigma_yaw**2]), "told where it is")
        self._set_verdict()
        self._notes.append(
            f"told that it is at ({pose.x:.2f}, {pose.y:.2f}), {math.degrees(pose.yaw):.0f}°: "
            f"{off:.2f} m and {turn:.0f}° from where it took itself to be"
        )
        return True

    def finish(self, now: Nanos) -> None:
        """Do what is left of the scans that came. A robot's steps between two scans do that; a log whose
        events are as far apart as its scans has none."""
        while self._todo:
            self.observe(now, [])

    def settle(self) -> None:
        """Do all that is left: of the scans, of loops, of the map that is drawn again. A recording has ended,
        and its map is to be kept."""
        while self._todo:
            self._do(*self._todo.popleft())
        while self._may_close_loops and (self._placing.loops.busy or self._redraw.busy):
            self._close_loops()

    def _apply(self, inputs: Sequence[Input]) -> dict[str, GateResult]:
        """Give measurements to the filter; return the newest decision by source."""
        results: dict[str, GateResult] = {}
        for judged in self._filter.observe(inputs):
            results[judged.source] = judged.result
            if judged.result is GateResult.ACCEPTED:
                continue
            self._count(judged.source, judged.result)
            if judged.result is GateResult.REJECTED:
                self.rejected[judged.source] += 1
            elif judged.result is GateResult.JUMPED:
                moving = not self._filter.state.resting
                self._check.on_jump(judged.source, moving)
        self._compare_wheels()
        t = self._filter.t
        if t is not None:
            x, y, yaw = self._filter.state.x[:3]
            linear, angular, lateral = self._filter.twist
            covariance = pose_part(self._filter.state.P)
            odom = Pose(*self._filter.odom[:2], wrap(self._filter.odom[2]))
            self._lag.on_motion(t, odom)
            self.estimate = Estimate(t, Pose(x, y, wrap(yaw)), linear, angular, covariance, lateral, odom)
        return results

    def _compare_wheels(self) -> None:
        state = self._filter.state
        if self._filter.t is None:
            return
        before = self._compared
        if before is None or state.t > before.t:
            if before is not None:
                ahead, aside, slid = (
                    now - then for now, then in zip(state.travelled, before.travelled, strict=True)
                )
                self._check.on_wheels(before.t, state.t, ahead, state.raw[2] - before.raw[2], aside, slid)
            self._compared = state

    def _on_fix(self, event: Fix | PoseReading) -> list[Input]:
        """Return the measurement; of a fix, that of the antenna's place, moved to the robot's origin."""
        if not is_possible(event):
            self._count(event.sensor, "no possible place")
            return []
        self._outside.add(event.sensor)
        measured = self._fixes.observe(event)
        if isinstance(event, PoseReading):
            return [measured]
        mount, yaw = self.mounts[event.sensor], self._filter.state.x[2]
        c, s = math.cos(yaw), math.sin(yaw)
        arm = np.array([c * mount.x - s * mount.y, s * mount.x + c * mount.y])
        return [replace(measured, value=measured.value - arm)]

    def _on_marker(self, event: msg.Marker) -> list[Input]:
        """Keep where it is; return the measurement that it is if its place is known."""
        here = self._filter.at(event.t)
        if here is None or not is_possible_marker(event):
            self._count(event.sensor, "no possible marker" if here else "no estimate for its time")
            return []
        measured = self.markers.observe(event, self.mounts[event.sensor], here[0], here[1][2, 2])
        if measured is None:
            return []
        self._outside.add(event.sensor)
        return [measured]

    def marker(self, number: int) -> Pose | None:
        """Return where a marker is that a camera sees now, its x axis out of its face; None if it is not
        seen."""
        return None if self._filter.t is None else self.markers.seen(number, self._filter.t)

    # -- gyro ----------------------------------------------------------------------------------

    def _on_imu(self, imu: Imu) -> list[Input]:
        vertical = self._vertical.get(imu.sensor)
        if vertical is None or self._is_constant(imu):
            return []
        rate = sum(a * b for a, b in zip(vertical, imu.angular_velocity, strict=True))
        if FASTEST < abs(rate) < math.inf:
            self._count(imu.sensor, "no possible rate")
            return []
        if math.isfinite(rate):
            self._check.on_gyro(imu.sensor, imu.t, rate)
        return [GyroRate(imu.sensor, imu.t, rate, self.settings.gyro_sigma)]

    def _is_constant(self, imu: Imu) -> bool:
        first, count = self._last_imu.get(imu.sensor, (imu, 0))
        if (imu.angular_velocity, imu.linear_acceleration) != (
            first.angular_velocity,
            first.linear_acceleration,
        ):
            first, count = imu, 0
        self._last_imu[imu.sensor] = first, count + 1
        constant = count + 1 >= CONSTANT_COUNT and imu.t - first.t >= CONSTANT_FOR
        self._set_absent(imu.sensor, CONSTANT if constant else "", CONSTANT)
        return constant

    # -- lidar ---------------------------------------------------------------------------------

    def _on_scan(self, scan: LaserScan) -> bool:
        """Keep a scan for the work; return whether there is something to do for it."""
        if scan.sensor not in self.mounts:
            return False
        last = self._last_scan.get(scan.sensor)
        if not _is_valid(scan):
            self._count(scan.sensor, "not a scan")
        elif last is not None and scan.t <= last[0]:
            self._count(scan.sensor, "out of order")
        else:
            ranges = np.asarray(scan.ranges, dtype=np.float64)
            self._last_scan[scan.sensor] = scan.t, ranges
            self._outside.add(scan.sensor)
            returns = int(np.count_nonzero((scan.range_min <= ranges) & (ranges < scan.range_max)))
            few = returns < self.settings.least_returns * len(ranges)
            reason = f"{returns} of {len(ranges)} rays have returns" if few else ""
            if returns and last is not None and np.array_equal(ranges, last[1], equal_nan=True):
                reason = CONSTANT
            elif not reason:
                beams = self._beams.setdefault(scan.sensor, Beams(self.body.outline, self._self_seen))
                reason = beams.observe(scan, ranges, self.mounts[scan.sensor], Pose(*self._filter.state.raw))
            self._set_absent(scan.sensor, reason, "too few returns" if few else "some beams do not measure")
            if returns and not reason:
                self._scans.append(scan)
                if len(self._scans) > SCANS_WAITING:
                    self._count(self._scans.popleft().sensor, "too many are waiting")
                return True
        return False

    def _set_absent(self, name: str, reason: str, kind: str) -> None:
        if reason:
            self.absent[name] = reason
            self._count(name, kind if reason != CONSTANT else CONSTANT)
        else:
            self.absent.pop(name, None)

    def _work(self, now: Nanos) -> None:
        """Do the next part of the work; and what is left of a scan, before the next one is begun."""
        while self._scans and self._is_ready(now, self._scans[0]):
            while self._todo:
                self._do(*self._todo.popleft())
            while self._credit > 0:
                self._close_loops()
            self._credit = 0 if self._consistency.lost else self.settings.loops.slices  # else it searches
            self._free(self._scans.popleft())
            if not self._scans:
                self._advance_search()
                return
        if self._todo:
            self._do(*self._todo.popleft())
        elif self._credit > 0:
            self._close_loops()
        else:
            self._advance_search()

    def _do(self, work: _Work, part: _Part) -> None:
        if work is _Work.MATCH:
            self._match(part)
        elif work is _Work.DRAW:
            self._draw(part)
        elif work is _Work.COMPARE:
            self._compare(part)
        else:
            self._keep(part)

    def _is_ready(self, now: Nanos, scan: LaserScan) -> bool:
        end, t = _end(scan), self._filter.t
        return (t is not None and t >= end) or now - end >= self.settings.scan_wait

    def _free(self, scan: LaserScan) -> None:
        """Free a scan from the motion during its sweep."""
        name, end, t = scan.sensor, _end(scan), self._filter.t
        known = self._filter.at(end)
        if t is None or t < end or known is None:
            self._count(name, GateResult.LATE if known else "no estimate for its time")
            return
        farthest = max(self.settings.map.farthest, self.settings.keyframes.farthest)
        body_scan = to_body(scan, self.mounts[name], farthest, self._motion(scan))
        moves = self._movers.observe(name, end, scan.duration, known[0], body_scan)
        self._todo.append((_Work.MATCH, _Part(name, end, body_scan, ~moves)))

    def _match(self, part: _Part) -> None:
        """Match a scan against the map and correct the filter."""
        believed = self._filter.at(part.t)
        if believed is None:
            self._count(part.name, "no estimate for its time")
            return
        if is_covered(self.map, self._placing.keyframes, part.scan, believed[0]):
            self._on_covered(part.name, believed[1])
            return
        if self.settings.matches:
            part = self._placed(part, believed)
        self._todo.append((_Work.DRAW, part))
        self._judge(part, believed[0])

    def _on_covered(self, name: str, covariance: Floats) -> None:
        """Take note of a scan that shows no place: the pose is as sure as wheels and gyro are since the
        last one."""
        self._count(name, "covered")
        variance = float(max(covariance[0, 0], covariance[1, 1]))
        self._consistency.on_covered(name, math.sqrt(max(variance - self._sure.get(name, variance), 0.0)))
        self._set_verdict()

    def _placed(self, part: _Part, believed: tuple[Pose, Floats]) -> _Part:
        """Correct the filter by what a scan tells; return the scan with whether it may be drawn."""
        consistency, placing, nis = self._consistency, self._placing, self._filter.nis
        name, t = part.name, part.t
        lost, anew = bool(consistency.lost), self._begins_anew
        agreement, fix, pose, placed = placing.tell(
            name,
            t,
            part.scan,
            self.map,
            believed,
            nis,
            self._lag,
            doubtful=consistency.doubtful and not anew,
            alone=anew,
        )
        trusted = None if consistency.doubtful else placed
        if trusted is not None and self._lag.on_scan(name, t, trusted.pose.yaw):
            self._notes.append(f"{name}: {_late(self._lag.found[name])}: counted for")
        if fix is not None and (anew or not lost):
            self._apply([fix])
            known = self._filter.at(t)
            if known is not None and not lost:
                placing.is_at(name, known[0])
                self._sure[name] = float(max(known[1][0, 0], known[1][1, 1]))
        elif pose is not None and not anew and consistency.recognised(agreement):
            # as unsure as it was wrong: a match may leave a direction open
            offset, turn = agreement.offset, agreement.turn
            self._relocate(t, pose, believed[1] + np.diag([offset * offset, offset * offset, turn * turn]))
        consistency.on_scan(name, agreement)
        if agreement.disagrees:
            self._count(name, "does not fit the map")
        beginning = self._saved is None and t - self._map_began_at < BEGINNING
        if consistency.lost and beginning and self._placing.keyframes.count == 1:
            self._forget_map()
            self._count(name, "what the map began with has gone")
        elif consistency.lost and self.is_placed:
            self._new_ground = (self._new_ground if lost else None) or _NewGround()
            self._go_on(agreement, self._new_ground)
        keep = not agreement.disagrees and (self._begins_anew or not consistency.lost)
        return replace(part, keep=keep, draw=keep and not agreement.poor, placed=placed)

    @property
    def _begins_anew(self) -> bool:
        """Whether it is lost, and has begun with new keyframes."""
        ground = self._new_ground
        return bool(self._consistency.lost) and ground is not None and ground.first is not None

    def _go_on(self, agreement: Agreement, ground: _NewGround) -> None:
        """While it is lost: where it has driven on to ground that the map does not have, begin with new
        keyframes; once scans agree with those, it is not lost any more."""
        driven = self._placing.driven
        if ground.on_scan(agreement, driven):
            self._placing.forget(carried=False)
            ground.begin(self._placing.keyframes.count, driven)
        elif ground.goes_on(driven):
            held = self._outside != self._last_scan.keys()  # in the map, by what else measures the pose
            self._consistency.found("" if held else f"{ADRIFT}: it drove {driven:.1f} m while it was lost")
            self._notes.append(f"{GOES_ON} it was lost: {driven:.1f} m")

    def _motion(self, scan: LaserScan) -> Floats | None:
        """Return the robot's pose at each beam's time, in its frame at the scan's end: n × 3."""
        if not scan.duration:
            return None
        count = len(scan.ranges)
        times = np.linspace(0.0, scan.duration, max(count, 2)).astype(np.int64)
        times += scan.t
        poses = self._filter.poses(times)
        if poses is None:
            return None
        x, y, yaw = poses[-1 if scan.duration > 0 else 0].tolist()
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy = poses[:count, 0] - x, poses[:count, 1] - y
        return np.column_stack((c * dx + s * dy, c * dy - s * dx, poses[:count, 2] - yaw))

    def _draw(self, part: _Part) -> None:
        at = self._filter.at(part.t)
        if part.draw and at is not None and not self._consistency.lost:
            if self._map_began is None:
                self._map_began, self._map_began_at = at[0], part.t
            scan, static = part.scan, part.static
            if 0 < np.count_nonzero(~static) <= MOST_MOVING * np.count_nonzero(scan.hit):
                scan = replace(scan, hit=scan.hit & static, straight=scan.straight & static)
            forgotten = self.map.forgotten
            self.map.add(at[0], scan, at[1])
            if self.map.forgotten > forgotten:
                self._count("", "the map is full")
            if self.map.forgotten > forgotten == 0:
                most = self.settings.map.tiles
                self._notes.append(f"the map is full, at {most} tiles: what is farthest is forgotten")
        self._todo.append((_Work.COMPARE, part))

    def _keep(self, part: _Part) -> None:
        at = self._filter.at(part.t)
        if at is not None and (self._begins_anew or not self._consistency.lost):
            pose = at[0] if part.placed is None else part.placed.pose
            self._placing.keep(pose, at[1], part.scan, part.static, part.placed)

    def _compare(self, part: _Part) -> None:
        yaw = self._check.on_scan(part.name, part.t, part.scan)
        self._notes += self._check.take_news()
        if yaw:
            self._correct_mounting(part.name, yaw)
        elif part.keep and self.settings.matches:
            self._todo.append((_Work.KEEP, part))

    def _correct_mounting(self, name: str, yaw: float) -> None:
        """Turn a lidar's mounting, and begin the map anew. What a single lidar drew is turned about where the
        map began, and so is the estimate: turn it back."""
        mount, t = self.mounts[name], self._filter.t
        self.mounts[name] = replace(mount, yaw=wrap(mount.yaw + yaw))
        here = None if t is None else self._filter.at(t)
        if t is not None and here is not None and self._saved is not None:  # which is right: it was turned
            self._filter.reset(t, here[0], here[1] + np.diag([0.0, 0.0, yaw * yaw]))
            self._apply([])
        elif t is not None and here is not None and len(self._last_scan) == 1:
            pose, covariance = here
            began = self._map_began or pose
            c, s = math.cos(yaw), math.sin(yaw)
            dx, dy = pose.x - began.x, pose.y - began.y
            back = replace(pose, x=began.x + c * dx - s * dy, y=began.y + s * dx + c * dy)
            unsure = (0.25 * math.dist((back.x, back.y), (pose.x, pose.y))) ** 2
            self._filter.reset(t, back, covariance + np.diag([unsure, unsure, 0.0]))
            self._apply([])
        self._forget_map()
        self._count(name, "mounting corrected")

    def _forget_map(self) -> None:
        """Begin the map anew at the estimate."""
        self.map.forget()
        self._redraw.forget()
        self._movers = Movers()
        self._placing.forget()
        self._map_began = self._search = self._found = self._new_ground = None
        self._consistency.found()

    # -- loops ---------------------------------------------------------------------------------

    @property
    def _may_close_loops(self) -> bool:
        """Whether nothing else that measures the pose holds it in the map."""
        return not self._consistency.lost and self._outside == self._last_scan.keys()

    def _close_loops(self) -> None:
        """Do the next slice: of the map that is drawn again, or of the search for loops."""
        self._credit -= 1
        if not self._may_close_loops:
            return
        keyframes, loops, redraw = self._placing.keyframes, self._placing.loops, self._redraw
        if redraw.waiting or (redraw.busy and not loops.busy):
            self._credit -= 0 if redraw.waiting else DRAWS
            poses = redraw.advance(keyframes, self.map)
        else:
            poses = loops.advance(keyframes)
            if poses is not None and not redraw.begin(keyframes, poses, self.map):
                poses = None
        if poses is not None:
            self._move(poses)
            ground = self._new_ground
            if self._consistency.adrift and ground is not None and loops.ties_to_before(ground.first or 0):
                self._consistency.tied()
                self.is_placed = True

    def _move(self, poses: Floats) -> None:
        """Give all keyframes better poses: the map moves, and the robot with the newest of them."""
        keyframes = self._placing.keyframes
        by = correction(keyframes.poses[-1], poses[-1])
        keyframes.move(poses)
        self._filter.shift(by)
        self._placing.shift(by)
        self._movers.shift(by)
        self.markers.shift(by)
        if self._map_began is not None:
            self._map_began = moved(by, self._map_began)
        self._apply([])

    # -- lost ----------------------------------------------------------------------------------

    def _judge(self, part: _Part, believed: Pose) -> None:
        """Update the verdict after a scan, and search for the place if it is needed."""
        self._set_verdict()
        if not self._consistency.lost:
            self._search = self._found = None
        elif self._search is None or self._search.work.result is not None:
            work = PoseSearch(self.map, part.scan, self.settings.relocalise, self.settings.match)
            self._search = _Search(work, part.scan, believed)

    def _set_verdict(self) -> None:
        self.verdict = self._consistency.verdict(
            {name: nis for name, nis in self._filter.nis.items() if name in self._outside}
        )

    def _advance_search(self) -> None:
        search = self._search
        if search is None:
            return
        result = search.work.advance(self.settings.relocalise.operations)
        if isinstance(result, PoseSearching) or not isinstance(result, PoseFound):
            return
        self._search = None
        if not self._begins_anew and self._placing.stays(search.scan, search.believed):
            self._consistency.found(self._consistency.adrift)
            self._count("", "lost, and had not moved")
            return
        t = self._filter.t
        here = None if t is None else self._filter.at(t)
        if t is None or here is None:
            return
        found = _moved(result.pose, search.believed, here[0])
        driven = self._placing.driven
        if (
            self.is_placed
            and driven > FAR
            and math.dist((found.x, found.y), (here[0].x, here[0].y)) > ASTRAY * driven
        ):
            self._count("", "found where its wheels cannot have taken it")
            return
        before, self._found = self._found, (found, here[0])
        if _is_far(found, here[0]) and (before is None or _is_far(_moved(*before, here[0]), found)):
            self._count("", "found once: one scan is no evidence of a move")
            return
        self._relocate(t, found, result.covariance)

    def _relocate(self, t: Nanos, pose: Pose, covariance: Floats, how: str = "relocalised") -> None:
        self._filter.reset(t, pose, covariance)
        self._movers = Movers()
        self._placing.forget()
        self.is_placed, self._new_ground = True, None
        self._consistency.found()
        self._count("", how)
        self._apply([])

    def _count(self, name: str, reason: str) -> None:
        reasons = self.anomalies.setdefault(name, {})
        reasons[str(reason)] = reasons.get(str(reason), 0) + 1


def _late(lag: float) -> str:
    return f"its stamps are {abs(lag):.2f} s {'late' if lag > 0.0 else 'early'}, beside those of the wheels"


def _moved(start: Pose, a: Pose, b: Pose) -> Pose:
    """Return the pose that follows from `start` by the motion from a to b."""
    c, s = math.cos(start.yaw - a.yaw), math.sin(start.yaw - a.yaw)
    dx, dy = b.x - a.x, b.y - a.y
    return Pose(start.x + c * dx - s * dy, start.y + s * dx + c * dy, wrap(start.yaw + b.yaw - a.yaw))


def _is_far(one: Pose, other: Pose) -> bool:
    """Return whether two poses are of different places."""
    return math.dist((one.x, one.y), (other.x, other.y)) > FAR or abs(wrap(one.yaw - other.yaw)) > FAR_YAW


def _end(scan: LaserScan) -> Nanos:
    """Return when its newest beam was measured."""
    return scan.t + max(scan.duration, 0)


def _is_valid(scan: LaserScan) -> bool:
    """True if a scan is what a planar lidar can send: everything else in it would be work, or overflow."""
    count, turn = len(scan.ranges), scan.angle_increment * (len(scan.ranges) - 1)
    return (
        0 < count <= MAX_BEAMS
        and 1e-5 <= scan.angle_increment <= 2.0 * math.pi
        and turn < 2.0 * math.pi + 1e-6
        and abs(scan.angle_min) <= 4.0 * math.pi
        and abs(scan.range_min) <= 1e3
        and 0.0 < scan.range_max <= 1e4
        and abs(scan.duration) <= LONGEST_SWEEP
    )
