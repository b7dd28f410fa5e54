"""Whether the sources of a bag show the same motion: gyro and wheels, twist and pose of the odometry.

Rules. Pure functions of arrays → sentences. Means over windows are compared, so that noise and rates of
sampling matter little. Each figure comes with its standard error, by leaving out one of `BLOCKS` parts with
the same share of the motion (the jackknife: it supposes nothing of the noise): what is said is beyond its
tolerance by `SURE` of them. A factor is taken as a range, from the regression of the one on the other to that
of the other on the one, since noise in either makes it seem smaller: only a range that is wholly beyond the
tolerance is said. What hardly moves shows nothing, and nothing is said of it. The gyro is compared with the
turns of the poses, since many controllers report the twist as a mean over the last second.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import degrees
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from brain.belief import Floats

Complexes = npt.NDArray[np.complex128]
Values = npt.NDArray[Any]
"""Floats or Complexes"""

BLOCKS, SURE = 10, 3.0
FEWEST = 4 * BLOCKS
"""Windows; with fewer, nothing is said."""
MOST = 20_000
"""Windows that are looked at."""
LAG = 0.15
"""s by which the base may follow the turns of its wheels, or the wheels be reported late."""
REACH = 2.0
"""s: the largest lag that is searched for,"""
STEP = 0.02
"""s: in steps of this; between them by a parabola."""
NEARER = 0.02
"""Correlation that the largest lag must have more than none: of a slalom, one turn resembles the next."""
SCALE = 0.2
"""Share by which two measurements of one motion may differ: wheels, tyres, gyro."""
TURNING = 0.05
"""rad/s, standard deviation: less shows nothing."""
MOVING = 0.05
"""m/s, RMS"""
FOLLOWS = 0.2
"""Share of one rate of turn that the other must follow, if both measure the same base,"""
LIKE, WIDE = 0.5, 2.0
"""unless they have this share of their squares in common; and the windows [s] over which that is taken."""
DIRECTION = 0.2
"""rad between the directions of twist and pose."""
UNEXPLAINED = SCALE**2
"""Share of the motion's square that twist and pose may not have in common."""
FRAME = 0.1
"""Twists are in a fixed frame if there they leave less than this share of what they leave in the base's."""
SIDEWAYS = 0.1
"""Share of its speed that a base which cannot move sideways may: a slip angle of 6 degrees."""
SMOOTHED = 0.8
"""s by which a twist may be later than its pose: some controllers report a mean over more than a second."""
GAP = 0.5
"""s without a measurement, in which nothing is compared."""


class UnwrappedAngles(NamedTuple):
    """Angles [rad], unwrapped, at times [s], in order."""

    t: Floats
    angle: Floats


class Odometry(NamedTuple):
    """Twists and poses at times [s], in order."""

    t: Floats
    twist: Complexes
    """m/s: forward, and to the left as the imaginary part"""
    rate: Floats
    """rad/s"""
    place: Complexes
    """m: x, and y as the imaginary part"""
    yaw: Floats
    """rad"""


# -- gyro and wheels -----------------------------------------------------------------------------


def turns_of(t: Floats, rate: Floats) -> UnwrappedAngles:
    """Return the turns that a rate [rad/s] adds up to."""
    return UnwrappedAngles(t, _integral(t, rate))


def wheel_turns(one: Odometry) -> UnwrappedAngles:
    """Return the turns of an odometry by its poses, or by its twists if those are never filled in."""
    return UnwrappedAngles(one.t, np.unwrap(one.yaw)) if np.ptp(one.yaw) else turns_of(one.t, one.rate)


