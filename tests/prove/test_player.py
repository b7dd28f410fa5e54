"""Players of recordings of every shipped robot: whatever is played before, equal to a straight replay.

./go prove -k player                all that are left
PLAYERS=50 ./go prove -k player     fewer
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import gateway as gw
from gateway import config
from gateway.replay import keyframes
from tests.gateway.replay.test_player import plays_as_a_straight_replay, record
from tests.prove.campaign import Campaign

ROBOTS = sorted(
    path.stem
    for path in Path(config.__file__).parent.parent.glob("fixtures/robots/*.toml")
    if all(bus.interface == "twin" for bus in gw.load_robot(path.stem).buses.values())
)


@pytest.mark.prove
def test_players_play_as_a_straight_replay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count = int(os.environ.get("PLAYERS", "200"))
    monkeypatch.setattr(keyframes, "SPACING", 50)

    def case(seed: int, number: int) -> str:
        name = ROBOTS[number % len(ROBOTS)]
        path = tmp_path / f"{number}.mcap"
        recording = record(name, path, 3.0)
        plays_as_a_straight_replay(recording, tmp_path / "cache", seed * 1_000_003 + number, moves=60)
        path.unlink()
        return name

    done = Campaign("players", count).run(case)
    assert set(done.values()) >= set(ROBOTS[:count])
