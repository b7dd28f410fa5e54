import copy
import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from brain.belief import Floats, Pose
from brain.bodies.differential import wrap
from brain.perception.ekf import Ekf, Nis
from brain.perception.ekf_settings import CHI_SQUARE, EkfSettings
from brain.perception.measurement import GateResult, Measurement, gyro, gyro_at_rest, pose_fix, wheels
from brain.perception.motion_model import (
    BIAS,
    POSE,
    SIZE,
    SLIP,
    YAW,
    V,
    W,
    X,
    jacobian,
    process_noise,
    propagate,
)
from protocols.messages import MILLISECOND, SECOND, Nanos, seconds

MS = MILLISECOND
WHEEL_NOISE = np.diag([0.01**2, 0.05**2])
POSE_NOISE = np.diag([0.02**2, 0.02**2, 0.01**2])


def random(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


def some_state(rng: np.random.Generator) -> Floats:
    return np.asarray(rng.normal(size=SIZE) * [5.0, 5.0, 2.0, 0.5, 1.0, 0.05, 0.05], dtype=np.float64)


def fed(belief: Ekf, until: Nanos = 1 * SECOND) -> Ekf:
    """A filter that stood still for a while."""
    for t in range(0, until, 10 * MS):
        belief.observe(wheels("left", t, 0.0, 0.0, WHEEL_NOISE))
        belief.observe(gyro("imu", t + 5 * MS, 0.0, 0.01))
    return belief


# -- the model ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("turning", [1.0, 1e-6, 0.0])
def test_jacobian_equals_differences(seed: int, turning: float) -> None:
    state = some_state(random(seed))
    state[W] *= turning
    for dt in (0.005, 0.3):
        numeric = np.empty((SIZE, SIZE))
        for i in range(SIZE):
            h = np.zeros(SIZE)
            h[i] = 1e-6
            difference = propagate(state + h, dt) - propagate(state - h, dt)
            difference[YAW] = wrap(difference[YAW])
            numeric[:, i] = difference / 2e-6
        assert jacobian(state, dt) == pytest.approx(numeric, abs=1e-8), f"seed {seed}"


@pytest.mark.parametrize("seed", range(10))
def test_process_noise_is_a_covariance(seed: int) -> None:
    noise = process_noise(some_state(random(seed)), 0.02, EkfSettings())
    assert (noise == noise.T).all()
    assert np.linalg.eigvalsh(noise).min() > -1e-15, f"seed {seed}"


def test_process_noise_does_not_depend_on_how_time_is_cut() -> None:
    """One step of 50 ms adds what fifty of 1 ms add, at constant speed."""
    settings = EkfSettings()
    state = np.array([1.0, 2.0, 0.5, 0.4, 0.3, 0.01, 0.02])
    once = process_noise(state, 0.05, settings)
    covariance, now = np.zeros((SIZE, SIZE)), state
    for _ in range(50):
        F = jacobian(now, 0.001)
        covariance = F @ covariance @ F.T + process_noise(now, 0.001, settings)
        now = propagate(now, 0.001)
    assert np.sqrt(np.diag(once)) == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.02, abs=1e-9)


def test_standing_still_the_slip_does_not_wander() -> None:
    still = process_noise(np.zeros(SIZE), 1.0, EkfSettings())
    assert still[SLIP, SLIP] == 0.0
    assert still[X, X] > 0.0  # the speeds may


# -- the library -------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_an_update_equals_the_joseph_form(seed: int) -> None:
    rng = random(seed)
    belief = fed(Ekf(EkfSettings()))
    x, P, t = belief.state, belief.covariance, belief.t
    assert t is not None
    measurement = pose_fix("lidar", t, Pose(*(float(n) for n in 0.001 * rng.normal(size=3))), POSE_NOISE)
    H, R = measurement.matrix, measurement.noise
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    left = np.eye(SIZE) - K @ H
    assert belief.observe(measurement) is GateResult.ACCEPTED
    assert belief.state == pytest.approx(x + K @ (measurement.value - H @ x), abs=1e-15), f"seed {seed}"
    assert belief.covariance == pytest.approx(left @ P @ left.T + K @ R @ K.T, abs=1e-15), f"seed {seed}"


