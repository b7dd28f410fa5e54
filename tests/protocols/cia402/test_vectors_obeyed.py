"""The independent vectors at the drive's side: the twin responds as canopen's slave did.

The vectors are of node 2, whose dictionary was another one: what it held is put into the twin first.
"""

from __future__ import annotations

import math

from protocols import messages as msg
from protocols.canopen.pdo import decode_entry
from protocols.canopen.services import NmtState, decode
from protocols.cia402 import objects as o
from protocols.cia402.faults import OVERCURRENT
from protocols.cia402.options import Options, Settings
from protocols.cia402.twin import Cia402Twin
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND
from protocols.plugin import Device
from tests.protocols.cia402.stack import VECTORS

BY_NAME = {vector.name: vector for vector in VECTORS}
DEVICE = Device("m", 2, Options(), Settings())
TURN = Settings().encoder_increments
# fmt: off
ANSWERED: list[tuple[str, str]] = [
    ("sdo_read_statusword#0",                  "sdo_read_statusword#1"),
    ("sdo_read_position_-123456#0",            "sdo_read_position_-123456#1"),
    ("sdo_write_mode_pp#0",                    "sdo_write_mode_pp#1"),
    ("sdo_write_target_velocity_-1000#0",      "sdo_write_target_velocity_-1000#1"),
    ("sdo_write_target_torque_500permille#0",  "sdo_write_target_torque_500permille#1"),
    ("sdo_abort_no_object#0",                  "sdo_abort_no_object#1"),
    ("enable_over_sdo#2",                      "enable_over_sdo#3"),
    ("sdo_read_statusword#0",                  "enable_over_sdo#4"),
    ("enable_over_sdo#5",                      "enable_over_sdo#3"),
    ("sdo_read_statusword#0",                  "enable_over_sdo#6"),
    ("enable_over_sdo#7",                      "enable_over_sdo#3"),
    ("sdo_read_statusword#0",                  "enable_over_sdo#8"),
    ("quick_stop_over_sdo#2",                  "quick_stop_over_sdo#3"),
    ("disable_over_sdo#2",                     "quick_stop_over_sdo#3"),
    ("sdo_read_statusword#0",                  "disable_over_sdo#4"),
]
# fmt: on


def frame_of(name: str) -> CanFrame:
    frame = BY_NAME[name].frame
    assert isinstance(frame, CanFrame)
    return frame


class StillTwin:
    """A twin on a shaft at standstill."""

    def __init__(self) -> None:
        self.twin = Cia402Twin(DEVICE, 0)
        self.now = 0
        self.position = -123_456 / TURN * math.tau

    def step(self, *frames: Frame) -> list[Frame]:
        self.now += MILLISECOND
        for frame in frames:
            self.twin.receive(self.now, frame)
        return list(self.twin.step(self.now, (msg.Feedback("m", self.now, self.position, 0.0),))[1])


def test_the_twin_answers_sdo_vectors_as_the_slave_did() -> None:
    drive = StillTwin()
    drive.step()
    drive.step()
    for asked, answered in ANSWERED:
        if asked == "enable_over_sdo#2":  # in no mode the statusword has no bits of a mode
            drive.twin.memory.node.dictionary.values[o.MODE] = 0
        sent = [
            frame
            for frame in drive.step(frame_of(asked))
            if isinstance(frame, CanFrame) and frame.id == 0x582
        ]
        assert sent == [frame_of(answered)], f"{asked}: {[str(s) for s in sent]}"


def test_the_twin_uploads_its_name_in_segments_as_in_the_vectors() -> None:
    drive = StillTwin()
    drive.step()
    ask = CanFrame(0x602, bytes.fromhex("4008100000000000"))
    assert drive.step(ask)[:1] == [frame_of("sdo_read_dev_name_segmented#1")]
    sent = drive.step(frame_of("sdo_read_dev_name_segmented#2"))
    assert sent[0] == CanFrame(0x582, b"\x01twin402")


def test_boot_up_heartbeat_and_fault_reset_are_as_in_the_vectors() -> None:
    drive = StillTwin()
    sent = [frame for _ in range(120) for frame in drive.step()]
    assert sent[0] == frame_of("nmt_slave_bootup#0")
    assert frame_of("heartbeat_preop") in sent
    drive.twin.provoke(OVERCURRENT)
    drive.step()
    fault = drive.step(frame_of("sdo_read_statusword#0"))
    assert frame_of("fault_statusword#1") in fault
    drive.step(frame_of("reset_from_fault_cw#0"))
    assert frame_of("emcy_reset#0") in drive.step(frame_of("reset_from_fault_cw#1"))
    for name, state in (
        ("nmt_start#0", NmtState.OPERATIONAL),
        ("nmt_stop#0", NmtState.STOPPED),
        ("nmt_enter_preop#0", NmtState.PRE_OPERATIONAL),
    ):
        sent = [*drive.step(frame_of(name)), *(frame for _ in range(110) for frame in drive.step())]
        assert any(getattr(decode(frame), "state", None) is state for frame in sent), name
    assert frame_of("nmt_slave_bootup#0") in drive.step(frame_of("nmt_reset_comm#0"))


def test_pdo_vectors_configure_the_twin_and_it_maps_what_they_map() -> None:
    drive = StillTwin()
    drive.step()
    frames = [v.frame for v in VECTORS if v.name.startswith("configure_")]
    for frame in frames:
        for sent in drive.step(frame):
            assert isinstance(sent, CanFrame)
            assert sent.id != 0x582 or sent.data[0] in (0x60, 0x4F, 0x4B, 0x43), f"{frame!r}: {sent}"
    dictionary = drive.twin.memory.node.dictionary
    for vector in VECTORS:
        if vector.name.startswith("configure_") and vector.name.endswith("#0"):
            what = vector.name.removeprefix("configure_").partition("#")[0]
            first = o.RPDO_COMMUNICATION if what[0] == "R" else o.TPDO_COMMUNICATION
            packing = dictionary.active(first + int(what[-1]) - 1)
            assert packing is not None, what
            assert [*packing.entries] == [decode_entry(value) for value in vector.meaning["entries"]], what
