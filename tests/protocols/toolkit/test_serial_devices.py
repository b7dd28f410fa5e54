"""What serial devices share: boards of two motors, periods of questions, shafts within a turn, framings."""

from __future__ import annotations

import math

import pytest

from protocols.messages import MILLISECOND
from protocols.plugin import Device
from protocols.toolkit.boards import Boards, both
from protocols.toolkit.masked import Masked
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.questions import Questions
from protocols.toolkit.serial import CRC16_XMODEM, Coded, Covered, Stream, Unmarked, xor8
from protocols.toolkit.table import Decoded, sint, uint
from protocols.toolkit.turns import Shaft

BOARDS = Boards(range(0x80, 0x88))


def test_the_two_motors_of_each_board_have_addresses_of_their_own() -> None:
    assert [(BOARDS.board(at), BOARDS.side(at)) for at in (0x80, 0x87, 0x88, 0x8F)] == [
        *((0x80, 1), (0x87, 1), (0x80, 2), (0x87, 2)),
    ]
    assert all(BOARDS.motor(BOARDS.board(at), BOARDS.side(at)) == at for at in BOARDS.motors)
    with pytest.raises(ValueError, match="it must be its board's, 128 to 135"):
        BOARDS.check(Device("left", 0x90, None, None))


def test_of_a_message_to_a_board_a_motor_has_its_own_numbers() -> None:
    mixed = Decoded("MIXEDSPEED", 0x80, both({1: {"speed": 3}, 2: {"speed": 4}}))
    assert BOARDS.own(0x80, mixed) == {"speed": 3}
    assert BOARDS.own(0x88, mixed) == {"speed": 4}
    assert BOARDS.own(0x81, mixed) is None
    assert BOARDS.own(0x88, Decoded("M1SPEED", 0x80, {"speed": 3})) is None


def test_a_question_is_due_after_its_period_or_when_it_is_set() -> None:
    asked = Questions()
    assert [asked.take(t, "state", 10) for t in (0, 9, 10, 19)] == [True, False, True, False]
    asked.set_due("state", 15)
    assert asked.due("state", 10) == 15
    assert asked.take(15, "state", 10)
    assert asked.due("state", 10) == 25
    asked.forget()
    assert asked.take(15, "state", 10)


def test_a_shaft_is_followed_over_its_turns_and_by_its_velocity_alone() -> None:
    angles, speeds = Shaft(), Shaft(0.0)
    for step in range(300):
        t, true = step * 10 * MILLISECOND, 0.2 * step
        angles.add(t, true % math.tau if step % 5 else None, 20.0)
        speeds.add(t, None, 20.0)
    assert angles.position == pytest.approx(0.2 * 299)
    assert speeds.position == pytest.approx(0.2 * 299)


MASKED = Masked(((sint("current", 16, 0.1),), (uint("code"),), (sint("one", 32), sint("two", 32))))


def test_a_mask_chooses_the_fields_of_a_message() -> None:
    mask = MASKED.mask("current", "one")
    assert mask == 0b101
    data = MASKED.encode(mask, {"current": -3.5, "one": 7, "two": 1e12})
    assert MASKED.size(mask) == len(data) == 10
    assert MASKED.decode(mask, data) == {"current": -3.5, "one": 7, "two": None}
    assert MASKED.decode(mask, data[:-1]) is None


def test_messages_whose_size_follows_from_their_code() -> None:
    framing = Coded(range(0x80, 0x88), {1: 0, 2: 3}, {1}, CRC16_XMODEM, 2)
    messages = [b"\x80\x01", b"\x81\x02abc"]
    line = b"".join(map(framing.frame, messages))
    assert len(line) == 2 + 7
    assert Stream(framing).feed(b"\x07" + line) == [Rx.IGNORED, *messages]
    assert Stream(framing).feed(line[:-1] + b"\x00")[1] is Rx.MALFORMED


def test_an_answer_that_a_checksum_over_its_question_shows() -> None:
    covered, asked, other = Covered(2, CRC16_XMODEM, 2), b"\x80\x10", b"\x81\x10"
    answer, text = covered.frame(asked, b"data"), covered.frame(asked, b"v1\0")
    for noise in (b"", b"\xff", b"1234567"):
        assert covered.find(asked, noise + answer, (6,)) == (len(noise), len(noise) + 6)
        assert covered.find(other, noise + answer, (6,)) is None
        assert covered.find_text(asked, noise + text) == (len(noise), len(noise) + 5)


def test_messages_that_nothing_marks() -> None:
    framing = Unmarked(4, lambda four: None if xor8(four) else four[:-1], xor8)
    assert framing.frame(b"abc") == b"abc" + bytes((xor8(b"abc"),))
    assert Stream(framing).messages(b"\x01" + framing.frame(b"abc") + framing.frame(b"xyz")) == [
        b"abc",
        b"xyz",
    ]
