"""What is measured of arms agrees with MuJoCo."""

from __future__ import annotations

from importlib.resources import files

import numpy as np
import pytest

from benchmarks import arms
from brain.bodies import urdf
from brain.bodies.chain import Chain, moving


def test_the_shipped_arm_is_the_same_to_mujoco() -> None:
    mujoco = pytest.importorskip("mujoco")
    text = (files("gateway.fixtures") / "robots" / "arm.urdf").read_text("utf-8")
    model = urdf.parse(text)
    chain, theirs = Chain(model, "base", "tool", moving(model)), arms.InMujoco(mujoco, text)
    for q in arms.places()[:5]:
        (turned, at), rows = chain.jacobian(q)
        (turned_too, at_too), rows_too = theirs.jacobian(q)
        assert turned == pytest.approx(turned_too, abs=1e-9)
        assert at == pytest.approx(at_too, abs=1e-9)
        assert rows == pytest.approx(rows_too, abs=1e-9)
        assert chain.torques(q, q, q) == pytest.approx(theirs.torques(q), abs=1e-6)
    goal = chain.forward(arms.places()[0])
    found = arms.damped(theirs.jacobian, goal)
    assert chain.forward(found)[1] == pytest.approx(goal[1], abs=1e-4)
    assert np.array(arms.solved(chain, [goal])).shape == (1, 7)
