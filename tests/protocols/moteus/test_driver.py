"""The driver at its twins: limits, stops, faults, several devices on a bus."""

from __future__ import annotations

from dataclasses import replace
from math import tau
from typing import Any

import pytest

from protocols import messages as msg
from protocols.frames import BusState
from protocols.moteus.codec import make_frame, reply_id
from protocols.moteus.options import Options
from protocols.moteus.registers import Mode, Register
from tests.protocols.helpers import of
from tests.protocols.moteus.helpers import Bench, device, ready

LIMITS = {
    "max_torque": (1.5, Register.COMMAND_POSITION_MAX_TORQUE),
    "velocity_limit": (1.5 * tau, Register.COMMAND_VELOCITY_LIMIT),
    "acceleration_limit": (1.5 * tau, Register.COMMAND_ACCEL_LIMIT),
}


@pytest.mark.parametrize("given", LIMITS)
def test_one_limit_alone_leaves_the_others_to_the_device(given: str) -> None:
    limit: dict[str, Any] = {given: LIMITS[given][0]}
    bench = ready(device(options=replace(Options(), **limit)))
    bench.run(50, msg.Hold("left"))
    bench.run(50, msg.Torque("left", 0.5))
    for sent in bench.commanded():
        assert {name: sent[register] for name, (_, register) in LIMITS.items()} == {
            name: 1.5 if name == given else None for name in LIMITS
        }


def test_a_velocity_begins_at_zero_where_the_shaft_is_at_zero() -> None:
    bench = ready()
    for command in (msg.Velocity("left", 1.0), msg.Torque("left", 0.0)):
        bench.shaft.position, bench.shaft.locked = 0.0, True
        since = bench.now
        bench.run(10, command)
        assert bench.commanded(since)[0][Register.COMMAND_POSITION] == 0.0


# -- idle ---------------------------------------------------------------------------------------------


def test_an_operator_s_stop_reaches_what_another_host_armed() -> None:
    bench = ready()
    bench.run(200, msg.Hold("left"))
    fresh = Bench(bench.devices)
    fresh.twins, fresh.shafts, fresh.now = bench.twins, bench.shafts, bench.now
    fresh.run(30, msg.Idle("left"))
    assert fresh.sent_messages() == []
    fresh.ask(msg.Stop("test"))
    fresh.run(60, msg.Idle("left"))
    assert set(fresh.sent_messages()) == {"stop"}
    assert fresh.twin.servo.mode == Mode.STOPPED


# -- faults and timeouts ------------------------------------------------------------------------------


def test_clear_sends_no_stop_where_nothing_is_latched() -> None:
    bench = ready()
    bench.run(100, msg.Hold("left"))
    since = bench.now
    reported = bench.ask(msg.ClearFault("left"), 100)
    assert len(of(msg.Done, reported)) == 1
    assert "stop" not in bench.sent_messages(since)
    assert bench.twin.servo.mode == Mode.POSITION


def test_a_fault_that_comes_back_is_reported_again() -> None:
    bench = ready()
    bench.run(50, msg.Hold("left"))
    for _ in range(2):
        bench.twin.provoke(38)
        assert len(of(msg.Fault, bench.run(100))) == 1
        bench.ask(msg.ClearFault("left"), 100)


def test_what_limits_the_output_is_reported_once_with_the_state_and_taken_back() -> None:
    bench = ready(device(options=Options(max_torque=0.1)))
    bench.shaft.locked = True
    limited = [state.detail for state in of(msg.State, bench.run(2000, msg.Torque("left", 1.0)))]
    assert limited[-2:] == ["position", "position, limited by the commanded maximum torque"]
    free = [state.detail for state in of(msg.State, bench.run(2000, msg.Torque("left", 0.05)))]
    assert free == ["position"]
    bench.run(50, msg.Torque("left", 1.0))
    assert of(msg.State, bench.run(100, msg.Idle("left")))[-1].detail == "stopped"


def replied(bench: Bench, at: int, mode: int, limit: int) -> list[msg.Event]:
    """The events, but feedback, of a reply of the device at rest, so many cycles of 5 ms from now."""
    frame = f"2100{mode:02x}2f01{'00000000' * 3}210f{limit:02x}"
    events = bench.driver.receive(bench.now + at * 5_000_000, make_frame(reply_id(1), bytes.fromhex(frame)))
    return [event for event in events if not isinstance(event, msg.Feedback)]


def details(events: list[msg.Event]) -> list[str]:
    assert len(of(msg.State, events)) == len(events)  # and no fault
    return [state.detail for state in of(msg.State, events)]


def test_limits_that_come_and_go_with_every_reply_are_reported_once() -> None:
    bench = ready()
    bench.run(100, msg.Hold("left"))
    # none, the current, none, the torque, and so on
    events = [event for i in range(500) for event in replied(bench, i, 10, (0, 99, 0, 102)[i % 4])]
    assert details(events) == [
        "position, limited by servo.max_current_A",
        "position, limited by servo.max_current_A and the commanded maximum torque",
    ]


@pytest.mark.parametrize(
    ("mode", "detail"), [(1, "fault"), (11, "timeout"), (0, "stopped"), (3, "calibrating")]
)
def test_a_limit_is_reported_of_an_armed_device_only(mode: int, detail: str) -> None:
    bench = ready()
    replied(bench, 0, 10, 99)
    assert of(msg.State, replied(bench, 1, mode, 99))[-1].detail == detail


def test_a_limit_from_before_the_bus_was_lost_is_not_reported() -> None:
    bench = ready()
    assert details(replied(bench, 0, 10, 99)) == ["position, limited by servo.max_current_A"]
    bench.driver.bus(bench.now + 1, BusState.BACK)
    assert details(replied(bench, 1, 10, 0)) == ["position"]


# -- the bus ------------------------------------------------------------------------------------------


def test_several_devices_one_frame_each_a_cycle() -> None:
    bench = ready(*(device(f"m{i}", i) for i in range(1, 9)))
    bench.run(100, *(msg.Velocity(f"m{i}", float(i)) for i in range(1, 9)))
    since = bench.now
    bench.run(500)
    for i in range(1, 9):
        assert len([f for t, f in bench.sent if t >= since and f.id == 0x8000 | i]) == pytest.approx(
            100, abs=2
        )
        assert bench.shafts[i - 1].velocity == pytest.approx(float(i), rel=0.02)
