"""Conversations of vectors: the profile modes (PP with its handshake, PV, PT), homing, and zero.

Of the controlword: bit 4 is a new set-point in PP, and starts homing in HM; bit 5 changes the set-point at
once: 0x0F, 0x1F, 0x2F, 0x3F. 16384 increments a turn: 1 rad is 2607.6 of them, 2 rad 5215.2.
"""

from __future__ import annotations

from itertools import pairwise

from protocols.messages import ClearFault, Hold, Home, Idle, Position, Torque, Velocity, Zero
from tests.protocols.cia402.conversation import HOMING, Talk, armed, arming, held_at, up
from tests.protocols.cia402.firmware import Drive


def test_vectors_of_profile_position_and_its_handshake() -> None:
    talk = up(Talk(modes="profile"))
    talk.chapter(70, Hold("m"))
    assert talk.drive.get(0x1400, 2) == 255, "what shakes hands does not wait for SYNC"
    assert talk.drive.get(0x1800, 2) == 1
    talk.chapter(130, Hold("m"))
    talk.chapter(
        20,
        Position("m", 1.0, 5.0),  # a profile has no feed-forward
        expected="""
        0 < Refused Position m * no velocity for Position
        sync /10, beat ?
        """,
    )
    talk.chapter(
        100,
        Position("m", 1.0),
        expected="""
        0..10 rpdo1 6040=003F 6060=1 607A=2608 …
        rpdo1 6040=002F 6060=1 607A=2608 …
        still rpdo2 60FF=0 6071=0 60B2=0 …
        still rpdo3 60B1=0 …
        sync /10, beat ?
        """,
    )
    talk.chapter(
        100,
        Position("m", 1.0),
        expected="""
        still rpdo1 6040=002F 6060=1 607A=2608 …
        sync /10, beat ?
        """,
    )
    talk.chapter(
        100,
        Position("m", 2.0),
        expected="""
        0..10 rpdo1 6040=003F 6060=1 607A=5215 …
        rpdo1 6040=002F 6060=1 607A=5215 …
        sync /10, beat ?
        """,
    )


def test_vectors_of_the_first_set_point_of_profile_position() -> None:
    drive = Drive()
    drive.map(0x1400, 0x202, 255, 0x60400010, 0x60600008, 0x607A0020)
    drive.map(0x1401, 0x302, 255, 0x60FF0020, 0x60710010)
    drive.map(0x1800, 0x40000182, 1, 0x60410010, 0x60610008, 0x60640020)
    talk = up(Talk(drive, modes="profile", watchdog_ms=0))
    talk.chapter(
        200,
        Position("m", 1.0),
        expected=f"""
        0..10 nmt OPERATIONAL 2
        rpdo2 60FF=0 6071=0 …
        {arming(4096, 1)}
        rpdo1 6040=003F 6060=1 607A=2608 …
        rpdo1 6040=002F 6060=1 607A=2608 …
        sync /10
        """,
    )


def test_vectors_of_a_set_point_that_is_not_acknowledged_yet() -> None:
    talk = armed(Talk(modes="profile"), Position("m", 0.0))
    talk.drive.acknowledges = False
    talk.chapter(50, Position("m", 1.0), expected="0..10 rpdo1 6040=003F 6060=1 607A=2608 …\nsync ?, beat ?")
    talk.chapter(
        100,
        Position("m", 2.0),  # the target stays while it is handed over
        expected="""
        still rpdo1 6040=003F 6060=1 607A=2608 …
        sync ?, beat ?
        """,
    )
    talk.drive.acknowledges = True
    talk.chapter(
        100,
        Position("m", 2.0),
        expected="""
        still rpdo1 6040=003F 6060=1 607A=2608 …
        rpdo1 6040=002F 6060=1 607A=* …
        rpdo1 6040=003F 6060=1 607A=5215 …
        rpdo1 6040=002F 6060=1 607A=5215 …
        sync ?, beat ?
        """,
    )


