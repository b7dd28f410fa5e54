"""Idle during the set-up of a drive that needs 60 ms for each SDO request, or whose responses come once more.

What counts is what stands in the drive afterwards."""

from __future__ import annotations

from math import tau

import pytest

from protocols.messages import Fault, Idle, Velocity
from tests.protocols.cia402.bus import BEGIN, Bus, motor
from tests.protocols.cia402.drive import Drive
from tests.sampled import sampled

STARTED_MS, ARMED_MS = 6000, 14_000
"""Until it has been read, and until it is armed, whatever was interrupted before."""


def started(**settings: int) -> tuple[Bus, Drive]:
    """Return a bus whose drive has been read."""
    drive = Drive(motor())
    drive.change("60A9=0x00B50300")
    for name, value in settings.items():
        setattr(drive, name, value)
    bus = Bus([motor()], [drive])
    bus.run(STARTED_MS)
    return bus, drive


@pytest.mark.sample(3)
@pytest.mark.parametrize("moment", sampled(range(0, 4000, 410), 4))
@pytest.mark.parametrize(("keeps", "echo"), [(99, 0), (0, 15), (1, 215)])
def test_idle_during_the_set_up_leaves_no_motor_that_does_not_obey(
    moment: int, keeps: int, echo: int
) -> None:
    bus, drive = started(slow=60, keeps=keeps, echo=echo)
    bus.run(moment, Velocity("m", tau))
    bus.run(600, Idle("m"))
    assert not drive.enabled()
    bus.run(ARMED_MS, Velocity("m", 2 * tau))
    assert drive.enabled()
    assert drive.get(0x60FF) == 2 * 16384
    bus.run(50, Velocity("m", 0.0))
    assert drive.get(0x60FF) == 0
    bus.run(400, Idle("m"))
    assert not drive.enabled()
    assert not [event for event in bus.events if isinstance(event, Fault)]


@pytest.mark.parametrize("echo", [3, 7, 45])
def test_confirmations_that_come_once_more_do_not_count_for_later_requests(echo: int) -> None:
    bus, drive = started(echo=echo)
    bus.run(3000, Velocity("m", tau))
    assert drive.get(0x60FF) == 16384
    bus.run(50, Velocity("m", 0.0))
    assert drive.get(0x60FF) == 0
    assert not [event for event in bus.events if isinstance(event, Fault)]


@pytest.mark.parametrize("state", ["SWITCH ON DISABLED", "READY TO SWITCH ON", "SWITCHED ON"])
@pytest.mark.parametrize("late", [0, 3, 8, 25])
def test_what_a_drive_was_sent_before_it_was_operational_is_sent_again(late: int, state: str) -> None:
    """Defect: the velocity offset that somebody had left in a drive that was switched on was added to the
    first set-points: its zero had gone out with the NMT start, which the drive had not obeyed yet."""
    bus, drive = started(started_late=late)
    drive.put(0x60B1, 0, 100_000)
    drive.change(f'stands "{state}" 9')
    while not drive.enabled():
        bus.run(1, *([Velocity("m", 0.0)] if bus.ms % 10 == 0 else []))
        assert bus.ms < BEGIN + STARTED_MS + ARMED_MS
    assert drive.get(0x60B1) == 0
