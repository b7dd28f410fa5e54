"""A round of a control loop of twelve motors: ours, and what a user would write with a package of the field.

Rules. Behind all of them are the same twins, in simulated time: a round sends a set-point to each motor and
takes in what each has reported since. The time of the twins is none of a round's. Ours is the whole step:
brain, limits, faults, and the guard, which reads each frame again; theirs put numbers into frames and take
them out. Every motor must turn, or follow, at the end. Contestants take turns, round by round.
"""

from __future__ import annotations

import asyncio
import struct
import weakref
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from math import tau
from typing import Any, TypeAlias

from benchmarks.measure import Effort, Figures, NotMeasured, figures, rival
from benchmarks.rows import Row, against
from benchmarks.steps import SPRING, of_protocol
from gateway import config
from gateway.buses.virtual.bus import open_world
from gateway.core.clock import stopwatch
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from gateway.runtime.process import quiet_collector
from protocols.frames import CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, Instruction, Nanos, Position, Velocity

GROUP = "a round of a loop: 12 motors report and are commanded (the twins behind it not counted)"
OURS = "ours"
TURN = 0.5
"""rad/s at the output shaft"""
PLACE = 0.2
"""rad"""
ARMED: Nanos = 300 * MILLISECOND
"""From here on our gateway is asked: by then every motor has reported."""
WARM: Nanos = 700 * MILLISECOND
"""From here on rounds count."""
STIFFNESS, DAMPING = 20.0, 1.0
"""N·m/rad and N·m·s/rad, as in `SPRING`"""

Exchange: TypeAlias = Callable[[Sequence[CanFrame]], Sequence[CanFrame]]
"""Puts frames onto the wires, lets a period go by, and returns what was received."""
Round: TypeAlias = Callable[[Exchange], int]
"""Commands all motors once; returns how many have reported since the round before."""


class Wires:
    """The twins of a robot, for one contestant."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.world = robot, open_world(robot, robot.seed)
        self.now: Nanos = 0
        self.elsewhere: Nanos = 0
        """The machine's time that the twins took since it was last set to 0."""

    def exchange(self, given: Callable[[str], Sequence[Frame]]) -> tuple[Packet, ...]:
        """Send what each bus is given; return all that has come a period later."""
        began = stopwatch()
        for name, bus in self.world.buses.items():
            bus.write(self.now, given(name))
        self.now += self.robot.period
        packets = [packet for bus in self.world.buses.values() for packet in bus.read(self.now)[1]]
        self.elsewhere += stopwatch() - began
        return tuple(packets)


class Ours:
    """The gateway, whose step makes and takes the frames."""

    def __init__(self, robot: Robot, target: Callable[[str], Instruction]) -> None:
        self.wires, self._gateway = Wires(robot), Gateway(robot)
        self._asked = [target(motor) for motor in robot.motors]
        self._received: tuple[Packet, ...] = ()

    def round(self) -> None:
        """Step, then let the world go on by a period."""
        asked: Sequence[Instruction] = ()
        if self.wires.now >= ARMED:
            asked, self._asked = self._asked, []
        sent = self._gateway.step(self.wires.now, Inputs((), self._received, tuple(asked))).packets
        self._received = self.wires.exchange(lambda bus: [one.frame for one in sent if one.bus == bus])


class Theirs:
    """A loop of a package's user."""

    def __init__(self, robot: Robot, made: Round, address: Callable[[CanFrame], int]) -> None:
        self.wires, self._made, self._address = Wires(robot), made, address
        self._bus_of = {motor.device.address: motor.bus for motor in robot.motors.values()}
        self.heard = 0

    def round(self) -> None:
        """Go through it once."""
        self.heard = self._made(self._exchange)

    def _exchange(self, frames: Sequence[CanFrame]) -> Sequence[CanFrame]:
        packets = self.wires.exchange(
            lambda bus: [each for each in frames if self._bus_of[self._address(each)] == bus]
        )
        return [packet.frame for packet in packets if isinstance(packet.frame, CanFrame)]


