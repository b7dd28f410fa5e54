"""Feedback of one device: which objects are polled by SDO and when, and their values in SI.

Rules. What a TPDO reports is not polled as long as it keeps coming. Every object has a polling period,
whether it is answered or not; of those that are due the one is polled that is latest in its own periods, so
that on a slow bus the motion comes first. What is received meanwhile only postpones a poll, so the plan is
made anew shortly before one is due, or when another reason to poll arises.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from protocols.cia402 import objects as o
from protocols.cia402.objects import Key, Type
from protocols.cia402.units import Units
from protocols.messages import MILLISECOND, Feedback, Nanos

NEVER: Nanos = 1 << 62
POLLED: tuple[tuple[Key, int], ...] = (
    (o.POSITION, 1),
    (o.VELOCITY, 1),
    (o.STATUSWORD, 2),
    (o.TORQUE, 5),
    (o.MODE_DISPLAY, 10),
    (o.ERROR_CODE, 20),
    (o.CURRENT, 20),
    (o.DC_VOLTAGE, 20),
)
"""The polled objects, and their polling periods in feedback periods."""
TRANSIENT = (o.STATUSWORD, o.MODE_DISPLAY)
"""Objects polled every feedback period while a change of state is expected."""
AHEAD = 5 * MILLISECOND
"""Lead time before a poll is due at which its plan is made anew."""
UNTIMED = 100 * MILLISECOND
"""Validity of an object from a TPDO whose period is not known."""
MISSED = 3
"""Periods after which a TPDO that did not come is no longer waited for."""
MARGIN = 10 * MILLISECOND


class Conditions(NamedTuple):
    """What changes a plan besides time."""

    transient: bool = False
    """A change of state is expected."""
    failed: bool = False
    """It is in fault, and the error code is not known."""
    units_known: bool = False
    """Nothing is polled before."""


@dataclass(slots=True)
class PollSchedule:
    """Which objects of a device are polled when. Plain data."""

    period: Nanos
    at: Nanos = 0
    """When the next poll is due, or later."""
    conditions: Conditions = field(default_factory=Conditions)
    """Those of the present plan."""
    reported_at: dict[Key, Nanos] = field(default_factory=dict)
    """When each object came last by TPDO."""
    validity: dict[Key, Nanos] = field(default_factory=dict)
    """How long the value of a TPDO is valid, if its period is known."""
    polled_at: dict[Key, Nanos] = field(default_factory=dict)
    """When each object was last polled."""

    def forget(self) -> None:
        """Begin anew: the device may have restarted."""
        self.reported_at.clear()
        self.validity.clear()
        self.polled_at.clear()
        self.at = 0

    def expect(self, tpdos: Iterable[tuple[Collection[Key], Nanos | None]]) -> None:
        """Expect these objects by TPDO from now on, with their period; None: unknown."""
        self.validity, self.at = {}, 0
        for keys, period in tpdos:
            if period is not None:
                valid = MISSED * period + MARGIN
                self.validity |= {key: min(valid, self.validity.get(key, valid)) for key in keys}

    def on_tpdo(self, t: Nanos, keys: Collection[Key]) -> None:
        """Note that these objects came by TPDO."""
        for key in keys:
            self.reported_at[key] = t

    def invalidate(self, key: Key) -> None:
        """Poll an object at once: its last value is not valid any more."""
        self.polled_at.pop(key, None)
        self.at = 0

    def next(self, now: Nanos, conditions: Conditions, absent: Collection[Key]) -> Key | None:
        """Return the object that is most overdue; None if none is due."""
        if now + AHEAD < self.at and conditions == self.conditions:
            return None
        self.conditions = conditions
        if not conditions.units_known:
            self.at = NEVER
            return None
        times = self._plan(absent)
        if now < self.at:
            return None
        late = [(now - at) / periods for at, (_, periods) in zip(times, POLLED, strict=True)]
        return POLLED[late.index(max(late))][0]

    def begin(self, now: Nanos, key: Key, absent: Collection[Key]) -> None:
        """Note that an object is polled now."""
        self.polled_at[key] = now
        self._plan(absent)

    def due(self, conditions: Conditions) -> Nanos:
        """Return when `next` has something to poll, or to plan."""
        return self.at if conditions == self.conditions else 0

    def _plan(self, absent: Collection[Key]) -> list[Nanos]:
        """Return when each object is due; keep the earliest time."""
        times = [NEVER if key in absent else self._due_at(key, periods) for key, periods in POLLED]
        self.at = min(times)
        return times

    def _due_at(self, key: Key, periods: int) -> Nanos:
        if key == o.ERROR_CODE and not self.conditions.failed:
            return NEVER
        if key in TRANSIENT and self.conditions.transient:
            periods = 1
        polled = self.polled_at.get(key)
        again = 0 if polled is None else polled + periods * self.period
        reported = self.reported_at.get(key)
        return again if reported is None else max(again, reported + self.validity.get(key, UNTIMED))


def feedback(motor: str, t: Nanos, values: Mapping[Key, int], units: Units) -> Feedback | None:
    """Convert these objects to Feedback in SI; None if none of them is a measurement.

    A value at the end of its type may as well be beyond it, and is no measurement."""
    position, velocity = _inside(Type.I32, values.get(o.POSITION)), _inside(Type.I32, values.get(o.VELOCITY))
    torque, current = _inside(Type.I16, values.get(o.TORQUE)), _inside(Type.I16, values.get(o.CURRENT))
    voltage = values.get(o.DC_VOLTAGE)
    torque_rated, current_rated = units.rated_torque > 0.0, units.rated_current > 0.0
    made = Feedback(
        motor,
        t,
        None if position is None else units.position(position),
        None if velocity is None or not units.velocity_per_turn else units.velocity(velocity),
        None if torque is None or not torque_rated else units.torque(torque),
        None if current is None or not current_rated else units.current(current),
        None if voltage is None else voltage / 1000.0,
    )
    measured = (made.position, made.velocity, made.torque, made.current, made.voltage)
    return made if any(value is not None for value in measured) else None


def _inside(kind: Type, value: int | None) -> int | None:
    return value if value is not None and kind.low < value < kind.high else None
