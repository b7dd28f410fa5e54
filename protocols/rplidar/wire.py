"""The stream of a lidar, cut anywhere: answers, and what is repeated, as the last descriptor says.

Rules. A capsule has a checksum. Nodes have nothing but three bits: who has lost their place (a byte that is
missing, noise) finds it by several in a row whose angles go on. Bytes that are none of these are counted once
for each run, by what it began with. Any bytes are accepted, and at most one message's bytes, or those of a
few nodes, are held.
"""

from __future__ import annotations

from dataclasses import dataclass

from protocols.rplidar import capsules
from protocols.rplidar import table as rp
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.serial import FrameFormat, Stream

IN_ROW = 4
"""Nodes by which the place among nodes is found again;"""
AHEAD = 30.0
"""degrees from one of them to the next, at most."""


@dataclass(slots=True)
class Wire(Stream):
    """The bytes of one lidar. Plain data."""

    framing: FrameFormat = rp.REQUESTS  # unused: what begins here depends on what came before
    kind: int = rp.EXPRESS
    """Of what is repeated: `table.NODES`, `EXPRESS` …, or another, of which nothing is read"""
    placed: bool = False
    """It is known where the next node begins."""

    def feed(self, data: bytes) -> list[bytes | Rx]:
        """Return the messages that these bytes complete: answers, nodes, capsules."""
        held, at, found = self.held + data, 0, list[bytes | Rx]()
        while at < len(held):
            size, wrong = self._message(held, at)
            if size is None:
                break
            if size:
                found.append(held[at : at + size])
                self._learn(held, at, size)
            elif not self.skipping:
                found.append(wrong)
            self.skipping = not size
            self.skipped += not size
            at += size or 1
        self.held = held[at:]
        return found

    def drop(self) -> None:
        """Discard a partial message: the line was interrupted, its rest will not come."""
        self.skipped += len(self.held)
        self.held, self.skipping, self.placed = b"", False, False

    def _learn(self, held: bytes, at: int, size: int) -> None:
        if size == rp.HEAD:
            self.kind = held[at + 6]
        self.placed = self.kind == rp.NODES

    def _message(self, held: bytes, at: int) -> tuple[int | None, Rx]:
        """Return the bytes of the message that begins here, 0 for none, None if more must come; and as what
        these bytes count otherwise."""
        size = rp.answer_size(held[at : at + rp.HEAD])
        if size is None or size:
            return (None if size is None or len(held) < at + size else size), Rx.IGNORED
        if self.kind == rp.NODES:
            found = self._node(held, at)
            self.placed = self.placed and found != 0
            return found, Rx.IGNORED
        if self.kind == rp.HQ:
            return self._packet(held, at)
        if self.kind not in rp.SCANS or held[at] >> 4 != 0xA:
            return 0, Rx.IGNORED
        if len(held) < at + 2:
            return None, Rx.IGNORED
        if not capsules.is_capsule(held, at):
            return 0, Rx.IGNORED
        end = at + rp.REPEATS[self.kind]
        # Among other bytes a wrong capsule may look right: where the next one begins, this one ends.
        if len(held) < end + 2 * self.skipping:
            return None, Rx.IGNORED
        right = capsules.is_sound(held[at:end]) and (not self.skipping or capsules.is_capsule(held, end))
        return (end - at if right else 0), Rx.MALFORMED

    def _packet(self, held: bytes, at: int) -> tuple[int | None, Rx]:
        """Return the same of a packet of HQ, whose checksum is to be trusted."""
        size = rp.REPEATS[rp.HQ]
        if held[at] != capsules.SYNC_HQ:
            return 0, Rx.IGNORED
        if len(held) < at + size:
            return None, Rx.IGNORED
        return (size if capsules.is_sound_hq(held[at : at + size]) else 0), Rx.MALFORMED

    def _node(self, held: bytes, at: int) -> int | None:
        """Return 5 if a node begins here, 0 if none does, None if more must come."""
        before: float | None = None
        for _ in range(1 if self.placed else IN_ROW):
            if len(held) < at + rp.NODE_BYTES:
                return None
            if not rp.is_node(held, at):
                return 0
            one = rp.node(held[at : at + rp.NODE_BYTES])
            if before is not None and (one.angle - before) % 360.0 > AHEAD:
                return 0
            before, at = one.angle, at + rp.NODE_BYTES
        return rp.NODE_BYTES
