"""`gateway jog`: the meaning of keys, the motion while one is held, and how it ends."""

from __future__ import annotations

import io
import os
import pty
import select
import signal
import termios
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np
import pytest

from brain.belief import Belief
from gateway import config
from gateway.buses.virtual.bus import open_world
from gateway.cli.jog import (
    DEFAULT_SHARE,
    MULTIPLEXERS,
    JogControl,
    drive,
    log,
    log_above,
    single_motor,
    status_line,
)
from gateway.cli.terminal.keys import (
    CREEP_SHARE,
    FIRST_HOLD,
    KEYS,
    REPEAT_HOLD,
    HeldKey,
    Key,
    parse,
    press,
    raw_mode,
    read_keys,
    speed_share,
)
from gateway.cli.terminal.output import Unblocked
from gateway.cli.terminal.screen import TerminalLine
from gateway.core.clock import SimulatedClock
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.errors import UserError
from gateway.operator.commands import FRESH
from gateway.runtime.process import signals
from gateway.runtime.session import Session
from protocols.messages import MILLISECOND, SECOND, ClearFault, Command, Idle, Instruction, Nanos, Velocity
from tests.gateway.processes import Process, TerminalProcess, patient
from tests.gateway.rig import BENCH, sent_commands

MS = MILLISECOND


