"""What must hold of a recording whose process was killed. Shared by the sample and the campaign."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from numpy.random import PCG64, Generator
from rosbags.highlevel import AnyReader

from gateway import config
from gateway.core.robot import Robot
from gateway.core.step import Gateway, decoder_of
from gateway.recording import read, tick_codec
from gateway.recording.recover import salvage
from gateway.replay.compare import compare
from protocols.messages import MILLISECOND, Nanos
from tests.gateway.witness import Runs

PROMISE: Nanos = 100 * MILLISECOND


@dataclass(frozen=True, slots=True)
class Outcome:
    """Of one kill."""

    after: float
    """s from the first tick to the kill"""
    ticks: int
    """that were recovered"""
    lost: Nanos
    """Time between the last tick handed over and the last one recovered."""
    queued: Nanos
    """How long the recorder had to wait for a processor, in the last 150 ms before the kill."""


def one_kill(runs: Runs, folder: Path, seed: int, number: int) -> Outcome:
    """Kill a run of the bench at a moment drawn from the seed, and hold its recording to the promises."""
    generator = Generator(PCG64([seed, number]))
    after = float(generator.uniform(0.0, 0.6))
    speed = float(generator.uniform(-8.0, 8.0))
    file, whole = folder / f"{number}.mcap", folder / f"{number}.whole.mcap"
    killed = runs.kill("bench", file, after, f"velocity left {speed:.3f}")
    before = file.read_bytes()
    flushed = raw_ticks(file)
    if not flushed:
        return _judged(Outcome(after, 0, killed.last - killed.first, killed.queued))
    found = salvage(file, whole)
    assert file.read_bytes() == before, "the input was changed"
    assert read_by_rosbags(whole, opened=number % 5 == 0) == flushed, (
        "not every flushed tick came back byte for byte"
    )
    assert (found.ticks, found.gaps) == (len(flushed), [])
    last = [tick.now for tick in read(whole).ticks][-1]
    replays(whole)
    file.unlink()
    whole.unlink()
    return _judged(Outcome(after, len(flushed), killed.last - last, killed.queued))


def _judged(outcome: Outcome) -> Outcome:
    """100 ms; and what the machine had the recorder wait for a processor, of which it can do nothing."""
    lost, queued = outcome.lost / MILLISECOND, outcome.queued / MILLISECOND
    assert outcome.lost <= PROMISE + outcome.queued, (
        f"{lost:.1f} ms are lost, and the recorder had to wait for a processor only {queued:.1f} ms of it"
    )
    return outcome


def raw_ticks(path: Path) -> list[bytes]:
    """Every tick that stands in a file, as bytes, by a reader that is not ours."""
    ticks: list[bytes] = []
    topics: dict[int, str] = {}
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, record_size_limit=path.stat().st_size).records:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message) and topics[record.channel_id] == tick_codec.TOPIC:
                    ticks.append(record.data)
        except (McapError, ValueError, RuntimeError):  # where it was cut
            pass
    return ticks


def read_by_rosbags(path: Path, *, opened: bool = True) -> list[bytes]:
    """Every tick in a file, as bytes; with `opened`, every message of every topic is looked into."""
    ticks: list[bytes] = []
    with AnyReader([path]) as reader:
        assert {c.topic for c in reader.connections} >= {tick_codec.TOPIC, "/diagnostics"}
        for connection, _, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype) if opened else raw
            assert message is not None
            if connection.topic == tick_codec.TOPIC:
                ticks.append(bytes(raw))
    return ticks


def replays(path: Path) -> None:
    """To the same bytes, as `gateway replay` judges it."""
    recording = read(path)
    robot = _robot(recording.robot_text)
    gateway = Gateway(robot)
    verdict = compare(
        recording, gateway.step, gateway.belief, lambda bus: decoder_of(robot, bus), buses=robot.buses
    )
    assert not verdict.differences, verdict.text()
    assert not verdict.unread
    assert not verdict.left_over
    # A kill in the very first ticks may leave nothing that was sent.
    assert verdict.ok or not verdict.packets, verdict.text()


@cache
def _robot(text: str) -> Robot:
    return config.parse_robot(text, "robot.toml")


def summary(outcomes: list[Outcome]) -> str:
    """For a person."""
    lost = sorted(outcome.lost / MILLISECOND for outcome in outcomes)
    ticks = sum(outcome.ticks for outcome in outcomes)
    span = sum(outcome.after for outcome in outcomes)
    over = sum(outcome.lost > PROMISE for outcome in outcomes)
    busy = f" ({over} of them over 100 ms, the machine being busy)" if over else ""
    return (
        f"{len(outcomes)} kills over {span:.0f} s: {ticks} ticks recovered; lost before the kill: "
        f"median {lost[len(lost) // 2]:.1f} ms, at most {lost[-1]:.1f} ms{busy}"
    )
