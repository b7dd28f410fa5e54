"""What is read of a drive before it is commanded, and what is written to it before it is armed.

Rules. Units and modes are read first, since feedback needs them; then the identity; then the PDOs. An object
that the drive refuses to upload is *absent*, and not read again until it restarts. A set of PDOs *fits* if
the objects that move the motor and those that report its state are in usable ones; then it is kept, else
written. Other objects are transferred by SDO.

Source: CiA 301 (identity object 1018, PDO parameters), CiA 402-2 (608F, 6091, 6092, 6076, 6502).
"""

from __future__ import annotations

from collections.abc import Iterator

from protocols.canopen import mapping
from protocols.canopen import objects as co
from protocols.canopen.mapping import Kind, Pdo, Setup, Write, default_id
from protocols.canopen.objects import Key, Type, from_bytes
from protocols.canopen.pdo import EVENT, NO_RTR, encode_entry, entry
from protocols.cia402 import objects as o
from protocols.cia402 import units
from protocols.cia402.objects import OBJECTS
from protocols.cia402.options import Options
from protocols.cia402.profile import Mode, supports
from protocols.cia402.setpoints import POSITION, TORQUE, VELOCITY, Family
from protocols.cia402.units import Units
from protocols.messages import MILLISECOND

PROFILE = 402
"""The lower 16 bits of object 1000."""
FIRST: tuple[Key, ...] = (
    co.DEVICE_TYPE,
    *units.READ,
    o.SUPPORTED_MODES,
    o.STATUSWORD,
    o.POSITION,
    o.MODE_DISPLAY,
)
"""With these, feedback can be reported."""
THEN: tuple[Key, ...] = (
    co.VENDOR_ID,
    co.PRODUCT_CODE,
    co.REVISION,
    co.SERIAL_NUMBER,
    co.DEVICE_NAME,
    o.ERROR_CODE,
    co.PRODUCER_HEARTBEAT,
    o.QUICK_STOP_OPTION,
    o.VELOCITY_OFFSET,
    o.TORQUE_OFFSET,
)
FILLED = frozenset({o.CONTROLWORD, o.MODE, *o.TARGETS})
"""Objects for which the driver has a value at any time."""
SLOW = 10
"""SYNCs, or event timers, per TPDO of the supply."""


def value_of(key: Key, data: bytes) -> int | None:
    """Decode an upload as a number; None if its length is not the type's.

    A shorter response for an unsigned object is accepted: some drives shorten them."""
    known = OBJECTS.get(key)
    if known is None or known.type is Type.TEXT:
        return int.from_bytes(data, "little") if 1 <= len(data) <= 8 else None
    if not known.type.signed and 1 <= len(data) <= known.type.bits // 8:
        return int.from_bytes(data, "little")
    return from_bytes(known.type, data)


