"""What a robot looks like, as its page gets it: parts, how they stand, meshes."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from math import pi, sin, sqrt
from pathlib import Path

import numpy as np
import pytest

from brain.bodies import urdf
from brain.bodies.chain import Array, Place, placed, rotation
from brain.bodies.limbs import limbs
from brain.bodies.parts import Part
from brain.bodies.quadruped import Quadruped
from fixtures import __file__ as fixtures
from gateway.config import load_robot
from gateway.core.robot import Robot
from gateway.core.tick import Inputs, Outputs, Tick
from gateway.view.figure import MOST_TRIANGLES, PIECE, coarser, figure, read_stl
from gateway.vision.camera import Intrinsics, Seen
from protocols.messages import Marker
from tests.gateway.view.test_view import bench

ROBOTS = Path(fixtures).parent / "robots"
NAMES = sorted(one.stem for one in ROBOTS.glob("*.toml"))


def frames(parts: Sequence[Part], at: Mapping[str, float]) -> list[Place]:
    """Return where the parts are, for these positions of motors."""
    found: list[Place] = []
    for part in parts:
        turned, origin = placed(part.origin)
        value = at.get(part.motor, part.rest) if part.motor else part.rest
        axis = np.array(part.axis)
        if part.slides:
            origin = origin + turned @ axis * value
        else:
            turned = turned @ about(axis, value)
        if part.carrier >= 0:
            outer, start = found[part.carrier]
            turned, origin = outer @ turned, start + outer @ origin
        found.append((turned, origin))
    return found


def about(axis: Array, angle: float) -> Array:
    """Return the rotation about an axis, by the rotations that bring x there and back."""
    yaw, pitch = np.arctan2(axis[1], axis[0]), -np.arcsin(axis[2])
    there = rotation(0.0, float(pitch), float(yaw))
    turned: Array = there @ rotation(angle, 0.0, 0.0) @ there.T
    return turned


@pytest.mark.parametrize("name", NAMES)
def test_every_motor_of_a_body_with_dimensions_moves_one_part(name: str) -> None:
    robot = load_robot(name)
    parts = figure(robot).parts
    assert all(part.carrier < number for number, part in enumerate(parts))
    moved = [part.motor for part in parts if part.motor]
    assert len(moved) == len(set(moved))
    bodies = [limb.body for limb in limbs(robot.brain.body).values()]
    assert set(moved) == {joint for body in bodies if not body.bare for joint in body.joints}


@pytest.mark.parametrize("name", ["arm", "boom", "two_arms", "mobile_arm", "pan_tilt"])
def test_an_arm_is_drawn_as_its_kinematics_has_it(name: str) -> None:
    robot = load_robot(name)
    seen = figure(robot)
    for limb in limbs(robot.brain.body).values():
        arm = limb.body.as_linkage
        if arm is None:
            continue
        lengths = [low + 0.3 * (high - low) for low, high in arm.ranges]
        at: dict[str, float | None] = dict(zip(arm.joints, lengths, strict=True))
        moved = [part.motor for part in seen.parts if part.motor]
        stands = dict(zip(moved, seen.stands(robot, at), strict=True))
        places = frames(seen.parts, {motor: value for motor, value in stands.items() if value is not None})
        found = {part.motor: place[1] for part, place in zip(seen.parts, places, strict=True)}
        for motor, point in zip(arm.of_tip, arm.points(lengths)[1:], strict=False):
            assert found[motor] == pytest.approx(limb.at.outward(*point), abs=1e-3)


def test_a_quadruped_without_a_urdf_is_drawn_by_its_own_dimensions_as_its_legs_are() -> None:
    body = load_robot("quadruped").brain.body
    assert isinstance(body, Quadruped)
    parts = body.parts()
    legs = (body.front_left, body.front_right, body.rear_left, body.rear_right)
    angles = (0.2, -0.7, 1.3)
    at = {motor: angle for leg in legs for motor, angle in zip(leg, angles, strict=True)}
    places = dict(zip((part.motor for part in parts), frames(parts, at), strict=True))
    for number, (hip, _, knee) in enumerate(legs):
        turned, origin = places[knee]
        foot = origin + turned @ np.array((0.0, 0.0, -body.shank))
        assert foot - places[hip][1] == pytest.approx(body.leg(number).foot(angles), abs=1e-9)


def test_where_a_position_is_not_known_a_part_is_at_rest() -> None:
    robot = load_robot("arm")
    assert figure(robot).stands(robot, {"turn": 1.0, "elbow": float("nan")}) == [1.0, *[None] * 6]


# -- meshes ------------------------------------------------------------------------------------------

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], dtype=np.float32)
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
TETRAHEDRON = np.array([[CORNERS[one] for one in face] for face in FACES], dtype=np.float32)


def binary(triangles: Iterable[object]) -> bytes:
    """Return an STL file, as its description has it: header, count, normal and corners, attribute."""
    facets = [struct.pack("<12fH", 0, 0, 0, *np.asarray(one, dtype=float).ravel(), 0) for one in triangles]
    return b"solid by chance".ljust(80) + struct.pack("<I", len(facets)) + b"".join(facets)


def text(triangles: Iterable[object]) -> bytes:
    lines = ["solid t"]
    for one in triangles:
        lines += ["facet normal 0 0 0", " outer loop"]
        lines += ["  vertex {:e} {:e} {:e}".format(*corner) for corner in np.asarray(one, dtype=float)]
        lines += [" endloop", "endfacet"]
    return "\n".join([*lines, "endsolid t", ""]).encode()


@pytest.mark.parametrize("write", [binary, text])
def test_both_forms_of_stl_are_read(write: Callable[[Iterable[object]], bytes]) -> None:
    assert read_stl(write(TETRAHEDRON)) == pytest.approx(TETRAHEDRON)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "no STL"),
        (b"PK\3\4" + bytes(200), "no STL"),
        (binary(TETRAHEDRON)[:-1], "no STL|no triangles"),
        (binary(TETRAHEDRON) + b"\0", "no STL|no triangles"),
        (binary([]), "no triangles"),
        (binary([np.full((3, 3), np.nan)]), "nowhere"),
        (b"solid t\nfacet\nvertex 0 0 0\nvertex 1 0 0\nendfacet", "three corners"),
        (b"solid t\nvertex a b c\nvertex 1 0 0\nvertex 1 0 0", "could not convert"),
    ],
)
def test_what_is_no_stl_is_refused(data: bytes, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        read_stl(data)


def test_a_fine_mesh_becomes_coarser_and_keeps_its_size() -> None:
    across, along = np.linspace(0.0, pi, 90), np.linspace(0.0, 2.0 * pi, 90)
    ring = np.array(
        [[(np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)) for b in along] for a in across]
    )
    one, two, three, four = ring[:-1, :-1], ring[:-1, 1:], ring[1:, :-1], ring[1:, 1:]
    fine = np.concatenate(
        [np.stack(each, 2).reshape(-1, 3, 3) for each in ((one, two, three), (two, four, three))]
    ).astype(np.float32)
    coarse = coarser(fine)
    assert 300 < len(coarse) <= MOST_TRIANGLES < len(fine)
    assert coarse.min(axis=(0, 1)) == pytest.approx(fine.min(axis=(0, 1)), abs=0.05)
    assert coarse.max(axis=(0, 1)) == pytest.approx(fine.max(axis=(0, 1)), abs=0.05)
    radii = np.linalg.norm(coarse, axis=2)
    assert radii.min() > 1.0 - 2.0 * sin(pi / 40)


def described(folder: Path, *meshes: str) -> Robot:
    """Return a pan-tilt head whose URDF shows its lens by these meshes."""
    shown = (
        f'<visual><origin xyz="0 0 0.1"/><geometry><mesh filename="{mesh}" scale="0.1 0.1 0.1"/></geometry>'
        '<material name="m"><color rgba="1 0.5 0 1"/></material></visual>'
        for mesh in meshes
    )
    urdf = (ROBOTS / "pan_tilt.urdf").read_text()
    (folder / "pan_tilt.urdf").write_text(
        urdf.replace('<link name="lens">', '<link name="lens">' + "".join(shown))
    )
    file = folder / "robot.toml"
    file.write_text((ROBOTS / "pan_tilt.toml").read_text())
    return load_robot(file)


@pytest.mark.parametrize("name", ["lens.stl", "package://head/meshes/lens.STL", "file://{}/lens.stl"])
def test_a_mesh_is_found_beside_its_urdf_or_in_its_package(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "head" / "urdf"
    (tmp_path / "head" / "meshes").mkdir(parents=True)
    folder.mkdir()
    for file in (folder / "lens.stl", tmp_path / "head" / "meshes" / "lens.STL"):
        file.write_bytes(binary(TETRAHEDRON))
    seen = figure(described(folder, name.format(folder)))
    assert seen.missing == ()
    (mesh,) = seen.meshes
    assert mesh == pytest.approx(TETRAHEDRON)
    (shape,) = [one for part in seen.described for one in part["shapes"] if one["kind"] == "mesh"]
    assert shape["mesh"] == 0
    assert shape["colour"] == (1.0, 0.5, 0.0)
    assert shape["size"] == [0.1, 0.1, 0.1]
    assert shape["at"] == [0.0, 0.0, 0.1, 0.0, 0.0, 0.0]


def test_what_is_wrong_with_the_look_of_a_link_is_no_mistake() -> None:
    text = """<robot name="r"><link name="l">
      <collision><geometry><box size="1 1 1"/></geometry></collision>
      <visual><geometry><box size="a b c"/></geometry></visual>
      <visual><geometry><mesh filename="a.stl" scale="big"/></geometry></visual>
      <visual><origin xyz="0 0"/><geometry><sphere radius="0.1"/></geometry><material name="none"/></visual>
      <visual><geometry><capsule radius="1"/></geometry></visual><visual/>
    </link></robot>"""
    model = urdf.parse(text)
    assert [one.kind for one in model.links["l"].looks] == ["mesh", "sphere"]


def test_meshes_that_cannot_be_drawn_are_named_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "no.stl").write_bytes(b"no")
    robot = described(tmp_path, "there_is_none.stl", "a.dae", "no.stl")
    assert set(figure(robot).missing) == {
        "there_is_none.stl: there is no such file",
        "a.dae: only STL is drawn",
        "no.stl: it is no STL: its length does not fit the number of its triangles",
    }


# -- over the wire -----------------------------------------------------------------------------------


def test_a_page_gets_each_mesh_once_in_pieces(tmp_path: Path) -> None:
    fine = np.concatenate([TETRAHEDRON * (1.0 + number / 250.0) for number in range(225)]).astype(np.float32)
    (tmp_path / "lens.stl").write_bytes(binary(fine))
    described(tmp_path, "lens.stl")
    with bench(robot=str(tmp_path / "robot.toml")) as loop:
        page = loop.page()
        loop.run(1.0)
        (hello,) = page.of("hello")
        (shape,) = [one for part in hello["figure"] for one in part["shapes"] if one["kind"] == "mesh"]
        pieces = page.of("mesh")
        assert [one["count"] for one in pieces] == [PIECE, PIECE, len(fine) - 2 * PIECE]
        assert {one["mesh"] for one in pieces} == {shape["mesh"]}
        corners = [
            np.array(one["low"]) + one["step"] * np.frombuffer(one["bytes"], "<u2").reshape(-1, 3, 3)
            for one in pieces
        ]
        assert np.concatenate(corners) == pytest.approx(fine, abs=float(fine.max()) / 65535)
        (joints,) = page.of("joints")[-1:]
        assert joints["figure"] == [None, None]  # its servos report nothing


def test_a_page_gets_what_cameras_saw_and_their_pictures() -> None:
    half = sqrt(0.5)
    seen = Marker("eye", 0, 7, (2.0, 0.5, -0.25), (0.0, 0.0, 1.0, 0.0))  # faces the camera
    aside = Marker("eye", 0, 8, (1.0, 0.0, 0.0), (0.0, 0.0, half, half))  # faces to its left
    with bench() as loop:
        page = loop.page()
        scene = next(iter(loop.view._cockpits.values())).scene
        image = np.zeros((480, 640, 3), dtype=np.uint8)
        scene.pictures = lambda: {"eye": Seen(5, image, Intrinsics(320.0, 320.0, 319.5, 239.5))}
        events = tuple(replace(one, t=loop.now) for one in (seen, aside, Marker("eye", 0, None)))
        scene.observe(Tick(0, loop.now, Inputs(), Outputs(events=events)), scene.belief)
        loop.run(2.4)
        first, *_ = page.of("camera")
        (eye,) = first["cameras"]
        assert eye["name"] == "eye"
        facing, turned, nothing = eye["seen"]
        assert (facing["marker"], facing["at"], facing["distance"]) == (7, [0.25, -0.125], 2.077)
        assert facing["face"] == pytest.approx([0.5 / 1.9, -0.25 / 1.9], abs=1e-4)  # 0.1 m nearer
        assert turned["face"] == pytest.approx([0.1, 0.0], abs=1e-5)
        assert (nothing["marker"], "at" in nothing) == (None, False)
        assert page.of("camera")[-1]["cameras"] == [{"name": "eye", "seen": []}]  # 2 s later
        pictures = page.of("picture")
        assert 2 <= len(pictures) <= 3
        assert (pictures[0]["name"], pictures[0]["wide"], pictures[0]["tall"]) == ("eye", 1.0, 0.75)
        assert pictures[0]["bytes"].startswith(b"\xff\xd8")
