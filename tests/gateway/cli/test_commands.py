"""The command line: what it prints, its exit status, and never a traceback."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gateway.cli.main import main
from gateway.config import parse_robot
from gateway.recording import read_recording
from protocols.messages import Feedback, Velocity
from tests.gateway.bag_helpers import ROBOT, drive, write
from tests.gateway.processes import Process
from tests.gateway.rig import BENCH, sent_commands

HEAVY = {"numpy", "can", "serial", "mcap", "rosbags", "filterpy", "mujoco", "matplotlib"}


@pytest.fixture(autouse=True)
def own_sockets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "run"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return what a command that cannot begin prints, on standard error alone; its exit status is 2."""
    status: object
    try:
        status = main(list(arguments))
    except SystemExit as exit_:  # by argparse
        status = exit_.code
    printed = capsys.readouterr()
    assert status == 2, printed
    assert printed.out == ""
    assert "Traceback" not in printed.err
    return printed.err


METRES = ("-1", "nan", "inf", "three")
SEEDS = ("-1", "x", str(2**63), "1.5")


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("", "COMMAND"),
        ("fly", "invalid choice: 'fly'"),
        ("-q fly --fast", "invalid choice: 'fly'"),
        ("-q run difbot --fast", "did you mean 'diffbot'?"),
        ("run bench --bus can0=candle:0", 'expected "socketcan:can0", since Linux has a driver for it'),
        ("run", "ROBOT"),
        ("run difbot", "did you mean 'diffbot'?"),
        ("run no/such.toml", "there is no file no/such.toml"),
        ("check README", "neither a .toml file nor one of the shipped robots"),
        ("run bench --goal 1", "'1' is not X,Y or X,Y,YAW"),
        ("run bench --goal 1,nan", "is not X,Y or X,Y,YAW"),
        ("run bench --goal a,b", "is not X,Y or X,Y,YAW"),
        ("run bench --seconds 0", "is not a positive number of seconds"),
        ("run bench --seconds inf", "is not a positive number of seconds"),
        ("run bench --bus can0", "is not NAME=INTERFACE:CHANNEL"),
        ("run bench --bus can7=twin", "no bus 'can7'"),
        ("run bench --bus can0=socketcan", "INTERFACE:CHANNEL"),
        ("run bench --bus can0=sockettcan:can0", "sockettcan"),
        ("run bench --bus can0=virtual:x --fast", "needs a simulated world: can0 is on a real interface"),
        ("run bench --goal 1,2", "--goal: 'bench' has no base to drive; its joints take"),
        ("run bench --goal -1,-.5", "--goal: 'bench' has no base to drive; its joints take"),
        ("run bench --mission rounds", "'bench' cannot do this: step 1: goto: there is no base to drive"),
        ("twin difbot", "did you mean 'diffbot'"),
        ("twin bench --bus cann0=socketcan:vcan0", "no bus 'cann0': there is can0; did you mean 'can0'"),
        ("twin bench --bus can0=socketcan:no-such-bus", "no-such-bus"),
        ("twin diffbot --bus sensors=serial:/dev/no-such-port", "no-such-port"),
        ("twin bench --seconds -1", "not a positive number"),
        ("twin bench --ports 0", "'0' is not a number from 1 to 16"),
        ("twin bench --ports 17", "'17' is not a number from 1 to 16"),
        ("twin bench --ports 1.5", "'1.5' is not a number from 1 to 16"),
        ("replay no.mcap", "no.mcap"),
        ("map no.bag", "no.bag: there is no such file or folder"),
        *((f"replay no.mcap --at-most={m}", f"'{m}' is not a number of metres") for m in METRES),
        ("replay pyproject.toml", "not a recording of this gateway"),
        ("replay no.mcap --view 0 --at-most 1", "--at-most is for bags and logs only"),
        ("replay no.mcap --view 0 --report a.html", "leave --report or --view away"),
        ("demo --robot bench --out {tmp}", "has no tour"),
        ("demo --robot bench --out {tmp} --goal 1,2", "--goal: 'bench' has no base to drive"),
        ("demo --out /proc/no", "--out /proc/no"),
        ("protocols chek plain", "invalid choice: 'chek'"),
        ("protocols check plane", "did you mean 'plain'?"),
        ("protocols check plain plane", "did you mean 'plain'?"),
        *((f"protocols check --seed={n}", f"'{n}' is not a number from 0 to 2**63 - 1") for n in SEEDS),
        ("ask absent status", "no robot runs"),
        ("scan virtual:x --protocol oddrive", "no protocol 'oddrive'"),
        ("watch difbot", "did you mean 'diffbot'?"),
        ("watch diffbot", "bus 'can0' is simulated inside the process"),
        ("watch diffbot", "where nothing else can listen"),
        ("watch diffbot", "--bus sensors=serial:PORT"),
        ("watch serial:/dev/nowhere", "/dev/nowhere"),
        ("watch socketcan:vcan7", "sudo ip link"),
        ("watch candle:0", 'candle:0: expected "socketcan:can0"'),
        ("watch virtual:x --bus can0=virtual:y", "--bus is for the buses of a robot file"),
        ("watch virtual:x --bitrate fast", "'fast' is not a rate in bit/s"),
        ("watch pyproject.mcap", "pyproject.mcap"),
        ("watch README.md", "not a recording of this gateway"),
        ("jog left bench", "standard input must be a terminal"),
        ("jog leftt", "did you mean 'left'"),
        ("jog left bench --speed 30", "the limit of left is 20 rad/s"),
        ("jog left bench --speed -1", "is not a positive number of rad/s"),
        ("jog left bnch", "did you mean 'bench'"),
        ("jog left bench --bus can7=twin", "no bus 'can7'"),
    ],
)
def test_a_command_that_cannot_begin_prints_why_and_exits_with_2(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str, expected: str
) -> None:
    assert expected in refused(capsys, *command.format(tmp=tmp_path).split())