def test_vectors_of_a_set_point_that_is_acknowledged_very_late_the_newest_still_wins() -> None:
    """Bit 4 is obeyed on its rising edge: a target that is put beside a bit that stands was never given."""
    talk = armed(Talk(modes="profile"), Position("m", 0.0))
    talk.drive.acknowledges = False
    talk.chapter(50, Position("m", 1.0))
    talk.chapter(500, Position("m", 2.0))
    talk.drive.acknowledges = True
    talk.chapter(200, Position("m", 2.0))
    words = [(w.data[0], int.from_bytes(w.data[3:7], "little")) for _, w in talk.frames if w.id == 0x202]
    rising = [target for (before, _), (word, target) in pairwise(words) if word & ~before & 0x10]
    assert rising[-1] == 5215, rising


def test_vectors_of_profile_velocity_and_torque() -> None:
    talk = armed(Talk(modes="profile"), Velocity("m", 1.0))
    assert talk.drive.get(0x60FF) == 2608
    talk.chapter(
        100,
        Velocity("m", -2.0),
        expected="""
        rpdo2 60FF=-5215 6071=0 60B2=0 …
        still rpdo1 6040=000F 6060=3 607A=4096 …
        sync /10, beat ?
        """,
    )
    talk.chapter(
        100,
        Torque("m", -0.25),
        expected="""
        rpdo2 60FF=0 6071=-250 60B2=0 …
        rpdo1 6040=000F 6060=4 607A=4096 …
        < State armed OPERATION ENABLED, profile torque
        sync /10, beat ?
        """,
    )


def test_vectors_of_homing() -> None:
    talk = armed(Talk())
    talk.chapter(
        150,
        Home("m"),
        Hold("m"),
        expected=f"""
        {HOMING}
        50..110 < Done Home m *
        {held_at(0)}
        sync /10, beat ?
        measures position=0 velocity=0 torque=0
        """,
    )


def test_vectors_of_homing_by_sdo() -> None:
    talk = armed(Talk(feedback="sdo", mapping="keep", watchdog_ms=0))
    talk.chapter(
        200,
        Home("m"),
        Hold("m"),
        expected="""
        write 6060 = 6
        write 607A = 4096 /20..25 until 50..70
        write 6040 = 001F
        < State armed OPERATION ENABLED, homing
        write 607A = 0 /20..25
        < Done Home m *
        write 6060 = 8
        write 6040 = 000F
        < State armed OPERATION ENABLED, cyclic synchronous position
        """,
    )


def test_vectors_of_homing_that_fails_or_never_ends() -> None:
    drive = Drive()
    drive.homes = "failed"
    talk = armed(Talk(drive, home_timeout_ms=200))
    talk.chapter(
        150,
        Home("m"),
        Hold("m"),
        expected=f"""
        {HOMING}
        50..110 < Refused Home m it reports a homing error*
        {held_at(4096)}
        sync /10, beat ?
        """,
    )
    drive.homes = "never"
    talk.chapter(
        300,
        Home("m"),
        Hold("m"),
        expected=f"""
        {HOMING}
        200..210 < Fault 10006 homing did not end
        < Refused Home m it did not end in time
        {held_at(4096)}
        sync /10, beat ?
        """,
    )


def test_vectors_of_homing_that_is_left() -> None:
    drive = Drive()
    drive.homes = "never"
    talk = armed(Talk(drive))
    talk.chapter(60, Home("m"), Hold("m"))
    talk.chapter(
        20,
        Home("m"),
        Hold("m"),
        expected="""
        0 < Refused Home m homing is under way
        still rpdo1 6040=001F 6060=6 607A=4096 …
        sync ?, beat ?
        """,
    )
    talk.chapter(
        100,
        Idle("m"),
        expected="""
        < Refused Home m *disarmed*
        rpdo1 6040=0006 6060=6 607A=4096 …
        < State ready READY TO SWITCH ON
        write 1016:01 = 00000000
        sync ?, beat ?
        """,
    )
    talk.chapter(
        50,
        Home("m"),
        Zero("m"),
        Idle("m"),
        expected="""
        0 < Refused Home m it must be armed and hold*
        0 < Refused Zero m it must be armed and hold*
        """,
    )


