"""Message tables: values and bytes in both directions, ids, what is refused, and random rows."""

from __future__ import annotations

import math
import struct
from random import Random
from typing import Any

import pytest

from protocols.frames import EXTENDED_BIT, CanFrame, exact
from protocols.toolkit.table import FLOAT_MAX, Field, Row, Table, const, f32, sint, span, uint, unused

BOTH = ("little", "big")
ADDRESS = (const(0b101, 3), uint("address", 8))


def table(*fields: Field, **changes: Any) -> Table:
    """A table of one message called "m", to the device at an address."""
    return Table([Row(**{"name": "m", "id": ADDRESS, "fields": fields} | changes)])


# Fields, their values, and the bytes with the first field lowest (little) and highest (big): by hand.
# fmt: off
CASES: list[tuple[tuple[Field, ...], dict[str, Any], str, str]] = [
    ((), {}, "", ""),
    ((uint("a"),), {"a": 0x12}, "12", "12"),
    ((uint("a", 16), uint("b", 32)), {"a": 0x1234, "b": 5}, "3412 05000000", "1234 00000005"),
    ((uint("a", 64),), {"a": 1 << 63 | 2}, "0200000000000080", "8000000000000002"),
    ((sint("a", 16), sint("b", 8)), {"a": -2, "b": 127}, "feff 7f", "fffe 7f"),
    ((sint("a", 12), uint("b", 4)), {"a": -2, "b": 5}, "fe5f", "ffe5"),
    ((uint("a", 24),), {"a": 0x123456}, "563412", "123456"),
    ((uint("a", 16, 0.01), sint("b", 16, 0.001)), {"a": 1.5, "b": -0.25}, "9600 06ff", "0096 ff06"),
    ((uint("a", 4), uint("b", 4)), {"a": 0xD, "b": 3}, "3d", "d3"),
    ((uint("a", 1), unused(6), uint("b", 1)), {"a": 1, "b": 0}, "01", "80"),
    ((const(0xA5), uint("a")), {"a": 7}, "a507", "a507"),
    ((unused(8, 0xA5), uint("a")), {"a": 7}, "a507", "a507"),
    ((const(0x123, 12), uint("a", 4)), {"a": 7}, "2371", "1237"),
    ((f32("a"), f32("b")), {"a": 1.0, "b": -2.5}, "0000803f 000020c0", "3f800000 c0200000"),
    ((uint("a", 4), f32("b"), uint("c", 4)), {"a": 1, "b": 1.0, "c": 2}, "010000f823", "13f8000002"),
    ((f32("a", optional=True),), {"a": None}, "0000c07f", "7fc00000"),
    ((span("a", 16, -12.5, 12.5),), {"a": -12.5}, "0000", "0000"),
    ((span("a", 16, -12.5, 12.5),), {"a": 12.5}, "ffff", "ffff"),
    ((span("a", 12, 0.0, 4.095), span("b", 12, 0.0, 4.095)), {"a": 0.001, "b": 2.748}, "01c0ab", "001abc"),
]
# fmt: on


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case[1]} {case[2]}")
@pytest.mark.parametrize("order", BOTH)
def test_values_are_bytes_and_bytes_are_values(case: Any, order: str) -> None:
    fields, values, little, big = case
    data, one = bytes.fromhex(little if order == "little" else big), table(*fields, order=order)
    assert one.encode("m", 0x42, **values) == CanFrame(0x542, data)
    assert one.encode("m", **values).data == data
    decoded = one.decode(CanFrame(0x542, data), "to_device")
    assert decoded is not None
    assert (decoded.name, decoded.address) == ("m", 0x42)
    assert decoded.values == pytest.approx(values, abs=1e-9)
    assert one.read("m", data) == decoded.values


