"""How joints start on a bench: outside their range, a turn lost, held or turned by a host before, loaded.

Rules. Each case is one joint of one protocol on a shaft in virtual time, and one way to begin. The judge
sees the shaft and the torque of the motor, not what the gateway believes. No motor drives on a shaft that is
faster than its limit of velocity, by 2 % at most. None gives more than its limit of torque, by as much, where
torque is what it is commanded: by a torque, or a spring. The loops of a drive have limits of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import pi

from gateway import config
from gateway.buses.virtual.bus import TwinWorld, open_world
from gateway.core.clock import SimulatedClock
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from gateway.runtime.loop import moments, read, write
from gateway.runtime.timing import LoopStats
from protocols import messages as msg
from protocols.conformance.random import Random
from protocols.frames import Packet
from protocols.messages import SECOND, Command, Instruction

# fmt: off
MOTORS: dict[str, tuple[str, str, float]] = {
    "damiao": ("can", 'model = "4310"', 1.0),
    "robstride": ("can", 'model = "RS02"', 1.0),
    "robstride position": ("can", 'model = "RS02", mode = "position"', 1.0),
    "myactuator": ("can", "", 1.0),
    "myactuator motion": ("can", 'mode = "motion"', 1.0),
    "cubemars": ("can", 'watchdog = "acknowledged"', 1.0),
    "cubemars mit": ("can", 'mode = "mit", sole_host = true, watchdog = "acknowledged"', 1.0),
    "odrive_can": ("can", 'watchdog = "acknowledged"', 8.0),
    "cia402": ("can", "sync_ms = 10", 8.0),
    "moteus": ("canfd", "", 8.0),
    "vesc": ("can", "", 8.0),
    "robomaster": ("can", "", 1.0),
    "zlac8015d": ("can", "", 1.0),
}
# fmt: on
"""By protocol, and mode: the bus, the options of the driver, and the gear."""
LOW, HIGH = -1.5, 1.5
"""rad"""
FASTEST, STRONGEST = 5.0, 2.0
"""rad/s and N·m"""
NO_TORQUE = 0.01
"""N·m: what a device that gives none may give by rounding"""
TURNS = 2.0 * 2.0 * pi
"""rad: two turns"""


def robot_of(motor: str, *, on_fault: str = "continue") -> Robot:
    """Return a robot of one joint with a range."""
    bus, options, gear = MOTORS[motor]
    rate = "bitrate = 1_000_000" + ("\ndata_bitrate = 5_000_000" if bus == "canfd" else "")
    torque = STRONGEST if motor not in ("robomaster", "vesc") else 0.3 * gear
    return config.parse_robot(f"""
        name = "start"
        rate_hz = 200
        world = "bench"
        [buses.can0]
        kind = "{bus}"
        {rate}
        interface = "twin"
        [motors.left]
        protocol = "{motor.split()[0]}"
        bus = "can0"
        address = 1
        gear = {gear}
        feedback_timeout_ms = 200
        on_fault = "{on_fault}"
        options = {{ {options} }}
        [motors.left.limits]
        velocity = {FASTEST}
        acceleration = 20.0
        torque = {torque}
        position = [{LOW}, {HIGH}]
        [brain]
        body = "joints"
        [brain.joints]
        motors = ["left"]
    """)


@dataclass
class Bench:
    """One joint under way, and what its judge has seen."""

    robot: Robot
    world: TwinWorld
    clock: SimulatedClock
    gateway: Gateway
    offset: float = 0.0
    """rad at the output shaft by which the device reads more than the world's shaft has."""
    load: float = 0.0
    """N·m on the shaft beside the motor's"""
    damping: float = 0.0
    """N·m·s/rad of the shaft's bearings"""
    torque: float = 0.0
    """N·m that the motor gives"""
    fastest: float = 0.0
    """rad/s: of a shaft that its motor drove on"""
    strongest: float = 0.0
    """N·m"""
    judged: bool = True
    """Whether this gateway has sent it anything but what only reads. Before, what the motor does is not ours:
    it goes on with what it had from the host before, or ends that by its own watchdog."""
    notes: tuple[str, ...] = ()
    parameters: dict[str, float] = field(default_factory=dict)
    """Read, by name."""

    @classmethod
    def of(cls, robot: Robot, seed: int, at: float = 0.0) -> Bench:
        """Switch it on with its shaft at a position [rad], and wait until it has reported."""
        made = cls(robot, open_world(robot, seed), SimulatedClock(), Gateway(robot), at)
        ratio = robot.motors["left"].joint.gear
        made.world.tamper.measured = lambda _, true: replace(
            true, position=(true.position or 0.0) + made.offset * ratio
        )
        made.world.tamper.torques = made._judged
        made.run(2.0)
        return made

    def _judged(self, torques: dict[str, float]) -> dict[str, float]:
        self.torque = torques.get("left", 0.0)
        speed = self.world.world.shaft("left")[1]
        self.strongest = max(self.strongest, abs(self.torque) * self.judged)
        if self.judged and self.torque * speed > 0.0 and abs(self.torque) > NO_TORQUE:
            self.fastest = max(self.fastest, abs(speed))
        return torques | {"left": self.torque + self.load - self.damping * speed}

    def run(self, seconds: float, *given: Instruction, each: Callable[[], Instruction] | None = None) -> None:
        """Go on for some seconds; `each` gives an instruction for every step."""
        until = self.clock.now() + round(seconds * SECOND)
        for now in moments(self.clock, self.robot.period, self.gateway.due, LoopStats()):
            if now >= until:
                break
            states, packets = read(self.world.buses, now)
            given = (*given, each()) if each else given
            outputs = self.gateway.step(now, Inputs(tuple(states), tuple(packets), given))
            self.notes += tuple(note.text for note in outputs.notes)
            self.parameters |= {
                one.parameter: one.value for one in outputs.events if isinstance(one, msg.Parameter)
            }
            self.judged = self.judged or not self._only_reads(outputs.packets)
            write(self.world.buses, now, outputs.packets)
            given = ()

    def _only_reads(self, packets: Sequence[Packet]) -> bool:
        return all(self.robot.motors["left"].spec.read_only(packet.frame) for packet in packets)

    @property
    def place(self) -> float:
        """Where the shaft is, as its device reads it [rad]."""
        return self.world.world.shaft("left")[0] + self.offset

    def take_over(self) -> None:
        """Go on with a new gateway, as after a restart of the program; the motor is left as it is."""
        self.gateway, self.judged, self.strongest, self.fastest = Gateway(self.robot), False, 0.0, 0.0

    def keeps(self, command: Command) -> None:
        """Check that it has kept its limits, by this command."""
        motor = self.robot.motors["left"]
        limits, by_torque = motor.joint.limits, isinstance(command, msg.Torque | msg.Impedance)
        assert self.fastest <= 1.02 * limits.velocity, f"{self.fastest:.3g} rad/s"
        if motor.spec.gains is not None or by_torque:
            assert self.strongest <= 1.02 * limits.torque, f"{self.strongest:.3g} N·m"


