"""Vendors' EDS and DCF files in a cia402 robot: what they lack is told, before anything is opened."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.cia402 import plugin
from protocols.cia402.data_sheet import read
from protocols.plugin import Device, Spec

TWIN = Path(__file__).resolve().parents[2] / "protocols/cia402/twin.eds"
SHEETS: list[tuple[str, set[type[msg.Command]]]] = [
    ("dbc_eds/cia402_cia402_slave.eds", {msg.Position, msg.Velocity}),
    ("dbc_eds/robot_control_prbt_0_1.dcf", {msg.Position}),  # it has no 60FF
    ("dbc_eds/e35.eds", {msg.Position, msg.Velocity, msg.Torque}),
    ("dbc_eds/robot_control_cia402_slave.eds", {msg.Position, msg.Velocity}),  # 6502 has no mode for torque
]


def spec(text: str, name: str = "drive.eds", **changes: Any) -> Spec:
    settings = replace(plugin.settings(), **changes.pop("settings", {}))
    return plugin.spec(Device("drive", 1, plugin.options(eds=f"{name}\n{text}", **changes), settings))


@pytest.mark.parametrize(("name", "commands"), SHEETS, ids=[name for name, _ in SHEETS])
def test_a_drive_is_commanded_as_its_data_sheet_can(
    recording: Callable[[str], Path], name: str, commands: set[type[msg.Command]]
) -> None:
    text = recording(name).read_text()
    made = spec(text, Path(name).name, counts_per_turn=4096.0, velocity_per_turn=60.0, rated_torque=1.0)
    assert {*made.commands} & {msg.Position, msg.Velocity, msg.Torque} == commands


def test_the_twin_is_as_its_own_data_sheet_says() -> None:
    usual = plugin.spec(Device("drive", 1, plugin.options(), plugin.settings()))
    assert spec(TWIN.read_text()).commands == usual.commands


def wrong(*arguments: Any, **changes: Any) -> str:
    with pytest.raises(Invalid) as found:
        spec(*arguments, **changes)
    return "\n".join(f"{key}: {text}" for key, text in found.value.wrong)


def test_what_is_no_drive_or_no_data_sheet_is_told(recording: Callable[[str], Path]) -> None:
    sample = wrong(recording("dbc_eds/sample.eds").read_text(), "sample.eds")
    assert sample.count("no drive of CiA 402 is without") == 4
    assert "sample.eds has no 6040" in sample
    assert "options.eds: x.eds: " in wrong("nonsense [", "x.eds")
    assert "there is no text of 'x.eds'" in wrong("", "x.eds")


def test_without_the_objects_for_units_the_robot_file_has_to_say_them(
    recording: Callable[[str], Path],
) -> None:
    name = "dbc_eds/robot_control_prbt_0_1.dcf"
    told = wrong(recording(name).read_text(), Path(name).name)
    assert re.search(r"^options\.counts_per_turn: \S+ has none of 608F:01 \(Encoder increments\)", told, re.M)
    text = TWIN.read_text()
    start, end = text.index("[6076]"), text.index("[", text.index("[6076]") + 1)
    assert msg.Torque in spec(text).commands
    assert msg.Torque not in spec(text[:start] + text[end:]).commands
    assert msg.Torque in spec(text[:start] + text[end:], rated_torque=1.0).commands


def test_limits_and_mappings_are_held_against_it() -> None:
    text = TWIN.read_text()
    limited = text.replace("[6072]\n", "[6072]\nLowLimit=0\nHighLimit=500\n")
    assert limited != text
    assert "Max torque is 1500, and drive.eds has it from 0 to 500" in wrong(
        limited, settings={"max_torque": 1500}
    )
    start, end = text.index("[6072]"), text.index("[", text.index("[6072]") + 1)
    absent = text[:start] + text[end:]
    assert read(f"a.eds\n{absent}").entries.keys() < read(f"a.eds\n{text}").entries.keys()
    assert "Max torque is stated, and drive.eds has no 6072 (Max torque)" in wrong(
        absent, settings={"max_torque": 1500}
    )
    no_pdo = text.replace("PDOMapping=1", "PDOMapping=0")
    assert "options.mapping: none of 607A (Target position), 60FF (Target velocity)" in wrong(no_pdo)
    assert spec(no_pdo, mapping="keep").commands


def test_modes_are_those_of_6502() -> None:
    text = TWIN.read_text()
    at = text.index("[6502]")
    line = text.index("DefaultValue=", at)
    csp = f"{text[:line]}DefaultValue={1 << 7:#x}{text[text.index(chr(10), line) :]}"
    assert msg.Position in spec(csp).commands
    assert msg.Velocity not in spec(csp).commands
