"""A second gateway takes over a motor that a first one left holding a load: it neither drops nor jerks it.

Rules. Two whole gateways, one after the other, on one world; the load is a constant torque at the shaft. A
spring without integral gives way to its load once more, but slowly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import pytest

from protocols import messages as msg
from protocols.messages import Command, Mode
from tests.gateway.rig import Rig

CAN, SERIAL = 'kind = "can"\nbitrate = 1_000_000', 'kind = "serial"\nbaudrate = 1_000_000'
CANFD = 'kind = "canfd"\nbitrate = 1_000_000\ndata_bitrate = 5_000_000'
HOLDING = {
    "odrive_can": (CAN, 8.0, 'options = { watchdog = "acknowledged" }'),
    "cia402": (CAN, 8.0, "options = { sync_ms = 10, watchdog_ms = 1000 }"),
    "moteus": (CANFD, 8.0, "options = { timeout_ms = 1000 }"),
    "damiao": (CAN, 1.0, "options = { timeout_ms = 1000 }"),
    "robstride": (CAN, 1.0, "options = { timeout_ms = 1000 }"),
    "myactuator": (CAN, 1.0, "options = { timeout_ms = 1000 }"),
    "myactuator motion": (CAN, 1.0, 'options = { mode = "motion", timeout_ms = 1000 }'),
    "cubemars": (CAN, 1.0, 'options = { watchdog = "acknowledged" }'),
    "plain": (SERIAL, 8.0, 'options = { kind = "motor" }\nsettings = { watchdog_ms = 1000 }'),
}
"""Bus, gear and device of each protocol that can hold; its watchdog lets the next gateway start in time."""
ROBOT = """
name = "holding"
rate_hz = 200
world = "bench"
[buses.bus]
{bus}
interface = "twin"
[motors.joint]
protocol = "{protocol}"
bus = "bus"
address = 1
gear = {gear}
feedback_timeout_ms = 200
{device}
limits = {{ velocity = 5.0, acceleration = 20.0, torque = 2.0, position = [-3.0, 3.0] }}
[brain]
body = "joints"
[brain.joints]
motors = ["joint"]
"""
PLACE, LOAD, SPEED = 0.1, 0.3, 0.5
"""rad, N·m, rad/s"""
SLACK = 0.02
"""rad by which the softest of these springs gives way to the load (20 N·m/rad)."""
LIMP = 3
"""Steps of the world without torque, while a device changes its mode, or follows coarse set-points."""


@dataclass
class Held:
    """A joint with a load, and what was seen of it in each step of the world."""

    rig: Rig
    load: float = 0.0

    def __post_init__(self) -> None:
        self.seen: list[tuple[float, float, float]] = []
        """Torque of the motor, position, velocity."""
        self.rig.world.tamper.torques = self._loaded

    def _loaded(self, torques: dict[str, float]) -> dict[str, float]:
        self.seen.append((torques["joint"], *self.rig.world.world.shaft("joint")))
        return {"joint": torques["joint"] - self.load}

    def commanded(self, rig: Rig, seconds: float, command: Command) -> None:
        """Run with one command, given at every step."""
        rig.poll = lambda: [command]  # type: ignore[method-assign]
        rig.run(seconds)


def taken_over(
    name: str, command: Callable[[float], Command]
) -> tuple[float, list[tuple[float, float, float]]]:
    """Return how far the shaft gave way to its load, and what was seen while a second gateway gave a command
    of that place."""
    bus, gear, device = HOLDING[name]
    text = ROBOT.format(bus=bus, protocol=name.split()[0], gear=gear, device=device)
    first = Rig(text)
    held = Held(first)
    first.run(0.4)
    held.commanded(first, 0.5, msg.Position("joint", PLACE))
    held.load = LOAD
    held.commanded(first, 0.6, msg.Position("joint", PLACE))
    joint = first.gateway.joints["joint"]
    assert (joint.mode, joint.faults) == (Mode.ARMED, {})
    second = Rig(text, first)
    before = held.seen[-1][1]
    second.run(0.1)
    assert abs(held.seen[-1][1] - before) < 0.1 * SLACK, "it only listens"
    held.seen.clear()
    held.commanded(second, 0.4, command(before))
    joint = second.gateway.joints["joint"]
    assert (joint.mode, joint.faults) == (Mode.ARMED, {})
    return PLACE - before, held.seen


def limp(torques: Sequence[float]) -> int:
    """Return for how many steps together the load was not carried."""
    carried = "".join(" " if torque < 0.2 * LOAD else "|" for torque in torques)
    return max(map(len, carried.split("|")))


@pytest.mark.sample(6)
@pytest.mark.parametrize("name", HOLDING)
@pytest.mark.parametrize("kind", ["Hold", "Position"])
def test_a_load_stays_where_it_is(name: str, kind: str) -> None:
    gave_way, seen = taken_over(
        name, lambda place: msg.Hold("joint") if kind == "Hold" else msg.Position("joint", place)
    )
    torques, places, speeds = zip(*seen, strict=True)
    assert abs(gave_way) < SLACK
    assert max(abs(each - places[0]) for each in places) < SLACK
    assert max(map(abs, speeds)) < 0.2, "no jerk"
    assert limp(torques) <= LIMP, "it is carried throughout"


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", HOLDING)
def test_a_first_velocity_begins_at_rest_and_drops_nothing(name: str) -> None:
    _, seen = taken_over(name, lambda _: msg.Velocity("joint", SPEED))
    torques, places, speeds = zip(*seen, strict=True)
    assert min(places) > places[0] - SLACK
    assert max(abs(b - a) for a, b in zip(speeds, speeds[5:], strict=False)) < 0.5 * SPEED, "within 5 steps"
    assert limp(torques) <= LIMP
