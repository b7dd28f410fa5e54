"""The stream of a lidar, cut anywhere: answers, and what is repeated, as the last descriptor says.

Rules. A capsule has a checksum. Nodes have nothing but three bits: who has lost their place (a byte that is
missing, noise) finds it by several in a row whose angles go on. Bytes that are none of these are counted once
for each run, by what it began with. Any bytes are accepted, and at most one message's bytes, or those of a
few nodes, are held.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from protocols.rplidar import capsules
from protocols.rplidar import table as rp
from protocols.toolkit.motor_driver import Rx

IN_ROW = 4
"""Nodes by which the place among nodes is found again;"""
AHEAD = 30.0
"""degrees from one of them to the next, at most."""


@dataclass(slots=True, eq=False)
class Wire:
    """How what a lidar sends is read, by what it has sent before: a `FrameReader`. Plain data."""

    scan: str = "express"
    """What is repeated, by its name in `device.toml`; of another one nothing is read."""
    placed: bool = False
    """It is known where the next node begins."""
    skips: bool = False
    """What came last was none of these."""

    def lose(self) -> None:
        """Note that the line was interrupted."""
        self.placed = self.skips = False

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, an answer, a node or a capsule, and where the search goes on."""
        size, wrong = self._message(held, at)
        if size is None:
            return None, at
        before, self.skips = self.skips, not size
        if not size:
            return Rx.IGNORED if before else wrong, at + 1
        message = held[at : at + size]
        if size == rp.HEAD:
            self.scan = rp.SCANS[message[6]]
        self.placed = self.scan == "standard"
        return message, at + size

    def _message(self, held: bytes, at: int) -> tuple[int | None, Rx]:
        """Return the bytes of the message that begins here, 0 for none, None if more must come; and as what
        these bytes count otherwise."""
        if held[at] == 0xA5 and (size := rp.answer_size(held[at : at + rp.HEAD])) != 0:
            return (None if size is None or len(held) < at + size else size), Rx.IGNORED
        if self.scan == "standard":
            found = self._node(held, at)
            self.placed = self.placed and found != 0
            return found, Rx.IGNORED
        if self.scan not in rp.RAYS or not capsules.begins(held, at, self.scan):
            return 0, Rx.IGNORED
        end = at + rp.SIZES[self.scan]
        # Among other bytes a wrong capsule may look right: where the next one begins, this one ends.
        doubted = self.skips and self.scan != "hq"
        if len(held) < end + 2 * doubted:
            return None, Rx.IGNORED
        right = capsules.is_sound(held[at:end], self.scan)
        right = right and not (doubted and not capsules.begins(held, end, self.scan))
        return (end - at if right else 0), Rx.MALFORMED

    def _node(self, held: bytes, at: int) -> int | None:
        """Return 5 if a node begins here, 0 if none does, None if more must come."""
        if self.placed:
            whole = len(held) >= at + rp.NODE_BYTES
            return None if not whole else rp.NODE_BYTES if rp.is_node(held, at) else 0
        places = range(at, at + IN_ROW * rp.NODE_BYTES, rp.NODE_BYTES)
        here = [place for place in places if len(held) >= place + rp.NODE_BYTES]
        if not all(rp.is_node(held, place) for place in here):
            return 0
        angles = [rp.node(held[place : place + rp.NODE_BYTES]).angle for place in here]
        if any((after - one) % 360.0 > AHEAD for one, after in pairwise(angles)):
            return 0
        return rp.NODE_BYTES if len(here) == len(places) else None
