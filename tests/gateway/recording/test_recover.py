"""`gateway recover`: all that was written comes back byte for byte, wherever the file was cut or damaged."""

from __future__ import annotations

import hashlib
import random
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.highlevel import AnyReader

from gateway.cli.main import main
from gateway.errors import RecordingError
from gateway.recording import read_recording, tick_codec
from gateway.recording.layout import RECOVERED
from gateway.recording.recover import is_whole, recover
from protocols.messages import seconds
from tests.gateway import little
from tests.gateway.kills import raw_ticks, read_by_rosbags

SEED = 7


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """40 ticks in five chunks."""
    path = tmp_path / "a.mcap"
    little.record_in_chunks(path, 40)
    return path


def chunks(path: Path) -> list[tuple[int, int, list[bytes]]]:
    """Start, end and ticks of each chunk, by a reader that is not ours."""
    found = []
    with path.open("rb") as file:
        reader = StreamReader(file, emit_chunks=True)
        topics: dict[int, str] = {}
        for record in reader.records:
            note(topics, record)
            if isinstance(record, Chunk):
                end = file.tell()
                size = 9 + 8 + 8 + 8 + 4 + 4 + 4 + 8 + len(record.data)
                ticks = [
                    r.data  # type: ignore[attr-defined]  # messages alone have a channel
                    for r in breakup_chunk(record)
                    if topics.get(getattr(r, "channel_id", 0)) == tick_codec.TOPIC
                ]
                found.append((end - size, end, ticks))
    return found


def note(topics: dict[int, str], record: McapRecord) -> None:
    if topic := getattr(record, "topic", ""):
        topics[record.id] = topic  # type: ignore[attr-defined]  # it is a channel


def recovered_ticks(path: Path, target: Path) -> list[bytes]:
    """The ticks that come back, as bytes; the file that they come back in must be whole."""
    before = hashlib.sha256(path.read_bytes()).digest()
    found = recover(path, target)
    assert hashlib.sha256(path.read_bytes()).digest() == before, "the input was changed"
    assert not target.with_name(target.name + ".part").exists()
    if not found.ticks:
        assert not target.exists()
        return []
    made = read_recording(target)
    assert made.whole
    assert made.indexed == found.ticks
    assert is_whole(target)
    ticks = raw_ticks(target)
    target.unlink()
    return ticks


# -- cut off -----------------------------------------------------------------------------------


def places(path: Path, count: int, seed: int) -> list[int]:
    """Where to cut: all about the ends of chunks, and anywhere."""
    size = path.stat().st_size
    near = [end + d for start, end, _ in chunks(path) for end in (start, end) for d in (-1, 0, 1)]
    anywhere = random.Random(seed).sample(range(size), count)
    return sorted({*near, *anywhere, *range(12), size - 1})


def test_all_whole_ticks_before_a_cut_come_back(recorded: Path, tmp_path: Path) -> None:
    whole, cut = recorded.read_bytes(), tmp_path / "cut.mcap"
    parts = chunks(recorded)
    assert len(parts) == 5
    seen = set()
    for size in places(recorded, 60, SEED):
        cut.write_bytes(whole[:size])
        expected = [tick for _, end, ticks in parts if end <= size for tick in ticks]
        try:
            found = recovered_ticks(cut, tmp_path / "out.mcap")
        except RecordingError:  # so early that it is not known for a recording
            found = []
        assert found == expected, f"cut at byte {size}"
        seen.add(len(found))
    assert {0, 40} < seen


def test_every_view_comes_back_too(recorded: Path, tmp_path: Path) -> None:
    data = recorded.read_bytes()
    recorded.write_bytes(data[: chunks(recorded)[2][1]])
    steps = list(read_recording(recorded).steps)
    recover(recorded, tmp_path / "out.mcap")
    again = list(read_recording(tmp_path / "out.mcap").steps)
    assert [(s.tick, s.views) for s in again] == [(s.tick, s.views) for s in steps]
    with AnyReader([tmp_path / "out.mcap"]) as reader:
        topics = {c.topic: c.msgcount for c in reader.connections}
        qos = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}  # type: ignore[union-attr]
    assert topics["/gateway/tick"] == len(steps)
    assert {"/odom", "/tf", "/tf_static", "/map", "/diagnostics", "/can0/from_can_bus"} < set(topics)
    assert qos["/map"], "late subscribers are still offered it"
    assert read_by_rosbags(tmp_path / "out.mcap") == raw_ticks(recorded)


def test_a_recovered_file_names_its_source(recorded: Path, tmp_path: Path) -> None:
    recorded.write_bytes(recorded.read_bytes()[: chunks(recorded)[1][1] + 100])
    recover(recorded, tmp_path / "out.mcap")
    with (tmp_path / "out.mcap").open("rb") as file:
        reported = {m.name: m.metadata for m in make_reader(file).iter_metadata()}
    assert reported[RECOVERED]["from"] == "a.mcap"
    assert "the file was not closed" in reported[RECOVERED]["summary"]
    assert read_recording(tmp_path / "out.mcap").facts == read_recording(recorded).facts


