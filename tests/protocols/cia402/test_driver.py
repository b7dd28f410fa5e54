"""The driver against the twin, in virtual time: reading, arming, each mode, letting go, attaching."""

from __future__ import annotations

import copy
import math
from itertools import pairwise
from typing import Any

import pytest

from protocols import messages as msg
from protocols.cia402 import objects as o
from protocols.cia402.faults import NOT_ARMED, NOT_CONFIGURED, WRONG_DEVICE
from protocols.cia402.options import Options, Settings
from protocols.cia402.profile import Mode as Operation
from protocols.cia402.profile import mode_bit
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Command, Mode
from tests.protocols.cia402.driver_stage import ALL, stage

A = "alpha"
KINDS: dict[str, Command] = {
    "hold": msg.Hold(A),
    "position": msg.Position(A, 1.5),
    "velocity": msg.Velocity(A, 2.0),
    "torque": msg.Torque(A, 0.05),
}


# -- unclaimed ------------------------------------------------------------------------------------------


def test_until_commanded_it_only_uploads() -> None:
    s = stage(count=2)
    s.steps(400, msg.Idle(A), msg.Idle("beta"))
    assert s.down
    assert {f.id for f in s.down} == {0x601, 0x602}
    assert {f.data[0] & 0xEF for f in s.down} == {0x40, 0x60}


def test_is_initialising_until_units_and_identity_are_read_then_ready() -> None:
    s = stage()
    s.until(Mode.READY)
    assert s.of(msg.State)[0].mode is Mode.INITIALISING
    uploads = [(f.data[1] | f.data[2] << 8, f.data[3]) for f in s.down]
    assert {o.ENCODER_INCREMENTS, o.GEAR_MOTOR, o.FEED, o.RATED_TORQUE, o.SUPPORTED_MODES} <= set(uploads)
    assert {o.SERIAL_NUMBER, o.DEVICE_NAME, (0x1400, 1), (0x1803, 1)} <= set(uploads)
    assert s.drive.device_name == "twin402"


def test_the_motion_is_told_while_the_drive_is_configured_and_armed() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.steps(50, msg.Hold(A))
    reported = [f.t for f in s.feedback if f.position is not None]
    gaps = [after - before for before, after in pairwise(reported)]
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
    assert s.drive.units.gear == 50


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
        (fault,) = s.of(msg.Fault)
        assert fault.code == WRONG_DEVICE
        assert "counts_per_turn" in fault.cause
        s.steps(50, msg.Velocity(A, 1.0))
        assert not s.writes()
    else:
        s.until(Mode.READY)
        assert s.drive.units.per_turn == 1000.0


def test_another_profile_is_no_drive() -> None:
    s = stage()
    s.twin.axis.dictionary.values[o.DEVICE_TYPE] = 401
    s.until(Mode.FAULT)
    assert "401" in s.of(msg.Fault)[0].cause


# -- arming ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("options", ALL)
def test_arms_in_every_mode_from_the_measured_position(options: str, kind: str) -> None:
    s = stage(ALL[options], position=0.7)
    s.stage.shafts[A].locked = True
    s.until(Mode.READY)
    received: list[Any] = []
    for _ in range(400):
        received += [
            w for w in s.step(KINDS[kind]).received if isinstance(w, msg.Position | msg.Velocity | msg.Torque)
        ]
        if s.stage.modes[A] is Mode.ARMED:
            break
    enabled = s.twin.axis
    assert enabled.enabled
    if options != "profile" or kind not in ("position", "hold"):  # PP: nothing before its first set-point
        still: dict[str, Command] = {"velocity": msg.Velocity(A, 0.0), "torque": msg.Torque(A, 0.0)}
        place = enabled.units.position(enabled.units.to_position(0.7))
        assert received[:1] == [still.get(kind, msg.Position(A, place))]
    cyclic = {"hold": 8, "position": 8, "velocity": 9, "torque": 10}
    profile = {"hold": 1, "position": 1, "velocity": 3, "torque": 4}
    assert enabled.mode == (profile if options == "profile" else cyclic)[kind]


@pytest.mark.parametrize("options", ALL)
def test_the_controlwords_come_in_order(options: str) -> None:
    s = stage(ALL[options])
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    words = [int.from_bytes(data[:2], "little") for data in s.said(0x201)]
    words += [value for index, _, value in s.writes() if index == 0x6040]
    assert list(dict.fromkeys(word & 0x0F for word in words)) == [0x06, 0x07, 0x0F]


