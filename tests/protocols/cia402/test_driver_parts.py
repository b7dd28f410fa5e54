"""Parts of the driver by themselves: state machine, PDOs that fit, set-points, SDO client, startup, scan."""

from __future__ import annotations

import pytest

from protocols.cia402 import mapping, state_machine
from protocols.cia402 import objects as o
from protocols.cia402.client import DUPLICATES, TRIES, Job, Purpose, SdoClient
from protocols.cia402.mapping import Pdo
from protocols.cia402.options import Options
from protocols.cia402.pdo import DISABLED, decode_entry
from protocols.cia402.pdo import mapping as entries
from protocols.cia402.profile import Mode, PowerState
from protocols.cia402.scanning import BURST, Scanner
from protocols.cia402.sdo import (
    GENERAL,
    TIMEOUT,
    Abort,
    Downloaded,
    Upload,
    Uploaded,
    UploadedSegment,
    UploadSegment,
    UploadStart,
)
from protocols.cia402.setpoint import standstill, values_of
from protocols.cia402.setpoint_writer import REFRESH, SetpointWriter
from protocols.cia402.startup import units_from, value_of
from protocols.cia402.units import Units
from protocols.messages import MILLISECOND, Position
from tests.protocols.cia402.driver_vectors import pdos

UNITS = Units(per_turn=16_384.0, gear=1.0, rated_torque=1.0, rated_current=5.0)


def test_feed_forward_is_left_out_of_profile_modes() -> None:
    values = values_of(Position("m", 1.0, 2.0, 0.5), Mode.PP, UNITS, 0)
    assert (values[o.VELOCITY_OFFSET], values[o.TORQUE_OFFSET]) == (0, 0)


@pytest.mark.parametrize(
    ("power", "option", "prepared", "demand"),
    [
        (PowerState.SWITCH_ON_DISABLED, 2, True, 0x06),
        (PowerState.READY, 2, True, 0x07),
        (PowerState.SWITCHED_ON, 2, True, 0x0F),
        (PowerState.SWITCHED_ON, 2, False, 0x07),
        (PowerState.OPERATION_ENABLED, 2, False, 0x0F),
        (PowerState.QUICK_STOP, 2, True, 0x00),
        (PowerState.QUICK_STOP, 6, True, 0x0F),
        (PowerState.QUICK_STOP, 6, False, 0x02),
        (PowerState.NOT_READY, 2, True, None),
        (PowerState.FAULT, 2, True, None),
        (PowerState.FAULT_REACTION, 2, True, None),
    ],
)
def test_arming_demands(power: PowerState, option: int, prepared: bool, demand: int | None) -> None:
    assert state_machine.arming_demand(power, option, prepared=prepared) == demand


@pytest.mark.parametrize(
    ("acknowledged", "new_setpoint", "target", "given", "after"),
    [
        (False, False, 5, None, (0x3F, 5, True)),
        (False, True, 7, 5, (0x3F, 5, True)),
        (True, True, 7, 5, (0x2F, 5, False)),
        (True, False, 7, 5, (0x2F, 5, False)),
        (False, False, 7, 5, (0x3F, 7, True)),
        (False, False, 5, 5, (0x2F, 5, False)),
    ],
)
def test_the_handshake_of_pp(
    acknowledged: bool, new_setpoint: bool, target: int, given: int | None, after: tuple[int, int, bool]
) -> None:
    assert state_machine.pp_handshake(acknowledged, new_setpoint, target, given) == after


# -- PDOs -----------------------------------------------------------------------------------------------


def _rpdo(**changed: object) -> Pdo:
    plain: dict[str, object] = {
        "kind": "RPDO",
        "number": 1,
        "cob": 0x205,
        "transmission": 1,
        "entries": entries(o.CONTROLWORD, o.TARGET_POSITION),
    }
    return Pdo(**(plain | changed))  # type: ignore[arg-type]  # the fields by name


@pytest.mark.parametrize(
    ("pdo", "synced", "usable"),
    [
        (_rpdo(), True, True),
        (_rpdo(), False, False),
        (_rpdo(transmission=255), False, True),
        (_rpdo(cob=0x205 | DISABLED), True, False),
        (_rpdo(cob=0x206), True, False),
        (_rpdo(cob=0x205 | 1 << 29), True, False),
        (_rpdo(entries=()), True, False),
        (_rpdo(entries=entries(o.CONTROLWORD, o.MAX_TORQUE)), True, False),
        (_rpdo(entries=(decode_entry(0x00050008), *entries(o.CONTROLWORD))), True, True),
        (_rpdo(entries=(decode_entry(0x60400008),)), True, False),
        (_rpdo(kind="TPDO", cob=0x185 | 1 << 30, entries=entries(o.MAX_TORQUE)), True, True),
    ],
)
def test_which_pdos_are_usable(pdo: Pdo, synced: bool, usable: bool) -> None:
    assert mapping.usable(pdo, 5, synced) is usable


