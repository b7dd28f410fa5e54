"""The guard: what goes to a bus is what the devices may obey, whatever brain, joint and driver make of it."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import pi, tau
from pathlib import Path
from struct import pack, unpack
from typing import Any, NoReturn

import pytest

from gateway import config
from gateway.core.faults import DRIVER_FAILED, FRAME_BLOCKED
from gateway.core.guard import Blocked, Guard, decoder_of
from gateway.core.joint import Joint
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from protocols import messages as msg
from protocols.conformance.bench import DriverWrapper, Messages
from protocols.frames import CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Command, Event, Mode, Nanos, Request
from protocols.toolkit.mit import commanded
from tests.gateway.rig import BENCH, Rig, notes_in, sent_commands
from tests.sampled import sampled

LEFT, RIGHT, ABSENT = 1, 2, 9
"""Addresses."""
ROBOT = config.parse_robot(
    BENCH.replace("[motors.right]", "[motors.right]\nlimits.position = [-2.0, 2.0]\nsign = -1").replace(
        "torque = 2.0", "torque = 2.005"
    )
)
GEAR = 8.0
LIMIT = 20.0
"""rad/s"""


def odrive(address: int, command: int, data: bytes) -> CanFrame:
    """A frame to an ODrive."""
    return CanFrame(address << 5 | command, data)


def mode(address: int, control: int, inputs: int = 1) -> CanFrame:
    """Set_Controller_Mode."""
    return odrive(address, 0x0B, pack("<II", control, inputs))


def arm(address: int) -> CanFrame:
    """Set_Axis_State, closed loop."""
    return odrive(address, 0x07, pack("<II", 8, 0)[:4])


def velocity(address: int, value: float, torque: float = 0.0) -> CanFrame:
    """Set_Input_Vel at the joint's output shaft [rad/s, N·m]."""
    return odrive(address, 0x0D, pack("<ff", value * GEAR / tau, torque / GEAR))


def torque(address: int, value: float) -> CanFrame:
    """Set_Input_Torque at the output shaft [N·m]."""
    return odrive(address, 0x0E, pack("<f", value / GEAR))


def position(address: int, value: float, ahead: float = 0.0, torque: float = 0.0) -> CanFrame:
    """Set_Input_Pos at the output shaft [rad, rad/s, N·m]; the last two are rounded to thousandths."""
    forward = (round(ahead * GEAR / tau * 1000), round(torque / GEAR * 1000))
    return odrive(address, 0x0C, pack("<fhh", value * GEAR / tau, *forward))


IDLE = odrive(LEFT, 0x07, pack("<I", 1))
POLL = CanFrame(LEFT << 5 | 0x09, remote=True)
CLEAR = odrive(LEFT, 0x18, b"")
SET_ID = CanFrame(0x7E6, b"\x09" + (0x385F34733301).to_bytes(6, "little"))
SET_ANOTHER = CanFrame(0x7E6, b"\x09" + (7).to_bytes(6, "little"))
REBOOT = odrive(LEFT, 0x16, b"\0")


def failing(*_given: object, **_named: object) -> NoReturn:
    """Raise, as a plugin with a defect does."""
    raise ZeroDivisionError("a defect")


@dataclass
class Situation:
    """What the guard knows when a frame comes."""

    owned: bool = True
    mode: Mode = Mode.ARMED
    fault: bool = False
    stopped: bool = False
    asked: tuple[Request, ...] = ()
    asked_ago: Nanos = 0
    before: tuple[CanFrame, ...] = ()
    """Frames that were passed,"""
    before_ago: Nanos = 5 * MILLISECOND
    """this long before."""
    measured: dict[str, float] = field(default_factory=dict)
    has: Sequence[Command] | None = None
    """What the driver was given in this step; None: what the frame makes the device do."""
    coasted: float = 0.0
    """rad/s, with which it turned before it was armed,"""
    coasted_ago: Nanos = 200 * MILLISECOND
    """this long before."""


