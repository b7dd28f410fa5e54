"""Package canopen 2.4.1 drives our twin over a python-can bus: its scanner, NMT, SDO, PdoMap, BaseNode402.

The package waits in its calls, by a wall clock of its own, for frames that a thread of its own receives. So
the twin runs in a thread here (the one exception in these tests): each turn of it is a millisecond of the
twin's time. The package's timeouts (0.3 s for an SDO response) are set so as to be against hanging alone:
nothing is measured in wall time.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

import protocols.cia402
from protocols.cia402.profile import Mode
from protocols.cia402.settings import Settings
from protocols.frames import CanFrame
from tests.protocols.cia402.bus import TwinOnShaft

NODE = 5
EDS = str(Path(protocols.cia402.__file__).parent / "twin.eds")
MODES = {
    Mode.PP: "PROFILED POSITION",
    Mode.PV: "PROFILED VELOCITY",
    Mode.PT: "PROFILED TORQUE",
    Mode.HM: "HOMING",
    Mode.CSP: "CYCLIC SYNCHRONOUS POSITION",
    Mode.CSV: "CYCLIC SYNCHRONOUS VELOCITY",
    Mode.CST: "CYCLIC SYNCHRONOUS TORQUE",
}

OVERCURRENT = 0x2310


class Rig:
    """A twin that runs in a thread behind a virtual bus, and a canopen network on the same bus."""

    def __init__(self, channel: str) -> None:
        increments = Settings(velocity_unit=0x00B50300, acceleration_unit=0)  # a second
        self.bench = TwinOnShaft(increments, NODE)
        self.lock = threading.Lock()
        self.turns = 0
        self.turned = threading.Condition()
        self._bus = can.Bus(interface="virtual", channel=channel)
        self.sync_every = 0
        """Milliseconds of the twin's time between two SYNCs of the network's producer."""
        self._stop = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.network = canopen.Network()
        self.network.NOTIFIER_CYCLE = 0.02  # how long its disconnect takes
        self.network.connect(interface="virtual", channel=channel)
        make: Any = BaseNode402
        self.node = make(NODE, canopen.import_od(EDS, node_id=NODE))
        self.network.add_node(self.node)
        self.node.sdo.RESPONSE_TIMEOUT = 60.0
        for name in (
            "OP_MODE",
            "STATE_FINAL",
            "STATE_SINGLE",
        ):  # a fault's reset waits its time out
            setattr(self.node, f"TIMEOUT_SWITCH_{name}", 60.0)
        self.node.TIMEOUT_CHECK_TPDO = 60.0
        self._thread.start()

    def _run(self) -> None:
        while not self._stop:
            message = self._bus.recv(0.0005)
            with self.lock:
                if message is not None:
                    frame = CanFrame(
                        message.arbitration_id, bytes(message.data), remote=message.is_remote_frame
                    )
                    self.bench.twin.receive(self.bench.now, frame)
                sent = self.bench.run(1)
            for frame in sent:
                self._bus.send(can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False))
            if self.sync_every and self.turns % self.sync_every == 0:
                self.network.sync.transmit()
            with self.turned:
                self.turns += 1
                self.turned.notify_all()

    def wait(self, true: Callable[[], bool], milliseconds: int = 4000) -> bool:
        """Let the twin's time go on until something is true; whether it became so."""
        last = self.turns + milliseconds
        while not true():
            with self.turned:
                if self.turns >= last:
                    return False
                self.turned.wait(5.0)
        return True

    def close(self) -> None:
        self._stop = True
        self._thread.join(60.0)
        self.network.disconnect()
        self._bus.shutdown()


@pytest.fixture
def drive(request: pytest.FixtureRequest) -> Iterator[Rig]:
    one = Rig(f"cia402 {request.node.name}")
    try:
        yield one
    finally:
        one.close()


