"""Package durand 0.5.0 as a foreign drive: its CANopen, with objects and states of CiA 402 around it.

Its NMT, SDO server, PDOs, SYNC, heartbeat and EMCY are durand's, its time is durand's VirtualScheduler, its
bus a for-loop. Objects of the profile have the types of canopen's dictionary, states follow canopen's table.

What durand cannot do: it has no heartbeat consumer (1016; so no watchdog here), no event timer of a TPDO
(1800:05; its feedback comes with SYNC or by SDO), counts no nth SYNC anew (a TPDO of type 10 comes with each
SYNC after the tenth), keeps what was written when it is reset, enables its RPDOs as delivered, and empty.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import tau
from typing import Any

import durand
import pytest
from canopen.objectdictionary import ODVariable
from durand.scheduler import VirtualScheduler

from protocols.frames import CanFrame, Frame
from protocols.messages import (
    ClearFault,
    Done,
    Fault,
    Feedback,
    Found,
    Hold,
    Idle,
    Parameter,
    Position,
    ReadParameter,
    Reboot,
    Refused,
    Scan,
    State,
    Torque,
    Velocity,
    WriteParameter,
)
from tests.protocols.cia402.bus import Bus, motor
from tests.protocols.cia402.drive import DEMAND, NEXT, STATUSWORDS
from tests.protocols.cia402.stack import dictionary

NODE = 2
TURN = 16384
OBJECTS = (0x603F, *range(0x6040, 0x6600))
PRESET = {0x6064: 4096, 0x6502: 0x3AD, 0x60A9: 0x00B50300}


class Network:
    """durand's network: frames go to a list."""

    def __init__(self) -> None:
        self.sent: list[Frame] = []
        self.subscribed: dict[int, Callable[[int, bytes], None]] = {}

    def add_subscription(self, cob_id: int, callback: Callable[[int, bytes], None]) -> None:
        self.subscribed[cob_id] = callback

    def remove_subscription(self, cob_id: int) -> None:
        self.subscribed.pop(cob_id)

    def send(self, cob_id: int, msg: bytes) -> None:
        self.sent.append(CanFrame(cob_id, bytes(msg)))


class DurandDrive:
    """A drive whose shaft turns as it is commanded at once."""

    def __init__(self) -> None:
        self.scheduler = VirtualScheduler()
        durand.set_scheduler(self.scheduler)
        self.network = Network()
        self.node: Any = durand.MinimalNode(self.network, NODE)
        self.objects: Any = self.node.object_dictionary
        self.state, self.control, self.position = "SWITCH ON DISABLED", 0, float(PRESET[0x6064])
        for index, known in dictionary(NODE).indices.items():
            if index in OBJECTS:
                self.objects[index] = _object(known)
        for index, value in PRESET.items():
            self.objects.write(index, 0, value)
        self.objects[0x1000].value, self.objects[0x1008].value = 0x00020192, b"a drive of durand"
        self.objects[0x1018][4].value = 99
        self.objects.update_callbacks[0x6040, 0].add(self._obey)
        self._show()

    def receive(self, frame: Frame) -> None:
        """Handle a frame of the driver."""
        assert isinstance(frame, CanFrame)
        if frame.id in self.network.subscribed:
            self.network.subscribed[frame.id](frame.id, frame.data)

    def step(self) -> Sequence[Frame]:
        """Advance by a millisecond. Returns what it sends."""
        self.scheduler.run(0.001)
        mode, enabled = self.objects.read(0x6060, 0), self.state == "OPERATION ENABLED"
        speed = self.objects.read(0x60FF, 0) if enabled and mode in (3, 9) else 0
        self.position += speed / 1000
        if enabled and mode == 8:
            self.position = self.objects.read(0x607A, 0)
        torque = self.objects.read(0x6071, 0) if enabled and mode == 10 else 0
        for index, value in ((0x6061, mode), (0x606C, speed), (0x6064, int(self.position)), (0x6077, torque)):
            self.objects.write(index, 0, value)
        sent, self.network.sent = self.network.sent, []
        return sent

    def change(self, text: str) -> str:
        """Nothing in a transcript demands anything of it."""
        raise NotImplementedError(text)

    def trip(self, code: int) -> None:
        """A fault."""
        self.objects.write(0x603F, 0, code)
        self._go("FAULT")
        self.node.emcy.set(code, 1)

    def _obey(self, control: int) -> None:
        rising, self.control = control & ~self.control & 0x80, control
        if self.state != "FAULT" or rising:
            self._go(NEXT.get((self.state, control & DEMAND), self.state))

    def _go(self, state: str) -> None:
        if (self.state, state) == ("FAULT", "SWITCH ON DISABLED"):
            self.objects.write(0x603F, 0, 0)
            self.node.emcy.set(0, 0)
        self.state = state
        self._show()

    def _show(self) -> None:
        self.objects.write(0x6041, 0, STATUSWORDS[self.state])


