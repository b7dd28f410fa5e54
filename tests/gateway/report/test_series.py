"""Signals and paths in bounded memory: no peak is lost, ends stay, and the bound holds."""

from __future__ import annotations

from math import cos, inf, nan, sin

import numpy as np
import pytest

from brain.belief import Pose
from gateway.report.series import APART, DrivenTrack, Signals
from protocols.messages import MILLISECOND, SECOND

PERIOD = 5 * MILLISECOND


@pytest.mark.parametrize("ticks", [1, 2, 7, 64, 65, 1000, 4321])
def test_each_interval_has_the_lowest_and_the_highest_value_in_it(ticks: int) -> None:
    samples = np.random.default_rng(ticks).normal(size=ticks)
    signals = Signals(PERIOD, most=64)
    for i, sample in enumerate(samples):
        signals.move_to(SECOND + i * PERIOD)
        signals.add(float(sample), "a", "b")
    ((name, values),) = signals.values()
    times, width = signals.times(), signals.width // PERIOD
    assert name == ("a", "b")
    assert len(times) == len(values) <= 2 * 64
    assert times[0] == 0.0
    assert times[-1] <= ticks * PERIOD / SECOND
    for at in range(0, len(values), 2):
        part = samples[at // 2 * width : (at // 2 + 1) * width]
        order = (part.min(), part.max()) if part.argmin() <= part.argmax() else (part.max(), part.min())
        assert tuple(values[at : at + 2]) == order


def test_a_rare_signal_has_gaps_and_a_common_one_none() -> None:
    signals = Signals(PERIOD, most=64)
    for i in range(40):
        signals.move_to(i * PERIOD)
        signals.add(1.0, "often")
        if i % 10 == 0:
            signals.add(2.0, "rare")
    values = dict(signals.values())
    assert None not in values[("often",)]
    assert values[("rare",)].count(2.0) == 8
    assert values[("rare",)].count(None) == 72


def test_what_is_not_finite_is_left_out() -> None:
    signals, track = Signals(PERIOD), DrivenTrack()
    signals.move_to(0)
    for value in (nan, 1.0, inf, -inf):
        signals.add(value, "a")
        track.add(0, Pose(value, 0.0, 0.0))
    assert dict(signals.values()) == {("a",): [1.0, 1.0]}
    assert track.points == [(0, Pose(1.0, 0.0, 0.0))]


def test_shrinking_keeps_the_peaks_of_all_signals() -> None:
    signals = Signals(PERIOD)
    for i in range(1500):
        signals.move_to(i * PERIOD)
        for name in "abcd":
            signals.add(9.0 if i == 777 else float(i % 3), name)
    signals.shrink(2000)
    values = dict(signals.values())
    assert sum(len(one) for one in values.values()) <= 2000
    assert all(one.count(9.0) == 1 for one in values.values())


def test_a_path_of_any_length_is_bounded_and_keeps_its_ends() -> None:
    track, steps = DrivenTrack(most=100), 20_000
    for i in range(steps):
        angle = 0.001 * i
        track.add(i * PERIOD, Pose(3.0 * cos(angle), 3.0 * sin(angle), 0.0))
    points = track.points
    assert len(points) <= 101
    assert points[0][0] == 0
    assert points[-1][0] == (steps - 1) * PERIOD
    assert track.length == pytest.approx(3.0 * 0.001 * steps, rel=0.01)
    assert [t for t, _ in points] == sorted(t for t, _ in points)


def test_noise_at_rest_adds_neither_points_nor_length() -> None:
    track, noise = DrivenTrack(), np.random.default_rng(1).normal(scale=APART / 10, size=(2000, 2))
    for i, (x, y) in enumerate(noise):
        track.add(i * PERIOD, Pose(float(x), float(y), 0.0))
    assert len(track.points) <= 2
    assert track.length == 0.0