def test_scanner_nmt_and_heartbeat(drive: Rig) -> None:
    drive.network.scanner.search(limit=8)
    assert drive.wait(lambda: NODE in drive.network.scanner.nodes)
    assert drive.network.scanner.nodes == [NODE]
    assert drive.node.nmt.wait_for_heartbeat(10) == "PRE-OPERATIONAL"
    for state in ("OPERATIONAL", "STOPPED", "PRE-OPERATIONAL"):
        drive.node.nmt.state = state
        drive.node.nmt.wait_for_heartbeat(10)
        assert drive.node.nmt.state == state
    boots: list[int] = []
    drive.node.nmt.add_heartbeat_callback(boots.append)
    for state in ("RESET", "RESET COMMUNICATION"):
        boots.clear()
        drive.node.nmt.state = state
        assert drive.wait(lambda: 0 in boots), state


def test_sdo_of_every_kind_and_its_aborts(drive: Rig) -> None:
    sdo = drive.node.sdo
    assert sdo[0x1008].raw == "twin402"
    assert sdo["Device type"].raw & 0xFFFF == 402
    sdo["Profile velocity"].raw = 54_321
    assert sdo["Profile velocity"].raw == 54_321
    sdo.download(0x6083, 0, (77).to_bytes(4, "little"), force_segment=True)
    assert sdo["Profile acceleration"].raw == 77
    refused: list[tuple[int, Callable[[], Any]]] = [
        (0x06020000, lambda: sdo.upload(0x5FFF, 0)),
        (0x06090011, lambda: sdo.upload(0x1018, 9)),
        (0x06010002, lambda: sdo.download(0x6041, 0, b"\0\0")),
        (0x06070010, lambda: sdo.download(0x6040, 0, b"\0\0\0\0")),
        (0x06090030, lambda: sdo.download(0x6060, 0, b"\x07")),
        (0x05040001, lambda: sdo.open(0x1008, 0, "wb", size=9, block_transfer=True)),
    ]
    for code, does in refused:
        with pytest.raises(canopen.SdoAbortedError) as caught:
            does()
        assert caught.value.code == code


@pytest.mark.parametrize("mode", [m for m in MODES if m is not Mode.HM], ids=lambda m: m.name)
def test_arming_motion_and_disarming_in_each_mode(drive: Rig, mode: Mode) -> None:
    node, bench = drive.node, drive.bench
    node.op_mode = MODES[mode]
    assert node.op_mode == MODES[mode]
    node.sdo[0x607A].raw = node.sdo[0x6064].raw
    node.state = "OPERATION ENABLED"
    assert node.state == "OPERATION ENABLED"
    if mode in (Mode.PP, Mode.CSP):
        node.sdo[0x607A].raw = 5000
        if mode is Mode.PP:
            node.controlword = 0x1F
            assert drive.wait(lambda: bool(node.statusword & 1 << 12))
            node.controlword = 0x0F
            assert drive.wait(lambda: not node.statusword & 1 << 12)
            assert drive.wait(lambda: bool(node.statusword & 1 << 10))
        assert drive.wait(lambda: abs(node.sdo[0x6064].raw - 5000) < 60)
    elif mode in (Mode.PV, Mode.CSV):
        node.sdo[0x60FF].raw = -20_000
        assert drive.wait(lambda: abs(node.sdo[0x606C].raw + 20_000) < 400)
        assert bench.shaft.velocity < -7.0
    else:
        node.sdo[0x6071].raw = -30
        assert drive.wait(lambda: node.sdo[0x6077].raw == -30)
        assert drive.wait(lambda: bench.shaft.velocity < -3.0)
    node.state = "SWITCH ON DISABLED"
    assert drive.wait(lambda: bench.torque == 0.0)


def test_a_fault_is_reported_and_recovered_from(drive: Rig) -> None:
    node = drive.node
    node.op_mode = MODES[Mode.CSV]
    node.state = "OPERATION ENABLED"
    with drive.lock:
        drive.bench.twin.provoke(OVERCURRENT)
    assert drive.wait(lambda: bool(node.emcy.active))
    assert node.emcy.active[0].code == OVERCURRENT
    assert node.emcy.active[0].get_desc() == "Current"
    assert drive.wait(node.is_faulted)
    assert node.sdo[0x603F].raw == OVERCURRENT
    assert drive.bench.torque == 0.0
    node.reset_from_fault()
    assert node.state == "OPERATION ENABLED"
    assert node.sdo[0x603F].raw == node.sdo[0x1001].raw == 0
    assert not node.emcy.active


