"""Every fault of the campaign, a row each: how it comes about, and when it must have been noticed.

`notice` is the time [s] within which a report names the device, its bus or a suspect, counted while the fault
shows (`shows`); None, with the reason, where nothing can be noticed, or need be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

from gateway.buses.virtual.bus import HOST
from gateway.buses.virtual.medium import Transmission
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from protocols import messages as msg
from protocols.conformance.random import Random
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Feedback, Instruction, LaserScan, Nanos
from tests.faults.session import Result, Run
from tests.faults.start import PHASES, Warm

Inject: TypeAlias = Callable[[Run], None]
Arrived: TypeAlias = Sequence[Transmission]
Memory: TypeAlias = dict[str, Any]
"""Of one fault in one run."""


BOOT: Nanos = 150 * MILLISECOND
"""From a device's supply to its first frame: few are faster."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault."""

    name: str
    inject: Inject
    on: Literal["motor", "wheel", "lidar", "imu"]
    """What has it: only robots with such a device are given it."""
    notice: float | None
    shows: Literal[
        "at once",
        "in motion",
        "once it has moved",
        "in turning",
        "if it strays",
        "if commanded",
        "if it was commanded",
    ] = "at once"
    why: str = ""
    """Why it is not noticed."""
    free: Literal["", "target", "all"] = ""
    """What no host can stop: after Stop that is reported, and it may move until its supply is cut."""
    harmless: bool = False
    """Whether it may be noticed all the same."""
    suspects: tuple[str, ...] = ()
    """What may be named instead of the device: where two sources disagree, either."""
    lasts: float = 1.0
    """s until Stop, where nothing is to be noticed."""


# -- frames ------------------------------------------------------------------------------------------------


def frames(change: Callable[[Run, Transmission], Arrived], seconds: float = 1.0) -> Inject:
    """Change what arrives on the target's bus, for a while."""

    def inject(run: Run) -> None:
        end = run.since + round(seconds * SECOND)
        run.world.tamper.transmission = lambda bus, one: (
            change(run, one) if bus == run.bus and one.t < end else (one,)
        )

    return inject


def later(one: Transmission, by: Nanos) -> Arrived:
    """Return a frame that is delayed."""
    return (replace(one, t=one.t + by),)


def damaged(run: Run, one: Transmission) -> Arrived:
    """Change one bit of every tenth frame."""
    data = bytearray(one.frame.data if isinstance(one.frame, CanFrame) else one.frame)
    if not data or run.random.below(10):
        return (one,)
    data[run.random.below(len(data))] ^= 1 << run.random.below(8)
    changed = replace(one.frame, data=bytes(data)) if isinstance(one.frame, CanFrame) else bytes(data)
    return (replace(one, frame=changed),)


# -- motors ------------------------------------------------------------------------------------------------


def provoked(run: Run) -> None:
    """Trip a fault that the device's specification lists."""
    codes = sorted(run.robot.motors[run.target].spec.faults)
    run.world.twin(run.target).provoke(run.random.choice(codes))


def encoder(change: Callable[[Run, Feedback, Memory], Feedback]) -> Inject:
    """Falsify what the target's encoder measures."""

    def inject(run: Run) -> None:
        memory: Memory = {}
        run.world.tamper.measured = lambda motor, true: (
            change(run, true, memory) if motor == run.target else true
        )

    return inject


def restarted(run: Run) -> None:
    """Switch the target off and on: it begins anew, and is silent until it has booted."""
    run.world.reset(run.target)
    run.world.disconnect(run.target)
    booted = run.since + BOOT

    def wait(now: Nanos) -> Sequence[Instruction]:
        if now >= booted:
            run.world.reconnect(run.target)
        return ()

    run.each = wait


def same_again(_run: Run, true: Any, memory: Memory) -> Any:
    return replace(memory.setdefault("as", true), t=true.t)