def _object(known: Any) -> Any:
    """Return an object of canopen's dictionary as one of durand's."""
    if isinstance(known, ODVariable):
        return durand.Variable(durand.DatatypeEnum(known.data_type), known.access_type, known.default)
    record: Any = durand.Record()
    for sub, each in known.items():
        if sub:
            record[sub] = _object(each)
    return record


def started(**options: Any) -> tuple[Bus, DurandDrive]:
    drive = DurandDrive()
    bus = Bus([motor(node=NODE, watchdog_ms=0, **options)], [drive])
    bus.run(500)
    return bus, drive


def of_kind(bus: Bus, kind: type) -> list[Any]:
    return [event for event in bus.events if type(event) is kind]


def measured(bus: Bus, name: str) -> float:
    """Return the last value that was reported."""
    return float([value for each in of_kind(bus, Feedback) if (value := getattr(each, name)) is not None][-1])


@pytest.mark.parametrize("feedback", ["sync", "sdo"])
def test_it_is_armed_steered_in_each_mode_and_released(feedback: str) -> None:
    bus, drive = started(feedback=feedback)
    assert drive.state == "SWITCH ON DISABLED"
    assert of_kind(bus, State)[-1].mode == "ready"
    bus.run(1000, Hold("m"))
    assert (drive.state, drive.position) == ("OPERATION ENABLED", 4096)
    bus.run(1000, Velocity("m", tau))
    assert 0.8 * TURN < drive.position - 4096 < TURN
    assert measured(bus, "velocity") == pytest.approx(tau, rel=1e-4)
    bus.run(50, Velocity("m", 0.0))
    stopped = drive.position
    bus.run(200, Velocity("m", 0.0))
    assert drive.position == stopped
    bus.run(200, Torque("m", 0.25))
    assert drive.objects.read(0x6077, 0) == 250
    bus.run(200, Position("m", -tau))
    assert drive.position == -TURN
    assert measured(bus, "position") == pytest.approx(-tau)
    bus.run(300, Idle("m"))
    assert drive.state in ("READY TO SWITCH ON", "SWITCH ON DISABLED")
    assert not of_kind(bus, Fault)


def test_its_faults_are_reported_and_cleared() -> None:
    bus, drive = started()
    bus.run(1000, Hold("m"))
    drive.trip(0x7305)
    bus.run(300, Hold("m"))
    assert [fault.code for fault in of_kind(bus, Fault)] == [0x7305]
    assert drive.state == "FAULT"
    bus.run(1000, ClearFault("m"), Hold("m"))
    assert drive.state == "OPERATION ENABLED"
    assert len(of_kind(bus, Done)) == 1


def test_its_parameters_are_read_in_segments_written_and_refused() -> None:
    bus, drive = started()
    requests = [ReadParameter("m", "1008"), ReadParameter("m", "6083"), ReadParameter("m", "5FFF")]
    requests.append(ReadParameter("m", "1018:09"))
    bus.run(100, *requests, WriteParameter("m", "6083", 77.0), WriteParameter("m", "6041", 1.0))
    assert [(each.request, each.detail) for each in of_kind(bus, Done)] == [
        ("ReadParameter", "a drive of durand"),
        ("WriteParameter", ""),
    ]
    assert [each.parameter for each in of_kind(bus, Parameter)] == ["6083"]
    assert [each.reason[-11:-1] for each in of_kind(bus, Refused)] == [
        "0x06020000",
        "0x06090011",
        "0x06010002",
    ]
    assert drive.objects.read(0x6083, 0) == 77


def test_it_is_found_and_restarts() -> None:
    bus, drive = started()
    bus.run(900, Scan("can0"))
    (found,) = of_kind(bus, Found)
    assert (found.address, found.serial, found.duplicate_address) == (NODE, 99, False)
    bus.run(1000, Reboot("m"))
    assert [each.request for each in of_kind(bus, Done)] == ["Scan", "Reboot"]
    bus.run(1000, Hold("m"))
    assert drive.state == "OPERATION ENABLED"
