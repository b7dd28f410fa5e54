"""Joints that carry one another as a limb: an arm. Positions are moved to together; what is armed is held.

Rules. The first target arms every joint: those without one hold where they are, against gravity. A joint goes
limp only if an operator says Idle to it, if it is lost, or if the stop action disarmed it; nothing is armed
by the release of a stop. Positions are reached at one time, within the body's limits of velocity,
acceleration and jerk; every command has the torque that the motion takes. Positions that are given step by
step with a velocity are a trajectory: they are passed on as they are given, with that torque. A joint that is
given a torque pushes with it, and goes on to when it is commanded to hold: what is gripped stays gripped.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf

from brain.bare_joints import BareJoints
from brain.belief import BrainTask
from brain.bodies.body import Linkage, Search
from brain.bodies.joint_profile import JointLimits, JointState, Profiles, stopping, synchronised
from brain.bodies.limbs import LimbPlace
from brain.health import HealthLevel
from brain.limb import Allowance, Percept, Plan
from brain.settings import BrainSettings
from brain.skills.skill import Intent, Observed, Tally, ToolPlace
from brain.status import StatusReporter
from protocols.messages import (
    MILLISECOND,
    SECOND,
    Command,
    Event,
    Feedback,
    Hold,
    Idle,
    Impedance,
    Mode,
    Nanos,
    Position,
    State,
    Torque,
    Velocity,
)

ITERATIONS = 4
"""Of the search for a place, in each step"""
AT_REST = 0.05
"""rad/s: a joint that is taken up from less starts at rest."""
SAME = 1e-9
"""rad: a target that is given again"""
APART: Nanos = 100 * MILLISECOND
"""Positions that are given less often than that are no trajectory."""


class LinkedJoints(BareJoints):
    """The joints of a linkage. Plain data."""

    def __init__(
        self,
        name: str,
        body: Linkage,
        at: LimbPlace,
        timeouts: Mapping[str, Nanos],
        settings: BrainSettings,
        status: StatusReporter,
    ) -> None:
        """`at`: where it is mounted: places for its tip are in the robot's frame."""
        super().__init__(body.joints, timeouts, settings, status)
        self._name, self._mounted = name, at
        self._ended = Tally()
        """Places for the tip that are done with."""
        self._body, self._joints, self._moves_tip = body, body.joints, body.of_tip
        self._limits = [JointLimits(*each) for each in body.limits]
        self._armed: dict[str, bool] = {}
        self._states: dict[str, JointState] = {}
        """Where each joint that is held should be now."""
        self._goals: dict[str, float] = {}
        """Where the present motion ends, by joint that is held."""
        self._holding: dict[str, float] = {}
        """Where each joint holds that was commanded to hold."""
        self._grips: dict[str, float] = {}
        """Torque with which a joint goes on to push while it holds."""
        self._sampled: dict[str, Nanos] = {}
        """When each joint was last given a position"""
        self._followed: set[str] = set()
        """Joints that follow a trajectory."""
        self._profiles = Profiles(())
        self._since: Nanos = 0
        """When these began"""
        self._planned_at: Nanos = 0
        """When it was last planned where the joints should be"""
        self._span: Nanos = 0
        """Time that the next motion is to take, at least."""
        self._search: Search | None = None
        self._placing: dict[str, float] = {}
        """Positions of the place that the tip is on its way to."""

    def perceive(self, now: Nanos, events: Sequence[Event], given: Percept | None = None) -> Percept:
        """Process the motors' events of this step; `given`: what is perceived, in place of its own."""
        for event in events:
            if isinstance(event, State) and event.mode is not Mode.OFFLINE:
                self._armed[event.motor] = event.mode is Mode.ARMED
        return super().perceive(now, events, given)

    def see(self, seen: Observed, percept: Percept, allowance: Allowance) -> Observed:
        """Add how many places for the tip have ended."""
        return replace(super().see(seen, percept, allowance), places={**seen.places, self._name: self._ended})

    # -- what is asked for --------------------------------------------------------------------------

    def accept(self, now: Nanos, task: BrainTask) -> None:
        """Take a target; hold the other joints."""
        super().accept(now, task)
        assert isinstance(task, Command), "a joint takes targets"
        self._span = 0
        self._engage(task)
        self._note_sample(now, task)

    def begin(self, now: Nanos, intent: Intent) -> str:
        """Take what a mission's step wants, if it is its own; return why not, or ""."""
        place = intent.place
        if place is not None and place.limb in ("", self._name):
            return self.place(now, place)
        return super().begin(now, intent)

    def _note_sample(self, now: Nanos, task: Command) -> None:
        """Note whether a target is one of a trajectory's samples."""
        last = self._sampled.pop(task.motor, None)
        self._followed.discard(task.motor)
        if not isinstance(task, Position) or task.motor not in self._joints:
            return
        self._sampled[task.motor] = now
        most = self._limits[list(self._joints).index(task.motor)].velocity
        if task.velocity and abs(task.velocity) <= most and last is not None and 0 < now - last <= APART:
            near = abs(task.position - self._at(task.motor)) <= 1.5 * most * (now - last) / SECOND
            self._followed |= {task.motor} if near else set()

    def reach(self, now: Nanos, targets: Sequence[Command], span: Nanos) -> str:
        """Take targets, positions to be reached together, in this time or more; return why not, or ""."""
        if why := super().reach(now, targets, 0):
            return why
        self._span = span
        for target in targets:
            self._engage(target)
        return ""

    def place(self, now: Nanos, wanted: ToolPlace) -> str:
        """Begin to bring the tip to a place; return why not, or ""."""
        lost = [self._health.source(now, motor).reason for motor in self._joints if self._is_lost(now, motor)]
        if lost or not self._known():
            return lost[0] if lost else "the positions of the joints are not known yet"
        place = self._mounted.inward(wanted.at)
        self._search = self._body.search([self._at(motor) for motor in self._joints], place)
        self._span = round(wanted.seconds * SECOND)
        self._placing = {}
        return ""

    def _engage(self, task: Command) -> None:
        """Hold what has no target, once anything has: the joints carry one another."""
        self._give_up("another target was given")
        if isinstance(task, Idle):
            return
        for motor in self._joints:
            if isinstance(self._targets[motor], Idle) and motor != task.motor:
                self._targets[motor] = Hold(motor)

    def stand(self, now: Nanos) -> None:  # noqa: ARG002 -- others end their motions at it
        """Come to rest, and hold; what pushes goes on to push."""
        self._give_up("it was to stand")
        for motor, target in self._targets.items():
            if isinstance(target, Position | Velocity):
                self._targets[motor] = Hold(motor)

    def drop(self, now: Nanos, allowance: Allowance) -> None:
        """Drop the targets of lost motors, and if stopped every target.

        What is still armed when the stop is released holds from then on."""
        if not allowance.stopped:
            super().drop(now, allowance)
            return
        self._give_up(f"stopped: {allowance.stopped}")
        super().drop(now, allowance)
        for motor in self._joints:
            if self._armed.get(motor) and motor not in allowance.lost:
                self._targets[motor] = Hold(motor)
        for known in (self._states, self._goals, self._holding):
            known.clear()
        self._profiles = Profiles(())

    def _objection(self, now: Nanos, task: Command) -> str:
        if why := super()._objection(now, task):
            return why
        ranges = dict(zip(self._joints, self._body.ranges, strict=True))
        low, high = ranges.get(task.motor, (-inf, inf))
        if isinstance(task, Position) and not low <= task.position <= high:
            return f"{task.motor} goes from {low:g} to {high:g}, not to {task.position:g}"
        return ""

    def _is_lost(self, now: Nanos, motor: str) -> bool:
        return self._health.source(now, motor).level >= HealthLevel.HALT

    def _give_up(self, why: str) -> None:
        if self._search is not None or self._placing:
            self._search, self._placing = None, {}
            self._end(why)

    def _end(self, why: str) -> None:
        self._ended = Tally(self._ended.number + 1, why)

    def _is_busy(self) -> bool:
        """Return whether a joint moves to its target, or is to be moved otherwise."""
        plain = any(not isinstance(target, Idle | Hold | Position) for target in self._targets.values())
        moving = any(self._states[motor].position != goal for motor, goal in self._goals.items())
        return plain or moving or self._search is not None

    # -- plan and commands --------------------------------------------------------------------------

    def plan(self, percept: Percept, allowance: Allowance, *, running: bool) -> Plan:  # noqa: ARG002
        """Return where each joint should be, and the torques that this takes; nothing while it is not known
        where they are."""
        busy, now = self._is_busy(), percept.now
        self._advance_search(now)
        if not self._known():
            return Plan(busy, degraded=allowance.reason, targets={m: Idle(m) for m in self.motors})
        self._plan(now)
        states = dict(zip(self._goals, self._profiles.at((now - self._since) / SECOND), strict=True))
        for motor in self._followed:
            target = self._targets[motor]
            if isinstance(target, Position):
                states[motor] = JointState(target.position, target.velocity)
        self._states, self._planned_at = states, now
        self._arrive()
        free = [
            states.get(motor, JointState(self._measured(motor).position or 0.0)) for motor in self._joints
        ]
        torques = dict(zip(self._joints, self._body.torques(*zip(*free, strict=True)), strict=True))
        for motor in states:
            torques[motor] += self._grips.get(motor, 0.0)
        return Plan(
            busy, degraded=allowance.reason, targets=dict(self._targets), states=dict(states), torques=torques
        )

    def commands(self, percept: Percept, allowance: Allowance, plan: Plan) -> Sequence[Command]:  # noqa: ARG002
        """Return one command per motor."""
        return self._described(allowance, [self._command(target, plan) for target in plan.targets.values()])

    def _command(self, target: Command, plan: Plan) -> Command:
        motor = target.motor
        if state := plan.states.get(motor):
            return self._body.command(motor, state.position, state.velocity, plan.torques[motor])
        if isinstance(target, Idle):
            return target
        if isinstance(target, Torque):
            return self._body.push(motor, self._at(motor), target.torque + plan.torques[motor])
        if isinstance(target, Velocity | Impedance):
            return replace(target, torque=target.torque + plan.torques[motor])
        return target

    def _plan(self, now: Nanos) -> None:
        """Plan a motion of all joints that are held, if where one of them ends has changed."""
        self._followed = {m for m in self._followed if now - self._sampled[m] <= APART}
        goals: dict[str, float] = {}
        for motor, limit, (low, high) in zip(self._joints, self._limits, self._body.ranges, strict=True):
            target = self._targets[motor]
            if isinstance(target, Torque):
                self._grips[motor] = target.torque
            elif not isinstance(target, Hold):
                self._grips.pop(motor, None)
            if not isinstance(target, Hold):
                self._holding.pop(motor, None)
            elif motor not in self._holding:
                self._holding[motor] = stopping(self._state(motor), limit).goal
            if isinstance(target, Position | Hold) and motor not in self._followed:
                wanted = target.position if isinstance(target, Position) else self._holding[motor]
                goals[motor] = max(low, min(high, wanted))
        if goals.keys() == self._goals.keys() and all(
            abs(goals[m] - g) <= SAME for m, g in self._goals.items()
        ):
            return
        starts = [self._state(motor) for motor in goals]
        limits = [each for motor, each in zip(self._joints, self._limits, strict=True) if motor in goals]
        self._profiles = synchronised(starts, list(goals.values()), limits)
        moving = any(s.velocity or s.acceleration for s in starts)
        # what moves goes on from where it was planned to be, which was a step ago
        self._goals, self._since = goals, self._planned_at if moving and self._states else now
        duration, span = self._profiles.duration, self._span / SECOND
        self._span = 0
        if duration < span and duration > 0.0 and not moving:
            slower = span / duration
            self._profiles = Profiles(
                tuple(replace(one, slower=one.slower * slower) for one in self._profiles.joints)
            )

    def _arrive(self) -> None:
        """Note that the tip has come to its place."""
        if self._placing and all(
            abs(self._states[m].position - at) <= SAME if m in self._states else False
            for m, at in self._placing.items()
        ):
            self._placing = {}
            self._end("")

    def _advance_search(self, now: Nanos) -> None:
        search = self._search
        if search is None or not search.advance(ITERATIONS):
            return
        self._search = None
        if search.found is None:
            own = f", in the frame of {self._name}" if self._mounted != LimbPlace() else ""
            self._end(f"{search.why}{own}")
            return
        before = self._span
        found = dict(zip(self._joints, search.found, strict=True))
        self.reach(now, [Position(m, at) for m, at in found.items() if m in self._moves_tip], before)
        self._placing = {motor: found[motor] for motor in self._moves_tip}

    # -- what is known ------------------------------------------------------------------------------

    def _known(self) -> bool:
        return all(self._measured(motor).position is not None for motor in self._joints)

    def _measured(self, motor: str) -> Feedback:
        return self._feedback.get(motor) or Feedback(motor, 0)

    def _at(self, motor: str) -> float:
        """Return where a joint should be, or else where it is."""
        return (
            self._states[motor].position if motor in self._states else self._measured(motor).position or 0.0
        )

    def _state(self, motor: str) -> JointState:
        if motor in self._states:
            return self._states[motor]
        measured = self._measured(motor)
        speed = measured.velocity or 0.0
        return JointState(measured.position or 0.0, speed if abs(speed) > AT_REST else 0.0)
