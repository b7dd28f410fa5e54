"""The driver against the twin, in virtual time: what the conversations do not cover."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from protocols import messages as msg
from protocols.cia402.codec import Emcy, encode
from protocols.cia402.faults import FAULTS
from protocols.cia402.profile import PowerState
from protocols.messages import MILLISECOND, Command, Mode
from tests.protocols.cia402.driver_stage import ALL, Stage, stage

A = "alpha"
KINDS: dict[str, Command] = {
    "hold": msg.Hold(A),
    "position": msg.Position(A, 1.5),
    "velocity": msg.Velocity(A, 2.0),
    "torque": msg.Torque(A, 0.05),
}


def controlwords(s: Stage) -> list[int]:
    """Return the controlwords that were written by SDO."""
    return [value for index, _, value in s.writes() if index == 0x6040]


# -- arming and disarming -------------------------------------------------------------------------------


def test_the_motion_is_reported_while_the_drive_is_configured_and_armed() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.steps(50, msg.Hold(A))
    times = [f.t for f in s.feedback if f.position is not None]
    assert max(after - before for before, after in pairwise(times)) <= 25 * MILLISECOND
    assert any(index == 0x1A00 for index, _, _ in s.writes()), "it was configured"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("options", ALL)
def test_arms_in_every_mode_from_the_measured_position(options: str, kind: str) -> None:
    s = stage(ALL[options], position=0.7)
    s.stage.shafts[A].locked = True
    s.until(Mode.READY)
    received: list[Any] = []
    for _ in range(400):
        received += [
            m for m in s.step(KINDS[kind]).received if isinstance(m, msg.Position | msg.Velocity | msg.Torque)
        ]
        if s.stage.modes[A] is Mode.ARMED:
            break
    axis = s.twin.axis
    assert axis.enabled
    if options != "profile" or kind not in ("position", "hold"):  # PP: nothing before its first set-point
        still: dict[str, Command] = {"velocity": msg.Velocity(A, 0.0), "torque": msg.Torque(A, 0.0)}
        place = axis.units.position(axis.units.to_position(0.7))
        assert received[:1] == [still.get(kind, msg.Position(A, place))]
    cyclic = {"hold": 8, "position": 8, "velocity": 9, "torque": 10}
    profile = {"hold": 1, "position": 1, "velocity": 3, "torque": 4}
    assert axis.mode == (profile if options == "profile" else cyclic)[kind]
    controls = [int.from_bytes(data[:2], "little") for data in s.sent(0x201)] + controlwords(s)
    assert list(dict.fromkeys(control & 0x0F for control in controls)) == [0x06, 0x07, 0x0F]


@pytest.mark.parametrize("at", [1, 5, 20, 60, 70, 80, 90, 100])
def test_idle_disarms_in_the_middle_of_arming(at: int) -> None:
    s = stage()
    s.until(Mode.READY)
    s.steps(at, msg.Hold(A))
    s.steps(250, msg.Idle(A))
    assert not s.twin.axis.enabled
    assert not s.drive.owned
    s.until(Mode.ARMED, msg.Hold(A))


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


# -- faults and losses ----------------------------------------------------------------------------------


@pytest.mark.parametrize("persists", [False, True])
@pytest.mark.parametrize("name", ["sync", "polled"])
def test_a_fault_reported_by_emcy_is_cleared_only_by_a_newer_statusword(name: str, persists: bool) -> None:
    s = stage(ALL[name])
    s.until(Mode.ARMED, msg.Hold(A))
    s.twin.provoke(0x2310)
    s.twin.axis.fault_persists = persists
    while not s.of(msg.Fault):
        s.step(msg.Hold(A))
    (fault,) = s.of(msg.Fault)
    info = FAULTS[0x2310]
    assert (fault.name, fault.cause, fault.remedy) == (info.name, info.cause, info.remedy)
    assert s.drive.power is PowerState.OPERATION_ENABLED, "as far as it has reported"
    s.forget()
    s.step(msg.ClearFault(A), msg.Idle(A))
    assert not s.of(msg.Done)
    s.steps(3100, msg.Idle(A))
    if persists:
        assert not s.of(msg.Done)
        assert "still in fault" in s.of(msg.Refused)[0].reason
        assert s.stage.modes[A] is Mode.FAULT
    else:
        assert [done.request for done in s.of(msg.Done)] == ["ClearFault"]
        assert s.twin.axis.state is not PowerState.FAULT
        assert s.stage.modes[A] is Mode.READY


def test_an_emergency_that_no_statusword_confirms_is_cleared_without_a_controlword() -> None:
    s = stage()
    s.until(Mode.ARMED, msg.Hold(A))
    s.forget()
    s.step(msg.ClearFault(A), msg.Hold(A), stray=[encode(Emcy(1, 0x2310, 1, bytes(5)))])
    s.step(msg.ClearFault(A), msg.Hold(A))
    s.steps(20, msg.Hold(A))
    assert len(s.of(msg.Done)) == 2
    assert s.twin.axis.state is PowerState.OPERATION_ENABLED
    assert 0x80 not in controlwords(s)


def test_a_silent_device_is_offline_in_time_and_the_other_goes_on() -> None:
    s = stage(count=2)
    both = [msg.Hold(A), msg.Hold("beta")]
    s.until(Mode.READY)
    for name in (A, "beta"):
        s.until(Mode.ARMED, *both, name=name)
    connected = s.twin.step
    s.twin.step = lambda now, truth: (connected(now, truth)[0], [])
    s.forget()
    taken = s.until(Mode.OFFLINE, *both)
    assert 480 <= taken <= 505
    assert sum(f.motor == "beta" for f in s.feedback) > 80
    s.twin.step = connected
    s.steps(100, *both)
    assert s.stage.modes[A] is not Mode.OFFLINE


def test_a_host_without_commands_trips_the_watchdog() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Velocity(A, 1.0))
    s.steps(200, msg.Velocity(A, 1.0))
    s.forget()
    s.steps(520)
    assert 0x77F not in {f.id for f in s.down}
    assert [fault.code for fault in s.of(msg.Fault)] == [0x8130]
