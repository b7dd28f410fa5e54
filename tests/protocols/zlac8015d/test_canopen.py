"""Package canopen 2.4.1 as the client of a drive: SDO, PDO, NMT, and the state machine of its BaseNode402."""

from __future__ import annotations

from typing import Any

import canopen
import pytest
from canopen.profiles.p402 import State402

from protocols import messages as msg
from protocols.messages import MILLISECOND, Mode
from protocols.plugin import Device
from protocols.zlac8015d import table as z
from protocols.zlac8015d.options import Options, Settings
from protocols.zlac8015d.twin import ZlacTwin
from tests.protocols.cia402.stack import Joined
from tests.protocols.zlac8015d.drive import dictionary


class Rig:
    """The halves of node 1, and the package's client, which waits by stepping them."""

    def __init__(self, client: type[Any] = canopen.RemoteNode) -> None:
        devices = [Device(name, at, Options(), Settings()) for name, at in (("left", 1), ("right", 129))]
        self.halves = [ZlacTwin(device, seed) for seed, device in enumerate(devices)]
        self.network, self.now = Joined(), 10**9
        self.node: Any = self.network.add_node(client(1, dictionary()))
        self.network.on_sent = lambda frame: self.receive(frame)
        self.step(20)

    def receive(self, frame: Any) -> None:
        for half in self.halves:
            half.receive(self.now, frame)
        self.step(2)

    def step(self, count: int = 1) -> list[float]:
        torques = [0.0, 0.0]
        for _ in range(count):
            self.now += MILLISECOND
            for at, half in enumerate(self.halves):
                truth = [msg.Feedback(half.device.name, self.now, 1.0 + at, 0.5 - at)]
                applied, frames = half.step(self.now, truth)
                torques[at] = applied[0].torque
                for frame in frames:
                    self.halves[1 - at].receive(self.now, frame)
                    self.network.notify(frame.id, bytearray(frame.data), self.now / 1e9)  # type: ignore[union-attr] # CAN
        return torques


def test_each_value_has_one_response() -> None:
    rig = Rig()
    answered: list[int] = []
    rig.network.subscribe(0x581, lambda *_: answered.append(1))
    sdo = rig.node.sdo
    assert sdo[0x6064][1].raw == round(1.0 * 4096 / (2 * 3.14159265))
    assert sdo[0x6064][2].raw == round(2.0 * 4096 / (2 * 3.14159265))
    tenths = 0.5 / z.RPM * 10
    assert [sdo[0x606C][side].raw for side in z.SIDES] == pytest.approx([tenths, -tenths], abs=1)
    assert (sdo[0x6041].raw, sdo[0x603F].raw, sdo[0x1000].raw) == (0x00400040, 0, 0x20192)
    assert len(answered) == 7
    with pytest.raises(canopen.SdoAbortedError):
        sdo[0x6041].raw = 1


def test_the_sequence_of_public_drivers_turns_both() -> None:
    rig = Rig()
    sdo = rig.node.sdo
    sdo[0x200F].raw, sdo[0x6060].raw = 1, 3
    for word in (6, 7, 15):
        sdo[0x6040].raw = word
    assert sdo[0x6041].raw == 0x00270027
    sdo[0x60FF][3].raw = z.combine(100, -100)
    left, right = rig.step(5)
    assert left > 0.0 > right
    sdo[0x6040].raw = 2
    assert sdo[0x6041].raw == 0x00070007
    sdo[0x6040].raw = 0
    assert rig.step(2) == [0.0, 0.0]
    assert sdo[0x6041].raw == 0x00400040


def test_its_state_machine_enables_resets_and_disables() -> None:
    rig = Rig(canopen.BaseNode402)
    node = rig.node

    def move(target: str) -> str:
        node.sdo[0x6040].raw = State402.TRANSITIONTABLE[state(), target]
        return state()

    def state() -> str:
        word = node.sdo[0x6041].raw & 0xFFFF
        return next(name for name, (mask, bits) in State402.SW_MASK.items() if word & mask == bits)

    assert state() == "SWITCH ON DISABLED"
    for target in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED", "QUICK STOP ACTIVE"):
        assert move(target) == target
    assert move("SWITCH ON DISABLED") == "SWITCH ON DISABLED"
    rig.halves[1].provoke(0x4)
    rig.step(2)
    assert (state(), node.sdo[0x603F].raw) == ("FAULT", 0x00040000)
    assert move("SWITCH ON DISABLED") == "SWITCH ON DISABLED"
    assert node.sdo[0x603F].raw == 0
    assert [half.mode for half in rig.halves] == [Mode.READY, Mode.READY]


def test_rpdo_and_tpdo_mapped_by_the_package() -> None:
    rig = Rig()
    node = rig.node
    node.rpdo.read()
    node.tpdo.read()
    node.rpdo[2].clear()
    node.rpdo[2].add_variable(0x60FF, 3)
    node.rpdo[2].trans_type, node.rpdo[2].enabled = 255, True
    node.tpdo[1].clear()
    node.tpdo[1].add_variable(0x6041)
    node.tpdo[1].trans_type, node.tpdo[1].event_timer, node.tpdo[1].enabled = 255, 20, True
    node.rpdo[2].save()
    node.tpdo[1].save()
    node.nmt.send_command(1)
    node.sdo[0x6060].raw = 3
    for word in (6, 7, 15):
        node.sdo[0x6040].raw = word
    node.rpdo[2][0].raw = z.combine(-50, 50)
    node.rpdo[2].transmit()
    left, right = rig.step(50)
    assert left < 0.0 < right
    assert node.tpdo[1][0].raw == 0x00270027
