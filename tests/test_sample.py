"""Of a test with the mark `sample`, `./go test` runs some parameters, and `./go prove` all others."""

from __future__ import annotations

import subprocess
import sys

from tests.distributions import ROOT

FILE = "tests/protocols/test_line_sessions.py"


def collected(marks: str) -> set[str]:
    command = [sys.executable, "-m", "pytest", FILE, "-m", marks, "--collect-only", "-q", "--no-header"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return {line for line in listed.splitlines() if line.startswith(FILE)}


def test_a_sample_and_its_campaign_are_all_of_it_and_share_nothing() -> None:
    everything, tests, campaign = collected("prove or not prove"), collected("not prove"), collected("prove")
    sample = [line for line in tests if "test_a_session_with_bad_answers_ends_well[" in line]
    assert len(sample) == 8
    assert len({line.partition("[")[2].partition("-")[0] for line in sample}) > 2  # spread, not the first
    assert tests | campaign == everything
    assert not tests & campaign
