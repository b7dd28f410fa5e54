"""LSS, judged by package canopen: its master gives the twin a node id, and sends what our driver sends."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import canopen
import pytest
from canopen import lss as judge
from canopen.lss import LssError

from protocols.canopen import lss
from protocols.canopen.lss import Slave
from protocols.cia402 import plugin
from protocols.conformance.bench import make_bench
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Done, Feedback, Refused, SetAddress
from protocols.plugin import Device

LssMaster: Any = judge.LssMaster  # it is not typed
IDENTITY = (0, 402, 0x0001_0000, 0x0402_0001)


class Network(canopen.Network):
    """A network on which one drive is."""

    def __init__(self, master: Any, settings: Any = None) -> None:
        super().__init__()
        self.master, self.now, self.sent = master, 0, list[str]()
        self.twin = plugin.twin(Device("drive", 1, plugin.options(), settings or plugin.settings()), 1)
        self.heard: list[CanFrame] = []
        master.network = self
        self.wait()

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """What the master sends is received by the drive, and its answers by the master."""
        self.sent.append(f"{can_id:03X}#{bytes(data).hex()}")
        self.twin.receive(self.now, CanFrame(can_id, bytes(data)))
        self.wait()

    def wait(self) -> None:
        for _ in range(500):
            self.now += MILLISECOND
            for frame in self.twin.step(self.now, ())[1]:
                assert isinstance(frame, CanFrame)
                self.heard.append(frame)
                if frame.id == lss.SLAVE:
                    self.master.on_message_received(frame.id, bytearray(frame.data), self.now * 1e-9)


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Network:
    monkeypatch.setattr(LssMaster, "RESPONSE_TIMEOUT", 0.01)  # all that comes has come
    return Network(LssMaster())


def test_another_master_gives_it_a_node_id_that_counts_from_its_reset(network: Network) -> None:
    master = network.master
    assert master.send_switch_state_selective(*IDENTITY)
    assert master.inquire_node_id() == 1
    asked = [master.inquire_lss_address(command) for command in lss.INQUIRE]
    assert tuple(asked) == IDENTITY
    master.configure_node_id(5)
    master.store_configuration()
    master.send_switch_state_global(LssMaster.WAITING_STATE)
    assert {frame.id for frame in network.heard if frame.id > 0x700} <= {0x701, lss.SLAVE}
    network.heard.clear()
    network.send_message(0, bytes((0x82, 1)))
    assert [frame for frame in network.heard if frame.id > 0x700][:1] == [CanFrame(0x705, b"\0")]


@pytest.mark.parametrize("at", range(4))
def test_one_of_another_identity_does_not_answer(network: Network, at: int) -> None:
    other = tuple(number + (place == at) for place, number in enumerate(IDENTITY))
    with pytest.raises(LssError):
        network.master.send_switch_state_selective(*other)
    with pytest.raises(LssError):
        network.master.inquire_node_id()


@pytest.mark.parametrize("node", [0, 128, 254])
def test_a_node_id_that_is_none_is_refused(network: Network, node: int) -> None:
    network.master.send_switch_state_global(LssMaster.CONFIGURATION_STATE)
    with pytest.raises(LssError, match="LSS Error: 1"):
        network.master.configure_node_id(node)


def test_our_driver_sends_the_same(network: Network) -> None:
    network.master.send_switch_state_selective(*IDENTITY)
    network.master.configure_node_id(5)
    network.master.store_configuration()
    network.master.send_switch_state_global(LssMaster.WAITING_STATE)
    bench = make_bench(plugin, plugin.options(), (1, 2), ("drive", "other"))
    bench.steps(1500)
    steps = [bench.step([SetAddress("drive", 5)]), *bench.steps(3500)]
    frames = [frame for step in steps for frame in step.down if isinstance(frame, CanFrame)]
    ours = [f"{one.id:03X}#{one.data.hex()}" for one in frames if one.id == lss.MASTER]
    assert ours == network.sent
    assert [e.request for step in steps for e in step.events if isinstance(e, Done)] == ["SetAddress"]
    assert [one.data.hex() for one in frames if one.id == 0] == ["8201"]


def test_a_command_decoder_knows_no_identity_and_takes_a_reset_of_another_node_for_that() -> None:
    slave = Slave(None)
    answers = [slave.receive(one.data, 1)[:1] for one in lss.assignment(IDENTITY, 5)]
    assert answers == [b"", b"", b"", b"\x44", b"\x11", b"\x17", b""]
    assert (slave.take(), slave.take()) == (5, 0)


# -- a device that has no node id yet --------------------------------------------------------------------

UNADDRESSED = replace(plugin.settings(), has_node_id=False, serial_number=0x8000_0F01, vendor_id=0xFFFF_FFFF)
WITHOUT = (0xFFFF_FFFF, 402, 0x0001_0000, 0x8000_0F01)


def test_another_master_finds_a_device_without_a_node_id_and_gives_it_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(LssMaster, "RESPONSE_TIMEOUT", 0.0)
    monkeypatch.setattr("canopen.lss.time.sleep", lambda _: None)
    network = Network(LssMaster(), UNADDRESSED)
    assert network.heard == []
    network.send_message(0, bytes((0x81, 0)))
    network.send_message(0x601, bytes((0x40, 0x18, 0x10, 1, 0, 0, 0, 0)))
    assert network.heard == [], "it has no node id, and is silent"
    assert network.master.fast_scan() == (True, list(WITHOUT))
    assert network.master.inquire_node_id() == lss.UNADDRESSED
    network.master.configure_node_id(9)
    network.master.store_configuration()
    assert {frame.id for frame in network.heard} == {lss.SLAVE}
    network.master.send_switch_state_global(LssMaster.WAITING_STATE)
    assert CanFrame(0x709, b"\0") in network.heard
    assert network.master.fast_scan() == (False, None)


def test_our_search_is_that_of_another_master_and_ends_with_a_node_id(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(LssMaster, "RESPONSE_TIMEOUT", 0.0)
    monkeypatch.setattr("canopen.lss.time.sleep", lambda _: None)
    theirs, ours = Network(LssMaster(), UNADDRESSED), Network(LssMaster(), UNADDRESSED)
    theirs.master.fast_scan()
    search = lss.FastScan(9)
    while (message := search.message()) is not None:
        before = len(ours.heard)
        ours.send_message(message.id, message.data)
        for frame in ours.heard[before:]:
            if frame.id == lss.SLAVE:
                search.take(frame.data)
    assert ours.sent[1:-3] == theirs.sent
    assert (search.ended, search.failed, tuple(search.numbers)) == (True, "", WITHOUT)
    assert CanFrame(0x709, b"\0") in ours.heard


def test_who_has_a_node_id_takes_no_part_and_no_answer_is_said_so() -> None:
    network, search = Network(LssMaster()), lss.FastScan(9)
    while (message := search.message()) is not None:
        network.send_message(message.id, message.data)
    assert search.failed == "no device without a node id answers"
    assert not [frame for frame in network.heard if frame.id == lss.SLAVE]


def test_our_driver_gives_a_drive_without_a_node_id_that_of_its_motor() -> None:
    both = replace(UNADDRESSED, serial_number=0)  # each its own; the lower one is found
    bench = make_bench(plugin, plugin.options(), (5, 2), ("drive", "other"), both)
    before = [event for step in bench.steps(1500) for event in step.events]
    assert not [one for one in before if isinstance(one, Feedback) and one.motor == "drive"]
    steps = [bench.step([SetAddress("drive", 5)]), *bench.steps(8000)]
    (done,) = [e for step in steps for e in step.events if isinstance(e, Done | Refused)]
    assert isinstance(done, Done), done
    assert "serial number 4020002 took" in done.detail
    assert any(isinstance(e, Feedback) and e.motor == "drive" for step in steps for e in step.events)
    again = [bench.step([SetAddress("drive", 5)]), *bench.steps(50)]
    (refused,) = [e for step in again for e in step.events if isinstance(e, Done | Refused)]
    assert isinstance(refused, Refused)
    assert refused.reason == "it answers at 5 already"
