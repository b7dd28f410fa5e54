"""fdcanusb: lines made and read by the package moteus 1.1.1, streams cut anywhere, checksums, both ends."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Iterator
from contextlib import closing

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from moteus import fdcanusb_device as vendor
from moteus.transport_device import Frame

from gateway.buses.adapters import fdcanusb_client
from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.buses.adapters.fdcanusb import (
    EmulatedAdapter,
    checksum,
    decode_received,
    encode_received,
    encode_send,
    split_checksum,
    with_checksum,
)
from gateway.buses.adapters.pty import Pty
from gateway.buses.can import CanBus, open_can
from gateway.core.clock import SimulatedClock
from gateway.core.robot import BusSettings
from protocols.frames import BusState, CanFrame, Packet
from tests.gateway.buses.adapter_helpers import (
    DATA_RATE,
    FD,
    RATE,
    can_frames,
    cut,
    cuts,
    cuttings,
    feed,
    open_path,
    poll,
    raw_pty,
    taken,
)

# fmt: off
LINES = [
    # frame, the command that sends it, the line that reports it
    (CanFrame(0x8005, bytes.fromhex("11001f01130d"), True, False, True, True),
        "can send 8005 11001F01130D BF",        "rcv 8005 11001F01130D E B F r f-1"),
    (CanFrame(0x500, b"\x21\x00\x0a\x50", fd=True, brs=True),
        "can send 0500 21000A50 BF",            "rcv 0500 21000A50 e B F r f-1"),
    (CanFrame(0x105, bytes(64), fd=True),
        f"can send 0105 {'00' * 64} bF",        f"rcv 0105 {'00' * 64} e b F r f-1"),
    (CanFrame(0x12, b"\xff" * 8),
        f"can send 0012 {'FF' * 8} bf",         f"rcv 12 {'FF' * 8} e b f r f-1"),
    (CanFrame(0x1ABCDEF0, b"\xde\xad", True),
        "can send 1abcdef0 DEAD bf",            "rcv 1ABCDEF0 DEAD E b f r f-1"),
    (CanFrame(0x7FF, b"\x01", True),
        "can ext 07ff 01 bf",                   "rcv 07FF 01 E b f r f-1"),
    (CanFrame(0x7E6, remote=True, requested=2),
        "can send 07e6 0000 bfR",               "rcv 07E6 0000 e b f R f-1"),
]
# fmt: on
frames = can_frames(min_size=1)


# -- lines, against the vendor's own code -------------------------------------------------------------


class Written:
    """Stands for the serial port of the vendor's client, and keeps what it writes."""

    def __init__(self) -> None:
        self.data = b""

    def write(self, data: bytes) -> None:
        self.data += data


def vendors_client(*, checksums: bool) -> tuple[vendor.FdcanusbDevice, Written]:
    """The vendor's client, without a port and without its constructor, which wants one."""
    client = vendor.FdcanusbDevice.__new__(vendor.FdcanusbDevice)
    written = Written()
    state = {
        "_disable_brs": False,
        "_padding_hex": "50",
        "_checksum_active": checksums,
        "_serial": written,
        "_debug_log": None,
    }
    client.__dict__.update(state)
    return client, written


def theirs(frame: CanFrame) -> Frame:
    return Frame(frame.id, frame.data, len(frame.data), frame.extended, frame.fd, frame.brs)


@pytest.mark.parametrize(("frame", "command", "reported"), LINES, ids=[line for _, line, _ in LINES])
def test_a_frame_is_its_lines_in_both_directions(frame: CanFrame, command: str, reported: str) -> None:
    assert encode_send(frame) == command
    assert EmulatedAdapter(RATE, DATA_RATE).feed(command.encode() + b"\n") == ([frame], b"OK\r\n")
    assert encode_received(frame) == reported
    assert decode_received(reported) == frame
    assert EmulatedAdapter(RATE, DATA_RATE).report(0, frame) == reported.encode() + b"\r\n"


def test_checksums_are_the_vendors() -> None:
    assert checksum(b"123456789") == vendor._compute_crc8(b"123456789") == 0x94
    for length in range(40):
        line = bytes((7 * n + 13 * length) % 256 for n in range(length))
        assert checksum(line) == vendor._compute_crc8(line)
        assert with_checksum(line) == vendor._append_checksum(line)


