"""How one drive is armed and given set-points: what it should have, step by step, until it obeys.

Rules. The first set-point of a sequence is the measured position. What waits for a state waits for a number
of statuswords, too: a drive that is slow is not late.

Source: CiA 402-2 "finite state automaton", "profile position mode".
"""

from __future__ import annotations

from typing import NamedTuple

from protocols.canopen.objects import Key
from protocols.cia402 import faults, setpoints
from protocols.cia402 import objects as o
from protocols.cia402.drive_state import DriveState
from protocols.cia402.homing import Homing
from protocols.cia402.profile import Demand, Mode, PowerState, Status
from protocols.cia402.setpoints import FAMILIES, TARGET_OF, Handshake, Values
from protocols.cia402.setup import Known
from protocols.messages import Command, Hold, Nanos

PREPARED = 2
"""Set-points sent before a drive is enabled."""
PATIENCE = 5
"""Statuswords that a drive may send without progress in its time."""


class Wanted(NamedTuple):
    """What a drive should have now."""

    values: Values
    """Set-points, mode and controlword"""
    moving: Key
    """The object that moves the motor"""
    followed: bool
    """It is enabled, in the mode."""


class Steering:
    """The steering of one drive since it was last released. Plain data."""

    def __init__(self, timeout: Nanos) -> None:
        self._timeout = timeout
        """Within which it is to make progress."""
        self.restart()

    def restart(self) -> None:
        """Record that it does not follow set-points: the next one begins anew."""
        self._values: Values = {}
        """What it should have."""
        self._hold: int | None = None
        """The position where it holds."""
        self.holding = False
        """The last command was Hold."""
        self._rounds = 0
        """Set-points sent since arming began."""
        self._enabling: int | None = None
        """Statuswords received when it was last not enabled, while it is to rest where it was enabled."""
        self._handshake = Handshake()
        self.homing: Homing | None = None
        self._progress: object = None
        self._since: tuple[Nanos, int] | None = None
        """Since when arming has made no progress, and the statuswords received then."""

    @property
    def waits(self) -> bool:
        """True if a state or mode is not reached yet."""
        return self._since is not None

    def begin(self, command: Command) -> None:
        """Note what is commanded."""
        self.holding = isinstance(command, Hold)

    def on_written(self) -> None:
        """Note that a set-point was written by SDO."""
        self._rounds += 1

    def home(self, homing: Homing) -> None:
        """Begin homing."""
        self.homing = homing

    def end_homing(self) -> Homing | None:
        """Go back to holding, at the position measured from now on; return what has ended."""
        homing, self.homing = self.homing, None
        if homing is not None and homing.runs:
            self._hold, self._rounds = None, 0
        return homing

    def step(
        self, now: Nanos, command: Command, known: Known, reported: DriveState
    ) -> tuple[Wanted | None, str]:
        """Return what it should have by a command, if anything; and why arming has failed, if so."""
        units, mode = known.units, known.mode(*FAMILIES[type(command)])
        power, position = reported.power, reported.position
        if units is None or mode is None or power is None or position is None:
            return None, ""
        if not self.holding:
            self._hold = None
            self.homing = None
        elif self._hold is None:
            self._hold = position
        if self.homing is not None and self.homing.runs:
            values = self.homing.values(position, reported.mode_display, reported.reports)
            return self._wanted(values, known, o.CONTROLWORD), ""
        in_mode, enabled = reported.mode_display == mode, power is PowerState.OPERATION_ENABLED
        if enabled and self._rests(reported.reports):
            rest = self._values.get(o.TARGET_POSITION, position)
            values, control, failure = setpoints.standstill(rest), int(Demand.ENABLE_OPERATION), ""
        elif enabled:
            rest = self._values.get(o.TARGET_POSITION, position) if self._hold is None else self._hold
            values, control = setpoints.values_of(command, mode, units, rest), int(Demand.ENABLE_OPERATION)
            if mode is Mode.PP and in_mode:
                control = self._hand_over(now, values, reported)
            failure = self._note_progress(now, None if in_mode else (power, mode), reported)
        else:
            self._enabling = reported.reports
            values = setpoints.standstill(position)
            failure = self._note_progress(now, (power, in_mode), reported)
            option = known.read.get(o.QUICK_STOP_OPTION, 2)
            prepared = in_mode and self._rounds >= PREPARED
            demand = setpoints.arming_demand(power, option, prepared=prepared)
            if demand is None:
                return None, failure
            control = int(demand)
        self._rounds += 1
        values |= {o.CONTROLWORD: control, o.MODE: int(mode)}
        return self._wanted(values, known, TARGET_OF[mode], followed=enabled and in_mode), failure

    def _rests(self, reports: int) -> bool:
        """Return whether it rests where it was enabled: that has stopped its shaft, and the motion that came
        with the first statusword to show it may be older. It does until the next one."""
        if self._enabling is not None and reports > self._enabling + 1:
            self._enabling = None
        return self._enabling is not None

    def _wanted(self, values: Values, known: Known, moving: Key, *, followed: bool = False) -> Wanted:
        self._values = {key: value for key, value in values.items() if key not in known.absent}
        return Wanted(self._values, moving, followed)

    def _hand_over(self, now: Nanos, values: Values, reported: DriveState) -> int:
        """Return the controlword of PP's handshake; put its target into the values."""
        acknowledged = bool((reported.statusword or 0) & Status.BIT_12)
        target, handshake = values[o.TARGET_POSITION], self._handshake
        control, given = handshake.step(now, reported.reports, target, acknowledged=acknowledged)
        values[o.TARGET_POSITION] = given
        if handshake.stuck(now, reported.reports, self._timeout):
            reported.codes.add(faults.SETPOINT_STUCK)
        elif not handshake.blocked:
            reported.codes.discard(faults.SETPOINT_STUCK)
        return control

    def _note_progress(self, now: Nanos, progress: object, reported: DriveState) -> str:
        """Note how far arming is (None: done); without progress in its time return why it has failed."""
        if progress is None or self._since is None or self._progress != progress:
            self._progress, self._since = progress, None if progress is None else (now, reported.reports)
            return ""
        since, reports = self._since
        late = now - since >= self._timeout and reported.reports >= reports + PATIENCE
        if not late and now - since < 10 * self._timeout:
            return ""
        self.restart()
        return f"it stayed in {reported.in_words()}"
