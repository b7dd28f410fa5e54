"""Every fault of the campaign, a row each: how it comes about (`CAUSES`), and when it must be noticed.

`notice` is the time [s] within which a report names the device, its bus or a suspect, counted while the fault
shows (`shows`); None, with the reason, where nothing can be noticed, or need be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from gateway.buses.virtual.faults import CAUSES
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from protocols import messages as msg
from protocols.conformance.random import Random
from protocols.frames import Frame, Packet
from protocols.messages import MILLISECOND, Instruction, Nanos
from tests.faults.session import Result, Run
from tests.faults.start import PHASES, Warm

Inject: TypeAlias = Callable[[Run], None]


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
    ends: float = 1.0
    """s after which frames, or the host's interface, are as before."""


def of(name: str) -> Inject:
    """Return how a fault comes about that scenarios can have, too."""
    return CAUSES[name].inject


def known(name: str, *columns: Any, **more: Any) -> Fault:
    """Return the row of such a fault under its own name."""
    return Fault(name, of(name), *columns, **more)


# -- buses ---------------------------------------------------------------------------------------------


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


# -- clocks and people -------------------------------------------------------------------------------------


def then_silent(cause: str) -> Inject:
    """Let the target be silent 100 ms after another fault."""

    def inject(run: Run) -> None:
        of(cause)(run)

        def each(now: Nanos) -> Sequence[Instruction]:
            if now > run.since + 100 * MILLISECOND:
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

FAULTS: tuple[Fault, ...] = (
    Fault("nothing", lambda _run: None, "motor", None, why="there is none: a report would be a false alarm"),
    # frames
    known("frames lost, 30 %", "motor", None, why=LEVELS, harmless=True),
    known("frames doubled", "motor", None, why=LEVELS, harmless=True),
    known("frames 15 ms late", "motor", None, why="within every timeout", harmless=True),
    known("frames reordered", "motor", None, why=LEVELS, harmless=True),
    known("feedback damaged", "motor", None, why=DAMAGE, harmless=True),
    known("commands damaged", "motor", None, why=DAMAGE, harmless=True),
    known("scans damaged", "lidar", None, why="checksums: a scan is lost", harmless=True),
    known("host not received", "motor", 1.0, "if it strays", ends=60.0, free="all"),
    known("devices not received", "motor", 0.3, "if commanded", ends=60.0),
    # motors; of a joint that is no wheel nothing else measures the motion: a false scale cannot be noticed
    known("device resets", "motor", 0.5, "if it was commanded"),
    known("device silent", "motor", 0.3, "if commanded", free="target"),
    known("device in fault", "motor", 0.3, "if commanded"),
    known("encoder stuck", "motor", 0.6, "in motion"),
    known("feedback frozen", "motor", 0.5, "in motion"),
    known("encoder jumps", "motor", 0.3, "if it was commanded"),
    known("encoder at half scale", "wheel", 1.0, "in motion", suspects=EITHER),
    known("encoder reversed", "motor", 0.5, "in motion"),
    known("encoders swapped", "wheel", 1.0, "in turning", suspects=EITHER),
    known("no torque", "motor", 0.6, "if it strays"),
    known("weak motor, 30 %", "motor", 0.6, "if it strays"),
    known("half torque", "motor", 0.6, "if it strays"),
    known("runaway", "motor", 0.5, "if commanded", free="target"),
    known("commands 300 ms late", "motor", 1.0, "if it strays", ends=60.0),
    # buses
    Fault("bus-off, back after 0.5 s", of("bus-off"), "motor", 0.1, ends=0.5),
    Fault("bus gone, back after 0.5 s", of("bus gone"), "motor", 0.1, ends=0.5),
    Fault("bus gone for good", of("bus gone"), "motor", 0.1, ends=60.0, free="all"),
    Fault("bus of the sensors gone", of("bus gone"), "lidar", 0.1, ends=60.0),
    known("bus saturated", "motor", 0.5, "if commanded", free="all"),
    # sensors
    known("lidar: all zeros", "lidar", 0.7),
    known("lidar: all maxima", "lidar", 0.7),
    known("lidar: 0.5 m too far", "lidar", 1.0),
    known("lidar: turned by 180°", "lidar", 1.0),
    known("lidar: turned by 5°", "lidar", 1.0, suspects=EITHER),
    known("lidar: 90 % without a reading", "lidar", 1.0),
    known("lidar frozen", "lidar", 0.7, "in motion"),
    known("lidar: front quarter frozen", "lidar", 0.8, "in motion"),
    known("lidar: front quarter blind", "lidar", 0.7),
    known("lidar: front quarter at maximum", "lidar", 0.7),
    known("lidar: a phantom at 0.25 m", "lidar", 0.5, "once it has moved"),
    known("lidar silent", "lidar", 0.6),
    known("IMU: bias of 0.3 rad/s", "imu", 1.2, suspects=EITHER),
    known("IMU constant", "imu", 0.5),
    known("IMU reversed", "imu", 1.0, "in turning", suspects=EITHER),
    known("IMU silent", "imu", 0.3),
    # clocks, people, other hosts
    known("slow steps", "motor", 2.0, suspects=("loop",)),
    known("a step takes 400 ms", "motor", 0.42, suspects=("loop",)),
    known("stamps 1 s early", "motor", 0.3, "if commanded"),
    known("stamps 1 h late", "motor", None, harmless=True,
          why="counted as received now, which is true within the delay of a frame"),
    Fault("stamps 1 h late, then silence", then_silent("stamps 1 h late"), "motor", 0.5, "if commanded",
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
