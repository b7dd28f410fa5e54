"""Two signals to a robot that drives, at random distances: no motor is left armed, and none turns for longer
than after one signal.

Shared by the sample, the campaign, and the tests on a real CAN. In real processes, `run` is a `gateway run`
on the same bus as `twin`, a `gateway twin` that reports the changes of its motors' modes: it is the devices
that are judged. How fast the shafts turn is judged in simulated time (`speeds_after`)."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

from numpy.random import PCG64, Generator

import gateway as gw
from gateway.buses.virtual.bus import TwinBus
from gateway.core.step import LEFT_ARMED
from gateway.core.tick import Tick
from protocols.messages import MILLISECOND, SECOND, Mode, Nanos, Velocity
from tests.gateway.processes import eventually
from tests.gateway.rig import BENCH
from tests.real_can.programs import Program

ROBOT = "stall_timeout_ms = 2000\n" + BENCH.replace(
    "limits = { velocity = 20.0, acceleration = 60.0, torque = 2.0 }",
    "limits = { velocity = 20.0, acceleration = 20.0, torque = 2.0 }\n"
    'stop_action = "brake"\nfeedback_timeout_ms = 2000\ncommand_timeout_ms = 2000',
)
"""Brakes for 0.4 s from the speed below; a machine that does other things for a while makes no fault."""
SPEED = 8.0
"""rad/s, of both motors"""
MOTORS = ("left", "right")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one run."""

    signals: tuple[int, int]
    waited: float
    """s from the commands, or every second time from when a motor was armed, to the first signal,"""
    between: float
    """and from there to the second."""
    armed: bool
    """Whether a motor had reported armed when the first came."""
    hurried: bool
    """Whether the second came while the motors braked;"""
    closed: bool
    """whether it came when everything was closed."""
    unreported: bool
    """Whether the devices took longer to report that they are disarmed than leaving waits."""


def one_run(start: Callable[[], Program], twin: Program, seed: int, number: int) -> Outcome:
    """Start a run, command both motors, and send two signals; check that every motor reports disarmed."""
    generator = Generator(PCG64([seed, number]))
    waited, between = (float(generator.uniform(0.0, most)) for most in (0.5, 0.6))
    first, second = (SIGNALS[int(generator.integers(len(SIGNALS)))] for _ in range(2))
    mark = len(twin.text)
    with start() as run:
        run.until("left: ready", "right: ready")
        for motor in MOTORS:
            run.ask("rig", f"velocity {motor} {SPEED}")
        if number % 2 == 0:
            twin.until("armed", after=mark)
        time.sleep(waited)
        armed = "armed" in twin.text[mark:]
        assert run.pid is not None
        os.kill(run.pid, first)
        time.sleep(between)
        if run.alive:
            os.kill(run.pid, second)
        status = run.end(None)
        text = run.text
    assert re.search(rf"leaving: ({first.name}|{second.name})", text), text  # both may be handled at once
    closed = status == -second or "KeyboardInterrupt" in text
    known = "left in fault" in text or LEFT_ARMED in text  # of devices whose process has no processor
    assert status == 0 or closed or known, f"{text}\nexit status {status}"
    settled(twin, mark)
    return Outcome(
        (first, second), waited, between, armed, "leaving sooner" in text, closed, LEFT_ARMED in text
    )


def settled(twin: Program, mark: int) -> None:
    """Check that no device's last mode, reported beyond `mark` characters, is armed, and that it stays so."""

    def disarmed() -> bool:
        modes = [re.findall(rf"{motor}: (armed|ready|fault|offline)", twin.text[mark:]) for motor in MOTORS]
        return all(of_one[-1:] in ([], ["ready"]) for of_one in modes)

    eventually(disarmed)
    time.sleep(0.3)
    assert disarmed(), twin.text[mark:]


def summary(outcomes: list[Outcome]) -> str:
    """Return the outcomes as text."""
    armed, hurried, closed, unreported = (
        sum(getattr(one, name) for one in outcomes) for name in ("armed", "hurried", "closed", "unreported")
    )
    return (
        f"{len(outcomes)} runs of two signals: every motor disarmed at the end; {armed} with motors armed at "
        f"the first, {hurried} in which the second came while they braked, {closed} in which it came when "
        f"all was closed, {unreported} whose devices reported it late"
    )


# -- in simulated time -------------------------------------------------------------------------------------

PAIRS = list(product((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), repeat=2))
WATCHED: Nanos = 3 * SECOND
"""How long the shafts are watched after the first signal."""
JITTER = 0.2
"""rad/s by which two runs may differ at a moment: a period later, the shaft is so much slower."""


def speeds_after(path: str, waited: Nanos, signals: Sequence[tuple[Nanos, signal.Signals]]) -> list[float]:
    """Send signals to a run on twins, each so long after the first moment, which comes `waited` after both
    motors were commanded; return the larger of the true speeds [rad/s] every 10 ms from the first on."""
    with gw.open_session(path, simulated=True) as session:
        assert session.twins is not None
        assert session.twins.world is not None
        world, buses, speeds = session.twins.world, session.twins.buses, list[float]()
        commanded: list[Nanos] = []
        left = list(signals)

        def take(tick: Tick, _: object) -> None:
            if not commanded and all(joint.mode is Mode.READY for joint in session.joints.values()):
                commanded.append(tick.now)
                session.submit(*(Velocity(motor, SPEED) for motor in MOTORS))
            while commanded and left and tick.now >= commanded[0] + waited + left[0][0]:
                os.kill(os.getpid(), left.pop(0)[1])
            if session.reasons:
                speeds.append(max(abs(world.shaft(motor)[1]) for motor in MOTORS))

        session.watch(take)
        list(session.run(10.0))
        assert session.reasons
        assert session.gateway.still_armed() == []
        while len(speeds) * session.robot.period < WATCHED:
            session.clock.wait(session.clock.now() + session.robot.period)
            for bus in buses.values():
                TwinBus.read(bus, session.clock.now())
            speeds.append(max(abs(world.shaft(motor)[1]) for motor in MOTORS))
    return speeds[:: 10 * MILLISECOND // session.robot.period]


def compare(path: str, seed: int, number: int) -> tuple[float, float, float]:
    """Send one signal, and two of a pair of kinds at a random distance; check that the second makes nothing
    worse. Return when the first came, and the second after it [s], and the speed at the first [rad/s]."""
    generator = Generator(PCG64([seed, number]))
    waited, between = (round(generator.uniform(0.0, most) * SECOND) for most in (1.0, 1.0))
    first, second = PAIRS[number % len(PAIRS)]
    before = {
        each: signal.signal(each, signal.SIG_DFL) for each in (first, second)
    }  # not ignored, as by nohup
    try:
        one = speeds_after(path, waited, [(0, first)])
        two = speeds_after(path, waited, [(0, first), (between, second)])
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
    worst = max(b - a for a, b in zip(one, two, strict=True))
    assert worst <= JITTER, f"{first.name}, {between / SECOND} s later {second.name}: {worst} rad/s faster"
    return waited / SECOND, between / SECOND, one[0]
