"""What is configured on the motors: what is found, what is written, and what never is."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from gateway.config import load_robot, parse_robot
from gateway.core.guard import decoder_of
from gateway.core.robot import TWIN, Robot
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.runtime import configuration
from gateway.runtime.configuration import Interrupted, Motors, Reading
from gateway.runtime.session import Session, open_session
from protocols.messages import Mode, ReadParameter, Velocity, WriteParameter
from tests.gateway.rig import BENCH
from tests.sampled import sampled

ROBOTS = sorted({path.stem for path in Path("fixtures/robots").glob("*.toml")} - {"twelve"})  # six of bench
SIMULATED = [name for name in ROBOTS if all(bus.interface == TWIN for bus in load_robot(name).buses.values())]
ENDPOINTS = """
[defaults.motors.options]
watchdog = "acknowledged"
endpoints_version = "0.6.10"
endpoints = ["axis0.config.enable_watchdog 11 bool", "axis0.config.watchdog_timeout 12 float",
    "axis0.controller.config.vel_limit 13 float", "axis0.trap_traj.config.vel_limit 14 float",
    "axis0.config.can.node_id 15 uint32", "axis0.config.motor.current_soft_max 16 float",
    "vbus_voltage 17 float"]
"""
ODRIVE = BENCH.replace('options = { watchdog = "acknowledged" }', "") + ENDPOINTS
CIA402 = BENCH.replace("odrive_can", "cia402").replace('options = { watchdog = "acknowledged" }', "")
DAMIAO = CIA402.replace("cia402", "damiao").replace("gear = 8.0", "gear = 1.0")
MCU = """
name = "mcu"
[buses.line]
kind = "serial"
baudrate = 1_000_000
interface = "twin"
[motors.left]
protocol = "plain"
bus = "line"
address = 1
limits = { velocity = 20.0, acceleration = 60.0, torque = 2.0 }
options = { kind = "motor" }
[brain]
body = "joints"
[brain.joints]
motors = ["left"]
"""


def with_settings(text: str, settings: str, motor: str = "left") -> Robot:
    """Return the robot with these settings on one device, as the maker's tool has left it."""
    return parse_robot(text + f"\n[motors.{motor}.settings]\n{settings}\n")


@contextmanager
def running(robot: Robot, record: Path | None = None) -> Iterator[tuple[Session, Motors]]:
    alone = configuration.motors_only(robot)
    with open_session(alone, simulated=True, record=record) as session, closing(Motors(session)) as motors:
        yield session, motors


def arm(session: Session, motors: Motors) -> None:
    session.submit(Velocity("left", 1.0))
    for _ in range(100):
        motors.ask([ReadParameter("left", "PMAX")])
        if session.joints["left"].mode is Mode.ARMED:
            return
    pytest.fail("it does not arm")


def sent(robot: Robot, record: Path) -> tuple[list[bool], list[object]]:
    """Return of each frame that was sent whether it is read-only, and what the devices obeyed of all."""
    harmless, obeyed = list[bool](), list[object]()
    decoders = {bus: decoder_of(robot, bus) for bus in robot.buses}
    for tick in read_recording(record).ticks:
        for packet in tick.outputs.packets:
            obeyed += decoders[packet.bus].decode(packet.t, packet.frame)
            specs = [one.spec for one in robot.motors.values() if one.bus == packet.bus]
            harmless.append(any(spec.read_only(packet.frame) for spec in specs))
    return harmless, obeyed


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", sampled(SIMULATED, 4))
def test_each_shipped_robot_is_read_without_a_frame_that_does_anything(name: str, tmp_path: Path) -> None:
    robot = configuration.motors_only(load_robot(name))
    with running(robot, tmp_path / "r.mcap") as (_, motors):
        readings = motors.read()
    assert {n: list(each.values) for n, each in readings.items()} == {
        n: list(motor.spec.configuration) for n, motor in robot.motors.items()
    }
    assert configuration.against_robot(robot, readings)[0] == []
    harmless, obeyed = sent(robot, tmp_path / "r.mcap")
    assert harmless or not any(each.values for each in readings.values())
    assert all(harmless)
    assert obeyed == []


