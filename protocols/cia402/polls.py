"""Which objects of a drive are polled by SDO and when, and what they measure in SI.

Rules. What a TPDO reports is not polled as long as it keeps coming. Every object has a polling period,
whether it is answered or not; of those that are due the one is polled that is latest in its own periods, so
that on a slow bus the motion comes first. While a change of state is expected, only state and position are.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

from protocols.canopen.client import NEVER
from protocols.canopen.mapping import Pdo
from protocols.canopen.objects import Key, Type
from protocols.cia402 import objects as o
from protocols.cia402.units import Units
from protocols.messages import MILLISECOND, Feedback, Nanos

POLLED: Mapping[Key, int] = {
    o.POSITION: 1,
    o.VELOCITY: 1,
    o.STATUSWORD: 2,
    o.TORQUE: 5,
    o.MODE_DISPLAY: 10,
    o.CURRENT: 20,
    o.DC_VOLTAGE: 20,
}
"""The polled objects, and their polling periods in feedback periods."""
HURRIED: Mapping[Key, int] = {o.STATUSWORD: 1, o.MODE_DISPLAY: 1, o.POSITION: 1}
"""The same while a change of state is expected."""
UNTIMED = 100 * MILLISECOND
"""Validity of an object from a TPDO whose period is not known."""
MISSED = 3
"""Periods after which a TPDO that did not come is no longer waited for."""
MARGIN = 10 * MILLISECOND


@dataclass(slots=True)
class Polls:
    """Which objects of one drive are polled when. Plain data."""

    period: Nanos
    due: Nanos = 0
    """When `next` has something to poll, or to plan."""
    _hurried: bool = False
    _polled: dict[Key, Nanos] = field(default_factory=dict)
    """When each object was last polled."""
    _fresh: dict[Key, Nanos] = field(default_factory=dict)
    """Until when what came by TPDO is valid."""
    _validity: dict[Key, Nanos] = field(default_factory=dict)
    """How long the value of a TPDO is, if its period is known."""

    def forget(self) -> None:
        """Begin anew: the drive may have restarted."""
        self._polled, self._fresh, self._validity, self.due = {}, {}, {}, 0

    def expect(self, tpdos: Iterable[Pdo], sync: Nanos) -> None:
        """Expect these TPDOs from now on; `sync`: the period of SYNC, 0: not known."""
        self._validity, self.due = {}, 0
        for pdo in tpdos:
            period = pdo.period(sync)
            if period is not None:
                valid = MISSED * period + MARGIN
                self._validity |= {key: min(valid, self._validity.get(key, valid)) for key in pdo.keys}

    def on_tpdo(self, t: Nanos, keys: Collection[Key]) -> None:
        """Record that these objects came by TPDO."""
        for key in keys:
            self._fresh[key] = t + self._validity.get(key, UNTIMED)

    def invalidate(self, key: Key) -> None:
        """Poll an object at once: its last value is not valid any more."""
        self._polled.pop(key, None)
        self.due = 0

    def next(self, now: Nanos, absent: Collection[Key], *, hurried: bool, failed: bool) -> Key | None:
        """Return the object that is polled now; None if none is due. `hurried`: a change of state is
        expected; `failed`: it is in fault, and the error code is not known."""
        self.due = self.due if hurried is self._hurried else 0
        self._hurried = hurried
        if now < self.due:
            return None
        rows = {**(HURRIED if hurried else POLLED), **({o.ERROR_CODE: 1} if failed else {})}
        times = {key: self._due_at(key, rows[key]) for key in rows if key not in absent}
        self.due = min(times.values(), default=NEVER)
        if now < self.due:
            return None
        key = max(times, key=lambda key: (now - times[key]) / rows[key])
        self._polled[key], self.due = now, 0
        return key

    def _due_at(self, key: Key, periods: int) -> Nanos:
        again = self._polled[key] + periods * self.period if key in self._polled else 0
        return max(again, self._fresh.get(key, 0))

    def hasten(self) -> None:
        """Plan anew: the state has changed."""
        self.due = 0


def feedback(motor: str, t: Nanos, values: Mapping[Key, int], units: Units) -> Feedback | None:
    """Convert these objects to Feedback in SI; None if none of them is a measurement.

    A value at the end of its type may as well be beyond it, and is no measurement."""
    position, velocity = values.get(o.POSITION), values.get(o.VELOCITY)
    torque, current = values.get(o.TORQUE), values.get(o.CURRENT)
    measured: dict[str, float] = {}
    if position is not None and I32.low < position < I32.high:
        measured["position"] = units.position(position)
    if velocity is not None and units.velocity_per_turn and I32.low < velocity < I32.high:
        measured["velocity"] = units.velocity(velocity)
    if torque is not None and units.rated_torque and I16.low < torque < I16.high:
        measured["torque"] = units.torque(torque)
    if current is not None and units.rated_current and I16.low < current < I16.high:
        measured["current"] = units.current(current)
    if o.DC_VOLTAGE in values:
        measured["voltage"] = values[o.DC_VOLTAGE] / 1000.0
    return Feedback(motor, t, **measured) if measured else None


I16, I32 = Type.I16, Type.I32
