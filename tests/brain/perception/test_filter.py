from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from brain.belief import Floats, Pose
from brain.bodies.plane import wrap
from brain.perception.engine import (
    SCALE,
    SIZE,
    YAW,
    Filterpy,
    MoveErrors,
    Packed,
    Structured,
    X,
    matrices,
    relative,
    unpacked,
)  # fmt: skip
from brain.perception.filter import Filter
from brain.perception.filter_inputs import GateResult, GyroRate, Input, Judged, PoseFix, WheelAngle
from brain.perception.filter_settings import CHI_SQUARE, FilterSettings
from brain.perception.fixes import Fixes, FixSettings
from protocols.messages import SECOND, Fix, Nanos, PoseReading, seconds
from tests.brain.bodies.kinematics import speeds
from tests.brain.perception.rolling import BODY, MS, Floor, consistency, roll

NOISE = np.diag([0.02**2, 0.02**2, 0.01**2])
DRIVE = Floor(fixes=200 * MS, rest=400 * MS)


def random(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


def fed(belief: Filter, inputs: list[Input]) -> list[Judged]:
    """One input per call, as a live robot has them."""
    return [judged for item in inputs for judged in belief.observe([item])]


def pose_fix(t: Nanos, x: float, y: float, yaw: float, shared: Floats | None = None) -> PoseFix:
    return PoseFix("lidar", t, np.array([x, y, yaw]), NOISE, shared)


def standing(
    until: Nanos, since: Nanos = 0, rate: float = 0.0, every: Nanos = 10 * MS, gyro: bool = True
) -> list[Input]:
    """Wheels at rest, and a gyro without noise."""
    inputs: list[Input] = []
    for t in range(since, until, every):
        inputs += [GyroRate("imu", t, rate, 0.003)] if gyro else []
        inputs += [WheelAngle("left", t, 0.0), WheelAngle("right", t, 0.0)]
    return inputs


def rested(settings: FilterSettings | None = None) -> Filter:
    belief = Filter(BODY, settings or FilterSettings())
    fed(belief, standing(SECOND))
    return belief


# -- the two engines ---------------------------------------------------------------------------


def hostile(seed: int) -> list[Input]:
    """A drive with position-only, shared, wrong and outlying poses, and a gyro that lies for a while."""
    rng, inputs = random(seed), roll(seed, 3 * SECOND, DRIVE).inputs
    for i, item in enumerate(inputs):
        if isinstance(item, PoseFix):
            kind = rng.integers(4)
            if kind == 0:
                inputs[i] = replace(item, value=item.value[:2], noise=item.noise[:2, :2])
            elif kind == 1:
                root = 0.02 * rng.normal(size=(3, 3))
                inputs[i] = replace(item, shared=root @ root.T)
            elif seconds(item.t) > 1.6:
                inputs[i] = replace(item, value=item.value + np.array([0.5, 0.0, 3.0]))
        elif isinstance(item, GyroRate) and 2.0 < seconds(item.t) < 2.6:
            inputs[i] = replace(item, rate=item.rate + 0.5)
    return inputs


@pytest.mark.parametrize("seed", range(2))
def test_the_engines_agree(seed: int) -> None:
    beliefs = [Filter(BODY, FilterSettings(engine=engine)) for engine in ("structured", "filterpy")]
    ours, theirs = (fed(belief, hostile(seed)) for belief in beliefs)
    assert {judged.result for judged in ours} == {GateResult.ACCEPTED, GateResult.REJECTED, GateResult.FORCED}
    assert [(j.source, j.t, j.result) for j in ours] == [(j.source, j.t, j.result) for j in theirs]
    states = [belief.state for belief in beliefs]
    assert states[0].x == pytest.approx(states[1].x, abs=1e-9), f"seed {seed}"
    assert pytest.approx(states[1].P, abs=1e-9) == states[0].P, f"seed {seed}"


@pytest.mark.parametrize("turning", [1.0, 1e-5, 0.0])
def test_the_jacobian_equals_differences(turning: float) -> None:
    """Of one travel, by the mean that the filter itself computes."""
    moves: list[MoveErrors] = []

    class Engine(Structured):
        def predict(self, packed: Packed, move: MoveErrors) -> Packed:
            moves.append(move)
            return super().predict(packed, move)

    belief = Filter(BODY, FilterSettings())
    belief.observe([*standing(1), GyroRate("imu", 2, 0.0, 0.003)])
    start = replace(belief.state, model=replace(belief.state.model, engine=Engine()), gyro=None)
    samples = ((0, 0.0), (50 * MS, 0.5)), ((0, 0.0), (50 * MS, 0.5 + 0.7 * turning))

    def after(x: Floats) -> Floats:
        state = replace(start, x=tuple(x.tolist()), samples=samples)
        state.travel(50 * MS)
        return np.array(state.x)

    x = np.array([0.3, -0.2, 1.1, 0.02, 0.03, 0.01, -0.02, 0.001])
    numeric = np.column_stack(
        [(after(x + 1e-6 * unit) - after(x - 1e-6 * unit)) / 2e-6 for unit in np.eye(SIZE)]
    )
    after(x)
    assert pytest.approx(numeric, abs=1e-8) == matrices(moves[-1])[0]


@pytest.mark.parametrize("engine", [Structured, Filterpy])
def test_an_update_equals_the_joseph_form(engine: type[Structured] | type[Filterpy]) -> None:
    rng = random(5)
    root = rng.normal(size=(SIZE, SIZE))
    P, x, y = root @ root.T, tuple(rng.normal(size=SIZE)), rng.normal(size=3)
    R = root[:3, :3] @ root[:3, :3].T + np.eye(3)
    H = np.eye(SIZE)[:3]
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    left = np.eye(SIZE) - K @ H
    packed = tuple(P[np.tril_indices(SIZE)].tolist())
    state, covariance, distance = engine().update(x, packed, (0, 1, 2), tuple(y), R)
    assert state == pytest.approx(x + K @ y)
    assert unpacked(covariance) == pytest.approx(left @ P @ left.T + K @ R @ K.T)
    assert distance == pytest.approx(y @ np.linalg.inv(S) @ y)


@pytest.mark.parametrize("confidence", CHI_SQUARE)
def test_the_table_of_chi_square(confidence: float) -> None:
    expected = [stats.chi2.ppf(confidence, freedom) for freedom in (1, 2, 3)]
    assert CHI_SQUARE[confidence] == pytest.approx(expected, abs=1e-6)


# -- order of arrival --------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(2))
def test_the_order_of_arrival_changes_no_bit(seed: int) -> None:
    """Shuffled within the rewind, some inputs twice, several per call: same state, same decisions."""
    inputs, rng = hostile(seed), random(100 + seed)
    in_order, shuffled = Filter(BODY, FilterSettings()), Filter(BODY, FilterSettings())
    fed(in_order, inputs)
    arrival = {id(item): item.t + int(rng.integers(0, 450)) * MS for item in inputs}
    late = sorted(inputs, key=lambda item: arrival[id(item)])
    while late:
        count = int(rng.integers(1, 6))
        shuffled.observe(late[:count] + late[: int(rng.integers(2))])
        late = late[count:]
    assert (shuffled.state.x, shuffled.state.P, shuffled.t) == (
        in_order.state.x, in_order.state.P, in_order.t,
    ), f"seed {seed}"  # fmt: skip
    assert [state.rejected for state in shuffled._states] == [state.rejected for state in in_order._states]


def test_a_copy_continues_as_the_original() -> None:
    inputs = hostile(1)
    one = Filter(BODY, FilterSettings())
    fed(one, inputs[:500])
    other = copy.deepcopy(one)
    assert fed(one, inputs[500:]) == fed(other, inputs[500:])
    assert one.state == other.state


def test_what_is_older_than_the_rewind_is_late_and_changes_nothing() -> None:
    belief = rested()
    before = belief.state
    (judged,) = belief.observe([WheelAngle("left", 300 * MS, 9.0)])
    assert judged.result is GateResult.LATE
    assert belief.state is before


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_never_enters(bad: float) -> None:
    belief = rested()
    before = belief.state
    spoilt: list[Input] = [
        WheelAngle("left", SECOND, bad),
        GyroRate("imu", SECOND, bad, 0.003),
        GyroRate("imu", SECOND, 0.0, bad),
        pose_fix(SECOND, 0.0, 0.0, bad),
        PoseFix("lidar", SECOND, np.zeros(3), np.full((3, 3), bad)),
        PoseFix("lidar", SECOND, np.zeros(3), -NOISE),
    ]
    assert [j.result for j in belief.observe(spoilt)] == [GateResult.NOT_FINITE] * len(spoilt)
    assert belief.state is before


def test_memory_is_bounded() -> None:
    belief = rested()
    for t in range(SECOND, 3 * SECOND, MS // 2):  # too fast, the right wheel silent, poses that wait for it
        belief.observe([GyroRate("imu", t, 0.0, 0.003), WheelAngle("left", t, 1e-9 * t)])
        belief.observe([pose_fix(t, 0.0, 0.0, 0.0)])
    state = belief.state
    assert state.gyro is not None
    counts = [len(each) for each in (belief._items, state.samples[0], state.gyro.samples, state.waiting)]
    assert all(count <= most for count, most in zip(counts, (600, 33, 151, 16), strict=True)), counts
    assert len(belief._reported) < 2000


# -- gyro --------------------------------------------------------------------------------------


def creeping(linear: float, angular: float, until: Nanos) -> list[Input]:
    """A slow motion with a gyro whose bias is 0, after a second of rest."""
    inputs: list[Input] = []
    res = FilterSettings().resolution
    for t in range(0, until, 10 * MS):
        share = min(1.0, seconds(max(0, t - SECOND)))  # it starts within a second
        moving = seconds(max(0, t - SECOND)) - share + 0.5 * share * share
        inputs.append(GyroRate("imu", t, angular * share, 0.003))
        for motor, speed in zip(("left", "right"), speeds(BODY, linear, angular), strict=True):
            inputs.append(WheelAngle(motor, t, math.floor(speed * moving / res) * res))
    return inputs


@pytest.mark.parametrize(("linear", "angular"), [(0.001, 0.0), (0.007, 0.0), (0.0, 0.005), (0.0, -0.02)])
def test_slow_motion_is_motion(linear: float, angular: float) -> None:
    belief = Filter(BODY, FilterSettings())
    fed(belief, creeping(linear, angular, 31 * SECOND))
    assert belief.state.x[X] == pytest.approx(29.5 * linear, abs=1e-3)
    assert belief.state.x[YAW] == pytest.approx(29.5 * angular, rel=0.02, abs=1e-3)
    assert abs(belief.bias) < 3e-4


def test_resting_wheels_teach_the_bias() -> None:
    belief = Filter(BODY, FilterSettings())
    fed(belief, standing(2 * SECOND, rate=0.03))
    assert belief.bias == pytest.approx(0.03, abs=1e-3)
    assert belief.bias_sigma < 5e-4
    assert abs(belief.state.x[YAW]) < 1e-3


def test_a_base_turned_on_its_resting_wheels_teaches_nothing() -> None:
    """By 69 degrees: for longer than the lockout, so the gyro is accepted again, with a bias not known."""
    belief = rested()
    judged = fed(belief, standing(7 * SECOND, since=SECOND, rate=0.2))
    assert GateResult.FORCED in {j.result for j in judged}
    assert abs(belief.bias) < 1e-3
    assert math.sqrt(belief.covariance[YAW, YAW]) > 0.01


def test_a_wheel_that_spins_leaves_the_yaw_in_doubt() -> None:
    """Wheels turn by 1.1 rad in half a second, and the gyro by nothing."""
    belief = rested()
    inputs: list[Input] = []
    for t in range(SECOND, SECOND + SECOND // 2, 10 * MS):
        angle = 10.0 * seconds(t - SECOND)
        inputs += [GyroRate("imu", t, 0.0, 0.003)]
        inputs += [WheelAngle("left", t, 0.0), WheelAngle("right", t, angle)]
    fed(belief, inputs)
    error = belief.state.x[YAW]
    assert error**2 / belief.covariance[YAW, YAW] < 50.0


@pytest.mark.parametrize("every", [2, 10])
def test_a_slow_gyro_is_worth_as_much(every: int) -> None:
    """Of 100 and 20 readings per second: the heading is far better than that of the wheels alone."""
    run = roll(3, 8 * SECOND, Floor(rest=2 * SECOND))
    less = [i for i in run.inputs if not isinstance(i, GyroRate) or i.t % (every * 5 * MS) == 0]
    belief, alone = Filter(BODY, FilterSettings()), Filter(BODY, FilterSettings())
    judged = fed(belief, less)
    fed(alone, [i for i in run.inputs if not isinstance(i, GyroRate)])
    t = belief.t
    assert t is not None
    error = belief.state.x[YAW] - run.truth[t][2]
    assert abs(error) < 0.02
    assert abs(error) < 0.5 * abs(alone.state.x[YAW] - run.truth[t][2])
    assert sum(j.result is GateResult.REJECTED for j in judged) < 0.05 * len(judged)


def test_the_scale_is_not_learnt_from_wheels_and_gyro() -> None:
    belief = Filter(BODY, FilterSettings())
    fed(belief, roll(4, 6 * SECOND, Floor(radius_errors=(0.03, 0.03))).inputs)
    assert belief.scale == 0.0
    assert math.sqrt(belief.covariance[SCALE, SCALE]) >= 0.03


@pytest.mark.parametrize("error", [0.025, -0.025])
def test_the_scale_is_learnt_from_references(error: float) -> None:
    belief = Filter(BODY, FilterSettings())
    fed(belief, roll(4, 12 * SECOND, Floor(radius_errors=(error, error), fixes=500 * MS)).inputs)
    assert belief.scale == pytest.approx(-error, abs=0.01)


def test_scale_slip_and_bias_are_bounded() -> None:
    """Wheels that spin on the spot while references insist."""
    belief = Filter(BODY, FilterSettings())
    for t in range(0, 8 * SECOND, 10 * MS):
        inputs: list[Input] = [WheelAngle(motor, t, 8.0 * seconds(t)) for motor in ("left", "right")]
        inputs.append(GyroRate("imu", t, 0.3, 0.003))
        if t % (100 * MS) == 0:
            inputs.append(pose_fix(t, 0.0, 0.0, 0.0))
        belief.observe(inputs)
        _, _, _, bias, scale, left, right, _ = belief.state.x
        assert max(abs(scale), abs(left), abs(right)) <= 0.1
        assert abs(bias) <= 0.2
    assert np.linalg.eigvalsh(belief.covariance).min() > -1e-12


# -- poses from outside ------------------------------------------------------------------------


def test_a_rejected_pose_changes_nothing() -> None:
    belief = rested()
    before = belief.state
    (judged,) = belief.observe([pose_fix(990 * MS, 1.0, 0.0, 0.0)])
    assert judged.result is GateResult.REJECTED
    assert (belief.state.x, belief.state.P) == (before.x, before.P)


def test_a_vector_is_gated_as_a_vector() -> None:
    """Two components, each just within its own gate, together outside of theirs."""
    settings = FilterSettings(confidence=0.95)
    at = 1.9 * math.hypot(0.02, 0.001)
    one, both = rested(settings), rested(settings)
    assert one.observe([pose_fix(990 * MS, at, 0.0, 0.0)])[0].result is GateResult.ACCEPTED
    assert both.observe([pose_fix(990 * MS, at, at, 1.9 * 0.01)])[0].result is GateResult.REJECTED


def test_no_gate_locks_the_filter_out() -> None:
    """Carried away by 2 m: rejected at first, accepted after the lockout, and then as usual."""
    belief = rested()
    results = []
    for t in range(SECOND, 3 * SECOND, 100 * MS):
        belief.observe(standing(t + 100 * MS, since=t, every=20 * MS))
        results += [
            j.result for j in belief.observe([pose_fix(t + 80 * MS, 2.0, 0.0, 0.0)]) if j.source == "lidar"
        ]
    assert results[:5] == [*[GateResult.REJECTED] * 4, GateResult.FORCED]
    assert results[-5:] == [GateResult.ACCEPTED] * 5
    assert belief.state.x[X] == pytest.approx(2.0, abs=0.02)


def test_a_map_is_no_independent_reference() -> None:
    """A thousand matches against a map that is 10 cm unsure leave the robot 10 cm unsure; without its
    share they would make it sure to a millimetre."""
    shared = np.diag([0.1**2, 0.1**2, 0.05**2])
    for share, low, high in ((shared, 0.0999, 0.102), (None, 0.0, 0.002)):
        belief = rested(FilterSettings(start_sigma=0.2, start_yaw_sigma=0.1))
        for k in range(1000):
            t = SECOND + k * 10 * MS
            belief.observe([WheelAngle("left", t, 0.0), WheelAngle("right", t, 0.0)])
            belief.observe([pose_fix(t, 0.0, 0.0, 0.0, share)])
        assert low <= math.sqrt(belief.covariance[X, X]) < high


@pytest.mark.parametrize("seed", range(10))
def test_the_share_of_a_map_leaves_covariances(seed: int) -> None:
    """Whatever the map claims: what is left is a covariance, and the share is at most the pose's own."""
    rng = random(seed)
    root, other = rng.normal(size=(SIZE, SIZE)), rng.normal(size=(3, 3)) * rng.uniform(0.1, 3.0)
    P = root @ root.T
    left, share = relative(tuple(P[np.tril_indices(SIZE)].tolist()), (0, 1, 2), other @ other.T)
    assert unpacked(left) + share == pytest.approx(P)
    assert np.linalg.eigvalsh(unpacked(left)).min() > -1e-9
    assert np.linalg.eigvalsh(share).min() > -1e-9
    assert np.linalg.eigvalsh(other @ other.T - share[:3, :3]).min() > -1e-9


def test_a_late_pose_is_applied_at_its_own_time() -> None:
    """A fix of 300 ms ago moves the robot that has driven on by as much as it was off then."""
    run = roll(7, 2 * SECOND, Floor(slip=0.0, rest=0))
    belief = Filter(BODY, FilterSettings(start_sigma=0.1))
    fed(belief, run.inputs)
    x, y, _ = run.truth[1700 * MS]
    before = belief.state.x
    (judged,) = belief.observe([PoseFix("gps", 1700 * MS, np.array([x + 0.05, y - 0.02]), np.eye(2) * 1e-6)])
    assert (judged.source, judged.result) == ("gps", GateResult.ACCEPTED)
    assert belief.state.x[0] - before[0] == pytest.approx(0.05, abs=5e-3)
    assert belief.state.x[1] - before[1] == pytest.approx(-0.02, abs=5e-3)


def test_a_reset_keeps_bias_and_scale() -> None:
    belief = Filter(BODY, FilterSettings())
    fed(belief, standing(2 * SECOND, rate=0.03))
    bias, sigma = belief.bias, belief.bias_sigma
    covariance = np.diag([0.1**2, 0.1**2, 0.2**2])
    assert belief.reset(1990 * MS, Pose(3.0, -2.0, 3.0), covariance)
    found = belief.at(1990 * MS)
    assert found is not None
    assert found[0] == Pose(3.0, -2.0, 3.0)
    assert found[1] == pytest.approx(covariance)
    assert (belief.bias, belief.bias_sigma) == (bias, sigma)
    assert not belief.reset(SECOND, Pose(0.0, 0.0, 0.0), covariance)


# -- times -------------------------------------------------------------------------------------


def test_poses_at_other_times() -> None:
    """Between stamps, ahead by the twist, and none beyond what is kept."""
    belief = Filter(BODY, FilterSettings())
    fed(belief, standing(100 * MS, gyro=False))
    left, right = speeds(BODY, 0.4, 0.8)
    start, radius = 90 * MS, 0.5
    for t in range(start, 900 * MS, 30 * MS):
        dt = seconds(t - start)
        belief.observe([WheelAngle("left", t, left * dt), WheelAngle("right", t, right * dt)])
    assert belief.twist == pytest.approx((0.4, 0.8, 0.0))
    assert belief.t == 870 * MS
    times = np.arange(500, 960, 7) * MS
    turns = 0.8 * (times - start) / SECOND
    true = np.column_stack((radius * np.sin(turns), radius * (1.0 - np.cos(turns)), turns))
    poses = belief.poses(times)
    assert poses is not None
    assert poses == pytest.approx(true, abs=1e-4)  # chords of 12 mm
    for t, (x, y, yaw) in zip(times.tolist(), true, strict=True):
        found = belief.at(t)
        assert found is not None
        assert (found[0].x, found[0].y, found[0].yaw) == pytest.approx((x, y, wrap(yaw)), abs=1e-9)
    for t in (200 * MS, 980 * MS):
        assert belief.at(t) is None
        assert belief.poses(np.array([t])) is None


def test_a_correction_leaves_the_motion_without_a_leap() -> None:
    run = roll(8, 2 * SECOND, Floor(rest=0))
    belief = Filter(BODY, FilterSettings(start_sigma=0.1))
    fed(belief, run.inputs)
    times = np.arange(1800, 2001, 5) * MS
    before = belief.poses(times)
    x, y, yaw = run.truth[1900 * MS]
    belief.observe([pose_fix(1900 * MS, x + 0.05, y, yaw)])
    after = belief.poses(times)
    assert before is not None
    assert after is not None
    steps = [np.hypot(*np.diff(poses[:, :2], axis=0).T) for poses in (before, after)]
    assert steps[1] == pytest.approx(steps[0], abs=1e-4)


# -- honesty -----------------------------------------------------------------------------------

EXACT = FilterSettings(
    start_sigma=1e-6,
    start_yaw_sigma=1e-6,
    scale_sigma=1e-4,
    scale_walk=0.0,
    travel_noise=0.0055,
    sideways_noise=0.0,
)
CASES = {
    "wheels and gyro": (Floor(), EXACT),
    "wheels alone": (Floor(gyro=False), EXACT),
    "a fix every 2 s, worn tyres": (
        Floor(fixes=2 * SECOND, radius_errors=(0.028, 0.022)),
        replace(EXACT, scale_sigma=0.03),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_the_covariance_is_honest(case: str) -> None:
    """A sample; the campaign is in tests/prove."""
    floor, settings = CASES[case]
    nees, beliefs = zip(*(consistency(seed, 12 * SECOND, floor, settings) for seed in range(4)), strict=True)
    assert 0.4 < np.mean(nees) < 1.7
    for source in beliefs[0].nis:
        total = sum(belief.nis[source].total for belief in beliefs)
        assert 0.5 < total / sum(belief.nis[source].freedom for belief in beliefs) < 2.0, source


# -- fixes -------------------------------------------------------------------------------------


def test_a_fix_is_metres_east_and_north_of_the_datum() -> None:
    """One arc minute of latitude at 48°: 1853.3 m; of longitude: 1243.7 m (WGS 84)."""
    fixes = Fixes(FixSettings())
    assert fixes.observe(Fix("gps", 1, 48.0, 11.0)).value == pytest.approx([0.0, 0.0])
    fix = fixes.observe(Fix("gps", 2, 48.0 + 1 / 60, 11.0, 500.0, 4.0))
    assert fix.value == pytest.approx([0.0, 1853.3], abs=0.2)
    assert fix.noise == pytest.approx(np.eye(2) * 4.0)
    fix = Fixes(FixSettings(48.0, 11.0)).observe(Fix("gps", 2, 48.0, 11.0 + 1 / 60))
    assert fix.value == pytest.approx([1243.7, 0.1], abs=0.3)
    assert fix.noise == pytest.approx(np.eye(2) * 4.0)


def test_a_pose_reading_with_and_without_yaw() -> None:
    fixes = Fixes(FixSettings())
    assert len(fixes.observe(PoseReading("markers", 1, 1.0, 2.0)).value) == 2
    fix = fixes.observe(PoseReading("markers", 1, 1.0, 2.0, 0.5, 0.01, 0.0))
    assert fix.value.tolist() == [1.0, 2.0, 0.5]
    assert np.diag(fix.noise) == pytest.approx([0.01, 0.01, 1e-8])
