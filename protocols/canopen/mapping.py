"""The host's side of PDOs: those that a device has are read, others written; what was written is read back.

Rules. Pure functions over values, and `Setup`, which is plain data. A PDO of the device is *usable* if it is
enabled, has its identifier of the predefined connection set, takes effect without more SYNC than was agreed,
and has no object for which the host has no value. Order of writing: as `PdoMap.save()` of package canopen
2.4.1 (COB-ID with bit 31, transmission type, inhibit time, event timer, count 0, entries, count, COB-ID).

Nothing is taken for written because its writing was confirmed: after the last write of a `Setup` every object
is read back, and what differs is written again.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

from protocols.canopen import objects as o
from protocols.canopen import pdo as p
from protocols.canopen import sdo
from protocols.canopen.client import Job, Outcome, Purpose
from protocols.canopen.objects import Key, Objects, from_bytes, title, to_bytes
from protocols.canopen.services import rpdo_id, tpdo_id
from protocols.messages import MILLISECOND, Nanos

Kind: TypeAlias = Literal["RPDO", "TPDO"]
"""RPDO: to the device; TPDO: from it."""
KINDS: tuple[Kind, Kind] = ("TPDO", "RPDO")
FLAGS = 0xE000_0000
"""Of a COB-ID: not valid, no RTR, extended."""
DUMMIES = range(1, 8)
"""Indices that only take room."""
LARGEST_TIME = 0xFFFF
ROUNDS = 3
"""Times that a setup is written, before a difference is a failure."""


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO of a device."""

    kind: Kind
    number: int
    cob: int
    """COB-ID with its flags."""
    transmission: int = p.EVENT
    event_ms: int = 0
    entries: tuple[p.Entry, ...] = ()

    @property
    def id(self) -> int:
        """Its identifier."""
        return self.cob & ~FLAGS

    @property
    def keys(self) -> tuple[Key, ...]:
        """The mapped objects."""
        return tuple(entry.key for entry in self.entries)

    @property
    def synchronous(self) -> bool:
        """True if it is sent, or takes effect, with SYNC."""
        return p.is_synchronous(self.transmission)

    def period(self, sync: Nanos) -> Nanos | None:
        """Return the period at which it is sent; None if only on a change, or unknown."""
        if self.synchronous:
            return self.transmission * sync or None
        return self.event_ms * MILLISECOND or None

    def usable(self, node: int, objects: Objects, filled: Collection[Key], *, synced: bool) -> bool:
        """True if it can be used as it is. `filled`: what the host has values for; `synced`: there is SYNC
        while the device is commanded."""
        if not self.entries or self.cob & ~p.NO_RTR != default_id(self.kind, self.number, node):
            return False
        if self.synchronous and not synced:
            return False
        if any(each.key in objects and objects[each.key].type.bits != each.bits for each in self.entries):
            return False
        return self.kind == "TPDO" or all(key[0] in DUMMIES or key in filled for key in self.keys)

    def is_like(self, other: Pdo) -> bool:
        """True if this PDO, of the device, is as another one that is wanted."""
        same = (self.cob & ~p.NO_RTR, self.transmission) == (other.cob & ~p.NO_RTR, other.transmission)
        timed = self.kind == "TPDO" and not self.synchronous
        return same and self.entries == other.entries and (not timed or self.event_ms == other.event_ms)


def parameters(kind: Kind, number: int) -> tuple[int, int]:
    """Return the indices of a PDO's communication and mapping parameters."""
    first = o.RPDO_COMMUNICATION if kind == "RPDO" else o.TPDO_COMMUNICATION
    return first + number - 1, first + o.MAPPING_OFFSET + number - 1


def default_id(kind: Kind, number: int, node: int) -> int:
    """Return the identifier of a PDO in the predefined connection set."""
    return rpdo_id(number, node) if kind == "RPDO" else tpdo_id(number, node)


# -- reading --------------------------------------------------------------------------------------------


def next_key(read: Mapping[Key, int], absent: Collection[Key]) -> Key | None:
    """Return the object of a PDO to be read next; None if all are known."""
    wanted = [key for kind in KINDS for number in o.PDO_NUMBERS for key in _keys(kind, number, read)]
    return next((key for key in wanted if key not in read and key not in absent), None)


def _keys(kind: Kind, number: int, read: Mapping[Key, int]) -> list[Key]:
    communication, mapped = parameters(kind, number)
    keys = [(communication, o.COB_ID)]
    if not read.get(keys[0], p.DISABLED) & p.DISABLED:
        keys += [(communication, o.TRANSMISSION), (mapped, 0)]
        keys += [(communication, o.EVENT_TIMER)] if kind == "TPDO" else []
        keys += [(mapped, sub) for sub in range(1, min(read.get((mapped, 0), 0), p.MOST_BITS) + 1)]
    return keys


def pdos_of(read: Mapping[Key, int]) -> dict[tuple[Kind, int], Pdo]:
    """Make PDOs, by kind and number, of what was read."""
    found = [_pdo_of(kind, number, read) for kind in KINDS for number in o.PDO_NUMBERS]
    return {(pdo.kind, pdo.number): pdo for pdo in found if pdo is not None}


