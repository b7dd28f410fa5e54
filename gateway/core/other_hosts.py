"""What other hosts send on a CAN bus: what only a host sends, and is not ours, since ours is not received."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from protocols.frames import CanFrame, IdSet, Packet, id_number

if TYPE_CHECKING:
    from gateway.core.robot import Robot

IDS_KEPT = 4096
OVERHEARD = 8
"""Most frames of other hosts that a step reads, by bus."""


class OtherHosts:
    """The other hosts of one robot's buses. State is plain data."""

    def __init__(self, robot: Robot) -> None:
        self._ids: dict[str, tuple[IdSet, IdSet]] = {}
        """By bus: the ids to its devices, and those that they or others answer with."""
        for bus, settings in robot.buses.items():
            specs = settings.devices
            received = [ids for spec in specs for ids in (*spec.expects, *spec.receives_also)]
            self._ids[bus] = IdSet([ids for spec in specs for ids in spec.sends]), IdSet(received)
        self._theirs: dict[str, dict[int, bool]] = {bus: {} for bus in robot.buses}
        """By bus and id: whether only a host sends it; of the first `IDS_KEPT` that were seen."""
        self._noted: set[str] = set()
        """The motors that another host commands, and that are not ours."""

    def among(self, packets: Iterable[Packet]) -> Iterator[tuple[Packet, bool]]:
        """Yield the packets of a step, and of each whether it is another host's, to be read."""
        read = dict.fromkeys(self._ids, 0)
        for packet in packets:
            theirs = self._sends(packet) and read[packet.bus] < OVERHEARD
            if theirs:
                read[packet.bus] += 1
            yield packet, theirs

    def _sends(self, packet: Packet) -> bool:
        """True if only a host sends such a frame."""
        if not isinstance(packet.frame, CanFrame):
            return False
        number, known = id_number(packet.frame), self._theirs[packet.bus]
        theirs = known.get(number)
        if theirs is None:
            sent, received = self._ids[packet.bus]
            theirs = number in sent and number not in received
            if len(known) < IDS_KEPT:
                known[number] = theirs
        return theirs

    def is_news(self, motor: str) -> bool:
        """True if it was not noted yet that another host commands this motor; it is now."""
        news = motor not in self._noted
        self._noted.add(motor)
        return news