@settings(deadline=None, derandomize=True)
@given(frames, st.booleans())
def test_the_vendors_client_sends_what_we_send_and_the_adapter_receives_it(
    frame: CanFrame, checksums: bool
) -> None:
    """Its classic frames bear no f, and leave the format to the adapter; else the lines are the same."""
    client, written = vendors_client(checksums=checksums)
    asyncio.run(client._write_send_frame(theirs(frame)))
    frames_received, answer = EmulatedAdapter(RATE, DATA_RATE).feed(written.data)
    assert answer == (b"OK *BD\r\n" if checksums else b"OK\r\n")
    if frame.extended != (frame.id > 0x7FF):
        return  # the client cannot express that
    line = encode_send(frame).encode()
    if frame.fd:
        assert written.data == (with_checksum(line) if checksums else line) + b"\n"
        assert frames_received == [frame]
    else:
        assert split_checksum(written.data.strip())[0] == line.removesuffix(b"f")
        assert [(received.id, received.data, received.fd) for received in frames_received] == [
            (frame.id, frame.data, True)
        ]


@settings(deadline=None, derandomize=True)
@given(frames, st.booleans())
def test_what_the_adapter_reports_is_read_by_the_vendors_client_and_by_us(
    frame: CanFrame, checksums: bool
) -> None:
    adapter = EmulatedAdapter(RATE, DATA_RATE)
    adapter.protected = checksums
    line, had, right = vendor._strip_and_validate_checksum(adapter.report(0, frame).strip())
    assert (had, right) == (checksums, checksums)
    read = vendors_client(checksums=checksums)[0]._parse_frame(line)
    assert (read.arbitration_id, read.data, read.is_fd) == (frame.id, frame.data, frame.fd)
    assert (read.is_extended_id, read.bitrate_switch) == (frame.extended, frame.brs)
    assert decode_received(line.decode()) == frame


@pytest.mark.parametrize(
    "line",
    [
        "rcv",
        "rcv 123",
        "rcv  01 e",
        "rcv 123 0",
        "rcv 123 0g",
        "rcv 20000000 00",
        "rcv 123456789 00",
        "rcv 123 " + "00" * 9 + " e b f r",
        "rcv 123 " + "00" * 65 + " F",
        "rcv 123 00 F R",
        "rcv +12 00",
        "rcv 123 00 E\xb2",
        "RCV 123 00",
    ],
)
def test_what_cannot_be_a_frame_is_none(line: str) -> None:
    assert decode_received(line) is None


def test_missing_flags_are_read_as_the_vendor_reads_them() -> None:
    assert decode_received("rcv 500 21") == CanFrame(0x500, b"\x21")
    assert decode_received("rcv 8005 21") == CanFrame(0x8005, b"\x21", True)
    assert decode_received("rcv 500 21 F B t12345 f3") == CanFrame(0x500, b"\x21", fd=True, brs=True)


def test_a_line_that_was_cut_is_no_shorter_frame() -> None:
    device, host = raw_pty()
    where = BusSettings("can0", "can", f"fdcanusb:{os.ttyname(host)}", RATE)
    with closing(open_can(where, SimulatedClock())) as bus:
        os.write(device, b"rcv 0100 2100\r\nrcv 0100 21000A2F e b f r f-1\r\n")
        (packet,) = poll(lambda: bus.read(0)[1])
        assert (packet.frame, bus.bad) == (CanFrame(0x100, bytes.fromhex("21000A2F")), 1)
    os.close(device)
    os.close(host)


# -- commands ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "answers"),
    [
        (b"\n\r\n\r", b""),
        (b"can on\n", b"ERR already in BusOn\r\n"),
        (b"can off\ncan off\n", b"OK\r\nERR already in BusOff\r\n"),
        (b"can off\ncan send 123 01\ncan on\n", b"OK\r\nERR not in BusOn state\r\nOK\r\n"),
        (b"can status\n", b"lec=0 dlec=0 err=0 warn=0 busoff=0 pexc=0 tdc=0\r\n"),
        (b"conf get can.bitrate\nconf get can.fd_bitrate\n", b"1000000\r\n5000000\r\n"),
        (
            b"conf get\nconf get x\nconf set can.bitrate 1e6\n",
            b"ERR unknown name\r\n" * 2 + b"ERR error setting\r\n",
        ),
        (b"can send 123\ncan send 123 \ncan send 123  bf\n", b"ERR insufficient options\r\n" * 3),
        (b"can send 123 01 bq\ncan send 123 01 *00 \n", b"ERR unknown flag\r\n" * 2),
        (b"can send xyz 01\ncan send +1 01\ncan std 800 01\ncan ext 20000000 01\n", b"ERR bad id\r\n" * 4),
        (b"can send 123 012\ncan send 123 " + b"00" * 65 + b"\n", b"ERR data invalid length\r\n" * 2),
        (b"can send 123 " + b"00" * 9 + b" f\n", b"ERR data invalid length\r\n"),
        (b"can send 123 0g\ncan send 123 1_\n", b"ERR invalid data\r\n" * 2),
        (b"can sned 1 2\ncan\nconf write\n", b"ERR unknown subcommand\r\n" * 3),
        (b"tel get\nOK\n\xff\x00\n", b"ERR unknown command\r\n" * 3),
        (b"can send " + b"0" * 5000 + b"\ncan off\n", b"ERR line too long\r\nOK\r\n"),
    ],
)
def test_commands_are_answered_and_invalid_ones_refused(sent: bytes, answers: bytes) -> None:
    for pieces in cuttings(sent):
        adapter = EmulatedAdapter(RATE, DATA_RATE)
        assert feed(adapter, pieces) == ([], answers)
        assert adapter.refused == answers.count(b"ERR")


