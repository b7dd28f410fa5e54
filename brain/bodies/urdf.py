"""URDF: the text of a robot's links and joints as a `UrdfModel`.

Rules. What a brain needs is read: kinematics, limits, inertia, plain shapes; and for a picture the names of
meshes, and colours. Transmissions and what simulators add are skipped. What ROS's own parser takes is taken,
as far as it has a meaning: the axis of a joint that does not move is not read; a limit that is negative,
infinite or beyond the bounds below is none; an inertia that no body has is a mistake of who uses it. Every
mistake becomes a sentence, all of one ValueError. A text with an entity, or beyond the bounds, is refused
before it is read further.

Source: the URDF specification at wiki.ros.org/urdf/XML (robot, link, joint); urdfdom for what is taken (no
namespaces, anything in comments). Lengths in m, angles in rad; a joint's frame is its child link's, at
position 0 at `origin` in the parent link's frame; roll, pitch and yaw turn about the fixed axes x, y, z, in
this order.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, NamedTuple, TypeAlias, cast, get_args
from xml.parsers import expat

MOST_CHARACTERS, MOST_LINKS, MOST_ELEMENTS, MOST_DEPTH = 1_000_000, 512, 20_000, 32
FARTHEST, HEAVIEST = 1e3, 1e5
"""m and rad; kg and kg·m²"""
FASTEST, STRONGEST = 1e3, 1e5
"""rad/s and m/s; N·m and N: what is beyond means no limit"""
EXPAND = (
    "it is xacro that was not expanded: make a URDF of it by `xacro FILE.xacro > FILE.urdf` (pip install "
    "xacro), or where it has $(find …) by `xacrodoc FILE.xacro -o FILE.urdf` (pip install xacrodoc)"
)
OTHERS = {
    "sdf": "Gazebo's SDF",
    "mujoco": "MuJoCo's MJCF",
    "COLLADA": "a mesh",
}
"""What is taken for a URDF, by its root element."""
Vector: TypeAlias = tuple[float, float, float]
Kind: TypeAlias = Literal["revolute", "continuous", "prismatic", "fixed", "floating", "planar"]
Numbers: TypeAlias = dict[str, float]


class Origin(NamedTuple):
    """A frame in another: m; roll, pitch, yaw in rad."""

    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)


class Inertial(NamedTuple):
    """Mass of a link, in the frame of its centre of mass."""

    origin: Origin
    mass: float
    """kg"""
    inertia: tuple[float, float, float, float, float, float]
    """kg·m²: xx, xy, xz, yy, yz, zz"""
    wrong: str = ""
    """Why no body has it, as a sentence; "": one can."""


Colour: TypeAlias = tuple[float, float, float]
"""Red, green, blue: 0 to 1."""


class Geometry(NamedTuple):
    """A box (x, y, z), cylinder (radius, length along z) or sphere (radius) in its link's frame [m].

    Of what a link only looks like: a mesh (its scales along x, y, z), too; of a body without a URDF a prism
    (its height along z, then x and y of each corner of its foot)."""

    kind: str
    size: tuple[float, ...]
    origin: Origin
    colour: Colour | None = None
    file: str = ""
    """Of a mesh, as the URDF names it"""


class Link(NamedTuple):
    """A rigid body."""

    name: str
    inertial: Inertial | None
    shapes: tuple[Geometry, ...]
    """What it collides with; where it has nothing, what it looks like."""
    looks: tuple[Geometry, ...] = ()
    """What it looks like, meshes too; where that is nothing, what it collides with."""


class UrdfJoint(NamedTuple):
    """What connects a link to its parent; limits are None where the kind of joint has none."""

    name: str
    kind: Kind
    parent: str
    child: str
    origin: Origin
    axis: Vector
    """In the child's frame, of length 1."""
    range: tuple[float, float] | None
    """rad, or m of a prismatic joint"""
    velocity: float | None
    """rad/s, m/s"""
    effort: float | None
    """N·m, N"""
    mimics: str = ""
    """The joint that this one follows."""

    @property
    def moves(self) -> bool:
        """Whether it has one degree of freedom."""
        return self.kind in ("revolute", "continuous", "prismatic")


