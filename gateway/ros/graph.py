"""What of a robot is in the graph: one table of its topics, services and actions, with names, types and QoS.

Rules. Topics that are published are those of a recording (`gateway.recording.ros_views`), but frames of buses
and the goal, which others publish. Whatever is offered is reliable: who wants less gets it, too. What keeps
its value is latched. A command is read without repetition: an old one is worth nothing.

| name | type | to us |
|---|---|---|
| cmd_vel | geometry_msgs/Twist, TwistStamped | drive, for as long as it is repeated |
| goal_pose | geometry_msgs/PoseStamped | drive there, in place of what it does |
| initialpose | geometry_msgs/PoseWithCovarianceStamped | it is there |
| map, with `perception.given` | nav_msgs/OccupancyGrid | what it plans on |
| position_controller/commands, velocity_…, effort_… | std_msgs/Float64MultiArray | targets of bare joints |
| joint_trajectory_controller/joint_trajectory | trajectory_msgs/JointTrajectory | a motion of joints |
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias

from gateway.config.errors import unknown
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.recording.ros_views import OF_SENSORS, topic_name, topics, typestore
from gateway.ros import images, types
from gateway.ros.map_topics import MAP, UPDATE, UPDATES
from gateway.ros.rtps import Qos

Kind: TypeAlias = Literal["publish", "subscribe", "serve"]
TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
POSE_STAMPED, ARRAY = "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Float64MultiArray"
POSE_KNOWN, GRID = "geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/OccupancyGrid"
TRAJECTORY, CLOCK, STRING = (
    "trajectory_msgs/msg/JointTrajectory",
    "rosgraph_msgs/msg/Clock",
    "std_msgs/msg/String",
)
TRIGGER, STATUSES = "std_srvs/srv/Trigger", "action_msgs/msg/GoalStatusArray"
CANCEL = "action_msgs/srv/CancelGoal"
NAVIGATE, FOLLOW = "nav2_msgs/action/NavigateToPose", "control_msgs/action/FollowJointTrajectory"
BATTERY = "sensor_msgs/msg/BatteryState"

LATCHED = frozenset(("/map", "/tf_static", "/robot_description", "/plan", "/battery_state"))
"""Topics whose newest message who comes later gets, too."""
DEPTHS = {"/tf": 100, "/rosout": 100, "/clock": 1} | dict.fromkeys(LATCHED, 1) | dict.fromkeys(OF_SENSORS, 5)
STREAM = Qos(reliable=False, depth=1)
LARGEST = 1 << 16
"""Bytes of a message or request that is read: a trajectory of six joints has 350 points with everything."""
MOST_BYTES = dict.fromkeys((TWIST, TWIST_STAMPED, POSE_STAMPED, POSE_KNOWN, ARRAY), 2048)
JOINT_COMMANDS = {f"/{kind}_controller/commands": kind for kind in ("position", "velocity", "effort")}
TRAJECTORIES = "/joint_trajectory_controller/joint_trajectory"
TRIGGERS = {"stop": "stop asked for in ROS 2", "release": "release", "clear_faults": "clear"}
"""Services of the node, by the operator's line that each is"""
PARTS = "/_action/"
"""Between an action's name and those of its parts"""
ZERO = "zero"
"""A service of each motor"""
PARAMETERS = {
    name: f"rcl_interfaces/srv/{''.join(part.capitalize() for part in name.split('_'))}"
    for name in (
        "list_parameters",
        "get_parameters",
        "get_parameter_types",
        "describe_parameters",
        "set_parameters",
        "set_parameters_atomically",
    )
}
"""Services of every node, and their types."""


class Row(NamedTuple):
    """A topic or service."""

    kind: Kind
    name: str
    """In this table"""
    type: str
    qos: Qos
    shown: str
    """In the graph"""
    hash: str


def rows(robot: Robot, *, steers: bool, cameras: Sequence[str] = ()) -> list[Row]:
    """Return what a robot has, and these cameras. Raises UserError if its file remaps what there is not."""
    able = robot.brain.abilities(robot.motors)
    found: list[tuple[Kind, str, str, Qos]] = []
    published = topics(typestore()) | {"/clock": CLOCK, "/robot_description": STRING, UPDATES: UPDATE}
    published.pop("/goal_pose")
    published |= images.topics(cameras)
    if robot.brain.perception.given:
        del published[MAP], published[UPDATES]
    for name, type_ in published.items():
        latched = name in LATCHED or name == "/rosout"
        found.append(("publish", name, type_, Qos(transient=latched, depth=DEPTHS.get(name, 10))))
    if steers and able.base is not None:
        found += [("subscribe", "/cmd_vel", kind, STREAM) for kind in (TWIST, TWIST_STAMPED)]
        found.append(("subscribe", "/goal_pose", POSE_STAMPED, Qos()))
        found.append(("subscribe", "/initialpose", POSE_KNOWN, Qos()))
        found += _action("/navigate_to_pose", NAVIGATE)
        if robot.brain.perception.given:
            found.append(("subscribe", MAP, GRID, Qos()))
    if steers and able.joints:
        found += [("subscribe", name, ARRAY, STREAM) for name in JOINT_COMMANDS]
        found.append(("subscribe", TRAJECTORIES, TRAJECTORY, Qos()))
        found += _action("/joint_trajectory_controller/follow_joint_trajectory", FOLLOW)
    if steers:
        found += [("serve", f"~/{name}", TRIGGER, Qos()) for name in TRIGGERS]
        found += [("serve", f"~/{name}/{ZERO}", TRIGGER, Qos()) for name in robot.motors]
        found += [("serve", f"~/{name}", type_, Qos()) for name, type_ in PARAMETERS.items()]
    names = [name for _, name, _, _ in found]
    names += dict.fromkeys(name.partition(PARTS)[0] for name in names if PARTS in name)
    names += images.topics([*robot.sensors])  # of which one may be a camera, in another world
    for key in robot.ros.remap:
        if key not in names:
            raise UserError(f"[ros] remap: {unknown('topic', key, names)}")
    return [Row(*one, full_name(robot, one[1]), types.type_hash(one[2])) for one in found]


def _action(name: str, type_: str) -> list[tuple[Kind, str, str, Qos]]:
    inner = f"{name}{PARTS[:-1]}"
    return [
        ("serve", f"{inner}/send_goal", f"{type_}_SendGoal", Qos()),
        ("serve", f"{inner}/get_result", f"{type_}_GetResult", Qos()),
        ("serve", f"{inner}/cancel_goal", CANCEL, Qos()),
        ("publish", f"{inner}/feedback", f"{type_}_FeedbackMessage", Qos()),
        ("publish", f"{inner}/status", STATUSES, Qos(transient=True, depth=1)),
    ]


def node_name(robot: Robot) -> str:
    """Return the name of our node."""
    return robot.ros.node or topic_name(robot.name)


def full_name(robot: Robot, name: str) -> str:
    """Return the name in the graph: remapped, or in the namespace; "~" is our node. The parts of an action
    go with it."""
    whole, parts, part = name.partition(PARTS)
    for each, rest in ((name, ""), (whole, parts + part)):
        if each in robot.ros.remap:
            return f"{robot.ros.remap[each]}{rest}"
    inner = re.sub(r"^~", f"/{node_name(robot)}", name)
    return f"{robot.ros.namespace}{inner}"
