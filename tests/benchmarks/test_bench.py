"""The bench: that all of it is measured, that rivals do the same work, that the table tells what it should.

No time is judged here. One quick run of the whole (with its processes and its recording, on a wall clock) is
shared by the tests that look at its outcome; they are run by `./go prove`.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.csgraph

from benchmarks import (
    arms,
    bridge,
    cars,
    codec,
    drive,
    drivers,
    latency,
    lines,
    loops,
    measure,
    paths,
    perceive,
    plans,
    process,
    rivals,
    rows,
    steps,
    view,
)
from benchmarks.__main__ import main
from benchmarks.measure import Effort, Figures, NotMeasured, Rival
from benchmarks.rows import Beside, Row, Target
from benchmarks.samples import odrive_can as samples
from brain.perception import engine
from brain.perception.body_scan import to_body
from brain.perception.map import Map, MapSettings
from brain.perception.mount import Mount
from brain.planning.footprint import Footprint
from gateway import config
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, SECOND, Feedback, Position, Velocity

STARTS = ["gateway --help", "gateway run bench: first frame out", "gateway run diffbot: first frame out"]
MEMORIES = [
    "gateway run bench, on its buses",
    "gateway run diffbot, on its buses",
    "gateway run diffbot --fast --seconds 10",
]
STEPS = [
    "2 motors, velocity",
    "12 motors, velocity",
    "12 motors, position",
    "12 Damiao in MIT mode, position",
    "12 RobStride in MIT mode, position",
    "12 moteus, velocity",
    "12 CiA 402, velocity",
]
LANGUAGES = codec.languages()
TARGETS = {
    "gateway --help",
    "gateway run bench: first frame out",
    "gateway run diffbot: first frame out",
    "12 motors, velocity",
    "12 motors, position",
    process.NOTHING,
    "processor time of both",
    view.BOTH,
    *lines.WHAT,
    *plans.what(plans.SIZES[0])[::3],
    *(sample.what for _, language in LANGUAGES for sample in language.SAMPLES),
}


# -- the whole of it ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """What a quick run has left."""

    status: int
    printed: str
    document: dict[str, Any]

    @property
    def rows(self) -> list[dict[str, Any]]:
        made: list[dict[str, Any]] = self.document["rows"]
        return made


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    file = tmp_path_factory.mktemp("bench") / "figures.json"
    with pytest.MonkeyPatch.context() as patch:
        said: list[str] = []
        patch.setattr("builtins.print", lambda *parts, **_: said.append(" ".join(map(str, parts))))
        status = main(["--quick", "--json", str(file)])
    return Run(status, "\n".join(said), json.loads(file.read_text(encoding="utf-8")))


@pytest.mark.prove
def test_every_row_is_there_once_and_in_order(run: Run) -> None:
    assert run.status == 0
    assert [row["what"] for row in run.rows] == [
        *STARTS,
        *MEMORIES,
        process.NOTHING,
        *STEPS,
        *(f"a tick: {name}" for name in STEPS),
        *(f"a frame: {name}" for name in STEPS),
        *loops.WHAT,
        *(latency.WHAT.format(rate) for rate in latency.RATES),
        *(what.format(name) for name in drivers.OPTIONS for what in drivers.WHAT),
        *(sample.what for _, language in LANGUAGES for sample in language.SAMPLES),
        bridge.SENT,
        bridge.RECEIVED,
        *lines.WHAT,
        "one predict and update, gated",
        "cells of 0.05 m, beams of up to 12 m",
        "200 × 200 cells",
        "1000 × 1000 cells",
        *plans.what(plans.SIZES[0]),
        cars.WHAT,
        *arms.WHAT,
        *drive.KINDS,
        *drive.REPLAYS,
        *drive.PARTS,
        view.NOBODY,
        view.PAGE,
        view.BOTH,
    ]


@pytest.mark.prove
def test_the_document_says_of_each_row_what_was_measured_or_why_not(run: Run) -> None:
    assert set(run.document) == {"format", "quick", "machine", "rows"}
    assert (run.document["format"], run.document["quick"]) == (1, True)
    for row in run.rows:
        assert set(row) == {"group", "what", "ours", "not_run", "beside", "target"}
        assert (row["ours"] is None) == bool(row["not_run"])
        for side in (row, *row["beside"]):
            reported = side["ours"] if side is row else side["theirs"]
            assert (reported is None) == bool(side["not_run"])
            if reported is not None:
                assert set(reported) == {"median", "p99", "samples", "unit"}
                assert 0.0 < reported["median"] <= reported["p99"] < math.inf
                assert reported["samples"] >= 1


@pytest.mark.prove
def test_ratios_are_finite_and_theirs_by_ours(run: Run) -> None:
    ratios = [(row, other) for row in run.rows for other in row["beside"] if other["ratio"] is not None]
    assert len(ratios) >= 25
    for row, other in ratios:
        assert 0.0 < other["ratio"] < math.inf
        assert other["ratio"] == pytest.approx(other["theirs"]["median"] / row["ours"]["median"])


@pytest.mark.prove
def test_every_row_that_ran_stands_beside_something(run: Run) -> None:
    assert all(row["beside"] for row in run.rows if row["ours"] is not None)


@pytest.mark.prove
def test_every_target_of_the_project_is_judged(run: Run) -> None:
    assert {row["what"] for row in run.rows if row["target"]} == TARGETS
    assert all(row["target"]["met"] in (True, False) for row in run.rows if row["target"])


@pytest.mark.prove
def test_what_is_not_installed_is_told_by_name(run: Run) -> None:
    """scikit-image is no dependency of ours: it may be there or not, but it is always spoken of."""
    there = not measure.rival("skimage", "scikit-image").why_not
    others = [other for row in run.rows for other in row["beside"] if "scikit-image" in other["what"]]
    assert len(others) == (5 if there else 3)
    assert all((other["ratio"] is not None) == there for other in others)
    assert there or all(other["not_run"] == "scikit-image is not installed" for other in others)


@pytest.mark.prove
def test_the_machine_is_told(run: Run) -> None:
    machine = run.document["machine"]
    assert {"python", "platform", "load average", "processors", "preemptions", "seconds"} <= set(machine)
    assert f"Python {machine['python'].split()[0]}" in run.printed
    assert "--quick: these figures are rough" in run.printed


@pytest.mark.prove
def test_the_table_has_a_line_for_every_comparison(run: Run) -> None:
    table = run.printed.splitlines()
    for row in run.rows:
        group = table.index(row["group"])
        first = next(i for i in range(group, len(table)) if f"  {row['what']}  " in table[i])
        assert all(other["what"] in table[first + n] for n, other in enumerate(row["beside"]))


def test_a_file_that_cannot_be_written_is_told_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--json", str(tmp_path / "no" / "figures.json")]) == 2
    reported = capsys.readouterr()
    assert "figures.json" in reported.err
    assert "measuring" not in reported.out


# -- measuring ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("samples", "median", "p99"),
    [
        ([7.0], 7.0, 7.0),
        ([3.0, 1.0], 2.0, 3.0),
        ([3.0, 1.0, 2.0], 2.0, 3.0),
        (list(map(float, range(100, 0, -1))), 50.5, 99.0),
        (list(map(float, range(1, 1001))), 500.5, 990.0),
    ],
)
def test_median_and_nearest_rank(samples: list[float], median: float, p99: float) -> None:
    assert measure.figures(samples) == Figures(median, p99, len(samples))


def test_contestants_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    clock = iter(range(0, 10**9, 2 * measure.LEAST_SAMPLE))
    monkeypatch.setattr(measure, "stopwatch", lambda: next(clock))
    found = measure.in_turn({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 3)
    assert order == ["a", "b"] + ["a", "b"] * 3
    assert found["a"] == Figures(2 * measure.LEAST_SAMPLE, 2 * measure.LEAST_SAMPLE, 3)


def test_what_is_quick_is_repeated_and_what_is_slow_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    now, called = 0, {"quick": 0, "slow": 0}

    def take(name: str, nanos: int) -> None:
        nonlocal now
        now += nanos
        called[name] += 1

    monkeypatch.setattr(measure, "stopwatch", lambda: now)
    contestants = {"quick": lambda: take("quick", 100), "slow": lambda: take("slow", measure.SLOW)}
    found = measure.in_turn(contestants, 2)
    assert called["slow"] == 2
    assert called["quick"] > 2 * measure.LEAST_SAMPLE / 100
    assert (found["quick"].median, found["slow"].median) == (100.0, measure.SLOW)
    assert found["quick"].samples == found["slow"].samples == 2


def test_a_rival_that_is_not_there_is_named() -> None:
    assert measure.rival("no_such_module", "no-such-package").why_not == "no-such-package is not installed"
    assert measure.rival("numpy.linalg", "numpy").name == f"numpy {np.__version__}"


# -- the table ------------------------------------------------------------------------------------

MICRO = Figures(2_000.0, 3_000.0, 10)
ROWS = [
    Row(
        "group",
        "what",
        MICRO,
        (Beside("theirs", Figures(5_000.0, 9_000.0, 10)), Beside("absent", None, "absent is not installed")),
        Target(ratio=2.0),
    ),
    Row("group", "in a tick", MICRO, (rows.span("a tick", 5e6),), Target(at_most=1_000.0)),
    Row("other", "memory", Figures(59e6, 60e6, 1, "B")),
    Row("other", "left", None, not_run="no such thing"),
]


def test_ratio_target_and_verdict() -> None:
    assert [row.ratio(other) for row in ROWS for other in row.beside] == [2.5, None, 2500.0]
    assert [row.met() for row in ROWS] == [True, False, None, None]
    absent = Row("g", "w", MICRO, (Beside("absent", None, "why"),), Target(ratio=2.0))
    assert absent.met() is None


def test_the_table_puts_ratios_first_and_says_what_was_not_run() -> None:
    assert [" ".join(line.split()) for line in rows.text(ROWS).splitlines() if line] == [
        "ratio median p99 beside its median its p99 target",
        "group",
        "2.5 what 2.00 µs 3.00 µs theirs 5.00 µs 9.00 µs ratio at least 2: met",
        "- absent not run absent is not installed",
        "2.5e+03 in a tick 2.00 µs 3.00 µs a tick 5.00 ms 5.00 ms at most 1.00 µs: MISSED",
        "other",
        "memory 59 MB 60 MB",
        "- left not run no such thing",
    ]


@pytest.mark.parametrize(
    ("nanos", "text"),
    [(12.0, "12 ns"), (999.4, "999 ns"), (1234.0, "1.23 µs"), (56_700.0, "56.7 µs"), (4.2e9, "4.20 s")],
)
def test_times_for_a_person(nanos: float, text: str) -> None:
    assert rows.shown(nanos, MICRO) == text


def test_a_document_is_json() -> None:
    made = rows.document(ROWS, {"machine": "here"}, quick=False)
    assert json.loads(json.dumps(made)) == made
    assert [row["target"] and row["target"]["met"] for row in made["rows"]] == [True, False, None, None]


# -- rivals do the same work ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("language", "sample"),
    [(language, sample) for _, language in LANGUAGES for sample in language.SAMPLES],
    ids=[f"{name}-{sample.what}" for name, language in LANGUAGES for sample in language.SAMPLES],
)
def test_all_sides_of_a_sample_come_to_the_same(language: codec.Language, sample: codec.Sample) -> None:
    known = codec.opened(language)
    assert not known.why_not
    call = codec.theirs(sample, known.module)
    assert sample.alike(sample.ours(), call(), sample.struct())
    assert sample.alike(sample.ours(), call(), sample.struct()), "a second time, as when measured"


def test_a_sample_tells_bytes_and_fields_apart() -> None:
    velocity, _, estimates, _ = samples.SAMPLES
    frame, good = velocity.ours(), velocity.data
    assert isinstance(frame, CanFrame)
    assert velocity.alike(frame, good, good)
    for wrong in ((replace(frame, id=1), good, good), (frame, b"", good), (frame, good, b"")):
        assert not velocity.alike(*wrong)
    assert estimates.alike(estimates.ours(), {"a": 1.25, "b": -0.5}, (1.25, -0.5))
    assert not estimates.alike(estimates.ours(), {"a": 1.25, "b": 0.5}, (1.25, -0.5))
    assert not estimates.alike(estimates.ours(), {"a": 1.25, "b": -0.5}, (1.25, 0.5))


def test_a_rival_in_another_process_answers_is_measured_there_and_ends_with_its_object() -> None:
    elsewhere = measure.Elsewhere("CALLS = {'two': lambda: bytes((1, 2)), 'none': lambda: 1 / 0}")
    call = elsewhere.call("two")
    assert call() == [1, 2]
    assert measure.sample(call, 1000) > 0.0
    with pytest.raises(NotMeasured, match="division by zero"):
        elsewhere.call("none")()
    process = elsewhere._process
    del elsewhere, call
    assert process.returncode is not None


def test_a_rival_elsewhere_that_is_not_installed_is_named() -> None:
    assert measure.rival_elsewhere("no-such-package", "").why_not == "no-such-package is not installed"


def test_a_sample_on_which_they_differ_is_not_measured() -> None:
    class Wrong:
        def encode_message(self, number: int, values: dict[str, float]) -> bytes:
            return b"\0" * 8

    with pytest.raises(NotMeasured, match="Set_Input_Vel"):
        codec.theirs(samples.SAMPLES[0], Wrong())


def test_without_its_package_a_dbc_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    (language,) = [found for name, found in LANGUAGES if name == "odrive_can"]
    monkeypatch.setattr(codec, "languages", lambda: [("odrive_can", language)])
    monkeypatch.setattr(samples, "DBC", ("no_such_package", "x.dbc"))
    found = codec.opened(language)
    assert (found.module, found.why_not) == (None, "no_such_package is not installed")
    monkeypatch.setattr(codec, "rival", lambda *_: Rival("cantools", None, "cantools is not installed"))
    assert {
        (row.beside[0].what, row.beside[0].not_run, row.beside[1].what)
        for row in codec.codec(Effort(quick=True))
    } == {("cantools", "cantools is not installed", "bare struct")}


def test_bare_filters_follow_ours() -> None:
    """Our arithmetic is the textbook's: to its last digits."""
    ours, (x, P, _, R, _) = engine.Structured(), perceive.RIVALS
    bare, plain = rivals.BareFilterpy(*perceive.RIVALS), rivals.PlainNumpy(*perceive.RIVALS)
    state, packed = tuple(x.tolist()), engine.pack(P)
    for _ in range(50):
        packed = ours.predict(packed, perceive.MOVE)
        innovation = 1e-4 - state[engine.TURN]
        state, packed, distance = ours.turn(state, packed, innovation, float(R[0, 0]))
        for rival in (bare, plain):
            assert rival.step(np.array([1e-4])) ** 2 == pytest.approx(distance, abs=1e-9)
    for found_x, found_P in ((bare.filter.x, bare.filter.P), (plain.x, plain.P)):
        np.testing.assert_allclose(found_x, state, atol=1e-9)
        np.testing.assert_allclose(found_P, engine.unpacked(packed), atol=1e-9)
    assert state[engine.TURN] > 5e-5


