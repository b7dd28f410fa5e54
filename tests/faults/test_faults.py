"""Each fault once, of 10,000 runs in `tests.prove.test_faults`; and that the judge can find fault."""

from __future__ import annotations

import pytest

from protocols import messages as msg
from protocols.conformance.random import Random
from tests.faults.report import markdown
from tests.faults.session import Run
from tests.faults.start import STANDING, TOUR, TURNING, Warm
from tests.faults.table import FAULTS, Fault

WARM = Warm(seed=1, way=2)
PHASES = (TOUR, TURNING)


@pytest.mark.sample(20)
@pytest.mark.parametrize("number", range(len(FAULTS)), ids=[fault.name for fault in FAULTS])
def test_a_fault_is_noticed_in_its_time_and_does_no_harm(number: int) -> None:
    fault = FAULTS[number]
    robot = ("bench", "diffbot_moteus")[number % 3 == 0] if fault.on == "motor" else "diffbot"
    result = Run(fault, WARM, robot, PHASES[number // 2 % 2], Random(number)).run()
    assert not result.failed, (result.robot, result.phase, result.target, result.alarm)


def test_a_fault_that_nobody_notices_and_an_unsafe_frame_are_failures() -> None:
    def careless(run: Run) -> None:
        run.at.buses["can0"]._judge(run.since, msg.Velocity("left", 1e6))

    unnoticed = Fault("unnoticed", careless, "motor", 0.1)
    result = Run(unnoticed, WARM, "bench", STANDING, Random(1)).run()
    assert any("not noticed" in each for each in result.failed)
    assert any("unsafe frames: left: velocity 1e+06" in each for each in result.failed)
    assert "| unnoticed | 1 | 1 | 0 |" in markdown([vars(result)])
