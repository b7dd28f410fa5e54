"""A ClearFault for a motor that runs: what clears the faults of most disarms them."""

from __future__ import annotations

from typing import Any

import pytest

from protocols import messages as msg
from protocols.messages import Mode
from protocols.plugin import Device, load
from tests.protocols.helpers import bench_of, of

OPTIONS: dict[str, dict[str, Any]] = {
    "damiao": {},
    "robstride": {},
    "myactuator": {},
    "cubemars": {},
    "cubemars mit": {"mode": "mit", "sole_host": True},
    "vesc": {},
}


@pytest.mark.parametrize("name", OPTIONS)
def test_clearing_disarms_no_motor_that_runs(name: str) -> None:
    plugin = load(name.split()[0])
    rig = bench_of(plugin, Device("left", 1, plugin.options(**OPTIONS[name]), plugin.settings()))
    rig.shaft.locked = True
    rig.run(500, msg.Torque("left", 0.5))
    assert rig.twins[0].mode is Mode.ARMED
    events = rig.ask(msg.ClearFault("left"))
    for _ in range(50):
        events += rig.run(1)
        assert rig.twins[0].mode is Mode.ARMED
    assert len(of(msg.Done, events)) == 1
    assert not of(msg.State, events)
