"""A line as it is: echo, collisions, garbage of another rate; ports: taken, forbidden, slow, back again."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest
import serial
from serial.tools.list_ports_common import ListPortInfo

from gateway.buses import WakingBus, ports, usb
from gateway.buses.can import open_can
from gateway.buses.serial import garbage, opening
from gateway.buses.serial.bus import LEAST_PIECE, SerialBus, open_serial
from gateway.buses.serial.echo import ABSENT, ALONE, COLLIDED, GONE, SURE, WAIT, WRONG, Echo
from gateway.core.clock import SimulatedClock, WallClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState
from protocols.messages import MILLISECOND, SECOND
from tests.gateway.buses.adapter_helpers import gather, poll, raw_pty, taken, wait_for_input

RATE = 1_000_000
MS = MILLISECOND

# -- echo ----------------------------------------------------------------------------------------


def echo(kind: Any) -> Echo:
    return Echo(kind, "line", RATE, 2 * MS)


def asked(one: Echo, number: int, comes: Callable[[bytes], bytes], pieces: int = 1000) -> bytes:
    """Send a question, and return what is left of what comes."""
    question, now = b"question %d" % number, number * 5 * MS
    one.sent(now, question)
    came = comes(question)
    return b"".join(one.strip(now + MS, came[at : at + pieces]) for at in range(0, len(came), pieces))


def echoed(question: bytes) -> bytes:
    return question + b"answer"


@pytest.mark.parametrize("pieces", [1, 3, 1000])
def test_an_adapter_that_echoes_is_found_named_once_and_left_out(pieces: int) -> None:
    one = echo("auto")
    left = [asked(one, number, echoed, pieces) for number in range(20)]
    assert left[SURE:] == [b"answer"] * (20 - SURE)
    assert all(each.endswith(b"answer") for each in left)
    (note,) = one.take_notes()
    assert note.startswith("its adapter echoes: what is sent comes back before the answer")
    assert 'echo = "yes" under [buses.line]' in note
    assert one.collisions == 0


def test_by_a_setting_it_is_left_out_from_the_first_byte_on() -> None:
    one = echo("yes")
    assert [asked(one, number, echoed) for number in range(5)] == [b"answer"] * 5
    assert one.take_notes() == []


@pytest.mark.parametrize(
    "comes",
    [
        lambda question: b"answer",
        lambda question: b"answer" + question,
        lambda question: b"",
        lambda question: question if int(question.split()[1]) % 3 == 0 else b"answer",  # as a Modbus write
        lambda question: question[:5] + b"xx",
    ],
)
def test_what_is_no_echo_is_never_left_out(comes: Callable[[bytes], bytes]) -> None:
    one = echo("auto")
    for number in range(50):
        assert asked(one, number, comes) == comes(b"question %d" % number)
    assert one.take_notes() == []


def test_an_echo_with_no_device_behind_it_is_named_as_that() -> None:
    one = echo("auto")
    left = [asked(one, number, lambda question: question) for number in range(ALONE + 3)]
    assert left[ALONE:] == [b"", b"", b""]
    (note,) = one.take_notes()
    assert "and nothing else: no device answers, or RX is on TX" in note


def test_an_echo_that_differs_is_a_collision_counted_each_time_and_named_once() -> None:
    one = echo("yes")
    for number in range(9):
        comes = (lambda q: bytes([q[0] ^ 1]) + q[1:] + b"answer") if number % 3 == 1 else echoed
        assert asked(one, number, comes) == b"answer"
    assert one.collisions == 3
    assert one.take_notes() == [COLLIDED]


def test_an_echo_that_ends_is_noticed() -> None:
    one = echo("auto")
    for number in range(5):
        asked(one, number, echoed)
    one.take_notes()
    left = [asked(one, number, lambda _: b"an answer that is long") for number in range(5, 30)]
    assert left[WRONG:] == [b"an answer that is long"] * (25 - WRONG)
    assert GONE in one.take_notes()


def test_an_echo_that_never_comes_is_named_where_it_is_expected() -> None:
    one = echo("yes")
    for number in range(20):
        one.sent(number * SECOND, b"set-point")
        assert one.strip(number * SECOND + 100 * MS, b"late") == b"late"
    assert one.take_notes() == [ABSENT]


def test_set_points_that_nobody_answers_are_no_matter() -> None:
    one = echo("auto")
    for number in range(200):
        now = number * 5 * MS
        one.sent(now, b"set-point")
        one.sent(now, b"question")
        one.strip(now + MS, b"set-pointques")
        one.strip(now + 2 * MS, b"tionanswer")
    assert one.on
    one.sent(SECOND, b"set-pointquestion")
    assert one.strip(SECOND + MS, b"set-pointquestionanswer") == b"answer"


def test_what_is_remembered_is_bounded() -> None:
    one = echo("auto")
    for number in range(1000):
        one.sent(number, b"x" * 100)
        one.strip(number, b"")
    assert len(one._expected) <= 8192
    assert one._until < WAIT + 2 * SECOND


# -- garbage ---------------------------------------------------------------------------------------


def received(data: bytes, sent: int, at: int, pause: float = 0.0) -> tuple[bytes, int]:
    """What a receiver makes of bytes sent at another rate, and how many had no stop bit: 8N1, sampled in the
    middle of its own bits, from each falling edge on."""
    edges: list[tuple[float, int]] = [(0.0, 1)]
    t = 2.0
    for byte in data:
        for bit in (0, *(byte >> n & 1 for n in range(8)), 1):
            edges.append((t, bit))
            t += 1.0
        t += pause
    levels = [bit for _, bit in edges]

    def level(when: float) -> int:
        low, high = 0, len(edges)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if edges[middle][0] <= when else (low, middle)
        return levels[low]

    width, when, found, errors = sent / at, 0.0, bytearray(), 0
    starts = [edges[n][0] for n in range(1, len(edges)) if levels[n] == 0 and levels[n - 1] == 1]
    for start in starts:
        if start < when or level(start + 0.5 * width):
            continue
        found.append(sum(level(start + (1.5 + n) * width) << n for n in range(8)))
        errors += not level(start + 9.5 * width)
        when = start + 9.5 * width
    return bytes(found), errors


PACKETS = b"".join(
    b"\xff\xff\xfd\x00" + bytes([address, 14, 0, 0x55]) + random.Random(address).randbytes(12)
    for address in range(1, 13)
)


def test_the_receiver_of_these_tests_reads_what_was_sent_at_its_own_rate() -> None:
    assert received(PACKETS, RATE, RATE) == (PACKETS, 0)


@pytest.mark.parametrize("sent", [57600, 115200, 230400, 500000])
@pytest.mark.parametrize("times", [2, 4, 8])
def test_a_device_that_is_slower_is_recognised_with_its_rate(sent: int, times: int) -> None:
    data, errors = received(PACKETS, sent, sent * times)
    assert sent in garbage.sent_at(data, sent * times)
    assert f"{sent} bit/s, and received at {sent * times}" in garbage.verdict(data, sent * times, errors)


@pytest.mark.parametrize(("sent", "at"), [(57600, 1_000_000), (115200, 3_000_000)])
def test_one_that_is_much_slower_too(sent: int, at: int) -> None:
    data, errors = received(PACKETS, sent, at)
    assert "another baud rate" in garbage.verdict(data, at, errors)


@pytest.mark.parametrize(("sent", "at"), [(1_000_000, 115_200), (1_000_000, 57_600), (3_000_000, 1_000_000)])
def test_one_that_is_faster_is_recognised_by_the_missing_stop_bits(sent: int, at: int) -> None:
    data, errors = received(PACKETS * 3, sent, at)
    assert "lack their stop bit" in garbage.verdict(data, at, errors)


@pytest.mark.parametrize(
    "data", [PACKETS, random.Random(1).randbytes(300), b"f 0 1.25 0.5\n" * 9, b"\xff" * 99]
)
def test_what_is_of_the_right_rate_is_not_called_another(data: bytes) -> None:
    assert garbage.verdict(data, RATE) == ""
    assert garbage.verdict(data[:10], RATE, 9) == ""


# -- ports -----------------------------------------------------------------------------------------


@pytest.fixture
def line() -> Iterator[tuple[int, SerialBus, BusSettings]]:
    """The device's end of a line, and the bus at the other one."""
    device, host = raw_pty()
    os.set_blocking(device, False)
    settings = BusSettings("line", "serial", f"serial:{os.ttyname(host)}", baudrate=RATE, echo="yes")
    bus = open_serial(settings)
    os.close(host)
    yield device, bus, settings
    bus.close()
    with suppress(OSError):
        os.close(device)


