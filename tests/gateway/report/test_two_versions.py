"""`gateway judge --against`: defects put into a copy of the sources are named by signal, second and file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import gateway as gw
from gateway.cli.main import main
from gateway.config import load_robot, resources
from gateway.recording import read_recording
from gateway.replay.input_log import input_log
from gateway.report.minimise import minimise
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
