"""The operator's commands, and the socket and terminal that take them: real ones, and without waiting."""

from __future__ import annotations

import math
import os
import select
import socket
import stat
import subprocess
import sys
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.config import load_mission, load_robot
from gateway.core.robot import Robot
from gateway.errors import OperatorError
from gateway.operator import Operator, ask, socket_path
from gateway.operator.commands import COMMANDS, Query, RejectedLine, help_text, parse
from gateway.operator.server import MAX_CLIENTS, MAX_LINE, MAX_LINES, socket_folder
from protocols import messages as msg
from tests.gateway.processes import PATIENCE

DIFFBOT = load_robot("diffbot")
BENCH, ARM = load_robot("bench"), load_robot("arm")
MIXED = load_robot("diffbot_mixed")
"""A base that carries a mast."""


def one(name: str, step: msg.Step) -> msg.Mission:
    return msg.Mission(name, (step,))


# -- the commands ------------------------------------------------------------------------------

LINES: list[tuple[Robot, str, msg.Instruction | Query | None]] = [
    (DIFFBOT, "goal 2 1.5", msg.Goal(2.0, 1.5)),
    (DIFFBOT, "goal 2,1.5,90", msg.Goal(2.0, 1.5, math.pi / 2)),
    (DIFFBOT, "GOAL 2 1.5 -90deg", msg.Goal(2.0, 1.5, -math.pi / 2)),
    (DIFFBOT, "goal 2 1.5 1.25rad", msg.Goal(2.0, 1.5, 1.25)),
    (DIFFBOT, "drive 0.2 -1e-1", msg.Drive(0.2, -0.1)),
    (
        load_robot("quadruped"),
        "move left 1",
        msg.Mission("drive 0.15 m/s to the left for 1 m", (msg.Move(0.0, 0.15, 0.0, None, 1.0),)),
    ),
    (load_robot("mecanum"), "drive 0.2 0 0.1", msg.Drive(0.2, 0.0, 0.1)),
    (DIFFBOT, "turn 30deg", one("turn 30° to the left", msg.Turn(math.pi / 6))),
    (DIFFBOT, "turn right 30", one("turn 30° to the right", msg.Turn(-math.pi / 6))),
    (DIFFBOT, "move 0.5 for 3 s", one("drive 0.5 m/s for 3 s", msg.Move(0.5, seconds=3.0))),
    (DIFFBOT, "move 2 m", one("drive 0.2 m/s for 2 m", msg.Move(0.2, distance=2.0))),
    (DIFFBOT, "move -1m", one("drive -0.2 m/s for 1 m", msg.Move(-0.2, distance=1.0))),
    (DIFFBOT, "follow 1,2 3,4", one("follow 2 points to (3, 4)", msg.Follow(((1.0, 2.0), (3.0, 4.0))))),
    (DIFFBOT, "wait 5 s", one("wait 5 s", msg.Wait(5.0))),
    (ARM, "tool 0.3 0 0.2", one("bring the tool to (0.3, 0, 0.2)", msg.MoveTool(0.3, 0.0, 0.2))),
    (BENCH, "wait 5", one("wait 5 s", msg.Wait(5.0))),
    (DIFFBOT, "dock 3 0.4m", one("dock 0.4 m before marker 3", msg.Dock(3, 0.4))),
    (DIFFBOT, "mission rounds", load_mission("rounds")),
    (DIFFBOT, "pause", msg.Pause()),
    (DIFFBOT, "resume", msg.Resume()),
    (DIFFBOT, "drop", msg.Drop()),
    (DIFFBOT, "locate 1 2 90", msg.Locate(1.0, 2.0, math.pi / 2)),
    (DIFFBOT, "stop", msg.Stop()),
    (DIFFBOT, "stop a cat is in the way", msg.Stop("a cat is in the way")),
    (DIFFBOT, "  release  ", msg.Release()),
    (DIFFBOT, "clear", msg.ClearFault("all")),
    (DIFFBOT, "clear left", msg.ClearFault("left")),
    (DIFFBOT, "estop left", msg.Estop("left")),
    (DIFFBOT, "estop all", msg.Estop("all")),
    (DIFFBOT, "set brain.pursuit.lookahead 0.4", msg.Set("brain.pursuit.lookahead", 0.4)),
    (DIFFBOT, "set left.limits.velocity 5", msg.Set("left.limits.velocity", 5.0)),
    (DIFFBOT, "confirm left", msg.Confirm("left")),
    (DIFFBOT, "reboot right", msg.Reboot("right")),
    (DIFFBOT, "zero right", msg.Zero("right")),
    (DIFFBOT, "home right", msg.Home("right")),
    (DIFFBOT, "scan can0", msg.Scan("can0")),
    (DIFFBOT, "setid can0 385F34733301 7", msg.SetId("can0", 0x385F34733301, 7)),
    (DIFFBOT, "setid can0 0x10 7", msg.SetId("can0", 16, 7)),
    (DIFFBOT, "setaddress left 7", msg.SetAddress("left", 7)),
    (DIFFBOT, "read left axis0.config.x", msg.ReadParameter("left", "axis0.config.x")),
    (DIFFBOT, "write left vel_gain 0.2", msg.WriteParameter("left", "vel_gain", 0.2)),
    (BENCH, "position left -1.5", msg.Position("left", -1.5)),
    (BENCH, "position left 90deg", msg.Position("left", math.pi / 2)),
    (MIXED, "position mast 90deg", msg.Position("mast", math.pi / 2)),
    (MIXED, "hold mast", msg.Hold("mast")),
    (BENCH, "velocity right 3", msg.Velocity("right", 3.0)),
    (BENCH, "torque right 0.5", msg.Torque("right", 0.5)),
    (BENCH, "idle left", msg.Idle("left")),
    (BENCH, "hold left", msg.Hold("left")),
    (BENCH, "status", Query("status")),
    (BENCH, "doctor", Query("doctor")),
    (BENCH, "help", Query("help")),
    (BENCH, "quit  # enough", Query("quit")),
    (BENCH, "ready", Query("ready")),
    (DIFFBOT, "wait ready", Query("ready")),
    (BENCH, "view 127.0.0.1:0 steer", Query("view", "127.0.0.1:0 steer")),
    (BENCH, "", None),
    (BENCH, "   # only a comment", None),
]


