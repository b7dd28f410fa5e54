"""A robot in real time, judged by real ROS 2 (rclpy on Fast DDS) and by Cyclone DDS: what they see is true,
what they ask is done, and all of it is in the recording.

They are Python packages, in an environment of their own: `bash tests/gateway/ros/judges/install`.
"""

from __future__ import annotations

import base64
import math
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gateway
from brain.belief import Belief
from gateway.config import load_robot, parse_robot
from gateway.core.tick import Tick
from gateway.recording import read_recording
from gateway.replay import replay_recording
from gateway.ros import actions, definitions, graph, images, types
from gateway.ros.link import Link
from gateway.runtime.cameras import RealCamera, cameras_of
from gateway.vision import camera as vision
from protocols import messages as msg
from tests.gateway.processes import PATIENCE
from tests.gateway.ros.judged import Judge, domain, python

NEAR, FAR = (0.35, 0.0), (0.15, 0.1)
"""Goals"""


class Seen:
    """What the robot did."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.odom: set[tuple[float, float, float]] = set()
        self.map: set[tuple[float, float, float]] = set()
        self.scans: list[tuple[float, ...]] = []

    def take(self, tick: Tick, belief: Belief) -> None:
        self.asked += tick.inputs.instructions
        self.scans += [one.ranges for one in tick.outputs.events if isinstance(one, msg.LaserScan)]
        if (estimate := belief.estimate) is not None:
            for poses, pose in ((self.odom, estimate.odom), (self.map, estimate.pose)):
                poses.add((round(pose.x, 9), round(pose.y, 9), round(pose.yaw, 9)))


def agree(found: list[list[float]], true: set[tuple[float, float, float]]) -> float:
    """Return the largest difference of any of these poses from the nearest true one."""
    worst = 0.0
    for _, x, y, yaw in found:
        worst = max(
            worst,
            min(max(abs(x - a), abs(y - b), abs(math.remainder(yaw - c, math.tau))) for a, b, c in true),
        )
    return worst


def test_two_implementations_of_dds_drive_a_robot(tmp_path: Path) -> None:
    python()
    seen, recording, number = Seen(), tmp_path / "run.mcap", domain()
    results: list[dict[str, Any]] = []
    with gateway.open_session("diffbot", seed=1, record=recording) as session:
        session.watch(seen.take)
        assert session.ros(domain=number).startswith(f"/diffbot in domain {number}, at 127.0.0.1:")
        rows = graph.rows(session.robot, steers=True)
        offered = [
            len({r.name for r in rows if r.kind == kind}) for kind in ("publish", "subscribe", "serve")
        ]
        scripts = [
            ("cyclone_client", (str(number), *map(str, NEAR))),
            ("rclpy_robot", (*map(str, FAR), *map(str, offered))),
        ]
        judge = None
        for _ in session.run(seconds=PATIENCE):
            while judge is not None and not (judge.begun() or judge.done()):
                time.sleep(0.05)
            if judge is not None and judge.done():
                results.append(judge.end())
                judge = None
            if judge is None:
                if not scripts:
                    break
                script, arguments = scripts.pop(0)
                judge = Judge(tmp_path, script, number, *arguments)
        if judge is not None:
            judge.end()
    cyclone, ros = results

    # Cyclone DDS: a message of several fragments, an action, a service
    grid = cyclone["map"]
    assert grid["cells"] == grid["width"] * grid["height"] > 0
    assert cyclone["goal"]["accepted"]
    assert (cyclone["result"]["status"], cyclone["result"]["error"]) == (4, 0)
    distances = cyclone["feedback"]["distances"]
    assert len(distances) >= 3
    assert distances[-1] < distances[0] == pytest.approx(math.dist((0.0, 0.0), NEAR), abs=0.1)
    assert cyclone["clear"] == {"kind": "clear", "success": True, "text": "accepted"}

    # ROS 2: who we are
    assert ["diffbot", "/"] in ros["nodes"]["names"]
    for name, (node, type_, hash_) in ros["infos"]["of"].items():
        assert node == "diffbot", name
        assert hash_ == types.type_hash(type_), name
    assert {"/diffbot/stop", "/diffbot/get_parameters"} <= set(ros["services"]["names"])
    for kind, found in (("publish", ros["graph"]["published"]), ("subscribe", ros["graph"]["taken"])):
        of: dict[str, list[str]] = {}
        for row in rows:
            if row.kind == kind:
                of.setdefault(row.shown, []).append(row.type)
        assert {name: sorted(kinds) for name, kinds in found.items()} == of
    assert ros["actions"]["names"] == ["/navigate_to_pose"]
    kept = ["RELIABLE", "TRANSIENT_LOCAL"]
    assert ros["qos"]["of"] == {"/map": kept, "/odom": ["RELIABLE", "VOLATILE"]}

    # what it reads is what the robot has
    ranges = ros["scan"]["ranges"]
    assert any(ranges == pytest.approx(one, rel=1e-6, nan_ok=True) for one in seen.scans)
    assert ros["scan"]["frame"] == "lidar"
    assert ros["joints"]["names"] == ["left", "right"]
    assert ros["battery"]["volts"] == pytest.approx(24.0, abs=2.0)
    assert agree(ros["odom"]["poses"][::10], seen.odom) < 1e-6
    assert agree(ros["estimate"]["poses"][::10], seen.map) < 1e-6

    # what it asks is done
    parameters = ros["parameters"]
    assert "brain.differential.max_linear" in parameters["listed"]
    assert (parameters["unknown"], parameters["set"]) == (True, [True, False])
    assert parameters["now"] == parameters["value"] / 2 == parameters["high"] / 2
    assert ros["square"]["off"] < 0.1
    assert ros["goal"]["off"] < 0.15
    assert ros["goal"]["points"] >= 2
    assert (ros["stop"]["success"], ros["stop"]["message"]) == (True, "accepted")
    assert ros["stopped"]["moved"] < 0.02
    assert ros["stopped"]["refused"]
    kinds = {type(one) for one in seen.asked}
    assert {msg.Drive, msg.Goal, msg.Locate, msg.Mission, msg.Set, msg.Stop, msg.ClearFault} <= kinds
    assert ros["told"]["text"].endswith("from where it took itself to be")
    assert any(isinstance(one, msg.Goal) and (one.x, one.y) == FAR for one in seen.asked)

    # and all of it is replayed to the same bytes
    comparison = replay_recording(read_recording(recording))
    assert comparison.ok, comparison.text()


NAMED = """
[ros]
namespace = "/left"
node = "rover"
remap = { "/joint_states" = "/arm/states", "~/release" = "/go_on" }
"""


def test_joints_in_a_namespace_by_names_of_the_robot_file(tmp_path: Path) -> None:
    python()
    number, asked = domain(), list[Any]()
    robot = parse_robot(load_robot("bench").text + NAMED)
    with gateway.open_session(robot, seed=1) as session:
        session.watch(lambda tick, _: asked.extend(tick.inputs.instructions))
        assert session.ros(domain=number).startswith(f"/left/rover in domain {number}, ")
        judge = Judge(tmp_path, "rclpy_joints", number)
        for _ in session.run(seconds=PATIENCE):
            if judge.done():
                break
        found = judge.end()
    assert found["topics"]["of"] == {"/arm/states": ["rover"], "/left/joint_states": []}
    assert "left.limits.velocity" in found["parameters"]["listed"]
    assert found["states"]["names"] == ["left", "right"]
    assert found["velocity"]["values"] == pytest.approx([2.0, -1.0], abs=0.2)
    assert found["trajectory"]["values"] == pytest.approx(found["trajectory"]["goal"], abs=0.05)
    assert found["zero"]["success"], found["zero"]["message"]
    assert (found["stop"]["success"], found["go_on"]["success"]) == (True, True)
    assert {msg.Velocity("left", 2.0), msg.Zero("left"), msg.Release()} <= set(asked)


LENS = "fx = 480.0, fy = 470.0, cx = 318.5, cy = 241.0, distortion = [0.0, 0.0, 0.0, 0.0, 0.0]"


def filmed(folder: Path) -> str:
    """The robot with a camera, which is a video file: grey wedges that turn, three a second."""
    cv2: Any = vision.opencv()
    path = folder / "drive.avi"
    file = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 3.0, (640, 480))
    rows, columns = np.mgrid[:480, :640]
    for number in range(600):
        grey = (rows // 2 + columns // 3 + 40 * number) // 2 % 256
        file.write(np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2))
    file.release()
    table = (
        f'interface = "camera:{path}"\n[buses.eye.camera]\nwidth = 640\nheight = 480\nlens = {{ {LENS} }}\n'
    )
    table += "detectors.tags.size = 0.16\n"
    text = load_robot("diffbot_camera").text
    head, eye, rest = text.partition("[buses.eye]")
    return head + eye + rest.replace('interface = "twin"', table, 1)


@pytest.mark.parametrize("real", [False, True], ids=["simulated", "a video as the device"])
def test_images_of_a_camera(real: bool, tmp_path: Path) -> None:
    """What ROS 2 unpacks is what the camera saw, in its frame, with its description."""
    python()
    number = domain()
    drawn: dict[int, vision.Image] = {}
    robot = parse_robot(filmed(tmp_path)) if real else load_robot("diffbot_camera")
    with gateway.open_session(robot, seed=1) as session:
        (camera,) = cameras_of(session.robot, session.buses, session.twins)
        assert isinstance(camera, RealCamera) == real
        session.ros(domain=number)
        judge = Judge(tmp_path, "rclpy_camera", number)
        for _ in session.run(seconds=PATIENCE):
            if camera.seen is not None:
                drawn.setdefault(camera.seen.t, camera.seen.image)
            if judge.done():
                break
        found = judge.end()
    assert found["stamps"]["both"] >= 2
    assert found["stamps"]["distinct"] == found["stamps"]["images"]
    assert (found["images"]["frame"], found["images"]["format"]) == ("camera_optical", "jpeg")
    for text in found["images"]["data"]:
        image = vision.decoded(np.frombuffer(base64.b64decode(text), np.uint8))
        assert image is not None
        off = [float(np.abs(image.astype(float) - one).mean()) for one in drawn.values()]
        assert min(off) < 3.0, "grey levels, of JPEG"
    assert camera.seen is not None
    one, info = camera.seen.intrinsics, found["info"]
    assert info["size"] == [640, 480]
    assert info["k"] == [one.fx, 0.0, one.cx, 0.0, one.fy, one.cy, 0.0, 0.0, 1.0]
    assert info["p"] == [one.fx, 0.0, one.cx, 0.0, 0.0, one.fy, one.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    assert (info["d"], info["model"], info["frame"]) == ([0.0] * 5, "plumb_bob", "camera_optical")
    of = {"/camera/image_raw/compressed": images.IMAGE, "/camera/camera_info": images.INFO}
    assert found["hashes"]["of"] == {name: types.type_hash(type_) for name, type_ in of.items()}


class Server:
    """A server of an action of which ROS installs the types: one step of the sequence in each turn."""

    def __init__(self, number: int, network: str = "127.0.0.1") -> None:
        name, type_ = "/fibonacci", "test_msgs/action/Fibonacci"
        rows = [
            (kind, one, type_, types.type_hash(type_), qos)
            for kind, one, type_, qos in graph._action(name, type_)
        ]
        ours, theirs = socket.socketpair()
        with theirs:
            command = [sys.executable, "-m", "gateway.ros.process"]
            self.process = subprocess.Popen(command, stdin=theirs.fileno())
        self._link, self._names = Link(ours), [one[1] for one in rows]
        described = [(*row[:4], row[4].reliable, row[4].transient, row[4].depth) for row in rows]
        self._link.send(network, number, "server", "", described)
        self._action = actions.Action(name, type_, self._publish, self._answer)
        self._sequence = [0, 1]

    def _publish(self, name: str, data: bytes) -> None:
        self._link.send("publish", self._names.index(name), data)

    def _answer(self, name: str, data: bytes, token: Any) -> None:
        self._link.send("answer", self._names.index(name), data, token)

    def turn(self) -> None:
        self._link.flush()
        for kind, *rest in self._link.receive():
            if kind == "request":
                self._request(*rest)
        goal = self._action.active
        if goal is None:
            return
        self._sequence.append((self._sequence[-1] + self._sequence[-2]) % 1000)
        content = np.array(self._sequence, np.int32)
        self._action.feedback(goal, types.make("test_msgs/action/Fibonacci_Feedback", sequence=content))
        if len(self._sequence) > goal.content.order:
            result = types.make("test_msgs/action/Fibonacci_Result", sequence=content)
            self._action.set(goal, actions.SUCCEEDED, result)

    def _request(self, row: int, payload: bytes, token: Any) -> None:
        kinds = {"send_goal": "test_msgs/action/Fibonacci_SendGoal", "cancel_goal": graph.CANCEL}
        part = self._names[row].rpartition("/")[2]
        request = types.decode(f"{kinds.get(part, 'test_msgs/action/Fibonacci_GetResult')}_Request", payload)
        if part == "get_result":
            self._action.get_result(request, token)
        elif part == "cancel_goal":
            for goal in self._action.cancel(request, token):
                nothing = types.make("test_msgs/action/Fibonacci_Result")
                self._action.set(goal, actions.CANCELED, nothing)
        else:
            stamp = types.make("builtin_interfaces/msg/Time")
            refuse = lambda goal: "negative" if goal.order < 0 else ""  # noqa: E731
            made = self._action.send_goal(bytes(request.goal_id.uuid), request.goal, stamp, token, refuse)
            if made is not None:
                self._sequence = [0, 1]
                self._action.set(made, actions.EXECUTING)

    def close(self) -> None:
        self._link.close()
        self.process.wait()


def test_an_action_client_of_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    python()
    fibonacci = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence"
    monkeypatch.setitem(definitions.ACTIONS, "test_msgs/action/Fibonacci", fibonacci)
    types.store.cache_clear()
    number = domain() + 60
    server = Server(number)
    judge = Judge(tmp_path, "rclpy_action", number)
    try:
        while not judge.done():
            server.turn()
            time.sleep(0.02)
    finally:
        found = judge.end()
        server.close()
    done = found["done"]
    assert (done["accepted"], done["status"], done["sequence"]) == (True, actions.SUCCEEDED, [0, 1, 1, 2, 3])
    assert done["feedback"] == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]]
    assert found["refused"]["accepted"] is False
    assert found["cancelled"] == {"kind": "cancelled", "code": 0, "goals": 1, "status": actions.CANCELED}
    assert found["again"]["code"] == actions.TERMINATED


TUTORIAL = Path(__file__).parents[3] / "examples" / "ros2_tutorial"


TOPICS = {
    "perception": {"/tutorial/map": "/map"},
    "planner": {"/tutorial/map": "/map", "/tutorial/path": "/plan", "/tutorial/goal": "/goal_pose"},
    "controller": {},
}
"""What is ours in the place of a node: topics of theirs, by those of ours"""
GIVEN = {"perception": "perception", "controller": "pursuit"}
"""Our settings by which a node does that for our planning"""


@pytest.mark.prove
@pytest.mark.parametrize(
    "nodes",
    ["perception planner controller", "planner controller", "planner", "perception", "controller",
     "perception controller"],
)  # fmt: skip
def test_nodes_of_a_tutorial_drive_a_robot(nodes: str, tmp_path: Path) -> None:
    """What is not a node of ROS is the gateway's own: a planner without a controller leads it from goal to
    goal."""
    python()
    number, recording, there = domain(), tmp_path / "drive.mcap", (1.2, 0.3)
    names = nodes.split()
    mine = [name for name in TOPICS if name not in names]
    remaps = {f"{theirs}:={ours}": "-r" for name in mine for theirs, ours in TOPICS[name].items()}
    given = [part for remap, flag in remaps.items() for part in (flag, remap)]
    given += ["-p", "leads:=true"] if "controller" in mine and "planner" in names else []
    arguments = ["--ros-args", *given] if given else []
    text = load_robot("diffbot").text
    for name in GIVEN if "planner" in mine else ():
        if name in names:
            table = f"[brain.{GIVEN[name]}]\n"
            text = (
                text.replace(table, f"{table}given = true\n")
                if table in text
                else f"{text}\n{table}given = true\n"
            )
    seen = Seen()
    with gateway.open_session(parse_robot(text), seed=1, record=recording) as session:
        session.watch(seen.take)
        session.ros(domain=number)
        running = [Judge(tmp_path, f"{TUTORIAL}/{name}", number, *arguments) for name in names]
        judge = Judge(tmp_path, "goal", number, *map(str, there), *arguments)
        try:
            for _ in session.run(seconds=PATIENCE):
                if judge.done():
                    break
        finally:
            for node in running:
                node.kill()
        found = judge.end()
    assert found["there"]["off"] < 0.2
    driven = [one for one in seen.asked if isinstance(one, msg.Drive)]
    goals = [one for one in seen.asked if isinstance(one, msg.Goal)]
    assert bool(len(driven) > 20) == ("controller" in names)
    assert len(goals) >= (2 if "leads:=true" in given else "planner" in mine)
    assert bool([one for one in seen.asked if isinstance(one, msg.Grid)]) == (
        nodes.startswith("perception") and "planner" in mine
    )
    comparison = replay_recording(read_recording(recording))
    assert comparison.ok, comparison.text()
