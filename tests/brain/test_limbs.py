"""One brain over several limbs: a base in an office, and an arm on it whose shafts are where they are put."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from importlib.resources import files

import pytest

from brain.belief import Belief, BrainState, BrainTask
from brain.bodies.arm import JointAxis, SerialArm
from brain.bodies.limbs import BodyAsLimb, LimbPlace, Limbs
from brain.brain import Brain
from brain.settings import BrainSettings
from protocols import messages as msg
from protocols.messages import MILLISECOND, Command, Event, Feedback, Goal, Idle, Impedance, Mission, MoveTool
from tests.brain.helpers import BODY, MOUNTS, TICK, TIMEOUTS, Office

WHEELS = (BODY.left, BODY.right)
ARM = ("turn", "shoulder", "elbow", "forearm_roll", "wrist_pitch", "wrist_roll")
REST = dict(zip(ARM, (0.0, -1.0, 2.6, 0.0, 1.54, 0.0), strict=True))
TEXT = (files("gateway.fixtures") / "robots" / "arm.urdf").read_text("utf-8")
MAST = "mast"


def settings() -> BrainSettings:
    arm = SerialArm(axes={motor: JointAxis() for motor in ARM}, tip="tool", urdf=TEXT)
    made = Limbs(limbs={"base": BodyAsLimb(BODY), "arm": BodyAsLimb(arm, "base", LimbPlace(0.1, 0.0, 0.2))})
    return BrainSettings(made)


class Robot:
    """The office's base, an arm and a mast on it."""

    def __init__(self) -> None:
        self.office, self.shafts = Office(), {**REST, MAST: 0.0}
        motors = (*ARM, *WHEELS, MAST)
        timeouts = {**TIMEOUTS, **dict.fromkeys((*ARM, MAST), 100 * MILLISECOND)}
        self.brain = Brain(settings(), motors, MOUNTS, timeouts)
        self.silent: set[str] = set()
        self.out: dict[str, Command] = {}
        self.notes: list[str] = []

    def tick(self, *tasks: BrainTask, stopped: str = "") -> Belief:
        events: list[Event] = list(self.office.step([self.out[w] for w in WHEELS] if self.out else []))
        for motor, command in self.out.items():
            if isinstance(command, Impedance):
                self.shafts[motor] = command.position
        now = self.office.now
        events += [Feedback(m, now, at, 0.0) for m, at in self.shafts.items() if m not in self.silent]
        commands: Sequence[Command] = self.brain.step(now, events, tasks, stopped)
        assert [command.motor for command in commands] == [*ARM, *WHEELS, MAST]
        self.out = {command.motor: command for command in commands}
        self.notes += [text for _, text in self.brain.take_notes()]
        return self.brain.belief()

    def run(self, span: float) -> Belief:
        for _ in range(round(span * 1e9 / TICK)):
            belief = self.tick()
        return belief

    def kinds(self, motors: Sequence[str]) -> set[type[Command]]:
        return {type(self.out[motor]) for motor in motors}


def test_a_mission_moves_one_limb_after_the_other_and_the_arm_holds_while_the_base_drives() -> None:
    robot = Robot()
    robot.run(0.5)
    x = robot.office.pose.x
    robot.tick(Mission("fetch", (MoveTool(0.45, 0.0, 0.45, seconds=0.5), msg.Move(0.2, distance=0.2))))
    robot.run(3.0)
    held = dict(robot.shafts)
    arm = robot.brain.settings.abilities(ARM).arms["arm"]
    assert arm.points([held[m] for m in ARM])[-1] == pytest.approx((0.35, 0.0, 0.25), abs=1e-3)
    belief = robot.run(3.0)
    assert belief.mission is not None
    assert belief.mission.phase == "done"
    assert belief.state is BrainState.READY
    assert robot.office.pose.x - x == pytest.approx(0.2, abs=0.03)
    assert robot.shafts == held
    assert robot.kinds(ARM) == {Impedance}
    assert robot.kinds(["mast"]) == {Idle}


def test_a_goal_and_a_tool_are_asked_of_the_same_robot() -> None:
    robot = Robot()
    robot.run(0.5)
    belief = robot.tick(Goal(robot.office.pose.x + 0.2, robot.office.pose.y))
    assert belief.goal is not None
    robot.tick(Mission("tool", (MoveTool(0.45, 0.0, 0.45),)))
    assert robot.notes[-1] == "Mission refused: there are goals: drop them first"


def test_nothing_moves_before_the_arm_has_reported() -> None:
    robot = Robot()
    robot.silent = {"elbow", MAST}
    belief = robot.run(0.5)
    assert (belief.state, belief.reason) == (BrainState.INITIALISING, "waiting for feedback of elbow")
    robot.tick(msg.Drive(0.1, 0.0))
    assert robot.notes[-1] == "Drive refused: waiting for feedback of elbow"
    robot.silent = {MAST}
    assert robot.run(0.1).state is BrainState.READY, "the mast is not used"


def test_a_joint_that_is_lost_pauses_the_mission_of_the_base_and_a_mast_does_not() -> None:
    robot = Robot()
    robot.run(0.5)
    robot.tick(Mission("drive", (msg.Move(0.1, distance=1.0),)))
    robot.silent = {MAST}
    belief = robot.run(0.5)
    assert belief.mission is not None
    assert belief.mission.phase == "running"
    robot.silent = {"elbow"}
    belief = robot.run(0.5)
    assert belief.mission is not None
    assert belief.mission.phase == "paused"
    assert (belief.state, belief.reason) == (
        BrainState.DEGRADED,
        "elbow: no feedback for more than 90 ms",
    )
    assert robot.office.speed == pytest.approx(0.0, abs=0.01)


def test_a_stop_disarms_all_and_drops_what_each_was_doing() -> None:
    robot = Robot()
    robot.run(0.5)
    robot.tick(msg.Position("turn", 0.5), msg.Drive(0.2, 0.0))
    robot.tick(stopped="enough")
    assert robot.kinds([*ARM, *WHEELS, MAST]) == {Idle}
    assert "Position refused: stopped: enough" not in robot.notes
    robot.tick(msg.Position("turn", 0.5), stopped="enough")
    assert robot.notes[-1] == "Position refused: stopped: enough"


def test_a_limb_is_changed_by_its_name_within_what_the_file_allows() -> None:
    robot = Robot()
    assert robot.brain.set("base.max_linear", 0.2) == ""
    assert robot.brain.settings.base is not None
    assert robot.brain.settings.base.max_linear == 0.2
    assert "must be at most" in robot.brain.set("base.max_linear", 2.0)
    assert robot.brain.set("arm.axes", 1.0).startswith("there is no setting 'arm.axes'")


def test_a_copy_goes_on_as_the_original() -> None:
    robot = Robot()
    robot.run(0.5)
    robot.tick(Mission("fetch", (MoveTool(0.45, 0.0, 0.45),)))
    robot.run(0.1)
    other = copy.deepcopy(robot)
    robot.run(0.3)
    other.run(0.3)
    assert robot.out == other.out
