"""Messages and bytes: independent vectors both ways, properties of SDO and PDO, units, objects."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from protocols.cia402 import objects as o
from protocols.cia402 import sdo
from protocols.cia402.codec import (
    Emcy,
    Heartbeat,
    Message,
    Nmt,
    NmtCommand,
    NmtState,
    Sync,
    decode,
    encode,
    rpdo_id,
    sdo_rx_id,
    sdo_tx_id,
    tpdo_id,
)
from protocols.cia402.faults import FAULTS, fault_info, register_of
from protocols.cia402.objects import OBJECTS, Type, find, from_bytes, parse, title, to_bytes
from protocols.cia402.options import Options, Settings, units_of_settings
from protocols.cia402.pdo import Entry, decode_entry, encode_entry, mapping, packing
from protocols.cia402.profile import (
    STATE_BITS,
    Demand,
    HomingStatus,
    Mode,
    demand_of,
    homing_of,
    mode_bit,
    state_of,
    supports,
)
from protocols.cia402.transfer import Transfer
from protocols.cia402.units import Units, units_of
from protocols.frames import CanFrame, Frame
from protocols.reference_vectors import Vector
from tests.protocols.cia402.vectors import VECTORS

SEED = 20261121


def is_pdo(vector: Vector) -> bool:
    return isinstance(vector.frame, CanFrame) and 0x180 <= vector.frame.id < 0x580


def value_of(vector: Vector) -> Message | sdo.Request | sdo.Response | None:
    """Decode a vector's frame by its identifier; None for a PDO."""
    frame = vector.frame
    assert isinstance(frame, CanFrame)
    node = frame.id & 0x7F
    if frame.id == sdo_rx_id(node):
        return sdo.decode_request(frame.data)
    if frame.id == sdo_tx_id(node):
        return sdo.decode_response(frame.data)
    return decode(frame)


def bytes_of(value: Message | sdo.Request | sdo.Response) -> bytes:
    if isinstance(value, Nmt | Sync | Heartbeat | Emcy):
        return encode(value).data
    return sdo.encode(value)


@pytest.mark.parametrize("vector", [v for v in VECTORS if not is_pdo(v)], ids=lambda v: v.name)
def test_every_vector_is_decoded_and_encoded_alike(vector: Vector) -> None:
    frame = vector.frame
    assert isinstance(frame, CanFrame)
    value = value_of(vector)
    assert value is not None
    assert bytes_of(value) == frame.data


# fmt: off
MEANINGS: list[tuple[str, Message | sdo.Request | sdo.Response]] = [
    ("nmt_slave_bootup#0",                   Heartbeat(2, NmtState.INITIALISING)),
    ("heartbeat_preop",                      Heartbeat(2, NmtState.PRE_OPERATIONAL)),
    ("nmt_enter_preop#0",                    Nmt(NmtCommand.ENTER_PRE_OPERATIONAL, 2)),
    ("nmt_start#0",                          Nmt(NmtCommand.START, 2)),
    ("nmt_stop#0",                           Nmt(NmtCommand.STOP, 2)),
    ("nmt_reset_comm#0",                     Nmt(NmtCommand.RESET_COMMUNICATION, 2)),
    ("sync#0",                               Sync()),
    ("emcy_overcurrent_2310#0",              Emcy(2, 0x2310, 2, bytes((1, 2, 3, 4, 5)))),
    ("emcy_reset#0",                         Emcy(2, 0, 0)),
    ("sdo_read_position_-123456#0",          sdo.Upload(0x6064, 0)),
    ("sdo_read_position_-123456#1",          sdo.Uploaded(0x6064, 0, to_bytes(Type.I32, -123456))),
    ("sdo_write_mode_pp#0",                  sdo.Download(0x6060, 0, b"\x01")),
    ("sdo_write_mode_pp#1",                  sdo.Downloaded(0x6060, 0)),
    ("sdo_write_target_velocity_-1000#0",    sdo.Download(0x60FF, 0, to_bytes(Type.I32, -1000))),
    ("sdo_write_target_torque_500permille#0", sdo.Download(0x6071, 0, to_bytes(Type.I16, 500))),
    ("sdo_read_dev_name_segmented#1",        sdo.UploadStart(0x1008, 0, 7)),
    ("sdo_read_dev_name_segmented#2",        sdo.UploadSegment(toggle=False)),
    ("sdo_abort_no_object#1",                sdo.Abort(0x5FFF, 0, sdo.NO_OBJECT)),
]
# fmt: on


