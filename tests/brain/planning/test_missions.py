"""Missions as transcripts: a mission's text, what happens meanwhile, and what it tells. Times in s."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from math import degrees, hypot, inf, pi

import pytest

from brain.belief import Pose
from brain.bodies.arm import JointAxis, SerialArm
from brain.bodies.limbs import Abilities
from brain.bodies.plane import REST, Twist, arc, moved, wrap
from brain.planning.missions import PHASES, Cause, MissionPhase, Missions, MissionTask, why_not
from brain.skills.skill import Intent, Observed, Tally
from gateway.config.mission import parse_mission
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Feedback, Goal, Mission, Nanos, Step
from tests.brain.helpers import BODY, START

TICK: Nanos = 20 * MILLISECOND
JOINTS = ("lift", "jaw")
ABLE, BARE = Abilities(BODY, {}, JOINTS), Abilities(None, {}, JOINTS)
JAW_MEETS = 0.4
"""rad at which the jaw meets something"""


def arms(*names: str) -> Abilities:
    text = (files("gateway.fixtures") / "robots" / "arm.urdf").read_text("utf-8")
    arm = SerialArm(
        axes={"turn": JointAxis(), "shoulder": JointAxis(), "elbow": JointAxis()}, tip="tool", urdf=text
    )
    return Abilities(None, dict.fromkeys(names, arm), JOINTS)


@dataclass
class Plant:
    """A base that does at once what is asked, within its accelerations; goals take a second."""

    missions: Missions = field(default_factory=Missions)
    now: Nanos = 0
    pose: Pose = START
    twist: Twist = REST
    goals: list[Goal] = field(default_factory=list)
    closed: tuple[float, float] = (inf, inf)
    """A place that cannot be reached"""
    wall: float = inf
    """x at which it stands"""
    marker: Pose | None = None
    missed: Pose = START
    """Where a goal's turned place is reached, seen from it"""
    joints: dict[str, Feedback] = field(
        default_factory=lambda: {name: Feedback(name, 0, 0.0, 0.0) for name in JOINTS}
    )
    targets: dict[str, msg.Command] = field(default_factory=dict)
    ended: int = 0
    why: str = ""
    _since: Nanos = 0

    def ask(self, task: MissionTask, may_not_move: str = "") -> str:
        return self.missions.request(task, ABLE, may_not_move)

    def tick(self) -> Intent:
        self.now += TICK
        stands = self.pose.x >= self.wall
        seen = Observed(
            self.now,
            BODY,
            self.pose,
            self.twist.speed,
            self.twist.angular,
            obstructed="a wall ahead" if stands else "",
            goals=Tally(self.ended, self.why),
            joints=self.joints,
            marker=lambda number: self.marker if number == 3 else None,
        )
        intent = self.missions.advance(seen)
        if intent.goal is not None:
            self.goals.append(intent.goal)
            self._since = self.now
        elif intent.keep and self.goals and self.now - self._since >= SECOND:
            goal, self.ended = self.goals[-1], self.ended + 1
            self.why = "no way there" if (goal.x, goal.y) == self.closed else ""
            if not self.why:
                yaw = self.pose.yaw if goal.yaw is None else goal.yaw
                self.pose = moved(Pose(goal.x, goal.y, yaw), self.missed)
        self._drive(intent.twist or Twist(), stands=stands)
        self.targets |= {target.motor: target for target in intent.targets}
        for motor, target in self.targets.items():
            self._turn_joint(motor, target)
        return intent

    def _drive(self, wanted: Twist, *, stands: bool) -> None:
        dt = TICK / SECOND
        most = (BODY.max_linear_acceleration, BODY.max_angular_acceleration, BODY.max_linear_acceleration)
        steps = [
            min(max(a - b, -limit * dt), limit * dt)
            for a, b, limit in zip(wanted, self.twist, most, strict=True)
        ]
        after = (now + step for now, step in zip(self.twist, steps, strict=True))
        self.twist = REST if stands else Twist(*after)
        turn = self.twist.angular * dt
        self.pose = arc(self.pose, self.twist.linear * dt, turn, self.twist.lateral * dt)

    def _turn_joint(self, motor: str, target: msg.Command) -> None:
        position = self.joints[motor].position
        assert position is not None
        speed = 0.0
        if isinstance(target, msg.Position):
            speed = max(-1.0, min(1.0, 10.0 * (target.position - position)))
        elif isinstance(target, msg.Torque) and not (motor == "jaw" and position >= JAW_MEETS):
            speed = 0.5
        self.joints[motor] = Feedback(motor, self.now, position + speed * TICK / SECOND, speed)

    def run(self, span: float, asked: Mapping[float, MissionTask | str] | None = None) -> list[str]:
        """Run for a time, or to the end of the mission; return what it told."""
        left = dict(asked or {})
        end = self.now + round(span * SECOND)
        while self.now < end and (left or self.missions.active):
            self.tick()
            for at in [at for at in left if self.now >= at * SECOND]:
                task = left.pop(at)
                if isinstance(task, str):
                    self.missions.halt(task)
                elif refused := self.ask(task):
                    self.missions.notes.append(("warning", f"refused: {refused}"))
        told, self.missions.notes = self.missions.notes, []
        return [text.removeprefix(f"mission {self.missions.name}: ") for _, text in told]


