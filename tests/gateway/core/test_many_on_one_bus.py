"""Eight devices on one bus: one that is silent slows no other, nor does a wire that destroys frames, and all
obey behind a transmit queue that is shorter than what a step sends."""

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
from gateway.runtime.loop import moments, read, write
from gateway.runtime.timing import LoopStats
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Hold, Nanos, Velocity
from tests.sampled import sampled

OPTIONS = {
    "odrive_can": 'watchdog = "acknowledged"',
    "cia402": 'feedback = "sdo"',
    "damiao": 'model = "4310"',
    "moteus": "timeout_ms = 100",
    "robstride": "",
    "vesc": "",
    "myactuator": "",
    "cubemars": "",
    "robomaster": "[defaults.motors.loop]\nvelocity_gain = 0.3\nintegral_gain = 3.0\nintegral_most = 1.0",
}
"""What each needs; polled wherever a device can be."""
GEARS = {"odrive_can": 8.0, "robomaster": 19.2}
RATES = {"robomaster": 100}
"""Hz: beside eight that report a thousand times a second there is no room for more commands."""
NAMES = tuple(f"m{number}" for number in range(1, 9))


def eight(protocol: str, transmit_queue: int) -> Robot:
    """Eight motors of a protocol on one bus; one in fault stops none of the others."""
    fd = protocol == "moteus"
    return parse_robot(
        f"""\
name = "eight"
rate_hz = {RATES.get(protocol, 200)}
world = "bench"
[buses.can0]
kind = "{"canfd" if fd else "can"}"
bitrate = 1_000_000
{"data_bitrate = 5_000_000" if fd else ""}
interface = "twin"
transmit_queue = {transmit_queue}
[defaults.motors]
protocol = "{protocol}"
bus = "can0"
gear = {GEARS.get(protocol, 1.0)}
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

    def __init__(self, protocol: str, transmit_queue: int = 100) -> None:
        self.robot = eight(protocol, transmit_queue)
        self.gateway, self.clock = Gateway(self.robot), SimulatedClock()
        self.world: TwinWorld = open_world(self.robot, 1)
        self.velocity: float | None = None
        """rad/s of all motors; None: they hold, or turn slowly"""

    def speeds(self) -> list[float]:
        """rad/s of the true shafts"""
        return [self.world.world.shaft(name)[1] for name in NAMES]

    def command(self, name: str) -> Command:
        """Return what keeps a motor armed."""
        if self.velocity is not None:
            return Velocity(name, self.velocity)
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


@pytest.mark.sample(1)
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


@pytest.mark.sample(1)
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


@pytest.mark.sample(1)
@pytest.mark.parametrize("protocol", sampled(OPTIONS, 3))
def test_behind_a_short_transmit_queue_all_stay_armed_and_obey_the_newest_command(protocol: str) -> None:
    """A step sends up to sixteen frames, or more; ten fit, as in the kernel's queue unless it is set."""
    bench = Bench(protocol, transmit_queue=10)
    for velocity in (2.0, 0.0):
        bench.velocity = velocity
        bench.reports(5.0 if protocol == "cia402" else 3.0)
        for name, joint in bench.gateway.joints.items():
            assert joint.armed, name
            assert not joint.faults
        assert bench.speeds() == pytest.approx([velocity] * len(NAMES), abs=0.2 if velocity else 0.05)
