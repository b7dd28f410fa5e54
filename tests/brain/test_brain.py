"""The brain, whole, in a kinematic office: goals through a doorway, and one test per demand.

Simulated time, seeded noise, no ground truth: the brain gets Feedback, Imu and LaserScan and returns Velocity
or Idle. Only the office knows the true pose.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from math import hypot, inf, isfinite, nan

import pytest

from brain.base_limb import BaseLimb
from brain.belief import Belief, BrainState, BrainTask, Pose
from brain.bodies.joints import Joints
from brain.bodies.plane import arc, wrap
from brain.brain import Brain, BrainSettings
from brain.perception.consistency import Trust, Verdict
from brain.planning.behaviours import Fact
from brain.planning.costmap import PlannerSettings
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Mode, Nanos
from tests.brain.helpers import BODY, MOUNTS, ROOMS, TICK, TIMEOUTS, Noise, Office, Trip

NEXT_ROOM = msg.Goal(4.5, -1.0)
ACROSS = msg.Goal(-1.0, 3.0)


def from_goal(trip: Trip, goal: msg.Goal) -> float:
    """By the true pose [m]."""
    return hypot(trip.office.pose.x - goal.x, trip.office.pose.y - goal.y)


def top_speed(trip: Trip, ticks: int) -> float:
    speeds = []
    for _ in range(ticks):
        trip.tick()
        speeds.append(abs(trip.office.speed))
    return max(speeds)


def all_idle(commands: Sequence[Command]) -> bool:
    return all(isinstance(command, msg.Idle) for command in commands)


def driving(span: float = 3.0, timeouts: dict[str, Nanos] = TIMEOUTS) -> Trip:
    """On its way across the room, at speed."""
    trip = Trip(Office(), timeouts=timeouts)
    trip.tick([ACROSS])
    trip.run(span)
    assert trip.brain.belief().state is BrainState.RUNNING
    assert trip.office.speed > 0.1
    return trip


# -- end to end --------------------------------------------------------------------------------


def test_goals_through_a_doorway_are_reached_and_no_wall_is_touched() -> None:
    trip, home = Trip(Office()), msg.Goal(-1.0, 3.0, 1.57)
    belief = trip.go(NEXT_ROOM)
    assert belief.reached == 1
    assert from_goal(trip, NEXT_ROOM) < 0.20
    belief = trip.go(home)
    assert belief.reached == 2
    assert from_goal(trip, home) < 0.20
    assert abs(wrap(trip.office.pose.yaw - 1.57)) < 0.15
    assert trip.office.touched == 0
    trip.run(2.0)
    assert trip.states == ["initialising", "running", "ready"]
    assert trip.brain.belief().state is BrainState.READY
    assert all_idle(trip.commands)


def test_a_goal_is_reached_though_a_person_says_on_the_way_that_it_is_elsewhere() -> None:
    """40 cm and 15° beside where it is: what scans show is believed again, and no wall is touched."""
    trip, wrong = driving(), []
    for bad in (msg.Locate(nan, 0.0, 0.0), msg.Locate(2e4, 0.0, 0.0), msg.Locate(0.0, 0.0, 0.0, 9.0)):
        trip.tick([bad])
        wrong.append(trip.notes[-1][1])
    assert [text.partition(":")[0] for text in wrong] == ["Locate refused"] * 3
    assert "its x must be" in wrong[0]
    assert "is beyond 10000 m" in wrong[1]
    assert "a standard deviation of 9 m" in wrong[2]
    at = trip.office.pose
    trip.tick([msg.Locate(at.x + 0.3, at.y - 0.26, at.yaw + 0.26, 0.3, 0.26)])
    trip.run(20.0, lambda belief: belief.reached == 1)
    assert from_goal(trip, ACROSS) < 0.2
    assert trip.office.touched == 0


def test_equal_runs_are_equal_and_a_deep_copy_continues_alike() -> None:
    runs = [Trip(Office(seed=3)) for _ in range(2)]
    for trip in runs:
        trip.tick([NEXT_ROOM])
        trip.run(6.0)
    assert runs[0].log == runs[1].log
    other = copy.deepcopy(runs[0])
    for trip in (runs[0], other):
        trip.run(3.0)
    assert runs[0].log == other.log
    assert runs[0].notes == other.notes
    assert runs[0].brain.belief().path == other.brain.belief().path


def test_every_motor_has_one_finite_command_at_every_step_within_the_limits() -> None:
    trip = driving(7.0)
    per_step = 0.0
    before = {"left": 0.0, "right": 0.0}
    for commands in trip.log:
        assert [command.motor for command in commands] == ["left", "right"]
        for command in commands:
            velocity = command.velocity if isinstance(command, msg.Velocity) else 0.0
            assert isfinite(velocity)
            assert abs(velocity) <= BODY.top_speeds[0] + 1e-9
            per_step = max(per_step, abs(velocity - before[command.motor]))
            before[command.motor] = velocity
    # One control period at both largest accelerations.
    most = (BODY.max_linear_acceleration + BODY.max_angular_acceleration * 0.11) / BODY.wheel_radius
    assert per_step <= most * 0.020 + 1e-9


def test_control_is_due_by_time_not_by_count() -> None:
    trip = driving(2.0)
    start = len(trip.log)
    trip.run(1.0)
    changes = sum(a != b for a, b in zip(trip.log[start:], trip.log[start - 1 :], strict=False))
    assert 40 <= changes <= 50
    assert trip.brain.set("pursuit.period_ms", 50.0) == ""
    start = len(trip.log)
    trip.run(1.0)
    changes = sum(a != b for a, b in zip(trip.log[start:], trip.log[start - 1 :], strict=False))
    assert 15 <= changes <= 20


# -- one test per demand -----------------------------------------------------------------------


def test_demand_high_speed() -> None:
    """Three times as fast: still no wall is touched, and the goal is reached."""
    fast = replace(
        BODY, max_linear=2.0, max_angular=4.0, max_linear_acceleration=2.0, max_angular_acceleration=8.0
    )
    long_hall = (
        (-2.1, -2.1, 14.1, -2.0),
        (-2.1, 2.0, 14.1, 2.1),
        (-2.1, -2.1, -2.0, 2.1),
        (14.0, -2.1, 14.1, 2.1),
    )
    office = Office((*long_hall, (6.0, -2.0, 6.5, 0.6)), body=fast)
    trip = Trip(office, BrainSettings(fast))
    belief = trip.go(msg.Goal(12.0, -1.0), span=30.0)
    assert belief.reached == 1
    assert from_goal(trip, msg.Goal(12.0, -1.0)) < 0.20
    assert trip.office.touched == 0
    assert (
        max(hypot(a.x - b.x, a.y - b.y) for a, b in zip(trip.track, trip.track[1:], strict=False))
        > 1.5 * 0.01
    )


def test_demand_sharp_turn() -> None:
    """A goal right behind, then one around the corner of a wall: turned on the spot, nothing touched."""
    corner = (*ROOMS[:4], (-1.0, 0.5, 3.0, 0.6))
    trip = Trip(Office(corner))
    assert trip.go(msg.Goal(-1.4, 0.0), span=20.0).reached == 1
    behind = msg.Goal(-0.5, 1.4)
    assert trip.go(behind, span=30.0).reached == 2
    assert from_goal(trip, behind) < 0.20
    assert trip.office.touched == 0


def test_demand_sensor_noise() -> None:
    """Slip of 5 %, a gyro bias of 0.03 rad/s, ranges off by 3 cm."""
    rough = Noise(gyro=0.02, gyro_bias=0.03, range=0.03, slip=0.05)
    trip = Trip(Office(noise=rough, seed=2))
    assert trip.go(NEXT_ROOM).reached == 1
    assert from_goal(trip, NEXT_ROOM) < 0.20
    assert trip.office.touched == 0


@pytest.mark.parametrize(("silent", "measurement"), [("lidar", "scan"), ("left", "feedback")])
def test_demand_safe_mode_on_perception_failure(silent: str, measurement: str) -> None:
    """Slow, then standing, with the reason; and on again when it comes back in time."""
    trip = driving()
    trip.office.silent = {silent}
    trip.states.clear()
    stand = f"{0.9 * TIMEOUTS[silent] / MILLISECOND:g} ms"
    belief = trip.run(6.0, lambda b: "standing" in b.reason)
    assert belief.state is BrainState.DEGRADED
    assert belief.reason == f"{silent}: no {measurement} for more than {stand}: standing"
    trip.run(1.5)
    assert top_speed(trip, 20) < 1e-3
    assert any("slow" in text and level == "warning" for level, text in trip.notes)
    trip.office.silent = set()
    belief = trip.run(3.0, lambda b: b.state is BrainState.RUNNING)
    assert belief.state is BrainState.RUNNING
    assert trip.states == ["running", "degraded", "running"]
    assert trip.run(60.0, lambda b: b.reached == 1).reached == 1
    assert from_goal(trip, ACROSS) < 0.20
    assert trip.office.touched == 0


def test_without_the_gyro_the_base_goes_on_slowly() -> None:
    """Wheels and lidar suffice to know where it is."""
    trip = driving()
    trip.office.silent = {"imu"}
    belief = trip.run(60.0, lambda b: b.reached == 1)
    assert belief.reached == 1
    assert from_goal(trip, ACROSS) < 0.20
    assert any("imu: no reading for more than 75 ms: slow" in text for _, text in trip.notes)
    assert trip.office.touched == 0


def test_a_lost_robot_drops_its_goals_and_is_driven_by_hand_slowly() -> None:
    """Put into a room that it has never seen: it stands, and after a while a person drives it."""
    trip = driving()
    trip.office.boxes = [
        (-3.0, -3.1, 3.0, -3.0),
        (2.4, -3.0, 2.5, 3.0),
        (-3.0, 2.2, 3.0, 2.3),
        (-1.6, -3.0, -1.5, 3.0),
    ]
    trip.office.pose = Pose(0.3, -1.0, 2.2)
    belief = trip.run(8.0, lambda b: b.state is BrainState.STOPPED)
    assert belief.state is BrainState.STOPPED
    assert belief.reason.startswith("lost: lidar: ")
    assert belief.reached == 0
    for _ in range(15):
        trip.tick([msg.Drive(0.3, 0.0)])
        trip.run(0.1)
    assert 0.05 < trip.office.speed < 0.1
    trip.run(1.0)
    assert trip.brain.belief().state is BrainState.STOPPED


def test_slow_means_slow_before_it_means_standing() -> None:
    """A patient timeout: slow from 1.5 s on, standing from 2.7 s on."""
    trip = driving(timeouts={**TIMEOUTS, "lidar": 3000 * MILLISECOND})
    trip.office.silent = {"lidar"}
    trip.run(1.2)
    assert top_speed(trip, 10) > 0.9 * BODY.max_linear
    trip.run(0.9)
    assert 0.02 < top_speed(trip, 30) <= 0.3 * BODY.max_linear + 0.01
    trip.run(0.8)
    assert top_speed(trip, 20) < 1e-3


def test_a_lost_source_stops_the_base_and_nothing_resumes_by_itself() -> None:
    trip = driving()
    trip.office.silent = {"lidar"}
    belief = trip.run(8.0, lambda b: b.state is BrainState.STOPPED)
    assert belief.state is BrainState.STOPPED
    assert "lidar: no scan" in belief.reason
    assert ("error", f"stopped: {belief.reason}") in trip.notes
    assert belief.goal is None
    trip.run(1.5)
    assert all_idle(trip.commands)
    trip.tick([ACROSS])
    assert "Goal refused: lidar: no scan" in trip.notes[-1][1]
    trip.office.silent = set()
    belief = trip.run(2.0)
    assert belief.state is BrainState.READY
    assert top_speed(trip, 100) < 1e-3
    assert trip.go(ACROSS).reached == 1


IMPATIENT = BrainSettings(BODY, planner=PlannerSettings(patience=8 * SECOND))


def test_demand_stop_when_no_path_arrives() -> None:
    """A closed room: it searches for a path, stops, gives the reason, and disarms the motors."""
    closed = (*ROOMS, (2.0, 1.4, 2.1, 2.6))
    trip = Trip(Office(closed), IMPATIENT)
    trip.tick([NEXT_ROOM])
    belief = trip.run(40.0, lambda b: b.state is BrainState.STOPPED)
    assert belief.state is BrainState.STOPPED
    assert belief.reason.startswith("no path to goal 1 (4.50, -1.00) within 8 s: everything between")
    assert belief.path == ()
    assert "degraded" in trip.states
    trip.run(1.5)
    assert all_idle(trip.commands)
    assert trip.office.touched == 0
    assert trip.go(msg.Goal(-1.0, 1.0)).reached == 1


def test_a_doorway_that_is_closed_on_the_way_stops_the_robot_in_front_of_it() -> None:
    trip = Trip(Office(), IMPATIENT)
    trip.tick([NEXT_ROOM])
    trip.run(40.0, lambda b: trip.office.pose.x > 1.2 and bool(b.path) and b.path[-1][0] > 2.5)
    trip.office.boxes.append((2.0, 1.4, 2.1, 2.6))
    belief = trip.run(30.0, lambda b: b.state is BrainState.STOPPED)
    assert belief.state is BrainState.STOPPED
    assert trip.office.touched == 0
    assert trip.office.pose.x < 2.0


def test_a_box_put_in_the_way_is_driven_around() -> None:
    trip = driving(2.0)
    trip.office.boxes.append((-0.75, 1.6, -0.45, 1.9))
    assert trip.run(30.0, lambda b: b.reached == 1).reached == 1
    assert trip.office.touched == 0
    assert any("it is blocked near" in text for _, text in trip.notes)


def test_initialising_until_every_source_reports_and_goals_wait_for_it() -> None:
    office = Office()
    office.silent = {"lidar"}
    trip = Trip(office)
    trip.tick([ACROSS])
    belief = trip.run(4.0)
    assert belief.state is BrainState.INITIALISING
    assert belief.reason == "waiting for a reading of lidar"
    assert all(map(all_idle, trip.log))
    assert ("warning", "still waiting for a reading of lidar") in trip.notes
    trip.tick([msg.Drive(0.2, 0.0)])
    assert trip.notes[-1] == ("warning", "Drive refused: waiting for a reading of lidar")
    office.silent = set()
    belief = trip.run(1.0)
    assert belief.state is BrainState.RUNNING
    assert belief.goal == ACROSS


def test_a_stop_before_the_first_motion_drops_what_waits_for_it() -> None:
    office = Office()
    office.silent = {"lidar"}
    trip = Trip(office)
    trip.tick([ACROSS])
    trip.tick([ACROSS], stopped="stopped by hand")
    trip.tick([msg.Mission("m", (ACROSS,))], stopped="stopped by hand")
    refused = [text for _, text in trip.notes if text.endswith("refused: stopped by hand")]
    assert [text.split()[0] for text in refused] == ["Goal", "Mission"]
    office.silent = set()
    belief = trip.run(1.0)
    assert (belief.state, belief.goal, belief.mission) == (BrainState.READY, None, None)
    assert all(map(all_idle, trip.log))


def test_stop_disarms_at_once_and_release_does_not_resume() -> None:
    trip = driving()
    trip.tick(stopped="stopped by the operator")
    assert all_idle(trip.commands)
    belief = trip.brain.belief()
    assert (belief.state, belief.reason) == (BrainState.STOPPED, "stopped by the operator")
    assert ("warning", "1 goal dropped: stopped by the operator") in trip.notes
    assert ("warning", "stopped: stopped by the operator") in trip.notes
    assert not [text for level, text in trip.notes if level == "error"]
    trip.tick([ACROSS, msg.Drive(0.1, 0.0)], stopped="stopped by the operator")
    assert trip.notes[-1][1] == "Drive refused: stopped by the operator"
    belief = trip.run(1.0)
    assert belief.state is BrainState.READY
    assert all_idle(trip.commands)
    assert top_speed(trip, 50) < 1e-3
    assert trip.go(ACROSS).reached == 1


def base_of(trip: Trip) -> BaseLimb:
    body = trip.brain.base
    assert isinstance(body, BaseLimb)
    return body


def systems(belief: Belief) -> dict[str, tuple[str, str]]:
    return {one.name: (one.state, one.reason) for one in belief.systems}


def test_a_stop_and_a_lost_source_leave_planning_idle() -> None:
    trip = driving()
    assert systems(trip.brain.belief())["planning"] == ("following", "a path")
    belief = trip.tick(stopped="stopped by the operator")
    assert systems(belief)["planning"] == ("idle", "there is no goal")
    trip = driving()
    trip.office.silent = {"lidar"}
    belief = trip.run(8.0, lambda b: b.state is BrainState.STOPPED)
    assert systems(belief)["planning"] == ("idle", "there is no goal")


def test_backing_off_ends_with_a_stop_and_does_not_go_on_after_it() -> None:
    trip = driving()
    base_of(trip).navigator.behaviour.update(trip.office.now, {Fact.STUCK}, "an obstacle")
    trip.tick(stopped="stopped by the operator")
    start = len(trip.log)
    trip.run(0.2)
    assert all(map(all_idle, trip.log[start:]))


def test_the_verdict_is_named_as_in_the_documents() -> None:
    trip = driving()
    base_of(trip).perception.verdict = Verdict(Trust.TOO_SURE, "too sure: of x")
    assert systems(trip.brain.belief())["perception"] == ("too sure", "too sure: of x")


def test_a_motor_in_fault_stops_the_base() -> None:
    trip = driving()
    events = trip.office.step(trip.commands)
    fault = msg.State("left", trip.office.now, Mode.FAULT, "MOTOR_OVER_TEMP")
    trip.commands = trip.brain.step(trip.office.now, [*events, fault], [], "")
    belief = trip.brain.belief()
    assert belief.state is BrainState.STOPPED
    assert belief.reason == "left is in fault: MOTOR_OVER_TEMP"
    assert belief.goal is None


def test_manual_driving_obeys_the_limits_and_times_out() -> None:
    trip = Trip(Office(pose=Pose(-1.5, 1.0, 0.0)))
    trip.run(0.5)
    for _ in range(200):
        trip.tick([msg.Drive(5.0, 0.0)])
    assert trip.office.speed == pytest.approx(BODY.max_linear, abs=0.02)
    belief = trip.run(1.8)
    assert trip.office.speed < 1e-2
    assert belief.state is BrainState.READY
    trip.run(1.5)
    assert all_idle(trip.commands)


def test_a_command_to_a_wheel_is_refused() -> None:
    trip = Trip(Office())
    trip.run(0.5)
    trip.tick([msg.Velocity("left", 3.0)])
    assert trip.notes[-1] == (
        "warning",
        "Velocity refused: left moves the base: give the base a goal, or drive it",
    )
    assert all_idle(trip.commands)


def carrier() -> Brain:
    """A base with a mast."""
    settings = BrainSettings(BODY)
    return Brain(settings, ("left", "mast", "right"), MOUNTS, {**TIMEOUTS, "mast": 100 * MILLISECOND})


def test_a_joint_that_the_base_carries_has_targets_of_its_own() -> None:
    office, brain = Office(), carrier()
    reported = msg.Feedback("mast", office.now, 0.0, 0.0)
    there = msg.Position("mast", 0.5)
    steps: list[tuple[list[Command | msg.Drive], Command]] = [
        ([], msg.Idle("mast")),
        ([there], there),
        ([], there),
    ]
    steps.append(([msg.Drive(0.2, 0.0)], there))
    for asked, wanted in steps:
        reported = replace(reported, t=office.now + TICK)
        commands = brain.step(office.now + TICK, [*office.step([]), reported], asked, "")
        assert [command.motor for command in commands] == ["left", "mast", "right"]
        assert commands[1] == wanted
    assert list(brain.step(office.now, office.step([]), [], "by hand")) == [
        msg.Idle("left"),
        msg.Idle("mast"),
        msg.Idle("right"),
    ]


def test_a_joint_that_the_base_carries_loses_its_target_by_silence_and_the_base_goes_on() -> None:
    office, brain = Office(), carrier()
    received = [*office.step([]), msg.Feedback("mast", office.now, 0.0, 0.0)]
    commands = brain.step(office.now, received, [msg.Velocity("mast", 1.0)], "")
    assert commands[1] == msg.Velocity("mast", 1.0)
    for _ in range(20):
        commands = brain.step(office.now, office.step([]), [], "")
    assert commands[1] == msg.Idle("mast")
    dropped = "the target of mast is dropped: mast: no feedback for more than 90 ms"
    assert ("error", dropped) in brain.take_notes()
    assert brain.belief().state is BrainState.READY


BEYOND = "must be from -1000000 to 1000000, not"


@pytest.mark.parametrize(
    ("task", "reason"),
    [
        (msg.Goal(nan, 0.0), f"Goal refused: its x {BEYOND} nan"),
        (msg.Goal(0.0, 1.0, inf), f"Goal refused: its yaw {BEYOND} inf"),
        (msg.Goal(1e308, 0.0), f"Goal refused: its x {BEYOND} 1e+308"),
        (
            msg.Goal(1e6, 0.0),
            "Goal refused: (1e+06, 0) is beyond 10000 m",
        ),
        (msg.Drive(nan, 0.0), f"Drive refused: its linear {BEYOND} nan"),
        (msg.Drive(0.1, -inf), f"Drive refused: its angular {BEYOND} -inf"),
        (msg.Drive(0.1, 1e308), f"Drive refused: its angular {BEYOND} 1e+308"),
        (msg.Position("mast", 1e308), f"Position refused: its position {BEYOND} 1e+308"),
        (msg.Velocity("mast", 1.0, -1e308), f"Velocity refused: its torque {BEYOND} -1e+308"),
        (msg.Torque("mast", nan), f"Torque refused: its torque {BEYOND} nan"),
    ],
)
def test_a_task_beyond_what_any_robot_could_do_is_refused(task: BrainTask, reason: str) -> None:
    office, brain = Office(), carrier()
    for tasks in [*([[]] * 99), [task]]:
        brain.take_notes()
        received = [*office.step([]), msg.Feedback("mast", office.now, 0.0, 0.0)]
        brain.step(office.now, received, tasks, "")
    assert [text[: len(reason)] for _, text in brain.take_notes()] == [reason]
    assert brain.belief().state is BrainState.READY


def test_more_goals_than_anybody_waits_for_are_refused() -> None:
    trip = Trip(Office())
    trip.tick([msg.Goal(0.1 * (k % 10), 0.0) for k in range(1001)])
    assert trip.notes[-1] == ("warning", "Goal refused: 1000 goals are waiting already")


def test_belief_has_goal_path_and_version() -> None:
    trip = driving()
    belief = trip.brain.belief()
    assert belief.goal == ACROSS
    assert len(belief.path) >= 2
    assert belief.path_version >= 1
    assert belief.estimate is not None
    assert (
        hypot(belief.estimate.pose.x - trip.office.pose.x, belief.estimate.pose.y - trip.office.pose.y) < 0.05
    )
    assert belief.map is not None
    assert belief.raw is not None


def test_an_estimate_is_extrapolated_by_its_own_twist_up_to_a_limit() -> None:
    trip = driving()
    body, estimate = base_of(trip), trip.brain.belief().estimate
    assert estimate is not None
    for late, span in ((0, 0.0), (40, 0.04), (100, 0.1), (900, 0.1)):
        there = body.perception.sight(estimate.t + late * MILLISECOND).pose
        assert there == arc(estimate.pose, estimate.linear * span, estimate.angular * span)


def test_after_a_pause_of_the_loop_the_speed_does_not_jump() -> None:
    """Half a second without a step: the next command changes by no more than a tenth of a second's worth."""
    trip = driving(2.0)
    before = [c.velocity for c in trip.commands if isinstance(c, msg.Velocity)]
    for _ in range(100):
        events = trip.office.step(trip.commands)
    trip.commands = trip.brain.step(trip.office.now, events, [], "")
    after = [c.velocity for c in trip.commands if isinstance(c, msg.Velocity)]
    most = 0.1 * (BODY.max_linear_acceleration + BODY.max_angular_acceleration * 0.11) / BODY.wheel_radius
    assert max(abs(a - b) for a, b in zip(after, before, strict=True)) <= most + 1e-9


