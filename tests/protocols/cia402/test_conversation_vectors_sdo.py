"""Conversations of vectors: SDO responses lost, late, doubled, refused, cut; and requests."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby, pairwise

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import Request
from tests.protocols.cia402.conversation import Talk, armed, up
from tests.protocols.cia402.firmware import Drive
from tests.protocols.cia402.stack import VECTORS


def test_vectors_of_answers_that_are_lost() -> None:
    talk = Talk(sdo_timeout_ms=30)
    talk.chapter(20)
    talk.drive.mute = True
    before = len(talk.frames)
    talk.chapter(300)
    times = [at for at, _ in talk.frames[before:]]
    asked = [frame.data[1:4].hex() for _, frame in talk.frames[before:]]
    assert {late - soon for soon, late in pairwise(times[1:])} == {30}
    repeated = [len(list(same)) for _, same in groupby(asked)]
    assert set(repeated[1:-1]) == {3}, "given up after three, and something else is asked"
    talk.drive.mute = False
    talk.chapter(150)
    assert "< State ready SWITCH ON DISABLED" in talk.transcript(150)[0], talk.transcript(150)


def test_vectors_of_a_write_that_is_not_answered_all_of_it_again() -> None:
    talk = up(Talk(sdo_timeout_ms=30))
    talk.chapter(10, msg.Hold("m"))
    talk.drive.mute = True
    talk.chapter(250, msg.Hold("m"))  # three times 30 ms, for a question and for a write
    talk.drive.mute = False
    talk.chapter(300, msg.Hold("m"))
    assert talk.drive.state == "OPERATION ENABLED"
    written = [
        frame.data for _, frame in talk.frames if frame.id == 0x602 and frame.data[:4] == b"\x23\x00\x14\x01"
    ]
    assert [bool(data[7] & 0x80) for data in written] == [True, False] * 2, "begun anew with the first PDO"


def test_vectors_of_answers_that_come_late() -> None:
    drive = Drive()
    drive.late = 15
    talk = Talk(drive, feedback_ms=20)
    talk.chapter(
        1200,
        expected="""
        < State initialising reading its object dictionary
        < State initialising SWITCH ON DISABLED*
        < State ready SWITCH ON DISABLED
        asks 6041 6061 6064 606C 6077 6078 6079
        measures position=1.5708 velocity=0 torque=0 current=0 voltage=48
        """,
    )
    assert not [event for event in talk.events if isinstance(event, msg.Found)]


def test_vectors_of_answers_that_come_after_the_request_was_repeated() -> None:
    drive = Drive()
    drive.late = 40
    talk = Talk(drive, sdo_timeout_ms=30, feedback_ms=100)
    talk.chapter(4000)
    assert not [event for event in talk.events if isinstance(event, msg.Found)], "one late device is not two"
    assert talk.drive.get(0x6064) == 4096
    assert any("State ready" in str(run) for run in talk.runs()) or len(talk.events) > 10


def test_vectors_of_every_request_answered_twice() -> None:
    talk = up(Talk())
    talk.drive.copies = 2
    talk.chapter(
        100,
        msg.Idle("m"),
        expected="""
        0..50 < Found 2 4711 duplicate node id 2: * duplicate_address
        < Fault 10002 duplicate node id
        """,
    )
    talk.chapter(1200, msg.Idle("m"), expected="reads 1018:04")  # told once
    talk.drive.copies = 1
    talk.chapter(100, msg.ClearFault("m"), msg.Idle("m"), expected="< Done ClearFault m")
    talk.chapter(1200, msg.Idle("m"), expected="reads 1018:04")
    talk.drive.copies = 2
    talk.chapter(100, msg.Idle("m"), expected="< Found *\n< Fault 10002 *")


def test_vectors_of_two_serial_numbers_and_of_another_device() -> None:
    talk = Talk(feedback_ms=50)
    talk.chapter(900)
    talk.handle(CanFrame(0x582, bytes.fromhex("4318100405000000")))  # no host asked: it changes nothing
    talk.chapter(50, expected="")
    talk.drive.put(0x1018, 99, 4)
    talk.chapter(
        1200,
        expected="""
        0..1060 < State initialising another device responds
        < State initialising reading its object dictionary
        < State initialising SWITCH ON DISABLED*
        < State ready SWITCH ON DISABLED
        """,
    )
    other = Drive()
    other.put(0x1018, 77, 4)
    other.restart()
    for _ in range(1100):  # it hears the same questions, and is a bit later
        mark = len(talk.frames)
        talk.chapter(1)
        for _, raw in talk.frames[mark:]:
            if raw.id == 0x602 and raw.data[:4] == b"\x40\x18\x10\x04":
                other.slave.take_sent()
                other.slave.receive(raw)
                talk.drive.extra += [frame for frame in other.slave.take_sent() if frame.id == 0x582]
    found = [event for event in talk.events if isinstance(event, msg.Found)]
    assert [(each.address, each.duplicate_address) for each in found] == [(2, True)]


def test_vectors_of_heartbeats_that_alternate() -> None:
    beats = {state: CanFrame(0x702, bytes((state,))) for state in (5, 127)}
    talk = Talk()
    talk.chapter(60)
    talk.handle(beats[5], beats[127], beats[127])  # it was stopped: no contradiction
    talk.chapter(20, expected="")
    talk.handle(beats[5], beats[127], beats[5])
    talk.chapter(0)
    found = [event for event in talk.events if isinstance(event, msg.Found)]
    assert [(each.address, each.serial, each.duplicate_address) for each in found] == [(2, 4711, True)]


# fmt: off
ASKED: list[tuple[Request, Sequence[str]]] = [
    (msg.ReadParameter("m", "6081"),              ["< Parameter 6081 100000"]),
    (msg.ReadParameter("m", "0x608F:01"),         ["< Parameter 0x608F:01 16384"]),
    (msg.ReadParameter("m", "Profile velocity"),  ["< Parameter Profile velocity 100000"]),
    (msg.ReadParameter("m", "608Fsub1"),          ["< Parameter 608Fsub1 16384"]),
    (msg.ReadParameter("m", " feed "),            ["< Parameter  feed  0"]),
    (msg.ReadParameter("m", "605a"),              ["< Parameter 605a 2"]),
    (msg.ReadParameter("m", "1008"),              ["< Done ReadParameter m twin402"]),  # 7 bytes: in segments
    (msg.ReadParameter("m", "5FFF"),              ["< Refused ReadParameter m * (SDO abort 0x06020000)"]),
    (msg.ReadParameter("m", "1018:09"),           ["< Refused ReadParameter m * (SDO abort 0x06090011)"]),
    (msg.ReadParameter("m", "nonsense"),          ["0 < Refused ReadParameter m 'nonsense' is no object*"]),
    (msg.ReadParameter("m", "60"),                ["0 < Refused ReadParameter m '60' is no object*"]),
    (msg.ReadParameter("m", "608F:1234"),         ["0 < Refused ReadParameter m '608F:1234' is no object*"]),
    (msg.WriteParameter("m", "6081", 12345.0),    ["write 6081 = 12345", "< Done WriteParameter m"]),
    (msg.WriteParameter("m", "605A", -2.0),       ["write 605A = -2", "< Done *", "< State initialising *"]),
    (msg.WriteParameter("m", "6098", 37.0),       ["write 6098 = 37", "< Done WriteParameter m"]),
    (msg.WriteParameter("m", "Torque slope", 5.0), ["write 6087 = 5", "< Done WriteParameter m"]),
    (msg.WriteParameter("m", "6041", 1.0),        ["write 6041 = 0001", "< Refused * (* 0x06010002)"]),
    (msg.WriteParameter("m", "nonsense", 1.0),    ["0 < Refused WriteParameter m 'nonsense' is no object*"]),
    (msg.WriteParameter("m", "6081", 0.5),        ["0 < Refused WriteParameter m 0.5 is not a whole number"]),
    (msg.WriteParameter("m", "6081", -1.0),       ["0 < Refused WriteParameter m -1 *"]),
    (msg.WriteParameter("m", "6098", 128.0),      ["0 < Refused WriteParameter m 128 *"]),
    (msg.WriteParameter("m", "2000", 1.0),        ["0 < Refused WriteParameter m * not known*"]),
    (msg.WriteParameter("m", "1008", 1.0),        ["0 < Refused WriteParameter m * not known*"]),
    (msg.WriteParameter("m", "6040", 6.0),        ["0 < Refused WriteParameter m * driver's own*"]),
    (msg.WriteParameter("m", "6060", 1.0),        ["0 < Refused WriteParameter m * driver's own*"]),
    (msg.WriteParameter("m", "607A", 1.0),        ["0 < Refused WriteParameter m * driver's own*"]),
    (msg.WriteParameter("m", "60FF", 1.0),        ["0 < Refused WriteParameter m * driver's own*"]),
    (msg.WriteParameter("m", "6071", 1.0),        ["0 < Refused WriteParameter m * driver's own*"]),
    (msg.WriteParameter("m", "60B1", 1.0),        ["0 < Refused WriteParameter m * driver's own*"]),
    (msg.WriteParameter("m", "1016:01", 1.0),     ["0 < Refused WriteParameter m * driver's own*"]),
    (msg.WriteParameter("m", "1400:01", 1.0),     ["0 < Refused WriteParameter m * driver's own*"]),
    (msg.WriteParameter("m", "1A03:08", 1.0),     ["0 < Refused WriteParameter m * driver's own*"]),
]
# fmt: on


@pytest.mark.parametrize(("request_", "reported"), ASKED)
def test_vectors_of_parameters(request_: Request, reported: Sequence[str]) -> None:
    talk = up(Talk())
    talk.chapter(30, request_, expected="\n".join(reported))


def test_vectors_of_parameters_of_makers_are_read_as_unsigned_numbers() -> None:
    drive = Drive()
    drive.own(0x2000, 1)
    talk = up(Talk(drive))
    drive.local.data_store[0x2000] = {1: b"\xfe"}
    talk.chapter(
        30,
        msg.ReadParameter("m", "2000:01"),
        expected="< Parameter 2000:01 254",
    )
    drive.local.data_store[0x2000] = {1: bytes(9)}
    talk.chapter(
        30, msg.ReadParameter("m", "2000:01"), expected="< Refused ReadParameter m * is no number of its type"
    )


def test_vectors_of_answers_without_their_size() -> None:
    talk = Talk()
    talk.drive.unsized = True
    talk.drive.put(0x6064, 70_000)  # 26.8447 rad
    talk.chapter(100, expected="< *\n< State ready *\nmeasures position=26.845 voltage=48")
    talk.chapter(30, msg.ReadParameter("m", "6081"), expected="< Parameter 6081 100000")


def test_vectors_of_parameters_below_zero() -> None:
    talk = up(Talk())
    talk.drive.put(0x607C, -5)
    talk.chapter(30, msg.ReadParameter("m", "607C"), expected="< Parameter 607C -5")


def test_vectors_of_a_unit_that_is_written_is_read_anew() -> None:
    talk = up(Talk())
    talk.chapter(
        100,
        msg.WriteParameter("m", "608F:01", 8192.0),
        msg.Idle("m"),
        expected="""
        write 608F:01 = 8192
        < Done WriteParameter m
        < State initialising SWITCH ON DISABLED*
        < State ready SWITCH ON DISABLED
        measures position=3.1416
        """,
    )


def test_vectors_of_parameters_of_an_armed_drive_and_without_a_response() -> None:
    talk = armed(Talk(sdo_timeout_ms=50))
    talk.chapter(
        50,
        msg.ReadParameter("m", "6502"),
        msg.WriteParameter("m", "6083", 7.0),
        msg.Hold("m"),
        expected="""
        < Parameter 6502 941
        write 6083 = 7
        < Done WriteParameter m
        sync /10, beat ?
        """,
    )
    talk.drive.mute = True
    talk.chapter(
        400,
        msg.ReadParameter("m", "6502"),
        msg.Hold("m"),
        expected="""
        100..310 < Refused ReadParameter m no response from the device
        still rpdo1 6040=000F 6060=8 607A=4096 /10
        sync /10, beat ?
        """,
    )


def test_vectors_of_too_many_requests() -> None:
    talk = up(Talk())
    talk.chapter(100, *[msg.ReadParameter("m", "6064") for _ in range(40)])
    names = [type(event).__name__ for event in talk.events]
    assert (names.count("Parameter"), names.count("Done"), names.count("Refused")) == (32, 0, 8)


def test_vectors_of_a_reboot() -> None:
    talk = up(Talk())
    talk.chapter(
        150,
        msg.Reboot("m"),
        msg.Idle("m"),
        expected="""
        0 nmt RESET 2
        < State initialising restarted
        < Done Reboot m *
        < State initialising SWITCH ON DISABLED*
        < State ready SWITCH ON DISABLED
        """,
    )
    talk = armed(Talk())
    talk.chapter(
        20, msg.Reboot("m"), msg.Hold("m"), expected="0 < Refused Reboot m it is armed*\nsync ?, beat ?"
    )
    talk.chapter(200, msg.Idle("m"))
    talk.drive.starts = 99  # NMT is lost
    talk.chapter(
        8200,
        msg.Reboot("m"),
        msg.Idle("m"),
        expected="""
        nmt RESET 2 /2000 until 6000..8000
        8000..8010 < Refused Reboot m no boot-up message after the reset
        """,
    )
    drive = Drive()
    drive.stand("OPERATION ENABLED", 8)
    talk = up(Talk(drive))
    talk.chapter(20, msg.Reboot("m"), msg.Idle("m"), expected="0 < Refused Reboot m it is armed*")


def test_vectors_of_requests_to_a_drive_that_is_gone() -> None:
    talk = up(Talk())
    talk.drive.dead = True
    talk.chapter(600, expected="400..510 < State offline no frames received")
    talk.chapter(
        8200,
        msg.Reboot("m"),
        msg.ClearFault("m"),
        expected="""
        0 nmt RESET 2 /2000 until 6000..8000
        3000..3010 < Refused ClearFault m no response from the device
        8000..8010 < Refused Reboot m no response from the device
        """,
    )


def test_vectors_of_segments_that_come_twice() -> None:
    talk = up(Talk(feedback_ms=1000))
    talk.drive.copies = 2
    talk.chapter(20, msg.ReadParameter("m", "1008"))
    assert [event for event in talk.events if "twin402" in str(event)]


def test_vectors_of_noise_change_nothing() -> None:
    """Every independent vector from the drive's side, cut and lengthened, beside the drive's frames."""
    noise: dict[CanFrame, None] = {}
    for vector in VECTORS:
        raw = vector.frame
        assert isinstance(raw, CanFrame)
        if 0x580 <= raw.id < 0x600 or raw.id >= 0x700:
            for data in (raw.data[:-1], raw.data + b"\x05", b""):
                noise[CanFrame(raw.id, data)] = None
        noise[CanFrame(raw.id & 0x780 | 0x21, raw.data)] = None  # another node's
        noise[CanFrame(raw.id, raw.data, extended=True)] = None
        noise[CanFrame(raw.id, raw.data, fd=True)] = None
    quiet, loud = armed(Talk(), msg.Velocity("m", 1.0)), armed(Talk(), msg.Velocity("m", 1.0))
    beginning = loud.driver.counters.accepted, loud.driver.counters.ignored + loud.driver.counters.malformed
    own = quiet.driver.counters.accepted
    loud.drive.extra = [frame for frame in noise if frame.id != 0x80]
    for talk in (quiet, loud):
        talk.chapter(100, msg.Velocity("m", 1.0))
    assert loud.frames == quiet.frames
    assert loud.events == quiet.events
    assert loud.driver.counters.accepted - beginning[0] == quiet.driver.counters.accepted - own
    reported = loud.driver.counters.ignored + loud.driver.counters.malformed - beginning[1]
    assert reported == len([frame for frame in noise if frame.id != 0x80])


def test_vectors_are_counted_exactly() -> None:
    talk = armed(Talk())
    counters = talk.driver.counters
    assert talk.frame_count > 150
    assert (counters.accepted, counters.malformed, counters.ignored) == (talk.frame_count, 0, 0)
    before = talk.frame_count
    talk.handle(CanFrame(0x182, b"\x37"), CanFrame(0x582, b"\x60"), CanFrame(0x702, b"\x06"), CanFrame(0x702))
    talk.handle(CanFrame(0x082, bytes(7)), CanFrame(0x282, bytes(9)), CanFrame(0x582, b"\xe0" + bytes(7)))
    # so far 7 for its own drive, and malformed; now a TPDO with an unknown mapping: the drive is alive
    talk.handle(CanFrame(0x482, bytes(3)))
    talk.handle(CanFrame(0x183, bytes(7)), CanFrame(0x583, bytes(8)), CanFrame(0x703, b"\x05"))
    talk.handle(CanFrame(0x202, bytes(7)), CanFrame(0x602, bytes(8)), CanFrame(0x000, b"\x01\x02"))
    talk.handle(CanFrame(0x182, bytes(7), extended=True), CanFrame(0x182, remote=True), CanFrame(0x7E4))
    talk.handle(CanFrame(0x182, bytes(7), fd=True), CanFrame(0x702, remote=True), CanFrame(0x700, b"\x05"))
    assert (counters.accepted, counters.malformed, counters.ignored) == (before + 1, 7, 12)
