"""What a joint is, from what it was told and did: inertia, friction, load, backlash, and its loop's gains.

Rules. All is at the output shaft, SI. Between two moments the integral of the torque is what inertia, dry and
viscous friction and load took: linear in them, and no acceleration is ever computed. From there the joint is
simulated with its velocity loop on the set-points that were sent, and every value is changed until velocity
and torque are those that were reported. Torque counts as reported: where the true inertia is known, the
factor on it follows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from brain.belief import Floats
from gateway.bench.joint_trace import JointTrace, columns
from gateway.bench.scatter import covariance
from gateway.errors import UserError
from gateway.sim.files import ShaftFile
from gateway.sim.shafts import DT, Shaft

GRID = 0.002
"""s between the moments at which all is interpolated"""
WINDOW = 0.06
"""s over which torques are integrated"""
CREEP = 0.02
"""rad/s, and share of the fastest, below which it is not certain which way a shaft turns"""
SHIFTS = np.arange(-0.02, 0.0401, 0.002)
"""s by which a report may be later than another"""
NOISE = 0.01, 0.02
"""Of velocity and torque, as shares of the largest: their weights"""
STARTS, RATIOS = ((0.8, 1.0), (15.0, 40.0, 100.0, 250.0), (0.0005, 0.0015, 0.003, 0.008)), (1.0, 8.0)
"""Where the search begins: the inertia as a share of the first guess, the bandwidth of the loop [rad/s], s
from a set-point to the torque that answers it; the integral's gain over the other [1/s]"""
AGAIN = (None, 1.0, 4.0), (0.0005, 0.001, 0.0015, 0.0025), (0.0005, 0.0015, 0.003), (0.0, 0.0015)
"""And where it begins again, once that is known roughly: that ratio (None: as found), s of delay, of lag, and
by which torques are older, each of which another value of the others hides"""
ROUNDS = 2
"""How often at most"""
FEWEST = 50
"""Set-points of velocity from which on a loop is looked for"""
STRANGE = 0.1
"""Misfit from which on a loop is none that this describes"""
GOOD = 0.002
"""Misfit at which backlash is not looked for"""
BACKLASHES, WORTH = (0.01, 0.03, 0.06, 0.12), 0.7
"""rad that are tried, and the share of the misfit that one must leave at most, lest it be no backlash"""
DIFFERENCE = 1e-4
"""Share by which a value is changed to see what it does"""
WIDEST = 80.0
"""rad/s, of the bandwidth that is proposed"""
NEIGHBOURS, TOGETHER = 6, 20
"""Windows, and readings, that may be wrong together"""
HIDDEN = DT / math.sqrt(12.0)
"""s, standard deviation: when within a step something happens is not seen, whatever the scatter says, and a
loop that settles in a few steps hides as much of what it moves"""
LEAST_TRAVEL = 0.05
"""rad"""
SLOWEST = 60.0
"""Readings a second of position, velocity and torque each, at least"""


@dataclass(frozen=True, slots=True)
class Value:
    """A value with its standard deviation."""

    value: float
    sigma: float


@dataclass(frozen=True, slots=True)
class Identified:
    """What was found."""

    joint: str
    inertia: Value
    """kg·m²"""
    friction: Value
    """N·m, dry"""
    damping: Value
    """N·m·s/rad"""
    load: Value
    """N·m, positive where it drives forward"""
    backlash: Value | None
    """rad; None: no reversal that shows it"""
    gain: Value | None
    """N·m·s/rad of its velocity loop; None: it has none that could be seen; so is the next"""
    integral: Value | None
    """N·m/rad"""
    delay: float
    """s from a set-point to the torque that answers it"""
    lag: float
    """s by which the velocity lags that the device measures, and its loop with it"""
    torque_limit: float
    """N·m, the largest that was reported"""
    misfit: float
    """Root mean square of simulated less measured velocity, as a share of the fastest; nan without gains"""

    def shaft(self) -> ShaftFile:
        """Return the same as what a twin turns."""
        friction, damping = max(self.friction.value, 0.0), max(self.damping.value, 0.0)
        backlash = self.backlash.value if self.backlash is not None else 0.0
        return ShaftFile(self.inertia.value, damping, friction, self.load.value, backlash=backlash)