def test_the_librarys_mahalanobis_is_not_nought() -> None:
    """filterpy 1.4.5 sent 0.0 always (rlabbe/filterpy#188), and a gate on it never rejected anything."""
    belief = Ekf(EkfSettings(start_sigma=3.0))
    belief.observe(gyro("imu", 0, 0.0, 0.01))
    before = belief.covariance[X, X]
    H = np.eye(SIZE)[[X]]
    distance = belief._update(Measurement("x", 0, np.array([10.0]), H, np.array([[16.0]])))
    assert before == 9.0
    assert distance == pytest.approx(10.0**2 / (9.0 + 16.0))


@pytest.mark.parametrize("confidence", CHI_SQUARE)
def test_the_table_of_chi_square(confidence: float) -> None:
    expected = [stats.chi2.ppf(confidence, dof) for dof in (1, 2, 3)]
    assert CHI_SQUARE[confidence] == pytest.approx(expected, abs=1e-6)


# -- gates -------------------------------------------------------------------------------------


def test_a_rejected_measurement_changes_nothing() -> None:
    belief = fed(Ekf(EkfSettings()))
    x, P, t = belief.state.copy(), belief.covariance.copy(), belief.t
    assert t is not None
    assert belief.observe(gyro("imu", t, 1.0, 0.01)) is GateResult.REJECTED
    assert (belief.state == x).all()
    assert (belief.covariance == P).all()


def test_a_vector_is_gated_as_a_vector() -> None:
    """Two components, each just within its own gate, together outside of theirs."""
    belief = fed(Ekf(EkfSettings(confidence=0.95)))
    assert belief.t is not None
    deviation = np.sqrt(np.diag(belief.covariance)[[V, W]] + np.diag(WHEEL_NOISE))
    value = belief.state[[V, W]] + 1.9 * deviation
    alone = copy.deepcopy(belief)
    v, w = (float(n) for n in value)
    assert (
        alone.observe(wheels("left", belief.t, v, float(belief.state[W]), WHEEL_NOISE)) is GateResult.ACCEPTED
    )
    assert belief.observe(wheels("left", belief.t, v, w, WHEEL_NOISE)) is GateResult.REJECTED


def test_no_gate_locks_the_filter_out() -> None:
    """Something carried the robot 2 m away: rejected at first, believed again after the lockout."""
    belief = fed(Ekf(EkfSettings(lockout=SECOND)))
    results: list[GateResult] = []
    for i in range(40):
        t = 1 * SECOND + 100 * i * MS
        belief.observe(wheels("left", t, 0.0, 0.0, WHEEL_NOISE))
        results.append(belief.observe(pose_fix("lidar", t, Pose(2.0, 0.0, 0.0), POSE_NOISE)))
    assert results[:10] == [GateResult.REJECTED] * 10
    assert GateResult.FORCED in results[10:12]
    assert results[-5:] == [GateResult.ACCEPTED] * 5
    assert belief.state[X] == pytest.approx(2.0, abs=0.02)


def test_how_long_a_sensor_has_been_rejected() -> None:
    belief = fed(Ekf(EkfSettings()))
    assert belief.rejected_for("lidar", SECOND) == 0.0
    belief.observe(pose_fix("lidar", 1000 * MS, Pose(2.0, 0.0, 0.0), POSE_NOISE))
    assert belief.rejected_for("lidar", 1250 * MS) == pytest.approx(0.25)
    belief.observe(pose_fix("lidar", 1050 * MS, Pose(0.0, 0.0, 0.0), POSE_NOISE))
    assert belief.rejected_for("lidar", 1250 * MS) == 0.0


