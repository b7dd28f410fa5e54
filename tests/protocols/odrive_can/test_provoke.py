"""Every fault that the contract names: a twin trips it, a driver tells it with its words, and it goes."""

from __future__ import annotations

import copy

import pytest

from protocols.messages import ClearFault, Fault, Idle, Velocity
from protocols.odrive_can import spec
from protocols.odrive_can.faults import DUPLICATE_NODE, FAULT_TABLE06, PROCEDURE, Error
from protocols.odrive_can.faults05 import FAULT_TABLE05
from protocols.odrive_can.options import Options
from protocols.plugin import FaultInfo
from tests.protocols.helpers import of
from tests.protocols.odrive_can.helpers import Bench, device, ready


def armed(options: Options) -> Bench:
    """A bench whose motor turns."""
    bench = ready(device(options=options))
    bench.run(900, Velocity("left", 1.0))
    return bench


ARMED = {options: armed(options) for options in (Options(), Options(firmware="0.5"))}
CASES = [(Options(), code) for code in FAULT_TABLE06] + [(Options(firmware="0.5"), c) for c in FAULT_TABLE05]


@pytest.mark.parametrize(("options", "code"), CASES)
def test_a_provoked_fault_disarms_is_told_as_the_contract_has_it_and_is_cleared(
    options: Options, code: int
) -> None:
    bench = copy.deepcopy(ARMED[options])
    (left,) = bench.devices
    complaint = spec(left).faults[code]
    assert [twin.axis.armed for twin in bench.twins] == [True]
    bench.twins[0].provoke(code)
    assert [twin.axis.armed for twin in bench.twins] == [False]
    reported = {fault.code: fault for fault in of(Fault, bench.run(250))}
    assert reported[code] == Fault(
        "left", reported[code].t, code, complaint.name, complaint.cause, complaint.remedy
    )
    assert set(reported) <= set(spec(left).faults)
    bench.words = (Idle("left"),)
    bench.ask(ClearFault("left"), 200)
    assert not of(Fault, bench.run(150))


def test_codes_mean_one_thing_whichever_the_line() -> None:
    assert not FAULT_TABLE05.keys() & FAULT_TABLE06.keys()
    assert all(isinstance(said, FaultInfo) and said.cause and said.remedy for said in FAULT_TABLE06.values())


@pytest.mark.parametrize("code", [0, 3, Error.INITIALIZING, PROCEDURE + 14, DUPLICATE_NODE, 1 << 60, -1])
@pytest.mark.parametrize("options", [Options(), Options(firmware="0.5")], ids=["0.6", "0.5"])
def test_what_is_no_fault_of_the_device_is_not_provoked(options: Options, code: int) -> None:
    bench = ready(device(options=options))
    with pytest.raises(ValueError, match="has no fault"):
        bench.twins[0].provoke(int(code))