def plant(text: str, **more: object) -> Plant:
    made = Plant(**more)  # type: ignore[arg-type]  # fields of a plant
    assert made.ask(parse_mission(text, "m.toml")) == ""
    return made


TOLD: dict[str, tuple[str, dict[float, MissionTask | str], list[str]]] = {
    "drive, turn, wait": (
        """
        [[steps]]
        drive = 0.2
        distance = 0.5
        [[steps]]
        turn_deg = -90
        [[steps]]
        wait = 2
        """,
        {},
        [
            "begins: 3 steps",
            "step 1 of 3: drive 0.2 m/s for 0.5 m",
            "step 1 of 3: done: 0.50 m in 3.3 s",
            "step 2 of 3: turn 90° to the right",
            "step 2 of 3: done: turned -89.5°",
            "step 3 of 3: wait 2 s",
            "step 3 of 3: done",
            "done",
        ],
    ),
    "a place that cannot be reached ends the mission": (
        """
        [[steps]]
        goto = [9, 9]
        [[steps]]
        wait = 1
        """,
        {},
        ["begins: 2 steps", "step 1 of 2: go to (9, 9)", "failed at step 1 of 2: no way there"],
    ),
    "it is skipped, if that was asked": (
        """
        on_failure = "skip"
        [[steps]]
        goto = [9, 9]
        [[steps]]
        wait = 1
        """,
        {},
        [
            "begins: 2 steps",
            "step 1.1 of 2: go to (9, 9)",
            "step 1.1 of 2 failed: no way there; it is skipped",
            "step 2.1 of 2: wait 1 s",
            "step 2.1 of 2: done",
            "done",
        ],
    ),
    "or something else is done": (
        """
        [[steps]]
        repeat = 2
        steps = [{goto = [9, 9], on_failure = [{turn_deg = 10}]}]
        """,
        {},
        [
            "begins: 1 step",
            "step 1.1.1 of 1, round 1 of 2: go to (9, 9)",
            "step 1.1.1 of 1, round 1 of 2 failed: no way there; what is to be done then follows",
            "step 1.1.1 of 1, round 1 of 2: turn 10° to the left",
            "step 1.1.1 of 1, round 1 of 2: done: turned 9.5°",
            "step 1.1.1 of 1, round 2 of 2: go to (9, 9)",
            "step 1.1.1 of 1, round 2 of 2 failed: no way there; what is to be done then follows",
            "step 1.1.1 of 1, round 2 of 2: turn 10° to the left",
            "step 1.1.1 of 1, round 2 of 2: done: turned 9.5°",
            "done",
        ],
    ),
    "paused, it goes on with what is left": (
        "[[steps]]\nwait = 3",
        {1.0: msg.Pause(), 2.0: msg.Pause(), 5.0: msg.Resume(), 5.5: msg.Resume()},
        [
            "begins: 1 step",
            "step 1 of 1: wait 3 s",
            "paused at step 1 of 1: an operator sent pause; resume it, or drop it",
            "refused: mission 'm' is paused, not running",
            "goes on at step 1 of 1",
            "refused: mission 'm' is running, not paused",
            "step 1 of 1: done",
            "done",
        ],
    ),
    "a stop pauses it; another mission is refused; it is dropped": (
        "[[steps]]\nwait = 3",
        {1.0: "stopped by hand", 2.0: Mission("other", (msg.Wait(1.0),)), 3.0: msg.Drop(), 4.0: msg.Drop()},
        [
            "begins: 1 step",
            "step 1 of 1: wait 3 s",
            "paused at step 1 of 1: stopped by hand; resume it, or drop it",
            "refused: mission 'm' is paused, not done: drop it first",
            "dropped at step 1 of 1",
            "refused: mission 'm' is dropped, not to be dropped",
        ],
    ),
    "a wall ends a motion": (
        "[[steps]]\ndrive = 0.2\ndistance = 9",
        {},
        [
            "begins: 1 step",
            "step 1 of 1: drive 0.2 m/s for 9 m",
            "failed at step 1 of 1: no progress for 8 s: a wall ahead",
        ],
    ),
    "grasp: approach, close, lift": (
        """
        [[steps]]
        joints = {lift = 0.6, jaw = 0.1}
        seconds = 1
        [[steps]]
        joints = {jaw = {torque = 0.3}}
        seconds = 3
        contact = true
        [[steps]]
        joints = {lift = 0.0}
        """,
        {},
        [
            "begins: 3 steps",
            "step 1 of 3: move lift, jaw",
            "step 1 of 3: done: lift at 0.600 rad, jaw at 0.100 rad",
            "step 2 of 3: close jaw",
            "step 2 of 3: done: held up: jaw at 0.410 rad",
            "step 3 of 3: move lift",
            "step 3 of 3: done: lift at 0.002 rad",
            "done",
        ],
    ),
}


