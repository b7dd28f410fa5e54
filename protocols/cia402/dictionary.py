"""A drive's object dictionary: its values, what may be read and written, and what is refused.

Rules. Plain data: the values by (index, subindex). Reading and writing return an SDO abort code, or 0; a
refused write changes nothing. The reasons to refuse a write are checked in this order: no object, no
subindex, read only, wrong length, unsupported value, present state. PDOs are reconfigured as CiA 301 demands:
while they are disabled, and with no object mapped.

Source: package canopen 2.4.1 `node/local.py` (`get_data`, `set_data`) for the abort codes and their order;
`pdo/base.py` `PdoMap.save` for the sequence of a reconfiguration; CiA 301 "PDO mapping parameter".
"""

from __future__ import annotations

from protocols.canopen import sdo
from protocols.canopen.pdo import (
    DISABLED,
    EVENT_VENDOR,
    MOST_BITS,
    NO_RTR,
    SYNCHRONOUS_MOST,
    Packing,
    decode_entry,
    encode_entry,
    mapping,
    packing,
)
from protocols.canopen.services import EMCY_BASE, SYNC_ID, rpdo_id, tpdo_id
from protocols.cia402 import objects as o
from protocols.cia402.objects import OBJECTS, Key, Type, from_bytes, to_bytes
from protocols.cia402.options import SETTING_OBJECTS, SUPPORTED_VALUES, Settings
from protocols.cia402.profile import Mode, supports

DEVICE_TYPE = 0x0002_0192
"""1000: profile 402, servo drive."""
INDICES = frozenset(index for index, _ in OBJECTS)
USUAL_RPDOS = (
    mapping(OBJECTS, o.CONTROLWORD, o.MODE, o.TARGET_POSITION),
    mapping(OBJECTS, o.TARGET_VELOCITY, o.TARGET_TORQUE),
)
USUAL_TPDOS = (
    mapping(OBJECTS, o.STATUSWORD, o.MODE_DISPLAY, o.POSITION),
    mapping(OBJECTS, o.VELOCITY, o.TORQUE, o.ERROR_CODE),
)
"""PDOs of a drive that is delivered with a mapping (`Settings.pdos`)."""
_CONSTANTS: dict[Key, int] = {
    o.DEVICE_TYPE: DEVICE_TYPE,
    o.SYNC_COB_ID: SYNC_ID,
    o.ENCODER_REVOLUTIONS: 1,
    o.INTERPOLATION_INDEX: -3,
}
LARGEST_ID = 0x7FF


