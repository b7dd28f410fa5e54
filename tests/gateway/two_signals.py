"""Two signals to a robot that drives, at random distances: no motor is left armed. Real processes.

Shared by the sample, the campaign, and the tests on a real CAN: `run` is a `gateway run` on the same bus as
`twin`, a `gateway twin` that reports the changes of its motors' modes. It is the devices that are judged."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass

from numpy.random import PCG64, Generator

from gateway.core.step import LEFT_ARMED
from tests.gateway.rig import BENCH
from tests.real_can.programs import Program

ROBOT = BENCH.replace(
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
    """s from the commands to the first signal,"""
    between: float
    """and from there to the second."""
    armed: bool
    """Whether a motor had reported armed when the first came."""
    at_once: bool
    """Whether the second ended the time to brake;"""
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
        (first, second), waited, between, armed, "leaving at once" in text, closed, LEFT_ARMED in text
    )


def settled(twin: Program, mark: int) -> None:
    """Check that no device's last mode, reported beyond `mark` characters, is armed, and that it stays so."""

    def disarmed() -> bool:
        modes = [re.findall(rf"{motor}: (armed|ready|fault|offline)", twin.text[mark:]) for motor in MOTORS]
        return all(of_one[-1:] in ([], ["ready"]) for of_one in modes)

    for _ in range(100):  # the machine may have other things to do
        if disarmed():
            break
        time.sleep(0.1)
    time.sleep(0.3)
    assert disarmed(), twin.text[mark:]


def summary(outcomes: list[Outcome]) -> str:
    """Return the outcomes as text."""
    armed, at_once, closed, unreported = (
        sum(getattr(one, name) for one in outcomes) for name in ("armed", "at_once", "closed", "unreported")
    )
    return (
        f"{len(outcomes)} runs of two signals: every motor disarmed at the end; {armed} with motors armed at "
        f"the first, {at_once} in which the second ended the time to brake, {closed} in which it came when "
        f"all was closed, {unreported} whose devices reported it late"
    )
