"""The vendor's names of what a host says: `messages_in`, for whoever asks which vector speaks for a wire.

Rules. A name stands for one payload: where firmware lines say different things by one name, that of 0.5.x is
marked. What the two lines read differently from the same bytes has both names. A question is named after
what it asks for.
"""

from __future__ import annotations

import re

from protocols.frames import CanFrame, Frame
from protocols.odrive_can import messages as m
from protocols.odrive_can import messages05 as m05
from protocols.odrive_can.codec import BROADCAST, TABLES, node_of
from protocols.odrive_can.layout import Layout

NAMES: dict[type, str] = {
    m.RxSdo: "RxSdo",
    m.EnterDfuMode: "Enter_DFU_Mode",
    m05.SetAxisNodeId: "Set_Axis_Node_ID",
    m05.AskAdcVoltage: "Ask_ADC_Voltage",
    m05.Reboot05: "Reboot (0.5.x)",
    m05.ClearErrors05: "Clear_Errors (0.5.x)",
    m05.Heartbeat05: "Heartbeat (0.5.x)",
}
"""Where the vendor's name is not the class's with underscores."""
SIZES = {"f": 4, "n": 4, "m": 2, "B": 1, "c": 0, "b": 1, "7": 0, "H": 2, "I": 4, "i": 4, "S": 6, "Q": 8}


def name_of(message: type) -> str:
    """The vendor's name of a message."""
    return NAMES.get(message) or re.sub(r"(?<=[a-z])(?=[A-Z])", "_", message.__name__)


def messages_in(frame: Frame) -> tuple[str, ...]:
    """The names of the one message to a device in this frame, as each firmware line reads it; () if none."""
    if not isinstance(frame, CanFrame) or frame.fd or len(frame.data) > 8:
        return ()
    cmd = frame.id & 0x1F
    tables = (TABLES["0.6"], TABLES["0.5"])
    if frame.remote:
        reported = [table.from_device[cmd] for table in tables if cmd in table.askable]
        return _names("ask for ", reported)
    rows = [table.to_device[cmd] for table in tables if cmd in table.to_device]
    # A node id is given out on the broadcast node in 0.6.x, to the axis that is to have it in 0.5.x.
    giving_out = node_of(frame) == BROADCAST
    rows = [row for row in rows if row.message not in ((m05.SetAxisNodeId,) if giving_out else (m.Address,))]
    whole = [row for row in rows if _size(row) <= len(frame.data)]
    longest = max(map(_size, whole), default=0)
    return _names("", [row for row in whole if _size(row) == longest])


def _names(prefix: str, rows: list[Layout]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(prefix + name_of(row.message) for row in rows))


def _size(row: Layout) -> int:
    """Bytes that the message's fields fill."""
    return sum(SIZES[code] for code in row.codes)