def loops(effort: Effort) -> list[Row]:
    """Each protocol beside what is used with it."""
    return [measured(case, effort.of(600, 20)) for case in CASES]


@dataclass(frozen=True, slots=True)
class Case:
    """Twelve motors of one protocol, and a package with which a user would move them."""

    what: str
    robot: Callable[[], Robot]
    target: Callable[[str], Instruction]
    package: tuple[str, str]
    """Its module and distribution,"""
    how: str
    """and what of it is used."""
    loop: Callable[[Any, Robot], Round]
    """From the module and the robot"""
    address: Callable[[CanFrame], int]
    """Of the device that a frame is for."""


def measured(case: Case, rounds: int) -> Row:
    """So many rounds of each. Raises NotMeasured if one does not move the motors, or hears too few."""
    robot, other = case.robot(), rival(*case.package)
    name = other.name if other.why_not else f"{other.name}: {case.how}"
    contestants: dict[str, Ours | Theirs] = {OURS: Ours(robot, case.target)}
    if not other.why_not:
        contestants[name] = Theirs(robot, case.loop(other.module, robot), case.address)
    found = timed(contestants, rounds)
    for each in contestants.values():
        check(case, each.wires)
        if isinstance(each, Theirs) and each.heard < len(robot.motors):
            raise NotMeasured(f"{case.what}: {name} heard {each.heard} of {len(robot.motors)} motors")
    return Row(GROUP, case.what, found[OURS], against(found, name, missing=(other,)))


def timed(contestants: dict[str, Ours | Theirs], rounds: int) -> dict[str, Figures]:
    """Nanoseconds of so many rounds of each, once all are warm."""
    took: dict[str, list[float]] = {name: [] for name in contestants}
    with quiet_collector():
        while len(took[OURS]) < rounds:
            for name, each in contestants.items():
                counts, each.wires.elsewhere = each.wires.now >= WARM, 0
                began = stopwatch()
                each.round()
                took[name] += [stopwatch() - began - each.wires.elsewhere] if counts else []
    return {name: figures(samples) for name, samples in took.items()}


def check(case: Case, wires: Wires) -> None:
    """Raise NotMeasured if a motor does not do what it was to."""
    for motor in wires.robot.motors:
        position, velocity = wires.world.world.shaft(motor)
        wanted = case.target(motor)
        there = abs(position - PLACE) < 0.5 * PLACE if isinstance(wanted, Position) else velocity > 0.5 * TURN
        if not there:
            raise NotMeasured(
                f"{case.what}: {motor} is at {position:.3g} rad and turns at {velocity:.3g} rad/s"
            )


# -- what a user would write ---------------------------------------------------------------------------


def by_struct(can: Any, robot: Robot) -> Round:  # noqa: ANN401 -- without types
    """CANSimple by hand: messages of python-can, numbers by `struct`, a set-point of velocity a round."""
    message, pair, two = can.Message, struct.Struct("<ff"), struct.Struct("<II")
    gear = {motor.device.address: motor.joint.gear * motor.joint.sign for motor in robot.motors.values()}
    measured: dict[int, tuple[float, float]] = {}
    begun: list[int] = []

    def sent(node: int, command: int, data: bytes) -> CanFrame:
        made = message(arbitration_id=node << 5 | command, data=data, is_extended_id=False)
        return CanFrame(made.arbitration_id, bytes(made.data))

    def turn(exchange: Exchange) -> int:
        measured.clear()
        frames = []
        for node, ratio in gear.items():
            if not begun:
                frames += [sent(node, 0x0B, two.pack(2, 1)), sent(node, 0x07, struct.pack("<I", 8))]
            frames.append(sent(node, 0x0D, pair.pack(TURN * ratio / tau, 0.0)))
        begun.append(1)
        for frame in exchange(frames):
            came = message(arbitration_id=frame.id, data=frame.data, is_extended_id=False)
            if came.arbitration_id & 0x1F == 0x09:
                measured[came.arbitration_id >> 5] = pair.unpack(came.data)
        return len(measured)

    return turn