@pytest.fixture(autouse=True)
def no_multiplexer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Be outside tmux and screen, wherever the tests are run."""
    for variable in MULTIPLEXERS:
        monkeypatch.delenv(variable, raising=False)


# -- keys -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sent", "key"), KEYS.items(), ids=lambda v: repr(v))
def test_each_key_is_known_whole_in_pieces_and_among_others(sent: bytes, key: Key) -> None:
    assert parse(sent) == ([key], b"")
    assert parse(b"zz" + sent + b"\xff" + sent) == ([key, key], b"")
    for cut in range(1, len(sent)):
        keys, rest = parse(sent[:cut])
        assert keys == []
        assert parse(rest + sent[cut:]) == ([key], b"")


def test_other_bytes_are_no_key() -> None:
    assert parse(b"xyz\x00\x1b[Z\x1b\x1b[5~") == ([], b"")
    assert parse(b"\x1b[") == ([], b"\x1b[")


def moves(keys: Sequence[tuple[Nanos, int]], now: Nanos) -> float:
    """Return the share of the speed after the keys received by now."""
    come = [(t, direction) for t, direction in keys if t <= now]
    return speed_share(reduce(lambda held, key: press(held, *key), come, HeldKey()), now)


def test_a_tap_is_a_short_slow_move() -> None:
    keys = [(SECOND, 1)]
    motion = {t: moves(keys, t * MS) for t in range(2500)}
    assert [t for t, share in motion.items() if share] == list(range(1000, 1000 + FIRST_HOLD // MS))
    assert set(motion.values()) == {0.0, CREEP_SHARE}


@pytest.mark.parametrize(
    ("delay", "interval"),
    [(250, 92), (500, 33), (660, 40), (600, 100)],
    ids=["console", "gnome", "x", "slow"],
)
@pytest.mark.parametrize("direction", [1, -1])
def test_holding_is_one_motion_and_releasing_stops_it(delay: int, interval: int, direction: int) -> None:
    times = [0, *range(delay, 3000, interval)]
    keys = [(t * MS, direction) for t in times]
    motion = [moves(keys, t * MS) for t in range(4000)]
    end = times[-1] + REPEAT_HOLD // MS
    assert all(motion[t] == direction * CREEP_SHARE for t in range(delay))
    assert all(motion[t] == direction for t in range(delay, end))
    assert not any(motion[end:])


def test_another_direction_begins_anew() -> None:
    keys = [(0, 1), (500 * MS, 1), (550 * MS, 1), (600 * MS, -1)]
    assert moves(keys, 599 * MS) == 1.0
    assert moves(keys, 600 * MS) == -CREEP_SHARE
    assert moves(keys, 600 * MS + FIRST_HOLD) == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_whatever_is_typed_motion_ends_soon_after_the_last_key(seed: int) -> None:
    rng = np.random.Generator(np.random.PCG64(seed))
    times = np.cumsum(rng.integers(1, 900, 40)).tolist()
    keys = [(t * MS, int(rng.choice([-1, 1]))) for t in times]
    for now in range(0, times[-1] + 2000, 7):
        before = [(t, direction) for t, direction in keys if t <= now * MS]
        motion = moves(keys, now * MS)
        assert abs(motion) <= 1.0
        if motion:
            last, direction = before[-1]
            assert now * MS - last < FIRST_HOLD
            assert motion * direction > 0.0
            if abs(motion) > CREEP_SHARE:
                assert len(before) > 1
                assert now * MS - last < REPEAT_HOLD


def test_keys_received_at_once_move_no_longer_than_one() -> None:
    """Keys that waited while the process stood still are old."""
    assert moves([(0, 1)] * 30, REPEAT_HOLD - 1) == 1.0
    assert moves([(0, 1)] * 30, REPEAT_HOLD) == 0.0


# -- the motor's instructions -------------------------------------------------------------------------

FREE, BLOCKED = False, True


def velocity(share: float) -> list[Instruction]:
    return [Velocity("left", 2.0 * share)]


def answered() -> JogControl:
    """Return a control whose terminal has answered at once."""
    control = JogControl("left", 2.0, asked=deque([0]))
    control.on_input(0, b"\x1b[0n", blocked=False)
    return control


@pytest.mark.parametrize(
    "steps",
    [
        [
            (0, b"", FREE, []),
            (1, b"+", FREE, velocity(CREEP_SHARE)),
            (2, b"", FREE, []),
            (3, b"+", FREE, velocity(1.0)),
            (4, b"\x1b[", FREE, []),
            (5, b"D", FREE, velocity(-CREEP_SHARE)),
            (5 + FIRST_HOLD, b"", FREE, velocity(0.0)),
            (6 + FIRST_HOLD, b"", FREE, []),
        ],
        [
            (0, b"++", FREE, velocity(1.0)),
            (1, b" ", FREE, [Idle("left")]),
            (2, b"", FREE, []),
            (3, b"+", FREE, velocity(CREEP_SHARE)),
        ],
        [
            (0, b"++", FREE, velocity(1.0)),
            (1, b"+", BLOCKED, []),
            (2, b"c", BLOCKED, [ClearFault("left")]),
            (3, b"", FREE, []),
            (4, b"+", FREE, velocity(CREEP_SHARE)),
        ],
    ],
    ids=["only changes after the first key", "space disarms", "blocked, it needs a new key"],
)
def test_instructions(steps: list[tuple[Nanos, bytes, bool, list[Instruction]]]) -> None:
    control = answered()
    for now, data, blocked, expected in steps:
        assert control.on_input(now, data, blocked) == expected
    assert not control.leaving


@pytest.mark.parametrize("data", [b"q", None])
def test_q_and_a_closed_terminal_stop_and_leave(data: bytes | None) -> None:
    control = answered()
    control.on_input(0, b"++", blocked=False)
    assert control.on_input(1, data, blocked=False) == velocity(0.0)
    assert control.leaving


# -- one motor of a robot ---------------------------------------------------------------------------


def test_the_robot_is_reduced_to_one_slow_motor() -> None:
    whole = config.parse_robot(BENCH)
    robot = single_motor(whole, "right")
    assert list(robot.motors) == ["right"]
    assert robot.motors["right"].joint.limits == replace(
        whole.motors["right"].joint.limits, velocity=DEFAULT_SHARE * 20.0
    )
    assert robot.sensors == {}
    assert robot.brain.body.joints == ("right",)
    assert single_motor(whole, "left", 20.0).motors["left"].joint == whole.motors["left"].joint


def test_a_motor_that_takes_no_velocity_cannot_be_jogged() -> None:
    robot = config.parse_robot(BENCH)
    left = robot.motors["left"]
    other = replace(left, spec=replace(left.spec, commands=left.spec.commands - {Velocity}))
    with pytest.raises(UserError, match="takes no velocity"):
        single_motor(replace(robot, motors={"left": other}), "left")


# -- driven, in simulated time ----------------------------------------------------------------------


class RecordedSession(Session):
    """A session that keeps its ticks, also those after it was left."""

    kept: list[Tick]

    def _record(self, tick: Tick, belief: Belief) -> None:
        self.kept.append(tick)


class Jogged:
    """The simulated motors of the whole robot, and a session with one of them, driven by keys."""

    def __init__(self, keys: Sequence[tuple[float, bytes]], speed: float | None = None) -> None:
        """`keys`: what is typed, and when [s]."""
        self.whole: Robot = config.parse_robot(BENCH)
        robot = single_motor(self.whole, "left", speed)
        self.clock = SimulatedClock()
        self.twins = open_world(self.whole, 0)
        self.made = RecordedSession(robot, Gateway(robot), self.clock, {**self.twins.buses}, None, None)
        self.ticks = self.made.kept = []
        self.keys = [(round(t * SECOND), typed) for t, typed in keys]
        self.shown: list[str] = []
        self.answers: list[Nanos] = []
        """When the terminal answers."""
        self.delay: Nanos = 0
        """Of the link to it, there and back; `keys` come as they come."""
        self.at: dict[Nanos, Callable[[], None]] = {}

    def typed(self) -> bytes | None:
        now = self.clock.now()
        for t in [t for t in self.at if t <= now]:
            self.at.pop(t)()
        answers = b"\x1b[0n" * sum(t <= now for t in self.answers)
        self.answers = [t for t in self.answers if t > now]
        come = b"".join(typed for t, typed in self.keys if t <= now)
        self.keys = [(t, typed) for t, typed in self.keys if t > now]
        return answers + come if come or self.keys else None

    def ask(self) -> bool:
        self.answers.append(self.clock.now() + self.delay)
        return True

    def drive(self) -> Jogged:
        drive(self.made, "left", self.typed, self.shown.append, self.ask)
        return self

    def obeyed(self) -> list[tuple[Nanos, Command]]:
        """Return what any device of the whole robot would obey of what was sent."""
        return sent_commands(self.whole, self.ticks)

    def turned(self, motor: str = "left") -> float:
        assert self.twins.world is not None
        return self.twins.world.shaft(motor)[0]


def held(direction: bytes, since: float, until: float) -> list[tuple[float, bytes]]:
    """A key as a terminal sends it: at once, after 0.5 s again, then every 33 ms."""
    return [
        (since, direction),
        *((t / 1000, direction) for t in range(round(since * 1000) + 500, round(until * 1000), 33)),
    ]


def test_nothing_but_read_only_frames_goes_out_before_the_first_key() -> None:
    jogged = Jogged([(0.5, b"x"), (1.0, b"q")]).drive()
    read_only = jogged.whole.motors["left"].spec.read_only
    sent = [packet.frame for tick in jogged.ticks for packet in tick.outputs.packets]
    assert sent
    assert all(read_only(frame) for frame in sent)
    assert jogged.turned() == 0.0


def test_the_motor_alone_turns_and_only_while_a_key_is_held() -> None:
    jogged = Jogged([*held(b"\x1b[C", 0.5, 2.0), (3.0, b"q")]).drive()
    sent = [(t, c.velocity / 8.0) for t, c in jogged.obeyed() if isinstance(c, Velocity)]
    assert max(velocity for _, velocity in sent) == pytest.approx(1.0)  # 5 % of 20 rad/s
    assert all(velocity == 0.0 for t, velocity in sent if t < 0.5 * SECOND or t > 2.2 * SECOND)
    assert all(velocity > 0.0 for t, velocity in sent if 0.6 * SECOND < t < 2.0 * SECOND)
    assert jogged.turned() == pytest.approx(0.5 * CREEP_SHARE + 1.0 + REPEAT_HOLD / SECOND, abs=0.1)
    assert any(" → 1.00 rad/s | armed | " in text for text in jogged.shown)
    assert {command.motor for _, command in jogged.obeyed()} == {"left"}
    assert jogged.turned("right") == 0.0


def test_a_tap_backwards_is_a_small_turn_back() -> None:
    jogged = Jogged([(0.5, b"-"), (3.0, b"q")], speed=2.0).drive()
    assert jogged.turned() == pytest.approx(-2.0 * CREEP_SHARE * FIRST_HOLD / SECOND, abs=0.05)


@pytest.mark.sample(2)
@pytest.mark.parametrize("delay", [0.0, 0.1, 0.2, 2.0, 60.0])
def test_keys_that_come_late_turn_nothing(delay: float, caplog: pytest.LogCaptureFixture) -> None:
    """Held from 0.5 to 2.5 s; over a link of this delay there and back. 60 s: the terminal never answers."""
    come = min(1.0, delay / 2)
    jogged = Jogged([*held(b"+", 0.5 + come, 2.5 + come), (4.0, b"q")])
    jogged.delay = round(delay * SECOND)
    jogged.drive()
    turning = [t for t, c in jogged.obeyed() if isinstance(c, Velocity) and c.velocity]
    assert bool(turning) == (delay < 0.3)
    assert all(t < (2.5 + come) * SECOND + REPEAT_HOLD + 50 * MS for t in turning)
    slow = [one.getMessage() for one in caplog.records if "slow" in one.getMessage()]
    assert len(slow) == (delay > 0.3), slow


def test_a_link_that_becomes_slow_while_a_key_is_held_ends_the_motion() -> None:
    jogged = Jogged([*held(b"+", 0.5, 4.0), (5.0, b"q")])
    jogged.at[2 * SECOND] = lambda: setattr(jogged, "delay", SECOND)
    jogged.drive()
    turning = [t for t, c in jogged.obeyed() if isinstance(c, Velocity) and c.velocity]
    assert 2 * SECOND < max(turning) < 2 * SECOND + FRESH + 100 * MS


def test_within_a_multiplexer_which_answers_in_place_of_the_terminal_nothing_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMUX", "default,1,0")
    with TerminalProcess(tmp_path, "jog", "left", "bench") as jog:
        status, text = jog.end()
    assert status == 2
    assert "outside tmux" in text


@contextmanager
def hangup(handler: signal.Handlers) -> Iterator[None]:
    """Handle SIGHUP so while inside, whether the tests run under nohup or not."""
    before = signal.signal(signal.SIGHUP, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("end", [b"q", None, signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_however_it_ends_in_motion_the_stop_command_is_sent(end: bytes | signal.Signals | None) -> None:
    keys = held(b"+", 0.2, 1.0)
    if end is None or isinstance(end, bytes):
        jogged = Jogged([*keys, *([(1.0, end)] if end else [])])
    else:
        jogged = Jogged([*keys, (9.0, b"q")])
        number = end
        jogged.at[SECOND] = lambda: os.kill(os.getpid(), number)
    with hangup(signal.SIG_DFL), signals(jogged.made.leave):
        jogged.drive()
    assert jogged.clock.now() < 2 * SECOND
    assert isinstance(jogged.obeyed()[-1][1], Idle)
    assert jogged.made.gateway.still_armed() == []


def test_a_fault_is_shown_and_nothing_moves_again_by_itself() -> None:
    """The plug is out from 1.0 to 1.5 s, with the key held until 3 s; c at 3.5 s; a tap at 4 s."""
    jogged = Jogged([*held(b"+", 0.2, 3.0), (3.5, b"c"), (4.0, b"+"), (5.5, b"q")])
    jogged.at[SECOND] = lambda: jogged.twins.disconnect("left")
    jogged.at[3 * SECOND // 2] = lambda: jogged.twins.reconnect("left")
    jogged.drive()
    assert any("FAULT silent: no feedback for more than 100 ms" in text for text in jogged.shown)
    moving = [t for t, c in jogged.obeyed() if isinstance(c, Velocity) and c.velocity]
    assert [t for t in moving if 1.2 * SECOND < t < 4.0 * SECOND] == []
    assert any(t > 4.0 * SECOND for t in moving)
    assert not jogged.made.gateway.joints["left"].faults


def test_the_line_shows_the_feedback() -> None:
    jogged = Jogged([(0.5, b"+"), (0.9, b"+"), (1.0, b"q")]).drive()
    text = status_line(jogged.made.gateway.joints["left"], 0.0, jogged.clock.now())
    for part in ("left · 0.00 rad/s", "ready", " rad | ", " rad/s | ", " N·m", " A", " V", " °C", "ms ago"):
        assert part in text
    assert "no feedback yet" in jogged.shown[0]


def test_log_records_are_printed_above_the_line(caplog: pytest.LogCaptureFixture) -> None:
    stream = io.StringIO()
    line = TerminalLine(stream)
    with log_above(line):
        log.warning("left: %s", "fault")
    log.warning("after")
    assert stream.getvalue() == "WARNING: left: fault\n"
    assert [record.getMessage() for record in caplog.records] == ["after"]


def test_the_last_line_is_shown_though_the_terminal_was_still_at_the_one_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Defect: on a busy machine the last that was read of a motor was that it is armed."""
    text = io.StringIO()
    stream = Unblocked(text)
    line = TerminalLine(stream)
    line.draw("armed")
    with monkeypatch.context() as busy:
        busy.setattr(Unblocked, "idle", False)
        line.draw("slower")
        line.draw("ready")
        line.end()
    stream.close(60.0)
    assert text.getvalue() == "armed\nready\n"


