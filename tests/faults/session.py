"""One run with one fault: a robot on its way, the fault at a random time, and what the true motion shows.

Rules. The judge trusts no report: motion and torque are the world's. A run ends as soon as it is decided, and
always with Stop, which must be obeyed within `STAND`, or reported as not obeyed within `REPORTED`.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from brain.belief import BrainState
from gateway.core.faults import FRAME_BLOCKED
from gateway.core.tick import Outputs
from gateway.runtime.timing import LoopStats, StepTiming
from protocols import messages as msg
from protocols.conformance.random import Random
from protocols.messages import MILLISECOND, SECOND, Instruction, Nanos
from tests.faults.start import STOPPED, TOUR, TURNING, Warm

if TYPE_CHECKING:
    from tests.faults.table import Fault

STAND: Nanos = 1200 * MILLISECOND
"""After Stop, or a fault that stops, no joint may be driven any longer than this: braking, then Idle."""
REPORTED: Nanos = 2 * SECOND
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
"""The longest time that a fault is given to show itself, and to be noticed."""


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
        sensor = fault.on in ("lidar", "imu")
        self.target = fault.on if sensor else random.choice(self.wheels or tuple(self.robot.motors))
        """The device that has the fault,"""
        self.bus = (self.robot.sensors if sensor else self.robot.motors)[self.target].bus
        """and its bus."""
        self.each: Callable[[Nanos], Sequence[Instruction]] = lambda _now: ()
        """The part of the fault that goes on, called at every step; returns what an operator asks."""
        self.since: Nanos = 0
        """When the fault was injected,"""
        self.ends = fault.ends
        """and after how many seconds it ends, where it ends by itself."""
        self.result = Result(fault.name, name, phase, self.target)
        self.torques: dict[str, float] = {}
        self.stats = LoopStats()
        self._turning = random.choice((-1.2, 1.2))
        self._targets = [
            msg.Velocity(motor, random.choice((-6.0, -3.0, 3.0, 6.0))) for motor in self.robot.motors
        ]
        self._released = self._commanded = self._reported = False
        """Whether motion was asked for again, the target was commanded when the fault came, and what still
        moves was reported as such."""
        self._strays: dict[str, Nanos] = {}
        """Since when each shaft has not followed."""
        self._exposed: Nanos = 0
        self._noticed_at: Nanos | None = None
        self._stopped_at: Nanos | None = None
        self._braking: list[str] = []
        """The wheels that were commanded when Stop came: they brake."""

    # -- the course of a run ----------------------------------------------------------------------------

    def run(self) -> Result:
        """Run until it is decided, then stop; return what it has shown."""
        began = time.process_time()
        self.world.tamper.torques = self._limited
        try:
            self._drive()
        except Exception as error:  # noqa: BLE001 -- whatever it is, it is what the campaign looks for
            self._fail(f"raised {type(error).__name__}: {error}")
        self._conclude()
        self.result.processor = round(time.process_time() - began, 3)
        return self.result

    def _drive(self) -> None:
        if self.phase == STOPPED:
            self.at.run(self.random.uniform(0.05, 0.45), msg.Stop("a person"))
        begin = self.at.clock.now()
        wait = {STOPPED: 0.0, TURNING: self.random.uniform(0.2, 1.2)}.get(
            self.phase, self.random.uniform(0.0, 0.4)
        )
        for now in self._steps(self._asked):
            if now - begin >= wait * SECOND:
                self._inject(now)
                break
        for now in self._steps(lambda now: [*self._asked(now), *self.each(now)]):
            if self._decided(now):
                self._stopped_at = now
                self._braking = [name for name in self.wheels if not math.isnan(self._wanted(name))]
                break
        for now in self._steps(self._stop):
            if self._over(now):
                break

    def _stop(self, now: Nanos) -> list[Instruction]:
        """Ask for Stop once; the fault goes on, its operator asks nothing more, and no step is slow."""
        self.each(now)
        self.world.tamper.takes = None
        return [msg.Stop("the end")] if now == self._stopped_at else []

    def _steps(self, asked: Callable[[Nanos], Sequence[Instruction]]) -> Iterator[Nanos]:
        """Yield the time of each step, before it is done."""
        timing = StepTiming(self.stats, self.robot.period, self.at.clock)
        for now in self.at.moments(self.stats):
            yield now
            instructions, takes = asked(now), self.world.tamper.takes
            timing.begin()
            outputs = self.at.step(now, instructions, takes(now) if takes is not None else 0)
            timing.end(now)
            if self.since:
                self._observe(now, outputs)

    def _inject(self, now: Nanos) -> None:
        self.since = self._last = now
        self._pose, self._turned = self.world.world.truth(), self._shaft(self.target)[0]
        self._contacts = self.world.world.contacts()
        braking = bool(self.gateway.stopped)  # then a restart changes nothing
        self._commanded = not braking and not math.isnan(self._wanted(self.target))
        self.fault.inject(self)
        if (own := self.world.tamper.torques) != self._limited and own is not None:
            self.world.tamper.torques = lambda torques: self._limited(own(torques))

    def _asked(self, now: Nanos) -> list[Instruction]:
        """Return what is asked of the robot in this phase; at rest, to move half a second after the fault."""
        if self.phase == TURNING:
            return [msg.Drive(0.1, self._turning)] if self.wheels else [*self._targets]
        if self.phase == TOUR or self._released or not self.since or now - self.since < SECOND // 2:
            return []
        self._released = True
        return [msg.Release(), *([msg.Goal(1.6, 0.6)] if self.wheels else self._targets)]

    def _limited(self, torques: dict[str, float]) -> dict[str, float]:
        """Keep the torques, limited as by the supply: at twice its limit of velocity there is none."""
        for name, torque in torques.items():
            limits, speed = self.robot.motors[name].joint.limits, self._shaft(name)[1]
            most = 2.0 * limits.torque * max(0.0, 1.0 - abs(speed) / (2.0 * limits.velocity))
            if torque * speed > 0.0 and abs(torque) > most:
                torques[name] = math.copysign(most, torque)
        self.torques = torques
        return torques

    def _decided(self, now: Nanos) -> bool:
        """True once it is noticed and stands, or has had its time."""
        waited = now - self.since
        if self.fault.notice is None:
            return waited > self.fault.lasts * SECOND
        return waited > HORIZON or (
            self._noticed_at is not None and (self._at_rest() or now - self._noticed_at > SECOND)
        )

    def _over(self, now: Nanos) -> bool:
        """True if the end has shown what it can."""
        stopped = now - (self._stopped_at or now)
        if self.fault.free:
            return self._reported or stopped > REPORTED
        return stopped > STAND + SECOND // 10 or (stopped > SECOND // 5 and self._at_rest())

    # -- judgement --------------------------------------------------------------------------------------

    def _shaft(self, name: str) -> tuple[float, float]:
        return self.world.world.shaft(name) if name in self.robot.motors else (0.0, 0.0)

    def _at_rest(self) -> bool:
        return all(abs(self._shaft(name)[1]) < 0.2 for name in self.robot.motors)

    def _driven(self, name: str) -> bool:
        speed = self._shaft(name)[1]
        return self.torques.get(name, 0.0) * speed > DRIVEN and abs(speed) > TURNING_ON

    def _wanted(self, name: str) -> float:
        """Return the velocity that a shaft is to have; NaN if none is commanded, or it has no shaft."""
        motor = self.robot.motors.get(name)
        return self.at.buses[motor.bus].wanted(name) if motor else math.nan

    def _observe(self, now: Nanos, outputs: Outputs) -> None:
        result, world = self.result, self.world.world
        span, self._last = now - self._last, now
        pose, turned = world.truth(), self._shaft(self.target)[0]
        moved = math.hypot(pose.x - self._pose.x, pose.y - self._pose.y)
        if self._stopped_at is None:
            result.distance += moved if self.wheels else abs(turned - self._turned)
            self._exposed += span if self._exposed_now(now) else 0
        self._touch(moved / (span / SECOND) if span else 0.0)
        self._pose, self._turned = pose, turned
        for name, motor in self.robot.motors.items():
            speed, wanted = self._shaft(name)[1], self._wanted(name)
            result.fastest = max(result.fastest, abs(speed) / motor.joint.limits.velocity)
            if abs(speed - wanted) > max(1.0, 0.4 * abs(wanted)):
                self._strays.setdefault(name, now)
            else:
                self._strays.pop(name, None)
            last = max(self.since, self.at.buses[motor.bus].driven_at.get(name, 0))
            free = self.fault.free == "all" or (self.fault.free == "target" and name == self.target)
            if now - min(last, self._stopped_at or last) > STAND and self._driven(name) and not free:
                self._fail(f"{name} is driven without a command")
        self._listen(now, outputs)

    def _touch(self, speed: float) -> None:
        contacts, result, fault = self.world.world.contacts(), self.result, self.fault
        if contacts > self._contacts and self.wheels:
            result.touches += contacts - self._contacts
            result.impact = max(result.impact, speed)
            if fault.notice is not None and not fault.free and self._exposed > fault.notice * SECOND:
                result.late_impact = max(result.late_impact, speed)
        self._contacts = contacts

    def _exposed_now(self, now: Nanos) -> bool:
        """True if the fault can be noticed at present; that of a sensor is of no account during a stop."""
        motors = [self.target] if self.target in self.robot.motors else [*self.robot.motors]
        wanted = [self._wanted(name) for name in motors]
        strays = any(now - since > STRAY for since in self._strays.values())
        match self.fault.shows:
            case "in motion":
                return strays or any(abs(each) > MOVING for each in wanted)
            case "once it has moved":
                return self.result.distance > 0.5
            case "in turning":
                left, right = map(self._wanted, self.wheels)
                return abs(left - right) > 1.5
            case "if it strays":
                return strays
            case "if commanded":
                return not all(map(math.isnan, wanted))
            case "if it was commanded":
                return self._commanded
        return not (self.gateway.stopped and self.target in self.robot.sensors)

    def _listen(self, now: Nanos, outputs: Outputs) -> None:
        """Find the first report that names a suspect; and any that something still moves."""
        trouble = self.stats.trouble
        notes = [note for note in outputs.notes if note.level != "info" and note.source != "operator"]
        reports = [f"{note.source}: {note.text}" for note in notes] + [f"loop: {trouble}"] * bool(trouble)
        for name, joint in self.gateway.joints.items():
            faults = [fault for fault in joint.faults.values() if fault.t >= self.since]
            reports += [f"{name}: {fault.name}; {fault.remedy}" for fault in faults]
            for fault in faults:
                if fault.code == FRAME_BLOCKED:
                    self._fail(f"a driver's frame, blocked: {fault.cause[:80]}")
        self._reported = self._reported or any("armed" in each or "cut " in each for each in reports)
        if self.result.noticed is not None or self._stopped_at is not None:
            return
        if now % (20 * MILLISECOND) < 5 * MILLISECOND:
            belief = self.gateway.belief()
            bad = belief.state in (BrainState.DEGRADED, BrainState.STOPPED)
            if bad and not belief.reason.startswith("just recovered"):
                reports.append(belief.reason)
        suspects = (self.target, self.bus, *self.fault.suspects, *(["wheels"] if self.wheels else []))
        for report in reports:
            if self.result.noticed is None and re.search(rf"\b({'|'.join(suspects)})\b", report):
                self.result.noticed, self.result.alarm = self._exposed / SECOND, report[:100]
                self._noticed_at = now

    def _fail(self, text: str) -> None:
        if text not in self.result.failed:
            self.result.failed.append(text)

    def _conclude(self) -> None:
        result, notice = self.result, self.fault.notice
        result.exposed = self._exposed / SECOND
        result.unsafe = [each for bus in self.at.buses.values() for each in bus.unsafe][:5]
        if result.unsafe:
            self._fail(f"unsafe frames: {result.unsafe[0]}")
        if notice is None:
            if result.noticed is not None and not self.fault.harmless:
                self._fail(f"a false alarm: {result.alarm}")
        elif result.noticed is None and result.exposed > notice:
            self._fail(f"not noticed in {result.exposed:.2f} s")
        elif result.noticed is not None and result.noticed > notice:
            self._fail(f"noticed late: {result.noticed:.2f} s")
        if result.late_impact > SOFT:
            self._fail(f"touched a wall at {result.late_impact:.2f} m/s")
        moving = [name for name in self.robot.motors if self._driven(name)]
        # A joint that is in fault itself is let go, and cannot brake.
        braking = [name for name in self._braking if not self.gateway.joints[name].faults]
        coasting = [name for name in braking if abs(self._shaft(name)[1]) > TURNING_ON]
        if coasting and (notice is None or self.target in self.robot.sensors):
            self._fail(f"{', '.join(coasting)} has not been braked after Stop")
        if self.fault.free and moving and not self._reported:
            self._fail(f"{', '.join(moving)} turns on after Stop, and nothing reports it")
