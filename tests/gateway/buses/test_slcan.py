"""slcan: vectors, the emulated adapter, python-can's own client, streams cut anywhere."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from importlib.resources import files
from typing import Any

import can
import pytest
from can.interfaces.slcan import slcanBus
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.buses.adapters.slcan import EmulatedAdapter, frame_of, line_of, rate_of
from gateway.buses.can import CanBus, open_can
from gateway.buses.python_can import message_of
from gateway.core.clock import SimulatedClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, CanFrame, Packet
from protocols.messages import MILLISECOND
from tests.gateway.buses.adapter_helpers import (
    DATA_RATE,
    FD,
    RATE,
    can_frames,
    cut,
    cuts,
    cuttings,
    feed,
    is_connected,
    open_path,
    poll,
    raw_pty,
    wait_for_input,
)

VECTORS: list[dict[str, Any]] = json.loads((files("gateway.fixtures") / "vectors" / "slcan.json").read_text())

# fmt: off
FRAMES = [
    # frame, its line, source
    (CanFrame(0x123, b"\x11\x22\x33"),                        "t1233112233"),
    (CanFrame(0x1ABCDEF0, b"\xde\xad", extended=True),        "T1ABCDEF02DEAD"),
    (CanFrame(0x7E6, remote=True),                            "r7E60"),
    (CanFrame(0x12345, remote=True, extended=True),           "R000123450"),
    (CanFrame(0x001, remote=True, requested=3),               "r0013"),
    (CanFrame(0x7FF, b""),                                    "t7FF0"),
    (CanFrame(0x001, bytes(12), fd=True),                     "d0019" + "00" * 12),
    (CanFrame(0x1FFFFFFF, bytes(64), True, False, True),      "D1FFFFFFFF" + "00" * 64),
    (CanFrame(0x001, b"\x01", fd=True, brs=True),             "b001101"),
    (CanFrame(0x8001, bytes(range(12)), True, False, True, True), "B000080019000102030405060708090A0B"),
]
# fmt: on


def opened(data_bitrate: int = DATA_RATE) -> EmulatedAdapter:
    adapter = EmulatedAdapter(RATE, data_bitrate)
    assert adapter.feed(b"S8\rO\r") == ([], b"\r\r")
    return adapter


# -- bytes -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("frame", "line"), FRAMES, ids=[line[:12] for _, line in FRAMES])
def test_a_frame_is_its_line_in_both_directions(frame: CanFrame, line: str) -> None:
    assert line_of(frame) == line
    assert frame_of(line) == frame
    assert frame_of(line.lower().replace(line[0].lower(), line[0], 1)) == frame
    answer = b"Z\r" if frame.extended else b"z\r"
    assert opened().feed(line.encode() + b"\r") == ([frame], answer)
    assert opened().report(0, frame) == line.encode() + b"\r"


@settings(deadline=None, derandomize=True)
@given(can_frames())
def test_any_frame_survives(frame: CanFrame) -> None:
    assert frame_of(line_of(frame)) == frame


def test_the_vectors_are_decoded_and_encoded() -> None:
    """Bytes of python-can 4.6.1 over a pty, in the order in which it sent them; each with its source."""
    assert all("python-can 4.6.1" in vector["source"] for vector in VECTORS)
    adapter = EmulatedAdapter(RATE, DATA_RATE)
    received: dict[str, tuple[list[CanFrame], bytes]] = {}
    encoded: list[str] = []
    for vector in VECTORS:
        data, meaning = bytes.fromhex(vector["data"]), vector["meaning"]
        if vector["direction"] == "to_device":
            received[vector["name"]] = adapter.feed(data)
        elif "id" in meaning:
            frame = CanFrame(
                meaning["id"],
                bytes.fromhex(meaning.get("data", "")),
                meaning.get("extended", False),
                meaning.get("rtr", False),
            )
            assert adapter.report(0, frame) == data
            encoded.append(vector["name"])
    assert encoded == ["rx_t10081122334455667788", "rx_T000002904DEADBEEF", "rx_r7E60"]
    assert received == {
        "open_1M#0": ([], b"\r"),
        "open_1M#4": ([], b"\r"),
        "open_1M#6": ([], b"\r"),
        "open_1M#8": ([], b"\r"),
        "tx_std_0x123_3bytes": ([FRAMES[0][0]], b"z\r"),
        "tx_ext_0x1abcdef0": ([FRAMES[1][0]], b"Z\r"),
        "tx_rtr_0x7e6": ([FRAMES[2][0]], b"z\r"),
        "tx_fd_brs_ext_12bytes": ([FRAMES[9][0]], b"Z\r"),
        "version_serial#2": ([], b"NTWIN\r"),
        "close#0": ([], b"\r"),
    }


# -- commands --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "answers"),
    [
        (b"V\r", b"V1001\r"),
        (b"N\r", b"NTWIN\r"),
        (b"\r\r", b"\r\r"),
        (b"C\rC\r", b"\r\r"),
        (b"O\rO\r", b"\r\r"),
        (b"S8\rO\rF\r", b"\r\rF00\r"),
        (b"s0014\rO\rF\r", b"\r\rF00\r"),  # Lawicel's table: 1 Mbit/s
        (b"S6\rO\rF\r", b"\r\rFA0\r"),
        (b"S8\rY2\rO\rF\r", b"\r\r\rFA0\r"),
        (b"S8\rY5\rO\rF\r", b"\r\r\rF00\r"),
        (b"F\r", b"\a"),  # closed
        (b"t1230\r", b"\a"),  # closed
        (b"O\rC\rt1230\r", b"\r\r\a"),
        (b"L\rt1230\r", b"\r\a"),  # listens only
        (b"O\rS6\r", b"\r\a"),  # open
        (b"O\rZ1\r", b"\r\a"),  # open
        (b"O\rt1239" + b"00" * 9 + b"\r", b"\r\a"),
        (b"O\rt12321122334455\r", b"\r\a"),
        (b"O\rt123211\r", b"\r\a"),
        (b"O\rt8000\r", b"\r\a"),
        (b"O\rT200000000\r", b"\r\a"),
        (b"O\rt1 30\r", b"\r\a"),
        (b"O\rt+120\r", b"\r\a"),
        (b"O\rt12321_1\r", b"\r\a"),
        ("O\rt12\u0663\u0660\r".encode(), b"\r\a"),
        (b"O\rr7E6011\r", b"\r\a"),
        (b"S\rSA\rs00\rs00GG\rY9\rZ2\rZ\rX\rVx\rOO\rL1\rt\rT\r", b"\a" * 13),
        (b"x" * 5000 + b"\rV\r", b"\aV1001\r"),
        (b"S8\r\nO\r\nV\r\n", b"\r\rV1001\r"),  # as a program prints lines
        (b"S8\nO\nV\n\nt1\n", b"\r\rV1001\r\r\a"),
    ],
)
def test_commands_are_answered_and_invalid_ones_with_bell(sent: bytes, answers: bytes) -> None:
    for pieces in cuttings(sent):
        assert feed(EmulatedAdapter(RATE, DATA_RATE), pieces) == ([], answers)


def test_bus_timing_registers_of_the_manual() -> None:
    """Lawicel CAN232 manual: 0x031C is 125 kbit/s; 0x00 0x14 is 1 Mbit/s, 0x00 0x1C 500 kbit/s."""
    assert [rate_of(btr) for btr in ("031C", "0014", "001C", "00", "001g", "00 1")] == [
        125_000,
        1_000_000,
        500_000,
        None,
        None,
        None,
    ]


def test_an_adapter_of_another_bit_rate_neither_sends_nor_receives() -> None:
    adapter = EmulatedAdapter(500_000)
    adapter.feed(b"S8\rO\r")
    assert adapter.wrong_rate
    assert adapter.feed(b"t1230\r") == ([], b"\a")
    assert adapter.report(0, CanFrame(1)) == b""
    assert adapter.feed(b"C\rS6\rO\rt1230\r") == ([CanFrame(0x123)], b"\r\r\rz\r")


def test_a_bus_of_classic_can_takes_no_fd_frames() -> None:
    assert opened(data_bitrate=0).feed(b"d0010\rb0010\r") == ([], b"\a\a")


def test_timestamps_are_milliseconds_of_a_minute_and_only_where_asked_for() -> None:
    adapter = EmulatedAdapter(RATE)
    adapter.feed(b"Z1\rO\r")
    frame = CanFrame(0x100, b"\x01")
    assert adapter.report(1234 * MILLISECOND, frame) == b"t100101" + b"04D2\r"
    assert adapter.report(60_001 * MILLISECOND, frame) == b"t100101" + b"0001\r"
    adapter.feed(b"C\rZ0\rO\r")
    assert adapter.report(0, frame) == b"t100101\r"


def test_a_loss_is_reported_once_by_the_flags() -> None:
    adapter = opened()
    adapter.overrun = True
    assert adapter.feed(b"F\rF\r")[1] == b"F08\rF00\r"


streams = st.lists(
    st.one_of(
        st.binary(max_size=30),
        st.sampled_from([b"\r", b"\n", b"O\r", b"C\r", b"S8\r", b"t1231", b"11\r", b"B", b"F\r", b"0" * 200]),
        can_frames().map(lambda frame: line_of(frame).encode() + b"\r"),
    ),
    max_size=30,
)


@settings(deadline=None, derandomize=True)  # the machine may be busy; the same cases every time
@given(streams, cuts)
def test_any_bytes_cut_anywhere_raise_nothing_and_decode_alike(pieces: list[bytes], sizes: list[int]) -> None:
    data = b"".join(pieces)
    whole, parted = EmulatedAdapter(RATE, DATA_RATE), EmulatedAdapter(RATE, DATA_RATE)
    frames, replies = whole.feed(data)
    assert feed(parted, cut(data, sizes)) == (frames, replies)
    assert len(replies.replace(b"\a", b"\r").split(b"\r")) == len(re.split(rb"\r\n?|\n", data))
    assert parted.open == whole.open


# -- python-can's own client -----------------------------------------------------------------------


@pytest.fixture
def bus() -> Iterator[AdapterPty]:
    with closing(AdapterPty(FD, ("slcan", "slcan"))) as made:
        yield made


def client(path: str, **options: Any) -> slcanBus:
    return slcanBus(path, sleep_after_open=0.0, timeout=0.0, **options)


def received_by(program: can.BusABC, seconds: float = 60.0) -> can.Message | None:
    """The next frame; acknowledgements are none."""
    for _ in range(1000):
        message = program.recv(seconds / 1000)
        if message is not None:
            return message
    return None


def test_python_cans_own_client_works_in_both_directions(bus: AdapterPty) -> None:
    raw = client(bus.paths[0], bitrate=RATE)
    assert bus.read(0) == ([BusState.BACK], [])
    for frame, _ in FRAMES:
        raw.send(message_of(frame))
        assert bus.read(1) == ([], [Packet(1, "can0", frame)])
        bus.write(2, [frame])
        reported = received_by(raw)
        assert reported is not None
        assert reported.equals(message_of(frame), timestamp_delta=None, check_direction=False)
    raw.shutdown()
    assert bus.read(3) == ([BusState.GONE], [])


def test_a_program_that_hangs_up_leaves_a_closed_adapter(bus: AdapterPty) -> None:
    for turn in range(3):
        other = open_path(bus.paths[0])
        os.write(other, b"S8\rO\rt12")  # and is killed in the middle of a line
        assert bus.read(turn)[0] == [BusState.BACK]
        bus.write(turn, [CanFrame(0x1, b"old news")])
        os.close(other)
        assert bus.read(turn)[0] == [BusState.GONE]
    frame = client(bus.paths[0])
    bus.read(9)
    frame.send(message_of(FRAMES[0][0]))
    assert bus.read(9)[1] == [Packet(9, "can0", FRAMES[0][0])]
    assert received_by(frame, 0.05) is None
    frame.shutdown()


def test_another_bit_rate_is_reported(bus: AdapterPty) -> None:
    frame = client(bus.paths[0], bitrate=500_000)
    assert bus.read(0)[0] == [BusState.PASSIVE]
    frame.set_bitrate(RATE)
    assert bus.read(1)[0] == [BusState.BACK]
    frame.shutdown()


def test_a_slow_program_loses_the_oldest_frames_and_the_flags_report_it(bus: AdapterPty) -> None:
    other = open_path(bus.paths[0])
    os.write(other, b"O\r")
    bus.read(0)
    for number in range(2000):
        bus.write(number, [CanFrame(0x100, number.to_bytes(8, "big"))])
    assert bus.dropped > 0
    os.write(other, b"F\r")
    lines = b""
    for turn in range(1000):
        bus.read(turn)
        if b"F08\r" in lines:
            break
        wait_for_input(other)
        lines += os.read(other, 65536)
    frames_received = [frame for line in lines.decode().split("\r") if (frame := frame_of(line))]
    assert frames_received[-1].data == (1999).to_bytes(8, "big")
    assert len(frames_received) == 2000 - bus.dropped
    os.close(other)


# -- the client ------------------------------------------------------------------------------------


def test_what_cannot_be_opened_is_a_sentence_and_leaves_nothing_open() -> None:
    with closing(AdapterPty(FD)) as adapters:
        path = adapters.paths[0]
        for settings, text in (
            (BusSettings("can0", "can", "slcan:/dev/there-is-none", RATE), "No such file"),
            (BusSettings("can0", "can", "slcan:/dev/null", RATE), "Could not configure port"),
            (BusSettings("can0", "can", f"slcan:{path}", 123), "no bitrate of slcan is 123; there is 10000,"),
            (BusSettings("can0", "canfd", f"slcan:{path}", RATE, 3_000_000), "no data_bitrate of slcan"),
        ):
            with pytest.raises(BusError, match=text):
                open_can(settings, SimulatedClock())
        assert not is_connected(adapters._ports[0].pty)


# fmt: off
STATUS = CanFrame(0x001, b"\0\0\0\0\x08\0\0\0")
LINE = b"t00180000000008000000"
SENT_BY_ADAPTERS = [
    # what they send, the frames in it, malformed lines, refusals
    (LINE + b"\r" + LINE + b"\r",                 [STATUS] * 2, 0, 0),
    ((LINE + b"\r\n") * 3,                        [STATUS] * 3, 0, 0),
    ((LINE + b"\n") * 3,                          [STATUS] * 3, 0, 0),
    (LINE + b"1A2B\r" + LINE + b"1A2C\r",         [STATUS] * 2, 0, 0),
    (b"z\r" + LINE + b"\rZ\r\a" + LINE + b"\r",   [STATUS] * 2, 0, 1),
    (b"\a\a\a",                                   [],           0, 3),
    (b"CANable2 slcan v2.0\r\n" + LINE + b"\r",   [STATUS],     1, 0),
    (b"V1013\rNA123\rF08\rz\r\r" + LINE + b"\r",  [STATUS],     0, 0),
    (LINE[:9] + b"\r" + LINE[:-1] + b"\r",        [],           2, 0),
    (LINE[:9] + b"\a" + LINE + b"\r",             [STATUS],     1, 1),
    (b"TFFFFFFFF0\rt8000\rT200000000\r",         [],           3, 0),
    (b"t0019" + b"00" * 9 + b"\r",                [],           1, 0),
    (b"r0013\rr00131A2B\r",                       [CanFrame(1, remote=True, requested=3)] * 2, 0, 0),
    (b"R000000018\r",                             [CanFrame(1, b"", True, True, requested=8)], 0, 0),
    (b"r001311\rr0019\r",                         [],           2, 0),
    (b"x" * 5000 + b"\r" + LINE + b"\r",          [STATUS],     1, 0),
]
# fmt: on


@pytest.mark.parametrize(("sent", "frames", "malformed", "refused"), SENT_BY_ADAPTERS)
def test_what_adapters_send_is_taken_as_it_is_or_counted(
    sent: bytes, frames: list[CanFrame], malformed: int, refused: int
) -> None:
    last = CanFrame(0x7FF, b"last")
    for pieces in cuttings(sent):
        device, host = raw_pty()
        settings = BusSettings("can0", "can", f"slcan:{os.ttyname(host)}", RATE)
        with closing(open_can(settings, SimulatedClock())) as bus:
            received: list[object] = []
            for piece in (*pieces, line_of(last).encode() + b"\r"):
                os.write(device, piece)
                received += [packet.frame for packet in bus.read(0)[1]]
            while last not in received:
                received += [packet.frame for packet in poll(lambda: bus.read(0)[1])]
            assert (received, bus.bad, bus.refused) == ([*frames, last], malformed, refused)
        os.close(device)
        os.close(host)


@contextmanager
def driven(bus: BusSettings = FD) -> Iterator[tuple[CanBus, AdapterPty]]:
    """A host on the adapter of a bus, set to the usual bit rate."""
    with closing(AdapterPty(bus)) as adapters:
        settings = replace(bus, interface=f"slcan:{adapters.paths[0]}", bitrate=RATE)
        with closing(open_can(settings, SimulatedClock())) as host:
            adapters.read(0)
            yield host, adapters


def commanded(host: CanBus, adapters: AdapterPty, numbers: range) -> tuple[list[BusState], list[int]]:
    """Send a frame every 5 ms; the states of the bus, and the numbers of the frames that reached it."""
    states: list[BusState] = []
    reached: list[int] = []
    (port,) = adapters._ports
    for number in numbers:
        now, lost = number * 5 * MILLISECOND, host.dropped
        host.write(now, [CanFrame(0x100, number.to_bytes(8, "big"))])
        sent = host.dropped == lost
        if sent:
            wait_for_input(port.pty._end)
        packets = adapters.read(now)[1]
        if sent and host._interface is not None:  # each frame is answered
            wait_for_input(host._interface.fileno())
        reached += [int.from_bytes(p.frame.data, "big") for p in packets if isinstance(p.frame, CanFrame)]
        states += host.read(now)[0]
    return states, reached


def test_an_adapter_that_was_reset_is_closed_and_opened(caplog: pytest.LogCaptureFixture) -> None:
    with driven() as (host, adapters):
        (port,) = adapters._ports
        port.adapter = port._powered_up()  # its power failed for a moment, and nobody has opened it since
        states, reached = commanded(host, adapters, range(400))
        assert states == [BusState.OFF, BusState.BACK]
        assert min(reached) > 200  # what was given while it was off does not come later
        assert reached == [*range(min(reached), 400)]
        assert host.turned_off == 1
        assert "can0: its adapter refuses what it is sent" in caplog.text


def test_an_adapter_that_always_refuses_is_tried_less_and_less_often() -> None:
    """It is set to a bit rate that the bus does not have."""
    with driven(BusSettings("can0", "can", "twin", 500_000)) as (host, adapters):
        states, reached = commanded(host, adapters, range(4000))
        assert (states, reached) == ([BusState.OFF, BusState.BACK] * 4 + [BusState.OFF], [])
        assert host.turned_off == 5  # for 1, 2, 4, 8 and 8 s
        assert host.refused > 5 * 30


def test_a_few_refusals_are_counted_and_turn_nothing_off() -> None:
    with driven() as (host, adapters):
        for turn in range(20):
            adapters._ports[0].pty.write(b"\a" * (turn % 4 == 0))
            states, reached = commanded(host, adapters, range(20 * turn, 20 * turn + 20))
            assert (states, len(reached)) == ([], 20)
        assert (host.refused, host.turned_off) == (5, 0)
