"""PDO mappings of a device: read first, left if they fit, else written anew in the usual order.

Rules. Pure functions over values. A PDO of the device is *usable* if it is enabled, has its identifier of the
predefined connection set, takes effect without us doing more than was agreed, and holds nothing that we would
fill with an invented number. A set of PDOs *fits* if what moves the motor and what tells of it stands in
usable ones; what else is wanted goes by SDO. Order of writing: as `PdoMap.save()` of package canopen 2.4.1
(COB-ID with bit 31, transmission type, inhibit time, event timer, count 0, entries, count, COB-ID).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from protocols.cia402 import objects as o
from protocols.cia402.codec import rpdo_id, tpdo_id
from protocols.cia402.objects import OBJECTS, Key, to_bytes
from protocols.cia402.options import Options
from protocols.cia402.pdo import DISABLED, EVENT, MOST_BITS, Entry, entry, entry_of, is_synchronous, word_of
from protocols.messages import MILLISECOND, Nanos

Way = Literal["to", "from"]
"""To the device (RPDO), or from it (TPDO)."""
FIRST: Mapping[Way, tuple[int, int]] = {
    "to": (o.RPDO_COMMUNICATION, o.RPDO_MAPPING),
    "from": (o.TPDO_COMMUNICATION, o.TPDO_MAPPING),
}
FLAGS = 0xE000_0000
"""Of a COB-ID: not valid, no RTR, extended."""
DUMMIES = range(1, 8)
"""Indices that only take room."""
FILLED = frozenset(
    {
        o.CONTROLWORD,
        o.MODE,
        o.TARGET_POSITION,
        o.TARGET_VELOCITY,
        o.TARGET_TORQUE,
        o.VELOCITY_OFFSET,
        o.TORQUE_OFFSET,
    }
)
"""What our end has a number for at any time."""
SLOW = 10
"""What is told of the supply comes with every so manieth SYNC."""
LARGEST_TIME = 0xFFFF


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO as a device has it."""

    way: Way
    number: int
    cob: int
    """With its flags."""
    transmission: int = EVENT
    event_ms: int = 0
    entries: tuple[Entry, ...] = ()

    @property
    def enabled(self) -> bool:
        """Whether it exists on the bus."""
        return not self.cob & DISABLED

    @property
    def id(self) -> int:
        """Its identifier."""
        return self.cob & ~FLAGS

    @property
    def keys(self) -> tuple[Key, ...]:
        """What it holds."""
        return tuple(one.key for one in self.entries)

    def period(self, sync: Nanos) -> Nanos | None:
        """How often it comes by itself; None if only on a change, or not known."""
        if is_synchronous(self.transmission):
            return max(self.transmission, 1) * sync if sync and self.transmission else None
        return self.event_ms * MILLISECOND or None


# -- reading --------------------------------------------------------------------------------------------


def to_be_read(number: int, way: Way, read: Mapping[Key, int], absent: Collection[Key]) -> Key | None:
    """What is next to be read of a PDO; None if it is known, or the device does not have it."""
    communication, mapped = (first + number - 1 for first in FIRST[way])
    cob = (communication, o.COB_ID)
    wanted = [cob]
    if not read.get(cob, DISABLED) & DISABLED:
        wanted += [(communication, o.TRANSMISSION), (mapped, 0)]
        wanted += [(communication, o.EVENT_TIMER)] if way == "from" else []
        wanted += [(mapped, sub) for sub in range(1, min(read.get((mapped, 0), 0), MOST_BITS) + 1)]
    return next((key for key in wanted if key not in read and key not in absent), None)


def pdo_of(number: int, way: Way, read: Mapping[Key, int]) -> Pdo | None:
    """A PDO from what was read of it; None if the device does not have it."""
    communication, mapped = (first + number - 1 for first in FIRST[way])
    cob = read.get((communication, o.COB_ID))
    if cob is None:
        return None
    count = read.get((mapped, 0), 0)
    words = [read.get((mapped, sub)) for sub in range(1, count + 1)]
    entries = tuple(entry_of(word) for word in words if word is not None)
    if (
        len(entries) < count
        or sum(one.bits for one in entries) > MOST_BITS
        or not all(x.bits for x in entries)
    ):
        cob |= DISABLED  # nobody knows how it lies
    transmission = read.get((communication, o.TRANSMISSION), EVENT)
    return Pdo(way, number, cob, transmission, read.get((communication, o.EVENT_TIMER), 0), entries)


# -- judging --------------------------------------------------------------------------------------------


def usable(pdo: Pdo, node: int, synced: bool) -> bool:
    """Whether a PDO can be worked with as it is; `synced`: SYNC comes while the device is commanded."""
    own = rpdo_id(pdo.number, node) if pdo.way == "to" else tpdo_id(pdo.number, node)
    if not pdo.enabled or not pdo.entries or pdo.cob & ~DISABLED & ~(1 << 30) != own:
        return False
    if is_synchronous(pdo.transmission) and not synced:
        return False
    known = all(key[0] in DUMMIES or key in FILLED for key in pdo.keys)
    whole = all(key not in OBJECTS or OBJECTS[key].bits == one.bits for key, one in _pairs(pdo))
    return whole and (known or pdo.way == "from")


