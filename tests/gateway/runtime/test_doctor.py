"""What the doctor says: each cause is provoked on twins, and its finding has what to do."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest

from gateway import config
from gateway.buses import Bus
from gateway.buses.virtual.bus import TwinWorld, open_world
from gateway.core.clock import SimulatedClock
from gateway.core.robot import Robot
from gateway.runtime.doctor import Finding, examine
from protocols import messages as msg
from protocols.frames import BusState, Frame
from protocols.messages import SECOND, Nanos
from tests.gateway.rig import BENCH

Cause = Callable[[TwinWorld], None]


class Overheard:
    """A bus that keeps what is sent."""

    def __init__(self, bus: Bus) -> None:
        self.name, self.sent = bus.name, list[Frame]()
        self.read, self.close = bus.read, bus.close
        self._bus = bus

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        self.sent += frames
        self._bus.write(now, frames)


def examined(truth: Robot, *causes: Cause, believed: Robot | None = None) -> list[Finding]:
    """Examine a robot whose twins are as `truth` says, after these causes."""
    world, clock = open_world(truth, 1), SimulatedClock()
    clock.wait(SECOND)
    for bus in world.buses.values():
        bus.read(clock.now())  # its devices run, each in its own phase
    for cause in causes:
        cause(world)
    return examine(believed or truth, world.buses, clock).findings()


def bench(old: str = "", new: str = "") -> Robot:
    assert old in BENCH
    return config.parse_robot(BENCH.replace(old, new))


def trip(world: TwinWorld) -> None:
    spec = bench().motors["left"].spec
    world.twin("left").provoke(next(iter(spec.faults)))


def lose(state: BusState) -> Cause:
    return lambda world: world.buses["can0"].lose(state)


CAUSES: dict[str, tuple[Cause, str, str, str]] = {
    "unplugged": (
        lambda world: world.disconnect("left"),
        "left",
        "nothing is heard of it at address 1 on can0",
        "gateway scan",
    ),
    "in fault": (trip, "left", "fault ", "clear left"),
    "bus-off": (lose(BusState.OFF), "can0", "bus-off", "60 ohms"),
    "gone": (lose(BusState.GONE), "can0", "vanished", "supply"),
}


@pytest.mark.parametrize("name", CAUSES)
def test_a_cause_is_found_and_said_with_what_to_do(name: str) -> None:
    cause, about, seen, todo = CAUSES[name]
    findings = examined(bench(), cause)
    told = [one for one in findings if one.about == about and seen in one.seen]
    assert [one.grave for one in told] == [True], findings
    assert todo in told[0].todo
    assert told[0].matters
    assert len(findings) == 1, "one cause, one finding"


def test_two_causes_at_once_are_both_found_and_a_healthy_robot_has_none() -> None:
    assert examined(bench()) == []
    both = examined(bench(), lambda world: world.disconnect("right"), trip)
    assert {one.about for one in both} == {"left", "right"}


def test_a_wrong_address_and_what_is_not_in_the_file_are_named() -> None:
    truth, wrong = bench(), bench("address = 2", "address = 5")
    findings = {one.about: one for one in examined(truth, believed=wrong)}
    assert "at address 2" in findings["right"].seen  # that looks like
    assert findings["odrive_can"].seen == "a device at address 2 is not in the robot file"


def test_nothing_is_sent_but_what_only_reads_and_no_sensor_is_started() -> None:
    """Defect: a lidar that its robot file has started began to turn while the doctor looked."""
    robot = config.load_robot("diffbot_rplidar")
    world, clock = open_world(robot, 1), SimulatedClock()
    buses = {name: Overheard(bus) for name, bus in world.buses.items()}
    assert examine(robot, buses, clock).findings() == []
    sent = [(name, frame) for name, bus in buses.items() for frame in bus.sent]
    assert sent
    for name, frame in sent:
        assert all(one.spec.read_only(frame) for one in robot.devices_on(name)), (name, frame)


def test_two_devices_of_one_address_are_one_finding() -> None:
    """As a driver reports them; twins of one address have one serial number."""
    world, clock = open_world(bench(), 1), SimulatedClock()
    seen = examine(bench(), world.buses, clock)
    seen.found += [msg.Found(0, "odrive_can", 1, serial, duplicate_address=True) for serial in (7, 8, 7)]
    (finding,) = seen.findings()
    assert (finding.about, finding.seen) == ("left", "two devices have address 1")
    assert "setid can0 7 NEW" in finding.todo


def test_a_scale_that_is_assumed_and_a_place_outside_its_limits_are_told() -> None:
    vesc = BENCH.replace("odrive_can", "vesc").replace('options = { watchdog = "acknowledged" }', "")
    seen = [one.seen for one in examined(config.parse_robot(vesc))]
    assert any("pole_pairs" in text and "assumed" in text for text in seen), seen
    narrow = config.parse_robot(BENCH.replace("torque = 2.0 }", "torque = 2.0, position = [0.5, 1.0] }"))
    (left, right) = examined(narrow)
    assert left.seen == "it reads 0 rad, limits [0.5, 1.0]"
    assert "zero left (or home left, or confirm left)" in left.todo
    assert right.about == "right"
