"""Conversations of vectors: what a drive reports of state, mode and name; segmented transfers."""

from __future__ import annotations

from itertools import pairwise

import pytest
from canopen.objectdictionary import ODVariable, datatypes
from canopen.profiles.p402 import State402

from protocols.canopen import sdo
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Feedback, Found, Hold, Position, Scan, State, Torque, Velocity
from tests.protocols.cia402.conversation import Talk, armed, up
from tests.protocols.cia402.firmware import Drive
from tests.protocols.cia402.stack import Slave
from tests.protocols.cia402.transfer import Transfer

STATES: dict[str, tuple[str, set[int]]] = {
    "NOT READY TO SWITCH ON": ("initialising", set()),
    "SWITCH ON DISABLED": ("ready", {0x06}),
    "READY TO SWITCH ON": ("ready", {0x07}),
    "SWITCHED ON": ("ready", {0x07}),
    "OPERATION ENABLED": ("armed", {0x0F}),
    "QUICK STOP ACTIVE": ("ready", {0x02}),
    "FAULT REACTION ACTIVE": ("fault", set()),
    "FAULT": ("fault", set()),
}
"""The mode that is reported, and the controlwords towards OPERATION ENABLED while no other mode is shown."""


@pytest.mark.parametrize("state", sorted(State402.SW_MASK))
def test_vectors_of_every_state_whatever_its_other_bits(state: str) -> None:
    mask, value = State402.SW_MASK[state]
    for others in (0x0000, 0xFF90 & ~mask, 0x0290):
        drive = Drive()
        drive.deaf = True
        drive.put(0x605A, 6)  # a quick stop stays one
        drive._show = lambda: None  # type: ignore[method-assign]  # its statusword stands
        drive.put(0x6041, value | others)
        talk = Talk(drive)
        talk.chapter(120)
        last = [event for event in talk.events if isinstance(event, State)][-1]
        assert (str(last.mode), last.detail.partition(",")[0]) == (STATES[state][0], state), (
            f"{value | others:#x}"
        )
        before = len(talk.frames)
        talk.chapter(200, Hold("m"))
        sent = [frame for _, frame in talk.frames[before:]]
        controlwords = {frame.data[0] for frame in sent if frame.id == 0x202}
        controlwords |= {frame.data[4] for frame in sent if frame.data[:3] == b"\x2b\x40\x60"}
        assert controlwords == STATES[state][1], hex(value | others)


NAMES = {
    0: "no mode",
    1: "profile position",
    2: "velocity",
    3: "profile velocity",
    4: "profile torque",
    6: "homing",
    7: "interpolated position",
    8: "cyclic synchronous position",
    9: "cyclic synchronous velocity",
    10: "cyclic synchronous torque",
    11: "mode 11",
    -3: "mode -3",
}


@pytest.mark.parametrize("mode", NAMES)
def test_vectors_of_every_mode_that_is_shown(mode: int) -> None:
    drive = Drive()
    drive.stand("OPERATION ENABLED", mode)
    talk = up(Talk(drive))
    last = [event for event in talk.events if isinstance(event, State)][-1]
    assert last.detail == f"OPERATION ENABLED, {NAMES[mode]}"


# fmt: off
SUPPORTED = [  # 6502 by CiA 402-2: PP bit 0, PV 2, PT 3, HM 5, CSP 7, CSV 8, CST 9
    (0x3AD, "cyclic",  (8, 9, 10)), (0x3AD, "profile", (1, 3, 4)),
    (0x00D, "cyclic",  (1, 3, 4)),  (0x380, "profile", (8, 9, 10)),
    (0x10D, "cyclic",  (1, 9, 4)),  (0x38C, "profile", (8, 3, 4)),
]
# fmt: on


@pytest.mark.parametrize(("supported", "prefer", "modes"), SUPPORTED)
def test_vectors_of_the_modes_that_are_taken(supported: int, prefer: str, modes: tuple[int, ...]) -> None:
    words: list[Position | Velocity | Torque] = [Position("m", 0.5), Velocity("m", 0.5), Torque("m", 0.5)]
    for word, mode in zip(words, modes, strict=True):
        drive = Drive()
        drive.put(0x6502, supported)
        assert armed(Talk(drive, modes=prefer), word).drive.get(0x6061) == mode


def test_vectors_of_a_drive_that_shortens_its_answers() -> None:
    drive = Drive()
    drive.put_bytes(0x6502, b"\xad\x03")  # unsigned, of 32 bits: shortened by some
    drive.put_bytes(0x6076, b"\xfa")  # 250 mN·m
    drive.put(0x6077, 500)
    talk = armed(Talk(drive))
    assert "torque=0.125" in talk.transcript(300)[-1]
    drive = Drive()
    drive.put_bytes(0x6064, b"\x00\x10")  # signed: who knows what it means
    talk = up(Talk(drive), 150)
    assert "position" not in talk.transcript(150)[-1]


