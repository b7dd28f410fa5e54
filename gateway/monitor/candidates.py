"""Which devices may be on a bus: those of a robot file, or every one that an installed protocol allows.

Rules. Without a robot file, every installed protocol is tried with a device at every address that it allows,
and again for every other choice that its options offer: the variant that decodes the traffic has found a
device. No protocol is known here by name.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

from gateway.core.joint import Joint, JointSettings
from gateway.core.limits import Limits
from gateway.core.robot import BusSettings, Motor, Robot, by_protocol
from gateway.monitor.state import DeviceRecord, ProtocolVariant
from protocols.frames import IdSet
from protocols.messages import Nanos
from protocols.plugin import Device, Plugin, Spec, remembered

MAX_ADDRESSES = 256
"""Addresses of one protocol that are tried on one bus without a robot file."""
MAX_CHOICES = 16
SLICE = 16
"""Addresses that are tried at once beside a loop."""
COMPATIBLE: dict[str, tuple[str, ...]] = {
    "can": ("can",),
    "canfd": ("can", "canfd"),
    "serial": ("serial",),
    "i2c": ("i2c",),
    "camera": ("camera",),
}
"""Which kinds of protocol run on a kind of bus: a CAN FD bus also carries classic frames."""
NO_GEAR = JointSettings(Limits(velocity=1.0, acceleration=1.0, torque=1.0))
"""Of a motor that no robot file describes; nothing is commanded, so its limits are never used."""


def of_robot(robot: Robot, buses: Iterable[str]) -> list[ProtocolVariant]:
    """Return the protocols of the devices that the robot file has on these buses."""
    variants = []
    for bus in buses:
        for plugin, group in by_protocol(robot.devices_on(bus)):
            variant = _variant(bus, plugin, [one.device for one in group])
            for one in group:
                joint = one.joint if isinstance(one, Motor) else None
                timeout = one.joint.feedback_timeout if isinstance(one, Motor) else one.timeout
                _add(variant, one.device, one.spec, joint, timeout)
            variants.append(variant)
    return variants


def of_plugins(bus: BusSettings, plugins: Sequence[Plugin]) -> list[ProtocolVariant]:
    """Return every protocol that can run on this bus, with every choice of options and every address."""
    variants = []
    for plugin in plugins:
        for options in choices(plugin.options):
            specs: list[tuple[Device, Spec]] = []
            settings = plugin.settings()
            for address in range(MAX_ADDRESSES):
                device = Device(f"{plugin.name}:{address}", address, options, settings)
                with suppress(ValueError):  # the protocol does not allow this address
                    spec = remembered(plugin.spec)(device)
                    if spec.bus not in COMPATIBLE[bus.kind]:
                        break
                    specs.append((device, spec))
            if specs:
                variants.append(_with_devices(bus, plugin, specs))
    return variants


def of_ids(
    bus: BusSettings, plugin: Plugin, options: object, heard: Collection[int]
) -> Generator[None, None, list[ProtocolVariant]]:
    """Return a protocol with the devices that send one of these ids, if there are any.

    In slices of `SLICE` addresses, for a loop that has more to do."""
    specs: list[tuple[Device, Spec]] = []
    for address in range(MAX_ADDRESSES):
        if address % SLICE == 0:
            yield
        device = Device(f"{plugin.name}:{address}", address, options, plugin.settings())
        with suppress(ValueError):
            spec = remembered(plugin.spec)(device)
            if spec.bus not in COMPATIBLE[bus.kind]:
                break
            sends = IdSet(spec.expects)
            if any(number in sends for number in heard):
                specs.append((device, spec))
    return [_with_devices(bus, plugin, specs)] if specs else []


def _with_devices(bus: BusSettings, plugin: Plugin, specs: Sequence[tuple[Device, Spec]]) -> ProtocolVariant:
    variant = _variant(bus.name, plugin, [device for device, _ in specs])
    for device, spec in specs:
        _add(variant, device, spec, NO_GEAR if spec.kind == "motor" else None, spec.offline_after)
    return variant


def _variant(bus: str, plugin: Plugin, devices: Sequence[Device]) -> ProtocolVariant:
    return ProtocolVariant(bus, plugin.name, plugin.driver(devices), plugin.decoder(devices))


def _add(
    variant: ProtocolVariant, device: Device, spec: Spec, settings: JointSettings | None, timeout: Nanos
) -> None:
    joint = Joint(device.name, settings, spec) if settings else None
    variant.devices[device.name] = DeviceRecord(device.name, variant, device.address, spec, joint, timeout)


def choices(options: type) -> list[object]:
    """Return an instance with the defaults, and one for every other value of a field with few values.

    A value that is not valid with the defaults is tried together with each of the others. What the options'
    dataclass itself refuses is left out."""
    hints = get_type_hints(options)
    changes = [
        {field.name: value}
        for field in fields(options)
        for value in _few_values(hints[field.name])
        if value != field.default
    ]
    made = [options()]
    for change in changes:
        alone = _made(options, change)
        made += [alone] if alone else [o for other in changes if (o := _made(options, other | change))]
    return [one for i, one in enumerate(made) if one not in made[:i]][:MAX_CHOICES]


def _few_values(hint: object) -> tuple[Any, ...]:
    """Return the values of a type that has only a few."""
    if hint is bool:
        return (False, True)
    return get_args(hint) if get_origin(hint) is Literal else ()


def _made(options: type, change: Mapping[str, Any]) -> object | None:
    try:
        made: object = options(**change)
    except ValueError:
        return None
    return made
