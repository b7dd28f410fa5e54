"""The table of the graph: names as the robot file has them, what each kind of robot offers, and mistakes."""

from __future__ import annotations

import pytest

from gateway.config import load_robot, parse_robot
from gateway.errors import ConfigError, UserError
from gateway.recording.ros_views import TOPICS
from gateway.ros import graph
from gateway.ros.network import parse_network

DIFFBOT = load_robot("diffbot").text


def with_ros(table: str) -> str:
    return f"{DIFFBOT}\n[ros]\n{table}\n"


def shown(text: str) -> dict[str, str]:
    return {row.name: row.shown for row in graph.rows(parse_robot(text), steers=True)}


def test_names_are_absolute_in_a_namespace_or_remapped() -> None:
    assert shown(DIFFBOT)["/odom"] == "/odom"
    assert shown(DIFFBOT)["~/stop"] == "/diffbot/stop"
    there = shown(
        with_ros(
            'namespace = "/left"\nnode = "rover"\nremap = { "/scan" = "/front/scan", "~/stop" = "/halt" }'
        )
    )
    assert there["/odom"] == "/left/odom"
    assert there["/scan"] == "/front/scan"
    assert (there["~/stop"], there["~/release"]) == ("/halt", "/left/rover/release")
    assert there["/navigate_to_pose/_action/send_goal"] == "/left/navigate_to_pose/_action/send_goal"


@pytest.mark.parametrize(
    ("robot", "takes", "not_"),
    [
        ("diffbot", {"/cmd_vel", "/goal_pose"}, {graph.TRAJECTORIES}),
        ("bench", {graph.TRAJECTORIES, "/velocity_controller/commands"}, {"/cmd_vel", "/goal_pose"}),
        ("mobile_arm", {graph.TRAJECTORIES, "/cmd_vel"}, set()),
    ],
)
def test_what_a_robot_takes(robot: str, takes: set[str], not_: set[str]) -> None:
    rows = graph.rows(load_robot(robot), steers=True)
    names = {row.name for row in rows if row.kind == "subscribe"}
    assert takes <= names
    assert not names & not_
    published = {row.name for row in rows if row.kind == "publish"}
    assert TOPICS.keys() - {"/goal_pose"} <= published
    assert {"subscribe", "serve"} & {row.kind for row in graph.rows(load_robot(robot), steers=False)} == set()


def test_both_kinds_of_twist_are_taken_and_what_is_latched_is() -> None:
    rows = graph.rows(load_robot("diffbot"), steers=True)
    assert [row.type for row in rows if row.name == "/cmd_vel"] == [graph.TWIST, graph.TWIST_STAMPED]
    latched = {row.name for row in rows if row.qos.transient}
    assert {
        "/map",
        "/tf_static",
        "/robot_description",
        "/rosout",
        "/navigate_to_pose/_action/status",
    } <= latched
    assert all(row.qos.reliable for row in rows if row.kind != "subscribe")


def test_an_action_is_remapped_with_its_parts() -> None:
    there = shown(with_ros('namespace = "/left"\nremap = { "/navigate_to_pose" = "/nav/go" }'))
    parts = {name: there[name] for name in there if name.startswith("/navigate_to_pose/")}
    assert parts["/navigate_to_pose/_action/send_goal"] == "/nav/go/_action/send_goal"
    assert {one.partition("/_action/")[0] for one in parts.values()} == {"/nav/go"}
    assert len(parts) == 5


def test_topics_of_a_camera_are_remapped_where_there_is_none_too() -> None:
    there = shown(with_ros('remap = { "/lidar/camera_info" = "/eye" }'))
    assert "/eye" not in there.values()


def test_a_remap_of_what_there_is_not_is_said() -> None:
    with pytest.raises(UserError, match=r"'/scna'.*did you mean '/scan'"):
        shown(with_ros('remap = { "/scna" = "/front" }'))


@pytest.mark.parametrize(
    ("table", "key", "sentence"),
    [
        ("domain = 233", "ros.domain", "233"),
        ("cmd_vel_timeout_ms = 20", "ros.cmd_vel_timeout_ms", "20"),
        ('namespace = "left"', "ros.namespace", "expected a name as"),
        ('node = "1st"', "ros.node", "no digit first"),
        ('remap = { "/scan" = "front scan" }', "ros.remap", "no name of a topic"),
        ("topics = 3", "ros.topics", "no key"),
    ],
)
def test_mistakes_of_the_table(table: str, key: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_robot(with_ros(table))
    found = [(one.key, one.text) for one in caught.value.mistakes]
    assert [one for one, text in found if sentence in text] == [key], found


def test_an_urdf_is_the_description() -> None:
    assert "<robot" in load_robot("arm").description
    assert load_robot("diffbot").description == ""


def test_networks() -> None:
    assert parse_network("") == parse_network("lo") == "127.0.0.1"
    assert parse_network("192.0.2.1") == "192.0.2.1"
    with pytest.raises(
        UserError, match=r"expected an address of this machine, or an interface that has one \(.*lo"
    ):
        parse_network("wlan77")
