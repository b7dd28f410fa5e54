"""Conversations of vectors: what devices are asked for by the clock, and how often.

What vouches: the devices' bytes are cantools' with the DBCs 0.6.10 and 0.5.6; how often is derived by
hand from the README ("Settings on the device", "What it does": discovery) and the docstrings of
`options` and `polling`. Spans in ms. See `talk`.
"""

from __future__ import annotations

from itertools import pairwise

import pytest

from protocols.messages import Velocity
from tests.protocols.odrive_can.conversation import device
from tests.protocols.odrive_can.talk import Talk, standing, standing05


def since(talk: Talk, question: str) -> list[int]:
    """When this was asked in the present stage."""
    return [at - talk.began for at in talk.requests.get(question, []) if at >= talk.began]


def spans(talk: Talk, question: str) -> set[int]:
    """From one asking to the next in the present stage."""
    asked = since(talk, question)
    return {later - earlier for earlier, later in pairwise(asked)}


def test_vectors_of_requests_to_an_absent_device() -> None:
    talk = Talk([device()])
    talk.run(10_010)
    for question, first, span in (
        ("3?Get_Version", 0, 100),
        ("3?Heartbeat", 250, 100),
        ("63?Address", 0, 5000),
    ):
        assert since(talk, question)[0] == first
        assert spans(talk, question) == {span}
    assert max(spans(talk, "3?Get_Encoder_Estimates")) <= 100
    # Nothing is polled of who says nothing.
    assert set(talk.requests) == {"3?Get_Version", "3?Heartbeat", "63?Address", "3?Get_Encoder_Estimates"}


def test_vectors_of_polls_when_due_and_not_at_the_next_step() -> None:
    talk = Talk([device()], every=0)
    talk.run(600)
    assert since(talk, "3?Get_Version") == [0, 100, 200, 300, 400, 500]
    assert since(talk, "3?Heartbeat") == [250, 350, 450, 550]


@pytest.mark.parametrize(
    ("line", "polled"),
    [
        ("0.6", {"Get_Iq", "Get_Bus_Voltage_Current", "Get_Temperature", "Get_Torques"}),
        ("0.5", {"Get_Iq", "Get_Bus_Voltage_Current"}),
    ],
)
@pytest.mark.parametrize("poll_ms", [0, 50, 200])
def test_vectors_of_what_is_polled(line: str, polled: set[str], poll_ms: int) -> None:
    talk = Talk([device(poll_ms=poll_ms, firmware=line)], line)
    talk.up() if line == "0.6" else talk.up05()
    talk.run(300)
    talk.stage()
    talk.run(1000)
    asked = {question for question in talk.requests if since(talk, question)}
    assert asked == ({f"3?{name}" for name in polled} if poll_ms else set())
    for question in asked:
        assert since(talk, question)[0] <= poll_ms
        assert spans(talk, question) <= {poll_ms, poll_ms + 10}  # after the answer, at the next step
    # One by one, not all in one step.
    assert len({since(talk, question)[0] for question in asked}) == len(asked)


def test_vectors_of_cyclic_messages_that_are_not_polled() -> None:
    talk = Talk([device(poll_ms=50)])
    talk.up()
    talk.cycle(40, "Get_Bus_Voltage_Current", Bus_Voltage=20.0)
    talk.run(300)
    talk.stage()
    talk.run(500)
    assert not since(talk, "3?Get_Bus_Voltage_Current")
    talk.cycle(0, "Get_Bus_Voltage_Current")
    talk.stage()
    talk.run(500)
    assert since(talk, "3?Get_Bus_Voltage_Current")[0] <= 60
    assert spans(talk, "3?Get_Bus_Voltage_Current") == {50}  # unanswered


def test_vectors_of_a_silent_device_that_is_not_polled() -> None:
    talk = Talk([device(poll_ms=50)])
    talk.up()
    talk.run(300)
    talk.mute()
    talk.run(300)
    talk.stage()
    talk.run(300)
    assert not since(talk, "3?Get_Iq")
    assert spans(talk, "3?Get_Version") == spans(talk, "3?Heartbeat") == {100}


def test_vectors_of_heartbeats_that_are_not_cyclic() -> None:
    talk = standing()
    talk.run(1000)
    assert not talk.requests.get("3?Heartbeat")
    talk.cycle(0, "Heartbeat")
    talk.answer("Heartbeat", Axis_State=1)
    talk.stage()
    talk.run(1100)
    # Four times a second; the last came 100 ms ago.
    assert since(talk, "3?Heartbeat")[0] == 150
    assert spans(talk, "3?Heartbeat") <= {250, 251, 260}
    del talk.answers["Heartbeat", 3]
    talk.run(300)
    talk.stage()
    talk.run(500)
    assert spans(talk, "3?Heartbeat") == {100}