def test_being_believed_once_ends_the_lockouts_count() -> None:
    belief = fed(Ekf(EkfSettings(lockout=SECOND)))
    results = []
    for i in range(30):  # every fifth is good
        pose = Pose(0.0 if i % 5 == 4 else 2.0, 0.0, 0.0)
        results.append(belief.observe(pose_fix("lidar", 1 * SECOND + 100 * i * MS, pose, POSE_NOISE)))
    assert GateResult.FORCED not in results
    assert results.count(GateResult.ACCEPTED) == 6


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    "spoilt",
    [
        lambda bad, t: gyro("imu", t, bad, 0.01),
        lambda bad, t: gyro("imu", t, 0.0, bad),
        lambda bad, t: wheels("left", t, 0.0, bad, WHEEL_NOISE),
        lambda bad, t: pose_fix("lidar", t, Pose(0.0, 0.0, bad), POSE_NOISE),
    ],
)
def test_nan_never_enters(bad: float, spoilt: Callable[[float, Nanos], Measurement]) -> None:
    belief = fed(Ekf(EkfSettings()))
    assert belief.t is not None
    x = belief.state.copy()
    assert belief.observe(spoilt(bad, belief.t + MS)) is GateResult.NOT_FINITE
    assert (belief.state == x).all()
    assert belief.observe(gyro("imu", belief.t + 2 * MS, 0.0, 0.01)) is GateResult.ACCEPTED


# -- time --------------------------------------------------------------------------------------


def a_drive(seed: int) -> list[Measurement]:
    """Two seconds of a straight drive into a turn, as three sensors see it."""
    rng = random(seed)
    sent: list[Measurement] = []
    for t in range(0, 2 * SECOND, 5 * MS):
        v, w = min(0.5, seconds(t)), 0.4 * max(0.0, seconds(t) - 1.0)
        if t % (10 * MS) == 0:
            sent.append(wheels("left", t, v, w + 0.02 * rng.normal(), WHEEL_NOISE))
        sent.append(gyro("imu", t + 1 * MS, w + 0.01 + 0.01 * rng.normal(), 0.01))
    return sent


@pytest.mark.parametrize("seed", range(3))
def test_late_measurements_are_put_in_their_place(seed: int) -> None:
    """In any order of arrival within the rewind the filter comes to the same belief."""
    sent = a_drive(seed)
    in_order, shuffled = Ekf(EkfSettings()), Ekf(EkfSettings())
    for measurement in sent:
        in_order.observe(measurement)
    rng = random(100 + seed)
    late = {id(m): m.t + int(rng.integers(0, 100)) * MS for m in sent[1:]}
    for measurement in [sent[0], *sorted(sent[1:], key=lambda m: late[id(m)])]:
        assert shuffled.observe(measurement) is GateResult.ACCEPTED
    assert shuffled.t == in_order.t
    assert shuffled.state == pytest.approx(in_order.state, abs=1e-12), f"seed {seed}"
    assert shuffled.covariance == pytest.approx(in_order.covariance, abs=1e-12), f"seed {seed}"


def test_a_late_measurement_keeps_old_results() -> None:
    belief, without = fed(Ekf(EkfSettings())), fed(Ekf(EkfSettings()))
    for one in (belief, without):
        assert one.observe(gyro("imu", 1010 * MS, 5.0, 0.01)) is GateResult.REJECTED
        one.observe(gyro("imu", 1020 * MS, 0.0, 0.01))
    belief.observe(wheels("left", 1015 * MS, 0.0, 0.0, WHEEL_NOISE))
    assert belief.t == without.t == 1020 * MS
    assert abs(belief.state[W]) < 0.01  # what was rejected stays rejected


def test_a_measurement_that_is_too_late_is_rejected() -> None:
    belief = fed(Ekf(EkfSettings()))
    x = belief.state.copy()
    assert belief.observe(gyro("imu", 300 * MS, 0.0, 0.01)) is GateResult.LATE
    assert (belief.state == x).all()


def test_history_is_bounded() -> None:
    belief = fed(Ekf(EkfSettings()), 5 * SECOND)
    assert len(belief._history) <= 2 * 51 + 1


