"""Whether the stamps of a bag can be those of one clock: their resolution, order, spans and rates.

Rules. Pure functions of times [s], in the order of writing → sentences. Only stamps are times of measurement;
when a message was logged serves to find what was measured at the same time, and need not be true time: a bag
may have been converted, or played slowly. So each topic is compared with the odometry as both were logged.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from brain.belief import Floats

LATE = 3
"""Messages in a row that are older than one before them, and more than overtake each other."""
LATE_SHARE = 0.2
"""Share of all messages that may be older by that many periods."""
OFFSET = 1.0
"""s by which a topic may be later than the odometry, or earlier: the slowest receivers take as long."""
WANDER = 0.2
"""s by which that may change within the bag, and"""
JITTERS = 6.0
"""times the spread of single messages about it."""
PARTS = 10
"""The change is taken between this many parts of a bag,"""
PART = 3
"""each with this many messages at least."""


class Stamps(NamedTuple):
    """The times of one topic's messages [s], in the order of writing."""

    logged: Floats
    stamps: Floats


def resolution(stamps: Floats) -> list[str]:
    """Return what stamps coarser than two periods hide: they repeat each other."""
    distinct = np.unique(stamps)
    if len(stamps) < 2 * PARTS or 2 * len(distinct) >= len(stamps):
        return []
    apart = f", {np.median(np.diff(distinct)):.2g} s apart" if len(distinct) > 1 else ""
    return [
        f"{len(stamps)} messages have only {len(distinct)} stamps{apart}: when each was measured is not known"
    ]


def order(stamps: Floats) -> list[str]:
    """Return where time goes back, by more than messages overtake each other."""
    newest = np.maximum.accumulate(stamps)
    late = stamps[1:] < newest[:-1]
    edges = np.flatnonzero(np.diff(np.concatenate(([0], late, [0]))))
    jumps = [begin for begin, end in zip(edges[::2], edges[1::2], strict=True) if _again(stamps, begin, end)]
    if jumps:
        back = newest[jumps[0]] - stamps[jumps[0] + 1]
        more = f", and {len(jumps) - 1} more times" if len(jumps) > 1 else ""
        return [f"its stamps jump back by {back:.3g} s after {stamps[jumps[0]] - stamps[0]:.1f} s{more}"]
    distinct = np.unique(stamps)
    if len(distinct) < 2 * PARTS:
        return []
    older = int((newest[:-1] - stamps[1:] > LATE * np.median(np.diff(distinct))).sum())
    if older > LATE_SHARE * len(stamps):
        return [f"{older} of {len(stamps)} stamps are older than those before: there are two clocks on it"]
    return []


def _again(stamps: Floats, begin: int, end: int) -> bool:
    """True if messages that are older than one before them tell of a time that was told of already; what was
    only held up fills a gap."""
    late, before = stamps[begin + 1 : end + 1], stamps[: begin + 1]
    told = ((before >= late.min()) & (before <= late.max())).sum()
    return len(late) >= LATE and bool(2 * told >= len(late))


def steps(one: Stamps) -> list[str]:
    """Return where stamps leap ahead of the log, and stay so: a clock was set, and nothing is missing."""
    gaps = np.diff(one.stamps)
    ahead = one.stamps - one.logged
    if len(gaps) < 2 * PARTS:
        return []
    at = int(np.argmax(np.diff(ahead)))
    before, after = ahead[max(0, at + 1 - PARTS) : at + 1], ahead[at + 1 : at + 1 + PARTS]
    leap = float(np.median(after) - np.median(before))
    if min(len(before), len(after)) < PART or not OFFSET < leap <= 1.5 * gaps[at]:
        return []
    regular = np.abs(np.diff(ahead)) < WANDER  # else the log has another time than the stamps
    if regular.mean() < 1.0 - LATE_SHARE:
        return []
    return [
        f"its stamps leap by {leap:.3g} s after {one.stamps[at] - one.stamps[0]:.1f} s, with none missing"
    ]


def clock(one: Stamps, odometry: Stamps) -> list[str]:
    """Return how a topic's stamps differ from those of the odometry that were logged with them."""
    first, last = one.stamps.min(), one.stamps.max()
    begin, end = odometry.stamps.min(), odometry.stamps.max()
    if len(one.stamps) >= PART and len(odometry.stamps) >= PART and (first > end or last < begin):
        away = first - end if first > end else last - begin
        return [f"another clock than the odometry's: all its stamps are {_ahead(away)}"]
    inside = (one.logged >= odometry.logged.min()) & (one.logged <= odometry.logged.max())
    if inside.sum() < PART:
        return []
    ahead = one.stamps[inside] - np.interp(one.logged[inside], odometry.logged, odometry.stamps)
    middle = float(np.median(ahead))
    if abs(middle) > OFFSET:
        return [f"another clock than the odometry's: {_ahead(middle)}"]
    parts = [part for part in np.array_split(ahead, PARTS) if len(part) >= PART]
    if len(parts) < PARTS:
        return []
    middles = np.array([np.median(part) for part in parts])
    jitter = float(np.median([np.median(np.abs(part - np.median(part))) for part in parts]))
    if float(np.ptp(middles)) <= WANDER + JITTERS * jitter:
        return []
    lowest, highest = float(middles.min()), float(middles.max())
    return [f"another clock than the odometry's: from {_ahead(lowest)} to {_ahead(highest)} within the bag"]


def _ahead(time: float) -> str:
    return f"{abs(time):.3g} s {'ahead of' if time > 0.0 else 'behind'} it"
