"""One motor on the bench: its address, its zero, its calibration, saving; what is told, done, read back and
put back, and that nothing is ever armed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import pytest

from gateway.buses import Bus
from gateway.config import parse_robot
from gateway.core.guard import decoder_of
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.runtime import motor_setup
from gateway.runtime.motor_setup import Action
from gateway.runtime.session import Session, open_session
from protocols import messages as msg
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import Nanos, Obeyed
from tests.sampled import sampled

ONE = """
name = "one"
[buses.bus]
{bus}
interface = "twin"
[motors.left]
protocol = "{protocol}"
bus = "bus"
address = {address}
limits = {{ velocity = 5.0, acceleration = 20.0, torque = 1.0 }}
options = {{ {options} }}
[brain]
body = "joints"
[brain.joints]
motors = ["left"]
"""


CAN = 'kind = "can"\nbitrate = 1_000_000'
BUSES = {
    "moteus": 'kind = "canfd"\nbitrate = 1_000_000\ndata_bitrate = 5_000_000',
    **dict.fromkeys(("dynamixel", "feetech"), 'kind = "serial"\nbaudrate = 1_000_000'),
    "vesc_uart": 'kind = "serial"\nbaudrate = 115_200',
}


def robot_of(protocol: str, options: str = "", address: int = 1) -> Robot:
    bus = BUSES.get(protocol, CAN)
    return parse_robot(ONE.format(protocol=protocol, options=options, address=address, bus=bus))


class Tap:
    """A bus that keeps what is written, and loses some of it."""

    def __init__(self, bus: Bus, lost: Callable[[Frame], bool]) -> None:
        self.name, self.bus, self.lost = bus.name, bus, lost
        self.written: list[Frame] = []

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        return self.bus.read(now)

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        self.written += frames
        self.bus.write(now, [frame for frame in frames if not self.lost(frame)])

    def close(self) -> None:
        self.bus.close()


@contextmanager
def tapped(robot: Robot, lost: Callable[[Frame], bool] = lambda _: False) -> Iterator[tuple[Session, Tap]]:
    with open_session(robot, simulated=True) as session:
        tap = Tap(session.buses["bus"], lost)
        session.buses["bus"] = tap
        yield session, tap


def done(session: Session, action: Action) -> tuple[bool, list[str]]:
    lines: list[str] = []
    good = motor_setup.perform(session, action, lines.append)
    return good, lines


def obeyed(robot: Robot, tap: Tap) -> list[Obeyed]:
    decoder = decoder_of(robot, "bus")
    return [one for frame in tap.written for one in decoder.decode(0, frame)]


GIVEN = (
    (
        "odrive_can",
        'firmware = "0.5", watchdog = "acknowledged"',
        "has the address 5, until it is switched*",
        False,
    ),
    ("odrive_can", 'firmware = "0.6", watchdog = "acknowledged"', "has the address 5, not saved yet*", True),
    ("damiao", "", "has the address 5", True),
    ("damiao", "reply_id = 0x123", "has the address 5", True),
    ("robstride", 'model = "RS02"', "has the address 5", True),
    ("robstride", 'model = "cybergear"', "has the address 5", False),
    ("myactuator", "torque_constant = 1.0", "has the address 5", False),
    ("dynamixel", 'model = "XM430-W350"', "has the address 5", False),
    ("feetech", 'model = "sts3215"', "has the address 5", False),
    ("cia402", "", "has the address 5", True),
    ("moteus", "", "has the address 5, not saved yet*", True),
)


@pytest.mark.parametrize(("protocol", "options", "said", "saves"), sampled(GIVEN, 3))
def test_an_address_is_given_found_again_and_saved(
    protocol: str, options: str, said: str, saves: bool
) -> None:
    robot = motor_setup.alone(robot_of(protocol, options), "left")
    action = Action("set-id", "left", 5)
    assert f"left: the {protocol} at address 1 on bus gets the address 5" in motor_setup.told(robot, action)
    with tapped(robot) as (session, tap):
        good, lines = done(session, action)
    expected = [said.partition("*")[0], "read back at 5", *(["saved"] if saves else [])]
    assert good
    assert len(lines) == len(expected)
    assert all(line.startswith(f"left: {text}") for line, text in zip(lines, expected, strict=True)), lines
    assert not [one for one in obeyed(robot, tap) if isinstance(one, msg.Arm)]


def test_what_cannot_be_saved_gets_its_old_address_again() -> None:
    robot = motor_setup.alone(robot_of("damiao"), "left")

    def saving(frame: Frame) -> bool:
        return isinstance(frame, CanFrame) and frame.data[2:3] == b"\xaa"

    with tapped(robot, saving) as (session, _):
        good, lines = done(session, Action("set-id", "left", 5))
        twins = session.twins
        assert twins is not None
    assert not good
    assert lines == [
        "left: has the address 5",
        "left: read back at 5, serial number DA310001",
        "left: NOT saved: no reply to this request",
        "left: has the address 1",
    ]


def test_what_does_not_take_its_address_is_left_where_it_is() -> None:
    robot = motor_setup.alone(robot_of("robstride", 'model = "RS02"'), "left")

    def given(frame: Frame) -> bool:
        return isinstance(frame, CanFrame) and frame.id >> 24 == 7

    with tapped(robot, given) as (session, _):
        good, lines = done(session, Action("set-id", "left", 5))
    assert (good, lines) == (
        False,
        ["left: NOT given the address 5: it was sent, and nothing is heard at address 5"],
    )


@pytest.mark.parametrize("kind", ["set-id", "zero", "save"])
def test_a_motor_that_another_host_has_armed_is_left(kind: motor_setup.Kind) -> None:
    robot = motor_setup.alone(robot_of("damiao"), "left")
    with tapped(robot) as (session, tap):
        tap.bus.write(0, [CanFrame(1, b"\xff" * 7 + b"\xfc")])
        good, lines = done(session, Action(kind, "left", 5))
    assert (good, lines) == (
        False,
        ["left: nothing was done: it is armed, and another host has it: end that"],
    )
    spec = robot.motors["left"].spec
    assert all(spec.read_only(frame) for frame in tap.written)


def test_where_nothing_answers_nothing_is_done() -> None:
    robot = motor_setup.alone(robot_of("damiao"), "left")
    with tapped(robot, lambda _: True) as (session, _):
        good, (line,) = done(session, Action("zero", "left"))
    assert not good
    assert line.startswith("left: nothing was done: it is ")
    assert "nothing answers at address 1 (gateway scan, gateway doctor)" in line


ZEROED = (
    ("damiao", ""),
    ("robstride", 'model = "RS02"'),
    ("myactuator", "torque_constant = 1.0"),
    ("moteus", ""),
    ("odrive_can", 'watchdog = "acknowledged"'),
)


@pytest.mark.parametrize(("protocol", "options"), sampled(ZEROED, 2))
def test_a_zero_is_taken_and_read_back(protocol: str, options: str) -> None:
    robot = motor_setup.alone(robot_of(protocol, options), "left")
    assert "takes the place where its shaft stands as its zero" in motor_setup.told(
        robot, Action("zero", "left")
    )
    with tapped(robot) as (session, tap):
        assert session.twins is not None
        session.twins.tamper.measured = lambda _, one: replace(one, position=0.7)
        good, lines = done(session, Action("zero", "left"))
    assert (good, len(lines)) == (True, 1), lines
    assert lines[0].startswith("left: zero; it read "), lines
    assert not [one for one in obeyed(robot, tap) if isinstance(one, msg.Arm)]


def test_a_calibration_is_told_to_turn_the_shaft() -> None:
    robot = motor_setup.alone(robot_of("odrive_can", 'watchdog = "acknowledged"'), "left")
    action = Action("calibrate", "left")
    assert "Axis_Requested_State = 3): ITS SHAFT TURNS BY ITSELF" in motor_setup.told(robot, action)
    with tapped(robot) as (session, tap):
        good, (line,) = done(session, action)
    assert good
    assert line.startswith("left: done")
    assert msg.WriteParameter("left", "Axis_Requested_State", 3.0) in obeyed(robot, tap)


@pytest.mark.parametrize(
    ("protocol", "options", "action", "why"),
    [
        ("damiao", "", Action("calibrate", "left"), "cannot do this over its bus: use the vendor's tool"),
        ("vesc", "pole_pairs = 7", Action("set-id", "left", 2), "cannot do this over its bus"),
        ("vesc", "pole_pairs = 7", Action("zero", "left"), "cannot do this over its bus"),
        ("vesc", "pole_pairs = 7", Action("save", "left"), "has nothing that saves its configuration"),
        ("vesc_uart", "pole_pairs = 7", Action("set-id", "left", 2), "cannot do this over its bus"),
        ("cia402", "", Action("set-id", "left", 200, first=True), "address 200 of left"),
        ("damiao", "", Action("set-id", "left", 5, first=True), "has an address from the beginning"),
        ("damiao", "", Action("set-id", "left", 99), "address 99 of left: it must be 1 to 15"),
        ("damiao", "", Action("zero", "leg"), "leg"),
    ],
)
def test_what_cannot_be_done_is_said_before(protocol: str, options: str, action: Action, why: str) -> None:
    robot = robot_of(protocol, options)
    with pytest.raises(UserError, match=why):
        motor_setup.told(motor_setup.alone(robot, action.motor), action)


@pytest.mark.parametrize("settings", ["has_node_id = false", ""], ids=["without a node id", "with one"])
def test_a_device_without_an_address_gets_that_of_its_motor(settings: str) -> None:
    text = ONE.format(protocol="cia402", options="", address=5, bus=CAN)
    robot = parse_robot(text.replace("options = {  }", f"settings = {{ {settings} }}"))
    robot = motor_setup.alone(robot, "left")
    action = Action("set-id", "left", 5, first=True)
    assert "that has no address yet gets the address 5" in motor_setup.told(robot, action)
    with tapped(robot) as (session, tap):
        good, lines = done(session, action)
    assert good == bool(settings)
    if settings:
        assert "by LSS" in lines[0]
        assert lines[1].startswith("left: read back at 5, serial number")
    else:
        assert lines == ["left: NOT given the address 5: it answers at 5 already"]
    assert not [one for one in obeyed(robot, tap) if isinstance(one, msg.Arm)]