class Known:
    """What was read of one drive. Plain data."""

    def __init__(self, options: Options, node: int) -> None:
        self.options, self.node = options, node
        self.forget()

    def forget(self) -> None:
        """Forget everything: the drive may have restarted, or been replaced."""
        self.read: dict[Key, int] = {}
        self.absent: set[Key] = set()
        self.name: str | None = None
        """Object 1008; None: not read yet."""
        self.units: Units | None = None
        self.unusable = ""
        """Why it cannot be commanded at all."""
        self.pdos: dict[tuple[Kind, int], Pdo] | None = None
        """Its PDOs; None: not all is read."""

    def forget_pdos(self) -> None:
        """Read the PDOs anew: they may have been written."""
        self.read = {key: value for key, value in self.read.items() if key[0] not in co.PDO_PARAMETERS}
        self.pdos = None

    def lacks(self, key: Key) -> None:
        """Record that it does not have an object."""
        self.absent.add(key)

    # -- reading --------------------------------------------------------------------------------------

    @property
    def complete(self) -> bool:
        """True if all is read that a command needs."""
        return self.pdos is not None and not self.unusable

    def next_key(self) -> Key | None:
        """Return the object to be read next; None if all is read."""
        if self.pdos is not None or self.unusable:
            return None
        known = self.read.keys() | self.absent | (set() if self.name is None else {co.DEVICE_NAME})
        key = next((key for key in (*FIRST, *THEN) if key not in known), None)
        return key or mapping.next_key(self.read, self.absent)

    def add(self, key: Key, data: bytes, abort: int | None) -> int | None:
        """Record an object that was read; with `abort` it is absent. Returns its value."""
        value = value_of(key, data) if abort is None else None
        if key == co.DEVICE_NAME:
            self.name = "" if abort is not None else data.decode("ascii", "replace").strip("\0 ")
        elif value is None:
            self.absent.add(key)
        else:
            self.read[key] = value
        if self.units is None and not self.unusable:
            self._judge()
        if self.units is not None and self.next_key() is None:
            self.pdos = mapping.pdos_of(self.read)
        return value

    def _judge(self) -> None:
        """Compute the units, once all is read that they need; or why it cannot be commanded."""
        if any(key not in self.read and key not in self.absent for key in FIRST):
            return
        options, profile = self.options, self.read.get(co.DEVICE_TYPE, 0) & 0xFFFF
        own = options.counts_per_turn, options.velocity_per_turn, options.rated_torque
        found = units.units_of(self.read, *own)
        if profile != PROFILE:
            self.unusable = f"its object 1000 has device profile {profile}, not {PROFILE}"
        elif not {o.STATUSWORD, o.POSITION}.isdisjoint(self.absent):
            self.unusable = "it has no statusword (6041) or no position (6064)"
        elif isinstance(found, str):
            self.unusable = found
        else:
            self.units = found

    # -- what it can do -------------------------------------------------------------------------------

    @property
    def serial(self) -> int | None:
        """Its serial number, if it has one."""
        return self.read.get(co.SERIAL_NUMBER) or None

    def mode(self, *families: Family) -> Mode | None:
        """Return the mode to be used of the first of these families of which the drive has one."""
        order = 1 if self.options.modes == "cyclic" else -1
        modes = [mode for family in families for mode in (family.cyclic, family.profile)[::order]]
        return next((mode for mode in modes if supports(self.read.get(o.SUPPORTED_MODES, 0), mode)), None)

    def usable(self, kind: Kind) -> list[Pdo]:
        """Return its PDOs that can be used as they are."""
        synced = self.options.feedback == "sync"
        pdos = [pdo for pdo in (self.pdos or {}).values() if pdo.kind == kind]
        return [pdo for pdo in pdos if pdo.usable(self.node, OBJECTS, FILLED, synced=synced)]

    def cob_ids(self) -> dict[Key, int]:
        """Return the COB-IDs of the RPDOs in use, by their object."""
        used = self.usable("RPDO")
        return {(mapping.parameters(pdo.kind, pdo.number)[0], co.COB_ID): pdo.cob for pdo in used}

    # -- what is written to it ------------------------------------------------------------------------

    def setup(self) -> Setup:
        """Return what must be written before it is armed: heartbeats, and the PDOs that do not fit."""
        plan: list[Write] = []
        options = self.options
        if options.heartbeat_ms and not self.read.get(co.PRODUCER_HEARTBEAT):
            plan.append(Write(co.PRODUCER_HEARTBEAT, options.heartbeat_ms, optional=True))
        for pdo in self._unfitting() if options.mapping == "auto" else ():
            before = self.read.get((mapping.parameters(pdo.kind, pdo.number)[0], co.COB_ID), 0)
            plan += mapping.writes(pdo, before)
        if options.watchdog_ms:
            plan.append(Write(co.CONSUMER_HEARTBEAT, options.host_id << 16 | options.watchdog_ms))
        return Setup(OBJECTS, plan)

    def all_writes(self) -> Iterator[Write]:
        """Yield what `setup` may write to a drive, whatever it has."""
        options = self.options
        yield Write(co.PRODUCER_HEARTBEAT, options.heartbeat_ms)
        if options.watchdog_ms:
            yield Write(co.CONSUMER_HEARTBEAT, options.host_id << 16 | options.watchdog_ms)
        for pdo in self.wanted() if options.mapping == "auto" else ():
            for before in (0, NO_RTR):
                yield from mapping.writes(pdo, before)
            _, mapped = mapping.parameters(pdo.kind, pdo.number)
            for number in range(1, len(pdo.entries) + 1):  # objects that a drive lacks are left out
                yield Write((mapped, 0), number)
                yield from (Write((mapped, number), encode_entry(each)) for each in pdo.entries)

    def adopt(self, setup: Setup) -> None:
        """Record what a setup that is done has configured."""
        pdos = (self.pdos or {}) | {(pdo.kind, pdo.number): pdo for pdo in setup.pdos}
        refused = {(pdo.kind, pdo.number) for pdo in setup.refused}
        self.pdos = {key: pdo for key, pdo in pdos.items() if key not in refused}

    def _unfitting(self) -> list[Pdo]:
        """Return the PDOs that must be written."""
        options, present = self.options, self.pdos or {}
        sync = options.sync_ms * MILLISECOND if options.feedback == "sync" else 0
        families = (POSITION, VELOCITY, TORQUE)
        targets = {family.target for family in families if self.mode(family) is not None}
        commanded = {key for pdo in self.usable("RPDO") for key in pdo.keys}
        reports = self.usable("TPDO")
        # With another producer of SYNC its period is unknown here: one report in ten periods must do.
        most = 10 * max(sync, options.feedback_ms * MILLISECOND)
        periods = [pdo.period(sync or most // 10) for pdo in reports if o.POSITION in pdo.keys]
        fits: dict[Kind, bool] = {
            "RPDO": commanded >= targets | {o.CONTROLWORD},
            "TPDO": any(o.STATUSWORD in pdo.keys for pdo in reports)
            and any(period is not None and period <= most for period in periods),
        }
        wanted = [pdo for pdo in self.wanted() if not fits[pdo.kind]]
        pairs = [(pdo, present.get((pdo.kind, pdo.number))) for pdo in wanted]
        return [pdo for pdo, other in pairs if other is not None and not other.is_like(pdo)]

    def wanted(self) -> list[Pdo]:
        """Return the PDOs as this driver writes them. Cyclic set-points take effect on SYNC, those of profile
        modes at once: their handshake would be slow."""
        options = self.options
        synced = options.feedback == "sync"
        at = EVENT if not synced or options.modes == "profile" else 1
        event_ms = 0 if synced else min(options.feedback_ms, mapping.LARGEST_TIME)
        motion, slow = (1, SLOW) if synced else (EVENT, EVENT)
        rows: list[tuple[Kind, int, int, int, tuple[Key, ...]]] = [
            ("RPDO", 1, at, 0, (o.CONTROLWORD, o.MODE, o.TARGET_POSITION)),
            ("RPDO", 2, at, 0, (o.TARGET_VELOCITY, o.TARGET_TORQUE, o.TORQUE_OFFSET)),
            ("RPDO", 3, at, 0, (o.VELOCITY_OFFSET,)),
            ("TPDO", 1, motion, event_ms, (o.STATUSWORD, o.MODE_DISPLAY, o.POSITION)),
            ("TPDO", 2, motion, event_ms, (o.VELOCITY, o.TORQUE, o.ERROR_CODE)),
            ("TPDO", 3, slow, min(SLOW * event_ms, mapping.LARGEST_TIME), (o.CURRENT, o.DC_VOLTAGE)),
        ]
        pdos = []
        for kind, number, transmission, timer, keys in rows:
            entries = tuple(entry(OBJECTS, key) for key in keys if key not in self.absent)
            if entries and (kind == "RPDO" or options.feedback != "sdo"):
                cob = default_id(kind, number, self.node)
                pdos.append(Pdo(kind, number, cob, transmission, timer, entries))
        return pdos
