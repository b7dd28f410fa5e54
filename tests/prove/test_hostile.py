"""Ten million hostile frames per protocol to driver, decoder and twin, and a million to a whole gateway.

    ./go prove -k "hostile_frames and moteus"               all that are left
    HOSTILE=100000 ./go prove -k hostile_frames             fewer

Nothing may be raised, a frame may cost only so many calls, and the memory must stay as it is after the first
frames. A slice is one `line` or `robot` of `tests/protocols/hostile.py`, with a seed of its own.
"""

from __future__ import annotations

import os

import pytest

from tests.protocols.hostile import PLUGINS, line, resident, robot
from tests.prove.campaign import Campaign

GROWTH = 40.0
"""MB from one slice to the last of the same process"""
ENDS = {"line": (line, 1, 50_000), "robot": (robot, 10, 10_000)}
"""What takes them, one in how many of them, and how many are a slice."""


@pytest.mark.prove
@pytest.mark.parametrize("name", sorted(PLUGINS))
@pytest.mark.parametrize("end", ENDS)
def test_hostile_frames(name: str, end: str) -> None:
    feed, share, size = ENDS[end]

    def case(seed: int, number: int) -> float:
        feed(name, seed * 1_000_003 + number, size)
        return resident()

    count = int(os.environ.get("HOSTILE", "10000000")) // share
    campaign = Campaign(f"hostile_{name}_{end}", -(-count // size))
    before = set(campaign.done)
    memory = campaign.run(case)
    here = [used for number, used in sorted(memory.items()) if number not in before]
    print(f"{name}, {end}: {len(memory) * size} frames; here {min(here):.0f} to {max(here):.0f} MB")
    late = here[len(here) // 4 :]
    assert max(late) - late[0] < GROWTH, here
