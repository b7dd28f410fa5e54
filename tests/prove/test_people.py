"""A hundred runs through a doorway with two people each: nobody is struck, and every goal is reached.

./go prove -k people                      PROVE_SEED=7 ./go prove -k people begins with seed 7
.venv/bin/python -m tests.people 12 13    these seeds alone
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest

from tests.people.crossing import LIMIT, Crossing, alone, run
from tests.prove.campaign import Campaign

pytestmark = pytest.mark.prove


def test_people_in_the_doorway_are_not_struck() -> None:
    def case(seed: int, number: int) -> Any:
        one = seed % 1_000_000 + number
        return {"alone": alone(one, one % 2)[0].span, **asdict(run(one))}

    late, bad = [], []
    for _, row in sorted(Campaign("people", 100).run(case).items()):
        without = row.pop("alone")
        result = Crossing(**row)
        print(result.line(without))
        late.append(min(result.span, LIMIT) - without)
        if result.struck or result.span > LIMIT:
            bad.append(result.line(without))
    late.sort()
    print(f"delay {sum(late) / 100:.1f} s, median {late[50]:.1f} s, worst {late[-1]:.1f} s")
    assert bad == []
