"""Every fault of the campaign, a row each: how it comes about, and when it must have been noticed.

`notice` is the time [s] within which a report names the device (or its bus, or a suspect), counted while the
fault shows (`shows`); None with the reason in `why` where nothing can be noticed, or need be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from gateway.buses.virtual.bus import HOST
from gateway.buses.virtual.medium import Transmission
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from protocols import messages as msg
from protocols.conformance.random import Random
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Feedback, Instruction, Nanos
from tests.faults.session import PHASES, Result, Run, Warm


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault."""

    name: str
    inject: Callable[[Run], None]
    on: Literal["motor", "wheel", "lidar", "imu"]
    """What has it: only robots with such a device are given it."""
    notice: float | None
    shows: Literal[
        "at once", "in motion", "in turning", "if it strays", "if commanded", "if it was commanded"
    ] = "at once"
    why: str = ""
    """Why it is not noticed."""
    free: Literal["", "target", "all"] = ""
    """What no host can stop: it must be reported as such after Stop, and may move until its supply is cut."""
    harmless: bool = False
    """Whether it may be noticed all the same."""
    suspects: tuple[str, ...] = ()
    """What may be named beside the device and its bus: where two sources disagree, either."""
    lasts: float = 1.0
    """s until Stop, where nothing is to be noticed."""


# -- frames ------------------------------------------------------------------------------------------------


def on_frames(change: Callable[[Run, Transmission], Sequence[Transmission]], seconds: float = 1.0) -> Any:
    """Return an injection that changes every frame of the target's bus for a while."""

    def inject(run: Run) -> None:
        def transmission(bus: str, one: Transmission) -> Sequence[Transmission]:
            falsified = bus == run.bus and one.t < run.since + round(seconds * SECOND)
            return change(run, one) if falsified else (one,)

        run.world.tamper.transmission = transmission

    return inject


def share_lost(run: Run, one: Transmission) -> Sequence[Transmission]:
    return () if run.random.uniform() < 0.3 else (one,)


def doubled(run: Run, one: Transmission) -> Sequence[Transmission]:
    return (one, one) if run.random.uniform() < 0.5 else (one,)


def delayed(run: Run, one: Transmission) -> Sequence[Transmission]:
    return (replace(one, t=one.t + 15 * MILLISECOND),)


def reordered(run: Run, one: Transmission) -> Sequence[Transmission]:
    return (replace(one, t=one.t + run.random.below(12) * MILLISECOND),)


def damaged(run: Run, one: Transmission) -> Sequence[Transmission]:
    """Change one bit of every tenth frame."""
    data = bytearray(one.frame.data if isinstance(one.frame, CanFrame) else one.frame)
    if not data or run.random.below(10):
        return (one,)
    data[run.random.below(len(data))] ^= 1 << run.random.below(8)
    changed: Frame = replace(one.frame, data=bytes(data)) if isinstance(one.frame, CanFrame) else bytes(data)
    return (replace(one, frame=changed),)


def damaged_feedback(run: Run, one: Transmission) -> Sequence[Transmission]:
    return (one,) if one.sender == HOST else damaged(run, one)


def damaged_commands(run: Run, one: Transmission) -> Sequence[Transmission]:
    return damaged(run, one) if one.sender == HOST else (one,)


def host_unheard(_run: Run, one: Transmission) -> Sequence[Transmission]:
    return () if one.sender == HOST else (one,)


def devices_unheard(_run: Run, one: Transmission) -> Sequence[Transmission]:
    return (one,) if one.sender == HOST else ()


# -- devices -----------------------------------------------------------------------------------------------


def provoked(run: Run) -> None:
    """Trip a fault that the device's specification lists."""
    codes = sorted(run.robot.motors[run.target].spec.faults)
    device = run.world._devices(run.target)[0]
    device.twin.provoke(run.random.choice(codes))


Falsified = Callable[[Run, Feedback, dict[str, Any]], Feedback]