def gyro(measured: UnwrappedAngles, wheels: UnwrappedAngles, slip: float) -> list[str]:
    """Return how a gyro contradicts the wheels. `slip`: standard deviation of a turn's slip, as a share."""
    width = max(0.1, 3.0 * _period(measured.t), 3.0 * _period(wheels.t))
    reach = min(REACH, (wheels.t[-1] - wheels.t[0]) / 8.0)
    at = _windows(wheels.t, width, measured.t, reach)
    if len(at) < FEWEST:
        return []
    lags = STEP * np.arange(-round(reach / STEP), round(reach / STEP) + 1)
    x, ys = _mean(*wheels, at, width), [_mean(*measured, at + lag, width) for lag in lags]
    blocks = _blocks(x, ys[len(lags) // 2])
    sums = np.stack([_moments(x, y, blocks) for y in ys], axis=1)
    lag, lag_error = _jackknife(sums, lambda total: _lag(total, lags))
    best = sums[:, int(np.argmin(np.abs(lags - lag)))]
    by_wheels, by_gyro, _ = _moments_about_mean(best.sum(axis=0))
    if max(by_wheels, by_gyro) < TURNING**2:
        return []
    tolerance = SURE * slip + SCALE
    unlike = _unlike(measured, wheels, min(FOLLOWS, 1.0 - tolerance))
    if unlike:
        return unlike
    found = _factor(best, tolerance)
    if abs(lag) - SURE * lag_error > LAG:
        side = "before" if lag < 0.0 else "after"
        found.append(f"the gyro turns {abs(lag):.2f} s {side} the wheels do: its stamps or theirs are wrong")
    return found


def _unlike(measured: UnwrappedAngles, wheels: UnwrappedAngles, least: float) -> list[str]:
    """Return that one of two rates hardly follows the other: a wrong axis, a rate that is never filled in.

    Over wide windows, in which no noise of a gyro is a turn."""
    width = max(WIDE, 3.0 * _period(measured.t), 3.0 * _period(wheels.t))
    at = _windows(wheels.t, width, measured.t, 0.0)
    if len(at) < FEWEST:
        return []
    x, y = _mean(*wheels, at, width), _mean(*measured, at, width)
    sums = _moments(x, y, _blocks(x, y))
    by_wheels, by_gyro, common = _moments_about_mean(sums.sum(axis=0))
    if common * common > LIKE * by_wheels * by_gyro:
        return []
    for of, one, other in (
        (0, "the wheels turn", "the gyro shows"),
        (1, "the gyro turns", "the wheels show"),
    ):
        turning = float((by_wheels, by_gyro)[of] ** 0.5)
        follows, error = _jackknife(sums, partial(_follows, of))
        if turning > TURNING and follows + SURE * error < least:
            return [f"{one} by {turning:.2g} rad/s (RMS), and {other} {100 * follows:.0f} % of it"]
    return []


def _follows(of: int, total: Floats) -> float:
    return float(abs(_regression(total, of)))


def _factor(sums: Floats, tolerance: float) -> list[str]:
    """Return that the gyro turns otherwise than the wheels, by sign or factor."""
    least, least_error = _jackknife(sums, lambda total: _regression(total, 0))
    most, most_error = _jackknife(sums, lambda total: 1.0 / _regression(total, 1))
    if abs(least) < SURE * least_error:
        return []
    turned = ["the gyro turns the other way than the wheels"] if least < 0.0 else []
    low, high = abs(least) - SURE * least_error, abs(most) + SURE * most_error
    if low > 1.0 + tolerance or high < 1.0 / (1.0 + tolerance):
        turned.append(f"the gyro turns {_times(abs(least * most) ** 0.5, 'the wheels')}")
    return turned


def _times(factor: float, other: str) -> str:
    for hint, unit in (("degrees for radians?", np.degrees(1.0)), ("radians for degrees?", np.radians(1.0))):
        if 0.9 < factor / unit < 1.1:
            return f"{factor:.3g} times as much as {other} ({hint})"
    return f"{factor:.3g} times as much as {other}"


def _lag(total: Floats, lags: Floats) -> float:
    """Return the lag at which two rates are most alike, or most opposite, in sums by lag."""
    xx, yy, xy = _moments_about_mean(total)
    likeness = np.abs(xy) / np.sqrt(xx * yy)
    framed = np.concatenate(([-np.inf], likeness, [-np.inf]))
    peaks = np.flatnonzero((likeness >= framed[:-2]) & (likeness >= framed[2:]))
    if not len(peaks):
        return 0.0
    at = peaks[np.argmax(likeness[peaks] - NEARER * np.abs(lags[peaks]) / REACH)]
    if not 0 < at < len(lags) - 1:
        return float(lags[at])
    before, here, after = likeness[at - 1 : at + 2]
    bend = before - 2.0 * here + after
    return float(lags[at] + (STEP * 0.5 * (before - after) / bend if bend < 0.0 else 0.0))


# -- twist and pose ------------------------------------------------------------------------------


def odometry(one: Odometry, *, sideways: bool) -> list[str]:
    """Return how the twists of an odometry contradict its poses, or a base that cannot move `sideways`."""
    return [*_twist_and_pose(one), *([] if sideways else _moves_sideways(one))]


def _twist_and_pose(one: Odometry) -> list[str]:
    width = max(2.0, 4.0 * _period(one.t))
    at = _windows(one.t, width, one.t, SMOOTHED)
    if len(at) < FEWEST or not (np.ptp(one.place.real) or np.ptp(one.place.imag) or np.ptp(one.yaw)):
        return []  # too short, or a pose that is never filled in
    shown = [_shown(one, at, width, lag) for lag in np.arange(0.0, SMOOTHED + STEP, 2.0 * STEP)]
    moved, turned, body, _, turn = min(shown, key=_disagreement)
    found = []
    if max(_rms(moved), _rms(body)) > MOVING:
        found += _motion(moved, body, min(_residual(_product(moved, fixed)) for *_, fixed, _ in shown))
    if max(_rms(turned), _rms(turn)) > TURNING:
        found += _turn(turned, turn)
    return found


def _shown(
    one: Odometry, at: Floats, width: float, lag: float
) -> tuple[Complexes, Floats, Complexes, Complexes, Floats]:
    """Return the mean motion over windows: by the poses, place and turn; by the twists, `lag` s later: in the
    base's frame, in a fixed frame, and turn."""
    yaw, twist = np.unwrap(one.yaw), np.interp(one.t + lag, one.t, one.twist)
    rate = np.interp(one.t + lag, one.t, one.rate)
    ways = one.place, yaw, *(_integral(one.t, r) for r in (twist * np.exp(1j * yaw), twist, rate))
    place, turned, body, fixed, turn = (_mean(one.t, way, at, width) for way in ways)
    return place, turned, body, fixed, turn


def _disagreement(shown: tuple[Complexes, Floats, Complexes, Complexes, Floats]) -> float:
    moved, turned, body, _, turn = shown
    pairs = ((moved, body, MOVING), (turned, turn, TURNING))
    return sum(_residual(_product(p, d)) for p, d, least in pairs if min(_rms(p), _rms(d)) > least)


def _motion(moved: Complexes, body: Complexes, there: float) -> list[str]:
    """Return how displacements by pose and twist contradict each other. `there`: what twists that were in a
    fixed frame would not explain."""
    if _rms(body) < SCALE * _rms(moved):
        return [f"its poses move at {_rms(moved):.2g} m/s (RMS), and its twists at {_rms(body):.2g}"]
    blocks = _blocks(moved, body)
    sums = _products(moved, body, blocks)
    other = _residual(sums.sum(axis=0))
    if other > FRAME**2 and there < FRAME * other:
        return ["its twists are in the frame of the odometry, not of the base"]
    if min(_without(sums, _residual)) > UNEXPLAINED:
        return [f"its twists do not explain {100 * other**0.5:.0f} % of the motion of its poses"]
    found = []
    direction = np.conj(sums.sum(axis=0)[2])
    angle = -float(np.angle(direction))
    _, angle_error = _jackknife(sums, lambda total: float(np.angle(total[2] * direction)))
    if abs(angle) - SURE * angle_error > DIRECTION:
        side = "left" if angle > 0.0 else "right"
        text = f"its twists point {abs(degrees(angle)):.0f} degrees to the {side} of the motion of its poses"
        found.append(text)
    return found + _scale(sums, "move")


def _turn(turned: Floats, turn: Floats) -> list[str]:
    if _rms(turn) < SCALE * _rms(turned):
        return [f"its poses turn by {_rms(turned):.2g} rad/s (RMS), and its twists by {_rms(turn):.2g}"]
    sums = _products(turned, turn, _blocks(turned, turn))
    if min(_without(sums, _residual)) > UNEXPLAINED:
        other = _residual(sums.sum(axis=0))
        return [f"its twists do not explain {100 * other**0.5:.0f} % of the turns of its poses"]
    against = ["its twists turn the other way than its poses"] if sums.sum(axis=0)[2].real < 0.0 else []
    return against + _scale(sums, "turn")


def _scale(sums: Complexes, verb: str) -> list[str]:
    """Return that twists are larger or smaller than what the poses show."""
    least, least_error = _jackknife(sums, lambda total: abs(total[2]) / total[0].real)
    most, most_error = _jackknife(sums, lambda total: total[1].real / abs(total[2]))
    if least - SURE * least_error <= 1.0 + SCALE and most + SURE * most_error >= 1.0 / (1.0 + SCALE):
        return []
    return [f"its twists {verb} {_times((least * most) ** 0.5, 'its poses')}"]


def _moves_sideways(one: Odometry) -> list[str]:
    """Return that a base moves sideways which cannot; beside its axle, a point does so in turns."""
    across, turning = one.twist.imag, float((one.rate**2).sum())
    lever = float((across * one.rate).sum()) / turning if turning else 0.0
    slides, speed = _rms(across - lever * one.rate), _rms(one.twist)
    if slides < SIDEWAYS * speed or slides < SCALE * MOVING:
        return []
    return [f"it moves sideways at {slides:.2g} m/s (RMS), and this base cannot"]


# -- statistics ----------------------------------------------------------------------------------


def _period(t: Floats) -> float:
    """Return the usual time between two measurements that are not of the same time."""
    apart = np.diff(t)
    apart = apart[apart > 0.0]
    return float(np.median(apart)) if len(apart) else 0.0


def _windows(t: Floats, width: float, other: Floats, reach: float) -> Floats:
    """Return the middles of windows that both series fill, also if the other is moved by `reach`."""
    margin = width / 2.0 + reach
    low, high = max(t[0] + width / 2.0, other[0] + margin), min(t[-1] - width / 2.0, other[-1] - margin)
    at = t[(t >= low) & (t <= high)]
    at = at[:: len(at) // MOST + 1]
    kept = np.ones(len(at), dtype=bool)
    for times, half in ((t, width / 2.0), (other, margin)):
        gaps = np.diff(times)
        lost = np.concatenate(([0.0], np.cumsum(gaps * (gaps > max(GAP, 2.0 * width)))))
        kept &= np.interp(at + half, times, lost) == np.interp(at - half, times, lost)
    filled: Floats = at[kept]
    return filled


def _integral(t: Floats, rate: Values) -> Values:
    integral: Values = np.concatenate(([0.0], np.cumsum(np.diff(t) * (rate[1:] + rate[:-1]) / 2.0)))
    return integral


def _mean(t: Floats, integral: Values, at: Floats, width: float) -> Values:
    """Return the mean rate over each window, from its integral."""
    half = width / 2.0
    mean: Values = (np.interp(at + half, t, integral) - np.interp(at - half, t, integral)) / width
    return mean


def _rms(values: Values) -> float:
    return float((np.abs(values) ** 2).mean() ** 0.5)


def _blocks(*motions: Values) -> npt.NDArray[np.intp]:
    """Return where each of `BLOCKS` parts begins that have the same share of what differs from the mean."""
    share = np.cumsum(sum(np.abs(one - one.mean()) ** 2 for one in motions))
    share /= share[-1]
    return np.unique(np.searchsorted(share, np.arange(BLOCKS) / BLOCKS))


def _moments(x: Floats, y: Floats, blocks: npt.NDArray[np.intp]) -> Floats:
    """Return the sums of 1, x, y, xx, yy and xy, by block."""
    moments: Floats = np.add.reduceat(np.stack([np.ones_like(x), x, y, x * x, y * y, x * y]), blocks, axis=1)
    return moments.T


def _products(p: Values, d: Values, blocks: npt.NDArray[np.intp]) -> Complexes:
    """Return the sums of pp, dd and d to p, by block."""
    products = np.stack([p * p.conj(), d * d.conj(), d * p.conj()]).astype(np.complex128)
    sums: Complexes = np.add.reduceat(products, blocks, axis=1)
    return sums.T


def _product(p: Values, d: Values) -> Complexes:
    """Return the same sums of all."""
    sums: Complexes = _products(p, d, np.zeros(1, dtype=np.intp))[0]
    return sums


def _moments_about_mean(total: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the variances of x and y and their covariance, of sums of `_moments`."""
    count, x, y, xx, yy, xy = (np.asarray(total[..., column]) for column in range(6))
    return (xx - x * x / count) / count, (yy - y * y / count) / count, (xy - x * y / count) / count


def _regression(total: Floats, of: int) -> Floats:
    """Return by how much the other changes with x (0) or y (1)."""
    *variances, covariance = _moments_about_mean(total)
    regression: Floats = covariance / variances[of]
    return regression


def _residual(total: Complexes) -> float:
    """Return the share of the square of one motion that the other does not explain, by any factor or turn."""
    return float(1.0 - abs(total[2]) ** 2 / (total[0].real * total[1].real))


def _jackknife(sums: Values, figure: Callable[[Values], Any]) -> tuple[float, float]:
    """Return a figure of sums by block, and its standard error: how it changes without each block."""
    without = _without(sums, figure)
    spread = without - without.sum() / len(without)
    return float(figure(sums.sum(axis=0))), float(
        ((len(without) - 1) / len(without) * (spread**2).sum()) ** 0.5
    )


def _without(sums: Values, figure: Callable[[Values], Any]) -> Floats:
    """Return a figure without each block."""
    total = sums.sum(axis=0)
    return np.array([float(figure(total - block)) for block in sums])
