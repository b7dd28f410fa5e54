"""Evaluation of perception on another program's recording: the estimated path against a ground truth.

Rules. Perception processes the events of the recording one by one, in order, each at its own time: nothing
looks ahead, and the ground truth is not among them. At each time of the truth the estimated pose is what a
robot would have had at that time: the filter's newest, extrapolated by its own twist. What the truth says
(`gateway.rosbag.truth`) stands beside the same of dead reckoning, and of the recording's own odometry. What
contradicts itself does not pass; without a truth nothing is judged, and what perception says of itself
remains: whether it is as sure as it may be, and how many scans came while it was lost.
"""

from __future__ import annotations

import heapq
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from math import degrees
from pathlib import Path

from brain.belief import Estimate, MapView, Pose
from brain.bodies.body import Base
from brain.bodies.plane import arc, moved
from brain.perception.consistency import Trust
from brain.perception.filter_inputs import Nis
from brain.perception.mount import Mount
from brain.perception.perception import Anchor, Perception
from brain.perception.saved_keyframes import SavedKeyframes
from gateway.core.robot import Robot
from gateway.errors import BagError
from gateway.rosbag import Bag, Topic, read
from gateway.rosbag.contradictions import contradictions, remarks
from gateway.rosbag.trajectory_error import MIN_PAIRS, PathError
from gateway.rosbag.truth import CLOSE, MIN_EXTENT, Positions, RelationError, Relations
from protocols.messages import MILLISECOND, Event, LaserScan, Nanos, seconds

