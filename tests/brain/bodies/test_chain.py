"""The mechanism of a URDF against Pinocchio, whose results are in fixtures/vectors/chain.json."""

from __future__ import annotations

import json
import math
import random
from typing import Any

import numpy as np
import pytest

from brain.bodies import urdf
from brain.bodies.chain import Array, Chain, rotation, rotation_vector
from tests.brain.bodies.from_pinocchio import FILE, UR5, ur5

VECTORS: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
EXACT = 1e-9


def of_case(case: dict[str, Any]) -> tuple[Chain, list[int]]:
    """A chain, and for each of its joints the place in the vectors."""
    chain = Chain(urdf.parse(case["urdf"]), "base", "tip", case["joints"])
    return chain, [case["joints"].index(name) for name in chain.joints]


@pytest.mark.parametrize("number", range(len(VECTORS["cases"])))
def test_places_jacobian_gravity_and_torques_are_those_of_pinocchio(number: int) -> None:
    case = VECTORS["cases"][number]
    chain, order = of_case(case)
    for state in case["states"]:
        q, v, a = (np.array(state[key])[order] for key in "qva")
        (turned, origin), jacobian = chain.jacobian(q)
        expected = {
            key: np.array(state[key]) for key in ("rotation", "origin", "jacobian", "gravity", "torques")
        }
        assert turned == pytest.approx(expected["rotation"], abs=EXACT)
        assert origin == pytest.approx(expected["origin"], abs=EXACT)
        assert jacobian == pytest.approx(expected["jacobian"][:, order], abs=EXACT)
        assert chain.gravity(q) == pytest.approx(expected["gravity"][order], abs=EXACT)
        assert chain.torques(q, v, a) == pytest.approx(expected["torques"][order], abs=EXACT)


def test_the_same_frames_by_every_way_of_asking() -> None:
    chain, _ = of_case(VECTORS["cases"][1])
    q = [0.3] * len(chain.joints)
    turned, origin = chain.forward(q)
    assert (turned == chain.jacobian(q)[0][0]).all()
    assert (chain.points(q)[-1] == origin).all()
    still = [0.0] * len(q)
    assert chain.gravity(q) == pytest.approx(chain.torques(q, still, still), abs=EXACT)


def test_a_base_on_a_wall_hangs_in_the_same_gravity() -> None:
    """The UR5's base turned by 90° about x: pan carries what the root's frame makes of it."""
    text = ur5().replace('<link name="base"/>', '<link name="wall"/><link name="base"/>').replace(
        "</robot>",
        '<joint name="on" type="fixed"><parent link="wall"/><child link="base"/>'
        '<origin rpy="1.5707963267948966 0 0"/></joint></robot>',
    )  # fmt: skip
    names = [name for name, *_ in UR5]
    on_wall, on_floor = (Chain(urdf.parse(one), "base", "tip", names) for one in (text, ur5()))
    q = [0.4, -1.0, 0.5, 0.2, 0.1, 0.0]
    assert on_wall.forward(q)[1] == pytest.approx(on_floor.forward(q)[1])  # in the base's frame
    assert abs(on_wall.gravity(q)[0]) > 5.0 > 1e-9 > abs(on_floor.gravity(q)[0])


def test_a_joint_that_is_not_driven_is_locked() -> None:
    model = urdf.parse(ur5())
    driven = [name for name, *_ in UR5 if name != "elbow"]
    full = Chain(model, "base", "tip", [*driven, "elbow"])
    less = Chain(model, "base", "tip", driven)
    q = dict.fromkeys(driven, 0.3) | {"elbow": 0.0}
    assert less.forward([0.3] * 5)[1] == pytest.approx(full.forward([q[name] for name in full.joints])[1])


@pytest.mark.parametrize(
    ("base", "tip", "driven", "sentence"),
    [
        ("foot", "tip", ["pan"], "there is no link 'foot'"),
        ("base", "hand", ["pan"], "there is no link 'hand'"),
        ("base", "tip", ["pam"], "there is no joint 'pam'; there are pan, lift"),
        ("base", "tip", ["tool"], "joint 'tool' is fixed: it cannot be driven"),
        ("pan_link", "tip", ["lift"], "joint 'pan' moves the base link, 'pan_link'"),
        ("base", "base", ["pan"], ""),
    ],
)
def test_what_does_not_fit_is_refused(base: str, tip: str, driven: list[str], sentence: str) -> None:
    if not sentence:
        Chain(urdf.parse(ur5()), base, tip, driven)
        return
    with pytest.raises(ValueError, match=sentence):
        Chain(urdf.parse(ur5()), base, tip, driven)


def test_rotations_and_their_vectors() -> None:
    """Against the closed form of an axis and an angle, from 0 to π."""
    rng = random.Random(7)
    for angle in (0.0, 1e-9, 1e-4, 0.7, 2.0, 3.0, math.pi - 1e-4, math.pi - 1e-7, math.pi):
        axis: Array = np.array([rng.gauss(0.0, 1.0) for _ in range(3)])
        axis /= np.linalg.norm(axis)
        x, y, z = axis
        skew = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
        turned = np.eye(3) + math.sin(angle) * skew + (1.0 - math.cos(angle)) * skew @ skew
        found = rotation_vector(turned)
        sign = -1.0 if angle == math.pi and found @ axis < 0.0 else 1.0
        assert found == pytest.approx(sign * angle * axis, abs=1e-7)
    assert rotation(0.0, 0.0, math.pi / 2) @ (1.0, 0.0, 0.0) == pytest.approx((0.0, 1.0, 0.0))
    assert rotation(math.pi / 2, 0.0, math.pi / 2) @ (0.0, 1.0, 0.0) == pytest.approx((0.0, 0.0, 1.0))
