"""The driver against the twin, in virtual time: reading, arming, every mode, attaching, faults, requests, and
what happens when frames or devices are lost.
"""

from __future__ import annotations

import copy
import math
from itertools import pairwise
from typing import Any

import pytest

from protocols.cia402 import objects as o
from protocols.cia402.codec import Emcy, encode
from protocols.cia402.complaints import DUPLICATE_NODE, NOT_ARMED, NOT_CONFIGURED, QUICK_STOPPED, WRONG_DEVICE
from protocols.cia402.faults import FAULTS, HEARTBEAT_LOST
from protocols.cia402.options import Options, Settings
from protocols.cia402.profile import Mode as Operation
from protocols.cia402.profile import PowerState, mode_bit
from protocols.wire import BusState, CanFrame
from protocols.words import (
    MILLISECOND,
    ClearFault,
    Command,
    Done,
    Estop,
    Fault,
    Found,
    Hold,
    Home,
    Idle,
    Impedance,
    Mode,
    Parameter,
    Position,
    ReadParameter,
    Reboot,
    Refused,
    Request,
    Scan,
    State,
    Stop,
    Torque,
    Velocity,
    WriteParameter,
    Zero,
)
from tests.protocols.cia402.driver_stage import Stage, stage

A = "alpha"
PROFILE = Options(modes="profile")
BY_SDO = Options(mapping="keep")
EVENT = Options(feedback="event")
POLLED = Options(feedback="sdo")
ALL = {"sync": Options(), "event": EVENT, "polled": POLLED, "keep": BY_SDO, "profile": PROFILE}
KINDS: dict[str, Command] = {
    "hold": Hold(A),
    "position": Position(A, 1.5),
    "velocity": Velocity(A, 2.0),
    "torque": Torque(A, 0.05),
}


def said(s: Stage, id_: int) -> list[bytes]:
    return [frame.data for frame in s.down if frame.id == id_]


# -- unclaimed ------------------------------------------------------------------------------------------


def test_until_commanded_it_only_uploads() -> None:
    s = stage(count=2)
    s.steps(400, Idle(A), Idle("beta"))
    assert s.down
    assert {f.id for f in s.down} == {0x601, 0x602}
    assert {f.data[0] & 0xEF for f in s.down} == {0x40, 0x60}


def test_is_initialising_until_units_and_identity_are_read_then_ready() -> None:
    s = stage()
    s.until(Mode.READY)
    assert s.of(State)[0].mode is Mode.INITIALISING
    uploads = [(f.data[1] | f.data[2] << 8, f.data[3]) for f in s.down]
    assert {o.ENCODER_INCREMENTS, o.GEAR_MOTOR, o.FEED, o.RATED_TORQUE, o.SUPPORTED_MODES} <= set(uploads)
    assert {o.SERIAL_NUMBER, o.DEVICE_NAME, (0x1400, 1), (0x1803, 1)} <= set(uploads)
    assert s.node.title == "twin402"


def test_the_motion_is_told_while_the_drive_is_configured_and_armed() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    s.steps(50, Hold(A))
    told = [f.t for f in s.feedback if f.position is not None]
    gaps = [after - before for before, after in pairwise(told)]
    assert max(gaps) <= 25 * MILLISECOND
    assert any(
        frame.id == 0x601 and frame.data[:3] == b"\x23\x00\x1a" for frame in s.down
    )  # it was configured


def test_units_are_the_drive_s_own() -> None:
    settings = Settings(encoder_increments=4096, gear_motor=50, gear_shaft=1, feed=360_000, rated_torque=200)
    s = stage(settings=settings, position=1.0)
    s.until(Mode.READY)
    s.steps(40)
    position = [f.position for f in s.feedback if f.position is not None][-1]
    assert position == pytest.approx(1.0, abs=math.tau / 4096 / 50 + math.tau / 360_000)
    assert s.node.units.gear == 50


