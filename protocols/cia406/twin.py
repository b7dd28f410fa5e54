"""The device's end: an encoder's object dictionary, and where the world says that its shaft stands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from protocols.bounds import Bounds, check
from protocols.canopen.dictionary import Dictionary, pdo_defaults
from protocols.canopen.node import Listeners, Node, Received, Sender
from protocols.canopen.objects import DEVICE_TYPE, title
from protocols.canopen.services import NMT_STATE, NmtCommand
from protocols.cia406 import table as enc
from protocols.frames import Frame
from protocols.messages import Event, Kept, Nanos, Obeyed, Reboot, ShaftReading, Torque
from protocols.plugin import Device

MULTI_TURN = 2
"""High word of the device type"""
BOOTS = (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION)


@dataclass(frozen=True, slots=True)
class Settings:
    """What is configured on the encoder, in simulation."""

    units: Annotated[int, Bounds(2, 2**20)] = 4096
    """Per turn"""
    turns: Annotated[int, Bounds(1, 4096)] = 4096

    def __post_init__(self) -> None:
        check(self)


def node_of(device: Device) -> Node:
    """Return an encoder's node as it is when switched on."""
    settings = device.settings
    values = {
        DEVICE_TYPE: MULTI_TURN << 16 | enc.PROFILE,
        enc.UNITS: settings.units,
        enc.RANGE: settings.units * settings.turns,
        enc.PHYSICAL: settings.units,
        enc.TURNS: settings.turns,
    }
    values |= pdo_defaults(enc.OBJECTS, device.address, tpdos=((), (enc.POSITION,)))
    return Node(Dictionary(enc.OBJECTS, device.address, values), device.address)


class EncoderDecoder:
    """What encoders would obey."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._devices = [(device.name, node_of(device)) for device in devices]
        self._listeners = Listeners([node for _, node in self._devices])

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what each would obey; what only reads is nothing."""
        obeyed: list[Obeyed] = []
        for at in self._listeners.of(frame):
            name, node = self._devices[at]
            received = node.receive(t, frame)
            if received is not None:
                obeyed += _obeyed(name, node, received)
        return obeyed


def _obeyed(name: str, node: Node, received: Received) -> Sequence[Obeyed]:
    if received.command is not None:
        return (Reboot(name),) if received.command in BOOTS else (Kept(name, NMT_STATE, float(node.nmt)),)
    values = node.dictionary.values
    return [Kept(name, title(key), float(values[key])) for key in received.written]


class EncoderTwin:
    """One encoder."""

    def __init__(self, device: Device, seed: int) -> None:
        self.device = device
        self.node = node_of(device)
        self.sender = Sender(self.node, seed, frozenset())
        self.counts = 0
        """Units from where its shaft stood at zero, as the world has it,"""
        self.shift = 0
        """and what a preset has added."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Obey it; respond with the next step."""
        received = None if self.sender.loses(frame) else self.node.receive(t, frame)
        if received is None:
            return
        self.sender.note(t, received)
        if received.command is NmtCommand.RESET_NODE:
            self.sender.restart()
        if enc.PRESET in received.written:
            self.shift = self.node.dictionary.values[enc.PRESET] - self.counts
        self._measure()

    def due(self) -> Nanos | None:
        """Return when it next sends something by itself."""
        return self.sender.due()

    def provoke(self, code: int) -> None:
        """Have the alarm that its position is wrong. Raises ValueError if there is no such fault."""
        if code != enc.POSITION_ERROR:
            raise ValueError(f"no fault {code}")
        self.node.dictionary.measure({enc.ALARMS: enc.POSITION_ERROR})
        self.sender.error(enc.EMCY, 1)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Measure; send what is due."""
        for event in truth:
            if not isinstance(event, ShaftReading) or event.sensor != self.device.name:
                continue
            if math.isfinite(event.position) and abs(event.position) < 1e9:
                self.counts = round(event.position / math.tau * self.device.settings.units)
        self._measure()
        return (), self.sender.frames(now)

    def _measure(self) -> None:
        settings = self.device.settings
        position = (self.counts + self.shift) % (settings.units * settings.turns)
        self.node.dictionary.measure({enc.POSITION: position})