MAX_EXTRAPOLATION: Nanos = 500 * MILLISECOND
"""Longest time that an estimate is extrapolated by its own twist."""
PATH_PERIOD: Nanos = 100 * MILLISECOND
ESTIMATED, WHEELS, OWN = "estimated", "dead reckoning", "the recording's own"
KNOWN = "known in the end"
"""The path after all loops, where one was closed"""
PASSED, NOT_PASSED, NOT_JUDGED = 0, 1, 3
"""Exit statuses."""
NOT_PLACED = (
    "nowhere in it does a place look like the map that it was to begin in, and like no other place there"
)
NO_TRUTH = "there is no ground truth: name a topic of poses or fixes (truth, under [bag]) or a file (--truth)"


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Result of running perception on a recording."""

    bag: Bag
    duration: Nanos
    """From the first event to the last."""
    driven: float
    """m: estimated distance travelled"""
    end: Pose | None
    """Last estimated pose, relative to the start in the robot file"""
    truth: Positions | Relations
    """What it was judged by: the recording's own, or a file's; perhaps empty."""
    early: int
    """Fixes or poses of it before the first estimate: not compared."""
    extent: float
    """m: largest distance of the truth from its centre; 0 without a truth"""
    errors: Mapping[str, PathError]
    """By path: `ESTIMATED`, `WHEELS`, `OWN`; {} if there are too few fixes."""
    relations: Mapping[str, RelationError]
    """The same, where the truth consists of relations."""
    nis: Mapping[str, Nis]
    anomalies: Mapping[str, Mapping[str, int]]
    """Measurements not used, or used against the gate, by motor or sensor and reason."""
    at_most: float | None
    """m: the largest error that passes: RMS, or of relations the mean"""
    contradictions: tuple[str, ...] = ()
    """What in the recording contradicts itself: then no figure is right."""
    scans: int = 0
    """Scans that perception was given,"""
    lost: int = 0
    """and those that came while it was lost."""
    mounts: Mapping[str, str] = field(default_factory=dict)
    """Where sensors are that the robot file does not place, in words."""
    notes: tuple[str, ...] = ()
    is_placed: bool = True
    """Whether it was found where it is in the map that it began in."""

    @property
    def estimated(self) -> PathError | None:
        """Error of the estimated path."""
        return self.errors.get(ESTIMATED)

    @property
    def wheels(self) -> PathError | None:
        """Error of dead reckoning: the base's motion, integrated."""
        return self.errors.get(WHEELS)

    @property
    def odometry(self) -> PathError | None:
        """Error of the poses of the recording's own odometry."""
        return self.errors.get(OWN)

    @property
    def ok(self) -> bool:
        """True if the path was judged, and is as good as required."""
        return self.status == PASSED

    @property
    def status(self) -> int:
        """PASSED, NOT_PASSED, or NOT_JUDGED where there is no truth and nothing else is wrong."""
        if self.objections():
            return NOT_PASSED
        return PASSED if self.truth else NOT_JUDGED

    def objections(self) -> list[str]:
        """Return why it does not pass; [] if nothing is wrong."""
        unused = [t for t in self.bag.topics if t.role and not t.used]
        objections = [
            f"no message of {t.name} ({t.role}) could be used: {_reasons(t.unused)}" for t in unused
        ]
        figure = self.relations[ESTIMATED].mean if self.relations else None
        if self.estimated is not None:
            figure = self.estimated.rms
        if not self.truth:
            if self.at_most is not None:
                objections.append(f"at most {self.at_most:g} m is allowed, and {NO_TRUTH}")
        elif figure is None:
            least = 1 if isinstance(self.truth, Relations) else MIN_PAIRS
            objections.append(
                f"fewer than {least} {self.truth.what} can be compared: the path cannot be evaluated"
            )
        elif self.estimated is not None and self.extent < MIN_EXTENT:
            objections.append(
                f"the truth stays within {self.extent:.2f} m: it did not move, and proves nothing"
            )
        elif self.at_most is not None and not figure <= self.at_most:
            objections.append(f"the path error is {figure:.2f} m, and at most {self.at_most:g} m is allowed")
        return [*self.contradictions, *objections, *([] if self.is_placed else [NOT_PLACED])]

    def text(self) -> str:
        """Return the result as text."""
        lines = [f"{self.bag.path.name}: {seconds(self.duration):.1f} s, {self.driven:.1f} m driven"]
        if self.end is not None:
            lines[0] += f", to {self.end.x:.2f} m, {self.end.y:.2f} m, {degrees(self.end.yaw):.0f} degrees"
        lines += [*self._path_errors(), *self._relation_errors()]
        lines += ["consistency (NIS per degree of freedom: 1 if the covariances are right)"]
        lines += [f"  {name}: {_nis(nis)}" for name, nis in self.nis.items()] or ["  nothing was measured"]
        if self.scans:
            share = 100.0 * self.lost / self.scans
            lines.append(f"scans: {self.scans}, of which {self.lost} ({share:.1f} %) came while it was lost")
        anomalies = [
            f"  {name or 'map'}: {_reasons(reasons)}" for name, reasons in self.anomalies.items() if reasons
        ]
        lines += ["measurements not used, or used against the gate:", *(anomalies or ["  none"])]
        lines += ["messages used", *(f"  {_use(t)}" for t in self.bag.topics if t.role)]
        rest = [f"  {t.name}: {t.count} of {t.type}" for t in self.bag.topics if not t.role]
        lines += ["topics left over", *(rest or ["  none"])]
        if self.mounts:
            lines += ["where the sensors are", *(f"  {name}: {by}" for name, by in self.mounts.items())]
        lines += self.notes
        if self.ok and self.at_most is not None:
            lines.append(f"passed: at most {self.at_most:g} m is allowed")
        if self.status == NOT_JUDGED:
            lines.append(f"NOT JUDGED: {NO_TRUTH}")
        return "\n".join([*lines, *(f"NOT PASSED: {objection}" for objection in self.objections())])

    def _path_errors(self) -> list[str]:
        if self.estimated is None:
            return []
        early = f" ({self.early} more before the first estimate)" if self.early else ""
        compared = f"{self.estimated.count} {self.truth.what}{early}"
        head = f"path error against the truth, over {compared}, after alignment"
        lines = [head, *(f"  {f'{name}:':<21}{_error(error)}" for name, error in self.errors.items())]
        if self.driven:
            lines[1] += f", {100 * self.estimated.rms / self.driven:.2f} % of the path"
        return lines

    def _relation_errors(self) -> list[str]:
        if not self.relations:
            return []
        one = self.relations[ESTIMATED]
        more = len(self.truth) - one.count
        beyond = f" ({more} more are beyond the recording)" if more else ""
        close = f"; within {seconds(CLOSE):g} s ({one.close})" if one.close else ""
        return [
            f"error over {one.count} {self.truth.what}{beyond}{close}",
            *(f"  {f'{name}:':<21}{_relation(error)}" for name, error in self.relations.items()),
        ]


def _relation(error: RelationError) -> str:
    text = f"mean {error.mean:.3f} m and {degrees(error.mean_turn):.2f} degrees, median {error.median:.3f} m"
    if error.close:
        text += f"; {error.close_mean:.4f} m and {degrees(error.close_turn):.2f} degrees"
    return text


def _error(error: PathError) -> str:
    return f"{error.rms:6.2f} m RMS, median {error.median:.2f} m, largest {error.largest:.2f} m"


def _nis(nis: Nis) -> str:
    return f"{nis.mean:.3g} over {nis.count} measurements, {100 * nis.beyond / nis.count:.1f} % beyond 95 %"


