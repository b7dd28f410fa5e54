import math
from dataclasses import fields, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from brain.belief import Pose
from brain.bodies.differential import Differential
from brain.bodies.plane import Twist, arc, moved, seen_from, sinc, wrap
from tests.brain.bodies.kinematics import rolled
from tests.brain.bodies.kinematics import speeds as wheel_speeds

BODY = Differential(
    left="left",
    right="right",
    wheel_radius=0.05,
    wheel_separation=0.22,
    radius=0.24,
    max_linear=0.6,
    max_angular=2.0,
    max_linear_acceleration=1.0,
    max_angular_acceleration=4.0,
)

speeds = st.floats(-20.0, 20.0)
turns = st.floats(-12.0, 12.0)
places = st.builds(Pose, st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.14, 3.14))


@given(speeds, speeds)
def test_forward_undoes_inverse(linear: float, angular: float) -> None:
    assert rolled(BODY, *wheel_speeds(BODY, linear, angular)) == pytest.approx((linear, angular), abs=1e-9)


@given(speeds, speeds)
def test_inverse_undoes_forward(left: float, right: float) -> None:
    assert wheel_speeds(BODY, *rolled(BODY, left, right)) == pytest.approx((left, right), abs=1e-9)


def test_signs() -> None:
    distance, turn = rolled(BODY, 1.0, 2.0)
    assert distance == pytest.approx(0.075)
    assert turn == pytest.approx(0.05 / 0.22)  # the right wheel goes further: to the left
    left, right = wheel_speeds(BODY, 0.0, 1.0)
    assert left == pytest.approx(-2.2)
    assert right == pytest.approx(2.2)


