"""The independent vectors, made by package canopen 2.4.1: the package still makes them.

Its BaseNode402 is the master, its LocalNode the slave, joined by function calls (`stack`). LocalNode has no
state machine of CiA 402, so a callback stands in for it: what the statuswords of these vectors prove is how
they are encoded, not when a drive sends them. (`test_canopen` proves the twin's own state machine.)
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

from protocols.canopen import mapping, sdo
from protocols.canopen.mapping import Pdo
from protocols.canopen.objects import to_bytes
from protocols.cia402.objects import OBJECTS
from protocols.frames import CanFrame
from protocols.reference_vectors import Vector
from tests.protocols.cia402 import driver_vectors
from tests.protocols.cia402.stack import VECTORS, Joined, Slave, dictionary

NODE = 2
BOTH_ENDS = [v for v in VECTORS if "python-can virtual" in v.source]
FOLLOWS = {0x06: 0x231, 0x07: 0x233, 0x0F: 0x237, 0x02: 0x217, 0x00: 0x250}
"""What the slave's statusword becomes, by the controlword."""
FAULT = 0x218


class Ends:
    """A master and a slave, and all frames that canopen's own networks have sent."""

    def __init__(self) -> None:
        self.slave = Slave(NODE)
        self.network = Joined()
        make: Any = BaseNode402
        self.drive = make(NODE, dictionary(NODE))
        self.network.add_node(self.drive)
        self.network.on_sent = self.slave.receive
        self.slave.network.on_sent = self.network.handle
        self.slave.node.add_write_callback(self._follow)

    def _follow(self, index: int, data: bytes, **_: Any) -> None:
        word = int.from_bytes(data, "little")
        if index == 0x6040 and word in FOLLOWS and self.slave.value(0x6041) != FAULT:
            self.hold(0x6041, FOLLOWS[word], 2)

    def hold(self, index: int, value: int, size: int) -> None:
        """Put a value into the slave."""
        self.slave.node.set_data(index, 0, value.to_bytes(size, "little", signed=value < 0))

    def sent(self) -> set[tuple[str, CanFrame]]:
        """Return all frames."""
        down = {("to_device", frame) for frame in self.network.sent}
        return down | {("from_device", frame) for frame in self.slave.network.sent}


def _objects(ends: Ends) -> None:
    sdo = ends.drive.sdo
    for index, value, size in ((0x1000, -65134, 4), (0x6041, 0x250, 2), (0x6064, -123_456, 4)):
        ends.hold(index, value, size)
        assert int(sdo[index].raw) & 0xFFFF == value & 0xFFFF
    sdo[0x6060].raw = 1
    sdo[0x60FF].raw = -1000
    sdo[0x6071].raw = 500
    assert sdo[0x1008].raw == "twin402"
    with pytest.raises(canopen.SdoAbortedError):
        sdo.upload(0x5FFF, 0)


def _power(ends: Ends) -> None:
    ends.drive.state = "OPERATION ENABLED"
    ends.drive.state = "QUICK STOP ACTIVE"
    ends.drive.controlword = 0x00
    assert ends.drive.state == "SWITCH ON DISABLED"
    ends.hold(0x6041, FAULT, 2)
    assert ends.drive.state == "FAULT"
    for word in (0x00, 0x80, 0x06, 0x07, 0x0F):  # as reset_from_fault writes them, without its 0.4 s
        ends.drive.controlword = word
    ends.slave.node.emcy.send(0x2310, 2, bytes((1, 2, 3, 4, 5)))
    ends.slave.node.emcy.reset()


def _pdos(ends: Ends) -> None:
    drive, local = ends.drive, ends.slave.node
    for known, cob, indices in (
        (drive.rpdo[1], 0x202, (0x6040, 0x6060)),
        (drive.tpdo[1], 0x182, (0x6041, 0x6061, 0x6077)),
    ):
        known.read()
        known.clear()
        known.cob_id, known.trans_type, known.enabled, known.rtr_allowed = cob, 255, True, True
        known.event_timer = 0 if cob == 0x182 else None
        for index in indices:
            known.add_variable(index)
        known.save()
    drive.rpdo[1][0x6040].raw, drive.rpdo[1][0x6060].raw = 0x0F, 8
    drive.rpdo[1].transmit()
    local.tpdo.read()
    reports = local.tpdo[1]
    for index, value in ((0x6041, 0x637), (0x6061, 8), (0x6077, -250)):
        reports[index].raw = value
    reports.transmit()


def _rest(ends: Ends) -> None:
    for command in (0x80, 0x01, 0x02, 0x82):
        ends.drive.nmt.send_command(command)
    ends.network.sync.transmit()
    ends.network.scanner.search(limit=3)
    ends.slave.node.nmt.state = "INITIALISING"
    ends.slave.node.nmt.state = "PRE-OPERATIONAL"
    ends.slave.node.nmt.start_heartbeat(100)
    ends.slave.network.send_message(0x702, ends.slave.network.cyclic[0x702])


@pytest.fixture(scope="module")
def sent() -> set[tuple[str, CanFrame]]:
    ends = Ends()
    for scene in (_objects, _power, _pdos, _rest):
        scene(ends)
    return ends.sent()


@pytest.mark.parametrize("vector", BOTH_ENDS, ids=lambda v: v.name)
def test_the_package_still_sends_it(vector: Vector, sent: set[tuple[str, CanFrame]]) -> None:
    assert isinstance(vector.frame, CanFrame)
    assert (vector.direction, vector.frame) in sent


def test_they_are_many() -> None:
    assert len(BOTH_ENDS) == 60


# -- what the driver sends ------------------------------------------------------------------------------


def test_the_vectors_of_the_driver_are_those_that_the_package_makes() -> None:
    kept = json.loads(driver_vectors.FILE.read_text("utf-8"))
    assert [e for e in kept if e["source"] == driver_vectors.SOURCE] == driver_vectors.made()


def _timed(pdo: Pdo) -> Pdo:
    return replace(pdo, transmission=255, event_ms=10)


@pytest.mark.parametrize("pdo", [*driver_vectors.pdos(), *map(_timed, driver_vectors.pdos()[3:])])
def test_pdos_are_configured_as_by_pdo_map_save(pdo: Pdo) -> None:
    theirs = [frame.data for frame in driver_vectors.saved(pdo)]
    flag = 1 << 30 if pdo.kind == "TPDO" else 0
    rows = [(row.key, to_bytes(OBJECTS[row.key].type, row.value)) for row in mapping.writes(pdo, flag)]
    ours = [sdo.encode(sdo.Download(*key, data)) for key, data in rows]
    assert ours == theirs
