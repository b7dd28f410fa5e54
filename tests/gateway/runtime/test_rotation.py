"""A recording in several files: no tick is lost between them, and of a ring stays what a fault needs."""

from __future__ import annotations

from argparse import ArgumentTypeError
from pathlib import Path

import pytest

from gateway.cli.run import rotated
from gateway.core.tick import Tick
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.runtime.rotation import Rotation
from gateway.runtime.session import open_session
from protocols.messages import SECOND, Velocity


def run(file: Path, rotation: Rotation, seconds: float, fault_at: float = 1e9) -> int:
    """Run a bench, one motor of which is unplugged at a time [s] while it turns; the number of ticks."""
    asked = False
    with open_session("bench", simulated=True, record=file) as session:
        session.rotate_recording(rotation)
        for tick in session.run(seconds):
            if tick.now >= SECOND and not asked:
                asked = True
                session.submit(*(Velocity(motor, 1.0) for motor in session.robot.motors))
            if tick.now >= fault_at * SECOND and session.twins is not None:
                fault_at = 1e9
                session.twins.disconnect(next(iter(session.robot.motors)))
    return session.stats.ticks


def numbers(files: list[Path]) -> list[list[int]]:
    """The numbers of the ticks in each file, all of which are whole."""
    return [[tick.number for tick in each] for each in ticks_of(files)]


def ticks_of(files: list[Path]) -> list[list[Tick]]:
    """The ticks in each file."""
    recordings = [read_recording(file) for file in files]
    assert all(each.whole for each in recordings)
    return [list(each.ticks) for each in recordings]


def test_files_follow_each_other_without_a_gap(tmp_path: Path) -> None:
    ticks = run(tmp_path / "a.mcap", Rotation(seconds=2.0), 5.0)
    files = [tmp_path / f"a{part}.mcap" for part in ("", "-0002", "-0003")]
    assert sorted(tmp_path.iterdir()) == sorted(files)
    found = ticks_of(files)
    assert [tick.number for each in found for tick in each] == list(range(ticks))
    assert [each[0].now for each in found] == [0, 2 * SECOND, 4 * SECOND]


def test_a_file_is_no_larger_than_asked_for_but_for_a_second(tmp_path: Path) -> None:
    ticks = run(tmp_path / "a.mcap", Rotation(size=100_000), 5.0)
    files = sorted(tmp_path.iterdir(), key=lambda file: (len(file.name), file.name))
    assert len(files) > 1
    assert [number for each in numbers(files) for number in each] == list(range(ticks))


def test_a_ring_keeps_the_last_seconds(tmp_path: Path) -> None:
    ticks = run(tmp_path / "a.mcap", Rotation(keep=4.0), 10.0)
    files = sorted(tmp_path.iterdir())
    kept = [tick for each in ticks_of(files) for tick in each]
    assert [tick.number for tick in kept] == list(range(kept[0].number, ticks))
    assert 4 * SECOND <= 10 * SECOND - kept[0].now <= 6 * SECOND


def test_what_was_before_a_fault_stays(tmp_path: Path) -> None:
    run(tmp_path / "a.mcap", Rotation(keep=4.0), 12.0, fault_at=4.5)
    found = {tick.now // SECOND for each in ticks_of(sorted(tmp_path.iterdir())) for tick in each}
    assert found >= {1, 2, 3, 4}, "before the fault"
    assert found.isdisjoint({5, 6}), "between the fault and the ring"
    assert found >= {9, 10, 11}, "the ring"


def test_without_a_recording_there_is_nothing_to_rotate() -> None:
    with open_session("bench", simulated=True) as session, pytest.raises(UserError, match="nothing is recor"):
        session.rotate_recording(Rotation(seconds=1.0))


def test_where_the_next_file_cannot_be_made_the_present_one_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "a-0002.mcap").write_text("somebody's")
    ticks = run(tmp_path / "a.mcap", Rotation(seconds=1.0), 2.5)
    assert numbers([tmp_path / "a.mcap"]) == [list(range(ticks))]
    assert (tmp_path / "a-0002.mcap").read_text() == "somebody's"
    assert "goes on in the same file" in caplog.text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("10min", Rotation(seconds=600.0)),
        ("1.5h", Rotation(seconds=5400.0)),
        ("500MB", Rotation(size=500_000_000)),
        ("2 GB", Rotation(size=2_000_000_000)),
    ],
)
def test_rotate_is_a_time_or_a_size(text: str, expected: Rotation) -> None:
    assert rotated(text) == expected


@pytest.mark.parametrize("text", ["", "10", "min", "-3min", "0s", "10 parsecs", "nanh", "1e9h"])
def test_anything_else_is_told(text: str) -> None:
    with pytest.raises(ArgumentTypeError, match="expected a number and one of s, min, h, kB, MB, GB"):
        rotated(text)
