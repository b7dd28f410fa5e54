"""Parts of the driver by themselves: the handshake of PP, usable PDOs, SDO client, scan."""

from __future__ import annotations

import pytest

from protocols.cia402.old_client import DUPLICATES, TRIES, Job, Purpose, SdoClient
from protocols.canopen.pdo import DISABLED, decode_entry
from protocols.canopen.pdo import mapping as entries
from protocols.canopen.sdo import (
    GENERAL,
    Abort,
    Downloaded,
    Upload,
    Uploaded,
    UploadedSegment,
    UploadSegment,
    UploadStart,
)
from protocols.cia402 import mapping, state_machine
from protocols.cia402 import objects as o
from protocols.cia402.mapping import Pdo
from protocols.cia402.scanning import BURST, Scanner
from protocols.cia402.startup import value_of
from protocols.messages import MILLISECOND


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


# -- SDO ------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("key", "data"),
    [(o.STATUSWORD, b"\x50\x02\0"), (o.POSITION, b"\xc0\x1d"), ((0x2000, 1), b""), (o.DEVICE_NAME, bytes(9))],
)
def test_an_upload_of_a_wrong_length_is_no_number(key: o.Key, data: bytes) -> None:
    assert value_of(key, data) is None


# -- reading, scanning ----------------------------------------------------------------------------------


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
