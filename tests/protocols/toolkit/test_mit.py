"""Commands as five numbers."""

from __future__ import annotations

from protocols.damiao.table import ANY
from protocols.messages import Hold, Impedance
from protocols.toolkit.mit import ImpedanceGains

GAINS = ImpedanceGains(20.0, 1.0, ANY.row("MIT"))


def test_hold_has_a_spring_only_where_the_position_is_known() -> None:
    assert GAINS.impedance(Hold("left"), 1.5) == Impedance("left", 1.5, 0.0, 0.0, 20.0, 1.0)
    assert GAINS.impedance(Hold("left"), None) == Impedance("left", 0.0, 0.0, 0.0, 0.0, 1.0)


def test_hold_beyond_the_range_of_the_position_does_not_pull_it_to_the_end() -> None:
    assert GAINS.impedance(Hold("left"), 12.6) == Impedance("left", 0.0, 0.0, 0.0, 0.0, 1.0)
    assert GAINS.impedance(Hold("left", 2.0), -40.0) == Impedance("left", 0.0, 0.0, 2.0, 0.0, 1.0)
