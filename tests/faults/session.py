"""One run with one fault: a robot on its way, the fault at a random time, and what the true motion shows.

Rules. The judge trusts nobody: motion and torque are the world's, set-points are read with decoders of its
own from what the host writes, limits are the robot file's. A run starts from a copy of a robot that is
under way (`Warm`), ends as soon as it is decided, and always ends with Stop, which is obeyed within `STAND`.
"""

from __future__ import annotations

import copy
import math
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from brain.belief import BrainState
from gateway import config
from gateway.buses.virtual.bus import TwinBus, TwinWorld, open_world
from gateway.core.clock import SimulatedClock
from gateway.core.guard import decoder_of
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs
from gateway.runtime.loop import LoopStats, moments, read, write
from protocols import messages as msg
from protocols.conformance.random import Random
from protocols.frames import BusState, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Instruction, Mode, Nanos

if TYPE_CHECKING:
    from tests.faults.table import Fault

STAND: Nanos = 1200 * MILLISECOND
"""After Stop, or a fault that stops, no joint may be driven any longer than this: braking, then Idle."""
TOLD: Nanos = 2 * SECOND
"""After Stop, what still moves and cannot be stopped has been reported."""
SOFT = 0.1
"""m/s: a wall may be touched slower than this, by what coasts."""
DRIVEN, TURNING_ON = 0.02, 1.0
"""W of the torque on a shaft, and its rad/s, from which on it counts as driven."""
MOVING = 2.0
"""rad/s of a set-point: what is commanded less may be followed or not."""
STRAY: Nanos = 150 * MILLISECOND
"""A shaft strays if it is more than 1 rad/s and 40 % off its set-point for this time."""
HORIZON: Nanos = 4 * SECOND
"""The longest time that a fault is given to show itself."""
STANDING, STOPPED, TURNING, TOUR = PHASES = ("standing", "stopped", "turning", "tour")


@dataclass
class WatchedBus:
    """A bus of the world, and the judge's decoder of what the gateway writes to it."""

    bus: TwinBus
    robot: Robot
    gateway: Gateway
    skew: Nanos = 0
    """What the stamps of the received packets are wrong by."""
    tap: list[Packet] | None = None
    """Where everything received is put, for another host on the bus."""
    setpoints: dict[str, msg.Command] = field(default_factory=dict)
    """What the device last obeys of it, by motor,"""
    driven_at: dict[str, Nanos] = field(default_factory=dict)
    """and when it was last to give torque while nothing was stopped."""
    unsafe: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.name = self.bus.name
        self.decoder = decoder_of(self.robot, self.name)

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Pass on what the world has, with its stamps as falsified."""
        states, packets = self.bus.read(now)
        if self.tap is not None:
            self.tap.extend(packets)
        return states, [replace(p, t=p.t + self.skew) for p in packets] if self.skew else packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Judge what the devices would obey, and pass it on."""
        for frame in frames:
            for message in self.decoder.decode(now, frame):
                if isinstance(message, msg.Command | msg.Arm):
                    self._judge(now, message)
        self.bus.write(now, frames)

    def close(self) -> None:
        """Close the bus."""
        self.bus.close()

    def _judge(self, now: Nanos, message: msg.Command | msg.Arm) -> None:
        joint, motor = self.gateway.joints[message.motor], self.robot.motors[message.motor]
        halted = bool(self.gateway.why_stopped() or joint.faults)
        if isinstance(message, msg.Arm):
            if halted and joint.mode is not Mode.ARMED and motor.joint.stop_action != "hold":
                self.unsafe.append(f"{message.motor} is armed against a stop")
            return
        self.setpoints[message.motor] = message
        if not halted and not isinstance(message, msg.Idle):
            self.driven_at[message.motor] = now
        limits, gear = motor.joint.limits, motor.joint.gear
        for name, limit in (("velocity", limits.velocity * gear), ("torque", limits.torque / gear)):
            value = getattr(message, name, 0.0)
            known = motor.spec.ranges.get(f"{type(message).__name__}.{name}")
            fuzz = limit * 1e-3 + (known.resolution if known else 0.0)
            if not (math.isfinite(value) and abs(value) <= limit + fuzz):
                self.unsafe.append(f"{message.motor}: {name} {value:g}, limit {limit:g}")
        if not math.isfinite(getattr(message, "position", 0.0)):
            self.unsafe.append(f"{message.motor}: position {message}")

    def wanted(self, motor: str) -> float:
        """Return the velocity at the output shaft that a motor is to have, NaN if it is to have none."""
        setpoint = self.setpoints.get(motor)
        if setpoint is None or isinstance(setpoint, msg.Idle | msg.Torque):
            return math.nan
        joint = self.robot.motors[motor].joint
        return float(getattr(setpoint, "velocity", 0.0)) / (joint.gear * joint.sign)


