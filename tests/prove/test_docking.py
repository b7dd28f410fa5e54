"""A mission that ends at a marker: by a goal round the boxes, then docked 0.6 m before the tag."""

import math

import pytest

import gateway as gw
from protocols import messages as msg

pytestmark = pytest.mark.prove


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_robot_docks_at_a_tag(seed: int) -> None:
    robot = gw.load_robot("diffbot_camera")
    mission = msg.Mission("dock", (msg.Goal(1.6, -0.9), msg.Dock(7, 0.6)))
    with gw.open_session(robot, simulated=True, seed=seed) as session:
        session.submit(mission)
        texts = [note.text for tick in session.run(seconds=25.0) for note in tick.outputs.notes]
        assert session.twins is not None
        true, touched = session.twins.world.truth(), session.twins.world.contacts()
    assert "mission dock: done" in texts, texts
    assert touched == 0
    # The tag hangs at (3.948, 0.4) and looks along -x.
    assert (true.x, true.y) == pytest.approx((3.948 - 0.6, 0.4), abs=0.025)
    assert math.degrees(abs(true.yaw)) < 3.0
