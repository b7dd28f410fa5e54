"""`gateway again`: what a recording asks of its robot, asked again in the simulated world; sweeps of it."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from gateway.bench.again import drive_again, lasts, recorded_world, simulated
from gateway.bench.on_recording import run_spoilt
from gateway.cli import arguments
from gateway.cli.tasks import Engine, add_engine, run_tasks
from gateway.cli.terminal.progress import progress
from gateway.config import load_robot, parse_robot
from gateway.config.one_setting import with_settings
from gateway.config.resources import is_path
from gateway.config.text import read_text
from gateway.core.message_text import escaped
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.recording.new_file import replace_with
from gateway.replay.input_log import InputLog, input_log
from gateway.runtime.scenario_file import parse_faults
from gateway.sim import WorldFile, load_world

MOST_RUNS = 100_000
RECORDED = "recorded"
"""As a world: what was mapped in the recording"""
COLUMNS = (
    "goals reached",
    "faults",
    "ticks missed",
    "off the path, RMS",
    "error of the believed place, most",
    "nearest to anything",
    "touches",
)
"""Figures of a sweep's table; all are in --csv"""


class Sweep(NamedTuple):
    """A setting, and its values."""

    key: str
    values: tuple[float, ...]


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = "a recording of this gateway; or what --json wrote of the shards of a sweep"
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help=text)
    parser.add_argument("--robot", metavar="ROBOT", help="use this robot file instead of the recorded one")
    text = "faults, loads and walls that come meanwhile, and what must hold"
    parser.add_argument("--inject", type=Path, metavar="TOML", help=text)
    text = "with --inject: on the recorded inputs, by which no world answers"
    parser.add_argument("--recorded", action="store_true", help=text)
    text = (
        f"another world: {RECORDED}, made of the map of the recording; or a world's name, or its file or map"
    )
    parser.add_argument("--world", metavar="WORLD", help=text)
    arguments.add_settings(parser, "another value of a setting of the robot file")
    arguments.add_seed(parser)
    text = "record the run, in a file that must not exist yet"
    parser.add_argument("--record", type=Path, metavar="FILE", help=text)
    text = "drive again for each of N values of a setting, from A to B (or for VALUE,VALUE,…)"
    parser.add_argument("--sweep", type=sweep, metavar="KEY=A..B:N", help=text)
    text = "for each value with so many seeds of the world's noise (default: 1)"
    seeds = arguments.integer("a number from 1 to 1000", 1, 1000)
    parser.add_argument("--seeds", type=seeds, default=1, metavar="K", help=text)
    text = "drive every Nth of these runs, from the Ith on: of several machines, each another I of 1 to N"
    parser.add_argument("--shard", type=arguments.shard, default=(1, 1), metavar="I/N", help=text)
    add_engine(parser)
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write all figures of all runs as a table")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the sweep, as SVG or PNG")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results as JSON")


def run(options: Namespace) -> int:
    """Return 1 if something does not hold that must."""
    if all(path.suffix == ".json" for path in options.files):
        return _told(options, *_merged(options.files))
    if len(options.files) != 1:
        raise UserError("one recording at a time; of the shards of a sweep, what --json wrote")
    options.file = options.files[0]
    if options.recorded and options.world is not None:
        raise UserError("--recorded has no world: leave --world away")
    if options.recorded and (options.inject is None or options.sweep is not None or options.seeds != 1):
        raise UserError(
            "--recorded puts faults upon recorded inputs: give --inject, and no --sweep or --seeds"
        )
    if options.sweep is None and options.seeds == 1:
        for name, none in (("csv", None), ("plot", None), ("shard", (1, 1)), ("engine", Engine())):
            if getattr(options, name) != none:
                named = "jobs and --engine are" if name == "engine" else f"{name} is"
                raise UserError(f"--{named} of a sweep: give --sweep KEY=A..B:N, or --seeds K")
        return _once(options)
    if options.record is not None:
        raise UserError("--record is of one run: leave it, or --sweep and --seeds, away")
    return _sweep(options)