@dataclass(frozen=True, slots=True)
class UrdfModel:
    """The links and joints of a robot, by name; parents are before their children."""

    name: str
    root: str
    links: dict[str, Link]
    joints: dict[str, UrdfJoint]
    joint_of: dict[str, UrdfJoint]
    """The joint above each link but the root."""

    def above(self, link: str) -> Iterator[UrdfJoint]:
        """Yield the joints from a link up to the root."""
        while link in self.joint_of:
            joint = self.joint_of[link]
            yield joint
            link = joint.parent


@lru_cache(maxsize=8)
def parse(text: str) -> UrdfModel:
    """Return the model of a URDF's text. Raises ValueError with every mistake, in sentences."""
    reader = _Reader()
    root = read(text)
    reader.materials(root)
    links = {link.name: link for element in root.findall("link") if (link := reader.link(element))}
    joints = {one.name: one for element in root.findall("joint") if (one := reader.joint(element))}
    model = reader.model(root.get("name", ""), links, joints)
    if reader.mistakes or model is None:
        raise ValueError("; ".join(reader.mistakes))
    return model


def read(text: str) -> ET.Element:
    """Return the element <robot>, whose size is bounded. Raises ValueError if it is none."""
    if len(text) > MOST_CHARACTERS:
        raise ValueError(f"the URDF is too large: expected at most {MOST_CHARACTERS} characters")
    if "<!ENTITY" in text:
        raise ValueError("the URDF has an ENTITY: expected plain elements only")
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    depth = count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > MOST_DEPTH or count > MOST_ELEMENTS:
            raise ValueError(
                f"the URDF has more than {MOST_ELEMENTS} elements, or {MOST_DEPTH} in each other"
            )
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    for name, handler in (("StartElementHandler", start), ("EndElementHandler", end)):
        setattr(parser, name, handler)
    try:
        parser.Parse(COMMENT.sub(_lines, text.lstrip("\ufeff \t\r\n")), True)
    except expat.ExpatError as error:
        raise ValueError(f"the URDF is not XML: {error}") from error
    root = builder.close()
    if root.tag != "robot":
        known = f" ({OTHERS[root.tag]})" if root.tag in OTHERS else ""
        raise ValueError(f"the URDF has the root <{root.tag[:40]}>{known}, expected <robot>")
    if any(one.tag.startswith("xacro:") or "${" in "".join(one.attrib.values()) for one in root.iter()):
        raise ValueError(f"the URDF cannot be read: {EXPAND}")
    return root


COMMENT = re.compile("<!--.*?-->", re.DOTALL)


def _lines(comment: re.Match[str]) -> str:
    """Return the ends of lines in a comment, so that those after it keep their numbers."""
    return "\n" * comment.group().count("\n")