def test_vectors_of_heartbeats_of_0_5_that_cannot_be_requested() -> None:
    talk = Talk([device(poll_ms=50, firmware="0.5")], "0.5")
    talk.up05()
    talk.run(300)
    talk.cycle(0, "Heartbeat")
    talk.stage()
    talk.run(1000)
    assert not since(talk, "3?Heartbeat")


@pytest.mark.parametrize("feedback_ms", [10, 50])
def test_vectors_of_estimates_that_are_not_cyclic(feedback_ms: int) -> None:
    talk = standing(feedback_ms=feedback_ms)
    talk.stage()
    talk.run(200)
    assert not since(talk, "3?Get_Encoder_Estimates")
    talk.cycle(0, "Get_Encoder_Estimates")
    talk.stage()
    talk.run(500)
    assert feedback_ms <= since(talk, "3?Get_Encoder_Estimates")[0] <= 2 * feedback_ms
    assert spans(talk, "3?Get_Encoder_Estimates") == {feedback_ms}
    talk.answer("Get_Encoder_Estimates", Vel_Estimate=1.0)
    talk.stage()
    talk.run(500)
    assert spans(talk, "3?Get_Encoder_Estimates") == {feedback_ms}
    talk.place()
    talk.run(100)
    talk.stage()
    talk.run(200)
    assert not since(talk, "3?Get_Encoder_Estimates")


def test_vectors_of_a_version_that_is_known() -> None:
    """0.6.x has told it; who was told apart without it may be replaced, and is asked again every 5 s."""
    talk = standing()
    talk.run(10_000)
    assert not since(talk, "3?Get_Version")
    talk = standing05()
    asked = talk.requests["3?Get_Version"][-1] - talk.began
    talk.run(10_000)
    assert since(talk, "3?Get_Version") == [asked + 5000, asked + 10_000]


def test_vectors_of_what_both_lines_answer_alike() -> None:
    """Asked for with the version until the line is known, and polled from then on."""
    talk = Talk([device(poll_ms=0)], "0.5")
    talk.up05()
    talk.run(1000)
    asked = [0, 100, 200, 300, 400]
    assert since(talk, "3?Get_Bus_Voltage_Current") == since(talk, "3?Get_Version") == asked


def test_vectors_of_a_bus_with_0_5_only_without_discovery() -> None:
    """An axis with node id 63 would take it for Set_Axis_Node_ID."""
    talk = standing05(4)
    talk.run(5100)
    assert "63?Address" not in talk.requests


def test_vectors_of_polls_while_it_is_driven() -> None:
    """The set-points of a step are not said once more because a poll is due; a version is worth it."""
    talk = Talk([device(poll_ms=35)], every=20)
    talk.up(state=8)
    talk.run(200)
    talk.stage()
    talk.run(400, Velocity("left", 0.0))
    talk.reports("""
        0 > 3:Set_Input_Vel 0 0 | 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0
        20…380 > 3:Set_Input_Vel 0 0
    """)
    assert {at % 20 for at in since(talk, "3?Get_Iq")} <= {0}


def test_vectors_of_what_one_motor_costs() -> None:
    """At 200 steps a second: a set-point at every step, and four questions at 5 Hz."""
    talk = Talk([device()], every=5)
    talk.up(state=8)
    talk.run(300, Velocity("left", 0.0))
    talk.stage()
    talk.run(1000, Velocity("left", 0.0))
    assert [(line.text, line.count) for line in talk.lines] == [("3:Set_Input_Vel 0 0", 200)]
    assert sum(len(since(talk, question)) for question in talk.requests) == 20


def test_vectors_of_a_watchdog_of_0_5_that_is_fed_while_idle() -> None:
    """It runs while idle too, and any frame to the axis feeds it: one in 100 ms, and a step."""
    talk = Talk([device(firmware="0.5")], "0.5")
    talk.up05()
    talk.answer("Get_Iq", Iq_Measured=0.0)
    talk.run(5300)
    asked = sorted(at for question in talk.requests for at in talk.requests[question] if at >= 300)
    assert max(later - earlier for earlier, later in pairwise(asked)) <= 110
