"""What is read of a device before its first command, and what that makes known. Uploads only.

Rules. Units and modes come first, since feedback needs them; then who it is; then its PDOs. An object that
the device refuses to tell is *absent*, and not asked for again until the device restarts. What was read is a
plain dictionary; `Known` is made of it when all of it is there.

Source: CiA 301 (identity object 1018, PDO parameters), CiA 402-2 (608F, 6091, 6092, 6076, 6502).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from protocols.cia402 import mapping, units
from protocols.cia402 import objects as o
from protocols.cia402.mapping import Pdo, Way
from protocols.cia402.objects import OBJECTS, Key, Type, from_bytes
from protocols.cia402.options import Options
from protocols.cia402.profile import MODE_NAMES, Mode, supports
from protocols.cia402.units import Units

PROFILE = 402
"""The lower 16 bits of object 1000."""
FIRST: tuple[Key, ...] = (
    o.DEVICE_TYPE,
    *units.READ,
    o.SUPPORTED_MODES,
    o.STATUSWORD,
    o.POSITION,
    o.MODE_DISPLAY,
)
"""With these, feedback can be told."""
THEN: tuple[Key, ...] = (
    o.VENDOR_ID,
    o.PRODUCT_CODE,
    o.REVISION,
    o.SERIAL_NUMBER,
    o.DEVICE_NAME,
    o.ERROR_CODE,
    o.PRODUCER_HEARTBEAT,
    o.QUICK_STOP_OPTION,
    o.VELOCITY_OFFSET,
    o.TORQUE_OFFSET,
)
WAYS: tuple[Way, Way] = ("from", "to")


@dataclass(frozen=True, slots=True)
class Known:
    """A device of which everything is known that commanding it takes."""

    units: Units
    modes: int
    """Object 6502."""
    serial: int | None
    pdos: tuple[Pdo, ...]

    def mode(self, *wanted: Mode) -> Mode | None:
        """The first of these modes that the device supports."""
        return next((mode for mode in wanted if supports(self.modes, mode)), None)


def next_key(read: Mapping[Key, int], absent: Collection[Key], named: bool) -> Key | None:
    """What is to be read next; None if all is read. `named`: the device's name is known, or is not told."""
    for key in (*FIRST, *THEN):
        if key not in read and key not in absent and not (named and key == o.DEVICE_NAME):
            return key
    for way in WAYS:
        for number in o.PDO_NUMBERS:
            key_of_pdo = mapping.to_be_read(number, way, read, absent)
            if key_of_pdo is not None:
                return key_of_pdo
    return None


def units_known(read: Mapping[Key, int], absent: Collection[Key]) -> bool:
    """Whether everything is read that units are made of."""
    return all(key in read or key in absent for key in FIRST)


def value_of(key: Key, data: bytes) -> int | None:
    """What an upload tells, as a number; None if it is not as long as its type.

    A 1-byte or 2-byte answer for a wider unsigned object is taken: some devices shorten them."""
    known = OBJECTS.get(key)
    if known is None or known.type is Type.TEXT:
        return int.from_bytes(data, "little") if 1 <= len(data) <= 8 else None
    if not known.type.signed and 1 <= len(data) <= known.bits // 8:
        return int.from_bytes(data, "little")
    return from_bytes(known.type, data)


def units_from(read: Mapping[Key, int], options: Options) -> Units | None:
    """The device's units, or what the robot file says where the device does not."""
    reported = units.units_of(read)
    if reported is None and not options.counts_per_turn:
        return None
    gear, current = (
        (reported.gear, reported.rated_current) if reported else (1.0, read.get(o.RATED_CURRENT, 0) / 1000.0)
    )
    per_turn = options.counts_per_turn or (reported.per_turn if reported else 0.0)
    torque = read.get(o.RATED_TORQUE, 0) / 1000.0 or options.rated_torque
    return Units(per_turn, gear, torque, current)


def wrong_with(read: Mapping[Key, int], absent: Collection[Key], options: Options) -> str:
    """Why a device cannot be commanded at all, once units are read; "" if it can."""
    profile = read.get(o.DEVICE_TYPE, 0) & 0xFFFF
    if profile != PROFILE:
        return f"its object 1000 says device profile {profile}, not 402"
    if o.STATUSWORD in absent or o.POSITION in absent:
        return "it does not tell its statusword (6041) or its position (6064)"
    if units_from(read, options) is None:
        return (
            "its units are not known: 608F, 6091 and 6092 do not tell them; say counts_per_turn under options"
        )
    return ""


def known_of(read: Mapping[Key, int], options: Options) -> Known | None:
    """What is known when all is read."""
    found = units_from(read, options)
    if found is None:
        return None
    pdos = [mapping.pdo_of(number, way, read) for way in WAYS for number in o.PDO_NUMBERS]
    modes = read.get(o.SUPPORTED_MODES, 0)
    serial = read.get(o.SERIAL_NUMBER) or None
    return Known(found, modes, serial, tuple(pdo for pdo in pdos if pdo is not None))


def mode_name(value: int) -> str:
    """A mode of operation in CiA 402's words."""
    try:
        return MODE_NAMES[Mode(value)]
    except ValueError:
        return f"mode {value}"