def measured(change: Falsified) -> Callable[[Run], None]:
    """Return an injection that falsifies what the target's encoder measures; with a memory of its own."""

    def inject(run: Run) -> None:
        memory: dict[str, Any] = {}

        def function(motor: str, true: Feedback) -> Feedback:
            return change(run, true, memory) if motor == run.target else true

        run.world.tamper.measured = function

    return inject


def stuck(_run: Run, true: Feedback, memory: dict[str, Any]) -> Feedback:
    return replace(true, position=memory.setdefault("at", true.position), velocity=0.0)


def frozen(_run: Run, true: Feedback, memory: dict[str, Any]) -> Feedback:
    kept: Feedback = memory.setdefault("as", true)
    return replace(kept, t=true.t)


def jumped(run: Run, true: Feedback, memory: dict[str, Any]) -> Feedback:
    by = memory.setdefault("by", run.random.choice((-1, 1)) * run.random.uniform(2.0, 30.0))
    return replace(true, position=(true.position or 0.0) + by * run.robot.motors[run.target].joint.gear)


def scaled(factor: float) -> Falsified:
    """Return an encoder that counts this share from now on."""

    def change(_run: Run, true: Feedback, memory: dict[str, Any]) -> Feedback:
        at = true.position or 0.0
        begin = memory.setdefault("at", at)
        return replace(true, position=begin + factor * (at - begin), velocity=factor * (true.velocity or 0.0))

    return change


def swapped(run: Run) -> None:
    """Exchange the encoders of the two wheels."""
    other = dict(zip(run.wheels, reversed(run.wheels), strict=True))
    ratio = {name: motor.joint.gear * motor.joint.sign for name, motor in run.robot.motors.items()}

    def function(motor: str, true: Feedback) -> Feedback:
        if motor not in other:
            return true
        position, velocity = run.world.world.shaft(other[motor])
        return replace(true, position=position * ratio[motor], velocity=velocity * ratio[motor])

    run.world.tamper.measured = function


def torque(change: Callable[[Run, float], float]) -> Callable[[Run], None]:
    """Return an injection that changes the torque of the target."""

    def inject(run: Run) -> None:
        run.world.tamper.torques = lambda torques: (
            torques | {run.target: change(run, torques.get(run.target, 0.0))}
        )

    return inject


def runaway(run: Run) -> None:
    """Make the target give half of its largest torque, whatever it is commanded."""
    full = run.random.choice((-0.5, 0.5)) * run.robot.motors[run.target].joint.limits.torque
    torque(lambda _run, _torque: full)(run)


# -- buses -------------------------------------------------------------------------------------------------


def lost(state: BusState, seconds: float) -> Callable[[Run], None]:
    """Return an injection that takes the host's interface away, for a while."""

    def inject(run: Run) -> None:
        bus, back = run.world.buses[run.bus], [run.since + round(seconds * SECOND)]
        bus.lose(state)

        def each(now: Nanos) -> Sequence[Instruction]:
            if back and now >= back[0]:
                back.clear()
                bus.restore()
            return ()

        run.each = each

    return inject


def saturated(run: Run) -> None:
    """Fill the bus with frames of the highest priority, as a babbling device does."""
    bus = run.world.buses[run.bus]

    def each(now: Nanos) -> Sequence[Instruction]:
        bus.intrude(now, "babbler", [CanFrame(0, bytes(8))] * 60)
        return ()

    run.each = each


def second_gateway(run: Run) -> None:
    """Let another gateway with the same robot file command the same motors."""
    other, bus = Gateway(run.robot), run.world.buses
    speed = run.random.choice((-4.0, 4.0))
    taken: list[Packet] = []
    for watched in run.at.buses.values():
        watched.tap = taken

    def each(now: Nanos) -> Sequence[Instruction]:
        tasks: list[Instruction] = (
            [msg.Drive(0.0, speed / 4.0)]
            if run.wheels
            else [msg.Velocity(name, speed) for name in run.robot.motors]
        )
        packets = tuple(sorted(taken, key=lambda packet: packet.t))
        taken.clear()
        for packet in other.step(now, Inputs((), packets, tuple(tasks))).packets:
            bus[packet.bus].intrude(now, "other host", [packet.frame])
        return ()

    run.each = each