def _robot(options: Namespace) -> Robot:
    """Return the robot as it is to drive, all of it simulated."""
    if options.robot is None:
        recording = read_recording(options.file)
        text, name = recording.robot_text, f"{options.file}: robot.toml"
        robot = parse_robot(text, name)
    else:
        robot = load_robot(options.robot, recorded=True)
        text, name = robot.text, str(options.robot)
    return simulated(parse_robot(with_settings(text, options.set), name) if options.set else robot)


def _once(options: Namespace) -> int:
    robot, log = _robot(options), input_log(read_recording(options.file))
    file = options.inject or Path("nothing.toml")
    text = "" if options.inject is None else read_text(options.inject)
    scenario = parse_faults(text, file, robot, max(0.1, lasts(log)), world=_world(options.world, log))
    if options.recorded:
        found = run_spoilt(replace(log, robot_text=robot.text, robot=robot), scenario, options.record)
    else:
        found = drive_again(log, scenario, options.record, options.seed)
    if options.json is not None:
        result = {
            "figures": {name: figure.value for name, figure in found.figures.items()},
            "held": {one.name: one.holds for one in found.verdicts},
            "bytes": found.digests,
        }
        _write(options.json, json.dumps(result, sort_keys=True))
    for line in found.told:
        print(escaped(line))
    for name, figure in found.figures.items():
        print(escaped(f"{name}: {figure.value:.6g} {figure.unit}".rstrip()))
    for one in found.verdicts:
        print(escaped(f"{'held' if one.holds else 'DID NOT HOLD'}: {one.name}: {one.text}"))
    return 0 if found.passed else 1


def _world(given: str | None, log: InputLog) -> WorldFile | None:
    """Return the world that is asked for; None: the robot's."""
    if given is None:
        return None
    return recorded_world(log) if given == RECORDED else load_world(given)


def _sweep(options: Namespace) -> int:
    """Drive again for each value and seed, and tell what comes of each value."""
    key, values = options.sweep or Sweep("", (0.0,))
    if len(values) * options.seeds > MOST_RUNS:
        raise UserError(f"{len(values)} values with {options.seeds} seeds are more than {MOST_RUNS} runs")
    for value in values if key else ():  # all mistakes before the first run
        _robot(Namespace(**{**vars(options), "set": [*options.set, (key, value)]}))
    first, (part, of) = (1 if options.seed is None else options.seed), options.shard
    every = [(value, seed) for value in values for seed in range(first, first + options.seeds)]
    runs = [*enumerate(every)][part - 1 :: of]
    tasks = [[*_arguments(options, key, value), "--seed", str(seed)] for _, (value, seed) in runs]
    rows: list[Row] = []
    with progress("again, runs", len(tasks)) as shown:
        for (place, (value, seed)), (text, error) in zip(runs, run_tasks(tasks, options.engine), strict=True):
            if error:
                raise UserError(f"{_named(key, value)} with seed {seed}: {error}")
            rows.append(_row((place, value if key else 0.0, seed, json.loads(text))))
            shown.update(len(rows))
    return _told(options, key, rows)


class Row(NamedTuple):
    """What came of one run."""

    place: int
    """Among all of the sweep"""
    value: float
    seed: int
    result: Mapping[str, Any]


def _told(options: Namespace, key: str, rows: Sequence[Row]) -> int:
    """Tell, and write, what came of the runs."""
    if options.json is not None:
        _write(options.json, json.dumps({"setting": key, "runs": rows}, sort_keys=True))
    print("\n".join(map(escaped, table(key, rows))))
    if options.csv is not None:
        _write(options.csv, as_csv(key, rows))
    if options.plot is not None:
        from gateway.cli.picture import draw_sweep

        values = dict.fromkeys(row.value for row in rows)
        draw_sweep(key, {value: _of(rows, value) for value in values}, COLUMNS, options.plot)
    return 0 if all(all(row.result["held"].values()) for row in rows) else 1


