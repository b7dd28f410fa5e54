"""The vendor's names of a host's messages: `messages_in`, which identifies the reference vector of a frame.

Rules. A name stands for one payload: where the firmware lines have different messages of one name, that of
0.5.x is marked. Bytes that the two lines decode differently have both names. A remote frame is named after
the message that it requests.
"""

from __future__ import annotations

import re

from protocols.frames import CanFrame, Frame
from protocols.odrive_can import messages as m
from protocols.odrive_can.codec import BROADCAST, TABLES, node_of
from protocols.odrive_can.layout import Layout

NAMES: dict[type, str] = {
    m.RxSdo: "RxSdo",
    m.EnterDfuMode: "Enter_DFU_Mode",
    m.SetAxisNodeId: "Set_Axis_Node_ID",
    m.RequestAdcVoltage: "Ask_ADC_Voltage",
    m.Reboot05: "Reboot (0.5.x)",
    m.ClearErrors05: "Clear_Errors (0.5.x)",
    m.Heartbeat05: "Heartbeat (0.5.x)",
}
"""Where the name is not the class's with underscores."""
SIZES = {"f": 4, "n": 4, "m": 2, "B": 1, "c": 0, "b": 1, "7": 0, "H": 2, "I": 4, "i": 4, "S": 6, "Q": 8}
"""Bytes by the code of a field, as in `Layout.codes`."""


def messages_in(frame: Frame) -> tuple[str, ...]:
    """Return the names of the one message to a device in this frame, as each firmware line decodes it."""
    if not isinstance(frame, CanFrame) or frame.fd or len(frame.data) > 8:
        return ()
    cmd = frame.id & 0x1F
    tables = (TABLES["0.6"], TABLES["0.5"])
    if frame.remote:
        requested = [table.from_device[cmd] for table in tables if cmd in table.requestable]
        return _names("request for ", requested)
    rows = [table.to_device[cmd] for table in tables if cmd in table.to_device]
    # A node id is assigned on the broadcast node in 0.6.x, on the axis' present node in 0.5.x.
    other_line = m.SetAxisNodeId if node_of(frame) == BROADCAST else m.Address
    complete = [row for row in rows if row.message is not other_line and _size(row) <= len(frame.data)]
    longest = max(map(_size, complete), default=0)
    return _names("", [row for row in complete if _size(row) == longest])


def _names(prefix: str, rows: list[Layout]) -> tuple[str, ...]:
    names = [
        NAMES.get(row.message) or re.sub(r"(?<=[a-z])(?=[A-Z])", "_", row.message.__name__) for row in rows
    ]
    return tuple(dict.fromkeys(prefix + name for name in names))


def _size(row: Layout) -> int:
    """Return the bytes that the message's fields occupy."""
    return sum(SIZES[code] for code in row.codes)
