"""Conversations of vectors: units, what a drive cannot do, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, nan, tau
from typing import Any

import pytest

from protocols import messages as msg
from protocols.messages import Command
from tests.protocols.cia402.conversation import Talk, armed, up
from tests.protocols.cia402.firmware import Drive


def _encoder(drive: Drive) -> None:
    drive.lack(0x6091)  # no gear: 1:1
    drive.put(0x608F, 2000, 1)  # increments in
    drive.put(0x608F, 4, 2)  # four turns of the motor: 500 a turn
    drive.put(0x6064, 125)  # a quarter turn
    drive.put(0x606C, -500)  # -1 turn/s
    drive.put(0x6077, 500)  # half of 1 N·m
    drive.put(0x6078, -200)  # a fifth of 5 A


def _gear(drive: Drive) -> None:
    drive.put(0x608F, 1000, 1)
    drive.put(0x6091, 15, 1)  # turns of the motor per
    drive.put(0x6091, 3, 2)  # turns of the shaft: 5:1, 5000 increments a turn of the shaft
    drive.put(0x6064, 1250)
    drive.put(0x606C, -5000)
    drive.put(0x6076, 2000)  # mN·m, of the motor
    drive.put(0x6077, 50)  # 0.1 N·m of the motor, 0.5 N·m of the shaft
    drive.put(0x6075, 2500)  # mA
    drive.put(0x6078, -400)  # ‰ of them: -1 A


def _feed(drive: Drive) -> None:
    drive.put(0x6091, 5, 1)  # 5:1
    drive.put(0x6092, 1080, 1)  # position units for
    drive.put(0x6092, 3, 2)  # three turns of the shaft: degrees
    drive.put(0x6064, 90)
    drive.put(0x606C, -360)
    drive.put(0x6076, 200)
    drive.put(0x6077, 500)  # half of 0.2 N·m, five times that
    drive.put(0x6078, -200)


def _feed_alone(drive: Drive) -> None:
    _feed(drive)
    drive.lack(0x608F)


def _untold(drive: Drive) -> None:
    drive.lack(0x608F, 0x6091, 0x6092, 0x6076)
    drive.put(0x6064, 2500)
    drive.put(0x606C, -10_000)
    drive.put(0x6077, 250)  # of 2 N·m
    drive.put(0x6078, -200)


COUNTS: list[tuple[Callable[[Drive], None], dict[str, float], int, int, int]] = [
    # 1 rad in position units: per turn / τ; -2 rad/s; 0.25 N·m in ‰
    (_encoder, {}, 80, -159, 250),  # 500/τ = 79.6, -1000/τ = -159.2
    (
        _gear,
        {"rated_torque": 9.0},
        796,
        -1592,
        25,
    ),  # 5000/τ = 795.8, -1591.5; 0.25/(2·5)
    (_feed, {}, 57, -115, 250),  # 360/τ = 57.3, -114.6; 0.25/(0.2·5)
    (_feed_alone, {}, 57, -115, 250),
    (_untold, {"counts_per_turn": 10_000.0, "rated_torque": 2.0}, 1592, -3183, 125),  # 1591.5, -3183.1
]


@pytest.mark.parametrize(("kind", "options", "turned", "turning", "torque"), COUNTS)
def test_vectors_of_units(
    kind: Callable[[Drive], None], options: dict[str, Any], turned: int, turning: int, torque: int
) -> None:
    drive = Drive()
    kind(drive)
    talk = Talk(drive, **options)
    talk.chapter(
        100, expected="< *\n< *\nmeasures position=1.5708 velocity=-6.2832 torque=0.5 current=-1 voltage=48"
    )
    talk.chapter(200, msg.Position("m", 1.0))
    assert drive.get(0x607A) == turned
    talk.chapter(50, msg.Velocity("m", -2.0))
    assert drive.get(0x60FF) == turning
    talk.chapter(50, msg.Torque("m", 0.25))
    assert drive.get(0x6071) == torque
    drive.put(0x6064, -2 * drive.get(0x6064))
    talk.chapter(
        50,
        msg.Hold("m"),
        expected="rpdo2 *\nrpdo1 * /10\n< State *\nsync /10, beat ?\nmeasures position=-3.1416",
    )


def test_vectors_of_a_drive_without_rated_current_and_torque() -> None:
    drive = Drive()
    drive.lack(0x6075, 0x6076)
    drive.put(0x6077, 250)
    talk = armed(Talk(drive))
    talk.chapter(
        50,
        msg.Torque("m", 0.25),
        expected="""
        0 < Refused Torque m *
        sync /10, beat ?
        """,
    )
    talk.chapter(400, msg.Hold("m"))
    said = " ".join(talk.transcript(400))
    assert "torque=" not in said
    assert "current=" not in said
    assert "voltage=48" in said


# fmt: off
UNFIT: list[tuple[Callable[[Drive], None], str]] = [
    (lambda d: d.lack(0x608F),            "units"),
    (lambda d: d.put(0x608F, 0, 1),       "units"),
    (lambda d: d.put(0x608F, 0, 2),       "units"),
    (lambda d: d.put(0x1000, 0x00020191), "401"),  # an I/O module
    (lambda d: d.lack(0x1000),            "402"),
    (lambda d: d.lack(0x6041),            "6041"),
    (lambda d: d.lack(0x6064),            "6064"),
]
# fmt: on


@pytest.mark.parametrize(("kind", "why"), UNFIT)
def test_vectors_of_what_cannot_be_commanded(kind: Callable[[Drive], None], why: str) -> None:
    drive = Drive()
    kind(drive)
    talk = up(Talk(drive))
    talk.chapter(100, msg.Hold("m"))
    reported = [event for event in talk.events if isinstance(event, msg.Fault)]
    assert [(fault.code, why in fault.cause) for fault in reported] == [(0x10003, True)]
    state = [event for event in talk.events if isinstance(event, msg.State)][-1]
    assert (state.mode, why in state.detail) == ("fault", True)
    assert {frame.data[0] for _, frame in talk.frames} <= {0x40, 0x60, 0x70}, "only uploads"


def test_vectors_of_a_drive_with_position_alone() -> None:
    drive = Drive()
    drive.put(0x6502, 0x80)  # CSP
    talk = armed(Talk(drive, modes="profile"))
    assert talk.drive.get(0x6060) == 8
    for word in (msg.Velocity("m", 1.0), msg.Torque("m", 1.0)):
        talk.chapter(
            50,
            word,
            expected=f"""
            0 < Refused {type(word).__name__} m its object 6502 (0x80) has no mode *
            sync /10, beat ?
            """,
        )


def test_vectors_of_a_drive_without_position_modes_that_holds_by_velocity() -> None:
    drive = Drive()
    drive.put(0x6502, 0x104)  # PV and CSV
    talk = armed(Talk(drive))
    talk.chapter(50, msg.Velocity("m", 1.0))
    talk.chapter(
        50,
        msg.Hold("m"),
        expected="""
        rpdo2 60FF=0 6071=0 60B2=0 /10
        still rpdo1 6040=000F 6060=9 607A=4096 …
        sync /10, beat ?
        """,
    )
    talk.chapter(
        50,
        msg.Position("m", 1.0),
        expected="""
        0 < Refused Position m *
        sync /10, beat ?
        """,
    )


# fmt: off
REFUSED: list[tuple[Command, str]] = [
    (msg.Impedance("m", 0.0, 0.0, 0.0, 1.0, 1.0), "the profile has no impedance control"),
    (msg.Position("m", inf),                      "position is inf"),
    (msg.Velocity("m", nan),                      "velocity is nan"),
    (msg.Torque("m", -inf),                       "torque is -inf"),
    (msg.Position("m", 1e9),                      "*"),
    (msg.Velocity("m", -1e9),                     "*"),
    (msg.Torque("m", 33.0),                       "*"),  # 33000 ‰ do not fit into 16 bits
    (msg.Position("m", 0.0, 1e9),                 "*"),
    (msg.Velocity("m", 0.0, 33.0),                "*"),
    (msg.Hold("nobody"),                          "no such motor*"),
]
# fmt: on


@pytest.mark.parametrize(("word", "why"), REFUSED)
def test_vectors_of_commands_that_are_never_sent(word: Command, why: str) -> None:
    talk = armed(Talk())
    reported = f"0 < Refused {type(word).__name__} {word.motor} {why}"
    talk.chapter(60, word, expected=f"{reported}\nsync /10, beat ?")  # told once, as long as it stands
    assert not [frame for _, frame in talk.frames[-3:] if frame.id == 0x202]
    talk.chapter(20, msg.Hold("m"), expected="still rpdo1 6040=000F 6060=8 607A=4096 …\nsync ?, beat ?")
    if word.motor == "m":
        talk.chapter(20, word, expected=f"{reported}\nsync ?, beat ?")
    talk.chapter(
        20,
        msg.SetId("can0", 4711, 3),
        msg.ClearFault("nobody"),
        msg.Hold("m"),
        expected="""
        < Refused SetId *
        < Refused ClearFault nobody *
        sync ?, beat ?
        """,
    )


def test_vectors_of_the_largest_set_points_that_fit() -> None:
    talk = armed(Talk())
    most = (2**31 - 1) * tau / 16384
    talk.chapter(50, msg.Position("m", most * (1 - 1e-12), -most * (1 - 1e-12)))
    assert abs(talk.drive.get(0x607A) - 2**31) < 9
    assert abs(talk.drive.get(0x60B1) + 2**31) < 9
    talk.chapter(50, msg.Torque("m", 32.767))
    assert talk.drive.get(0x6071) == 32767
    talk.chapter(50, msg.Velocity("m", -most * (1 - 1e-12), -32.767))
    assert abs(talk.drive.get(0x60FF) + 2**31) < 9
    assert talk.drive.get(0x60B2) == -32767
