"""Why a device is silent: one line for each that has not been heard after two seconds, with what was heard.

Rules. A line names the nearest cause that is known: the bus is dead, its adapter refuses what is sent,
nothing at all is heard, or others are: then their ids, and which devices they look like. The search for these
tries every installed protocol on what was heard, in slices, one for each tick.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence

from gateway.buses import Bus
from gateway.buses.serial.garbage import verdict
from gateway.core.robot import BusDevice, Motor, Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.monitor.state import ProtocolVariant
from protocols.frames import BusState, CanFrame, IdSet, Packet, id_number
from protocols.messages import SECOND, Measurement, Mode, Nanos, State
from protocols.plugin import FeedbackKind, installed, load

log = logging.getLogger("gateway")

LISTENED: Nanos = 2 * SECOND
MOST_KEPT = 200
"""Packets of a bus that are looked at."""
MOST_LISTED = 8
"""Ids that a line has."""
_DEAD = {
    BusState.OFF: "the bus is off: check the wiring, the termination and the bit rate",
    BusState.GONE: "the interface has vanished",
    BusState.PASSIVE: "the bus is error-passive: check the wiring, the termination and the bit rate",
    BusState.FULL: "nothing takes what is sent: no device acknowledges it, or the bit rate is wrong",
}
_NOTHING_AT_ALL = "nothing at all is: check supply, cable, termination and bit rate"
_NOTHING = {"camera": "no picture has come: see whether another program shows any, and its cable"}
"""By kind of bus"""


class Silence:
    """What is heard in the first two seconds of a run, and of which devices."""

    def __init__(self, gateway: Gateway, buses: Mapping[str, Bus]) -> None:
        self._gateway, self._buses = gateway, buses
        self._began: Nanos | None = None
        self._heard: dict[str, list[Packet]] = {name: [] for name in buses}
        self._measured: set[str] = set()
        """Sensors."""
        self._answered: dict[str, str] = {}
        """Their states, of those that are heard"""
        self.told: dict[str, str] = {}
        """What was said, by device."""
        self._work: Iterator[None] = self._listen()

    def take(self, tick: Tick) -> None:
        """Take in a tick; log what is silent, once."""
        self._began = tick.now if self._began is None else self._began
        self._tick = tick
        next(self._work, None)

    def _listen(self) -> Iterator[None]:
        """Listen, look, and say."""
        while self._began is None or self._tick.now - self._began < LISTENED:
            for packet in self._tick.inputs.packets:
                if len(self._heard[packet.bus]) < MOST_KEPT:
                    self._heard[packet.bus].append(packet)
            events = self._tick.outputs.events
            self._measured |= {e.sensor for e in events if isinstance(e, Measurement)}
            states = (e for e in events if isinstance(e, State) and e.mode is not Mode.OFFLINE)
            self._answered |= {e.motor: e.detail for e in states if e.motor in self._gateway.robot.sensors}
            yield
        silent = [device for device in self._gateway.robot.devices() if self._is_silent(device)]
        looks: dict[str, list[str]] = {}
        for bus in dict.fromkeys(device.bus for device in silent):
            looks[bus] = yield from self._search(bus)
        for device in silent:
            where = f"at address {device.device.address} on {device.bus}"
            self.told[device.name] = f"nothing is heard of it {where}: {self._why(device, looks)}"
            log.warning("%s: %s", device.name, self.told[device.name])

    def _is_silent(self, device: BusDevice) -> bool:
        if not isinstance(device, Motor):
            return device.name not in self._measured
        joint, kind = self._gateway.joints[device.name], device.spec.feedback
        only_replies = kind is FeedbackKind.REPLY and not joint.owned
        return (
            kind is not FeedbackKind.NONE and not only_replies and joint.feedback_age(self._tick.now) is None
        )

    def _why(self, device: BusDevice, looks: Mapping[str, Sequence[str]]) -> str:
        """Return the nearest cause that is known."""
        state = self._gateway.bus_states.get(device.bus, BusState.UP)
        bus, heard = self._buses[device.bus], self._heard[device.bus]
        refused, bad = (int(getattr(bus, name, 0)) for name in ("refused", "bad"))
        refusing = f"its adapter refuses what it is sent ({refused} so far)"
        if state in _DEAD and not heard:
            return f"{_DEAD[state]}; {refusing}" if refused else _DEAD[state]
        if refused:
            return f"{refusing}: another bit rate, or it is bus-off"
        if not heard:
            broken = (
                f"; {bad} pieces that are no frames: another kind of adapter, or another rate" if bad else ""
            )
            kind = self._gateway.robot.buses[device.bus].kind
            return f"{_NOTHING.get(kind, _NOTHING_AT_ALL)}{broken}"
        if isinstance(device, Motor) and self._gateway.joints[device.name].mode is not Mode.OFFLINE:
            return "it answers, but does not report its motion: see its cyclic messages"
        if device.name in self._answered:
            return f"it answers, but measures nothing: {self._answered[device.name]}"
        return self._others(device, bus, heard, looks[device.bus])

    def _others(self, device: BusDevice, bus: Bus, heard: Sequence[Packet], looks: Sequence[str]) -> str:
        frames = [packet.frame for packet in heard if isinstance(packet.frame, CanFrame)]
        if not frames:
            beside = [one for one in self._gateway.robot.devices_on(device.bus) if not self._is_silent(one)]
            if beside:
                return f"{beside[0].name} is, on the same line: check its supply, cable and address"
            data = b"".join(packet.frame for packet in heard if isinstance(packet.frame, bytes))
            rate, errors = self._gateway.robot.buses[device.bus].baudrate, getattr(bus, "errors", 0)
            what = verdict(data, rate, errors) or "another baud rate, protocol or address"
            return f"the line is alive, {len(data)} bytes came: {what}"
        ids = {id_number(frame): frame for frame in frames}
        others = [one for one in self._gateway.robot.devices_on(device.bus) if one is not device]
        known = IdSet(each for one in others for each in one.spec.expects)
        strange = [number for number in sorted(ids) if number not in known]
        if not strange:
            return "the bus is alive, of other devices: check its supply, cable and address"
        shown = ", ".join(f"0x{number & 0x1FFF_FFFF:03X}" for number in strange[:MOST_LISTED])
        shown += ", …" if len(strange) > MOST_LISTED else ""
        text = f"the bus is alive ({len(ids)} ids are heard), of no other device in the robot file: {shown}"
        return f"{text}; that looks like {', '.join(looks)}" if looks else text

    def _search(self, bus: str) -> Generator[None, None, list[str]]:
        """Return which devices that are not in the robot file were heard on a bus; none while a motor is
        commanded, since it takes the loop's time."""
        if any(joint.owned for joint in self._gateway.joints.values()):
            return []
        return (yield from looks(self._gateway.robot, bus, self._heard[bus]))


