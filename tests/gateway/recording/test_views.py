"""What others see: the right numbers in the right fields, thinned out, the same every time."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from brain.belief import Belief, BrainState, Estimate, MapView, Pose
from brain.perception.mount import Mount
from gateway.core.tick import Inputs, Note, Outputs, Tick
from gateway.recording import ros_messages
from gateway.recording.ros_views import ViewMessage, Views, topic_name, typestore
from protocols.frames import CanFrame, Packet
from protocols.messages import (
    MILLISECOND,
    SECOND,
    Done,
    Event,
    Fault,
    Feedback,
    Fix,
    Goal,
    Imu,
    LaserScan,
    Mode,
    Nanos,
    PoseReading,
    State,
)
from tests.gateway import little

T = 3 * SECOND + 7
BELIEF = little.bare_belief()


def tick(*events: Event, now: Nanos = T, received: Any = (), sent: Any = (), notes: Any = ()) -> Tick:
    return Tick(0, now, Inputs((), tuple(received)), Outputs(tuple(sent), events, tuple(notes)))


def shown(made: Tick, belief: Belief = BELIEF, views: Views | None = None) -> dict[str, Any]:
    """The messages of one tick by topic (the last of each), read back by rosbags."""
    views = views or Views()
    return {view.topic: views.deserialise(view) for view in views.messages(made, belief)}


def at(message: Any) -> tuple[Nanos, str]:
    return message.header.stamp.sec * SECOND + message.header.stamp.nanosec, message.header.frame_id


def believing(t: Nanos = T, **changes: Any) -> Belief:
    covariance = np.array([[1.0, 2.0, 3.0], [2.0, 5.0, 6.0], [3.0, 6.0, 9.0]])
    estimate = Estimate(
        t, Pose(1.0, 2.0, math.pi / 2), 0.4, -0.3, covariance, odom=Pose(3.0, -1.0, -math.pi / 2)
    )
    return replace(BELIEF, state=BrainState.RUNNING, estimate=estimate, **changes)


# -- frames ------------------------------------------------------------------------------------


def test_a_classic_frame() -> None:
    packet = Packet(T - 5, "can0", CanFrame(0x18DAF110, b"\x01\x02\x03", extended=True))
    message = shown(tick(received=[packet]))["/can0/from_can_bus"]
    assert at(message) == (T - 5, "can0")
    assert (message.id, message.is_extended, message.is_rtr, message.is_error) == (
        0x18DAF110,
        True,
        False,
        False,
    )
    assert (message.dlc, message.data.tolist()) == (3, [1, 2, 3, 0, 0, 0, 0, 0])


def test_a_remote_frame() -> None:
    message = shown(tick(sent=[Packet(T, "can0", CanFrame(5, remote=True, requested=4))]))["/can0/to_can_bus"]
    assert (message.is_rtr, message.dlc) == (True, 4)


def test_an_fd_frame() -> None:
    data = bytes(range(48))
    message = shown(tick(sent=[Packet(T, "fd 1", CanFrame(5, data, fd=True))]))["/fd_1/to_can_bus_fd"]
    assert (message.id, message.len, message.data.tobytes()) == (5, 48, data)


def test_serial_bytes_stand_in_the_tick_only() -> None:
    assert set(shown(tick(received=[Packet(T, "tty", b"abc")]))) == {"/diagnostics"}


@pytest.mark.parametrize(
    ("name", "topic"), [("can0", "can0"), ("a-b c", "a_b_c"), ("1st", "_1st"), ("", "_")]
)
def test_topic_names_are_legal(name: str, topic: str) -> None:
    assert topic_name(name) == topic


# -- sensors -----------------------------------------------------------------------------------


def test_a_scan() -> None:
    message = shown(tick(little.scan(T - 9)))["/scan"]
    assert at(message) == (T - 9, "lidar")
    assert message.angle_min == np.float32(-math.pi)
    assert message.angle_increment == np.float32(2 * math.pi / 360)
    assert message.angle_max == pytest.approx(math.pi - 2 * math.pi / 360, abs=1e-6)
    assert (message.range_min, message.range_max) == (np.float32(0.1), 10.0)
    assert message.ranges[:4].tolist() == [0.0, math.inf, math.inf, 1.0]
    assert len(message.ranges) == 360
    assert len(message.intensities) == 0


def test_the_beams_of_a_sweep_are_evenly_spaced_in_time() -> None:
    message = shown(tick(replace(little.scan(T), duration=359 * 250_000)))["/scan"]
    assert message.time_increment == np.float32(250e-6)


def test_an_empty_scan() -> None:
    message = shown(tick(LaserScan("lidar", T, 0.5, 0.1, 0.1, 10.0, ())))["/scan"]
    assert (message.angle_max, len(message.ranges)) == (0.5, 0)


def test_an_imu_without_and_with_orientation() -> None:
    without = shown(tick(Imu("imu", T, (1.0, 2.0, 3.0), (4.0, 5.0, 9.81))))["/imu/data"]
    assert at(without) == (T, "imu")
    assert (without.angular_velocity.x, without.linear_acceleration.z) == (1.0, 9.81)
    assert without.orientation_covariance[0] == -1.0
    given_ = Imu("imu", T, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0, 0.0, 0.6, 0.8))
    with_ = shown(tick(given_))["/imu/data"]
    assert (with_.orientation.z, with_.orientation.w, with_.orientation_covariance[0]) == (0.6, 0.8, 0.0)


def test_a_fix_without_and_with_variance() -> None:
    without = shown(tick(Fix("gps", T, 50.0, 8.0)))["/fix"]
    assert math.isnan(without.altitude)
    assert without.position_covariance_type == 0
    with_ = shown(tick(Fix("gps", T, 50.0, 8.0, 120.0, 2.5)))["/fix"]
    assert (with_.latitude, with_.longitude, with_.altitude) == (50.0, 8.0, 120.0)
    assert with_.position_covariance.tolist() == [2.5, 0, 0, 0, 2.5, 0, 0, 0, 0]
    assert with_.position_covariance_type == 1


def test_a_pose_reading_without_and_with_yaw() -> None:
    without = shown(tick(PoseReading("markers", T, 1.0, 2.0)))["/pose"]
    assert (without.pose.pose.position.x, without.pose.pose.position.y) == (1.0, 2.0)
    assert without.pose.covariance[[0, 7, 35]].tolist() == [0.0, 0.0, 1e9]
    with_ = shown(tick(PoseReading("markers", T, 1.0, 2.0, math.pi / 2, 0.01, 0.04)))["/pose"]
    assert with_.pose.pose.orientation.z == pytest.approx(math.sin(math.pi / 4))
    assert with_.pose.covariance[[0, 7, 35]].tolist() == [0.01, 0.01, 0.04]


def test_joint_states_hold_the_last_values_of_each_motor() -> None:
    views = Views()
    first = shown(tick(Feedback("left", T, position=1.0, velocity=2.0)), views=views)["/joint_states"]
    assert (first.name, first.position.tolist(), first.velocity.tolist()) == (["left"], [1.0], [2.0])
    assert first.effort.tolist() == [], "not measured"
    later = tick(Feedback("right", T, torque=0.5), Feedback("left", T, velocity=3.0), now=T + SECOND)
    second = shown(later, views=views)["/joint_states"]
    assert second.name == ["left", "right"]
    assert second.velocity[0] == 3.0
    assert second.position[0] == 1.0
    assert math.isnan(second.position[1])
    assert math.isnan(second.effort[0])
    assert second.effort[1] == 0.5


# -- belief ------------------------------------------------------------------------------------


def test_a_battery_is_the_voltage_that_motors_measure() -> None:
    views = Views(wanted={"/battery_state"})
    measured = [Feedback("left", T, voltage=24.0), Feedback("right", T, voltage=23.0)]
    state = shown(tick(*measured), views=views)["/battery_state"]
    assert (state.voltage, state.present, at(state)[0]) == (23.5, True, T)
    assert math.isnan(state.percentage)
    assert math.isnan(state.current)
    assert "/battery_state" not in shown(tick(now=T + SECOND // 2), views=views), "once a second"
    assert "/battery_state" not in shown(tick(*measured)), "recordings have none"


def test_times_of_another_clock() -> None:
    epoch = 1_700_000_000 * SECOND
    views = Views({"lidar": Mount()}, epoch=epoch)
    scan = LaserScan("lidar", T - 5, -1.0, 0.5, 0.1, 10.0, (1.0,))
    made = shown(tick(scan, Feedback("left", T, position=1.0)), believing(T - 3), views)
    assert at(made["/scan"])[0] == epoch + T - 5
    assert at(made["/odom"])[0] == at(made["/estimate"])[0] == epoch + T - 3
    assert {at(one)[0] for one in made["/tf"].transforms} == {epoch + T - 3}
    assert at(made["/joint_states"])[0] == at(made["/tf_static"].transforms[0])[0] == epoch + T


def test_odometry_and_tf() -> None:
    message = shown(tick(), believing(T - 3))["/odom"]
    assert (*at(message), message.child_frame_id) == (T - 3, "odom", "base_link")
    assert (message.pose.pose.position.x, message.pose.pose.position.y) == (3.0, -1.0)
    assert not message.pose.covariance.any()
    assert (message.twist.twist.linear.x, message.twist.twist.angular.z) == (0.4, -0.3)
    message = shown(tick(), believing(T - 3))["/estimate"]
    assert at(message) == (T - 3, "map")
    pose = message.pose.pose
    assert (pose.position.x, pose.position.y, pose.position.z) == (1.0, 2.0, 0.0)
    assert (pose.orientation.z, pose.orientation.w) == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))
    covariance = message.pose.covariance.reshape(6, 6)
    assert covariance[np.ix_([0, 1, 5], [0, 1, 5])].tolist() == [[1, 2, 3], [2, 5, 6], [3, 6, 9]]
    assert covariance.sum() == 37
    base, odom = shown(tick(), believing(T - 3))["/tf"].transforms
    assert (*at(base), base.child_frame_id) == (T - 3, "odom", "base_link")
    assert (base.transform.translation.x, base.transform.rotation.w) == (3.0, math.sqrt(0.5))
    assert (*at(odom), odom.child_frame_id) == (T - 3, "map", "odom")
    place, turn = odom.transform.translation, odom.transform.rotation
    assert (abs(turn.z), turn.w) == pytest.approx((1.0, 0.0), abs=1e-12)  # half a turn
    assert (place.x + -3.0, place.y + 1.0) == pytest.approx((1.0, 2.0))


def test_the_wheels_alone_beside_it() -> None:
    message = shown(tick(), believing(raw=Pose(3.0, 4.0, 0.0)))["/wheel_odom"]
    assert (message.pose.pose.position.x, message.pose.pose.position.y) == (3.0, 4.0)
    assert "/wheel_odom" not in shown(tick(), believing())


def test_the_map() -> None:
    odds = np.array([[0.0, -20.0, 20.0], [math.log(3), -0.0, 1e-6]], np.float32)
    message = shown(tick(), replace(BELIEF, map=MapView(1, 0.05, {(0, 0): odds}, corner=(-1.0, -2.0))))[
        "/map"
    ]
    assert at(message) == (T, "map")
    assert (message.info.width, message.info.height) == (3, 2)
    assert message.info.resolution == np.float32(0.05)
    assert (message.info.origin.position.x, message.info.origin.position.y) == (-1.0, -2.0)
    assert message.data.tolist() == [-1, 0, 100, 75, -1, 50]


def test_the_map_comes_with_a_new_version_at_most_once_a_second() -> None:
    views, sent = Views(), []
    for i in range(100):
        view = MapView(i // 3, 0.05, {(0, 0): np.zeros((2, 2), np.float32)})
        now = i * 100 * MILLISECOND
        if "/map" in shown(tick(now=now), replace(BELIEF, map=view), views):
            sent.append(now)
    assert sent == [n * SECOND for n in range(10)]
    last = replace(BELIEF, map=view)
    assert "/map" in shown(tick(now=98 * SECOND), last, views)
    assert "/map" not in shown(tick(now=99 * SECOND), last, views), "no new version"


def test_the_plan_and_the_goal_come_on_change() -> None:
    views = Views()
    assert not {"/plan", "/goal_pose"} & set(shown(tick(), BELIEF, views))
    path = ((0.0, 0.0), (0.0, 2.0), (2.0, 2.0))
    wanting = replace(BELIEF, goal=Goal(2.0, 2.0), path=path, path_version=1)
    made = shown(tick(), wanting, views)
    assert [(p.pose.position.x, p.pose.position.y) for p in made["/plan"].poses] == list(path)
    yaws = [2 * math.atan2(p.pose.orientation.z, p.pose.orientation.w) for p in made["/plan"].poses]
    assert yaws == pytest.approx([math.pi / 2, 0.0, 0.0])
    assert (made["/goal_pose"].pose.position.x, made["/goal_pose"].header.frame_id) == (2.0, "map")
    assert not {"/plan", "/goal_pose"} & set(shown(tick(), wanting, views))
    gone = shown(tick(), replace(BELIEF, path_version=2), views)
    assert gone["/plan"].poses == []
    assert "/goal_pose" not in gone
    assert "/goal_pose" in shown(tick(), wanting, views), "the same goal again"


MOUNTS = [
    Mount(0.1, 0.2, 0.3),
    Mount(yaw=1.0),
    Mount(pitch=-0.4),
    Mount(roll=math.pi),
    Mount(yaw=2.0, pitch=0.5, roll=-1.0),
]


@pytest.mark.parametrize("mount", MOUNTS)
def test_static_transforms_turn_as_the_mount_does(mount: Mount) -> None:
    views = Views({"lidar": mount})
    (transform,) = shown(tick(), views=views)["/tf_static"].transforms
    assert (*at(transform), transform.child_frame_id) == (T, "base_link", "lidar")
    moved = transform.transform.translation
    assert (moved.x, moved.y, moved.z) == (mount.x, mount.y, mount.z)
    q = transform.transform.rotation
    for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
        assert _turn((q.x, q.y, q.z, q.w), axis) == pytest.approx(mount.rotate(axis), abs=1e-12)
    assert "/tf_static" not in shown(tick(now=T + SECOND), views=views), "once"


def _turn(q: tuple[float, float, float, float], v: tuple[float, float, float]) -> tuple[float, ...]:
    """v turned by q: v + 2 u × (u × v + w v)."""
    u, w = np.array(q[:3]), q[3]
    return tuple(np.array(v) + 2 * np.cross(u, np.cross(u, v) + w * np.array(v)))


# -- how it is ---------------------------------------------------------------------------------


def statuses(made: dict[str, Any]) -> dict[str, tuple[int, str]]:
    return {s.name: (s.level, s.message) for s in made["/diagnostics"].status}


def test_diagnostics_show_brain_motors_and_notes() -> None:
    views = Views()
    belief = replace(
        BELIEF, state=BrainState.DEGRADED, reason="no scan", rejected={"lidar": 3, "imu": 0}, reached=2
    )
    made = shown(
        tick(
            State("left", T, Mode.ARMED, "CLOSED_LOOP"),
            State("right", T, Mode.OFFLINE),
            Feedback("left", T, voltage=24.5, temperature=40.0, current=1.5),
            Fault("left", T, 5, "DRV_FAULT", "short", "look"),
            notes=[Note("warning", "lidar", "silent")],
        ),
        belief,
        views,
    )
    assert statuses(made) == {
        "/gateway/brain": (1, "degraded: no scan"),
        "/gateway/motors/left": (2, "armed: CLOSED_LOOP; faults: DRV_FAULT"),
        "/gateway/motors/right": (3, "offline"),
        "/gateway/notes/lidar": (1, "silent"),
    }
    values = [{v.key: v.value for v in s.values} for s in made["/diagnostics"].status]
    assert values[0] == {"rejected imu": "0", "rejected lidar": "3", "goals reached": "2"}
    assert values[1] == {"current [A]": "1.5", "voltage [V]": "24.5", "temperature [degC]": "40.0"}
    cleared = shown(tick(Done(T, "ClearFault", "left")), belief, views)
    assert statuses(cleared)["/gateway/motors/left"] == (0, "armed: CLOSED_LOOP")


@pytest.mark.parametrize(("level", "number"), [("info", 20), ("warning", 30), ("error", 40)])
def test_notes_reach_the_log(level: Any, number: int) -> None:
    message = shown(tick(notes=[Note(level, "left", "it is späte \udcff")]))["/rosout"]
    assert (message.level, message.name, message.msg) == (number, "left", "it is späte \\udcff")


def test_thinning() -> None:
    """5 s at 200 Hz: belief at 50 Hz, diagnostics at 2 Hz, and at once on a change of state."""
    views, count = Views(), dict.fromkeys(("/odom", "/tf", "/estimate", "/joint_states", "/diagnostics"), 0)
    for i in range(1000):
        now = i * 5 * MILLISECOND
        for topic in shown(tick(Feedback("left", now, 1.0), now=now), believing(now), views):
            count[topic] += 1
    assert count.pop("/diagnostics") == 10
    assert set(count.values()) == {250}
    stopped = replace(believing(now), state=BrainState.STOPPED)
    assert "/diagnostics" in shown(tick(now=now + 1), stopped, views)
    assert "/diagnostics" not in shown(tick(now=now + 2), stopped, views)


def test_an_estimate_is_shown_once() -> None:
    views = Views()
    assert "/odom" in shown(tick(), believing(T), views)
    assert "/odom" not in shown(tick(now=T + SECOND), believing(T), views)


# -- always ------------------------------------------------------------------------------------


def test_the_same_again_to_the_byte() -> None:
    def all_of_it() -> list[list[ViewMessage]]:
        views = Views(little.MOUNTS)
        return [views.messages(made, belief) for made, belief in little.life(200)]

    assert all_of_it() == all_of_it()


_VIEWS = Views()


@given(little.ticks)
@settings(max_examples=200, deadline=None)
def test_no_tick_raises_and_rosbags_reads_every_view(made: Tick) -> None:
    for view in _VIEWS.messages(made, BELIEF):
        assert _VIEWS.deserialise(view) is not None


@pytest.mark.parametrize("t", [-(2**63), -1, 2**31 * SECOND, 2**63 - 1])
def test_a_stamp_out_of_range_is_cut(t: Nanos) -> None:
    message = shown(tick(little.scan(t, 8)))["/scan"]
    assert message.header.stamp.sec == max(-(2**31), min(2**31 - 1, t // SECOND))


def test_every_type_has_a_definition_that_stands_alone() -> None:
    views = Views(little.MOUNTS)
    received = [Packet(T, "can0", CanFrame(1)), Packet(T, "fd", CanFrame(1, fd=True))]
    made = tick(
        little.scan(T), Imu("imu", T, (0.0,) * 3, (0.0,) * 3), Fix("gps", T, 0.0, 0.0), received=received
    )
    types = {view.type for view in views.messages(made, believing())}
    assert {
        ros_messages.CAN_FRAME,
        ros_messages.FD_FRAME,
        "nav_msgs/msg/Odometry",
        "sensor_msgs/msg/Imu",
    } <= types
    for type_ in types:
        alone = get_typestore(Stores.EMPTY)
        alone.register(get_types_from_msg(views.definition(type_), type_))
        assert alone.hash_rihs01(type_) == typestore().hash_rihs01(type_)
