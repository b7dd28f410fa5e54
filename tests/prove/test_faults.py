"""10,000 runs with one fault each: every fault on every robot in every phase, in turn, at random times.

./go prove -k faults                          all that are left; then the table
PROVE_PART=0/2 ./go prove -k faults           every second one: another process does 1/2
PROVE_SEED=7 FAULTS=500 ./go prove -k faults  others, and fewer
"""

from __future__ import annotations

import os
from dataclasses import asdict
from typing import Any

import pytest

from tests.faults.report import failures, markdown
from tests.faults.start import Warm
from tests.faults.table import one_run
from tests.prove.campaign import Campaign


@pytest.mark.prove
def test_no_fault_is_unsafe_or_unnoticed() -> None:
    part, parts = map(int, os.environ.get("PROVE_PART", "0/1").split("/"))
    count = int(os.environ.get("FAULTS", "10000")) // parts
    warm: dict[int, Warm] = {}

    def case(seed: int, number: int) -> Any:
        return asdict(one_run(warm.setdefault(seed, Warm(seed)), seed, number * parts + part))

    name = f"faults-{part}of{parts}" if parts > 1 else "faults"
    results = [*Campaign(name, count).run(case).values()]
    print(markdown(results))
    failed = failures(results)
    assert not failed, "\n".join(failed)
