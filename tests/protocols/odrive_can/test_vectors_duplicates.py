"""Conversations of vectors: two devices hold one node id.

What vouches: the devices' bytes are cantools' with the DBCs 0.6.10 and 0.5.6, replies to discovery
are as vector address_reply06 has them; what is expected is derived by hand from the README ("What it
does": a duplicate node id) and the docstrings of `duplicate_address` and `driver`. See `talk`.
"""

from __future__ import annotations

import pytest

from protocols.messages import ClearFault, Idle, Velocity
from tests.protocols.odrive_can.conversation import address, device, frame
from tests.protocols.odrive_can.talk import Talk, standing


def test_vectors_of_two_that_answer_the_roll_call() -> None:
    talk = standing()
    for serial in (10, 11, 10, 11):
        talk.handle(address(3, serial))
    twice = """
        0 < Found 3 00000000000A duplicate: serial numbers 00000000000A and 00000000000B answer to it
        0 < Found 3 00000000000B duplicate: serial numbers 00000000000A and 00000000000B answer to it
        0 < Fault left 0x200000000 duplicate node id 3: *00000000000A and 00000000000B*
    """
    talk.reports(twice)
    # Of others it is found, and no motor's fault; who has no node id yet is not alone with that.
    for serial in (12, 13):
        talk.handle(address(7, serial), address(63, serial + 2))
    talk.reports("""
        0 < Found 7 00000000000C duplicate: *
        0 < Found 7 00000000000D duplicate: *
    """)
    talk.ask(ClearFault("left"))
    talk.run(10)
    talk.reports("""
        0 > 3:Clear_Errors 0
        0 < Done ClearFault left:*
    """)
    talk.handle(address(3, 11))
    talk.reports(twice)


def test_vectors_of_one_that_was_replaced_and_of_one_that_moved() -> None:
    """A serial number counts for two roll calls, and at the node id where it was heard last."""
    talk = Talk([device(poll_ms=0), device("right", 4, poll_ms=0)])
    talk.up()
    talk.up(4)
    talk.run(200)
    talk.stage()
    talk.handle(address(3, 10))
    talk.run(10_001)
    talk.handle(address(3, 11), address(4, 11), address(3, 12))
    talk.reports("")
    talk.run(10_000)
    talk.handle(address(4, 13))
    talk.reports("""
        10000 < Found 4 00000000000B duplicate: serial numbers 00000000000B and 00000000000D answer to it
        10000 < Found 4 00000000000D duplicate: serial numbers 00000000000B and 00000000000D answer to it
        10000 < Fault right 0x200000000 duplicate node id 4: *00000000000B and 00000000000D*
    """)


@pytest.mark.parametrize(
    ("beats", "twice"),
    [
        (((8, 0), (1, 0), (8, 0), (1, 0)), True),
        (((1, 0), (1, 2), (1, 0), (1, 2)), True),
        (((1, 0), (1, 0), (1, 0), (1, 0)), False),
        (((8, 0), (1, 0), (8, 0), (8, 0)), False),
        (((8, 0), (1, 0), (1, 0), (1, 0)), False),
        (((8, 0), (1, 0), (8, 0), (9, 0)), False),
        (((8, 0), (1, 0), (9, 0), (1, 0)), False),
        (((8, 0), (1, 0), (8, 0)), False),
        (((1, 0), (8, 0), (1, 0), (8, 0), (1, 0), (8, 0)), True),
    ],
)
def test_vectors_of_heartbeats_that_contradict_each_other(
    beats: tuple[tuple[int, int], ...], twice: bool
) -> None:
    """The fourth shows it; it is told once, and the roll is called at once."""
    talk = Talk([device(poll_ms=0)])
    talk.handle(frame("Get_Version", Fw_Version_Minor=6))
    for state, error in beats:
        talk.report("Heartbeat", Axis_State=state, Axis_Error=error << 8)
        talk.run(50)
    reported = [str(line) for line in talk.lines if "duplicate" in line.text or "Found" in line.text]
    why = "its heartbeats contradict each other in turn"
    assert (
        reported
        == [
            f"150 < Found 3 ? duplicate: {why}",
            f"150 < Fault left 0x200000000 duplicate node id 3: {why}",
        ]
        * twice
    )
    assert talk.requests["63?Address"] == [0, *[150] * twice]


