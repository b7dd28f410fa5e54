"""The joint: which commands it gives, at which shaft, and which faults it latches."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Literal, TypeAlias

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gateway.core.faults import ARMED_AGAINST_IDLE, DISARMED_ITSELF, FEEDBACK_LOST, STILL_ARMED
from gateway.core.joint import Joint, JointSettings
from gateway.core.limits import Limits
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Mode, Nanos
from protocols.plugin import FeedbackKind, Range, Spec, Watchdog

Action: TypeAlias = Literal["idle", "hold", "brake"]
MS = MILLISECOND
STEP = 5 * MS


def spec(*commands: type[Command], feedback: FeedbackKind = FeedbackKind.CYCLIC) -> Spec:
    return Spec(
        bus="can",
        kind="motor",
        sends=(),
        expects=(),
        read_only=lambda _frame: False,
        feedback=feedback,
        feedback_period=10 * MS,
        offline_after=100 * MS,
        commands=frozenset(
            commands or (msg.Idle, msg.Hold, msg.Position, msg.Velocity, msg.Torque, msg.Impedance)
        ),
        requests=frozenset(),
        ranges={"Velocity.velocity": Range(-1e6, 1e6, 1e-3)},
        watchdog=Watchdog(None, enabled=False),
        holds_unattended=True,
        stop_clears_faults=False,
    )


def joint(
    *,
    gear: float = 1.0,
    sign: Literal[1, -1] = 1,
    position: tuple[float, float] | None = None,
    stop_action: Action = "idle",
    on_command_timeout: Literal["idle", "hold"] = "idle",
    feedback_timeout: Nanos = 100 * MS,
) -> Joint:
    limits = Limits(velocity=10.0, acceleration=50.0, torque=2.0, position=position)
    settings = JointSettings(
        limits, gear, sign, on_command_timeout, stop_action, feedback_timeout=feedback_timeout
    )
    return Joint("m", settings, spec())


def armed(made: Joint, position: float = 0.0, velocity: float = 0.0, t: Nanos = 0) -> Joint:
    """Give feedback and ARMED."""
    ratio = made.settings.gear * made.settings.sign
    made.on_event(msg.Feedback("m", t, position * ratio, velocity * ratio))
    made.on_event(msg.State("m", t, Mode.ARMED))
    return made


def obeyed(made: Joint, command: Command) -> msg.Feedback:
    """Return the feedback of a device that has obeyed a command for a step."""
    ratio, before = made.settings.gear * made.settings.sign, made.feedback
    match command:
        case msg.Velocity(_, velocity):
            position = (before.position or 0.0) + velocity / ratio * STEP / SECOND
            return msg.Feedback("m", 0, position, velocity / ratio)
        case msg.Position(_, position):
            speed = (position / ratio - (before.position or 0.0)) / (STEP / SECOND)
            return msg.Feedback("m", 0, position / ratio, speed)
    return before


def drive(
    made: Joint, command: Command, steps: int, plant: Callable[[Command], msg.Feedback] | None = None
) -> list[Command]:
    """Repeat a command for some steps, with feedback at each; return the device's commands.

    Without a plant, the shaft is where the last command wants it."""
    out: list[Command] = []
    for i in range(1, steps + 1):
        now: Nanos = i * STEP
        fed = plant(out[-1]) if plant and out else obeyed(made, out[-1]) if out else made.feedback
        ratio = made.settings.gear * made.settings.sign
        made.on_event(msg.Feedback("m", now, (fed.position or 0.0) * ratio, (fed.velocity or 0.0) * ratio))
        out.append(made.command(now, command, stopped=False))
    return out


def test_the_device_turns_gear_times_as_far_and_reversed_by_the_sign() -> None:
    made = armed(joint(gear=8.0, sign=-1), position=1.0)
    received = made.on_event(msg.Feedback("m", 0, position=-16.0, velocity=-8.0, torque=-0.25))
    assert received == msg.Feedback("m", 0, position=2.0, velocity=1.0, torque=2.0)
    out = drive(made, msg.Torque("m", 1.6), 30)[-1]
    assert isinstance(out, msg.Torque)
    assert out.torque == pytest.approx(-0.2)


@given(gear=st.floats(0.1, 200.0), sign=st.sampled_from([1, -1]), torque=st.floats(-0.5, 0.5))
def test_power_is_the_same_on_both_sides_of_the_gear(
    gear: float, sign: Literal[1, -1], torque: float
) -> None:
    made = armed(joint(gear=gear, sign=sign))
    out = made.command(STEP, msg.Impedance("m", 0.5, 3.0, torque, 2.0, 0.1), stopped=False)
    assert isinstance(out, msg.Impedance)
    assert out.torque * out.velocity == pytest.approx(torque * 3.0)
    # the spring at the device's shaft feels as stiff at the joint's
    assert out.stiffness * (gear * gear) == pytest.approx(2.0)


def test_nothing_but_idle_before_the_first_feedback() -> None:
    made = joint()
    assert made.command(STEP, msg.Velocity("m", 1.0), stopped=False) == msg.Idle("m")
    assert not made.owned
    assert not made.faults


def test_velocity_is_reached_within_the_limit_of_acceleration_and_not_exceeded() -> None:
    out = drive(armed(joint()), msg.Velocity("m", 1e9), 200)
    speeds = [c.velocity for c in out if isinstance(c, msg.Velocity)]
    assert len(speeds) == 200
    assert max(b - a for a, b in pairwise([0.0, *speeds])) <= 50.0 * 0.005 + 1e-9
    assert speeds == sorted(speeds)
    assert speeds[24] == pytest.approx(25 * 50.0 * 0.005)
    assert speeds[60] > 0.95 * 10.0
    assert speeds[-1] == 10.0


def test_the_first_velocity_is_near_the_measured_one() -> None:
    (out,) = drive(armed(joint(), velocity=-4.0), msg.Velocity("m", 9.0), 1)
    assert isinstance(out, msg.Velocity)
    assert out.velocity == pytest.approx(-4.0 + 50.0 * 0.005)


def test_an_unarmed_joint_does_not_wind_up_its_profile() -> None:
    made = joint()
    made.on_event(msg.Feedback("m", 0, 0.0, 0.0))
    made.on_event(msg.State("m", 0, Mode.READY))
    out = drive(made, msg.Velocity("m", 10.0), 50, lambda _: made.feedback)
    assert out[-1] == out[0] == msg.Velocity("m", 50.0 * 0.005)


def test_position_starts_at_the_measured_one_and_arrives_within_the_limits() -> None:
    made = armed(joint(), position=3.0)
    out = [c for c in drive(made, msg.Position("m", -2.0), 400) if isinstance(c, msg.Position)]
    places = [3.0, *(c.position for c in out)]
    assert abs(places[1] - 3.0) <= 50.0 * 0.005**2 + 1e-12
    speeds = [(b - a) / 0.005 for a, b in pairwise(places)]
    assert max(abs(s) for s in speeds) <= 10.0 + 1e-9
    assert max(abs(b - a) for a, b in pairwise([0.0, *speeds])) <= 50.0 * 0.005 * 2 + 1e-6
    assert places[-1] == pytest.approx(-2.0, abs=1e-9)
    assert min(places) >= -2.0 - 1e-6  # no overshoot


@given(st.floats(-5.0, 5.0), st.floats(-50.0, 50.0))
def test_a_position_outside_the_range_is_never_commanded(start: float, wanted: float) -> None:
    made = armed(joint(position=(-1.0, 2.0)), position=max(-1.0, min(2.0, start)))
    for out in drive(made, msg.Position("m", wanted), 300):
        assert isinstance(out, msg.Position)
        assert -1.0 <= out.position <= 2.0


def test_a_velocity_towards_the_end_of_travel_brakes_before_it_and_stops_at_it() -> None:
    made = armed(joint(position=(-1.0, 1.0)))
    place = 0.0

    def plant(last: Command) -> msg.Feedback:
        nonlocal place
        assert isinstance(last, msg.Velocity)
        place += last.velocity * 0.005
        return msg.Feedback("m", 0, place, last.velocity)

    out = drive(made, msg.Velocity("m", 10.0), 300, plant)
    assert place <= 1.02
    assert isinstance(out[-1], msg.Velocity)
    assert abs(out[-1].velocity) < 0.2


def test_torque_is_clamped_and_not_given_beyond_the_speed_limit_or_the_end_of_travel() -> None:
    made = armed(joint(position=(-1.0, 1.0)))
    grown = [c.torque for c in drive(made, msg.Torque("m", 99.0), 30) if isinstance(c, msg.Torque)]
    assert max(b - a for a, b in pairwise(grown)) <= 0.1 + 1e-9  # to the limit in 0.1 s
    assert grown[-1] == 2.0
    now = 31 * STEP
    made.on_event(msg.Feedback("m", now, 0.5, 12.0))
    assert made.command(now, msg.Torque("m", 1.0), stopped=False) == msg.Torque("m", 0.0)
    assert made.command(now, msg.Torque("m", -1.0), stopped=False) == msg.Torque("m", -1.0)
    made.on_event(msg.Feedback("m", now + STEP, 1.05, 0.0))
    assert made.command(now + STEP, msg.Torque("m", 1.0), stopped=False) == msg.Torque("m", 0.0)


def test_a_light_shaft_is_given_less_torque_before_it_is_too_fast() -> None:
    """It gathers 200 rad/s² per N·m, and reports every 10 ms what was true 5 ms ago; the limit is 10."""
    made, speed, position, torque, reported = armed(joint()), 0.0, 0.0, 0.0, (0.0, 0.0)
    for step in range(1, 200):
        if step % 2 == 0:
            made.on_event(msg.Feedback("m", step * STEP, *reported))
        reported = position, speed
        out = made.command(step * STEP, msg.Torque("m", 2.0), stopped=False)
        speed += 200.0 * torque * STEP / SECOND
        position += speed * STEP / SECOND
        torque = out.torque if isinstance(out, msg.Torque) else 0.0
        assert speed <= 1.02 * 10.0
    assert speed > 0.9 * 10.0


@pytest.mark.parametrize(
    "command", [msg.Position("m", 1.0), msg.Velocity("m", 1.0), msg.Torque("m", 0.1)], ids=repr
)
def test_nothing_moves_where_the_position_must_be_known_and_is_not(command: Command) -> None:
    made = joint(position=(-1.0, 2.0))
    made.on_event(msg.Feedback("m", 0, velocity=0.0))
    made.on_event(msg.State("m", 0, Mode.ARMED))
    assert made.command(STEP, command, stopped=False) == msg.Idle("m")
    made.on_event(msg.Feedback("m", STEP, position=0.5))
    assert made.command(2 * STEP, command, stopped=False) != msg.Idle("m")


BAD = [math.nan, math.inf, -math.inf]


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize(
    "make",
    [
        lambda x: msg.Position("m", x),
        lambda x: msg.Position("m", 0.0, x),
        lambda x: msg.Position("m", 0.0, 0.0, x),
        lambda x: msg.Velocity("m", x),
        lambda x: msg.Velocity("m", 0.0, x),
        lambda x: msg.Torque("m", x),
        lambda x: msg.Impedance("m", 0.0, 0.0, 0.0, x, 0.0),
        lambda x: msg.Impedance("m", 0.0, 0.0, 0.0, 0.0, x),
    ],
)
def test_a_value_that_is_not_finite_is_refused(make: Callable[[float], Command], bad: float) -> None:
    made = armed(joint())
    assert made.command(STEP, make(bad), stopped=False) == msg.Idle("m")
    assert "not finite" in made.refused


@pytest.mark.parametrize("bad", BAD)
def test_feedback_that_is_not_finite_is_dropped(bad: float) -> None:
    made = armed(joint(), position=1.0)
    assert made.on_event(msg.Feedback("m", 7, position=bad)) is None
    assert made.on_event(msg.Feedback("m", 7, velocity=0.0, torque=bad)) is None
    assert made.feedback.position == 1.0


def test_a_command_that_the_device_cannot_do_is_refused_by_name() -> None:
    made = Joint("m", JointSettings(Limits(1.0, 1.0, 1.0)), spec(msg.Idle, msg.Velocity))
    armed(made)
    assert made.command(STEP, msg.Torque("m", 0.5), stopped=False) == msg.Idle("m")
    assert made.refused == "Torque is not among what m can do: Idle, Velocity"


@pytest.mark.parametrize("on_command_timeout", ["idle", "hold"])
def test_the_command_timeout_has_the_action_of_the_file(on_command_timeout: Literal["idle", "hold"]) -> None:
    made = armed(joint(on_command_timeout=on_command_timeout))
    made.command(STEP, msg.Velocity("m", 1.0), stopped=False)
    made.on_event(msg.Feedback("m", 100 * MS, 0.0, 0.0))
    assert isinstance(made.command(100 * MS, None, stopped=False), msg.Velocity)
    made.on_event(msg.Feedback("m", 110 * MS, 0.0, 0.0))
    out = made.command(110 * MS, None, stopped=False)
    assert out == (msg.Hold("m") if on_command_timeout == "hold" else msg.Idle("m"))


@pytest.mark.parametrize("acceleration", [0.5, 1e-300])
def test_braking_takes_two_seconds_at_most_whatever_the_limits_are(acceleration: float) -> None:
    limits = Limits(velocity=10.0, acceleration=acceleration, torque=2.0)
    made = armed(Joint("m", JointSettings(limits, stop_action="brake"), spec()), velocity=5.0)
    made.command(STEP, msg.Velocity("m", 5.0), stopped=False)
    assert made.braking_time == 2 * SECOND
    for now in range(2 * STEP, 2100 * MS, STEP):
        made.on_event(msg.Feedback("m", now, 5.0 * now / SECOND, 5.0))
        out = made.command(now, None, stopped=True)
    assert out == msg.Idle("m")


def test_a_stop_brakes_with_the_robot_files_acceleration_not_with_one_that_was_set() -> None:
    made = armed(joint(stop_action="brake"), velocity=5.0)
    assert made.change("acceleration", 2.5) == ""
    made.command(STEP, msg.Velocity("m", 5.0), stopped=False)
    armed(made, velocity=5.0, t=STEP + 1)
    first, second = (made.command(step * STEP, None, stopped=True) for step in (2, 3))
    assert isinstance(first, msg.Velocity)
    assert isinstance(second, msg.Velocity)
    assert first.velocity - second.velocity == pytest.approx(50.0 * 0.005)
    assert made.braking_time == 400 * MS


@pytest.mark.parametrize("mode", [Mode.READY, Mode.FAULT, Mode.INITIALISING])
def test_a_stop_by_hold_arms_no_device(mode: Mode) -> None:
    made = joint(stop_action="hold")
    made.on_event(msg.Feedback("m", 0, 0.0, 0.0))
    made.on_event(msg.State("m", 0, mode))
    made.command(STEP, msg.Velocity("m", 1.0), stopped=False)  # not armed yet
    assert made.command(2 * STEP, None, stopped=True) == msg.Idle("m")


def test_a_device_that_reports_only_what_it_is_commanded_is_first_commanded_to_give_no_torque() -> None:
    limits = JointSettings(Limits(10.0, 50.0, 2.0))
    for able, first in ((msg.Torque, msg.Torque("m", 0.0)), (msg.Velocity, msg.Velocity("m", 0.0))):
        made = Joint("m", limits, spec(msg.Idle, msg.Velocity, able, feedback=FeedbackKind.REPLY))
        assert made.command(STEP, None, stopped=False) == msg.Idle("m")
        assert made.command(2 * STEP, msg.Velocity("m", 3.0), stopped=False) == first
        assert made.command(3 * STEP, None, stopped=True) == msg.Idle("m")
        armed(made)
        made.command(4 * STEP, msg.Velocity("m", 3.0), stopped=False)
        armed(made, t=4 * STEP + 1)
        assert made.command(5 * STEP, None, stopped=False) == msg.Velocity("m", 0.25 + 0.25)


def test_a_motion_begins_once_the_device_has_answered_a_set_point_that_it_was_sent() -> None:
    made = armed(joint())
    wanted = msg.Velocity("m", 5.0)
    first = msg.Velocity("m", 0.25)
    for step in range(1, 10):  # armed, and reporting: but its driver still prepares it
        assert made.command(step * STEP, wanted, stopped=False) == first
        made.on_held_back()
        armed(made, t=step * STEP + 1)
    assert [made.command(step * STEP, wanted, stopped=False) for step in (10, 11, 12)] == [first] * 3  # sent
    armed(made, t=12 * STEP)
    assert made.command(13 * STEP, wanted, stopped=False) == msg.Velocity("m", 0.5)
    assert made.command(14 * STEP, wanted, stopped=False) == msg.Velocity("m", 0.75)


def test_a_motion_begins_anew_if_the_shaft_was_stopped_when_its_device_was_armed() -> None:
    made = joint()
    wanted = msg.Velocity("m", 5.0)

    def report(t: int, velocity: float, mode: Mode) -> None:
        made.on_event(msg.State("m", t, mode))
        made.on_event(msg.Feedback("m", t + 1, 0.0, velocity))

    report(0, -4.0, Mode.READY)  # falls
    made.command(STEP, wanted, stopped=False)
    report(STEP + 1, -4.0, Mode.ARMED)  # that motion may have been sampled before
    made.command(2 * STEP, wanted, stopped=False)
    report(2 * STEP + 1, 0.0, Mode.ARMED)
    assert made.command(3 * STEP, wanted, stopped=False) == msg.Velocity("m", 0.25)
    report(3 * STEP + 1, -4.0, Mode.ARMED)  # what disturbs it later is the device's to make good
    assert made.command(4 * STEP, wanted, stopped=False) == msg.Velocity("m", 0.5)


def test_a_device_that_reports_only_what_it_is_commanded_and_takes_neither_is_not_commanded() -> None:
    limits = JointSettings(Limits(10.0, 50.0, 2.0))
    made = Joint("m", limits, spec(msg.Idle, msg.Position, feedback=FeedbackKind.REPLY))
    assert made.command(STEP, msg.Position("m", 3.0), stopped=False) == msg.Idle("m")


def test_a_stamp_from_the_future_does_not_keep_a_joint_from_going_blind() -> None:
    made = armed(joint())
    made.on_event(msg.Feedback("m", 3600 * SECOND, 0.0, 0.0))
    made.command(STEP, msg.Velocity("m", 1.0), stopped=False)
    assert made.feedback_age(STEP) == 0
    made.command(STEP + 101 * MS, msg.Velocity("m", 1.0), stopped=False)
    assert [f.code for f in made.faults.values()] == [FEEDBACK_LOST]


@pytest.mark.parametrize(
    ("command", "out"),
    [
        (msg.Position("m", 1.0), msg.Idle("m")),
        (msg.Impedance("m", 1.0, 0.0, 0.0, 1.0, 0.1), msg.Idle("m")),
        (msg.Hold("m"), msg.Velocity("m", 0.0)),
        (msg.Torque("m", 0.5), msg.Torque("m", 0.5)),
    ],
    ids=repr,
)
def test_a_position_that_the_device_no_longer_reports_is_neither_held_nor_moved_from(
    command: Command, out: Command
) -> None:
    made = armed(joint(), position=12.4)
    notes = []
    for now in range(STEP, 150 * MS, STEP):
        made.on_event(msg.Feedback("m", now, None, 0.0))
        given = made.command(now, command, stopped=False)
        notes += [made.refused] if made.refused else []
    assert given == out
    assert made.feedback.position is None
    assert notes == ["its position is lost: the device no longer reports it"]
    made.on_event(msg.Feedback("m", 150 * MS, 12.4, 0.0))
    made.command(150 * MS, command, stopped=False)
    assert made.feedback.position == 12.4


@example(0.0, 1.0, 2.0, -2.0, 2.0, 1.0, 2.0)  # within the limit when it is in force, and not before
@given(*[st.floats(-20.0, 20.0)] * 5, st.floats(0.0, 1e4), st.floats(0.0, 1e3))
def test_the_torque_of_a_spring_is_within_the_limit_where_the_shaft_is(
    position: float, velocity: float, torque: float, to: float, at: float, stiffness: float, damping: float
) -> None:
    made = armed(joint(), position=position, velocity=velocity)
    out = made.command(STEP, msg.Impedance("m", to, at, torque, stiffness, damping), stopped=False)
    assert isinstance(out, msg.Impedance)
    total = out.torque + out.stiffness * (out.position - position) + out.damping * (out.velocity - velocity)
    assert abs(total) <= 2.0 + 1e-6
    assert 0.0 <= out.stiffness <= stiffness
    assert 0.0 <= out.damping <= damping
    assert abs(velocity) <= 10.0 or total * velocity <= 1e-6  # nor does it speed up a shaft that is too fast


@pytest.mark.parametrize("stop_action", ["idle", "hold"])
def test_stop_sends_the_stop_command_at_once(stop_action: Action) -> None:
    made = armed(joint(stop_action=stop_action))
    made.command(STEP, msg.Velocity("m", 1.0), stopped=False)
    out = made.command(2 * STEP, msg.Velocity("m", 1.0), stopped=True)
    assert out == (msg.Hold("m") if stop_action == "hold" else msg.Idle("m"))


def test_braking_slows_down_within_the_limit_and_then_disarms() -> None:
    made = armed(joint(stop_action="brake"), velocity=5.0)
    drive(made, msg.Velocity("m", 5.0), 1)
    speeds, now = [5.0], STEP
    while isinstance(out := made.command(now + STEP, None, stopped=True), msg.Velocity):
        now += STEP
        speeds.append(out.velocity)
        made.on_event(msg.Feedback("m", now, 0.0, out.velocity))
    assert out == msg.Idle("m")
    assert len([speed for speed in speeds if speed]) == pytest.approx(5.0 / (50.0 * 0.005), abs=2)
    assert all(a - b <= 50.0 * 0.005 + 1e-9 for a, b in pairwise(speeds))
    assert speeds[-19:] == [0.0] * 19  # for 0.1 s: a wheel that slips is turned again by its base
    assert made.command(now + 2 * STEP, None, stopped=True) == msg.Idle("m")


def test_braking_ends_in_bounded_time_even_if_the_shaft_does_not_slow_down() -> None:
    made = armed(joint(stop_action="brake"), velocity=5.0)
    drive(made, msg.Velocity("m", 5.0), 1)
    out = []
    for now in range(2 * STEP, 1000 * MS, STEP):
        made.on_event(msg.Feedback("m", now, 0.0, 5.0))
        out.append(made.command(now, None, stopped=True))
    braked = [c for c in out if isinstance(c, msg.Velocity)]
    assert len(braked) * STEP <= made.braking_time == 400 * MS
    assert out[-1] == msg.Idle("m")


@pytest.mark.parametrize("why", ["fault", "feedback lost", "last", "idle before"])
def test_what_cannot_be_trusted_to_brake_is_disarmed_at_once(why: str) -> None:
    made = armed(joint(stop_action="brake"), velocity=5.0)
    drive(made, msg.Idle("m") if why == "idle before" else msg.Velocity("m", 5.0), 1)
    if why == "fault":
        made.on_event(msg.Fault("m", STEP, 1, "X"))
    later = 500 * MS if why == "feedback lost" else 2 * STEP
    assert made.command(later, None, stopped=True, last=why == "last") == msg.Idle("m")


def test_lost_feedback_of_a_commanded_joint_latches_and_it_does_not_start_by_itself() -> None:
    made = armed(joint())
    made.command(STEP, msg.Velocity("m", 1.0), stopped=False)
    assert made.command(200 * MS, msg.Velocity("m", 1.0), stopped=False) == msg.Idle("m")
    assert [f.code for f in made.take_unreported()] == [FEEDBACK_LOST]
    made.on_event(msg.Feedback("m", 205 * MS, 0.0, 0.0))
    assert made.command(205 * MS, msg.Velocity("m", 1.0), stopped=False) == msg.Idle("m")
    made.clear()
    assert isinstance(made.command(210 * MS, msg.Velocity("m", 1.0), stopped=False), msg.Velocity)
    assert made.take_unreported() == []


def test_the_feedback_timeout_is_the_robot_files_not_the_drivers() -> None:
    made = armed(joint(feedback_timeout=500 * MS))
    made.command(STEP, msg.Velocity("m", 1.0), stopped=False)
    made.on_event(msg.State("m", 250 * MS, Mode.OFFLINE))  # the driver's own timeout
    made.command(400 * MS, msg.Velocity("m", 1.0), stopped=False)
    assert not made.faults
    made.command(510 * MS, msg.Velocity("m", 1.0), stopped=False)
    assert [f.code for f in made.faults.values()] == [FEEDBACK_LOST]


def test_a_device_that_returns_disarmed_from_a_short_outage_has_disarmed_itself() -> None:
    made = armed(joint(feedback_timeout=500 * MS))
    made.command(STEP, msg.Velocity("m", 1.0), stopped=False)
    made.on_event(msg.State("m", 250 * MS, Mode.OFFLINE))
    made.on_event(msg.State("m", 300 * MS, Mode.READY))
    assert [f.code for f in made.faults.values()] == [DISARMED_ITSELF]


def test_lost_feedback_of_an_idle_joint_is_no_fault() -> None:
    made = armed(joint())
    made.command(200 * MS, None, stopped=False)
    assert made.feedback_lost(200 * MS)
    assert not made.faults


def test_a_device_that_disarms_itself_latches() -> None:
    made = armed(joint())
    made.command(STEP, msg.Velocity("m", 1.0), stopped=False)
    made.on_event(msg.State("m", 2 * STEP, Mode.INITIALISING, "INITIALIZING"))
    assert [f.code for f in made.faults.values()] == [DISARMED_ITSELF]
    assert made.command(3 * STEP, msg.Velocity("m", 1.0), stopped=False) == msg.Idle("m")


def test_a_device_that_reports_its_disarming_when_the_next_command_is_given_has_obeyed() -> None:
    made = idle_since_10_ms()
    made.command(3 * STEP, msg.Velocity("m", 1.0), stopped=False)
    made.on_event(msg.State("m", 4 * STEP, Mode.READY))
    made.on_event(msg.State("m", 5 * STEP, Mode.ARMED))
    assert not made.faults
    made.on_event(msg.State("m", 6 * STEP, Mode.READY))
    assert [f.code for f in made.faults.values()] == [DISARMED_ITSELF]


def test_a_device_that_restarts_soon_after_its_first_command_has_disarmed_itself() -> None:
    made = joint()
    made.on_event(msg.Feedback("m", 0, 0.0, 0.0))
    made.on_event(msg.State("m", 0, Mode.READY))
    made.command(STEP, msg.Idle("m"), stopped=False)
    made.command(2 * STEP, msg.Velocity("m", 1.0), stopped=False)
    made.on_event(msg.State("m", 3 * STEP, Mode.ARMED))
    made.on_event(msg.State("m", 4 * STEP, Mode.INITIALISING))
    assert [f.code for f in made.faults.values()] == [DISARMED_ITSELF]


def test_disarming_by_command_is_no_fault() -> None:
    made = armed(joint())
    made.command(STEP, msg.Velocity("m", 1.0), stopped=False)
    made.command(2 * STEP, msg.Idle("m"), stopped=False)
    made.on_event(msg.State("m", 3 * STEP, Mode.READY))
    assert not made.faults


def idle_since_10_ms(stop_action: Action = "hold") -> Joint:
    made = armed(joint(stop_action=stop_action))
    made.command(STEP, msg.Velocity("m", 1.0), stopped=False)
    made.command(2 * STEP, msg.Idle("m"), stopped=False)
    return made


def test_a_device_that_a_late_frame_has_armed_is_a_fault_and_gets_idle_whatever_the_stop_action() -> None:
    made = idle_since_10_ms()
    made.on_event(msg.State("m", 3 * STEP, Mode.READY))
    for now in range(20 * MS, 600 * MS, STEP):
        made.command(now, msg.Idle("m"), stopped=False)
    made.on_event(msg.State("m", 600 * MS, Mode.ARMED))
    made.on_event(msg.State("m", 601 * MS, Mode.READY))  # within one step
    assert [f.code for f in made.take_unreported()] == [ARMED_AGAINST_IDLE]
    made.on_event(msg.Feedback("m", 605 * MS, 0.0, 0.0))
    assert made.command(605 * MS, msg.Velocity("m", 1.0), stopped=False) == msg.Idle("m")
    made.clear()
    assert isinstance(made.command(610 * MS, msg.Velocity("m", 1.0), stopped=False), msg.Velocity)


def test_a_device_that_does_not_obey_idle_is_a_fault_after_half_a_second() -> None:
    made = idle_since_10_ms()
    made.on_event(msg.Feedback("m", 510 * MS, 0.0, 0.0))
    made.command(510 * MS, msg.Idle("m"), stopped=False)
    assert not made.faults  # it may take that long to disarm, and to report it
    made.command(511 * MS, msg.Idle("m"), stopped=False)
    assert [f.code for f in made.faults.values()] == [STILL_ARMED]
    assert made.take_unreported()[0].name == "still armed: cut its supply"


def test_a_running_device_that_was_never_commanded_is_no_fault() -> None:
    made = armed(joint())
    made.command(STEP, None, stopped=False)
    made.command(2000 * MS, None, stopped=False)
    made.on_event(msg.State("m", 2001 * MS, Mode.ARMED))
    assert not made.faults


def test_the_time_for_disarming_begins_anew_with_each_command() -> None:
    made = idle_since_10_ms()
    made.on_event(msg.Feedback("m", 600 * MS, 0.0, 0.0))
    made.on_event(msg.State("m", 20 * MS, Mode.READY))
    made.command(600 * MS, msg.Velocity("m", 1.0), stopped=False)
    made.command(605 * MS, msg.Idle("m"), stopped=False)
    made.on_event(msg.State("m", 610 * MS, Mode.ARMED))
    assert not made.faults


def test_faults_latch_once_each_and_stay_when_the_device_forgets_them() -> None:
    made = armed(joint())
    for _ in range(3):
        made.on_event(msg.Fault("m", 1, 0x40, "MOTOR_FAILED"))
    made.on_event(msg.Fault("m", 1, 0x80, "OTHER"))
    made.on_event(msg.State("m", 2, Mode.READY))
    assert [f.code for f in made.take_unreported()] == [0x40, 0x80]
    assert len(made.faults) == 2
    assert made.command(STEP, msg.Velocity("m", 1.0), stopped=False) == msg.Idle("m")


def test_after_clearing_the_old_command_is_not_resumed() -> None:
    made = armed(joint())
    made.command(STEP, msg.Velocity("m", 1.0), stopped=False)
    made.on_event(msg.Fault("m", 1, 1, "X"))
    made.clear()
    made.on_event(msg.Feedback("m", 2 * STEP, 0.0, 0.0))
    assert made.command(2 * STEP, None, stopped=False) == msg.Idle("m")


@pytest.mark.parametrize(
    ("key", "value", "objection"),
    [
        ("velocity", 3.0, ""),
        ("velocity", 10.1, "from 0.5 to the robot file's 10"),
        ("torque", 0.0, "from 0.1 to the robot file's 2"),
        ("torque", math.inf, "not inf"),
        ("acceleration", math.nan, "not nan"),
        ("acceleration", 1e-300, "from 2.5 to"),
        ("gear", 2.0, "no limit"),
    ],
)
def test_a_limit_may_be_changed_but_not_removed(key: str, value: float, objection: str) -> None:
    made = armed(joint())
    refused = made.change(key, value)
    assert objection in refused
    assert bool(refused) == bool(objection)
    if not objection:
        assert made.settings.limits.velocity == 3.0