def jumped(run: Run, true: Feedback, memory: Memory) -> Feedback:
    by = memory.setdefault("by", run.random.choice((-1, 1)) * run.random.uniform(2.0, 30.0))
    return replace(true, position=(true.position or 0.0) + by * run.robot.motors[run.target].joint.gear)


def scaled(factor: float) -> Inject:
    """Let the target's encoder count this share from now on."""

    def change(_run: Run, true: Feedback, memory: Memory) -> Feedback:
        at, velocity = true.position or 0.0, true.velocity or 0.0
        begin = memory.setdefault("at", at)
        return replace(true, position=begin + factor * (at - begin), velocity=factor * velocity)

    return encoder(change)


def swapped(run: Run) -> None:
    """Exchange the encoders of the two wheels."""
    other = dict(zip(run.wheels, reversed(run.wheels), strict=True))

    def function(motor: str, true: Feedback) -> Feedback:
        if motor not in other:
            return true
        (position, velocity), joint = run.world.world.shaft(other[motor]), run.robot.motors[motor].joint
        ratio = joint.gear * joint.sign
        return replace(true, position=position * ratio, velocity=velocity * ratio)

    run.world.tamper.measured = function


def torque(change: Callable[[float], float]) -> Inject:
    """Change the torque of the target."""

    def inject(run: Run) -> None:
        name = run.target
        run.world.tamper.torques = lambda given: given | {name: change(given.get(name, 0.0))}

    return inject


def runaway(run: Run) -> None:
    """Make the target give half of its largest torque, whatever it is commanded."""
    half = run.random.choice((-0.5, 0.5)) * run.robot.motors[run.target].joint.limits.torque
    torque(lambda _given: half)(run)


# -- buses -------------------------------------------------------------------------------------------------


def lost(state: BusState, seconds: float) -> Inject:
    """Take the host's interface away, for a while."""

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

    def each(now: Nanos) -> Sequence[Instruction]:
        run.world.buses[run.bus].intrude(now, "babbler", [CanFrame(0, bytes(8))] * 60)
        return ()

    run.each = each


def second_gateway(run: Run) -> None:
    """Let another gateway with the same robot file command the same motors."""
    other, speed = Gateway(run.robot), run.random.choice((-4.0, 4.0))
    received: list[Packet] = []
    for watched in run.at.buses.values():
        watched.tap = received
    tasks: tuple[Instruction, ...] = (msg.Drive(0.0, speed / 4.0),)
    if not run.wheels:
        tasks = tuple(msg.Velocity(name, speed) for name in run.robot.motors)

    def each(now: Nanos) -> Sequence[Instruction]:
        packets = tuple(sorted(received, key=lambda packet: packet.t))
        received.clear()
        for packet in other.step(now, Inputs((), packets, tasks)).packets:
            run.world.buses[packet.bus].intrude(now, "other host", [packet.frame])
        return ()

    run.each = each


def replayed(run: Run) -> None:
    """Let another host send again what ours has sent, a while later."""
    bus, late = run.at.buses[run.bus], run.random.below(400) * MILLISECOND + 100 * MILLISECOND
    waiting: list[tuple[Nanos, Frame]] = []
    bus.sent = waiting

    def each(now: Nanos) -> Sequence[Instruction]:
        while waiting and now - waiting[0][0] >= late:
            run.world.buses[run.bus].intrude(now, "other host", [waiting.pop(0)[1]])
        return ()

    run.each = each


# -- sensors -----------------------------------------------------------------------------------------------


def reading(change: Callable[[Run, Any, Memory], Any]) -> Inject:
    """Falsify what the target senses."""

    def inject(run: Run) -> None:
        memory: Memory = {}
        run.world.tamper.reading = lambda true: (
            change(run, true, memory) if true.sensor == run.target else true
        )

    return inject


def ranges(change: Callable[[Run, LaserScan], Sequence[float]]) -> Inject:
    """Change a scan's ranges, within what the lidar can report."""
    return reading(
        lambda run, scan, _memory: replace(
            scan, ranges=tuple(min(each, scan.range_max) for each in change(run, scan))
        )
    )


