"""Frames of a conversation of vectors: devices' encoded, and ours read, by cantools from the vendor's DBC.

Rules. The DBCs are those of package odrive-can 2.1.0; our codec has no part in it. What they do not have
(node ids given out and replies to discovery; Estop of 0.5.x) is shown as bytes.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from odrive_can.utils import get_dbc

from protocols.frames import CanFrame
from protocols.odrive_can.options import Options, Settings
from protocols.plugin import Device

DBCS = {"0.5": get_dbc("odrive-cansimple-0.5.6"), "0.6": get_dbc("odrive-cansimple-0.6.10")}
MESSAGES: dict[str, dict[str, Any]] = {
    line: {m.name[6:]: m for m in dbc.messages if m.name.startswith("Axis3_")} for line, dbc in DBCS.items()
}
"""By firmware line and name: the messages of the DBC."""
BY_CMD = {line: {m.frame_id & 0x1F: m for m in table.values()} for line, table in MESSAGES.items()}
ADDRESS = 0x06
"""Assigning a node id is not in the DBC, and shown as bytes."""


def frame(name: str, line: str = "0.6", node: int = 3, extended: bool = False, **signals: float) -> CanFrame:
    """A message as cantools encodes it; a signal that is not named is 0."""
    return _frame(name, line, node, extended, tuple(signals.items()))


@cache
def _frame(
    name: str, line: str, node: int, extended: bool, signals: tuple[tuple[str, float], ...]
) -> CanFrame:
    message = MESSAGES[line][name]
    data = message.encode({s.name: 0 for s in message.signals} | dict(signals), scaling=True, strict=True)
    return CanFrame(node << 5 | message.frame_id & 0x1F, data, extended)


@cache
def meaning(frame: CanFrame, line: str = "0.6") -> str:
    """A frame as cantools reads it: node, name, values."""
    node, cmd = f"{'x' if frame.extended else ''}{frame.id >> 5}", frame.id & 0x1F
    message = BY_CMD[line].get(cmd)
    if frame.remote:
        return f"{node}?{message.name[6:] if message else hex(cmd)}"
    if message is None or cmd == ADDRESS:
        return f"{node}:{cmd:#04x} {frame.data.hex()}".rstrip()
    values = message.decode(frame.data, decode_choices=False)
    return " ".join([f"{node}:{message.name[6:]}", *(f"{value:g}" for value in values.values())])


def device(name: str = "left", address: int = 3, **options: Any) -> Device:
    """A device of the robot file."""
    return Device(name, address, Options(**options), Settings())


SERIAL = 0x385F34733330
DISCOVERED = CanFrame(0x66, bytes.fromhex("03303373345f3800"))
"""Vector address_reply06."""


def address(node: int, serial: int) -> CanFrame:
    """An answer to the roll call, as vector address_reply06 has it."""
    return CanFrame(node << 5 | ADDRESS, bytes([node]) + serial.to_bytes(6, "little") + b"\0")


def names_of(line: str, message: str, signal: str) -> dict[int, str]:
    """The values of a signal, or the bits of an error word, as the DBC names them."""
    choices = next(s for s in MESSAGES[line][message].signals if s.name == signal).choices or {}
    return {int(value): str(name) for value, name in choices.items()}
