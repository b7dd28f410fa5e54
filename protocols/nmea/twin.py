"""The device's end: a receiver's firmware, which sends where the world says that it is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from protocols.frames import Frame
from protocols.messages import SECOND, Event, Fix, Nanos, Obeyed, Torque
from protocols.nmea import table
from protocols.plugin import Device

SIGMAS = {4: 0.02, 5: 0.4, 2: 1.0, 1: 2.5}
"""m with an HDOP of 1, by quality: the first is told that a fix is good enough for"""
BEST_HDOP, WORST_HDOP = 0.5, 99.99


class NmeaDecoder:
    """What receivers obey: nothing that is known here."""

    def __init__(self, devices: Sequence[Device]) -> None:
        pass

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return nothing."""
        return ()


class NmeaTwin:
    """One receiver."""

    def __init__(self, device: Device, seed: int) -> None:
        self.device = device
        self._last: Fix | None = None

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Ignore it."""

    def due(self) -> Nanos | None:
        """Return None: it sends when it has a fix."""
        return None

    def provoke(self, code: int) -> None:
        """Raise ValueError: it reports no fault."""
        raise ValueError(f"no fault {code}: it has none")

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Send the sentences of each fix of the world."""
        frames: list[Frame] = []
        for event in truth:
            if isinstance(event, Fix) and event.sensor == self.device.name and _is_on_earth(event):
                frames += map(table.encode, self._sentences(event))
        return (), frames

    def _sentences(self, fix: Fix) -> Iterator[str]:
        settings = self.device.settings
        talker, decimals = settings.talker, settings.decimals
        at = table.clock(fix.t)
        where = table.place(fix.latitude, 2, "NS", decimals), table.place(fix.longitude, 3, "EW", decimals)
        quality, hdop = _quality(fix.variance)
        above = "" if fix.altitude is None else f"{fix.altitude:.3f}"
        place = ",".join(where)
        yield (f"{talker}GGA,{at},{place},{quality},{settings.satellites:02d},{hdop:.2f},{above},M,0.0,M,,")
        knots, course = self._motion(fix)
        yield f"{talker}RMC,{at},A,{place},{knots:.3f},{course:.2f},010126,,,A"
        yield f"{talker}VTG,{course:.2f},T,,M,{knots:.3f},N,{knots * 1.852:.3f},K,A"

    def _motion(self, fix: Fix) -> tuple[float, float]:
        """Return knots, and degrees from north, since the fix before."""
        last, self._last = self._last, fix
        if last is None or fix.t <= last.t:
            return 0.0, 0.0
        north = math.radians(fix.latitude - last.latitude) * 6.371e6
        east = math.radians(fix.longitude - last.longitude) * 6.371e6 * math.cos(math.radians(fix.latitude))
        knots = math.hypot(north, east) / ((fix.t - last.t) / SECOND) / table.KNOT
        return min(knots, 999.0), math.degrees(math.atan2(east, north)) % 360.0


def _is_on_earth(fix: Fix) -> bool:
    """False for numbers that no sentence has, such as what is not finite."""
    height = fix.altitude is None or abs(fix.altitude) < 1e6
    return abs(fix.latitude) <= 90.0 and abs(fix.longitude) <= 180.0 and height


def _quality(variance: float | None) -> tuple[int, float]:
    """Return the quality and HDOP that tell a variance; without one, the best."""
    if variance is None or not 0.0 <= variance < 1e12:
        return 4, 1.0
    sigma = math.sqrt(variance)
    quality = next((each for each, best in SIGMAS.items() if sigma <= 2.0 * best), 1)
    return quality, max(BEST_HDOP, min(WORST_HDOP, sigma / SIGMAS[quality]))
