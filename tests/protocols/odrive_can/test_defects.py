"""The defects found in existing drivers, as far as they concern this language: none of them is in this one.

Each test names the defect. (7, 11-bit frames for a 29-bit device, and 13, whole units on the wire, have their
own form here; the rest follow the list: NaN, wrapped feed-forward, waiting without end, uninitialised
frames, faults wiped, own frames believed, fault bits ignored, polling by clearing, first frame lost,
silence not told, old state as new, finding by enabling.)
"""

from __future__ import annotations

import math

import pytest
from numpy.random import PCG64, Generator

from protocols import messages as msg
from protocols.frames import BusState, CanFrame
from protocols.messages import MILLISECOND, Command, Mode
from protocols.odrive_can.codec import TABLES, encode, radians, turns
from protocols.odrive_can.faults import Error
from protocols.odrive_can.messages import (
    ClearErrors,
    GetEncoderEstimates,
    Heartbeat,
    SetAxisState,
    SetControllerMode,
    SetInputPos,
)
from tests.protocols.helpers import of
from tests.protocols.odrive_can.helpers import Bench, device, ready


def test_1_nan_never_becomes_motion() -> None:
    bench = ready()
    bench.run(400, msg.Position("left", 1.0))
    start = bench.now
    for bad in (math.nan, math.inf, -math.inf):
        words: list[Command] = [msg.Position("left", bad), msg.Velocity("left", bad), msg.Torque("left", bad)]
        for word in words:
            assert of(msg.Refused, bench.run(5, word))
    assert bench.said(since=start) == []


def test_2_a_feed_forward_beyond_int8_arrives_as_it_was_said() -> None:
    bench = ready()
    bench.run(400, msg.Position("left", 0.0))
    for value in (0.127, 0.128, -0.129, 1.0, 20.0, -32.0):
        bench.run(5, msg.Position("left", 0.0, radians(value), value / 100))
        assert bench.twin.axis.velocity == pytest.approx(value, abs=0.0005)
        assert bench.twin.axis.torque == pytest.approx(value / 100, abs=0.0005)


def test_3_a_silent_device_lets_every_request_end() -> None:
    bench = Bench([device()])
    bench.to_device = lambda frame: False
    bench.from_device = lambda frame: False
    bench.run(1)
    assert [r.reason for r in of(msg.Refused, bench.ask(msg.ClearFault("left"), 700))] == [
        "no reply from the device"
    ]


def test_4_every_frame_that_goes_out_is_a_message_of_the_table_in_full() -> None:
    bench = ready()
    words: list[Command] = [
        msg.Velocity("left", 3.0),
        msg.Position("left", 1.0),
        msg.Torque("left", 0.01),
        msg.Hold("left"),
    ]
    for word in words:
        bench.run(400, word)
    bench.run(300, msg.Idle("left"))
    lengths = {layout.cmd: layout.dlc for layout in TABLES["0.6"].layouts}
    assert {len(f.data) - lengths[f.id & 0x1F] for _, f in bench.sent if not f.remote} == {0}
    assert len(bench.said()) == len([f for _, f in bench.sent if not f.remote])


def test_5_a_fault_survives_a_mode_switch_and_the_first_setpoint_is_where_the_shaft_is() -> None:
    bench = ready()
    bench.shaft.position = radians(-8.125)
    bench.run(50)
    bench.run(400, msg.Position("left", 0.0))
    first = next(m for m in bench.said() if isinstance(m, SetInputPos))
    assert first.position == pytest.approx(-8.125, abs=1e-3)
    bench.twin.trip(Error.DRV_FAULT)
    for word in (msg.Velocity("left", 1.0), msg.Torque("left", 0.0), msg.Position("left", 0.0)):
        bench.run(300, word)
    assert bench.twin.errors == Error.DRV_FAULT
    assert of(msg.State, bench.events)[-1].mode is Mode.FAULT