@dataclass
class Robotic:
    """A robot under way, in its world: plain state that can be copied."""

    robot: Robot
    clock: SimulatedClock
    world: TwinWorld
    gateway: Gateway
    buses: dict[str, WatchedBus]

    @classmethod
    def switched_on(cls, name: str, seed: int) -> Robotic:
        """Open a robot with its world, and wait until everything has reported."""
        robot = config.load_robot(name)
        world, gateway = open_world(robot, seed), Gateway(robot)
        buses = {name: WatchedBus(bus, robot, gateway) for name, bus in world.buses.items()}
        made = cls(robot, SimulatedClock(), world, gateway, buses)
        made.run(1.5)
        return made

    def copied(self) -> Robotic:
        """Return a copy, which shares what is never changed."""
        file = self.world.world.file
        return copy.deepcopy(self, {id(self.robot): self.robot, id(file): file})

    def run(self, seconds: float, *instructions: Instruction) -> None:
        """Go on for some seconds, beginning with the instructions."""
        until = self.clock.now() + round(seconds * SECOND)
        for now in self.moments():
            if now >= until:
                break
            self.step(now, instructions)
            instructions = ()

    def moments(self) -> Iterator[Nanos]:
        """Yield the moments to step at, from now on."""
        return moments(self.clock, self.robot.period, self.gateway.due, LoopStats())

    def step(self, now: Nanos, instructions: Sequence[Instruction], took: Nanos = 0) -> Outputs:
        """Do one step as the live loop does, which takes some time."""
        states, packets = read(self.buses, now)
        outputs = self.gateway.step(now, Inputs(tuple(states), tuple(packets), tuple(instructions)))
        self.clock.wait(now + took)
        write(self.buses, now + took, outputs.packets)
        return outputs

    def wheels(self) -> tuple[str, ...]:
        """Return the names of a base's wheels; () of none."""
        body = self.robot.brain.differential
        return (body.left, body.right) if body else ()


class Warm:
    """Robots under way, at up to `way` places a second apart: each is driven there once, and copied for runs."""

    def __init__(self, seed: int, way: int = 10) -> None:
        self.seed, self.way = seed, way
        self._places: dict[str, list[Robotic]] = {}

    def start(self, name: str, phase: str, random: Random) -> Robotic:
        """Return a robot in this phase, somewhere on its way."""
        places = self._places.setdefault(name, [])
        if not places:
            places.append(Robotic.switched_on(name, self.seed))
        if phase in (STANDING, TURNING):
            return places[0].copied()
        index = 1 + random.below(self.way)
        while len(places) <= index:
            further = places[-1].copied()
            further.run(1.0, *(tour(further) if len(places) == 1 else ()))
            places.append(further)
        return places[index].copied()


def tour(robotic: Robotic) -> list[Instruction]:
    """Return what sets a robot going: a base's goals, the others' targets."""
    if robotic.wheels():
        return [msg.Goal(*each) for each in robotic.world.world.tour]
    return [msg.Velocity(name, 3.0 + index) for index, name in enumerate(robotic.robot.motors)]


@dataclass
class Result:
    """What one run has shown. Times in s, of the robot's clock."""

    fault: str
    robot: str
    phase: str
    target: str
    noticed: float | None = None
    """After the fault could be noticed: how long until it was,"""
    alarm: str = ""
    """and how it was first reported."""
    exposed: float = 0.0
    """How long it could be noticed."""
    distance: float = 0.0
    """m of the base, or rad of the target's shaft, after the fault until the end."""
    touches: int = 0
    impact: float = 0.0
    """m/s of the hardest touch of a wall,"""
    late_impact: float = 0.0
    """and of those after the fault could have been known."""
    fastest: float = 0.0
    """Largest share of its limit at which any shaft turned."""
    unsafe: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    processor: float = 0.0


