"""`gateway judge --self-test`: what the judge claims is shown, and a blind one is found out."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import gateway as gw
from gateway.cli.main import main
from gateway.replay.compare import Comparer
from gateway.report.self_test import self_test
from protocols.messages import SECOND


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("self_test") / "turn.mcap"
    with gw.open_session("bench", simulated=True, record=path) as session:
        for tick in session.run(0.8):
            if tick.now > 0.4 * SECOND:
                session.submit(gw.Velocity("left", 3.0))
    return path


def test_all_that_the_judge_claims_is_shown(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["judge", "--self-test", str(recorded)]) == 0
    printed = capsys.readouterr().out
    assert re.match(rf"{recorded}:\n(  shown: .*\n){{7}}$", printed), printed
    assert re.search(r"the same, from all of its inputs: (\d+) of \1 frames given again", printed)
    assert re.search(r"a changed gear is found: tick \d+, 0\.[4-9]\d\d s after the start: ", printed)
    assert [one.name for one in recorded.parent.iterdir()] == ["turn.mcap"]


@pytest.mark.prove
def test_a_judge_that_does_not_look_is_found_out(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def blind(*_given: Any) -> None:
        """See nothing."""

    monkeypatch.setattr(Comparer, "differ", blind)
    shown = {one.name: one.shown for one in self_test(recorded)}
    assert shown["as it is, it is the same, from all of its inputs"]
    wrong = [name for name, seen in shown.items() if not seen]
    assert "a changed gear is found" in wrong
    assert "two runs in one file do not replay as one" in wrong
    assert "a swapped order of two frames is found" in wrong


def test_of_what_replays_otherwise_nothing_is_claimed(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recorded.read_bytes()[:-20_000])
    assert main(["judge", "--self-test", str(cut)]) == 1
    assert "NOT SHOWN: as it is, it is the same" in capsys.readouterr().out
    assert main(["judge", "--self-test", str(cut), "--update"]) == 2
    assert "--self-test tries the judge itself: leave --update away" in capsys.readouterr().err
