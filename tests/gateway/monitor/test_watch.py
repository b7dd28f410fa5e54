"""`gateway watch`: on buses and recordings, as page and as lines; not a single frame is sent."""

from __future__ import annotations

import ast
import gzip
import io
import os
import pty
import re
import signal
import tty
from argparse import Namespace
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import can
import pytest

from gateway.buses import Bus
from gateway.buses.adapters.pty import SerialPty
from gateway.buses.can import open_can
from gateway.cli.main import main
from gateway.cli.terminal.screen import ENTER, LEAVE, TerminalLine, cut, screen
from gateway.cli.terminal.screen import page as drawn
from gateway.cli.watch import READ_PERIOD, lines, page, received, refresh
from gateway.core.clock import SimulatedClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError, UserError
from gateway.monitor.sources import Source, WatchSession, open_all, open_source
from gateway.recording import read_recording
from protocols.frames import BusState, CanFrame, Packet
from protocols.messages import SECOND, Imu, Velocity
from protocols.plain import table as plain
from tests.gateway.buses.adapter_helpers import poll
from tests.gateway.processes import TerminalProcess, eventually, written
from tests.gateway.rig import BENCH, Rig

ROOT = Path(__file__).resolve().parents[3]
LISTENERS = (
    "cli/watch",
    *(f"monitor/{name}" for name in ("sources", "decoder", "candidates", "state", "render")),
)
"""The modules of `gateway watch`, beside the buses and the screen."""


def options(what: str | None, *bus: tuple[str, str], baudrate: int = 1_000_000) -> Namespace:
    return Namespace(what=what, bus=list(bus), bitrate=0, data_bitrate=0, baudrate=baudrate, robot="")


@contextmanager
def watching(arguments: Namespace) -> Iterator[WatchSession]:
    with ExitStack() as stack:
        yield open_all(arguments, SimulatedClock(), stack)


@pytest.fixture(scope="module")
def drive() -> list[Packet]:
    """Half a second on the bench's bus, in which the left motor begins to turn."""
    rig = Rig()
    rig.run(0.3)
    rig.run(0.2, Velocity("left", 4.0))
    packets = [p for tick in rig.ticks for p in (*tick.inputs.packets, *tick.outputs.packets)]
    return sorted(packets, key=lambda packet: packet.t)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("watch")
    robot, file = folder / "rig.toml", folder / "run.mcap"
    robot.write_text(BENCH)
    folder.chmod(0o700)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        assert main(["run", str(robot), "--fast", "--seconds", "1", "--record", str(file)]) == 0
    return file


@contextmanager
def virtual(channel: str) -> Iterator[Bus]:
    """Another participant on a virtual CAN bus."""
    bus = open_can(BusSettings("other", "can", f"virtual:{channel}", bitrate=1_000_000), SimulatedClock())
    try:
        yield bus
    finally:
        bus.close()


# -- nothing is ever sent ---------------------------------------------------------------------------


def test_on_a_can_bus_not_a_single_frame_is_sent(drive: list[Packet]) -> None:
    with virtual("watched") as other:
        with watching(options("virtual:watched")) as made:
            for packet in drive:
                other.write(packet.t, [packet.frame])
                list(lines(made, made.clock.now()))
            refresh(made, made.clock.now() + SECOND, lambda _: None)
            assert made.monitor.buses["watched"].packets.total == len(drive)
            assert len(made.monitor.found) == 2
        assert other.read(2 * SECOND) == ([], [])


def test_an_adapter_on_a_serial_port_is_opened_listen_only_and_sent_no_frame() -> None:
    """The adapter receives these commands only: close, bit rate, listen, close."""
    adapter, port = pty.openpty()
    settings = BusSettings("can0", "can", f"slcan:{os.ttyname(port)}", bitrate=500_000)
    try:
        tty.setraw(adapter)
        source = open_source(settings, SimulatedClock())
        os.write(adapter, b"t0213010203\r\r\a")
        result = poll(lambda: (read := source.read(SECOND))[1] and read)
        source.close()
        os.close(port)
        commands = written(adapter).split(b"\r")
    finally:
        os.close(adapter)
    assert result == ([], [Packet(SECOND, "can0", CanFrame(0x021, b"\x01\x02\x03"))])
    assert set(commands) == {b"C", b"S6", b"L", b""}


def test_on_a_serial_bus_not_a_single_byte_is_sent() -> None:
    line = SerialPty(BusSettings("tty", "serial", "twin", baudrate=1_000_000))
    try:
        with watching(options(f"serial:{line.pty.path}")) as made:
            line.read(0)
            for t in range(5):
                line.write(t, [plain.encode(2, Imu("", 0, (0.0, 0.0, 0.5), (0.0, 0.0, 9.81)))])
                list(lines(made, made.clock.now()))
            assert [record.address for record in made.monitor.found.values()] == [2]
            states, packets = line.read(1)
            assert packets == []
            assert states == []
    finally:
        line.close()


