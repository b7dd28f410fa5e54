"""The bench's table: a row is something of ours, and beside it what it is measured against.

Rules. A ratio is always "theirs by ours": above 1, ours is the quicker or smaller one, whatever is compared;
beside a span of time (a tick, real time) it is how many times ours fits into it. What could not be measured
stands in its row, by name and with the reason. Targets are the project's own; whether one is met is reported,
never raised.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.measure import Figures, Rival

FORMAT = 1
"""Of the JSON document."""


@dataclass(frozen=True, slots=True)
class Beside:
    """What ours is compared with."""

    what: str
    figures: Figures | None
    """None: it was not run."""
    not_run: str = ""
    """Why not."""


@dataclass(frozen=True, slots=True)
class Target:
    """What the project wants of a row: an upper limit, or a least ratio to the first thing beside it."""

    at_most: float | None = None
    """In the unit of the row's figures, for the median."""
    ratio: float | None = None

    def __str__(self) -> str:
        return f"at least {self.ratio:g}" if self.ratio is not None else ""


@dataclass(frozen=True, slots=True)
class Row:
    """One thing that was measured. Either `ours` is there or `not_run` has the reason."""

    group: str
    what: str
    ours: Figures | None
    beside: tuple[Beside, ...] = ()
    target: Target | None = None
    not_run: str = ""

    def ratio(self, other: Beside) -> float | None:
        """Theirs by ours; None if one of them was not run."""
        if self.ours is None or other.figures is None:
            return None
        return other.figures.median / self.ours.median

    def met(self) -> bool | None:
        """Whether the target is met; None if there is none, or nothing to judge it by."""
        if self.target is None or self.ours is None:
            return None
        if self.target.at_most is not None:
            return self.ours.median <= self.target.at_most
        ratio = self.ratio(self.beside[0]) if self.beside else None
        return None if ratio is None or self.target.ratio is None else ratio >= self.target.ratio


def against(found: Mapping[str, Figures], *names: str, missing: Sequence[Rival] = ()) -> tuple[Beside, ...]:
    """What was measured under these names, and the rivals that are not there."""
    there = [Beside(name, found[name]) for name in names if name in found]
    return (*there, *(Beside(rival.name, None, rival.why_not) for rival in missing if rival.why_not))


def span(what: str, nanos: float) -> Beside:
    """A span of time that ours should fit into."""
    return Beside(what, Figures(nanos, nanos, 1))


# -- for a person ---------------------------------------------------------------------------------

_HEAD = ("ratio", "", "median", "p99", "beside", "its median", "its p99", "target")
_RIGHT = {0, 2, 3, 5, 6}


def text(rows: Sequence[Row]) -> str:
    """The table: one line for each thing that something of ours stands beside, ratios first."""
    lines: list[tuple[str, ...]] = []
    for group in dict.fromkeys(row.group for row in rows):
        lines.append((group,))
        for row in rows:
            if row.group == group:
                lines += _lines(row)
    widths = [
        max(len(_HEAD[i]), *(len(line[i]) for line in lines if len(line) > 1)) for i in range(len(_HEAD))
    ]
    return "\n".join([_joined(_HEAD, widths), *(_joined(line, widths) for line in lines)])


def _lines(row: Row) -> list[tuple[str, ...]]:
    if row.ours is None:
        return [("-", row.what, "not run", "", row.not_run, "", "", _target(row))]
    made: list[tuple[str, ...]] = []
    for number, other in enumerate(row.beside or (None,)):
        ours = (
            (row.what, shown(row.ours.median, row.ours), shown(row.ours.p99, row.ours))
            if not number
            else ("",) * 3
        )
        target = _target(row) if not number else ""
        if other is None:
            made.append(("", *ours, "", "", "", target))
        elif other.figures is None:
            made.append(("-", *ours, other.what, "not run", "", target or other.not_run))
        else:
            theirs = (shown(other.figures.median, other.figures), shown(other.figures.p99, other.figures))
            made.append((f"{row.ratio(other):.3g}", *ours, other.what, *theirs, target))
    return made


def _target(row: Row) -> str:
    if row.target is None:
        return ""
    verdict = {True: ": met", False: ": MISSED", None: ""}[row.met()]
    if row.target.at_most is not None:
        unit = row.ours or Figures(0.0, 0.0, 0)
        return f"at most {shown(row.target.at_most, unit)}{verdict}"
    return f"ratio at least {row.target.ratio:g}{verdict}"


def _joined(line: tuple[str, ...], widths: Sequence[int]) -> str:
    if len(line) == 1:
        return f"\n{line[0]}"
    cells = [
        cell.rjust(width) if i in _RIGHT else cell.ljust(width)
        for i, (cell, width) in enumerate(zip(line, widths, strict=True))
    ]
    return "  ".join(cells).rstrip()


def shown(value: float, unit: Figures) -> str:
    """A figure with its unit, to three digits."""
    if unit.unit == "B":
        return f"{value / 1e6:.0f} MB"
    for size, name in ((1e9, "s"), (1e6, "ms"), (1e3, "µs")):
        if value >= size:
            return f"{_three(value / size)} {name}"
    return f"{value:.0f} ns"


def _three(value: float) -> str:
    return f"{value:.2f}" if value < 10.0 else f"{value:.1f}" if value < 100.0 else f"{value:.0f}"


# -- for a program --------------------------------------------------------------------------------


def document(rows: Sequence[Row], machine: Mapping[str, str], *, quick: bool) -> dict[str, Any]:
    """All of it as JSON has it. Times in ns, memory in bytes; a ratio is theirs by ours."""
    return {
        "format": FORMAT,
        "quick": quick,
        "machine": dict(machine),
        "rows": [_row(row) for row in rows],
    }


def _row(row: Row) -> dict[str, Any]:
    return {
        "group": row.group,
        "what": row.what,
        "ours": None if row.ours is None else asdict(row.ours),
        "not_run": row.not_run,
        "beside": [
            {
                "what": other.what,
                "ratio": row.ratio(other),
                "theirs": None if other.figures is None else asdict(other.figures),
                "not_run": other.not_run,
            }
            for other in row.beside
        ],
        "target": None if row.target is None else {**asdict(row.target), "met": row.met()},
    }
