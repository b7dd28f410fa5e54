"""The fourteen defects of drivers in the field, each in a plugin that has it, and the clause that finds it.

Rules. One row per defect at least; the defect is described as it was found, by number.
"""

from __future__ import annotations

import pytest

from protocols.conformance import CLAUSES, check
from protocols.plugin import Plugin
from tests.protocols.broken_all import BROKEN

DEFECTS: tuple[tuple[int, str, str, str], ...] = (
    (1, "NaN in, full speed out", "clamps_nan", "finite"),
    (2, "a feed-forward of int8 where the protocol has int16", "wraps_feed_forward", "commands"),
    (3, "waits without a timeout", "WaitsForEver", "offline"),
    (4, "a frame whose data is never set", "SendsAnUnsetFrame", "vectors"),
    (5, "a mode switch clears faults", "ClearsAtEachModeSwitch", "faults"),
    (5, "the first set-point is zero", "FirstSetPointIsZero", "jump"),
    (6, "what was sent is decoded into the state", "AcceptsItsOwnFrames", "offline"),
    (7, "frames in the other format of id", "SendsLongIds", "vectors"),
    (8, "fault bits are ignored", "ignores_the_fault_bits", "faults"),
    (9, "status is polled by clearing the fault", "PollsByClearing", "faults"),
    (10, "the first frame is dropped", "LosesTheFirst", "counts"),
    (10, "a full transmit queue is ignored", "IgnoresAFullQueue", "dropped"),
    (11, "a timeout is stored and never used", "NeverReportsOffline", "offline"),
    (12, "read gives the last state without a device", "ReadsTheLastStateForEver", "offline"),
    (12, "read gives zero without a device", "ReadsZeroAtFirst", "offline"),
    (13, "a twin that measures whole units", "WholeUnits", "measurements"),
    (14, "devices are found by enabling them", "ScansByArming", "scan"),
)
"""Number, what was found, the plugin that has it here, the clause that must find it."""
BY_NAME: dict[str, Plugin] = {plugin.name: plugin for plugin, _ in BROKEN}


def test_no_defect_is_left_out() -> None:
    assert {number for number, *_ in DEFECTS} == set(range(1, 15))


def test_no_two_broken_plugins_have_one_name() -> None:
    assert len(BY_NAME) == len(BROKEN)


@pytest.mark.parametrize(
    ("number", "what", "name", "clause"), DEFECTS, ids=[f"{row[0]}-{row[2]}" for row in DEFECTS]
)
def test_a_defect_of_the_field_is_found(number: int, what: str, name: str, clause: str) -> None:
    (result,) = check(BY_NAME[name], clauses=[each for each in CLAUSES if each.name == clause])
    assert result.outcome == "failed", f"defect {number}, {what}: {result}"
    assert result.text
    assert result.frames or result.messages, "a counterexample in bytes or messages"
