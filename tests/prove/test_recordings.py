"""100,000 recordings that were made to do harm: cut, damaged, forged, or sealed with valid digests.

    ./go prove -k hostile_recordings               all that are left; HOSTILE=1000: so many

Each is read, recovered, replayed and recognised, every 50th also printed by the commands. Nothing may be
raised but a sentence, and the memory must stay as it is after the first of them.
"""

from __future__ import annotations

import os
import resource
from collections import Counter
from pathlib import Path

import pytest

from tests.gateway.recording.hostile import KINDS, Forge, read_all
from tests.prove.campaign import Campaign

BATCH = 7 * 50
GROWTH = 100
"""MB"""


@pytest.mark.prove
def test_hostile_recordings(tmp_path: Path) -> None:
    count = int(os.environ.get("HOSTILE", "100000"))

    def case(seed: int, number: int) -> dict[str, int]:
        forge = Forge(tmp_path, seed)
        refused = Counter[str]()
        for each in range(number * BATCH, (number + 1) * BATCH):
            refused[KINDS[each % len(KINDS)]] += bool(read_all(forge.make(each), printed=each % 50 == 0))
        return {**refused, "MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024}

    done = Campaign("hostile_recordings", -(-count // BATCH)).run(case)
    total = Counter[str]()
    for result in done.values():
        total.update(result)
    memory = [result["MB"] for result in done.values()]
    print(
        f"{len(done) * BATCH} recordings, of which refused: {dict(total)}; {min(memory)} to {max(memory)} MB"
    )
    assert max(memory) - min(memory) < GROWTH