def test_quick_stop_and_back(drive: Rig) -> None:
    node = drive.node
    node.sdo[0x605A].raw = 6
    node.op_mode = MODES[Mode.CSV]
    node.state = "OPERATION ENABLED"
    node.sdo[0x60FF].raw = 30_000
    assert drive.wait(lambda: drive.bench.shaft.velocity > 9.0)
    node.state = "QUICK STOP ACTIVE"
    assert drive.wait(lambda: abs(drive.bench.shaft.velocity) < 0.05)
    assert node.state == "QUICK STOP ACTIVE"
    node.state = "OPERATION ENABLED"
    assert drive.wait(lambda: drive.bench.shaft.velocity > 9.0)


@pytest.mark.parametrize("method", [33, 34, 35, 37])
def test_homing(drive: Rig, method: int) -> None:
    node = drive.node
    with drive.lock:
        drive.bench.shaft.position = 1.0
    node.sdo[0x6098].raw = method
    node.sdo[0x6099][2].raw = 30_000
    assert not node.is_homed()
    assert node.homing(timeout=60)
    assert node.is_homed(restore_op_mode=True)
    at = {33: 0, 34: 16_384}.get(method, 2608)
    away = drive.bench.shaft.position * 16384 / math.tau - at
    assert abs(node.sdo[0x6064].raw - away) < 200


@pytest.mark.parametrize("transmission", [1, 255])
def test_pdo_mapping_written_by_the_package(drive: Rig, transmission: int) -> None:
    """PdoMap.save, then arming and motion by PDOs alone; read back, the mapping is what was written."""
    node = drive.node
    node.nmt.wait_for_heartbeat(10)
    node.tpdo.read()
    node.rpdo.read()
    for number, names in ((1, (0x6041, 0x6061, 0x6064)), (2, (0x606C, 0x6077))):
        tpdo = node.tpdo[number]
        tpdo.clear()
        for index in names:
            tpdo.add_variable(index)
        tpdo.trans_type, tpdo.enabled = transmission, True
        tpdo.event_timer = 20 if transmission == 255 else None
    rpdo = node.rpdo[1]
    rpdo.clear()
    for index in (0x6040, 0x6060, 0x60FF):
        rpdo.add_variable(index)
    rpdo.trans_type, rpdo.enabled = 255, True
    node.pdo.save()
    node.setup_pdos()
    assert [v.index for v in node.tpdo[1]] == [0x6041, 0x6061, 0x6064]
    assert node.tpdo[1].trans_type == transmission
    node.nmt.state = "OPERATIONAL"
    drive.sync_every = 5 if transmission == 1 else 0
    node.op_mode = MODES[Mode.CSV]
    node.state = "OPERATION ENABLED"
    node.rpdo[1][0x60FF].raw = 25_000
    node.rpdo[1].transmit()
    speed: Any = node.tpdo[2][0x606C]
    assert drive.wait(lambda: abs(speed.raw - 25_000) < 400)
    node.state = "SWITCH ON DISABLED"


def test_the_package_notices_a_guarded_device(drive: Rig) -> None:
    """The heartbeat's period as written (1017); the master's own as consumed (1016)."""
    node = drive.node
    node.sdo[0x1017].raw = 20
    beats: list[int] = []
    node.nmt.add_heartbeat_callback(beats.append)
    assert drive.wait(lambda: len(beats) >= 5, 200)
    node.sdo[0x1016][1].raw = 127 << 16 | 100
    node.op_mode = MODES[Mode.CSV]
    drive.network.send_message(0x700 + 127, b"\x05")
    node.state = "OPERATION ENABLED"
    assert drive.wait(lambda: bool(node.emcy.active), 1000)
    assert node.emcy.active[0].code == 0x8130
    assert drive.wait(node.is_faulted)
