"""A hundred runs through a doorway with two people each: nobody is struck, and every goal is reached.

./go prove -k people                      PROVE_SEED=7 ./go prove -k people begins with seed 7
.venv/bin/python -m tests.people 12 13    these seeds alone
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest

from tests.people.crossing import LIMIT, Crossing, run
from tests.prove.campaign import Campaign

pytestmark = pytest.mark.prove


def test_people_in_the_doorway_are_not_struck() -> None:
    def case(seed: int, number: int) -> Any:
        return asdict(run(seed % 1_000_000 + number))

    results = [Crossing(**row) for _, row in sorted(Campaign("people", 100).run(case).items())]
    print(*(each.line() for each in results), sep="\n")
    late = sorted(each.delay for each in results)
    print(f"delay: mean {sum(late) / 100:.1f} s, median {late[50]:.1f} s, worst {late[-1]:.1f} s")
    assert [each.line() for each in results if each.struck or each.span > LIMIT] == []
