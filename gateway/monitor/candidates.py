"""Who may be on a bus, for one that only listens: the devices of a robot file, or anybody.

Rules. A tongue is one device language with one set of options on one bus: a driver to hear what devices say,
an ear to hear what they would obey. Neither is ever asked to speak. Where there is no robot file every
installed language is tried with a device at every address that it allows, and once more for every other
choice that its options offer: whoever makes sense of what is heard has found a device. No language is known
here by name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

from gateway.core.joint import JointSettings
from gateway.core.limits import Limits
from gateway.core.robot import BusSettings, Motor, Robot, Sensor
from protocols.messages import Nanos
from protocols.plugin import CommandDecoder, Device, Driver, Plugin, Spec

MOST_ADDRESSES = 256
"""Of one language on one bus that are tried where no robot file says who is there."""
MOST_CHOICES = 16
FITS: dict[str, tuple[str, ...]] = {"can": ("can",), "canfd": ("can", "canfd"), "serial": ("serial",)}
"""Which languages can be spoken on a kind of bus: classic frames also stand on a CAN FD bus."""
UNGEARED = JointSettings(Limits(velocity=1.0, acceleration=1.0, torque=1.0))
"""Of a motor that no robot file describes; nothing is commanded, so its limits are never asked for."""


@dataclass(frozen=True, slots=True)
class Party:
    """A device that is on a bus, or may be."""

    name: str
    bus: str
    protocol: str
    address: int
    spec: Spec
    joint: JointSettings | None
    """None: a sensor."""
    silent_after: Nanos

    @property
    def ratio(self) -> float:
        """Turns of the device's shaft per turn of the joint, with its sense."""
        return self.joint.gear * self.joint.sign if self.joint else 1.0


@dataclass(frozen=True, slots=True)
class Tongue:
    """One language, with one set of options, on one bus."""

    bus: str
    protocol: str
    parties: dict[str, Party]
    """By the name in the words."""
    driver: Driver
    decoder: CommandDecoder


def of_robot(robot: Robot, buses: Sequence[str]) -> list[Tongue]:
    """The languages of the devices that the robot file has on these buses."""
    gathered: dict[tuple[str, str], list[Motor | Sensor]] = {}
    parts: list[Motor | Sensor] = [*robot.motors.values(), *robot.sensors.values()]
    for part in parts:
        if part.bus in buses:
            gathered.setdefault((part.bus, part.plugin.name), []).append(part)
    tongues: list[Tongue] = []
    for (bus, protocol), those in gathered.items():
        devices = [part.device for part in those]
        plugin = those[0].plugin
        parties = {part.name: _party(part) for part in those}
        tongues.append(Tongue(bus, protocol, parties, plugin.driver(devices), plugin.decoder(devices)))
    return tongues


def _party(part: Motor | Sensor) -> Party:
    joint = part.joint if isinstance(part, Motor) else None
    patience = part.joint.feedback_timeout if isinstance(part, Motor) else part.timeout
    device = part.device
    return Party(part.name, part.bus, part.plugin.name, device.address, part.spec, joint, patience)


def anybody(bus: BusSettings, plugins: Sequence[Plugin]) -> list[Tongue]:
    """Every language that can be spoken on this bus, with every choice of options and every address."""
    return [
        tongue
        for plugin in plugins
        for options in choices(plugin.options)
        if (tongue := _everybody(bus, plugin, options)) is not None
    ]


def choices(options: type) -> list[object]:
    """An instance with the defaults, and one for every other value that a field of a few values allows.

    A value that is not taken with the defaults is tried together with each of the others. What an options'
    dataclass itself does not take is left out."""
    hints = get_type_hints(options)
    changes = [
        {field.name: value}
        for field in fields(options)
        for value in _few(hints[field.name])
        if value != field.default
    ]
    made = [options()]
    for change in changes:
        alone = _made(options, change)
        made += [alone] if alone else [o for other in changes if (o := _made(options, other | change))]
    return [one for i, one in enumerate(made) if one not in made[:i]][:MOST_CHOICES]


def _few(hint: object) -> tuple[Any, ...]:
    """The values of a type that has only a few."""
    if hint is bool:
        return (False, True)
    return get_args(hint) if get_origin(hint) is Literal else ()


def _made(options: type, change: Mapping[str, Any]) -> object | None:
    try:
        made: object = options(**change)
    except ValueError:
        return None
    return made


def _everybody(bus: BusSettings, plugin: Plugin, options: object) -> Tongue | None:
    parties: dict[str, Party] = {}
    devices: list[Device] = []
    for address in range(MOST_ADDRESSES):
        device = Device(f"{plugin.name}:{address}", address, options, plugin.settings())
        try:
            spec = plugin.spec(device)
        except ValueError:  # no device of this language has this address
            continue
        if spec.bus not in FITS[bus.kind]:
            return None
        joint = UNGEARED if spec.kind == "motor" else None
        parties[device.name] = Party(
            device.name, bus.name, plugin.name, address, spec, joint, spec.offline_after
        )
        devices.append(device)
    if not devices:
        return None
    return Tongue(bus.name, plugin.name, parties, plugin.driver(devices), plugin.decoder(devices))
