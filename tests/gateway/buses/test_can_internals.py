"""The parts of a CAN bus: states, timestamps, the kernel's structs and errors, rtnetlink."""

from __future__ import annotations

import copy
import json
import struct
from importlib.resources import files
from itertools import pairwise
from random import Random
from typing import Any

import can
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame

from gateway.buses.error_frames import BUS_OFF, CanError, describe, kinds, state_of
from gateway.buses.frame_time import LENGTHS
from gateway.buses.netlink import NetDevice, NetLink, parse, request
from gateway.buses.socketcan.raw_socket import pack, unpack
from gateway.buses.states import CALM, StateTracker
from gateway.buses.timestamps import OLDEST, TimestampMapper
from protocols.frames import BusState, CanFrame
from protocols.messages import MILLISECOND, SECOND, Nanos

UP, PASSIVE, OFF, FULL, GONE, BACK = BusState

# -- states ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("states_set", "reported"),
    [
        ([UP], []),
        ([PASSIVE, PASSIVE, UP], [PASSIVE, UP]),
        ([PASSIVE, OFF, BACK], [PASSIVE, OFF, BACK]),
        ([OFF, UP], [OFF, BACK]),
        ([OFF, OFF, PASSIVE], [OFF, BACK, PASSIVE]),
        ([OFF, GONE, UP], [OFF, GONE, BACK]),
        ([GONE, GONE, BACK, BACK], [GONE, BACK]),
        ([FULL, FULL], [FULL]),
        ([FULL, PASSIVE, UP], [FULL]),
        ([PASSIVE, FULL], [PASSIVE, FULL]),
        ([FULL, GONE, FULL, BACK], [FULL, GONE, BACK]),
        ([GONE, FULL], [GONE]),
    ],
    ids=str,
)
def test_each_change_is_reported_once(states_set: list[BusState], reported: list[BusState]) -> None:
    states = StateTracker()
    for state in states_set:
        if state is FULL:
            states.full(0)
        else:
            states.set(state)
    assert states.take(1) == reported
    assert states.take(2) == []


def test_congestion_is_over_when_nothing_had_to_wait_for_a_while_and_then_the_state_is_reported() -> None:
    for line, after in ((UP, UP), (PASSIVE, PASSIVE)):
        states = StateTracker()
        reported = []
        for tick in range(400):  # every tick's last frame finds no room: reported once
            states.full(tick * 5 * MILLISECOND)
            reported += states.take(tick * 5 * MILLISECOND)
        assert reported == [FULL]
        states.set(line)
        last = 399 * 5 * MILLISECOND
        assert states.take(last + CALM - 1) == []
        assert states.take(last + CALM) == [after]


def test_the_last_report_is_always_the_present_state() -> None:
    """Over random histories: no state twice in a row, and BACK exactly where OFF or GONE ends."""
    for seed in range(200):
        random, states, reported = Random(seed), StateTracker(), []
        now = 0
        for _ in range(60):
            now += random.randrange(2 * CALM)
            if (state := random.choice([UP, PASSIVE, OFF, GONE, BACK, FULL])) is FULL:
                states.full(now)
            else:
                states.set(state)
            reported += states.take(now)
        reported += states.take(now + CALM)
        assert all(a is not b for a, b in pairwise(reported)), seed
        shown = UP
        for state in reported:
            assert (state is BACK) <= (shown in (OFF, GONE)), seed
            shown = UP if state is BACK else state
        assert shown is states.state, seed
        assert copy.deepcopy(states).take(now + CALM) == []


# -- stamps ---------------------------------------------------------------------------------------

OFFSET: Nanos = 1_790_000_000 * SECOND
"""The system's clock minus ours."""


def read(
    stamps: TimestampMapper, now: Nanos, offset: Nanos, *arrived: Nanos, whole: bool = True
) -> list[Nanos]:
    """One reading at `now`, with `offset` between the clocks, of frames that the system stamped so."""
    stamps.begin(now, offset)
    moved = [stamps.map(stamp) for stamp in arrived]
    if whole:
        stamps.end()
    return moved


def test_stamps_are_moved_exactly_and_never_backwards_nor_into_the_future() -> None:
    stamps = TimestampMapper()
    assert read(stamps, 100, OFFSET, OFFSET + 7, OFFSET + 9, OFFSET + 8) == [7, 9, 9]
    assert read(stamps, 200, OFFSET, OFFSET + 150, OFFSET + 230) == [150, 200]
    assert read(stamps, 300, OFFSET, OFFSET + 120) == [200]
    assert (stamps.steps, stamps.bad) == (0, 0)


@pytest.mark.parametrize(
    "step", [-3600 * SECOND, -7 * MILLISECOND, 7 * MILLISECOND, 30 * MILLISECOND, SECOND]
)
def test_a_clock_that_is_set_moves_no_stamp(step: Nanos) -> None:
    """Every 5 ms one frame before the system's clock is set and one after it, in one reading."""
    stamps = TimestampMapper()
    tick, offset, wrong = 5 * MILLISECOND, OFFSET, []
    for n in range(1, 20):
        now, before = n * tick, offset
        if n == 10:
            offset += step
        early, late = now - 4 * MILLISECOND, now - MILLISECOND
        moved = read(stamps, now, offset, early + before, late + offset)
        wrong += [abs(m - t) for m, t in zip(moved, (early, late), strict=True) if m != t]
    assert wrong == []
    assert (stamps.steps, stamps.bad) == (1, 0)


