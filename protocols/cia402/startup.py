"""What is read of a device before its first command, and the `DeviceProfile` made of it. Uploads only.

Rules. Units and modes come first, since feedback needs them; then the identity; then the PDOs. An object that
the device refuses to upload is *absent*, and not read again until the device restarts. What was read is a
plain dictionary; the `DeviceProfile` is made when all of it is there.

Source: CiA 301 (identity object 1018, PDO parameters), CiA 402-2 (608F, 6091, 6092, 6076, 6502).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from protocols.cia402 import mapping, units
from protocols.cia402 import objects as o
from protocols.cia402.mapping import Pdo, PdoKind
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
"""With these, feedback can be reported."""
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
KINDS: tuple[PdoKind, PdoKind] = ("TPDO", "RPDO")


@dataclass(frozen=True, slots=True)
class DeviceProfile:
    """All that must be known of a device to command it."""

    units: Units
    modes: int
    """Object 6502."""
    serial: int | None
    pdos: tuple[Pdo, ...]

    def mode(self, *wanted: Mode) -> Mode | None:
        """Return the first of these modes that the device supports."""
        return next((mode for mode in wanted if supports(self.modes, mode)), None)


def next_key(read: Mapping[Key, int], absent: Collection[Key], named: bool) -> Key | None:
    """Return the object to be read next; None if all is read. `named`: the device's name (text) is read."""
    for key in (*FIRST, *THEN):
        if key not in read and key not in absent and not (named and key == o.DEVICE_NAME):
            return key
    for kind in KINDS:
        for number in o.PDO_NUMBERS:
            pdo_key = mapping.next_key(number, kind, read, absent)
            if pdo_key is not None:
                return pdo_key
    return None


def units_read(read: Mapping[Key, int], absent: Collection[Key]) -> bool:
    """True if everything is read that units are computed from."""
    return all(key in read or key in absent for key in FIRST)


def value_of(key: Key, data: bytes) -> int | None:
    """Decode an upload as a number; None if its length is not the type's.

    A shorter response for an unsigned object is accepted: some devices shorten them."""
    known = OBJECTS.get(key)
    if known is None or known.type is Type.TEXT:
        return int.from_bytes(data, "little") if 1 <= len(data) <= 8 else None
    if not known.type.signed and 1 <= len(data) <= known.bits // 8:
        return int.from_bytes(data, "little")
    return from_bytes(known.type, data)


def units_from(read: Mapping[Key, int], options: Options) -> Units | None:
    """Return the device's units, with the options' values where the device has none."""
    found = units.units_of(read, options.counts_per_turn, options.velocity_per_turn, options.rated_torque)
    return None if isinstance(found, str) else found


def why_unusable(read: Mapping[Key, int], absent: Collection[Key], options: Options) -> str:
    """Return why a device cannot be commanded at all, once units are read; "" if it can."""
    profile = read.get(o.DEVICE_TYPE, 0) & 0xFFFF
    if profile != PROFILE:
        return f"its object 1000 has device profile {profile}, not 402"
    if o.STATUSWORD in absent or o.POSITION in absent:
        return "it has no statusword (6041) or no position (6064)"
    if units_from(read, options) is None:
        return "its units are unknown: 608F, 6091, 6092 do not define them; set counts_per_turn under options"
    return ""


def device_profile(read: Mapping[Key, int], options: Options) -> DeviceProfile | None:
    """Make the profile of a device when all is read."""
    found = units_from(read, options)
    if found is None:
        return None
    pdos = [mapping.pdo_of(number, kind, read) for kind in KINDS for number in o.PDO_NUMBERS]
    modes = read.get(o.SUPPORTED_MODES, 0)
    serial = read.get(o.SERIAL_NUMBER) or None
    return DeviceProfile(found, modes, serial, tuple(pdo for pdo in pdos if pdo is not None))


def mode_name(value: int) -> str:
    """Return the name of a mode of operation in CiA 402."""
    try:
        return MODE_NAMES[Mode(value)]
    except ValueError:
        return f"mode {value}"