def _pairs(pdo: Pdo) -> Iterable[tuple[Key, Entry]]:
    return zip(pdo.keys, pdo.entries, strict=True)


def commands_fit(pdos: Sequence[Pdo], targets: Collection[Key]) -> bool:
    """Whether controlword and set-points stand in these usable PDOs."""
    held = {key for pdo in pdos if pdo.way == "to" for key in pdo.keys}
    return o.CONTROLWORD in held and held >= set(targets)


def feedback_fits(pdos: Sequence[Pdo], sync: Nanos, most: Nanos) -> bool:
    """Whether position and statusword come by themselves, the position at least every `most`."""
    reported = [pdo for pdo in pdos if pdo.way == "from"]
    status = any(o.STATUSWORD in pdo.keys for pdo in reported)
    periods = [pdo.period(sync) for pdo in reported if o.POSITION in pdo.keys]
    return status and any(period is not None and period <= most for period in periods)


# -- what is wanted -------------------------------------------------------------------------------------


def wanted(node: int, options: Options, synced: bool, absent: Collection[Key]) -> list[Pdo]:
    """The PDOs as this driver writes them. `absent`: objects that the device does not have.

    Cyclic set-points take effect on SYNC, those of profile modes at once: their handshake would be slow."""
    at_once = not synced or options.modes == "profile"
    set_point = EVENT if at_once else 1
    event_ms = min(options.feedback_ms, LARGEST_TIME)
    maps = [
        Pdo("to", 1, 0, set_point, 0, _mapped(absent, o.CONTROLWORD, o.MODE, o.TARGET_POSITION)),
        Pdo("to", 2, 0, set_point, 0, _mapped(absent, o.TARGET_VELOCITY, o.TARGET_TORQUE, o.TORQUE_OFFSET)),
        Pdo("to", 3, 0, set_point, 0, _mapped(absent, o.VELOCITY_OFFSET)),
    ]
    if options.feedback != "sdo":
        motion = (1, 0) if synced else (EVENT, event_ms)
        slow = (SLOW, 0) if synced else (EVENT, min(SLOW * event_ms, LARGEST_TIME))
        maps += [
            Pdo("from", 1, 0, *motion, _mapped(absent, o.STATUSWORD, o.MODE_DISPLAY, o.POSITION)),
            Pdo("from", 2, 0, *motion, _mapped(absent, o.VELOCITY, o.TORQUE, o.ERROR_CODE)),
            Pdo("from", 3, 0, *slow, _mapped(absent, o.CURRENT, o.DC_VOLTAGE)),
        ]
    return [_placed(pdo, node) for pdo in maps if pdo.entries]


def _mapped(absent: Collection[Key], *keys: Key) -> tuple[Entry, ...]:
    return tuple(entry(key) for key in keys if key not in absent)


def _placed(pdo: Pdo, node: int) -> Pdo:
    own = rpdo_id(pdo.number, node) if pdo.way == "to" else tpdo_id(pdo.number, node)
    return Pdo(pdo.way, pdo.number, own, pdo.transmission, pdo.event_ms, pdo.entries)


def same(one: Pdo | None, other: Pdo) -> bool:
    """Whether a PDO of the device is as it is wanted."""
    if one is None or not one.enabled:
        return False
    alike = (one.id, one.transmission, one.entries) == (other.id, other.transmission, other.entries)
    return alike and (other.way == "to" or is_synchronous(one.transmission) or one.event_ms == other.event_ms)


def writes(pdo: Pdo, before: int) -> list[tuple[Key, bytes]]:
    """What configures a PDO, in order. `before`: its COB-ID so far; a TPDO that cannot be asked for by a
    remote frame stays so."""
    communication, mapped = (first + pdo.number - 1 for first in FIRST[pdo.way])
    cob = pdo.cob | before & 1 << 30
    said: list[tuple[Key, int]] = [((communication, o.COB_ID), cob | DISABLED)]
    said.append(((communication, o.TRANSMISSION), pdo.transmission))
    if pdo.way == "from" and not is_synchronous(pdo.transmission):
        said.append(((communication, o.INHIBIT), min(10 * pdo.event_ms, LARGEST_TIME)))
        said.append(((communication, o.EVENT_TIMER), pdo.event_ms))
    said.append(((mapped, 0), 0))
    said += [((mapped, sub), word_of(one)) for sub, one in enumerate(pdo.entries, 1)]
    said.append(((mapped, 0), len(pdo.entries)))
    said.append(((communication, o.COB_ID), cob))
    return [(key, to_bytes(OBJECTS[key].type, value)) for key, value in said]
