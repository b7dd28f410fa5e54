"""The filter with every body on wheels: the same motion, and an honest covariance."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from brain.bodies.body import Base
from brain.perception.filter import Filter
from brain.perception.filter_inputs import WheelAngle
from brain.perception.filter_settings import FilterSettings
from brain.perception.track import SourceTrack
from protocols.messages import SECOND
from tests.brain.bodies.test_wheeled_bodies import BODIES
from tests.brain.perception.rolling import MS, Floor, consistency, roll

LEVEL = Floor(slip=0.0, gyro=False, rest=100 * MS)
each_body = pytest.mark.parametrize("name", BODIES)


def floor(seed: int) -> Floor:
    """A floor whose wheels are larger or smaller than stated, by as much as the filter supposes."""
    error = FilterSettings().scale_sigma * float(np.random.default_rng([seed, 2]).normal())
    return Floor(radius_errors=(error, error))


@each_body
def test_without_slip_all_bodies_are_reckoned_alike(name: str) -> None:
    """Each joint with stamps of its own: 2 mm over 3 s, without gyro."""
    changed: dict[str, Any] = {"turn_slip": 0.0} if BODIES[name].turn_slip else {}
    body = replace(BODIES[name], **changed)
    run, belief = roll(1, 3 * SECOND, LEVEL, body=body), Filter(body, FilterSettings())
    belief.observe([replace(one) for one in run.inputs])
    assert belief.t == 3 * SECOND
    found = belief.at(belief.t)
    assert found is not None
    x, y, yaw = run.truth[belief.t]
    assert math.dist((found[0].x, found[0].y), (x, y)) < 2e-3
    assert math.remainder(found[0].yaw - yaw, 2.0 * math.pi) == pytest.approx(0.0, abs=2e-3)


@pytest.mark.parametrize("name", ["skid_steer", "omni of three", "ackermann"])
def test_the_covariance_is_honest(name: str) -> None:
    """A sample; 200 runs of all bodies: `./go prove -k honest`."""
    assert consistency(1, 4 * SECOND, floor(1), FilterSettings(), BODIES[name])[0] < 3.0


@each_body
def test_resting_wheels_are_rest_whatever_the_steering_does(name: str) -> None:
    body = BODIES[name]
    steers = [radius == 0.0 for radius in body.rolling]
    belief = Filter(body, FilterSettings())
    for t in range(0, 500 * MS, 10 * MS):
        angles = [0.4 * math.sin(t / SECOND) if steers[j] else 0.0 for j in range(len(steers))]
        belief.observe([WheelAngle(m, t, a) for m, a in zip(body.joints, angles, strict=True)])
    assert belief.state.resting
    assert belief.state.x[:3] == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert belief.state.P[5] == pytest.approx(FilterSettings().start_yaw_sigma ** 2)


def test_a_track_knows_sideways_motion() -> None:
    track = SourceTrack()
    for t in range(10):
        track.add(t * 10 * MS, (t + 1) * 10 * MS, 0.0, 0.0, 0.0, 0.0, 0.01)
    motion = track.between(0, 100 * MS)
    assert motion is not None
    assert motion.ahead() == pytest.approx((0.0, 0.1))


@pytest.mark.prove
@each_body
def test_the_covariance_of_all_bodies_is_honest(name: str) -> None:
    """Mean NEES per number over 200 runs of 20 s of motion: not above 1 by more than its own noise, nor far
    too cautious: the filter allows for tyres that give way and for sliding sideways, which this floor does
    not have."""
    body: Base = BODIES[name]
    nees = [consistency(seed, 21 * SECOND, floor(seed), FilterSettings(), body)[0] for seed in range(200)]
    mean, noise = float(np.mean(nees)), float(np.std(nees)) / math.sqrt(len(nees))
    print(f"{name}: NEES {mean:.2f} ± {1.96 * noise:.2f}")
    assert 0.4 < mean < 1.0 + 3.0 * noise
