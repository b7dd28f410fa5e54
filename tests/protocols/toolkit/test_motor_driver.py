"""The driver of a bus: what ends a latched fault, and to whom an address may be given."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Mode, Nanos, Request
from protocols.plugin import Device, FaultInfo
from protocols.toolkit.host import Host, Report, Timing
from protocols.toolkit.motor_driver import Adapter, MotorDriver, Pending, Rx

HOT = 5
MODES = [Mode.READY, Mode.ARMED, Mode.FAULT]


class Simple(Adapter[None]):
    """A frame from address n is: mode, position, and perhaps a serial number, a byte each."""

    name = "simple"
    faults = {HOT: FaultInfo("hot", "", "")}  # noqa: RUF012 -- a constant of the class, as in every adapter
    latch = True

    def own(self, device: Device) -> None:
        return None

    def timing(self, options: object) -> Timing:
        return Timing(offline=1000 * MILLISECOND)

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[None]) -> Sequence[Report[None] | Rx]:
        assert isinstance(frame, CanFrame)
        host, mode = driver.at.get(frame.id), MODES[frame.data[0]]
        measured = msg.Feedback("m", t, float(frame.data[1]))
        faults = [HOT] if mode is Mode.FAULT else []
        serial = frame.data[2] if len(frame.data) > 2 else None
        return [Report(host, frame.id, mode, faults=faults, feedback=measured, serial=serial)]

    def arm(self, now: Nanos, host: Host[None], command: Command) -> Sequence[Frame]:
        return []

    command = arm

    def release(self, now: Nanos, host: Host[None]) -> Sequence[Frame]:
        return []

    def begin(
        self, now: Nanos, request: Request, host: Host[None] | None, driver: MotorDriver[None]
    ) -> Pending[None] | str:
        frames = (CanFrame(0x700),)
        return Pending(request, "m", now, now + 100 * MILLISECOND, now, host, frames)


def made() -> MotorDriver[None]:
    devices = [Device(name, address, None, None) for name, address in (("m", 1), ("n", 2))]
    return MotorDriver(Simple(), devices, {"m": {}, "n": {}})


def test_only_clear_fault_ends_a_latched_fault() -> None:
    driver = made()
    driver.receive(0, CanFrame(1, b"\2\0"))
    driver.send(1, [msg.Zero("m")])
    after = driver.receive(2, CanFrame(1, b"\0\0"))
    assert msg.Done(2, "Zero", "m") in after
    assert [event.mode for event in after if isinstance(event, msg.State)] == [Mode.FAULT]
    driver.send(3, [msg.ClearFault("m")])
    after = driver.receive(4, CanFrame(1, b"\0\0"))
    assert [event.mode for event in after if isinstance(event, msg.State)] == [Mode.READY]


def test_a_clear_fault_that_is_refused_ends_none() -> None:
    driver = made()
    driver.receive(0, CanFrame(1, b"\2\0"))
    driver.send(1, [msg.ClearFault("m")])
    (refused,) = [e for e in driver.send(200 * MILLISECOND, [])[0] if isinstance(e, msg.Refused)]
    assert refused.request == "ClearFault"
    assert driver.hosts["m"].tripped


@pytest.mark.parametrize(
    ("serial", "address", "armed", "why"),
    [
        (20, 5, 1, ""),  # that of n, to a free address, while m is armed
        (20, 5, 2, "n: it is armed"),
        (20, 2, 2, "n: it is armed"),
        (10, 5, 1, "m: it is armed"),
        (99, 1, 1, "held by serial number A"),
        (99, 5, 1, ""),  # a stranger's
        (99, 9, 1, "not an address: 1 to 8"),
        (0, 5, 1, "not a serial number"),
        (256, 5, 1, "not a serial number"),
        (255, 8, 1, ""),
    ],
)
def test_an_address_is_given_to_nobody_who_is_armed_and_taken_from_nobody(
    serial: int, address: int, armed: int, why: str
) -> None:
    driver = made()
    for at in (1, 2):
        driver.receive(0, CanFrame(at, bytes((at == armed, 0, 10 * at))))
    wrong = driver.wrong_id(msg.SetId("can0", serial, address), range(1, 9), 8)
    assert why in wrong
    assert bool(why) is bool(wrong)
