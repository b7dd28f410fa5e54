"""Recordings that survive, at length: 200 kills, and a cut at every byte."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.errors import RecordingError
from gateway.recording.recover import recover
from tests.gateway import kills, little
from tests.gateway.kills import Outcome, raw_ticks
from tests.gateway.recording.test_recover import chunks
from tests.gateway.witness import Runs
from tests.prove.campaign import Campaign

pytestmark = pytest.mark.prove


def test_two_hundred_kills_lose_at_most_100_ms(tmp_path: Path) -> None:
    with Runs() as runs:

        def case(seed: int, number: int) -> list[float]:
            outcome = kills.one_kill(runs, tmp_path, seed, number)
            return [outcome.after, outcome.ticks, outcome.lost, outcome.queued]

        done = Campaign("kills", 200).run(case)
    outcomes = [Outcome(after, *map(int, rest)) for after, *rest in done.values()]
    print(kills.summary(outcomes))
    assert sum(outcome.lost > kills.PROMISE for outcome in outcomes) <= 10, "a machine cannot be that busy"


def test_a_cut_at_every_byte_gives_back_all_whole_ticks_before_it(tmp_path: Path) -> None:
    path, cut, out = tmp_path / "a.mcap", tmp_path / "cut.mcap", tmp_path / "out.mcap"
    little.record_in_chunks(path, 40)
    whole, parts = path.read_bytes(), chunks(path)
    step = 64

    def case(_seed: int, number: int) -> int:
        most = 0
        for size in range(number * step, min((number + 1) * step, len(whole))):
            cut.write_bytes(whole[:size])
            expected = [tick for _, end, ticks in parts if end <= size for tick in ticks]
            try:
                found = recover(cut, out).ticks
            except RecordingError:
                found = 0
            assert (raw_ticks(out) if found else []) == expected, f"cut at byte {size}"
            out.unlink(missing_ok=True)
            most = max(most, found)
        return most

    done = Campaign("cuts", len(whole) // step + 1).run(case)
    assert max(done.values()) == 40
    print(f"{len(whole)} cuts")
