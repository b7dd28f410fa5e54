"""What is on a bus, without a robot file: each installed protocol asks its read-only questions, one by one.

Rules. A protocol asks through gateway, driver and guard like any other, by a robot of placeholders that
nothing commands: nothing is moved, armed, cleared or stored. Questions of one protocol may be commands of
another: it asks after those protocols whose devices would obey them, and not at all once one of these was
found. What no question finds is known by what it sends by itself, or answers when its driver polls it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from typing import Literal, TypeAlias

from brain.bodies import bare
from brain.settings import BrainSettings
from gateway.buses import Bus, WakingBus
from gateway.core.clock import Clock, SimulatedClock
from gateway.core.joint import JointSettings
from gateway.core.limits import Limits
from gateway.core.robot import BusSettings, Motor, Robot
from gateway.core.step import Gateway
from gateway.core.tick import Outputs
from gateway.errors import UserError
from gateway.runtime import loop
from protocols import messages as msg
from protocols.asked import READS
from protocols.bounds import Invalid
from protocols.frames import BusState, CanFrame, Frame, Packet, id_number
from protocols.messages import MILLISECOND, SECOND, Nanos
from protocols.plugin import CommandDecoder, Device, Plugin, Spec
from protocols.suggest import did_you_mean

PLACE = "probe"
"""What the placeholders are called, with their number."""
LISTENING: Nanos = 1500 * MILLISECOND
"""For how long a protocol without a scan is listened to, or polls."""
ANSWER: Nanos = 15 * SECOND
"""Time after which a scan counts as not answered; drivers end it sooner (conformance: 8 s)."""
BITRATES = (1_000_000, 500_000, 250_000, 125_000)
"""bit/s at which a CAN bus is looked at through an adapter whose rate is ours to set."""
HEARING: Nanos = 600 * MILLISECOND
"""For how long such a bus is listened to at each rate,"""
STALE: Nanos = 150 * MILLISECOND
"""and at first for nothing: an adapter may still hand over what it received at the rate before."""
DRY: Nanos = 2 * SECOND
"""For how long the questions of a scan are listed that nothing answers."""
MOST_ADDRESSES = 256
"""Addresses that are tried as placeholders, and taken for a command by."""
POLLED = 16
"""Placeholders of a protocol without a scan."""
PERIOD: Nanos = 10 * MILLISECOND
"""At which it is asked."""
SLOWEST = Limits(0.01, 0.1, 0.01)
"""Of placeholders, which nothing commands."""


How: TypeAlias = Literal["answered", "heard"]


@dataclass(frozen=True, slots=True)
class Finding:
    """A device that was found."""

    protocol: str
    address: int
    serial: int | None = None
    """None: it does not tell."""
    detail: str = ""
    """Hardware and firmware, as it reports them."""
    duplicate: bool = False
    """More than one device has its address."""
    how: How = "answered"
    """"heard": by what it sends; what it is, is not known."""


@dataclass(frozen=True, slots=True)
class Probe:
    """How one protocol looks for its devices on one bus."""

    plugin: Plugin
    bus: BusSettings
    places: tuple[tuple[Device, Spec], ...]
    """Placeholders, which nothing commands: one, if it has a scan."""

    @property
    def name(self) -> str:
        """The protocol's."""
        return self.plugin.name

    @property
    def asks(self) -> bool:
        """Whether it has a scan."""
        return msg.Scan in self.places[0][1].requests

    @property
    def moves(self) -> bool:
        """Whether its devices are motors."""
        return self.places[0][1].kind == "motor"

    @property
    def tells_serial(self) -> bool:
        """Whether what answers tells its serial number."""
        return self.places[0][1].tells_serial

    @property
    def requests(self) -> tuple[msg.Scan, ...]:
        """What it asks at first."""
        return (msg.Scan(self.bus.name),) if self.asks else ()

    def robot(self) -> Robot:
        """Return a robot of its placeholders, if they are motors."""
        bus = replace(self.bus, receive_filter=(), devices=tuple(spec for _, spec in self.places))
        joint = JointSettings(SLOWEST)
        motors = {
            device.name: Motor(device.name, bus.name, self.plugin, device, spec, (), joint)
            for device, spec in self.places
        }
        return Robot("scan", "", PERIOD, None, 0, {bus.name: bus}, motors, {}, BrainSettings(bare(motors)))


class Overhearing:
    """A bus, of which the CAN ids are counted that are read; or one on which nothing answers."""

    def __init__(self, bus: Bus | None, ids: dict[int, int]) -> None:
        self.name = "" if bus is None else bus.name
        self._bus, self._ids = bus, ids

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Return what the bus has."""
        states, packets = ((), ()) if self._bus is None else self._bus.read(now)
        for packet in packets:
            if isinstance(packet.frame, CanFrame):
                number = id_number(packet.frame)
                self._ids[number] = self._ids.get(number, 0) + 1
        return states, packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Give them to the bus."""
        if self._bus is not None:
            self._bus.write(now, frames)

    def close(self) -> None:
        """Close the bus."""
        if self._bus is not None:
            self._bus.close()

    def wakes(self, now: Nanos) -> tuple[Sequence[int], Nanos | None]:
        """Return when there may be something to read."""
        return self._bus.wakes(now) if isinstance(self._bus, WakingBus) else ((), None)


