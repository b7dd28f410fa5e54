"""Which of the motors that were found is which, shown by a person; and what limits their devices have.

Rules. The motors are bare joints of a robot that is made for this. By hand: nothing is commanded; the shaft
that a person turns is seen by its position, and forwards is positive. By jog: one motor turns at a time,
slowly and for a moment, then the person says which it was, and which way. Both end by themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from math import inf
from typing import TypeAlias

from gateway.config import parse_robot
from gateway.config.new_robot import Part, Plan
from gateway.config.toml_text import bus_section, section
from gateway.core.robot import TWIN, Robot
from gateway.runtime.configuration import Motors
from gateway.runtime.session import open_session
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Nanos

Shown: TypeAlias = Callable[[str, Sequence[Part]], tuple[Part, int] | None]
"""From a motor's name and the devices that are left: which it is, and its sign; None: it was not shown."""
TURNED = 0.4
"""rad at the device's shaft by which it must be turned by hand"""
CLEAR = 3.0
"""By what factor further than any other"""
PATIENCE: Nanos = 60 * SECOND
"""Time for a person to turn it"""
READ: Nanos = 2 * SECOND
"""Time in which all must report where they stand"""
SPEED, JOGGED = 1.0, 700 * MILLISECOND
"""rad/s at the device's shaft, and for how long"""
GENTLE = {"velocity": 2.0, "acceleration": 10.0, "torque": 5.0}
"""Limits of the bare joints: rad/s, rad/s², N·m"""


def bench_of(plan: Plan, parts: Mapping[str, Part]) -> Robot:
    """Return a robot of these devices alone, by the names of its bare joints."""
    buses = plan.buses(list(parts.values()))
    sections = [section("", {"name": "bench"}, {})]
    sections += [bus_section(table) for table in buses.values()]
    for name, part in parts.items():
        motor = {"gear": 1.0, "limits": GENTLE, **plan.connection(name, part, buses)}
        sections.append(section(f"motors.{name}", motor, {}))
    plan.answers.check_missing()
    sections += [section("brain", {"body": "joints"}, {}), section("brain.joints", {"motors": [*parts]}, {})]
    return parse_robot("\n".join(sections), "bench")


@contextmanager
def motors_of(plan: Plan, parts: Mapping[str, Part]) -> Iterator[Motors]:
    """Open the buses of devices, as those of bare joints; in simulated time if they are all simulated."""
    robot = bench_of(plan, parts)
    simulated = all(bus.interface == TWIN for bus in robot.buses.values())
    with open_session(robot, simulated=simulated) as session, closing(Motors(session)) as motors:
        yield motors


def places(motors: Motors) -> dict[str, float]:
    """Return where the motors that report it stand [rad]."""
    joints = motors.session.joints
    return {n: place for n in motors.motors if (place := joints[n].feedback.position) is not None}


def turned(motors: Motors, patience: Nanos) -> tuple[str, int] | None:
    """Wait until one shaft was turned, far and alone. Returns which, and its sign; None: none was."""
    motors.wait(READ)
    start, until = places(motors), motors.session.clock.now() + patience
    while motors.session.clock.now() < until:
        motors.wait(200 * MILLISECOND)
        moved = {name: place - start.get(name, place) for name, place in places(motors).items()}
        far = sorted(moved, key=lambda name: abs(moved[name]), reverse=True)
        second = abs(moved[far[1]]) if len(far) > 1 else 0.0
        if far and abs(moved[far[0]]) > max(TURNED, CLEAR * second):
            return far[0], 1 if moved[far[0]] > 0.0 else -1
    return None


Opened: TypeAlias = Callable[[Plan, dict[str, Part]], AbstractContextManager[Motors]]


def by_hand(plan: Plan, say: Callable[[str], None], opened: Opened = motors_of) -> Shown:
    """Return how a person shows a motor by turning it by hand."""

    def shown(name: str, left: Sequence[Part]) -> tuple[Part, int] | None:
        parts = {f"motor_{at}": one for at, one in enumerate(left)}
        with opened(plan, parts) as motors:
            say(f"turn {name} FORWARDS by hand, a quarter of a turn or more; all others stand still")
            found = turned(motors, PATIENCE)
        if found is None:
            say(f"no shaft was turned alone within {PATIENCE // SECOND} s")
            return None
        part, sign = parts[found[0]], found[1]
        say(f"{name} is the {part}, sign {sign}")
        return part, sign

    return shown


def by_jog(
    plan: Plan, say: Callable[[str], None], ask: Callable[[str], str], opened: Opened = motors_of
) -> Shown:
    """Return how a person shows the motors by saying which one turned: each turns once."""
    known: dict[str, tuple[Part, int]] = {}

    def shown(name: str, left: Sequence[Part]) -> tuple[Part, int] | None:
        if known:
            return known.get(name)
        parts = {f"motor_{at}": one for at, one in enumerate(left)}
        with opened(plan, parts) as motors:
            motors.wait(READ)
            for each, part in parts.items():
                ask(f"the {part} is about to turn slowly, for {JOGGED / SECOND:g} s: lift the wheels; Enter ")
                jog(motors, each)
                which = ask(f"which one turned? ({', '.join(plan.named())}; - for none) ")
                if which in plan.named():
                    forwards = ask("forwards? [Y/n] ").lower() not in ("n", "no")
                    known[which] = part, 1 if forwards else -1
                    say(f"{which} is the {part}, sign {known[which][1]}")
        return known.get(name)

    return shown


def jog(motors: Motors, name: str) -> None:
    """Turn one motor slowly for a moment, and let go of it."""
    session, until = motors.session, motors.session.clock.now() + JOGGED
    while session.clock.now() < until:
        session.submit(msg.Velocity(name, SPEED))
        motors.wait(session.robot.period)
    session.submit(msg.Idle(name))
    motors.wait(JOGGED)


def allowed(plan: Plan) -> dict[str, dict[str, float]]:
    """Return what the devices allow at their own shafts, as they tell: rad/s and N·m, by motor."""
    found: dict[str, dict[str, float]] = {name: {} for name in plan.motors}
    with motors_of(plan, plan.motors) as motors:
        motors.identify()
        for name, motor in motors.motors.items():
            for parameter, setting in motor.spec.configuration.items():
                if not setting.limit:
                    continue
                (read,) = motors.ask([msg.ReadParameter(name, parameter)]).values() or (None,)
                if isinstance(read, msg.Parameter):
                    most = abs(read.value) * setting.unit
                    found[name][setting.limit] = min(most, found[name].get(setting.limit, inf))
    return found
