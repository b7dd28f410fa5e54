"""Fault injection: cables, hosts, and what the clauses of safety take for a jump."""

from __future__ import annotations

from dataclasses import replace

import pytest

from protocols import messages as msg
from protocols.conformance import variants
from protocols.conformance.bench import ADDRESSES
from protocols.conformance.case import Case, Inapplicable
from protocols.conformance.fault_injection import Rig, make_rig, resting, takeover, torque_of
from protocols.conformance.safety import leads_away
from protocols.conformance.timeouts import (
    settings_with_watchdog,
    silent_host_trips_watchdog,
    watchdog_of,
)
from protocols.frames import BusState
from protocols.messages import Command, Mode, Request
from protocols.odrive_can import plugin as odrive
from protocols.plain import plugin as plain
from protocols.plugin import Range
from tests.protocols.broken import motors


def case(options: object = None, seed: int = 0) -> Case:
    return Case(motors, motors.options() if options is None else options, seed, ADDRESSES)


def running(count: int = 1) -> Rig:
    rig = make_rig(case(), count, position=0.7)
    rig.get_ready()
    assert rig.arm(lambda _: [msg.Velocity(name, 1.0) for name in rig.names])
    return rig


def test_a_cable_can_be_cut_in_either_direction() -> None:
    rig = running(2)
    rig.cables["alpha"].up = False
    rig.step()
    commands = [msg.Velocity("alpha", 1.0), msg.Velocity("beta", 1.0)]
    events = [event for _ in range(200) for event in rig.step(commands).events]
    assert {event.motor for event in events if isinstance(event, msg.Feedback)} == {"beta"}
    assert abs(torque_of(rig.step())) > 0.0
    rig.cables["alpha"].down = False
    rig.wait(300, commands)
    assert torque_of(rig.step()) == 0.0  # its watchdog


def test_a_stopped_host_receives_and_sends_nothing_until_it_starts_again() -> None:
    rig = running()
    rig.host.alive = False
    steps = [rig.step([msg.Velocity("alpha", 1.0)]) for _ in range(300)]
    assert not any(step.down or step.events for step in steps)
    rig.host.alive = True
    assert rig.until(lambda _: rig.mode() is Mode.FAULT, 300)
    assert [fault.name for fault in rig.faults] == ["watchdog expired"]


def test_a_lazy_host_calls_only_when_its_driver_is_due() -> None:
    rig = make_rig(case())
    rig.step()
    rig.host.lazy = True
    rig.cables["alpha"].up = False
    rig.wait(400)
    assert "alpha" in rig.offline


def test_what_is_dropped_reaches_no_device() -> None:
    rig = running()
    rig.host.dropping = True
    step = rig.step([msg.Torque("alpha", 0.5)])
    assert (step.down, step.received) == ((), ())
    rig.host.dropping = False
    rig.host.bus(rig.now, BusState.UP)
    assert rig.step([msg.Torque("alpha", 0.5)]).received == (msg.Arm("alpha"), msg.Torque("alpha", 0.5))


def test_a_new_host_beside_another_reports_only_what_it_received() -> None:
    before = running()
    rig = takeover(case(), before)
    rig.host.other, rig.host.others_messages = before.host.driver, [msg.Velocity("alpha", 1.0)]
    assert rig.until(lambda _: rig.mode() is Mode.ARMED, 300)
    step = rig.step()
    assert step.received == (msg.Arm("alpha"), msg.Velocity("alpha", 1.0))
    assert rig.host.sent == ()


def test_a_rig_keeps_the_last_of_each_run_of_messages() -> None:
    rig = make_rig(case())
    for message in (
        msg.Velocity("alpha", 1.0),
        msg.Velocity("alpha", 2.0),
        msg.Idle("alpha"),
        msg.Velocity("alpha", 3.0),
    ):
        rig.step([message])
    assert rig.failure("x").messages == (
        msg.Velocity("alpha", 2.0),
        msg.Idle("alpha"),
        msg.Velocity("alpha", 3.0),
    )


def test_a_shaft_turned_by_hand_is_measured_where_it_was_released() -> None:
    rig = make_rig(case(), position=0.7)
    rig.get_ready()
    rig.turn(1.9)
    assert rig.measured["alpha"] == pytest.approx(2.6, abs=1e-9)
    assert rig.bench.shafts["alpha"].velocity == 0.0


@pytest.mark.parametrize(
    ("message", "jumps"),
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
def test_what_leads_away_from_where_a_shaft_stands(message: Command | Request, jumps: bool) -> None:
    assert leads_away(message, case().spec, 0.7) is jumps


def test_each_number_may_miss_by_its_own_resolution() -> None:
    """Half a step of 12 bits: ±45 rad/s, ±18 N·m, and 16 bits of ±12.5 rad."""
    packed = {"position": 12.5 / 65535, "velocity": 45 / 4095, "torque": 18 / 4095}
    ranges = {f"Position.{name}": Range(-50.0, 50.0, fine) for name, fine in packed.items()}
    spec = replace(case().spec, ranges=ranges)
    assert not leads_away(msg.Position("alpha", 0.7, 0.01098, -0.00439), spec, 0.7)
    assert leads_away(msg.Position("alpha", 0.7, 0.0110, 0.0), spec, 0.7)
    assert leads_away(msg.Position("alpha", 0.7, 0.0, 0.0044), spec, 0.7)
    assert leads_away(msg.Velocity("alpha", 0.0, 1e-9), case().spec, 0.7)


def test_a_command_at_rest_asks_for_nothing() -> None:
    spec = case().spec
    for kind in sorted(spec.commands, key=lambda kind: kind.__name__):
        assert not leads_away(resting(kind, spec, "alpha", 0.7), spec, 0.7)


def test_a_watchdog_that_is_off_is_switched_on_by_settings() -> None:
    assert settings_with_watchdog(case()) == motors.settings()
    its = Case(odrive, odrive.options(), 0, ADDRESSES)
    assert not its.spec.watchdog.enabled
    settings = settings_with_watchdog(its)
    assert settings is not None
    watchdog = watchdog_of(its, settings)
    assert (watchdog.enabled, watchdog.timeout) == (True, 200_000_000)


def test_the_clause_does_not_apply_without_a_watchdog() -> None:
    def spec(device: object) -> object:
        its = motors.spec(device)  # type: ignore[arg-type]  # passed on as it came
        return replace(its, watchdog=replace(its.watchdog, timeout=None, enabled=False))

    without = replace(motors, spec=spec)  # type: ignore[arg-type]  # as above
    with pytest.raises(Inapplicable, match="no timeout"):
        silent_host_trips_watchdog(Case(without, without.options(), 0, ADDRESSES))


def test_default_options_get_all_trials_and_others_a_sample() -> None:
    its = [Case(odrive, options, 0, ADDRESSES) for options in variants(odrive)]
    assert its[0].sample(range(9)) == list(range(9))
    assert {len(each.sample(range(9))) for each in its[1:]} == {3}
    assert (
        len({tuple(Case(odrive, its[1].options, seed, ADDRESSES).sample(range(9))) for seed in range(9)}) == 3
    )
    assert its[1].sample([7]) == [7]
    (_, motor) = (Case(plain, options, 0, ADDRESSES) for options in variants(plain))
    assert motor.sample(range(9)) == list(range(9))