def commanded_by(frame: Frame) -> Sequence[Command]:
    """Return the command, at the device's shaft, of which an ODrive's driver makes this frame."""
    if not isinstance(frame, CanFrame) or frame.id >> 5 not in (LEFT, RIGHT):
        return ()
    motor, data = {LEFT: "left", RIGHT: "right"}[frame.id >> 5], frame.data.ljust(8, b"\0")
    match frame.id & 0x1F:
        case 0x0B:
            kinds: dict[int, Command] = {1: msg.Torque(motor, 0.0), 2: msg.Velocity(motor, 0.0)}
            kinds[3] = msg.Position(motor, 0.0)
            return [kinds[data[0]]]
        case 0x07 if data[0] == 8:
            return [msg.Velocity(motor, 0.0)]
        case 0x0C:
            turns, ahead, torque = unpack("<fhh", data)
            return [msg.Position(motor, turns * tau, ahead * 0.001 * tau, torque * 0.001)]
        case 0x0D:
            turns, torque = unpack("<ff", data)
            return [msg.Velocity(motor, turns * tau, torque)]
        case 0x0E:
            return [msg.Torque(motor, unpack("<f", data[:4])[0])]
    return ()


def verdict(situation: Situation, frame: Frame) -> str:
    """Return the rule that a frame breaks; "" if it is passed."""
    return ((found := blocked_of(situation, frame)) and found.rule) or ""


def blocked_of(situation: Situation, frame: Frame) -> Blocked | None:
    """Return what the guard makes of a frame; None if it is passed."""
    guard, now = Guard(ROBOT), 100 * SECOND
    joints = {}
    for name, motor in ROBOT.motors.items():
        joint = joints[name] = Joint(name, motor.joint, motor.spec)
        ratio = motor.joint.gear * motor.joint.sign
        at_device = {quantity: value * ratio for quantity, value in situation.measured.items()}
        shaft = {"position": 0.0, "velocity": 0.0} | at_device
        past = now - situation.coasted_ago
        joint.on_event(msg.Feedback(name, past, 0.0, situation.coasted * ratio, *(None,) * 4))
        guard.check(past, "can0", "odrive_can", [], {name: joint}, stopped=False)
        joint.on_event(msg.Feedback(name, now, shaft["position"], shaft["velocity"], *(None,) * 4))
        joint.on_event(msg.State(name, now, situation.mode, ""))
        joint._arming.owned = situation.owned
        if situation.fault:
            joint.latch(msg.Fault(name, now, 1, "a fault", "", ""))
    for request in situation.asked:
        guard.ask(now - situation.asked_ago, request)
    past = now - situation.before_ago
    for sent in situation.before:
        for command in commanded_by(sent):
            guard.ask(past, command)
        assert guard.check(past, "can0", "odrive_can", [sent], joints, stopped=False) == ([sent], [])
    for command in situation.has if situation.has is not None else commanded_by(frame):
        guard.ask(now, command)
    passed, blocked = guard.check(now, "can0", "odrive_can", [frame], joints, situation.stopped)
    assert len(passed) + len(blocked) == 1
    return blocked[0] if blocked else None


TURNING = (mode(LEFT, 2), arm(LEFT), mode(RIGHT, 2), arm(RIGHT))
"""In velocity control."""
PUSHING = (mode(LEFT, 1), arm(LEFT))
MOVING = (mode(LEFT, 3), arm(LEFT), mode(RIGHT, 3), arm(RIGHT))
"""In position control."""
FRESH = Situation(owned=False, mode=Mode.READY)
OURS = Situation(mode=Mode.READY)
NOT_OURS = "a command to a device that was not commanded"
NOT_MADE = "a request that was not made"
AGAINST = "arming against a stop or a fault"
TOO_FAST = "velocity beyond the limit"
TOO_FAR = "position beyond the limit"
TOO_STRONG = "torque beyond the limit"
NOT_COMMANDED = "a set-point that was not commanded"
NOT_DECLARED = "a setting that was neither asked for nor declared"
JERKS = "acceleration beyond the limit"
JUMPS = "a jump of the position"


def turning(measured: float = 0.0, *before: CanFrame) -> Situation:
    """Both in velocity control, at a measured velocity [rad/s]."""
    return Situation(before=(*TURNING, *before), measured={"velocity": measured})


def moving(measured: float = 0.0, *before: CanFrame) -> Situation:
    """Both in position control, at a measured position [rad]."""
    return Situation(before=(*MOVING, *before), measured={"position": measured})


def asked(request: Request, ago: Nanos = 0, situation: Situation = OURS) -> Situation:
    """After a request of the operator."""
    return replace(situation, asked=(request,), asked_ago=ago)


def having(command: Command) -> Situation:
    """Turning at 1 rad/s, and given this, at the device's shaft."""
    return replace(turning(1.0, velocity(LEFT, 1.0)), has=(command,))