def test_a_scan_of_an_interface_that_is_not_there_says_so_and_of_an_empty_bus_that_nothing_answers(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["scan", "/dev/nowhere"]) == 2
    assert "there is no /dev/nowhere" in capsys.readouterr().err
    assert main(["scan", "virtual:nobody", "--protocol", "moteus", "--protocol", "cubemars"]) == 1
    assert "nothing answers" in capsys.readouterr().out


def test_a_missing_can_interface_is_named_with_the_commands_that_make_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    printed = refused(capsys, "run", "bench", "--bus", "can0=socketcan:vcan7", "--seconds", "1")
    assert "bus 'can0' cannot be opened as 'socketcan:vcan7'" in printed
    assert "sudo ip link add dev vcan7 type vcan" in printed
    assert "sudo ip link set vcan7 " in printed


def test_every_mistake_of_a_robot_file_is_printed_at_once(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "wrong.toml"
    text = BENCH.replace("gear = 8.0", "geer = 8.0").replace("address = 2", 'address = "2"')
    file.write_text(text.replace('bus = "can0"', 'bus = "can1"'))
    printed = refused(capsys, "run", str(file))
    for part in ("geer", "gear", "motors.right.address", "can1"):
        assert part in printed, printed
    assert printed.count(str(file)) >= 3


def test_a_recording_is_not_overwritten(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "old.mcap"
    file.write_bytes(b"precious")
    assert "never overwritten" in refused(capsys, "run", "bench", "--record", str(file))
    assert file.read_bytes() == b"precious"


def test_check_describes_the_robot(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "diffbot"]) == 0
    printed = capsys.readouterr().out
    for part in ("odrive_can", "wheel_separation", "3000000 bit/s", "20 rad/s"):
        assert part in printed


def test_a_missing_watchdog_is_a_warning_at_every_start_until_it_is_acknowledged(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(BENCH)
    assert main(["run", str(file), "--fast", "--seconds", "0.1"]) == 0
    assert "watchdog" not in caplog.text
    file.write_text(BENCH.replace('options = { watchdog = "acknowledged" }\n', ""))
    assert main(["run", str(file), "--fast", "--seconds", "0.1"]) == 0
    assert "left" in caplog.text
    assert "watchdog" in caplog.text
    assert main(["check", str(file)]) == 0
    assert "watchdog" in capsys.readouterr().out


def test_a_dry_run_does_everything_but_write_to_the_buses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = tmp_path / "run.mcap"
    options = ["--fast", "--dry-run", "--goal", "1,0", "--seconds", "2", "--record", str(recording)]
    assert main(["run", "diffbot", *options]) == 1  # the goal is not reached
    ticks = list(read_recording(recording).ticks)
    assert any(tick.outputs.packets for tick in ticks)
    received = [event for tick in ticks for event in tick.outputs.events if isinstance(event, Feedback)]
    assert received  # the twins report by themselves
    assert all(event.velocity in (None, 0.0) for event in received)
    err = capsys.readouterr().err
    assert "firmware unknown" in err  # no device has received the driver's query
    assert "gateway run: exit status 1: 0 of 1 goals reached within 2 s (" in err


def test_what_became_of_a_mission_is_printed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "twice.toml"
    file.write_text("[[steps]]\nrepeat = 2\nsteps = [{wait = 0.1}]")
    assert main(["run", "bench", "--bus", "can0=twin", "--fast", "--mission", str(file)]) == 0
    assert capsys.readouterr().out.endswith("\nmission twice: done\n")


def test_lines_on_the_terminal_and_by_ask_drive_the_bench(tmp_path: Path) -> None:
    """On the wall clock, in processes of their own: a terminal and a socket are theirs."""
    recording = tmp_path / "run.mcap"
    with Process(tmp_path / "run", "run", "bench", "--record", str(recording), "-v") as robot:
        robot.until("brain: ready")
        robot.send_line("velocity left 4\nvelosity right 4")
        robot.until("left: armed", "did you mean 'velocity'?")
        with Process(tmp_path / "run", "ask", "bench", "hold right", "velocity right 3") as asking:
            asking.until("accepted: hold right", "accepted: velocity right 3")
            assert asking.end()[0] == 0
        robot.until("right: armed")
        robot.send_line("quit")
        status, text = robot.end()
    assert status == 0, text
    commands = [command for _, command in sent_commands(parse_robot(BENCH), read_recording(recording).ticks)]
    assert {command.motor for command in commands if isinstance(command, Velocity)} == {"left", "right"}


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\nfrom gateway.cli.main import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        f"sys.exit(', '.join(sorted({HEAVY} & set(sys.modules))) or None)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_an_interrupt_where_nothing_is_open_is_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gateway.runtime.schedule.count_buses", interrupted)
    assert main(["schedule", "bench"]) == 130
    assert capsys.readouterr().err == "gateway: interrupted\n"


def test_a_robot_is_checked_without_the_library_that_its_world_needs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert main(["check", "diffbot"]) == 0
    assert "the load of the buses was not counted: world 'office': it needs MuJoCo" in capsys.readouterr().out


ELSEWHERE = """
import sys
for name in ("fcntl", "termios", "tty", "pty", "resource", "grp", "pwd"):
    sys.modules[name] = None
from pathlib import Path
import platform
platform.system = lambda: "Windows"
from gateway.cli.main import main
from gateway.rosbag import file
file.STATM = Path("no such file")
for line in sys.argv[1:]:
    print(line, "->", main(line.split()), flush=True)
"""
"""A process on a system without what Linux has."""


def test_what_needs_no_bus_runs_elsewhere_and_the_rest_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "rover.toml").write_text(ROBOT)
    bag = write(tmp_path / "drive", drive(8.0))
    recording, report = tmp_path / "run.mcap", tmp_path / "report.html"
    assert main(["run", "bench", "--fast", "--seconds", "0.3", "--record", str(recording)]) == 0
    runs = {
        "check bench": 0,
        f"replay {recording}": 0,
        f"replay {recording} --report {report}": 0,
        f"replay {bag} --robot {tmp_path}/rover.toml": 0,
        f"judge {recording} --update": 0,
        f"trim {recording} --to 0.2": 0,
        f"minimise {recording} --while tells": 2,
        "schema mission": 0,
        f"recover {recording}": 0,
        "fixtures list": 0,
        f"watch {recording}": 0,
        "protocols": 0,
        **dict.fromkeys(("demo --fast", "run bench", "twin bench", "jog left bench", "ask bench status"), 2),
        "watch socketcan:can0": 2,
    }
    command = [sys.executable, "-c", ELSEWHERE, *runs]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    assert [line for line in done.stdout.splitlines() if " -> " in line] == [
        f"{line} -> {status}" for line, status in runs.items()
    ], done.stderr
    there = "replay, judge, trim, minimise, diff, inspect, map, recover, fixtures, watch, check, schema"
    assert done.stderr.count(f": runs on Linux only; here do: {there},") == 5
    assert done.stderr.count("gateway watch: this runs on Linux only") == 1


def test_options_may_precede_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["-q", "check", "bench"]) == 0
    first = capsys.readouterr().out
    assert main(["check", "bench", "-q"]) == 0
    assert capsys.readouterr().out == first