def _reasons(reasons: Mapping[str, int]) -> str:
    return ", ".join(f"{count} × {reason}" for reason, count in reasons.items())


def _use(topic: Topic) -> str:
    unused = f"; not used: {_reasons(topic.unused)}" if topic.unused else ""
    return f"{topic.name}: {topic.used} of {topic.count} as {topic.role}{unused}"


# -- evaluate ------------------------------------------------------------------------------------


def evaluate_file(
    path: Path,
    robot: Robot,
    at_most: float | None = None,
    truth: Positions | Relations | None = None,
    watch: Callable[[int], object] = lambda _: None,
    trace: Trace | None = None,
) -> Evaluation:
    """Read a recording and evaluate it. Raises BagError. `truth`: instead of the recording's own."""
    return evaluate(read(path, robot.bag, _body(robot)), robot, at_most, truth, watch, trace)


@dataclass(slots=True)
class Trace:
    """What is kept of a run beside its figures."""

    path: list[tuple[Nanos, Pose]] = field(default_factory=list)
    """Where the robot was, as it is known in the end, at most every `PATH_PERIOD`"""
    map: MapView | None = None
    """The last"""
    anchors: list[Anchor | None] = field(default_factory=list)
    """Where it was relative to keyframes, which loops may move"""
    keyframes: SavedKeyframes | None = None
    """The last, if there are some"""
    is_placed: bool = True
    """Whether it knows where it is in the map that it began in: before, it has no path there"""

    def is_due(self, t: Nanos) -> bool:
        """Return whether the last pose is old enough for another one."""
        return not self.path or t >= self.path[-1][0] + PATH_PERIOD

    def add(self, t: Nanos, pose: Pose, perception: Perception | None) -> None:
        """Add a pose, if the last one is old enough, and if it knows where it is. None: another program
        perceives."""
        if self.is_due(t) and (perception is None or perception.is_placed):
            self.path.append((t, pose))
            self.anchors.append(None if perception is None else perception.anchor(pose))

    def end(self, perception: Perception) -> None:
        """Keep the map, its keyframes, and the path, once all that is known of them is worked in."""
        perception.settle()
        self.map, self.is_placed = perception.map.view(), perception.is_placed
        found = perception.saved_keyframes()
        self.keyframes = found if found.kept else None
        self.correct(found)

    def correct(self, keyframes: SavedKeyframes) -> None:
        """Correct the path by the keyframes as they are known now, also of who went on in this map."""
        self.path = [
            (
                t,
                pose
                if anchor is None
                else moved(Pose(*keyframes.poses[anchor.keyframe].tolist()), anchor.pose),
            )
            for (t, pose), anchor in zip(self.path, self.anchors, strict=True)
        ]


def mounts_of(bag: Bag, robot: Robot) -> dict[str, Mount]:
    """Return where the sensors are: as the robot file says, else as the recording does."""
    stated = {name: sensor.mount for name, sensor in robot.sensors.items()}
    if not robot.recorded or robot.bag is None:
        return stated
    found = {name: one.mount for name, one in bag.placed.items()} | robot.bag.mounts
    return {name: found.get(name, Mount()) for name in (*robot.bag.sensors, *robot.bag.cameras)}


