"""The parts of a plugin that devices with a table have alike: spec, driver, and decoder of what they obey."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import fields, is_dataclass
from typing import Any, Literal, Protocol, TypeVar

from protocols.bounds import Invalid
from protocols.frames import Frame, IdMask
from protocols.messages import COMMANDS, MILLISECOND, Command, Nanos, Obeyed, Scan
from protocols.plugin import (
    CommandDecoder,
    Device,
    Driver,
    FeedbackKind,
    Range,
    Spec,
    Watchdog,
    Written,
    remembered,
    unchanged,
)
from protocols.toolkit.motor_driver import Adapter, MotorDriver, may_scan
from protocols.toolkit.servo_packets import ServoPackets
from protocols.toolkit.table import Decoded, Table


def can_motor(
    device: Device,
    table: Table,
    addresses: range,
    scan: Sequence[IdMask] = (),
    **others: Any,  # noqa: ANN401 -- fields
) -> Spec:
    """Return the spec of a motor that is polled every `feedback_ms` and offline after `offline_ms` of its
    options.

    Args:
        device: the motor.
        table: its messages.
        addresses: those that it can have; ValueError if it has another one.
        scan: ids of the questions of a scan, unless its options have `scan` false.
        others: its other fields.
    """
    asks = scan if may_scan(device) else ()
    if asks:
        others["requests"] = others.get("requests", frozenset()) | {Scan}
    usual: dict[str, Any] = {
        "bus": "can",
        "sends": (*table.ids("to_device", device.address), *asks),
        "expects": table.ids("from_device", device.address),
        "read_only": table.read_only,
    }
    return _motor(device, addresses, usual | others)


def serial_motor(
    device: Device,
    read_only: Callable[[Frame], bool],
    addresses: range,
    line: Literal["free", "asked", "half-duplex"] = "asked",
    **others: Any,  # noqa: ANN401 -- fields
) -> Spec:
    """Return the same for a motor on a serial line; `read_only` and `line` as in `Spec`."""
    usual: dict[str, Any] = {
        "bus": "serial",
        "sends": (),
        "expects": (),
        "read_only": read_only,
        "line": line,
    }
    return _motor(device, addresses, usual | others)


def bus_servo(device: Device, packets: ServoPackets, **others: Any) -> Spec:  # noqa: ANN401 -- fields
    """Return the same for a servo on a bus, whose options have `table` and `set_up`."""
    options: Any = device.options
    off = packets.sync_write(options.table.target("Torque_Enable")[0], {device.address: b"\0"})
    usual: dict[str, Any] = {"id_parameter": "ID", "parameters": tuple(options.table.by_name), "stop": (off,)}
    usual |= {"set_up": declared(options.set_up)}
    return serial_motor(device, packets.read_only, packets.addresses, "half-duplex", **usual | others)


def _motor(device: Device, addresses: range, others: dict[str, Any]) -> Spec:
    if device.address not in addresses:
        low, high = addresses.start, addresses.stop - 1
        text = f"address {device.address} of {device.name}: it must be {low} to {high}"
        raise Invalid(("address", text))
    usual: dict[str, Any] = {
        "kind": "motor",
        "feedback": FeedbackKind.POLLED,
        "feedback_period": round(device.options.feedback_ms * MILLISECOND),
        "offline_after": round(device.options.offline_ms * MILLISECOND),
        "holds_unattended": False,
        "stop_clears_faults": False,
    }
    return Spec(**usual | others)


def own_ramps(rate: float, *kinds: type[Command]) -> Mapping[type[Command], float]:
    """Return `Spec.ramps` of a device with one ramp [rad/s²] for these commands; 0: it has none."""
    return dict.fromkeys(kinds, rate) if rate else {}


def both_ways(most: float, resolution: float, relative: float = 0.0) -> Range:
    """Return the range of a quantity with a sign."""
    return Range(-most, most, resolution, relative)


def declared(values: Mapping[str, float]) -> Written:
    """Return values as `Spec.set_up` has them."""
    return {name: (value,) for name, value in values.items()}


def fed_by_any_frame(timeout: Nanos | None, why: str = "") -> dict[str, Any]:
    """Return the fields of the spec of a motor whose watchdog any frame feeds; 0 or None: without one, and
    `why`, if not by its options."""
    why = why or "it has no watchdog (timeout_ms = 0)"
    note = "" if timeout else f"{why}: nothing stops it, without a host its last command goes on"
    watchdog = Watchdog(timeout or None, bool(timeout), note, "any frame")
    return {"watchdog": watchdog, "holds_unattended": not timeout}


def driver_of(
    adapter: Callable[[], Adapter[Any]], spec: Callable[[Device], Spec]
) -> Callable[[Sequence[Device]], Driver]:
    """Return `Plugin.driver`, with the ranges of the spec. It raises ValueError if two devices on a bus have
    one address."""

    def driver(devices: Sequence[Device]) -> Driver:
        specs = {device.name: remembered(spec)(device) for device in devices}
        held: dict[object, str] = {}
        for device in devices:
            other = held.setdefault((device.address, specs[device.name].sends), device.name)
            if other != device.name:
                raise ValueError(f"address {device.address} of {device.name} is that of {other}, too")
        return MotorDriver(adapter(), devices, {name: each.ranges for name, each in specs.items()})

    return driver


class Memory(Protocol):
    """What a device keeps of the frames it received. The twin's firmware runs on the very same object, so
    that decoder and twin cannot disagree."""

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Apply a message to any address; return what the device then does."""
        ...


