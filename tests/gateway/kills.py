"""Recordings whose process is killed: what must hold of them. Shared by the sample and the campaign."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from numpy.random import PCG64, Generator
from rosbags.highlevel import AnyReader

from gateway.recording import read_recording, tick_codec
from gateway.recording.recover import recover
from gateway.replay import replay_recording
from protocols.messages import MILLISECOND, Nanos
from tests.gateway.witness import Runs

PROMISE: Nanos = 100 * MILLISECOND


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one kill."""

    after: float
    """s from the first tick to the kill"""
    ticks: int
    """recovered"""
    lost: Nanos
    """Time between the last tick given to the recorder and the last one recovered."""
    queued: Nanos
    """Time that its threads waited for a processor, in the last 150 ms before the kill."""


def one_kill(runs: Runs, folder: Path, seed: int, number: int) -> Outcome:
    """Kill a run of the bench at a random time, and check what its recording promises."""
    generator = Generator(PCG64([seed, number]))
    after = float(generator.uniform(0.0, 0.6))
    speed = float(generator.uniform(-8.0, 8.0))
    file, whole = folder / f"{number}.mcap", folder / f"{number}.whole.mcap"
    killed = runs.kill("bench", file, after, f"velocity left {speed:.3f}")
    before = file.read_bytes()
    flushed = raw_ticks(file)
    if not flushed:
        return _checked(Outcome(after, 0, killed.last - killed.first, killed.queued))
    found = recover(file, whole)
    assert file.read_bytes() == before, "the input was changed"
    assert read_by_rosbags(whole, opened=number % 5 == 0) == flushed, (
        "not every flushed tick came back byte for byte"
    )
    assert (found.ticks, found.gaps) == (len(flushed), [])
    last = [tick.now for tick in read_recording(whole).ticks][-1]
    _assert_replays(whole)
    file.unlink()
    whole.unlink()
    return _checked(Outcome(after, len(flushed), killed.last - last, killed.queued))


def _checked(outcome: Outcome) -> Outcome:
    """Check that at most 100 ms are lost, and the time that its threads waited for a processor."""
    lost, queued = outcome.lost / MILLISECOND, outcome.queued / MILLISECOND
    assert outcome.lost <= PROMISE + outcome.queued, (
        f"{lost:.1f} ms are lost, and its threads waited for a processor only {queued:.1f} ms of it"
    )
    return outcome


def raw_ticks(path: Path) -> list[bytes]:
    """Return every tick in a file, as bytes, by an independent reader."""
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
    """Return every tick in a file, as bytes; with `opened`, decode every message of every topic."""
    ticks: list[bytes] = []
    with AnyReader([path]) as reader:
        assert {c.topic for c in reader.connections} >= {tick_codec.TOPIC, "/diagnostics"}
        for connection, _, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype) if opened else raw
            assert message is not None
            if connection.topic == tick_codec.TOPIC:
                ticks.append(bytes(raw))
    return ticks


def _assert_replays(path: Path) -> None:
    """Assert that a recording replays to the same bytes, as far as `gateway replay` can compare."""
    comparison = replay_recording(read_recording(path))
    assert not comparison.differences, comparison.text()
    assert not comparison.unread
    assert not comparison.left_over
    # A kill in the very first ticks may leave nothing that was sent.
    assert comparison.ok or not comparison.packets, comparison.text()


def summary(outcomes: list[Outcome]) -> str:
    """Return the outcomes as text."""
    lost = sorted(outcome.lost / MILLISECOND for outcome in outcomes)
    ticks = sum(outcome.ticks for outcome in outcomes)
    span = sum(outcome.after for outcome in outcomes)
    over = sum(outcome.lost > PROMISE for outcome in outcomes)
    busy = f" ({over} of them over 100 ms, the machine being busy)" if over else ""
    return (
        f"{len(outcomes)} kills over {span:.0f} s: {ticks} ticks recovered; lost before the kill: "
        f"median {lost[len(lost) // 2]:.1f} ms, at most {lost[-1]:.1f} ms{busy}"
    )