@pytest.mark.parametrize(
    ("options", "wrong"),
    [(Options(), True), (Options(counts_per_turn=1000.0), False)],
)
def test_without_units_it_is_not_commanded_unless_the_robot_file_says_them(
    options: Options, wrong: bool
) -> None:
    s = stage(options)
    s.twin.axis.dictionary.read = lambda key, read=s.twin.axis.dictionary.read: (
        (0x06020000, b"") if key[0] in (0x608F, 0x6091, 0x6092) else read(key)
    )
    if wrong:
        s.until(Mode.FAULT)
        (fault,) = s.of(Fault)
        assert fault.code == WRONG_DEVICE
        assert "counts_per_turn" in fault.cause
        s.steps(50, Velocity(A, 1.0))
        assert not s.writes()
    else:
        s.until(Mode.READY)
        assert s.node.units.per_turn == 1000.0


def test_another_profile_is_no_drive() -> None:
    s = stage()
    s.twin.axis.dictionary.values[o.DEVICE_TYPE] = 401
    s.until(Mode.FAULT)
    assert "401" in s.of(Fault)[0].cause


# -- arming ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("options", ALL)
def test_arms_in_every_mode_from_the_measured_position(options: str, kind: str) -> None:
    s = stage(ALL[options], position=0.7)
    s.stage.shafts[A].locked = True
    s.until(Mode.READY)
    heard: list[Any] = []
    for _ in range(400):
        heard += [w for w in s.step(KINDS[kind]).heard if isinstance(w, Position | Velocity | Torque)]
        if s.stage.armed[A] is Mode.ARMED:
            break
    enabled = s.twin.axis
    assert enabled.enabled
    if options != "profile" or kind not in ("position", "hold"):  # PP: nothing before its first set-point
        still: dict[str, Command] = {"velocity": Velocity(A, 0.0), "torque": Torque(A, 0.0)}
        place = enabled.units.position(enabled.units.to_position(0.7))
        assert heard[:1] == [still.get(kind, Position(A, place))]
    cyclic = {"hold": 8, "position": 8, "velocity": 9, "torque": 10}
    profile = {"hold": 1, "position": 1, "velocity": 3, "torque": 4}
    assert enabled.mode == (profile if options == "profile" else cyclic)[kind]


@pytest.mark.parametrize("options", ALL)
def test_the_controlwords_come_in_order(options: str) -> None:
    s = stage(ALL[options])
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    words = [int.from_bytes(data[:2], "little") for data in said(s, 0x201)]
    words += [value for index, _, value in s.writes() if index == 0x6040]
    assert list(dict.fromkeys(word & 0x0F for word in words)) == [0x06, 0x07, 0x0F]


def test_moves_and_follows_each_command() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    s.steps(600, Position(A, 0.5))
    assert s.stage.shafts[A].position == pytest.approx(0.5, abs=0.01)
    s.steps(500, Velocity(A, 2.0))
    assert s.stage.shafts[A].velocity == pytest.approx(2.0, abs=0.1)
    s.steps(100, Torque(A, 0.03))
    assert s.twin.axis.dictionary.values[o.TARGET_TORQUE] == 30
    s.steps(600, Hold(A))
    assert abs(s.stage.shafts[A].velocity) < 0.05


def test_pp_hands_over_by_bit_4_and_the_newest_target_wins() -> None:
    s = stage(Options(modes="profile", feedback="event", feedback_ms=5))
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    s.forget()
    for at in range(100):
        s.step(Position(A, 0.001 * at))
    words = [int.from_bytes(data[:2], "little") for data in said(s, 0x201)]
    rises = sum(not one & 0x10 and bool(two & 0x10) for one, two in pairwise(words))
    assert rises >= 5
    assert all(word & 0x20 for word in words), "change immediately"
    s.steps(50, Position(A, 0.123))
    assert s.stage.shafts[A].position == pytest.approx(0.123, abs=0.02)
    assert s.node.setpoint == s.node.units.to_position(0.123)


