"""The driver at edges that no bench comes by: a shaft at zero, one limit of three, a bus that fails twice."""

from __future__ import annotations

from math import tau

import pytest

from protocols import messages as msg
from protocols.frames import BusState, CanFrame
from protocols.messages import MILLISECOND, Command, Event
from protocols.moteus import RANGES
from protocols.moteus.codec import make_frame, parse
from protocols.moteus.driver import MoteusDriver
from protocols.moteus.messages import written
from protocols.moteus.options import Options
from protocols.moteus.registers import Mode, Register
from tests.protocols.helpers import of
from tests.protocols.moteus.helpers import device

STANDS = "2100{:02x}2f01" + "00000000" * 3 + "210f00"
"""At 0 rev, in a mode."""


def _driver(options: Options | None = None, mode: int = Mode.POSITION) -> MoteusDriver:
    driver = MoteusDriver([device(options=options)], RANGES)
    driver.send(0, [])
    driver.receive(1, make_frame(0x100, bytes.fromhex(STANDS.format(mode))))
    return driver


def _said(driver: MoteusDriver, now: int, command: Command) -> dict[int, float | None]:
    """The registers that the first frame of a command writes."""
    frame = driver.send(now, [command])[1][0]
    assert isinstance(frame, CanFrame)
    return written(parse(frame.data)[0])


def test_a_velocity_begins_at_zero_where_the_shaft_stands_at_zero() -> None:
    assert _said(_driver(), 2, msg.Velocity("left", 1.0))[Register.COMMAND_POSITION] == 0.0
    assert _said(_driver(mode=Mode.STOPPED), 2, msg.Velocity("left", 1.0))[Register.COMMAND_POSITION] == 0.0
    assert _said(_driver(), 2, msg.Torque("left", 1.0))[Register.COMMAND_POSITION] == 0.0


LIMITS = {
    "max_torque": (Options(max_torque=1.5), Register.COMMAND_POSITION_MAX_TORQUE),
    "velocity_limit": (Options(velocity_limit=1.5 * tau), Register.COMMAND_VELOCITY_LIMIT),
    "acceleration_limit": (Options(acceleration_limit=1.5 * tau), Register.COMMAND_ACCEL_LIMIT),
}


@pytest.mark.parametrize("given", LIMITS)
def test_one_limit_alone_leaves_the_others_to_the_device(given: str) -> None:
    for command in (msg.Hold("left"), msg.Torque("left", 0.5)):
        said = _said(_driver(LIMITS[given][0]), 2, command)
        for name, (_, register) in LIMITS.items():
            assert said[register] == (1.5 if name == given else None)


def test_a_device_that_stays_stopped_is_said_to() -> None:
    driver = _driver(mode=Mode.STOPPED)
    events: list[Event] = []
    for at in range(1, 220):
        events += driver.send(at * 5 * MILLISECOND, [msg.Hold("left")])[0]
        driver.receive(at * 5 * MILLISECOND, make_frame(0x100, bytes.fromhex(STANDS.format(0))))
    assert [fault.cause for fault in of(msg.Fault, events)] == ["it stayed in mode stopped for 1000 ms"]


def test_what_a_lost_bus_ends_is_told_whatever_else_befalls_the_bus() -> None:
    driver = _driver()
    driver.send(2, [msg.ReadParameter("left", "power")])
    for state in (BusState.GONE, BusState.OFF, BusState.BACK):
        driver.bus(3, state)
    assert [refused.reason for refused in of(msg.Refused, driver.send(4, [])[0])] == ["the bus is gone"]


def test_who_it_is_and_how_it_is_may_come_in_one_answer() -> None:
    driver = _driver()
    uuid = bytes.fromhex("2804d002") + bytes(range(16))
    events = driver.receive(2, make_frame(0x100, bytes.fromhex("2d01000000002100002d0d0000c041") + uuid))
    assert [type(event) for event in events] == [msg.Feedback, msg.State]
    other = bytes.fromhex("2804d002") + bytes(range(1, 17))
    events = driver.receive(3, make_frame(0x100, bytes.fromhex("2d0100000000") + other))
    assert [type(event) for event in events] == [msg.Feedback, msg.Found, msg.Found, msg.Fault]
