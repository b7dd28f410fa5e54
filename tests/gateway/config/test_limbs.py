"""Robot files of several limbs: what they give, every mistake in them, and what such a robot is asked."""

from __future__ import annotations

import pytest

from brain.bodies.limbs import LimbPlace, limbs
from gateway.config import cannot, load_robot, resources
from gateway.config.describe import describe
from gateway.config.errors import Mistakes
from gateway.config.files import with_files
from gateway.config.mission import parse_mission
from gateway.config.robot_file import parse_robot
from gateway.errors import ConfigError
from protocols import messages as msg
from protocols.plugin import load

PATH = resources.find("robots", "mobile_arm")
TEXT = with_files(PATH.read_text(), PATH, Mistakes("", ""), load)
BASE, TWO = load_robot("mobile_arm"), load_robot("two_arms")


def test_a_base_with_an_arm_is_one_robot() -> None:
    able = BASE.brain.abilities(BASE.motors)
    assert able.base is BASE.brain.base
    assert able.wheels == ("left", "right")
    assert list(able.arms) == ["arm"]
    assert able.joints == ("turn", "shoulder", "elbow", "forearm_roll", "wrist_pitch", "wrist_roll", "grip")
    arm = limbs(BASE.brain.body)["arm"]
    assert (arm.mounted_on, arm.at) == ("base", LimbPlace(0.2, 0.0, 0.2))
    told = describe(BASE)
    assert "limb base: differential\n  radius = 0.4" in told
    assert "limb arm: arm\n  on base\n  at 0.2, 0, 0.2 m" in told


def test_it_is_asked_to_drive_and_to_bring_its_tool_somewhere() -> None:
    tool = parse_mission("[[steps]]\ngoto = [1, 0]\n[[steps]]\ntool = [0.5, 0, 0.4]")
    assert cannot(tool, BASE) == ""
    assert cannot(msg.Drive(0.1, 0.0), BASE) == ""
    assert cannot(msg.Position("elbow", 1.0), BASE) == ""
    assert cannot(msg.Position("elbow", 3.0), BASE) == "elbow goes from -0.2 to 2.6, not to 3"
    assert cannot(msg.Velocity("left", 1.0), BASE).startswith("'left' moves the base: use goal or drive")
    assert cannot(tool, load_robot("diffbot")) == "step 2: there is no arm to bring the tool there"
    assert cannot(tool, load_robot("arm")) == "step 1: goto: there is no base to drive"
    assert cannot(tool, load_robot("bench")) == "step 1: goto: there is no base to drive"


def test_a_step_names_one_of_two_arms() -> None:
    def told(more: str) -> str:
        return cannot(parse_mission(f"[[steps]]\ntool = [0.3, 0.1, 0.3]\n{more}"), TWO)

    assert told('limb = "left"') == ""
    assert told("") == "step 1: which arm? expected limb = 'left' or 'right'"
    assert told('limb = "lift"') == "step 1: there is no arm 'lift'; there are left, right"
    with pytest.raises(ConfigError, match=r"limb: found 3, expected a name"):
        told("limb = 3")


MISTAKES = [
    ('body = "differential"', 'body = "diferential"', "limbs.base.body", "did you mean 'differential'"),
    ('body = "arm"\n', "", "limbs.arm.body", "missing; expected the name of a body"),
    (
        'mounted_on = "base"',
        'mounted_on = "bass"',
        "limbs.arm.mounted_on",
        "mounted_on = 'bass' is no base; the base is 'base'",
    ),
    (
        'mounted_on = "base"',
        'mounted_on = "arm"',
        "limbs.arm.mounted_on",
        "mounted_on = 'arm' is no base; the base is 'base'",
    ),
    ("at = { x = 0.2, z = 0.2 }", "at = { x = 20.0 }", "limbs.arm.at.x", "from -10 to 10 m"),
    ("at = { x = 0.2, z = 0.2 }", "at = { x = 0.2, roll = 1.0 }", "limbs.arm.at.roll", "no key 'roll'"),
    ('left = "left"\n', 'left = "turn"\n', "limbs.arm", "'turn' is a motor of 'base' and of 'arm'"),
    ('left = "left"\n', 'left = "lefft"\n', "limbs.base.left", "did you mean 'left'"),
    ("wheel_radius = 0.08 ", "wheel_radius = 0.0 ", "limbs.base.wheel_radius", "m"),
    ("[limbs.base]", "[limbs.stop]", "limbs.stop", "a setting of the brain is called 'stop'"),
    ("[brain.perception]", "[brain]\nbody = 1\n[brain.perception]", "brain.body", "the file has limbs"),
    (
        '[limbs.arm]\nbody = "arm"',
        '[limbs.arm]\nbody = "arm"\nradius = 3',
        "limbs.arm.radius",
        "no key 'radius'",
    ),
]


@pytest.mark.parametrize(("old", "new", "key", "words"), MISTAKES)
def test_each_mistake_has_its_key_and_its_line(old: str, new: str, key: str, words: str) -> None:
    assert old in TEXT
    with pytest.raises(ConfigError) as caught:
        parse_robot(TEXT.replace(old, new, 1))
    found = [one for one in caught.value.mistakes if words in one.text]
    assert key in [one.key for one in found], caught.value
    assert all(one.line for one in found)


def test_two_bases_are_one_too_many() -> None:
    second = '[limbs.other]\nbody = "differential"\nleft = "turn"\nright = "elbow"\nradius = 0.4\n'
    rest = "wheel_radius = 0.1\nwheel_separation = 0.4\nmax_linear = 1.0\nmax_angular = 1.0\n"
    limits = "max_linear_acceleration = 1.0\nmax_angular_acceleration = 1.0\n"
    with pytest.raises(ConfigError, match="a robot has one base at most, not base, other"):
        parse_robot(TEXT.replace("[limbs.arm]", f"{second}{rest}{limits}\n[limbs.arm]"))
