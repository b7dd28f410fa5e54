"""Where a joint is when it is first commanded: it begins there, leads inwards only, or not at all."""

from __future__ import annotations

import math

import pytest

from gateway.core.faults import BEYOND_TRAVEL, FRAME_BLOCKED, UNREFERENCED
from protocols import messages as msg
from tests.gateway.core.starts import HIGH, LOW, MOTORS, TURNS, Bench, commands_of, robot_of, start_case
from tests.sampled import sampled

KINDS = ("Position", "Hold", "Velocity", "Torque", "Impedance")
OUTSIDE = (0.02, 0.09, 0.5, 1.0, math.tau, TURNS)
"""rad beyond the range"""
CASES = [
    (motor, kind, outside)
    for motor in MOTORS
    for kind in KINDS
    if kind in commands_of(robot_of(motor))
    for outside in OUTSIDE
]


@pytest.mark.sample(8)
@pytest.mark.parametrize(("motor", "kind", "outside"), sampled(CASES, 13))
def test_a_joint_outside_its_range_is_led_inwards_or_not_commanded(
    motor: str, kind: str, outside: float
) -> None:
    robot = robot_of(motor)
    bench = Bench.of(robot, 1, HIGH + outside)
    command = commands_of(robot)[kind]
    joint, margin = bench.gateway.joints["left"], robot.motors["left"].joint.limits.margin
    before, reads = bench.place, joint.feedback.position
    bench.run(1.5, command)
    bench.keeps(command)
    assert FRAME_BLOCKED not in {fault.code for fault in bench.gateway.joints["left"].faults.values()}
    if reads is None or reads > HIGH + margin:
        refused = [note for note in bench.notes if "a turn lost? zero it or home it" in note]
        assert len(refused) == 1, bench.notes
        assert reads is None or f"limits [{LOW:g}, {HIGH:g}]" in refused[0]
        assert bench.place == pytest.approx(before)
    elif kind != "Hold":
        assert bench.place < before
    else:
        assert bench.place == pytest.approx(before, abs=0.01)


def test_where_others_depend_on_it_the_robot_stops() -> None:
    bench = Bench.of(robot_of("damiao", on_fault="stop"), 1, HIGH + 1.0)
    bench.run(0.1, msg.Position("left", 0.0))
    assert "a turn lost?" in bench.gateway.why_stopped()


def test_a_turn_that_was_lost_makes_the_position_unknown_until_it_is_confirmed() -> None:
    bench = Bench.of(robot_of("damiao"), 1)
    bench.run(1.0, msg.Position("left", 1.0))
    bench.world.reset("left")
    bench.offset -= math.tau
    bench.run(0.5)
    joint = bench.gateway.joints["left"]
    (lost,) = [fault.name for fault in joint.faults.values() if fault.code == UNREFERENCED]
    assert lost.endswith("-1.00 turns of the device")
    bench.run(0.5, msg.ClearFault("left"))
    bench.run(0.5, msg.Position("left", 1.0))
    assert not joint.faults
    assert bench.place == pytest.approx(1.0 - math.tau, abs=0.01)
    bench.offset += math.tau  # a person turns it back by hand, and looks
    bench.run(0.2, msg.ClearFault("left"))
    bench.run(0.2, msg.Confirm("left"))
    bench.run(1.0, msg.Position("left", 0.5))
    assert bench.place == pytest.approx(0.5, abs=0.01)
    assert any(note.startswith("Confirm: done (it reads") for note in bench.notes)
    bench.run(0.1, msg.Confirm("lefft"))
    assert any("there is no motor 'lefft'" in note for note in bench.notes)


def test_a_position_that_is_lost_and_goes_on_jumping_is_noted_once() -> None:
    bench = Bench.of(robot_of("damiao"), 1)
    for _ in range(5):
        bench.offset += 3.0
        bench.run(0.1)
    assert len([note for note in bench.notes if "its position is not known" in note]) == 1


def test_to_zero_it_makes_the_position_known() -> None:
    bench = Bench.of(robot_of("robstride"), 1)
    bench.run(0.5, msg.Position("left", 1.0))
    bench.run(0.5, msg.Idle("left"))
    bench.world.reset("left")
    bench.offset -= math.tau
    bench.run(0.5)
    joint = bench.gateway.joints["left"]
    assert [fault.code for fault in joint.faults.values()] == [UNREFERENCED]
    bench.run(0.5, msg.Zero("left"))
    assert not joint.faults
    bench.run(1.0, msg.Position("left", 0.3))
    assert joint.feedback.position == pytest.approx(0.3, abs=0.01)


def test_a_torque_that_drives_a_joint_out_of_its_range_is_ended() -> None:
    bench = Bench.of(robot_of("damiao"), 1)
    bench.run(1.0, msg.Torque("left", 1.0))
    joint = bench.gateway.joints["left"]
    assert BEYOND_TRAVEL in {fault.code for fault in joint.faults.values()}
    assert joint.sent == msg.Idle("left")


@pytest.mark.sample(3)
@pytest.mark.parametrize("number", range(6))
def test_joints_start_within_their_limits(number: int) -> None:
    start_case(11, 7 * number)


LOADED = {
    (11, 1087): "a drive that stopped a falling shaft when it was enabled",
    (11, 2458): "a spring that slows the shaft down where it is expected, and drives it on a little before",
    (11, 446): "a spring's first set-point",
    (11, 1418): "Hold on a moving shaft",
    (11, 1509): "a torque beside a load",
    (31, 2792): "a torque that only carries the load, then is larger, where reports are 20 ms apart",
    (31, 2085): "the same beside a load that helps",
}
"""By seed and number: what went beyond the limits where a load turns a bare rotor, until that was reckoned
with."""


@pytest.mark.parametrize("case", LOADED)
def test_a_load_that_turns_the_rotor_is_reckoned_with(case: tuple[int, int]) -> None:
    start_case(*case)
