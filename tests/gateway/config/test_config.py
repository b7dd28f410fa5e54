"""The robot file: what a valid one gives; that a wrong one gets every mistake at once, with its place."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.config import (
    cautions,
    describe,
    load_mission,
    load_robot,
    parse_robot,
    resources,
    with_interfaces,
)
from gateway.config.errors import Mistakes, lines, shown
from gateway.config.schema import build
from gateway.config.sections import Find
from gateway.config.validate import id_conflict
from gateway.core.robot import BagTopics, Robot
from gateway.errors import ConfigError
from gateway.sim import load_plant, load_world
from gateway.sim.files import SceneFile
from gateway.sim.linked_file import LinkedFile
from gateway.sim.plant_files import Lidar
from protocols import plugin
from protocols.bounds import Bounds, Duration, Invalid, check, keys
from protocols.frames import EXTENDED_BIT, exact
from protocols.messages import MILLISECOND, SECOND, Idle, Torque
from protocols.plugin import Device, Plugin, Range, Spec
from tests.gateway.bag_helpers import ROBOT as WITH_BAG
from tests.gateway.rig import WATCHED

ROOT = Path(resources.__file__).parent.parent
ROBOTS = sorted(ROOT.glob("fixtures/robots/*.toml"))
OTHERS = [path for path in sorted(ROOT.glob("tests/*/robots/*.toml")) if "[brain]" in path.read_text()]
"""Robots that only campaigns and the tests on a real CAN drive."""
BENCH = resources.find("robots", "bench").read_text()

INSTALLED = ", ".join(point.name for point in plugin.installed())
ROVER = (
    resources.find("robots", "diffbot").read_text().replace('stop_action = "brake"', 'stop_action = "idle" ')
)
"""A differential robot over ODrive 0.6 CAN frames, with a lidar and an IMU on a serial line."""


def mistakes_in(text: str, find: Any = plugin.load, *, with_world: bool = False) -> list[str]:
    """The mistakes in a file called r.toml, one line each; [] if it is right."""
    try:
        parse_robot(text, "r.toml", find, file=Path("r.toml") if with_world else None)
    except ConfigError as error:
        return [str(mistake) for mistake in error.mistakes]
    return []


def line_of(text: str, part: str, nth: int = 1) -> int:
    """The line on which a part of the text stands for the nth time."""
    at = -1
    for _ in range(nth):
        at = text.index(part, at + 1)
    return text.count("\n", 0, at) + 1


def changed(old: str, new: str, text: str = ROVER, times: int = 1) -> str:
    assert old in text
    return text.replace(old, new, times)


# -- valid files -------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ROBOTS + OTHERS, ids=lambda path: path.stem)
def test_every_robot_file_is_valid_and_named_as_its_file(path: Path) -> None:
    robot = load_robot(path)
    assert robot.name == path.stem
    assert robot.text.partition("\n\n[files]")[0].strip() == path.read_text().strip()
    assert parse_robot(robot.text).motors.keys() == robot.motors.keys()


def test_the_robot_is_as_in_its_file() -> None:
    robot = parse_robot(ROVER)
    assert (robot.name, robot.period, robot.world, robot.seed) == ("diffbot", 5 * MILLISECOND, "office", 0)
    can0, sensors = robot.buses["can0"], robot.buses["sensors"]
    assert (can0.kind, can0.bitrate, can0.baudrate, can0.interface) == ("can", 1_000_000, 0, "twin")
    assert (sensors.kind, sensors.bitrate, sensors.baudrate) == ("serial", 0, 3_000_000)
    right = robot.motors["right"]
    assert (right.plugin.name, right.bus, right.device.address) == ("odrive_can", "can0", 2)
    assert (right.joint.gear, right.joint.sign, right.joint.on_fault) == (8.0, -1, "stop")
    assert (right.joint.limits.velocity, right.joint.limits.position) == (20.0, None)
    assert right.joint.command_timeout == 100 * MILLISECOND
    assert right.device.options.watchdog == "acknowledged"
    assert right.spec == right.plugin.spec(right.device)
    lidar = robot.sensors["lidar"]
    assert (lidar.mount.x, lidar.mount.z, lidar.timeout) == (0.12, 0.12, 500 * MILLISECOND)
    assert robot.brain.body.kind == "differential"
    assert getattr(robot.brain.body, "wheel_separation", None) == 0.22
    assert [d.name for d in robot.devices_on("can0")] == ["left", "right"]
    assert [d.name for d in robot.devices_on("sensors")] == ["lidar", "imu"]


def test_defaults_are_inherited_all_the_way_down_and_can_be_overruled() -> None:
    text = BENCH + "\n[motors.left.limits]\ntorque = 0.5\nposition = [-1, 1]\n"
    robot = parse_robot(text)
    left, right = robot.motors["left"].joint, robot.motors["right"].joint
    assert (left.limits.torque, left.limits.velocity, left.limits.position) == (0.5, 20.0, (-1.0, 1.0))
    assert (right.limits.torque, right.limits.position) == (2.0, None)
    assert (left.sign, right.sign, left.gear) == (1, -1, 8.0)


def test_numbers_are_converted_to_the_type_of_their_field() -> None:
    text = changed("command_timeout_ms = 100", "command_timeout_ms = 12.5", changed("gear = 8.0", "gear = 8"))
    robot = parse_robot(f"{text}\n[brain.health]\nrecover_ms = 321\n")
    left = robot.motors["left"].joint
    assert (left.command_timeout, left.gear, type(left.gear)) == (12_500_000, 8.0, float)
    assert robot.brain.health.recover == 321 * MILLISECOND


def test_interfaces_are_replaced_and_wrong_ones_reported() -> None:
    robot = parse_robot(ROVER)
    moved = with_interfaces(robot, {"can0": "socketcan:vcan0", "sensors": "serial:/dev/ttyS7"})
    assert moved.buses["can0"].interface == "socketcan:vcan0"
    assert moved.buses["sensors"].interface == "serial:/dev/ttyS7"
    assert robot.buses["can0"].interface == "twin"
    with pytest.raises(ConfigError) as caught:
        with_interfaces(robot, {"can1": "twin", "can0": "can0", "sensors": "socketcan:can0"})
    text = str(caught.value)
    assert "no bus 'can1': there is can0, sensors; did you mean 'can0'?" in text
    assert 'found "can0", expected "twin" or INTERFACE:CHANNEL, such as "socketcan:can0"' in text
    assert 'found "socketcan:can0", expected "serial:PORT"' in text
    assert with_interfaces(robot, {"can0": "dm-serial:/dev/ttyACM0"})
    with pytest.raises(ConfigError, match="which carries classic CAN only; expected a bus of kind 'can'"):
        with_interfaces(load_robot("diffbot_moteus"), {"can0": "dm-serial:/dev/ttyACM0"})
    with pytest.raises(ConfigError, match="expected usb-VENDOR:PRODUCT:SERIAL, such as usb-0483:5740:3A5F"):
        with_interfaces(robot, {"can0": "slcan:usb-483:5740:3A5F"})


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("slcan:/dev/ttyACM0", "serial:/dev/ttyACM0"),
        ("slcan:/dev/ttyACM0@2000000", "serial:/dev/ttyACM0"),
        ("slcan:usb-0483:5740:3A5F", "serial:usb-0483:5740:3A5F"),
    ],
)
def test_one_interface_for_two_buses_is_a_mistake(one: str, other: str) -> None:
    robot = parse_robot(ROVER)
    text = f'found "{other}", which is the interface of .can0. too; expected one of its own'
    with pytest.raises(ConfigError, match=text):
        with_interfaces(robot, {"can0": one, "sensors": other})
    both = ROVER
    for interface in (one, other):
        both = both.replace('interface = "twin"', f'interface = "{interface}"', 1)
    with pytest.raises(ConfigError, match=text):
        parse_robot(both)
    assert with_interfaces(robot, {"can0": one, "sensors": "serial:/dev/ttyACM1"})


def test_adapters_that_may_be_exchanged_unnoticed_are_a_caution() -> None:
    """Two arms with equal motors: what the machine calls can0 today may be can1 after the next start."""
    second = '[buses.can1]\nkind = "can"\nbitrate = 1_000_000\ninterface = "{}"\n[defaults.motors]'
    arms = changed("[defaults.motors]", second, BENCH)
    arms = changed("address = 2", 'address = 1\nbus = "can1"', arms)

    def found(one: str, other: str, text: str = arms) -> list[str]:
        robot = with_interfaces(parse_robot(text.replace("{}", "twin")), {"can0": one, "can1": other})
        return [each for each in cautions(robot) if "change places" in each]

    (caution,) = found("socketcan:can0", "socketcan:can1")
    assert caution.startswith(
        "can0, can1: socketcan:can0 and socketcan:can1 may change places at the next start"
    )
    assert found("slcan:/dev/ttyACM0@2000000", "slcan:/dev/ttyUSB0")
    assert not found("slcan:usb-0483:5740:1", "slcan:usb-0483:5740:2")
    assert not found("socketcan:can0", "socketcan:can1", changed("address = 1", "address = 3", arms))
    demanded = changed("[motors.left]\n", '[motors.left]\nserial = "12"\n', arms)
    assert not found("socketcan:can0", "socketcan:can1", demanded)


# -- one mistake each --------------------------------------------------------------------------

# fmt: off
POSITIVE = "expected a finite number from "
MISTAKES = [
    # key, what stands in the rover's file, what stands there instead, what is reported
    ("rate_hz", "rate_hz = 200", "rate_hz = 0",
     "found 0, expected a finite number from 10 to 1000 steps per second"),
    ("rate_hz", "rate_hz = 200", "rate_hz = nan", "found nan, expected a finite number"),
    ("rate_hz", "rate_hz = 200", "rate_hz = 1e6", "from 10 to 1000 steps per second"),
    ("rate_hz", "rate_hz = 200", "rate_hz = true", "found true, expected a finite number"),
    ("rate_hz", "rate_hz = 200", "rate_hz = 2026-01-01", "found 2026-01-01, expected a finite number"),
    ("rate", "rate_hz = 200", "rate = 200", "no key 'rate'"),
    ("seed", "rate_hz = 200", "seed = -1", "found -1, expected an integer from 0 to 4294967295"),
    ("seed", "rate_hz = 200", "seed = 9223372036854775808",
     "found an integer of more than 64 bits, expected an int"),
    ("name", 'name = "diffbot"', 'name = "diff/bot"', "expected letters, digits, _ and -"),
    ("name", 'name = "diffbot"', "name = 5", "found 5, expected a string"),
    ("buses.can0.kind", 'kind = "can" ', 'kind = "cam"',
     "found \"cam\", expected 'can' or 'canfd' or 'serial' or 'i2c' or 'camera'; did you mean 'can'?"),
    ("buses.can0.bitrate", "bitrate = 1_000_000", "", "missing; expected an integer"),
    ("buses.can0.bitrate", "bitrate = 1_000_000", "bitrate = 0",
     "found 0, expected an integer from 5000 to 1000000"),
    ("buses.can0.baudrate", "bitrate = 1_000_000", "bitrate = 5000\nbaudrate = 300",
     "a bus of kind 'can' has no baudrate; expected bitrate"),
    ("buses.can0.data_bitrate", 'kind = "can" ', 'kind = "canfd"\ndata_bitrate = 500_000',
     "found 500000, expected at least the bitrate of 1000000"),
    ("buses.can0.transmit_queue", "bitrate = 1_000_000", "bitrate = 1_000_000\ntransmit_queue = 0",
     "found 0, expected an integer from 1 to 10000"),
    ("buses.sensors.transmit_queue", "baudrate = 3_000_000", "baudrate = 3_000_000\ntransmit_queue = 10",
     "a serial bus has no queue of CAN frames; expected no key 'transmit_queue'"),
    ("buses.can0.interface", 'interface = "twin"  ', 'interface = "can0"',
     'expected "twin" or INTERFACE:CHANNEL'),
    ("motors.left.protocol", 'protocol = "odrive_can"', 'protocol = "odrive-can"',
     f"no protocol 'odrive-can'; installed: {INSTALLED}; did you mean 'odrive_can'?"),
    ("motors.left.protocol", 'protocol = "odrive_can"', "", "missing; expected a string"),
    ("motors.left.bus", 'bus = "can0"', 'bus = "can1"',
     "no bus 'can1': there is can0, sensors; did you mean 'can0'?"),
    ("motors.left.bus", 'bus = "can0"', 'bus = "sensors"',
     "odrive_can needs a bus of kind can or canfd, and 'sensors' is serial"),
    ("motors.left.address", "address = 1\n", 'address = "1"\n', 'found "1", expected an integer'),
    ("motors.left.address", "address = 1\n", "address = 1.0\n", "found 1.0, expected an integer"),
    ("motors.left.address", "address = 1\n", "address = -1\n",
     "found -1, expected an integer from 0 to 4294967295"),
    ("motors.left.address", "address = 1\n", "address = 99\n", "it must be 0 to 62"),
    ("motors.right.address", "address = 1\n", "address = 2\n", "'left' has address 2 on bus 'can0' too"),
    ("motors.left.gear", "gear = 8.0", "gear = 0", f"found 0, {POSITIVE}"),
    ("motors.left.gear", "gear = 8.0", "gear = -8.0", f"found -8.0, {POSITIVE}"),
    ("motors.left.gear", "gear = 8.0", "gear = inf", "found inf, expected a finite number"),
    ("motors.left.geer", "gear = 8.0", "geer = 8.0", "did you mean 'gear'?"),
    ("motors.left.sign", "sign = 1 ", "sign = 0 ", "found 0, expected 1 or -1"),
    ("motors.left.sign", "sign = 1 ", "sign = true ", "found true, expected 1 or -1"),
    ("motors.left.silent", 'on_command_timeout = "idle"', 'silent = "idle"',
     "no key 'silent': it is called 'on_command_timeout' now"),
    ("motors.left.on_command_timeout", 'on_command_timeout = "idle"', 'on_command_timeout = "idel"',
     "found \"idel\", expected 'idle' or 'hold'; did you mean 'idle'?"),
    ("motors.left.on_fault", 'on_fault = "stop"', 'on_fault = "ignore"', "expected 'stop' or 'continue'"),
    ("motors.left.command_timeout_ms", "command_timeout_ms = 100", "command_timeout_ms = 0",
     "found 0, expected a finite number of milliseconds from 1 to"),
    ("motors.left.command_timeout_ms", "command_timeout_ms = 100", "command_timeout_ms = inf",
     "found inf, expected a finite number of milliseconds"),
    ("motors.left.command_timeout_ms", "command_timeout_ms = 100", "command_timeout_ms = 1e308",
     "found 1e+308, expected a finite number of milliseconds"),
    ("motors.left.command_timeout_ms", "command_timeout_ms = 100", "command_timeout_ms = 5",
     "the robot steps every 5 ms; expected more"),
    ("motors.left.command_timeout", "command_timeout_ms = 100", "command_timeout = 100",
     "did you mean 'command_timeout_ms' (milliseconds)?"),
    ("motors.left.feedback_timeout_ms", "feedback_timeout_ms = 100", "feedback_timeout_ms = 10",
     "the device reports every 10 ms; expected more"),
    ("motors.left.limits.torque", "torque = 2.0", "torque = 0.0", f"found 0.0, {POSITIVE}"),
    ("motors.left.limits.torque", "torque = 2.0", "", "missing; expected a finite number"),
    ("motors.left.limits.position", "torque = 2.0", "torque = 2.0\nposition = [1, -1]",
     "position is [1, -1], expected the lowest first"),
    ("motors.left.limits.position", "torque = 2.0", "torque = 2.0\nposition = [1]",
     "found an array, expected an array of 2 finite numbers"),
    ("motors.left.limits.position", "torque = 2.0", "torque = 2.0\nposition = [1, inf]",
     "expected an array of 2 finite numbers"),
    ("motors.left.options.watchdog", 'watchdog = "acknowledged"', 'watchdog = "acknowleged"',
     "did you mean 'acknowledged'?"),
    ("motors.left.options.watchdoc", 'watchdog = "acknowledged"', "watchdoc = 1", "did you mean 'watchdog'?"),
    ("motors.left.options.feedback_ms", 'watchdog = "acknowledged"', "feedback_ms = 0",
     "found 0, expected an integer from 1 to 1000"),
    ("motors.left.setings", "[motors.left.options]", "[motors.left.setings]", "did you mean 'settings'?"),
    ("sensors.lidar.protocol", 'protocol = "plain"', 'protocol = "odrive_can"',
     "'odrive_can' is the protocol of a motor here, expected a sensor"),
    ("sensors.lidar.timeout_ms", "timeout_ms = 500", "timeout_ms = 0",
     "found 0, expected a finite number of milliseconds from 1 to 5000"),
    ("sensors.lidar.mount.x", "mount = { x = 0.12,", "mount = { x = nan,",
     "found nan, expected a finite number"),
    ("sensors.lidar.mount.q", "mount = { x = 0.12,", "mount = { q = 0.12,",
     "no key 'q': there is x, y, z, yaw, pitch, roll"),
    ("sensors.left", "[sensors.imu]", "[sensors.left]", "a motor is called 'left' too"),
    ("sensors.all", "[sensors.imu]", "[sensors.all]", "'all' has a meaning of its own"),
    ("sensors.my imu", "[sensors.imu]", '[sensors."my imu"]', "expected a name of letters, digits and _"),
    ("brain.body", 'body = "differential"', 'body = "differental"',
     "; did you mean 'differential'?"),
    ("brain.joints", 'body = "differential"', 'body = "joints"',
     "missing; the body 'joints' expects this table"),
    ("brain.differential.left", 'left = "left"', 'left = "lift"',
     "no motor 'lift': there is left, right; did you mean 'left'?"),
    ("brain.differential.left", 'left = "left"', 'left = "lidar"',
     "'lidar' is a sensor; there is left, right"),
    ("brain.differential.wheel_radius", "wheel_radius = 0.05", "wheel_radius = 0", "wheel_radius"),
    ("brain.differential.wheel_radios", "wheel_radius = 0.05", "wheel_radios = 0.05",
     "did you mean 'wheel_radius'?"),
    ("brian", "[brain]", "[brian]", "did you mean 'brain'?"),
    ("buses.x", "[buses.can0]", "[buses]\nx = 1\n[buses.can0]", "found 1, expected a table [buses.x]"),
]
# fmt: on


@pytest.mark.parametrize(("key", "old", "new", "expected"), MISTAKES)
def test_a_mistake_has_its_line_its_key_and_what_is_right(
    key: str, old: str, new: str, expected: str
) -> None:
    text = changed(old, new)
    found = [line for line in mistakes_in(text) if re.match(rf"r\.toml:\d+: {re.escape(key)}: ", line)]
    assert len(found) == 1, mistakes_in(text)
    assert expected in found[0]
    if "missing" not in expected and "too" not in expected:
        number = int(found[0].split(":")[1])
        assert key.rsplit(".", 1)[-1] in text.splitlines()[number - 1]


def test_all_of_them_at_once_in_the_order_of_the_file() -> None:
    text, keys = ROVER, []
    for old, new, key in [
        ("rate_hz = 200", "rate_hz = inf", "rate_hz"),
        ("office", "ofice", "world"),
        ('bus = "can0"', 'bus = "can7"', "motors.left.bus"),
        ("gear = 8.0   ", 'gear = "8"', "motors.left.gear"),
        ("acceleration = 60.0", "acceleration = 0", "motors.left.limits.acceleration"),
        ('"acknowledged"', "5", "motors.left.options.watchdog"),
        ("sign = -1", "sign = 3", "motors.right.sign"),
        ("timeout_ms = 500", "timeout_ms = -1", "sensors.lidar.timeout_ms"),
        ('right = "right"', 'right = "rihgt"', "brain.differential.right"),
        ("wheel_radius = 0.05", "wheel_radius = -1", "brain.differential.wheel_radius"),
        ("max_linear = 0.6", "max_linear = 0", "brain.differential.max_linear"),
        ("max_angular = 2.0", 'max_angular = "fast"', "brain.differential.max_angular"),
    ]:
        text = changed(old, new, text)
        keys.append(key)
    found = mistakes_in(text + "\n[brain.plan]\n", with_world=True)
    assert [line.split(": ")[1] for line in found] == [*keys, "brain.plan"]
    numbers = [int(line.split(":")[1]) for line in found]
    assert numbers == sorted(numbers)
    assert "did you mean 'office'?" in found[1]
    with pytest.raises(ConfigError) as caught:
        parse_robot(text, "r.toml")
    assert str(caught.value).splitlines() == [
        line for line in found if "brain.plan" not in line and "world" not in line
    ]


@pytest.mark.parametrize(
    ("protocol", "motor", "options", "expected"),
    [
        ("damiao", "left", "reply_id = 2", "0x002 (it would obey what 'left' reports there)"),
        ("damiao", "right", "reply_id = 1", "0x001 ('left' would obey what it reports there)"),
        ("damiao", "left", "reply_id = 0x102", "0x102 (it would obey what 'left' reports there)"),
        ("damiao", "left", "reply_id = 0x12", "left and right would both answer by 0x012, and destroy"),
        ("damiao", "left", "reply_id = 0x101", "reply_id 0x101 of left: the motor itself obeys that id"),
        ("cubemars", "left", "reply_id = 2", "0x002 (it would obey what 'left' reports there)"),
        ("vesc", "left", "host_id = 2", "0x00000802 (it would obey what 'left' reports there)"),
    ],
)
def test_no_motor_may_obey_what_another_of_its_protocol_reports(
    protocol: str, motor: str, options: str, expected: str
) -> None:
    usual = 'mode = "mit"' if protocol == "cubemars" else ""
    text = changed('watchdog = "acknowledged"', usual, changed("odrive_can", protocol, BENCH))
    assert mistakes_in(text) == []
    (mistake,) = mistakes_in(
        changed(f"[motors.{motor}]", f"[motors.{motor}]\noptions = {{ {options} }}", text)
    )
    assert expected in mistake


def test_motors_of_one_protocol_may_report_by_one_id_where_they_name_themselves() -> None:
    """In MIT mode these all answer by id 0, or each by its own; any is taken, or the stated one."""
    text = changed('watchdog = "acknowledged"', 'mode = "mit"', changed("odrive_can", "cubemars", BENCH))
    assert mistakes_in(text) == []
    assert mistakes_in(changed("address = 1", "address = 1\noptions = { reply_id = 1 }", text)) == []
    assert mistakes_in(changed("address = 1", "address = 1\noptions = { reply_id = 0 }", text)) == []


def test_what_a_driver_requires_of_its_devices_together_is_checked() -> None:
    text = resources.find("robots", "diffbot_cia402").read_text("utf-8")
    text = text.replace("sync_ms = 10", "sync_ms = 20", 1).replace("gear = 8.0", "gear = 0.0", 1)
    mistakes = mistakes_in(text)
    assert len(mistakes) == 2
    assert any("motors.left.gear: " in one for one in mistakes)
    found = "buses.can0: cia402: sync_ms must be the same for all drives of one bus: it is 20 for left and 10"
    assert any(found in one for one in mistakes)


def test_a_joint_that_would_run_ahead_of_its_devices_own_ramp_is_refused() -> None:
    text = resources.find("robots", "diffbot_zlac8015d").read_text("utf-8")
    text = changed("steps_per_rpm = 1 ", "acceleration_ms = 1000\nsteps_per_rpm = 1 ", text, times=2)
    left, right = mistakes_in(text)
    number = line_of(text, "acceleration = 60.0")
    assert "motors.right.limits.acceleration: " in right
    assert left == (
        f"r.toml:{number}: motors.left.limits.acceleration: found 60, but the device's own ramp of Velocity "
        "is 31.42 rad/s² at its own shaft; expected at most 31.42, or an option that makes its ramp steeper"
    )


def test_a_driver_that_raises_is_named_with_what_it_raises() -> None:
    def driver(_: object) -> Any:
        raise RuntimeError("boom")

    broken = dataclasses.replace(plugin.load("odrive_can"), driver=driver)
    (mistake,) = mistakes_in(BENCH, lambda name: broken if name == "odrive_can" else plugin.load(name))
    assert "buses.can0: odrive_can is broken: its driver raises RuntimeError: boom" in mistake


def test_a_mistake_in_a_default_is_reported_once_at_its_own_line() -> None:
    text = changed("gear = 8.0", "gear = 0", BENCH)
    number = line_of(text, "gear = 0")
    (mistake,) = mistakes_in(text)
    assert mistake.startswith(f"r.toml:{number}: defaults.motors.gear: found 0, {POSITIVE}")


def test_what_is_not_toml_is_reported_with_its_line() -> None:
    (found,) = mistakes_in(changed("rate_hz = 200", "rate_hz = = 200"))
    assert re.match(r"r\.toml:3: not TOML: .*line 3", found)
    (twice,) = mistakes_in(changed("gear = 8.0", "gear = 8.0\ngear = 9.0"))
    assert "not TOML: Cannot overwrite a value" in twice


@pytest.mark.parametrize(
    "text", ["", "name = 'x'", "motors = 5\nbuses = []\nsensors = 'x'\nbrain = 1\ndefaults = 2"]
)
def test_missing_sections_are_reported(text: str) -> None:
    found = "\n".join(mistakes_in(text))
    for key in ("buses", "motors", "brain"):
        assert re.search(rf"^r\.toml(:\d+)?: {key}", found, re.MULTILINE), found


def test_a_file_that_cannot_be_read_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot be read: .*No such file"):
        load_robot(tmp_path / "none.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match=r"bytes\.toml: is not UTF-8"):
        load_robot(tmp_path / "bytes.toml")


def test_a_missing_world_is_a_mistake_for_a_run_and_not_for_a_replay(tmp_path: Path) -> None:
    text = changed("office", str(tmp_path / "gone.toml"))
    assert mistakes_in(text) == []
    (found,) = mistakes_in(text, with_world=True)
    assert "world: there is no file" in found


@pytest.mark.parametrize(
    ("text", "mistake"),
    [
        ("x = " + "[" * 5000 + "]" * 5000, "nested too deeply"),
        (f"x{'.a' * 50} = 1", "nested too deeply"),
        (f"defaults.motors{'.a' * 5000} = 1\nmotors.m{'.a' * 5000} = 2", "nested too deeply"),
        (f"rate_hz = {'9' * 5000}", "not TOML"),
        (f"rate_hz = 0x{'f' * 5000}", "found an integer of more than 64 bits, expected a finite number"),
        (f"motors.m.limits.position = [0x{'f' * 5000}, 0]", "found an array, expected an array of 2 finite"),
        (f"motors.m.address = 0x{'f' * 5000}", "found an integer of more than 64 bits, expected an integer"),
    ],
    ids=["arrays", "tables", "tables and defaults", "digits", "hexadecimal", "in an array", "address"],
)
def test_depth_and_size_are_mistakes_and_no_crash(text: str, mistake: str) -> None:
    assert any(mistake in one for one in mistakes_in(text))


@settings(deadline=None)
@given(st.text(max_size=300))
def test_any_text_raises_config_error_or_nothing(text: str) -> None:
    assert mistakes_in(text)


@settings(deadline=None, max_examples=40)
@given(
    st.sampled_from(ROVER.splitlines()), st.sampled_from(["", "x = 1", "= 3", "[motors.left]", "bus = {}"])
)
def test_any_line_may_be_wrong(line: str, instead: str) -> None:
    mistakes_in(ROVER.replace(line, instead, 1))


# -- third-party protocols ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class NoOptions:
    """Nothing to be set."""


def no_driver(_: object) -> Any:
    """Return no driver: none of these tests sends."""
    return None


def foreign(**changes: Any) -> Plugin:
    """Return another protocol: the built-in one's spec with some changes."""
    odrive = plugin.load("odrive_can")
    left = parse_robot(ROVER).motors["left"].device

    def spec(device: Device) -> Spec:
        return dataclasses.replace(odrive.spec(dataclasses.replace(left, address=device.address)), **changes)

    return dataclasses.replace(
        odrive, name="foreign", options=NoOptions, settings=NoOptions, spec=spec, driver=no_driver
    )


