"""10,000 random sessions on lines of questions and answers, dealt out to the protocols that have them.

./go prove -k line_sessions                      all that are left
PROVE_SEED=7 SESSIONS=500 ./go prove -k line_sessions      others, and fewer
"""

from __future__ import annotations

import os

import pytest

from tests.protocols.line_sessions import QUESTIONED, LineSession
from tests.prove.campaign import Campaign


@pytest.mark.prove
def test_line_sessions_with_bad_answers_end_well() -> None:
    count = int(os.environ.get("SESSIONS", "10000"))

    def case(seed: int, number: int) -> int:
        return LineSession(QUESTIONED[number % len(QUESTIONED)], seed * 1_000_003 + number).run()

    disturbed = Campaign("line_sessions", count).run(case)
    assert sum(disturbed.values()) > count
    print(f"{count} sessions, {sum(disturbed.values())} answers lost or late")