def test_feed_forwards_stand_in_60b1_and_60b2() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    s.steps(30, Position(A, 0.0, 1.0, 0.05))
    values = s.twin.axis.dictionary.values
    assert values[o.VELOCITY_OFFSET] == s.node.units.to_velocity(1.0)
    assert values[o.TORQUE_OFFSET] == 50
    s.steps(30, Velocity(A, 1.0))
    assert (values[o.VELOCITY_OFFSET], values[o.TORQUE_OFFSET]) == (0, 0)


def test_a_drive_without_cyclic_modes_gets_the_profile_ones() -> None:
    modes = sum(mode_bit(m) for m in (Operation.PP, Operation.PV))
    s = stage(settings=Settings(supported_modes=modes))
    s.until(Mode.READY)
    s.until(Mode.ARMED, Velocity(A, 1.0))
    assert s.twin.axis.mode is Operation.PV
    s.forget()
    s.steps(3, Torque(A, 0.1))
    (refused,) = s.of(Refused)
    assert "6502" in refused.reason or "torque" in refused.reason


def test_a_drive_that_does_not_follow_the_controlword_is_a_fault_and_not_tried_again() -> None:
    s = stage()
    s.until(Mode.READY)
    s.twin.axis._demand = lambda _: ()  # safe torque off: it stays where it is
    s.steps(1600, Hold(A))
    faults = s.of(Fault)
    assert [fault.code for fault in faults] == [NOT_ARMED]
    assert "SWITCH ON DISABLED" in faults[0].cause
    s.forget()
    s.steps(300, Hold(A))
    assert not said(s, 0x201)
    del s.twin.axis._demand
    s.step(ClearFault(A), Hold(A))
    s.until(Mode.ARMED, Hold(A))


def test_a_refused_configuration_is_told_in_words() -> None:
    s = stage()
    s.until(Mode.READY)
    refuse = s.twin.axis.dictionary._refuse
    s.twin.axis.dictionary._refuse = lambda key, value: (
        0x08000022 if key == o.CONSUMER_HEARTBEAT else refuse(key, value)
    )
    s.steps(200, Hold(A))
    (fault,) = s.of(Fault)
    assert fault.code == NOT_CONFIGURED
    assert fault.cause.startswith("1016:01: the device's present state")


def test_what_cannot_be_mapped_goes_by_sdo() -> None:
    s = stage()
    s.until(Mode.READY)
    refuse = s.twin.axis.dictionary._refuse
    s.twin.axis.dictionary._refuse = lambda key, value: (
        0x06040041 if key[0] == 0x1601 and key[1] else refuse(key, value)
    )
    s.until(Mode.ARMED, Velocity(A, 1.0))
    s.steps(100, Velocity(A, 1.0))
    assert (0x60FF, 0, s.node.units.to_velocity(1.0)) in s.writes()
    assert s.twin.axis.dictionary.values[o.TARGET_VELOCITY] == s.node.units.to_velocity(1.0)


# -- disarming ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", ALL)
def test_idle_disarms_and_then_only_asks(options: str) -> None:
    s = stage(ALL[options])
    s.until(Mode.READY)
    s.until(Mode.ARMED, Velocity(A, 1.0))
    s.until(Mode.READY, Idle(A), most=100)
    assert not s.twin.axis.enabled
    s.steps(100, Idle(A))
    assert s.twin.axis.dictionary.values[o.CONSUMER_HEARTBEAT] == 0
    s.forget()
    s.steps(200, Idle(A))
    assert not s.writes()
    assert {f.id for f in s.down} <= {0x601}


@pytest.mark.parametrize("at", [1, 5, 20, 60, 70, 80, 90, 100])
def test_idle_disarms_in_the_middle_of_arming(at: int) -> None:
    s = stage()
    s.until(Mode.READY)
    s.steps(at, Hold(A))
    s.steps(250, Idle(A))
    assert not s.twin.axis.enabled
    assert not s.node.claimed
    s.until(Mode.ARMED, Hold(A))


