"""Every robot that ships begins what its world has for it to do, and nothing is wrong with it."""

from __future__ import annotations

from importlib.resources import files

import pytest

import gateway as gw
from gateway import config

OF_RECORDINGS = ("husky", "jackal")
FOLDER = files("gateway.fixtures") / "robots"
NAMES = sorted(path.name.removesuffix(".toml") for path in FOLDER.iterdir() if path.name.endswith(".toml"))


@pytest.mark.parametrize("name", [name for name in NAMES if name not in OF_RECORDINGS])
def test_it_begins_without_a_fault(name: str) -> None:
    """Defect: an arm was in a fault before its first motion, for five versions, and its demo alone told."""
    robot = config.load_robot(name)
    with gw.open_session(robot, simulated=True) as session:
        assert session.twins is not None
        mission = session.twins.world.mission
        session.submit(*([gw.load_mission(mission, robot)] if mission else session.tour()[:1]))
        told = [note for tick in session.run(seconds=0.4) for note in tick.outputs.notes]
    assert [note.text for note in told if note.level == "error"] == []
    assert [each for one in session.joints.values() for each in one.faults.values()] == []