def foreign_left(text: str, **changes: Any) -> tuple[str, Find]:
    """Return the file with a foreign protocol for the left motor, and what finds it."""
    made = foreign(**changes)
    text = re.sub(r"\[motors.left.options\].*\nwatchdog = .*\n", "", text)
    text = changed('protocol = "odrive_can"', 'protocol = "foreign"', text)
    return text, lambda name: made if name == "foreign" else plugin.load(name)


def with_foreign(text: str, **changes: Any) -> list[str]:
    return mistakes_in(*foreign_left(text, **changes))


NO_IDS: dict[str, Any] = {"sends": (), "expects": (), "obeys_also": ()}


@pytest.mark.parametrize(
    ("key", "action", "changes", "mistake"),
    [
        # at exit, nothing feeds a device's watchdog any more
        ("stop_action", "hold", {"holds_unattended": False}, "without commands from its host"),
        ("stop_action", "brake", {"commands": frozenset({Idle, Torque})}, "takes no velocity to brake by"),
        # while the brain is silent, the joint goes on sending
        ("on_command_timeout", "hold", {"holds_unattended": False}, ""),
    ],
)
def test_an_action_needs_a_device_that_can_do_it(
    key: str, action: str, changes: dict[str, Any], mistake: str
) -> None:
    text = changed(f'{key} = "idle"', f'{key} = "{action}"')
    assert mistakes_in(text) == []
    found = with_foreign(text, **NO_IDS, **changes)
    assert len(found) == bool(mistake)
    for one in found:
        assert f'motors.left.{key}: found "{action}", expected "idle"' in one
        assert mistake in one