@pytest.mark.parametrize(
    ("start", "end", "cells"),
    [
        ((0, 0), (0, 0), [(0, 0)]),
        ((0, 0), (0, 3), [(0, 0), (0, 1), (0, 2), (0, 3)]),
        ((2, 2), (0, 0), [(2, 2), (1, 1), (0, 0)]),
        ((0, 0), (-4, 2), [(0, 0), (-1, 0), (-2, 1), (-3, 1), (-4, 2)]),
    ],
)
def test_bresenham(start: tuple[int, int], end: tuple[int, int], cells: list[tuple[int, int]]) -> None:
    assert len(rivals.bresenham(start, end)) == len(cells)
    assert rivals.bresenham(start, end)[0] == start
    assert rivals.bresenham(start, end)[-1] == end
    if abs(end[0] - start[0]) in (0, abs(end[1] - start[1])):
        assert rivals.bresenham(start, end) == cells


def test_the_loop_over_beams_sees_the_walls_that_our_map_sees() -> None:
    chart = Map(MapSettings())
    loop, drawn = perceive.loop_over(chart), perceive.loop_over(chart)
    pose = perceive.places()[3]
    swept = to_body(perceive.scan_at(pose), Mount(), chart.settings.farthest)
    chart.add(pose, swept, perceive.SURE)
    start, ends = perceive.cells_of(chart, pose, swept)
    loop.add(start, ends)
    drawn.add_by(_line, start, ends)
    np.testing.assert_allclose(drawn.log_odds, loop.log_odds, atol=1e-5)
    cells = np.arange(-perceive.AROUND, perceive.AROUND)
    ours = chart.values(cells, cells[:, None])
    walls, occupied = loop.log_odds > 0.0, ours > 0
    assert walls.sum() > 200
    assert (walls & occupied).sum() / (walls | occupied).sum() > 0.95
    free, near = loop.log_odds < 0.0, ours < 0  # its lines start in the middle of a cell: one cell beside
    for axis in (0, 1):
        near |= np.roll(near, 1, axis) | np.roll(near, -1, axis)
    assert (free & near).sum() / free.sum() > 0.99


