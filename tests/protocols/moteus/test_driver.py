"""The driver at its twins: arming, set-points, faults and timeouts, silence, several devices on a bus."""

from __future__ import annotations

import copy
from dataclasses import replace
from math import tau
from typing import Any

import pytest

from protocols import messages as msg
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import MILLISECOND, Command
from protocols.moteus.codec import READ_ERROR, Error, Values, encode, make_frame, reply_id
from protocols.moteus.faults import FAULTS, NOT_ARMED, TIMEOUT
from protocols.moteus.messages import IDENTIFY
from protocols.moteus.options import Options, Settings
from protocols.moteus.registers import Mode, Register
from protocols.moteus.reply import FAST, FULL
from tests.protocols.helpers import modes, of
from tests.protocols.moteus.helpers import Bench, device, ready, rev, subframes

P, V, T = Register.COMMAND_POSITION, Register.COMMAND_VELOCITY, Register.COMMAND_FEEDFORWARD_TORQUE


# -- queries ------------------------------------------------------------------------------------


def test_a_device_that_was_not_commanded_is_only_queried() -> None:
    bench = ready()
    bench.run(500, msg.Idle("left"))
    assert bench.sent_messages() == []
    queries = {f.data.rstrip(b"\x50") for _, f in bench.sent}
    assert queries == {FAST, FULL, IDENTIFY}
    assert {f.id for _, f in bench.sent} == {0x8001}
    assert all(f.extended and f.fd and f.brs for _, f in bench.sent)


def test_a_device_without_a_uuid_is_not_queried_for_it_all_the_time() -> None:
    bench = Bench([device()])
    bench.arrives = lambda frame: (_without_uuid(frame),)
    bench.run(2000)
    assert bench.node.firmware == 0x010304
    assert bench.node.uuids == {}
    assert len([f for _, f in bench.sent if f.data.startswith(IDENTIFY)]) <= 2


def _without_uuid(frame: CanFrame) -> CanFrame:
    """As an older firmware would have answered."""
    errors = b"".join(encode(Error(READ_ERROR, r, 1)) for r in (0x150, 0x151, 0x152, 0x153, 0x158))
    kept = [encode(s) for s in subframes(frame) if not (isinstance(s, Values) and s.start >= 0x150)]
    return frame if len(kept) == len(subframes(frame)) else make_frame(frame.id, b"".join(kept) + errors)


# -- arming and set-points --------------------------------------------------------------------------


def test_arming_begins_where_the_shaft_is_and_names_every_register() -> None:
    bench = Bench([device()])
    bench.shaft.position = rev(3.5)
    bench.run(60)
    bench.run(30, msg.Position("left", rev(4.0)))
    first = bench.commanded()[0]
    assert first[Register.MODE] == Mode.POSITION
    assert first[P] == pytest.approx(3.5, abs=1 / 16384)
    assert (first[V], first[T]) == (0.0, 0.0)
    assert first[Register.COMMAND_TIMEOUT] == pytest.approx(0.1)
    assert bench.commanded()[-1][P] == pytest.approx(4.0)
    states = of(msg.State, bench.events)
    assert {s.mode for s in states if s.detail in ("enabling", "calibrating")} == {"ready"}
    assert list(dict.fromkeys(modes(bench.events))) == ["ready", "armed"]  # enabling is no new beginning


def test_positions_are_reached_and_feed_forwards_arrive() -> None:
    bench = ready()
    bench.run(3000, msg.Position("left", rev(0.5)))
    assert bench.shaft.position == pytest.approx(rev(0.5), abs=0.02)
    bench.run(20, msg.Position("left", rev(0.5), 0.25, 0.125))
    sent = bench.commanded()[-1]
    assert sent[V] == pytest.approx(0.25 / tau)
    assert sent[T] == 0.125


def test_a_velocity_is_reached_and_names_no_position() -> None:
    bench = ready()
    bench.run(500, msg.Velocity("left", 10.0))
    assert bench.shaft.velocity == pytest.approx(10.0, rel=0.01)
    assert bench.commanded()[-1][P] is None  # left out, it would be 0: the motor would turn there
    assert P in bench.commanded()[-1]


