"""`gateway diff`: how two runs part, by signal and in time."""

from __future__ import annotations

import copy
import re
from pathlib import Path

import pytest

import gateway as gw
from gateway.cli.main import main
from gateway.config import resources
from gateway.replay import partings

DIFFBOT = resources.find("robots", "diffbot").read_text()


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("drives")
    for name, most in (("as it is", "0.6"), ("slower", "0.4")):
        robot = gw.parse_robot(DIFFBOT.replace("max_linear = 0.6", f"max_linear = {most}"))
        with gw.open_session(robot, simulated=True, record=folder / name) as session:
            session.submit(gw.Goal(1.6, 0.6))
            for _ in session.run(3.0):
                pass
    return {path.name: path for path in folder.iterdir()}


def test_it_tells_settings_first_difference_and_signals_in_order_of_time(
    drives: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["diff", str(drives["as it is"]), str(drives["slower"])]) == 1
    printed = capsys.readouterr().out
    assert "robot file: brain.differential.max_linear: 0.6 in the first, 0.4 in the second" in printed
    assert re.search(r"the same for \d+ ticks; then\n  tick \d+, .* after the start: sent\n", printed)
    signals = re.findall(r"^  ([\w.]+): from ([\d.]+) s on; at most ([\d.]+)", printed, re.MULTILINE)
    assert [float(since) for _, since, _ in signals] == sorted(float(since) for _, since, _ in signals)
    largest = {name: float(most) for name, _, most in signals}
    assert largest["base.linear"] == pytest.approx(0.2, abs=0.02)
    assert largest["left.command.velocity"] == pytest.approx(0.2 / 0.05, abs=0.4)


def test_a_recording_is_the_same_as_itself(
    drives: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["diff", str(drives["slower"]), str(drives["slower"])]) == 0
    assert re.search(r"^the same: \d+ ticks$", capsys.readouterr().out, re.MULTILINE)


def test_a_signal_parts_where_it_stays_apart_not_at_one_odd_sample(drives: dict[str, Path]) -> None:
    log = gw.log_of(drives["as it is"])
    assert partings(log, log) == []
    other = copy.deepcopy(log)
    column = 1 + list(log.units).index("left.torque")
    other._table[300, column] += 5.0
    assert partings(log, other) == []
    other._table[400:, column] += 1.0
    (parting,) = partings(log, other)
    assert parting.name == "left.torque"
    assert parting.since == pytest.approx(log.t[400])
    assert parting.largest == pytest.approx(5.0)


def test_runs_are_aligned_by_their_own_beginnings_and_clocks(drives: dict[str, Path]) -> None:
    """The same drive, later, and with a tick in three left out."""
    log = gw.log_of(drives["as it is"])
    other = copy.deepcopy(log)
    kept = [at for at in range(len(log)) if at % 3]
    other._table[: len(kept)] = log._table[kept]
    other._table[: len(kept), 0] += 17.0 - log.t[kept[0]] + log.t[0]
    other._taken = len(kept)
    assert [each for each in partings(log, other) if each.name.startswith("base.")] == []
