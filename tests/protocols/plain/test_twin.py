from __future__ import annotations

import copy
import math
from itertools import pairwise
from typing import Any

import pytest

from protocols import messages as msg
from protocols.conformance.bench import Bench
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Command, Mode
from protocols.plain import codec, plugin
from protocols.plain.twin import BOOT, Settings
from tests.protocols.plain.bench import ask, bench, reported


def mode(stage: Bench) -> Mode:
    state: Mode = stage.twins[0]._mode  # type: ignore[attr-defined]  # the twin's own state
    return state


def torque(stage: Bench, *messages: Command) -> float:
    return stage.step(messages).torques[0].torque


# -- arming, watchdog, faults --------------------------------------------------------------------------


ARMING: list[Command] = [
    msg.Hold("m"),
    msg.Position("m", 0.0),
    msg.Velocity("m", 0.0),
    msg.Torque("m", 0.0),
    msg.Impedance("m", 0.0, 0.0, 0.0, 1.0, 0.1),
]


@pytest.mark.parametrize("command", ARMING, ids=lambda message: type(message).__name__)
def test_any_command_but_idle_arms_and_idle_disarms(command: Command) -> None:
    stage = bench()
    stage.steps(5)
    assert mode(stage) == Mode.READY
    steps = ask(stage, command, steps=3)
    assert mode(stage) == Mode.ARMED
    assert [s.mode for s in reported(steps, msg.State)] == [Mode.ARMED]
    steps = ask(stage, msg.Idle("m"), steps=3)
    assert mode(stage) == Mode.READY
    assert [s.mode for s in reported(steps, msg.State)] == [Mode.READY]


def test_silence_of_the_host_trips_the_watchdog_which_only_clear_fault_undoes() -> None:
    stage = bench()
    stage.step([msg.Torque("m", 0.5)])
    assert {torque(stage) for _ in range(99)} == {0.5}
    steps = stage.steps(5)
    assert [s.torques[0].torque for s in steps][1:] == [0.0] * 4
    assert [(f.code, f.name) for f in reported(steps, msg.Fault)] == [(1, "watchdog expired")]
    assert mode(stage) == Mode.FAULT
    for message in (msg.Torque("m", 0.5), msg.Idle("m"), msg.Hold("m")):
        assert torque(stage, message) == 0.0
        assert mode(stage) == Mode.FAULT
    steps = ask(stage, msg.ClearFault("m"), steps=3)
    assert mode(stage) == Mode.READY
    assert [d.request for d in reported(steps, msg.Done)] == ["ClearFault"]
    assert torque(stage, msg.Torque("m", 0.5)) == 0.5


def test_the_watchdog_is_exact_and_expired_before_a_late_command() -> None:
    for late, expected in ((0, Mode.ARMED), (1, Mode.FAULT)):
        stage = bench()
        stage.step([msg.Torque("m", 0.5)])
        stage.twins[0].receive(stage.now + 100 * MILLISECOND + late, codec.encode(1, msg.Torque("", 0.5)))
        assert mode(stage) == expected


def test_only_commands_feed_the_watchdog() -> None:
    stage = bench()
    stage.step([msg.Torque("m", 0.5)])
    for _ in range(120):
        stage.step([msg.ReadParameter("m", "supply")])
    assert mode(stage) == Mode.FAULT


def test_a_watchdog_of_zero_never_expires() -> None:
    stage = bench(watchdog_ms=0.0)
    stage.step([msg.Torque("m", 0.001)])
    stage.steps(2000)
    assert mode(stage) == Mode.ARMED


def test_no_watchdog_while_disarmed() -> None:
    stage = bench()
    assert reported(stage.steps(500), msg.Fault) == []


def test_estop_faults_from_any_mode() -> None:
    for message in (msg.Torque("m", 0.5), None):
        stage = bench()
        stage.step([message] if message else [])
        steps = ask(stage, msg.Estop("m"))
        assert [(f.code, f.name) for f in reported(steps, msg.Fault)] == [(2, "emergency stop")]
        assert steps[-1].torques[0].torque == 0.0


def test_an_active_fault_is_reported_to_a_host_that_connects_later() -> None:
    stage = bench()
    ask(stage, msg.Estop("m"))
    stage.driver = bench().driver
    steps = stage.steps(200)
    assert [f.code for f in reported(steps, msg.Fault)] == [2]


