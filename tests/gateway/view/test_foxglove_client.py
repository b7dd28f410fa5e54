"""Foxglove's own client and its decoder of ROS 2 messages, with a robot in real time: what they read is true.

Both are on npm: `bash tests/gateway/view/foxglove_client/install`.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

import gateway
from brain.belief import Belief
from gateway.core.tick import Tick
from gateway.operator import commands
from gateway.recording.ros_views import TOPICS
from protocols.messages import SECOND, Drive, Goal, LaserScan, Set, Stop
from tests.gateway.processes import PATIENCE

CLIENT = Path(__file__).parent / "foxglove_client" / "client.cjs"
MODULES = Path(__file__).parents[3] / "out" / "foxglove_client" / "node_modules"
INSTALL = "install nodejs and npm, then bash tests/gateway/view/foxglove_client/install"


@pytest.fixture(scope="module")
def node() -> str:
    found = shutil.which("node")
    if found is None or not MODULES.is_dir():
        required = "foxglove" in re.split(r"[,\s]+", os.environ.get("MOTOR_GATEWAY_REQUIRE", ""))
        (pytest.fail if required else pytest.skip)(f"NOT RUN: Foxglove's own client: {INSTALL}")
    return found


class Seen:
    """What the robot did while the client was there."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.poses: set[tuple[int, float, float]] = set()
        """With their times, at which there may be two: one is corrected by what comes later."""
        self.scans: dict[int, LaserScan] = {}
        self.turned = 0.0
        """The highest angular velocity while the client drove, rad/s."""

    def take(self, tick: Tick, belief: Belief) -> None:
        self.asked += tick.inputs.instructions
        self.scans |= {one.t: one for one in tick.outputs.events if isinstance(one, LaserScan)}
        if belief.estimate is not None:
            self.poses.add((belief.estimate.t, belief.estimate.pose.x, belief.estimate.pose.y))
            self.turned = max(self.turned, belief.estimate.angular)


def test_foxgloves_own_client(node: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "FRESH", 60 * SECOND)  # a machine that is busy is no slow link
    seen, out = Seen(), tmp_path / "out"
    with gateway.open_session("diffbot", seed=1) as session, out.open("wb") as file:
        session.watch(seen.take)
        url = session.view("127.0.0.1:0", steer=True).replace("http:", "ws:")
        there = session.tour()[0]
        client = subprocess.Popen(
            [node, CLIENT, url, str(there.x), str(there.y)],
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | {"NODE_PATH": str(MODULES)},
        )
        try:
            for _ in session.run(seconds=PATIENCE):
                if client.poll() is not None:
                    break
        finally:
            client.kill()
            client.wait()
        torque = session.joints["right"].settings.limits.torque
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    of = {kind: [one for one in lines if one["kind"] == kind] for kind in {one["kind"] for one in lines}}
    assert client.returncode == 0, out.read_text()[-2000:]
    assert not of.get("error"), of["error"]
    assert not of.get("status"), of["status"]
    assert not of.get("failure"), of["failure"]

    # what it reads is what the robot has
    first = {one["topic"]: one for one in reversed(of["message"])}
    odom = first["/estimate"]
    position = odom["content"]["pose"]["pose"]["position"]
    assert (odom["t"], position["x"], position["y"]) in seen.poses
    stamp = odom["content"]["header"]["stamp"]
    assert stamp["sec"] * 10**9 + stamp["nanosec"] == odom["t"]
    scan = first["/scan"]["content"]
    assert scan["ranges"] == pytest.approx(seen.scans[first["/scan"]["t"]].ranges, rel=1e-6, nan_ok=True)
    assert first["/joint_states"]["content"]["name"] == ["left", "right"]
    grid = first["/map"]["content"]
    assert len(grid["data"]) == grid["info"]["width"] * grid["info"]["height"] > 0
    frames = {one["child_frame_id"] for one in first["/tf_static"]["content"]["transforms"]}
    assert frames == set(session.robot.sensors)
    transforms = first["/tf"]["content"]["transforms"]
    between = [(each["header"]["frame_id"], each["child_frame_id"]) for each in transforms]
    assert between == [("odom", "base_link"), ("map", "odom")]
    statuses = [one["name"] for one in first["/diagnostics"]["content"]["status"]]
    assert {"/gateway/brain", "/gateway/motors/left"} <= set(statuses)
    frame = first["/can0/from_can_bus"]["content"]
    assert len(frame["data"]) == 8
    silent = {"/fix", "/pose"}  # this robot has no such sensor
    frames_too = {"/can0/from_can_bus", "/can0/to_can_bus"}
    assert of["end"][0]["counts"].keys() == (TOPICS.keys() - silent) | frames_too | {"time"}

    # what it asks is done
    assert Set("right.limits.torque", 1.25) in seen.asked
    assert torque == 1.25
    told = [one["parameters"] for one in of["parameters"]]
    expected = {"name": "right.limits.torque", "value": 1.25, "type": "float64"}
    assert told[0] == [{"name": "right.limits.torque", "value": 2.0, "type": "float64"}]
    assert told[1:] == [[expected], [expected]]  # the answer, and as one who has subscribed
    goal = next(one for one in seen.asked if isinstance(one, Goal))
    assert (goal.x, goal.y) == (there.x, there.y)
    assert goal.yaw == pytest.approx(0.5, abs=1e-12)
    shown = first["/goal_pose"]["content"]["pose"]["position"]
    assert (shown["x"], shown["y"]) == (there.x, there.y)
    assert Drive(0.05, 0.5) in seen.asked
    assert seen.turned > 0.1
    assert Stop("the test is over") in seen.asked
    assert of["answer"] == [{"kind": "answer", "callId": 3, "encoding": "json", "message": "stopped"}]
    assert "the test is over" in of["end"][0]["rosout"]["msg"]