def test_jitter_of_the_look_at_both_clocks_is_no_step() -> None:
    stamps, random = TimestampMapper(), Random(1)
    for n in range(1, 100):
        now = n * 5 * MILLISECOND
        jitter = random.randrange(-100_000, 100_000)
        (moved,) = read(stamps, now, OFFSET + jitter, OFFSET + now - 2 * MILLISECOND)
        assert abs(moved - (now - 2 * MILLISECOND)) <= 100_000
    assert stamps.steps == 0


def test_a_stamp_that_cannot_be_is_the_moment_of_reading() -> None:
    stamps = TimestampMapper()
    read(stamps, 3 * SECOND, OFFSET)
    assert read(stamps, 4 * SECOND, OFFSET, 0) == [4 * SECOND]
    assert read(stamps, 5 * SECOND, OFFSET, OFFSET + 4 * SECOND - OLDEST - 1) == [5 * SECOND]
    assert stamps.bad == 2


def test_what_a_reading_left_behind_is_as_old_as_it_is() -> None:
    stamps = TimestampMapper()
    read(stamps, SECOND, OFFSET)
    read(stamps, 2 * SECOND, OFFSET, OFFSET + SECOND + 1, whole=False)
    assert read(stamps, 9 * SECOND, OFFSET, OFFSET + SECOND + 2) == [SECOND + 2]


def test_without_a_wall_clock_a_stamp_is_the_moment_of_reading() -> None:
    stamps = TimestampMapper()
    stamps.begin(5, None)
    assert stamps.map(OFFSET + 3) == 5


# -- the kernel's struct ------------------------------------------------------------------------------

FRAMES = [
    CanFrame(0x123, b"\x01\x02"),
    CanFrame(0),
    CanFrame(0x7FF, b"12345678"),
    CanFrame(0x123, remote=True),
    CanFrame(0x1FFFFFFF, b"\xff" * 8, extended=True),
    CanFrame(0x12, extended=True, remote=True, requested=8),
    *(CanFrame(n, bytes(range(length)), fd=True, brs=n % 2 == 1) for n, length in enumerate(LENGTHS)),
    CanFrame(0x12345678, bytes(64), extended=True, fd=True, brs=True),
]


@pytest.mark.parametrize("frame", FRAMES, ids=str)
def test_frames_are_python_cans_own_bytes_and_come_back(frame: CanFrame) -> None:
    message = can.Message(
        arbitration_id=frame.id,
        data=frame.data,
        dlc=frame.requested or None,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        is_fd=frame.fd,
        bitrate_switch=frame.brs,
    )
    theirs = bytearray(build_can_frame(message))
    theirs[7] = 0  # python-can fills in len8_dlc, which is ignored unless the driver is configured for it
    assert pack(frame) == bytes(theirs)
    assert unpack(pack(frame)) == frame


def test_can_fd_is_padded_to_a_valid_length() -> None:
    for length in range(65):
        back = unpack(pack(CanFrame(1, b"\xff" * length, fd=True)))
        assert isinstance(back, CanFrame)
        assert len(back.data) == next(n for n in LENGTHS if n >= length)
        assert back.data == (b"\xff" * length).ljust(len(back.data), b"\0")


@pytest.mark.parametrize(
    "frame",
    [CanFrame(0x800), CanFrame(-1), CanFrame(1 << 29, extended=True), CanFrame(1, bytes(9)),
     CanFrame(1, bytes(65), fd=True)],
    ids=str,
)  # fmt: skip
def test_an_invalid_frame_is_not_encoded(frame: CanFrame) -> None:
    with pytest.raises(ValueError, match="carr"):
        pack(frame)


def test_no_bytes_raise() -> None:
    random = Random(7)
    seen = set()
    for _ in range(5000):
        frame = unpack(random.randbytes(random.choice([0, 8, 15, 16, 16, 17, 71, 72, 72])))
        seen.add(type(frame).__name__)
        if isinstance(frame, CanError):
            assert describe(frame)
            state_of(frame)
    assert seen == {"CanFrame", "CanError", "NoneType"}
    assert unpack(struct.pack("=IB3x8s", 1, 9, b"")) is None
    assert unpack(struct.pack("=IBB2x64s", 1, 65, 0, b"")) is None


# -- error frames ----------------------------------------------------------------------------------


def error(classes: int, *data: int) -> CanError:
    raw = struct.pack("=IB3x8s", 0x2000_0000 | classes, 8, bytes(data))
    frame = unpack(raw)
    assert isinstance(frame, CanError)
    return frame