# -- the terminal -----------------------------------------------------------------------------------


def test_the_terminal_is_restored_after_an_exception() -> None:
    master, terminal = pty.openpty()
    try:
        before = termios.tcgetattr(terminal)

        def fail() -> None:
            with raw_mode(terminal):
                inside = termios.tcgetattr(terminal)
                assert not inside[3] & (termios.ICANON | termios.ECHO)
                assert inside[3] & termios.ISIG  # Ctrl-C still interrupts
                os.write(master, b"\x1a\x1c\x13+")  # Ctrl-Z, Ctrl-\ and Ctrl-S are keys like any other
                select.select([terminal], [], [], 60)
                assert read_keys(terminal) == b"\x1a\x1c\x13+"
                assert read_keys(terminal) == b""
                os.write(master, b"rest")
                select.select([terminal], [], [], 60)  # what is on its way only then is not thrown away
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            fail()
        assert termios.tcgetattr(terminal) == before
        assert read_keys(terminal) == b""  # what was not read is not left to the shell
    finally:
        os.close(master)
    assert read_keys(terminal) is None  # hung up
    os.close(terminal)


@pytest.mark.parametrize("end", ["ctrl-c", "sigterm"])
def test_the_command_on_a_terminal(tmp_path: Path, end: str) -> None:
    with TerminalProcess(tmp_path, "jog", "left", "bench") as jog:
        jog.until("ready")
        assert not termios.tcgetattr(jog.terminal)[3] & termios.ECHO
        jog.until("→ 1.00 rad/s | armed", keys=b"\x1b[C")
        jog.until("· 0.00 rad/s | armed")
        if end == "sigterm":
            jog.send(signal.SIGTERM)
        else:
            jog.send_keys(b"\x03")
        status, text = jog.end()
        assert status == 0, text
        assert termios.tcgetattr(jog.terminal) == jog.before
    assert "· 0.00 rad/s | ready" in text.rpartition("| armed |")[2]
    assert "cut its supply" not in text


def test_a_terminal_that_is_closed_while_a_key_is_held_ends_it(tmp_path: Path) -> None:
    """The devices are another process here, which goes on and reports their states."""
    robot = tmp_path / "bench.toml"
    robot.write_text(patient(config.load_robot("bench").text))
    with Process(tmp_path, "twin", str(robot), "-v") as twin:
        bus = twin.find(r"--bus (\S+)")
        with TerminalProcess(tmp_path, "jog", "left", str(robot), "--bus", bus) as jog:
            jog.until("→ 1.00 rad/s | armed", keys=b"+")
            jog.hang_up()
            assert jog.end()[0] == 0
        _, text = twin.end(signal.SIGTERM)
    assert "left: armed" in text, text
    assert "left: ready" in text.partition("left: armed")[2], text


def test_under_nohup_a_closed_terminal_is_ignored() -> None:
    with hangup(signal.SIG_IGN), signals(lambda _: None):
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