def test_a_torque_is_given_with_all_gains_at_zero() -> None:
    bench = ready()
    bench.shaft.held = True
    bench.run(100, msg.Torque("left", 0.2))
    assert bench.twin.servo.torque() == pytest.approx(0.2, rel=1e-3)
    scales = [Register.COMMAND_KP_SCALE, Register.COMMAND_KD_SCALE, Register.COMMAND_ILIMIT_SCALE]
    assert [bench.commanded()[-1][scale] for scale in scales] == [0.0, 0.0, 0.0]
    assert all(set(scales) <= set(sent) for sent in bench.commanded())  # arming, too, has no gains


@pytest.mark.parametrize(
    "before", [msg.Torque("left", 0.02), msg.Position("left", rev(20.0)), msg.Hold("left")]
)
def test_a_velocity_goes_on_from_where_the_shaft_is(before: Command) -> None:
    """The device's own set-point may stand anywhere: at a goal not reached, or where torque left it."""
    bench = ready()
    bench.run(25, before)
    bench.shaft.position += rev(2.0)
    bench.run(20, before)
    place, since = bench.shaft.position, bench.now
    bench.shaft.velocity = 0.0
    bench.run(100, msg.Velocity("left", 0.0))
    first = bench.commanded(since)[0]
    assert first[P] == pytest.approx(place / tau, abs=0.3)
    assert bench.commanded()[-1][P] is None
    assert abs(bench.shaft.position - place) < rev(0.5)


def test_the_start_of_a_velocity_is_sent_until_a_reply_comes() -> None:
    bench = ready()
    bench.run(60, msg.Position("left", rev(20.0)))
    bench.to_device = lambda _: False
    since = bench.now
    bench.run(50, msg.Velocity("left", 0.0))
    assert all(sent[P] is not None for sent in bench.commanded(since))
    bench.to_device = lambda _: True
    bench.run(100, msg.Velocity("left", 0.0))
    assert bench.commanded()[-1][P] is None


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
        bench.shaft.position, bench.shaft.held = 0.0, True
        since = bench.now
        bench.run(10, command)
        assert bench.commanded(since)[0][P] == 0.0


def test_a_trajectory_of_the_device_keeps_its_limits() -> None:
    options = Options(velocity_limit=rev(1.0), acceleration_limit=rev(4.0))
    bench = ready(device(options=options))
    bench.run(600, msg.Position("left", rev(2.0)))
    assert bench.shaft.velocity == pytest.approx(rev(1.0), rel=0.05)
    bench.run(2500, msg.Position("left", rev(2.0)))
    assert bench.shaft.position == pytest.approx(rev(2.0), abs=0.05)


def test_a_running_device_is_taken_over_without_a_gap() -> None:
    bench = ready()
    bench.shaft.load = 0.1
    bench.run(500, msg.Hold("left"))
    place = bench.shaft.position
    fresh = Bench(bench.devices)
    fresh.twins, fresh.shafts, fresh.now = bench.twins, bench.shafts, bench.now
    fresh.run(30)
    fresh.run(300, msg.Hold("left"))
    assert fresh.sent_messages() == ["position 020 021 022 027"] * len(fresh.sent_messages())
    assert modes(fresh.events) == ["armed"]
    assert fresh.shaft.position == pytest.approx(place, abs=0.1)


# -- idle ---------------------------------------------------------------------------------------------


def test_idle_stops_what_we_armed_until_that_is_confirmed() -> None:
    bench = ready()
    bench.run(200, msg.Velocity("left", 5.0))
    since = bench.now
    bench.run(300, msg.Idle("left"))
    sent = bench.sent_messages(since)
    assert set(sent) == {"stop"}
    assert len(sent) <= 3
    assert bench.twin.servo.mode == Mode.STOPPED
    assert not bench.node.owned


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


@pytest.mark.parametrize("code", FAULTS)
def test_every_fault_is_reported_with_cause_and_remedy_and_left_alone(code: int) -> None:
    bench = ready()
    bench.run(50, msg.Velocity("left", 2.0))
    bench.twin.provoke(code)
    since = bench.now + 20 * MILLISECOND
    reported = of(msg.Fault, bench.run(100))
    text = FAULTS[code]
    assert [(f.code, f.name, f.cause, f.remedy) for f in reported] == [
        (code, text.name, text.cause, text.remedy)
    ]
    bench.run(300, msg.Position("left", 0.0))
    bench.run(300, msg.Idle("left"))
    assert bench.sent_messages(since) == []
    assert bench.twin.servo.mode == (Mode.TIMEOUT if code == TIMEOUT else Mode.FAULT)
    assert modes(bench.events)[-1] == "fault"