COASTED = replace(turning(), coasted=12.0)
TIMEOUT = ROBOT.motors["left"].joint.command_timeout
AHEAD = moving(0.0, position(LEFT, 1.0))
CASES: list[tuple[str, Situation, Frame, str]] = [
    ("read-only, before any command", FRESH, POLL, ""),
    ("arming before any command", FRESH, arm(LEFT), NOT_OURS),
    ("Idle before any command", FRESH, IDLE, NOT_OURS),
    ("Idle, after the operator's stop", asked(msg.Stop(), 0, FRESH), IDLE, ""),
    ("set-up before any command", FRESH, mode(LEFT, 2), NOT_OURS),
    ("set-up while a scan is asked for", asked(msg.Scan("can0"), 0, FRESH), mode(LEFT, 2), NOT_OURS),
    ("an address unasked", OURS, SET_ID, NOT_MADE),
    ("an address", asked(msg.SetId("can0", 0x385F34733301, 9), 0, FRESH), SET_ID, ""),
    ("another address", asked(msg.SetId("can0", 0x385F34733301, 8), 0, FRESH), SET_ID, NOT_MADE),
    ("the address of a stranger", asked(msg.SetId("can0", 7, 9), 0, FRESH), SET_ANOTHER, ""),
    ("that, unasked", FRESH, SET_ANOTHER, NOT_OURS),
    ("set-up of a commanded device", OURS, mode(LEFT, 2), ""),
    ("to no device of the robot", OURS, arm(ABSENT), "not a frame to any device of this driver"),
    ("arming a commanded device", OURS, arm(LEFT), ""),
    ("arming against a stop", replace(OURS, stopped=True), arm(LEFT), AGAINST),
    ("arming against a fault", replace(OURS, fault=True), arm(LEFT), AGAINST),
    ("armed already, in a stop: it brakes", Situation(stopped=True), arm(LEFT), ""),
    ("Idle in a stop", Situation(stopped=True, fault=True), IDLE, ""),
    ("clearing unasked", OURS, CLEAR, NOT_MADE),
    ("clearing", asked(msg.ClearFault("left")), CLEAR, ""),
    ("clearing another", asked(msg.ClearFault("right")), CLEAR, NOT_MADE),
    ("clearing, asked long ago", asked(msg.ClearFault("left"), 61 * SECOND), CLEAR, NOT_MADE),
    ("clearing, asked a minute ago", asked(msg.ClearFault("left"), 60 * SECOND), CLEAR, ""),
    ("a restart unasked", OURS, REBOOT, NOT_MADE),
    ("a restart of what was not commanded", asked(msg.Reboot("left"), 0, FRESH), REBOOT, ""),
    ("at the limit", turning(LIMIT), velocity(LEFT, LIMIT), ""),
    ("beyond the limit", turning(LIMIT), velocity(LEFT, LIMIT + 0.01), TOO_FAST),
    ("beyond it backwards", turning(-LIMIT), velocity(LEFT, -LIMIT - 0.01), TOO_FAST),
    ("reversed: at the limit", turning(LIMIT), velocity(RIGHT, -LIMIT), ""),
    ("feed-forward at the limit", turning(), velocity(LEFT, 0.0, 2.0), ""),
    ("feed-forward beyond it", turning(), velocity(LEFT, 0.0, -2.01), TOO_STRONG),
    ("torque at the limit", Situation(before=PUSHING), torque(LEFT, 2.0), ""),
    ("torque beyond the limit", Situation(before=PUSHING), torque(LEFT, -2.01), TOO_STRONG),
    ("faster, within 55 ms of acceleration", turning(0.0, velocity(LEFT, 1.0)), velocity(LEFT, 4.29), ""),
    ("faster than that", turning(0.0, velocity(LEFT, 1.0)), velocity(LEFT, 4.31), JERKS),
    ("as measured", turning(12.0), velocity(LEFT, 12.0), ""),
    ("slower at once", turning(12.0), velocity(LEFT, 0.0), ""),
    ("to the other direction", turning(12.0), velocity(LEFT, -12.0), JERKS),
    ("a position near", moving(), position(LEFT, 0.99), ""),
    ("a jump", moving(), position(LEFT, 1.01), JUMPS),
    ("a jump back to zero", moving(12.5), position(LEFT, 0.0), JUMPS),
    ("on from the last set-point", AHEAD, position(LEFT, 2.09), ""),
    ("on from it after its mode", moving(0.0, position(LEFT, 1.0), mode(LEFT, 3)), position(LEFT, 2.0), ""),
    ("on from coasting, armed at rest", COASTED, velocity(LEFT, 12.0), ""),
    ("on from coasting a second ago", replace(COASTED, coasted_ago=SECOND), velocity(LEFT, 12.0), ""),
    ("no longer on from coasting", replace(COASTED, coasted_ago=SECOND + 1), velocity(LEFT, 12.0), JERKS),
    ("faster than it coasted", COASTED, velocity(LEFT, 15.1), JERKS),
    ("on from it a while later", replace(AHEAD, before_ago=TIMEOUT), position(LEFT, 3.9), ""),
    ("no longer on from it", replace(AHEAD, before_ago=TIMEOUT + 1), position(LEFT, 3.9), JUMPS),
    ("as near to the limit as it can be encoded", moving(), position(LEFT, 0.0, LIMIT), ""),
    ("as near to the limit of torque", moving(), position(LEFT, 0.0, 0.0, 2.005), ""),
    ("within the range", moving(1.9), position(RIGHT, -2.0), ""),
    ("out of the range", moving(1.9), position(RIGHT, -2.01), TOO_FAR),
    ("back into the range", moving(9.0), position(RIGHT, -2.0), ""),
    ("the last velocity, to be idle", having(msg.Idle("left")), velocity(LEFT, 1.0), NOT_COMMANDED),
    ("slower than it, to be idle", having(msg.Idle("left")), velocity(LEFT, 0.9), NOT_COMMANDED),
    ("at rest, to be idle", having(msg.Idle("left")), velocity(LEFT, 0.0), ""),
    ("the last velocity, to hold", having(msg.Hold("left")), velocity(LEFT, 1.0), NOT_COMMANDED),
    ("the last velocity, to brake: at once", having(msg.Velocity("left", 0.0)), velocity(LEFT, 1.0), ""),
    ("another one, to brake", having(msg.Velocity("left", 0.0)), velocity(LEFT, 0.9), NOT_COMMANDED),
    ("another velocity", having(msg.Velocity("left", 8.0)), velocity(LEFT, 1.1), NOT_COMMANDED),
    ("another mode", having(msg.Velocity("left", 8.0)), mode(LEFT, 1), NOT_DECLARED),
    ("arming, to be idle", having(msg.Idle("left")), arm(LEFT), "arming a motor that is to be idle"),
    ("feed-forward too fast", moving(), position(LEFT, 0.0, -LIMIT - 0.1), TOO_FAST),
]  # fmt: skip


