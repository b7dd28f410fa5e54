"""When the twin sends its TPDOs.

Rules. Plain data; the frames that are due are returned, made from the dictionary at that moment. A TPDO of
transmission type 0 is sent with a SYNC if a value in it has changed, 1 to 240 with every n-th SYNC; 254 and
255 by the event timer and on events: a change of a state object (statusword, mode, error) in it, or of any
object if there is no event timer; never within the inhibit time.

Source: CiA 301 "PDO communication parameter"; what counts as an event for 254 and 255 is the maker's choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocols.canopen.pdo import DISABLED, Packing, is_synchronous
from protocols.cia402 import objects as o
from protocols.cia402.dictionary import Dictionary
from protocols.cia402.objects import Key
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Nanos

STATE_OBJECTS: frozenset[Key] = frozenset({o.STATUSWORD, o.MODE_DISPLAY, o.ERROR_CODE, o.ERROR_REGISTER})
"""A change of these is an event."""
INHIBIT_UNIT: Nanos = MILLISECOND // 10


@dataclass(slots=True)
class Tpdo:
    """One TPDO."""

    index: int
    """Of its communication parameter."""
    syncs: int = 0
    """SYNCs since it was sent."""
    sent: Nanos | None = None
    """None: not since the drive became operational."""
    values: tuple[int, ...] = ()
    """As sent last."""

    def frame(self, now: Nanos, dictionary: Dictionary, packing: Packing) -> CanFrame:
        """Return the frame, and note that it is sent now."""
        self.values = _values(dictionary, packing)
        self.sent, self.syncs = now, 0
        return CanFrame(dictionary.values[self.index, o.COB_ID] & 0x7FF, packing.pack(self.values))

    def on_sync(self, now: Nanos, dictionary: Dictionary) -> Sequence[CanFrame]:
        """Handle a SYNC; return the frame if one is due."""
        packing = dictionary.active(self.index)
        transmission = dictionary.values[self.index, o.TRANSMISSION]
        if packing is None or not is_synchronous(transmission):
            return ()
        self.syncs += 1
        if not transmission:
            due = self.sent is None or _values(dictionary, packing) != self.values
        else:
            due = self.syncs >= transmission
        return (self.frame(now, dictionary, packing),) if due else ()

    def is_timed(self, dictionary: Dictionary) -> bool:
        """True if it is sent without SYNC."""
        if dictionary.values[self.index, o.COB_ID] & DISABLED:
            return False
        return not is_synchronous(dictionary.values[self.index, o.TRANSMISSION])

    def on_time(self, now: Nanos, dictionary: Dictionary) -> Sequence[CanFrame]:
        """Return the frame if the event timer or an event makes one due."""
        packing = dictionary.active(self.index)
        if packing is None or is_synchronous(dictionary.values[self.index, o.TRANSMISSION]):
            return ()
        timer = dictionary.values[self.index, o.EVENT_TIMER] * MILLISECOND
        if self.sent is not None:
            if now - self.sent < dictionary.values[self.index, o.INHIBIT] * INHIBIT_UNIT:
                return ()
            if not (timer and now - self.sent >= timer) and not self._event(dictionary, packing, timer):
                return ()
        return (self.frame(now, dictionary, packing),)

    def _event(self, dictionary: Dictionary, packing: Packing, timer: Nanos) -> bool:
        if len(self.values) != len(packing.entries):
            return True
        changed = [
            entry.key
            for entry, value, was in zip(
                packing.entries, _values(dictionary, packing), self.values, strict=True
            )
            if value != was
        ]
        return any(key in STATE_OBJECTS for key in changed) if timer else bool(changed)

    def due(self, dictionary: Dictionary) -> Nanos | None:
        """Return when its event timer expires."""
        timer = dictionary.values[self.index, o.EVENT_TIMER] * MILLISECOND
        if not timer or self.sent is None or dictionary.active(self.index) is None:
            return None
        return None if is_synchronous(dictionary.values[self.index, o.TRANSMISSION]) else self.sent + timer


def _values(dictionary: Dictionary, packing: Packing) -> tuple[int, ...]:
    return tuple(dictionary.values.get(entry.key, 0) for entry in packing.entries)


def tpdos() -> list[Tpdo]:
    """Return the TPDOs of a drive that became operational."""
    return [Tpdo(o.TPDO_COMMUNICATION + number - 1) for number in o.PDO_NUMBERS]