def bytes_of(bus: SerialBus, now: int) -> bytes:
    return b"".join(p.frame for p in bus.read(now)[1] if isinstance(p.frame, bytes))


def test_an_echo_on_a_real_port_is_left_out(line: tuple[int, SerialBus, BusSettings]) -> None:
    device, bus, _ = line
    for number in range(5):
        sent, answer = b"set-pointquestion %d" % number, b"answer %d" % number
        bus.write(number * MS, [sent[:9], sent[9:]])
        came = taken(device, len(sent))
        assert came == sent
        os.write(device, came + answer)
        assert gather(lambda: bytes_of(bus, number * MS + 1), len(answer)) == answer  # noqa: B023 -- at once
    assert bus.echo.collisions == 0


def test_what_is_written_after_a_long_pause_is_not_taken_for_stuck(
    line: tuple[int, SerialBus, BusSettings], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A port that holds nothing is not asked what it holds."""
    device, bus, _ = line
    asked: list[int] = []
    holds = [0]

    def held(_fileno: int) -> int:
        asked.append(1)
        return holds[0]

    monkeypatch.setattr(ports, "held", held)
    assert [bus.read(number * MS)[0] for number in range(1000)] == [[]] * 1000
    assert len(asked) == 1
    holds[0] = 8
    bus.write(SECOND, [b"question"])
    assert [bus.read(SECOND + number * MS)[0] for number in range(90)] == [[]] * 90
    assert taken(device, 8) == b"question"
    assert BusState.FULL in [each for number in range(90, 120) for each in bus.read(SECOND + number * MS)[0]]


def test_a_collision_on_a_real_port_is_told_once(
    line: tuple[int, SerialBus, BusSettings], caplog: pytest.LogCaptureFixture
) -> None:
    device, bus, _ = line
    for number in range(5):
        bus.write(number * MS, [b"question"])
        taken(device, len(b"question"))
        os.write(device, b"qEEstionanswer")
        assert gather(lambda: bytes_of(bus, number * MS + 1), 6) == b"answer"  # noqa: B023 -- at once
    assert bus.echo.collisions == 5
    assert [message for message in caplog.messages if "two send at the same time" in message] == [
        f"line: {COLLIDED}"
    ]


def test_bytes_are_stamped_by_when_they_can_have_arrived(line: tuple[int, SerialBus, BusSettings]) -> None:
    """At 1 Mbaud 100 bytes take 1 ms; none was there when it was read before."""
    device, bus, _ = line
    sent = bytes(range(256)) + bytes(100)
    bus.read(7 * MS)
    os.write(device, sent)
    wait_for_input(bus.wakes(0)[0][0])
    packets = list(bus.read(10 * MS)[1])
    while sum(len(p.frame) for p in packets if isinstance(p.frame, bytes)) < len(sent):
        packets += poll(lambda: list(bus.read(10 * MS)[1]))
    assert b"".join(p.frame for p in packets if isinstance(p.frame, bytes)) == sent
    stamps = [packet.t for packet in packets]
    assert stamps == sorted(stamps)
    assert stamps[0] >= 7 * MS
    assert stamps[-1] == 10 * MS
    if len(packets) == 4:  # it came in one piece
        assert stamps == [10 * MS - 2_560_000, 10 * MS - 1_560_000, 10 * MS - 560_000, 10 * MS]
    assert bus._piece == 100
    assert SerialBus(line[2], bus_port(line[2]))._piece == max(100, LEAST_PIECE)


def bus_port(settings: BusSettings) -> Any:
    """Another opening of the same port: an adversary that does not ask for the lock."""
    import serial

    return serial.Serial(settings.interface.partition(":")[2], settings.baudrate, timeout=0)


def test_a_bus_that_wakes_the_loop_does_so_by_its_file(line: tuple[int, SerialBus, BusSettings]) -> None:
    """Nothing but the byte ends this wait."""
    device, bus, _ = line
    clock = WallClock()
    assert isinstance(bus, WakingBus)
    files, look = bus.wakes(0)
    assert look is None
    os.write(device, b"x")
    clock.wait(clock.now() + 3600 * SECOND, files)
    os.close(device)
    clock.wait(clock.now() + 3600 * SECOND, files)
    assert poll(lambda: list(bus.read(5)[0])) == [BusState.GONE]
    assert bus.wakes(6) == ((), 5 + SECOND)


@pytest.mark.parametrize("rate", [9600, 123_456, 1_234_567, 4_500_000])
def test_any_baud_rate_can_be_had(rate: int) -> None:
    device, host = raw_pty()
    settings = BusSettings("line", "serial", f"serial:{os.ttyname(host)}", baudrate=rate)
    with closing(open_serial(settings)) as bus:
        os.write(device, b"abc")
        assert gather(lambda: bytes_of(bus, 1), 3) == b"abc"
    os.close(device)
    os.close(host)


def test_a_port_is_marked_as_ours() -> None:
    """Root alone may open it all the same (TIOCEXCL); who asks for the lock gets none."""
    device, host = raw_pty()
    path = os.ttyname(host)
    settings = BusSettings("line", "serial", f"serial:{path}", baudrate=RATE)
    with closing(open_serial(settings)):
        other = subprocess.run(
            [sys.executable, "-c", f"import serial; serial.Serial({path!r}, exclusive=True)"],
            capture_output=True,
            text=True,
            check=False,
        )
    assert other.returncode != 0
    assert "lock" in other.stderr or "busy" in other.stderr
    os.close(device)
    os.close(host)


def test_who_has_a_port_open_is_named() -> None:
    device, host = raw_pty()
    path = os.ttyname(host)
    script = f"import serial, sys; p = serial.Serial({path!r}, exclusive=True); print(flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        assert (other.pid, "python") in [(n, name[:6]) for n, name in opening.holders(path)]
        text = rf"another program has {path} open: python\S* \(process {other.pid}\)"
        with pytest.raises(BusError, match=text):
            open_serial(BusSettings("line", "serial", f"serial:{path}", baudrate=RATE))
        other.communicate()
    os.close(device)
    os.close(host)


def test_modem_manager_is_named_with_what_helps(tmp_path: Path) -> None:
    (tmp_path / "812" / "fd").mkdir(parents=True)
    port = tmp_path / "ttyACM0"
    port.touch()
    (tmp_path / "812" / "fd" / "9").symlink_to(port)
    (tmp_path / "812" / "comm").write_text("ModemManager\n")
    text = opening.in_use(str(port), tmp_path)
    assert "open: ModemManager (process 812); it looks for modems on every new port: `sudo systemctl" in text
    assert "sudo fuser -v /dev/ttyS9" in opening.in_use("/dev/ttyS9", tmp_path)


def test_a_port_that_is_forbidden_is_named_with_its_group(tmp_path: Path) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch()
    port.chmod(0o600)
    text = opening.forbidden(str(port))
    assert "rw-------: a udev rule gives it to a group: " in text
    assert 'KERNEL=="ttyUSB0", MODE="0660", GROUP="dialout"' in text
    port.chmod(0o660)
    assert ("we are in it" in opening.forbidden(str(port))) == (os.getegid() != 0)
    if os.getuid() == 0:
        os.chown(port, 0, 20)
        text = opening.forbidden(str(port))
        assert "of the group dialout, rw-rw----: `sudo usermod -aG dialout root`, then log in again" in text


def test_what_is_no_port_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BusError, match="is no serial port"):
        open_serial(BusSettings("line", "serial", f"serial:{tmp_path / 'file'}", baudrate=RATE))


def test_dtr_is_off_while_the_port_is_open_and_on_from_then_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """So the motor of an RPLIDAR A1 stands when the run has ended: the kernel would let it turn again."""
    levels: list[bool] = []
    monkeypatch.setattr(serial.Serial, "_update_dtr_state", lambda port: levels.append(port.dtr))
    device, host = raw_pty()
    attributes = termios.tcgetattr(host)
    attributes[2] |= termios.HUPCL  # as of a serial port
    termios.tcsetattr(host, termios.TCSANOW, attributes)
    settings = BusSettings("line", "serial", f"serial:{os.ttyname(host)}", baudrate=115_200, dtr="off")
    bus = open_serial(settings)
    assert levels == [False]
    assert termios.tcgetattr(device)[2] & termios.HUPCL
    bus.close()
    assert levels == [False, True]
    assert not termios.tcgetattr(device)[2] & termios.HUPCL
    os.close(device)
    os.close(host)


def test_a_driver_without_rs485_is_said(line: tuple[int, SerialBus, BusSettings]) -> None:
    device, host = raw_pty()
    settings = BusSettings("line", "serial", f"serial:{os.ttyname(host)}", baudrate=RATE, rs485="rts_high")
    with pytest.raises(BusError, match=r"cannot switch the direction of RS-485 by RTS .*leave rs485 out"):
        open_serial(settings)
    os.close(device)
    os.close(host)


@pytest.mark.parametrize(("timer", "said"), [("1", ""), ("16", "for up to 16 ms"), ("x", ""), (None, "")])
def test_an_adapter_that_holds_back_is_noticed(tmp_path: Path, timer: str | None, said: str) -> None:
    (tmp_path / "ttyUSB0").mkdir()
    if timer is not None:
        (tmp_path / "ttyUSB0" / "latency_timer").write_text(f"{timer}\n")
    settings = BusSettings("line", "serial", "serial:/dev/ttyUSB0", baudrate=RATE)
    text = opening.holds_back(settings, "/dev/ttyUSB0", tmp_path)
    assert said in text
    assert bool(said) == bool(text)
    if said:
        assert f"echo 1 | sudo tee {tmp_path}/ttyUSB0/latency_timer" in text


def test_a_port_that_comes_back_under_another_name_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = raw_pty(), raw_pty()
    now_there = [os.ttyname(first[1])]

    def comports() -> list[ListPortInfo]:
        made = ListPortInfo(now_there[0])
        made.vid, made.pid, made.serial_number = 0x0403, 0x6014, "FT7W"
        return [made]

    monkeypatch.setattr(usb, "comports", comports)
    settings = BusSettings("line", "serial", "serial:usb-0403:6014:FT7W", baudrate=RATE)
    with closing(open_serial(settings)) as bus:
        os.close(first[1])
        os.close(first[0])
        assert poll(lambda: list(bus.read(0)[0])) == [BusState.GONE]
        now_there[0] = os.ttyname(second[1])
        assert bus.read(SECOND)[0] == [BusState.BACK]
        os.write(second[0], b"here")
        assert gather(lambda: bytes_of(bus, SECOND), 4) == b"here"
        bus.write(SECOND, [b"there"])
        assert taken(second[0], 5) == b"there"
    os.close(second[0])
    os.close(second[1])


@pytest.mark.parametrize("kind", ["slcan", "fdcanusb", "dm-serial"])
def test_so_is_a_can_adapter(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = raw_pty(), raw_pty()
    now_there = [os.ttyname(first[1])]

    def comports() -> list[ListPortInfo]:
        made = ListPortInfo(now_there[0])
        made.vid, made.pid, made.serial_number = 0x16D0, 0x117E, "A1"
        return [made]

    monkeypatch.setattr(usb, "comports", comports)
    settings = BusSettings("can0", "can", f"{kind}:usb-16D0:117E:A1", bitrate=1_000_000)
    with closing(open_can(settings, SimulatedClock())) as bus:
        os.close(first[1])
        os.close(first[0])
        assert BusState.GONE in poll(lambda: list(bus.read(0)[0]))
        now_there[0] = os.ttyname(second[1])
        assert poll(lambda: list(bus.read(2 * SECOND)[0])) == [BusState.BACK]
    os.close(second[0])
    os.close(second[1])


def test_noise_without_end_is_read_in_bounded_pieces(line: tuple[int, SerialBus, BusSettings]) -> None:
    device, bus, _ = line
    noise, sent, got, now = random.Random(5), 0, 0, 0
    for _ in range(200):
        now += MS
        with suppress(BlockingIOError):
            sent += os.write(device, noise.randbytes(500))
        packets = bus.read(now)[1]
        got += sum(len(p.frame) for p in packets if isinstance(p.frame, bytes))
        assert len(packets) <= 1 + 65536 // bus._piece
    while got < sent:
        got += len(poll(lambda: bytes_of(bus, now)))
    assert got == sent
    assert termios.tcgetattr(device)