def commands_of(robot: Robot) -> dict[str, Command]:
    """Return a strong command of each kind that the joint has, inwards."""
    motor = robot.motors["left"]
    every: list[Command] = [
        msg.Position("left", 0.0),
        msg.Hold("left"),
        msg.Velocity("left", -FASTEST),
        msg.Torque("left", -motor.joint.limits.torque),
        msg.Impedance("left", 0.0, 0.0, 0.0, 5.0, 0.5),
    ]
    able = motor.joint.commands(motor.spec)
    return {type(one).__name__: one for one in every if type(one) in able}


WAYS = ("outside", "lost turn", "zero", "held", "turned", "falling")


def start_case(seed: int, number: int) -> str:
    """Begin in one of the ways with one command, and judge; return the motor, the way and the command."""
    random = Random(seed * 1_000_003 + number)
    motor = list(MOTORS)[number % len(MOTORS)]
    robot = robot_of(motor)
    way, (name, command) = random.choice(WAYS), random.choice(sorted(commands_of(robot).items()))
    at = HIGH + random.uniform(0.02, TURNS if random.below(2) else 0.15)
    bench = Bench.of(robot, seed, at if way == "outside" else random.uniform(LOW, HIGH))
    if way in ("lost turn", "zero"):
        bench.run(0.5, command)
        bench.run(0.5, msg.Idle("left"))
        bench.world.reset("left")
        turn = 2.0 * pi / robot.motors["left"].joint.gear
        bench.offset -= bench.place if way == "zero" else turn * (1 + random.below(2))
        bench.run(0.2 + random.uniform(0.0, 1.0))
        bench.run(0.2, msg.ClearFault("left"))
    elif way in ("held", "turned"):
        first = commands_of(robot).get("Hold" if way == "held" else "Velocity")
        bench.run(0.5, first or command)
        bench.load = random.uniform(-0.3, 0.3) * robot.motors["left"].joint.limits.torque
        bench.run(0.2)
        bench.take_over()
        bench.run(random.uniform(0.05, 0.5))
    elif way == "falling":
        bench.load = random.uniform(-0.15, 0.15) * robot.motors["left"].joint.limits.torque
        bench.run(random.uniform(0.01, 0.05))
    bench.run(2.0, command)
    bench.keeps(command)
    return f"{motor}, {way}, {name}"
