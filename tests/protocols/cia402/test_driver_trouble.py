"""The driver against the twin, in virtual time: faults, watchdogs, and what is lost."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from protocols import messages as msg
from protocols.cia402.codec import Emcy, encode
from protocols.cia402.faults import DUPLICATE_NODE, FAULTS, HEARTBEAT_LOST
from protocols.cia402.options import Options
from protocols.cia402.profile import PowerState
from protocols.frames import BusState
from protocols.messages import Mode
from tests.protocols.cia402.driver_stage import ALL, stage

A = "alpha"


# -- faults ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", [0x2310, 0x3210, 0x8611])
def test_a_fault_is_told_with_its_words_and_cleared_only_when_asked(code: int) -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.twin.provoke(code)
    s.until(Mode.FAULT, msg.Hold(A))
    (fault,) = s.of(msg.Fault)
    words = FAULTS[code]
    assert (fault.code, fault.name, fault.cause, fault.remedy) == (
        code,
        words.name,
        words.cause,
        words.remedy,
    )
    s.forget()
    s.steps(400, msg.Hold(A))
    assert 0x80 not in [value for index, _, value in s.writes() if index == 0x6040]
    assert not s.of(msg.Fault)
    s.step(msg.ClearFault(A), msg.Idle(A))
    s.steps(50, msg.Idle(A))
    assert [value for index, _, value in s.writes() if index == 0x6040][:2] == [0x00, 0x80]
    assert isinstance(s.of(msg.Done)[-1], msg.Done)
    assert s.stage.modes[A] is Mode.READY
    s.until(Mode.ARMED, msg.Hold(A))


def test_a_fault_that_was_there_before_is_told_from_603f() -> None:
    s = stage()
    s.until(Mode.READY)
    s.twin.provoke(0x3220)
    s.steps(5)
    s.fresh()
    s.until(Mode.FAULT)
    assert [fault.code for fault in s.of(msg.Fault)] == [0x3220]


@pytest.mark.parametrize("stands", [False, True], ids=["goes", "stands"])
@pytest.mark.parametrize("name", ["sync", "polled"])
def test_a_fault_told_by_emcy_is_cleared_only_by_what_a_newer_statusword_says(
    name: str, stands: bool
) -> None:
    s = stage(ALL[name])
    s.until(Mode.ARMED, msg.Hold(A))
    s.twin.provoke(0x2310)
    s.twin.axis.fault_persists = stands
    while not s.of(msg.Fault):
        s.step(msg.Hold(A))
    assert s.drive.power is PowerState.OPERATION_ENABLED  # as far as it has said
    s.forget()
    s.step(msg.ClearFault(A), msg.Idle(A))
    assert not s.of(msg.Done)
    s.steps(3100, msg.Idle(A))
    if stands:
        assert not s.of(msg.Done)
        assert "still in fault" in s.of(msg.Refused)[0].reason
        assert s.stage.modes[A] is Mode.FAULT
    else:
        assert [done.request for done in s.of(msg.Done)] == ["ClearFault"]
        assert s.twin.axis.state is not PowerState.FAULT
        assert s.stage.modes[A] is Mode.READY


def test_an_emergency_that_no_statusword_confirms_is_cleared_without_a_word_to_the_drive() -> None:
    s = stage()
    s.until(Mode.ARMED, msg.Hold(A))
    s.forget()
    s.step(msg.ClearFault(A), msg.Hold(A), stray=[encode(Emcy(1, 0x2310, 1, bytes(5)))])
    s.step(msg.ClearFault(A), msg.Hold(A))
    s.steps(20, msg.Hold(A))
    assert len(s.of(msg.Done)) == 2
    assert s.twin.axis.state is PowerState.OPERATION_ENABLED
    assert 0x80 not in [value for index, _, value in s.writes() if index == 0x6040]


def test_a_fault_that_stands_is_refused_to_be_cleared_and_told_again() -> None:
    s = stage()
    s.until(Mode.READY)
    s.twin.provoke(0x4310)
    s.twin.axis.fault_persists = True
    s.until(Mode.FAULT)
    s.forget()
    s.step(msg.ClearFault(A))
    s.steps(3100)
    assert "still in fault" in s.of(msg.Refused)[0].reason
    assert [fault.code for fault in s.of(msg.Fault)] == [0x4310]


def test_silence_of_the_host_trips_the_watchdog_and_a_host_without_words_is_silent() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Velocity(A, 1.0))
    s.steps(200, msg.Velocity(A, 1.0))
    s.forget()
    s.steps(520)
    assert 0x77F not in {f.id for f in s.down}
    assert [fault.code for fault in s.of(msg.Fault)] == [HEARTBEAT_LOST]


def test_the_host_s_heartbeat_goes_only_if_every_armed_device_is_commanded() -> None:
    s = stage(count=2)
    both = [msg.Velocity(A, 1.0), msg.Velocity("beta", 1.0)]
    s.until(Mode.READY)
    for name in (A, "beta"):
        s.until(Mode.ARMED, *both, name=name)
    s.forget()
    s.steps(300, *both)
    assert len(s.said(0x77F)) in (2, 3)
    s.forget()
    s.steps(700, both[0])
    assert not s.said(0x77F)


# -- what is lost ---------------------------------------------------------------------------------------


def test_a_restart_is_told_and_only_a_fresh_sequence_arms_again() -> None:
    s = stage()
    s.until(Mode.READY)
    s.until(Mode.ARMED, msg.Hold(A))
    s.forget()
    s.stage.twins[0] = type(s.twin)(s.stage.devices[0], 3)
    s.until(Mode.INITIALISING, msg.Hold(A))
    s.until(Mode.ARMED, msg.Hold(A))
    words = [int.from_bytes(data[:2], "little") for data in s.said(0x201)]
    assert [w for w in dict.fromkeys(words) if w != 0x0F] == [0x06, 0x07]


def test_a_silent_device_is_offline_in_time_and_the_other_goes_on() -> None:
    s = stage(count=2)
    both = [msg.Hold(A), msg.Hold("beta")]
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
    assert s.stage.modes[A] is not Mode.OFFLINE


@pytest.mark.parametrize("lost", [2, 3, 5])
def test_lost_answers_are_asked_for_again(lost: int) -> None:
    s = stage(Options(sdo_timeout_ms=20))
    step, count = s.twin.step, 0

    def lossy(now: int, truth: Any) -> Any:
        nonlocal count
        torques, frames = step(now, truth)
        kept = []
        for frame in frames:
            count += 1
            kept += [frame] if count % lost else []
        return torques, kept

    s.twin.step = lossy
    s.until(Mode.READY, most=4000)
    s.until(Mode.ARMED, msg.Velocity(A, 1.0), most=4000)
    s.twin.step = step
    assert s.driver.counters.malformed == 0


def test_two_devices_with_one_node_id_are_noticed() -> None:
    s = stage()
    s.until(Mode.READY)
    s.stage.twins.append(copy.deepcopy(s.twin))
    s.stage.devices = (s.stage.devices[0], s.stage.devices[0])
    s.stage.specs = (s.stage.specs[0], s.stage.specs[0])
    s.steps(1500)
    assert [fault.code for fault in s.of(msg.Fault)] == [DUPLICATE_NODE]
    (found,) = s.of(msg.Found)
    assert found.duplicate_address
    assert found.address == 1


def test_an_answer_that_came_twice_once_is_nothing() -> None:
    s = stage()
    s.until(Mode.READY)
    s.steps(30)
    for _ in range(20):
        answers = [w for w in s.up[-3:] if w.id == 0x581]
        s.step(stray=answers[:1])
        s.steps(40)
    assert not s.of(msg.Fault)


@pytest.mark.parametrize("state", [BusState.GONE, BusState.OFF])
def test_a_bus_that_vanished_ends_requests_and_forgets(state: BusState) -> None:
    s = stage()
    s.until(Mode.READY)
    s.step(msg.ReadParameter(A, "6081"), msg.Scan("bus"))
    s.driver.bus(s.stage.now, state)
    s.step()
    assert {refused.request for refused in s.of(msg.Refused)} == {"ReadParameter", "Scan"}
    assert s.drive.profile is None
