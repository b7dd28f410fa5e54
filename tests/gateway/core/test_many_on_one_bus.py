"""Eight devices on one bus: one that is silent slows no other, nor does a wire that destroys frames."""

from __future__ import annotations

from itertools import count

import pytest

from gateway.buses.virtual import TwinWorld, open_world
from gateway.buses.virtual.medium import Transmission
from gateway.config import parse_robot
from gateway.core.clock import SimulatedClock
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from gateway.runtime.loop import LoopStats, moments, read, write
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Hold, Nanos, Velocity
from tests.sampled import sampled

OPTIONS = {
    "odrive_can": 'watchdog = "acknowledged"',
    "cia402": 'feedback = "sdo"',
    "damiao": 'model = "4310"',
    "moteus": "timeout_ms = 100",
    "robstride": "",
    "vesc": "",
}
"""What each needs; polled wherever a device can be."""
NAMES = tuple(f"m{number}" for number in range(1, 9))


def eight(protocol: str) -> Robot:
    """Eight motors of a protocol on one bus; one in fault stops none of the others."""
    fd = protocol == "moteus"
    return parse_robot(
        f"""\
name = "eight"
world = "bench"
[buses.can0]
kind = "{"canfd" if fd else "can"}"
bitrate = 1_000_000
{"data_bitrate = 5_000_000" if fd else ""}
interface = "twin"
[defaults.motors]
protocol = "{protocol}"
bus = "can0"
gear = 1.0
sign = 1
on_command_timeout = "idle"
stop_action = "idle"
on_fault = "continue"
command_timeout_ms = 100
feedback_timeout_ms = 500
[defaults.motors.limits]
velocity = 5.0
acceleration = 20.0
torque = 2.0
[defaults.motors.options]
{OPTIONS[protocol]}
{"".join(f"[motors.{name}]{chr(10)}address = {address}{chr(10)}" for address, name in enumerate(NAMES, 1))}
[brain]
body = "joints"
[brain.joints]
motors = {list(NAMES)}
""".replace("'", '"')
    )


class Bench:
    """The eight, driven in virtual time; every motor holds, or turns slowly."""

    def __init__(self, protocol: str) -> None:
        self.robot = eight(protocol)
        self.gateway, self.clock = Gateway(self.robot), SimulatedClock()
        self.world: TwinWorld = open_world(self.robot, 1)

    def command(self, name: str) -> Command:
        """Return what keeps a motor armed."""
        return Hold(name) if Hold in self.robot.motors[name].spec.commands else Velocity(name, 0.5)

    def reports(self, seconds: float) -> tuple[dict[str, int], dict[str, Nanos]]:
        """Run for a time; return how often each motor reported, and the longest age of what it did."""
        counts, ages, last = (
            dict.fromkeys(NAMES, 0),
            dict.fromkeys(NAMES, 0),
            dict.fromkeys(NAMES, self.clock.now()),
        )
        until, commands = self.clock.now() + round(seconds * SECOND), tuple(map(self.command, NAMES))
        for now in moments(self.clock, self.robot.period, self.gateway.due, LoopStats()):
            if now >= until:
                break
            states, packets = read(self.world.buses, now)
            outputs = self.gateway.step(now, Inputs(tuple(states), tuple(packets), commands))
            write(self.world.buses, now, outputs.packets)
            for event in outputs.events:
                if isinstance(event, Feedback):
                    counts[event.motor] += 1
                    last[event.motor] = event.t
            for name in NAMES:
                ages[name] = max(ages[name], now - last[name])
        return counts, ages


@pytest.mark.parametrize("protocol", sampled(OPTIONS, 3))
def test_a_silent_device_slows_no_other(protocol: str) -> None:
    bench = Bench(protocol)
    bench.reports(5.0 if protocol == "cia402" else 2.0)  # until every object has been read
    assert all(joint.armed for joint in bench.gateway.joints.values())
    before, age_before = bench.reports(1.0)
    bench.world.disconnect("m3")
    bench.reports(1.0)
    after, age_after = bench.reports(1.0)
    assert after.pop("m3") == 0
    for name, number in after.items():
        assert number >= 0.98 * before[name] > 50, name
        assert age_after[name] <= age_before[name] + 2 * MILLISECOND, name
        assert bench.gateway.joints[name].armed


@pytest.mark.parametrize("protocol", sampled(OPTIONS, 3))
def test_frames_that_are_destroyed_are_sent_again_and_stall_nobody(protocol: str) -> None:
    """Every fiftieth frame is cut off by an error frame after forty bits."""
    bench, sent = Bench(protocol), count()

    def error(_bus: str, _one: Transmission) -> int:
        return 40 if next(sent) % 50 == 0 else 0

    bench.reports(5.0 if protocol == "cia402" else 2.0)  # until every object has been read
    before, age_before = bench.reports(1.0)
    bench.world.tamper.error = error
    after, age_after = bench.reports(1.0)
    for name, number in after.items():
        assert number >= 0.97 * before[name], name
        assert age_after[name] <= age_before[name] + 3 * MILLISECOND, name
        assert bench.gateway.joints[name].armed