def test_flags_may_be_left_out_separated_or_repeated() -> None:
    adapter = EmulatedAdapter(RATE, DATA_RATE)
    sent = b"".join(b"can send 1 01%s\n" % flags for flags in (b"", b" b", b" f", b" B F", b" FBf", b" R"))
    kinds = [(frame.fd, frame.brs, frame.remote) for frame in adapter.feed(sent)[0]]
    assert kinds == [
        (True, True, False),
        (True, False, False),
        (False, False, False),
        (True, True, False),
        (False, False, False),
        (False, False, True),
    ]
    assert adapter.feed(b"can std 7ff 01 bf\ncan ext 1 01 bf\n")[0] == [
        CanFrame(0x7FF, b"\x01"),
        CanFrame(1, b"\x01", True),
    ]


def test_an_invalid_length_is_zero_padded() -> None:
    frames_received, _ = EmulatedAdapter(RATE, DATA_RATE).feed(b"can send 1 %s BF\n" % (b"AA" * 33))
    assert frames_received == [CanFrame(1, b"\xaa" * 33 + bytes(15), fd=True, brs=True)]


def test_a_bus_of_classic_can_takes_no_fd_frames_and_none_are_sent_unasked() -> None:
    adapter = EmulatedAdapter(RATE)
    assert adapter.feed(b"can send 1 01 F\n") == ([], b"ERR this bus carries classic CAN only\r\n")
    assert adapter.feed(b"can send 1 01\n") == ([CanFrame(1, b"\x01")], b"OK\r\n")


def test_an_adapter_of_another_bit_rate_neither_sends_nor_receives() -> None:
    adapter = EmulatedAdapter(RATE, DATA_RATE)
    assert adapter.feed(b"can off\nconf set can.fd_bitrate 2000000\ncan on\n") == ([], b"OK\r\n" * 3)
    assert adapter.wrong_rate
    assert adapter.feed(b"can send 1 01\n") == ([], b"OK\r\n")
    assert adapter.report(0, CanFrame(1)) == b""
    adapter.feed(b"conf set can.fd_bitrate 5000000\n")
    assert adapter.wrong_rate  # until it goes on the bus anew
    adapter.feed(b"can off\ncan on\n")
    assert adapter.feed(b"can send 1 01 bf\n")[0] == [CanFrame(1, b"\x01")]


# -- checksums -----------------------------------------------------------------------------------------

SEND = b"can send 0123 01 bf"
FRAME = CanFrame(0x123, b"\x01")


def test_once_a_checksum_always_checksums() -> None:
    adapter = EmulatedAdapter(RATE, DATA_RATE)
    assert adapter.feed(SEND + b"\n") == ([FRAME], b"OK\r\n")
    assert adapter.feed(with_checksum(SEND) + b"\n") == ([FRAME], with_checksum(b"OK") + b"\r\n")
    assert adapter.report(0, FRAME) == with_checksum(encode_received(FRAME).encode()) + b"\r\n"
    assert adapter.bad_checksums == 0
    assert adapter.feed(SEND + b"\n") == ([], with_checksum(b"ERR checksum missing") + b"\r\n")
    assert (adapter.refused, adapter.bad_checksums) == (1, 1)