def test_moves_and_follows_each_command() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.steps(600, msg.Position(A, 0.5))
    assert s.stage.shafts[A].position == pytest.approx(0.5, abs=0.01)
    s.steps(500, msg.Velocity(A, 2.0))
    assert s.stage.shafts[A].velocity == pytest.approx(2.0, abs=0.1)
    s.steps(100, msg.Torque(A, 0.03))
    assert s.twin.axis.dictionary.values[o.TARGET_TORQUE] == 30
    s.steps(600, msg.Hold(A))
    assert abs(s.stage.shafts[A].velocity) < 0.05


def test_pp_hands_over_by_bit_4_and_the_newest_target_wins() -> None:
    s = stage(Options(modes="profile", feedback="event", feedback_ms=5))
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.forget()
    for at in range(100):
        s.step(msg.Position(A, 0.001 * at))
    words = [int.from_bytes(data[:2], "little") for data in s.said(0x201)]
    rises = sum(not one & 0x10 and bool(two & 0x10) for one, two in pairwise(words))
    assert rises >= 5
    assert all(word & 0x20 for word in words), "change immediately"
    s.steps(50, msg.Position(A, 0.123))
    assert s.stage.shafts[A].position == pytest.approx(0.123, abs=0.02)
    assert s.drive.pp_target == s.drive.units.to_position(0.123)


def test_feed_forwards_stand_in_60b1_and_60b2() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.steps(30, msg.Position(A, 0.0, 1.0, 0.05))
    values = s.twin.axis.dictionary.values
    assert values[o.VELOCITY_OFFSET] == s.drive.units.to_velocity(1.0)
    assert values[o.TORQUE_OFFSET] == 50
    s.steps(30, msg.Velocity(A, 1.0))
    assert (values[o.VELOCITY_OFFSET], values[o.TORQUE_OFFSET]) == (0, 0)


def test_a_drive_without_cyclic_modes_gets_the_profile_ones() -> None:
    modes = sum(mode_bit(m) for m in (Operation.PP, Operation.PV))
    s = stage(settings=Settings(supported_modes=modes))
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Velocity(A, 1.0))
    assert s.twin.axis.mode is Operation.PV
    s.forget()
    s.steps(3, msg.Torque(A, 0.1))
    (refused,) = s.of(msg.Refused)
    assert "6502" in refused.reason or "torque" in refused.reason


def test_a_drive_that_does_not_follow_the_controlword_is_a_fault_and_not_tried_again() -> None:
    s = stage()
    s.until(Mode.READY)
    s.twin.axis._demand = lambda _: ()  # safe torque off: it stays where it is
    s.steps(1600, msg.Hold(A))
    faults = s.of(msg.Fault)
    assert [fault.code for fault in faults] == [NOT_ARMED]
    assert "SWITCH ON DISABLED" in faults[0].cause
    s.forget()
    s.steps(300, msg.Hold(A))
    assert not s.said(0x201)
    del s.twin.axis._demand
    s.step(msg.ClearFault(A), msg.Hold(A))
    s.until(Mode.ARMED, msg.Hold(A))


def test_a_refused_configuration_is_told_in_words() -> None:
    s = stage()
    s.until(Mode.READY)
    refuse = s.twin.axis.dictionary._refuse
    s.twin.axis.dictionary._refuse = lambda key, value: (
        0x08000022 if key == o.CONSUMER_HEARTBEAT else refuse(key, value)
    )
    s.steps(200, msg.Hold(A))
    (fault,) = s.of(msg.Fault)
    assert fault.code == NOT_CONFIGURED
    assert fault.cause.startswith("1016:01: the device's present state")


def test_what_cannot_be_mapped_goes_by_sdo() -> None:
    s = stage()
    s.until(Mode.READY)
    refuse = s.twin.axis.dictionary._refuse
    s.twin.axis.dictionary._refuse = lambda key, value: (
        0x06040041 if key[0] == 0x1601 and key[1] else refuse(key, value)
    )
    s.until(Mode.ARMED, msg.Velocity(A, 1.0))
    s.steps(100, msg.Velocity(A, 1.0))
    assert (0x60FF, 0, s.drive.units.to_velocity(1.0)) in s.writes()
    assert s.twin.axis.dictionary.values[o.TARGET_VELOCITY] == s.drive.units.to_velocity(1.0)


# -- disarming ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", ALL)
def test_idle_disarms_and_then_only_asks(options: str) -> None:
    s = stage(ALL[options])
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Velocity(A, 1.0))
    s.until(Mode.READY, msg.Idle(A), most=100)
    assert not s.twin.axis.enabled
    s.steps(100, msg.Idle(A))
    assert s.twin.axis.dictionary.values[o.CONSUMER_HEARTBEAT] == 0
    s.forget()
    s.steps(200, msg.Idle(A))
    assert not s.writes()
    assert {f.id for f in s.down} <= {0x601}