def test_idle_to_what_somebody_else_armed_says_nothing_and_an_operator_s_stop_disarms() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    s.fresh()
    s.steps(300, Idle(A))
    assert s.twin.axis.enabled
    assert not s.writes()
    s.step(Stop("enough"), Idle(A))
    s.steps(200, Idle(A))
    assert not s.twin.axis.enabled


def test_a_lost_controlword_is_said_again_by_sdo() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    hear = s.twin.receive
    s.twin.receive = lambda t, wire: None if wire.id == 0x201 else hear(t, wire)
    s.until(Mode.READY, Idle(A), most=300)
    assert (0x6040, 0, 0x06) in s.writes()


# -- attaching ------------------------------------------------------------------------------------------


def test_a_running_device_is_taken_over_without_remapping_or_a_gap() -> None:
    s = stage()
    s.stage.shafts[A].load = -0.2
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    s.steps(600, Hold(A))
    s.fresh()
    least = 1.0
    for at in range(600):
        step = s.step(*([Hold(A)] if at > 150 else []))
        least = min(least, *(torque.torque for torque in step.torques))
    assert least > 0.1
    assert {index for index, _, _ in s.writes()} == {0x1016}
    assert s.node.armed
    assert 0x000 not in {f.id for f in s.down}


def test_pdos_that_fit_are_left_and_those_that_do_not_are_written() -> None:
    s = stage(settings=Settings(pdos="usual"))
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    assert {index for index, _, _ in s.writes()} == {0x1016}
    other = stage()
    other.until(Mode.READY)
    other.until(Mode.ARMED, Hold(A))
    assert {0x1400, 0x1600, 0x1800, 0x1A00} <= {index for index, _, _ in other.writes()}


# -- faults ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", [0x2310, 0x3210, 0x8611])
def test_a_fault_is_told_with_its_words_and_cleared_only_when_asked(code: int) -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    s.twin.provoke(code)
    s.until(Mode.FAULT, Hold(A))
    (fault,) = s.of(Fault)
    words = FAULTS[code]
    assert (fault.code, fault.name, fault.cause, fault.cure) == (code, words.name, words.cause, words.cure)
    s.forget()
    s.steps(400, Hold(A))
    assert 0x80 not in [value for index, _, value in s.writes() if index == 0x6040]
    assert not s.of(Fault)
    s.step(ClearFault(A), Idle(A))
    s.steps(50, Idle(A))
    assert [value for index, _, value in s.writes() if index == 0x6040][:2] == [0x00, 0x80]
    assert isinstance(s.of(Done)[-1], Done)
    assert s.stage.armed[A] is Mode.READY
    s.until(Mode.ARMED, Hold(A))


def test_a_fault_that_was_there_before_is_told_from_603f() -> None:
    s = stage()
    s.until(Mode.READY)
    s.twin.provoke(0x3220)
    s.steps(5)
    s.fresh()
    s.until(Mode.FAULT)
    assert [fault.code for fault in s.of(Fault)] == [0x3220]


@pytest.mark.parametrize("stands", [False, True], ids=["goes", "stands"])
@pytest.mark.parametrize("name", ["sync", "polled"])
def test_a_fault_told_by_emcy_is_cleared_only_by_what_a_newer_statusword_says(
    name: str, stands: bool
) -> None:
    s = stage(ALL[name])
    s.until(Mode.ARMED, Hold(A))
    s.twin.provoke(0x2310)
    s.twin.axis.fault_stands = stands
    while not s.of(Fault):
        s.step(Hold(A))
    assert s.node.power is PowerState.OPERATION_ENABLED  # as far as it has said
    s.forget()
    s.step(ClearFault(A), Idle(A))
    assert not s.of(Done)
    s.steps(3100, Idle(A))
    if stands:
        assert not s.of(Done)
        assert "still in fault" in s.of(Refused)[0].reason
        assert s.stage.armed[A] is Mode.FAULT
    else:
        assert [done.request for done in s.of(Done)] == ["ClearFault"]
        assert s.twin.axis.state is not PowerState.FAULT
        assert s.stage.armed[A] is Mode.READY