def test_reboot_takes_its_time_disarms_and_forgets_zero_and_faults() -> None:
    stage = bench()
    stage.shafts["m"].position = 1.0
    stage.steps(2)
    ask(stage, msg.Zero("m"))
    ask(stage, msg.Estop("m"))
    steps = ask(stage, msg.Reboot("m"), msg.Torque("m", 0.5), steps=BOOT // MILLISECOND + 10)
    assert [s.mode for s in reported(steps, msg.State)] == [Mode.INITIALISING, Mode.READY]
    assert {s.torques[0].torque for s in steps} == {0.0}
    assert reported(steps, msg.Feedback)[-1].position == pytest.approx(1.0)


# -- loops ---------------------------------------------------------------------------------------------


def run(stage: Bench, command: Command, steps: int = 2000) -> None:
    for _ in range(steps):
        stage.step([command])


def test_position_is_reached_and_held() -> None:
    stage = bench()
    run(stage, msg.Position("m", 2.0))
    assert stage.shafts["m"].position == pytest.approx(2.0, abs=1e-3)
    assert stage.shafts["m"].velocity == pytest.approx(0.0, abs=1e-3)


def test_velocity_is_reached_without_an_error_that_stays() -> None:
    stage = bench()
    stage.shafts["m"].friction = 0.02
    run(stage, msg.Velocity("m", -8.0), 4000)
    assert stage.shafts["m"].velocity == pytest.approx(-8.0, abs=1e-3)


def test_hold_holds_the_position_at_the_first_hold() -> None:
    stage = bench()
    run(stage, msg.Velocity("m", 5.0), 300)
    at = stage.shafts["m"].position
    run(stage, msg.Hold("m"))
    assert stage.shafts["m"].position == pytest.approx(at, abs=0.02)
    held = stage.shafts["m"].position
    stage.shafts["m"].position += 0.3  # turned by hand
    run(stage, msg.Hold("m"))
    assert stage.shafts["m"].position == pytest.approx(held, abs=1e-3)


def test_hold_after_idle_holds_anew() -> None:
    stage = bench()
    run(stage, msg.Hold("m"), 10)
    run(stage, msg.Idle("m"), 10)
    stage.shafts["m"].position = 3.0
    run(stage, msg.Hold("m"), 100)
    assert stage.shafts["m"].position == pytest.approx(3.0, abs=1e-6)


def test_impedance_is_a_spring_and_a_damper() -> None:
    stage = bench()
    shaft = stage.shafts["m"]
    shaft.position, shaft.velocity, shaft.locked = 0.25, 2.0, True
    given = torque(stage, msg.Impedance("m", 0.5, 1.0, 0.1, 2.0, 0.3))
    assert given == pytest.approx(0.1 + 2.0 * 0.25 + 0.3 * -1.0)


def test_feed_forward_is_added() -> None:
    stage = bench()
    stage.shafts["m"].locked = True
    assert torque(stage, msg.Position("m", 0.0, 2.0, 0.5)) == pytest.approx(0.5 + 0.05 * 2.0)
    assert torque(stage, msg.Velocity("m", 0.0, 0.5)) == pytest.approx(0.5)


@pytest.mark.parametrize("command", [msg.Torque("m", 9.0), msg.Position("m", 99.0), msg.Velocity("m", 999.0)])
def test_torque_is_limited_and_the_integral_does_not_wind_up(command: Command) -> None:
    stage = bench()
    stage.shafts["m"].locked = True
    for _ in range(3000):
        assert torque(stage, command) <= 2.0
    assert torque(stage, msg.Velocity("m", 0.0)) <= 2.0
    run(stage, msg.Velocity("m", -999.0), 3000)
    assert torque(stage, msg.Velocity("m", -999.0)) == -2.0


def test_a_shaft_that_was_never_measured_gets_no_torque() -> None:
    stage = bench()
    twin = stage.twins[0]
    twin.receive(stage.now, codec.encode(1, msg.Torque("", 1.0)))
    assert twin.step(stage.now, [])[0] == [msg.Torque("m", 0.0)]
    for wrong in (
        msg.Feedback("m", 0, math.nan, 0.0),
        msg.Feedback("m", 0, 1.0),
        msg.Feedback("x", 0, 1.0, 1.0),
    ):
        assert twin.step(stage.now, [wrong])[0] == [msg.Torque("m", 0.0)]


# -- what it sends -------------------------------------------------------------------------------------


def test_feedback_and_state_come_at_their_periods() -> None:
    stage = bench(feedback_ms=7.0, state_ms=30.0)
    steps = stage.steps(700)
    times = [steps.index(s) for s in steps if reported([s], msg.Feedback)]
    assert {b - a for a, b in pairwise(times)} == {7}
    times = [steps.index(s) for s in steps if reported([s], msg.State)]
    assert {b - a for a, b in pairwise(times)} == {30}


def test_feedback_reports_shaft_torque_current_and_supply() -> None:
    stage = bench(torque_constant=0.25)
    shaft = stage.shafts["m"]
    shaft.position, shaft.velocity, shaft.locked = 1.5, 0.5, True
    feedback = reported([stage.step([msg.Torque("m", 0.5)]), *stage.steps(11)], msg.Feedback)[-1]
    values = (feedback.position, feedback.velocity, feedback.torque, feedback.current, feedback.voltage)
    assert values == (1.5, 0.5, 0.5, 2.0, 24.0)
    assert feedback.temperature is None


def test_due_is_when_it_next_does_something() -> None:
    stage = bench(feedback_ms=7.0, state_ms=30.0)
    stage.steps(10)
    for command in ((), (msg.Torque("m", 0.1),)):
        stage.step(command)
        for _ in range(200):
            before = copy.deepcopy(stage.twins[0])
            due = before.due()
            assert due is not None
            steps = stage.step()
            told_something = bool(steps.up) or mode(stage) != before._mode  # type: ignore[attr-defined]  # as above
            assert told_something == (due <= steps.now)


def test_a_clock_that_jumps_does_not_bring_a_burst() -> None:
    stage = bench()
    stage.steps(10)
    stage.now += 10_000 * MILLISECOND
    assert len(stage.step().up) == 2
    assert len(stage.step().up) == 0


# -- requests ------------------------------------------------------------------------------------------


def answers(stage: Bench, *messages: Any) -> list[Any]:
    return reported(ask(stage, *messages), (msg.Done, msg.Refused, msg.Parameter))


def test_zero_makes_the_present_position_zero() -> None:
    stage = bench()
    stage.shafts["m"].position = 1.25
    stage.steps(2)
    assert [type(a) for a in answers(stage, msg.Zero("m"))] == [msg.Done]
    assert reported(stage.steps(10), msg.Feedback)[-1].position == 0.0
    run(stage, msg.Position("m", 1.0))
    assert stage.shafts["m"].position == pytest.approx(2.25, abs=1e-3)


def test_zero_is_refused_while_armed() -> None:
    stage = bench()
    stage.step([msg.Hold("m")])
    (refused,) = answers(stage, msg.Zero("m"))
    assert isinstance(refused, msg.Refused)
    assert "armed" in refused.reason


def test_parameters_are_read_and_written() -> None:
    stage = bench()
    assert [a.value for a in answers(stage, msg.ReadParameter("m", "torque_limit"))] == [2.0]
    assert [type(a) for a in answers(stage, msg.WriteParameter("m", "torque_limit", 0.5))] == [msg.Done]
    assert [a.value for a in answers(stage, msg.ReadParameter("m", "torque_limit"))] == [0.5]
    assert torque(stage, msg.Torque("m", 9.0)) == 0.5


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (msg.ReadParameter("m", "nonsense"), "no parameter 'nonsense'"),
        (msg.ReadParameter("m", "__doc__"), "no parameter '__doc__'"),
        (msg.WriteParameter("m", "nonsense", 1.0), "no parameter 'nonsense'"),
        (msg.WriteParameter("m", "serial", 1.0), "no parameter 'serial'"),
        (msg.WriteParameter("m", "torque_limit", -1.0), "zero or more"),
        (msg.WriteParameter("m", "feedback_ms", 0.0), "more than zero"),
    ],
)
def test_a_parameter_that_cannot_be_is_refused(
    message: msg.ReadParameter | msg.WriteParameter, reason: str
) -> None:
    (refused,) = answers(bench(), message)
    assert isinstance(refused, msg.Refused)
    assert reason in refused.reason


