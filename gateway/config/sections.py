"""One bus, motor or sensor of the robot file → its object, or None with its mistakes told.

Rules. Each part is looked at in all its halves, whatever is wrong with the others: what the file says of its
wiring, what its protocol says of its options and settings, what a joint or a mounting takes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from brain.perception.mount import Mount
from gateway.config import validate
from gateway.config.errors import Key, Mistakes, shown, unknown
from gateway.config.schema import build, keys, positive
from gateway.core.joint import JointSettings
from gateway.core.robot import TWIN, BusSettings, Motor, Sensor
from protocols.messages import MILLISECOND, Nanos
from protocols.plugin import Device, Plugin, Spec, UnknownProtocol

Find: TypeAlias = Callable[[str], Plugin]
"""A protocol by its name, or UnknownProtocol."""
Table: TypeAlias = dict[str, Any]


@dataclass(frozen=True, slots=True)
class _Bus:
    kind: Literal["can", "canfd", "serial"]
    interface: str
    bitrate: int = 0
    data_bitrate: int = 0
    baudrate: int = 0
    receive_filter: Literal["all", "own"] = "all"
    shared_bus: Literal["unknown", "acknowledged"] = "unknown"
    """What a person knows of languages that share the bus (gateway.config.sharing)."""


@dataclass(frozen=True, slots=True)
class _Wiring:
    """What a motor and a sensor have in common."""

    protocol: str
    bus: str
    address: int
    options: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Mounting:
    """What a sensor has beside its wiring."""

    mount: Mount = field(default_factory=Mount)
    timeout: Nanos = 500 * MILLISECOND


ALL_BITS = 0x1FFF_FFFF
"""Of a CAN id."""
_RATES = {"can": ("bitrate",), "canfd": ("bitrate", "data_bitrate"), "serial": ("baudrate",)}


def read_bus(name: str, table: Table, mistakes: Mistakes) -> BusSettings | None:
    """The bus of this name."""
    at = ("buses", name)
    made = build(_Bus, table, at, mistakes)
    rates = ("bitrate", "data_bitrate", "baudrate")
    positive(table, at, rates, mistakes)
    kind, interface = table.get("kind"), table.get("interface")
    if not isinstance(kind, str) or kind not in _RATES:
        return None
    for rate in rates:
        if rate in _RATES[kind] and rate not in table:
            mistakes.add((*at, rate), "missing; expected an integer: bits per second")
        elif rate not in _RATES[kind] and rate in table:
            wanted = " and ".join(_RATES[kind])
            mistakes.add((*at, rate), f"a bus of kind {kind!r} has no {rate}; expected {wanted}")
    if isinstance(interface, str):
        check_interface(interface, kind, at, mistakes)
    if made is None:
        return None
    if made.kind == "canfd" and 0 < made.data_bitrate < made.bitrate:
        slower = f"found {made.data_bitrate}, expected at least the bitrate of {made.bitrate}"
        mistakes.add((*at, "data_bitrate"), slower)
    if made.receive_filter == "own" and kind == "serial":
        mistakes.add(
            (*at, "receive_filter"), "a serial bus has no ids to filter; expected no key 'receive_filter'"
        )
    rates_of_bus = made.bitrate, made.data_bitrate, made.baudrate
    known = made.shared_bus == "acknowledged"
    return BusSettings(name, made.kind, made.interface, *rates_of_bus, acknowledged=known)


def only_own(table: Table, specs: Iterable[Spec]) -> tuple[tuple[int, int], ...]:
    """The ids to let in on a bus whose table says `receive_filter = "own"`: what its devices send, and what their
    drivers understand of others. () if the table says otherwise, or nothing is expected: everything."""
    if table.get("receive_filter") != "own":
        return ()
    found = {(number, ALL_BITS) for spec in specs for number in spec.expects}
    return tuple(sorted(found | {choice for spec in specs for choice in spec.receives_also}))


def check_interface(interface: str, kind: str, at: Key, mistakes: Mistakes) -> None:
    """It is "twin", or INTERFACE:CHANNEL with an interface that fits the kind of bus."""
    if interface == TWIN:
        return
    driver, colon, channel = interface.partition(":")
    example = "serial:/dev/ttyUSB0" if kind == "serial" else "socketcan:can0"
    if not (driver and colon and channel):
        wanted = f'expected "{TWIN}" or INTERFACE:CHANNEL, such as "{example}"'
        mistakes.add((*at, "interface"), f"found {shown(interface)}, {wanted}")
    elif kind == "serial" and driver != "serial":
        mistakes.add((*at, "interface"), f'found {shown(interface)}, expected "serial:PORT" on a serial bus')


@dataclass(frozen=True, slots=True)
class _Wired:
    """A device whose wiring is right as far as its own language can tell."""

    bus: str
    plugin: Plugin
    device: Device
    spec: Spec


def read_motor(
    name: str, table: Table, buses: tuple[str, ...], find: Find, mistakes: Mistakes
) -> Motor | None:
    """The motor of this name; `buses` are those of the file."""
    at = ("motors", name)
    wired = _wired(at, table, buses, find, "motor", mistakes)
    joint = build(JointSettings, table, at, mistakes, also=keys(_Wiring))
    positive(table, at, ("gear", "command_timeout_ms", "feedback_timeout_ms"), mistakes)
    validate.check_limits(table.get("limits"), (*at, "limits"), mistakes)
    if wired is None or joint is None:
        return None
    return Motor(name, wired.bus, wired.plugin, wired.device, wired.spec, joint)


def read_sensor(
    name: str, table: Table, buses: tuple[str, ...], find: Find, mistakes: Mistakes
) -> Sensor | None:
    """The sensor of this name; `buses` are those of the file."""
    at = ("sensors", name)
    wired = _wired(at, table, buses, find, "sensor", mistakes)
    mounting = build(_Mounting, table, at, mistakes, also=keys(_Wiring))
    positive(table, at, ("timeout_ms",), mistakes)
    if wired is None or mounting is None:
        return None
    return Sensor(name, wired.bus, wired.plugin, wired.device, wired.spec, mounting.mount, mounting.timeout)


def _wired(
    at: Key,
    table: Table,
    buses: tuple[str, ...],
    find: Find,
    kind: Literal["motor", "sensor"],
    mistakes: Mistakes,
) -> _Wired | None:
    """The device with its own language's options, settings and spec."""
    own = {key: value for key, value in table.items() if key in keys(_Wiring)}
    wiring = build(_Wiring, own, at, mistakes)
    protocol, bus, address = table.get("protocol"), table.get("bus"), table.get("address")
    if isinstance(bus, str) and bus not in buses:
        mistakes.add((*at, "bus"), unknown("bus", bus, buses))
    if isinstance(address, int) and address < 0:
        mistakes.add((*at, "address"), f"found {shown(address)}, expected an integer of at least 0")
        wiring = None
    if not isinstance(protocol, str):
        return None
    try:
        language = find(protocol)
    except UnknownProtocol as error:
        mistakes.add((*at, "protocol"), str(error))
        return None
    options: object = build(language.options, table.get("options", {}), (*at, "options"), mistakes)
    settings: object = build(language.settings, table.get("settings", {}), (*at, "settings"), mistakes)
    if wiring is None or options is None or settings is None:
        return None
    device = Device(at[-1], wiring.address, options, settings)
    try:
        spec = language.spec(device)
    except ValueError as error:
        mistakes.add((*at, "address") if "address" in str(error) else at, str(error))
        return None
    except Exception as error:  # noqa: BLE001 -- a third party's spec may raise anything
        said = f"protocol {protocol!r} is broken: its spec raises {type(error).__name__}: {error}"
        mistakes.add((*at, "protocol"), said)
        return None
    if spec.kind != kind:
        mistakes.add((*at, "protocol"), f"{protocol!r} speaks to a {spec.kind} here, expected a {kind}")
        return None
    return _Wired(wiring.bus, language, device, spec)