def test_an_emergency_that_no_statusword_confirms_is_cleared_without_a_word_to_the_drive() -> None:
    s = stage()
    s.until(Mode.ARMED, Hold(A))
    s.forget()
    s.step(ClearFault(A), Hold(A), stray=[encode(Emcy(1, 0x2310, 1, bytes(5)))])
    s.step(ClearFault(A), Hold(A))
    s.steps(20, Hold(A))
    assert len(s.of(Done)) == 2
    assert s.twin.axis.state is PowerState.OPERATION_ENABLED
    assert 0x80 not in [value for index, _, value in s.writes() if index == 0x6040]


def test_a_fault_that_stands_is_refused_to_be_cleared_and_told_again() -> None:
    s = stage()
    s.until(Mode.READY)
    s.twin.provoke(0x4310)
    s.twin.axis.fault_stands = True
    s.until(Mode.FAULT)
    s.forget()
    s.step(ClearFault(A))
    s.steps(3100)
    assert "still in fault" in s.of(Refused)[0].reason
    assert [fault.code for fault in s.of(Fault)] == [0x4310]


def test_silence_of_the_host_trips_the_watchdog_and_a_host_without_words_is_silent() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, Velocity(A, 1.0))
    s.steps(200, Velocity(A, 1.0))
    s.forget()
    s.steps(520)
    assert 0x77F not in {f.id for f in s.down}
    assert [fault.code for fault in s.of(Fault)] == [HEARTBEAT_LOST]


def test_the_host_s_heartbeat_goes_only_if_every_armed_device_is_commanded() -> None:
    s = stage(count=2)
    both = [Velocity(A, 1.0), Velocity("beta", 1.0)]
    s.until(Mode.READY)
    for name in (A, "beta"):
        s.until(Mode.ARMED, *both, name=name)
    s.forget()
    s.steps(300, *both)
    assert len(said(s, 0x77F)) in (2, 3)
    s.forget()
    s.steps(700, both[0])
    assert not said(s, 0x77F)


# -- requests -------------------------------------------------------------------------------------------


def test_estop_stops_latches_and_is_cleared() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, Velocity(A, 3.0))
    s.step(Estop(A), Velocity(A, 3.0))
    s.steps(300, Velocity(A, 3.0))
    assert not s.twin.axis.enabled
    assert [fault.code for fault in s.of(Fault)] == [QUICK_STOPPED]
    assert s.stage.armed[A] is Mode.FAULT
    assert s.of(Done)[-1].request == "Estop"
    s.step(ClearFault(A), Idle(A))
    s.steps(20, Idle(A))
    s.until(Mode.ARMED, Hold(A))


@pytest.mark.parametrize("option", [5, 6])
def test_a_quick_stop_that_holds_is_left_without_dropping_the_load(option: int) -> None:
    s = stage(settings=Settings(quick_stop_option=option))
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    s.step(Estop(A), Hold(A))
    s.steps(100, Hold(A))
    assert s.twin.axis.state.value == "QUICK STOP ACTIVE"
    s.forget()
    s.step(ClearFault(A), Hold(A))
    s.until(Mode.ARMED, Hold(A))
    assert {data[0] & 0x0F for data in said(s, 0x201)} == {0x02, 0x0F}


@pytest.mark.parametrize("word", [Home(A), Zero(A)])
def test_homing_needs_hold_and_ends_where_the_shaft_is_zero(word: Request) -> None:
    s = stage(position=2.0)
    s.until(Mode.READY)
    s.step(word)
    assert "hold" in s.of(Refused)[0].reason
    s.until(Mode.ARMED, Hold(A))
    s.step(word, Hold(A))
    s.steps(200, Hold(A))
    assert s.of(Done)[-1].request == type(word).__name__
    position = [f.position for f in s.feedback if f.position is not None][-1]
    assert abs(position) < 0.05
    assert abs(s.stage.shafts[A].position - 2.0) < 0.05
    assert s.twin.axis.mode is Operation.CSP
    assert s.twin.axis.dictionary.values[o.HOMING_METHOD] == 35


