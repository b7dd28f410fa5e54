"""A drive for transcripts: package canopen 2.4.1's LocalNode, with our table of objects.

Rules. SDO, NMT and the bytes of values are the package's. The rest is what manual and public drivers have:
the lower bits of the statusword follow the controlword; PDOs may be mapped while they are enabled, and act
while the node is operational; event timers are in 0.5 ms; an RPDO of another length than its mapping is lost.

What a transcript's `peer NAME …` lines demand of it (numbers decimal or 0x…): `6064:01=-8192` sets objects,
`has 60FF:03=0` holds these values now, `lacks 200F` has no such object, `restarts` loses what was written.
"""

from __future__ import annotations

from typing import Any

import canopen
from canopen.objectdictionary import ODRecord, ODVariable, datatypes

from protocols.canopen.objects import Key, Type, parse
from protocols.frames import CanFrame, Frame
from protocols.plugin import Device
from protocols.zlac8015d import table as z
from tests.protocols.cia402.stack import Joined

TYPES = {
    Type.I8: datatypes.INTEGER8,
    Type.I16: datatypes.INTEGER16,
    Type.I32: datatypes.INTEGER32,
    Type.U8: datatypes.UNSIGNED8,
    Type.U16: datatypes.UNSIGNED16,
    Type.U32: datatypes.UNSIGNED32,
}
WORDS = {0x06: 0x21, 0x07: 0x23, 0x0F: 0x27, 0x02: 0x07}
"""Statuswords of a side, by the controlword; 0x40 after any other."""


def dictionary() -> Any:
    """Return our table of objects as the package's."""
    made: Any = canopen.ObjectDictionary()  # type: ignore[no-untyped-call] # the package has no types
    records: dict[int, Any] = {}
    for (index, sub), row in z.OBJECTS.items():
        if row.type not in TYPES or index in z.LACKS:
            continue
        variable = ODVariable(row.name, index, sub)
        variable.data_type, variable.access_type, variable.default = TYPES[row.type], row.access, 0
        if (index, 1) in z.OBJECTS:
            records.setdefault(index, ODRecord(f"{index:04X}", index)).add_member(variable)
        else:
            made.add_object(variable)
    for record in records.values():
        made.add_object(record)
    return made


class Drive:
    """The drive, stepped by milliseconds."""

    def __init__(self, device: Device) -> None:
        self.node, self.ms = device.address & 0x7F, 0
        self.network = Joined()
        self.local: Any = self.network.create_node(self.node, dictionary())
        self.local.add_write_callback(self._written)  # type: ignore[no-untyped-call] # the package has no types
        self._restart()

    def _restart(self) -> None:
        self.local.data_store.clear()
        self.local.nmt.state = "INITIALISING"
        self.local.nmt.state = "PRE-OPERATIONAL"
        self._put(z.STATUS, 0x00400040)

    def _put(self, key: Key, value: int) -> None:
        row = z.OBJECTS[key].type
        self.local.set_data(*key, value.to_bytes(row.bits // 8, "little", signed=row.signed))

    def _get(self, index: int, sub: int = 0) -> int:
        return int.from_bytes(
            self.local.get_data(index, sub), "little", signed=z.OBJECTS[index, sub].type.signed
        )

    def _written(self, **of: Any) -> None:
        if of["index"] == z.CONTROL[0]:
            word = WORDS.get(int.from_bytes(of["data"], "little"), 0x40)
            self._put(z.STATUS, z.combine(word, word))

    def receive(self, frame: Frame) -> None:
        if not isinstance(frame, CanFrame):
            return
        if frame.id == self._get(0x1401, 1) and self.local.nmt.state == "OPERATIONAL":
            entries = [self._get(0x1601, n) for n in range(1, self._get(0x1601) + 1)]
            if sum(entry & 0xFF for entry in entries) == 8 * len(frame.data):
                self.local.set_data(entries[0] >> 16, entries[0] >> 8 & 0xFF, frame.data)
        self.network.handle(frame)

    def step(self) -> list[Frame]:
        self.ms += 1
        sent, self.network.sent = self.network.sent, []
        for number in range(4) if self.local.nmt.state == "OPERATIONAL" else ():
            timer = self._get(0x1800 + number, 5)
            if timer and not self.ms % max(timer // 2, 1):
                entries = [self._get(0x1A00 + number, n) for n in range(1, self._get(0x1A00 + number) + 1)]
                data = b"".join(self.local.get_data(each >> 16, each >> 8 & 0xFF) for each in entries)
                sent.append(CanFrame(self._get(0x1800 + number, 1), data))
        return [*sent]

    def change(self, text: str) -> str:
        """Do what a line demands, or return what is not as it demands."""
        first, *rest = text.split()
        if first == "restarts":
            self._restart()
        elif first == "lacks":
            del self.local.object_dictionary[int(rest[0], 16)]
        else:
            pairs = [each.split("=") for each in (rest if first == "has" else (first, *rest))]
            values = {key: int(value, 0) for name, value in pairs if (key := parse(name)) is not None}
            if first == "has":
                return ", ".join(
                    f"{key}: {self._get(*key)}" for key in values if self._get(*key) != values[key]
                )
            for key, value in values.items():
                self._put(key, value)
        return ""
