"""Messages on a plain serial line: their bytes, and the numbers that they may carry.

Rules. `encode` raises ValueError for what must not be sent (our mistake); `decode` takes any bytes and never
raises. All numbers are little-endian:

    A5 57 | length u16 | length XOR FFFF u16 | body: address u8, packed message | CRC-32 u32 of the body

In the body the name of the device or bus is empty, since the address identifies it, and `t` is the age of
the measurement [ns] when it was sent. −0.0, and what is smaller than any normal binary32, is 0.0 in both
directions. The complement reveals a false or damaged length at once.
"""

from __future__ import annotations

import math
import struct
from dataclasses import fields
from functools import cache
from typing import Any

from protocols import messages as msg
from protocols import sensors
from protocols.message_codec import CODES, MessageLayout, layout_of, pack_fields, unpack_fields
from protocols.messages import Message, Nanos
from protocols.plugin import FaultInfo
from protocols.toolkit.serial import CRC32, Framing
from protocols.toolkit.table import TINY

NAME = "plain"
TO_MOTOR = msg.ClearFault | msg.Estop | msg.Zero | msg.ReadParameter | msg.WriteParameter | msg.Reboot
"""Requests to one motor."""
TO_ALL = msg.Scan | msg.SetId
"""Requests to all devices on the line."""
BROADCAST, ADDRESSES = 0, range(1, 0x100)
"""The address to which all devices obey, and those that a device may have."""
MAX_BODY = 0x4000
"""Bytes in the body of one message: a scan of some 2,000 beams."""
MAX_AGE: Nanos = 10 * msg.SECOND
"""Largest age of a measurement; a message with a larger one is malformed."""
WATCHDOG_EXPIRED, EMERGENCY_STOP = 1, 2
_LOST = "no command came within watchdog_ms", "find why the host fell silent, then clear"
FAULTS = {
    WATCHDOG_EXPIRED: FaultInfo("watchdog expired", *_LOST),
    EMERGENCY_STOP: FaultInfo("emergency stop", "requested by the host", "clear when it is safe"),
}

_HEAD = struct.Struct("<2sHH")


def _body_size(head: bytes) -> int | None:
    _, length, complement = _HEAD.unpack(head)
    return length if length ^ complement == 0xFFFF and 1 <= length <= MAX_BODY else None


ADDRESS = _HEAD.size
"""Where the address is in a message (head and body)."""
FRAMING = Framing(b"\xa5\x57", _HEAD.size, _body_size, CRC32, 4, covers=_HEAD.size)

# fmt: off
LIMITS: dict[str, tuple[float, float]] = {
    "position": (-1e6, 1e6), "velocity": (-1e5, 1e5), "torque": (-1e4, 1e4),
    "stiffness": (0.0, 1e6), "damping": (0.0, 1e5),
    "current": (-1e5, 1e5), "voltage": (-1e4, 1e4), "temperature": (-273.15, 1e4),
    "value": (math.nextafter(-math.inf, 0.0), math.nextafter(math.inf, 0.0)),
}
# fmt: on
"""Permitted numbers by the name of the field, in the units of `protocols.messages`. A sender refuses to
encode what lies outside, a receiver takes it for malformed."""


def limits(kind: type[Message]) -> dict[str, tuple[float, float]]:
    """Return the permitted numbers of a message, by field: of a reading, as its kind of sensor has them."""
    sensor = sensors.kinds().by_type.get(kind) if issubclass(kind, msg.Measurement) else None
    if sensor:
        return {name: (each.low, each.high) for name, each in sensor.quantities.items()}
    return {f.name: LIMITS[f.name] for f in fields(kind) if f.name in LIMITS}


@cache
def _limited() -> dict[type[Message], list[tuple[int, str, float, float]]]:
    """Return, by message, index, name, lowest and highest value of each number that has limits."""
    every: list[type[Message]] = [*CODES.values(), *sensors.kinds().by_type]
    found = {kind: limits(kind) for kind in every}
    return {
        kind: [(at, f.name, *bounds[f.name]) for at, f in enumerate(fields(kind)) if f.name in bounds]
        for kind, bounds in found.items()
    }


def _refused(layout: MessageLayout, values: list[Any]) -> str:
    """Return which number lies outside `LIMITS`, "" if none does; then make what is too small 0.0."""
    for at, name, low, high in _limited()[layout.message_type]:
        value = values[at]
        if value is None or value == ():
            continue
        many = type(value) is tuple
        smallest, largest = (min(value), max(value)) if many else (value, value)
        if not low <= smallest <= largest <= high:
            return f"{name} {value!r} is not in {low:g} … {high:g}"
        if smallest < TINY:  # most scans have no such range
            if many:
                values[at] = tuple([0.0 if -TINY < each < TINY else each for each in value])
            elif value > -TINY:
                values[at] = type(value)(0)
    return ""


def encode(address: int, message: Message, now: Nanos = 0) -> bytes:
    """Return a message to or from the device at this address; a measurement's `t` becomes its age at `now`.

    Raises ValueError as `pack` does, for a number outside `LIMITS`, and for a body that is too long."""
    layout = layout_of(message)
    values = list(layout.values(message))
    if wrong := _refused(layout, values):
        raise ValueError(f"{layout.message_type.__name__}: {wrong}")
    if layout.name is not None:
        values[layout.name] = ""
    if layout.time is not None:
        values[layout.time] = min(max(now - values[layout.time], 0), MAX_AGE)
    body = bytes((address,)) + pack_fields(layout, values)
    if len(body) > MAX_BODY:
        raise ValueError(f"a body of {len(body)} bytes; it may have {MAX_BODY}")
    return FRAMING.frame(_HEAD.pack(FRAMING.sync, len(body), len(body) ^ 0xFFFF) + body)


def decode(message: bytes, t: Nanos, name: str) -> Message | None:
    """Decode a message (head and body) of the device called `name`, received at `t`; None if malformed."""
    unpacked = unpack_fields(message[ADDRESS + 1 :])
    if unpacked is None or _refused(*unpacked):
        return None
    layout, values = unpacked
    if layout.name is not None:
        values[layout.name] = name
    if layout.time is not None:
        if not 0 <= values[layout.time] <= MAX_AGE:
            return None
        values[layout.time] = t - values[layout.time]
    return layout.message_type(*values)