# -- sensors -----------------------------------------------------------------------------------------------


def reading(change: Callable[[Run, Any, dict[str, Any]], Any]) -> Callable[[Run], None]:
    """Return an injection that falsifies what the target senses; with a memory of its own."""

    def inject(run: Run) -> None:
        memory: dict[str, Any] = {}

        def function(true: Any) -> Any:
            return change(run, true, memory) if true.sensor == run.target else true

        run.world.tamper.reading = function

    return inject


def ranges(
    change: Callable[[Run, tuple[float, ...], msg.LaserScan], Sequence[float]],
) -> Callable[[Run], None]:
    """Return an injection that changes a scan's ranges, within what the lidar can report."""

    def of(run: Run, scan: msg.LaserScan, _memory: dict[str, Any]) -> msg.LaserScan:
        changed = change(run, scan.ranges, scan)
        return replace(scan, ranges=tuple(min(each, scan.range_max) for each in changed))

    return reading(of)


def turned(degrees: float) -> Callable[[Run], None]:
    """Return an injection that turns a scan: the lidar has come loose."""

    def change(_run: Run, own: tuple[float, ...], _scan: msg.LaserScan) -> Sequence[float]:
        beams = round(degrees / 360.0 * len(own))
        return own[-beams:] + own[:-beams]

    return ranges(change)


def gyro(change: Callable[[float], float]) -> Callable[[Run], None]:
    """Return an injection that changes the rate about the vertical axis."""
    return reading(
        lambda _run, imu, _memory: replace(
            imu, angular_velocity=(*imu.angular_velocity[:2], change(imu.angular_velocity[2]))
        )
    )


def same_again(_run: Run, true: Any, memory: dict[str, Any]) -> Any:
    return replace(memory.setdefault("as", true), t=true.t)


# -- clocks and people -------------------------------------------------------------------------------------


def slow_steps(run: Run) -> None:
    """Let single steps take 50 … 500 ms."""

    def each(now: Nanos) -> Sequence[Instruction]:
        run.took = 0 if run.random.below(20) else (50 + run.random.below(450)) * MILLISECOND
        return ()

    run.each = each


def stamps(offset: Nanos, then_silent: bool = False) -> Callable[[Run], None]:
    """Return an injection that falsifies the stamps of what is received on all buses."""

    def inject(run: Run) -> None:
        for bus in run.at.buses.values():
            bus.skew = offset

        def each(now: Nanos) -> Sequence[Instruction]:
            if then_silent and now > run.since + 100 * MILLISECOND:
                run.world.disconnect(run.target)
            return ()

        run.each = each

    return inject


NUMBERS = (0.0, -1.0, 1e-300, 1e-3, 0.5, 10.0, 1000.0, 1e308, math.inf, math.nan)
KEYS = (
    *(f"{{motor}}.limits.{name}" for name in ("velocity", "acceleration", "torque")),
    *(f"brain.pursuit.{name}" for name in ("period", "lookahead_time", "idle_after")),
    *(f"brain.planner.{name}" for name in ("margin", "replan_after", "tolerance")),
    *(f"brain.health.{name}" for name in ("slow_age", "stand_age", "give_up", "recover")),
    *(
        f"brain.differential.{name}"
        for name in ("max_linear", "max_angular", "max_linear_acceleration", "radius")
    ),
    "brain.perception.gyro_sigma",
    "nothing.at.all",
)


