"""The contract's verdict on a plugin, as a person reads it: a heading, the table of clauses, a sum.

Rules. Each table is printed as soon as it is known, since a contract takes seconds.
"""

from __future__ import annotations

from protocols.conformance import Result, check, table
from protocols.plugin import Plugin

OUTCOMES = ("passed", "failed", "not applicable")


def verdict(plugin: Plugin, seed: int, *, failures_only: bool = False) -> bool:
    """Print what the contract finds in a plugin; whether it keeps it."""
    heading = f"{plugin.name}: {plugin.title}"
    print(f"{heading}\n{'-' * min(len(heading), 110)}", flush=True)
    results = check(plugin, seed)
    failed = [result for result in results if result.outcome == "failed"]
    if shown := failed if failures_only else results:
        print(table(shown))
    print(f"{plugin.name}: {counted(results)} (seed {seed})\n", flush=True)
    return not failed


def counted(results: tuple[Result, ...]) -> str:
    """How many clauses passed, failed and did not apply."""
    counts = {outcome: sum(result.outcome == outcome for result in results) for outcome in OUTCOMES}
    return ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
