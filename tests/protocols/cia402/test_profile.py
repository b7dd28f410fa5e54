"""The profile's states, modes, faults and units, beside those of package canopen 2.4.1."""

from __future__ import annotations

import numpy as np
import pytest
from canopen.emcy import EmcyError
from canopen.profiles.p402 import Homing, State402

from protocols.canopen.objects import Type
from protocols.cia402 import homing
from protocols.cia402.faults import FAULTS, fault_info, register_of
from protocols.cia402.profile import STATE_BITS, PowerState, state_of
from protocols.cia402.settings import Settings, units_of_settings
from protocols.cia402.state_machine import TRANSITIONS
from protocols.frames import CanFrame
from protocols.messages import Hold, State
from tests.protocols.cia402.bus import Bus, motor
from tests.protocols.cia402.drive import Drive

SEED = 20261121


def test_units_both_ways() -> None:
    random = np.random.Generator(np.random.PCG64(SEED))
    units = units_of_settings(Settings(gear_motor=7, gear_shaft=3, feed=3600, rated_torque=1270))
    for _ in range(500):
        whole = int(random.integers(Type.I32.low, Type.I32.high))
        assert units.to_position(units.position(whole)) == whole
        assert units.to_velocity(units.velocity(whole)) == whole
        torque = int(random.integers(Type.I16.low, Type.I16.high))
        assert units.to_torque(units.torque(torque)) == torque


def test_every_statusword_as_the_package_has_them() -> None:
    assert {s.value: bits for s, bits in STATE_BITS.items()} == State402.SW_MASK
    for status in range(1 << 16):
        theirs = [name for name, (mask, value) in State402.SW_MASK.items() if status & mask == value]
        ours = state_of(status)
        assert theirs == ([ours.value] if ours else [])


def test_homing_bits_as_the_package_has_them() -> None:
    begun, ended = homing.Homing(token=1, zero=False, began_at=0), {}
    for name, (mask, value) in Homing.STATES.items():
        results = {begun.result(value | others, homing.REPORTS) for others in (0x0237, 0xFFFF & ~mask)}
        (ended[name],) = (result and result[0] for result in results)
    assert begun.result(0x3000, homing.REPORTS) is None
    assert ended == {
        "IN PROGRESS": None,
        "INTERRUPTED": None,
        "ATTAINED": None,
        "TARGET REACHED": True,
        "ERROR VELOCITY IS NOT ZERO": False,
        "ERROR VELOCITY IS ZERO": False,
    }


def test_every_transition_of_the_package_is_the_twins() -> None:
    """Those that a controlword makes."""
    made = {(before, after) for (before, _), after in TRANSITIONS.items()}
    made.add((PowerState.QUICK_STOP, PowerState.OPERATION_ENABLED))
    automatic = {PowerState.NOT_READY, PowerState.FAULT_REACTION}
    names = {state.value: state for state in PowerState if state not in automatic}
    for before, after in State402.TRANSITIONTABLE:
        assert before not in names or (names[before], names[after]) in made


# -- what the driver reports of them ---------------------------------------------------------------------


REPORTED = {
    "NOT READY TO SWITCH ON": ("initialising", set()),
    "SWITCH ON DISABLED": ("ready", {0x06}),
    "READY TO SWITCH ON": ("ready", {0x07}),
    "SWITCHED ON": ("ready", {0x07}),
    "OPERATION ENABLED": ("armed", {0x0F}),
    "QUICK STOP ACTIVE": ("armed", {0x02}),
    "FAULT REACTION ACTIVE": ("fault", set()),
    "FAULT": ("fault", set()),
}
"""The mode that is reported, and the controlwords towards OPERATION ENABLED while no other mode is shown."""


def reported(drive: Drive) -> State:
    """Return what the driver has reported of a drive after its start."""
    bus = Bus([motor()], [drive])
    bus.run(300)
    return [event for event in bus.events if isinstance(event, State)][-1]