SEVERAL = (
    "0x055 (it would obey what 'left' reports there)"
    "; 0x041, 0x043, 0x044, 0x045, … ('left' would obey what it reports there)"
    "; 0x042, 0x047 (each would obey what the other is sent)"
)

SEVERAL_OF_A_MASK = (
    "0x040, 0x041, 0x043, 0x044, … ('left' would obey what it reports there)"
    "; 0x042, 0x047, 0x04B, 0x04C, … (each would obey what the other is sent)"
    "; 0x040…0x04F (it would obey what 'left' is sent)"
)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        # `right` is node 2: it is commanded on 0x42, 0x43 …, and reports on 0x41, 0x43 … when asked there
        ({"sends": (exact(0x41),)}, "0x041 ('left' would obey what it reports there)"),
        # of its node, not its protocol
        ({"sends": (exact(0x5F),)}, "0x05F (it would obey what 'left' is sent)"),
        ({"obeys_also": ((0x42, 0x7FF),)}, "0x042 ('left' would obey what it is sent)"),
        ({"sends": (exact(0x42),)}, "0x042 (each would obey what the other is sent)"),
        ({"expects": (exact(0x42),)}, "0x042 (it would obey what 'left' reports there)"),
        ({"sends": tuple(map(exact, range(0x41, 0x48))), "expects": (exact(0x55),)}, SEVERAL),
        # a command in the upper bits, the node in the lower ones, and a torque between them
        ({"sends": ((0x40, 0x7F0),)}, SEVERAL_OF_A_MASK),
    ],
)
def test_two_protocols_do_not_share_ids_on_a_bus(changes: dict[str, Any], why: str) -> None:
    ids: dict[str, Any] = {"sends": (exact(0x701),), "expects": (exact(0x700),), "obeys_also": ()}
    assert with_foreign(ROVER, **ids) == []
    (found,) = with_foreign(ROVER, **ids | changes)
    found = found.partition(": ")[2]
    assert found == (
        f"motors.right.address: uses CAN ids of 'left' (foreign) on bus 'can0': {why}; "
        "expected another address or bus, or an option that moves its ids"
    )