@pytest.mark.parametrize(
    ("situation", "frame", "rule"), [case[1:] for case in CASES], ids=[c[0] for c in CASES]
)
def test_what_passes_and_what_does_not(situation: Situation, frame: Frame, rule: str) -> None:
    assert verdict(situation, frame) == rule


@pytest.mark.parametrize(
    ("situation", "frame", "text"),
    [
        (turning(1.0), velocity(LEFT, -19.0), "acceleration beyond the limit (velocity -19 after 1): "),
        (turning(20.0), velocity(LEFT, 21.0), "velocity beyond the limit (21, limit 20): "),
        (moving(1.0), position(LEFT, 5.0), "a jump of the position (5 after 1): "),
        (moving(2.0), position(RIGHT, -3.0), "position beyond the limit (3, limits (-2.0, 2.0)): "),
        (replace(OURS, fault=True), arm(LEFT), "arming against a stop or a fault (a fault): "),
        (replace(OURS, stopped=True), arm(LEFT), "arming against a stop or a fault: "),
        (OURS, CLEAR, "a request that was not made (ClearFault): "),
        (OURS, arm(ABSENT), "not a frame to any device of this driver: "),
    ],
)
def test_what_is_blocked_is_named_with_its_numbers_and_its_motor(
    situation: Situation, frame: CanFrame, text: str
) -> None:
    blocked = blocked_of(situation, frame)
    assert blocked is not None
    assert blocked.text == f"{text}{frame}"
    assert blocked.motors == {LEFT: ("left",), RIGHT: ("right",), ABSENT: ()}[frame.id >> 5]