# -- bare joints -------------------------------------------------------------------------------


class TwoJoints:
    """A brain of two bare joints."""

    def __init__(self) -> None:
        timeouts = {"a": 100 * MILLISECOND, "b": 200 * MILLISECOND}
        self.brain = Brain(BrainSettings(Joints(motors=("a", "b"))), ["a", "b"], {}, timeouts)
        self.now, self.silent = 0, set[str]()

    def tick(
        self, *tasks: Command | msg.Goal | msg.Mission, stopped: str = "", state: msg.State | None = None
    ) -> Sequence[Command]:
        self.now += 10 * MILLISECOND
        events = [msg.Feedback(motor, self.now, 0.0, 0.0) for motor in ("a", "b") if motor not in self.silent]
        return self.brain.step(self.now, [*events, *([state] if state else [])], tasks, stopped)

    def systems(self) -> dict[str, tuple[str, str]]:
        return {one.name: (one.state, one.reason) for one in self.brain.belief().systems}

    def state(self) -> tuple[str, str]:
        belief = self.brain.belief()
        return belief.state, belief.reason


def test_joints_keep_their_targets() -> None:
    joints = TwoJoints()
    assert joints.tick() == (msg.Idle("a"), msg.Idle("b"))
    assert joints.state() == ("ready", "")
    joints.tick(msg.Velocity("a", 2.0))
    for _ in range(500):
        assert joints.tick() == (msg.Velocity("a", 2.0), msg.Idle("b"))
    assert joints.state() == ("running", "")
    assert joints.tick(msg.Torque("a", 0.2), msg.Position("b", 1.0)) == (
        msg.Torque("a", 0.2),
        msg.Position("b", 1.0),
    )
    belief = joints.brain.belief()
    assert (belief.estimate, belief.map, belief.path, belief.goal) == (None, None, (), None)


