"""NIS: what honest, too sure and too unsure covariances look like, on the filter itself."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest

from brain.perception.consistency import Nis
from brain.perception.ekf import Ekf
from brain.perception.filter_settings import EkfSettings
from brain.perception.measurement import Verdict, gyro, wheels
from protocols.messages import MILLISECOND


def driven(reported: float, really: float, seed: int, readings: int = 2000) -> Ekf:
    """A base that turns at random, whose gyro has a noise of `really` and tells of `told`, rad/s."""
    random = np.random.Generator(np.random.PCG64(seed))
    settings = EkfSettings(start_sigma=1e-6, bias_sigma=1e-9, bias_noise=0.0, angular_noise=0.5)
    ekf = Ekf(settings)
    rate = float(random.normal(0.0, 1.0))
    for step in range(1, readings + 1):
        rate += float(random.normal(0.0, 0.5 * np.sqrt(0.01)))
        ekf.observe(gyro("imu", 10 * step * MILLISECOND, rate + float(random.normal(0.0, really)), reported))
    return ekf


@pytest.mark.parametrize("seed", range(3))
def test_honest_covariances_give_one(seed: int) -> None:
    nis = driven(0.05, 0.05, seed).nis["imu"]
    assert nis.count == nis.freedom == 2000
    # chi-square of 2000 degrees of freedom over 2000: 1 ± 0.032; three sigma, and the first readings
    assert 0.9 < nis.mean < 1.1
    assert 0.03 < nis.beyond / nis.count < 0.07


def test_a_sensor_that_tells_of_too_little_noise_is_seen() -> None:
    nis = driven(0.01, 0.05, 1).nis["imu"]
    assert nis.mean > 1.5
    assert nis.beyond / nis.count > 0.1


def test_a_sensor_that_tells_of_too_much_noise_is_seen() -> None:
    assert driven(0.5, 0.05, 1).nis["imu"].mean < 0.5


def test_a_refused_measurement_counts_and_a_late_one_once() -> None:
    ekf = Ekf(EkfSettings())
    for step in range(1, 11):
        ekf.observe(gyro("imu", 100 * step * MILLISECOND, 0.0, 0.01))
    assert ekf.observe(gyro("imu", 1010 * MILLISECOND, 50.0, 0.01)) is Verdict.REFUSED
    before = deepcopy(ekf.nis)
    assert before["imu"].count == 11
    assert before["imu"].mean > 1000
    # put in its place before what came after it, which is applied again but not judged again
    assert ekf.observe(wheels("left", 950 * MILLISECOND, 0.0, 0.0, np.eye(2) * 1e-2)) is Verdict.ACCEPTED
    assert ekf.nis["imu"] == before["imu"]
    assert (ekf.nis["left"].count, ekf.nis["left"].freedom) == (1, 2)
    assert ekf.observe(gyro("imu", 1, 0.0, 0.01)) is not Verdict.ACCEPTED
    assert ekf.nis["imu"] == before["imu"]


def test_before_the_first_measurement() -> None:
    assert Nis().mean == 0.0
