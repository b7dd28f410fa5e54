"""Frames by the vendor's DBCs, encoded by cantools: the odrive_can notation of transcripts.

`3:Heartbeat 0 8` is a message of firmware 0.6.x at node 3: signals in the order of the DBC, or by name
(`3:Heartbeat Axis_State=8`); what is not written is 0. `axis3:Heartbeat` is one of 0.5.x, `x3:Heartbeat` the
same with an extended identifier; `3?Get_Error` is a remote frame. The codec under test has no part in it.
"""

from __future__ import annotations

import re
from functools import cache
from typing import Any

from odrive_can.utils import get_dbc

from protocols.frames import CanFrame
from protocols.transcripts.notation import tokens

DBCS = {"0.5": get_dbc("odrive-cansimple-0.5.6"), "0.6": get_dbc("odrive-cansimple-0.6.10")}
MESSAGES: dict[str, dict[str, Any]] = {
    line: {m.name[6:]: m for m in dbc.messages if m.name.startswith("Axis3_")} for line, dbc in DBCS.items()
}
"""By firmware line and name: the messages of the DBC."""
NOTATION = re.compile(r"(axis|x|)(\d+)([:?])(\w+)(.*)")


@cache
def notation(text: str) -> CanFrame:
    """Return the frame that a text means. Raises ValueError if there is none."""
    found = NOTATION.fullmatch(text)
    if found is None:
        raise ValueError(f"{text}: neither a name, nor bytes, nor a message of the DBC")
    prefix, node, mark, name, values = found.groups()
    message = MESSAGES["0.5" if prefix else "0.6"][name]
    identifier, extended = int(node) << 5 | message.frame_id & 0x1F, prefix == "x"
    if mark == "?":
        return CanFrame(identifier, extended=extended, remote=True)
    signals: dict[str, float] = {signal.name: 0 for signal in message.signals}
    order = iter(list(signals))
    for token in tokens(values):
        key, equals, value = token.rpartition("=")
        signals[key if equals else next(order)] = _number(value)
    return CanFrame(identifier, message.encode(signals, scaling=True, strict=True), extended)


def _number(text: str) -> float:
    return int(text, 0) if re.fullmatch(r"-?\d+|0x[0-9a-f]+", text) else float(text)


def choices_of(line: str, message: str, signal: str) -> dict[int, str]:
    """Return the values of a signal, or the bits of an error word, as the DBC names them."""
    choices = next(s for s in MESSAGES[line][message].signals if s.name == signal).choices or {}
    return {int(value): str(name) for value, name in choices.items()}
