"""Set-points that are written by SDO: in which order, and on a drive that needs 60 ms for each."""

from __future__ import annotations

from math import tau

import pytest

from protocols.canopen.objects import Key
from protocols.cia402 import objects as o
from protocols.cia402.setpoints import Output, Values
from protocols.messages import MILLISECOND, Command, Fault, Position, Velocity
from tests.protocols.cia402.bus import Bus, motor
from tests.protocols.cia402.drive import Drive


def written(output: Output, ms: int, values: Values, target: Key) -> Key | None:
    """Let the output write once, at this time; return what."""
    found = output.next_download(ms * MILLISECOND, values, target)
    if found is not None:
        output.confirm(ms * MILLISECOND, *found)
    return None if found is None else found[0]


def test_a_mode_is_written_after_what_it_will_obey() -> None:
    output = Output()
    run = {o.VELOCITY_OFFSET: 0, o.TARGET_VELOCITY: 500, o.MODE: 9, o.CONTROLWORD: 15}
    assert [written(output, ms, run, o.TARGET_VELOCITY) for ms in range(1, 6)] == [*run, None]
    go = {o.VELOCITY_OFFSET: 70, o.TARGET_POSITION: 4096, o.MODE: 8, o.CONTROLWORD: 15}
    assert [written(output, ms, go, o.TARGET_POSITION) for ms in range(10, 14)] == [
        o.TARGET_POSITION,  # never written so far
        o.VELOCITY_OFFSET,
        o.MODE,
        None,
    ]
    slow = run | {o.TARGET_VELOCITY: 5}
    order = [written(output, ms, slow, o.TARGET_VELOCITY) for ms in range(20, 24)]
    assert order == [o.TARGET_VELOCITY, o.VELOCITY_OFFSET, o.MODE, None]


def test_a_target_that_always_changes_does_not_keep_the_mode_from_being_written() -> None:
    output = Output()
    for ms in range(4):
        written(output, ms, {o.TARGET_POSITION: ms, o.MODE: 8, o.CONTROLWORD: 15}, o.TARGET_POSITION)
    order = [
        written(output, ms, {o.TARGET_VELOCITY: ms, o.MODE: 9, o.CONTROLWORD: 31}, o.TARGET_VELOCITY)
        for ms in range(10, 13)
    ]
    assert order[:2] == [o.TARGET_VELOCITY, o.MODE]


@pytest.mark.parametrize("command", [Velocity("m", tau), Position("m", tau)])
@pytest.mark.parametrize("modes", ["cyclic", "profile"])
def test_a_slow_drive_without_pdos_is_armed_and_obeys(command: Command, modes: str) -> None:
    device = motor(feedback="sdo", mapping="keep", watchdog_ms=0, modes=modes)
    drive = Drive(device)
    drive.change("60A9=0x00B50300")
    drive.slow = 60
    bus = Bus([device], [drive])
    bus.run(12_000, command)
    assert drive.enabled()
    assert drive.get(0x60FF if isinstance(command, Velocity) else 0x607A) == 16384
    assert not [event for event in bus.events if isinstance(event, Fault)]