def by_cycle(moteus: Any, robot: Robot) -> Round:  # noqa: ANN401 -- without types
    """The vendor's package: `Transport.cycle` of a position without a place, which is a velocity, with a
    query, of all controllers."""

    class Wire(moteus.TransportDevice):  # type: ignore[misc]  # a package without types
        """Its adapter: what it is given goes onto our wires."""

        exchange: Exchange

        async def transaction(self, requests: Sequence[Any], **_: object) -> None:
            frames = [
                CanFrame(r.frame.arbitration_id, r.frame.data, extended=True, fd=True) for r in requests
            ]
            for frame in self.exchange(frames):
                came = moteus.Frame(frame.id, frame.data, len(frame.data), is_extended_id=True, is_fd=True)
                for request in requests:
                    if request.frame_filter is not None and request.frame_filter(came):
                        request.responses.append(came)
                        break

    wire = Wire()
    transport = moteus.Transport([wire])
    turns = {motor.device.address: motor.joint.sign / tau for motor in robot.motors.values()}
    controllers = {at: moteus.Controller(id=at, transport=transport) for at in turns}

    async def cycle() -> int:
        results = await transport.cycle(
            [
                each.make_position(position=float("nan"), velocity=TURN * turns[at], query=True)
                for at, each in controllers.items()
            ]
        )
        return len({each.id for each in results})

    return _in_loop(wire, cycle)


def _in_loop(wire: Any, cycle: Callable[[], Coroutine[Any, Any, int]]) -> Round:  # noqa: ANN401
    """Return a round that runs a coroutine, in the one event loop that a program has."""
    runner = asyncio.Runner()

    def turn(exchange: Exchange) -> int:
        wire.exchange = exchange
        return runner.run(cycle())

    weakref.finalize(turn, runner.close)
    return turn


def by_motors(package: Any, robot: Robot) -> Round:  # noqa: ANN401 -- without types
    """damiao-motor's class of a motor, with python-can's messages: `send_cmd_mit`, and each feedback."""
    sent: list[CanFrame] = []

    class Bus:
        """What its motors send by."""

        def send(self, message: Any) -> None:  # noqa: ANN401 -- python-can's
            """Take a message."""
            sent.append(CanFrame(message.arbitration_id, bytes(message.data)))

    bus, made = Bus(), package.DaMiaoMotor
    addresses = [motor.device.address for motor in robot.motors.values()]
    motors = {at: made(at, at + 16, bus, motor_type="4310") for at in addresses}
    signs = {motor.device.address: motor.joint.sign for motor in robot.motors.values()}
    begun: list[int] = []

    def turn(exchange: Exchange) -> int:
        sent.clear()
        for at, motor in motors.items():
            if not begun:
                motor.enable()
            motor.send_cmd_mit(signs[at] * PLACE, 0.0, STIFFNESS, DAMPING, 0.0)
        begun.append(1)
        heard = set[int]()
        for frame in exchange(sent):
            if (motor := motors.get(frame.id - 16)) is not None:
                motor.process_feedback_frame(frame.data, frame.id)
                heard.add(frame.id)
        return len(heard)

    return turn


def _turning(motor: str) -> Instruction:
    return Velocity(motor, TURN)


CASES = (
    Case(
        "a round: 12 ODrive, velocity",
        lambda: config.load_robot("twelve"),
        _turning,
        ("can", "python-can"),
        "its messages and struct",
        by_struct,
        lambda frame: frame.id >> 5,
    ),
    Case(
        "a round: 12 moteus, velocity",
        lambda: of_protocol("moteus", "timeout_ms = 100"),
        _turning,
        ("moteus", "moteus"),
        "transport.cycle",
        by_cycle,
        lambda frame: frame.id & 0x7F,
    ),
    Case(
        "a round: 12 Damiao in MIT mode, position",
        lambda: of_protocol("damiao", SPRING),
        lambda motor: Position(motor, PLACE),
        ("damiao_motor.core.motor", "damiao-motor"),
        "its class of a motor",
        by_motors,
        lambda frame: frame.id & 0x7F,
    ),
)
WHAT = [case.what for case in CASES]