@pytest.mark.parametrize(("robot", "line", "meant"), LINES, ids=[row[1] for row in LINES])
def test_a_line_means(robot: Robot, line: str, meant: msg.Instruction | Query | None) -> None:
    parsed = parse(line, robot)
    assert parsed == meant
    assert type(parsed) is type(meant)


def test_every_command_is_tested_and_in_the_help() -> None:
    used = {line.split()[0].lower() for _, line, meant in LINES if meant is not None}
    assert used == set(COMMANDS)
    assert [row.split()[0] for row in help_text().splitlines()] == list(COMMANDS)


def test_the_document_has_the_list_that_help_prints() -> None:
    page = (Path(__file__).parents[3] / "docs" / "watch-and-jog.md").read_text()
    assert f"```text\n{help_text()}\n```" in page


WRONG: list[tuple[Robot, str, str]] = [
    (DIFFBOT, "gaol 1 2", "did you mean 'goal'?"),
    (DIFFBOT, "jump", "no command 'jump': there is goal, drive, mission"),
    (DIFFBOT, "goal", "an argument is missing; expected: goal X Y [YAW]"),
    (DIFFBOT, "goal 1", "an argument is missing; expected: goal X Y [YAW]"),
    (DIFFBOT, "goal 1 2 3 4", "'4' is one argument too many; expected: goal X Y [YAW]"),
    (DIFFBOT, "goal 1 x", "'x' is not a number"),
    (DIFFBOT, "move left 1 m", "this base does not move sideways"),
    (DIFFBOT, "move 9 m/s for 1 s", "its linear speed, 9, is beyond this base's 0.6"),
    (DIFFBOT, "move", "a motion needs a time or a distance"),
    (DIFFBOT, "turn", "one angle is needed; expected: turn [left|right] ANGLE"),
    (DIFFBOT, "follow 1 2 3", "points have two numbers each"),
    (DIFFBOT, "wait -3", "its time must be from 0"),
    (DIFFBOT, "mission round", "did you mean 'rounds'?"),
    (BENCH, "mission rounds", "'bench' cannot do this: step 1: goto: there is no base to drive"),
    (BENCH, "turn 30", "'bench' has no base to drive; its joints take targets: left, right"),
    (DIFFBOT, "goal nan 1", "'nan' is not a finite number"),
    (DIFFBOT, "goal 1 inf", "'inf' is not a finite number"),
    (DIFFBOT, "goal 1 1e999", "'1e999' is not a finite number"),
    (DIFFBOT, "goal 1 2 nandeg", "'nan' is not a finite number"),
    (DIFFBOT, "drive -inf 0", "'-inf' is not a finite number"),
    (DIFFBOT, "set brain.x nan", "'nan' is not a finite number"),
    (
        DIFFBOT,
        "set brian.x 1",
        "no owner of settings 'brian': there is brain, left, right; did you mean 'brain'?",
    ),
    (DIFFBOT, "set brain 1", "'brain' names no setting"),
    (DIFFBOT, "write left x nan", "'nan' is not a finite number"),
    (DIFFBOT, "clear lift", "no motor 'lift': there is left, right, all; did you mean 'left'?"),
    (DIFFBOT, "estop", "an argument is missing; expected: estop MOTOR|all"),
    (DIFFBOT, "reboot all", "no motor 'all': there is left, right"),
    (DIFFBOT, "release now", "'now' is one argument too many; expected: release"),
    (DIFFBOT, "scan can1", "no bus 'can1': there is can0, sensors; did you mean 'can0'?"),
    (DIFFBOT, "setid can0 xyz 1", "'xyz' is not a hexadecimal integer"),
    (DIFFBOT, "setid can0 12 1.5", "'1.5' is not an integer"),
    (DIFFBOT, "setid can0 12 -1", "'-1' is negative"),
    (DIFFBOT, "velocity left 1", "'left' moves the base: use goal or drive; expected"),
    (DIFFBOT, "idle left", "'left' moves the base: use goal or drive"),
    (MIXED, "position left 1", "'left' moves the base: use goal or drive; bare joints are mast"),
    (MIXED, "torque mats 1", "no bare joint 'mats': there is mast; did you mean 'mast'?"),
    (BENCH, "goal 1 2", "'bench' has no base to drive; its joints take targets: left, right"),
    (BENCH, "drive 1 2", "'bench' has no base"),
    (BENCH, "goal", "'bench' has no base"),
    (load_robot("arm"), "position shoulder 9", "shoulder goes from -1 to 2, not to 9"),
    (BENCH, "tool 0.1 0.2 0.3", "there is no arm to bring the tool there"),
    (DIFFBOT, "drive 0.1 0 0.2", "the base of 'diffbot' does not move sideways"),
    (BENCH, "torque left nan", "'nan' is not a finite number"),
    (BENCH, "position left 1deg2", "'1deg2' is not a number"),
]


