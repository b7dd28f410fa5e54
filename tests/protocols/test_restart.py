"""A motor that restarts has forgotten what was written into its registers: it is set up before it arms."""

from __future__ import annotations

import pytest

from gateway.core.faults import DISARMED_ITSELF
from protocols.messages import Mode, Release, Stop, Velocity
from protocols.robstride.twin import RobStrideTwin
from tests.gateway.rig import BENCH, Rig

TURN = Velocity("left", 5.0)
OPTIONS = {"damiao": '{ mode = "vel", position = "xout" }', "robstride": '{ mode = "speed" }'}


@pytest.fixture(params=OPTIONS)
def rig(request: pytest.FixtureRequest) -> Rig:
    made = Rig(
        BENCH.replace('"odrive_can"', f'"{request.param}"')
        .replace('{ watchdog = "acknowledged" }', OPTIONS[request.param])
        .replace("gear = 8.0", "gear = 1.0")
    )
    made.run(0.3)
    made.run(1.0, TURN)
    return made


def test_a_restart_under_way_is_reported_within_50_ms(rig: Rig) -> None:
    rig.world.reset("left")
    rig.run(0.05)
    assert [code for code, _ in rig.gateway.joints["left"].faults] == [DISARMED_ITSELF]


def test_after_a_restart_while_it_is_released_it_is_set_up_anew(rig: Rig) -> None:
    rig.run(0.1, Stop())
    rig.world.reset("left")
    rig.run(0.2)
    assert rig.gateway.joints["left"].mode is Mode.READY
    rig.run(1.0, Release())
    rig.run(1.0, TURN)
    assert rig.velocity("left") == pytest.approx(5.0, abs=0.1)
    if isinstance(twin := rig.world.twin("left"), RobStrideTwin):
        registers = twin.memory.registers
        assert (registers["run_mode"], registers["canTimeout"]) == (2, 2000)