ERRORS: list[tuple[CanError, BusState | None, str]] = [
    (error(0x004, 0, 0x04), UP, "error-warning while receiving"),
    (error(0x004, 0, 0x10), PASSIVE, "error-passive while receiving"),
    (error(0x204, 0, 0x20, 0, 0, 0, 0, 128, 3), PASSIVE,
     "error-passive while sending (error counters: 128 sending, 3 receiving)"),
    (error(0x004, 0, 0x28), PASSIVE, "error-warning while sending; error-passive while sending"),
    (error(0x004, 0, 0x40), UP, "error-active again"),
    (error(0x004, 0, 0x01), None, "receive buffer overflow: frames are lost"),
    (error(0x004, 0, 0x00), None, "error frame of class 0x4"),
    (error(0x040), OFF, "bus-off"),
    (error(0x100), BACK, "restarted after bus-off"),
    (error(0x144, 0, 0x30), OFF,
     "error-passive while receiving; error-passive while sending; bus-off; restarted after bus-off"),
    (error(0x020), None, "no acknowledgement (no other node is active)"),
    (error(0x0A8, 0, 0, 0x80, 0x19), None,
     "protocol violation while sending, at: acknowledge slot; no acknowledgement (no other node is active)"),
    (error(0x088, 0, 0, 0x04, 0x0A), None, "bit stuffing error, at: data"),
    (error(0x088, 0, 0, 0x90, 0x00), None, "a recessive bit could not be sent while sending"),
    (error(0x080), None, "bus error"),
    (error(0x002, 5), None, "arbitration lost"),
    (error(0x001), None, "transmit timeout of the controller"),
    (error(0x010, 0, 0, 0, 0, 0x74), None, "CAN-H is not connected; CAN-L is shorted to ground"),
    (error(0x010, 0, 0, 0, 0, 0x0F), None, "transceiver error 0x0F"),
]  # fmt: skip


@pytest.mark.parametrize(("received", "state", "text"), ERRORS, ids=[text for _, _, text in ERRORS])
def test_error_frames_have_a_state_and_a_description(
    received: CanError, state: BusState | None, text: str
) -> None:
    assert state_of(received) is state
    assert describe(received) == text
    assert all("counter" not in kind for kind in kinds(received))


def test_every_bit_of_an_error_frame_has_a_description() -> None:
    for bit in range(10):
        assert describe(error(1 << bit, *[0xFF] * 8)), bit
    assert describe(error(0x200, 0, 0, 0, 0, 0, 0, 1, 2)).endswith("(error counters: 1 sending, 2 receiving)")
    assert "counters" not in describe(error(0x040, 0, 0, 0, 0, 0, 0, 1, 2))
    assert BUS_OFF == 0x40


# -- rtnetlink -------------------------------------------------------------------------------------

ANSWERS: list[dict[str, Any]] = json.loads(
    (files("gateway.fixtures") / "vectors" / "rtnetlink.json").read_text()
)["answers"]


def link_of(reported: dict[str, Any]) -> NetLink:
    state = reported["state"] and BusState(reported["state"])
    count = reported["counters"] and tuple(reported["counters"])
    return NetLink(**{**reported, "state": state, "counters": count})


@pytest.mark.parametrize("row", ANSWERS, ids=[row["what"] for row in ANSWERS])
def test_a_kernels_answers_are_understood(row: dict[str, Any]) -> None:
    raw = bytes.fromhex(row["bytes"])
    assert parse(raw) == (row["link"] and link_of(row["link"]))
    for cut in range(0, len(raw), 7):  # cut anywhere: nothing, and no exception
        assert parse(raw[:cut]) is None


@pytest.mark.parametrize(
    ("number", "state"), [(0, UP), (1, UP), (2, PASSIVE), (3, OFF), (4, None), (5, None)]
)
def test_the_controllers_states(number: int, state: BusState | None) -> None:
    raw = bytes.fromhex(ANSWERS[0]["bytes"])
    attribute = struct.pack("=HHI", 8, 4, 0)  # IFLA_CAN_STATE: error-active
    at = raw.rindex(attribute)
    link = parse(raw[:at] + struct.pack("=HHI", 8, 4, number) + raw[at + 8 :])
    assert link is not None
    assert link.state is state


def test_no_answer_raises() -> None:
    random = Random(3)
    for _ in range(3000):
        raw = bytearray(bytes.fromhex(random.choice(ANSWERS)["bytes"]))
        for _ in range(random.randrange(1, 6)):
            raw[random.randrange(len(raw))] = random.randrange(256)
        parse(bytes(raw))


def test_this_machines_kernel_answers() -> None:
    """lo stands on every Linux: asked for real, both ways."""
    device = NetDevice("lo")
    try:
        link, status = device.link(), device.status()
        assert link is not None
        assert status is not None
        assert (link.name, link.kind, link.ifindex, link.up) == ("lo", "", status.ifindex, status.up)
        nothing = NetDevice("no-such-if")
        assert (nothing.link(), nothing.status()) == (None, None)
        nothing.close()
    finally:
        device.close()
    assert len(request("can0")) % 4 == 0