@pytest.mark.parametrize(("name", "value"), MEANINGS, ids=[name for name, _ in MEANINGS])
def test_the_vectors_mean_what_they_say(name: str, value: Message | sdo.Request | sdo.Response) -> None:
    vector = next(v for v in VECTORS if v.name == name)
    assert value_of(vector) == value
    assert isinstance(vector.frame, CanFrame)
    assert bytes_of(value) == vector.frame.data


def test_pdo_vectors() -> None:
    by_name = {v.name: v.frame for v in VECTORS}
    receives = packing(mapping(o.CONTROLWORD, o.MODE))
    assert by_name["rpdo1_cw_000F_mode_csp#0"] == CanFrame(rpdo_id(1, 2), receives.pack((0x0F, 8)))
    reports = packing(mapping(o.STATUSWORD, o.MODE_DISPLAY, o.TORQUE))
    frame = by_name["tpdo1_sw0637_mode8_torque-250#0"]
    assert isinstance(frame, CanFrame)
    assert frame.id == tpdo_id(1, 2)
    assert reports.unpack(frame.data) == (0x637, 8, -250)
    assert reports.pack((0x637, 8, -250)) == frame.data
    entries = [v for v in VECTORS if v.name.startswith("pdo_config_write") and v.meaning["sub"]]
    written = {v.meaning["value"] for v in entries if v.meaning["index"] in (0x1600, 0x1A00)}
    assert written == {
        encode_entry(entry)
        for entry in (*mapping(o.CONTROLWORD, o.MODE), *mapping(o.STATUSWORD, o.MODE_DISPLAY))
    } | {encode_entry(mapping(o.TORQUE)[0])}


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


@pytest.mark.parametrize("length", [0, 1, 5, 9])
def test_nothing_that_is_not_8_bytes_is_an_sdo(length: int) -> None:
    assert sdo.decode_request(bytes([0x40] * length)) is None
    assert sdo.decode_response(bytes([0x60] * length)) is None


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


@pytest.mark.parametrize(
    "frame",
    [
        b"\x01\x02",
        CanFrame(0, b"\x01"),
        CanFrame(0, b"\x01\x02\x03"),
        CanFrame(0, b"\x03\x02"),
        CanFrame(0, b"\x01\x80"),
        CanFrame(0x80, b"12"),
        CanFrame(0x702, b""),
        CanFrame(0x702, b"\x06"),
        CanFrame(0x700, b"\x05"),
        CanFrame(0x82, b"1234567"),
        CanFrame(0x702, b"\x05", fd=True),
        CanFrame(0x702, b"\x05", extended=True),
        CanFrame(0x702, remote=True),
    ],
    ids=str,
)
def test_ill_formed_messages_are_none(frame: Frame) -> None:
    assert decode(frame) is None


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


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("6083", (0x6083, 0)),
        ("0x6083", (0x6083, 0)),
        ("608F:01", (0x608F, 1)),
        ("608fsub1", (0x608F, 1)),
        ("Profile acceleration", (0x6083, 0)),
        (" feed ", (0x6092, 1)),
        ("6099:7", None),
        ("nothing of the kind", None),
        ("60", None),
    ],
)
def test_objects_are_found_by_name_and_address(text: str, key: o.Key | None) -> None:
    found = find(text)
    assert (found.key if found else None) == key
    if key is not None:
        assert parse(title(key)) == key


