"""100 screens that appear before a driving robot: none is touched.

./go prove -k screens                      all that are left
PROVE_SEED=7 SCREENS=20 ./go prove -k screens      others, and fewer
"""

from __future__ import annotations

import os
from collections import Counter

import pytest

from tests.brain.test_stopping import screen_case
from tests.prove.campaign import Campaign


@pytest.mark.prove
def test_screens_that_appear_are_never_touched() -> None:
    count = int(os.environ.get("SCREENS", "100"))
    print(Counter(Campaign("screens", count).run(screen_case).values()))
