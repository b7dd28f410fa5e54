"""Registers by name and number: values and bits, and what is refused."""

from __future__ import annotations

import pytest

from protocols.toolkit.registers import Register, Registers

# fmt: off
REGISTERS = Registers(
    Register("byte", 1, "u8"), Register("word", 2, "u16"), Register("long", 3, "u32"),
    Register("short", 4, "i16"), Register("int", 5, "i32"), Register("float", 6, "f32"),
    Register("fixed", 7, "f32", writable=False),
)
BITS = [
    ("byte", 255, 0xFF), ("word", 0x1234, 0x1234), ("long", 2**32 - 1, 0xFFFF_FFFF),
    ("short", -2, 0xFFFE), ("int", -2, 0xFFFF_FFFE), ("int", 2, 2),
    ("float", 1.0, 0x3F80_0000), ("float", -2.5, 0xC020_0000), ("fixed", 0.0, 0),
]
# fmt: on


@pytest.mark.parametrize(("name", "value", "raw"), BITS)
def test_a_value_is_bits_and_bits_are_a_value(name: str, value: float, raw: int) -> None:
    number = REGISTERS.by_name[name].number
    assert REGISTERS.raw(name, value) == raw
    assert REGISTERS.value(number, raw) == (name, value)


@pytest.mark.parametrize(
    ("number", "raw", "expected"),
    [
        (1, 0x1FF, ("byte", 255.0)),
        (4, 0xABCD_FFFE, ("short", -2.0)),
        (6, 0x7F80_0000, ("float", None)),
        (6, 0x7FC0_0000, ("float", None)),
        (6, 0x8000_0000, ("float", 0.0)),
        (99, 1, ("", None)),
    ],
)
def test_bits_of_devices(number: int, raw: int, expected: tuple[str, float | None]) -> None:
    assert repr(REGISTERS.value(number, raw)) == repr(expected)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("float", None, ""),
        ("fixed", None, ""),
        ("flaot", None, "no parameter 'flaot'; did you mean 'float'?; there are byte, word"),
        ("fixed", 1.0, "fixed is read only"),
        ("byte", 255, ""),
        ("byte", 256, "byte cannot be 256: it is u8, 0 … 255"),
        ("short", -32769, "short cannot be -32769: it is i16, -32768 … 32767"),
        ("int", 1.5, "int cannot be 1.5: it is i32"),
        ("float", 1e39, "float cannot be 1e+39: it is f32"),
    ],
)
def test_what_cannot_be_read_or_written_has_a_reason(name: str, value: float | None, reason: str) -> None:
    wrong = REGISTERS.wrong(name, value)
    assert wrong.startswith(reason)
    assert bool(wrong) is bool(reason)