def identify(trace: JointTrace, torque_limit: float) -> Identified:
    """Identify a joint. `torque_limit`: N·m of it in the robot file. Raises UserError, in words, where the
    trace does not show it."""
    for rows, what in ((trace.velocity, "velocity"), (trace.position, "position"), (trace.torque, "torque")):
        rate = (len(rows) - 1) / max(rows[-1][0] - rows[0][0], 1e-9) if len(rows) > 1 else 0.0
        if rate < SLOWEST:
            raise UserError(
                f"{trace.joint} reports its {what} {rate:.3g} times a second, and at least "
                f"{SLOWEST:g} are needed: have "
                f"it report {what} (or current) every 10 ms or faster, as its protocol's README says, "
                "then repeat"
            )
    grid, position, velocity, torque = _resampled(trace)
    if float(np.ptp(position)) < LEAST_TRAVEL or float(np.abs(velocity).max()) < CREEP:
        raise UserError(f"{trace.joint} has moved by {float(np.ptp(position)):.3f} rad: that shows nothing")
    best: tuple[float, Floats, Floats, float] | None = None
    for shift in SHIFTS:
        found = _mechanics(grid, position, velocity, np.interp(grid - shift, grid, torque))
        if best is None or found[0] < best[0]:
            best = (*found, float(shift))
    assert best is not None, "there are shifts"
    _, x, spread, shift = best
    torque = np.interp(grid - shift, grid, torque)
    inertia, friction, damping, load = (
        Value(float(v), float(s)) for v, s in zip(x, np.sqrt(np.diag(spread)), strict=True)
    )
    if inertia.value <= 0.0 or inertia.sigma > 0.3 * inertia.value:
        raise UserError(
            f"{trace.joint}: its inertia is not to be seen ({inertia.value:.2g} ± {inertia.sigma:.2g} "
            "kg·m²): it needs "
            "faster steps, or a longer travel"
        )
    most = float(np.abs(torque).max())
    one = Identified(
        trace.joint, inertia, friction, damping, load, None, None, None, 0.0, 0.0, most, math.nan
    )
    told = np.count_nonzero(~np.isnan(columns(trace.commanded)[1])) if trace.commanded else 0
    return _refined(one, trace, torque_limit) if told > FEWEST else one


def _refined(first: Identified, trace: JointTrace, torque_limit: float) -> Identified:
    """Return what makes the simulated velocity and torque equal the measured ones best, from the best of many
    first guesses; the guess itself, where its loop is none that this describes.

    A device's loop answers each set-point with a pulse, and reports fall upon one phase of it: only what
    makes the same pulses tells how large they are in the mean."""
    from scipy.optimize import least_squares

    times, speeds = columns(trace.velocity)
    at, torques = columns(trace.torque)
    scales = NOISE[0] * float(np.abs(speeds).max()), NOISE[1] * float(np.abs(torques).max())

    def residuals(x: Floats, backlash: float) -> Floats:
        one = _of(first, x, backlash)
        grid, velocity, torque = simulated(one, trace, torque_limit)
        return np.concatenate(
            [
                (np.interp(times, grid, velocity) - speeds) / scales[0],
                (np.interp(at - x[8], grid, torque) - torques) / scales[1],
            ]
        )

    guess = [math.log(max(one.value, 1e-7)) for one in (first.inertia, first.friction, first.damping)]
    steps = np.array([0.02] * 5 + [0.02 * scales[1] / NOISE[1], 0.001, 0.0005, 0.0005])

    def fitted(x: Floats, backlash: float, most: int) -> tuple[float, Floats, Floats]:
        found = least_squares(
            lambda y: residuals(y * steps, backlash),
            np.concatenate([x[:6], np.maximum(x[6:8], 1e-5), x[8:]]) / steps,
            diff_step=DIFFERENCE,
            max_nfev=most,
            loss="soft_l1",
            bounds=([-np.inf] * 6 + [0.0, 0.0, -np.inf], np.inf),
        )
        return float(found.cost), found.x * steps, found.jac / steps

    starts = [
        np.array(
            [
                guess[0] + math.log(share),
                *guess[1:],
                guess[0] + math.log(share * fast),
                0.0,
                first.load.value,
                delay,
                AGAIN[2][0],
                0.0,
            ]
        )
        for share, fast, delay in product(*STARTS)
    ]
    starts = [np.array([*one[:4], one[3] + math.log(ratio), *one[5:]]) for one in starts for ratio in RATIOS]

    def cost(x: Floats) -> float:
        return float(np.sum(np.log1p(residuals(x, 0.0) ** 2)))

    def best_of(starts: list[Floats], most: int) -> Floats:
        tried = (fitted(one, 0.0, most) for one in sorted(starts, key=cost)[:3])
        return min(tried, key=lambda one: one[0])[1]

    x = best_of(starts, 5)
    for _ in range(ROUNDS):
        again = [
            np.array(
                [*sizes, x[3], x[4] if ratio is None else x[3] + math.log(ratio), *x[5:6], delay, lag, late]
            )
            for sizes in (x[:3], guess)
            for ratio, delay, lag, late in product(*AGAIN)
        ]
        x = best_of([x, *again], 8)
        if misfit(_of(first, x, 0.0), trace, torque_limit) < GOOD / 4.0:
            break
    best = (*fitted(x, 0.0, 20), 0.0)
    x = best[1]
    for backlash in BACKLASHES if misfit(_of(first, x, 0.0), trace, torque_limit) > GOOD else ():
        tried = fitted(best[1] if best[3] else x, backlash, 3)
        if tried[0] < WORTH * best[0]:
            best = (*tried, backlash)
    for factor in (0.7, 0.8, 0.9, 1.1, 1.2, 1.3) if best[3] else ():
        tried = fitted(best[1], factor * best[3], 2)
        if tried[0] < best[0]:
            best = (*tried, factor * best[3])
    _, x, jacobian, backlash = best
    left = residuals(x, backlash)
    inverse: Floats = np.asarray(np.linalg.pinv(jacobian.T @ jacobian), dtype=np.float64)
    spread = covariance(jacobian * left[:, None], inverse, TOGETHER)
    sigmas = np.sqrt(np.maximum(np.diag(spread), 0.0))
    sigmas[[0, 3, 4]] = np.hypot(sigmas[[0, 3, 4]], HIDDEN * bandwidth_of(_of(first, x, backlash)))
    one = _of(first, x, backlash, sigmas)
    off = misfit(one, trace, torque_limit)
    return first if off > STRANGE else replace(one, misfit=off)


