"""Simulated devices in the live view, by its port: a robot that another program drives, and what is true."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from gateway.core.tick import Tick
from gateway.recording.ros_views import typestore
from gateway.runtime.device_log import DeviceLog
from gateway.runtime.session import Session, open_session
from gateway.runtime.twin_process import Devices
from gateway.runtime.twin_view import TwinView
from gateway.view import Access, Address, parse_address
from protocols.messages import SECOND, Drive, Velocity
from tests.gateway.view.clients import Browser
from tests.gateway.view.test_foxglove import App

TRUE = {"/odom", "/estimate", "/tf", "/tf_static", "/joint_states"}


class Watched:
    """The twins of a robot in simulated time, their view, a page and a Foxglove client."""

    def __init__(self, session: Session) -> None:
        assert session.twins is not None
        self.session, self.world = session, session.twins.world
        log, clock = DeviceLog(session.robot), session.clock
        made = Devices(session.robot, session.twins, session.buses, {}, clock, log, age=0)
        self.view = TwinView(made, Address(port=0), Access())
        address = parse_address(self.view.url.removeprefix("http://").rstrip("/"))
        self.page, self.app = Browser(address), App(address)
        self.ticks: Iterator[Tick] = session.run()
        self.until(lambda: bool(self.page.of("state")) and bool(self.app.binary))

    def until(self, what: Callable[[], bool], seconds: float = 10.0) -> None:
        end = self.session.clock.now() + seconds * SECOND
        while not what():
            tick = next(self.ticks)
            assert tick.now < end
            self.view.watch(tick.now)
            self.page.poll()
            self.app.poll()

    def drive(self, *instructions: Drive | Velocity, seconds: float) -> None:
        end = self.session.clock.now() + seconds * SECOND
        while self.session.clock.now() < end:
            self.session.submit(*instructions)
            before = self.session.clock.now()
            self.until(lambda before=before: self.session.clock.now() > before)  # type: ignore[misc]

    def newest(self, topic: str) -> Any:
        type_ = self.app.channels()[topic]["schemaName"]
        return typestore().deserialize_cdr(self.app.of(topic)[-1][1], type_)

    def close(self) -> None:
        self.page.close()
        self.app.close()
        self.view.close()


@pytest.fixture
def watched() -> Iterator[Watched]:
    with open_session("diffbot", simulated=True, seed=1) as session:
        made = Watched(session)
        made.until(lambda: session.belief.state.value == "ready")
        yield made
        made.close()


def test_a_page_is_shown_what_is_true(watched: Watched) -> None:
    hello, begin = watched.page.of("hello")[0], watched.page.of("state")[-1]["pose"]
    assert (hello["mode"], hello["steer"]) == ("twin", False)
    assert hello["walls"]
    assert watched.page.of("settings")[0]["rows"] == []
    watched.drive(Drive(0.2, 0.4), seconds=2.0)
    state, pose = watched.page.of("state")[-1], watched.world.truth()
    assert (state["state"], state["reason"]) == ("simulated", "what is true")
    assert state["pose"] == pytest.approx([pose.x, pose.y, pose.yaw], abs=0.05)
    assert state["twist"] == pytest.approx([0.2, 0.4, 0.0], abs=0.03)
    assert state["pose"][0] - begin[0] > 0.2
    for row, name in zip(watched.page.of("joints")[-1]["rows"], watched.session.robot.motors, strict=True):
        assert row[0] == "simulated"
        assert row[4:6] == pytest.approx(watched.world.shaft(name), abs=0.2)


def test_foxglove_is_shown_what_is_true(watched: Watched) -> None:
    app = watched.app
    assert app.messages[0]["metadata"]["mode"] == "twin"
    assert app.channels().keys() == TRUE
    app.subscribe(*TRUE)
    watched.drive(Drive(0.2, 0.4), seconds=2.0)
    now, pose = watched.session.clock.now(), watched.world.truth()
    [clock] = struct.unpack("<xQ", [one for one in app.binary if one[0] == 2][-1])
    assert 0 <= now - clock < SECOND // 20
    base, odom = watched.newest("/tf").transforms
    assert (odom.header.frame_id, odom.child_frame_id) == ("map", "odom")
    assert (odom.transform.translation.x, odom.transform.rotation.w) == (0.0, 1.0)
    assert (base.header.frame_id, base.child_frame_id) == ("odom", "base_link")
    place, odom = base.transform.translation, watched.newest("/odom")
    assert (place.x, place.y) == pytest.approx((pose.x, pose.y), abs=0.02)
    assert (odom.pose.pose.position.x, odom.pose.pose.position.y) == (place.x, place.y)
    assert (odom.twist.twist.linear.x, odom.twist.twist.angular.z) == pytest.approx((0.2, 0.4), abs=0.03)
    joints = watched.newest("/joint_states")
    assert list(joints.name) == list(watched.session.robot.motors)
    shafts = [watched.world.shaft(name) for name in joints.name]
    assert list(joints.position) == pytest.approx([position for position, _ in shafts], abs=0.2)
    assert list(joints.velocity) == pytest.approx([velocity for _, velocity in shafts], abs=0.2)
    assert {one.child_frame_id for one in watched.newest("/tf_static").transforms} == {"lidar", "imu"}


def test_simulated_devices_take_no_requests(watched: Watched) -> None:
    app, page = watched.app, watched.page
    assert "services" not in app.messages[0]["capabilities"]
    assert "clientPublish" not in app.messages[0]["capabilities"]
    assert not app.op("advertiseServices")
    app.advertise("/cmd_vel", "geometry_msgs/msg/Twist", "json")
    for line in ("stop", "goal 1 1"):
        page.send({"ask": line})
    page.send(json.dumps({"held": "drive 0.1 0"}))
    watched.until(lambda: len(page.of("answer")) == 3 and bool(app.statuses()))
    assert {(one["ok"], "no robot runs here" in one["text"]) for one in page.of("answer")} == {(False, True)}
    assert app.statuses() == [(2, "Server does not support clientPublish capability")]


def test_a_bench_has_shafts_and_no_pose() -> None:
    with open_session("bench", simulated=True) as session:
        watched = Watched(session)
        watched.app.subscribe(*TRUE)
        watched.drive(Velocity("left", 3.0), seconds=2.0)
        assert watched.page.of("state")[-1]["pose"] is None
        assert watched.page.of("joints")[-1]["rows"][0][5] == pytest.approx(3.0, abs=0.2)
        assert watched.newest("/joint_states").velocity[0] == pytest.approx(3.0, abs=0.2)
        assert not watched.app.of("/odom")
        watched.close()