@pytest.mark.parametrize("name", TOLD)
def test_what_a_mission_tells(name: str) -> None:
    text, asked, told = TOLD[name]
    assert plant(text, closed=(9.0, 9.0), wall=1.0).run(60.0, asked) == told


def test_what_is_measured_is_what_was_asked() -> None:
    """The end, by the plant's own pose; also across a pause in the middle."""
    paused: dict[float, MissionTask | str] = {2.0: msg.Pause(), 3.0: msg.Resume()}
    for asked in (None, paused):
        driven = plant("[[steps]]\ndrive = -0.3\ndistance = 1.5")
        driven.run(30.0, asked)
        assert driven.pose.x == pytest.approx(-1.5, abs=0.01)
        turned = plant("[[steps]]\nturn_deg = 450")
        turned.run(30.0, asked)
        assert degrees(turned.pose.yaw) == pytest.approx(90.0, abs=1.0)
    timed = plant("[[steps]]\ndrive = 0.3\nturn_deg = 20\nseconds = 3")
    timed.run(30.0)
    assert degrees(timed.pose.yaw) == pytest.approx(60.0, abs=2.0)
    assert hypot(timed.pose.x, timed.pose.y) == pytest.approx(0.9 * 0.955, abs=0.05)  # the chord of its arc


def test_points_are_passed_without_a_stop_but_the_last() -> None:
    following = plant("[[steps]]\nfollow = [[0.2, 0], [2, 0], [2, 2]]")
    wants = [following.tick() for _ in range(200)]
    assert [(intent.goal.x, intent.goal.y, intent.passing) for intent in wants if intent.goal] == [
        (0.2, 0.0, False),
        (2.0, 0.0, True),
        (2.0, 2.0, True),
    ]


@pytest.mark.parametrize(
    ("marker", "missed"),
    [(Pose(2.0, 1.0, -2.8), Pose(0.03, 0.05, -0.1)), (Pose(0.0, -2.0, pi / 2), Pose(-0.02, -0.1, -0.1))],
)
def test_docking_ends_straight_before_the_marker(marker: Pose, missed: Pose) -> None:
    """From a place that is missed by up to 10 cm and 6 degrees: within 1 cm of the line, 1 degree off."""
    docking = plant("[[steps]]\ndock = 3\ndistance = 0.6", marker=marker, missed=missed)
    told = docking.run(60.0)
    assert told[-1] == "done", told
    place = moved(marker, Pose(0.6, 0.0, pi))
    off = hypot(docking.pose.x - place.x, docking.pose.y - place.y)
    assert off < 0.02
    assert abs(wrap(docking.pose.yaw - place.yaw)) < 0.0175


def test_a_marker_that_is_nowhere_is_looked_for_once_around() -> None:
    docking = plant("[[steps]]\ndock = 4")
    assert docking.run(60.0)[-1] == "failed at step 1 of 1: marker 4 is not seen, all around"
    assert abs(wrap(docking.pose.yaw)) < 0.05


def test_the_jaw_that_meets_nothing_fails() -> None:
    empty = plant("[[steps]]\njoints = {lift = {torque = 0.3}}\nseconds = 1\ncontact = true")
    assert empty.run(60.0)[-1].startswith("failed at step 1 of 1: lift met nothing")


def test_the_table_of_phases_is_whole() -> None:
    """A mission that is over changes only by another; nothing but Resume makes it go on."""
    assert {after for (_, cause), after in PHASES.items() if cause is Cause.RESUME} == {MissionPhase.RUNNING}
    causes = {cause for (phase, cause), after in PHASES.items() if after is MissionPhase.RUNNING}
    assert causes == {Cause.START, Cause.RESUME}
    assert {phase for phase, cause in PHASES if cause is Cause.START} == {
        MissionPhase.NONE,
        MissionPhase.DONE,
        MissionPhase.FAILED,
        MissionPhase.DROPPED,
    }