def test_what_fits() -> None:
    both = {o.TARGET_POSITION}
    assert mapping.commands_fit([_rpdo()], both)
    assert not mapping.commands_fit([_rpdo()], both | {o.TARGET_VELOCITY})
    assert not mapping.commands_fit([_rpdo(entries=entries(o.TARGET_POSITION))], both)
    reported = entries(o.STATUSWORD, o.POSITION)
    for transmission, event_ms, fits in ((1, 0, True), (240, 0, False), (0, 0, False), (255, 0, False)):
        tpdo = Pdo("TPDO", 1, 0x185, transmission, event_ms, reported)
        assert mapping.feedback_fits([tpdo], 10 * MILLISECOND, 100 * MILLISECOND) is fits
    assert mapping.feedback_fits([Pdo("TPDO", 1, 0x185, 255, 20, reported)], 0, 100 * MILLISECOND)
    assert not mapping.feedback_fits([Pdo("TPDO", 1, 0x185, 255, 200, reported)], 0, 100 * MILLISECOND)


def test_set_points_go_when_they_move_or_change_and_again_after_a_while() -> None:
    writer = SetpointWriter()
    writer.configure([pdo for pdo in pdos() if pdo.kind == "RPDO"])
    values = standstill(0) | {o.CONTROLWORD: 6, o.MODE: 9}
    first = writer.frames(0, values, o.TARGET_VELOCITY)
    assert [frame.id & 0x700 for frame in first] == [0x300, 0x400, 0x200]
    assert [frame.id & 0x700 for frame in writer.frames(1, values, o.TARGET_VELOCITY)] == [0x300]
    changed = writer.frames(2, values | {o.CONTROLWORD: 7}, o.TARGET_VELOCITY)
    assert [frame.id & 0x700 for frame in changed] == [0x300, 0x200]
    assert len(writer.frames(REFRESH + 2, values | {o.CONTROLWORD: 7}, o.TARGET_VELOCITY)) == 3


# -- SDO ------------------------------------------------------------------------------------------------


def test_a_transfer_is_repeated_and_given_up() -> None:
    client = SdoClient(100)
    client.begin(Job(Purpose.POLL, o.STATUSWORD))
    sent = [now for now in range(1000) if client.poll(now)[0] is not None]
    assert sent == [0, 100, 200][:TRIES]
    assert client.job is None
    client.begin(Job(Purpose.POLL, o.STATUSWORD))
    outcomes = [outcome for now in range(2000, 3000) if (outcome := client.poll(now)[1])]
    assert [(x.abort, x.timed_out) for x in outcomes] == [(TIMEOUT, True)]


def test_a_response_to_something_else_is_ignored() -> None:
    client = SdoClient(100)
    client.begin(Job(Purpose.POLL, o.STATUSWORD))
    client.poll(0)
    for answer in (Uploaded(0x6064, 0, b"\0"), Downloaded(0x6041, 0), Abort(0x6041, 1, 1)):
        assert client.handle(answer) is None
    outcome = client.handle(Uploaded(0x6041, 0, b"\x37\x06"))
    assert outcome is not None
    assert outcome.value == b"\x37\x06"
    assert client.handle(Uploaded(0x6041, 0, b"\x37\x06")) is None


def test_segments_that_another_host_interrupted_are_requested_anew_at_once() -> None:
    client = SdoClient(100)
    client.begin(Job(Purpose.STARTUP, o.DEVICE_NAME))
    assert client.handle(Abort(*o.POSITION, GENERAL)) is None
    assert client.poll(0)[0] == Upload(*o.DEVICE_NAME)
    assert client.poll(1)[0] is None, "before it began, an abort of something else is ignored"
    client.handle(UploadStart(*o.DEVICE_NAME, 7))
    for _ in range(TRIES - 1):
        assert client.poll(2)[0] == UploadSegment(False)
        assert client.handle(Abort(*o.POSITION, GENERAL)) is None
        assert client.poll(3)[0] == Upload(*o.DEVICE_NAME)
        client.handle(UploadStart(*o.DEVICE_NAME, 7))
    client.poll(4)
    client.handle(Abort(*o.POSITION, GENERAL))
    assert client.poll(5) == (None, None), "not for ever"
    outcome = client.handle(UploadedSegment(False, b"twin402", True))
    assert outcome is not None
    assert outcome.value == b"twin402"