@given(places, st.floats(-5.0, 5.0), turns)
def test_arc_equals_fine_integration(start: Pose, distance: float, turn: float) -> None:
    """Midpoint steps, whose error goes with the square of the step: 2000 of them leave < 1e-5 m."""
    n = 2000
    x, y = start.x, start.y
    for i in range(n):
        heading = start.yaw + turn * (i + 0.5) / n
        x += distance / n * math.cos(heading)
        y += distance / n * math.sin(heading)
    end = arc(start, distance, turn)
    assert (end.x, end.y) == pytest.approx((x, y), abs=1e-5)
    assert math.remainder(end.yaw - start.yaw - turn, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_a_quarter_of_a_circle_is_exact() -> None:
    radius = 1.76 / (math.pi / 2)
    end = arc(Pose(0.0, 0.0, 0.0), 1.76, math.pi / 2)
    assert (end.x, end.y, end.yaw) == pytest.approx((radius, radius, math.pi / 2), abs=1e-15)


@pytest.mark.parametrize(
    ("left", "right", "end"),
    [
        (1.0, 1.0, (1.0, 0.0, 0.0)),
        (-1.0, 1.0, (0.0, 0.0, 2.0)),
        (1.0, 2.0, (1.5 * math.sin(1.0), -1.5 * (math.cos(1.0) - 1.0), 1.0)),
    ],
)
def test_ros2_controllers_agrees(left: float, right: float, end: tuple[float, float, float]) -> None:
    """Wheels of 1 m radius, 1 m apart, turning for 1 s: the figures expected by ros2_controllers
    @94e74de, diff_drive_controller/test/test_odometry.cpp."""
    body = replace(BODY, wheel_radius=1.0, wheel_separation=1.0)
    pose = arc(Pose(0.0, 0.0, 0.0), *rolled(body, left, right))
    assert (pose.x, pose.y, pose.yaw) == pytest.approx(end, abs=1e-12)


@given(places, st.floats(-5.0, 5.0), turns, st.floats(0.0, 1.0))
def test_two_parts_of_an_arc_are_the_arc(start: Pose, distance: float, turn: float, part: float) -> None:
    whole = arc(start, distance, turn)
    middle = arc(start, distance * part, turn * part)
    parts = arc(middle, distance * (1 - part), turn * (1 - part))
    assert (parts.x, parts.y) == pytest.approx((whole.x, whole.y), abs=1e-9)
    assert wrap(parts.yaw - whole.yaw) == pytest.approx(0.0, abs=1e-9)


@given(places, st.floats(-5.0, 5.0), turns)
def test_back_along_the_same_arc(start: Pose, distance: float, turn: float) -> None:
    back = arc(arc(start, distance, turn), -distance, -turn)
    assert (back.x, back.y) == pytest.approx((start.x, start.y), abs=1e-9)


@given(places, places)
def test_what_is_seen_from_a_pose_lies_there(start: Pose, pose: Pose) -> None:
    again = moved(start, seen_from(start, pose))
    assert (again.x, again.y) == pytest.approx((pose.x, pose.y), abs=1e-9)
    assert wrap(again.yaw - pose.yaw) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("half", [1e-4 * (1 + 1e-9), 1e-4 * (1 - 1e-9), -1e-4])
def test_sinc_has_no_seam(half: float) -> None:
    assert sinc(half) == pytest.approx(math.sin(half) / half, abs=1e-15)


@given(st.floats(-100.0, 100.0))
def test_wrap(angle: float) -> None:
    wrapped = wrap(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-12)


def test_wrap_has_one_name_for_backwards() -> None:
    assert wrap(-math.pi) == wrap(math.pi) == wrap(3 * math.pi) == math.pi


@given(st.floats(-5.0, 5.0), st.floats(-20.0, 20.0), st.sampled_from([None, 8.0, 100.0]))
def test_limit_keeps_curvature_and_limits(linear: float, angular: float, fastest: float | None) -> None:
    body = replace(BODY, max_wheel_speed=fastest)
    v, w, _ = body.limit(Twist(linear, angular))
    most = body.top_speeds[0]
    assert abs(v) <= body.max_linear + 1e-12
    assert abs(w) <= body.max_angular + 1e-12
    assert max(abs(speed) for speed in wheel_speeds(body, v, w)) <= most + 1e-9
    assert v * angular == pytest.approx(w * linear, abs=1e-9)
    within = abs(linear) <= body.max_linear and abs(angular) <= body.max_angular
    if within and max(abs(speed) for speed in wheel_speeds(body, linear, angular)) <= most:
        assert (v, w) == (linear, angular)
    else:
        used = [abs(v) / body.max_linear, abs(w) / body.max_angular]
        used += [abs(speed) / most for speed in wheel_speeds(body, v, w)]
        assert max(used) == pytest.approx(1.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_limit_refuses_what_is_not_finite(bad: float) -> None:
    with pytest.raises(ValueError, match="must be finite"):
        BODY.limit(Twist(bad, 0.0))
    with pytest.raises(ValueError, match="must be finite"):
        BODY.limit(Twist(0.0, bad))


@pytest.mark.parametrize(
    "field", [f.name for f in fields(BODY) if f.name not in ("left", "right", "footprint")]
)
@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_every_length_and_limit_is_above_0(field: str, bad: float) -> None:
    with pytest.raises(ValueError, match=f"{field} must be from"):
        replace(BODY, **{field: bad})  # type: ignore[arg-type]  # only numbers are replaced


@pytest.mark.parametrize(("left", "right"), [("a", "a"), ("", "b"), ("a", "")])
def test_two_wheels_are_two_motors(left: str, right: str) -> None:
    with pytest.raises(ValueError, match="left and right must"):
        replace(BODY, left=left, right=right)


SQUARE = ((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1))


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        (SQUARE[:2], "from 3 to 32 corners"),
        (SQUARE * 9, "from 3 to 32 corners"),
        (((0.3, 0.1), *SQUARE[1:]), r"the corner \(0.3, 0.1\) is not within the radius, 0.24 m"),
        (((math.nan, 0.1), *SQUARE[1:]), "is not within the radius"),
        (SQUARE[::-1], "counter-clockwise about the origin"),
        (((0.05, 0.1), (0.15, 0.1), (0.15, -0.1), (0.05, -0.1))[::-1], "about the origin"),
        ((*SQUARE, (0.0, 0.05)), "must be convex"),
        ((*SQUARE, SQUARE[0]), "must be convex"),
    ],
)
def test_a_footprint_is_a_convex_polygon_about_the_origin(
    corners: tuple[tuple[float, float], ...], message: str
) -> None:
    with pytest.raises(ValueError, match=f"footprint.*{message}"):
        replace(BODY, footprint=corners)


def test_the_outline_without_a_footprint_contains_the_circle() -> None:
    round_body, square = BODY, replace(BODY, footprint=SQUARE)
    assert square.outline == SQUARE
    replace(BODY, footprint=round_body.outline, radius=0.25)
    edges = zip(round_body.outline, (*round_body.outline[1:], round_body.outline[0]), strict=True)
    nearest = [math.hypot((ax + bx) / 2.0, (ay + by) / 2.0) for (ax, ay), (bx, by) in edges]
    assert min(nearest) == pytest.approx(BODY.radius)
