"""Two shafts at one node id: positions that no one shaft can have."""

from __future__ import annotations

import math

import pytest

from protocols.conformance.bench import Shaft
from protocols.messages import MILLISECOND, ClearFault, Fault, Found, Nanos
from protocols.odrive_can.duplicate_address import JUMPS, POSITION_TOLERANCE, PositionCheck
from protocols.odrive_can.faults import DUPLICATE_NODE
from protocols.odrive_can.options import Options
from protocols.odrive_can.twin import OdriveTwin
from protocols.odrive_can.twin05 import Twin05
from protocols.odrive_can.twin06 import Twin06
from tests.protocols.helpers import of
from tests.protocols.odrive_can.helpers import device, ready

Samples = list[tuple[Nanos, float, float]]


def first(reported: Samples) -> int | None:
    """Which of these made it certain that there are two shafts."""
    places = PositionCheck()
    return next((at for at, place in enumerate(reported) if places.add(*place)), None)


def every(period_ms: int, positions: list[tuple[float, float]]) -> Samples:
    return [(at * period_ms * MILLISECOND + 1, *place) for at, place in enumerate(positions)]


def vibration(amplitude: float, hertz: float) -> list[tuple[float, float]]:
    """100 Hz of samples of a shaft that vibrates."""
    turn = [math.tau * hertz * at * 0.01 + 0.3 for at in range(400)]
    return [(amplitude * math.sin(w), amplitude * math.tau * hertz * math.cos(w)) for w in turn]


@pytest.mark.parametrize(
    ("reported", "at"),
    [
        (every(10, [(0.0, 0.0), (1.0, 0.0)] * 20), JUMPS + 1),
        (every(5, [(0.0, 0.0), (2.0 * POSITION_TOLERANCE, 0.0)] * 20), JUMPS + 1),
        (every(10, [(3.0, 0.0), (3.0, 0.0), (3.0, 0.0), (-1.0, 0.0)] * 20), 4 * JUMPS),
        (every(5, [(at * 0.05, 10.0) if at % 2 else (7.5, 0.0) for at in range(40)]), JUMPS + 1),
    ],
    ids=["far apart", "just apart", "one sends more often", "one turns"],
)
def test_two_shafts_are_noticed(reported: Samples, at: int) -> None:
    assert first(reported) == at


@pytest.mark.parametrize(
    "reported",
    [
        every(10, [(at * 0.3, 30.0) for at in range(500)]),
        every(10, [(0.0, 0.0)] * 20 + [(5.0, 0.0)] * 20 + [(0.0, 0.0)] * 20),
        every(10, [(float(at % 7), 0.0) for at in range(500)]),
        every(10, [(0.0, 0.0), (POSITION_TOLERANCE * 0.9, 0.0)] * 200),
        every(400, [(0.0, 0.0), (1.0, 0.0)] * 50),
        *[every(10, vibration(0.024, hertz)) for hertz in (3.0, 17.0, 41.0, 49.0, 50.0, 51.0)],
    ],
    ids=["turning", "a new zero", "a loose encoder", "noise", "seldom", *["vibration"] * 6],
)
def test_one_shaft_is_not_taken_for_two(reported: Samples) -> None:
    assert first(reported) is None


@pytest.mark.parametrize("bunch", [1, 2, 3, 5])
def test_frames_that_are_delivered_in_bunches_make_no_second_shaft(bunch: int) -> None:
    """An adapter without stamps: so many frames bear the moment at which they were read."""
    times = [10 * MILLISECOND * (at // bunch * bunch + bunch) for at in range(300)]
    assert first([(t, 12.7 * 0.01 * at, 12.7) for at, t in enumerate(times)]) is None
    swing = [(0.5 * math.sin(0.06 * at), 3.0 * math.cos(0.06 * at)) for at in range(300)]
    assert first([(t, *place) for t, place in zip(times, swing, strict=True)]) is None


@pytest.mark.parametrize(("line", "kind"), [("0.5", Twin05), ("0.6", Twin06)])
def test_two_devices_with_one_serial_number_are_noticed_by_their_positions(
    line: str, kind: type[OdriveTwin]
) -> None:
    options = Options(firmware="0.5") if line == "0.5" else Options(firmware="0.6")
    bench = ready(device(options=options))
    bench.devices = [*bench.devices, device(options=options)]
    bench.twins.append(kind(device(options=options), 7))
    bench.shafts.append(Shaft(inertia=1e-4, friction=1e-4, position=3.0))
    events = bench.run(400)
    assert [(found.address, found.duplicate_address) for found in of(Found, events)] == [(1, True)]
    assert [fault.code for fault in of(Fault, events)] == [DUPLICATE_NODE]
    assert "positions contradict" in of(Fault, events)[0].cause

    assert not of(Fault, bench.run(400))  # reported once, until it is cleared
    assert [fault.code for fault in of(Fault, bench.ask(ClearFault("left"), 400))] == [DUPLICATE_NODE]
    bench.twins.pop()
    bench.shafts.pop()
    bench.devices = bench.devices[:1]
    assert not of(Fault, bench.ask(ClearFault("left"), 2000))
