"""The stored results of mutation testing: of these sources, judged by a person, and as good as is demanded.

Rules. The results stand in fixtures/mutation, made by `./go prove`. Where a source has changed since,
some mutants of some changed files are tried here (in about a minute of CPU time for all languages together).
A language that is below the 90 % that are demanded stands in fixtures/mutation/floors.json: it is told as an
expected failure in every summary, must not fall below its floor, and must leave the file when it is good
enough.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from numpy.random import PCG64, Generator

from gateway.cli.scores import mutation_score
from tests.mutation import store
from tests.mutation.campaign import changed
from tests.mutation.languages import installed_language, ours
from tests.mutation.mutants import digest

ROOT = Path(__file__).resolve().parent.parent
FLOORS = store.floors()
SAMPLE = 40
SECONDS = 28.0
"""CPU time for all languages together, beside the start: the mutants of a large file take 3 s to be made."""
FILES = 2
"""Changed files of a language that are looked at, others after each change."""
DEVIATIONS = 3.0
"""Standard deviations by which a sample may be below: it is cut off where the time is over."""


def share_of(name: str) -> float:
    """Killed of all that were tried; 0 if none was ever."""
    score = mutation_score(name)
    return score.share if score else 0.0


def demanded(name: str) -> Any:
    """A language, marked as below what is demanded if the floors say so."""
    if name not in FLOORS:
        return name
    said = mutation_score(name) or "none ever tried"
    reason = f"{name}: mutants killed: {said}; demanded: {store.DEMANDED:.0%}"
    return pytest.param(name, marks=pytest.mark.xfail(strict=True, reason=reason))


@pytest.mark.parametrize("name", [demanded(name) for name in ours()])
def test_nine_of_ten_mutants_are_killed(name: str) -> None:
    assert share_of(name) >= store.DEMANDED


@pytest.mark.parametrize("name", ours())
def test_no_language_falls_below_its_floor_and_the_floor_follows_what_is_reached(name: str) -> None:
    floor = FLOORS.get(name, store.DEMANDED)
    assert floor <= store.DEMANDED
    assert share_of(name) >= floor
    assert name not in FLOORS or share_of(name) < floor + 0.02, "raise the floor"


RESULTS = {name: result for name in ours() if (result := store.stored(name))}


@pytest.mark.parametrize("name", RESULTS)
def test_every_survivor_is_judged(name: str) -> None:
    result = RESULTS[name]
    assert not [row for row in result["survivors"] if not store.judged(row)]
    assert len(result["survivors"]) == result["tried"] - result["killed"]
    assert result["judge"]["failing"] == {}, "a clause that fails judges nothing"


def test_the_floors_are_of_languages_of_ours() -> None:
    assert set(FLOORS) <= set(ours())


def outdated() -> dict[str, list[str]]:
    """By language, the files that have changed since its result was stored."""
    found = {name: changed(installed_language(name), result["sources"]) for name, result in RESULTS.items()}
    return {name: files for name, files in found.items() if files}


OUTDATED = outdated()


def some_of(name: str) -> list[str]:
    """A few of the changed files, chosen by what stands in them."""
    files = OUTDATED[name]
    room = ROOT / "protocols" / name
    seed = int(digest(*((room / file).read_text("utf-8") for file in files if (room / file).exists())), 16)
    picked = Generator(PCG64(seed)).choice(len(files), min(FILES, len(files)), replace=False)
    return [files[at] for at in sorted(picked)]


@pytest.mark.parametrize("name", OUTDATED)
def test_a_changed_file_is_still_held_by_the_contract(name: str, tmp_path: Path) -> None:
    """Of a sample of its mutants, but for those that survived before, nine of ten are killed."""
    files = some_of(name)
    said = tmp_path / "verdicts.json"
    seconds = str(SECONDS / len(OUTDATED))
    subprocess.run(
        [
            *(sys.executable, "-m", "tests.mutation", name, "--quick", "--sample", str(SAMPLE)),
            *("--files", ",".join(files), "--seconds", seconds, "--cpu"),
            *("--verdicts", str(said), "--progress", str(tmp_path)),
        ],
        cwd=ROOT,
        check=True,
    )
    found = json.loads(said.read_text())
    verdicts = found["verdicts"]
    alive = [verdict for verdict in verdicts if not verdict["killer"]]
    told = "\n".join(f"{verdict['file']} {verdict['function']}\n{verdict['diff']}" for verdict in alive)
    tried, result = len(verdicts), RESULTS[name]
    print(f"{name}: {', '.join(files)} changed; of {tried} mutants {len(alive)} survive")
    share = FLOORS.get(name, store.DEMANDED) if result["seed"] is not None else store.DEMANDED
    assert tried or not found["chosen"], "not one mutant was tried in time"
    chance = DEVIATIONS * math.sqrt(share * (1.0 - share) * tried)
    assert len(alive) <= max(1.0, (1.0 - share) * tried + chance), told