def test_homing_that_does_not_end_is_given_up_and_told() -> None:
    s = stage(Options(home_timeout_ms=200))
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    s.twin.axis.dictionary.values[o.HOMING_METHOD] = 33
    s.twin.axis.dictionary.values[o.HOMING_SPEED_ZERO] = 1
    s.step(Home(A), Hold(A))
    s.steps(300, Hold(A))
    assert s.of(Refused)[-1].reason == "it did not end in time"


def test_reboot_is_refused_while_armed_and_done_at_boot_up() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    s.step(Reboot(A), Hold(A))
    assert "idle" in s.of(Refused)[0].reason
    s.steps(200, Idle(A))
    s.step(Reboot(A), Idle(A))
    s.steps(600, Idle(A))
    assert s.of(Done)[-1].request == "Reboot"
    assert s.stage.armed[A] is Mode.READY


@pytest.mark.parametrize(
    ("value", "parameter", "why"),
    [
        (math.nan, "6081", "whole"),
        (0.5, "6081", "whole"),
        (-1.0, "6081", "outside U32"),
        (1.0, "Controlword", "driver's own"),
        (1.0, "1600:01", "driver's own"),
        (1.0, "2000", "not known"),
        (1.0, "no such thing", "no object"),
    ],
)
def test_what_is_not_written(value: float, parameter: str, why: str) -> None:
    s = stage()
    s.until(Mode.READY)
    s.step(WriteParameter(A, parameter, value))
    assert why in s.of(Refused)[0].reason
    assert not s.writes()


def test_parameters_are_read_in_the_drive_s_own_numbers() -> None:
    s = stage()
    s.until(Mode.READY)
    s.step(ReadParameter(A, "Profile velocity"), ReadParameter(A, "0x6098"))
    s.steps(10)
    assert [(p.parameter, p.value) for p in s.of(Parameter)] == [
        ("Profile velocity", 100_000.0),
        ("0x6098", 35.0),
    ]


def test_a_scan_asks_everybody_and_changes_nothing() -> None:
    s = stage(count=2)
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    s.forget()
    s.step(Scan("bus"), Hold(A))
    s.steps(700, Hold(A))
    assert {found.address for found in s.of(Found)} == {1, 2}
    assert s.of(Done)[-1].detail == "2 devices"
    assert not s.writes()
    assert {f.id for f in s.down if 0x600 < f.id < 0x680} >= set(range(0x603, 0x680))
    assert s.twin.axis.enabled


# -- what is lost ---------------------------------------------------------------------------------------


def test_a_restart_is_told_and_only_a_fresh_sequence_arms_again() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    s.forget()
    s.stage.twins[0] = type(s.twin)(s.stage.devices[0], 3)
    s.until(Mode.INITIALISING, Hold(A))
    s.until(Mode.ARMED, Hold(A))
    words = [int.from_bytes(data[:2], "little") for data in said(s, 0x201)]
    assert [w for w in dict.fromkeys(words) if w != 0x0F] == [0x06, 0x07]


def test_a_silent_device_is_offline_in_time_and_the_other_goes_on() -> None:
    s = stage(count=2)
    both = [Hold(A), Hold("beta")]
    s.until(Mode.READY)
    for name in (A, "beta"):
        s.until(Mode.ARMED, *both, name=name)
    plug = s.twin.step
    s.twin.step = lambda now, truth: (plug(now, truth)[0], [])
    s.forget()
    taken = s.until(Mode.OFFLINE, *both)
    assert 480 <= taken <= 505
    assert sum(f.motor == "beta" for f in s.feedback) > 80
    s.twin.step = plug
    s.steps(100, *both)
    assert s.stage.armed[A] is not Mode.OFFLINE