@pytest.mark.parametrize("at", [1, 5, 20, 60, 70, 80, 90, 100])
def test_idle_disarms_in_the_middle_of_arming(at: int) -> None:
    s = stage()
    s.until(Mode.READY)
    s.steps(at, msg.Hold(A))
    s.steps(250, msg.Idle(A))
    assert not s.twin.axis.enabled
    assert not s.drive.owned
    s.until(Mode.ARMED, msg.Hold(A))


def test_idle_to_what_somebody_else_armed_says_nothing_and_an_operator_s_stop_disarms() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.fresh()
    s.steps(300, msg.Idle(A))
    assert s.twin.axis.enabled
    assert not s.writes()
    s.step(msg.Stop("enough"), msg.Idle(A))
    s.steps(200, msg.Idle(A))
    assert not s.twin.axis.enabled


def test_a_lost_controlword_is_said_again_by_sdo() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    handle = s.twin.receive
    s.twin.receive = lambda t, frame: None if frame.id == 0x201 else handle(t, frame)
    s.until(Mode.READY, msg.Idle(A), most=300)
    assert (0x6040, 0, 0x06) in s.writes()


# -- attaching ------------------------------------------------------------------------------------------


def test_a_running_device_is_taken_over_without_remapping_or_a_gap() -> None:
    s = stage()
    s.stage.shafts[A].load = -0.2
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.steps(600, msg.Hold(A))
    s.fresh()
    least = 1.0
    for at in range(600):
        step = s.step(*([msg.Hold(A)] if at > 150 else []))
        least = min(least, *(torque.torque for torque in step.torques))
    assert least > 0.1
    assert {index for index, _, _ in s.writes()} == {0x1016}
    assert s.drive.armed
    assert 0x000 not in {f.id for f in s.down}


def test_pdos_that_fit_are_left_and_those_that_do_not_are_written() -> None:
    s = stage(settings=Settings(pdos="usual"))
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    assert {index for index, _, _ in s.writes()} == {0x1016}
    other = stage()
    other.until(Mode.READY)
    other.until(Mode.ARMED, msg.Hold(A))
    assert {0x1400, 0x1600, 0x1800, 0x1A00} <= {index for index, _, _ in other.writes()}


# -- construction and refusal ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command",
    [
        msg.Position(A, math.nan),
        msg.Velocity(A, math.inf),
        msg.Torque(A, 1e6),
        msg.Position(A, 1e12),
        msg.Impedance(A, 0.0, 0.0, 0.0, 1.0, 1.0),
        msg.Velocity("nobody", 1.0),
    ],
)
def test_what_must_not_pass_is_refused_once_and_puts_nothing_on_the_wire(command: Command) -> None:
    s = stage()
    s.until(Mode.READY)
    s.forget()
    s.steps(60, command)
    assert len(s.of(msg.Refused)) == 1
    assert not s.writes()
    assert {f.id for f in s.down} <= {0x601}


def test_every_frame_is_counted_once() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    driver = s.driver
    for frame, kind in (
        (CanFrame(0x581, b"\x4b\x41\x60\x00\x50\x02\0\0"), "accepted"),
        (CanFrame(0x581, b"\x4b\x41\x60"), "malformed"),
        (CanFrame(0x581, b"\xe0" + bytes(7)), "malformed"),
        (CanFrame(0x701, b"\x05"), "accepted"),
        (CanFrame(0x701, b"\x06"), "malformed"),
        (CanFrame(0x081, bytes(8)), "accepted"),
        (CanFrame(0x081, bytes(7)), "malformed"),
        (CanFrame(0x181, bytes(6)), "malformed"),
        (CanFrame(0x481, bytes(6)), "accepted"),
        (CanFrame(0x201, bytes(8)), "ignored"),
        (CanFrame(0x601, bytes(8)), "ignored"),
        (CanFrame(0x080, b""), "accepted"),
        (CanFrame(0x080, b"\1\2"), "ignored"),
        (CanFrame(0x585, bytes(8)), "ignored"),
        (CanFrame(0x581, bytes(8), extended=True), "ignored"),
        (CanFrame(0x581, b"", remote=True), "ignored"),
        (CanFrame(0x581, bytes(8), fd=True), "ignored"),
    ):
        before = copy.copy(driver.counters)
        driver.receive(s.stage.now, frame)
        assert getattr(driver.counters, kind) == getattr(before, kind) + 1, str(frame)
        assert sum(driver.counters.__getattribute__(k) for k in ("accepted", "malformed", "ignored")) == (
            before.accepted + before.malformed + before.ignored + 1
        )
