"""The signals of CAN frames by a DBC file: what a log or a bus of any maker says.

Needs cantools (the extra `dbc`), which also reads KCD, SYM and ARXML. Physical values are those of the file's
factors and offsets, with its units; choices have their names. A frame that is shorter than its message is
named as that, and so is a multiplexed message whose multiplexer has a value of none of its cases.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gateway.config.text import read_text
from gateway.errors import UserError
from protocols.dbc.database import read_database
from protocols.frames import CanFrame, Packet

MOST = 256
"""Messages of which the last values are kept, by bus and id"""
MOST_CHARACTERS = 20_000_000
"""Of a file: those of whole cars have a million"""


@dataclass(slots=True)
class MessageRecord:
    """What was seen of one message."""

    name: str
    count: int = 0
    text: str = ""
    """Its last signals, or why they cannot be told"""


class DbcSignals:
    """Decodes frames by a file, and keeps the last of each message."""

    def __init__(self, path: Path) -> None:
        """Read the file. Raises UserError: without cantools, or for a file that it cannot read."""
        try:
            found = read_database(path.name, read_text(path, MOST_CHARACTERS, or_else="cp1252"))
        except ValueError as error:
            raise UserError(str(error)) from error
        self.path = path
        self._messages = {(bool(one.is_extended_frame), one.frame_id): one for one in found.messages}
        self.seen: dict[tuple[str, bool, int], MessageRecord] = {}
        self.others = 0
        """Frames of ids that it has not"""

    def take(self, packet: Packet) -> str:
        """Return the name and the signals of a frame; "" if the file has no message of its id."""
        frame = packet.frame
        if not isinstance(frame, CanFrame) or frame.remote:
            return ""
        message = self._messages.get((frame.extended, frame.id))
        if message is None:
            self.others += 1
            return ""
        text = _decoded(message, frame.data)
        key = (packet.bus, frame.extended, frame.id)
        if key in self.seen or len(self.seen) < MOST:
            record = self.seen.setdefault(key, MessageRecord(message.name))
            record.count, record.text = record.count + 1, text
        return f"{message.name}: {text}"

    def page(self, seconds: float) -> list[str]:
        """Return a line for each message that was seen: bus, id, name, rate, last signals."""
        rows = []
        for (bus, extended, number), one in sorted(self.seen.items()):
            head = f"{number:08X}" if extended else f"{number:03X}"
            rate = f"{one.count / seconds:.1f}/s" if seconds > 0 else f"{one.count}"
            rows.append(f"  {bus} {head} {one.name} {rate}  {one.text}")
        told = f"by {self.path.name}: {len(self.seen)} of its {len(self._messages)} messages were seen"
        return [f"{told}; {self.others} frames are of other ids", *rows]


def _decoded(message: Any, data: bytes) -> str:  # noqa: ANN401 -- of cantools
    if len(data) < message.length and not message.is_multiplexed():
        return f"{len(data)} bytes, of which the file has {message.length}: not decoded"
    try:
        values = message.decode(data, decode_choices=True, allow_truncated=True)
    except Exception as error:  # noqa: BLE001 -- whatever the file says, and whatever came
        return f"not decoded: {error}"
    units = {signal.name: signal.unit or "" for signal in message.signals}
    return ", ".join(
        f"{name} {_shown(value)} {units.get(name, '')}".rstrip() for name, value in values.items()
    )


def _shown(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
