"""What goes wrong on purpose: cables, hosts, and what the clauses of safety take for a jump."""

from __future__ import annotations

from dataclasses import replace

import pytest

from protocols import messages as msg
from protocols.conformance import variants
from protocols.conformance.bench import ADDRESSES
from protocols.conformance.case import Case
from protocols.conformance.fault_injection import Scene, resting, scene, some, takeover, torque_of
from protocols.conformance.safety import _leads_away
from protocols.conformance.watchdog import _dog, _watched, silence_trips
from protocols.frames import BusState
from protocols.messages import Command, Mode, Request
from protocols.odrive_can import plugin as odrive
from protocols.plain import plugin as plain
from tests.protocols.broken import motors


def case(options: object = None, seed: int = 0) -> Case:
    return Case(motors, motors.options() if options is None else options, seed, ADDRESSES)


def running(count: int = 1) -> Scene:
    on = scene(case(), count, position=0.7)
    assert on.ready()
    assert on.arm(lambda _: [msg.Velocity(name, 1.0) for name in on.names])
    return on


def test_a_cable_can_be_cut_in_either_direction() -> None:
    on = running(2)
    on.cables["alpha"].up = False
    on.step()
    received = [
        e for _ in range(400) for e in on.step([msg.Velocity("alpha", 1.0), msg.Velocity("beta", 1.0)]).events
    ]
    assert {getattr(event, "motor", "") for event in received if type(event).__name__ == "Feedback"} == {
        "beta"
    }
    assert abs(torque_of(on.step())) > 0.0
    on.cables["alpha"].down = False
    on.wait(300, [msg.Velocity("alpha", 1.0), msg.Velocity("beta", 1.0)])
    assert torque_of(on.step()) == 0.0  # its watchdog


def test_a_dead_host_hears_and_says_nothing_and_lives_again() -> None:
    on = running()
    on.host.alive = False
    said = [on.step([msg.Velocity("alpha", 1.0)]) for _ in range(300)]
    assert not any(step.down or step.events for step in said)
    on.host.alive = True
    assert on.until(lambda _: on.mode() is Mode.FAULT, 300)
    assert [fault.name for fault in on.faults] == ["watchdog expired"]


def test_a_lazy_host_calls_only_when_its_driver_is_due() -> None:
    on = scene(case())
    on.step()
    on.host.lazy = True
    on.cables["alpha"].up = False
    on.wait(400)
    assert "alpha" in on.offline


def test_what_is_dropped_reaches_nobody() -> None:
    on = running()
    on.host.dropping = True
    step = on.step([msg.Torque("alpha", 0.5)])
    assert (step.down, step.received) == ((), ())
    on.host.dropping = False
    on.host.bus(on.now, BusState.UP)
    assert on.step([msg.Torque("alpha", 0.5)]).received == (msg.Torque("alpha", 0.5),)


def test_a_fresh_host_beside_another_tells_for_itself_alone() -> None:
    before = running()
    on = takeover(case(), before)
    on.host.other, on.host.others_words = before.host.driver, [msg.Velocity("alpha", 1.0)]
    assert on.until(lambda _: on.mode() is Mode.ARMED, 300)
    step = on.step()
    assert step.received == (msg.Velocity("alpha", 1.0),)
    assert on.host.sent == ()


def test_a_scene_keeps_the_last_of_each_run_of_words() -> None:
    on = scene(case())
    for word in (
        msg.Velocity("alpha", 1.0),
        msg.Velocity("alpha", 2.0),
        msg.Idle("alpha"),
        msg.Velocity("alpha", 3.0),
    ):
        on.step([word])
    assert on.failure("x").words == (
        msg.Velocity("alpha", 2.0),
        msg.Idle("alpha"),
        msg.Velocity("alpha", 3.0),
    )


def test_a_shaft_turned_by_hand_is_measured_where_it_was_let_go() -> None:
    on = scene(case(), position=0.7)
    on.ready()
    on.turn(1.9)
    assert on.measured["alpha"] == pytest.approx(2.6, abs=1e-9)
    assert on.stage.shafts["alpha"].velocity == 0.0


@pytest.mark.parametrize(
    ("word", "jumps"),
    [
        (msg.Position("alpha", 0.7), False),
        (msg.Position("alpha", 0.705), False),
        (msg.Position("alpha", 0.72), True),
        (msg.Position("alpha", 0.7, 0.5), True),
        (msg.Position("alpha", 0.7, 0.0, 0.5), True),
        (msg.Velocity("alpha", 0.0), False),
        (msg.Velocity("alpha", -0.5), True),
        (msg.Torque("alpha", 0.0), False),
        (msg.Torque("alpha", -0.5), True),
        (msg.Impedance("alpha", 9.0, 9.0, 0.0, 0.0, 0.0), False),
        (msg.Impedance("alpha", 9.0, 0.0, 0.0, 1.0, 0.0), True),
        (msg.Impedance("alpha", 0.7, 9.0, 0.0, 1.0, 0.1), True),
        (msg.Hold("alpha"), False),
        (msg.Idle("alpha"), False),
        (msg.ClearFault("alpha"), False),
        (msg.Home("alpha"), True),
        (msg.Zero("alpha"), True),
    ],
)
def test_what_leads_away_from_where_a_shaft_stands(word: Command | Request, jumps: bool) -> None:
    assert _leads_away(word, 0.7, 0.01) is jumps


def test_a_command_at_rest_asks_for_nothing() -> None:
    spec = case().spec
    for kind in sorted(spec.commands, key=lambda kind: kind.__name__):
        assert not _leads_away(resting(kind, spec, "alpha", 0.7), 0.7, 1e-9)


def test_a_watchdog_that_is_off_is_switched_on_by_settings() -> None:
    assert _watched(case()) == motors.settings()
    its = Case(odrive, odrive.options(), 0, ADDRESSES)
    assert not its.spec.watchdog.enabled
    settings = _watched(its)
    assert settings is not None
    dog = _dog(its, settings)
    assert (dog.enabled, dog.timeout) == (True, 200_000_000)


def test_a_device_without_a_watchdog_says_so() -> None:
    def spec(device: object) -> object:
        its = motors.spec(device)  # type: ignore[arg-type]  # passed on as it came
        return replace(its, watchdog=replace(its.watchdog, timeout=None, enabled=False))

    without = replace(motors, spec=spec)  # type: ignore[arg-type]  # as above
    verdict = silence_trips(Case(without, without.options(), 0, ADDRESSES))
    assert "no timeout" in str(verdict)


def test_usual_options_get_all_tries_and_others_a_part() -> None:
    its = [Case(odrive, options, 0, ADDRESSES) for options in variants(odrive)]
    assert some(its[0], range(9)) == list(range(9))
    assert {len(some(each, range(9))) for each in its[1:]} == {3}
    assert (
        len({tuple(some(Case(odrive, its[1].options, seed, ADDRESSES), range(9))) for seed in range(9)}) == 3
    )
    assert some(its[1], [7]) == [7]
    (_, motor) = (Case(plain, options, 0, ADDRESSES) for options in variants(plain))
    assert some(motor, range(9)) == list(range(9))