@pytest.mark.sample(3)
@pytest.mark.parametrize(
    ("text", "stated", "device", "expected"),
    [  # what the robot file states, what its maker's tool has left on the device
        (ODRIVE, "enable_watchdog = true\nwatchdog_timeout = 0.1", "watchdog_timeout = 0.1", "watchdog = 0"),
        (ODRIVE, "", "vel_limit = 2.0", "the device allows only 1.571 rad/s at the joint"),
        (ODRIVE, "", "current_soft_max = 3.0", "0.7351 N·m at the joint, whose limit is 2"),
        (MCU, "", "watchdog_ms = 0.0", "watchdog_ms = 0: the robot file has 100"),
        (MCU, "", "torque_limit = 1.0", "allows only 1 N·m"),
        (CIA402, "", "abort_connection = 0", "the robot file has 1"),
        (CIA402, "", "encoder_increments = 4096", "left: it belongs to the encoder"),
        (CIA402, "", "max_motor_speed = 1000", "13.09 rad/s at the joint, whose"),
        (DAMIAO, "OT_Value = 90.0", "", "OT_Value = 100: the robot file has 90"),
    ],
)
def test_a_device_that_is_configured_otherwise_is_found(
    text: str, stated: str, device: str, expected: str
) -> None:
    with running(with_settings(text, device)) as (_, motors):
        readings = motors.read()
    found, _ = configuration.against_robot(with_settings(text, stated), readings)
    assert [expected in str(each) for each in found] == [True]


def test_what_the_driver_writes_before_it_arms_is_no_difference() -> None:
    robot = with_settings(DAMIAO, "timeout_ms = 50.0")
    with running(robot) as (session, motors):
        before = motors.read()
        arm(session, motors)
        after = motors.read()
    assert (before["left"].values["TIMEOUT"], after["left"].values["TIMEOUT"]) == (1000, 2000)
    assert configuration.against_dump(robot, after, before) == []


def test_what_differs_is_restored_read_back_and_saved_and_what_is_protected_is_left(tmp_path: Path) -> None:
    robot, lines = parse_robot(ODRIVE), list[str]()
    path = "axis0.controller.config.vel_limit"
    with running(robot, tmp_path / "r.mcap") as (_, motors):
        now = motors.read()
        dump = {"left": replace(now["left"], values=now["left"].values | {path: 30.0, "gone": 1.0})}
        dump["left"].values["axis0.config.can.node_id"] = 9.0
        differences = configuration.against_dump(robot, now, dump)
        assert configuration.restore(motors, differences, lines.append)
        again = configuration.against_dump(robot, motors.read(), dump)
    assert lines == [f"left.{path}: written: 30", "left: saved"]
    assert [(each.parameter, each.left) for each in again] == [
        ("gone", configuration.NO_PARAMETER),
        ("axis0.config.can.node_id", "address or bit rate: a mistake ends all communication"),
    ][::-1]
    _, obeyed = sent(configuration.motors_only(robot), tmp_path / "r.mcap")
    assert {each.parameter for each in obeyed if isinstance(each, WriteParameter)} == {path}


def test_a_value_that_the_device_does_not_keep_is_not_saved() -> None:
    robot, lines = parse_robot(DAMIAO), list[str]()
    with running(robot) as (_, motors):
        now = motors.read()
        dump = {"left": replace(now["left"], values={"SN": 1.0, "PMAX": 10.0, "Rs": 2.0})}
        wrong = [replace(each, left="") for each in configuration.against_dump(robot, now, dump)]
        assert not configuration.restore(motors, wrong, lines.append)
    assert [line.partition(": ")[2] for line in lines] == [
        "SN is read only",
        "written: 10",
        "Rs is read only",
        "not saved: what was written is lost when it is switched off",
    ]


