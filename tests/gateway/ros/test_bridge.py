"""The bridge with its process, and another participant: what is asked and refused, faults, what goes out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import gateway
from brain.belief import BrainState, MapView
from gateway.errors import UserError
from gateway.ros import actions, asked, bridge, graph, types
from gateway.ros.types import make
from protocols import messages as msg
from protocols.messages import SECOND, Drive, Goal, Position, Stop, Velocity
from tests.gateway.ros.judged import domain
from tests.gateway.ros.rig import ARRAY, LOG, TWIST, Rig, rig, twist
from tests.gateway.ros.test_asked import located
from tests.gateway.ros.test_trajectory import message, point

STOP = {f"/diffbot/{name}": graph.TRIGGER for name in graph.TRIGGERS}
TRIGGER = make(f"{graph.TRIGGER}_Request")


def said(peer: Any) -> list[str]:
    return [one.msg for one in peer.got["/rosout"]]


def drives(one: Rig) -> list[Drive]:
    return [each for each in one.asked if isinstance(each, Drive)]


def test_who_drives_and_what_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    with rig("diffbot", "cmd_vel_timeout_ms = 4000") as one:
        first = one.join(publishes={"/cmd_vel": TWIST}, subscribes={"/rosout": LOG}, calls=STOP)
        believed = one.session.gateway.belief
        monkeypatch.setattr(
            one.session.gateway, "belief", lambda: replace(believed(), state=BrainState.INITIALISING)
        )

        def says(text: str, each: Callable[[], None] | None = None) -> None:
            one.until(lambda: any(text in line for line in said(first)), f"the sentence {text!r}", each)

        says("not ready", lambda: first.publish("/cmd_vel", twist(0.1)))
        monkeypatch.setattr(one.session.gateway, "belief", believed)
        one.ready()
        assert not drives(one)

        # a NaN, and bytes of another type: nothing, but a sentence
        first.publish("/cmd_vel", twist(math.nan))
        says("not finite")
        first.publish_bytes("/cmd_vel", types.encode(make(ARRAY)))
        says("no geometry_msgs")
        assert not drives(one)

        # a flood, of 10 kHz and then less: one of each step counts, and a stop comes through
        def flood(count: int = 5) -> None:
            for x in range(count):
                first.publish("/cmd_vel", twist(0.001 + 0.001 * x))

        one.until(lambda: len(drives(one)) > 20, "driving", lambda: flood(50))
        assert one.most == 1
        second = one.join(flood, publishes={"/cmd_vel": TWIST})  # or the first is silent for too long
        before = len(drives(one))
        second.publish("/cmd_vel", twist(0.3))
        says("another publisher", flood)
        assert Drive(0.3, 0.0) not in drives(one)
        assert len(drives(one)) > before
        for _ in range(100):  # a flood of requests, before it
            first.call("/diffbot/clear_faults", TRIGGER)
        first.call("/diffbot/stop", TRIGGER)
        one.until(lambda: first.got["/diffbot/stop"], "an answer to a stop", flood)
        answers = first.got["/diffbot/clear_faults"]
        one.until(lambda: any(each.message.startswith("too many requests") for each in answers), "a refusal")
        assert 0 < sum(each.success for each in answers) <= 60
        assert first.got["/diffbot/stop"][0].success
        assert Stop("asked for in ROS 2") in one.asked
        says("/cmd_vel: stopped", flood)

        # released, it must let go first
        before = len(drives(one))
        one.run(100, flood)
        first.call("/diffbot/release", TRIGGER)
        one.until(lambda: first.got["/diffbot/release"], "an answer to a release", flood)
        assert first.got["/diffbot/release"][0].success
        says("let go first", flood)
        assert len(drives(one)) == before
        first.publish("/cmd_vel", twist())
        held = one.bridge._held["/cmd_vel"]
        one.until(lambda: not held.barred, "letting go")  # of two in a step the newest counts

        # a person comes first
        first.publish("/cmd_vel", twist(0.1))
        one.until(lambda: drives(one)[before:] == [Drive(0.1, 0.0)], "driving again")
        monkeypatch.setattr(asked, "PERSON", 3600 * SECOND)  # a machine may be busy: what comes may come late
        one.persons.append(Drive(0.05, 0.0))
        one.run(1)
        first.publish("/cmd_vel", twist(0.1))
        says("a person has the robot")
        assert drives(one)[before:] == [Drive(0.1, 0.0)]

        # silence
        monkeypatch.setattr(asked, "PERSON", 0)
        one.run(850)
        first.publish("/cmd_vel", twist(0.15))
        one.until(lambda: drives(one)[-1] == Drive(0.15, 0.0), "driving again")
        one.until(lambda: drives(one)[-1] == Drive(0.0, 0.0), "the end of it")
        says("silent for 4000 ms")

        # another type, and a clock that is of another century
        third = one.join(publishes={"/cmd_vel": graph.TWIST_STAMPED})
        header = make("std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", sec=2**31 - 1))
        third.publish("/cmd_vel", make(graph.TWIST_STAMPED, header=header, twist=twist(0.12)))
        one.until(lambda: Drive(0.12, 0.0) in drives(one), "driving by it")


def test_of_maps_that_come_fast_one_a_second_is_planned_on_and_the_newest_in_the_end() -> None:
    kind, sent = "nav_msgs/msg/OccupancyGrid", 0
    with rig("diffbot", perceives="given = true") as one:
        peer = one.join(publishes={"/map": kind})
        one.ready()

        def publish() -> None:
            nonlocal sent
            sent += 1
            turn = make("geometry_msgs/msg/Quaternion", w=1.0)
            origin = make("geometry_msgs/msg/Pose", orientation=turn)
            origin.position.x = 0.001 * sent
            info = make("nav_msgs/msg/MapMetaData", resolution=0.05, width=2, height=1, origin=origin)
            header = make("std_msgs/msg/Header", frame_id="map")
            peer.publish("/map", make(kind, header=header, info=info, data=np.zeros(2, np.int8)))

        for _ in range(50):  # 2.5 s
            one.run(1, publish)
            one.run(9)
        newest = pytest.approx(0.001 * sent)
        one.until(
            lambda: [each for each in one.asked if isinstance(each, msg.Grid)][-1].x == newest, "the newest"
        )
        one.run(300)
        grids = [each for each in one.asked if isinstance(each, msg.Grid)]
        assert 2 <= len(grids) <= 4
        assert grids[-1].x == newest


def test_a_shaft_is_zeroed_by_a_service_that_answers_when_it_is() -> None:
    calls = {f"/bench/{name}/zero": graph.TRIGGER for name in ("left", "right")}
    with rig("bench") as one:
        peer = one.join(calls=calls, publishes={"/velocity_controller/commands": ARRAY})
        one.ready()
        joint = one.session.joints["left"]
        drive = lambda: peer.publish("/velocity_controller/commands", make(ARRAY, data=np.array([3.0, 0.0])))  # noqa: E731
        one.until(lambda: (joint.feedback.position or 0.0) > 0.5, "a turn", drive)
        peer.call("/bench/left/zero", TRIGGER)
        answers = one.until(lambda: peer.got["/bench/left/zero"], "an answer", drive)
        assert not answers[0].success, "a shaft that is driven is not zeroed"
        assert answers[0].message
        one.until(lambda: one.asked[-1] == Velocity("right", 0.0), "rest")
        one.persons.extend(msg.Idle(name) for name in one.session.joints)
        one.run(100)
        one.until(lambda: abs(joint.feedback.velocity or 0.0) < 0.01, "a shaft at rest")
        assert abs(joint.feedback.position or 0.0) > 0.4
        peer.call("/bench/left/zero", TRIGGER)
        peer.call("/bench/right/zero", TRIGGER)
        one.until(lambda: len(answers) == 2 and peer.got["/bench/right/zero"], "answers")
        assert answers[1].success, answers[1].message
        assert joint.feedback.position == pytest.approx(0.0, abs=0.02)
        assert {msg.Zero("left"), msg.Zero("right")} <= set(one.asked)


def test_joints_by_arrays_and_trajectories() -> None:
    with rig("bench") as one:
        names = {"/velocity_controller/commands": ARRAY, graph.TRAJECTORIES: graph.TRAJECTORY}
        peer = one.join(
            publishes=names, subscribes={"/rosout": LOG, "/joint_states": "sensor_msgs/msg/JointState"}
        )
        one.ready()
        peer.publish("/velocity_controller/commands", make(ARRAY, data=np.array([1.0, -2.0])))
        one.until(lambda: Velocity("right", -2.0) in one.asked, "a velocity")
        one.until(lambda: one.asked[-1] == Velocity("right", 0.0), "its end, by silence")
        one.run(100)
        at = {name: joint.feedback.position or 0.0 for name, joint in one.session.joints.items()}
        goal = {name: position + 0.5 for name, position in at.items()}
        peer.publish(graph.TRAJECTORIES, message(list(goal), point(0.5, *goal.values())))
        one.until(lambda: Position("left", goal["left"]) in one.asked, "the end of a trajectory")
        one.run(200)
        for name, position in goal.items():
            assert one.session.joints[name].feedback.position == pytest.approx(position, abs=0.02)

        def states_are_there() -> bool:
            state = peer.got["/joint_states"][-1]
            there = dict(zip(state.name, state.position.tolist(), strict=True))
            return there == pytest.approx(goal, abs=0.02)

        one.until(states_are_there, "the goal in the states of the joints")
        peer.publish(graph.TRAJECTORIES, message(["elbow"], point(0.5, 1.0)))
        one.until(lambda: any("no joint 'elbow'" in text for text in said(peer)), "a refusal")


NAVIGATE, FOLLOW = "/navigate_to_pose/_action", "/joint_trajectory_controller/follow_joint_trajectory/_action"


def calls_of(name: str, type_: str) -> dict[str, Any]:
    services = {
        "send_goal": f"{type_}_SendGoal",
        "get_result": f"{type_}_GetResult",
        "cancel_goal": graph.CANCEL,
    }
    return {
        "calls": {f"{name}/{service}": kind for service, kind in services.items()},
        "subscribes": {f"{name}/feedback": f"{type_}_FeedbackMessage", f"{name}/status": graph.STATUSES},
    }


def uuid(number: int) -> Any:
    return make("unique_identifier_msgs/msg/UUID", uuid=np.full(16, number, np.uint8))


def statuses(peer: Any, name: str) -> list[int]:
    return [one.status for one in peer.got[f"{name}/status"][-1].status_list]


def send(one: Rig, peer: Any, name: str, type_: str, number: int, **goal: Any) -> bool:
    before = len(peer.got[f"{name}/send_goal"])
    content = make(f"{type_}_Goal", **goal)
    peer.call(f"{name}/send_goal", make(f"{type_}_SendGoal_Request", goal_id=uuid(number), goal=content))
    peer.call(f"{name}/get_result", make(f"{type_}_GetResult_Request", goal_id=uuid(number)))
    one.until(lambda: len(peer.got[f"{name}/send_goal"]) > before, "an answer to a goal")
    return bool(peer.got[f"{name}/send_goal"][-1].accepted)


def goal_of(one: Rig) -> Goal | None:
    return one.session.belief.goal


def stamped(x: float, y: float, frame: str = "map") -> Any:
    place = make("geometry_msgs/msg/Point", x=x, y=y)
    turned = make("geometry_msgs/msg/Quaternion", w=1.0)
    pose = make("geometry_msgs/msg/Pose", position=place, orientation=turned)
    return make(
        "geometry_msgs/msg/PoseStamped", header=make("std_msgs/msg/Header", frame_id=frame), pose=pose
    )


def test_a_goal_is_reached_replaced_cancelled_and_ended_by_a_stop() -> None:
    with rig("diffbot") as one:
        peer = one.join(**calls_of(NAVIGATE, graph.NAVIGATE))
        one.ready()
        results = peer.got[f"{NAVIGATE}/get_result"]
        assert not send(one, peer, NAVIGATE, graph.NAVIGATE, 1, pose=stamped(1.0, 0.0, "odom"))
        assert [result.status for result in one.until(lambda: results, "a result")] == [actions.UNKNOWN]
        assert send(one, peer, NAVIGATE, graph.NAVIGATE, 2, pose=stamped(0.25, 0.0))
        one.until(lambda: len(results) == 2, "a result")
        assert (results[1].status, results[1].result.error_code) == (actions.SUCCEEDED, 0)
        pose = one.session.pose
        assert pose is not None
        assert math.dist((pose.x, pose.y), (0.25, 0.0)) < 0.15
        far = [feedback.feedback.distance_remaining for feedback in peer.got[f"{NAVIGATE}/feedback"]]
        assert far[-1] < far[0] < 0.7

        assert send(one, peer, NAVIGATE, graph.NAVIGATE, 3, pose=stamped(2.0, 0.0))
        assert not send(one, peer, NAVIGATE, graph.NAVIGATE, 3, pose=stamped(2.0, 0.0)), "an id is used once"
        one.run(100)
        assert send(one, peer, NAVIGATE, graph.NAVIGATE, 4, pose=stamped(1.0, 0.0))
        one.until(lambda: len(results) == 4, "the result of what was replaced, for both who asked")
        assert {result.status for result in results[2:]} == {actions.ABORTED}
        one.run(100)
        assert goal_of(one)
        info = make("action_msgs/msg/GoalInfo", goal_id=uuid(4))
        peer.call(f"{NAVIGATE}/cancel_goal", make(f"{graph.CANCEL}_Request", goal_info=info))
        one.until(lambda: len(results) == 5, "the result of what was cancelled")
        assert results[4].status == actions.CANCELED
        assert peer.got[f"{NAVIGATE}/cancel_goal"][0].return_code == 0
        one.run(20)
        assert not goal_of(one)
        peer.call(f"{NAVIGATE}/cancel_goal", make(f"{graph.CANCEL}_Request", goal_info=info))
        one.until(lambda: len(peer.got[f"{NAVIGATE}/cancel_goal"]) == 2, "an answer")
        assert peer.got[f"{NAVIGATE}/cancel_goal"][1].return_code == actions.TERMINATED

        assert send(one, peer, NAVIGATE, graph.NAVIGATE, 5, pose=stamped(2.0, 0.0))
        one.run(50)
        one.persons.append(Stop("a button"))
        one.until(lambda: len(results) == 6, "the result of what was stopped")
        assert results[5].status == actions.ABORTED
        assert "a button" in results[5].result.error_msg or "a person" in results[5].result.error_msg
        one.until(lambda: statuses(peer, NAVIGATE) == [4, 6, 5, 6], "their states")

        one.persons.append(msg.Release())
        one.run(20)
        assert send(one, peer, NAVIGATE, graph.NAVIGATE, 6, pose=stamped(2.0, 0.0))
        one.run(50)
        one.persons.append(Drive(0.0, 0.3))
        one.until(lambda: len(results) == 7, "the result of what a person took over")
        assert (results[6].status, results[6].result.error_msg) == (actions.ABORTED, "manual driving")
        one.run(10)
        one.persons.append(Goal(0.3, 0.3))
        one.until(lambda: goal_of(one) == Goal(0.3, 0.3), "a person's goal, which nothing of ours drops")
        one.run(50)
        assert goal_of(one) == Goal(0.3, 0.3)


def test_a_trajectory_succeeds_and_one_that_is_left_behind_does_not() -> None:
    with rig("bench") as one:
        peer = one.join(**calls_of(FOLLOW, graph.FOLLOW))
        one.ready()
        results = peer.got[f"{FOLLOW}/get_result"]
        assert not send(one, peer, FOLLOW, graph.FOLLOW, 1, trajectory=message(["x"], point(1.0, 1.0)))
        assert send(one, peer, FOLLOW, graph.FOLLOW, 2, trajectory=message(["left"], point(0.6, 0.5)))
        one.until(lambda: len(results) == 2, "a result")
        assert (results[1].status, results[1].result.error_code) == (actions.SUCCEEDED, 0)
        desired = [m.feedback.desired.positions[0] for m in peer.got[f"{FOLLOW}/feedback"]]
        assert desired == sorted(desired)
        tolerance = make("control_msgs/msg/JointTolerance", name="left", position=0.05)
        fast = message(["left"], point(0.1, 40.0))  # 400 rad/s, where 20 are allowed
        assert send(one, peer, FOLLOW, graph.FOLLOW, 3, trajectory=fast, path_tolerance=[tolerance])
        one.until(lambda: len(results) == 3, "a result")
        assert (results[2].status, results[2].result.error_code) == (actions.ABORTED, -4)
        assert "off its path" in results[2].result.error_string


def test_parameters_are_read_and_set() -> None:
    with rig("bench") as one:
        names = ("list_parameters", "get_parameters", "get_parameter_types", "describe_parameters")
        names += ("set_parameters", "set_parameters_atomically")  # type: ignore[assignment]
        peer = one.join(calls={f"/bench/{name}": graph.PARAMETERS[name] for name in names})

        def call(name: str, **fields: Any) -> Any:
            before = len(peer.got[f"/bench/{name}"])
            peer.call(f"/bench/{name}", make(f"{graph.PARAMETERS[name]}_Request", **fields))
            one.until(lambda: len(peer.got[f"/bench/{name}"]) > before, name)
            return peer.got[f"/bench/{name}"][-1]

        def parameter(name: str, value: float) -> Any:
            made = make("rcl_interfaces/msg/ParameterValue", type=3, double_value=value)
            return make("rcl_interfaces/msg/Parameter", name=name, value=made)

        key = "left.limits.torque"
        assert key in call("list_parameters").result.names
        assert call("list_parameters", prefixes=["left"], depth=3).result.names[0].startswith("left.")
        assert call("list_parameters", prefixes=["none"]).result.names == []
        assert call("get_parameter_types", names=[key, "none"]).types.tolist() == [3, 0]
        described = call("describe_parameters", names=[key]).descriptors[0]
        assert described.floating_point_range[0].to_value == 2.0
        results = call("set_parameters", parameters=[parameter(key, 1.0), parameter("none", 1.0)]).results
        assert [one_.successful for one_ in results] == [True, False]
        one.run(3)
        assert [one_.double_value for one_ in call("get_parameters", names=[key]).values] == [1.0]
        result = call(
            "set_parameters_atomically", parameters=[parameter(key, 0.5), parameter("none", 1.0)]
        ).result
        assert (result.successful, "none" in result.reason) == (False, True)
        one.run(3)
        assert one.session.joints["left"].settings.limits.torque == 1.0
        assert msg.Set(key, 1.0) in one.asked


def test_a_large_map_and_what_is_latched() -> None:
    with rig("diffbot") as one:
        one.ready()
        belief = one.session.belief
        tiles = {(y, x): np.full((64, 64), (x + y) % 3 - 1, np.int8) for y in range(12) for x in range(10)}
        view = MapView(1, 0.05, tiles, unit=2.0)
        one.session.gateway.belief = lambda: replace(belief, map=view)  # type: ignore[method-assign]
        latched = {"/map": "nav_msgs/msg/OccupancyGrid", "/tf_static": "tf2_msgs/msg/TFMessage"}
        peers = [one.join(subscribes=latched) for _ in range(2)]  # who comes later, too
        one.until(lambda: all(peer.got["/map"] and peer.got["/tf_static"] for peer in peers), "a map")
        for peer in peers:
            grid = peer.got["/map"][-1]
            assert (grid.info.height, grid.info.width) == (768, 640)
            assert set(grid.data.tolist()) == {12, 88, -1}
            frames = {each.child_frame_id for each in peer.got["/tf_static"][0].transforms}
            assert frames == set(one.session.robot.sensors)


def test_who_says_where_the_robot_is() -> None:
    """Believed at once, also while it is stopped; what is absurd is refused in words."""
    kinds = {"/initialpose": graph.POSE_KNOWN, "/goal_pose": graph.POSE_STAMPED}
    with rig("diffbot") as one:
        peer = one.join(publishes=kinds, subscribes={"/rosout": LOG})
        one.ready()
        peer.publish("/goal_pose", stamped(2.0, 0.0))
        one.until(lambda: one.session.belief.path, "a path")
        here = one.session.pose
        assert here is not None
        peer.publish("/initialpose", located({0: -0.25, 35: 0.07}, here.x))
        one.until(lambda: any("its covariance is none" in text for text in said(peer)), "a refusal")
        peer.publish("/initialpose", located({0: 1e12, 7: 0.25, 35: 0.07}, here.x))
        one.until(lambda: any("1e+06 m: 0.001 to 5 m" in text for text in said(peer)), "the brain's refusal")
        assert not any("told that" in text for text in said(peer))
        version = one.session.belief.path_version
        peer.publish("/initialpose", located({0: 0.04, 7: 0.04, 35: 0.01}, here.x))
        one.until(lambda: any("told that it is at" in text for text in said(peer)), "a note")
        told = next(each for each in one.asked if isinstance(each, msg.Locate) and each.sigma < 1.0)
        assert (told.x, told.y, told.yaw) == pytest.approx((here.x, 2.0, 1.0))
        one.until(lambda: one.session.belief.path_version > version, "another path")
        one.persons.append(Stop("a button"))
        one.until(lambda: one.session.belief.state is BrainState.STOPPED, "a stop")
        before = len(one.asked)
        peer.publish("/initialpose", located({}, 0.5))
        one.until(lambda: any(isinstance(each, msg.Locate) for each in one.asked[before:]), "another place")


def test_a_flood_of_reasons_is_said_and_not_for_ever() -> None:
    with rig("diffbot") as one:
        peer = one.join(publishes={"/cmd_vel": TWIST}, subscribes={"/rosout": LOG})
        one.ready()

        def reasons() -> list[str]:
            return [text for text in said(peer) if "encapsulation" in text]

        def wrong(number: int) -> None:
            before = len(reasons())
            peer.publish_bytes("/cmd_vel", bytes((0, 64 + number)) + bytes(50))
            one.until(lambda: len(reasons()) > before, "another reason")

        for number in range(bridge.MOST_REASONS):
            wrong(number)
        for known in (32, 64):
            peer.publish_bytes("/cmd_vel", bytes((0, known)) + bytes(50))
            one.run(50)
        assert len(reasons()) == bridge.MOST_REASONS
        peer.publish("/cmd_vel", twist(0.1))
        one.until(lambda: drives(one), "driving")
        wrong(0)


def test_its_process_dies_and_the_robot_runs_on() -> None:
    with gateway.open_session("bench", simulated=True) as session:
        session.ros(domain=domain())
        ticks = session.run(seconds=1.0)
        next(ticks)
        assert session._ros is not None
        session._ros._bridge._held["/cmd_vel"].moves = True
        done: list[object] = []
        session.watch(lambda tick, _: done.extend(tick.inputs.instructions))
        process = session._ros._bridge._process
        assert process is not None
        process.kill()
        process.wait()
        assert sum(1 for _ in ticks) > 150
        assert getattr(session, "_ros", 0) is None
        assert Drive(0.0, 0.0) in done, "what was held has ended"


@pytest.mark.parametrize("address", ["203.0.113.7", "127.0.0.1"])
def test_a_network_that_cannot_be_opened_is_said(address: str) -> None:
    with gateway.open_session("bench", simulated=True) as session:
        if address == "127.0.0.1":
            assert session.ros(domain=domain()).startswith(f"/bench in domain {domain()}, at 127.0.0.1:")
            session.close_ros()
            return
        with pytest.raises(UserError, match=r"203.0.113.7 cannot be opened"):
            session.ros(address, domain=domain())
        with pytest.raises(UserError, match="expected an address of this machine, or an interface"):
            session.ros("nowhere0")


def test_goal_by_topic_replaces_what_it_does() -> None:
    with rig("diffbot") as one:
        peer = one.join(
            publishes={"/goal_pose": graph.POSE_STAMPED}, subscribes={"/plan": "nav_msgs/msg/Path"}
        )
        one.ready()
        peer.publish("/goal_pose", stamped(5.6, 1.0))  # so far that it is not there when the next one comes
        one.until(lambda: one.session.belief.goal, "a goal")
        peer.publish("/goal_pose", stamped(1.0, 0.5))
        one.until(lambda: one.session.belief.goal == Goal(1.0, 0.5, 0.0), "another")
        assert msg.Drop() in one.asked
        assert one.until(lambda: [p for p in peer.got["/plan"] if p.poses], "a plan")