def test_what_a_decoder_cannot_read_does_not_go_out(monkeypatch: pytest.MonkeyPatch) -> None:
    guard = Guard(ROBOT)
    joints = {name: Joint(name, motor.joint, motor.spec) for name, motor in ROBOT.motors.items()}
    monkeypatch.setattr(guard._receivers["can0"], "decode", failing)
    passed, (blocked,) = guard.check(0, "can0", "odrive_can", [IDLE], joints, stopped=False)
    assert passed == []
    assert (blocked.rule, blocked.detail) == ("its decoder failed", "ZeroDivisionError: a defect")
    assert blocked.motors == ("left",)


def test_a_blocked_frame_leaves_no_trace_and_does_not_hold_back_the_next() -> None:
    robot, guard, now = ROBOT, Guard(ROBOT), 100 * SECOND
    joints = {name: Joint(name, motor.joint, motor.spec) for name, motor in robot.motors.items()}
    joints["left"]._arming.owned = True
    wanted = [mode(LEFT, 2), arm(LEFT), velocity(RIGHT, 1.0), mode(RIGHT, 1), velocity(LEFT, 1.0)]
    for command in commanded_by(wanted[4]):
        guard.ask(now, command)
    passed, blocked = guard.check(now, "can0", "odrive_can", wanted, joints, stopped=False)
    assert passed == [wanted[0], wanted[1], wanted[4]]
    assert [each.motors for each in blocked] == [("right",), ("right",)]
    assert blocked[0].text == f"{NOT_OURS} (Kept): {wanted[2]}"
    decoder = decoder_of(robot, "can0")
    for frame in passed:
        decoder.decode(now, frame)
    for _ in range(40):
        more = [mode(LEFT, 2), velocity(RIGHT, 1.0), velocity(LEFT, 1.0)]
        kept, _ = guard.check(now, "can0", "odrive_can", more, joints, stopped=False)
        assert kept == [more[0], more[2]]
        for frame in kept:
            decoder.decode(now, frame)
    joints["right"]._arming.owned = True
    again = velocity(RIGHT, 1.0)
    assert guard._receivers["can0"].decode(now, again) == decoder.decode(now, again)


@pytest.mark.parametrize(
    ("here", "lead", "stiffness", "damping", "velocity_there", "torque", "passes"),
    [
        (2.0, 1.0, 2.0, 0.0, -10.0, 0.0, True),
        (2.0, 1.0, 2.8, 0.0, -10.0, 0.0, False),
        (2.0, 1.0, 0.0, 0.09, 10.0, 0.0, True),
        (2.0, 1.0, 0.0, 0.12, 10.0, 0.0, False),
        (2.0, 1.0, 1.5, 0.06, 10.0, 0.0, False),
        (2.0, 1.0, 1.5, 0.0, -10.0, 0.7, False),
        (2.0, 1.0, 3.0, 0.0, -10.0, -1.2, True),
        (2.0, 9.0, 0.15, 0.0, -10.0, 0.0, True),  # far away
        (0.0, 1.0, 2.8, 0.0, -10.0, 0.0, False),
    ],
)
def test_a_spring_pulls_within_the_limit_of_torque(
    here: float,
    lead: float,
    stiffness: float,
    damping: float,
    velocity_there: float,
    torque: float,
    passes: bool,
) -> None:
    """Of a reversed Damiao motor behind a gear of 2 at -10 rad/s."""
    text = BENCH.replace('"odrive_can"', '"damiao"').replace('{ watchdog = "acknowledged" }', "{}")
    robot = config.parse_robot(text.replace("gear = 8.0", "gear = 2.0\nsign = -1"))
    motor, now = robot.motors["left"], 100 * SECOND
    guard, joint = Guard(robot), Joint("left", motor.joint, motor.spec)
    joint.on_event(msg.Feedback("left", now, here * -2.0, -10.0 * -2.0, *(None,) * 4))
    joint.on_event(msg.State("left", now, Mode.ARMED, ""))
    joint._arming.owned = True
    table = motor.device.options.table
    gains = {"stiffness": stiffness / 4.0, "damping": damping / 4.0, "torque": torque / -2.0}
    spring = table.encode("MIT", 1, position=(here + lead) * -2.0, velocity=velocity_there * -2.0, **gains)
    frames = [table.encode("enable", 1), spring]
    values = table.decode(spring, "to_device")
    guard.ask(now, commanded("left", values.values if values else {}))
    _, blocked = guard.check(now, "can0", "damiao", frames, {"left": joint}, stopped=False)
    assert [each.rule for each in blocked] == ([] if passes else ["torque of the spring beyond the limit"])


