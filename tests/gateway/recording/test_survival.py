"""Recorded data survive, and what cannot be recorded is counted and reported while the robot continues.

The kills are real and in wall time (a kill in simulated time proves nothing); `./go prove` does 200 more.
Disks that are full, slow or broken are streams that behave so, and a limit on the size of files."""

from __future__ import annotations

import errno
import logging
import os
import signal
import threading
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from gateway import config
from gateway.recording import Recorder, read_recording, writer
from gateway.recording.recover import is_whole
from gateway.runtime.session import open_session
from gateway.runtime.status import status_text
from protocols.messages import SECOND, Velocity
from tests.gateway import kills, little
from tests.gateway.processes import PATIENCE, Process, eventually
from tests.gateway.recording.test_recording import child, drained
from tests.gateway.rig import BENCH, WATCHED, Rig
from tests.gateway.witness import Runs

SEED = 20261121


# -- kills -------------------------------------------------------------------------------------


def test_twenty_kills_lose_at_most_100_ms(tmp_path: Path) -> None:
    with Runs() as runs:
        outcomes = [kills.one_kill(runs, tmp_path, SEED, number) for number in range(20)]
    print(f"seed {SEED}: {kills.summary(outcomes)}")
    assert any(outcome.ticks for outcome in outcomes)


def test_a_killed_command_its_recovery_and_its_replay(path: Path, tmp_path: Path) -> None:
    """As a person does it: three commands."""
    with Process(tmp_path, "run", "bench", "--record", str(path)) as run:
        run.send_line("velocity left 6")

        def written() -> bool:
            run.look()
            return path.exists() and path.stat().st_size > 30_000

        assert eventually(written)
        assert run.end(signal.SIGKILL)[0] == -signal.SIGKILL
    for command, name, expected in (
        ("recover", "a.mcap", "the file was not closed"),
        ("replay", "a.recovered.mcap", "the same, byte for byte"),
    ):
        with Process(tmp_path, command, str(tmp_path / name)) as process:
            status, text = process.end()
            assert status == 0, text
            assert expected in text