def test_6_its_own_frames_teach_it_nothing() -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 20.0))
    nodes = repr(vars(bench.driver.axes[1]))
    for _, frame in bench.sent:
        assert bench.driver.receive(bench.now, frame) == []
    assert repr(vars(bench.driver.axes[1])) == nodes


def test_7_all_frames_have_standard_identifiers() -> None:
    bench = ready(device("left", 62))
    bench.run(400, msg.Velocity("left", 20.0))
    bench.ask(msg.Scan("can0"), 2000)
    assert all(not f.extended and not f.fd and f.id < 0x800 for _, f in bench.sent)
    assert encode(62, SetAxisState(8)).id == 0x7C7


def test_8_all_fault_bits_of_one_heartbeat_are_told_with_text() -> None:
    bench = ready()
    word = sum(error for error in Error)
    faults = of(msg.Fault, bench.driver.receive(bench.now, encode(1, Heartbeat(word, 1, 3, 0))))
    assert [f.name for f in faults] == [error.name for error in Error if error is not Error.INITIALIZING]
    assert all(f.cause and f.remedy for f in faults)


def test_9_nothing_is_cleared_without_a_request() -> None:
    bench = ready()
    words: list[Command] = [
        msg.Idle("left"),
        msg.Velocity("left", 1.0),
        msg.Hold("left"),
        msg.Torque("left", 0.0),
    ]
    for word in words:
        bench.twin.trip(Error.ESTOP_REQUESTED)
        bench.run(400, word)
        bench.driver.bus(bench.now, BusState.BACK)
    assert [m for m in bench.said() if isinstance(m, ClearErrors)] == []


def test_10_the_first_frame_counts_and_a_full_queue_is_taken_note_of() -> None:
    bench = Bench([device()])
    assert len(bench.driver.receive(0, encode(1, Heartbeat(0, 1, 0, 0)))) == 1
    bench.run(900, msg.Velocity("left", 5.0))
    start = bench.now
    bench.driver.bus(bench.now, BusState.FULL)
    bench.run(5)
    assert any(isinstance(m, SetControllerMode) for m in bench.said(since=start))


def test_11_silence_is_told_within_the_declared_time() -> None:
    bench = ready()
    last = bench.now
    bench.from_device = lambda frame: False
    (state,) = of(msg.State, bench.run(1000))
    assert state.mode is Mode.OFFLINE
    assert state.t <= last + 250 * MILLISECOND


def test_12_feedback_is_as_old_as_its_frame_and_none_is_made_up() -> None:
    bench = ready()
    bench.from_device = lambda frame: False
    assert of(msg.Feedback, bench.run(500, msg.Velocity("left", 1.0))) == []
    frame = encode(1, GetEncoderEstimates(0.25, 0.5))
    (event,) = bench.driver.receive(123, frame)
    assert event == msg.Feedback("left", 123, position=radians(0.25), velocity=radians(0.5))
    assert isinstance(event, msg.Feedback)
    assert (event.torque, event.current, event.voltage, event.temperature) == (None,) * 4


def test_13_fractions_of_a_unit_survive_the_way_there_and_back() -> None:
    seed = 13
    random = Generator(PCG64(seed))
    bench = ready()
    bench.run(400, msg.Position("left", 0.0))
    for turn in range(50):
        position = float(random.uniform(-3.0, 3.0))
        bench.run(5, msg.Position("left", position))
        assert bench.twin.axis.position == pytest.approx(turns(position), rel=1e-6), (seed, turn)
    bench.run(2000, msg.Position("left", 0.123))
    assert bench.driver.axes[1].position == pytest.approx(turns(0.123), abs=1e-3)


def test_14_looking_for_devices_enables_none() -> None:
    bench = Bench([device()])
    bench.ask(msg.Scan("can0"), 3000)
    said = bench.said()
    assert said == []
    assert all(isinstance(f, CanFrame) and f.remote for _, f in bench.sent)
    assert not bench.twin.axis.armed