def test_the_systems_of_joints_say_what_they_do_and_why() -> None:
    joints = TwoJoints()
    joints.silent = {"b"}
    joints.tick()
    assert joints.systems() == {
        "perception": ("waiting", "for feedback of b"),
        "planning": ("idle", ""),
        "control": ("disarmed", ""),
    }
    joints.silent = set()
    joints.tick(msg.Velocity("a", 2.0))
    assert joints.systems()["control"] == ("moving", "")
    joints.tick(msg.Hold("a"))
    assert joints.systems()["control"] == ("holding", "")
    joints.tick(msg.Mission("away", (msg.Wait(1.0),)))
    assert joints.systems()["planning"] == ("running", "")
    joints.tick(stopped="stop")
    assert joints.systems()["planning"] == ("paused", "stop")


def test_joints_initialise_until_every_motor_reports() -> None:
    joints = TwoJoints()
    joints.silent = {"b"}
    joints.tick()
    assert joints.state() == ("initialising", "waiting for feedback of b")
    joints.silent = set()
    joints.tick()
    assert joints.state() == ("ready", "")


def test_a_stop_ends_all_targets_and_they_do_not_come_back() -> None:
    joints = TwoJoints()
    joints.tick(msg.Velocity("a", 2.0), msg.Position("b", 1.0))
    assert joints.tick(stopped="stop") == (msg.Idle("a"), msg.Idle("b"))
    assert joints.state() == ("stopped", "stop")
    joints.tick(msg.Velocity("a", 2.0), stopped="stop")
    assert joints.brain.take_notes()[-1] == ("warning", "Velocity refused: stopped: stop")
    assert joints.tick() == (msg.Idle("a"), msg.Idle("b"))
    assert joints.state() == ("ready", "")


