"""The player: whatever is played before, the outputs and the state are those of a straight replay."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import wraps
from pathlib import Path
from random import Random
from typing import Any

import pytest

import gateway as gw
from gateway import config
from gateway.core.step import Gateway
from gateway.core.tick import Outputs
from gateway.recording import Recording, environment, read_recording
from gateway.replay import Playback, Player, keyframes, replay_recording
from protocols.messages import MILLISECOND, SECOND
from tests.gateway.recording.hostile import KINDS, Forge
from tests.gateway.replay.state_digest import constants_of, digest
from tests.sampled import sampled

SECONDS = 1.5
ROBOTS = ("bench", "diffbot_cia402", "diffbot_moteus", "diffbot_zlac8015d")
"""Registers and messages on CAN, CANopen with PDOs, CAN FD, and CANopen without; the rest in tests/prove."""


def record(name: str, path: Path, seconds: float = SECONDS) -> Recording:
    robot = gw.load_robot(name)
    with gw.open_session(robot, simulated=True, record=path) as session:
        for tick in session.run(seconds=seconds):
            if tick.number == 60:
                session.submit(*moving(robot))
    return read_recording(path)


def moving(robot: gw.Robot) -> list[Any]:
    for goal in ([gw.Goal(1.0, 0.3)], [gw.Velocity(name, 1.0) for name in robot.motors]):
        if not any(config.cannot(one, robot) for one in goal):
            return list(goal)
    return []


class Straight:
    """A straight replay: all outputs, and the state after some of the ticks."""

    def __init__(self, recording: Recording, states_after: Collection[int] = ()) -> None:
        gateway = Gateway(gw.parse_robot(recording.robot_text, "robot.toml"))
        constants = constants_of(gateway)
        self.times: list[int] = []
        self.outputs: list[Outputs] = []
        self.states: dict[int, str] = {}
        for tick in recording.ticks:
            self.times.append(tick.now)
            self.outputs.append(gateway.step(tick.now, tick.inputs))
            if len(self.times) in states_after:
                self.states[len(self.times)] = digest(gateway, constants)

    def number(self, t: int) -> int:
        """Number of ticks up to a time, at least one."""
        return max(1, sum(now <= t for now in self.times))


def walk(played: Player, seed: int, moves: int) -> Iterator[tuple[int, Outputs | None]]:
    """Seek, step, advance, pause and change the rate at random; yield where it is, and the outputs there."""
    random = Random(seed)
    clock, playback = 0, Playback(played.start, 0)
    for _ in range(moves):
        clock += random.randrange(200 * MILLISECOND)
        kind = random.choice(["seek", "seek", "step", "back", "play", "pause", "rate", "prepare"])
        if kind == "seek":
            playback = playback.changed(
                clock, position=random.randrange(played.start - 1, played.end + SECOND)
            )
            played.seek(playback.position)
            while not played.advance(random.choice((1, 30, 1000))):
                yield position(played)
            assert played.now <= max(played.start, playback.position)
        elif kind in ("step", "back"):
            at = played._reading.played
            steps = random.randrange(1, 40) * (1 if kind == "step" else -1)
            played.step(steps)
            while not played.advance(random.choice((1, 30, 1000))):
                yield position(played)
            ended = steps > 0 and played._ahead.following is None
            assert played._reading.played == max(1, at + steps) or ended
        elif kind == "prepare":
            played.prepare(random.randrange(100))
        else:
            rate = random.choice((0.1, 1.0, 4.0)) if kind == "rate" else None
            playback = playback.changed(clock, position=played.now, rate=rate, playing=kind != "pause")
            for _ in range(random.randrange(60)):
                clock += 5 * MILLISECOND
                played.advance(random.choice((1, 3)), playback.target(clock))
                yield position(played)
        yield position(played)


def go_by(played: Player, ticks: int) -> None:
    played.step(ticks)
    while not played.advance(7):
        pass


def position(played: Player) -> tuple[int, Outputs | None]:
    return played._reading.played, played.outputs


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keyframes, "SPACING", 50)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record("bench", tmp_path_factory.mktemp("bench") / "a.mcap")


def plays_as_a_straight_replay(recording: Recording, cache: Path, seed: int, moves: int = 25) -> None:
    with Player(recording, cache=cache) as played:
        constants = played._codec.constants
        seen, states = [], {}
        for at, outputs in walk(played, seed, moves):
            seen.append((at, outputs))
            if len(seen) % 40 == 0 and at:
                states[at] = digest(played.gateway, constants)
        states[played._reading.played] = digest(played.gateway, constants)
        straight = Straight(recording, set(states))
        for at, outputs in seen:
            assert outputs == (straight.outputs[at - 1] if at else None), f"tick {at}, seed {seed}"
        assert {at: straight.states[at] for at in states if at} == {a: s for a, s in states.items() if a}
        assert len(played._frames) > 2
        while played.prepare(1000) < 1:
            pass
        assert played.comparison == replay_recording(recording)


@pytest.mark.sample(1)
@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("name", sampled(ROBOTS, 2))
def test_it_plays_as_a_straight_replay(name: str, tmp_path: Path) -> None:
    recording = record(name, tmp_path / "a.mcap")
    plays_as_a_straight_replay(recording, tmp_path / "cache", seed=len(name))


@pytest.mark.usefixtures("often")
def test_the_next_player_goes_on_with_the_keyframes_of_the_last(bench: Recording, tmp_path: Path) -> None:
    with Player(bench, cache=tmp_path / "cache") as played:
        assert 0.3 < played.prepare(170) < 1
    with Player(bench, cache=tmp_path / "cache") as played:
        assert played._ahead.played == 150
        while played.prepare(1000) < 1:
            pass
        assert played.comparison == replay_recording(bench)
    with Player(bench, cache=tmp_path / "cache") as played:
        assert played.prepare(0) == 1
        assert played.comparison == replay_recording(bench)
        played.seek(played.end)
        assert played.advance(0)
        assert played.now == played.end
        straight = Straight(bench)
        assert position(played) == (len(straight.times), straight.outputs[-1])
        go_by(played, -2)
        assert position(played) == (len(straight.times) - 2, straight.outputs[-3])


@pytest.mark.usefixtures("often")
def test_keyframes_of_other_code_or_another_robot_are_not_used(
    bench: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def compared(robot: gw.Robot | None = None) -> int:
        with Player(bench, robot, cache=tmp_path / "cache") as played:
            before = played._ahead.played
            played.prepare(120)
            return before

    assert (compared(), compared()) == (0, 100)
    other = gw.parse_robot(bench.robot_text.replace("velocity = 20.0", "velocity = 0.1"), "robot.toml")
    assert other.text != bench.robot_text
    assert compared(other) == 0
    monkeypatch.setattr(environment, "sources", lambda: "other sources")
    assert compared() == 0
    monkeypatch.undo()
    assert compared() == 200


@pytest.mark.usefixtures("often")
def test_a_damaged_keyframe_is_not_used(bench: Recording, tmp_path: Path) -> None:
    with Player(bench, cache=tmp_path / "cache") as played:
        while played.prepare(1000) < 1:
            pass
    frames = sorted((tmp_path / "cache").glob("*/*.key"))
    assert len(frames) > 3
    for number, path in enumerate(frames):
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data if number % 2 else b"")
    straight = Straight(bench)
    with Player(bench, cache=tmp_path / "cache") as played:
        assert (played._ahead.played, len(played._frames)) == (0, 0)
        for t in (played.end, played.end // 2, played.start):
            played.seek(t)
            while not played.advance(100):
                pass
            at = straight.number(t)
            assert played.now == straight.times[at - 1]
            assert played.outputs == straight.outputs[at - 1]


@pytest.mark.usefixtures("often")
def test_a_cut_recording_is_played_to_its_cut(bench: Recording, tmp_path: Path) -> None:
    data = bench.path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    cut = read_recording(tmp_path / "cut.mcap")
    times = [tick.now for tick in cut.ticks]
    with Player(cut, cache=tmp_path / "cache") as played:
        assert (played.start, played.end) == (times[0], times[-1])
        played.seek(times[-1] + SECOND)
        while not played.advance(50):
            pass
        assert played.now == times[-1]
        assert [each.kind for each in played.differences] == ["recording"]
        assert "it was cut" in played.differences[0].text
        go_by(played, 1)
        assert played.now == times[-1]


def test_a_damaged_recording_is_played_to_its_damage(bench: Recording, tmp_path: Path) -> None:
    data = bytearray(bench.path.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "damaged.mcap").write_bytes(data)
    damaged = read_recording(tmp_path / "damaged.mcap")
    with Player(damaged, cache=tmp_path / "cache") as played:
        played.seek(played.end)
        while not played.advance(1000):
            pass
        assert played.comparison == replay_recording(damaged)
        assert played.now == played.end < bench.end


def test_the_first_difference_is_known_when_it_is_reached(bench: Recording, tmp_path: Path) -> None:
    other = gw.parse_robot(bench.robot_text.replace("velocity = 20.0", "velocity = 0.1"), "robot.toml")
    expected = replay_recording(bench, other)
    first = expected.first
    assert first is not None
    assert first.tick > 50
    with Player(bench, other, cache=tmp_path / "cache") as played:
        go_by(played, first.tick - 2)
        assert not played.differences
        go_by(played, 4)
        assert played.differences[0] == first
        while played.prepare(1000) < 1:
            pass
        assert played.comparison == expected


def test_code_that_fails_ends_the_playing_there(
    bench: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = Gateway.step

    def failing(self: Gateway, now: int, inputs: gw.Inputs) -> Outputs:
        if now > bench.end // 2:
            raise ValueError("no more")
        return step(self, now, inputs)

    monkeypatch.setattr(Gateway, "step", wraps(step)(failing))
    with Player(bench, cache=tmp_path / "cache") as played:
        played.seek(played.end)
        while not played.advance(100):
            pass
        assert played.now == max(tick.now for tick in bench.ticks if tick.now <= bench.end // 2)
        assert [each.text for each in played.differences] == ["the code of today fails: ValueError: no more"]
        go_by(played, -1)
        go_by(played, 5)
        assert len(played.differences) == 1


def test_work_is_bounded_by_the_budget(
    bench: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = 0
    step = Gateway.step

    def counted(self: Gateway, now: int, inputs: gw.Inputs) -> Outputs:
        nonlocal steps
        steps += 1
        return step(self, now, inputs)

    monkeypatch.setattr(Gateway, "step", wraps(step)(counted))
    with Player(bench, cache=tmp_path / "cache") as played:
        played.seek(played.end)
        assert steps == 0
        for budget in (0, 1, 7, 40):
            steps = 0
            assert not played.advance(budget)
            assert steps == budget
        steps = 0
        played.prepare(9)
        assert steps == 9
        while not played.advance(100):
            pass
        for ticks in (-1, -150, 140):
            steps = 0
            played.step(ticks)
            assert steps == 0
            while not played.advance(10):
                assert steps == 10
                steps = 0
            assert steps <= 10


def test_nothing_is_played_of_a_recording_without_ticks(tmp_path: Path) -> None:
    with gw.open_session("bench", simulated=True, record=tmp_path / "a.mcap"):
        pass
    with Player(read_recording(tmp_path / "a.mcap"), cache=tmp_path / "cache") as played:
        for begin, value in ((played.step, 3), (played.step, -3), (played.seek, 5)):
            begin(value)
            assert played.advance(3)
        assert (played.tick, played.outputs, played.now, played.prepare(1)) == (None, None, 0, 1.0)
        assert "nothing was compared" in played.comparison.text()


PLAYBACKS = [  # changes at a time of the clock, in s, and what is due at 10 s
    ([], 3.0),
    ([(2, {"playing": True})], 3.0 + 8),
    ([(2, {"playing": True}), (4, {"playing": False})], 3.0 + 2),
    ([(2, {"playing": True}), (4, {"rate": 0.5})], 3.0 + 2 + 3),
    ([(2, {"rate": -1.0}), (4, {"playing": True})], 3.0 - 6),
    ([(2, {"playing": True}), (9, {"position": 50 * SECOND})], 50.0 + 1),
]


@pytest.mark.parametrize(("changes", "due"), PLAYBACKS)
def test_playback(changes: list[tuple[int, dict[str, Any]]], due: float) -> None:
    playback = Playback(3 * SECOND, 0)
    for at, change in changes:
        playback = playback.changed(at * SECOND, **change)
    assert playback.target(10 * SECOND) == round(due * SECOND)


@pytest.mark.sample(3)
@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("number", range(len(KINDS)))
def test_recordings_that_were_made_to_do_harm_are_played_as_they_are_replayed(
    number: int, tmp_path: Path
) -> None:
    forge = Forge(tmp_path, 5)
    for each in range(number, 4 * len(KINDS), len(KINDS)):
        try:
            recording = read_recording(forge.make(each))
            expected = replay_recording(recording)
        except gw.GatewayError:
            continue
        with Player(recording, cache=tmp_path / "cache") as played:
            played.seek((played.start + played.end) // 2)
            played.advance(20)
            go_by(played, 5)
            go_by(played, -3)
            while played.prepare(1000) < 1:
                pass
            assert played.comparison == expected
