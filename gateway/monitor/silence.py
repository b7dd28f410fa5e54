"""Why a device is silent: one line for each that has not been heard after two seconds, with what was heard.

Rules. A line names the nearest cause that is known: the bus is dead, its adapter refuses what is sent,
nothing at all is heard, or others are: then their ids, and which devices they look like. The search for these
tries every installed protocol on what was heard, in slices, one for each tick.
"""

from __future__ import annotations

import logging
from collections.abc import Generator, Iterator, Mapping, Sequence

from gateway.buses import Bus
from gateway.core.robot import BusDevice, Motor
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from protocols.frames import BusState, CanFrame, Packet, any_matches, id_number
from protocols.messages import SECOND, Measurement, Mode, Nanos
from protocols.plugin import FeedbackKind, load_all

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


class Silence:
    """What is heard in the first two seconds of a run, and of which devices."""

    def __init__(self, gateway: Gateway, buses: Mapping[str, Bus]) -> None:
        self._gateway, self._buses = gateway, buses
        self._began: Nanos | None = None
        self._heard: dict[str, list[Packet]] = {name: [] for name in buses}
        self._measured: set[str] = set()
        """Sensors."""
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
            self._measured |= {e.sensor for e in self._tick.outputs.events if isinstance(e, Measurement)}
            yield
        silent = [device for device in self._gateway.robot.devices() if self._is_silent(device)]
        looks: dict[str, list[str]] = {}
        for bus in dict.fromkeys(device.bus for device in silent):
            looks[bus] = yield from self._search(bus)
        for device in silent:
            where = f"at address {device.device.address} on {device.bus}"
            log.warning("%s: nothing is heard of it %s: %s", device.name, where, self._why(device, looks))

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
        if state in _DEAD and not heard:
            return _DEAD[state] + (f"; its adapter has refused {refused} frames" if refused else "")
        if refused:
            return (
                f"its adapter has refused {refused} frames: another bit rate, or frames that it cannot send"
            )
        if not heard:
            broken = (
                f"; {bad} pieces that are no frames: another kind of adapter, or another rate" if bad else ""
            )
            return f"nothing at all is: check supply, cable, termination and bit rate{broken}"
        if isinstance(device, Motor) and self._gateway.joints[device.name].mode is not Mode.OFFLINE:
            return "it answers, but does not report its motion: see its cyclic messages"
        return self._others(device, heard, looks[device.bus])

    def _others(self, device: BusDevice, heard: Sequence[Packet], looks: Sequence[str]) -> str:
        frames = [packet.frame for packet in heard if isinstance(packet.frame, CanFrame)]
        if not frames:
            count = sum(len(packet.frame) for packet in heard if isinstance(packet.frame, bytes))
            return f"the line is alive, {count} bytes came: another baud rate, protocol or address"
        ids = dict.fromkeys(sorted(id_number(frame) for frame in frames))
        shown = [f"0x{number & 0x1FFF_FFFF:03X}" for number in ids][:MOST_LISTED]
        own = any(any_matches(device.spec.expects, frame) for frame in frames)
        text = f"the bus is alive, {len(ids)} ids are heard{', its own among them' * own}: {', '.join(shown)}"
        return f"{text}; that looks like {', '.join(looks)}" if looks else text

    # -- what it looks like -------------------------------------------------------------------

    def _search(self, bus: str) -> Generator[None, None, list[str]]:
        """Return which devices that are not in the robot file were heard on a bus."""
        from gateway.monitor.candidates import of_plugins
        from gateway.monitor.decoder import BusMonitor

        settings, heard = self._gateway.robot.buses[bus], self._heard[bus]
        if not heard or settings.kind == "serial":
            return []
        variants = []
        for plugin in load_all()[0]:
            yield
            variants += of_plugins(settings, [plugin])
        monitor = BusMonitor({bus: settings}, variants, heard[0].t, known=False)
        for packet in heard:
            yield
            monitor.decode(packet, sent=False)
        ours = {(one.plugin.name, one.device.address) for one in self._gateway.robot.devices_on(bus)}
        found = ((protocol, address) for _, protocol, address in monitor.found)
        return [f"{protocol} at address {at}" for protocol, at in found if (protocol, at) not in ours]