def test_one_of_two_motors_of_a_drive_may_be_cleared() -> None:
    """The drive has one controlword: what clears one motor also disarms the other."""
    rig = Rig(config.load_robot("diffbot_zlac8015d").text)
    rig.run(1.0)
    rig.run(0.5, msg.ClearFault("left"))
    assert not any(joint.faults for joint in rig.gateway.joints.values())
    assert notes_in(rig.ticks, "left")[-1].text.startswith("ClearFault: done")


def test_what_arms_both_motors_of_a_drive_may_turn_the_commanded_one_alone() -> None:
    robot = config.load_robot("diffbot_zlac8015d")
    guard, now = Guard(robot), SECOND
    joints = {name: Joint(name, motor.joint, motor.spec) for name, motor in robot.motors.items()}
    joints["left"]._arming.owned = True
    guard.ask(now, msg.Velocity("left", 10 * pi / 30.0))
    address = robot.motors["left"].device.address & 0x7F

    def write(index: int, sub: int, value: int, size: int) -> CanFrame:
        command = {2: 0x2B, 4: 0x23, 1: 0x2F}[size]
        data = bytes((command, *index.to_bytes(2, "little"), sub))
        return CanFrame(0x600 + address, data + value.to_bytes(4, "little"))

    def check(frame: CanFrame) -> list[str]:
        _, blocked = guard.check(now, "can0", "zlac8015d", [frame], joints, stopped=False)
        return [each.rule for each in blocked]

    sent = [write(0x6060, 0, 3, 1), *(write(0x6040, 0, word, 2) for word in (6, 7, 15))]
    assert [check(frame) for frame in sent] == [[], [], [], []]
    assert check(write(0x60FF, 1, 10, 4)) == []
    assert check(write(0x60FF, 2, 10, 4)) == [NOT_OURS]
    assert check(write(0x60FF, 3, 10 << 16 | 10, 4)) == [NOT_OURS]  # both at once
    assert check(write(0x60FF, 3, 10, 4)) == []


def test_on_a_serial_line_what_is_not_read_only_is_for_all() -> None:
    robot = config.load_robot("diffbot")
    passed, (blocked,) = Guard(robot).check(0, "sensors", "plain", [b"noise"], {}, stopped=False)
    assert passed == []
    assert (
        blocked.text == "not read-only, and nothing that was asked for or declared (lidar, imu): 6E6F697365"
    )


def test_a_command_to_a_strange_name_does_not_go_out(monkeypatch: pytest.MonkeyPatch) -> None:
    guard = Guard(ROBOT)
    monkeypatch.setattr(guard._receivers["can0"], "decode", lambda *_: [msg.Idle("mast")])
    _, (blocked,) = guard.check(0, "can0", "odrive_can", [IDLE], {}, stopped=False)
    assert (blocked.rule, blocked.detail) == (
        "a command to a device that is not a motor of this robot",
        "mast",
    )


# -- below a joint without limits ----------------------------------------------------------------------------

ROBOTS = (
    "diffbot",
    "diffbot_cia402",
    "diffbot_moteus",
    "diffbot_myactuator",
    "diffbot_cubemars",
    "diffbot_damiao",
    "diffbot_robomaster",
    "diffbot_robstride",
    "diffbot_vesc",
    "diffbot_zlac8015d",
    "bench05",
    "twelve",
)


class LimitlessJoint(Joint):
    """A joint that has no limits, and ignores a stop."""

    wild: Command | None = None

    def command(
        self, now: Nanos, new: Command | None, stopped: bool, last: bool = False, leaving: bool = False
    ) -> Command:
        """Return what was not asked for."""
        usual = super().command(now, new, stopped, last, leaving)
        if self.wild is None:
            return usual
        self._arming.owned = True
        return replace(self.wild, motor=self.name)


