"""10,000 robot files with random numbers, and random `set`s while they run.

./go prove -k settings                      all that are left
PROVE_SEED=7 SETTINGS=500 ./go prove -k settings      others, and fewer
"""

from __future__ import annotations

import os
from collections import Counter

import pytest

from tests.gateway.config import random_settings
from tests.prove.campaign import Campaign


@pytest.mark.prove
def test_random_numbers_are_refused_in_words_or_the_robot_runs() -> None:
    count = int(os.environ.get("SETTINGS", "10000"))

    def case(seed: int, number: int) -> str:
        return random_settings.run(f"{seed} {number}").partition(":")[0]

    print(Counter(Campaign("settings", count).run(case).values()))