def test_two_protocols_do_not_report_on_one_id() -> None:
    motors = parse_robot(ROVER).motors
    ids: dict[str, Any] = {"expects": (exact(0x41),), "obeys_also": ()}
    left, right = (
        dataclasses.replace(motor, spec=dataclasses.replace(motor.spec, sends=(exact(number),), **ids))
        for number, motor in enumerate(motors.values())
    )
    conflict = "uses CAN ids of 'left' (odrive_can) on bus 'can0': 0x041 (both report there)"
    other = dataclasses.replace(right, plugin=dataclasses.replace(right.plugin, name="foreign"))
    assert id_conflict(left, other) == conflict


def test_vesc_and_robstride_share_a_bus_where_neither_scans() -> None:
    """And each address is one motor's."""
    text = resources.find("robots", "diffbot_mixed_can").read_text("utf-8")
    assert mistakes_in(text) == []
    (found,) = mistakes_in(text.replace("scan = false", "scan = true", 1))
    assert "uses CAN ids of 'left' (vesc) on bus 'can0': 0x00001102 (each would obey" in found
    (found, *_) = mistakes_in(text.replace("address = 2", "address = 1"))
    assert "it would obey what 'left' reports there" in found


def test_an_id_of_29_bits_is_another_one_than_the_same_number_in_11() -> None:
    """As of an ODrive with is_extended."""
    ids: dict[str, Any] = {"expects": (exact(0x47, extended=True),), "obeys_also": ()}
    assert len(with_foreign(ROVER, **ids, sends=(exact(0x41), exact(0x1041, extended=True)))) == 1
    assert with_foreign(ROVER, **ids, sends=(exact(0x41, extended=True), exact(0x1041, extended=True))) == []
    options = 'watchdog = "acknowledged"'
    extended = changed(options, f'{options}\nfirmware = "0.5"\nis_extended = true')
    old = parse_robot(extended).motors["left"].spec
    assert all(number & EXTENDED_BIT for number, _ in old.sends + old.expects)
    new = parse_robot(ROVER).motors["left"].spec
    assert not any(number & EXTENDED_BIT for number, _ in new.sends + new.expects)