def _merged(files: Sequence[Path]) -> tuple[str, list[Row]]:
    """Return the setting and the runs of the shards of a sweep. Raises UserError for what is none."""
    found: dict[str, list[Row]] = {}
    for file in files:
        try:
            part = json.loads(read_text(file))
            found.setdefault(str(part["setting"]), []).extend(map(_row, part["runs"]))
        except (ValueError, TypeError, KeyError) as error:
            raise UserError(f"{file}: not what `gateway again --sweep … --json` writes: {error}") from error
    if len(found) != 1:
        raise UserError(f"these are of several sweeps: {', '.join(sorted(found))}")
    ((key, rows),) = found.items()
    if twice := [place for place, count in Counter(row.place for row in rows).items() if count > 1]:
        raise UserError(f"run {min(twice)} of the sweep is there more than once: give each shard once")
    return key, sorted(rows, key=lambda row: row.place)


def _row(found: Any) -> Row:  # noqa: ANN401 -- of any kind
    """Return a run as it was written. Raises what is no such run: ValueError, TypeError or KeyError."""
    place, value, seed, result = found
    figures = {str(name): float(figure) for name, figure in dict(result["figures"]).items()}
    held = {str(name): bool(holds) for name, holds in dict(result["held"]).items()}
    return Row(int(place), float(value), int(seed), {**result, "figures": figures, "held": held})


def table(key: str, rows: Sequence[Row]) -> Iterator[str]:
    """Yield the lines of a sweep's table: of each figure the mean, and the lowest and highest value."""
    names = [name for name in COLUMNS if any(name in row.result["figures"] for row in rows)]
    yield " | ".join([key or "seeds", "runs", "held", *names])
    for value in dict.fromkeys(row.value for row in rows):
        found = _of(rows, value)
        held = sum(all(one["held"].values()) for one in found)
        cells = [f"{value:g}" if key else "all", str(len(found)), str(held)]
        for name in names:
            numbers = [one["figures"][name] for one in found if name in one["figures"]]
            mean, low, high = math.fsum(numbers) / max(1, len(numbers)), min(numbers), max(numbers)
            cells.append(f"{mean:.4g}" if low == high else f"{mean:.4g} ({low:.4g} to {high:.4g})")
        yield " | ".join(cells)


def as_csv(key: str, rows: Sequence[Row]) -> str:
    """Return all figures of all runs, a row for each run."""
    names = list(dict.fromkeys(name for row in rows for name in row.result["figures"]))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([key or "value", "seed", *names])
    for _, value, seed, result in rows:
        figures = [result["figures"].get(name, "") for name in names]
        whole = [int(one) if one != "" and one.is_integer() else one for one in figures]
        writer.writerow([f"{value:g}" if key else "", seed, *whole])
    return out.getvalue()


def _of(rows: Sequence[Row], value: float) -> list[Mapping[str, Any]]:
    return [row.result for row in rows if row.value == value]


def _arguments(options: Namespace, key: str, value: float) -> list[str]:
    """Return the arguments of one run."""
    found = ["again", str(options.file.absolute())]
    if options.robot is not None:
        path = Path(options.robot)
        found += ["--robot", str(path.absolute() if path.exists() else path)]
    if options.world is not None:
        found += ["--world", str(Path(options.world).absolute()) if is_path(options.world) else options.world]
    if options.inject is not None:
        found += ["--inject", str(options.inject.absolute())]
    for name, given in [*options.set, *[(key, value)] * bool(key)]:
        found += ["--set", f"{name}={json.dumps(given)}"]
    return found


def _named(key: str, value: float) -> str:
    return f"{key}={value:g}" if key else "the run"


def sweep(text: str) -> Sweep:
    """Return the key and the values of KEY=A..B:N, or of KEY=VALUE,VALUE."""
    key, _, rest = text.partition("=")
    number = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
    expected = f"{text!r} is not KEY=A..B:N, with N from 2 to 1000, or KEY=VALUE,VALUE"
    if key and (found := re.fullmatch(rf"({number})\.\.({number}):(\d{{1,4}})", rest)):
        a, b, count = float(found[1]), float(found[2]), int(found[3])
        if 2 <= count <= 1000:
            return Sweep(key, tuple(float(f"{a + (b - a) * i / (count - 1):.12g}") for i in range(count)))
    elif key and re.fullmatch(rf"{number}(?:,{number})*", rest):
        return Sweep(key, tuple(map(float, rest.split(","))))
    raise ArgumentTypeError(expected)


def _write(path: Path, text: str) -> None:
    try:
        replace_with(path, text.encode())
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from error