# -- what may be asked -------------------------------------------------------------------------------------


def devices(plugin: Plugin, baudrate: int) -> Iterator[tuple[Device, Spec]]:
    """Yield a device for each address that one of the protocol can have, with default options."""
    for address in range(MOST_ADDRESSES):
        try:
            options, settings = plugin.options(), plugin.settings()
            device = Device(f"{PLACE}{address}", address, options, settings, baudrate)
            yield device, plugin.spec(device)
        except (Invalid, ValueError, TypeError):
            continue


def probe(plugin: Plugin, settings: BusSettings) -> Probe | None:
    """Return how a protocol looks for its devices on a bus; None: it has none there, with these rates."""
    found = next(devices(plugin, settings.baudrate), None)
    if found is None:
        return None
    spec = found[1]
    if spec.bus != settings.kind and not (spec.bus == "can" and settings.kind == "canfd"):
        return None
    count = 1 if msg.Scan in spec.requests or spec.kind == "sensor" else POLLED
    return Probe(plugin, settings, tuple(islice(devices(plugin, settings.baudrate), count)))


def questions(one: Probe) -> set[Frame]:
    """Return the frames that a probe sends while nothing answers."""
    clock = SimulatedClock()
    buses = {one.bus.name: Overhearing(None, {})}
    sent = (outputs.packets for outputs in _steps(one, buses, clock, DRY))
    return {packet.frame for packets in sent for packet in packets}


def obeyed(frames: Iterable[Frame], decoder: CommandDecoder) -> str:
    """Return what devices would make of frames, beside questions; "" if nothing."""
    for frame in frames:
        for one in decoder.decode(0, frame):
            if not isinstance(one, READS):
                return type(one).__name__
    return ""


def _decoder(one: Probe) -> CommandDecoder:
    """Return what all devices that one bus can have of a protocol would obey."""
    return one.plugin.decoder([device for device, _ in islice(devices(one.plugin, one.bus.baudrate), 128)])


def in_order(probes: Sequence[Probe]) -> list[tuple[Probe, dict[str, str]]]:
    """Return the probes in an order in which each asks after those whose devices would obey its questions,
    each with these protocols, and what they would take them for."""
    rivals: dict[str, dict[str, str]] = {}
    decoders = {one.name: _decoder(one) for one in probes}
    for one in probes:
        asked = sorted(questions(one), key=repr)
        others = {name: decoder for name, decoder in decoders.items() if name != one.name}
        taken = {name: obeyed(asked, decoder) for name, decoder in others.items()}
        rivals[one.name] = {name: what for name, what in taken.items() if what}
    ordered: list[Probe] = []
    left = sorted(probes, key=lambda one: len(rivals[one.name]))
    while left:
        waiting = {one.name for one in left}
        free = (one for one in left if not waiting & rivals[one.name].keys())
        ordered.append(next(free, left[0]))
        left.remove(ordered[-1])
    return [(one, rivals[one.name]) for one in ordered]


# -- looking -----------------------------------------------------------------------------------------------


def _steps(one: Probe, buses: Mapping[str, Bus], clock: Clock, seconds: Nanos) -> Iterator[Outputs]:
    """Let a probe ask, and yield what comes of each step. Motors are asked through a gateway; sensors need no
    guard: of what their driver sends, what is not read-only is left out."""
    until = clock.now() + seconds
    if one.moves:
        gateway = Gateway(one.robot())
        given = list[msg.Instruction](one.requests)

        def poll() -> Sequence[msg.Instruction]:
            now = tuple(given)
            given.clear()
            return now

        with closing(loop.live(gateway, buses, clock, poll=poll, until=until)) as ticks:
            for tick in ticks:
                yield tick.outputs
        return
    driver, requests = one.plugin.driver([device for device, _ in one.places]), one.requests
    while (now := clock.now()) < until:
        packets = [packet for bus in buses.values() for packet in bus.read(now)[1]]
        events = [event for packet in packets for event in driver.receive(packet.t, packet.frame)]
        more, frames = driver.send(now, requests)
        reads = [frame for frame in frames if all(spec.read_only(frame) for _, spec in one.places)]
        for bus in buses.values():
            bus.write(now, reads)
        sent = tuple(Packet(now, one.bus.name, frame) for frame in reads)
        yield Outputs(sent, (*events, *more))
        requests = ()
        clock.wait(now + PERIOD)


@dataclass(frozen=True, slots=True)
class Heard:
    """What was received of a bus that was only listened to."""

    frames: int = 0
    times: int = 0
    """At how many moments some came: what an adapter still had from another rate comes at once."""
    errors: bool = False
    """Its controller saw errors: what others send is sent at another rate."""