def test_a_classic_device_may_stand_on_an_fd_bus_and_not_the_other_way_round() -> None:
    fd = changed('kind = "can" ', 'kind = "canfd"\ndata_bitrate = 1_000_000')
    assert mistakes_in(fd) == []
    assert with_foreign(fd, **NO_IDS, bus="canfd") == []
    (found,) = with_foreign(ROVER, **NO_IDS, bus="canfd")
    assert "motors.left.bus: foreign needs a bus of kind canfd, and 'can0' is can" in found


def test_who_sends_unasked_is_not_on_a_line_of_questions_and_answers() -> None:
    """A lidar beside motor controllers that speak only when asked."""
    (path,) = [each for each in ROBOTS if each.name == "diffbot_roboclaw.toml"]
    text = path.read_text("utf-8")
    assert mistakes_in(text) == []
    found = mistakes_in(text.replace('bus = "sensors"', 'bus = "motors"'))
    refused = [one for one in found if "sends unasked" in one]
    assert len(refused) >= 2
    for one in refused:
        assert re.search(r"sensors.\w+.bus: plain sends unasked, and would garble the answers of '", one)
        assert one.endswith("(roboclaw) on bus 'motors'; expected a line of its own")


# -- cautions ------------------------------------------------------------------------------------


LATE = (
    "left: the base goes slow when its feedback is older than 10 ms, 0.5 of its feedback_timeout_ms; "
    "the device reports every 10 ms only"
)
UNUSED = "imu: bare joints use no sensor; it is recorded, and a loss of its measurements goes unnoticed"
SENSOR = """
[buses.line]
kind = "serial"
baudrate = 115_200
interface = "twin"
[sensors.imu]
protocol = "plain"
bus = "line"
address = 1
"""


def feedback_timeout(ms: int) -> str:
    return changed("feedback_timeout_ms = 100 ", f"feedback_timeout_ms = {ms} ")


@pytest.mark.parametrize(
    ("text", "starts"),
    [
        (ROVER, []),
        (BENCH, []),
        (changed('watchdog = "acknowledged"', ""), ["left: the device's watchdog is off"]),
        (WATCHED, []),
        (
            changed("velocity = 20.0", "velocity = 1e3", changed("torque = 2.0", "torque = 1e4")),
            [
                "left: its limit of velocity is 8000 rad/s at the device's shaft",
                "left: its limit of torque is 1250 N·m at the device's shaft",
            ],
        ),
        (
            changed("velocity = 20.0", "velocity = 16.0"),
            ["left: its limit of 16 rad/s is below the 16.4 rad/s that max_linear"],
        ),
        (feedback_timeout(21), []),
        (feedback_timeout(20), [LATE]),
        (feedback_timeout(20) + "\n[brain.health]\nslow_age = 0.6\n", []),
        (
            changed("feedback_timeout_ms = 100", "feedback_timeout_ms = 11", BENCH),
            ["left: its target is dropped ", "right: its target is dropped"],
        ),
        (BENCH + SENSOR, [UNUSED]),
    ],
)
def test_cautions(text: str, starts: list[str]) -> None:
    found = cautions(parse_robot(text))
    assert len(found) == len(starts)
    assert all(one.startswith(start) for one, start in zip(found, starts, strict=True))


def test_a_base_that_has_no_sensor_that_sees_obstacles_is_said() -> None:
    """One that is listened to, and never started, is none."""
    text = resources.find("robots", "diffbot_rplidar").read_text("utf-8")
    assert cautions(parse_robot(text)) == []
    silent, blind = cautions(parse_robot(text.replace("start = true", "start = false")))
    assert silent == "rplidar: it is sent nothing, so it does not scan: start = true has it do so"
    assert blind.startswith("diffbot_rplidar: no sensor sees obstacles (it has only rplidar, imu): the base")