def test_clear_stops_and_then_it_arms_again() -> None:
    bench = ready()
    bench.run(50, msg.Hold("left"))
    bench.twin.provoke(38)
    bench.run(50)
    reported = bench.ask(msg.ClearFault("left"), 60)
    assert of(msg.Done, reported)[0].request == "ClearFault"
    assert "stop" in bench.sent_messages(bench.now - 80 * MILLISECOND)
    bench.run(100)
    assert modes(bench.events)[-1] == "armed"


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


def test_what_another_host_stopped_is_still_not_commanded_before_clear() -> None:
    bench = ready()
    bench.run(50, msg.Hold("left"))
    bench.twin.provoke(38)
    bench.run(50)
    bench.twin.receive(bench.now, make_frame(0x0201, b"\x01\x00\x00"))
    bench.run(100)
    assert bench.twin.servo.mode == Mode.STOPPED
    assert modes(bench.events)[-1] == "fault"
    assert of(msg.State, bench.events)[-1].detail == "stopped, not cleared yet"


def test_silence_of_the_host_trips_the_watchdog_which_latches() -> None:
    bench = ready()
    bench.run(200, msg.Velocity("left", 5.0))
    events = bench.quiet(150)  # the driver queries, but nothing is commanded
    assert bench.twin.servo.mode == Mode.TIMEOUT
    assert [f.code for f in of(msg.Fault, events)] == [TIMEOUT]
    assert bench.twin.servo.torque() < 0.0  # it damps
    bench.run(300, msg.Velocity("left", 5.0))
    bench.run(300, msg.Idle("left"))
    assert bench.twin.servo.mode == Mode.TIMEOUT
    bench.ask(msg.ClearFault("left"), 100)
    assert bench.twin.servo.mode == Mode.STOPPED


def test_limits_that_are_active_are_no_faults() -> None:
    bench = ready()
    bench.shaft.held = True
    events = bench.run(300, msg.Torque("left", 50.0))
    assert bench.twin.servo.fault_register() == 99
    assert of(msg.Fault, events) == []
    assert modes(events)[-1] == "armed"


def test_what_limits_the_output_is_reported_once_with_the_state_and_taken_back() -> None:
    bench = ready(device(options=Options(max_torque=0.1)))
    bench.shaft.held = True
    details = [state.detail for state in of(msg.State, bench.run(2000, msg.Torque("left", 1.0)))]
    assert details[-2:] == ["position", "position, limited by the commanded maximum torque"]
    details = [state.detail for state in of(msg.State, bench.run(2000, msg.Torque("left", 0.05)))]
    assert details == ["position"]
    bench.run(50, msg.Torque("left", 1.0))
    assert of(msg.State, bench.run(100, msg.Idle("left")))[-1].detail == "stopped"


def test_limits_that_come_and_go_with_every_reply_are_reported_once() -> None:
    bench = ready()
    bench.run(100, msg.Hold("left"))
    reported = list[msg.State]()
    for i in range(500):  # at 200 Hz: none, the current, none, the torque
        frame = f"21000a2f01{'00000000' * 3}210f{(0, 99, 0, 102)[i % 4]:02x}"
        events = bench.driver.receive(
            bench.now + i * 5_000_000, make_frame(reply_id(1), bytes.fromhex(frame))
        )
        reported += of(msg.State, events)
    assert [state.detail for state in reported] == [
        "position, limited by servo.max_current_A",
        "position, limited by servo.max_current_A and the commanded maximum torque",
    ]


@pytest.mark.parametrize(
    ("mode", "detail"), [(1, "fault"), (11, "timeout"), (0, "stopped"), (3, "calibrating")]
)
def test_a_limit_is_reported_of_an_armed_device_only(mode: int, detail: str) -> None:
    bench = ready()
    limited = "21000a2f01000000000000000000000000210f63"
    bench.driver.receive(bench.now, make_frame(reply_id(1), bytes.fromhex(limited)))
    frame = make_frame(reply_id(1), bytes.fromhex(limited.replace("0a", f"{mode:02x}", 1)))
    assert of(msg.State, bench.driver.receive(bench.now + 1, frame))[-1].detail == detail