class Run:
    """One fault, injected into a robot on its way."""

    def __init__(self, fault: Fault, warm: Warm, name: str, phase: str, random: Random) -> None:
        self.fault, self.phase, self.random = fault, phase, random
        self.at = warm.start(name, phase, random)
        self.robot, self.world, self.gateway = self.at.robot, self.at.world, self.at.gateway
        self.wheels = self.at.wheels()
        sensors = fault.on in ("lidar", "imu")
        self.target = fault.on if sensors else random.choice(self.wheels or tuple(self.robot.motors))
        """The device that has the fault,"""
        self.bus = self.robot.motors[self.target].bus if not sensors else "sensors"
        """and its bus."""
        self.each: Callable[[Nanos], Sequence[Instruction]] = lambda _now: ()
        """The part of the fault that goes on, called at every step; returns what an operator asks."""
        self.took: Nanos = 0
        """How long each step takes."""
        self.since: Nanos = 0
        """When the fault was injected."""
        self.result = Result(fault.name, name, phase, self.target)
        self.torques: dict[str, float] = {}
        self._strays: dict[str, Nanos] = {}
        """Since when each shaft does not follow,"""
        self._exposed: Nanos = 0
        self._last: Nanos = 0
        self._pose = self.world.world.truth()
        self._turned = self.world.world.shaft(next(iter(self.robot.motors)))[0]
        self._contacts = self.world.world.contacts()
        self._alarms = 0
        self._stopped_at: Nanos | None = None
        self._told = False
        self._commanded = False
        """Whether the target was to give torque when the fault came."""
        self._direction = random.choice((-1.0, 1.0))
        self._target_speeds = [random.choice((-6.0, -3.0, 3.0, 6.0)) for _ in self.robot.motors]

    # -- the course of a run ----------------------------------------------------------------------------

    def run(self) -> Result:
        """Run until it is decided, then stop; return what it has shown."""
        began = time.process_time()
        self.world.tamper.torques = self._observe
        try:
            self._drive()
        except Exception as error:  # noqa: BLE001 -- whatever it is, it is what the campaign looks for
            self.result.failed.append(f"raised {type(error).__name__}: {error}")
        self._conclude()
        self.result.processor = round(time.process_time() - began, 3)
        return self.result

    def _drive(self) -> None:
        at, begin = self.at, self.at.clock.now()
        inject_at = begin + self.random.below(1000 if self.phase == TURNING else 400) * MILLISECOND
        injected = False
        if self.phase == STOPPED:
            at.run(0.05 + self.random.uniform() * 0.4, msg.Stop("a person"))
            inject_at = at.clock.now()
        end: Nanos | None = None
        driven_next = 0
        for now in at.moments():
            instructions: list[Instruction] = []
            if not injected and now >= inject_at:
                injected, self.since, self._last = True, now, now
                self._pose, self._turned = self.world.world.truth(), self._shaft(self.target)[0]
                self._commanded = self._is_commanded()
                self.fault.inject(self)
                self._overlay()
            if now >= driven_next and end is None:
                driven_next = now + 100 * MILLISECOND
                instructions += self._asked(now, injected)
            if injected:
                if end is None and self._decided(now):
                    end = now
                    instructions = [msg.Stop("the end")]
                    self._stopped_at = now
                elif end is None:
                    instructions += self.each(now)
                else:
                    self.each(now)
            outputs = at.step(now, instructions, self.took)
            if injected:
                self._observe_step(now, outputs)
            if end is not None and self._over(now - end):
                return

    def _over(self, stopped: Nanos) -> bool:
        """True if the end has shown what it can."""
        if self.fault.free:
            return self._told or stopped > TOLD
        return stopped > STAND + 100 * MILLISECOND or (stopped > 200 * MILLISECOND and self._at_rest())

    def _asked(self, now: Nanos, injected: bool) -> list[Instruction]:
        """Return what is asked of the robot in this phase, every 100 ms."""
        waited = now - self.since if injected else -1
        if self.phase == TURNING and self.wheels:
            return [msg.Drive(0.1, 1.2 * self._direction)]
        if self.phase == TURNING:
            return self._targets()
        if self.phase in (STANDING, STOPPED) and 500 * MILLISECOND <= waited < 600 * MILLISECOND:
            release = [msg.Release()] if self.phase == STOPPED else []
            return [*release, *([msg.Goal(1.6, 0.6)] if self.wheels else self._targets())]
        return []

    def _targets(self) -> list[Instruction]:
        return [
            msg.Velocity(name, speed)
            for name, speed in zip(self.robot.motors, self._target_speeds, strict=True)
        ]

    def _is_commanded(self) -> bool:
        return self.target in self.robot.motors and not math.isnan(
            self.at.buses[self.bus].wanted(self.target)
        )

    def _overlay(self) -> None:
        """Let the fault's own function change the torques before they are limited and observed."""
        own = self.world.tamper.torques
        if own is not None and own != self._observe:
            self.world.tamper.torques = lambda torques: self._observe(own(torques))

    def _observe(self, torques: dict[str, float]) -> dict[str, float]:
        """Keep the torques, limited as by the supply: at twice its limit of velocity there is none."""
        for name, torque in torques.items():
            limits, speed = self.robot.motors[name].joint.limits, self._shaft(name)[1]
            most = 2.0 * limits.torque * max(0.0, 1.0 - abs(speed) / (2.0 * limits.velocity))
            if torque * speed > 0.0 and abs(torque) > most:
                torques[name] = math.copysign(most, torque)
        self.torques = torques
        return torques

    # -- judgement --------------------------------------------------------------------------------------

    def _shaft(self, name: str) -> tuple[float, float]:
        return self.world.world.shaft(name) if name in self.robot.motors else (0.0, 0.0)

    def _at_rest(self) -> bool:
        return all(abs(self._shaft(name)[1]) < 0.2 for name in self.robot.motors)

    def _decided(self, now: Nanos) -> bool:
        """True once it is noticed and stands, or has had its time."""
        fault, waited = self.fault, now - self.since
        if fault.notice is None:
            return waited > round(fault.lasts * SECOND)
        if waited > HORIZON:
            return True
        if self.result.noticed is not None:
            return self._at_rest() or self._exposed > (fault.notice + 1.0) * SECOND
        return self._exposed > (1.5 * fault.notice + 0.3) * SECOND

    def _observe_step(self, now: Nanos, outputs: Outputs) -> None:
        result, world = self.result, self.world.world
        span, self._last = now - self._last, now
        pose, turned = world.truth(), self._shaft(self.target)[0]
        moved = math.hypot(pose.x - self._pose.x, pose.y - self._pose.y)
        if self._stopped_at is None:
            result.distance += moved if self.wheels else abs(turned - self._turned)
        self._touch(moved / (span / SECOND) if span else 0.0)
        self._pose, self._turned = pose, turned
        for name, motor in self.robot.motors.items():
            speed = self._shaft(name)[1]
            result.fastest = max(result.fastest, abs(speed) / motor.joint.limits.velocity)
            self._judge_drive(now, name, speed)
            self._follow(now, name, speed)
        if self._stopped_at is None:
            self._exposed += span if self._exposed_now(now) else 0
        self._listen(outputs, now)

    def _touch(self, speed: float) -> None:
        contacts = self.world.world.contacts()
        if contacts > self._contacts and self.wheels:
            result, fault = self.result, self.fault
            result.touches += contacts - self._contacts
            result.impact = max(result.impact, speed)
            if fault.notice is not None and not fault.free and self._exposed > fault.notice * SECOND:
                result.late_impact = max(result.late_impact, speed)
        self._contacts = contacts

    def _judge_drive(self, now: Nanos, name: str, speed: float) -> None:
        """No joint gives torque in its direction of motion long after it was last commanded to."""
        bus = self.at.buses[self.robot.motors[name].bus]
        last = bus.driven_at.get(name, 0)
        if self._stopped_at is not None:
            last = min(last, self._stopped_at)
        if self._driven(name, speed) and now - max(last, self.since) > STAND and not self._free(name):
            self._fail(f"{name} is driven without a command")

    def _free(self, name: str) -> bool:
        free = self.fault.free
        return free == "all" or (free == "target" and name == self.target)

    def _follow(self, now: Nanos, name: str, speed: float) -> None:
        wanted = self.at.buses[self.robot.motors[name].bus].wanted(name)
        if abs(speed - wanted) > max(1.0, 0.4 * abs(wanted)):
            self._strays.setdefault(name, now)
        else:
            self._strays.pop(name, None)

    def _exposed_now(self, now: Nanos) -> bool:
        """True if the fault can be noticed at present; that of a sensor is of no account during a stop."""
        if self.gateway.stopped and self.target in ("lidar", "imu"):
            return False
        wanted = {
            name: self.at.buses[motor.bus].wanted(name)
            for name, motor in self.robot.motors.items()
            if self.target in (name, "lidar", "imu")
        }
        match self.fault.shows:
            case "in motion":
                strays = any(now - since > STRAY for since in self._strays.values())
                return self._exposed > 0 or strays or any(abs(each) > MOVING for each in wanted.values())
            case "in turning":
                left, right = (wanted.get(name, math.nan) for name in self.wheels)
                return abs(left - right) > 1.5
            case "if it strays":
                return self._exposed > 0 or any(now - since > STRAY for since in self._strays.values())
            case "if it was commanded":
                return self._commanded
            case "if commanded":
                return self._exposed > 0 or any(not math.isnan(each) for each in wanted.values())
        return True

    def _listen(self, outputs: Outputs, now: Nanos) -> None:
        """Find the first report that names a suspect; and, after Stop, that something is still armed."""
        notes = [note for note in outputs.notes if note.level != "info" and note.source != "operator"]
        reports = [f"{note.source}: {note.text}" for note in notes]
        for name, joint in self.gateway.joints.items():
            faults = [fault for fault in joint.faults.values() if fault.t >= self.since]
            reports += [f"{name}: {fault.name}; {fault.remedy}" for fault in faults]
        self._told = self._told or any("armed" in each or "cut " in each for each in reports)
        if self.result.noticed is None and now % (20 * MILLISECOND) < 5 * MILLISECOND:
            belief = self.gateway.belief()
            if belief.state in (BrainState.DEGRADED, BrainState.STOPPED):
                reports.append(belief.reason)
        if self._stopped_at is not None:
            return
        suspects = (self.target, self.bus, *self.fault.suspects, *(["wheels"] if self.wheels else []))
        for report in reports:
            if any(re.search(rf"\b{each}\b", report) for each in suspects) and self.result.noticed is None:
                self.result.noticed, self.result.alarm = self._exposed / SECOND, report[:100]

    def _fail(self, text: str) -> None:
        if text not in self.result.failed:
            self.result.failed.append(text)

    def _conclude(self) -> None:
        result, fault = self.result, self.fault
        result.exposed = self._exposed / SECOND
        result.unsafe = [each for bus in self.at.buses.values() for each in bus.unsafe][:5]
        if result.unsafe:
            self._fail(f"unsafe frames: {result.unsafe[0]}")
        if fault.notice is None and not fault.harmless and result.noticed is not None:
            self._fail(f"a false alarm: {result.alarm}")
        if fault.notice is not None and result.noticed is None and result.exposed > fault.notice:
            self._fail(f"not noticed in {result.exposed:.2f} s")
        if result.noticed is not None and fault.notice is not None and result.noticed > fault.notice:
            self._fail(f"noticed late: {result.noticed:.2f} s")
        if result.late_impact > SOFT:
            self._fail(f"touched a wall at {result.late_impact:.2f} m/s")
        moving = [name for name in self.robot.motors if self._driven(name, self._shaft(name)[1])]
        if fault.free and moving and not self._told:
            self._fail(f"{', '.join(moving)} turns on after Stop, and nobody is told")

    def _driven(self, name: str, speed: float) -> bool:
        return self.torques.get(name, 0.0) * speed > DRIVEN and abs(speed) > TURNING_ON
