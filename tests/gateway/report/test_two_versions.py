"""`gateway judge --against`: defects put into a copy of the sources are named by signal, second and file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest

import gateway as gw
from gateway.cli.main import main
from gateway.config import load_robot, resources
from gateway.errors import RecordingError
from gateway.recording import read_recording
from gateway.replay.input_log import input_log
from gateway.report.minimise import minimise
from gateway.report.part_versions import part_compared
from gateway.report.two_versions import ALONE, NOT_ALONE, Differs, compared, settings_apart
from protocols.messages import SECOND
from tests.gateway.report.defects import DECOYS, DEFECTS, Defect, versions
from tests.sampled import sampled

LATE = 8.5
"""s that go by before anything is asked, of recordings that are to be made small"""


def turned(path: Path, wait: float) -> Path:
    """Record a bench of which a motor is asked for more than it may from 1.2 s on, and silent from 1.7 to 2.1
    s; all of it so much later."""
    begin, end = (round((wait + at) * SECOND) for at in (1.7, 2.1))
    with gw.open_session("bench", simulated=True, record=path) as session:
        assert session.twins is not None
        for tick in session.run(wait + 2.4):
            if tick.now > (wait + 1.2) * SECOND:
                session.submit(gw.Velocity("left", 25.0))
            if tick.now == begin:
                session.twins.disconnect("left")
            if tick.now == end:
                session.twins.reconnect("left")
    return path


def driven(path: Path, wait: float) -> Path:
    """Record a base that drives for 2.5 s; so much later."""
    with gw.open_session("diffbot", simulated=True, record=path) as session:
        asked = False
        for tick in session.run(wait + 2.5):
            if not asked and tick.now >= wait * SECOND:
                session.submit(gw.Goal(0.6, 0.1))
                asked = True
    return path


@pytest.fixture(scope="module")
def turn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return turned(tmp_path_factory.mktemp("versions") / "turn.mcap", 0.0)


@pytest.fixture(scope="module")
def goal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return driven(tmp_path_factory.mktemp("versions") / "goal.mcap", 0.0)


@pytest.fixture(scope="module")
def late_turn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return turned(tmp_path_factory.mktemp("versions") / "late_turn.mcap", LATE)


@pytest.fixture(scope="module")
def late_goal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return driven(tmp_path_factory.mktemp("versions") / "late_goal.mcap", LATE)


@pytest.mark.parametrize("defect", sampled([(one,) for one in DEFECTS], 10))
def test_a_defect_is_named_by_signal_second_and_file(
    defect: Defect, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    before, after = versions(tmp_path, defect)
    found = compared(request.getfixturevalue(defect.recording), before, after)
    assert not found.error
    assert found.tick is not None
    low, high = defect.since
    assert low <= found.since <= high, found.lines()
    named = [line.partition(":")[0] for line in found.signals]
    assert any(one.startswith(defect.signal) for one in named) or f" {defect.signal}:" in found.first, found
    assert found.files == {defect.file: ALONE} | dict.fromkeys(DECOYS, NOT_ALONE)


# fmt: off
ALONE_IN = [
    # defect, recording, part, and what is told: of the first value, and of the rest; none: it is the same
    ("a swapped wheel", "goal", "control", (r"tick \d\d, 0\.\d+ s after the start: left: velocity",)),
    ("a swapped wheel", "goal", "planning", ()),
    ("a sign", "turn", "driver", (r"tick \d+, 1\.[23]\d+ s .*: left: obeys Velocity\.velocity",)),
    ("a sign", "turn", "control", ()),
    ("a limit not applied", "turn", "driver", (r"left: obeys Velocity\.velocity",)),
    ("a mirrored scan", "goal", "perception", (r"the base: sight\.map\.digest",)),
    ("a mirrored scan", "goal", "planning", ()),
    ("a mirrored scan", "goal", "guard", ()),
    ("a unit", "goal", "driver", (r"compared up to tick \d+: .* since what it made came back",)),
]
# fmt: on


@pytest.mark.parametrize(("name", "recording", "part", "told"), sampled(ALONE_IN, 9))
def test_a_defect_is_seen_in_its_own_part_alone(
    name: str,
    recording: str,
    part: str,
    told: Sequence[str],
    request: pytest.FixtureRequest,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (defect,) = (one for one in DEFECTS if one.name == name)
    _, broken = versions(tmp_path, defect)
    path, report = str(request.getfixturevalue(recording)), tmp_path / "parts.md"
    command = ["judge", path, "--against", str(broken), "--only", part, "--report", str(report)]
    assert main(command) == bool(told)
    found = capsys.readouterr().out
    assert re.search(rf"^  {part} alone, on what it was given in \d\d+ recorded ticks$", found, re.M)
    assert f"{part} alone: {0 if told else 1} of 1 recordings give the same as in {broken}" in found
    assert all(re.search(one, found) for one in told), found
    assert ("the same in every tick" in found) is not bool(told)
    assert found in report.read_text()


@pytest.fixture(scope="module")
def brief(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench whose motor sets out."""
    path = tmp_path_factory.mktemp("versions") / "brief.mcap"
    with gw.open_session("bench", simulated=True, record=path) as session:
        for _ in session.run(0.3):
            session.submit(gw.Velocity("left", 2.0))
    return path


