"""What is read of a URDF, and every sentence about one that is wrong."""

from __future__ import annotations

import math
from typing import Any

import pytest

from brain.bodies import urdf
from brain.bodies.chain import Chain

ARM = """<?xml version="1.0"?>
<robot name="two">
  <!-- a comment, and what others need -->
  <material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
  <link name="base">
    <collision><origin xyz="0 0 0.1"/><geometry><box size="0.2 0.3 0.2"/></geometry></collision>
  </link>
  <link name="upper">
    <inertial><origin xyz="0 0 0.1" rpy="0 0 1"/><mass value="1.5"/>
      <inertia ixx="0.02" ixy="0" ixz="0.001" iyy="0.02" iyz="0" izz="0.01"/></inertial>
    <visual><geometry><cylinder radius="0.03" length="0.2"/></geometry></visual>
    <visual><geometry><mesh filename="package://none/upper.stl"/></geometry></visual>
  </link>
  <link name="finger"><collision><geometry><sphere radius="0.01"/></geometry></collision></link>
  <link name="tip"/>
  <joint name="slide" type="prismatic"><parent link="tip"/><child link="finger"/>
    <limit lower="0" upper="0.05" velocity="0.2" effort="30"/><mimic joint="turn"/></joint>
  <joint name="turn" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.2" rpy="0 1.5707963267948966 0"/><axis xyz="0 0 2"/>
    <limit lower="-1" upper="2" velocity="3" effort="20"/><dynamics damping="0.1"/></joint>
  <joint name="end" type="fixed"><parent link="upper"/><child link="tip"/><origin xyz="0.1 0 0"/></joint>
  <transmission name="t"/><gazebo reference="tip"/>
</robot>"""


def test_what_is_read() -> None:
    model = urdf.parse(ARM)
    assert (model.name, model.root) == ("two", "base")
    assert list(model.joints) == ["turn", "end", "slide"]  # parents first, whatever the order in the file
    turn, slide = model.joints["turn"], model.joints["slide"]
    assert (turn.kind, turn.parent, turn.child, turn.axis) == ("revolute", "base", "upper", (0.0, 0.0, 1.0))
    assert (turn.range, turn.velocity, turn.effort, turn.moves) == ((-1.0, 2.0), 3.0, 20.0, True)
    assert turn.origin == urdf.Origin((0.0, 0.0, 0.2), (0.0, math.pi / 2, 0.0))
    assert (slide.axis, slide.mimics, model.joints["end"].moves) == ((1.0, 0.0, 0.0), "turn", False)
    inertial = model.links["upper"].inertial
    assert inertial == urdf.Inertial(
        urdf.Origin((0.0, 0.0, 0.1), (0.0, 0.0, 1.0)), 1.5, (0.02, 0.0, 0.001, 0.02, 0.0, 0.01)
    )
    shapes = {name: [(one.kind, one.size) for one in link.shapes] for name, link in model.links.items()}
    assert shapes == {
        "base": [("box", (0.2, 0.3, 0.2))],
        "upper": [("cylinder", (0.03, 0.2))],
        "tip": [],
        "finger": [("sphere", (0.01,))],
    }
    assert [joint.name for joint in model.above("finger")] == ["slide", "end", "turn"]


