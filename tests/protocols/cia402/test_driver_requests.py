"""The driver against the twin, in virtual time: what a person asks for."""

from __future__ import annotations

import math

import pytest

from protocols import messages as msg
from protocols.cia402 import objects as o
from protocols.cia402.faults import QUICK_STOPPED
from protocols.cia402.options import Options, Settings
from protocols.cia402.profile import Mode as Operation
from protocols.messages import Mode, Request
from tests.protocols.cia402.driver_stage import stage

A = "alpha"


# -- requests -------------------------------------------------------------------------------------------


def test_estop_stops_latches_and_is_cleared() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Velocity(A, 3.0))
    s.step(msg.Estop(A), msg.Velocity(A, 3.0))
    s.steps(300, msg.Velocity(A, 3.0))
    assert not s.twin.axis.enabled
    assert [fault.code for fault in s.of(msg.Fault)] == [QUICK_STOPPED]
    assert s.stage.modes[A] is Mode.FAULT
    assert s.of(msg.Done)[-1].request == "Estop"
    s.step(msg.ClearFault(A), msg.Idle(A))
    s.steps(20, msg.Idle(A))
    s.until(Mode.ARMED, msg.Hold(A))


@pytest.mark.parametrize("option", [5, 6])
def test_a_quick_stop_that_holds_is_left_without_dropping_the_load(option: int) -> None:
    s = stage(settings=Settings(quick_stop_option=option))
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.step(msg.Estop(A), msg.Hold(A))
    s.steps(100, msg.Hold(A))
    assert s.twin.axis.state.value == "QUICK STOP ACTIVE"
    s.forget()
    s.step(msg.ClearFault(A), msg.Hold(A))
    s.until(Mode.ARMED, msg.Hold(A))
    assert {data[0] & 0x0F for data in s.said(0x201)} == {0x02, 0x0F}


@pytest.mark.parametrize("word", [msg.Home(A), msg.Zero(A)])
def test_homing_needs_hold_and_ends_where_the_shaft_is_zero(word: Request) -> None:
    s = stage(position=2.0)
    s.until(Mode.READY)
    s.step(word)
    assert "hold" in s.of(msg.Refused)[0].reason
    s.until(Mode.ARMED, msg.Hold(A))
    s.step(word, msg.Hold(A))
    s.steps(200, msg.Hold(A))
    assert s.of(msg.Done)[-1].request == type(word).__name__
    position = [f.position for f in s.feedback if f.position is not None][-1]
    assert abs(position) < 0.05
    assert abs(s.stage.shafts[A].position - 2.0) < 0.05
    assert s.twin.axis.mode is Operation.CSP
    assert s.twin.axis.dictionary.values[o.HOMING_METHOD] == 35


def test_homing_that_does_not_end_is_given_up_and_told() -> None:
    s = stage(Options(home_timeout_ms=200))
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.twin.axis.dictionary.values[o.HOMING_METHOD] = 33
    s.twin.axis.dictionary.values[o.HOMING_SPEED_ZERO] = 1
    s.step(msg.Home(A), msg.Hold(A))
    s.steps(300, msg.Hold(A))
    assert s.of(msg.Refused)[-1].reason == "it did not end in time"


def test_reboot_is_refused_while_armed_and_done_at_boot_up() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.step(msg.Reboot(A), msg.Hold(A))
    assert "idle" in s.of(msg.Refused)[0].reason
    s.steps(200, msg.Idle(A))
    s.step(msg.Reboot(A), msg.Idle(A))
    s.steps(600, msg.Idle(A))
    assert s.of(msg.Done)[-1].request == "Reboot"
    assert s.stage.modes[A] is Mode.READY


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
    s.step(msg.WriteParameter(A, parameter, value))
    assert why in s.of(msg.Refused)[0].reason
    assert not s.writes()


def test_parameters_are_read_in_the_drive_s_own_numbers() -> None:
    s = stage()
    s.until(Mode.READY)
    s.step(msg.ReadParameter(A, "Profile velocity"), msg.ReadParameter(A, "0x6098"))
    s.steps(10)
    assert [(p.parameter, p.value) for p in s.of(msg.Parameter)] == [
        ("Profile velocity", 100_000.0),
        ("0x6098", 35.0),
    ]


def test_a_scan_asks_everybody_and_changes_nothing() -> None:
    s = stage(count=2)
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.forget()
    s.step(msg.Scan("bus"), msg.Hold(A))
    s.steps(700, msg.Hold(A))
    assert {found.address for found in s.of(msg.Found)} == {1, 2}
    assert s.of(msg.Done)[-1].detail == "2 devices"
    assert not s.writes()
    assert {f.id for f in s.down if 0x600 < f.id < 0x680} >= set(range(0x603, 0x680))
    assert s.twin.axis.enabled
