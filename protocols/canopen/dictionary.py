"""The object dictionary of a device: its values, what may be read and written, and what is refused.

Rules. Plain data: the values by (index, subindex). Access returns an SDO abort code, or 0; a refused write
changes nothing. The reasons are checked in this order: no object, no subindex, read only, wrong length,
value. PDOs are reconfigured as CiA 301 demands: while they are disabled, and with no object mapped. Here are
also the list of errors (1003), and what is stored (1010) or restored (1011) for the next start.

Source: package canopen 2.4.1 `node/local.py` for abort codes and their order, `pdo/base.py` `PdoMap.save` for
a reconfiguration; CiA 301 "PDO mapping parameter", 1003, 1010, 1011.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

from protocols.canopen import objects as o
from protocols.canopen import pdo, sdo
from protocols.canopen.objects import Key, Objects, Type, from_bytes, to_bytes
from protocols.canopen.pdo import DISABLED, NO_RTR, Packing, decode_entry
from protocols.canopen.services import EMCY_BASE, SYNC_ID, rpdo_id, tpdo_id
from protocols.messages import MILLISECOND, Nanos

Refuse: TypeAlias = Callable[[Mapping[Key, int], Key, int], int]
"""(values, key, value) → the abort code with which a device refuses the value, or 0."""
SIGNATURES = {o.STORE: int.from_bytes(b"save", "little"), o.RESTORE: int.from_bytes(b"load", "little")}
NOT_STORED = 0x08000020
LARGEST_ID = 0x7FF


def pdo_defaults(
    objects: Objects, node: int, rpdos: Sequence[Sequence[Key]] = (), tpdos: Sequence[Sequence[Key]] = ()
) -> dict[Key, int]:
    """Return the PDO parameters at power-on: those with a mapping are enabled and synchronous, the others
    disabled and event-driven."""
    values: dict[Key, int] = {}
    for first, cob_id, flags, maps in (
        (o.RPDO_COMMUNICATION, rpdo_id, 0, rpdos),
        (o.TPDO_COMMUNICATION, tpdo_id, NO_RTR, tpdos),
    ):
        for number in o.PDO_NUMBERS:
            index, keys = first + number - 1, maps[number - 1] if number <= len(maps) else ()
            values[index, 0] = o.EVENT_TIMER
            values[index, o.COB_ID] = cob_id(number, node) | flags | (0 if keys else DISABLED)
            values[index, o.TRANSMISSION] = 1 if keys else pdo.EVENT
            values[index + o.MAPPING_OFFSET, 0] = len(keys)
            for sub, entry in enumerate(pdo.mapping(objects, *keys), 1):
                values[index + o.MAPPING_OFFSET, sub] = pdo.encode_entry(entry)
    return values


class Dictionary:
    """The objects of one device. Plain data."""

    def __init__(
        self,
        objects: Objects,
        node: int,
        defaults: Mapping[Key, int],
        texts: Mapping[Key, str] = {},
        refuse: Refuse = lambda *_: 0,
        volatile: frozenset[Key] = frozenset(),
        lacks: frozenset[int] = frozenset(),
        timer_unit: Nanos = MILLISECOND,
    ) -> None:
        self.objects, self.texts, self.refuse = objects, texts, refuse
        self.volatile = volatile
        """What is not stored: set-points."""
        self.lacks = lacks
        """Indices in the table that this device does not have."""
        self.timer_unit = timer_unit
        """Of the event timers of its PDOs: CiA 301 has ms, not every maker does."""
        self.factory: dict[Key, int] = dict.fromkeys(objects, 0)
        for index, sub in objects:
            if sub and index not in o.PDO_PARAMETERS and index != o.ERROR_HISTORY:
                self.factory[index, 0] = max(self.factory[index, 0], sub)
        self.factory |= dict.fromkeys(SIGNATURES, 1)
        self.factory |= {o.SYNC_COB_ID: SYNC_ID, o.EMCY_COB_ID: EMCY_BASE + node, **defaults}
        self.stored = self.factory
        """Values at the next start."""
        self.values: dict[Key, int] = {}
        self.packings: dict[int, Packing] = {}
        """Every mapping that is not empty, by its index."""
        self.start()

    def start(self, below: int = 0x1_0000) -> None:
        """Take the stored values of all objects below an index."""
        self.values |= {key: value for key, value in self.stored.items() if key[0] < below}
        for index in sorted(index for index, sub in self.values if not sub and index in o.PDO_PARAMETERS):
            self._repack(index)

    def __deepcopy__(self, _: dict[int, object]) -> Dictionary:
        """Copy what can change: keys and values are numbers, packings are frozen. (Copied often.)"""
        other = object.__new__(Dictionary)
        vars(other).update(vars(self), values=dict(self.values), packings=dict(self.packings))
        return other

    # -- access by SDO and PDO ------------------------------------------------------------------

    def read(self, key: Key) -> tuple[int, bytes]:
        """Read an object by SDO: (0, its bytes), or (abort code, b"")."""
        missing = self._missing(key)
        if missing:
            return missing, b""
        if key[0] == o.ERROR_HISTORY and key[1] > self.values[o.ERROR_COUNT]:
            return sdo.NO_DATA, b""
        if self.objects[key].type is Type.TEXT:
            text = self.texts.get(key)
            return (sdo.NO_DATA, b"") if text is None else (0, text.encode("ascii"))
        return 0, to_bytes(self.objects[key].type, self.values[key])

    def write(self, key: Key, data: bytes, *, sized: bool = True) -> int:
        """Write an object by SDO; return 0, or the abort code. Of data whose size is not given the object
        takes its own length."""
        missing = self._missing(key)
        if missing:
            return missing
        row = self.objects[key]
        if row.access != "rw":
            return sdo.READ_ONLY
        value = from_bytes(row.type, data if sized else data[: row.type.bits // 8])
        if value is None:
            return sdo.LENGTH_MISMATCH
        refused = self._refuse(key, value)
        if not refused:
            self._accept(key, value)
        return refused

    def take(self, key: Key, value: int) -> bool:
        """Write a value of a PDO; return False if it is ignored, as SDO would refuse it."""
        if self._missing(key) or self.objects[key].access != "rw" or self._refuse(key, value):
            return False
        self.values[key] = value
        return True

    def measure(self, values: Mapping[Key, int]) -> None:
        """Set what the device itself finds."""
        self.values.update(values)

    def log_error(self, code: int, register: int) -> None:
        """Put an error at the head of the list, unless it is 0; `register`: 1001."""
        if code:
            count = min(self.values[o.ERROR_COUNT] + 1, o.HISTORY_MOST)
            for sub in range(count, 1, -1):
                self.values[o.ERROR_HISTORY, sub] = self.values[o.ERROR_HISTORY, sub - 1]
            self.values[o.ERROR_HISTORY, 1], self.values[o.ERROR_COUNT] = code, count
        self.values[o.ERROR_REGISTER] = register

    def _missing(self, key: Key) -> int:
        if key[0] in self.lacks or key[0] not in self.objects.indices:
            return sdo.NO_OBJECT
        return 0 if key in self.objects else sdo.NO_SUBINDEX

    def _refuse(self, key: Key, value: int) -> int:
        if key in SIGNATURES:
            return 0 if value == SIGNATURES[key] else NOT_STORED
        if key == o.ERROR_COUNT:  # 0 clears the list
            return sdo.BAD_VALUE if value else 0
        if key == o.SYNC_COB_ID:  # another identifier, or the device as producer, is not supported
            return 0 if value == SYNC_ID else sdo.BAD_VALUE
        if key[0] in o.PDO_PARAMETERS:
            return self._refuse_pdo(*key, value)
        return self.refuse(self.values, key, value)

    def _accept(self, key: Key, value: int) -> None:
        if key == o.STORE:
            rows = self.objects
            kept = {k: v for k, v in self.values.items() if rows[k].access == "rw" and k not in self.volatile}
            self.stored = self.factory | kept
        elif key == o.RESTORE:
            self.stored = self.factory
        else:
            self.values[key] = value
            if key[0] in o.PDO_PARAMETERS:
                self._repack(key[0])

    # -- PDOs -----------------------------------------------------------------------------------

    def _refuse_pdo(self, index: int, sub: int, value: int) -> int:
        if not index & o.MAPPING_OFFSET:
            return self._refuse_communication(index, sub, value)
        if not self.values[index - o.MAPPING_OFFSET, o.COB_ID] & DISABLED:
            return sdo.DEVICE_STATE
        if sub:
            return sdo.INCOMPATIBLE if self.values[index, 0] else self._unmappable(index, value)
        if value > o.MAPPED_MOST:
            return sdo.BAD_VALUE
        entries = [self.values[index, at] for at in range(1, value + 1)]
        if any(self._unmappable(index, entry) for entry in entries):
            return sdo.NOT_MAPPABLE
        return sdo.PDO_TOO_LONG if sum(decode_entry(entry).bits for entry in entries) > pdo.MOST_BITS else 0

    def _refuse_communication(self, index: int, sub: int, value: int) -> int:
        before = self.values[index, o.COB_ID]
        if sub == o.COB_ID:
            # An identifier is changed only while the PDO is disabled (CiA 301 "COB-ID used by PDO").
            if value & ~(DISABLED | NO_RTR | LARGEST_ID) or not value & LARGEST_ID:
                return sdo.BAD_VALUE
            return 0 if (before | value) & DISABLED or not (value ^ before) & LARGEST_ID else sdo.DEVICE_STATE
        if sub == o.TRANSMISSION:
            return sdo.BAD_VALUE if pdo.SYNCHRONOUS_MOST < value < pdo.EVENT_VENDOR else 0
        return 0 if before & DISABLED or sub == o.EVENT_TIMER else sdo.DEVICE_STATE

    def _unmappable(self, index: int, value: int) -> int:
        """Return an abort code if an object is unknown, not mappable, not writable, or of another length."""
        entry = decode_entry(value)
        known = None if self._missing(entry.key) else self.objects[entry.key]
        if known is None or not known.mappable or known.type.bits != entry.bits:
            return sdo.NOT_MAPPABLE
        return sdo.NOT_MAPPABLE if index < o.TPDO_COMMUNICATION and known.access != "rw" else 0

    def _repack(self, index: int) -> None:
        if index & o.MAPPING_OFFSET and (index, 0) in self.values:
            self.packings.pop(index, None)
            entries = [decode_entry(self.values[index, sub]) for sub in range(1, self.values[index, 0] + 1)]
            if entries:
                self.packings[index] = pdo.packing(self.objects, entries)

    def active(self, communication: int) -> Packing | None:
        """Return the mapping of an enabled, non-empty PDO, by the index of its communication parameter."""
        if self.values[communication, o.COB_ID] & DISABLED:
            return None
        return self.packings.get(communication + o.MAPPING_OFFSET)
