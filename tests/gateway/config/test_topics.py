"""The table [bag] of the robot file: what a valid one gives, the mistakes of a wrong one."""

from __future__ import annotations

import pytest

from gateway.config import describe, load_robot, parse_robot, resources
from gateway.core.robot import BagTopics
from gateway.errors import ConfigError
from tests.gateway.bag_helpers import ROBOT

TABLE = ROBOT[ROBOT.index("[bag]") :]
FIRST = ROBOT[: ROBOT.index("[bag]")].count("\n") + 2
"""The line of the table's first key."""


def mistakes_in(text: str) -> list[str]:
    with pytest.raises(ConfigError) as error:
        parse_robot(text, "r.toml")
    return str(error.value).splitlines()


def test_a_complete_table() -> None:
    bag = parse_robot(ROBOT).bag
    assert bag == BagTopics("/odom", {"imu": "/imu/data"}, "/fix")
    assert list(bag.parts()) == [("/odom", "odometry"), ("/imu/data", "sensors.imu"), ("/fix", "truth")]


def test_a_minimal_table() -> None:
    bag = parse_robot(ROBOT.replace(TABLE, '[bag]\nodometry = "/o"\n')).bag
    assert bag == BagTopics("/o")
    assert list(bag.parts()) == [("/o", "odometry")]


def test_without_a_table_there_are_no_topics() -> None:
    assert parse_robot(ROBOT.replace(TABLE, "")).bag is None
    assert load_robot("diffbot").bag is None


MISTAKES = [
    ("[bag]\n", ["r.toml:{}: bag.odometry: missing; expected a string"]),
    ("[bag]\nodometry = 3\n", ["r.toml:{1}: bag.odometry: found 3, expected a string"]),
    (
        '[bag]\nodometry = "/o"\nimu = "/i"\n',
        ["r.toml:{2}: bag.imu: no key 'imu': there is odometry, sensors, truth"],
    ),
    (
        '[bag]\nodometry = "odom"\ntruth = ""\n',
        ['r.toml:{1}: bag.odometry: found "odom", expected a topic: it begins with "/"'],
    ),
    (
        '[bag]\nodometry = "/o"\nsensors = { imo = "/i" }\n',
        ["r.toml:{2}: bag.sensors.imo: no sensor 'imo': there is imu; did you mean 'imu'?"],
    ),
    (
        '[bag]\nodometry = "/o"\nsensors = { imu = "/o" }\ntruth = "/o"\n',
        [
            'r.toml:{2}: bag.sensors.imu: found "/o", which is odometry too; expected another topic',
            'r.toml:{3}: bag.truth: found "/o", which is odometry too; expected another topic',
        ],
    ),
    (
        '[bag]\nodometry = "o"\nsensors = { left = "i" }\ntruth = "f"\n',
        [
            'r.toml:{1}: bag.odometry: found "o", expected a topic: it begins with "/"',
            "r.toml:{2}: bag.sensors.left: no sensor 'left': there is imu",
            'r.toml:{2}: bag.sensors.left: found "i", expected a topic: it begins with "/"',
            'r.toml:{3}: bag.truth: found "f", expected a topic: it begins with "/"',
        ],
    ),
]


@pytest.mark.parametrize(("table", "mistakes"), MISTAKES)
def test_every_mistake_is_reported_at_its_place(table: str, mistakes: list[str]) -> None:
    lines = [FIRST - 1 + number for number in range(5)]
    expected = [text.replace("{}", str(lines[0])).format(*lines) for text in mistakes]
    assert mistakes_in(ROBOT.replace(TABLE, table)) == expected


def test_a_value_instead_of_the_table() -> None:
    (found,) = mistakes_in("bag = 3\n" + ROBOT.replace(TABLE, ""))
    assert found == "r.toml:1: bag: found 3, expected a table"


def test_the_description_has_the_topics_and_the_mounting_of_the_imu() -> None:
    found = describe(load_robot("husky"))
    assert "0, -0.3, 0.52 m  -1.5708 rad, pitch 0, roll 1.5708  500 ms" in found
    assert "odometry     /husky_velocity_controller/odom\nsensors.imu  /imu/data\ntruth        /fix" in found
    assert "/odom" not in describe(load_robot("diffbot"))


def test_bare_joints_need_no_bag() -> None:
    text = resources.find("robots", "bench").read_text() + '\n[bag]\nodometry = "/o"\n'
    (found,) = mistakes_in(text)
    assert found.endswith(
        "bag: a bag moves a base on wheels, and the body is 'joints'; expected no such table"
    )
