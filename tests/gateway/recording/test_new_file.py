"""Files that a command writes: none takes the place of another, and no link is followed."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway.cli.main import main
from gateway.errors import GatewayError
from gateway.recording import Recorder, read_recording
from gateway.recording.new_file import create_with, publish, replace_with
from gateway.recording.recover import recover
from gateway.runtime.session import open_session
from tests.gateway import little


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "a.mcap"
    with open_session("bench", simulated=True, record=path) as session:
        for _ in session.run(0.05):
            pass
    return path


def in_the_way(folder: Path) -> dict[str, Path]:
    """A link to nothing, a link to a file, a file."""
    found = {name: folder / f"{name}.there" for name in ("dangling", "link", "file")}
    (folder / "somebody's").write_text("kept")
    found["file"].write_text("kept")
    found["link"].symlink_to(folder / "somebody's")
    found["dangling"].symlink_to(folder / "nothing")
    return found


WRITERS: dict[str, Callable[[Path, Path], object]] = {
    "a recording": lambda path, _: Recorder(path, little.ROBOT, {}),
    "a session's recording": lambda path, _: open_session("bench", simulated=True, record=path).__enter__(),
    "a recovered recording": lambda path, source: recover(source, path),
    "a dump": lambda path, _: create_with(path, b"new"),
    "a part": lambda path, source: recover(source, path.with_suffix("")),
}
"""Of a part, whose name ends so, the thing in the way is called as the part would be."""


@pytest.mark.sample(5)
@pytest.mark.parametrize("what", WRITERS)
@pytest.mark.parametrize("there", ["dangling", "link", "file"])
def test_what_must_be_new_is_refused_and_nothing_is_touched(
    tmp_path: Path, recording: Path, what: str, there: str
) -> None:
    path = in_the_way(tmp_path)[there]
    if what == "a part":
        path = path.rename(path.with_suffix(".part"))
    with pytest.raises((GatewayError, FileExistsError), match=r"exists already|another recovery"):
        WRITERS[what](path, recording)
    assert not (tmp_path / "nothing").exists()
    assert (tmp_path / "somebody's").read_text() == "kept"
    assert there != "file" or path.read_text() == "kept"
    assert os.path.lexists(path)


@pytest.mark.parametrize("there", ["dangling", "link"])
def test_what_is_written_over_is_never_a_link(
    tmp_path: Path, there: str, capsys: pytest.CaptureFixture[str]
) -> None:
    found = in_the_way(tmp_path)
    with pytest.raises(OSError, match="is a link"):
        replace_with(found[there], b"new")
    assert main(["run", "bench", "--fast", "--seconds", "0.05", "--report", str(found[there])]) == 2
    assert "is a link: name the file itself" in capsys.readouterr().err
    assert not (tmp_path / "nothing").exists()
    assert (tmp_path / "somebody's").read_text() == "kept"
    replace_with(found["file"], b"new")
    assert found["file"].read_bytes() == b"new"


def test_a_recording_is_never_written_over(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = recording.read_bytes()
    for option in ("--json", "--report"):
        assert main(["judge", str(recording), option, str(recording)]) == 2
        assert "is a recording" in capsys.readouterr().err
    assert main(["again", str(recording), "--json", str(recording)]) == 2
    assert "is a recording" in capsys.readouterr().err
    assert recording.read_bytes() == before


def test_of_two_with_one_name_the_second_is_refused_and_the_first_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    with Recorder(path, little.ROBOT, {}), pytest.raises(GatewayError, match=r"one\.mcap: exists already"):
        Recorder(path, little.ROBOT, {})
    assert read_recording(path).whole
    assert stat.S_ISREG(path.lstat().st_mode)


def test_a_recording_that_cannot_be_begun_leaves_the_one_before_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "b.mcap").write_text("kept")
    with open_session("bench", simulated=True, record=tmp_path / "a.mcap") as session:
        with pytest.raises(GatewayError, match="exists already"):
            session.start_recording(tmp_path / "b.mcap")
        assert session.recorder is not None
        assert session.recorder.path == tmp_path / "a.mcap"


def test_a_finished_file_gets_its_name_unless_that_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_links(*_: object) -> None:
        raise PermissionError("a file system without hard links")

    for _ in range(2):
        part, target = tmp_path / "x.part", tmp_path / "x"
        part.write_text("new")
        publish(part, target)
        assert (target.read_text(), part.exists()) == ("new", False)
        part.write_text("newer")
        with pytest.raises(FileExistsError, match="never overwritten"):
            publish(part, target)
        assert target.read_text() == "new"
        target.unlink()
        monkeypatch.setattr(os, "link", no_links)
