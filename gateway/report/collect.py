"""What a report shows of a run, collected tick by tick. Plain data, bounded however long the run is."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import hypot, sqrt

import numpy as np

from brain.belief import Belief, Pose
from brain.planning.polyline import Polyline
from gateway.buses.frame_time import frame_time
from gateway.core.joint import Joint
from gateway.core.step import Gateway
from gateway.core.tick import Note, Tick
from gateway.replay.signal_log import COMMANDED, QUANTITIES
from gateway.report.series import DrivenTrack, Signals
from protocols import messages as msg
from protocols.messages import MILLISECOND, Goal, Nanos

SAMPLE_PERIOD: Nanos = 50 * MILLISECOND
"""Between two samples of what is not of a joint."""
FIRST_NOTES, LAST_NOTES = 500, 500
"""Notes that are kept; what is between them is counted."""
MOST_PATHS = 64
"""Planned paths that are kept: every second is dropped when there are more."""
MOST_GOALS = 500


@dataclass(frozen=True, slots=True)
class ReachedGoal:
    """A goal that was reached: when, and the believed and the true place."""

    goal: Goal
    t: Nanos
    believed: Pose
    true: Pose | None


def group_of(joint: str) -> str:
    """Return the name of a joint's group of signals, which no other group has: "base", "bus"."""
    return f"joint {joint}"