def test_vectors_of_heartbeats_with_extended_identifiers_that_contradict_each_other() -> None:
    talk = Talk([device(poll_ms=0, firmware="0.5", is_extended=True)], "0.5")
    for state in (8, 1, 8, 1):
        talk.report("Heartbeat", extended=True, Axis_State=state)
        talk.run(50)
    talk.reports("""
        0 < State left initialising: CLOSED_LOOP_CONTROL, identifying its firmware
        50 < State left initialising: IDLE, identifying its firmware
        100 < State left initialising: CLOSED_LOOP_CONTROL, identifying its firmware
        150 < State left initialising: IDLE, identifying its firmware
        150 < Found 3 ? duplicate: its heartbeats contradict each other in turn
        150 < Fault left 0x200000000 duplicate node id 3: its heartbeats contradict each other in turn
    """)


def test_vectors_of_heartbeats_after_requested_states() -> None:
    """What we had it do in between is no contradiction."""
    talk = standing(arm_retry_ms=50)
    for state in (8, 1, 8, 1):
        talk.run(20, Velocity("left", 0.0))
        talk.beat(state)
        talk.run(80, Velocity("left", 0.0))
        talk.report("Get_Error")
    for state in (8, 1, 8, 1):
        talk.report("Heartbeat", Axis_State=state)
        talk.run(20, Idle("left"))
    assert not [line for line in talk.lines if "duplicate" in line.text]


@pytest.mark.parametrize(
    ("places", "every", "twice"),
    [
        ((0.0, 1.0), 10, 9),
        ((0.0, 0.06), 10, 9),
        ((0.0, 0.04), 10, 0),
        ((0.0, -1.0), 100, 9),
        ((0.0, -1.0), 249, 9),
        ((0.0, -1.0), 250, 9),
        ((0.0, -1.0), 251, 0),
        ((0.0, 1.0, 2.0, 3.0), 10, 0),
        ((0.0, 1.0, 1.0), 10, 25),
        ((0.0, 1.0, 0.5), 10, 0),
    ],
)
def test_vectors_of_positions_that_contradict_each_other(
    places: tuple[float, ...], every: int, twice: int
) -> None:
    """`twice`: the estimate from which on it is known, counted from 0: the eighth leap back in two seconds.

    The first that can be one is the third estimate, number 2. After 500 ms a shaft may be anywhere."""
    talk = Talk([device(poll_ms=0, feedback_ms=100, offline_ms=1000)])
    talk.version()
    talk.beat()
    talk.run(10)
    reported: list[int] = []
    for at in range(40):
        talk.report("Get_Encoder_Estimates", Pos_Estimate=places[at % len(places)])
        talk.run(every)
        if not reported and any("positions contradict" in line.text for line in talk.lines):
            reported.append(at)
    assert reported == [twice] * bool(twice)
    assert sum(line.text.startswith("Fault") for line in talk.lines) == bool(twice)


@pytest.mark.parametrize(("velocity", "twice"), [(24.0, True), (26.0, False)])
def test_vectors_of_a_shaft_that_turns_so_fast_that_it_may_be_anywhere(velocity: float, twice: bool) -> None:
    """There and back 0.55 turns in 10 ms: 0.05 turns, and twice the velocity that it tells."""
    talk = standing()
    talk.cycle(0, "Get_Encoder_Estimates")
    for at in range(30):
        talk.report("Get_Encoder_Estimates", Pos_Estimate=0.55 * (at % 2), Vel_Estimate=velocity)
        talk.run(10)
    assert any("contradict" in line.text for line in talk.lines) == twice


def test_vectors_of_positions_that_are_reported_again_after_a_clearing() -> None:
    talk = standing()
    talk.cycle(0, "Get_Encoder_Estimates")
    reported = []
    for at in range(40):
        if at == 20:
            talk.ask(ClearFault("left"))
        talk.report("Get_Encoder_Estimates", Pos_Estimate=at % 2)
        talk.run(10)
        reported += [at for line in talk.lines if "Fault" in line.text and "duplicate" in line.text]
        talk.stage()
    # The eighth leap back is the tenth estimate here; after the clearing they are counted anew.
    assert len(reported) == 2
    assert reported[0] < 20 <= reported[1]