# fmt: off
SATURATED: list[tuple[Field, float, float]] = [
    (uint("a"), 300, 255), (uint("a"), -1, 0), (sint("a", 8), -129, -128), (uint("a", 8, 0.1), 99.0, 25.5),
    (span("a", 8, -1.0, 1.0), 7.0, 1.0), (span("a", 8, -1.0, 1.0), -7.0, -1.0),
    (f32("a"), 1e39, FLOAT_MAX), (f32("a"), -1e39, -FLOAT_MAX),
    (f32("a"), -0.0, 0.0), (f32("a"), 1e-39, 0.0), (f32("a"), 2.0**-126, 2.0**-126),
    (span("a", 8, 0.0, 255.0), 1.9, 1.0), (span("a", 8, 0.0, 255.0, floor=False), 1.9, 2.0),
    (uint("a", 8, 0.5), 0.74, 0.5),
]
# fmt: on


@pytest.mark.parametrize(("field", "given", "received"), SATURATED)
def test_what_a_field_cannot_hold_saturates_or_is_rounded(
    field: Field, given: float, received: float
) -> None:
    one = table(field)
    values = one.read("m", one.encode("m", a=given).data)
    assert values is not None
    assert repr(float(values["a"])) == repr(float(received))


@pytest.mark.parametrize("field", [f32("a"), uint("a"), uint("a", 8, 0.5), span("a", 12, -1.0, 1.0)])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_never_sent(field: Field, value: float) -> None:
    with pytest.raises(ValueError, match="not finite"):
        table(field).encode("m", a=value)


@pytest.mark.parametrize("wrong", [{}, {"b": 1}, {"a": 1, "b": 1}])
def test_a_field_that_is_missing_or_unknown_is_a_mistake(wrong: dict[str, float]) -> None:
    with pytest.raises((TypeError, KeyError)):
        table(uint("a")).encode("m", 1, **wrong)


# -- what is not a message -----------------------------------------------------------------------------

INFINITE, NAN, DENORMAL = (struct.pack("<f", value) for value in (math.inf, math.nan, 1e-40))


# fmt: off
MALFORMED: list[tuple[tuple[Field, ...], bytes, Any]] = [
    ((f32("a"),), INFINITE, None), ((f32("a"),), NAN, None), ((f32("a"),), DENORMAL, {"a": 0.0}),
    ((f32("a", optional=True),), NAN, {"a": None}), ((f32("a", optional=True),), INFINITE, None),
    ((f32("a"), f32("b")), NAN + bytes(4), None), ((f32(""),), NAN, {}),
    ((f32("a"), f32("b")), INFINITE + struct.pack("<f", -math.inf), None),
    ((const(7), uint("a")), b"\7\1", {"a": 1}), ((const(7), uint("a")), b"\6\1", None),
    ((unused(8), uint("a")), b"\6\1", {"a": 1}), ((uint("a", 16),), b"", None),
    ((uint("a", 16),), b"\1", None), ((uint("a", 16),), b"\1\2\3", None),
]
# fmt: on


@pytest.mark.parametrize(("fields", "data", "values"), MALFORMED)
def test_malformed_data_is_refused(fields: tuple[Field, ...], data: bytes, values: Any) -> None:
    assert table(*fields).read("m", data) == values


@pytest.mark.parametrize(
    ("changes", "sent", "accepted", "refused"),
    [
        ({}, "0201", ["0201"], ["", "02", "020100"]),
        ({"sent": 8}, "0201000000000000", ["0201", "0201000000000000", "02010009"], ["02", "", "00" * 9]),
        ({"sent": 1}, "02", ["0201"], ["02"]),
        ({"fewest": 0}, "0201", ["0201", "02010000"], ["00" * 9]),
        ({"fewest": 1}, "0201", ["0201", "020100"], [""]),
    ],
)
def test_padding(changes: dict[str, int], sent: str, accepted: list[str], refused: list[str]) -> None:
    one = table(uint("a", 16), **changes)
    assert one.encode("m", a=0x102).data.hex() == sent
    assert [one.read("m", bytes.fromhex(data)) for data in accepted] == [{"a": 0x102}] * len(accepted)
    assert [one.read("m", bytes.fromhex(data)) for data in refused] == [None] * len(refused)


