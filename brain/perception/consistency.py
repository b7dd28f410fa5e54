"""Whether the estimate may be trusted: a verdict, with its reason, for health and planning.

Rules. A scan is no witness against the believed pose because most of it is hidden: what appears before a wall
denies free ground, but no ray passes through the wall. It disagrees if little of it lies on what the scans
before saw, and rays pass through walls besides, or hardly any of it; or if it fits elsewhere than the
covariance, and slipping wheels, allow. Disagreeing for `LOST_AFTER` the robot is lost: it was moved, or
believes a wrong pose; before that comes a doubt. Being lost ends by relocalisation, or when scans in a row
fit near the believed pose; or when it has driven on to ground that the map does not have, and scans there
agree with one another: the map goes on, and the place in it is doubtful until a loop ties both. Besides,
innovations that are larger than believed, over a window, make the filter too sure (Bar-Shalom, Li,
Kirubarajan 2001, section 5.4).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

from brain.perception.filter_inputs import WINDOW, Nis
from brain.perception.match import MatchShares
from protocols.messages import MILLISECOND, Nanos


class Trust(IntEnum):
    """How far the estimate may be trusted, from fully to not at all."""

    CONSISTENT = 0
    TOO_SURE = 1
    """Innovations are larger than the covariance allows: drive slowly."""
    DOUBTFUL = 2
    """The newest scans disagree with the map at the believed pose: drive slowly."""
    LOST = 3
    """Stand: the pose is wrong."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Trust, and why not more, in words."""

    trust: Trust = Trust.CONSISTENT
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Agreement:
    """One scan against the map."""

    t: Nanos
    seen: MatchShares | None
    """Compared with the map at the matched pose, else at the believed one; None: it did not matter"""
    matched: bool
    near: bool = True
    """The matched pose is as near to the believed one as its covariance allows, and what wheels may slip"""
    offset: float = 0.0
    """m, from the believed to the matched pose"""
    turn: float = 0.0
    """rad"""
    share: float | None = None
    """Of its surfaces on the keyframes; None without any"""
    dropped: bool = False
    """That is much less than at the scan before, which was taken nearby"""

    @property
    def disagrees(self) -> str:
        """Why the scan speaks against the believed pose; "" if it does not."""
        if self.matched and not self.near:
            return f"it fits {self.offset:.2f} m and {math.degrees(self.turn):.0f}° off the believed pose"
        seen = self.seen
        if self.share is not None and self.share < LITTLE and not (seen is not None and _agrees(seen)):
            return f"{100 * self.share:.0f} % of it lies on what the scans before saw"
        if seen is None or (self.share is not None and self.share > POOR and not self.dropped):
            return ""
        if seen.crossed > CROSSED or (seen.crossed > FEW_CROSSED and seen.fit < LITTLE_FIT):
            return f"{100 * seen.crossed:.0f} % of its rays pass through walls of the map"
        if not self.matched and seen.known > LEAST_KNOWN and seen.denied > DENIED:
            return f"{100 * seen.denied:.0f} % of it lies where the map is free"
        return ""

    @property
    def poor(self) -> bool:
        """Whether it shows too little of what is known to be drawn."""
        return self.share is not None and self.share < POOR


def _agrees(seen: MatchShares) -> bool:
    """Return whether the map knows the place, although the newest scans have not seen it."""
    return seen.known > LEAST_KNOWN and seen.fit > LITTLE_FIT and seen.crossed < CROSSED


LITTLE, POOR, CERTAIN = 0.3, 0.45, 0.7
"""Share of a scan on the keyframes, below which it is at another place; below which it is not drawn, and
the map may speak against it; and from which on it is at this place"""
LEAST_KNOWN = 0.3
"""Of a scan with a smaller share of its hits on known ground nothing is concluded."""
CROSSED, DENIED = 0.15, 0.7
"""Shares of hits, from which on the pose is doubtful;"""
FEW_CROSSED, LITTLE_FIT = 0.05, 0.6
"""and from where on and below which together"""
MOST_FIT, RECOGNISED_SCANS = 0.85, 5
"""Least share that fits of a scan that shows where the robot is, and how many in a row end being lost"""
LOST_AFTER: Nanos = 300 * MILLISECOND
LEAST_SCANS = 3
"""Disagreeing for this time, in at least so many scans, the robot is lost."""
UNSEEN = 0.05
"""m: a pose that may be so far off since a scan last showed the place is doubtful: as far as a goal may be
missed"""
SURE = 3.0
"""NIS per degree of freedom over a window, beyond which the filter is too sure, and"""
HONEST = 2.0
"""below which it is not any more."""
OUTLIER = 12.0
"""NIS per degree of freedom, as which a larger one counts: one scan is no trend."""