def _line(row: int, column: int, to_row: int, to_column: int) -> tuple[list[int], list[int]]:
    """As skimage.draw.line has it."""
    cells = rivals.bresenham((row, column), (to_row, to_column))
    return [cell[0] for cell in cells], [cell[1] for cell in cells]


def test_what_a_lidar_sees_of_the_hall() -> None:
    assert perceive.reach(0.0, 5.0, 0.0) == pytest.approx(9.0)
    assert perceive.reach(8.0, 5.0, math.pi / 2.0) == pytest.approx(1.0)
    assert perceive.reach(3.0, 0.0, math.pi / 2.0) == pytest.approx(2.0 - 0.3)
    scan = perceive.scan_at(perceive.places()[0])
    assert len(scan.ranges) == perceive.BEAMS
    assert 0.5 < min(scan.ranges) < max(scan.ranges) < 12.0


@pytest.mark.parametrize("size", [40, 120])
def test_our_way_is_as_long_as_that_over_the_graph(size: int) -> None:
    blocked = paths.rooms(size)
    assert (blocked == paths.rooms(size)).all()
    assert 0.02 < blocked.mean() < 0.5
    ours = paths.ours(paths.ground_of(blocked), size)
    assert ours == pytest.approx(
        paths.length(scipy.sparse.csgraph, paths.graph(scipy.sparse, blocked)), abs=1e-9
    )
    assert ours > (size - 1) * math.sqrt(2.0)


