"""The transcripts of fixtures/transcripts/odrive_can, in frames of the vendor's DBCs; the names in these."""

from __future__ import annotations

import itertools

import pytest

from protocols.messages import Fault
from protocols.odrive_can import plugin
from protocols.plugin import Device
from tests.protocols.odrive_can.dbc import MESSAGES, choices_of, notation
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("odrive_can"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin, notation)


def device(firmware: str) -> Device:
    return Device("left", 3, plugin.options(firmware=firmware), plugin.settings())


@pytest.mark.parametrize(
    ("firmware", "message", "signal", "base", "part"),
    [
        ("0.6", "Heartbeat", "Axis_Error", 0, ""),
        ("0.5", "Heartbeat", "Axis_Error", 5 << 48, ""),
        ("0.5", "Get_Motor_Error", "Motor_Error", 1 << 48, "motor "),
        ("0.5", "Get_Encoder_Error", "Encoder_Error", 2 << 48, "encoder "),
        ("0.5", "Get_Controller_Error", "Controller_Error", 3 << 48, "controller "),
        ("0.5", "Get_Sensorless_Error", "Sensorless_Error", 4 << 48, "sensorless "),
    ],
)
def test_every_error_bit_has_the_vendor_s_name(
    firmware: str, message: str, signal: str, base: int, part: str
) -> None:
    faults = plugin.spec(device(firmware)).faults
    bits = choices_of(firmware, message, signal)
    bits = {bit: name for bit, name in bits.items() if name not in ("NONE", "INITIALIZING")}
    assert {bit: faults[base + bit].name for bit in bits} == {bit: part + bits[bit] for bit in bits}


@pytest.mark.parametrize(("prefix", "line"), [("", "0.6"), ("axis", "0.5")])
def test_every_message_of_a_host_has_the_vendor_s_name(prefix: str, line: str) -> None:
    of_hosts = [name for name, row in MESSAGES[line].items() if not any("ODrive" in s for s in row.senders)]
    assert len(of_hosts) >= 15
    for name in of_hosts:
        assert {name, f"{name} (0.5.x)"} & set(plugin.messages(notation(f"{prefix}3:{name}"))), name


def test_no_heartbeat_of_one_line_is_decoded_as_a_fault_of_the_other() -> None:
    """Of every error bit with every result, or with those flags that 0.5.x sets with it."""
    errors = choices_of("0.6", "Heartbeat", "Axis_Error")
    new = [
        f"3:Heartbeat {bit} 1 {result} {done}" for bit in errors for result in range(16) for done in (0, 1)
    ]
    old = [
        f"axis3:Heartbeat {bit | motor * 0x40 | encoder * 0x100} 1 {motor} {encoder} 0 {done}"
        for bit in choices_of("0.5", "Heartbeat", "Axis_Error")
        for motor, encoder, done in itertools.product((0, 1), repeat=3)
        if (motor or bit != 0x40) and (encoder or bit != 0x100)
    ]
    for text in [*new, *old]:
        events = plugin.driver([device("auto")]).receive(0, notation(text))
        codes = [event.code for event in events if isinstance(event, Fault)]
        assert all((code >= 5 << 48) == text.startswith("axis") for code in codes), text
