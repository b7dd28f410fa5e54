"""10,000 random sessions of drivers and twins over bad lines, dealt out to the installed protocols in turn.

./go prove -k sessions                      all that are left
PROVE_SEED=7 SESSIONS=500 ./go prove -k sessions      others, and fewer
"""

from __future__ import annotations

import os
from collections import defaultdict

import pytest

from tests.protocols.sessions import MOTORS, Session
from tests.prove.campaign import Campaign


@pytest.mark.prove
def test_sessions_over_bad_lines_end_well() -> None:
    count = int(os.environ.get("SESSIONS", "10000"))

    def case(seed: int, number: int) -> float:
        return Session(MOTORS[number % len(MOTORS)], seed * 1_000_003 + number).run()

    shares = defaultdict[str, list[float]](list)
    for number, share in Campaign("sessions", count).run(case).items():
        shares[MOTORS[number % len(MOTORS)].name].append(share)
    for name, worst in shares.items():
        print(f"{name}: {len(worst)} sessions; wrong torque for at most {max(worst):.2f} of its bound")
