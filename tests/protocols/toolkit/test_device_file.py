"""The tables of a device as texts: messages, registers, faults; and every `device.toml` that is shipped."""

from __future__ import annotations

from pathlib import Path

import pytest

import protocols
from protocols.plugin import FaultInfo
from protocols.toolkit.device_file import device_file
from protocols.toolkit.faults import faults
from protocols.toolkit.memory_map import rows
from protocols.toolkit.registers import Register
from protocols.toolkit.table import Field, fields, sint, uint

SHIPPED = sorted(path.parent.name for path in Path(protocols.__file__).parent.glob("*/device.toml"))


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", ()),
        ("count:u32", (uint("count", 32),)),
        ("speed:i32 voltage:u16*0.1", (sint("speed", 32), uint("voltage", 16, 0.1))),
        ("current:i16*0.01", (sint("current", 16, 0.01),)),
    ],
)
def test_the_numbers_of_a_message(text: str, wanted: tuple[Field, ...]) -> None:
    assert fields(text) == wanted


def test_registers_of_several_texts() -> None:
    wanted = [Register("ID", 7, "u8"), Register("Here", 12, "u16", writable=False, sign=15)]
    assert rows("5 u8 ID|10 m15 Here r", shift=2) == wanted
    assert rows("\n5 u8 ID\n", "", "10 m15 Here r", shift=2) == wanted


def test_faults_are_lines_with_phrases_in_common() -> None:
    text = "0x10 hot: hotter than the limit | {cool}\n~32 too fast: a ratio of 2:1 | slow down"
    assert faults(text, {"cool": "let it cool, then clear"}) == {
        16: FaultInfo("hot", "hotter than the limit", "let it cool, then clear"),
        32: FaultInfo("too fast", "a ratio of 2:1", "slow down", latching=False),
    }


@pytest.mark.parametrize("name", SHIPPED)
def test_a_file_that_is_shipped_is_read(name: str) -> None:
    assert device_file(f"protocols.{name}")