def _pdo_of(kind: Kind, number: int, read: Mapping[Key, int]) -> Pdo | None:
    communication, mapped = parameters(kind, number)
    cob = read.get((communication, o.COB_ID))
    if cob is None:
        return None
    count = read.get((mapped, 0), 0)
    values = [read.get((mapped, sub)) for sub in range(1, count + 1)]
    entries = tuple(p.decode_entry(value) for value in values if value is not None)
    bits = [entry.bits for entry in entries]
    if len(entries) < count or sum(bits) > p.MOST_BITS or not all(bits):
        cob |= p.DISABLED  # its layout is not known
    transmission = read.get((communication, o.TRANSMISSION), p.EVENT)
    return Pdo(kind, number, cob, transmission, read.get((communication, o.EVENT_TIMER), 0), entries)


# -- writing --------------------------------------------------------------------------------------------


class Write(NamedTuple):
    """An object to be written."""

    key: Key
    value: int
    pdo: Pdo | None = None
    """Of which it is a parameter. One that the device refuses to have written is not used."""
    optional: bool = False
    """The device may refuse it, or keep another value."""
    mask: int = -1
    """The bits that are compared when it is read back."""


def writes(pdo: Pdo, before: int) -> list[Write]:
    """Return what configures a PDO, in order. `before`: its present COB-ID; a TPDO without remote frames
    stays so."""
    communication, mapped = parameters(pdo.kind, pdo.number)
    cob = pdo.cob | before & p.NO_RTR
    timed = pdo.kind == "TPDO" and not pdo.synchronous
    inhibit = min(10 * pdo.event_ms, LARGEST_TIME)
    return [
        Write((communication, o.COB_ID), cob | p.DISABLED, pdo),
        Write((communication, o.TRANSMISSION), pdo.transmission, pdo),
        *([Write((communication, o.INHIBIT), inhibit, pdo, optional=True)] if timed else []),
        *([Write((communication, o.EVENT_TIMER), pdo.event_ms, pdo)] if timed else []),
        Write((mapped, 0), 0, pdo),
        *(Write((mapped, n), p.encode_entry(entry), pdo) for n, entry in enumerate(pdo.entries, 1)),
        Write((mapped, 0), len(pdo.entries), pdo),
        Write((communication, o.COB_ID), cob, pdo, mask=~p.NO_RTR),
    ]


class Setup:
    """Objects that are written to a device in this order, then read back. Plain data."""

    def __init__(self, objects: Objects, plan: Sequence[Write]) -> None:
        self.objects = objects
        self.plan = list(plan)
        """What the device has not refused."""
        self.refused: set[Pdo] = set()
        """The PDOs that it has."""
        self.failed = ""
        """Why it will never be done."""
        self._rounds = 0
        self._steps: list[tuple[Write, bool]] = []
        """What remains to be written, then to be read back (True)."""
        self._begin()

    def _begin(self) -> None:
        last = {write.key: write for write in self.plan}
        self._steps = [(write, False) for write in self.plan] + [(write, True) for write in last.values()]

    @property
    def done(self) -> bool:
        """True if everything was read back as it was written."""
        return not (self._steps or self.failed)

    @property
    def pdos(self) -> list[Pdo]:
        """The PDOs that it configures, but for those that the device has refused."""
        return list(dict.fromkeys(write.pdo for write in self.plan if write.pdo is not None))

    def job(self) -> Job | None:
        """Return the transfer that is next, until its outcome."""
        if self.failed or not self._steps:
            return None
        (key, value, *_), reads = self._steps[0]
        return Job(Purpose.SETUP, key, None if reads else to_bytes(self.objects[key].type, value))

    def on_outcome(self, outcome: Outcome) -> None:
        """Record the end of that transfer. Without a response all of it is written again: what the device has
        accepted is not known."""
        if outcome.job != self.job():
            return  # of a setup that was given up
        write, reads = self._steps[0]
        if outcome.abort == sdo.TIMEOUT:
            self._begin()
        elif outcome.abort is not None:
            self._on_refused(write, outcome.abort)
        elif reads and self._differs(write, outcome.value):
            self._rounds += 1
            if self._rounds == ROUNDS:
                found = outcome.value[::-1].hex()
                self.failed = f"{title(write.key)} is {found} after {write.value:x} was written to it"
            self._begin()
        else:
            self._steps = self._steps[1:]

    def _differs(self, write: Write, data: bytes) -> bool:
        value = from_bytes(self.objects[write.key].type, data)
        return not write.optional and (value is None or (value ^ write.value) & write.mask != 0)

    def _on_refused(self, write: Write, abort: int) -> None:
        if write.optional:
            gone = [each for each in self.plan if each.key == write.key]
        elif write.pdo is not None:
            self.refused.add(write.pdo)
            gone = [each for each in self.plan if each.pdo == write.pdo]
        else:
            self.failed = f"{title(write.key)}: {sdo.abort_text(abort)}"
            return
        self.plan = [each for each in self.plan if each not in gone]
        self._steps = [each for each in self._steps if each[0] not in gone]