@pytest.mark.parametrize(("robot", "line", "reason"), WRONG, ids=[row[1] for row in WRONG])
def test_a_wrong_line_is_rejected_with_the_reason(robot: Robot, line: str, reason: str) -> None:
    rejected = parse(line, robot)
    assert isinstance(rejected, RejectedLine)
    assert reason in rejected.reason


@given(
    st.sampled_from([DIFFBOT, BENCH, MIXED]),
    st.text(max_size=60) | st.lists(st.sampled_from(list(COMMANDS))).map(" ".join),
)
def test_no_line_raises_and_no_number_is_not_finite(robot: Robot, line: str) -> None:
    parsed = parse(line, robot)
    for name in getattr(parsed, "__dataclass_fields__", ()):
        value = getattr(parsed, name)
        assert not isinstance(value, float) or math.isfinite(value)


# -- the socket ----------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "run"


@pytest.fixture
def operator(folder: Path) -> Iterator[Operator]:
    with Operator(DIFFBOT, folder, terminal=None) as made:
        yield made


def status() -> str:
    return "all is well\nreally"


class Client:
    """A client that never waits."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.socket.connect(str(path))
        self.socket.setblocking(False)

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def received(self) -> str:
        """Return what has arrived."""
        data = b""
        while True:
            try:
                piece = self.socket.recv(1 << 16)
            except BlockingIOError:
                return data.decode()
            if not piece:
                return data.decode() + "<end>"
            data += piece


@pytest.fixture
def client(operator: Operator) -> Iterator[Client]:
    made = Client(operator.path)
    yield made
    made.socket.close()


def test_the_socket_belongs_to_its_owner_alone_and_goes_with_the_operator(folder: Path) -> None:
    with Operator(DIFFBOT, folder, terminal=None) as operator:
        assert operator.path == folder / "diffbot.sock" == socket_path("diffbot", folder)
        assert stat.S_IMODE(operator.path.stat().st_mode) == 0o600
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert not operator.path.exists()
    operator.close()


def test_lines_are_accepted_in_order_and_answered(operator: Operator, client: Client) -> None:
    assert operator.poll(status) == []
    client.send(b"goal 1 2\nnonsense\nstatus\n\nstop now\n")
    assert operator.poll(status) == [msg.Goal(1.0, 2.0), msg.Stop("now")]
    answer = client.received().splitlines()
    assert answer[0] == "accepted: goal 1 2"
    assert "no command 'nonsense'" in answer[1]
    assert answer[2:] == ["all is well", "really", "accepted: stop now"]
    assert operator.poll(status) == []
    assert client.received() == ""


def test_a_line_may_come_byte_by_byte(operator: Operator, client: Client) -> None:
    for byte in b"drive 0.5 0":
        client.send(bytes([byte]))
        assert operator.poll(status) == []
    client.send(b"\r\n")
    assert operator.poll(status) == [msg.Drive(0.5, 0.0)]


def test_the_last_line_needs_no_end(operator: Operator, client: Client) -> None:
    client.send(b"release")
    client.socket.shutdown(socket.SHUT_WR)
    asked = [one for _ in range(3) for one in operator.poll(status)]
    assert asked == [msg.Release()]


def test_the_report_of_the_next_step_is_received_too(operator: Operator, client: Client) -> None:
    client.send(b"set brain.x 5\n")
    client.socket.shutdown(socket.SHUT_WR)
    asked = operator.poll(status)
    if not asked:
        asked = operator.poll(status)
    assert asked == [msg.Set("brain.x", 5.0)]
    operator.report("operator: set brain.x: refused: there is no such setting")
    for _ in range(3):
        operator.poll(status)
    received = client.received()
    assert (
        received == "accepted: set brain.x 5\noperator: set brain.x: refused: there is no such setting\n<end>"
    )


def test_quit_is_answered_and_leaves(operator: Operator, client: Client) -> None:
    client.send(b"quit\n")
    assert operator.poll(status) == []
    assert operator.leaving
    assert client.received() == "leaving\n"


def test_a_line_that_is_too_long_is_left_out_whole(operator: Operator, client: Client) -> None:
    client.send(b"stop " + b"x" * (MAX_LINE * 12) + b"\nrelease\n")
    asked: list[msg.Instruction] = []
    for _ in range(10):
        asked += operator.poll(status)
    assert asked == [msg.Release()]
    assert client.received().count("longer than") == 1
    client.send(b"stop " + b"y" * (MAX_LINE - 10) + b"\n")
    assert operator.poll(status) == [msg.Stop("y" * (MAX_LINE - 10))]


def test_bytes_that_are_no_text_are_answered(operator: Operator, client: Client) -> None:
    client.send(b"\xff\xfe\x00\nrelease\n")
    assert operator.poll(status) == [msg.Release()]


def test_clients_that_vanish_or_never_read_affect_no_other(operator: Operator, client: Client) -> None:
    gone = [Client(operator.path) for _ in range(3)]
    for one in gone:
        one.send(b"status\ngoal 1 1\nhalf a li")
        one.socket.close()
    assert operator.poll(status) == [msg.Goal(1.0, 1.0)] * 3
    for _ in range(2000):
        operator.report("x" * 1000)
    assert operator.poll(status) == []
    other = Client(operator.path)
    try:
        other.send(b"release\n")
        assert operator.poll(status) == [msg.Release()]
        assert other.received() == "accepted: release\n"
    finally:
        other.socket.close()
    assert client.received().endswith("<end>")


@pytest.mark.parametrize("flood", [b"", b"goal 1 1\n" * 500, b"nonsense\n" * 500, b"x" * 5000])
def test_no_crowd_keeps_a_stop_out(operator: Operator, flood: bytes) -> None:
    """Idle, or sending without end: each is answered, and no poll takes more lines than declared."""
    answers: list[str] = []
    asker = threading.Thread(target=lambda: answers.append(ask(operator.path, "stop now", PATIENCE)))
    crowd: list[Client] = []
    stopped, polls = False, 0
    try:
        while not stopped or asker.is_alive():
            if len(crowd) < 6 * MAX_CLIENTS:
                crowd += [Client(operator.path) for _ in range(MAX_CLIENTS)]
                for one in crowd[-MAX_CLIENTS:]:
                    one.send(flood)
            elif not polls:
                asker.start()
                polls = 1
            asked = operator.poll(status)
            assert len(asked) <= MAX_LINES
            stopped = stopped or msg.Stop("now") in asked
            polls += stopped
        assert answers[0].startswith("accepted: stop now")
        assert len(operator._clients) <= MAX_CLIENTS
    finally:
        asker.join(PATIENCE)
        for one in crowd:
            one.socket.close()


def test_no_answer_controls_a_terminal(operator: Operator, client: Client) -> None:
    client.send("stop \x1b[2J\u202e\x9b1m\n\x07\r\x1b]0;x\x07\n".encode())
    operator.poll(lambda: "")
    operator.report("left: a device that \x1b[2J\nERROR: lies")
    received = client.received()
    assert all(c == "\n" or c.isprintable() for c in received)
    assert "left: a device that \\x1b[2J\\nERROR: lies\n" in received


def test_the_socket_of_a_dead_process_is_taken_over(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    dead = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    dead.bind(str(folder / "diffbot.sock"))
    dead.close()
    with Operator(DIFFBOT, folder, terminal=None) as operator:
        assert operator.path == folder / "diffbot.sock"
        client = Client(operator.path)
        client.send(b"stop\n")
        assert operator.poll(status) == [msg.Stop()]
        client.socket.close()


def test_a_second_gateway_of_the_same_name_gets_a_socket_of_its_own(operator: Operator, folder: Path) -> None:
    with Operator(DIFFBOT, folder, terminal=None) as second:
        assert second.path == folder / f"diffbot.{os.getpid()}.sock"
    assert operator.path.exists()
    operator.poll(status)


@pytest.mark.parametrize("what", ["open to others", "a link"])
def test_a_folder_that_is_not_private_is_refused(tmp_path: Path, folder: Path, what: str) -> None:
    if what == "a link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        folder.symlink_to(tmp_path / "elsewhere")
    else:
        folder.mkdir()
        folder.chmod(0o755)
    with pytest.raises(OperatorError, match="belongs to you alone"):
        Operator(DIFFBOT, folder, terminal=None)


def test_a_path_that_is_too_long_for_a_socket_is_reported(tmp_path: Path) -> None:
    with pytest.raises(OperatorError, match="too long for a socket"):
        Operator(DIFFBOT, tmp_path / ("x" * 120), terminal=None)


def test_where_sockets_stand(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert socket_folder() == tmp_path / "motor-gateway"
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert socket_folder() == tmp_path / f"motor-gateway-{os.getuid()}"


def test_ask_returns_the_answer(operator: Operator) -> None:
    """`ask` blocks, so the robot's loop runs in a thread of the test."""
    asked: list[msg.Instruction] = []
    enough = threading.Event()

    def loop() -> None:
        while not enough.is_set():
            for one in operator.poll(status):
                asked.append(one)
                operator.report("operator: so be it")

    robot = threading.Thread(target=loop)
    robot.start()
    try:
        assert ask(operator.path, "status", PATIENCE) == "all is well\nreally"
        assert ask(operator.path, "goal 1 2", PATIENCE) == "accepted: goal 1 2\noperator: so be it"
        assert "did you mean 'goal'" in ask(operator.path, "gaol 1 2", PATIENCE)
    finally:
        enough.set()
        robot.join()
    assert asked == [msg.Goal(1.0, 2.0)]