def abuse(run: Run) -> None:
    """Let a person ask for anything, valid and invalid, at every tenth step."""
    random, motors = run.random, [*run.robot.motors, "nobody"]

    def number() -> float:
        return random.choice(NUMBERS) if random.below(2) else random.uniform(-30.0, 30.0)

    asked: tuple[Callable[[], Instruction], ...] = (
        lambda: msg.Goal(number(), number(), number()),
        lambda: msg.Drive(number(), number()),
        lambda: msg.Velocity(random.choice(motors), number(), number()),
        lambda: msg.Position(random.choice(motors), number(), number(), number()),
        lambda: msg.Torque(random.choice(motors), number()),
        lambda: msg.Impedance(random.choice(motors), number(), number(), number(), number(), number()),
        lambda: msg.Hold(random.choice(motors)),
        lambda: msg.Stop("a person"),
        msg.Release,
        lambda: msg.ClearFault(random.choice((*motors, "all"))),
        lambda: msg.Zero(random.choice(motors)),
        lambda: msg.Scan(run.bus),
        lambda: msg.Set(random.choice(KEYS).format(motor=random.choice(motors)), number()),
        lambda: msg.Set(random.choice(KEYS).format(motor=random.choice(motors)), number()),
    )

    def each(now: Nanos) -> Sequence[Instruction]:
        return () if random.below(10) else (random.choice(asked)(),)

    run.each = each


EITHER = ("left", "right", "imu", "lidar")
LEVELS = "what should be is compared with what was received, and sent again until it is so"
DAMAGE = "a bit of every tenth frame, behind the checksum of the bus: refused, or amended by the next frame"