class Dictionary:
    """One drive's objects. Plain data."""

    def __init__(self, settings: Settings, address: int) -> None:
        self.supported = settings.supported_modes
        self.texts: dict[Key, str] = {
            o.DEVICE_NAME: settings.device_name,
            o.HARDWARE_VERSION: "twin",
            o.SOFTWARE_VERSION: "1",
        }
        self.values: dict[Key, int] = dict.fromkeys(OBJECTS, 0)
        self.values |= _CONSTANTS
        self.values |= {key: getattr(settings, name) for name, key in SETTING_OBJECTS.items()}
        self.values[o.EMCY_COB_ID] = EMCY_BASE + address
        self.values[o.HOMING_SPEED_SWITCH] = settings.homing_speed
        self.values[o.SERIAL_NUMBER] = settings.serial_number or 0x0402_0000 + address
        for index, sub in OBJECTS:
            if sub and index not in o.PDO_PARAMETERS:
                self.values[index, 0] = max(self.values[index, 0], sub)
        self._configure_pdos(address, usual=settings.pdos == "usual")
        self.packings: dict[int, Packing] = {}
        """Every mapping that is not empty, by its index."""
        for first in (o.RPDO_MAPPING, o.TPDO_MAPPING):
            for index in range(first, first + len(o.PDO_NUMBERS)):
                self._repack(index)

    def _configure_pdos(self, address: int, usual: bool) -> None:
        for number in o.PDO_NUMBERS:
            for first, cob in (
                (o.RPDO_COMMUNICATION, rpdo_id(number, address)),
                (o.TPDO_COMMUNICATION, tpdo_id(number, address) | NO_RTR),
            ):
                index = first + number - 1
                self.values[index, 0] = o.EVENT_TIMER
                self.values[index, o.COB_ID] = cob | DISABLED
                self.values[index, o.TRANSMISSION] = 1 if usual else 255
        for first, map_first, maps in (
            (o.RPDO_COMMUNICATION, o.RPDO_MAPPING, USUAL_RPDOS),
            (o.TPDO_COMMUNICATION, o.TPDO_MAPPING, USUAL_TPDOS),
        ):
            for at, entries in enumerate(maps if usual else ()):
                self.values[first + at, o.COB_ID] &= ~DISABLED
                self.values[map_first + at, 0] = len(entries)
                for sub, entry in enumerate(entries, 1):
                    self.values[map_first + at, sub] = encode_entry(entry)

    def __deepcopy__(self, _: dict[int, object]) -> Dictionary:
        """Copy what can change: keys and values are numbers, packings are frozen. (Copied often.)"""
        other = object.__new__(Dictionary)
        other.supported = self.supported
        other.texts, other.values = dict(self.texts), dict(self.values)
        other.packings = dict(self.packings)
        return other

    # -- access by SDO and PDO ------------------------------------------------------------------

    def read(self, key: Key) -> tuple[int, bytes]:
        """Read an object by SDO: (0, its bytes), or (abort code, b"")."""
        missing = self._missing(key)
        if missing:
            return missing, b""
        if OBJECTS[key].type is Type.TEXT:
            return 0, self.texts[key].encode("ascii")
        return 0, to_bytes(OBJECTS[key].type, self.values[key])

    def write(self, key: Key, data: bytes) -> int:
        """Write an object by SDO; return 0, or the abort code."""
        missing = self._missing(key)
        if missing:
            return missing
        object_ = OBJECTS[key]
        if object_.access != "rw":
            return sdo.READ_ONLY
        value = from_bytes(object_.type, data)
        if value is None:
            return sdo.LENGTH_MISMATCH
        refused = self._refuse(key, value)
        if not refused:
            self.values[key] = value
            if key[0] in o.PDO_PARAMETERS:
                self._repack(key[0])
        return refused

    def take(self, key: Key, value: int) -> bool:
        """Write a value of a PDO; return False if it is ignored, as SDO would refuse it."""
        if key not in OBJECTS or OBJECTS[key].access != "rw" or self._refuse(key, value):
            return False
        self.values[key] = value
        return True

    @staticmethod
    def _missing(key: Key) -> int:
        if key in OBJECTS:
            return 0
        return sdo.NO_SUBINDEX if key[0] in INDICES else sdo.NO_OBJECT

    def _refuse(self, key: Key, value: int) -> int:
        if key == o.MODE:
            known = value in Mode.__members__.values() and supports(self.supported, Mode(value))
            return 0 if known else sdo.BAD_VALUE
        if key in SUPPORTED_VALUES:
            return 0 if value in SUPPORTED_VALUES[key] else sdo.BAD_VALUE
        if key in _NOT_ZERO:
            return 0 if value else sdo.BAD_VALUE
        if key == o.SYNC_COB_ID:  # another identifier, or the drive as producer, is not supported
            return 0 if value == SYNC_ID else sdo.BAD_VALUE
        return self._refuse_pdo(key, value) if key[0] in o.PDO_PARAMETERS else 0

    # -- PDOs -----------------------------------------------------------------------------------

    def _refuse_pdo(self, key: Key, value: int) -> int:
        index, sub = key
        if index < o.RPDO_MAPPING or o.TPDO_COMMUNICATION <= index < o.TPDO_MAPPING:
            return self._refuse_communication(index, sub, value)
        if not self.values[index - o.MAPPING_OFFSET, o.COB_ID] & DISABLED:
            return sdo.DEVICE_STATE
        if not sub:
            return self._refuse_count(index, value)
        return sdo.INCOMPATIBLE if self.values[index, 0] else _unmappable(index, value)

    def _refuse_communication(self, index: int, sub: int, value: int) -> int:
        disabled = bool(self.values[index, o.COB_ID] & DISABLED)
        if sub == o.COB_ID:
            # An identifier is changed only while the PDO is disabled (CiA 301 "COB-ID used by PDO").
            same = (value ^ self.values[index, sub]) & LARGEST_ID == 0
            if value & ~(DISABLED | NO_RTR | LARGEST_ID) or not value & LARGEST_ID:
                return sdo.BAD_VALUE
            return 0 if disabled or same or value & DISABLED else sdo.DEVICE_STATE
        if sub == o.TRANSMISSION:
            return sdo.BAD_VALUE if SYNCHRONOUS_MOST < value < EVENT_VENDOR else 0
        return 0 if disabled or sub == o.EVENT_TIMER else sdo.DEVICE_STATE

    def _refuse_count(self, index: int, count: int) -> int:
        if count > o.MAPPED_MOST:
            return sdo.BAD_VALUE
        values = [self.values[index, sub] for sub in range(1, count + 1)]
        if any(_unmappable(index, value) for value in values):
            return sdo.NOT_MAPPABLE
        entries = [decode_entry(value) for value in values]
        return sdo.PDO_TOO_LONG if sum(entry.bits for entry in entries) > MOST_BITS else 0

    def _repack(self, index: int) -> None:
        if (index, 0) in self.values and index & o.MAPPING_OFFSET:
            entries = [decode_entry(self.values[index, sub]) for sub in range(1, self.values[index, 0] + 1)]
            self.packings.pop(index, None)
            if entries:
                self.packings[index] = packing(OBJECTS, entries)

    def active(self, communication: int) -> Packing | None:
        """Return the mapping of an enabled, non-empty PDO, by the index of its communication parameter."""
        if self.values[communication, o.COB_ID] & DISABLED:
            return None
        return self.packings.get(communication + o.MAPPING_OFFSET)


_NOT_ZERO = frozenset(
    {
        o.ENCODER_INCREMENTS,
        o.ENCODER_REVOLUTIONS,
        o.GEAR_MOTOR,
        o.GEAR_SHAFT,
        o.FEED_SHAFT,
        o.RATED_TORQUE,
        o.RATED_CURRENT,
        o.PROFILE_VELOCITY,
        o.PROFILE_ACCELERATION,
        o.PROFILE_DECELERATION,
        o.QUICK_STOP_DECELERATION,
        o.TORQUE_SLOPE,
        o.HOMING_SPEED_SWITCH,
        o.HOMING_SPEED_ZERO,
        o.HOMING_ACCELERATION,
    }
)


def _unmappable(index: int, value: int) -> int:
    """Return an abort code if an object is unknown, not mappable, not writable, or of another length."""
    entry = decode_entry(value)
    known = OBJECTS.get(entry.key)
    if known is None or not known.mappable or known.bits != entry.bits:
        return sdo.NOT_MAPPABLE
    writes = index < o.TPDO_COMMUNICATION
    return sdo.NOT_MAPPABLE if writes and known.access != "rw" else 0