def test_asking_a_robot_that_does_not_run_or_answer(operator: Operator, folder: Path) -> None:
    with pytest.raises(OperatorError, match=r"no robot runs at .*other\.sock .*running: diffbot"):
        ask(folder / "other.sock", "status")
    with pytest.raises(OperatorError, match="does not answer"):
        ask(operator.path, "status", timeout=0.01)


# -- the terminal --------------------------------------------------------------------------------


def test_lines_on_a_pipe_are_accepted_and_its_end_does_not_end_the_run(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reader, writer = os.pipe()
    with Operator(DIFFBOT, folder, terminal=reader) as operator:
        assert operator.poll(status) == []
        os.write(writer, b"goal 1 2\nstatus\ngo")
        assert operator.poll(status) == [msg.Goal(1.0, 2.0)]
        assert capsys.readouterr().out == "accepted: goal 1 2\nall is well\nreally\n"
        os.write(writer, b"al 3 4")
        os.close(writer)
        asked = [one for _ in range(4) for one in operator.poll(status)]
        assert asked == [msg.Goal(3.0, 4.0)]
        assert not operator.leaving
    os.close(reader)


def test_lines_on_a_pipe_wait_until_the_robot_is_ready_but_for_one_that_ends_something(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for line, kept in ((b"goal 3 4\n", True), (b"stop\n", False)):
        reader, writer = os.pipe()
        with Operator(DIFFBOT, folder, terminal=reader) as operator:
            os.write(writer, b"goal 1 2\n" + line)
            early = [one for _ in range(3) for one in operator.poll(status, unready=lambda: "left is silent")]
            assert bool(early) != kept
            assert capsys.readouterr().out.count("the lines wait: left is silent\n") == kept
            late = operator.poll(status)
            assert len([*early, *late]) == 2
        os.close(writer)
        os.close(reader)


@contextmanager
def waiting(
    folder: Path, *, by_pipe: bool
) -> Iterator[tuple[Operator, Callable[[bytes], int], socket.socket]]:
    """An operator, what sends lines by its standard input or as a client, and the client."""
    reader, writer = os.pipe()
    with Operator(DIFFBOT, folder, terminal=reader) as operator, socket.socket(socket.AF_UNIX) as client:
        client.connect(os.fspath(operator.path))
        client.settimeout(PATIENCE)
        yield operator, partial(os.write, writer) if by_pipe else client.send, client
    os.close(writer)
    os.close(reader)


@pytest.mark.parametrize("by_pipe", [True, False], ids=["a pipe", "a client"])
def test_what_follows_wait_ready_waits_until_it_is_but_for_a_stop(by_pipe: bool, folder: Path) -> None:
    for later, waits in ((b"quit\n", True), (b"stop enough\n", False)):
        with waiting(folder, by_pipe=by_pipe) as (operator, send, _):
            send(b"goal 0 1\nwait ready\n" + 100 * b"goal 1 2\n")
            silent = partial(operator.poll, status, unready=lambda: "left is silent")
            early = [one for _ in range(20) for one in silent()]
            assert early == [msg.Goal(0.0, 1.0)]
            send(later)
            then = [one for _ in range(20) for one in silent()]
            late = [one for _ in range(20) for one in operator.poll(status)]
            if waits:
                assert then == []
                assert late == 100 * [msg.Goal(1.0, 2.0)]
            else:  # it comes at once, and what waited never
                assert (then, late) == ([msg.Stop("enough")], [])
            assert operator.leaving == waits


@pytest.mark.parametrize("by_pipe", [True, False], ids=["a pipe", "a client"])
@pytest.mark.parametrize("by_line", [True, False], ids=["by a line", "from elsewhere"])
def test_what_waits_does_not_outlast_a_stop_of_somebody_else(
    by_pipe: bool, by_line: bool, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (
        waiting(folder, by_pipe=by_pipe) as (operator, send, client),
        socket.socket(socket.AF_UNIX) as other,
    ):
        send(b"wait ready\nrelease\ngoal 1 2\n")
        silent = partial(operator.poll, status, unready=lambda: "left is silent")
        assert [one for _ in range(3) for one in silent()] == []
        if by_line:
            other.connect(os.fspath(operator.path))
            other.send(b"stop enough\nwait ready\nrelease\n")  # what follows the stop is kept
            stopped = silent()
            assert stopped == [msg.Stop("enough")]
            operator.see(stopped)
        else:
            operator.see([msg.Stop("page")])
        late = [one for _ in range(3) for one in operator.poll(status)]
        assert late == by_line * [msg.Release()]
        told = capsys.readouterr().out if by_pipe else client.recv(4096).decode()
        assert "the robot was stopped: 3 lines that waited until it is ready are dropped" in told


@pytest.mark.parametrize("by_pipe", [True, False], ids=["a pipe", "a client"])
@pytest.mark.parametrize("filling", [0, 1500], ids=["all is read", "some is not read yet"])
def test_what_is_to_wait_behind_other_lines_does_not_outlast_a_stop_either(
    by_pipe: bool, filling: int, folder: Path
) -> None:
    with (
        waiting(folder, by_pipe=by_pipe) as (operator, send, client),
        socket.socket(socket.AF_UNIX) as other,
    ):
        silent = partial(operator.poll, status, unready=lambda: "left is silent")
        other.connect(os.fspath(operator.path))
        client.send(b"help\n")  # who was answered longest ago comes first
        assert silent() == []
        other.send(b"stop enough\n")
        send(b"goal 0 1\nwait ready\n" + filling * b"# more\n" + b"release\ngoal 1 2\n")
        before = [] if by_pipe else [msg.Goal(0.0, 1.0)]  # all lines of a pipe wait at first
        assert [one for _ in range(5) for one in silent()] == [msg.Stop("enough"), *before]
        assert [one for _ in range(400) for one in operator.poll(status)] == []
        send(b"release\n")
        assert [one for _ in range(3) for one in operator.poll(status)] == [msg.Release()]


@pytest.mark.parametrize("by_pipe", [True, False], ids=["a pipe", "a client"])
def test_who_waits_until_it_is_ready_is_told_for_what(
    by_pipe: bool, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with waiting(folder, by_pipe=by_pipe) as (operator, send, client):
        send(b"wait ready\n")
        for _ in range(3):
            operator.poll(status, unready=lambda: "left is silent")
        told = capsys.readouterr().out if by_pipe else client.recv(4096).decode()
        assert told == "the lines wait: left is silent\n"


def test_where_a_line_was_typed_its_answers_are_printed_too(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`scan` has no other answer than what is found; the log shows that with -v only."""
    reader, writer = os.pipe()
    with Operator(DIFFBOT, folder, terminal=reader) as operator:
        operator.report("left: idle", logged=False)
        os.write(writer, b"scan can0\n")
        assert operator.poll(status) == [msg.Scan("can0")]
        operator.report("scan: odrive_can at address 1", logged=False)
        operator.report("scan: odrive_can at address 2", logged=True)
    os.close(writer)
    os.close(reader)
    printed = capsys.readouterr().out
    assert "scan: odrive_can at address 1\n" in printed
    assert "left: idle" not in printed
    assert "address 2" not in printed


def test_lines_on_a_terminal_are_accepted(folder: Path) -> None:
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    try:
        with Operator(DIFFBOT, folder, terminal=theirs) as operator:
            os.write(ours, b"stop\n")
            assert select.select([theirs], [], [], 60)[0]
            assert operator.poll(status) == [msg.Stop()]
    finally:
        os.close(ours)
        os.close(theirs)


BACKGROUND = """
import os, sys
from pathlib import Path
from gateway.config import load_robot, resources
from gateway.operator import Operator

robot = load_robot("diffbot")
terminal = os.open(sys.argv[1], os.O_RDWR)  # the first one that a session opens controls it
child = os.fork()
if child == 0:
    if sys.argv[3] == "background":
        os.setpgid(0, 0)
    with Operator(robot, Path(sys.argv[2]), terminal=terminal) as operator:
        os._exit(len(operator.poll(str)))
_, status = os.waitpid(child, os.WUNTRACED)
sys.exit(99 if os.WIFSTOPPED(status) else os.waitstatus_to_exitcode(status))
"""


@pytest.mark.parametrize(("where", "asked"), [("foreground", 1), ("background", 0)])
def test_in_the_background_the_terminal_is_left_alone(folder: Path, where: str, asked: int) -> None:
    """Reading it there would stop the process (SIGTTIN), and with it the robot's loop."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    try:
        os.write(ours, b"stop\n")
        command = [sys.executable, "-c", BACKGROUND, os.ttyname(theirs), str(folder), where]
        assert subprocess.run(command, start_new_session=True, check=False).returncode == asked
    finally:
        os.close(ours)
        os.close(theirs)


def test_a_terminal_that_vanishes_is_ignored(folder: Path) -> None:
    reader, writer = os.pipe()
    os.close(writer)
    os.close(reader)
    with Operator(DIFFBOT, folder, terminal=reader) as operator:
        assert operator.poll(status) == []
        assert operator.poll(status) == []
