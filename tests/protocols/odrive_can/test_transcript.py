"""Transcripts: what is as expected, and what is not."""

from __future__ import annotations

import pytest

from protocols.messages import Velocity
from tests.protocols.odrive_can.talk import standing
from tests.protocols.odrive_can.transcript import Line, difference, expectation

AGAIN = Line(">", "3:Set_Axis_State 1", 20, 120, 50, 3)
EVENT = Line("<", "Done Zero left: ", 30, 30)


@pytest.mark.parametrize(
    ("line", "wanted", "same"),
    [
        (AGAIN, "20…120/50 > 3:Set_Axis_State 1", True),
        (AGAIN, "0-20…100-140/40-60 > 3:Set_Axis_State 1", True),
        (AGAIN, "20…120 > 3:Set_Axis_State 1", False),
        (AGAIN, "20 > 3:Set_Axis_State 1", False),
        (AGAIN, "21-30…120/50 > 3:Set_Axis_State 1", False),
        (AGAIN, "20…121/50 > 3:Set_Axis_State 1", False),
        (AGAIN, "20…120/50 > 3:Set_Axis_State 8", False),
        (AGAIN, "20…120/50 < 3:Set_Axis_State 1", False),
        (EVENT, "30 < Done Zero left:*", True),
        (EVENT, "0-30 < Done * left: ", True),
        (EVENT, "30 < Done Zero right:*", False),
        (EVENT, "30 < Done Zero left:* (× 2)", False),
        (Line("<", "Done Zero left: ", 30, 30, 0, 2), "30 < Done Zero left:* (× 2)", True),
        (Line("<", "a.c", 1, 1), "1 < abc", False),
        (Line("<", "abc", 1, 1), "1 < a.c", False),
    ],
)
def test_a_line_is_as_expected_or_not(line: Line, wanted: str, same: bool) -> None:
    assert line.is_as(wanted) == same


def test_too_few_too_many_and_the_wrong_order_are_differences() -> None:
    wanted = ["20…120/50 > 3:Set_Axis_State 1", "30 < Done Zero left:*"]
    assert difference([AGAIN, EVENT], wanted) == ""
    assert "line 2 is\nnothing" in difference([AGAIN], wanted)
    assert "and should be\nnothing more" in difference([AGAIN, EVENT, EVENT], wanted)
    assert "line 1" in difference([EVENT, AGAIN], wanted)


def test_an_expectation_may_have_long_lines_and_remarks() -> None:
    text = """
        # first
        0 > a
            | b
        1 < c
    """
    assert expectation(text) == ["0 > a | b", "1 < c"]


def test_a_conversation_that_is_not_as_expected_fails() -> None:
    talk = standing()
    talk.run(20, Velocity("left", 0.0))
    with pytest.raises(
        AssertionError, match="and should be\n10 > 3:Set_Input_Vel 1 0\nin\n0 > 3:Set_Controller"
    ):
        talk.reports("""
            0 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
            10 > 3:Set_Input_Vel 1 0
        """)


def test_a_frame_that_is_counted_otherwise_fails() -> None:
    talk = standing()
    with pytest.raises(AssertionError):
        talk.reports("", foreign=1)
