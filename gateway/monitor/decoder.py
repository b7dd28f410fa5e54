"""Decodes all packets of some buses: which devices are there, what they send and are commanded, at what rate.

Rules. Nothing here can send: packets come in, nothing goes out, and no driver is ever asked what it would
send. A device of a robot file is known from the start. Without a robot file, a device counts as found once a
protocol has decoded `MIN_EVENTS` events of it, a motor's state among them; until then its events are guesses.
The ids of a device that was found belong to it; all other ids are unknown. Faults have the texts of the
device's protocol; they are past when it reports a state without fault. All values are at the joints' output
shafts. A plugin that raises is named, and keeps nothing from the others.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

from gateway.buses.frame_time import frame_time
from gateway.core.faults import MAX_FAULTS
from gateway.core.robot import BusSettings
from gateway.monitor.state import (
    BusRecord,
    CanId,
    DecodedPacket,
    DeviceRecord,
    IdRecord,
    Place,
    ProtocolVariant,
    Rate,
)
from protocols import messages as msg
from protocols.frames import EXTENDED_BIT, BusState, CanFrame, IdSet, Packet, any_matches
from protocols.messages import SECOND, Command, Event, Mode, Nanos, Obeyed
from protocols.plugin import CommandDecoder, Driver

WINDOW: Nanos = 2 * SECOND
MIN_EVENTS = 3
SETTLED_EVENTS = 50
"""After this many events of a device, no other protocol or option is tried on its ids."""
MOST_IN_VAIN = 100
"""After so many frames of an id that meant nothing to a protocol with its options,"""
AGAIN = 50
"""only one of so many is decoded by it, until one means something."""
MAX_IDS = 4096
"""Number of CAN ids of which anything is kept; packets with other ids are counted by their bus only."""
MAX_NOTES = 8


class BusMonitor:
    """What is known of some buses. Its packets must come in order of time."""

    def __init__(
        self,
        buses: Mapping[str, BusSettings],
        variants: Sequence[ProtocolVariant],
        began: Nanos,
        *,
        known: bool,
        window: Nanos | None = WINDOW,
    ) -> None:
        """`known`: all devices are there, since a robot file lists them. `window`: of the rates; None: all
        the time since `began`."""
        self._began, self._window = began, window
        self.known = known
        self.buses = {name: BusRecord(bus, self._rate(), self._rate()) for name, bus in buses.items()}
        self.ids: dict[CanId, IdRecord] = {}
        self.notes: deque[Event] = deque(maxlen=MAX_NOTES)
        """Events of no device in particular: Found, Done, Refused."""
        self.failures: dict[str, str] = {}
        """What a plugin raised last, by protocol and bus."""
        self.found: dict[Place, DeviceRecord] = {}
        self._variants = {bus: [variant for variant in variants if variant.bus == bus] for bus in buses}
        self._ids_of = {variant: _ids_of(variant) for variant in variants}
        self._interested: dict[CanId, list[ProtocolVariant]] = {}
        """By CAN id, the variants that it may mean something to, as far as they have been looked for."""
        self._in_vain: dict[CanId, dict[int, int]] = {}
        """By CAN id, how many of its newest frames meant nothing to each driver and each decoder of these, by
        the object's own number."""
        self._worth: dict[CanId, list[ProtocolVariant]] = {}
        """By CAN id, those of which an end is asked each time, once one is not."""
        self._best: dict[Place, DeviceRecord] = {}
        """By the variant that has decoded most of a device."""
        self._owners_by_id: dict[CanId, list[DeviceRecord]] = {}
        """As far as they have been looked for."""
        if known:
            for variant in variants:
                for device in variant.devices.values():
                    self._best[device.place] = device
                    self._own(device)

    def on_state(self, t: Nanos, bus: str, state: BusState) -> None:
        """Take in a change of a bus."""
        self.buses[bus].state = BusState.UP if state is BusState.BACK else state
        for variant in self._variants[bus]:
            with self._asking(variant):
                variant.driver.bus(t, state)

    def decode(self, packet: Packet, *, sent: bool | None = None) -> DecodedPacket:
        """Return what a packet means; `sent`: whether the host sent it, None if that is not known."""
        self._count(packet)
        decoded = DecodedPacket(packet)
        accepted = False
        for variant in self._listening(packet, self._owners_of(packet)):
            if not sent and self._is_worth(packet, variant.driver):
                before, told = variant.driver.counters.accepted, len(decoded.events) + len(decoded.guesses)
                events: Sequence[Event] = ()
                with self._asking(variant, decoded):
                    events = tuple(variant.driver.receive(packet.t, packet.frame))
                meant = variant.driver.counters.accepted > before
                accepted = accepted or meant
                self._on_events(variant, events, decoded)
                meant = meant or told != len(decoded.events) + len(decoded.guesses)
                self._note(packet, variant.driver, meant=meant)
            of_bytes = not isinstance(packet.frame, CanFrame)
            if (sent is not False or not of_bytes) and self._is_worth(packet, variant.decoder):
                told = len(decoded.commands)
                obeyed: Sequence[Obeyed] = ()
                with self._asking(variant, decoded):
                    obeyed = tuple(variant.decoder.decode(packet.t, packet.frame))
                self._on_commands(variant, obeyed, decoded)
                self._note(packet, variant.decoder, meant=told != len(decoded.commands))
        owners = self._owners_of(packet)  # one may have been found just now
        if accepted and len(owners) == 1:
            owners[0].received_at = packet.t
        decoded.names = tuple(owner.name for owner in owners)
        if sent or (decoded.commands and not decoded.events):
            decoded.direction = "to"
        elif decoded.events or (accepted and (owners or self.known)):
            decoded.direction = "from"
        elif owners and isinstance(packet.frame, CanFrame):
            decoded.direction = "to" if any_matches(owners[0].spec.sends, packet.frame) else "from"
        return decoded

    def unknown(self, now: Nanos) -> list[tuple[CanId, IdRecord]]:
        """Return the ids that belong to no device, the busiest first."""
        unknown = [(key, record) for key, record in self.ids.items() if not self._owners(key)]
        return sorted(unknown, key=lambda one: (-one[1].rate.per_second(now), one[0]))

    def not_understood(self, bus: str) -> int:
        """Return the number of frames of unknown ids and of malformed messages from or to devices."""
        in_use = [self._best[place].variant for place in self.found]
        counters = [v.driver.counters for v in self._variants[bus] if self.known or v in in_use]
        if self.buses[bus].settings.carries_bytes:
            return min((count.malformed + count.ignored for count in counters), default=0)
        ids = (
            record.rate.total for key, record in self.ids.items() if key[0] == bus and not self._owners(key)
        )
        return sum(ids) + sum(count.malformed for count in counters if self.known)

    def message_rates(self, record: DeviceRecord, now: Nanos) -> list[tuple[str, float]]:
        """Return what a device sends per second: on CAN by id, with the kinds of events decoded from it."""
        bus, rates = record.variant.bus, []
        for key, one in sorted(self.ids.items(), key=lambda item: item[0]):
            _, extended, remote, number = key
            if key[0] != bus or remote or not any_matches(record.spec.expects, one.last):
                continue
            if self._owners(key) == [record]:
                head = f"{number:08X}" if extended else f"{number:03X}"
                rates.append((" ".join([head, *one.kinds]), one.rate.per_second(now)))
        return rates or [(kind, rate.per_second(now)) for kind, rate in record.kinds.items()]

    @contextmanager
    def _asking(self, variant: ProtocolVariant, decoded: DecodedPacket | None = None) -> Iterator[None]:
        """Note what a plugin raises: it keeps nothing from the others."""
        try:
            yield
        except Exception as error:  # noqa: BLE001 -- a plugin may raise anything
            text = f"{type(error).__name__}: {error}"
            self.failures[f"{variant.protocol} on {variant.bus}"] = text
            if decoded is not None:
                decoded.failures.append(f"the protocol {variant.protocol} has failed: {text}")

    # -- counting -----------------------------------------------------------------------------

    def _rate(self) -> Rate:
        return Rate(self._began, self._window)

    def _count(self, packet: Packet) -> None:
        bus, frame = self.buses[packet.bus], packet.frame
        settings = bus.settings
        bus.packets.add(packet.t)
        bitrate = settings.baudrate or settings.bitrate
        bus.busy.add(packet.t, frame_time(frame, bitrate, settings.data_bitrate))
        if not isinstance(frame, CanFrame):
            return
        key = _can_id(packet.bus, frame)
        record = self.ids.get(key)
        if record is None:
            if len(self.ids) >= MAX_IDS:
                return
            record = self.ids[key] = IdRecord(self._rate(), frame, packet.t)
        record.rate.add(packet.t)
        record.last, record.received_at = frame, packet.t

    # -- what devices send --------------------------------------------------------------------

    def _on_events(self, variant: ProtocolVariant, events: Sequence[Event], decoded: DecodedPacket) -> None:
        packet = decoded.packet
        for event in events:
            record = variant.devices.get(_name_in(event))
            if record is None:
                decoded.events.append(event)
                self.notes.append(event)
                continue
            one = None
            if isinstance(packet.frame, CanFrame):
                one = self.ids.get(_can_id(packet.bus, packet.frame))
            believed = self._learn(record, packet.t, event)
            if believed is None or not self._is_best(record):
                continue
            found = self.found.get(record.place) is record
            (decoded.events if found else decoded.guesses).append(believed)
            if one is not None and found:
                one.kinds[type(event).__name__] = None
            elif one is not None:
                one.could_be[record.name] = None

    def _learn(self, record: DeviceRecord, t: Nanos, event: Event) -> Event | None:
        """Keep an event of a device; return it at the output shaft, None if it is not plausible."""
        record.kinds.setdefault(type(event).__name__, self._rate()).add(t)
        record.received_at = t
        if isinstance(event, msg.Fault):
            if len(record.faults) < MAX_FAULTS:
                record.faults[event.code, event.name] = event
        elif isinstance(event, msg.Measurement):
            record.measurement = event
        elif isinstance(event, msg.Feedback | msg.State) and record.joint is not None:
            if isinstance(event, msg.State) and event.mode is not Mode.FAULT:
                past = [*record.past_faults.items(), *record.faults.items()]
                record.past_faults = dict(past[-MAX_FAULTS:])
                record.faults = {}
            return record.joint.on_event(event)
        return event

    # -- what devices are sent ----------------------------------------------------------------

    def _on_commands(
        self, variant: ProtocolVariant, commands: Sequence[Obeyed], decoded: DecodedPacket
    ) -> None:
        for command in commands:
            if isinstance(command, msg.Kept):
                continue  # nothing comes of it yet
            device = variant.devices.get(_name_in(command))
            if device is None:
                if command not in decoded.commands:
                    decoded.commands.append(command)
                continue
            best = self._best.get(device.place)
            if isinstance(command, msg.Arm) and best and best.joint and best.joint.mode is Mode.ARMED:
                continue
            at_output = at_joint(command, device.ratio)
            if best is device or (best is None and self._is_first(variant)):
                decoded.commands.append(at_output)
            if best is device and isinstance(at_output, Command):
                device.command, device.commanded_at = at_output, decoded.packet.t
                device.commands = device.commands or self._rate()
                device.commands.add(decoded.packet.t)

    # -- which devices are there --------------------------------------------------------------

    def _listening(self, packet: Packet, owners: Sequence[DeviceRecord]) -> list[ProtocolVariant]:
        """Return the variants that decode a packet: all with such ids, or the one settled for its owner."""
        if self.known or len(owners) != 1 or owners[0].weight < SETTLED_EVENTS:
            if not isinstance(packet.frame, CanFrame):
                return self._variants[packet.bus]
            key = _can_id(packet.bus, packet.frame)
            found = self._interested.get(key)
            if found is None:
                number = packet.frame.id | EXTENDED_BIT * packet.frame.extended
                found = [one for one in self._variants[packet.bus] if number in self._ids_of[one]]
                if len(self._interested) < MAX_IDS:
                    self._interested[key] = found
            record = self.ids.get(key)
            again = record is None or record.rate.total % AGAIN == 0
            return found if again else self._worth.get(key, found)
        return [self._best[owners[0].place].variant]

    def _is_worth(self, packet: Packet, end: Driver | CommandDecoder) -> bool:
        """True if an end of a variant is asked what a frame means: not where too many of its id meant
        nothing to it, but for one now and then."""
        if self.known or not isinstance(packet.frame, CanFrame):
            return True
        key = _can_id(packet.bus, packet.frame)
        vain = self._in_vain.get(key, {}).get(id(end), 0)
        return vain < MOST_IN_VAIN or self.ids[key].rate.total % AGAIN == 0

    def _note(self, packet: Packet, end: Driver | CommandDecoder, *, meant: bool) -> None:
        """Note whether a frame meant anything to an end of a variant."""
        if self.known or not isinstance(packet.frame, CanFrame):
            return
        key = _can_id(packet.bus, packet.frame)
        if key in self._in_vain or (len(self._in_vain) < MAX_IDS and key in self.ids):
            vain = self._in_vain.setdefault(key, {})
            before = vain.get(id(end), 0)
            vain[id(end)] = 0 if meant else before + 1
            if (before >= MOST_IN_VAIN) != (vain[id(end)] >= MOST_IN_VAIN):
                self._worth[key] = [
                    one
                    for one in self._interested.get(key, ())
                    if min(vain.get(id(one.driver), 0), vain.get(id(one.decoder), 0)) < MOST_IN_VAIN
                ]

    def _is_best(self, record: DeviceRecord) -> bool:
        """True if no other variant decodes more of this device; it may count as found from now on."""
        place = record.place
        best = self._best.get(place)
        if best is not None and best is not record and best.merit >= record.merit:
            return False
        self._best[place] = record
        enough = record.weight >= MIN_EVENTS and (record.joint is None or msg.State.__name__ in record.kinds)
        if enough and self.found.get(place) is not record:
            self._own(record)
        return True

    def likely(self) -> list[Place]:
        """Return the devices that were found; if none was, those of which so much was decoded that they may
        be there, though they tell no state unasked."""
        return list(self.found) or [
            place for place, one in self._best.items() if one.weight >= SETTLED_EVENTS
        ]

    def _own(self, record: DeviceRecord) -> None:
        """Add a device: its ids are no longer unknown."""
        self.found[record.place] = record
        self._owners_by_id.clear()

    def _owners(self, key: CanId) -> list[DeviceRecord]:
        """Return the devices that were found and send or receive an id."""
        owners = self._owners_by_id.get(key)
        if owners is None:
            bus, extended, _, number = key
            number |= EXTENDED_BIT * extended
            owners = [
                record
                for record in self.found.values()
                if record.variant.bus == bus
                and any_matches((*record.spec.sends, *record.spec.expects), number)
            ]
            if len(self._owners_by_id) < MAX_IDS:
                self._owners_by_id[key] = owners
        return owners

    def _owners_of(self, packet: Packet) -> list[DeviceRecord]:
        return self._owners(_can_id(packet.bus, packet.frame)) if isinstance(packet.frame, CanFrame) else []

    def _is_first(self, variant: ProtocolVariant) -> bool:
        """True for one variant of each protocol on a bus."""
        return variant is next(v for v in self._variants[variant.bus] if v.protocol == variant.protocol)


def _ids_of(variant: ProtocolVariant) -> IdSet:
    """Return every id that a protocol's driver or decoder may take: the contract holds it to them."""
    specs = [device.spec for device in variant.devices.values()]
    return IdSet(
        ids for spec in specs for ids in (*spec.expects, *spec.sends, *spec.receives_also, *spec.obeys_also)
    )


def at_joint(command: Obeyed, ratio: float) -> Obeyed:
    """Return a command at the joint's output shaft; the device's shaft turns `ratio` times as far."""
    factors = {
        "position": 1.0 / ratio,
        "velocity": 1.0 / ratio,
        "torque": ratio,
        "stiffness": ratio * ratio,
        "damping": ratio * ratio,
    }
    changes = {name: getattr(command, name) * by for name, by in factors.items() if hasattr(command, name)}
    return replace(command, **changes) if changes and isinstance(command, Command) else command


def _name_in(message: Event | Obeyed) -> str:
    """Return the device that a message names; "" if it names none."""
    name = getattr(message, "motor", "") or getattr(message, "sensor", "") or getattr(message, "name", "")
    return str(name)


def _can_id(bus: str, frame: CanFrame) -> CanId:
    return bus, frame.extended, frame.remote, frame.id
