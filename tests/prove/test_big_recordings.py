"""Recordings three times as large take the same memory: to open, to seek in, to read and to judge.

./go prove -k big_recordings
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import gateway as gw
from tests.gateway.recording.repeated import repeat

SIZES = (15_000_000, 45_000_000)
GROWTH = 3.0
"""MB: what the index of 30 MB more takes, and what one process differs by from another"""
MEASURE = """
import json, re, sys
from pathlib import Path
from gateway.recording import read_recording
from gateway.replay import Player

def peak():  # of this process alone: ru_maxrss is at least that of the one that started it
    return int(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]) / 1024

found = {}
recording = read_recording(sys.argv[1])
with Player(recording) as player:
    found["open"] = peak()
    player.prepare(3000)
    for share in (0.9, 0.1, 0.5):
        player.seek(player.start + round(share * 15e9))
        while not player.advance(500):
            pass
    found["seek"] = peak()
found["ticks"] = sum(1 for _ in recording.ticks)
found["read"] = peak()
print(json.dumps(found))
"""


def measured(path: Path) -> dict[str, float]:
    environ = {**os.environ, "XDG_CACHE_HOME": str(path.parent / "cache")}
    command = [sys.executable, "-c", MEASURE, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environ)
    found: dict[str, float] = json.loads(done.stdout)
    return found


@pytest.mark.prove
def test_the_memory_is_that_of_a_small_one(tmp_path: Path) -> None:
    source = tmp_path / "source.mcap"
    with gw.open_session("diffbot", simulated=True, record=source) as session:
        session.submit(gw.Goal(1.6, 0.6))
        for _ in session.run(8.0):
            pass
    small, large = (tmp_path / f"{size}.mcap" for size in SIZES)
    for path, size in zip((small, large), SIZES, strict=True):
        repeat(source, path, size)
    one, two = measured(small), measured(large)
    print(f"{SIZES[0]} bytes: {one}\n{SIZES[1]} bytes: {two}")
    assert two["ticks"] > 2.8 * one["ticks"]
    for what in ("open", "seek", "read"):
        assert two[what] - one[what] < GROWTH, what
