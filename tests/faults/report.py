"""The campaign of faults as a table: `python -m tests.faults.report .prove/faults*.jsonl`."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from statistics import median
from typing import Any

HEAD = ("fault", "runs", "could show", "noticed", "in s: median", "worst", "m: median", "worst", "touches",
        "hardest m/s", "fastest / limit", "unsafe frames", "failed")  # fmt: skip


def rows(results: Iterable[dict[str, Any]], names: Iterable[str]) -> list[tuple[str, ...]]:
    """Return a row for each fault, in the order of their names."""
    by_name: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for each in results:
        by_name.setdefault(each["fault"], []).append(each)
    return [_row(name, found) for name, found in by_name.items() if found]


def _row(name: str, found: list[dict[str, Any]]) -> tuple[str, ...]:
    noticed = [each["noticed"] for each in found if each["noticed"] is not None]
    ways = [each["distance"] for each in found if each["robot"].startswith("diffbot")]
    worst = f"{max(noticed):.2f}" if noticed else "-"
    return (
        name,
        f"{len(found)}",
        f"{sum(each['exposed'] > 0.0 for each in found)}",
        f"{len(noticed)}",
        f"{median(noticed):.2f}" if noticed else "-",
        worst,
        f"{median(ways):.2f}" if ways else "-",
        f"{max(ways):.2f}" if ways else "-",
        f"{sum(each['touches'] for each in found)}",
        f"{max(each['impact'] for each in found):.2f}",
        f"{max(each['fastest'] for each in found):.2f}",
        f"{sum(len(each['unsafe']) for each in found)}",
        f"{sum(bool(each['failed']) for each in found)}",
    )


def markdown(results: Iterable[dict[str, Any]], names: Iterable[str]) -> str:
    """Return the table."""
    lines = [HEAD, ("---", *("---:",) * (len(HEAD) - 1)), *rows(results, names)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def failures(results: Iterable[dict[str, Any]]) -> list[str]:
    """Return what failed, most frequent first."""
    kinds = Counter(
        f"{each['fault']}, {each['robot']}, {each['phase']}: {text}"
        for each in results
        for text in each["failed"]
    )
    return [f"{count} × {kind}" for kind, count in kinds.most_common()]


if __name__ == "__main__":
    from tests.faults.table import FAULTS

    lines = [json.loads(line) for path in sys.argv[1:] for line in Path(path).read_text().split("\n") if line]
    results = [line["result"] for line in lines if "result" in line]
    print(markdown(results, [fault.name for fault in FAULTS]))
    print("\n".join(failures(results)))