@pytest.mark.parametrize(("text", "stops"), [(WATCHED, True), (BENCH, False)])
def test_when_the_host_falls_silent_a_watchdog_stops_the_motor(text: str, stops: bool) -> None:
    """A killed host sends no stop command, and nothing else."""
    rig = Rig(text)
    rig.run(1.0)
    rig.run(2.0, Velocity("left", 6.0))
    assert rig.velocity("left") == pytest.approx(6.0, abs=0.5)
    killed = rig.clock.now()
    rig.world.advance(killed + SECOND // 10)
    assert rig.velocity("left") > 5.0, "a watchdog waits its time"
    rig.world.advance(killed + 5 * SECOND)
    turning = rig.velocity("left")
    assert abs(turning) < 0.5 if stops else turning > 5.0
    rig.leave()


# -- disks -------------------------------------------------------------------------------------


class Disk:
    """A file on a disk that can be full, slow or gone."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.broken: int | None = None
        """The error that a write gives, after half of it was written."""
        self.ready = threading.Event()
        self.ready.set()
        self.waiting = threading.Event()

    def write(self, data: memoryview) -> int:
        if not self.ready.is_set():
            self.waiting.set()
            self.ready.wait()
        if self.broken is not None:
            if len(data) > 100:
                return int(self._stream.write(data[: len(data) // 2]))
            raise OSError(self.broken, os.strerror(self.broken))
        return int(self._stream.write(data))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def on_a_disk(recorder: Recorder) -> Disk:
    file = recorder._writer._file
    disk = Disk(file._stream)
    file._stream = disk  # type: ignore[assignment]  # it behaves like one
    return disk


def hand_over(recorder: Recorder, moments: Iterator[Any], count: int) -> None:
    for _ in range(count):
        recorder.record(*next(moments), patient=True)
    drained(recorder)


@pytest.mark.sample(2)
@pytest.mark.parametrize("trouble", [errno.ENOSPC, errno.EROFS, errno.EIO, errno.EDQUOT])
def test_a_disk_that_takes_nothing_for_a_while(
    path: Path, trouble: int, caplog: pytest.LogCaptureFixture
) -> None:
    moments = little.life(2000)
    with Recorder(path, little.ROBOT, {}, little.MOUNTS) as recorder:
        disk = on_a_disk(recorder)
        hand_over(recorder, moments, 300)
        before = path.stat().st_size
        disk.broken = trouble
        hand_over(recorder, moments, 700)
        assert path.stat().st_size == before, "half a chunk was left in the file"
        assert recorder.lost == 700
        disk.broken = None
        hand_over(recorder, moments, 1000)
    left = [tick.number for tick in read_recording(path).ticks]
    gap = recorder.lost
    assert left == [*range(300), *range(300 + gap, 2000)]
    assert 700 <= gap <= 700 + 200, "it is tried again every second, which are 200 ticks"
    why = os.strerror(trouble)
    assert [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR] == [
        f"recording: nothing can be recorded in {path}: {why}; the robot continues",
        f"recording: the recording {path} continues; {gap} ticks are missing in it",
    ]
    steps = list(read_recording(path).steps)
    assert is_whole(path)
    assert not any(step.damage for step in steps)
    after = {view.topic for view in steps[300].views}
    assert {"/tf_static", "/map", "/plan", "/goal_pose"} < after, "what was shown in the gap is shown anew"
    assert len(kills.read_by_rosbags(path)) == 2000 - gap


def test_a_disk_that_never_comes_back(path: Path) -> None:
    """With a limit on the size of files, in a process of its own; what was written stays readable."""
    code = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
recorder = Recorder(Path(sys.argv[1]), little.ROBOT, {}, little.MOUNTS)
for tick, belief in little.life(1000):
    recorder.record(tick, belief, patient=True)
recorder.close()
print(recorder.lost)
print(recorder.trouble)
"""
    lost, trouble = child(code, path).splitlines()
    made = read_recording(path)
    left = list(made.ticks)
    assert not made.whole
    assert left == [tick for tick, _ in little.life(len(left))]
    assert 0 < len(left) < 1000
    assert len(left) + int(lost) == 1000
    assert trouble == f"{path} has no index: File too large; repair it with: gateway recover {path}"
    assert path.stat().st_size <= 60_000


def test_a_write_that_cannot_be_taken_back_ends_the_recording(path: Path) -> None:
    moments = little.life(1000)

    def refuse(_size: int) -> int:
        raise OSError(errno.EIO, "gone")

    with Recorder(path, little.ROBOT, {}, little.MOUNTS) as recorder:
        disk = on_a_disk(recorder)
        hand_over(recorder, moments, 300)
        disk.broken = errno.EIO
        disk.truncate = refuse  # type: ignore[attr-defined]
        hand_over(recorder, moments, 700)
    assert recorder.lost == 700
    assert recorder.trouble == (
        f"the recording ends here: {path}: {os.strerror(errno.EIO)}; the robot continues"
    )
    # Of the chunk that broke off, some may be readable: it is counted as lost.
    left = [tick.number for tick in read_recording(path).ticks]
    assert left == list(range(len(left)))
    assert 300 <= len(left) <= 320


def test_a_slow_disk_costs_ticks_and_never_the_loop(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    moments = little.life(600)
    with Recorder(path, little.ROBOT, {}, little.MOUNTS, depth=64) as recorder:
        disk = on_a_disk(recorder)
        hand_over(recorder, moments, 100)
        disk.ready.clear()
        for _ in range(300):  # if any of these waited for the disk, this test would not end
            recorder.record(*next(moments))
        assert disk.waiting.wait(PATIENCE), "the writer is at the disk"
        lost = recorder.lost
        assert 300 - 64 - 20 <= lost <= 300 - 64
        disk.ready.set()
        drained(recorder)
        hand_over(recorder, moments, 200)
    assert recorder.lost == lost
    steps = list(read_recording(path).steps)
    assert not any(step.damage for step in steps)
    numbers = [step.tick.number for step in steps]
    assert len(numbers) == 600 - lost
    written = list(little.life(600))
    assert [step.tick for step in steps] == [written[number][0] for number in numbers]
    jumps = [b - a - 1 for a, b in pairwise(numbers) if b != a + 1]
    assert jumps == [lost], "one gap"
    reported = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert len(reported) == 2
    assert "the disk is too slow; the robot continues" in reported[0]
    assert reported[1] == f"recording: {path} continues with tick 400: {lost} ticks are missing"


def test_a_robot_on_a_dead_disk_reaches_its_target(tmp_path: Path) -> None:
    """The live loop itself, with the disk blocked from the first tick on."""
    rig = Rig()
    with Recorder(tmp_path / "a.mcap", rig.robot.text, {}, depth=8) as recorder:
        disk = on_a_disk(recorder)
        disk.ready.clear()
        rig.record = recorder.record
        rig.run(1.0)
        rig.run(2.0, Velocity("left", 6.0))
        assert rig.velocity("left") == pytest.approx(6.0, abs=0.5)
        assert len(rig.ticks) - 40 <= recorder.lost < len(rig.ticks)
        disk.ready.set()
        rig.leave()


def test_a_folder_that_may_not_be_written(tmp_path: Path) -> None:
    """As another user, if this one may do everything."""
    tmp_path.chmod(0o555)
    code = """
from gateway.errors import RecordingError
from gateway.recording.tick_writer import TickWriter
from gateway.recording.ros_views import Views
views = Views()
views.prepare()
if os.geteuid() == 0:
    os.seteuid(65534)
try:
    TickWriter(Path(sys.argv[1]), little.ROBOT, {}, views)
except RecordingError as error:
    print(error)
"""
    try:
        assert "cannot be written: Permission denied" in child(code, tmp_path / "a.mcap")
    finally:
        tmp_path.chmod(0o755)


# -- power -------------------------------------------------------------------------------------


def test_syncing_to_disk_does_not_delay_the_writer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, go_on = threading.Event(), threading.Event()

    def sync(_descriptor: int) -> None:
        asked.set()
        go_on.wait()

    monkeypatch.setattr(writer, "SYNC_PERIOD", 0.001)
    monkeypatch.setattr(os, "fdatasync", sync)
    with Recorder(tmp_path / "a.mcap", little.ROBOT, {}, little.MOUNTS) as recorder:
        assert asked.wait(60)
        hand_over(recorder, little.life(200), 200)
        assert len(list(read_recording(recorder.path).ticks)) == 200
    assert read_recording(recorder.path).whole
    assert recorder.trouble == ""
    go_on.set()
    recorder._syncer._thread.join(60)


@pytest.mark.parametrize(("error", "reported"), [(errno.EIO, True), (errno.EINVAL, False)])
def test_a_disk_that_reports_lost_data_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: int, reported: bool
) -> None:
    asked = threading.Event()

    def sync(_descriptor: int) -> None:
        asked.set()
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr(writer, "SYNC_PERIOD", 0.001)
    monkeypatch.setattr(os, "fdatasync", sync)
    with Recorder(tmp_path / "a.mcap", little.ROBOT, {}) as recorder:
        assert asked.wait(60)
        recorder._syncer._thread.join(60)
        assert not recorder._syncer._thread.is_alive()
    assert ("the disk reports lost data" in recorder.trouble) == reported


def test_status_shows_the_recording_and_lost_ticks(path: Path) -> None:
    with open_session(config.parse_robot(BENCH), simulated=True, record=path) as made:
        for _ in made.run(1.0):
            pass
        assert f"recording: {path}" in status_text(made).splitlines()
        assert made.recorder is not None
        drained(made.recorder)
        on_a_disk(made.recorder).broken = errno.ENOSPC
        for _ in made.run(2.0):
            pass
        drained(made.recorder)
        lost = made.recorder.lost
        assert lost > 100
        line = status_text(made).splitlines()[-1]
    assert line.startswith(f"recording: {path}, {lost} ticks lost: nothing can be recorded in")
