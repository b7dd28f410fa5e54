"""Feedback of one device: what is asked for by SDO and when, and what its objects amount to in SI.

Rules. What a TPDO tells is not asked for as long as it keeps coming. Every question has a period, whether it
is answered or not; of those that are due the one goes that is latest in its own periods, so that on a slow
line the motion comes first. What is heard meanwhile only puts a question off, so the plan is made anew
shortly before one is due, or when another reason to ask comes up.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from protocols.cia402 import objects as o
from protocols.cia402.objects import Key
from protocols.cia402.units import Units
from protocols.messages import MILLISECOND, Feedback, Nanos

NEVER: Nanos = 1 << 62
ASKED: tuple[tuple[Key, int], ...] = (
    (o.POSITION, 1),
    (o.VELOCITY, 1),
    (o.STATUSWORD, 2),
    (o.TORQUE, 5),
    (o.MODE_DISPLAY, 10),
    (o.ERROR_CODE, 20),
    (o.CURRENT, 20),
    (o.DC_VOLTAGE, 20),
)
"""What is asked for, and how many feedback periods lie between."""
CHANGING = (o.STATUSWORD, o.MODE_DISPLAY)
"""What is asked for more often while it is to change."""
AHEAD = 5 * MILLISECOND
"""So long before a question is due its plan is made anew."""
UNTIMED = 100 * MILLISECOND
"""What an object is worth that came by a TPDO whose period is not known."""
MISSED = 3
"""A TPDO that did not come for so many of its periods is no longer waited for."""
SPARE = 10 * MILLISECOND


class Reasons(NamedTuple):
    """What changes a plan besides time."""

    changing: bool = False
    """Its state is to change."""
    failed: bool = False
    """It is in fault, and has not told why."""
    counted: bool = False
    """Its units are known: before that nothing is asked."""


@dataclass(slots=True)
class Polls:
    """What of a device's feedback is asked for. Plain data."""

    period: Nanos
    at: Nanos = 0
    """When the next question is due, or later."""
    reasons: Reasons = field(default_factory=Reasons)
    """What that was planned with."""
    fresh: dict[Key, Nanos] = field(default_factory=dict)
    """When each object came by itself last."""
    worth: dict[Key, Nanos] = field(default_factory=dict)
    """For how long what a TPDO told of an object is good, where its period is known."""
    asked: dict[Key, Nanos] = field(default_factory=dict)
    """When each object was last asked for."""

    def forget(self) -> None:
        """It may have restarted."""
        self.fresh.clear()
        self.worth.clear()
        self.asked.clear()
        self.at = 0

    def expect(self, coming: Iterable[tuple[Collection[Key], Nanos | None]]) -> None:
        """These objects come by themselves from now on, and how often; None: nobody knows."""
        self.worth, self.at = {}, 0
        for keys, period in coming:
            if period is not None:
                good = MISSED * period + SPARE
                self.worth |= {key: min(good, self.worth.get(key, good)) for key in keys}

    def came(self, t: Nanos, keys: Collection[Key]) -> None:
        """These came by themselves."""
        for key in keys:
            self.fresh[key] = t

    def again(self, key: Key) -> None:
        """What was told of an object is not true any more."""
        self.asked.pop(key, None)
        self.at = 0

    def next(self, now: Nanos, reasons: Reasons, absent: Collection[Key]) -> Key | None:
        """What is most overdue; None if nothing is due."""
        if now + AHEAD < self.at and reasons == self.reasons:
            return None
        self.reasons = reasons
        if not reasons.counted:
            self.at = NEVER
            return None
        times = self._plan(absent)
        if now < self.at:
            return None
        late = [(now - at) / periods for at, (_, periods) in zip(times, ASKED, strict=True)]
        return ASKED[late.index(max(late))][0]

    def begin(self, now: Nanos, key: Key, absent: Collection[Key]) -> None:
        """It is asked for now."""
        self.asked[key] = now
        self._plan(absent)

    def due(self, reasons: Reasons) -> Nanos:
        """When `next` next has something, or another plan to make."""
        return self.at if reasons == self.reasons else 0

    def _plan(self, absent: Collection[Key]) -> list[Nanos]:
        """When each question is due; the earliest is kept."""
        times = [NEVER if key in absent else self._at(key, periods) for key, periods in ASKED]
        self.at = min(times)
        return times

    def _at(self, key: Key, periods: int) -> Nanos:
        """When an object is next to be asked for."""
        if key == o.ERROR_CODE and not self.reasons.failed:
            return NEVER
        if key in CHANGING and self.reasons.changing:
            periods = 1
        asked = self.asked.get(key)
        again = 0 if asked is None else asked + periods * self.period
        fresh = self.fresh.get(key)
        return again if fresh is None else max(again, fresh + self.worth.get(key, UNTIMED))


def feedback(motor: str, t: Nanos, values: Mapping[Key, int], units: Units) -> Feedback | None:
    """What these objects say of the motion, in SI; None if nothing."""
    get = values.get
    position, velocity, torque = get(o.POSITION), get(o.VELOCITY), get(o.TORQUE)
    current, voltage = get(o.CURRENT), get(o.DC_VOLTAGE)
    rated, amperes = units.rated_torque > 0.0, units.rated_current > 0.0
    made = Feedback(
        motor,
        t,
        None if position is None else units.position(position),
        None if velocity is None else units.velocity(velocity),
        None if torque is None or not rated else units.torque(torque),
        None if current is None or not amperes else units.current(current),
        None if voltage is None else voltage / 1000.0,
    )
    measured = (made.position, made.velocity, made.torque, made.current, made.voltage)
    return made if any(value is not None for value in measured) else None
