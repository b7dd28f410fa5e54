"""The loop of a motor that takes only torque: alone, and on a device's twin that is sent nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import gateway as gw
from brain.bodies.joint_profile import JointLimits, JointState, fastest
from gateway.config.resources import find
from gateway.core.torque_loop import Loop, LoopSettings
from protocols import messages as msg

GAINS = LoopSettings(velocity_gain=0.3, integral_gain=3.0, integral_most=1.0)
INERTIA, DAMPING, FRICTION, DT = 0.006, 0.002, 0.02, 0.005


class Shaft:
    """An inertia with damping, dry friction and a load."""

    def __init__(self, load: float = 0.0) -> None:
        self.position = self.velocity = 0.0
        self.load = load

    def step(self, torque: float) -> None:
        for _ in range(5):
            dt = DT / 5
            free = self.velocity + (torque + self.load - DAMPING * self.velocity) * dt / INERTIA
            brake = min(abs(free), FRICTION * dt / INERTIA)
            self.velocity = free - np.copysign(brake, free)
            self.position += self.velocity * dt


def followed(settings: LoopSettings, load: float = 0.0, most: float = 2.0) -> tuple[float, float, Loop]:
    """The largest error on the way, the last one, and the loop."""
    loop, shaft, worst = Loop(), Shaft(load), 0.0
    motion = fastest(JointState(0.0), 3.0, JointLimits(4.0, 20.0, 200.0))
    for i in range(800):
        want = motion.at(i * DT)
        ahead = want.position - shaft.position
        torque = loop.step(ahead, want.velocity, shaft.velocity, 0.0, DT, most, settings)
        assert abs(torque) <= most
        worst = max(worst, abs(ahead))
        shaft.step(torque)
    return worst, abs(3.0 - shaft.position), loop


def test_what_is_known_in_advance_leaves_little_to_correct() -> None:
    known = LoopSettings(velocity_gain=0.3, inertia=INERTIA, damping=DAMPING, friction=FRICTION)
    assert followed(known)[0] < 0.25 * followed(LoopSettings(velocity_gain=0.3))[0]


@pytest.mark.parametrize("load", [-0.8, 0.0, 0.5])
def test_the_integral_carries_a_load(load: float) -> None:
    _, left, loop = followed(GAINS, load)
    assert left < 0.005
    assert loop.integral == pytest.approx(-load, abs=0.05)
    assert followed(LoopSettings(velocity_gain=0.3), load)[1] == pytest.approx(abs(load) / 2.4, abs=0.01)


def test_the_integral_does_not_wind_up_while_the_torque_is_at_its_limit() -> None:
    loop = Loop()
    for _ in range(1000):  # a shaft that is held fast
        assert loop.step(1.0, 0.0, 0.0, 0.0, DT, 1.5, GAINS) == 1.5
    assert loop.integral <= GAINS.integral_gain * 8.0 * DT
    torques = [loop.step(-0.05, 0.0, 0.0, 0.0, DT, 1.5, GAINS) for _ in range(20)]
    assert torques[0] < 0.1
    assert torques[-1] < 0.0


def test_the_integral_has_a_bound_of_its_own() -> None:
    loop = Loop()
    for _ in range(4000):
        loop.step(0.01, 0.0, 0.0, 0.0, DT, 50.0, GAINS)
    assert loop.integral == GAINS.integral_most


def test_a_joint_of_a_twin_that_is_sent_torques_only_reaches_positions_and_velocities() -> None:
    gains = "[motors.left.loop]\nvelocity_gain = 0.3\nintegral_gain = 3.0\nintegral_most = 1.0\n"
    text = find("robots", "bench").read_text().replace("[motors.right]", f"{gains}\n[motors.right]")
    sent: set[type[msg.Command]] = set()
    with gw.open_session(gw.parse_robot(text), simulated=True) as session:
        joint = session.joints["left"]
        command = joint.command

        def seen(*step: Any) -> msg.Command:
            out = command(*step)
            sent.add(type(out))
            return out

        vars(joint)["command"] = seen
        reached = []
        for number, _ in enumerate(session.run(2.6)):
            if number == 100:
                session.submit(msg.Position("left", 2.0))
            if number == 340:
                reached.append(joint.feedback.position)
                session.submit(msg.Velocity("left", -3.0))
            if number == 500:
                reached.append(joint.feedback.velocity)
        assert reached == [pytest.approx(2.0, abs=0.01), pytest.approx(-3.0, abs=0.2)]
        assert not joint.faults
    assert sent == {msg.Idle, msg.Torque}