def _of(first: Identified, x: Floats, backlash: float, sigmas: Floats | None = None) -> Identified:
    """Return the joint with these values: logarithms of inertia, friction, damping, gain and integral;
    load; delay; lag; and by how much a torque is reported later than a velocity."""
    sizes = np.exp(np.clip(x[:5], -20.0, 12.0))
    shares = np.zeros(9) if sigmas is None else sigmas
    inertia, friction, damping, gain, integral = (
        Value(float(v), float(v * s)) for v, s in zip(sizes, shares[:5], strict=True)
    )
    play = Value(backlash, 0.1 * backlash) if backlash else None
    return replace(
        first,
        inertia=inertia,
        friction=friction,
        damping=damping,
        load=Value(float(x[5]), float(shares[5])),
        backlash=play,
        gain=gain,
        integral=integral,
        delay=max(float(x[6]), 0.0),
        lag=max(float(x[7]), 0.0),
    )


def _resampled(trace: JointTrace) -> tuple[Floats, Floats, Floats, Floats]:
    rows = [columns(one) for one in (trace.position, trace.velocity, trace.torque)]
    first, last = max(t[0] for t, _ in rows), min(t[-1] for t, _ in rows)
    if last - first < 1.0:
        raise UserError(f"{trace.joint} was heard for {max(last - first, 0.0):.1f} s: that is too short")
    grid = np.arange(first, last, GRID)
    position, velocity, torque = (np.interp(grid, t, values) for t, values in rows)
    return grid, position, velocity, torque