SCALED = (
    ("diffbot", "gear = 8.0", "gear = 1"),
    ("diffbot_vesc", "pole_pairs = 15", "options.pole_pairs = 7"),
    ("diffbot_vesc", "torque_constant = 0.5", "options.torque_constant = 0.05"),
    ("diffbot_vesc", "min_erpm = 0.0", "options.min_erpm = 0.0"),
    ("diffbot_robstride", 'model = "RS02"', 'options.model = "RS02"'),
    ("diffbot_robomaster", 'model = "C620"', 'options.model = "C620"'),
    ("diffbot_cubemars", "pole_pairs = 21", "options.pole_pairs = 21"),
    ("diffbot_cubemars", "gear = 9.0", "options.gear = 9.0"),
    ("diffbot_cubemars", "torque_constant = 0.82", "options.torque_constant = 0.82"),
    ("diffbot_myactuator", "torque_constant = 1.0", "options.torque_constant = 1.0"),
    ("diffbot_zlac8015d", "steps_per_rpm = 1", "options.steps_per_rpm = 1"),
    ("diffbot_zlac8015d", "counts = 4096", "options.counts = 4096"),
)
"""Robot, line of its left motor, and what is assumed without it."""


@pytest.mark.parametrize(("robot", "line", "assumed"), SCALED, ids=[f"{r}-{x}" for r, x, _ in SCALED])
def test_a_scale_that_nobody_states_is_a_caution(robot: str, line: str, assumed: str) -> None:
    text = resources.find("robots", robot).read_text()
    assert not [one for one in cautions(parse_robot(text)) if "is assumed" in one]
    (found,) = [one for one in cautions(parse_robot(changed(line, "", text))) if "is assumed" in one]
    assert found.startswith(f"left: {assumed} is assumed")


def test_a_scale_that_the_device_tells_or_that_is_a_default_of_the_file_is_no_caution() -> None:
    asked = changed('model = "4310"', "", resources.find("robots", "diffbot_damiao").read_text())
    assert cautions(parse_robot(asked)) == []
    everywhere = changed("gear = 8.0", "", ROVER, times=2) + "\n[defaults.motors]\ngear = 8.0\n"
    assert cautions(parse_robot(everywhere)) == []


@pytest.mark.parametrize("path", ROBOTS, ids=lambda path: path.stem)
def test_every_shipped_robot_states_its_scales(path: Path) -> None:
    assert not any(device.assumed for device in load_robot(path).devices())


JOINTED = changed("torque = 2.0", "torque = 2.0\nposition = [-1.0, 1.0]")


@pytest.mark.parametrize(
    ("text", "starts"),
    [
        (JOINTED, 'left: by stop_action = "idle" nothing holds its load'),
        (changed('stop_action = "idle"', 'stop_action = "brake"', JOINTED), 'left: by stop_action = "brake"'),
        (changed('stop_action = "idle"', 'stop_action = "idle"\nunattended = "released"', JOINTED), ""),
        (
            changed('stop_action = "idle"', 'stop_action = "hold"', JOINTED),
            "left: it holds at a stop, but when",
        ),
        (changed('"idle"', '"hold"', JOINTED, times=2), ""),
    ],
)
def test_a_joint_whose_load_falls_is_a_caution(text: str, starts: str) -> None:
    found = cautions(parse_robot(text))
    assert [one for one in found if not one.startswith(starts)] == []
    assert len(found) == bool(starts)


def mixed_cautions(text: str, **changes: Any) -> list[str]:
    """Return the cautions of a robot whose left motor has a foreign protocol, with ids of its own."""
    own: dict[str, Any] = {"sends": (exact(0x701),), "expects": (exact(0x700),), "receives_also": ()}
    own["obeys_also"] = ()
    text, find = foreign_left(text, **own | changes)
    return [found for found in cautions(parse_robot(text, find=find)) if "watchdog" not in found]


NARROW = "left: its device reports at most 12.5 rad at its own shaft, and no position beyond; "
SOON = "without limits of position it gets there in 0.0781 s: give it limits of position"
FAR = "its limits of position reach 12.8 rad: narrow its limits of position"


@pytest.mark.parametrize(
    ("limits", "most", "start"),
    [
        (None, 12.5, NARROW + SOON),
        (None, 1e6, ""),  # in more than an hour
        ((-1.5, 1.5), 12.5, ""),
        ((-1.6, 1.5), 12.5, NARROW + FAR),
        ((-1.6, 1.5), 3.4e38, ""),
    ],
)
def test_a_joint_that_can_turn_past_what_its_device_reports(
    limits: tuple[float, float] | None, most: float, start: str
) -> None:
    """At a gear of 8 and 20 rad/s."""
    robot = parse_robot(ROVER)
    left = robot.motors["left"]
    ranges = left.spec.ranges | {"Feedback.position": Range(-most, most + 1.0, 2e-4)}
    joint = dataclasses.replace(left.joint, limits=dataclasses.replace(left.joint.limits, position=limits))
    left = dataclasses.replace(left, joint=joint, spec=dataclasses.replace(left.spec, ranges=ranges))
    every = cautions(dataclasses.replace(robot, motors=robot.motors | {"left": left}))
    found = [one for one in every if one.startswith(NARROW)]
    assert [one.startswith(start) for one in found] == [True] * bool(start)


FD = 'kind = "canfd"\ndata_bitrate = 5_000_000'


def test_classic_can_beside_can_fd_is_a_caution_until_acknowledged() -> None:
    text = changed('kind = "can" ', FD)
    assert mixed_cautions(text) == []  # all of it classic
    (found,) = mixed_cautions(text, bus="canfd")
    assert found.startswith(
        "can0: left uses CAN FD, and right classic CAN only; the controller of right must"
    )
    assert found.endswith('If so, write shared_bus = "acknowledged" under [buses.can0]')
    assert mixed_cautions(changed('kind = "can" ', f'{FD}\nshared_bus = "acknowledged"'), bus="canfd") == []


def test_reports_that_another_driver_mistakes_are_a_caution_until_acknowledged() -> None:
    """ODrive's driver decodes every heartbeat, 0x01 in the low five bits, of any node."""
    expects = (exact(0x181), exact(0x582), exact(0x701))
    (found,) = mixed_cautions(ROVER, expects=expects, sends=(exact(0x202),))
    assert found.startswith("left: odrive_can takes its frames on 0x181, 0x701 for messages of its own kind")
    acknowledged = changed('kind = "can" ', 'kind = "can"\nshared_bus = "acknowledged"')
    assert mixed_cautions(acknowledged, expects=expects) == []
    (found,) = mixed_cautions(ROVER, receives_also=((0x41, 0x7FF), (0x55, 0x7FF)))
    assert found.startswith("right: foreign takes its frames on 0x041, 0x055 for messages")


def numbers_of(robot: Robot) -> list[str]:
    limits = [motor.joint.limits for motor in robot.motors.values()]
    return [f"{one:g}" for limit in limits for one in (limit.velocity, limit.acceleration, limit.torque)]


@pytest.mark.sample(8)
@pytest.mark.parametrize("path", ROBOTS, ids=lambda path: path.stem)
def test_the_description_names_everything(path: Path) -> None:
    robot = load_robot(path)
    found = describe(robot)
    for name in (*robot.buses, *robot.motors, *robot.sensors, *numbers_of(robot), robot.brain.body.kind):
        assert name in found
    assert max(map(len, found.splitlines())) < 140


def test_the_description_has_the_cautions_and_the_bus_load() -> None:
    found = describe(parse_robot(changed('watchdog = "acknowledged"', "")))
    assert "cautions:\n  left: the device's watchdog is off" in found
    # two motors, a command every 5 ms and a report every 10 ms each: 600 frames of 125 bits in 1 Mbit
    assert "at least 8 %" in found


# -- the topics of a bag ---------------------------------------------------------------------------

TABLE = WITH_BAG[WITH_BAG.index("[bag]") :]
FIRST = WITH_BAG[: WITH_BAG.index("[bag]")].count("\n") + 2
"""The line of the table's first key."""


