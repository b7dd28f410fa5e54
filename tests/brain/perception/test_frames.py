"""The frames of REP-105: in "odom" the base moves as its wheels do, whatever corrects its pose in "map"."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from brain.bodies.plane import wrap
from brain.brain import Brain
from brain.perception.filter import Filter
from brain.perception.filter_inputs import Input, PoseFix, Relocated
from brain.perception.filter_settings import FilterSettings
from brain.perception.mount import Mount
from brain.planning.costmap import PlannerSettings
from brain.settings import BrainSettings
from protocols.messages import MILLISECOND, SECOND, Command, Goal, PoseReading, seconds
from tests.brain.helpers import Office
from tests.brain.perception.rolling import BODY, MS, Floor, roll


def corrected(seed: int, inputs: list[Input]) -> list[Input]:
    """Beside fixes that are right, some that are metres off for a while, and places that are found anew."""
    rng = np.random.Generator(np.random.PCG64([seed, 7]))
    wrong: list[Input] = []
    for i, item in enumerate(inputs):
        if isinstance(item, PoseFix) and 3 * SECOND < item.t < 6 * SECOND:
            wrong.append(replace(item, source="liar", value=item.value + np.array([2.0, -1.0, 1.5])))
        elif i % 700 == 699:
            wrong.append(Relocated(item.t, rng.uniform(-20.0, 20.0, 3), np.eye(3) * 1e-4))
    return inputs + wrong


def arriving(seed: int, inputs: list[Input]) -> Iterator[list[Input]]:
    """Every 5 ms what has come by then: up to 40 ms late, in any order."""
    rng = np.random.Generator(np.random.PCG64([seed, 8]))
    late = (rng.random(len(inputs)) * 40 * MS).tolist()
    due = sorted(((item.t + int(by), i) for i, (item, by) in enumerate(zip(inputs, late, strict=True))))
    for step in range(0, due[-1][0] + 5 * MS, 5 * MS):
        yield [inputs[i] for t, i in due if step - 5 * MS < t <= step]


@pytest.mark.sample(2)
@pytest.mark.parametrize("seed", range(4))
def test_in_odom_the_base_never_moves_faster_than_it_can(seed: int) -> None:
    """By fixes, right and wrong ones, another place, another start, and inputs that come late."""
    rng = np.random.Generator(np.random.PCG64(seed))
    x, y, yaw = rng.uniform(-3.0, 3.0, 3).tolist()
    belief = Filter(BODY, FilterSettings(start_x=x, start_y=y, start_yaw=yaw, lockout=SECOND))
    run = roll(seed, 10 * SECOND, Floor(fixes=200 * MS))
    before, t, leapt, fastest = belief.odom, belief.t or 0, 0.0, 0.0
    assert before == pytest.approx((x, y, yaw))
    place = belief.state.x[:2]
    for items in arriving(seed, corrected(seed, run.inputs)):
        belief.observe(items)
        now = belief.t or 0
        far, turn = math.dist(belief.odom[:2], before[:2]), abs(wrap(belief.odom[2] - before[2]))
        assert far <= 1.1 * BODY.max_linear * seconds(now - t) + 1e-4, f"seed {seed}, {now / SECOND} s"
        assert turn <= 1.1 * BODY.max_angular * seconds(now - t) + 5e-3, f"seed {seed}, {now / SECOND} s"
        leapt = max(leapt, math.dist(belief.state.x[:2], place))
        fastest = max(fastest, far)
        before, t, place = belief.odom, max(t, now), belief.state.x[:2]
    assert leapt > 1.0
    assert fastest > 1e-3
    true = run.truth[max(run.truth)]
    moved = math.hypot(before[0] - x, before[1] - y)
    assert moved == pytest.approx(math.hypot(*true[:2]), abs=0.05 + 0.05 * moved)  # wheels and gyro know it


SENSORS = {"imu": Mount(z=0.05), "mocap": Mount()}
OPEN = BrainSettings(BODY, planner=PlannerSettings(unknown_is_free=True))


@pytest.mark.sample(1)
@pytest.mark.parametrize(("dx", "dy"), [(0.3, 0.4), (-0.4, 0.3), (-0.5, 0.0)])
def test_goals_in_the_map_are_reached_after_a_correction_of_half_a_metre(dx: float, dy: float) -> None:
    """By poses from outside that leap while the base drives, in open ground and without a lidar."""
    office = Office([(6.0, 6.0, 6.1, 6.1)])
    office.silent = {"lidar"}
    timeouts = dict.fromkeys(("left", "right", "imu"), 200 * MILLISECOND) | {"mocap": SECOND}
    brain = Brain(OPEN, ("left", "right"), SENSORS, timeouts)
    commands: Sequence[Command] = ()
    tasks: list[Goal] = [Goal(3.0, 0.0), Goal(3.0, 2.0, 1.5)]
    leap, before, widest, speeds = (0.0, 0.0), None, 0.0, []
    for count in range(6000):
        events = office.step(commands)
        if count % 10 == 0:
            leap = (dx, dy) if count > 400 else leap
            x, y, yaw = office.pose.x + leap[0], office.pose.y + leap[1], office.pose.yaw
            events = [*events, PoseReading("mocap", office.now, x, y, yaw, 1e-4, 1e-4)]
        commands = brain.step(office.now, events, tasks if count == 100 else (), "")
        belief = brain.belief()
        estimate = belief.estimate
        if estimate is not None and before is not None:
            most = 1.1 * BODY.max_linear * seconds(estimate.t - before.t) + 1e-4
            assert math.hypot(estimate.odom.x - before.odom.x, estimate.odom.y - before.odom.y) <= most
            widest = max(widest, math.hypot(estimate.pose.x - before.pose.x, estimate.pose.y - before.pose.y))
        before = estimate
        speeds.append([getattr(command, "velocity", 0.0) or 0.0 for command in commands])
        if belief.reached == 2:
            break
    assert belief.reached == 2, brain.take_notes()
    assert widest > 0.3
    assert math.dist((office.pose.x + dx, office.pose.y + dy), (3.0, 2.0)) < 0.1
    rates = np.diff(np.array(speeds), axis=1)[:, 0] * BODY.wheel_radius / BODY.wheel_separation
    assert np.abs(rates[395:600]).max() < 0.7  # until then straight on