def test_units_follow_encoder_gear_and_feed() -> None:
    plain = units_of({o.ENCODER_INCREMENTS: 4096, o.RATED_TORQUE: 500})
    assert plain == Units(4096.0, 1.0, 0.5, 0.0)
    geared = units_of(
        {o.ENCODER_INCREMENTS: 4096, o.ENCODER_REVOLUTIONS: 2, o.GEAR_MOTOR: 50, o.GEAR_SHAFT: 1}
    )
    assert geared is not None
    assert geared.per_turn == 2048 * 50
    fed = units_of({o.ENCODER_INCREMENTS: 4096, o.GEAR_MOTOR: 50, o.FEED: 36_000, o.FEED_SHAFT: 1})
    assert fed is not None
    assert (fed.per_turn, fed.gear) == (36_000, 50)
    assert fed.to_position(math.tau) == 36_000
    assert units_of({}) is None
    assert units_of({o.GEAR_MOTOR: 3}) is None
    assert units_of({o.FEED: 1000}) == Units(1000.0)


def test_units_both_ways_and_at_their_limits() -> None:
    random = np.random.Generator(np.random.PCG64(SEED))
    units = units_of_settings(Settings(gear_motor=7, gear_shaft=3, feed=3600, rated_torque=1270))
    for _ in range(500):
        whole = int(random.integers(Type.I32.low, Type.I32.high))
        assert units.to_position(units.position(whole)) == whole
        assert units.to_velocity(units.velocity(whole)) == whole
        torque = int(random.integers(Type.I16.low, Type.I16.high))
        assert units.to_torque(units.torque(torque)) == torque
    refusals: list[Callable[[], int]] = [
        lambda: units.to_position(units.position(Type.I32.high + 1)),
        lambda: units.to_velocity(units.velocity(Type.I32.low - 1)),
        lambda: units.to_torque(units.torque(Type.I16.high + 1)),
        lambda: units.to_position(math.nan),
        lambda: units.to_torque(math.inf),
        lambda: Units(100.0).to_torque(0.1),
    ]
    for refused in refusals:
        with pytest.raises(ValueError, match=r"fit|finite|known"):
            refused()


# -- the profile -------------------------------------------------------------------------------------------


def test_states_and_statuswords_as_the_package_has_them() -> None:
    from canopen.profiles.p402 import OperationMode, State402

    assert {s.value: bits for s, bits in STATE_BITS.items()} == State402.SW_MASK
    for status in range(1 << 16):
        theirs = [name for name, (mask, value) in State402.SW_MASK.items() if status & mask == value]
        ours = state_of(status)
        assert theirs == ([ours.value] if ours else [])
    for mode in Mode:
        name = OperationMode.CODE2NAME[int(mode)]
        assert OperationMode.SUPPORTED[name] == mode_bit(mode)
    assert supports(0x1, Mode.PP)
    assert not supports(0x1, Mode.CSP)
    assert supports(0, Mode.NONE)


def test_homing_bits_as_the_package_has_them() -> None:
    from canopen.profiles.p402 import Homing as Theirs

    assert {mask for mask, _ in Theirs.STATES.values()} == {0x3400}
    assert {value for _, value in Theirs.STATES.values()} == {h.value for h in HomingStatus}
    assert homing_of(0x1637) is HomingStatus.DONE
    assert homing_of(0x3000) is None


@pytest.mark.parametrize(
    ("before", "control", "demand"),
    [
        (0x00, 0x06, Demand.SHUTDOWN),
        (0x06, 0x07, Demand.SWITCH_ON),
        (0x07, 0x0F, Demand.ENABLE_OPERATION),
        (0x0F, 0x1F, Demand.ENABLE_OPERATION),
        (0x0F, 0x10F, Demand.ENABLE_OPERATION),
        (0x0F, 0x02, Demand.QUICK_STOP),
        (0x0F, 0x0B, Demand.QUICK_STOP),
        (0x0F, 0x00, Demand.DISABLE_VOLTAGE),
        (0x0F, 0x0D, Demand.DISABLE_VOLTAGE),
        (0x00, 0x80, Demand.FAULT_RESET),
        (0x0F, 0x8F, Demand.FAULT_RESET),
        (0x80, 0x80, None),
        (0x80, 0x8F, None),
    ],
)
def test_what_a_controlword_demands(before: int, control: int, demand: Demand | None) -> None:
    assert demand_of(control, before) is demand


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
        (lambda: Settings(encoder_increments=0), "encoder_increments must be above 0"),
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
    with pytest.raises(ValueError, match=r"max_torque.*feed_shaft.*halt_option"):
        Settings(max_torque=70_000, feed_shaft=0, halt_option=9)
