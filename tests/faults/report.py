"""The campaign of faults as a table: `python -m tests.faults.report .prove/faults*.jsonl`."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from tests.faults.table import FAULTS

Found = Sequence[dict[str, Any]]

HEAD = ("fault", "runs", "showed in", "noticed in", "median, s", "worst", "declared", "driven on, m", "worst",
        "touches", "hardest, m/s", "fastest / limit", "unsafe frames", "failed")  # fmt: skip


def markdown(results: Iterable[dict[str, Any]]) -> str:
    """Return the table, a row for each fault."""
    by_name: dict[str, list[dict[str, Any]]] = {fault.name: [] for fault in FAULTS}
    for each in results:
        by_name.setdefault(each["fault"], []).append(each)
    lines = [HEAD, ("---", *("---:",) * (len(HEAD) - 1))]
    lines += [_row(name, found) for name, found in by_name.items() if found]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _row(name: str, found: Found) -> tuple[str, ...]:
    times = [each["noticed"] for each in found if each["noticed"] is not None]
    ways = [each["distance"] for each in found if each["robot"].startswith("diffbot")]
    declared = next((fault.notice for fault in FAULTS if fault.name == name), None)
    numbers = (len(found), sum(each["exposed"] > 0.0 for each in found), len(times))
    shares = [f"{function(each):.2f}" if each else "" for each in (times, ways) for function in (median, max)]
    hardest, fastest = (f"{max(each[key] for each in found):.2f}" for key in ("impact", "fastest"))
    unsafe, failed = (sum(map(len, (each[key] for each in found))) for key in ("unsafe", "failed"))
    touches = sum(each["touches"] for each in found)
    return (name, *map(str, numbers), *shares[:2], "" if declared is None else f"{declared:g}", *shares[2:],
            str(touches), hardest, fastest, str(unsafe), str(failed))  # fmt: skip


def failures(results: Iterable[dict[str, Any]]) -> list[str]:
    """Return what failed, most frequent first."""
    kinds = Counter(
        f"{each['fault']}, {each['robot']}, {each['phase']}: {text}"
        for each in results
        for text in each["failed"]
    )
    return [f"{count} × {kind}" for kind, count in kinds.most_common()]


if __name__ == "__main__":
    lines = [json.loads(line) for path in sys.argv[1:] for line in Path(path).read_text().split("\n") if line]
    results = [line["result"] for line in lines if "result" in line]
    print("\n".join([markdown(results), "", *failures(results)]))
