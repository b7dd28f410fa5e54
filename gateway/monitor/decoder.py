"""What can be known of a bus by listening: who is there, what they say and are told, how often.

Rules. Nothing here can say anything: packets come in, nothing comes out, and no driver is ever asked what it
would send. A device of a robot file is known from the start. Where there is none, a device counts as found
when a language has made sense of it `ENOUGH` times, a motor's state among them; until then what is made of it
is a guess. What was found is believed of its ids; all other ids are unknown. Faults are in the device's own
words; they are past when it says that it is well again. All is at the joints' output shafts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Literal

from gateway.buses.frame_time import frame_time
from gateway.core.joint import Joint
from gateway.core.robot import BusSettings
from gateway.monitor.candidates import Party, Tongue
from gateway.monitor.rate import Rate
from gateway.monitor.state import Heard, Id, Seen, SeenBus, SeenId, Told, about, at_joint
from protocols import messages as msg
from protocols.frames import BusState, CanFrame, Packet
from protocols.messages import SECOND, Command, Event, Mode, Nanos

WINDOW: Nanos = 2 * SECOND
ENOUGH = 3
SETTLED = 50
"""When sense has been made of a device so often, no other language or option is tried on its ids."""
MOST_IDS = 4096
"""Ids of CAN frames of which something is kept; what has another one is counted by its bus alone."""
MOST_NOTES = 8


class Listener:
    """Hears all packets of some buses, in order of time."""

    def __init__(
        self,
        buses: Mapping[str, BusSettings],
        tongues: Sequence[Tongue],
        began: Nanos,
        *,
        known: bool,
        window: Nanos | None = WINDOW,
    ) -> None:
        """`known`: all parties are there, since a robot file says so. `window`: of the rates; None: all."""
        self._began, self._window = began, window
        self.known = known
        self.buses = {name: SeenBus(bus, self._rate(), self._rate()) for name, bus in buses.items()}
        self.ids: dict[Id, SeenId] = {}
        self.notes: deque[Event] = deque(maxlen=MOST_NOTES)
        """What was said of no device in particular: found, done, refused."""
        self.found: dict[tuple[str, str, int], Seen] = {}
        """By bus, language and address."""
        self._tongues = list(enumerate(tongues))
        self._of_bus = {bus: [one for one in self._tongues if one[1].bus == bus] for bus in buses}
        self._seen: dict[tuple[int, str], Seen] = {}
        self._best: dict[tuple[str, str, int], int] = {}
        """The tongue that has made most sense of a device."""
        self._owners: dict[tuple[str, int], list[Seen]] = {}
        if known:
            for number, tongue in self._tongues:
                for party in tongue.parties.values():
                    self._own(self._look(number, party))

    def state(self, t: Nanos, bus: str, state: BusState) -> None:
        """A bus has told a change."""
        self.buses[bus].state = BusState.UP if state is BusState.BACK else state
        for _, tongue in self._of_bus[bus]:
            tongue.driver.bus(t, state)

    def handle(self, packet: Packet, *, sent: bool | None = None) -> Heard:
        """What a packet means; `sent`: whether the host did, None if that is not known."""
        self._count(packet)
        said: list[Event] = []
        reported: list[Told] = []
        guessed: list[Event] = []
        ours = False
        owners = self._owners_of(packet)
        for number, tongue in self._listening(packet.bus, owners):
            if not sent:
                before = tongue.driver.counters.accepted
                events = tongue.driver.receive(packet.t, packet.frame)
                ours = ours or tongue.driver.counters.accepted > before
                self._events(number, tongue, packet, events, said, guessed)
            if sent is not False or isinstance(packet.frame, CanFrame):
                self._words(number, tongue, packet.t, tongue.decoder.decode(packet.t, packet.frame), reported)
        owners = self._owners_of(packet)  # it may have been found just now
        if ours and len(owners) == 1:
            owners[0].received_at = packet.t
        direction = self._direction(
            packet, owners, sent=sent, said=bool(said), reported=bool(reported), ours=ours
        )
        names = tuple(seen.party.name for seen in owners)
        return Heard(packet, direction, tuple(said), tuple(reported), tuple(guessed), names)

    def unknown(self, now: Nanos) -> list[tuple[Id, SeenId]]:
        """The ids that belong to no device, the busiest first."""
        strange = [(key, seen) for key, seen in self.ids.items() if not self._owned(key)]
        return sorted(strange, key=lambda one: (-one[1].rate.per_second(now), one[0]))

    def not_understood(self, bus: str) -> int:
        """Frames of unknown ids, and messages to or from devices that were wrong."""
        ids = sum(seen.rate.total for key, seen in self.ids.items() if key[0] == bus and not self._owned(key))
        rx_counters = [
            tongue.driver.counters
            for number, tongue in self._of_bus[bus]
            if self.known or self._speaks(number, tongue)
        ]
        if self.buses[bus].settings.kind == "serial":
            return min((counters.malformed + counters.ignored for counters in rx_counters), default=0)
        return ids + sum(counters.malformed for counters in rx_counters if self.known)

    def messages(self, seen: Seen, now: Nanos) -> list[tuple[str, float]]:
        """What a device says how often: on CAN by id, with the kinds of words that come of it."""
        bus, sent = seen.party.bus, []
        for number in sorted(seen.party.spec.expects):
            for extended in (False, True):
                one = self.ids.get((bus, extended, False, number))
                if one is not None and len(self._owners.get((bus, number), ())) == 1:
                    head = f"{number:08X}" if extended else f"{number:03X}"
                    sent.append((" ".join([head, *one.kinds]), one.rate.per_second(now)))
        return sent or [(kind, rate.per_second(now)) for kind, rate in seen.says.items()]

    # -- what is counted ----------------------------------------------------------------------

    def _rate(self) -> Rate:
        return Rate(self._began, self._window)

    def _count(self, packet: Packet) -> None:
        bus, frame = self.buses[packet.bus], packet.frame
        settings = bus.settings
        bus.packets.add(packet.t)
        rate = settings.baudrate or settings.bitrate
        bus.busy.add(packet.t, frame_time(frame, rate, settings.data_bitrate))
        if not isinstance(frame, CanFrame):
            return
        key = _id(packet.bus, frame)
        seen = self.ids.get(key)
        if seen is None:
            if len(self.ids) >= MOST_IDS:
                return
            seen = self.ids[key] = SeenId(self._rate(), frame, packet.t)
        seen.rate.add(packet.t)
        seen.last, seen.at = frame, packet.t

    # -- what devices say -----------------------------------------------------------------------

    def _events(
        self,
        number: int,
        tongue: Tongue,
        packet: Packet,
        events: Sequence[Event],
        said: list[Event],
        guessed: list[Event],
    ) -> None:
        for event in events:
            party = tongue.parties.get(about(event))
            if party is None:
                said.append(event)
                self.notes.append(event)
                continue
            seen = self._look(number, party)
            if isinstance(packet.frame, CanFrame):
                seen.extended = packet.frame.extended
            moved = self._learn(seen, packet.t, event)
            if moved is not None and self._is_best(number, seen):
                found = self.found.get(_place(party)) is seen
                (said if found else guessed).append(moved)
                self._mark(packet, type(event).__name__, party.name, found=found)

    def _learn(self, seen: Seen, t: Nanos, event: Event) -> Event | None:
        """Remember what a device has said; at the output shaft, None if it is not to be believed."""
        kind = type(event).__name__
        if kind not in seen.says:
            seen.says[kind] = self._rate()
        seen.says[kind].add(t)
        seen.received_at = t
        if isinstance(event, msg.Fault):
            seen.faults[event.code, event.name] = event
        elif isinstance(event, msg.Imu | msg.LaserScan | msg.Fix):
            seen.measured = event
        elif isinstance(event, msg.Feedback | msg.State) and seen.joint is not None:
            if isinstance(event, msg.State) and event.mode is not Mode.FAULT:
                seen.past |= seen.faults
                seen.faults = {}
            return seen.joint.on_event(event)
        return event

    def _mark(self, packet: Packet, kind: str, name: str, *, found: bool) -> None:
        if isinstance(packet.frame, CanFrame) and (one := self.ids.get(_id(packet.bus, packet.frame))):
            (one.kinds if found else one.could_be)[kind if found else name] = None

    # -- what devices are told ------------------------------------------------------------------

    def _words(
        self, number: int, tongue: Tongue, t: Nanos, words: Sequence[Told], reported: list[Told]
    ) -> None:
        for word in words:
            party = tongue.parties.get(about(word))
            if party is None:
                if word not in reported:
                    reported.append(word)
                continue
            best = self._best.get(_place(party))
            if best is None and not self.known and self._is_first(number, tongue):
                reported.append(at_joint(word, party.ratio))
            if best != number:
                continue
            seen = self._look(number, party)
            moved = at_joint(word, party.ratio)
            reported.append(moved)
            if isinstance(moved, Command):
                seen.command, seen.commanded_at = moved, t
                seen.commands = seen.commands or self._rate()
                seen.commands.add(t)

    # -- who is who -----------------------------------------------------------------------------

    def _listening(self, bus: str, owners: Sequence[Seen]) -> list[tuple[int, Tongue]]:
        """Who listens to a packet: all, or the one that has proved right for the device whose id it has."""
        if self.known or len(owners) != 1 or owners[0].weight < SETTLED:
            return self._of_bus[bus]
        number = self._best[_place(owners[0].party)]
        return self._tongues[number : number + 1]

    def _look(self, number: int, party: Party) -> Seen:
        seen = self._seen.get((number, party.name))
        if seen is None:
            joint = Joint(party.name, party.joint, party.spec) if party.joint else None
            seen = self._seen[number, party.name] = Seen(party, joint)
            if self.known:
                self._best[_place(party)] = number
        return seen

    def _is_best(self, number: int, seen: Seen) -> bool:
        """Whether no other choice of options makes more of this device; and whether it is found now."""
        place = _place(seen.party)
        best = self._best.get(place)
        if best is not None and best != number:
            other = self._seen.get((best, seen.party.name))
            if other is not None and other.merit >= seen.merit:
                return False
        self._best[place] = number
        enough = seen.weight >= ENOUGH and (seen.joint is None or msg.State.__name__ in seen.says)
        if enough and self.found.get(place) is not seen:
            self._own(seen)
        return True

    def _own(self, seen: Seen) -> None:
        """A device is there: its ids are no longer unknown."""
        place, spec = _place(seen.party), seen.party.spec
        former = self.found.get(place)
        self.found[place] = seen
        for number in sorted(spec.sends | spec.expects):
            owners = self._owners.setdefault((seen.party.bus, number), [])
            owners[:] = [owner for owner in owners if owner is not former] + [seen]

    def _owned(self, key: Id) -> bool:
        bus, extended, _, number = key
        return any(seen.extended in (None, extended) for seen in self._owners.get((bus, number), ()))

    def _owners_of(self, packet: Packet) -> list[Seen]:
        if not isinstance(packet.frame, CanFrame) or not self._owned(_id(packet.bus, packet.frame)):
            return []
        return self._owners[packet.bus, packet.frame.id]

    def _direction(
        self,
        packet: Packet,
        owners: Sequence[Seen],
        *,
        sent: bool | None,
        said: bool,
        reported: bool,
        ours: bool,
    ) -> Literal["from", "to", ""]:
        if sent or (reported and not said):
            return "to"
        if said or (ours and (owners or self.known)):
            return "from"
        if owners and isinstance(packet.frame, CanFrame):
            return "to" if packet.frame.id in owners[0].party.spec.sends else "from"
        return ""

    def _is_first(self, number: int, tongue: Tongue) -> bool:
        same = (n for n, t in self._tongues if (t.bus, t.protocol) == (tongue.bus, tongue.protocol))
        return number == next(same)

    def _speaks(self, number: int, tongue: Tongue) -> bool:
        """Whether a device has been found that speaks so."""
        return any(
            self._best.get(place) == number and place[:2] == (tongue.bus, tongue.protocol)
            for place in self.found
        )


def _id(bus: str, frame: CanFrame) -> Id:
    return bus, frame.extended, frame.remote, frame.id


def _place(party: Party) -> tuple[str, str, int]:
    return party.bus, party.protocol, party.address