FAULTS: tuple[Fault, ...] = (
    Fault("nothing", lambda _run: None, "motor", None, why="there is none: a report would be a false alarm"),
    # frames
    Fault("frames lost, 30 %", on_frames(share_lost), "motor", None, why=LEVELS, harmless=True),
    Fault("frames doubled", on_frames(doubled), "motor", None, why=LEVELS, harmless=True),
    Fault("frames 15 ms late", on_frames(delayed), "motor", None, why="within every timeout", harmless=True),
    Fault("frames reordered", on_frames(reordered), "motor", None, why=LEVELS, harmless=True),
    Fault("feedback damaged", on_frames(damaged_feedback), "motor", None, why=DAMAGE, harmless=True),
    Fault("commands damaged", on_frames(damaged_commands), "motor", None, why=DAMAGE, harmless=True),
    Fault("scans damaged", on_frames(damaged), "lidar", None, why="checksums: a scan is lost", harmless=True),
    Fault("host not received", on_frames(host_unheard, 60.0), "motor", 1.0, "if it strays", free="all"),
    Fault("devices not received", on_frames(devices_unheard, 60.0), "motor", 0.3, "if commanded"),
    # devices
    Fault("device resets", lambda run: run.world.reset(run.target), "motor", 0.5, "if it was commanded"),
    Fault("device silent", lambda run: run.world.disconnect(run.target), "motor", 0.3, "if commanded",
          free="target"),
    Fault("device in fault", provoked, "motor", 0.3, "if commanded"),
    Fault("encoder stuck", measured(stuck), "motor", 0.6, "in motion"),
    Fault("feedback frozen", measured(frozen), "motor", 0.5, "in motion"),
    Fault("encoder jumps", measured(jumped), "motor", 0.3),
    # of a joint that is no wheel nothing else measures the motion: there a false scale cannot be noticed
    Fault("encoder at half scale", measured(scaled(0.5)), "wheel", 1.0, "in motion", suspects=EITHER),
    Fault("encoder reversed", measured(scaled(-1.0)), "motor", 0.5, "in motion"),
    Fault("encoders swapped", swapped, "wheel", 1.0, "in turning", suspects=EITHER),
    Fault("no torque", torque(lambda _run, _torque: 0.0), "motor", 0.6, "if it strays"),
    Fault("weak motor, 30 %", torque(lambda _run, torque: 0.3 * torque), "motor", 0.6, "if it strays"),
    Fault("runaway", runaway, "motor", 0.5, "if commanded", free="target"),
    # buses
    Fault("bus-off, back after 0.5 s", lost(BusState.OFF, 0.5), "motor", 0.1),
    Fault("bus gone, back after 0.5 s", lost(BusState.GONE, 0.5), "motor", 0.1),
    Fault("bus gone for good", lost(BusState.GONE, 60.0), "motor", 0.1, free="all"),
    Fault("bus of the sensors gone", lost(BusState.GONE, 60.0), "lidar", 0.1),
    Fault("bus saturated", saturated, "motor", 0.5, "if commanded", free="all"),
    # sensors
    Fault("lidar: all zeros", ranges(lambda _run, own, _scan: (0.0,) * len(own)), "lidar", 1.0),
    Fault("lidar: all maxima", ranges(lambda _run, own, scan: (scan.range_max,) * len(own)), "lidar", 1.0),
    Fault("lidar: 0.5 m too far", ranges(
        lambda _run, own, _scan: [each and each + 0.5 for each in own]), "lidar", 2.0),
    Fault("lidar: turned by 180°", turned(180.0), "lidar", 2.0),
    Fault("lidar: turned by 5°", turned(5.0), "lidar", 3.0, suspects=EITHER),
    Fault("lidar: 90 % without a reading", ranges(
        lambda run, own, _scan: [0.0 if run.random.below(10) else each for each in own]), "lidar", 1.5),
    Fault("lidar frozen", reading(same_again), "lidar", 1.5, "in motion"),
    Fault("lidar silent", reading(lambda _run, _true, _memory: None), "lidar", 0.6),
    Fault("IMU: bias of 0.3 rad/s", gyro(lambda rate: rate + 0.3), "imu", 2.0, suspects=EITHER),
    Fault("IMU constant", reading(same_again), "imu", 1.0),
    Fault("IMU reversed", gyro(lambda rate: -rate), "imu", 2.0, "in turning", suspects=EITHER),
    Fault("IMU silent", reading(lambda _run, _true, _memory: None), "imu", 0.3),
    # clocks, people, other hosts
    Fault("slow steps", slow_steps, "motor", None, lasts=2.0, harmless=True,
          why="no measurement shows it: missed deadlines are counted, set-points stay as they are meanwhile"),
    Fault("stamps 1 s early", stamps(-SECOND), "motor", 0.3, "if commanded"),
    Fault("stamps 1 h late", stamps(3600 * SECOND), "motor", None, harmless=True,
          why="counted as received now, which is true within the delay of a frame"),
    Fault("stamps 1 h late, then silence", stamps(3600 * SECOND, True), "motor", 0.5, "if commanded",
          free="target"),
    Fault("operator's abuse", abuse, "motor", None, lasts=2.5, why="it is no fault", harmless=True),
    Fault("a second gateway", second_gateway, "motor", 1.0, "if it strays", free="all"),
)  # fmt: skip

ROBOTS = (
    "diffbot", "diffbot_cia402", "diffbot_damiao", "diffbot_mixed", "diffbot_moteus", "diffbot_zlac8015d",
    "bench", "bench05", "twelve",
)  # fmt: skip
"""Those of fixtures/ that have a world."""
BASES = tuple(name for name in ROBOTS if name.startswith("diffbot"))


def one_run(warm: Warm, seed: int, number: int) -> Result:
    """Run the case of this number: fault by fault, then the next robot, then the next phase."""
    round_, index = divmod(number, len(FAULTS))
    fault = FAULTS[index]
    robots = ROBOTS if fault.on == "motor" else BASES
    turn, place = divmod(round_, len(robots))
    phase = PHASES[(turn + place + index) % len(PHASES)]
    return Run(fault, warm, robots[place], phase, Random(seed * 1_000_003 + number)).run()