def test_a_complete_table_of_topics() -> None:
    bag = parse_robot(WITH_BAG).bag
    assert bag == BagTopics("/odom", {"imu": "/imu/data"}, "/fix")
    assert list(bag.parts()) == [("/odom", "odometry"), ("/imu/data", "sensors.imu"), ("/fix", "truth")]


def test_a_minimal_table_of_topics() -> None:
    bag = parse_robot(WITH_BAG.replace(TABLE, '[bag]\nodometry = "/o"\n')).bag
    assert bag == BagTopics("/o")
    assert list(bag.parts()) == [("/o", "odometry")]


def test_without_a_table_there_are_no_topics() -> None:
    assert parse_robot(WITH_BAG.replace(TABLE, "")).bag is None
    assert load_robot("diffbot").bag is None


NO_MOTION = (
    "bag.odometry: missing; expected a topic, or under sensors a lidar whose scans show how the base moved"
)
BAG_MISTAKES = [
    ("[bag]\n", [f"r.toml:{{}}: {NO_MOTION}"]),
    ("[bag]\nodometry = 3\n", ["r.toml:{1}: bag.odometry: found 3, expected a string"]),
    (
        '[bag]\nodometry = "/o"\nimu = "/i"\n',
        [
            f"r.toml:{{2}}: bag.imu: no key 'imu': there is {', '.join(keys(BagTopics))}",
        ],
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


@pytest.mark.parametrize(("table", "mistakes"), BAG_MISTAKES)
def test_every_mistake_in_topics_is_reported_at_its_place(table: str, mistakes: list[str]) -> None:
    lines = [FIRST - 1 + number for number in range(5)]
    expected = [text.replace("{}", str(lines[0])).format(*lines) for text in mistakes]
    assert mistakes_in(WITH_BAG.replace(TABLE, table)) == expected


def test_a_value_instead_of_the_table_of_topics() -> None:
    found = mistakes_in("bag = 3\n" + WITH_BAG.replace(TABLE, ""))
    assert found == ["r.toml:1: bag: found 3, expected a table"]


def test_the_description_has_the_topics_and_the_mounting_of_the_imu() -> None:
    found = describe(load_robot("husky"))
    assert "0, -0.3, 0.52 m  -1.5708 rad, pitch 0, roll 1.5708  500 ms" in found
    assert "odometry     /husky_velocity_controller/odom\nsensors.imu  /imu/data\ntruth        /fix" in found
    assert "/odom" not in describe(load_robot("diffbot"))


def test_bare_joints_need_no_bag() -> None:
    (found,) = mistakes_in(BENCH + '\n[bag]\nodometry = "/o"\n')
    assert found.endswith("bag: a bag moves a base, and the body is 'joints'; expected no such table")


# -- lines of keys, and dataclasses from tables ----------------------------------------------------


def test_lines_of_tables_and_keys() -> None:
    text = """# comment = 1
a = 1
[b.c]   # header
"quoted key" = 2
d.e = 3
text = '''
no = 5
'''
list = [
  "x = 1",
]
[ f . 'g' ]
inline = { x = 1 }
"""
    assert lines(text) == {
        ("a",): 2,
        ("b",): 3,
        ("b", "c"): 3,
        ("b", "c", "quoted key"): 4,
        ("b", "c", "d"): 5,
        ("b", "c", "d", "e"): 5,
        ("b", "c", "text"): 6,
        ("b", "c", "list"): 9,
        ("f",): 12,
        ("f", "g"): 12,
        ("f", "g", "inline"): 13,
    }


class Colour(StrEnum):
    RED = "red"
    GREEN = "green"


@dataclass(frozen=True, slots=True)
class Inner:
    a: float = 1.0
    b: float = 2.0
    patience: Duration = 3 * MILLISECOND

    def __post_init__(self) -> None:
        if self.a <= 0:
            raise Invalid(("a", f"a must be above 0, not {self.a}"))
        if self.b <= 0 or self.patience <= 0:
            raise Invalid(("b", "b must be above 0"), ("patience", "patience must be above 0"))


@dataclass(frozen=True, slots=True)
class Outer:
    count: int
    inner: Inner = field(default_factory=Inner)
    perhaps: Inner | None = None
    named: dict[str, Inner] = field(default_factory=dict)
    colour: Colour = Colour.RED
    mode: Literal["on", "off"] = "on"
    words: tuple[str, ...] = ()
    pair: tuple[float, float] = (0.0, 1.0)
    either: int | str = 0
    length: Annotated[float, Bounds(0.0, 100.0, "m")] = 0.0
    items: tuple[Inner, ...] = ()
    modes: tuple[Literal["x", "y"], ...] = ()
    share: Annotated[float, Bounds(0.0, 0.9)] = 0.0
    thing: Inner | bool = False


def made(table: object) -> tuple[Outer | None, list[str]]:
    mistakes = Mistakes("f", "")
    outer = build(Outer, table, ("t",), mistakes)
    return outer, [str(one).removeprefix("f: t.").removeprefix("f: ") for one in mistakes.error().mistakes]


def test_a_dataclass_from_a_table() -> None:
    table = {
        "count": 3,
        "inner": {"a": 5, "patience_ms": 2.5},
        "perhaps": {},
        "named": {"x": {"b": 7}},
        "colour": "green",
        "mode": "off",
        "words": ["a", "b"],
        "pair": [1, 2],
        "either": "x",
        "items": [{}, {"a": 2}],
        "modes": ["y"],
        "share": 0,
        "thing": {"b": 3},
    }
    outer, mistakes = made(table)
    assert mistakes == []
    assert outer == Outer(
        3,
        Inner(5.0, 2.0, 2_500_000),
        Inner(),
        {"x": Inner(b=7.0)},
        Colour.GREEN,
        "off",
        ("a", "b"),
        (1.0, 2.0),
        "x",
        items=(Inner(), Inner(a=2.0)),
        modes=("y",),
        thing=Inner(b=3.0),
    )


def test_every_mistake_in_a_dataclass() -> None:
    names = ", ".join(one.name for one in dataclasses.fields(Outer))
    outer, mistakes = made(
        {
            "inner": {"a": -1, "b": 0, "patience_ms": 0, "c": 1},
            "perhaps": {"patience": 5},
            "named": {"x": {"a": "1"}},
            "colour": "blue",
            "mode": "of",
            "words": ["a", 1],
            "pair": [1, 2, 3],
            "either": 1.5,
            "length": "long",
            "items": [{"a": 1, "q": 2}],
            "modes": "x",
            "share": 1,
            "thing": {"b": "3"},
            "cuont": 1,
        }
    )
    assert outer is None
    assert sorted(mistakes) == sorted(
        [
            "perhaps.patience: unknown key; did you mean 'patience_ms' (milliseconds)?",
            "count: missing; expected an integer",
            "inner.c: no key 'c': there is a, b, patience_ms",
            'named.x.a: found "1", expected a finite number',
            "colour: found \"blue\", expected 'red' or 'green'",
            "mode: found \"of\", expected 'on' or 'off'; did you mean 'off'?",
            "words: found an array, expected an array of strings",
            "pair: found an array, expected an array of 2 finite numbers",
            "either: found 1.5, expected an integer or a string",
            'length: found "long", expected a finite number from 0 to 100 m',
            "items: found an array, expected an array of tables",
            "modes: found \"x\", expected an array of 'x' or 'y'",
            "share: found 1, expected a finite number from 0 to 0.9",
            "thing: found a table, expected a table or true or false",
            f"cuont: no key 'cuont': there is {names}; did you mean 'count'?",
            "inner.a: a must be above 0, not -1.0",
            "inner.b: b must be above 0",
            "inner.patience_ms: patience must be above 0",
        ]
    )


@dataclass(frozen=True, slots=True)
class Related:
    radius: float
    gear: Annotated[float, Bounds(1.0, 100.0)] = 1.0
    wait: Duration = MILLISECOND
    inner: Inner = field(default_factory=Inner)

    def __post_init__(self) -> None:
        too_long = "radius and gear allow less; see inner" if self.wait > SECOND else ""
        check(
            self,
            ("gear", "with this radius, gear must be at most 5" if self.gear > 5.0 / self.radius else ""),
            ("wait", too_long),
            ("inner.b", "gear and radius need another" if self.inner.b == self.radius else ""),
            ("", "radius is one of a kind" if self.radius == 0.5 else ""),
        )


@pytest.mark.parametrize(
    ("values", "key", "text"),
    [
        ("gear = 6.0", "t.gear", "with this radius, gear must be at most 5"),
        ("wait_ms = 2000", "t.wait_ms", "radius and gear allow less; see inner"),
        ("[t.inner]\nb = 1.0", "t.inner.b", "gear and radius need another"),
        ("gear = 0.0", "t.gear", "found 0.0, expected a finite number from 1 to 100"),
    ],
)
def test_what_several_fields_are_wrong_about_has_the_key_and_line_of_the_one_that_is_meant(
    values: str, key: str, text: str
) -> None:
    """Whatever the sentence says: no key is looked for in it, and it is not cut."""
    source = f"[t]\nradius = 1.0\n{values}\n"
    mistakes = Mistakes("f", source)
    assert build(Related, tomllib.loads(source)["t"], ("t",), mistakes) is None
    line = source.splitlines().index(values.splitlines()[-1]) + 1
    assert [(one.key, one.line, one.text) for one in mistakes.error().mistakes] == [(key, line, text)]


def test_what_is_wrong_with_a_whole_table_is_reported_there() -> None:
    mistakes = Mistakes("f", "")
    assert build(Related, {"radius": 0.5}, ("t",), mistakes) is None
    assert str(mistakes.error()) == "f: t: radius is one of a kind"


@pytest.mark.parametrize(
    ("kind", "table", "key", "text"),
    [
        (Lidar, {"sweep": False, "clockwise": True}, "clockwise", "what hands on its beams as they come has"),
        (plugin.load("cubemars").options, {"mode": "mit", "model": "AKE80-8"}, "model", "known in mode mit"),
        (plugin.load("dynamixel").options, {"model": "XL"}, "model", "no model 'XL'; there are"),
    ],
)
def test_a_sentence_that_begins_with_another_field_or_has_two_parts(
    kind: type, table: dict[str, object], key: str, text: str
) -> None:
    mistakes = Mistakes("f", "")
    assert build(kind, table, (), mistakes) is None
    (one,) = mistakes.error().mistakes
    assert (one.key, text in one.text) == (key, True)


def test_what_a_protocol_objects_to_is_reported_at_the_option_or_the_address() -> None:
    damiao = changed('watchdog = "acknowledged"', "reply_id = 0x101", changed("odrive_can", "damiao", BENCH))
    assert any(".options.reply_id: reply_id 0x101" in each for each in mistakes_in(damiao))
    far = changed("address = 1\n", "address = 999\n", BENCH)
    assert any("motors.left.address: address 999" in each for each in mistakes_in(far))


@pytest.mark.parametrize("table", [None, 5, "x", []])
def test_a_value_instead_of_a_table_is_reported(table: object) -> None:
    assert made(table) == (None, [f"t: found {shown(table)}, expected a table"])


def test_a_dataclass_that_no_file_can_fill_is_reported() -> None:
    @dataclass
    class Odd:
        thing: Mistakes

    mistakes = Mistakes("f", "")
    assert build(Odd, {}, ("t",), mistakes) is None
    assert "Odd cannot be filled from a file" in str(mistakes.error())


def test_more_than_256_motors_are_one_mistake() -> None:
    """Not one more for each wheel, limit and reference that names a motor beyond."""
    names = [f"m{n}" for n in range(300)]
    motors = "".join(f"[motors.{name}]\naddress = {n}\n" for n, name in enumerate(names))
    text = BENCH[: BENCH.index("[motors.")] + motors
    text += f'[brain]\nbody = "joints"\n[brain.joints]\nmotors = {names}\n'
    (found,) = mistakes_in(text)
    assert found.endswith("motors: found 300 tables, expected at most 256")


@pytest.mark.parametrize(
    ("word", "right"),
    [
        ("candle:0", "socketcan:can0"),
        ("gs_usb:0", "socketcan:can0"),
        ("canable:/dev/ttyACM0", "slcan:/dev/ttyACM0"),
        ("waveshare:/dev/ttyUSB0", "seeedstudio:/dev/ttyUSB0"),
    ],
)
def test_an_adapter_by_the_word_that_people_have_for_it_is_pointed_to_ours(word: str, right: str) -> None:
    (found,) = mistakes_in(changed('interface = "twin"', f'interface = "{word}"'))
    assert right in found


def test_paths_in_a_file_count_from_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a robot's world and plant, of a world's mission, of a plant's URDF, whatever the working folder."""
    here, elsewhere = tmp_path / "robots", tmp_path / "elsewhere"
    here.mkdir()
    elsewhere.mkdir()
    for kind, name in (("worlds", "workshop"), ("plants", "arm"), ("missions", "grasp")):
        (here / f"own_{name}.toml").write_text(resources.find(kind, name).read_text())  # type: ignore[arg-type]
    world, plant = here / "own_workshop.toml", here / "own_arm.toml"
    world.write_text(world.read_text().replace('mission = "grasp"', 'mission = "own_grasp.toml"'))
    plant.write_text(plant.read_text().replace('urdf = "arm.urdf"', 'urdf = "own.urdf"'))
    arm = resources.find("robots", "arm")
    (here / "own.urdf").write_text(arm.with_suffix(".urdf").read_text())
    text = arm.read_text().replace('urdf = "arm.urdf"', 'urdf = "own.urdf"')
    text = text.replace('world = "workshop"', 'world = "own_workshop.toml"')
    (here / "own.toml").write_text(text.replace('plant = "arm"', 'plant = "own_arm.toml"'))
    monkeypatch.chdir(elsewhere)
    robot = load_robot(here / "own.toml")
    assert (robot.world, robot.plant) == (str(world), str(plant))
    scene, linked = load_world(world), load_plant(plant)
    assert isinstance(scene, SceneFile)
    assert isinstance(linked, LinkedFile)
    assert load_mission(scene.mission, robot).steps
    assert linked.urdf == str(here / "own.urdf")


@pytest.mark.parametrize("name", ["robot.toml", "world.toml", "own.urdf", "mission.toml"])
def test_a_mark_of_an_editor_before_the_first_character_is_read_over(tmp_path: Path, name: str) -> None:
    arm = resources.find("robots", "arm")
    texts = {
        "robot.toml": arm.read_text().replace('world = "workshop"', 'world = "world.toml"'),
        "world.toml": resources.find("worlds", "workshop").read_text(),
        "own.urdf": arm.with_suffix(".urdf").read_text(),
        "mission.toml": resources.find("missions", "grasp").read_text(),
    }
    texts["robot.toml"] = texts["robot.toml"].replace('urdf = "arm.urdf"', 'urdf = "own.urdf"')
    for each, text in texts.items():
        (tmp_path / each).write_text(text, encoding="utf-8-sig" if each == name else "utf-8")
    robot = load_robot(tmp_path / "robot.toml")
    assert isinstance(load_world(tmp_path / "world.toml"), SceneFile)
    assert load_mission(str(tmp_path / "mission.toml"), robot).steps