def test_a_silent_motor_loses_its_target_and_the_other_goes_on() -> None:
    joints = TwoJoints()
    joints.tick(msg.Velocity("a", 2.0), msg.Velocity("b", 3.0))
    joints.silent = {"a"}
    for _ in range(12):
        commands = joints.tick()
    assert commands == (msg.Idle("a"), msg.Velocity("b", 3.0))
    assert joints.state() == ("degraded", "a: no feedback for more than 90 ms")
    joints.tick(msg.Velocity("a", 1.0))
    assert joints.brain.take_notes()[-1] == (
        "warning",
        "Velocity refused: a: no feedback for more than 90 ms",
    )
    joints.silent = set()
    assert joints.tick() == (msg.Idle("a"), msg.Velocity("b", 3.0))
    joints.silent = {"a", "b"}
    for _ in range(12):
        joints.tick()
    assert joints.state() == ("degraded", "a: no feedback for more than 90 ms")
    for _ in range(7):
        joints.tick()
    both = "a: no feedback for more than 90 ms; b: no feedback for more than 180 ms"
    assert joints.state() == ("stopped", both)
    assert joints.brain.take_notes()[-1] == ("error", f"stopped: {both}")


def test_a_joint_in_fault_loses_its_target() -> None:
    joints = TwoJoints()
    joints.tick(msg.Velocity("a", 2.0))
    assert joints.tick(state=msg.State("a", joints.now, Mode.FAULT, "STALL")) == (
        msg.Idle("a"),
        msg.Idle("b"),
    )
    assert joints.state() == ("degraded", "a is in fault: STALL")


def test_an_unknown_motor_is_refused_with_the_nearest_name() -> None:
    joints = TwoJoints()
    joints.tick()
    joints.tick(msg.Idle("aa"))
    note = "Idle refused: there is no motor 'aa'; there are a, b; did you mean 'a'?"
    assert joints.brain.take_notes()[-1] == ("warning", note)


def test_bare_joints_refuse_goals() -> None:
    joints = TwoJoints()
    joints.tick()
    joints.tick(msg.Goal(1.0, 1.0))
    note = "Goal refused: these are bare joints: there is no base to drive"
    assert joints.brain.take_notes()[-1] == ("warning", note)


def test_settings_of_bare_joints_change_too() -> None:
    joints = TwoJoints()
    joints.tick(msg.Velocity("a", 1.0))
    assert joints.brain.set("health.stand_age", 0.6) == ""
    joints.silent = {"a"}
    for _ in range(6):
        assert joints.tick()[0] == msg.Velocity("a", 1.0)
    assert joints.tick()[0] == msg.Idle("a")