# -- what it looks like ------------------------------------------------------------------------


def looks(robot: Robot, bus: str, heard: Sequence[Packet]) -> Generator[None, None, list[str]]:
    """Return what devices that are not in the robot file look like, by what was heard on a bus: every
    installed protocol is tried, a piece at a time."""
    from gateway.monitor.decoder import BusMonitor

    ids = {id_number(packet.frame) for packet in heard if isinstance(packet.frame, CanFrame)}
    if not ids:
        return []
    variants: list[ProtocolVariant] = []
    for name in dict.fromkeys(point.name for point in installed()):
        yield
        try:
            variants += yield from _variants(robot, bus, name, ids)
        except Exception as error:  # noqa: BLE001 -- a third party's plugin may raise anything
            log.debug("the protocol %s is not looked for: %r", name, error)
    monitor = BusMonitor({bus: robot.buses[bus]}, variants, heard[0].t, known=False)
    for packet in heard:
        yield
        monitor.decode(packet, sent=False)
    ours = {(one.plugin.name, one.device.address) for one in robot.devices_on(bus)}
    found = ((protocol, address) for _, protocol, address in monitor.likely())
    return [f"{protocol} at address {at}" for protocol, at in found if (protocol, at) not in ours]


def _variants(
    robot: Robot, bus: str, name: str, ids: Collection[int]
) -> Generator[None, None, list[ProtocolVariant]]:
    """Return a protocol as it is by default, and as the robot file has it."""
    from gateway.monitor.candidates import of_ids

    plugin = load(name)
    ours = [one.device.options for one in robot.devices_on(bus) if one.plugin.name == name]
    options = [plugin.options(), *ours]
    made: list[ProtocolVariant] = []
    for number, each in enumerate(options):
        if each not in options[:number]:
            made += yield from of_ids(robot.buses[bus], plugin, each, ids)
    return made
