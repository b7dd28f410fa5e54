"""3,000 starts of a joint on a bench, and the whole table of joints outside their range: none beyond limits.

./go prove -k starts                       all that are left
PROVE_SEED=7 STARTS=200 ./go prove -k starts      others, and fewer
"""

from __future__ import annotations

import os
from collections import Counter

import pytest

from tests.gateway.core.starts import start_case
from tests.prove.campaign import Campaign


@pytest.mark.prove
def test_starts_keep_the_limits() -> None:
    count = int(os.environ.get("STARTS", "3000"))
    done = Campaign("starts", count).run(start_case)
    print(Counter(case.split(", ")[1] for case in done.values()))