def test_a_source_can_only_be_read_and_closed() -> None:
    assert sorted(name for name in dir(Source) if not name.startswith("_")) == ["close", "read"]
    bus = open_can(
        BusSettings("can0", "can", "virtual:silent", bitrate=1_000_000), SimulatedClock(), listen_only=True
    )
    try:
        with pytest.raises(AssertionError, match="listen-only"):
            bus.write(0, [CanFrame(1)])
    finally:
        bus.close()


@pytest.mark.parametrize("module", LISTENERS)
def test_no_listening_module_calls_write_or_send(module: str) -> None:
    tree = ast.parse((ROOT / "gateway" / f"{module}.py").read_text())
    calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
    called = {function.attr for function in calls if isinstance(function, ast.Attribute)}
    assert called
    assert not called & {"write", "send", "due"}


# -- what there is to watch -------------------------------------------------------------------------


def test_a_robot_s_bus_that_cannot_be_opened_is_named_and_the_rest_is_watched(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with watching(options("diffbot", ("can0", "virtual:diffbot"))) as made:
        text = "\n".join(page(made))
    assert "left out: bus 'sensors' is simulated inside the process" in capsys.readouterr().err
    assert "no message yet" in text
    assert "left out" in text
    assert "lidar" not in text


def test_without_a_can_interface_the_error_names_what_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.buses.usb.can_interfaces", list)
    with pytest.raises(UserError, match="no CAN interface"), watching(options(None)):
        pass


def test_every_interface_of_a_machine_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(settings: BusSettings, clock: object, *, listen_only: bool) -> None:
        assert listen_only
        raise BusError(f"{settings.interface} is down")

    monkeypatch.setattr("gateway.buses.usb.can_interfaces", lambda: ["can0", "can1"])
    monkeypatch.setattr("gateway.monitor.sources.open_bus", refuse)
    with pytest.raises(UserError) as error, watching(options(None)):
        pass
    assert str(error.value) == "socketcan:can0 is down\nsocketcan:can1 is down"


# -- lines and pages --------------------------------------------------------------------------------


def test_a_line_has_time_bus_frame_and_meaning(drive: list[Packet]) -> None:
    with virtual("lines") as other, watching(options("bench", ("can0", "virtual:lines"))) as made:
        for packet in drive:
            other.write(packet.t, [packet.frame])
        other.write(0, [CanFrame(0x7FF, b"\x01")])
        made.monitor.on_state(0, "can0", BusState.UP)
        printed = [text for batch in lines(made, 0) for text in batch]
    assert len(printed) == len(drive) + 1
    assert printed[0].startswith("(0.000000) can0 ")
    assert any("029#0000000000000000  <- left: Feedback position 0 rad" in text for text in printed)
    assert any("-> left: Velocity" in text for text in printed)
    assert any(text.endswith("049#R  -> right") for text in printed)
    assert printed[-1].endswith("7FF#01   ?")


def test_the_page_is_refreshed_until_the_time_is_over() -> None:
    drawings: list[list[str]] = []
    with watching(options("virtual:pages")) as made:
        refresh(made, 2 * SECOND, drawings.append)
    assert 7 <= len(drawings) <= 10
    assert drawings[0][0] == "virtual:pages: 0.0 s, listening only"
    assert "silent" in drawings[-1][3]


def test_a_signal_ends_it() -> None:
    with watching(options("virtual:signal")) as made:
        for now, _, _ in received(made, None):
            if now == 3 * READ_PERIOD:
                made.leaving = "SIGINT"
        assert made.clock.now() == 4 * READ_PERIOD


def test_the_screen_is_restored_after_an_exception() -> None:
    stream = io.StringIO()

    def interrupted() -> None:
        with screen(stream) as draw:
            draw(["a"])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert stream.getvalue().startswith(ENTER)
    assert stream.getvalue().endswith(LEAVE)


def test_a_page_fits_its_terminal_and_contains_no_control_characters() -> None:
    text = drawn(["x" * 50, "\x1b[31mred\x07", "3", "4", "5"], os.terminal_size((20, 4)))
    rows = text.removeprefix("\x1b[H").removesuffix("\x1b[J").split("\r\n")
    assert [row.removesuffix("\x1b[K") for row in rows] == [
        "x" * 19 + "…",
        "\\x1b[31mred\\x07",
        "3",
        cut("… 2 more lines: the window is too low", 20),
    ]


def test_a_line_without_a_terminal_is_a_line() -> None:
    stream = io.StringIO()
    line = TerminalLine(stream)
    line.draw("one")
    line.print_above("two")
    line.end()
    assert stream.getvalue() == "one\ntwo\n"


# -- recordings -------------------------------------------------------------------------------------


def test_a_recording_gets_its_last_page(capsys: pytest.CaptureFixture[str], recording: Path) -> None:
    assert main(["watch", str(recording)]) == 0
    text = capsys.readouterr().out
    assert f"{recording}: rig, 1.0 s" in text
    for part in ("left", "right", "ready: IDLE", "029 Feedback", "0.000 rad/s", "of 1 Mbit/s"):
        assert part in text
    assert "\x1b" not in text


def test_a_recording_s_lines_are_all_its_frames(capsys: pytest.CaptureFixture[str], recording: Path) -> None:
    assert main(["watch", str(recording), "--lines"]) == 0
    printed = capsys.readouterr().out.splitlines()
    ticks = list(read_recording(recording).ticks)
    frames = sum(len(tick.inputs.packets) + len(tick.outputs.packets) for tick in ticks)
    others = sum(len(tick.outputs.notes) + len(tick.inputs.instructions) for tick in ticks)
    assert len(printed) == frames + others
    assert sum(" can0 " in text for text in printed) == frames
    assert any("info: brain: ready" in text for text in printed)


def test_the_first_seconds_of_a_recording_can_be_watched(
    capsys: pytest.CaptureFixture[str], recording: Path
) -> None:
    assert main(["watch", str(recording), "--seconds", "0.5"]) == 0
    assert ": rig, 0.5 s" in capsys.readouterr().out


def test_a_recording_that_was_cut_short_is_read_as_far_as_it_goes(
    capsys: pytest.CaptureFixture[str], recording: Path, tmp_path: Path
) -> None:
    data = recording.read_bytes()
    short = tmp_path / "short.mcap"
    short.write_bytes(data[: len(data) * 2 // 3])
    assert main(["watch", str(short)]) == 0
    assert "cut short" in capsys.readouterr().out


# -- the command, on a terminal ---------------------------------------------------------------------


def test_on_a_terminal_the_page_is_refreshed_until_ctrl_c(tmp_path: Path) -> None:
    """On the wall clock, in a process of its own: terminal and signal are its own."""
    line = SerialPty(BusSettings("tty", "serial", "twin", baudrate=1_000_000))
    frame = plain.encode(2, Imu("", 0, (0.0, 0.0, 0.5), (0.0, 0.0, 9.81)))
    with closing(line), TerminalProcess(tmp_path, "watch", f"serial:{line.pty.path}") as watch:

        def page_with_imu() -> bool:
            line.read(0)
            line.write(0, [frame])
            watch.look()
            return watch.text.count("\x1b[H") >= 3 and "angular velocity" in watch.text

        assert eventually(page_with_imu), watch.text
        status, text = watch.end(signal.SIGINT)
        assert status == 0, text
    assert ENTER in text
    assert LEAVE in text
    last = text.partition(LEAVE)[2]
    assert "angular velocity 0.000, 0.000, 0.500 rad/s" in last
    assert "\x1b" not in last


# -- logs of other programs ------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".log", ".log.gz", ".asc", ".blf", ".trc", ".csv"])
def test_a_log_that_another_program_has_written_is_decoded(
    drive: list[Packet], tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str
) -> None:
    log = tmp_path / f"can.day.1{suffix.removesuffix('.gz')}"
    frames = [
        p for p in drive if isinstance(p.frame, CanFrame) and not p.frame.remote
    ]  # .trc has none remote
    with can.Logger(log) as writer:
        for packet in frames:
            assert isinstance(packet.frame, CanFrame)
            writer(
                can.Message(
                    timestamp=100.0 + packet.t / SECOND,
                    arbitration_id=packet.frame.id,
                    data=packet.frame.data,
                    is_extended_id=packet.frame.extended,
                    channel=1,
                )
            )
    if suffix.endswith(".gz"):
        log = log.with_name(log.name + ".gz")
        log.write_bytes(gzip.compress(log.with_suffix("").read_bytes()))
    assert main(["watch", str(log), "--robot", "bench"]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"left +odrive_can +can0 1 +armed", printed), printed
    assert re.search(rf"can0 .* {len(frames)} +0\n", printed), printed


def test_a_log_without_a_robot_file_shows_which_devices_were_there_and_one_that_is_torn_what_is_whole(
    drive: list[Packet], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "candump.log"
    rows = [
        f"({p.t / SECOND:.6f}) can7 {p.frame.id:03X}#{p.frame.data.hex()}"
        for p in drive
        if isinstance(p.frame, CanFrame)
    ]
    log.write_text("\n".join([*rows[:120], "(12.5) can7"]))
    assert main(["watch", str(log)]) == 0
    printed = capsys.readouterr()
    assert re.search(r"odrive_can:1 +odrive_can +can7 1 ", printed.out)
    assert "cut short" in printed.err
    assert "after 120 frames" in printed.err
    log.write_text("no log at all\n")
    assert main(["watch", str(log)]) == 2
    assert main(["watch", str(log), "--robot", "diffbot_sensors"]) == 2
    assert main(["watch", "diffbot", "--robot", "diffbot"]) == 2
    assert "--robot is for a log of CAN" in capsys.readouterr().err