def test_vectors_of_setting_the_present_position_to_zero() -> None:
    for refused, method in ((None, 37), (37, 35)):
        drive = Drive()
        drive.put(0x6098, -3)  # one of the maker's own
        if refused:
            drive.refuse(0x6098, 0x06090030, refused)
        talk = armed(Talk(drive))
        tried = "write 6098 = 37\n        write 6098 = 35" if refused else "write 6098 = 37"
        talk.chapter(
            200,
            Zero("m"),
            Hold("m"),
            expected=f"""
        {tried}
        {HOMING}
        < Done Zero m *
        write 6098 = -3
        {held_at(0)}
        sync /10, beat ?
        reads 6098
        """,
        )
        assert drive.get(0x6098) == -3, method
        drive.put(0x6098, 33)
        talk.chapter(150, Home("m"), Hold("m"))  # by what is set there
        assert drive.get(0x6098) == 33


def test_vectors_of_drives_that_cannot_home() -> None:
    drive = Drive()
    drive.lack(0x6098)
    talk = armed(Talk(drive))
    talk.chapter(
        100,
        Zero("m"),
        Hold("m"),
        expected="""
        < Refused Zero m it cannot take its present position as zero: the device has no such object*
        sync /10, beat ?
        """,
    )
    drive = Drive()
    drive.put(0x6502, 0x80)  # CSP alone
    talk = armed(Talk(drive))
    talk.chapter(
        50,
        Home("m"),
        ClearFault("m"),
        Hold("m"),
        expected="""
        0 < Refused Home m it has no homing mode*
        < Done ClearFault m
        sync /10, beat ?
        """,
    )


def test_vectors_of_a_set_point_by_sdo_that_is_acknowledged_very_late() -> None:
    talk = armed(Talk(modes="profile", feedback="sdo", mapping="keep", watchdog_ms=0), Position("m", 0.0))
    talk.drive.acknowledges = False
    talk.chapter(50, Position("m", 1.0), expected="write 607A = 2608 …\nwrite 6040 = 003F")
    talk.chapter(
        350,
        Position("m", 2.0),
        expected="""
        write 607A = 2608 /20..25 until 180..220
        190..220 write 607A = 5215 /20..25
        write 6040 = 002F
        write 6040 = 003F
        """,
    )
    talk.drive.acknowledges = True
    talk.chapter(100, Position("m", 2.0), expected="write 607A = 5215 /20..25\nwrite 6040 = 002F")


def test_vectors_of_disarming_in_profile_modes() -> None:
    talk = armed(Talk(modes="profile", feedback="event"), Velocity("m", 1.0))
    talk.chapter(
        100,
        Idle("m"),
        expected="""
        0 rpdo2 60FF=0 6071=0 60B2=0
        0 rpdo1 6040=0006 6060=3 607A=4096
        < State ready READY TO SWITCH ON
        write 1016:01 = 00000000
        beat ?
        """,
    )


def test_vectors_of_a_zero_that_fails_leaves_the_homing_method_as_it_was() -> None:
    drive = Drive()
    drive.put(0x6098, 33)
    drive.homes = "failed"
    talk = armed(Talk(drive))
    talk.chapter(
        150,
        Zero("m"),
        Hold("m"),
        expected=f"""
        write 6098 = 37
        {HOMING}
        < Refused Zero m it reports a homing error*
        write 6098 = 33
        {held_at(4096)}
        sync /10, beat ?
        """,
    )


def test_vectors_of_a_restart_in_the_middle_of_homing() -> None:
    drive = Drive()
    drive.homes = "never"
    talk = armed(Talk(drive))
    talk.chapter(50, Home("m"), Hold("m"))
    drive.restart()
    talk.chapter(
        20,
        Idle("m"),
        expected="""
        0 < State initialising restarted
        < State initialising reading its object dictionary
        0 < Refused Home m it was disarmed*
        write 6040 = 0006 …
        < State initialising *
        sync ?, beat ?
        """,
    )