class Consistency:
    """Follows the agreement of scans with the map, by lidar, and the innovations. State is plain data."""

    def __init__(self) -> None:
        self.lost = ""
        """Why the robot is lost; "" if it is not."""
        self.adrift = ""
        """Why the place in the map is doubtful although the scans agree; "" if it is not."""
        self._since: dict[str, tuple[Nanos, int]] = {}
        """By lidar: since when its scans disagree, and how many."""
        self._doubt: dict[str, str] = {}
        self._recognised = 0
        """Scans in a row that fit near the believed pose, while lost"""
        self._too_sure: dict[str, float] = {}

    def on_scan(self, name: str, one: Agreement) -> None:
        """Add a scan of this lidar."""
        why = one.disagrees
        if not why:
            self._since.pop(name, None)
            self._doubt.pop(name, None)
            return
        since, count = self._since.get(name, (one.t, 0))
        self._since[name] = since, count + 1
        self._doubt[name] = f"{name}: {why}"
        if count + 1 >= LEAST_SCANS and one.t - since >= LOST_AFTER and not self.lost:
            self.lost = f"lost: {name}: {why}"

    def on_covered(self, name: str, off: float) -> None:
        """Add a scan of this lidar that shows no place; `off`: m, standard deviation by which the base may
        have moved otherwise than was believed since the last one that did."""
        if off > UNSEEN:
            self._doubt[name] = f"{name}: covered, and the pose may be {off:.2f} m off meanwhile"

    @property
    def doubtful(self) -> bool:
        """True while scans disagree, or the robot is lost."""
        return bool(self._doubt or self.lost)

    def recognised(self, one: Agreement) -> bool:
        """Return whether a scan, matched near the believed pose, ends being lost."""
        fits = one.near and one.share is not None and one.share > CERTAIN
        if one.seen is not None:
            fits = fits or (one.seen.fit > MOST_FIT and one.seen.crossed < CROSSED)
        fits = fits and bool(self.lost)
        self._recognised = self._recognised + 1 if fits else 0
        return self._recognised >= RECOGNISED_SCANS

    def found(self, adrift: str = "") -> None:
        """End being lost; `adrift`: why the place in the map is doubtful all the same."""
        self.lost, self.adrift = "", adrift
        self._recognised = 0
        self._since.clear()
        self._doubt.clear()
        self._too_sure.clear()

    def lose(self, why: str) -> None:
        """Begin being lost."""
        self.lost = why

    def tied(self) -> None:
        """A loop ties where it is to the map of before."""
        self.adrift = ""

    def verdict(self, nis: Mapping[str, Nis]) -> Verdict:
        """Return the verdict now; `nis`: of the references outside the robot, by name."""
        if self.lost:
            return Verdict(Trust.LOST, self.lost)
        if self._doubt:
            return Verdict(Trust.DOUBTFUL, next(iter(self._doubt.values())))
        if self.adrift:
            return Verdict(Trust.DOUBTFUL, self.adrift)
        for name, one in nis.items():
            limit = HONEST if name in self._too_sure else SURE
            ratio = one.recent(OUTLIER) if len(one.window) == WINDOW else 0.0
            if ratio > limit:
                self._too_sure[name] = ratio
            else:
                self._too_sure.pop(name, None)
        for name, ratio in self._too_sure.items():
            reason = f"too sure: the innovations of {name} are {ratio:.1f} times what is believed"
            return Verdict(Trust.TOO_SURE, reason)
        return Verdict()