def test_vectors_of_a_statusword_of_a_wrong_length_it_is_ignored() -> None:
    talk = up(Talk())
    talk.drive._show = lambda: None  # type: ignore[method-assign]  # as above
    talk.drive.put_bytes(0x6041, b"\x37")
    talk.chapter(100, expected="asks 6041 6061 6064 606C 6077")


@pytest.mark.parametrize(
    ("name", "reported"),
    [
        (b" drive 7 \0\0\0", "m, drive 7, "),
        (b"caf\xe9 9", "m, caf\N{REPLACEMENT CHARACTER} 9, "),
        (None, "m, device profile"),
    ],
)
def test_vectors_of_a_name(name: bytes | None, reported: str) -> None:
    drive = Drive()
    if name is None:
        drive.lack(0x1008)
    else:
        drive.put_bytes(0x1008, name)
    talk = up(Talk(drive))
    talk.chapter(900, Scan("can0"))
    (found,) = [event for event in talk.events if isinstance(event, Found)]
    assert found.detail.startswith(reported)


def test_vectors_of_a_faster_sync() -> None:
    talk = up(Talk(sync_ms=5, watchdog_ms=0))
    talk.chapter(200, Hold("m"))
    assert talk.drive.get(0x1802, 2) == 10
    talk.chapter(
        200,
        Hold("m"),
        expected="""
        still rpdo1 6040=000F 6060=8 607A=4096 /5
        still rpdo2 60FF=0 6071=0 60B2=0 /100
        still rpdo3 60B1=0 /100
        sync /5
        """,
    )


def test_vectors_of_a_tpdo_that_stops_its_objects_are_polled_again() -> None:
    talk = armed(Talk())
    talk.drive.local.data_store[0x1800][1] = (0xC000_0182).to_bytes(4, "little")  # somebody switches it off
    talk.drive._fresh = False
    talk.chapter(30, Hold("m"))
    talk.drive.put(0x6064, 4000)
    talk.chapter(
        200,
        Hold("m"),
        expected="""
        still rpdo1 6040=000F 6060=8 607A=4096 /10
        sync /10, beat ?
        asks 6041 6061 6064
        measures position=1.534 velocity=0 torque=0
        """,
    )


# -- our client, and the package's server -------------------------------------------------------------------


def _domain(slave: Slave) -> None:
    variable = ODVariable("anything", 0x2100)
    variable.data_type, variable.access_type = datatypes.DOMAIN, "rw"
    slave.node.object_dictionary.add_object(variable)


def _run(slave: Slave, transfer: Transfer) -> int:
    """Run a transfer; return the number of requests."""
    request: sdo.Request | None = transfer.first()
    count = 0
    while request is not None and count < 99:
        slave.receive(CanFrame(0x602, sdo.encode(request)))
        (answer,) = slave.take_sent()
        received = sdo.decode_response(answer.data)
        assert received is not None
        request, count = transfer.handle(received), count + 1
        assert transfer.handle(received) is None, "a response that comes twice"
    return count


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 6, 7, 8, 13, 14, 15, 40])
def test_vectors_of_transfers_of_any_length(size: int) -> None:
    slave, data = Slave(2), bytes(range(1, size + 1))
    slave.take_sent()
    _domain(slave)
    written, read = Transfer(0x2100, 0, data), Transfer(0x2100, 0)
    frames = 1 if size <= 4 else 1 + -(-size // 7)
    assert _run(slave, written) == frames
    assert written.done
    assert written.abort is None
    assert slave.node.data_store[0x2100][0] == data
    assert _run(slave, read) == frames
    assert (read.done, read.abort, read.value) == (True, None, data)


def test_vectors_of_a_transfer_of_nothing_and_of_one_that_is_refused() -> None:
    slave = Slave(2)
    slave.take_sent()
    _domain(slave)
    empty = Transfer(0x2100, 0, b"")
    assert _run(slave, empty) == 2
    assert (empty.done, slave.node.data_store[0x2100][0]) == (True, b"")
    for transfer, code in (
        (Transfer(0x5FFF, 0), 0x06020000),
        (Transfer(0x1018, 9), 0x06090011),
        (Transfer(0x6041, 0, b"\0\0"), 0x06010002),
        (Transfer(0x6081, 0, b"12345678"), 0x06070010),
    ):
        _run(slave, transfer)
        assert (transfer.done, transfer.abort) == (True, code)
        assert f"{code:#010x}" in sdo.abort_text(code)


def test_vectors_of_the_motion_is_reported_while_the_drive_is_configured_and_armed() -> None:
    talk = armed(Talk())
    times = [e.t for e in talk.events if isinstance(e, Feedback) and e.position is not None]
    assert max(after - before for before, after in pairwise(times)) <= 25 * MILLISECOND
    assert talk.drive.get(0x1A00), "it was configured"
