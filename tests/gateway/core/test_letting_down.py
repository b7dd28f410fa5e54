"""At the end of a run a load that is held is let down, on every protocol that can: it does not fall.

Rules. A whole gateway on twins; the load is a constant torque above a soft floor, where it rests.
"""

from __future__ import annotations

import pytest

from protocols import messages as msg
from protocols.messages import Mode
from tests.gateway.core.test_taking_over import HOLDING, LOAD, ROBOT, Held
from tests.gateway.rig import Rig

FLOOR, STIFF, DAMPS = -0.1, 20.0, 0.2
"""rad, N·m/rad, N·m·s/rad"""
GENTLE = 1.0
"""rad/s; it falls onto the floor with more than 4."""


class OverFloor(Held):
    """A joint whose load rests on a floor in the end."""

    def _loaded(self, torques: dict[str, float]) -> dict[str, float]:
        position, velocity = self.rig.world.world.shaft("joint")
        self.seen.append((torques["joint"], position, velocity))
        below = min(0.0, position - FLOOR)
        support = max(0.0, -STIFF * below - DAMPS * velocity) if below else 0.0
        return {"joint": torques["joint"] - self.load + support}


def fall(name: str, action: str) -> list[tuple[float, float, float]]:
    """Return what was seen from the end of a run on, while a joint held its load."""
    bus, gear, device = HOLDING[name]
    text = ROBOT.format(bus=bus, protocol=name.split()[0], gear=gear, device=f"{device}\n{action}")
    rig = Rig(text)
    held = OverFloor(rig)
    rig.run(0.4)
    held.commanded(rig, 0.3, msg.Position("joint", 0.1))
    held.load = LOAD
    held.commanded(rig, 0.4, msg.Position("joint", 0.1))
    joint = rig.gateway.joints["joint"]
    assert (joint.mode, joint.faults) == (Mode.ARMED, {})
    held.seen.clear()
    rig.reasons.append("the end")
    rig.run(3.5)
    assert joint.sent == msg.Idle("joint")
    return held.seen


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", sorted(HOLDING))
def test_a_load_is_let_down(name: str) -> None:
    seen = fall(name, 'stop_action = "hold"\nunattended = "released"')
    assert max(abs(velocity) for _, _, velocity in seen) < GENTLE
    assert seen[-1][1] < FLOOR


def test_by_idle_it_falls() -> None:
    seen = fall("damiao", 'stop_action = "idle"')
    assert max(abs(velocity) for _, _, velocity in seen) > 4.0 * GENTLE