class Collector:
    """Collects what a report shows: `take` each tick with the belief after it, then `write`.

    Args:
        gateway: the one that steps.
        truth: returns the true pose in the frame "map", where something knows it.
        busy: transmission time of all packets up to the tick before, by bus, where something counts it: that
            is half of the work here.
        signals: False: figures alone, which are a third of the rest.
    """

    def __init__(
        self,
        gateway: Gateway,
        truth: Callable[[], Pose] | None = None,
        busy: Mapping[str, Nanos] | None = None,
        *,
        signals: bool = True,
    ) -> None:
        self.gateway, self._truth, self._counted = gateway, truth, busy
        self.signals = Signals(2 * gateway.robot.period)
        self._with_signals = signals
        self.belief: Belief = gateway.belief()
        self.start: Nanos = 0
        self.end: Nanos = 0
        self.ticks = 0
        self.longest: Nanos = 0
        """Between two steps."""
        self.received = dict.fromkeys(gateway.robot.buses, 0)
        """Packets that were received, by bus."""
        self.sent = dict.fromkeys(gateway.robot.buses, 0)
        """Packets that were sent, by bus."""
        self.busy: dict[str, Nanos] = dict.fromkeys(gateway.robot.buses, 0)
        """Transmission time of all of them."""
        self._busy_before = dict(self.busy)
        self.notes: list[tuple[Nanos, Note]] = []
        """The first ones."""
        self.last_notes: deque[tuple[Nanos, Note]] = deque(maxlen=LAST_NOTES)
        """The last ones."""
        self.note_count = 0
        """How many notes there were in all."""
        self.driven, self.true, self.raw = DrivenTrack(), DrivenTrack(), DrivenTrack()
        """Paths: believed, true (where that is known), and by the wheels alone."""
        self.paths: list[tuple[Nanos, tuple[tuple[float, float], ...]]] = []
        """Planned, with the times from which they held."""
        self.arrivals: list[ReachedGoal] = []
        self.off: tuple[float, Nanos] = (0.0, 0)
        """m: farthest from the path that is followed, by the believed pose, and when."""
        self.error: tuple[float, Nanos] = (0.0, 0)
        """m: largest distance of the believed from the true position, and when."""
        self._off_squares, self._off_count = 0.0, 0
        self._line: tuple[int, Polyline] | None = None
        self._next: Nanos = 0
        self._sampled: Nanos = 0
        self._fed: dict[str, msg.Feedback] = {}
        self._ages: dict[str, Nanos] = {}
        """Of the oldest feedback of each joint since the last sample."""

    def take(self, tick: Tick, belief: Belief) -> None:
        """Take a tick, and the belief after it."""
        now = tick.now
        if not self.ticks:
            self.start = self._next = self._sampled = now
        else:
            self.longest = max(self.longest, now - self.end)
        self.ticks += 1
        self.end = now
        self._take_packets(tick)
        if self._with_signals:
            self.signals.move_to(now)
            for name, joint in self.gateway.joints.items():
                self._take_joint(name, joint, now)
        for note in tick.outputs.notes:
            self._take_note(now, note)
        self._take_arrival(now, belief)
        if now >= self._next:
            self._next = now + SAMPLE_PERIOD
            if self._with_signals:
                self._sample(now, belief)
            elif belief.estimate is not None:
                self.driven.add(now, belief.estimate.pose)
                self._follow(now, belief, belief.estimate.pose)
        self.belief = belief

    @property
    def off_rms(self) -> float | None:
        """m: root mean square distance from the path that is followed; None if none was."""
        return sqrt(self._off_squares / self._off_count) if self._off_count else None

    # -- each tick --------------------------------------------------------------------------------

    def _take_packets(self, tick: Tick) -> None:
        buses = self.gateway.robot.buses
        for counts, packets in ((self.received, tick.inputs.packets), (self.sent, tick.outputs.packets)):
            for packet in packets:
                bus = buses.get(packet.bus)
                if bus is None:
                    continue  # of a recording that is replayed with another robot
                counts[packet.bus] += 1
                if self._counted is None:
                    self.busy[packet.bus] += frame_time(
                        packet.frame, bus.baudrate or bus.bitrate, bus.data_bitrate
                    )

    def _take_joint(self, name: str, joint: Joint, now: Nanos) -> None:
        add, feedback, command = self.signals.add, joint.feedback, joint.sent
        group = group_of(name)
        if feedback is not self._fed.get(name):
            self._fed[name] = feedback
            for quantity in QUANTITIES:
                value = getattr(feedback, quantity)
                if value is not None:
                    add(value, group, quantity, "measured")
        for quantity in COMMANDED.get(type(command), ()):
            add(getattr(command, quantity), group, quantity, "commanded")
        age = joint.feedback_age(now)
        if age is not None:
            self._ages[name] = max(age, self._ages.get(name, 0))

    def _take_note(self, now: Nanos, note: Note) -> None:
        self.note_count += 1
        if len(self.notes) < FIRST_NOTES:
            self.notes.append((now, note))
        else:
            self.last_notes.append((now, note))

    def _take_arrival(self, now: Nanos, belief: Belief) -> None:
        before = self.belief
        if belief.reached <= before.reached or belief.estimate is None:
            return
        goal = before.goal or belief.goal
        if goal is not None and len(self.arrivals) < MOST_GOALS:
            true = self._truth() if self._truth is not None else None
            self.arrivals.append(ReachedGoal(goal, now, belief.estimate.pose, true))

    # -- each sample --------------------------------------------------------------------------------

    def _sample(self, now: Nanos, belief: Belief) -> None:
        add, passed = self.signals.add, now - self._sampled
        self.busy.update(self._counted or {})
        for bus, busy in self.busy.items():
            if passed:
                add(100.0 * (busy - self._busy_before[bus]) / passed, "bus", "load", bus)
        self._busy_before, self._sampled = dict(self.busy), now
        for name, age in self._ages.items():
            add(age / MILLISECOND, group_of(name), "age of feedback", "oldest")
        self._ages.clear()
        estimate = belief.estimate
        if estimate is None:
            return
        pose = estimate.pose
        self.driven.add(now, pose)
        if belief.raw is not None:
            self.raw.add(now, belief.raw)
        add(estimate.linear, "base", "velocity", "forward")
        if estimate.lateral != 0.0:
            add(estimate.lateral, "base", "velocity", "to the left")
        add(estimate.angular, "base", "turning", "to the left")
        spread = float(np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1])
        add(3.0 * sqrt(max(spread, 0.0)), "base", "error of the pose", "3 σ, by the filter")
        if self._truth is not None:
            true = self._truth()
            self.true.add(now, true)
            error = hypot(pose.x - true.x, pose.y - true.y)
            self.error = max(self.error, (error, now))
            add(error, "base", "error of the pose", "true")
        for sensor, nis in self.gateway.brain.nis.items():
            if nis.window:
                add(nis.recent(), "base", "consistency", sensor)
        self._follow(now, belief, pose)

    def _follow(self, now: Nanos, belief: Belief, pose: Pose) -> None:
        """Note the path that is followed, and how far the believed pose is beside it."""
        if len(belief.path) < 2:
            self._line = None
            return
        if self._line is None or self._line[0] != belief.path_version:
            self._line = (belief.path_version, Polyline(belief.path))
            self.paths.append((now, belief.path))
            if len(self.paths) > MOST_PATHS:
                del self.paths[-2::-2]
        along, off = self._line[1].project((pose.x, pose.y))
        if 0.0 < along < self._line[1].length:
            self._off_squares += off * off
            self._off_count += 1
            self.off = max(self.off, (off, now))
            if self._with_signals:
                self.signals.add(100.0 * off, "base", "beside the path", "believed")
