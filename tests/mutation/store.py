"""What is kept: the progress of a campaign, the stored result of a language, and how far it may be below 90
%.

Rules. Progress stands in `.prove/mutation-NAME.jsonl`, a line for each verdict, under the mutant's identity
and the judge's digest: an unchanged function needs no new run before an unchanged judge, and before a changed
one it begins with what killed it last. The result stands in fixtures/mutation/NAME.json, a line for each
survivor; a judgement that a person wrote there is kept as long as the survivor's difference is the same.
floors.json beside it names the languages that are below `DEMANDED`, and what they must not fall below.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.mutation.mutants import Mutant
from tests.mutation.runner import Verdict

ROOT = Path(__file__).resolve().parent.parent.parent
PROGRESS = ROOT / ".prove"
RESULTS = ROOT / "fixtures" / "mutation"
FLOORS = RESULTS / "floors.json"
DEMANDED = 0.9
UNJUDGED = "unjudged"
KINDS = ("equivalent: ", "missed: ")
"""How a judgement begins: the mutant does the same as the original, or the contract has a hole."""


@dataclass(slots=True)
class Progress:
    """Verdicts that were found before, on this machine."""

    path: Path
    judge: str
    killers: dict[str, str] = field(default_factory=dict)
    """By identity: what killed it, before this judge or another."""
    done: dict[str, tuple[str, str, float]] = field(default_factory=dict)
    """By identity, before this judge: killer, text, seconds."""

    def __post_init__(self) -> None:
        for line in _lines(self.path):
            if line["killer"]:
                self.killers[line["mutant"]] = line["killer"]
            if line["judge"] == self.judge:
                self.done[line["mutant"]] = (line["killer"], line["text"], line["seconds"])

    def before(self, mutant: Mutant) -> Verdict | None:
        """The verdict on a mutant, if there is one before this judge."""
        known = self.done.get(mutant.identity)
        return Verdict(mutant, *known) if known else None

    def keep(self, verdict: Verdict) -> None:
        """Write a verdict down at once."""
        line = {
            "mutant": verdict.mutant.identity,
            "judge": self.judge,
            "killer": verdict.killer,
            "text": verdict.text,
            "seconds": round(verdict.seconds, 3),
        }
        self.path.parent.mkdir(exist_ok=True)
        with self.path.open("a", encoding="utf-8") as file:
            file.write("\n" * self._torn() + json.dumps(line) + "\n")

    def _torn(self) -> bool:
        """Whether the last line has no end: the power went."""
        if not self.path.exists() or not self.path.stat().st_size:
            return False
        with self.path.open("rb") as file:
            file.seek(-1, 2)
            return file.read(1) != b"\n"


def _lines(path: Path) -> list[dict[str, Any]]:
    found = []
    for text in path.read_text("utf-8").splitlines() if path.exists() else ():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue  # the last line may be torn
        found.append(line)
    return found


# -- the stored result ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Campaign:
    """What was tried, and how it ended."""

    protocol: str
    sources: Mapping[str, str]
    """Digest of each mutated file, by its name."""
    judge: Mapping[str, Any]
    """The judge's digest, its checks, and those that the language fails as it is."""
    mutants: int
    """How many there are."""
    wordings: int
    seed: int | None
    """Of the sample; None if all were tried."""
    chosen: int
    """How many were to be tried."""
    verdicts: Sequence[Verdict]


def stored(name: str, folder: Path = RESULTS) -> dict[str, Any] | None:
    """The stored result of a language; None if there is none."""
    path = folder / f"{name}.json"
    if not path.exists():
        return None
    result: dict[str, Any] = json.loads(path.read_text("utf-8"))
    return result


def save(campaign: Campaign, folder: Path = RESULTS) -> Path:
    """Write a result in the place of the one before, whose judgements are kept."""
    old = stored(campaign.protocol, folder) or {"survivors": []}
    judgements: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for row in old["survivors"]:
        judgements[_key(row)].append(row["judgement"])
    survivors = []
    for verdict in campaign.verdicts:
        if verdict.killer:
            continue
        mutant = verdict.mutant
        row = {"file": mutant.file, "function": mutant.function, "diff": mutant.diff}
        known = judgements[_key(row)]
        survivors.append(row | {"judgement": known.pop(0) if known else UNJUDGED})
    head = {
        "protocol": campaign.protocol,
        "sources": dict(campaign.sources),
        "judge": dict(campaign.judge),
        "mutants": campaign.mutants,
        "wordings": campaign.wordings,
        "seed": campaign.seed,
        "tried": len(campaign.verdicts),
        "killed": sum(bool(verdict.killer) for verdict in campaign.verdicts),
    }
    folder.mkdir(exist_ok=True)
    path = folder / f"{campaign.protocol}.json"
    path.write_text(_text(head, survivors), "utf-8")
    return path


def _text(head: Mapping[str, Any], survivors: Iterable[Mapping[str, str]]) -> str:
    """JSON with a line for each entry of the head and for each survivor."""
    lines = [f' "{key}": {json.dumps(value, ensure_ascii=False)},' for key, value in head.items()]
    rows = ",\n".join("  " + json.dumps(row, ensure_ascii=False) for row in survivors)
    body = f"[\n{rows}\n ]" if rows else "[]"
    return "\n".join(["{", *lines, f' "survivors": {body}', "}", ""])


def _key(row: Mapping[str, str]) -> tuple[str, str, str]:
    return row["file"], row["function"], row["diff"]


def judged(row: Mapping[str, str]) -> bool:
    """Whether a survivor has a judgement that says something."""
    return any(row["judgement"].startswith(kind) and len(row["judgement"]) > len(kind) + 3 for kind in KINDS)


def named(result: Mapping[str, Any]) -> frozenset[tuple[str, str, str]]:
    """The survivors of a stored result: file, function, difference."""
    return frozenset(_key(row) for row in result["survivors"])


def floors(path: Path = FLOORS) -> dict[str, float]:
    """By language, the score that it must not fall below while it is below what is demanded."""
    floors: dict[str, float] = json.loads(path.read_text("utf-8"))
    return floors
