"""A motor that restarts has forgotten run mode and watchdog: it is set up anew before it arms."""

from __future__ import annotations

import pytest

from gateway.core.joint import DISARMED_ITSELF
from protocols.messages import Mode, Release, Stop, Velocity
from protocols.robstride.twin import RobStrideTwin
from tests.gateway.rig import BENCH, Rig

TURN = Velocity("left", 5.0)


@pytest.fixture
def rig() -> Rig:
    made = Rig(
        BENCH.replace('"odrive_can"', '"robstride"')
        .replace('{ watchdog = "acknowledged" }', '{ mode = "speed" }')
        .replace("gear = 8.0", "gear = 1.0")
    )
    made.run(0.3)
    made.run(1.0, TURN)
    return made


def test_a_restart_under_way_is_reported_within_50_ms(rig: Rig) -> None:
    rig.world.reset("left")
    rig.run(0.05)
    assert [code for code, _ in rig.gateway.joints["left"].faults] == [DISARMED_ITSELF]


def test_after_a_restart_it_is_set_up_anew(rig: Rig) -> None:
    rig.run(0.1, Stop())
    rig.world.reset("left")
    rig.run(0.2)
    assert rig.gateway.joints["left"].mode is Mode.READY
    rig.run(1.0, Release())
    rig.run(1.0, TURN)
    assert rig.velocity("left") == pytest.approx(5.0, abs=0.1)
    twin = rig.world.twin("left")
    assert isinstance(twin, RobStrideTwin)
    assert {name: twin.memory.registers[name] for name in ("run_mode", "canTimeout")} == {
        "run_mode": 2,
        "canTimeout": 2000,
    }