def test_a_car_may_be_where_its_footprint_fits() -> None:
    ground = paths.ground_of(cars.pillars(), cars.CELL, cars.CAR)
    free, footprint = cars.Free(ground), Footprint(cars.CAR, cars.CELL)
    x, y, yaw = np.random.default_rng(5).uniform((0, 0, -4), (cars.LONG, cars.WIDE, 4), (3000, 3)).T
    hit = footprint.collides(ground, x, y, yaw)
    assert 0.02 < hit.mean() < 0.5
    assert [free.at(*pose) for pose in zip(x, y, yaw, strict=True)] == (~hit).tolist()
    assert not free.at(-0.1, 5.0, 0.0)
    assert not free.at(5.0, cars.WIDE, 0.0)


def test_motorbridge_and_ours_send_the_same_packets_and_receive_the_same_position() -> None:
    motorbridge = pytest.importorskip("motorbridge")
    packets = set()
    for client in (bridge.ours, bridge.theirs(motorbridge)):
        with bridge.line() as (far, _, path), client(path) as (send, position):
            packets.add(bridge.sending(send, far)())
            receive = bridge.receiving(position, far)
            assert [receive(), receive()] == list(bridge.FEEDBACK)
    assert len(packets) == 1


# -- steps, drives, processes ---------------------------------------------------------------------