def test_files_of_a_part_that_do_not_fit_alone_are_told(brief: Path, tmp_path: Path) -> None:
    before, after = versions(tmp_path, DEFECTS[0])
    (after / "brain/planning/anew.py").write_text("LONGEST = 3.0\n")
    motion = after / "brain/control/motion.py"
    motion.write_text(motion.read_text() + "\nfrom brain.planning.anew import LONGEST  # noqa\n")
    found = part_compared(brief, before, "control", after)
    (note,) = found.notes
    assert note.startswith(
        "the whole of today's version: its own files do not fit into that of before (Module"
    )
    assert "No module named 'brain.planning.anew'" in note
    assert found.ticks > 60
    motion.write_text("broken(")
    with pytest.raises(RecordingError, match="the version of before cannot run control alone: SyntaxError"):
        part_compared(brief, after, "control", before)
    (after / "gateway/monitor/allowed.py").write_text("broken(")
    with pytest.raises(RecordingError, match="today's version cannot run guard alone: SyntaxError"):
        part_compared(brief, before, "guard", after)


@pytest.mark.prove
@pytest.mark.parametrize("defect", DEFECTS, ids=[one.name for one in DEFECTS])
def test_what_remains_of_a_defect_is_shorter_than_two_seconds(
    defect: Defect, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    differs = Differs(*versions(tmp_path, defect))
    try:
        log = input_log(read_recording(request.getfixturevalue(f"late_{defect.recording}")))
        assert log.ticks[-1].now - log.ticks[0].now > 10 * SECOND
        small = minimise(log, differs, 24)
        assert small is not None
        print(f"{defect.name}: {small.text()}")
        assert differs.first(small.log) == len(small.log.ticks) - 1
    finally:
        differs.close()
    assert small.log.ticks[-1].now - small.log.ticks[0].now < 2 * SECOND


@pytest.mark.prove
def test_the_same_sources_send_the_same(turn: Path, tmp_path: Path) -> None:
    before, _ = versions(tmp_path, DEFECTS[0])
    found = compared(turn, before)
    assert found.lines() == [f"{turn}: the same packets in both versions"]


def test_settings_are_put_in_by_turns(turn: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    text = resources.find("robots", "bench").read_text()
    text = re.sub(r"velocity = [\d.]+", "velocity = 5.0", text, count=1)
    other.write_text(text.replace('name = "bench"', 'name = "another"'))
    found = settings_apart(turn, load_robot(str(other)))
    assert found.tick is not None
    assert 1.2 < found.since < 1.5
    assert found.files == {"defaults.motors.limits.velocity": ALONE, "name": NOT_ALONE}
    assert settings_apart(turn, load_robot("bench")).tick is None


# fmt: off
WRONG = [
    # arguments, and what is told
    (["judge", "{turn}", "--against", "no-such-revision"], r"neither a folder with the rooms nor a rev"),
    (["judge", "{turn}", "--against", ".", "--update"], r"another version.*: leave --update away"),
    (["minimise", "{turn}", "--while", "differs"], r"`--while differs` and --against REV go together"),
    (["minimise", "{turn}", "--while", "raises", "--against", "."], r"go together: from which version"),
    (["judge", "{turn}", "--against", ".", "--only", "driver", "--set", "a=1"], r"leave --robot and --set"),
    (["judge", "{turn}", "--against", "no-such", "--only", "guard"], r"neither a folder with the rooms"),
    (["judge", "{turn}", "--against", ".", "--only", "guard", "--jobs", "2"], r"side by side; leave"),
    (["judge", "{turn}", "--against", ".", "--jobs", "2"], r"side by side; leave"),
    (["judge", "{turn}", "--against", ".", "--all"], r"another version.*: leave --all away"),
    (["judge", "{turn}", "--self-test", "--all"], r"the judge itself: leave --all away"),
    (["judge", "{turn}", "--against", ".", "--only", "guard", "--json", "x"], r"alone: leave --json"),
]
# fmt: on


@pytest.mark.parametrize(("given", "told"), WRONG)
def test_wrong_arguments_are_told(
    given: list[str], told: str, turn: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([one.format(turn=turn) for one in given]) == 2
    assert re.search(told, capsys.readouterr().err)


def test_a_revision_is_no_option_of_git(
    turn: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    theirs = tmp_path / "theirs"
    theirs.write_text("kept")
    assert main(["judge", str(turn), f"--against=--output={theirs}"]) == 2
    assert "neither a folder with the rooms nor a revision" in capsys.readouterr().err
    assert theirs.read_text() == "kept"


def test_a_folder_that_lacks_a_room_is_not_compared(
    turn: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gateway").mkdir()
    monkeypatch.chdir(tmp_path)
    for given in (str(tmp_path), ""):
        assert main(["judge", str(turn), "--against", given]) == 2
        assert "neither a folder with the rooms nor a revision" in capsys.readouterr().err