def test_a_copy_goes_on_as_the_original() -> None:
    one = plant(TOLD["or something else is done"][0], closed=(9.0, 9.0))
    one.run(1.5)
    two = copy.deepcopy(one)
    assert one.run(60.0) == two.run(60.0)


def test_a_mission_that_only_fails_keeps_nothing_busy() -> None:
    """A failure is followed by a second of standing."""
    text = '[[steps]]\nrepeat = 0\nsteps = [{goto = [9, 9], on_failure = "skip"}]'
    endless = plant(text, closed=(9.0, 9.0))
    assert len(endless.run(20.0)) < 25
    assert endless.missions.phase is MissionPhase.RUNNING


def deep(depth: int) -> Step:
    step: Step = msg.Wait(1.0)
    for _ in range(depth):
        step = msg.Repeat(1, (step,))
    return step


WRONG: list[tuple[Sequence[Step], str]] = [
    ((), "it has no steps"),
    ((msg.Repeat(2, ()),), "step 1 has no steps"),
    ((deep(8),), "nested more than 6 deep"),
    ((msg.Repeat(1, (msg.Wait(1.0),) * 600),), "it has more than 500 steps"),
    ((msg.Wait(1.0), msg.Move(9.0, seconds=1.0)), "step 2: its linear speed, 9, is beyond this base's 0.6"),
    ((msg.Move(0.1),), "step 1: a motion needs a time or a distance"),
    ((msg.Move(0.0, angular=1.0, distance=1.0),), "step 1: a distance needs a speed"),
    ((msg.Move(0.0, seconds=1.0),), "step 1: a motion needs a speed; to stand, wait"),
    ((msg.Move(0.1, 0.1, seconds=1.0),), "step 1: this base does not move sideways"),
    ((msg.Move(float("nan"), seconds=1.0),), "step 1: its linear must be from"),
    ((Goal(1e5, 0.0),), "step 1: (100000, 0) is beyond 10000 m"),
    ((msg.Follow(()),), "step 1: there are no points"),
    ((msg.Follow(((0.0, float("nan")),)),), "step 1: (0, nan) is beyond"),
    ((msg.Wait(-1.0),), "step 1: its time must be from 0"),
    ((msg.Turn(1e4),), "step 1: an angle beyond 1000 rad"),
    ((msg.Dock(3, 9.0),), "step 1: its place must be within 5 m"),
    ((msg.Reach(()),), "step 1: there are no targets"),
    (
        (msg.Reach((msg.Torque("lif", 1.0),)),),
        "step 1: 'lif' is no joint that takes a target",
    ),
    ((msg.Reach((msg.Torque("lift", 1.0), msg.Hold("lift"))),), "step 1: a joint has two targets"),
    ((msg.Reach((msg.Torque("lift", float("inf")),)),), "step 1: lift: its torque must be"),
    ((msg.Try((msg.Wait(1.0),), (msg.Wait(-1.0),)),), "step 1.1: its time must be"),
]


@pytest.mark.parametrize(("steps", "reason"), WRONG)
def test_what_a_base_cannot_do_is_refused(steps: Sequence[Step], reason: str) -> None:
    assert reason in why_not(Mission("m", tuple(steps)), ABLE)


def test_bare_joints_do_not_drive() -> None:
    assert why_not(Mission("m", (msg.Turn(1.0),)), BARE) == "step 1: turn: there is no base to drive"
    assert why_not(Mission("m", (msg.Wait(1.0), msg.Reach((msg.Hold("jaw"),)))), BARE) == ""
    turned = msg.MoveTool(0.3, 0.0, 0.2, (0.0, float("nan"), 0.0))
    assert why_not(Mission("m", (turned,)), arms("arm")) == "step 1: an angle beyond 1000 rad"
    assert why_not(Mission("m", (turned,)), BARE) == "step 1: there is no arm to bring the tool there"


def test_a_step_names_its_arm_where_there_are_several() -> None:
    def told(limb: str, *names: str) -> str:
        return why_not(Mission("m", (msg.MoveTool(0.3, 0.0, 0.2, limb=limb),)), arms(*names))

    assert told("", "arm") == told("arm", "arm") == told("left", "left", "right") == ""
    assert told("", "left", "right") == "step 1: which arm? expected limb = 'left' or 'right'"
    assert told("lift", "left", "right") == "step 1: there is no arm 'lift'; there are left, right"
    assert told("lift", "arm") == "step 1: there is no arm 'lift'; there is arm"