def evaluate(
    bag: Bag,
    robot: Robot,
    at_most: float | None = None,
    truth: Positions | Relations | None = None,
    watch: Callable[[int], object] = lambda _: None,
    trace: Trace | None = None,
) -> Evaluation:
    """Run the robot's perception on a recording. `at_most` [m] is the error allowed; `truth`: instead of the
    recording's own; `watch` is told how many events were processed; `trace`: where the path and the map
    are kept."""
    body, mounts = _body(robot), mounts_of(bag, robot)
    perception = Perception(body, mounts, robot.brain.perception, saved=robot.brain.saved)
    events = _EventFeed(heapq.merge(bag.events, bag.scans(), key=lambda one: one.t), perception, watch, trace)
    reference = truth or Positions(bag.truth)
    paths: dict[str, list[Pose | None]] = {ESTIMATED: [], WHEELS: []}
    anchors: list[Anchor | None] = []
    if bag.own_path:
        paths[OWN] = []
    for t in reference.times:
        events.process_until(t + reference.slack)
        known = perception.estimate
        nowhere = known is None or events.ended(t) or not perception.is_placed
        there = None if known is None or nowhere else extrapolated(known, t)
        anchors.append(None if there is None else perception.anchor(there))
        paths[ESTIMATED].append(there)
        paths[WHEELS].append(None if there is None else perception.raw)
        if bag.own_path:
            at = bisect_right(bag.odometry, t, key=lambda one: one.t) - 1
            paths[OWN].append(bag.odometry[at].pose if at >= 0 else None)
    events.process_until(None)
    if trace is not None:
        trace.end(perception)
    if perception.closed:
        paths[KNOWN] = [
            there if anchor is None else perception.anchored(anchor)
            for there, anchor in zip(paths[ESTIMATED], anchors, strict=True)
        ]
    errors, extent, early = ({}, 0.0, 0) if isinstance(reference, Relations) else reference.errors(paths)
    placed = bag.placed if robot.recorded else {}
    return Evaluation(
        bag=bag,
        duration=events.last - events.first,
        driven=events.driven,
        end=perception.estimate.pose if perception.estimate is not None else None,
        truth=reference,
        early=early,
        extent=extent,
        errors=errors,
        relations=reference.errors(paths) if isinstance(reference, Relations) else {},
        nis=perception.nis,
        anomalies=perception.anomalies,
        at_most=at_most,
        contradictions=contradictions(bag, body, mounts, robot.brain.perception.filter.turn_slip),
        scans=events.scans,
        lost=events.lost,
        mounts={name: f"{at_text(one.mount)}: {one.by}" for name, one in placed.items()},
        notes=(*_scales(robot), *remarks(bag), *perception.take_notes(), *_closed(perception)),
        is_placed=perception.is_placed,
    )


def at_text(mount: Mount) -> str:
    """Return a mounting in words."""
    text = f"{mount.x:g} m, {mount.y:g} m, {mount.z:g} m, yaw {degrees(mount.yaw):.1f} degrees"
    level = not (mount.pitch or mount.roll)
    return text if level else f"{text}, pitch {degrees(mount.pitch):.1f}, roll {degrees(mount.roll):.1f}"


def _closed(perception: Perception) -> tuple[str, ...]:
    """Return the loops in words, if there are any."""
    return (f"places seen again: {perception.loops}",) if perception.closed else ()


def _scales(robot: Robot) -> tuple[str, ...]:
    """Return on what no message says all metres hang."""
    if robot.bag is None or robot.bag.car is None:
        return ()
    car = robot.bag.car
    turns = "it drives straight on, since no topic is its steering"
    if car.steering:
        turns = f"wheelbase {car.wheelbase:g} m, steering {car.middle:g} {car.per_angle:+g} per rad"
    return (f"all metres and turns hang on [bag.car]: {car.speed} is {car.per_speed:g} for 1 m/s, {turns}",)


def extrapolated(estimate: Estimate, t: Nanos) -> Pose:
    """Return an estimate's pose at a later time, by its own twist, up to a limit."""
    dt = seconds(min(max(0, t - estimate.t), MAX_EXTRAPOLATION))
    return arc(estimate.pose, estimate.linear * dt, estimate.angular * dt)


class _EventFeed:
    """Feeds events to perception, up to given times."""

    def __init__(
        self,
        events: Iterator[Event],
        perception: Perception,
        watch: Callable[[int], object],
        trace: Trace | None,
    ) -> None:
        self._events, self._perception, self._watch, self._trace = events, perception, watch, trace
        self._next = next(events, None)
        self._count = 0
        self.driven = 0.0
        """m: the estimated speed, integrated; corrections of the pose do not count"""
        self.scans = self.lost = 0
        self.first: Nanos = self._next.t if self._next is not None else 0
        self.last = self.first

    def ended(self, t: Nanos) -> bool:
        """Return whether a time is beyond what the estimate can be extrapolated to, after the last event."""
        return self._next is None and t > self.last + MAX_EXTRAPOLATION

    def process_until(self, t: Nanos | None) -> None:
        """Process all events up to and at a time; None: all that are left."""
        while (event := self._next) is not None and (t is None or event.t <= t):
            self._next = next(self._events, None)
            before = self._perception.estimate
            self._perception.observe(event.t, [event])
            self._perception.finish(event.t)
            after = self._perception.estimate
            if before is not None and after is not None:
                self.driven += abs(after.linear) * seconds(after.t - before.t)
            if isinstance(event, LaserScan):
                self.scans += 1
                self.lost += self._perception.verdict.trust is Trust.LOST
            if self._trace is not None and after is not None:
                self._trace.add(after.t, after.pose, self._perception)
            self.last = event.t
            self._count += 1
            self._watch(self._count)


def _body(robot: Robot) -> Base:
    base = robot.brain.base
    if base is None:
        raise BagError(f"{robot.name}: a body of kind {robot.brain.body.kind!r} has no path to evaluate")
    return base