def test_a_widened_measurement_is_repeated_alike() -> None:
    """A report that comes after a forced one, late: the same belief as if it had come in time."""
    late, ordered = fed(Ekf(EkfSettings(lockout=SECOND))), fed(Ekf(EkfSettings(lockout=SECOND)))
    jump = pose_fix("lidar", 2000 * MS, Pose(1.0, 0.0, 0.0), POSE_NOISE)
    extra = wheels("left", 1995 * MS, 0.0, 0.0, WHEEL_NOISE)
    for one in (late, ordered):
        for t in range(1000 * MS, 2000 * MS, 10 * MS):
            one.observe(wheels("left", t, 0.0, 0.0, WHEEL_NOISE))
            if t % (100 * MS) == 0:
                assert one.observe(replace(jump, t=t)) is GateResult.REJECTED
    assert [late.observe(sent) for sent in (jump, extra)] == [GateResult.FORCED, GateResult.ACCEPTED]
    assert [ordered.observe(sent) for sent in (extra, jump)] == [GateResult.ACCEPTED, GateResult.FORCED]
    assert late.state[X] > 0.5
    assert late.state == pytest.approx(ordered.state, abs=0.02)


def test_a_past_state_can_be_asked_for() -> None:
    belief = Ekf(EkfSettings())
    for t in range(0, 1 * SECOND, 10 * MS):
        belief.observe(wheels("left", t, 0.5, 0.0, WHEEL_NOISE))
    now, then = belief.at(990 * MS), belief.at(890 * MS)
    assert now is not None
    assert then is not None
    assert (now[0] == belief.state).all()
    assert now[0][X] - then[0][X] == pytest.approx(0.05, abs=1e-3)
    ahead = belief.at(1090 * MS)
    assert ahead is not None
    assert ahead[0][X] - now[0][X] == pytest.approx(0.05, abs=1e-3)
    assert ahead[1][X, X] > now[1][X, X]
    assert belief.at(0) is None


# -- what it believes --------------------------------------------------------------------------


def test_yaw_wraps() -> None:
    belief = Ekf(EkfSettings(start_yaw=3.1))
    for i in range(300):
        belief.observe(wheels("left", i * 10 * MS, 0.0, 1.0, np.diag([1e-4, 1e-6])))
        assert -math.pi < belief.state[YAW] <= math.pi
    assert belief.state[YAW] == pytest.approx(wrap(3.1 + 2.99), abs=0.03)
    assert belief.t is not None
    pose = Pose(float(belief.state[X]), 0.0, wrap(float(belief.state[YAW])))
    assert belief.observe(pose_fix("lidar", belief.t, pose, POSE_NOISE)) is GateResult.ACCEPTED


def test_a_heading_across_the_seam_is_no_contradiction() -> None:
    belief = fed(Ekf(EkfSettings(start_yaw=math.pi - 0.001)))
    assert belief.t is not None
    sent = pose_fix("lidar", belief.t, Pose(0.0, 0.0, -math.pi + 0.001), POSE_NOISE)
    assert belief.observe(sent) is GateResult.ACCEPTED
    assert abs(belief.state[YAW]) > 3.13


def test_wheels_and_gyro_alone_leave_the_slip_alone() -> None:
    belief = Ekf(EkfSettings())
    for measurement in a_drive(1):
        belief.observe(measurement)
    assert belief.state[SLIP] == 0.0
    assert belief.covariance[SLIP, SLIP] >= EkfSettings().slip_sigma ** 2


def test_a_gyro_at_rest_tells_its_bias() -> None:
    belief = Ekf(EkfSettings())
    rng = random(3)
    for i in range(200):
        belief.observe(gyro_at_rest("imu", i * 5 * MS, 0.02 + 0.01 * rng.normal(), 0.01))
    assert belief.state[BIAS] == pytest.approx(0.02, abs=0.002)
    assert math.sqrt(belief.covariance[BIAS, BIAS]) == pytest.approx(0.01 / math.sqrt(200), rel=0.05)
    assert belief.state[W] == 0.0