def test_a_limit_from_before_the_bus_was_lost_is_not_reported() -> None:
    bench = ready()
    armed = f"21000a2f01{'00000000' * 3}210f"
    limited, free = (make_frame(reply_id(1), bytes.fromhex(armed + code)) for code in ("63", "00"))
    (state,) = of(msg.State, bench.driver.receive(bench.now, limited))
    assert state.detail == "position, limited by servo.max_current_A"
    bench.driver.bus(bench.now + 1, BusState.BACK)
    (state,) = of(msg.State, bench.driver.receive(bench.now + 2, free))
    assert state.detail == "position"


def test_a_device_that_does_not_arm_is_a_fault() -> None:
    bench = ready(device(settings=Settings(enable_ms=100_000)))
    reported = of(msg.Fault, bench.run(1500, msg.Hold("left")))
    assert [f.code for f in reported] == [NOT_ARMED]
    assert "enabling" in reported[0].cause
    assert len(of(msg.Fault, bench.run(1500, msg.Hold("left")))) == 0


# -- the bus ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", [BusState.OFF, BusState.GONE, BusState.BACK])
def test_a_bus_that_was_gone_is_begun_anew(state: BusState) -> None:
    bench = ready()
    bench.run(100, msg.Velocity("left", 1.0))
    bench.ask(msg.ClearFault("left"))
    bench.driver.bus(bench.now, state)
    assert bench.node.mode is None
    reported = bench.run(5)
    assert bool(of(msg.Refused, reported)) == (state is not BusState.BACK)
    assert modes([*reported, *bench.run(50)])[-1] == "armed"


@pytest.mark.parametrize("trouble", ["lost", "late", "doubled", "reordered"])
def test_the_replies_of_one_device_delay_no_other(trouble: str) -> None:
    bench = ready(device("left", 1), device("right", 2))
    held: list[CanFrame] = []

    def arrives(frame: CanFrame) -> tuple[CanFrame, ...]:
        if frame.id != reply_id(1):
            return (frame,)
        if trouble == "lost":
            return ()
        if trouble == "doubled":
            return (frame, frame)
        held.append(frame)
        late = 4 if trouble == "late" else 2
        if len(held) < late:
            return ()
        return (held.pop(0),) if trouble == "late" else (held.pop(), held.pop())

    bench.arrives = arrives
    since = bench.now
    bench.run(600, msg.Velocity("left", 5.0), msg.Velocity("right", 5.0))
    assert bench.shafts[1].velocity == pytest.approx(5.0, rel=0.05)
    assert len(bench.commanded(since, 2)) == pytest.approx(120, abs=3)
    if trouble != "lost":
        assert bench.shafts[0].velocity == pytest.approx(5.0, rel=0.05)
    assert not of(msg.Fault, bench.events)
    assert bench.driver.counters.malformed == 0


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


def test_a_prefix_and_a_host_id_are_used_both_ways() -> None:
    options = Options(can_prefix=0x1ABC, host_id=3)
    bench = ready(device(options=options, address=100))
    bench.run(100, msg.Velocity("left", 2.0))
    assert {f.id for _, f in bench.sent} == {0x1ABC8364}
    assert {f.id for _, f in bench.received} == {0x1ABC6403}
    assert bench.driver.counters.accepted == len(bench.received)
    assert modes(bench.events)[-1] == "armed"


def test_other_frames_are_counted_and_change_nothing() -> None:
    bench = ready()
    before = copy.deepcopy(bench.driver)
    good = bench.received[-1][1]
    ignored: list[Frame] = [
        b"\x01\x02",
        CanFrame(good.id, good.data[:8]),
        CanFrame(good.id, good.data, extended=True, fd=True),
        CanFrame(0x200, good.data, fd=True),
        CanFrame(good.id, b"", remote=True),
        bench.sent[-1][1],
    ]
    bad = [CanFrame(good.id, data, fd=True) for data in (b"\x21", b"\x60", good.data[:17], FAST, bytes(20))]
    for frame in (*ignored, *bad):
        assert bench.driver.receive(bench.now, frame) == []
    assert bench.driver.counters.ignored == before.counters.ignored + len(ignored)
    assert bench.driver.counters.malformed == before.counters.malformed + len(bad)
    assert bench.driver.send(bench.now, [msg.Hold("left")]) == before.send(bench.now, [msg.Hold("left")])