def turned(degrees: float) -> Inject:
    """Turn the lidar, which has come loose."""

    def change(_run: Run, scan: LaserScan) -> Sequence[float]:
        beams = round(degrees / 360.0 * len(scan.ranges))
        return scan.ranges[-beams:] + scan.ranges[:-beams]

    return ranges(change)


def sector(width: float, change: Callable[[Run, Memory, int, float], float], about: float = 0.0) -> Inject:
    """Change what the beams of a sector read [rad, from ahead], by the beam's number and the true range."""

    def changed(run: Run, scan: LaserScan, memory: Memory) -> LaserScan:
        found = list(scan.ranges)
        for beam, true in enumerate(scan.ranges):
            if (
                abs(math.remainder(scan.angle_min + beam * scan.angle_increment - about, math.tau))
                < width / 2
            ):
                found[beam] = min(change(run, memory, beam, true), scan.range_max)
        return replace(scan, ranges=tuple(found))

    return reading(changed)


def quarter(change: Callable[[Memory, int, float], float]) -> Inject:
    """Change what the front quarter of a lidar reads."""
    return sector(math.pi / 2, lambda _run, memory, beam, true: change(memory, beam, true))


def phantom(run: Run) -> None:
    """Hang something before the lidar, 20° wide, on any side."""
    side = run.random.uniform(-math.pi, math.pi)
    sector(math.radians(20.0), lambda run, *_: 0.25 + run.random.uniform(-0.01, 0.01), side)(run)


def gyro(change: Callable[[float], float]) -> Inject:
    """Change the rate about the vertical axis."""

    def changed(_run: Run, true: msg.Imu, _memory: Memory) -> msg.Imu:
        x, y, z = true.angular_velocity
        return replace(true, angular_velocity=(x, y, change(z)))

    return reading(changed)


def silent(_run: Run, _true: Any, _memory: Memory) -> None:
    return None


# -- clocks and people -------------------------------------------------------------------------------------


def slow_steps(run: Run) -> None:
    """Let every twentieth step take 50 … 500 ms."""

    def each(_now: Nanos) -> Sequence[Instruction]:
        run.took = 0 if run.random.below(20) else (50 + run.random.below(450)) * MILLISECOND
        return ()

    run.each = each


def stamps(offset: Nanos, then_silent: bool = False) -> Inject:
    """Falsify the stamps of what is received on all buses."""

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
KEYS = tuple(
    f"{table}.{name}"
    for table, names in (
        ("{motor}.limits", "velocity acceleration torque"),
        ("brain.pursuit", "period lookahead_time idle_after"),
        ("brain.planner", "margin replan_after tolerance"),
        ("brain.health", "slow_age stand_age give_up recover"),
        ("brain.differential", "max_linear max_angular max_linear_acceleration radius"),
        ("brain.perception", "gyro_sigma nothing"),
    )
    for name in names.split()
)


def abuse(run: Run) -> None:
    """Let a person ask for anything, valid and invalid, at every tenth step."""
    random = run.random

    def number() -> float:
        return random.choice(NUMBERS) if random.below(2) else random.uniform(-30.0, 30.0)

    def motor() -> str:
        return random.choice((*run.robot.motors, "nobody", "all"))

    asked: tuple[Callable[[], Instruction], ...] = (
        lambda: msg.Goal(number(), number(), number()),
        lambda: msg.Drive(number(), number()),
        lambda: msg.Velocity(motor(), number(), number()),
        lambda: msg.Position(motor(), number(), number(), number()),
        lambda: msg.Torque(motor(), number()),
        lambda: msg.Impedance(motor(), number(), number(), number(), number(), number()),
        lambda: msg.Hold(motor()),
        lambda: msg.Stop("a person"),
        msg.Release,
        lambda: msg.ClearFault(motor()),
        lambda: msg.Zero(motor()),
        lambda: msg.Scan(run.bus),
        *[lambda: msg.Set(random.choice(KEYS).format(motor=motor()), number())] * 3,
    )
    run.each = lambda _now: () if random.below(10) else (random.choice(asked)(),)