def listened(read: Callable[[Nanos], tuple[Sequence[BusState], Sequence[Packet]]], clock: Clock) -> Heard:
    """Listen to a bus that is open at one bit rate, by its `read`."""
    frames, times, errors, began = 0, 0, False, clock.now()
    while (now := clock.now()) < began + HEARING:
        states, packets = read(now)
        if now - began >= STALE:
            frames, times = frames + len(packets), times + bool(packets)
        errors |= bool({BusState.PASSIVE, BusState.OFF} & {*states})
        clock.wait(clock.now() + PERIOD)
    return Heard(frames, times, errors)


def likely(heard: Mapping[int, Heard]) -> list[int]:
    """Return the bit rates at which devices are asked, until one answers: those at which frames were
    received. On a bus that is silent all but those with errors: a question at a wrong rate disturbs it."""
    received = [rate for rate, one in heard.items() if one.frames]
    if received:
        return sorted(received, key=lambda rate: heard[rate].times, reverse=True)
    return [rate for rate, one in heard.items() if not one.errors]


def look(one: Probe, bus: Bus, clock: Clock) -> list[Finding]:
    """Ask, and return what answers or is heard on an open bus."""
    found: dict[tuple[int, int | None], Finding] = {}
    for outputs in _steps(one, {one.bus.name: bus}, clock, ANSWER if one.asks and one.moves else LISTENING):
        if _take(one, outputs.events, found):
            break
    return sorted(found.values(), key=lambda each: (each.address, each.serial or 0))


def _take(one: Probe, events: Iterable[msg.Event], found: dict[tuple[int, int | None], Finding]) -> bool:
    """Note what a step has found; return whether the scan is over."""
    addresses = {device.name: device.address for device, _ in one.places}
    for event in events:
        if isinstance(event, msg.Found):
            at = event.address, event.serial
            found.pop((event.address, None), None)
            duplicate = event.duplicate_address or (at in found and found[at].duplicate)
            detail = event.detail.removeprefix(f"{PLACE}{event.address}").removeprefix(", ")
            how: How = "heard" if event.serial is None and one.tells_serial else "answered"
            found[at] = Finding(one.name, event.address, event.serial, detail, duplicate, how)
        elif isinstance(event, msg.Measurement | msg.Feedback):
            name = event.sensor if isinstance(event, msg.Measurement) else event.motor
            if not any(addresses[name] == address for address, _ in found):
                found[addresses[name], None] = Finding(one.name, addresses[name], how="heard")
        elif isinstance(event, msg.Done | msg.Refused) and event.request == msg.Scan.__name__:
            return True
    return False


def scan(
    probes: Sequence[Probe],
    open_: Callable[[BusSettings], Bus],
    clock: Clock,
    say: Callable[[str], None],
    ids: dict[int, int],
) -> list[Finding]:
    """Let protocols look for their devices on a bus, one after the other.

    Args:
        probes: the protocols.
        open_: opens the bus; each protocol opens it anew.
        clock: of the bus.
        say: is given a sentence for each protocol that may not ask.
        ids: is given the CAN ids that were received, each with how often.
    """
    found: list[Finding] = []
    for one, rivals in in_order(probes):
        found = credible(found, ids, probes)
        here = {each.protocol for each in found}
        if rival := next((name for name in rivals if name in here), ""):
            what = f"its questions are {rivals[rival]} to the {rival} found here"
            say(f"{one.name} is not asked: {what}")
            continue
        bus = open_(one.bus)
        try:
            found += look(one, Overhearing(bus, ids), clock)
        finally:
            bus.close()
    return credible(found, ids, probes)


def credible(found: Sequence[Finding], ids: Mapping[int, int], probes: Sequence[Probe]) -> list[Finding]:
    """Return the findings without those of which nothing is heard but what others send that have answered."""
    others = unexplained(ids, [each for each in found if each.how == "answered"], probes)
    return [
        each
        for each in found
        if each.how == "answered" or not ids or unexplained(others, [each], probes) != others
    ]


def unexplained(ids: Mapping[int, int], found: Sequence[Finding], probes: Sequence[Probe]) -> dict[int, int]:
    """Return the CAN ids that were heard, and that none of these devices sends."""
    known: list[tuple[int, int]] = []
    for one in probes:
        specs = {device.address: spec for device, spec in devices(one.plugin, one.bus.baudrate)}
        for each in found:
            if each.protocol == one.name and each.address in specs:
                spec = specs[each.address]
                known += [(number & mask, mask) for number, mask in (*spec.expects, *spec.receives_also)]
    return {id_: n for id_, n in ids.items() if not any(id_ & mask == number for number, mask in known)}


def chosen(installed: Sequence[Plugin], names: Sequence[str]) -> list[Plugin]:
    """Return the protocols of these names; all without any. Raises UserError."""
    known = {one.name: one for one in installed}
    if missing := [name for name in names if name not in known]:
        hint = did_you_mean(missing[0], list(known))
        raise UserError(f"no protocol {missing[0]!r}; installed: {', '.join(known)}{hint}")
    return [known[name] for name in names] if names else list(installed)