def test_what_was_left_out_is_zero() -> None:
    assert table(uint("a"), uint("b", 16), fewest=1).read("m", b"\7") == {"a": 7, "b": 0}


# -- ids -----------------------------------------------------------------------------------------------

DATA_IN_ID = Row("data", (const(3, 5), uint("x", 16), uint("address")), (uint("a"),), extended=True)
ROWS = (
    Row("one", ADDRESS, (const(1), uint("a"))),
    Row("two", ADDRESS, (const(2), uint("a")), read_only=True),
    Row("to all", (const(0x7FF, 11),), (uint("address"), uint("a"))),
    Row("question", ADDRESS, (), read_only=True, remote=True),
    Row("reply", (uint("address", 11),), (uint("a"),), "from_device"),
    DATA_IN_ID,
)
TABLE = Table(ROWS)


@pytest.mark.parametrize(
    ("frame", "decoded"),
    [
        (CanFrame(0x507, b"\1\5"), ("one", 7, {"a": 5})),
        (CanFrame(0x507, b"\2\5"), ("two", 7, {"a": 5})),
        (CanFrame(0x507, b"\3\5"), ("", 7, {})),
        (CanFrame(0x507, b"\1"), ("", 7, {})),
        (CanFrame(0x507, b"", remote=True), ("question", 7, {})),
        (CanFrame(0x7FF, b"\7\5"), ("to all", 7, {"address": 7, "a": 5})),
        (CanFrame(0x7FF, b"\7"), ("", -1, {})),
        (CanFrame(0x03ABCD07, b"\5", extended=True), ("data", 7, {"a": 5, "x": 0xABCD})),
        (CanFrame(0x407, b"\1\5"), None),
        (CanFrame(0x507, b"\1\5", extended=True), None),
        (CanFrame(0x507, b"\1\5", fd=True), None),
        (CanFrame(0x04ABCD07, b"\5", extended=True), None),
        (b"\1\5", None),
    ],
)
def test_a_frame_is_the_message_of_its_id(frame: CanFrame, decoded: Any) -> None:
    got = TABLE.decode(frame, "to_device")
    assert (None if got is None else (got.name, got.address, got.values)) == decoded
    assert [TABLE.decode_once(frame), TABLE.decode_once(frame)] == [got, got], (
        "of each device that receives it"
    )
    name = decoded[0] if decoded else ""
    assert TABLE.names(frame) == ((name,) if name else ())
    assert TABLE.read_only(frame) is (name in ("two", "question"))


def test_numbers_in_the_id_are_no_ids_to_be_remembered() -> None:
    """Else a set-point in an id would be looked up anew whenever it changes."""
    one = Table([DATA_IN_ID])
    for x in range(0, 0x10000, 999):
        decoded = one.decode(one.encode("data", 7, a=5, x=x), "to_device")
        assert decoded is not None
        assert decoded.values["x"] == x
    _, known = one._extended["to_device"]
    assert len(known) == 1


def test_ids_are_encoded_and_listed_with_the_bits_that_carry_data_open() -> None:
    assert TABLE.encode("data", 7, a=5, x=0xABCD) == CanFrame(0x03ABCD07, b"\5", extended=True)
    assert TABLE.encode("question", 7) == CanFrame(0x507, b"", remote=True)
    assert TABLE.encode("to all", 7, a=5) == CanFrame(0x7FF, b"\7\5")
    moved = (0x03000007 | EXTENDED_BIT, 0x1F0000FF | EXTENDED_BIT)
    assert TABLE.ids("to_device", 7) == (exact(0x507), exact(0x7FF), moved)
    assert TABLE.ids("from_device", 7) == (exact(7),)
    assert TABLE.decode(TABLE.encode("reply", 0x507, a=1), "from_device") is not None
    assert TABLE.names(TABLE.encode("reply", 0x507, a=1)) == ()