def test_on_a_serial_line_only_the_motor_that_would_obey_is_in_fault() -> None:
    """No id shows for whom a message is: its decoder does."""
    text = (
        BENCH.replace('"can"', '"serial"').replace("bitrate", "baudrate").replace('"odrive_can"', '"plain"')
    )
    rig = Rig(text.replace('{ watchdog = "acknowledged" }', '{ kind = "motor" }'))
    rig.run(0.2)
    left = rig.gateway.joints["left"]
    left.__class__ = LimitlessJoint
    assert isinstance(left, LimitlessJoint)
    left.wild = msg.Velocity("left", GEAR * (LIMIT + 1.0))
    rig.run(0.05)
    codes = {name: {code for code, _ in joint.faults} for name, joint in rig.gateway.joints.items()}
    assert codes == {"left": {FRAME_BLOCKED}, "right": set()}


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("wild", "name"),
    [
        *sampled((("fast", name) for name in ROBOTS), 3),
        *(("against a stop", name) for name in ("bench05", "diffbot_cia402")),
    ],
)
def test_a_joint_without_limits_moves_nothing_beyond_them(name: str, wild: str) -> None:
    robot = config.load_robot(name)
    rig = Rig(robot.text)
    for joint in rig.gateway.joints.values():
        joint.__class__ = LimitlessJoint
    rig.run(1.2)
    if wild == "against a stop":
        rig.run(0.2, msg.Stop())
    speed = 1.3 if wild == "fast" else 0.05
    for name, joint in rig.gateway.joints.items():
        assert isinstance(joint, LimitlessJoint)
        own = robot.motors[name].joint
        joint.wild = msg.Velocity(name, speed * own.gear * own.limits.velocity)
        if msg.Velocity not in robot.motors[name].spec.commands:
            joint.wild = msg.Torque(name, speed * own.limits.torque / own.gear)
    ticks = rig.run(1.5)
    frames = [(packet.bus, packet.frame, tick.now) for tick in ticks for packet in tick.outputs.packets]
    decoders = {bus: decoder_of(robot, bus) for bus in robot.buses}
    for bus, frame, now in frames:
        for one in decoders[bus].decode(now, frame):
            if wild == "against a stop":
                assert not isinstance(one, msg.Arm)
            elif isinstance(one, msg.Velocity):
                motor = robot.motors[one.motor].joint
                assert abs(one.velocity / motor.gear) <= motor.limits.velocity * 1.0001
            elif isinstance(one, msg.Torque):
                motor = robot.motors[one.motor].joint
                assert abs(one.torque * motor.gear) <= motor.limits.torque * 1.001
    assert all(
        abs(rig.velocity(motor)) < 1.2 * robot.motors[motor].joint.limits.velocity for motor in robot.motors
    )
    codes = {code for joint in rig.gateway.joints.values() for code, _ in joint.faults}
    assert FRAME_BLOCKED in codes
    assert any("frame blocked by the guard" in note.text for note in notes_in(ticks))


