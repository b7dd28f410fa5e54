"""The whole brain in the 79 variations, others drawn at random, carried away, in four worlds.

./go prove -k robustness                              all that are left; then the table
PROVE_SEED=7 ./go prove -k "robustness and moves"     one campaign, with this seed
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import pytest

from tests.prove.campaign import Campaign
from tests.robustness.judge import Case, Row, mean_nees, mean_nis, run, table
from tests.robustness.variations import TABLE, WORLDS, carried, drawn, world

pytestmark = pytest.mark.prove


def rows(name: str, count: int, chosen: Callable[[int, int], Case]) -> list[Row]:
    """Run a campaign; the case of a number may depend on the seed. Prints what came of each."""

    def case(seed: int, number: int) -> Any:
        return asdict(run(chosen(seed, number), seed % 1_000_000 + number))

    found = [Row(**result) for _, result in sorted(Campaign(f"robustness-{name}", count).run(case).items())]
    print(table(found))
    return found


def test_the_variations() -> None:
    found = rows("table", len(TABLE), lambda _, number: TABLE[number])
    assert sum(row.good for row in found) >= 75
    others = rows("drawn", 40, lambda seed, number: drawn(seed + number))
    assert sum(row.good for row in others) / len(others) >= sum(row.good for row in found) / len(found) - 0.05


def test_who_is_carried_away_stands_and_finds_itself() -> None:
    found = rows("moves", 100, lambda seed, number: carried(seed + number))
    assert not [row for row in found if row.false]
    assert not [row for row in found if row.lost > 1.0]
    assert sum(row.found <= 5.0 for row in found) >= 95


@pytest.mark.parametrize("name", WORLDS)
def test_the_filter_is_consistent(name: str) -> None:
    found = rows(name, 20, lambda _seed, _number: world(name))
    assert 0.5 <= mean_nees(found) <= 1.5
    assert {sensor: mean for sensor, mean in mean_nis(found).items() if not 0.5 <= mean <= 2.0} == {}


def test_a_sweep_is_nearly_as_good_as_an_instant() -> None:
    swept = rows("sweep", 10, lambda _seed, _number: world("office"))
    instant = rows("instant", 10, lambda _seed, _number: world("office", sweep=False))
    assert sum(row.error for row in swept) <= 1.3 * sum(row.error for row in instant)