def test_only_an_urgent_job_replaces_another() -> None:
    client = SdoClient(100)
    client.begin(Job(Purpose.STARTUP, o.DEVICE_TYPE))
    assert not client.free(Purpose.SETUP)
    assert client.free(Purpose.URGENT)
    client.begin(Job(Purpose.URGENT, o.CONTROLWORD, b"\6\0"))
    assert not client.free(Purpose.URGENT)
    assert client.handle(Uploaded(*o.DEVICE_TYPE, b"\0")) is None
    outcome = client.handle(Downloaded(*o.CONTROLWORD))
    assert outcome is not None
    assert outcome.job.purpose is Purpose.URGENT


def test_responses_that_come_twice_are_counted_in_a_row() -> None:
    client = SdoClient(100)
    for count in range(1, DUPLICATES + 2):
        client.begin(Job(Purpose.POLL, o.POSITION))
        client.poll(0)
        client.handle(Uploaded(*o.POSITION, bytes(4)))
        assert client.duplicates == count - 1
        client.handle(Uploaded(*o.POSITION, bytes(4)))
    client.begin(Job(Purpose.POLL, o.POSITION))
    client.handle(Uploaded(*o.POSITION, bytes(4)))
    client.begin(Job(Purpose.POLL, o.POSITION))
    client.handle(Uploaded(*o.POSITION, bytes(4)))
    assert client.duplicates == 0


def test_two_serial_numbers_are_two_devices_at_once() -> None:
    client = SdoClient(100)
    client.begin(Job(Purpose.IDENTITY_CHECK, o.SERIAL_NUMBER))
    client.handle(Uploaded(*o.SERIAL_NUMBER, b"\1\0\0\0"))
    client.handle(Uploaded(*o.SERIAL_NUMBER, b"\2\0\0\0"))
    assert client.duplicates == DUPLICATES


# -- reading, scanning ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "data", "value"),
    [
        (o.STATUSWORD, b"\x50\x02", 0x0250),
        (o.SUPPORTED_MODES, b"\xef\x03", 0x3EF),
        (o.MODE_DISPLAY, b"\xff", -1),
        (o.POSITION, b"\xc0\x1d\xfe\xff", -123_456),
        (o.POSITION, b"\xc0\x1d", None),
        (o.STATUSWORD, b"\x50\x02\0", None),
        ((0x2000, 1), b"\xff\xff", 0xFFFF),
        ((0x2000, 1), b"", None),
        (o.DEVICE_NAME, b"a longer text", None),
    ],
)
def test_the_number_of_an_upload(key: o.Key, data: bytes, value: int | None) -> None:
    assert value_of(key, data) == value


def test_units_of_the_robot_file_stand_in_for_what_a_drive_lacks() -> None:
    assert units_from({}, Options()) is None
    reported = units_from({o.RATED_CURRENT: 2000}, Options(counts_per_turn=500.0, rated_torque=0.4))
    assert reported == Units(500.0, 1.0, 0.4, 2.0)
    drive = {o.ENCODER_INCREMENTS: 1000, o.GEAR_MOTOR: 5, o.RATED_TORQUE: 300}
    assert units_from(drive, Options(rated_torque=9.0)) == Units(5000.0, 5.0, 0.3, 0.0)


def test_a_scan_requests_in_bursts_and_accepts_only_what_it_requested() -> None:
    scan, requested, now = Scanner("can0", (3,), 0), [], 0
    while not scan.over(now):
        requested += [frame.id - 0x600 for frame in scan.send(now)]
        assert len(requested) <= BURST * (now // (10 * MILLISECOND) + 1)
        now += MILLISECOND
    assert requested == [n for n in range(1, 128) if n != 3]
    assert not scan.receive(now, 5, Uploaded(*o.DEVICE_TYPE, bytes(4))), "too late"
    fresh = Scanner("can0", (), 0)
    fresh.send(0)
    assert not fresh.receive(1, 100, Uploaded(*o.DEVICE_TYPE, bytes(4))), "not requested yet"
    assert not fresh.receive(1, 2, Uploaded(*o.VENDOR_ID, bytes(4))), "not requested"
    assert fresh.receive(1, 2, Uploaded(*o.DEVICE_TYPE, b"\x92\1\2\0"))
    assert fresh.send(MILLISECOND)[0].data[:4] == bytes((0x40, 0x18, 0x10, 1))
    assert fresh.receive(2, 2, Uploaded(*o.DEVICE_TYPE, b"\x92\1\2\0"))
    assert fresh.duplicates == {2}