def test_the_steps_that_count_are_those_of_every_motor() -> None:
    twelve = config.load_robot("twelve")
    robot = steps.first(twelve, 2)
    assert (len(twelve.motors), list(robot.motors), list(robot.buses)) == (
        12,
        list(twelve.motors)[:2],
        ["can0"],
    )
    _, ticks = steps.drive(robot, lambda motor: Velocity(motor, 5.0), 1)
    counting = steps.counting(ticks, robot)
    assert len(counting) > 40
    for tick in ticks:
        if tick.number in counting:
            assert tick.now >= steps.WARM
            assert len(tick.outputs.packets) >= 2
            assert {e.motor for e in tick.outputs.events if isinstance(e, Feedback)} == set(robot.motors)
    assert steps.counting(ticks, twelve) == set()


def test_a_paced_tick_takes_all_that_came_in_and_commands_again() -> None:
    robot = steps.first(config.load_robot("twelve"), 2)
    _, ticks = steps.drive(robot, lambda motor: Velocity(motor, 5.0), 1)
    found = steps.paced(robot, ticks)
    assert found.samples == len([tick for tick in ticks if tick.now >= steps.WARM]) // steps.WINDOW
    assert 0.0 < found.median < math.inf


@pytest.mark.sample(1)
@pytest.mark.parametrize("protocol", ["damiao", "robstride"])
def test_twelve_other_motors_are_commanded_as_springs(protocol: str) -> None:
    robot = steps.of_protocol(protocol, steps.SPRING)
    _, ticks = steps.drive(robot, lambda motor: Position(motor, 1.0), 1)
    assert len(steps.counting(ticks, robot)) > 40
    assert {motor.plugin.name for motor in robot.motors.values()} == {protocol}


