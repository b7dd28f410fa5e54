"""PDO mappings of a device: read first, kept if they fit, else rewritten in the usual order.

Rules. Pure functions over values. A PDO of the device is *usable* if it is enabled, has its identifier of the
predefined connection set, takes effect without more SYNC than was agreed, and has no object for which the
driver has no value. A set of PDOs *fits* if the objects that move the motor and those that report its state
are in usable ones; other objects are transferred by SDO. Order of writing: as `PdoMap.save()` of package
canopen 2.4.1 (COB-ID with bit 31, transmission type, inhibit time, event timer, count 0, entries, count,
COB-ID).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from protocols.canopen.pdo import (
    DISABLED,
    EVENT,
    MOST_BITS,
    NO_RTR,
    Entry,
    decode_entry,
    encode_entry,
    entry,
    is_synchronous,
)
from protocols.canopen.services import rpdo_id, tpdo_id
from protocols.cia402 import objects as o
from protocols.cia402.objects import OBJECTS, Key, to_bytes
from protocols.cia402.options import Options
from protocols.messages import MILLISECOND, Nanos

PdoKind = Literal["RPDO", "TPDO"]
"""RPDO: to the device; TPDO: from it."""
FIRST: Mapping[PdoKind, tuple[int, int]] = {
    "RPDO": (o.RPDO_COMMUNICATION, o.RPDO_MAPPING),
    "TPDO": (o.TPDO_COMMUNICATION, o.TPDO_MAPPING),
}
FLAGS = 0xE000_0000
"""Of a COB-ID: not valid, no RTR, extended."""
DUMMIES = range(1, 8)
"""Indices that only take room."""
FILLED = frozenset({o.CONTROLWORD, o.MODE, *o.TARGETS})
"""Objects for which the driver has a value at any time."""
SLOW = 10
"""SYNCs, or event timers, per TPDO of the supply."""
LARGEST_TIME = 0xFFFF


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO of a device."""

    kind: PdoKind
    number: int
    cob: int
    """COB-ID with its flags."""
    transmission: int = EVENT
    event_ms: int = 0
    entries: tuple[Entry, ...] = ()

    @property
    def enabled(self) -> bool:
        """True if it exists on the bus."""
        return not self.cob & DISABLED

    @property
    def id(self) -> int:
        """Its identifier."""
        return self.cob & ~FLAGS

    @property
    def keys(self) -> tuple[Key, ...]:
        """The mapped objects."""
        return tuple(one.key for one in self.entries)

    def period(self, sync: Nanos) -> Nanos | None:
        """Return the period at which it is sent; None if only on a change, or unknown."""
        if is_synchronous(self.transmission):
            return max(self.transmission, 1) * sync if sync and self.transmission else None
        return self.event_ms * MILLISECOND or None


def parameters(kind: PdoKind, number: int) -> tuple[int, int]:
    """Return the indices of a PDO's communication and mapping parameters."""
    communication, mapped = FIRST[kind]
    return communication + number - 1, mapped + number - 1


def default_id(kind: PdoKind, number: int, node: int) -> int:
    """Return the identifier of a PDO in the predefined connection set."""
    return rpdo_id(number, node) if kind == "RPDO" else tpdo_id(number, node)


# -- reading --------------------------------------------------------------------------------------------


def next_key(number: int, kind: PdoKind, read: Mapping[Key, int], absent: Collection[Key]) -> Key | None:
    """Return the object of a PDO to be read next; None if it is known, or the device does not have it."""
    communication, mapped = parameters(kind, number)
    cob = (communication, o.COB_ID)
    wanted = [cob]
    if not read.get(cob, DISABLED) & DISABLED:
        wanted += [(communication, o.TRANSMISSION), (mapped, 0)]
        wanted += [(communication, o.EVENT_TIMER)] if kind == "TPDO" else []
        wanted += [(mapped, sub) for sub in range(1, min(read.get((mapped, 0), 0), MOST_BITS) + 1)]
    return next((key for key in wanted if key not in read and key not in absent), None)


def pdo_of(number: int, kind: PdoKind, read: Mapping[Key, int]) -> Pdo | None:
    """Make a PDO of what was read; None if the device does not have it."""
    communication, mapped = parameters(kind, number)
    cob = read.get((communication, o.COB_ID))
    if cob is None:
        return None
    count = read.get((mapped, 0), 0)
    values = [read.get((mapped, sub)) for sub in range(1, count + 1)]
    entries = tuple(decode_entry(value) for value in values if value is not None)
    bits = [one.bits for one in entries]
    if len(entries) < count or sum(bits) > MOST_BITS or not all(bits):
        cob |= DISABLED  # its layout is not known
    transmission = read.get((communication, o.TRANSMISSION), EVENT)
    return Pdo(kind, number, cob, transmission, read.get((communication, o.EVENT_TIMER), 0), entries)


