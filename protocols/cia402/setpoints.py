"""Commands → modes, controlwords, set-points in a drive's own units → RPDOs, and SDO downloads of the rest.

Rules. A set-point is a whole set of values: what a mode does not use is zero, except the target position,
which stays where it is. What does not fit the drive's integers is a ValueError, and is never sent. An RPDO is
sent whole: when it has the object that moves the motor, when a value in it has changed, and again every
REFRESH. An object in no RPDO is written by SDO when it changes: offsets and target, then the mode, then the
controlword, so that a drive never obeys an old set-point.

Source: CiA 402-2 "finite state automaton", "profile position mode"; package canopen 2.4.1
`profiles/p402.py` for the bits.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

from protocols.canopen import sdo
from protocols.canopen.client import Outcome
from protocols.canopen.mapping import Pdo
from protocols.canopen.objects import Key, from_bytes, title
from protocols.canopen.pdo import Packing, packing
from protocols.cia402 import objects as o
from protocols.cia402.objects import OBJECTS
from protocols.cia402.profile import CYCLIC, Control, Demand, Mode, PowerState
from protocols.cia402.state_machine import HOLDING_QUICK_STOPS
from protocols.cia402.units import Units
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Command, Hold, Nanos, Position, Torque, Velocity

Values: TypeAlias = dict[Key, int]
Layouts: TypeAlias = dict[int, tuple[tuple[Key, ...], Packing]]
"""The objects of PDOs and their packing, by identifier."""


class Family(NamedTuple):
    """The modes that can do the same."""

    target: Key
    """Their set-point."""
    cyclic: Mode
    profile: Mode


POSITION = Family(o.TARGET_POSITION, Mode.CSP, Mode.PP)
VELOCITY = Family(o.TARGET_VELOCITY, Mode.CSV, Mode.PV)
TORQUE = Family(o.TARGET_TORQUE, Mode.CST, Mode.PT)
FAMILIES: Mapping[type[Command], tuple[Family, ...]] = {
    Position: (POSITION,),
    Velocity: (VELOCITY,),
    Torque: (TORQUE,),
    Hold: (POSITION, VELOCITY),
}
"""The modes that can do a command. Hold is a position, or without a position mode standstill."""
TARGET_OF = {mode: family.target for family in (POSITION, VELOCITY, TORQUE) for mode in family[1:]}


def values_of(command: Command, mode: Mode, units: Units, rest: int) -> Values:
    """Return the set-points of a command in a mode. `rest`: the target position if the command has none.

    Feed-forwards are objects of the cyclic modes: a profile mode generates its own."""
    values, feeds = standstill(rest), mode in CYCLIC
    match command:
        case Position(_, position, velocity, torque):
            values[o.TARGET_POSITION] = units.to_position(position)
            values[o.VELOCITY_OFFSET] = units.to_velocity(velocity) if velocity and feeds else 0
            values[o.TORQUE_OFFSET] = units.to_torque(torque) if torque and feeds else 0
        case Velocity(_, velocity, torque):
            values[o.TARGET_VELOCITY] = units.to_velocity(velocity)
            values[o.TORQUE_OFFSET] = units.to_torque(torque) if torque and feeds else 0
        case Torque(_, torque):
            values[o.TARGET_TORQUE] = units.to_torque(torque)
    return values


def standstill(position: int) -> Values:
    """Return set-points that do not move a shaft at this position, in any mode."""
    return dict.fromkeys(o.TARGETS, 0) | {o.TARGET_POSITION: position}


def arming_demand(state: PowerState, quick_stop_option: int, *, prepared: bool) -> Demand | None:
    """Return the demand towards OPERATION ENABLED; None if the host can only wait.

    `prepared`: mode and set-points are in the drive, and do not move the shaft. A quick stop that holds is
    left by ENABLE OPERATION, so that a load does not drop; any other by DISABLE VOLTAGE. Faults are never
    cleared here."""
    match state:
        case PowerState.SWITCH_ON_DISABLED:
            return Demand.SHUTDOWN
        case PowerState.READY:
            return Demand.SWITCH_ON
        case PowerState.SWITCHED_ON:
            return Demand.ENABLE_OPERATION if prepared else Demand.SWITCH_ON
        case PowerState.QUICK_STOP if quick_stop_option in HOLDING_QUICK_STOPS:
            return Demand.ENABLE_OPERATION if prepared else Demand.QUICK_STOP
        case PowerState.QUICK_STOP:
            return Demand.DISABLE_VOLTAGE
    return None


@dataclass(slots=True)
class Handshake:
    """PP: bit 4 rises with a target while bit 12 is low, stays until it shows, and falls until it is gone;
    meanwhile the target stays. The newest target wins. Plain data.

    A drive may report seldom: nothing is late before it has reported a few times."""

    AGAIN = 250 * MILLISECOND
    """Time after which a target that was not acknowledged is replaced by the newest, by a new rise."""
    LOW = 50 * MILLISECOND
    """Time for which bit 4 stays low before that: enough for a write by SDO."""
    REPORTS = 3

    raised: bool = False
    given: int | None = None
    """The target given last."""
    since: Nanos = 0
    """When bit 4 rose, or since when bit 12 does not fall."""
    reports: int = 0
    """Statuswords received then."""
    blocked: bool = False
    """Another target waits until bit 12 falls."""
    low_until: Nanos = 0

    def step(self, now: Nanos, reports: int, target: int, *, acknowledged: bool) -> tuple[int, int]:
        """Return (controlword, target). `reports`: statuswords received so far."""
        late = now > self.since + self.AGAIN and reports >= self.reports + self.REPORTS
        if self.raised and not acknowledged and late:
            self.raised, self.given, self.low_until = False, None, now + self.LOW
        waits = acknowledged and not self.raised and target != self.given
        if waits and not self.blocked:
            self.since, self.reports = now, reports
        self.blocked = waits
        if self.raised:
            self.raised = not acknowledged
        elif not acknowledged and target != self.given and now >= self.low_until:
            self.raised, self.given, self.since, self.reports = True, target, now, reports
        control = Demand.ENABLE_OPERATION | Control.CHANGE_IMMEDIATELY
        control |= Control.NEW_SETPOINT if self.raised else 0
        return int(control), self.given if self.given is not None and now >= self.low_until else target

    def stuck(self, now: Nanos, reports: int, timeout: Nanos) -> bool:
        """True if bit 12 has not fallen for this time, though another target waits."""
        return self.blocked and now > self.since + timeout and reports >= self.reports + self.REPORTS


@dataclass(slots=True)
class SetpointArrival:
    """Whether set-points arrive: one that is not 0 is read back once, and must be one that was sent. Plain
    data."""

    TIME = 500 * MILLISECOND
    MOST = 200
    """Set-points that are remembered."""

    proven: set[Key] = field(default_factory=set)
    values: list[int] = field(default_factory=list)
    """Those that were sent since the first that is not 0."""
    since: Nanos = 0

    def restart(self) -> None:
        """Forget what was sent: it is disarmed."""
        self.values = []

    def sent(self, now: Nanos, target: Key, value: int) -> bool:
        """Record a set-point; return True if it is to be read back."""
        if target in self.proven or not (value or self.values):
            return False
        self.since = self.since if self.values else now
        self.values = [*self.values[-self.MOST :], value]
        return True

    def on_outcome(self, t: Nanos, outcome: Outcome) -> str:
        """Handle what was read; return why set-points do not arrive, if so. A drive need not let them be
        read."""
        key = outcome.job.key
        found = from_bytes(OBJECTS[key].type, outcome.value)
        if (outcome.abort or sdo.TIMEOUT) != sdo.TIMEOUT or (found and found in self.values):
            self.proven.add(key)
            self.values = []
        elif (
            outcome.abort is None and self.values and found not in self.values and t > self.since + self.TIME
        ):
            return f"set-points do not arrive: {title(key)} is {found}, and {self.values[-1]} was sent"
        return ""


def layouts(pdos: Iterable[Pdo]) -> Layouts:
    """Return how these PDOs are packed."""
    return {pdo.id: (pdo.keys, packing(OBJECTS, pdo.entries)) for pdo in pdos}


@dataclass(slots=True)
class Output:
    """How the set-points of one drive are sent. Plain data."""

    REFRESH = 100 * MILLISECOND
    """Period at which an unchanged RPDO is repeated, in case one was lost."""
    REWRITE = 20 * MILLISECOND
    """Period at which the target is repeated by SDO, changed or not."""
    OFFSETS = (o.VELOCITY_OFFSET, o.TORQUE_OFFSET)

    rpdos: Layouts = field(default_factory=dict)
    sent: dict[int, tuple[bytes, Nanos]] = field(default_factory=dict)
    """The data of each last, and when that was."""
    mapped: frozenset[Key] = frozenset()
    """The objects in RPDOs."""
    synchronous: bool = False
    """Set-points take effect with SYNC: one set of RPDOs for each."""
    written: Values = field(default_factory=dict)
    """The values last written by SDO, and confirmed."""
    written_at: dict[Key, Nanos] = field(default_factory=dict)
    since: Nanos = 0
    """When another mode was first to be written."""

    def configure(self, pdos: Sequence[Pdo], offsets: Values) -> None:
        """Use these RPDOs, the one with the controlword last; `offsets` are what the drive has now."""
        ordered = sorted(pdos, key=lambda pdo: (o.CONTROLWORD in pdo.keys, pdo.number))
        self.rpdos, self.sent = layouts(ordered), {}
        self.mapped = frozenset(key for pdo in pdos for key in pdo.keys)
        self.synchronous = any(pdo.synchronous for pdo in pdos)
        self.written, self.written_at = dict(offsets), {}

    def frames(self, now: Nanos, values: Values, moving: Key) -> list[CanFrame]:
        """Return the RPDOs to be sent now; `moving`: the object that moves the motor, or commands its
        state."""
        frames = []
        for id_, (keys, layout) in self.rpdos.items():
            data = layout.pack([values.get(key, 0) for key in keys])
            before, at = self.sent.get(id_, (b"", 0))
            if data != before or moving in keys or now >= at + self.REFRESH:
                self.sent[id_] = data, now
                frames.append(CanFrame(id_, data))
        return frames

    def demand(self, now: Nanos, demand: Demand, position: int, mode: int) -> list[CanFrame]:
        """Return a controlword by RPDO, with values that move nothing; none if it is in no RPDO."""
        self.overrule()
        if o.CONTROLWORD not in self.mapped:
            return []
        values = {o.TARGET_POSITION: position, o.MODE: mode, o.CONTROLWORD: int(demand)}
        return self.frames(now, values, o.CONTROLWORD)

    def overrule(self) -> None:
        """Record that the controlword is written otherwise."""
        self.written.pop(o.CONTROLWORD, None)

    def next_download(self, now: Nanos, values: Values, target: Key) -> tuple[Key, int] | None:
        """Return what is to be written by SDO next; None if everything is in RPDOs, or written already."""
        keys = [key for key in (*self.OFFSETS, target, o.MODE, o.CONTROLWORD) if key in values]
        changed = [key for key in keys if key not in self.mapped and self.written.get(key) != values[key]]
        if not changed and target not in self.mapped and now >= self.written_at.get(target, 0) + self.REWRITE:
            changed = [target]
        if o.MODE not in changed:
            self.since = now
        # In turn, for on a slow drive each may have changed again. The mode waits for what is meant for it.
        meant = set(changed) - {o.MODE, o.CONTROLWORD}
        waits = {o.CONTROLWORD: 2, o.MODE: any(self.written_at.get(key, 0) < self.since for key in meant)}
        changed.sort(key=lambda key: (waits.get(key, 0), self.written_at.get(key, 0)))
        return (changed[0], values[changed[0]]) if changed else None

    def confirm(self, now: Nanos, key: Key, value: int) -> None:
        """Record that the drive has accepted a value by SDO."""
        self.written[key], self.written_at[key] = value, now

    def repeat(self) -> None:
        """Send every RPDO again with the next set-points, changed or not."""
        self.sent.clear()

    def forget(self) -> None:
        """Send everything again: what the drive has received is not known."""
        self.written.clear()
        self.repeat()
