"""`gateway again`: what a recording asks of its robot, asked again in the simulated world."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import threading
from pathlib import Path

import distributed
import pytest

import gateway as gw
from gateway.bench.again import asked, drive_again, lasts, simulated
from gateway.bench.on_recording import run_spoilt
from gateway.cli.main import main
from gateway.config import parse_robot, resources
from gateway.config.one_setting import with_setting
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.replay.input_log import InputLog, input_log
from gateway.runtime.scenario_file import parse_faults
from protocols.messages import SECOND
from tests.sampled import sampled

CABLE = """\
[faults.cable]
at = 0.7
cause = "device silent"
on = "left"

[must.tell.silence]
after = "cable"
within = 0.2
on = "left"
text = "silent"

[must.stand.left]
after = "cable"
within = 0.01
on = "left"
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench of which one motor turns from 0.5 to 0.9 s."""
    path = tmp_path_factory.mktemp("again") / "turn.mcap"
    with gw.open_session("bench", simulated=True, record=path) as session:
        for tick in session.run(1.1):
            if 0.5 * SECOND < tick.now < 0.9 * SECOND:
                session.submit(gw.Velocity("left", 3.0))
    return path


@pytest.fixture(scope="module")
def log(recorded: Path) -> InputLog:
    return input_log(read_recording(recorded))


def test_the_same_robot_and_world_give_the_same_bytes(recorded: Path, log: InputLog, tmp_path: Path) -> None:
    assert lasts(log) == pytest.approx(1.1, abs=0.01)
    assert {type(one) for _, asks in asked(log) for one in asks} == {gw.Velocity}
    again = tmp_path / "again.mcap"
    scenario = parse_faults("", Path("nothing"), simulated(log.robot), lasts(log))
    found = drive_again(log, scenario, again)
    assert found.passed
    ticks = [(tick.now, tick.inputs, tick.outputs) for tick in read_recording(recorded).ticks]
    assert [(tick.now, tick.inputs, tick.outputs) for tick in read_recording(again).ticks] == ticks
    assert found.figures["left: final position"].value == pytest.approx(1.8, abs=0.2)


def test_faults_come_meanwhile_and_what_must_hold_is_judged(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cable.toml").write_text(CABLE)
    assert main(["again", str(recorded), "--inject", str(tmp_path / "cable.toml")]) == 1
    printed = capsys.readouterr().out
    assert re.search(
        r"^0\.8\d s: left: fault: silent: no feedback for more than 100 ms", printed, re.MULTILINE
    )
    assert "held: must.tell.silence: 'silent' of left: told after 0.1" in printed
    assert "DID NOT HOLD: must.stand.left: " in printed  # it coasts


def test_a_clock_that_steps_back_is_told_and_the_motor_is_let_go(log: InputLog) -> None:
    text = CABLE.replace("device silent", "stamps 1 s early").partition("[must.stand")[0]
    scenario = parse_faults(text, Path("f.toml"), simulated(log.robot), lasts(log))
    found = drive_again(log, scenario)
    assert found.passed, found.verdicts
    assert found.figures["left: final position"].value < 1.4  # it coasts; 1.8 without


@pytest.mark.parametrize(("cause", "missed"), [("a step takes 400 ms", 79), ("slow steps", 10)])
def test_slow_ticks_are_told_as_missed_and_the_world_goes_on(
    log: InputLog, cause: str, missed: int, caplog: pytest.LogCaptureFixture
) -> None:
    text = CABLE.replace("device silent", cause).partition("[must")[0]
    found = drive_again(log, parse_faults(text, Path("f.toml"), simulated(log.robot), lasts(log)))
    told = [one for line in caplog.messages for one in re.findall(r"in this run: (\d+) of \d+ ticks", line)]
    assert len(told) == 1
    assert int(told[0]) >= missed
    assert found.figures["left: final position"].value > 1.5  # it went on while nobody asked anything else
    assert found.figures["ticks missed"].value >= 1


# fmt: off
SLOW = [
    # cause, whether upon the recorded inputs, within how many s it must be told, and whether it is
    ("a step takes 400 ms", False, 0.401, False),
    ("a step takes 400 ms", False, 0.42, True),
    ("a step takes 400 ms", True, 0.42, True),
    ("slow steps", False, 0.7, True),
    ("slow steps", True, 0.7, True),
    ("frames doubled", False, 0.42, False),
]
# fmt: on


@pytest.mark.parametrize(("cause", "upon", "within", "told"), SLOW)
def test_a_slow_step_is_told_within_a_declared_time(
    cause: str, upon: bool, within: float, told: bool, log: InputLog
) -> None:
    text = CABLE.replace("device silent", cause).partition("[must.stand")[0].replace("at = 0.7", "at = 0.3")
    text = text.replace('on = "left"\ntext = "silent"', 'on = "loop"\ntext = "ticks missed"')
    text = text.replace("within = 0.2", f"within = {within}")
    robot = log.robot if upon else simulated(log.robot)
    scenario = parse_faults(text, Path("f.toml"), robot, lasts(log))
    found = (run_spoilt if upon else drive_again)(log, scenario)
    (verdict,) = found.verdicts
    assert verdict.holds is told, verdict
    if cause == "a step takes 400 ms":
        assert re.search(r"told after 0\.4\d s|not told", verdict.text), verdict
        assert found.figures["oldest feedback"].value < 30.0, "what has come meanwhile is read"


def test_a_sweep_is_a_table_and_a_picture_the_same_by_jobs_and_by_shards(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures, plot = tmp_path / "s.csv", tmp_path / "s.svg"
    command = ["again", str(recorded), "--sweep", "motors.left.limits.velocity=1..3:2", "--csv", str(figures)]
    parts = [str(tmp_path / f"{number}.json") for number in (1, 2)]
    for number, part in enumerate(parts, 1):
        assert main([*command, "--shard", f"{number}/2", "--json", part]) == 0
    capsys.readouterr()
    assert main(["again", *reversed(parts), "--csv", str(figures), "--plot", str(plot)]) == 0
    printed, merged = capsys.readouterr().out, figures.read_bytes()
    assert main([*command, "--jobs", "2"]) == 0
    assert (capsys.readouterr().out, figures.read_bytes()) == (printed, merged)
    assert re.search(r"^motors\.left\.limits\.velocity \| runs \| held \| goals", printed, re.MULTILINE)
    assert re.search(r"^1 \| 1 \| 1 \| 0 \| .*\n3 \| 1 \| 1 \| 0 ", printed, re.MULTILINE)
    rows = list(csv.DictReader(figures.read_text().splitlines()))
    slow, fast = (float(row["left: final position"]) for row in rows)
    assert 0.5 < slow < 0.7 < 1.5 < fast
    assert b"<svg" in plot.read_bytes()[:400]
    one = tmp_path / "one.json"
    alone = ["--set", "motors.left.limits.velocity=1.0", "--seed", "1", "--json", str(one)]
    assert main(["again", str(recorded), *alone]) == 0
    assert json.loads(one.read_text())["figures"]["left: final position"] == slow


@pytest.mark.prove
def test_on_a_cluster_of_which_a_worker_is_killed_the_table_is_the_same(
    recorded: Path, tmp_path: Path
) -> None:
    command = ["again", str(recorded), "--sweep", "motors.left.limits.velocity=1..3:4", "--csv"]
    here, there = tmp_path / "here.csv", tmp_path / "there.csv"
    assert main([*command, str(here), "--jobs", "2"]) == 0
    with distributed.LocalCluster(n_workers=3, threads_per_worker=1, dashboard_address=None) as cluster:
        first = cluster.workers[0]
        killed = threading.Timer(0.5, lambda: os.kill(first.pid, signal.SIGKILL))
        killed.start()
        engine = f"dask:{cluster.scheduler_address}"
        assert main([*command, str(there), "--engine", engine]) == 0
        killed.join()
    assert there.read_bytes() == here.read_bytes()


# fmt: off
UPON = [
    # cause, seconds, and what is told
    ("device silent", 0.25, ["left: fault: silent: no feedback for more than 100 ms"]),
    ("bus gone", 0.2, ["can0: has vanished: the interface", "left: fault: silent"]),
    ("stamps 1 s early", 0.3, ["left: fault: silent: no feedback for more than 100 ms"]),
    ("stamps 1 h late", 0.3, []),
    ("frames doubled", 0.2, []),
    ("frames 15 ms late", 0.2, []),
]
# fmt: on


@pytest.mark.parametrize(("cause", "seconds", "expected"), sampled(UPON, 3))
def test_faults_are_put_upon_recorded_inputs(
    cause: str, seconds: float, expected: list[str], log: InputLog, tmp_path: Path
) -> None:
    text = f'[faults.it]\nat = 0.7\ncause = "{cause}"\non = "left"\nseconds = {seconds}\n'
    found = run_spoilt(log, parse_faults(text, Path("it.toml"), log.robot, lasts(log)), tmp_path / "it.mcap")
    told = [line.partition(" s: ")[2] for line in found.told if "the run ends" not in line]
    assert bool(told) is bool(expected), told
    assert all(any(each in line for line in told) for each in expected), told
    ticks = list(read_recording(tmp_path / "it.mcap").ticks)
    times = [0.7 <= (tick.now - ticks[0].now) / SECOND < 0.7 + seconds + 0.02 for tick in ticks]
    pairs = [*zip(times, log.ticks, ticks, strict=True)]
    assert all(tick.inputs == given.inputs for inside, given, tick in pairs if not inside)
    assert any(tick.inputs != given.inputs for inside, given, tick in pairs if inside)
    assert main(["replay", str(tmp_path / "it.mcap")]) == 0


# fmt: off
WRONG = [
    # arguments, and what is told
    (["--sweep", "left"], r"'left' is not KEY=A\.\.B:N, with N from 2 to 1000, or KEY=VALUE,VALUE"),
    (["--sweep", "a.b=1..2:1"], r"is not KEY=A\.\.B:N"),
    (["--sweep", "a.b=1..nan:5"], r"is not KEY=A\.\.B:N"),
    (["--sweep", "motors.left.limits.velocity=1,1e9"], r"motors\.left\.limits\.velocity.*1000000000"),
    (["--sweep", "motors.left.limits.velocty=1,2"], r"velocty"),
    (["--set", "velocity"], r"is not KEY=VALUE"),
    (["--set", "motors.left.gear=NaN"], r"expected a finite number, a word, true or false"),
    (["--csv", "x.csv"], r"--csv is of a sweep"),
    (["--jobs", "2"], r"--jobs and --engine are of a sweep"),
    (["--engine", "dask:127.0.0.1:1"], r"--jobs and --engine are of a sweep"),
    (["--shard", "1/2"], r"--shard is of a sweep"),
    (["--seeds", "2", "--record", "x"], r"--record is of one run"),
    (["--shard", "3/2"], r"'3/2' is not I/N"),
    (["another.mcap"], r"one recording at a time"),
    (["--seeds", "0"], r"'0' is not a number from 1 to 1000"),
    (["--seeds", "2", "--engine", "spark:1"], r"is not dask:ADDRESS, such as dask:tcp://10\.0\.0\.1:8786"),
    (["--inject", "{}"], r"faults\.cable\.cause.*did you mean 'device silent'"),
    (["--inject", "nowhere.toml"], r"nowhere\.toml"),
    (["--recorded"], r"--recorded puts faults upon recorded inputs: give --inject"),
    (["--recorded", "--inject", "{world}"], r"faults\.cable: 'encoder stuck' acts on the world, which"),
    (["--recorded", "--inject", "{full}"], r"faults\.cable: 'bus saturated' acts on the world, which"),
    (["--recorded", "--inject", "{late}"], r"faults\.cable: 'commands 300 ms late' acts on the world, which"),
    (["--seed", "-1"], r"'-1' is not a whole number from 0 on"),
]
# fmt: on


@pytest.mark.parametrize(("given", "told"), WRONG)
def test_wrong_arguments_are_told_before_anything_runs(
    given: list[str], told: str, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text(CABLE.replace("device silent", "device silnt"))
    world = tmp_path / "world.toml"
    world.write_text(CABLE.replace("device silent", "encoder stuck"))
    full = tmp_path / "full.toml"
    full.write_text(CABLE.replace("device silent", "bus saturated"))
    late = tmp_path / "late.toml"
    late.write_text(CABLE.replace("device silent", "commands 300 ms late"))
    status: object
    try:
        status = main(
            ["again", str(recorded), *(one.format(file, world=world, full=full, late=late) for one in given)]
        )
    except SystemExit as error:
        status = error.code
    printed = capsys.readouterr()
    assert status == 2, printed
    assert re.search(told, printed.err), printed.err


# fmt: off
NO_SHARDS = [
    # runs, and what is told
    ([[0, 1.0, 1, {}]], "not what `gateway again --sweep … --json` writes"),
    ([[0, 1.0, 1, 3]], "not what `gateway again --sweep … --json` writes"),
    ([["x", 1.0, 1, {"figures": {}, "held": {}}]], "not what `gateway again --sweep … --json` writes"),
    ([[0, 1.0, 1, {"figures": {"faults": "z"}, "held": {}}]], "not what `gateway again --sweep …"),
    ([[0, 1.0, 1, {"figures": {}, "held": {}}]] * 2, "run 0 of the sweep is there more than once"),
]
# fmt: on


@pytest.mark.parametrize(("runs", "told"), NO_SHARDS)
def test_what_is_no_shard_of_a_sweep_is_told(
    runs: list[object], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    part = tmp_path / "part.json"
    part.write_text(json.dumps({"setting": "k", "runs": runs}))
    assert main(["again", str(part)]) == 2
    assert told in capsys.readouterr().err


def test_a_setting_is_changed_where_it_stands_or_added() -> None:
    text = resources.find("robots", "bench").read_text()
    for key, value in (
        ("rate_hz", 100),
        ("motors.left.limits.velocity", 7.5),
        ("motors.right.following_time_ms", 300),
        ("brain.health.give_up_ms", 4000),
    ):
        changed = with_setting(text, key, value)
        differing = set(changed.splitlines()) ^ set(text.splitlines())
        assert 1 <= len(differing) <= 3, differing
    assert parse_robot(with_setting(text, "motors.left.limits.velocity", 7.5), "x").motors[
        "left"
    ].joint.limits.velocity == pytest.approx(7.5)
    assert "# comment" in with_setting("[a]\nb = 1  # comment\n", "a.b", 2)
    for broken in ("a = {b = 1}\n", "[[a]]\nb = 1\n", 'a.b = """\n1"""\n'):
        with pytest.raises(UserError, match=r"a\.b: cannot be changed where it stands"):
            with_setting(broken, "a.b", 2)
