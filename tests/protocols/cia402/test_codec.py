"""Messages and bytes: properties of SDO and PDO, types, statuswords, faults, options."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from protocols.canopen import sdo
from protocols.canopen.pdo import Entry, decode_entry, encode_entry, mapping, packing
from protocols.cia402 import objects as o
from protocols.cia402.faults import FAULTS, fault_info, register_of
from protocols.cia402.objects import OBJECTS, Type, from_bytes, to_bytes
from protocols.cia402.options import Options, Settings, units_of_settings
from protocols.cia402.profile import (
    STATE_BITS,
    HomingStatus,
    homing_of,
    state_of,
)
from tests.protocols.cia402.transfer import Transfer

SEED = 20261121


# -- SDO -----------------------------------------------------------------------------------------------


def test_a_transfer_takes_only_answers_to_itself() -> None:
    transfer = Transfer(0x6064, 0)
    transfer.first()
    for answer in (
        sdo.Uploaded(0x6063, 0, b"\0\0\0\0"),
        sdo.Uploaded(0x6064, 1, b"\0\0\0\0"),
        sdo.Downloaded(0x6064, 0),
        sdo.UploadedSegment(False, b"", True),
        sdo.SegmentDownloaded(False),
        sdo.Abort(0x6063, 0, sdo.NO_OBJECT),
    ):
        assert transfer.handle(answer) is None
        assert not transfer.done
    transfer.handle(sdo.Abort(0x6064, 0, sdo.NO_OBJECT))
    assert transfer.done
    assert transfer.abort == sdo.NO_OBJECT
    assert "0x06020000" in sdo.abort_text(sdo.NO_OBJECT)


def test_a_segmented_value_of_another_length_than_announced_is_refused() -> None:
    transfer = Transfer(0x1008, 0)
    transfer.first()
    transfer.handle(sdo.UploadStart(0x1008, 0, 9))
    transfer.handle(sdo.UploadedSegment(False, b"seven", True))
    assert transfer.abort == sdo.LENGTH_MISMATCH


def test_the_numbers_of_the_abort_codes_are_the_packages() -> None:
    from canopen.sdo.exceptions import SdoAbortedError  # slow to import: here only

    assert set(sdo.ABORTS) == set(SdoAbortedError.CODES)
    assert "unknown" in sdo.abort_text(1)


def test_what_does_not_fit_is_an_error() -> None:
    for bad in (
        sdo.Download(0x6040, 0, b""),
        sdo.Download(0x6040, 0, b"12345"),
        sdo.DownloadSegment(False, b"12345678", False),
    ):
        with pytest.raises(ValueError, match="bytes"):
            sdo.encode(bad)


def test_any_eight_bytes_decode_or_are_none() -> None:
    random = np.random.Generator(np.random.PCG64(SEED))
    for _ in range(2000):
        data = random.bytes(8)
        request, answer = sdo.decode_request(data), sdo.decode_response(data)
        assert request is not None
        for value in (request, answer):
            if value is not None and not isinstance(value, sdo.Unsupported):
                again = sdo.encode(value)
                both = (sdo.decode_request(again), sdo.decode_response(again))
                assert value in both, f"seed {SEED}: {data.hex()}"


# -- PDO, objects, units ---------------------------------------------------------------------------------


def test_packing_keeps_values_whole_bytes_or_not() -> None:
    random = np.random.Generator(np.random.PCG64(SEED))
    keys = [row.key for row in OBJECTS.values() if row.mappable]
    for _ in range(300):
        chosen: list[Entry] = []
        for at in random.permutation(len(keys)):
            entry = mapping(keys[at])[0]
            bits = entry.bits if random.random() < 0.6 else int(random.integers(1, entry.bits + 1))
            if sum(e.bits for e in chosen) + bits <= 64:
                chosen.append(Entry(entry.index, entry.sub, bits))
        pack = packing(chosen)
        values = []
        for entry, signed in zip(pack.entries, pack.signed, strict=True):
            low, high = (-(1 << entry.bits - 1), 1 << entry.bits - 1) if signed else (0, 1 << entry.bits)
            values.append(int(random.choice([low, high - 1, 0, int(random.integers(low, high))])))
        data = pack.pack(values)
        assert len(data) == pack.size
        assert pack.unpack(data) == tuple(values)
        assert pack.unpack(data + b"more") == tuple(values)
        assert pack.unpack(data[:-1]) is None
        general = type(pack)(pack.entries, pack.size, "", pack.signed)
        assert general.pack(values) == data
        assert general.unpack(data) == tuple(values)
        assert [decode_entry(encode_entry(entry)) for entry in pack.entries] == list(pack.entries)


def test_a_value_too_large_for_its_place_is_refused() -> None:
    for pack in (
        packing(mapping(o.CONTROLWORD, o.MODE)),
        packing([Entry(0x6040, 0, 12), Entry(0x6060, 0, 8)]),
    ):
        for values in ((1 << 16, 0), (-1, 0), (0, 128), (0, -129)):
            with pytest.raises(ValueError, match="fit"):
                pack.pack(values)
    with pytest.raises(ValueError, match="72 bits"):
        packing(mapping(o.TARGET_POSITION, o.TARGET_VELOCITY, o.MODE))
    with pytest.raises(ValueError, match="without bits"):
        packing([Entry(0x6040, 0, 0)])


@pytest.mark.parametrize("type_", [t for t in Type if t.bits], ids=lambda t: t.name)
def test_types_at_their_limits(type_: Type) -> None:
    for value in (type_.low, type_.high, 0):
        assert from_bytes(type_, to_bytes(type_, value)) == value
    for value in (type_.low - 1, type_.high + 1):
        with pytest.raises(ValueError, match=str(value)):
            to_bytes(type_, value)
    assert from_bytes(type_, b"") is None
    assert from_bytes(type_, bytes(type_.bits // 8 + 1)) is None


def test_units_both_ways() -> None:
    random = np.random.Generator(np.random.PCG64(SEED))
    units = units_of_settings(Settings(gear_motor=7, gear_shaft=3, feed=3600, rated_torque=1270))
    for _ in range(500):
        whole = int(random.integers(Type.I32.low, Type.I32.high))
        assert units.to_position(units.position(whole)) == whole
        assert units.to_velocity(units.velocity(whole)) == whole
        torque = int(random.integers(Type.I16.low, Type.I16.high))
        assert units.to_torque(units.torque(torque)) == torque


# -- the profile -------------------------------------------------------------------------------------------


def test_every_statusword_as_the_package_has_them() -> None:
    from canopen.profiles.p402 import State402

    assert {s.value: bits for s, bits in STATE_BITS.items()} == State402.SW_MASK
    for status in range(1 << 16):
        theirs = [name for name, (mask, value) in State402.SW_MASK.items() if status & mask == value]
        ours = state_of(status)
        assert theirs == ([ours.value] if ours else [])


def test_homing_bits_as_the_package_has_them() -> None:
    from canopen.profiles.p402 import Homing as Theirs

    assert {mask for mask, _ in Theirs.STATES.values()} == {0x3400}
    assert {value for _, value in Theirs.STATES.values()} == {h.value for h in HomingStatus}
    assert homing_of(0x1637) is HomingStatus.DONE
    assert homing_of(0x3000) is None


# -- faults, options ---------------------------------------------------------------------------------------


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
    from canopen.emcy import EmcyError

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


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        (lambda: Options(host_id=0), "host_id is 0"),
        (lambda: Options(sync_ms=-1), "sync_ms is -1"),
        (lambda: Options(offline_ms=150), "twice heartbeat_ms"),
        (lambda: Options(watchdog_ms=3), "watchdog_ms is 3"),
        (lambda: Options(rated_torque=math.nan), "rated_torque"),
        (lambda: Options(counts_per_turn=-1.0), "counts_per_turn"),
        (lambda: Settings(encoder_increments=0), "encoder_increments is 0"),
        (lambda: Settings(max_torque=70_000), "max_torque is 70000"),
        (lambda: Settings(homing_method=17), "homing_method is 17"),
        (lambda: Settings(quick_stop_option=4), "quick_stop_option is 4"),
        (lambda: Settings(soft_limit_low=1), "soft_limit_low"),
        (lambda: Settings(velocity_gain=-0.1), "velocity_gain"),
        (lambda: Settings(device_name="größer"), "ASCII"),
    ],
)
def test_wrong_options_are_refused(wrong: Any, error: str) -> None:
    with pytest.raises(ValueError, match=error):
        wrong()


def test_all_mistakes_are_reported_at_once() -> None:
    with pytest.raises(ValueError, match=r"feed_shaft.*max_torque.*halt_option"):
        Settings(max_torque=70_000, feed_shaft=0, halt_option=9)