class TableDecoder:
    """The command decoder of the devices on one bus: of each its table, its memory as it is when switched on,
    and the canonical form of its commands."""

    def __init__(self, devices: Sequence[tuple[Table, Memory, Callable[[Command], Command]]]) -> None:
        self._devices = {
            table: [(memory, canonical) for other, memory, canonical in devices if other is table]
            for table, _, _ in devices
        }

    def __deepcopy__(self, memo: dict[int, Any]) -> TableDecoder:
        """Copy what the devices keep: all else is constant. The guard does that every few frames."""
        return TableDecoder(
            [
                (table, copied(memory, memo), canonical)
                for table, devices in self._devices.items()
                for memory, canonical in devices
            ]
        )

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what the devices would obey in this frame; [] if nothing."""
        obeyed: list[Obeyed] = []
        for table, devices in self._devices.items():
            decoded = table.decode(frame, "to_device")
            if decoded is None or not decoded.name:
                continue
            for memory, canonical in devices:
                does = memory.obey(decoded)
                if canonical is not unchanged:
                    does = [canonical(each) if isinstance(each, COMMANDS) else each for each in does]
                obeyed += does
        return obeyed


_CONSTANTS = frozenset({int, float, bool, str, bytes, type(None)})


Kind = TypeVar("Kind")


def copied(memory: Kind, memo: dict[int, Any]) -> Kind:
    """Return a deep copy of what a device keeps. Most memories are dataclasses with slots, of numbers,
    options and dictionaries of numbers: these are copied in a fifth of the time."""
    plain: Any = memory
    if not is_dataclass(plain) or hasattr(plain, "__dict__"):
        return deepcopy(memory, memo)
    made: Kind = object.__new__(type(memory))
    for each in fields(plain):
        value = getattr(memory, each.name)
        if type(value) is dict and _CONSTANTS.issuperset(map(type, value.values())):
            value = value.copy()
        elif type(value) not in _CONSTANTS and not _is_frozen(value):
            value = deepcopy(value, memo)
        object.__setattr__(made, each.name, value)
    return made


def _is_frozen(value: object) -> bool:
    """True for options and settings, which never change."""
    parameters: Any = getattr(value, "__dataclass_params__", None)
    return parameters is not None and bool(parameters.frozen)


def decoder_of(
    table: Callable[[Any], Table], memory: Callable[[Device], Memory], spec: Callable[[Device], Spec]
) -> Callable[[Sequence[Device]], CommandDecoder]:
    """Return `Plugin.decoder`; `table`: from the options of a device; `memory` is what it keeps."""
    return lambda devices: TableDecoder(
        [(table(each.options), memory(each), remembered(spec)(each).canonical) for each in devices]
    )