def test_nothing_is_written_to_a_motor_that_is_armed(tmp_path: Path) -> None:
    robot = parse_robot(DAMIAO)
    with running(robot, tmp_path / "r.mcap") as (session, motors):
        now = motors.read()
        dump = {"left": replace(now["left"], values={"PMAX": 10.0})}
        arm(session, motors)
        differences = configuration.against_dump(robot, now, dump)
        with pytest.raises(UserError, match="nothing is written: left is armed; disarm it first"):
            configuration.restore(motors, differences, pytest.fail)
        assert motors.write("left", "PMAX", 10.0) == "left is armed"
    _, obeyed = sent(configuration.motors_only(robot), tmp_path / "r.mcap")
    assert "PMAX" not in {each.parameter for each in obeyed if isinstance(each, WriteParameter)}


def test_an_interrupted_restore_saves_nothing(tmp_path: Path) -> None:
    robot = parse_robot(DAMIAO)
    with running(robot, tmp_path / "r.mcap") as (session, motors):
        now = motors.read()
        dump = {"left": replace(now["left"], values={"OT_Value": 90.0, "PMAX": 10.0})}
        differences = configuration.against_dump(robot, now, dump)
        with pytest.raises(Interrupted, match="interrupted: SIGINT"):
            configuration.restore(motors, differences, lambda _: session.leave("SIGINT"))
    _, obeyed = sent(configuration.motors_only(robot), tmp_path / "r.mcap")
    assert obeyed == [WriteParameter("left", "OT_Value", 90.0)]


def test_a_dump_holds_every_number_and_any_text(tmp_path: Path) -> None:
    robot = parse_robot(CIA402)
    with running(robot) as (_, motors):
        readings = motors.read()
    readings["left"].firmware = 'a "b" \\ \x7f \x1b[31m\n \N{WHITE SMILING FACE}'
    readings["right"].not_read["1018"] = "no reply\r"
    path = tmp_path / "dump.toml"
    path.write_text(configuration.dump_text(robot, readings), encoding="utf-8")
    saved = configuration.read_dump(path, robot)
    assert {name: each.values for name, each in saved.items()} == {n: r.values for n, r in readings.items()}
    assert configuration.same_devices(readings, saved) == []
    table = tomllib.loads(path.read_text(encoding="utf-8"))["motors"]
    assert table["left"]["firmware"] == readings["left"].firmware
    assert table["right"]["not_read"] == readings["right"].not_read


@pytest.mark.parametrize(
    ("now", "saved", "expected"),
    [
        ((1, 7), (2, 7), ""),
        ((1, 7), (1, 8), "the device has the serial number 7, the dump is of 8"),
        ((1, None), (1, 8), ""),
        ((2, None), (1, 8), "no serial number shows that it is the same device"),
    ],
)
def test_another_device_is_told_by_its_serial_number_or_else_its_address(
    now: tuple[int, int | None], saved: tuple[int, int | None], expected: str
) -> None:
    wrong = configuration.same_devices({"left": Reading("x", *now)}, {"left": Reading("x", *saved)})
    assert (len(wrong), expected in "".join(wrong)) == (bool(expected), True)
    shared = Reading("x", *now, shared=True)
    assert "more than one device" in configuration.same_devices({"left": shared}, {"left": shared})[0]


def test_a_silent_motor_is_named_and_not_written_to() -> None:
    robot = parse_robot(DAMIAO)
    with running(robot) as (session, motors):
        assert session.twins is not None
        session.twins.disconnect("left")
        now = motors.read()
        dump = {"left": replace(now["right"], values={"PMAX": 10.0})}
        found, _ = configuration.against_robot(robot, now)
        left_out = configuration.against_dump(robot, now, dump)
        assert motors.write("left", "PMAX", 10.0) == "left is offline"
    silent = "not read: no reply of the device"
    assert [str(each) for each in found] == [f"left.{name} = {silent}" for name in ("PMAX", "VMAX", "TMAX")]
    assert [each.left for each in left_out] == [silent]


def test_two_devices_at_one_address_are_not_written_to() -> None:
    robot = parse_robot(DAMIAO)
    with running(robot) as (session, motors):
        assert session.twins is not None
        session.twins.duplicate("left")
        for _ in range(3):  # it takes some hundred answers to be certain
            now = motors.read()
        assert motors.write("left", "PMAX", 10.0) == configuration.SHARED
        assert motors.write("right", "PMAX", 10.0) == ""
    assert configuration.same_devices(now, now) == [f"left: {configuration.SHARED}"]