# -- beside a driver that raises -----------------------------------------------------------------------------


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("protocol", "method"),
    sampled(
        [("plain", "send"), ("plain", "due"), ("cia402", "send"), ("cia402", "bus"), ("cia402", "receive")], 2
    ),
)
def test_a_driver_that_raises_keeps_nothing_from_the_others(
    protocol: str, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(config.load_robot("diffbot_mixed").text)
    rig.run(2.0, msg.Goal(1.5, 0.0))
    assert rig.velocity("left") > 1.0
    broken = next(one for one in rig.gateway._drivers if one.protocol == protocol)
    monkeypatch.setattr(broken.driver, method, failing)
    if method == "bus":
        rig.world.buses[broken.bus].lose()
        rig.world.buses[broken.bus].restore()
    ticks = rig.run(2.0)
    stopped = rig.gateway.why_stopped()
    assert f"the driver {protocol} on {broken.bus} has failed" in stopped
    assert len([note for note in notes_in(ticks) if "ZeroDivisionError: a defect" in note.text]) == 1
    ours = {
        motor
        for motor, joint in rig.gateway.joints.items()
        if DRIVER_FAILED in {code for code, _ in joint.faults}
    }
    assert ours == (set() if protocol == "plain" else {"left"})
    last = {command.motor: command for _, command in sent_commands(rig.robot, rig.ticks)}
    for motor in ("right",) if (protocol, method) == ("cia402", "send") else ("right", "left"):
        assert isinstance(last[motor], msg.Idle), motor
    rig.run(0.5, msg.Release())
    if method != "bus":  # which is not called again
        assert rig.gateway.why_stopped() == stopped, "it stays stopped: the driver still fails"


def test_leaving_reaches_every_motor_though_a_driver_and_a_joint_raise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig(config.load_robot("diffbot_mixed").text)
    rig.run(2.0, msg.Goal(1.5, 0.0))
    rig.run(0.5, msg.Position("mast", 1.0))
    for one in rig.gateway._drivers:
        if one.protocol in ("plain", "cia402"):
            monkeypatch.setattr(one.driver, "send", failing)
    monkeypatch.setattr(rig.gateway.joints["mast"], "command", failing)
    sent = rig.gateway.leave(rig.clock.now())
    decoder = decoder_of(rig.robot, "can0")
    obeyed = [one for packet in sent for one in decoder.decode(packet.t, packet.frame)]
    assert [one.motor for one in obeyed if isinstance(one, msg.Idle)] == ["right", "mast"]


# -- stamps --------------------------------------------------------------------------------------------------


def test_a_packet_from_the_future_was_received_now() -> None:
    gateway, now = Gateway(ROBOT), 5 * SECOND
    encoder = CanFrame(LEFT << 5 | 0x09, pack("<ff", 1.0, 2.0))
    for t in (now + 3600 * SECOND, now - 20 * MILLISECOND):
        gateway.step(now, Inputs(packets=(Packet(t, "can0", encoder),)))
        assert gateway.joints["left"].feedback.t == min(t, now)
        now += 5 * MILLISECOND
    assert gateway.joints["left"].feedback_lost(now + 101 * MILLISECOND)


# -- what nobody asked for ---------------------------------------------------------------------------------

UNASKED: list[dict[str, Any]] = json.loads((Path(__file__).parent / "unasked.json").read_text("utf-8"))
"""Frames by robot: gains, limits, ids, calibrations, restarts, other modes, wrong kinds of frame."""


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", sampled(list(dict.fromkeys(each["robot"] for each in UNASKED)), 4))
def test_what_nobody_asked_for_is_blocked_driving_and_stopped(name: str) -> None:
    rig = Rig(config.load_robot(name).text)
    motor = next(iter(rig.robot.motors.values()))
    driving = msg.Velocity("left", 3.0) if name == "bench" else msg.Goal(1.5, 0.0)
    for _ in range(30):
        rig.run(0.05, driving)
    joints, guard = rig.gateway.joints, rig.gateway.guard
    assert any(joint.armed for joint in joints.values())
    for stopped in (False, True):
        if stopped:
            rig.run(1.0, msg.Stop())
        for each in UNASKED:
            if each["robot"] != name:
                continue
            data, fd = bytes.fromhex(each["data"]), each.get("fd", False)
            frame = CanFrame(int(each["id"], 16), data, each["extended"], fd=fd)
            passed, _ = guard.check(rig.ticks[-1].now, motor.bus, motor.plugin.name, [frame], joints, stopped)
            assert not passed, (each["name"], "stopped" if stopped else "driving")
    assert not any(joint.faults for joint in joints.values())


# -- a driver that does not pass on a stop -------------------------------------------------------------------


@dataclass
class Deaf(DriverWrapper):
    """A driver that goes on with the last set-point that it was given before it went deaf."""

    deaf: bool = False
    last: tuple[Command | Request, ...] = ()

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Encode what was given last."""
        self.last = self.last if self.deaf else tuple(messages)
        return self.driver.send(now, self.last)


@pytest.mark.sample(2)
@pytest.mark.parametrize("action", ["idle", "brake"])
@pytest.mark.parametrize(
    "name", sampled([*(each for each in ROBOTS if each.startswith("diffbot_")), "diffbot"], 5)
)
def test_nothing_drives_a_shaft_on_though_its_driver_ignores_the_stop(name: str, action: str) -> None:
    text = re.sub(r'(stop_action = )"\w+"', rf'\1"{action}"', config.load_robot(name).text)
    rig = Rig(text)
    deaf: list[Deaf] = []
    for one in rig.gateway._drivers:
        if one.motors:
            deaf.append(Deaf(one.driver))
            object.__setattr__(one, "driver", deaf[-1])
    rig.run(1.5, msg.Goal(3.0, 0.0))
    motors = list(rig.gateway.joints)
    assert min(abs(rig.velocity(motor)) for motor in motors) > 1.0
    for each in deaf:
        each.deaf = True
    speeds = []
    for _ in range(3):
        rig.run(0.5, msg.Stop())
        speeds.append([abs(rig.velocity(motor)) for motor in motors])
    assert speeds[2] < speeds[1] < speeds[0]  # nothing drives it any more