def test_resting_wheels_tell_the_gyros_bias() -> None:
    belief = Ekf(EkfSettings())
    rng = random(3)
    for i in range(2000):
        belief.observe(wheels("left", i * 10 * MS, 0.0, 0.0, np.diag([1e-6, 1e-6])))
        belief.observe(gyro("imu", i * 10 * MS + MS, 0.02 + 0.01 * rng.normal(), 0.01))
    assert belief.state[BIAS] == pytest.approx(0.02, abs=0.003)


@pytest.mark.parametrize("seed", range(3))
def test_the_covariance_stays_one(seed: int) -> None:
    belief = Ekf(EkfSettings())
    rng = random(seed)
    for i in range(2000):
        t = i * 5 * MS
        kind = rng.integers(0, 10)
        if kind == 0:
            pose = Pose(*(float(n) for n in belief.state[POSE] + 0.01 * rng.normal(size=3)))
            belief.observe(pose_fix("lidar", t, pose, np.eye(3) * 1e-12))
        elif kind < 5:
            belief.observe(gyro("imu", t, float(rng.normal()), 1e-5))
        else:
            belief.observe(wheels("left", t, float(rng.normal()), float(rng.normal()), np.eye(2) * 1e-10))
        covariance = belief.covariance
        assert np.isfinite(covariance).all(), f"seed {seed}"
        assert (covariance == covariance.T).all(), f"seed {seed}"
        assert np.linalg.eigvalsh(covariance).min() > -1e-12, f"seed {seed}"


# -- statistics --------------------------------------------------------------------------------

MODEL = EkfSettings(
    start_sigma=0.02, linear_noise=0.2, angular_noise=0.3, bias_noise=1e-3, slip_noise=2e-3, confidence=0.999
)