def test_a_bad_checksum_changes_nothing_and_is_counted() -> None:
    """Every single bit that may be wrong in a line: it is refused, unless the line is no longer that one."""
    line, counted = with_checksum(SEND), 0
    for bit in range(8 * len(line)):
        wrong = bytearray(line)
        wrong[bit // 8] ^= 1 << bit % 8
        if wrong[bit // 8] in b"\r\n":
            continue  # then it is two lines
        adapter = EmulatedAdapter(RATE, DATA_RATE)
        adapter.feed(with_checksum(b"can off") + b"\n" + with_checksum(b"can on") + b"\n")
        received, answer = adapter.feed(bytes(wrong) + b"\n")
        if wrong.upper() == line.upper() and wrong[:-3] == line[:-3]:
            continue  # a hex digit in the other case is the same checksum
        assert (received, answer[:3], adapter.bad_checksums) == ([], b"ERR", 1), bytes(wrong)
        counted += 1
    assert counted > 8 * len(line) - 16


# -- any bytes -----------------------------------------------------------------------------------------

streams = st.lists(
    st.one_of(
        st.binary(max_size=30),
        st.sampled_from([b"\r", b"\n", b"can send 1", b"23 00\n", b"can off\n", b"can on\n", b"0" * 300]),
        frames.map(lambda frame: encode_send(frame).encode() + b"\n"),
        frames.map(lambda frame: with_checksum(encode_send(frame).encode()) + b"\r\n"),
    ),
    max_size=30,
)


@settings(deadline=None, derandomize=True)
@given(streams, cuts)
def test_any_bytes_cut_anywhere_raise_nothing_and_decode_alike(pieces: list[bytes], sizes: list[int]) -> None:
    data = b"".join(pieces)
    whole, parted = EmulatedAdapter(RATE, DATA_RATE), EmulatedAdapter(RATE, DATA_RATE)
    replies = whole.feed(data)
    assert feed(parted, cut(data, sizes)) == replies
    assert (parted.open, parted.protected, parted.refused) == (
        whole.open,
        whole.protected,
        whole.refused,
    )
    lines = [line for line in data.replace(b"\r", b"\n").split(b"\n")[:-1] if line]
    assert replies[1].count(b"\r\n") == len(lines)


# -- the client ----------------------------------------------------------------------------------------


@pytest.fixture
def bus() -> Iterator[AdapterPty]:
    with closing(AdapterPty(FD, ("fdcanusb", "slcan"))) as made:
        yield made


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every port has the USB ids of an adapter."""
    monkeypatch.setattr(fdcanusb_client, "_is_known", lambda path: True)


def at(path: str, kind: BusSettings = FD) -> BusSettings:
    return BusSettings("can0", kind.kind, f"fdcanusb:{path}", kind.bitrate, kind.data_bitrate)


def opened(path: str, kind: BusSettings = FD) -> CanBus:
    made = open_can(at(path, kind), SimulatedClock())
    assert isinstance(made, CanBus)
    return made


EVERY = [frame for frame, _, _ in LINES]


@pytest.mark.usefixtures("known")
def test_a_known_adapter_works_without_checksums(bus: AdapterPty, caplog: pytest.LogCaptureFixture) -> None:
    with closing(opened(bus.paths[0])) as ours:
        bus.read(0)
        ours.write(1, EVERY)
        assert [packet.frame for packet in bus.read(1)[1]] == EVERY
        bus.write(2, EVERY)
        assert [packet.frame for packet in ours.read(2)[1]] == EVERY
        assert ours.bad == 0
    assert caplog.text == ""


def test_a_frame_without_data_is_refused_and_logged_once(
    bus: AdapterPty, caplog: pytest.LogCaptureFixture
) -> None:
    with closing(opened(bus.paths[0])) as ours:
        bus.read(0)
        for turn in range(3):
            ours.write(turn, [CanFrame(0x80), CanFrame(0x81, b"\x01")])
            assert [packet.frame for packet in bus.read(turn)[1]] == [CanFrame(0x81, b"\x01")]
            assert ours.read(turn) == ([], [])
    assert caplog.messages == [f"fdcanusb {bus.paths[0]} replies: ERR insufficient options"]


@pytest.fixture
def port() -> Iterator[Pty]:
    """A port whose other end is the test itself."""
    with closing(Pty()) as made:
        yield made


def send(port: Pty, ours: CanBus, data: bytes, now: int = 0) -> tuple[list[BusState], list[Packet]]:
    """What the host reads of these bytes."""
    port.write(data)
    states, packets = ours.read(now)
    return list(states), list(packets)


def test_bad_lines_are_counted_and_the_good_ones_behind_them_come_in_the_same_reading(port: Pty) -> None:
    with closing(opened(port.path)) as ours:
        port.read()
        good = with_checksum(encode_received(FRAME).encode()) + b"\r\n"
        wrong = good.replace(b"123", b"124")
        lines = [
            good,
            wrong,
            encode_received(FRAME).encode() + b"\r\n",
            b"\xff" * 300 + b"\n",
            with_checksum(b"rcv 1") + b"\n",
        ]
        states, packets = send(
            port, ours, b"".join([*lines, with_checksum(b"hello") + b"\n", b"\r\n", good]), 7
        )
        assert states == []
        assert packets == [Packet(7, "can0", FRAME), Packet(7, "can0", FRAME)]
        assert ours.bad == 5


@settings(deadline=None, derandomize=True, max_examples=30)
@given(streams, cuts)
def test_the_client_raises_nothing_on_any_bytes_cut_anywhere(pieces: list[bytes], sizes: list[int]) -> None:
    data = b"".join(piece.replace(b"can send", b"rcv") for piece in pieces)
    counts = []
    for parts in ([data], list(cut(data, sizes))):
        with closing(Pty()) as port, closing(opened(port.path)) as ours:
            port.read()
            received = [packet.frame for part in parts for packet in send(port, ours, part)[1]]
            counts.append((received, ours.bad))
    assert counts[0] == counts[1]


def test_checksums_follow_the_errors_of_the_adapter(port: Pty) -> None:
    with closing(opened(port.path)) as ours:
        port.read()
        ours.write(0, [FRAME])
        assert port.read() == with_checksum(SEND) + b"\n"
        send(port, ours, b"ERR unknown flag\r\n")  # as one that knows no checksums takes it
        ours.write(0, [FRAME])
        assert port.read() == SEND + b"\n"
        assert send(port, ours, encode_received(FRAME).encode() + b"\r\n")[1] == [Packet(0, "can0", FRAME)]
        send(port, ours, b"ERR checksum required\r\n")
        ours.write(0, [FRAME])
        assert port.read() == with_checksum(SEND) + b"\n"


def test_a_listener_receives_from_an_adapter_without_checksums(bus: AdapterPty) -> None:
    from gateway.monitor.sources import open_source

    source = open_source(at(bus.paths[0]), SimulatedClock())
    bus.read(0)
    bus.write(1, EVERY)
    assert [packet.frame for packet in source.read(1)[1]] == EVERY
    assert bus.read(2)[1] == []  # it has sent nothing
    source.close()


@pytest.mark.usefixtures("known")
def test_an_adapter_that_is_off_the_bus_is_put_on_it(port: Pty) -> None:
    with closing(opened(port.path)) as ours:
        ours.read(0)
        assert port.read() == b"conf get can.bitrate\nconf get can.fd_bitrate\n"
        ours.write(0, [FRAME])
        send(port, ours, b"ERR not in BusOn state\r\n")
        assert port.read() == SEND + b"\ncan on\n"


@pytest.mark.usefixtures("known")
def test_an_adapter_of_another_bit_rate_is_logged_with_the_commands(
    port: Pty, caplog: pytest.LogCaptureFixture
) -> None:
    with closing(opened(port.path)) as ours, caplog.at_level(logging.ERROR):
        ours.read(0)
        port.read()
        send(port, ours, b"1000000\r\n2000000\r\n")
        assert ours.bad == 0
    (text,) = caplog.messages
    assert text.startswith(
        f"fdcanusb {port.path} has a can.fd_bitrate of 2000000 bit/s, the robot file has 50"
    )
    assert text.endswith("send it: conf set can.fd_bitrate 5000000, conf write, can off, can on")


def test_a_program_that_hangs_up_leaves_an_adapter_without_checksums_and_nothing_waiting(
    bus: AdapterPty,
) -> None:
    for turn in range(3):
        other = open_path(bus.paths[0])
        os.write(other, with_checksum(SEND) + b"\n" + b"can send 12")  # and is killed in the middle of a line
        assert bus.read(turn) == ([BusState.BACK], [Packet(turn, "can0", FRAME)])
        bus.write(turn, [CanFrame(0x1, b"old news")])
        os.close(other)
        assert bus.read(turn)[0] == [BusState.GONE]
    other = open_path(bus.paths[0])
    bus.read(9)
    os.write(other, SEND + b"\n")
    assert bus.read(9)[1] == [Packet(9, "can0", FRAME)]
    assert taken(other, 4) == b"OK\r\n"
    os.close(other)