def _mechanics(
    grid: Floats, position: Floats, velocity: Floats, torque: Floats
) -> tuple[float, Floats, Floats]:
    """Return what is left, inertia, friction, damping and load, and their covariance."""
    creep = max(CREEP, 0.03 * float(np.abs(velocity).max()))
    way = np.clip(velocity / creep, -1.0, 1.0)
    size = round(WINDOW / GRID)
    starts = np.arange(0, len(grid) - size, size // 2)
    ends = starts + size
    moving = np.concatenate([[0.0], np.cumsum(np.abs(velocity) > creep)])
    used = moving[ends] - moving[starts] > 0.5 * size
    starts, ends = starts[used], ends[used]
    if len(starts) < 12:
        raise UserError("it hardly moved: nothing can be identified")
    sums = [np.concatenate([[0.0], np.cumsum(one[:-1] + one[1:]) * GRID / 2.0]) for one in (torque, way)]
    rows = np.column_stack(
        [
            velocity[ends] - velocity[starts],
            sums[1][ends] - sums[1][starts],
            position[ends] - position[starts],
            -(grid[ends] - grid[starts]),
        ]
    )
    return _least_squares(rows, sums[0][ends] - sums[0][starts])


def _least_squares(rows: Floats, values: Floats) -> tuple[float, Floats, Floats]:
    """Return what is left, the factors, and their covariance."""
    inverse: Floats = np.asarray(np.linalg.pinv(rows.T @ rows), dtype=np.float64)
    x = inverse @ rows.T @ values
    left = values - rows @ x
    return float(left @ left), x, covariance(rows * left[:, None], inverse, NEIGHBOURS)


# -- what it would do ----------------------------------------------------------------------------------


def _held(trace: JointTrace, at: Floats) -> Floats:
    """Return the newest set-point at some times."""
    t, values = columns(trace.commanded)
    index = np.searchsorted(t, at, side="right") - 1
    found: Floats = np.where(index >= 0, values[np.maximum(index, 0)], np.nan)
    return found


def simulated(one: Identified, trace: JointTrace, torque_limit: float) -> tuple[Floats, Floats, Floats]:
    """Return times, velocities and torques of the identified joint under the set-points that were sent."""
    assert one.gain is not None, "without its loop nothing is simulated"
    assert one.integral is not None, "without its loop nothing is simulated"
    t, speeds = columns(trace.velocity)
    grid = np.arange(t[0], t[-1], DT)
    steps = one.delay / DT
    share = steps - math.floor(steps)
    early, later = (_held(trace, grid - DT * (math.floor(steps) + one)) for one in (0, 1))
    wanted = ((1.0 - share) * early + share * later).tolist() if share > 1e-6 else early.tolist()
    shaft, gathered = Shaft(one.shaft()), 0.0
    shaft.velocity = float(speeds[0])
    made, given = np.empty(len(grid)), np.empty(len(grid))
    gain, integral = one.gain.value, one.integral.value * DT
    seen, share = shaft.velocity, -math.expm1(-DT / one.lag) if one.lag > 0.0 else 1.0
    for i, goal in enumerate(wanted):
        torque = 0.0
        seen += share * (shaft.velocity - seen)
        if goal == goal:  # a number
            error = goal - seen
            gathered = min(max(gathered + integral * error, -torque_limit), torque_limit)
            torque = min(max(gain * error + gathered, -torque_limit), torque_limit)
        else:
            gathered = 0.0
        made[i], given[i] = seen, torque
        shaft.step(torque)
    return grid, made, given


def misfit(one: Identified, trace: JointTrace, torque_limit: float) -> float:
    """Return how far the simulated velocity is from the measured one, as a share of the fastest."""
    grid, made, _ = simulated(one, trace, torque_limit)
    t, measured = columns(trace.velocity)
    inside = (t >= grid[0]) & (t <= grid[-1])
    off = np.interp(t[inside], grid, made) - measured[inside]
    return float(np.sqrt(np.mean(off**2)) / max(float(np.abs(measured).max()), 1e-9))


def proposed(one: Identified) -> tuple[float, float, float, float]:
    """Return a bandwidth [rad/s], and gains of the device's loop for it: of velocity [N·m·s/rad], its
    integral [N·m/rad], and of position [1/s].

    A loop whose torque is late by T loses T times its bandwidth of phase: a quarter rad is spared, and no
    more than `WIDEST` is asked of gears and frames. The two poles that inertia, gain and integral make are
    equal: the error does not swing. Position is four times slower."""
    bandwidth = min(0.25 / max(one.delay + one.lag, 1e-3), WIDEST)
    damping = max(one.damping.value, 0.0)
    gain = max(one.inertia.value * bandwidth - damping, 0.0)
    return bandwidth, gain, (gain + damping) ** 2 / (4.0 * one.inertia.value), bandwidth / 4.0


def bandwidth_of(one: Identified) -> float:
    """Return the bandwidth [rad/s] of the velocity loop that was identified."""
    assert one.gain is not None, "without its loop it has none"
    return (one.gain.value + max(one.damping.value, 0.0)) / one.inertia.value