@pytest.mark.sample(2)
@pytest.mark.parametrize("name", drivers.OPTIONS)
def test_four_motors_report_and_are_commanded(name: str) -> None:
    received, sent = drivers.timed(drivers.session(name, 3 * SECOND))
    assert len(sent) == SECOND // drivers.PERIOD
    assert len(received) >= 4 * 100


def test_polling_costs_no_steps_of_its_own() -> None:
    """Else every poll would send every set-point once more: with twelve motors, nearly twice the bus load."""
    twelve = config.load_robot("twelve")
    _, ticks = steps.drive(twelve, lambda motor: Velocity(motor, 5.0), 2)
    settled = [tick for tick in ticks if SECOND <= tick.now < 2 * SECOND]
    assert len(settled) == 200
    asked = sum(isinstance(p.frame, CanFrame) and p.frame.remote for t in settled for p in t.outputs.packets)
    assert 12 * 4 * 4 <= asked <= 12 * 4 * 6


@pytest.mark.sample(1)
@pytest.mark.parametrize("case", loops.CASES, ids=loops.WHAT)
def test_a_peer_s_loop_moves_the_same_motors(case: loops.Case) -> None:
    """Else it is not measured; one that sends nothing moves none."""
    made = loops.measured(case, 2)
    assert made.ours is not None
    (other,) = made.beside
    assert other.figures is not None
    assert other.figures.samples == made.ours.samples == 2
    still = replace(case, loop=lambda module, robot: lambda exchange: len(exchange([])) + len(robot.motors))
    with pytest.raises(NotMeasured, match="is at 0 rad and turns at 0 rad/s"):
        loops.measured(still, 1)


@pytest.mark.sample(1)
@pytest.mark.parametrize("rate", latency.RATES)
def test_a_set_point_follows_a_feedback(rate: int) -> None:
    found = latency.measured(rate, 1)
    assert found.samples > 1
    assert 0.0 < found.median < math.inf


def test_processor_time_of_an_idle_robot_is_of_its_own_second(monkeypatch: pytest.MonkeyPatch) -> None:
    assert 0 < process.while_idle(1) < 20 * SECOND
    monkeypatch.setattr(process, "NOTHING", "gateway run no-such-robot")
    with pytest.raises(NotMeasured, match="no-such-robot"):
        process.while_idle(1)


def test_figures_by_step_are_over_each_step_s_own_median() -> None:
    runs = [[10, 1, 900], [30, 2, 10], [20, 3, 10]]
    assert steps.figures_by_step(runs, {0, 2}) == Figures(15.0, 20.0, 2)


def test_without_a_world_its_rows_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    from gateway.sim import WorldError

    def no_world(_folder: Path, _seconds: int) -> drive.Drive:
        raise WorldError.about("office", ["MuJoCo is not installed"])

    monkeypatch.setattr(drive, "drive", no_world)
    made = drive.driving(Effort(quick=True))
    assert [row.what for row in made] == [*drive.KINDS, *drive.REPLAYS, *drive.PARTS]
    assert all(row.ours is None and "MuJoCo" in row.not_run for row in made)


def test_memory_of_a_process_is_the_kernel_s_own_figure() -> None:
    import os

    assert process.peak(os.getpid()) > 10e6
    assert process.peak(2**22 + 1) == 0


def test_a_process_that_fails_is_not_measured() -> None:
    with pytest.raises(NotMeasured, match="no such thing"):
        process.until_done(("-c", "raise SystemExit('no such thing')"))
    with pytest.raises(NotMeasured, match="ended with 3"):
        process.peak_until_done(("-c", "raise SystemExit(3)"))


def test_a_gateway_that_puts_nothing_on_its_bus_is_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "_address", lambda _: "slcan:/dev/no-such-port")
    with pytest.raises(NotMeasured, match="no-such-port"):
        process.until_first_frame("bench", SECOND)


def test_a_view_whose_clients_get_nothing_is_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view, "LEAST", dict.fromkeys(view.LEAST, 1 << 30))
    with pytest.raises(NotMeasured, match="nobody looks: 0 bytes"):
        view.costs(1)


def test_effort() -> None:
    assert (Effort().of(5, 1), Effort(quick=True).of(5, 1)) == (5, 1)
    assert measure.LEAST_SAMPLE < MILLISECOND