@dataclass(slots=True)
class _Reader:
    """Turns elements into values, and notes what is wrong with them."""

    mistakes: list[str] = field(default_factory=list)
    names: set[tuple[str, str]] = field(default_factory=set)
    colours: dict[str, Colour | None] = field(default_factory=dict)
    """Of the materials that the robot names"""

    def wrong(self, sentence: str) -> None:
        if len(self.mistakes) < 20:
            self.mistakes.append(sentence)

    def name(self, element: ET.Element) -> str:
        """Return the name of a link or joint; "" with a mistake if it has none, or not for itself."""
        name = element.get("name", "")
        if not name:
            self.wrong(f"a <{element.tag}> has no name")
        elif (element.tag, name) in self.names:
            self.wrong(f"there are two of the name {name!r}: <{element.tag}>")
            return ""
        self.names.add((element.tag, name))
        return name

    def numbers(
        self, element: ET.Element, key: str, default: str, what: str, count: int, most: float = HEAVIEST
    ) -> tuple[float, ...]:
        """Return the numbers of an attribute; zeros, with a mistake, if they are not as they should be."""
        written = element.get(key, default)
        try:
            found = tuple(map(float, written.split()))
        except ValueError:
            found = ()
        if len(found) == count and all(abs(one) <= most for one in found):
            return found
        wanted = "a number" if count == 1 else f"{count} numbers"
        within = f" within ±{most:g}" if most < math.inf else ""
        self.wrong(f"{what}: {key} is {written[:40]!r}, expected {wanted}{within}")
        return (0.0,) * count

    def number(self, element: ET.Element, key: str, default: str, what: str) -> float:
        """Return the number of an attribute, of any size."""
        return self.numbers(element, key, default, what, 1, math.inf)[0]

    def origin(self, element: ET.Element | None, what: str) -> Origin:
        if element is None:
            return Origin()
        xyz = cast(Vector, self.numbers(element, "xyz", "0 0 0", what, 3))
        rpy = cast(Vector, self.numbers(element, "rpy", "0 0 0", what, 3))
        if max(map(abs, (*xyz, *rpy))) > FARTHEST:
            self.wrong(f"{what}: its origin is farther than {FARTHEST:g}")
        return Origin(xyz, rpy)

    def link(self, element: ET.Element) -> Link | None:
        name = self.name(element)
        if not name:
            return None
        what = f"link {name!r}"
        given = element.find("inertial")
        inertial = None if given is None else self.inertial(given, what)
        solid = element.findall("collision") or element.findall("visual")
        shapes = tuple(shape for one in solid if (shape := self.shape(one, what)))
        seen = _Reader(colours=self.colours)  # what is wrong with what a link looks like is no mistake
        looks = tuple(
            look._replace(colour=self.colour(one.find("material")))
            for one in element.findall("visual")
            if (look := seen.shape(one, what) or seen.mesh(one, what))
        )
        return Link(name, inertial, shapes, looks or shapes)

    def materials(self, root: ET.Element) -> None:
        """Note the colours that the robot names."""
        for one in root.iter("material"):
            if one.find("color") is not None:
                self.colours[one.get("name", "")] = self.colour(one)

    def colour(self, material: ET.Element | None) -> Colour | None:
        """Return the colour of a material; None: it has none that can be read, which is no mistake here."""
        if material is None:
            return None
        if (given := material.find("color")) is None:
            return self.colours.get(material.get("name", ""))
        try:
            red, green, blue = (float(one) for one in given.get("rgba", "").split()[:3])
        except ValueError:
            return None
        shares = (red, green, blue)
        return shares if all(0.0 <= one <= 1.0 for one in shares) else None

    def mesh(self, element: ET.Element, what: str) -> Geometry | None:
        """Return the mesh that a link looks like; None if it is none."""
        mesh = element.find("geometry/mesh")
        if mesh is None or not mesh.get("filename"):
            return None
        scale = self.numbers(mesh, "scale", "1 1 1", what, 3)
        origin = self.origin(element.find("origin"), what)
        return Geometry("mesh", scale, origin, file=mesh.get("filename", ""))

    def inertial(self, element: ET.Element, what: str) -> Inertial | None:
        mass, inertia = element.find("mass"), element.find("inertia")
        if mass is None or inertia is None:
            self.wrong(f"{what}: its <inertial> needs <mass> and <inertia>")
            return None
        keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        xx, xy, xz, yy, yz, zz = (self.number(inertia, key, "0", what) for key in keys)
        kg = self.number(mass, "value", "", what)
        moments = (xx, xy, xz, yy, yz, zz)
        most = sum((xx, yy, zz)) / 2.0 * (1.0 + 1e-6) + 1e-12
        wrong = ""
        if kg < 0.0 or min(xx, yy, zz) < 0.0:
            wrong = f"{what}: mass and moments of inertia must not be negative"
        elif max(kg, *map(abs, moments)) > HEAVIEST:
            wrong = f"{what}: mass or inertia is more than {HEAVIEST:g}"
        elif max(xx, yy, zz) > most:
            wrong = f"{what}: no body has these moments of inertia, {xx:g}, {yy:g}, {zz:g}"
        return Inertial(self.origin(element.find("origin"), what), kg, moments, wrong)

    def shape(self, element: ET.Element, what: str) -> Geometry | None:
        geometry = element.find("geometry")
        sizes = {"box": ("size", 3), "cylinder": ("radius", 1), "sphere": ("radius", 1)}
        for one in () if geometry is None else geometry:
            if one.tag in sizes:
                key, count = sizes[one.tag]
                size = self.numbers(one, key, "", what, count)
                if one.tag == "cylinder":
                    size += self.numbers(one, "length", "", what, 1)
                origin = self.origin(element.find("origin"), what)
                return Geometry(one.tag, size, origin) if min(size) > 0.0 else None
        return None

    def joint(self, element: ET.Element) -> UrdfJoint | None:
        name, kind = self.name(element), element.get("type", "")
        if not name:
            return None
        what = f"joint {name!r}"
        if kind not in get_args(Kind):
            self.wrong(f"{what}: its type is {kind[:40]!r}, expected {', '.join(get_args(Kind))}")
            return None
        ends = []
        for tag in ("parent", "child"):
            found = element.find(tag)
            ends.append("" if found is None else found.get("link", ""))
            if not ends[-1]:
                self.wrong(f"{what}: it has no <{tag} link=…>")
        axis = (1.0, 0.0, 0.0)
        if (given := element.find("axis")) is not None and kind not in ("fixed", "floating"):
            axis = cast(Vector, self.numbers(given, "xyz", "1 0 0", what, 3))
        length = math.hypot(*axis)
        if length < 1e-6:
            self.wrong(f"{what}: its axis, 0 0 0, has no direction: only a fixed joint may have that")
            length = 1.0
        x, y, z = (one / length for one in axis)
        limits = self.limits(element.find("limit"), kind, what)
        mimic = element.find("mimic")
        mimics = "" if mimic is None else mimic.get("joint", "")
        origin = self.origin(element.find("origin"), what)
        return UrdfJoint(name, cast(Kind, kind), ends[0], ends[1], origin, (x, y, z), *limits, mimics)

    def limits(
        self, element: ET.Element | None, kind: str, what: str
    ) -> tuple[tuple[float, float] | None, float | None, float | None]:
        bounded = kind in ("revolute", "prismatic")
        if element is None:
            if bounded:
                self.wrong(f"{what}: a {kind} joint needs a <limit>")
            return None, None, None
        low, high = sorted(self.number(element, key, "0", what) for key in ("lower", "upper"))
        velocity, effort = (self.number(element, key, "0", what) for key in ("velocity", "effort"))
        endless = not bounded or (low < -FARTHEST and high > FARTHEST)
        return (
            None if endless else (max(low, -FARTHEST), min(high, FARTHEST)),
            velocity if 0.0 < velocity <= FASTEST else None,
            effort if 0.0 < effort <= STRONGEST else None,
        )

    def model(self, name: str, links: dict[str, Link], joints: dict[str, UrdfJoint]) -> UrdfModel | None:
        """Return the tree of these joints, if they form one."""
        above: dict[str, UrdfJoint] = {}
        below: dict[str, list[UrdfJoint]] = {}
        for joint in joints.values():
            for link in (joint.parent, joint.child):
                if link and link not in links:
                    self.wrong(f"joint {joint.name!r}: there is no link {link!r}")
            if joint.child in above:
                self.wrong(f"link {joint.child!r} has two joints above it, expected one")
            above[joint.child] = joint
            below.setdefault(joint.parent, []).append(joint)
        roots = [link for link in links if link not in above]
        if not links:
            self.wrong("there is no <link>, expected one tree of links")
        elif len(links) > MOST_LINKS:
            self.wrong(f"there are {len(links)} links, expected at most {MOST_LINKS}")
        elif len(roots) != 1:
            found = (
                f"{len(roots)} links without a joint above them ({', '.join(roots[:5])})"
                if roots
                else "a loop"
            )
            self.wrong(f"there is {found}, expected one tree of links")
        if self.mistakes:
            return None
        order, ordered = [roots[0]], {}
        for link in order:
            for joint in below.get(link, ()):
                ordered[joint.name] = joint
                order.append(joint.child)
        if len(order) < len(links):
            lost = next(link for link in links if link not in order)
            self.wrong(f"link {lost!r} is in a loop, expected one tree of links")
            return None
        return UrdfModel(name, roots[0], {link: links[link] for link in order}, ordered, above)