def test_requests_are_refused_during_a_restart() -> None:
    stage = bench()
    ask(stage, msg.Reboot("m"), steps=3)
    (refused,) = answers(stage, msg.ReadParameter("m", "supply"))
    assert refused.reason == "restarting"


@pytest.mark.parametrize("wrong", [{"torque_limit": math.nan}, {"supply": -1.0}, {"feedback_ms": 0.0}])
def test_settings_that_cannot_be_are_an_error_of_configuration(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Settings(**wrong)  # type: ignore[arg-type]  # serial is an int, and is not among them


# -- what the contract asks of a twin and of names ---------------------------------------------------------


def test_what_is_no_fault_is_not_provoked() -> None:
    stage = bench(sensors=["s"], motors=["m"])
    for twin, code in ((stage.twins[1], 1), (stage.twins[0], 0), (stage.twins[0], 3)):
        with pytest.raises(ValueError, match=f"has no fault {code}"):
            twin.provoke(code)


def test_messages_are_named_after_their_classes() -> None:
    two = codec.encode(1, msg.Velocity("m", 1.0)) + codec.encode(2, msg.Hold("m"))
    assert plugin.messages(two) == ("Velocity", "Hold")
    assert plugin.messages(two[:-1]) == ("Velocity",)
    assert plugin.messages(codec.encode(1, msg.Feedback("m", 0))) == ()
    assert plugin.messages(CanFrame(1)) == ()