@pytest.mark.parametrize("lost", [2, 3, 5])
def test_lost_answers_are_asked_for_again(lost: int) -> None:
    s = stage(Options(sdo_timeout_ms=20))
    step, count = s.twin.step, 0

    def lossy(now: int, truth: Any) -> Any:
        nonlocal count
        torques, wires = step(now, truth)
        kept = []
        for wire in wires:
            count += 1
            kept += [wire] if count % lost else []
        return torques, kept

    s.twin.step = lossy
    s.until(Mode.READY, most=4000)
    s.until(Mode.ARMED, Velocity(A, 1.0), most=4000)
    s.twin.step = step
    assert s.driver.tally.bad == 0


def test_two_devices_with_one_node_id_are_noticed() -> None:
    s = stage()
    s.until(Mode.READY)
    s.stage.twins.append(copy.deepcopy(s.twin))
    s.stage.devices = (s.stage.devices[0], s.stage.devices[0])
    s.stage.specs = (s.stage.specs[0], s.stage.specs[0])
    s.steps(1500)
    assert [fault.code for fault in s.of(Fault)] == [DUPLICATE_NODE]
    (found,) = s.of(Found)
    assert found.twice
    assert found.address == 1


def test_an_answer_that_came_twice_once_is_nothing() -> None:
    s = stage()
    s.until(Mode.READY)
    s.steps(30)
    for _ in range(20):
        answers = [w for w in s.up[-3:] if w.id == 0x581]
        s.step(stray=answers[:1])
        s.steps(40)
    assert not s.of(Fault)


@pytest.mark.parametrize("state", [BusState.GONE, BusState.OFF])
def test_a_bus_that_vanished_ends_requests_and_forgets(state: BusState) -> None:
    s = stage()
    s.until(Mode.READY)
    s.step(ReadParameter(A, "6081"), Scan("bus"))
    s.driver.bus(s.stage.now, state)
    s.step()
    assert {refused.request for refused in s.of(Refused)} == {"ReadParameter", "Scan"}
    assert s.node.known is None


# -- construction and refusal ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command",
    [
        Position(A, math.nan),
        Velocity(A, math.inf),
        Torque(A, 1e6),
        Position(A, 1e12),
        Impedance(A, 0.0, 0.0, 0.0, 1.0, 1.0),
        Velocity("nobody", 1.0),
    ],
)
def test_what_must_not_pass_is_refused_once_and_puts_nothing_on_the_wire(command: Command) -> None:
    s = stage()
    s.until(Mode.READY)
    s.forget()
    s.steps(60, command)
    assert len(s.of(Refused)) == 1
    assert not s.writes()
    assert {f.id for f in s.down} <= {0x601}


def test_every_frame_is_counted_once() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    driver = s.driver
    for frame, kind in (
        (CanFrame(0x581, b"\x4b\x41\x60\x00\x50\x02\0\0"), "heard"),
        (CanFrame(0x581, b"\x4b\x41\x60"), "bad"),
        (CanFrame(0x581, b"\xe0" + bytes(7)), "bad"),
        (CanFrame(0x701, b"\x05"), "heard"),
        (CanFrame(0x701, b"\x06"), "bad"),
        (CanFrame(0x081, bytes(8)), "heard"),
        (CanFrame(0x081, bytes(7)), "bad"),
        (CanFrame(0x181, bytes(6)), "bad"),
        (CanFrame(0x481, bytes(6)), "heard"),
        (CanFrame(0x201, bytes(8)), "foreign"),
        (CanFrame(0x601, bytes(8)), "foreign"),
        (CanFrame(0x080, b""), "heard"),
        (CanFrame(0x080, b"\1\2"), "foreign"),
        (CanFrame(0x585, bytes(8)), "foreign"),
        (CanFrame(0x581, bytes(8), extended=True), "foreign"),
        (CanFrame(0x581, b"", remote=True), "foreign"),
        (CanFrame(0x581, bytes(8), fd=True), "foreign"),
    ):
        before = copy.copy(driver.tally)
        driver.receive(s.stage.now, frame)
        assert getattr(driver.tally, kind) == getattr(before, kind) + 1, str(frame)
        assert sum(driver.tally.__getattribute__(k) for k in ("heard", "bad", "foreign")) == (
            before.heard + before.bad + before.foreign + 1
        )
