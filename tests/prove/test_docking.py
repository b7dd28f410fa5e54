"""Missions that end at a marker: by a goal round the boxes, then docked 0.6 m before the tag."""

import math

import pytest

import gateway as gw

pytestmark = pytest.mark.prove


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_robot_docks_at_a_tag(seed: int) -> None:
    """The shipped mission up to its docking."""
    robot = gw.load_robot("diffbot_camera")
    mission = gw.Mission("dock", gw.load_mission("dock", robot).steps[:2])
    texts: list[str] = []
    with gw.open_session(robot, simulated=True, seed=seed) as session:
        session.submit(mission)
        for tick in session.run(seconds=25.0):
            texts += [note.text for note in tick.outputs.notes]
        assert session.twins is not None
        true, touched = session.twins.world.truth(), session.twins.world.contacts()
    assert "mission dock: done" in texts, texts
    assert not [text for text in texts if text.startswith("degraded")], texts
    assert touched == 0
    # The tag hangs at (3.948, 0.4) and looks along -x.
    short, beside = 3.948 - 0.6 - true.x, true.y - 0.4
    turned = math.degrees(true.yaw)
    print(f"seed {seed}: {100 * short:.1f} cm before its place, {100 * beside:+.1f} beside, {turned:+.1f}°")
    assert abs(short) < 0.02
    assert abs(beside) < 0.01
    assert abs(turned) < 1.5
