"""Mission files: what ships can be done by every base, and every mistake is told at once, with its line."""

from __future__ import annotations

import pytest

from gateway.config import load_mission, load_robot, parse_mission
from gateway.errors import ConfigError, UserError
from protocols import messages as msg
from protocols.message_codec import pack, unpack

EVERY_STEP = """
name = "all"
[[steps]]
goto = [1, 2.5]
yaw_deg = 180
near = true
[[steps]]
drive = 0.3
left = -0.1
turn_deg = 90
seconds = 2
distance = 1.5
[[steps]]
turn_deg = -90
[[steps]]
follow = [[0, 1], [2, 3]]
[[steps]]
wait = 5
[[steps]]
dock = 3
distance = 0.4
[[steps]]
joints = {lift = 0.2, jaw = {torque = 1}, wrist = "hold", arm = {position = 1, stiffness = 20, damping = 2}}
seconds = 2
contact = true
[[steps]]
tool = [0.3, 0, 0.2]
attitude_deg = [0, 90, 0]
[[steps]]
repeat = 0
steps = [{wait = 1, on_failure = "skip"}, {wait = 2, on_failure = [{turn_deg = 1}]}]
"""


def test_every_kind_of_step_is_read_and_recorded() -> None:
    half, mission = 1.5707963267948966, parse_mission(EVERY_STEP)
    arm = msg.Impedance("arm", 1.0, 0.0, 0.0, 20.0, 2.0)
    joints = (msg.Position("lift", 0.2), msg.Torque("jaw", 1.0), msg.Hold("wrist"), arm)
    assert mission == msg.Mission(
        "all",
        (
            msg.Goal(1.0, 2.5, 2 * half, True),
            msg.Move(0.3, -0.1, half, 2.0, 1.5),
            msg.Turn(-half),
            msg.Follow(((0.0, 1.0), (2.0, 3.0))),
            msg.Wait(5.0),
            msg.Dock(3, 0.4),
            msg.Reach(joints, 2.0, True),
            msg.MoveTool(0.3, 0.0, 0.2, (0.0, half, 0.0)),
            msg.Repeat(0, (msg.Try((msg.Wait(1.0),)), msg.Try((msg.Wait(2.0),), (msg.Turn(half / 90),)))),
        ),
    )
    assert unpack(pack(mission)) == mission


def test_every_mistake_is_told_at_once_with_its_line() -> None:
    text = """nam = "x"
[[steps]]
goto = [1]
[[steps]]
trun_deg = 3
[[steps]]   # a comment
drive = 0.5
secnds = 3
on_failure = "ignore"
[[steps]]
repeat = 2
steps = [{wait = "a"}, {joints = {a = {torq = 1}}}, 3]
"""
    with pytest.raises(ConfigError) as caught:
        parse_mission(text, "m.toml")
    told = [str(line).removeprefix("m.toml:") for line in str(caught.value).splitlines()]
    assert told == MISTAKES.strip().splitlines()


MISTAKES = """
1: nam: no key 'nam': there is name, on_failure, steps; did you mean 'name'?
2: step 1: goto: found an array, expected 2 numbers
4: step 2: found trun_deg, expected exactly one of \
goto, drive, turn_deg, follow, wait, dock, joints, tool, repeat
6: step 3: no key 'secnds': there is \
drive, left, turn_deg, seconds, distance, on_failure; did you mean 'seconds'?
6: step 3: on_failure: found "ignore", expected "stop", "skip", or steps
10: step 4.1: wait: found "a", expected a number, up to a million
10: step 4.2: joints: found a table, expected for a: a number (rad), or position, velocity, torque
10: step 4.3: found 3, expected a table
"""


def test_what_the_file_says_of_failures_counts_within_a_repeat() -> None:
    text = 'on_failure = "skip"\n[[steps]]\nrepeat = 0\nsteps = [{wait = 1}, {wait = 2}]'
    once = msg.Try((msg.Wait(1.0),)), msg.Try((msg.Wait(2.0),))
    assert parse_mission(text).steps == (msg.Try((msg.Repeat(0, once),)),)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "there are no steps"),
        ("steps = 3", "expected an array of steps"),
        ("[[steps]]\nwait = nan", "expected a number, up to a million"),
        ("[[steps]]\nwait = 1\nrepeat = 1", "found wait and repeat, expected exactly one"),
        ("[[steps]]\nrepeat = 1", "step 1: expected an array of steps"),
        ("[[steps]]\nrepeat = -1\nsteps = []", "expected a whole number, at least 0"),
        ("steps = " + "[" * 5000, "not TOML" + "|nested too deep"),
        ("[[steps]]\nwait = ", "not TOML"),
    ],
)
def test_what_is_no_mission_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_mission(text)
    assert any(each in str(caught.value) for each in reason.split("|"))


@pytest.mark.parametrize("robot", ["diffbot", "ackermann", "mecanum", "swerve", "tracked"])
def test_the_rounds_can_be_driven_by_every_base(robot: str) -> None:
    assert len(load_mission("rounds", load_robot(robot)).steps) == 7


def test_a_robot_that_cannot_do_it_is_told_why() -> None:
    with pytest.raises(UserError, match="'bench' cannot do this: step 1: goto: there is no base to drive"):
        load_mission("rounds", load_robot("bench"))
    with pytest.raises(UserError, match="did you mean 'rounds'"):
        load_mission("round")
