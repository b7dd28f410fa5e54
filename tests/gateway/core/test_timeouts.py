"""The timeouts of the robot file reach the brain: the base slows down and stands at fractions of them.

The shipped robot drives across its office, in simulated time; a device is unplugged. Checked is how old its
newest measurement was when the brain changed its state, and what the wheels truly did.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TypeGuard

import pytest

from brain.belief import BrainState
from gateway.config import resources
from gateway.core.tick import Tick
from protocols.messages import MILLISECOND, Event, Feedback, Goal, LaserScan, Nanos
from tests.gateway.rig import Rig, notes_in

DIFFBOT = resources.find("robots", "diffbot").read_text()
LATE = 6 * MILLISECOND
"""Latest reaction after the timeout: the period is 5 ms, and drivers have steps of their own."""


def with_timeout(name: str, ms: int) -> str:
    """Return the robot file with another timeout of this motor or sensor."""
    above, header, below = DIFFBOT.partition(f".{name}]\n")
    assert header
    return above + header + re.sub(r"(?m)^((?:feedback_)?timeout_ms) = \d+", rf"\1 = {ms}", below, count=1)


@dataclass
class Seen:
    """What happened after a device was unplugged; ages are those of its last measurement."""

    slow: Nanos
    standing: Nanos
    reasons: list[str]
    wheel: list[tuple[Nanos, float]]
    """Age, and the speed of the right wheel [rad/s], at each step."""
    rig: Rig
    ticks: list[Tick]


def pulled(text: str, name: str, seconds: float) -> Seen:
    """Drive the base, and then unplug `name`."""
    rig = Rig(text)
    rig.run(0.5)
    rig.run(2.0, Goal(1.5, 0.0))
    assert rig.gateway.belief().state is BrainState.RUNNING
    assert rig.velocity("right") > 8.0
    rig.world.disconnect(name)
    beliefs: list[tuple[Nanos, BrainState, str]] = []
    speeds: list[tuple[Nanos, float]] = []

    def look(tick: Tick) -> None:
        belief = rig.gateway.belief()
        beliefs.append((tick.now, belief.state, belief.reason))
        speeds.append((tick.now, rig.velocity("right")))

    ticks = rig.run(seconds, at=look)
    events = [event for tick in rig.ticks for event in tick.outputs.events if _is_of(event, name)]
    last = max(event.t + (event.duration if isinstance(event, LaserScan) else 0) for event in events)

    def first(reason: str) -> Nanos:
        ends = [
            now - last for now, state, why in beliefs if state is BrainState.DEGRADED and why.endswith(reason)
        ]
        return min(ends, default=-1)

    reasons = list(dict.fromkeys(reason for _, _, reason in beliefs))
    return Seen(first(": slow"), first(": standing"), reasons, [(t - last, v) for t, v in speeds], rig, ticks)


def _is_of(event: Event, name: str) -> TypeGuard[Feedback | LaserScan]:
    """True for a measurement of this motor or sensor."""
    match event:
        case Feedback(motor, _, position):
            return motor == name and position is not None
        case LaserScan(sensor):
            return sensor == name
    return False


@pytest.mark.sample(1)
@pytest.mark.parametrize("timeout_ms", [300, 500, 1400])
def test_the_lidars_timeout_sets_when_the_base_goes_slow_and_when_it_stands(timeout_ms: int) -> None:
    timeout = timeout_ms * MILLISECOND
    seen = pulled(with_timeout("lidar", timeout_ms), "lidar", 1.5 + timeout_ms / 1000)
    assert 0 < seen.slow - 0.5 * timeout <= LATE
    assert 0 < seen.standing - 0.9 * timeout <= LATE
    assert seen.reasons == [
        "",
        f"lidar: no scan for more than {timeout_ms * 0.5:g} ms: slow",
        f"lidar: no scan for more than {timeout_ms * 0.9:g} ms: standing",
    ]
    before = [speed for age, speed in seen.wheel if age < 0.5 * timeout]
    assert min(before) > 8.0
    assert abs(seen.wheel[-1][1]) < 0.05


@pytest.mark.sample(1)
@pytest.mark.parametrize("timeout_ms", [60, 100, 200])
def test_the_feedback_timeout_does_so_for_a_wheel_before_its_joint_is_in_fault(timeout_ms: int) -> None:
    timeout = timeout_ms * MILLISECOND
    seen = pulled(with_timeout("right", timeout_ms), "right", 1.0)
    assert 0 < seen.slow - 0.5 * timeout <= LATE
    assert 0 < seen.standing - 0.9 * timeout <= LATE
    assert seen.reasons[1:3] == [
        f"right: no feedback for more than {timeout_ms * 0.5:g} ms: slow",
        f"right: no feedback for more than {timeout_ms * 0.9:g} ms: standing",
    ]
    feedback_lost = f"silent: no feedback for more than {timeout_ms} ms"
    assert any(feedback_lost in note.text and note.level == "error" for note in notes_in(seen.ticks, "right"))
    assert feedback_lost in seen.rig.gateway.why_stopped()


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("timeout_ms", "states"),
    [(500, {BrainState.RUNNING, BrainState.DEGRADED}), (1400, {BrainState.RUNNING})],
)
def test_an_outage_within_a_longer_timeout_slows_nothing(timeout_ms: int, states: set[BrainState]) -> None:
    """Half a second without a scan."""
    rig = Rig(with_timeout("lidar", timeout_ms))
    rig.run(0.5)
    rig.run(1.5, Goal(1.5, 0.0))
    seen: set[BrainState] = set()
    rig.world.disconnect("lidar")
    rig.run(0.5, at=lambda _: seen.add(rig.gateway.belief().state))
    rig.world.reconnect("lidar")
    rig.run(0.3, at=lambda _: seen.add(rig.gateway.belief().state))
    assert seen == states