TURN = '<joint name="turn" type="revolute"><parent link="base"/><child link="upper"/>'


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('<?xml version="1.0"?>', '<!DOCTYPE r [<!ENTITY a "b">]>', "expected plain elements only"),
        ("</robot>", "", "is not XML"),
        ("</robot>", "&lol;</robot>", "is not XML: undefined entity"),
        ("robot", "robots", "has the root <robots>, expected <robot>"),
        ('name="tip"', 'name="upper"', "there are two of the name 'upper': <link>"),
        ('<link name="tip"/>', "<link/>", "a <link> has no name"),
        ('mass value="1.5"', 'mass value="heavy"', "link 'upper': value is 'heavy', expected a number"),
        ('mass value="1.5"', 'mass value="nan"', "value is 'nan', expected a number"),
        ('xyz="0 0 2"', 'xyz="0 0 0"', "joint 'turn': its axis, 0 0 0, has no direction"),
        ('xyz="0 0 0.2"', 'xyz="0 0"', "joint 'turn': xyz is '0 0', expected 3 numbers"),
        ('xyz="0 0 0.2"', 'xyz="0 0 2000"', "its origin is farther than 1000"),
        ('type="revolute"', 'type="ball"', "its type is 'ball', expected revolute, continuous"),
        ('<limit lower="-1" upper="2" velocity="3" effort="20"/>', "", "a revolute joint needs a <limit>"),
        ('child link="upper"', 'child link="lower"', "joint 'turn': there is no link 'lower'"),
        ('<child link="upper"/>', "", "joint 'turn': it has no <child link=…>"),
        ('child link="upper"', 'child link="tip"', "link 'tip' has two joints above it, expected one"),
        (TURN, TURN.replace("base", "finger"), r"2 links without a joint above them|is in a loop"),
        ('<link name="tip"/>', '<link name="tip"/><link name="other"/>', r"\(base, other\), expected one"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(old: str, new: str, sentence: str) -> None:
    assert old in ARM
    with pytest.raises(ValueError, match=sentence):
        urdf.parse(ARM.replace(old, new))


LIMIT = '<limit lower="-1" upper="2" velocity="3" effort="20"/>'
END = '<joint name="end" type="fixed">'
INERTIA = '<inertia ixx="0.02" ixy="0" ixz="0.001" iyy="0.02" iyz="0" izz="0.01"/>'


def turn(model: urdf.UrdfModel) -> object:
    joint = model.joints["turn"]
    return joint.range, joint.velocity, joint.effort


def unusable(model: urdf.UrdfModel) -> str:
    inertial = model.links["upper"].inertial
    return inertial.wrong if inertial else ""


@pytest.mark.parametrize(
    ("old", "new", "look", "read"),
    [
        ('<?xml version="1.0"?>', '\n\n<?xml version="1.0" encoding="latin1"?>', lambda it: it.root, "base"),
        ('<?xml version="1.0"?>', "<!DOCTYPE robot>", lambda it: it.root, "base"),
        ("<!-- a comment", "<!-- --- two dashes -- a comment", lambda it: len(it.links), 4),
        ("<gazebo", "<sensor:camera name='eye'/><gazebo", lambda it: len(it.links), 4),
        ("<robot", "<robot xmlns:xacro='http://ros.org/wiki/xacro'", lambda it: it.name, "two"),
        (END, END + '<axis xyz="0 0 0"/>', lambda it: it.joints["end"].axis, (1.0, 0.0, 0.0)),
        (END, END + '<axis xyz="z"/><limit lower="2" upper="1"/>', lambda it: it.joints["end"].range, None),
        (LIMIT, LIMIT.replace("-1", "-1e16").replace('"2"', '"1e16"'), turn, (None, 3.0, 20.0)),
        (LIMIT, LIMIT.replace("-1", "-inf").replace('"2"', '"inf"'), turn, (None, 3.0, 20.0)),
        (LIMIT, LIMIT.replace("-1", "-1e16"), turn, ((-1e3, 2.0), 3.0, 20.0)),
        ('lower="-1" upper="2"', 'lower="2" upper="-1"', turn, ((-1.0, 2.0), 3.0, 20.0)),
        (LIMIT, '<limit velocity="-1" effort="-1"/>', turn, ((0.0, 0.0), None, None)),
        (LIMIT, LIMIT.replace("20", "1e7").replace('"3"', '"1e16"'), turn, ((-1.0, 2.0), None, None)),
        (INERTIA, INERTIA.replace("0.01", "0.1"), unusable, "no body has these moments of inertia, 0.02"),
        ('mass value="1.5"', 'mass value="-1"', unusable, "must not be negative"),
        ('mass value="1.5"', 'mass value="1e9"', unusable, "is more than 100000"),
        (INERTIA, "<inertia/>", unusable, ""),
        ('box size="0.2 0.3 0.2"', 'box size="0 0 0"', lambda it: it.links["base"].shapes, ()),
        ('sphere radius="0.01"', 'capsule radius="0.01"', lambda it: it.links["finger"].shapes, ()),
        ('<link name="tip"/>', '<link name="tip"><material/></link>', lambda it: len(it.links), 4),
    ],
)  # fmt: skip
def test_what_the_world_writes_is_read(old: str, new: str, look: Any, read: object) -> None:
    assert old in ARM
    found = look(urdf.parse(ARM.replace(old, new)))
    assert read in found if isinstance(read, str) else found == read


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            '<robot xmlns:xacro="x"><xacro:macro name="leg"/></robot>',
            "xacro that was not expanded: make a URDF",
        ),
        ('<robot name="r"><link name="${prefix}base"/></robot>', "xacro that was not expanded: make a URDF"),
        ("<sdf version='1.6'/>", r"the root <sdf> \(Gazebo's SDF\), expected <robot>"),
        ("<mujoco/>", r"the root <mujoco> \(MuJoCo's MJCF\), expected <robot>"),
        ("<robot name='r'/>", "there is no <link>, expected one tree"),
        ("", "is not XML: no element found"),
    ],
)
def test_what_is_no_urdf_is_said(text: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        urdf.parse(text)


def test_an_inertia_that_no_body_has_is_a_mistake_of_who_uses_it() -> None:
    impossible = f'<inertial><mass value="1"/>{INERTIA.replace("0.01", "0.1")}</inertial>'
    on_base = ARM.replace('<link name="base">', f'<link name="base">{impossible}')
    assert Chain(urdf.parse(on_base), "base", "tip", ["turn"]).joints == ("turn",), "nothing moves that link"
    on_tip = ARM.replace('<link name="tip"/>', f'<link name="tip">{impossible}</link>')
    with pytest.raises(ValueError, match="link 'tip': no body has these moments of inertia"):
        Chain(urdf.parse(on_tip), "base", "tip", ["turn"])


def test_all_mistakes_at_once() -> None:
    text = (
        ARM.replace('lower="-1"', 'lower="low"')
        .replace('value="1.5"', 'value="x"')
        .replace("box size", "box six")
    )
    with pytest.raises(ValueError, match="turn") as caught:
        urdf.parse(text)
    assert len(str(caught.value).split("; ")) == 3


def test_size_and_depth_are_bounded() -> None:
    with pytest.raises(ValueError, match="too large"):
        urdf.parse("<robot>" + " " * urdf.MOST_CHARACTERS)
    with pytest.raises(ValueError, match="in each other"):
        urdf.parse("<robot>" + "<a>" * 60 + "</a>" * 60 + "</robot>")
    with pytest.raises(ValueError, match="more than 20000 elements"):
        urdf.parse("<robot>" + "<a/>" * 20_001 + "</robot>")
    many = "".join(f'<link name="l{i}"/>' for i in range(urdf.MOST_LINKS + 1))
    with pytest.raises(ValueError, match="513 links, expected at most 512"):
        urdf.parse(f"<robot>{many}</robot>")