def simulated(rng: np.random.Generator, runs: int = 30) -> tuple[Floats, Floats]:
    """Robots that move by the model, sensors as noisy as assumed: NEES of each run at 8 times
    (runs × 8), and NIS over degrees of freedom of every measurement, by sensor (3 × number)."""
    nees = np.empty((runs, 8))
    nis: dict[int, list[float]] = {1: [], 2: [], 3: []}
    sigmas = np.array([0.02] * 3 + [1.0, 1.0, MODEL.bias_sigma, MODEL.slip_sigma])
    for run in range(runs):
        truth = sigmas * rng.normal(size=SIZE)
        belief = Ekf(MODEL)
        belief.observe(wheels("left", 0, *_pair(truth[[V, W]], rng), WHEEL_NOISE))
        for step in range(1, 161):
            t = step * 50 * MS
            for _ in range(5):
                values, vectors = np.linalg.eigh(process_noise(truth, 0.01, MODEL))
                shake = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=SIZE))
                truth = propagate(truth, 0.01) + shake
            sent = wheels("left", t, *_pair(truth[[V, W]], rng), WHEEL_NOISE)
            if step % 10 == 0:
                sent = pose_fix("lidar", t, Pose(*_noisy(truth[POSE], POSE_NOISE, rng)), POSE_NOISE)
            elif step % 2:
                sent = gyro("imu", t, float(truth[W] + truth[BIAS] + 0.01 * rng.normal()), 0.01)
            nis[len(sent.value)].append(_nis(belief, sent))
            belief.observe(sent)
            if step % 20 == 0:
                error = belief.state - truth
                error[YAW] = wrap(float(error[YAW]))
                nees[run, step // 20 - 1] = error @ np.linalg.solve(belief.covariance, error)
    means = [np.mean(nis[m]) / m for m in (1, 2, 3)]
    return nees, np.array([means, [len(nis[m]) for m in (1, 2, 3)]])


def _pair(value: Floats, rng: np.random.Generator) -> tuple[float, float]:
    v, w = _noisy(value, WHEEL_NOISE, rng)
    return v, w


def _noisy(value: Floats, covariance: Floats, rng: np.random.Generator) -> list[float]:
    noisy: list[float] = (value + np.sqrt(np.diag(covariance)) * rng.normal(size=len(value))).tolist()
    return noisy


def _nis(belief: Ekf, sent: Measurement) -> float:
    state = belief.at(sent.t)
    assert state is not None
    away = sent.value - sent.matrix @ state[0]
    if sent.heading is not None:
        away[sent.heading] = wrap(float(away[sent.heading]))
    S = sent.matrix @ state[1] @ sent.matrix.T + sent.noise
    return float(away @ np.linalg.solve(S, away))


def test_the_filter_is_as_sure_as_it_may_be() -> None:
    """Monte Carlo: mean NEES over 30 runs, and mean NIS, within the bounds of chi-square (99.9 %)."""
    nees, (nis, numbers) = simulated(random(2026))
    runs = len(nees)
    low, high = stats.chi2.ppf([0.0005, 0.9995], SIZE * runs) / runs
    assert ((nees.mean(axis=0) > low) & (nees.mean(axis=0) < high)).all(), nees.mean(axis=0)
    for dof, mean, number in zip((1, 2, 3), nis, numbers, strict=True):
        low, high = stats.chi2.ppf([0.0005, 0.9995], dof * number) / (dof * number)
        assert low < mean < high, f"NIS/dof {mean} of {number} measurements of {dof} degrees of freedom"


def test_a_filter_that_is_too_sure_is_caught() -> None:
    """The same statistics do refuse a filter that knows a tenth of the noise: they can fail."""
    nees, _ = simulated(random(7), runs=4)
    assert (nees * 100.0).mean() > stats.chi2.ppf(0.9995, SIZE * 4) / 4


def driven(reported: float, really: float, seed: int, readings: int = 2000) -> Ekf:
    """A base that turns at random, whose gyro has a noise of `really`, assumed as `reported` [rad/s]."""
    rng = random(seed)
    settings = EkfSettings(start_sigma=1e-6, bias_sigma=1e-9, bias_noise=0.0, angular_noise=0.5)
    ekf = Ekf(settings)
    rate = float(rng.normal(0.0, 1.0))
    for step in range(1, readings + 1):
        rate += float(rng.normal(0.0, 0.5 * np.sqrt(0.01)))
        ekf.observe(gyro("imu", 10 * step * MS, rate + float(rng.normal(0.0, really)), reported))
    return ekf


@pytest.mark.parametrize("seed", range(3))
def test_right_covariances_give_a_nis_of_one(seed: int) -> None:
    nis = driven(0.05, 0.05, seed).nis["imu"]
    assert nis.count == nis.freedom == 2000
    # chi-square of 2000 degrees of freedom over 2000: 1 ± 0.032; three sigma, and the first readings
    assert 0.9 < nis.mean < 1.1
    assert 0.03 < nis.beyond / nis.count < 0.07


def test_nis_shows_assumed_noise_that_is_too_small_or_too_large() -> None:
    nis = driven(0.01, 0.05, 1).nis["imu"]
    assert nis.mean > 1.5
    assert nis.beyond / nis.count > 0.1
    assert driven(0.5, 0.05, 1).nis["imu"].mean < 0.5


def test_nis_counts_a_rejected_measurement_and_a_late_one_once() -> None:
    ekf = Ekf(EkfSettings())
    for step in range(1, 11):
        ekf.observe(gyro("imu", 100 * step * MS, 0.0, 0.01))
    assert ekf.observe(gyro("imu", 1010 * MS, 50.0, 0.01)) is GateResult.REJECTED
    before = copy.deepcopy(ekf.nis)
    assert Nis().mean == 0.0
    assert before["imu"].count == 11
    assert before["imu"].mean > 1000
    # inserted before the later ones, which are applied again but not gated again
    assert ekf.observe(wheels("left", 950 * MS, 0.0, 0.0, np.eye(2) * 1e-2)) is GateResult.ACCEPTED
    assert ekf.nis["imu"] == before["imu"]
    assert (ekf.nis["left"].count, ekf.nis["left"].freedom) == (1, 2)
    assert ekf.observe(gyro("imu", 1, 0.0, 0.01)) is not GateResult.ACCEPTED
    assert ekf.nis["imu"] == before["imu"]


def test_only_the_filter_itself_loads_the_library() -> None:
    """Importing it takes seconds: `gateway --help` must not pay for it."""
    code = "import sys, brain.perception.perception; sys.exit('filterpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
