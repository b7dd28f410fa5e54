"""Targets of an arm: motions of all joints together, gravity, holding, pushing, places; shafts that obey."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from brain.bodies.arm import JointAxis, SerialArm
from brain.bodies.body import Linkage, Placement
from brain.bodies.limbs import LimbPlace
from brain.limb import Allowance, Percept, Plan
from brain.linked_joints import LinkedJoints
from brain.settings import BrainSettings
from brain.skills.skill import Observed, Tally, ToolPlace
from brain.status import StatusReporter
from gateway.core.limits import Limits, SetpointProfile
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
)

STEP: Nanos = 5 * MILLISECOND
TEXT = (files("gateway.fixtures") / "robots" / "arm.urdf").read_text("utf-8")
MOTORS = ("turn", "shoulder", "elbow", "forearm_roll", "wrist_pitch", "wrist_roll", "grip")
ARM = SerialArm(axes={motor: JointAxis() for motor in MOTORS}, tip="tool", urdf=TEXT)
REST = dict(zip(MOTORS, (0.0, -1.0, 2.6, 0.0, 1.54, 0.0, 0.0), strict=True))


class Bench:
    """Shafts that are where the last Impedance put them; the others stay."""

    def __init__(self, body: Linkage = ARM, at: LimbPlace = LimbPlace()) -> None:  # noqa: B008 -- a value
        timeouts = dict.fromkeys(MOTORS, 100 * MILLISECOND)
        self.status = StatusReporter()
        self.targets = LinkedJoints("arm", body, at, timeouts, BrainSettings(body=body), self.status)
        self.now: Nanos = 0
        self.shafts = dict(REST)
        self.out: dict[str, Command] = {}
        self.plan = Plan()
        self.stopped = ""
        self.armed = dict.fromkeys(MOTORS, False)

    def step(self, count: int = 1) -> dict[str, Command]:
        for _ in range(count):
            self.now += STEP
            modes = {m: Mode.ARMED if armed else Mode.READY for m, armed in self.armed.items()}
            events: list[Event] = [Feedback(m, self.now, at, 0.0) for m, at in self.shafts.items()]
            events += [State(m, self.now, mode) for m, mode in modes.items()]
            percept = self.targets.perceive(self.now, events)
            allowance = replace(self.targets.allow(percept, by_hand=False), stopped=self.stopped)
            self.targets.drop(self.now, allowance)
            self.plan = self.targets.plan(percept, allowance, running=False)
            commands = self.targets.commands(percept, allowance, self.plan)
            self.out = {command.motor: command for command in commands}
            for motor, command in self.out.items():
                if not self.stopped:
                    self.armed[motor] = not isinstance(command, Idle)
                if isinstance(command, Impedance) and command.stiffness:
                    self.shafts[motor] = command.position
        return self.out

    @property
    def ended(self) -> Tally:
        """Places for the tip that are done with."""
        return self.targets.see(Observed(0), Percept(0), Allowance()).places["arm"]

    def ask(self, task: Command) -> None:
        assert not self.targets.objection(self.now, task, Allowance())
        self.targets.accept(self.now, task)

    def reach(self, seconds: float = 0.0, **to: float) -> str:
        targets = [Position(motor, at) for motor, at in to.items()]
        return self.targets.reach(self.now, targets, round(seconds * SECOND))


def torques(out: dict[str, Command]) -> list[float]:
    return [command.torque for command in out.values() if isinstance(command, Impedance)]


def test_nothing_is_armed_before_a_target_and_all_is_held_after_the_first() -> None:
    bench = Bench()
    assert set(map(type, bench.step(3).values())) == {Idle}
    assert not bench.reach(wrist_roll=0.1)
    out = bench.step()
    assert set(map(type, out.values())) == {Impedance}
    assert torques(out) == pytest.approx(ARM.gravity(list(REST.values())), abs=0.05)
    bench.step(150)
    assert bench.shafts == REST | {"wrist_roll": 0.1}
    assert torques(bench.out) == pytest.approx(ARM.gravity(list(bench.shafts.values())), abs=1e-12)
    assert not bench.plan.busy


def test_joints_move_together_within_their_limits_and_arrive_in_the_time_asked_for() -> None:
    bench = Bench()
    bench.step()
    assert not bench.reach(1.5, shoulder=-0.6, elbow=2.0, grip=0.3)
    path = []
    for _ in range(320):
        bench.step()
        path.append([bench.shafts[m] for m in ("shoulder", "elbow", "grip")])
    way = np.array(path)
    moving = np.nonzero(np.abs(np.diff(way, axis=0)).max(axis=1) > 1e-9)[0]
    assert (moving[-1] - moving[0]) * STEP / SECOND == pytest.approx(1.5, abs=0.02)
    share = (way - way[0]) / (way[-1] - way[0])
    assert share[:, 0] == pytest.approx(share[:, 1], abs=0.03)  # all the way together
    dt = STEP / SECOND
    speed, jerk = np.diff(way, axis=0) / dt, np.diff(way, 3, axis=0) / dt**3
    assert np.abs(speed).max() <= 1.0 + 1e-9
    assert np.abs(jerk).max() <= 30.0 * 1.001
    assert way[-1] == pytest.approx((-0.6, 2.0, 0.3), abs=1e-12)


def test_the_torque_of_a_motion_is_that_of_inverse_dynamics() -> None:
    bench = Bench()
    bench.step()
    bench.reach(shoulder=0.5)
    bench.step(60)
    q, v, a = zip(*(bench.targets._state(motor) for motor in MOTORS), strict=True)
    assert max(map(abs, v)) > 0.3
    assert torques(bench.out) == pytest.approx(ARM.chain.torques(q, v, a).tolist())


def test_a_stop_is_held_where_it_is_and_nothing_arms_at_its_release() -> None:
    bench = Bench()
    bench.step()
    bench.reach(shoulder=0.5)
    bench.step(50)
    at = dict(bench.shafts)
    bench.stopped = "a person"
    bench.step(5)
    bench.shafts["shoulder"] -= 0.01  # it sinks a little
    bench.step(5)
    bench.stopped = ""
    out = bench.step(20)
    assert set(map(type, out.values())) == {Impedance}
    assert bench.shafts == at | {"shoulder": at["shoulder"] - 0.01}
    bench.stopped = "a person"
    bench.step()
    bench.armed = dict.fromkeys(MOTORS, False)  # by the stop action
    bench.step()
    bench.stopped = ""
    assert set(map(type, bench.step(20).values())) == {Idle}


def test_what_is_gripped_stays_gripped() -> None:
    bench = Bench()
    bench.step()
    bench.targets.reach(bench.now, [Torque("grip", -1.5)], 0)
    push = bench.step()["grip"]
    weight = ARM.gravity(list(bench.shafts.values()))[-1]
    assert isinstance(push, Impedance)
    assert (push.stiffness, push.damping) == (0.0, 2.0)
    assert push.torque == pytest.approx(weight - 1.5)
    bench.stopped = "a person"
    bench.step()
    bench.stopped = ""
    held = bench.step()["grip"]
    assert isinstance(held, Impedance)
    assert (held.stiffness, held.position) == (50.0, 0.0)
    assert held.torque == pytest.approx(weight - 1.5)
    bench.reach(grip=0.3)
    assert torques(bench.step())[-1] == pytest.approx(weight, abs=0.2)


def test_standing_comes_to_rest_within_the_limits() -> None:
    bench = Bench()
    bench.step()
    bench.reach(shoulder=1.5)
    bench.step(60)
    speed = bench.targets._state("shoulder").velocity
    before = bench.shafts["shoulder"]
    bench.targets.stand(bench.now)
    bench.step(150)
    assert 0.0 < bench.shafts["shoulder"] - before < speed * speed  # 3 rad/s², 30 rad/s³
    assert not bench.plan.busy
    assert isinstance(bench.targets._targets["shoulder"], Hold)


def test_idle_to_one_joint_lets_it_go_and_holds_the_others() -> None:
    bench = Bench()
    bench.step()
    bench.reach(shoulder=0.0)
    bench.step(10)
    bench.ask(Idle("grip"))
    out = bench.step()
    assert [m for m, command in out.items() if isinstance(command, Idle)] == ["grip"]


def test_the_tip_is_brought_to_a_place_and_attitude() -> None:
    bench = Bench()
    bench.step()
    down = (0.0, math.pi, 0.0)
    assert not bench.targets.place(bench.now, ToolPlace(Placement(0.35, 0.1, 0.15, down)))
    assert bench.ended.number == 0
    bench.step(700)
    turned, at = ARM.chain.forward(list(bench.shafts.values()))
    assert at == pytest.approx((0.35, 0.1, 0.15), abs=2e-4)
    assert turned[:, 2] == pytest.approx((0.0, 0.0, -1.0), abs=2e-3)
    assert bench.ended == (1, "")
    assert bench.shafts["grip"] == 0.0  # does not move the tip


def test_places_are_in_the_frame_of_the_robot_that_carries_it() -> None:
    at = LimbPlace(0.2, -0.1, 0.3, math.pi / 2.0)
    bench = Bench(at=at)
    bench.step()
    assert not bench.targets.place(bench.now, ToolPlace(Placement(0.1, 0.25, 0.45, (0.0, math.pi, 0.0))))
    bench.step(700)
    turned, tip = ARM.chain.forward(list(bench.shafts.values()))
    assert at.outward(*tip.tolist()) == pytest.approx((0.1, 0.25, 0.45), abs=2e-4)
    assert turned[:, 2] == pytest.approx((0.0, 0.0, -1.0), abs=2e-3)
    assert turned[:, 0] == pytest.approx((0.0, 1.0, 0.0), abs=5e-3)  # -x of the robot is y of the arm


def test_what_is_out_of_reach_is_refused_with_the_reason_and_nothing_moves() -> None:
    bench = Bench()
    bench.step()
    bench.targets.place(bench.now, ToolPlace(Placement(0.9, 0.0, 0.3)))
    bench.step(200)
    assert bench.ended.number == 1
    assert bench.ended.why.startswith("(0.9, 0, 0.3) is out of reach: it comes no nearer than 0.2")
    assert bench.shafts == REST
    assert bench.reach(shoulder=3.0) == "shoulder goes from -1 to 2, not to 3"


def test_every_place_of_random_joints_is_found_again_seed_3() -> None:
    rng = np.random.default_rng(3)
    low, high = np.array(ARM.ranges).T
    found = 0
    for _ in range(8):
        goal = low + (high - low) * rng.random(len(MOTORS))
        turned, at = ARM.chain.forward(goal)
        roll, yaw = math.atan2(turned[2, 1], turned[2, 2]), math.atan2(turned[1, 0], turned[0, 0])
        x, y, z = at.tolist()
        place = Placement(x, y, z, (roll, math.asin(-turned[2, 0]), yaw))
        search = ARM.search(list(REST.values()), place)
        work = 0
        while not search.advance(10):
            work += 10
        assert work <= 25 * 60
        if search.found is not None:
            found += 1
            assert (low <= search.found).all()
            assert (search.found <= high).all()
            assert np.array(ARM.chain.forward(search.found)[1]) == pytest.approx(at, abs=1.1e-4)
    assert found == 8


def test_a_copy_goes_on_as_the_original() -> None:
    bench = Bench()
    bench.step()
    bench.targets.place(bench.now, ToolPlace(Placement(0.3, 0.1, 0.25)))
    bench.step(3)
    other = copy.deepcopy(bench)
    assert bench.step(50) == other.step(50)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"urdf": ""}, "an arm needs its links and joints"),
        ({"tip": "hand_over"}, "there is no link 'hand_over'"),
        ({"axes": {"turns": JointAxis()}}, "there is no joint 'turns'"),
        ({"axes": {"a": JointAxis()}, "joint_names": {"a": "tool_mount"}}, "is fixed: it cannot be driven"),
        (
            {"axes": {"turn": JointAxis(), "b": JointAxis()}, "joint_names": {"b": "turn"}},
            "two motors move one joint",
        ),
    ],
)
def test_what_is_no_arm_is_refused(change: dict[str, object], sentence: str) -> None:
    given: dict[str, object] = {"axes": {"turn": JointAxis()}, "tip": "tool", "urdf": TEXT}
    with pytest.raises(ValueError, match=sentence):
        SerialArm(**(given | change))  # type: ignore[arg-type]


def test_position_control_has_the_same_set_points() -> None:
    plain = SerialArm(axes=ARM.axes, tip="tool", urdf=TEXT, control="position")
    bench = Bench(plain)
    bench.step()
    bench.reach(elbow=2.0)
    assert set(map(type, bench.step().values())) == {Position}


@pytest.mark.parametrize("jerk", [None, 60.0])
def test_a_planned_motion_is_profiled_here_alone(jerk: float | None) -> None:
    """What is planned goes to the wire as it is: the joint keeps its limits, and has no profile to add."""
    bench = Bench(SerialArm(axes=ARM.axes, tip="tool", urdf=TEXT, control="position"))
    limits, joints = Limits(2.0, 20.0, 50.0, None, jerk), {motor: SetpointProfile() for motor in MOTORS}
    bench.step()
    bench.reach(shoulder=-0.6, elbow=2.0, grip=0.3)
    planned, sent, dt = list[Command](), list[Command](), STEP / SECOND
    for n in range(300):
        if n == 60:  # on the way
            bench.reach(elbow=2.4)
        for motor, one in bench.step().items():
            planned.append(one)
            sent.append(joints[motor].limited(one, dt, Feedback(motor, bench.now, REST[motor], 0.0), limits))
    assert any(isinstance(one, Position) and abs(one.velocity) > 0.5 for one in planned)
    for one, other in zip(planned, sent, strict=True):
        assert isinstance(one, Position)
        assert isinstance(other, Position)
        assert (other.position, other.velocity) == pytest.approx((one.position, one.velocity), abs=1e-12)


def test_a_trajectory_is_passed_on_as_it_is_given_and_ends_where_it_ended() -> None:
    bench = Bench()
    bench.reach(elbow=2.6)
    bench.step(5)

    def sample(n: int) -> Position:
        return Position("elbow", 2.6 - 0.2 * (1.0 - math.cos(0.02 * n)), -0.8 * math.sin(0.02 * n))

    for n in range(100):
        bench.ask(sample(n))
        out = bench.step()["elbow"]
        assert isinstance(out, Impedance)
        if n > 1:
            assert (out.position, out.velocity) == (sample(n).position, sample(n).velocity)
    bench.step(400)
    last = bench.out["elbow"]
    assert isinstance(last, Impedance)
    assert last.position == pytest.approx(sample(99).position)
    assert last.velocity == 0.0


def test_positions_far_from_each_other_are_no_trajectory() -> None:
    bench = Bench()
    bench.reach(elbow=2.6)
    bench.step(5)
    for n in range(4):
        bench.ask(Position("elbow", 2.6 - 0.6 * n, -0.5))
        out = bench.step()["elbow"]
        assert isinstance(out, Impedance)
        assert out.position == pytest.approx(2.6, abs=0.01)