EITHER = ("left", "right", "imu", "lidar")
LEVELS = "what should be is compared with what was received, and sent again until it is so"
DAMAGE = "a bit of every tenth frame, behind the checksum of the bus: refused, or amended by the next frame"
LATE = "missed deadlines are counted; no measurement shows them, set-points stay as they are meanwhile"

FAULTS: tuple[Fault, ...] = (
    Fault("nothing", lambda _run: None, "motor", None, why="there is none: a report would be a false alarm"),
    # frames
    Fault("frames lost, 30 %", frames(lambda run, one: (one,) if run.random.below(10) > 2 else ()),
          "motor", None, why=LEVELS, harmless=True),
    Fault("frames doubled", frames(lambda _run, one: (one, one)), "motor", None, why=LEVELS, harmless=True),
    Fault("frames 15 ms late", frames(lambda _run, one: later(one, 15 * MILLISECOND)),
          "motor", None, why="within every timeout", harmless=True),
    Fault("frames reordered", frames(lambda run, one: later(one, run.random.below(12) * MILLISECOND)),
          "motor", None, why=LEVELS, harmless=True),
    Fault("feedback damaged", frames(lambda run, one: (one,) if one.sender == HOST else damaged(run, one)),
          "motor", None, why=DAMAGE, harmless=True),
    Fault("commands damaged", frames(lambda run, one: damaged(run, one) if one.sender == HOST else (one,)),
          "motor", None, why=DAMAGE, harmless=True),
    Fault("scans damaged", frames(damaged), "lidar", None, why="checksums: a scan is lost", harmless=True),
    Fault("host not received", frames(lambda _run, one: () if one.sender == HOST else (one,), 60.0),
          "motor", 1.0, "if it strays", free="all"),
    Fault("devices not received", frames(lambda _run, one: (one,) if one.sender == HOST else (), 60.0),
          "motor", 0.3, "if commanded"),
    # motors; of a joint that is no wheel nothing else measures the motion: a false scale cannot be noticed
    Fault("device resets", restarted, "motor", 0.5, "if it was commanded"),
    Fault("device silent", lambda run: run.world.disconnect(run.target), "motor", 0.3, "if commanded",
          free="target"),
    Fault("device in fault", provoked, "motor", 0.3, "if commanded"),
    Fault("encoder stuck", encoder(lambda _run, true, memory: replace(
        true, position=memory.setdefault("at", true.position), velocity=0.0)), "motor", 0.6, "in motion"),
    Fault("feedback frozen", encoder(same_again), "motor", 0.5, "in motion"),
    Fault("encoder jumps", encoder(jumped), "motor", 0.3, "if it was commanded"),
    Fault("encoder at half scale", scaled(0.5), "wheel", 1.0, "in motion", suspects=EITHER),
    Fault("encoder reversed", scaled(-1.0), "motor", 0.5, "in motion"),
    Fault("encoders swapped", swapped, "wheel", 1.0, "in turning", suspects=EITHER),
    Fault("no torque", torque(lambda _given: 0.0), "motor", 0.6, "if it strays"),
    Fault("weak motor, 30 %", torque(lambda given: 0.3 * given), "motor", 0.6, "if it strays"),
    Fault("half torque", torque(lambda given: 0.5 * given), "motor", 0.6, "if it strays"),
    Fault("runaway", runaway, "motor", 0.5, "if commanded", free="target"),
    Fault("commands 300 ms late", frames(
        lambda _run, one: later(one, 300 * MILLISECOND) if one.sender == HOST else (one,), 60.0),
        "motor", 1.0, "if it strays"),
    # buses
    Fault("bus-off, back after 0.5 s", lost(BusState.OFF, 0.5), "motor", 0.1),
    Fault("bus gone, back after 0.5 s", lost(BusState.GONE, 0.5), "motor", 0.1),
    Fault("bus gone for good", lost(BusState.GONE, 60.0), "motor", 0.1, free="all"),
    Fault("bus of the sensors gone", lost(BusState.GONE, 60.0), "lidar", 0.1),
    Fault("bus saturated", saturated, "motor", 0.5, "if commanded", free="all"),
    # sensors
    Fault("lidar: all zeros", ranges(lambda _run, scan: [0.0] * len(scan.ranges)), "lidar", 0.7),
    Fault("lidar: all maxima", ranges(lambda _run, scan: [math.inf] * len(scan.ranges)), "lidar", 0.7),
    Fault("lidar: 0.5 m too far", ranges(lambda _run, scan: [each and each + 0.5 for each in scan.ranges]),
          "lidar", 1.0),
    Fault("lidar: turned by 180°", turned(180.0), "lidar", 1.0),
    Fault("lidar: turned by 5°", turned(5.0), "lidar", 1.0, suspects=EITHER),
    Fault("lidar: 90 % without a reading", ranges(
        lambda run, scan: [0.0 if run.random.below(10) else each for each in scan.ranges]), "lidar", 1.0),
    Fault("lidar frozen", reading(same_again), "lidar", 0.7, "in motion"),
    Fault("lidar: front quarter frozen", quarter(
        lambda memory, beam, true: memory.setdefault(str(beam), true)), "lidar", 0.8, "in motion"),
    Fault("lidar: front quarter blind", quarter(lambda *_: 0.0), "lidar", 0.7),
    Fault("lidar: front quarter at maximum", quarter(lambda *_: math.inf), "lidar", 0.7),
    Fault("lidar: a phantom at 0.25 m", phantom, "lidar", 0.5, "once it has moved"),
    Fault("lidar silent", reading(silent), "lidar", 0.6),
    Fault("IMU: bias of 0.3 rad/s", gyro(lambda rate: rate + 0.3), "imu", 1.2, suspects=EITHER),
    Fault("IMU constant", reading(same_again), "imu", 0.5),
    Fault("IMU reversed", gyro(lambda rate: -rate), "imu", 1.0, "in turning", suspects=EITHER),
    Fault("IMU silent", reading(silent), "imu", 0.3),
    # clocks, people, other hosts
    Fault("slow steps", slow_steps, "motor", None, lasts=2.0, harmless=True, why=LATE),
    Fault("stamps 1 s early", stamps(-SECOND), "motor", 0.3, "if commanded"),
    Fault("stamps 1 h late", stamps(3600 * SECOND), "motor", None, harmless=True,
          why="counted as received now, which is true within the delay of a frame"),
    Fault("stamps 1 h late, then silence", stamps(3600 * SECOND, True), "motor", 0.5, "if commanded",
          free="target"),
    Fault("operator's abuse", abuse, "motor", None, lasts=2.5, why="it is no fault", harmless=True),
    Fault("set-points replayed", replayed, "motor", 0.7, "if commanded", free="all"),
    Fault("a second gateway", second_gateway, "motor", 1.0, "if it strays", free="all"),
)  # fmt: skip

ROBOTS = (
    "diffbot", "diffbot_cia402", "diffbot_cubemars", "diffbot_damiao", "diffbot_mixed", "diffbot_mixed_can",
    "diffbot_moteus", "diffbot_myactuator", "diffbot_robomaster", "diffbot_robstride", "diffbot_vesc",
    "diffbot_zlac8015d", "bench", "bench05", "twelve",
)  # fmt: skip
"""Those of fixtures/ that have a world."""
BASES = tuple(name for name in ROBOTS if name.startswith("diffbot"))


def one_run(warm: Warm, seed: int, number: int) -> Result:
    """Run the case of this number: fault by fault, then the next robot, then the next phase."""
    around, index = divmod(number, len(FAULTS))
    fault = FAULTS[index]
    robots = ROBOTS if fault.on == "motor" else BASES
    turn, place = divmod(around, len(robots))
    phase = PHASES[(turn + place + index) % len(PHASES)]
    return Run(fault, warm, robots[place], phase, Random(seed * 1_000_003 + number)).run()