def test_an_id_that_is_too_wide_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="an id of 12 bits"):
        table(id=(const(1, 12),))


# -- ranges --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "unit", "inside", "low", "high", "error"),
    [
        (uint("a"), 1.0, 0, 0.0, 255.0, 0.5),
        (sint("a", 16, 0.001), 1.0, 0, -32.768, 32.767, 0.0005),
        (sint("a", 8), math.tau, 1, -127 * math.tau, 126 * math.tau, 0.5 * math.tau),
        (span("a", 8, -1.0, 1.55), 1.0, 0, -1.0, 1.55, 0.01),
        (span("a", 8, -1.0, 1.55, floor=False), 2.0, 2, -1.96, 3.06, 0.01),
    ],
)
def test_ranges(field: Field, unit: float, inside: int, low: float, high: float, error: float) -> None:
    got = table(field).range("m", "a", unit, inside)
    assert (got.low, got.high, got.resolution) == pytest.approx((low, high, error), rel=2e-3)
    assert got.resolution >= error
    for unit in (1.0, 0.1, math.tau):  # of a binary32: no overflow, and a relative error
        whole = f32("a").range(unit)
        assert whole.high <= FLOAT_MAX
        assert whole.relative >= 2.0**-24


@pytest.mark.parametrize(("value", "end"), [(-1.0, True), (1.0, True), (0.0, False), (0.98, False)])
def test_the_ends_of_a_measured_span_are_none(value: float, end: bool) -> None:
    rows = table(span("a", 8, -1.0, 1.0, measured=True))
    decoded = rows.read("m", rows.encode("m", a=value).data)
    assert decoded is not None
    assert (decoded["a"] is None) is end


# -- random rows ---------------------------------------------------------------------------------------


def any_field(random: Random, at: int) -> Field:
    bits, name = random.randint(1, 40), f"f{at}"
    makers = [
        lambda: uint(name, bits),
        lambda: uint(name, bits, random.choice((0.5, 0.01))),
        lambda: sint(name, bits + 1),
        lambda: span(name, min(bits, 24) + 1, -random.uniform(0.1, 9.0), 20.0),
        lambda: const(random.getrandbits(bits), bits),
        lambda: unused(bits),
        lambda: f32(name),
    ]
    return random.choice(makers)()


@pytest.mark.parametrize("seed", range(60))
def test_random_rows_hold_their_bits_in_both_orders(seed: int) -> None:
    """Raw numbers are put together bit by bit, without what the table does."""
    random = Random(seed)
    fields = tuple(any_field(random, at) for at in range(random.randint(1, 7)))
    fields += (unused(-sum(field.bits for field in fields) % 8),) if sum(f.bits for f in fields) % 8 else ()
    raws, values = [], {}
    for field in fields:
        raw = random.getrandbits(field.bits)
        if field.kind == "const":
            raw = int(field.low)
        elif not field.name:
            raw = 0
        elif field.kind == "f32":
            values[field.name] = round(random.uniform(-9, 9) * 64) / 64
            raw = int.from_bytes(struct.pack(">f", values[field.name]), "big")
        else:
            signed = raw - (raw >> field.bits - 1 << field.bits) if field.kind == "int" else raw
            values[field.name] = signed * field.step + (field.low if field.kind == "span" else 0)
        raws.append(raw)
    bits = "".join(f"{raw:0{field.bits}b}" for field, raw in zip(fields, raws, strict=True))
    reverse = "".join(f"{raw:0{f.bits}b}" for f, raw in reversed([*zip(fields, raws, strict=True)]))
    size = len(bits) // 8
    expected = {
        "big": int(bits, 2).to_bytes(size, "big"),
        "little": int(reverse, 2).to_bytes(size, "little"),
    }
    for order, data in expected.items():
        one = table(*fields, order=order)
        assert one.encode("m", **values).data == data, f"seed {seed}: {fields}"
        assert one.read("m", data) == pytest.approx(values, rel=1e-9), f"seed {seed}: {fields}"