@pytest.mark.parametrize("state", sorted(State402.SW_MASK))
def test_every_state_whatever_its_other_bits(state: str) -> None:
    mask, value = State402.SW_MASK[state]
    for others in (0x0000, 0xFF90 & ~mask, 0x0290):
        drive = Drive(motor())
        drive.deaf = drive.frozen = True
        drive.put(0x605A, 0, 6)  # a quick stop stays one
        drive.put(0x6041, 0, value | others)
        bus = Bus([motor()], [drive])
        bus.run(300)
        last = [event for event in bus.events if isinstance(event, State)][-1]
        assert (str(last.mode), last.detail.partition(",")[0]) == (REPORTED[state][0], state)
        bus.frames.clear()
        bus.run(600, Hold("m"))
        frames = [frame for frame in bus.frames if isinstance(frame, CanFrame)]
        words = {frame.data[0] for frame in frames if frame.id == 0x202}
        words |= {frame.data[4] for frame in frames if frame.data[:3] == b"\x2b\x40\x60"}
        assert words == REPORTED[state][1], hex(value | others)


# fmt: off
MODES = {
    0: "no mode", 1: "profile position", 2: "velocity", 3: "profile velocity", 4: "profile torque",
    6: "homing", 7: "interpolated position", 8: "cyclic synchronous position",
    9: "cyclic synchronous velocity", 10: "cyclic synchronous torque", 11: "mode 11", -3: "mode -3",
}
# fmt: on


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_that_is_shown(mode: int) -> None:
    drive = Drive(motor())
    drive.change(f'stands "OPERATION ENABLED" {mode}')
    assert reported(drive).detail == f"OPERATION ENABLED, {MODES[mode]}"


# -- faults ---------------------------------------------------------------------------------------


def test_a_remedy_is_one_that_works() -> None:
    """As the transcripts of the set-up have it."""
    assert 'watchdog_ms = 0 if it is 1016, else mapping = "keep"' in fault_info(0x1_0005).remedy


def test_every_code_has_a_text() -> None:
    for code in range(1 << 16):
        reported = fault_info(code)
        assert reported.name
        if code in FAULTS:
            assert reported is FAULTS[code]
            assert reported.cause
            assert reported.remedy
        elif code >> 12:
            assert reported.remedy
            assert f"{code:#06x}" in reported.name


@pytest.mark.parametrize("family", range(1, 16))
def test_families_as_the_package_has_them(family: int) -> None:
    code = family << 12 | 0x00A7
    info, theirs = fault_info(code), EmcyError(code, 0, b"", 0.0).get_desc().lower()
    assert info.name.startswith(theirs or "unknown")
    assert "manual" in info.remedy


# fmt: off
CLASSES = [  # the classes of CiA 301 and CiA 402 that are finer than families
    (0x2111, "current, device input side"), (0x2211, "current inside the device"),
    (0x23A7, "current, device output side"), (0x31A7, "mains voltage"), (0x32A7, "DC link voltage"),
    (0x33A7, "output voltage"), (0x41A7, "ambient temperature"), (0x42A7, "device temperature"),
    (0x43A7, "drive temperature"), (0x61A7, "internal software"), (0x63A7, "data record"),
    (0x73A7, "additional modules: sensor"), (0x81A7, "monitoring: communication"),
    (0x86A7, "monitoring: positioning"),
]
# fmt: on


def test_a_code_without_a_name_has_that_of_its_class() -> None:
    for code, name in CLASSES:
        assert fault_info(code).name == f"{name} ({code:#06x})"


def test_the_error_register_names_the_family() -> None:
    codes = (0, 0x1000, 0x2310, 0x3210, 0x4310, 0x7305, 0x8130, 0x8250, 0x8611, 0xFF01)
    registers = (0x00, 0x01, 0x03, 0x05, 0x09, 0x01, 0x11, 0x11, 0x01, 0x81)
    assert tuple(map(register_of, codes)) == registers