# -- damaged -----------------------------------------------------------------------------------


def test_a_torn_chunk_in_the_middle_costs_its_own_ticks(recorded: Path, tmp_path: Path) -> None:
    parts = chunks(recorded)
    start, end, _ = parts[1]
    data = bytearray(recorded.read_bytes())
    data[(start + end) // 2] ^= 0x40
    recorded.write_bytes(data)
    found = recover(recorded, tmp_path / "out.mcap")
    assert raw_ticks(tmp_path / "out.mcap") == [t for part in (0, 2, 3, 4) for t in parts[part][2]]
    first = len(parts[0][2])
    assert found.gaps == [(first, first + len(parts[1][2]) - 1)]
    assert [(d.at, d.at + d.size) for d in found.damages] == [(start, end)]


def test_zeros_in_the_middle_are_stepped_over(recorded: Path, tmp_path: Path) -> None:
    """What a file system may leave of a page after a loss of power."""
    parts = chunks(recorded)
    start = parts[1][0]
    data = bytearray(recorded.read_bytes())
    data[start - 30 : start + 300] = bytes(330)
    recorded.write_bytes(data)
    recover(recorded, tmp_path / "out.mcap")
    assert raw_ticks(tmp_path / "out.mcap") == [t for part in (0, 2, 3, 4) for t in parts[part][2]]


def test_a_file_without_its_index_loses_nothing(recorded: Path, tmp_path: Path) -> None:
    ticks = raw_ticks(recorded)
    data = recorded.read_bytes()
    recorded.write_bytes(data[: chunks(recorded)[-1][1]])
    assert recovered_ticks(recorded, tmp_path / "out.mcap") == ticks
    damaged = bytearray(data)
    damaged[-40] ^= 1
    recorded.write_bytes(damaged)
    assert not is_whole(recorded)
    assert recovered_ticks(recorded, tmp_path / "out.mcap") == ticks


def test_any_flipped_bit_gives_the_truth_or_a_sentence(recorded: Path, tmp_path: Path) -> None:
    whole, ticks = recorded.read_bytes(), raw_ticks(recorded)
    generator = random.Random(SEED)
    came_back = 0
    for _ in range(120):
        at, bit = generator.randrange(len(whole)), generator.randrange(8)
        data = bytearray(whole)
        data[at] ^= 1 << bit
        recorded.write_bytes(data)
        try:
            found = recovered_ticks(recorded, tmp_path / "out.mcap")
        except RecordingError:
            continue
        assert set(found) <= set(ticks), f"bit {bit} of byte {at}: a tick that was never written"
        came_back += len(found) >= 20
    assert came_back > 60


@pytest.mark.parametrize("length", [2**62, 2**40, 2**31])
def test_no_length_is_trusted(recorded: Path, tmp_path: Path, length: int) -> None:
    parts = chunks(recorded)
    data = bytearray(recorded.read_bytes())
    data[parts[1][0] + 1 : parts[1][0] + 9] = length.to_bytes(8, "little")
    recorded.write_bytes(data)
    assert recovered_ticks(recorded, tmp_path / "out.mcap") == [t for p in (0, 2, 3, 4) for t in parts[p][2]]


# -- the command -------------------------------------------------------------------------------


def test_the_command_recovers_and_reports_what_was_lost(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = chunks(recorded)
    data = recorded.read_bytes()[: parts[2][1] + 50]
    recorded.write_bytes(data)
    assert main(["recover", str(recorded)]) == 0
    output = capsys.readouterr().out
    ticks = [tick for _, _, ticks in parts[:3] for tick in ticks]
    last = seconds((len(ticks) - 1) * little.PERIOD)
    # Behind the chunk stand its message indexes, one of them cut.
    assert f"to {len(data)} of {len(data)}: cut off" in output
    assert f"{len(ticks)} ticks, 0 to {len(ticks) - 1}, over {last:.3f} s" in output
    assert f"the last tick is {len(ticks) - 1}, at {last:.6f} s of its clock" in output
    assert "the file was not closed" in output
    assert raw_ticks(tmp_path / "a.recovered.mcap") == ticks
    assert main(["recover", str(recorded)]) == 2
    assert "exists already; it is never overwritten" in capsys.readouterr().err


def test_a_whole_file_is_left_alone(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["recover", str(recorded)]) == 0
    assert "is whole: nothing to recover, nothing written" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
    assert main(["recover", str(recorded), "-o", str(tmp_path / "b.mcap")]) == 0
    assert raw_ticks(tmp_path / "b.mcap") == raw_ticks(recorded)


def test_nothing_recovered_is_no_success(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded.write_bytes(recorded.read_bytes()[: chunks(recorded)[0][1] - 1])
    assert main(["recover", str(recorded)]) == 1
    assert "nothing could be recovered" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_a_place_that_cannot_be_written(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["recover", str(recorded), "-o", "/proc/none/b.mcap"]) == 2
    assert "cannot be written: No such file or directory" in capsys.readouterr().err
    assert main(["recover", "/proc/none/a.mcap"]) == 2