# -- judging --------------------------------------------------------------------------------------------


def usable(pdo: Pdo, node: int, synced: bool) -> bool:
    """True if a PDO can be used as it is; `synced`: there is SYNC while the device is commanded."""
    if not pdo.enabled or not pdo.entries or pdo.cob & ~NO_RTR != default_id(pdo.kind, pdo.number, node):
        return False
    if is_synchronous(pdo.transmission) and not synced:
        return False
    filled = all(key[0] in DUMMIES or key in FILLED for key in pdo.keys)
    whole = all(one.key not in OBJECTS or OBJECTS[one.key].bits == one.bits for one in pdo.entries)
    return whole and (filled or pdo.kind == "TPDO")


def commands_fit(pdos: Sequence[Pdo], targets: Collection[Key]) -> bool:
    """True if controlword and set-points are in these usable PDOs."""
    mapped = {key for pdo in pdos if pdo.kind == "RPDO" for key in pdo.keys}
    return o.CONTROLWORD in mapped and mapped >= set(targets)


def feedback_fits(pdos: Sequence[Pdo], sync: Nanos, most: Nanos) -> bool:
    """True if these PDOs report position and statusword, the position at least every `most`."""
    tpdos = [pdo for pdo in pdos if pdo.kind == "TPDO"]
    status = any(o.STATUSWORD in pdo.keys for pdo in tpdos)
    periods = [pdo.period(sync) for pdo in tpdos if o.POSITION in pdo.keys]
    return status and any(period is not None and period <= most for period in periods)


# -- the driver's own mapping ---------------------------------------------------------------------------


def wanted(node: int, options: Options, synced: bool, absent: Collection[Key]) -> list[Pdo]:
    """Return the PDOs as this driver writes them. `absent`: objects that the device does not have.

    Cyclic set-points take effect on SYNC, those of profile modes at once: their handshake would be slow."""

    def pdo(kind: PdoKind, number: int, transmission: int, event_ms: int, *keys: Key) -> Pdo:
        entries = tuple(entry(OBJECTS, key) for key in keys if key not in absent)
        return Pdo(kind, number, default_id(kind, number, node), transmission, event_ms, entries)

    at_once = not synced or options.modes == "profile"
    command = EVENT if at_once else 1
    pdos = [
        pdo("RPDO", 1, command, 0, o.CONTROLWORD, o.MODE, o.TARGET_POSITION),
        pdo("RPDO", 2, command, 0, o.TARGET_VELOCITY, o.TARGET_TORQUE, o.TORQUE_OFFSET),
        pdo("RPDO", 3, command, 0, o.VELOCITY_OFFSET),
    ]
    if options.feedback != "sdo":
        event_ms = min(options.feedback_ms, LARGEST_TIME)
        motion = (1, 0) if synced else (EVENT, event_ms)
        slow = (SLOW, 0) if synced else (EVENT, min(SLOW * event_ms, LARGEST_TIME))
        pdos += [
            pdo("TPDO", 1, *motion, o.STATUSWORD, o.MODE_DISPLAY, o.POSITION),
            pdo("TPDO", 2, *motion, o.VELOCITY, o.TORQUE, o.ERROR_CODE),
            pdo("TPDO", 3, *slow, o.CURRENT, o.DC_VOLTAGE),
        ]
    return [each for each in pdos if each.entries]


def same(one: Pdo, other: Pdo) -> bool:
    """True if `one`, of the device, is as `other`, wanted."""
    if not one.enabled:
        return False
    alike = (one.id, one.transmission, one.entries) == (other.id, other.transmission, other.entries)
    return alike and (
        other.kind == "RPDO" or is_synchronous(one.transmission) or one.event_ms == other.event_ms
    )


def writes(pdo: Pdo, before: int) -> list[tuple[Key, bytes]]:
    """Return the downloads that configure a PDO, in order. `before`: its present COB-ID; a TPDO without
    remote frames stays so."""
    communication, mapped = parameters(pdo.kind, pdo.number)
    cob = pdo.cob | before & NO_RTR
    values: list[tuple[Key, int]] = [((communication, o.COB_ID), cob | DISABLED)]
    values.append(((communication, o.TRANSMISSION), pdo.transmission))
    if pdo.kind == "TPDO" and not is_synchronous(pdo.transmission):
        values.append(((communication, o.INHIBIT), min(10 * pdo.event_ms, LARGEST_TIME)))
        values.append(((communication, o.EVENT_TIMER), pdo.event_ms))
    values.append(((mapped, 0), 0))
    values += [((mapped, sub), encode_entry(one)) for sub, one in enumerate(pdo.entries, 1)]
    values.append(((mapped, 0), len(pdo.entries)))
    values.append(((communication, o.COB_ID), cob))
    return [(key, to_bytes(OBJECTS[key].type, value)) for key, value in values]
