"""`gateway judge`: recordings as a test suite: each through the code of today, against what is expected."""

from __future__ import annotations

import json
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from gateway.buses.log_file import is_log
from gateway.cli import arguments
from gateway.cli.only import add_only, check_only, only
from gateway.cli.tasks import Engine, add_engine, run_tasks
from gateway.cli.terminal.progress import progress
from gateway.config import load_robot
from gateway.core.message_text import escaped
from gateway.core.robot import Robot
from gateway.errors import GatewayError, RecordingError, UserError
from gateway.recording.new_file import replace_with
from gateway.report import judge
from gateway.report.judge import Judged, Verdict
from gateway.report.part_versions import part_compared
from gateway.report.self_test import self_test
from gateway.report.two_versions import Parted, compared, settings_apart, version
from gateway.runtime.process import quiet_collector

TASK = 1_000_000
"""Bytes of recordings from which on a process of its own is worth its start"""


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = "recordings of this gateway or of other programs, and folders of them"
    parser.add_argument("paths", nargs="+", type=Path, metavar="FILE", help=text)
    text = "write what is expected of each: what it gives now; edited tolerances stay"
    parser.add_argument("--update", action="store_true", help=text)
    text = "name the other files of the folders, too, and why they are not judged"
    parser.add_argument("--all", action="store_true", help=text)
    text = "where what is expected is (default: beside each recording)"
    parser.add_argument("--expected", type=Path, metavar="FOLDER", help=text)
    parser.add_argument("--robot", metavar="ROBOT", help="use this robot file instead of the recorded ones")
    text = "other bytes pass, too, if every figure is within its tolerance"
    parser.add_argument("--within", action="store_true", help=text)
    add_engine(parser)
    text = "judge every Nth recording, from the Ith on: of several machines, each another I of 1 to N"
    parser.add_argument("--shard", type=arguments.shard, default=(1, 1), metavar="I/N", help=text)
    text = "judge the judge: put into copies of each recording what must be found, and tell whether it is"
    parser.add_argument("--self-test", action="store_true", help=text)
    text = "compare with another version of the program: a revision, or a folder that has its rooms"
    parser.add_argument("--against", metavar="REV", help=text)
    add_only(parser)
    text = "write the results to a file; several of them, in the place of recordings, are one report"
    parser.add_argument("--json", type=Path, metavar="FILE", help=text)
    parser.add_argument("--report", type=Path, metavar="FILE", help="write the verdicts as Markdown")
    parser.add_argument("--junit", type=Path, metavar="FILE", help="write the verdicts as JUnit's XML")


def run(options: Namespace) -> int:
    """Return 1 unless all are as expected."""
    if options.expected is not None and not options.expected.is_dir():
        raise UserError(f"--expected {options.expected}: there is no such folder")
    check_only(options, ("update", "all", "expected", "within", "self_test", "json", "junit"))
    if options.engine != Engine() and (options.only or options.against or options.self_test):
        raise UserError("--jobs and --engine: only whole recordings are judged side by side; leave them away")
    with quiet_collector():
        return _only(options) if options.only is not None else _judge(options)


def _judge(options: Namespace) -> int:
    """Judge whole recordings."""
    robot = None if options.robot is None else load_robot(options.robot, recorded=True)
    if options.self_test:
        return _self_test(options)
    if options.against is not None:
        return _against(options, robot)
    if all(path.suffix == ".json" for path in options.paths):
        results, others = [one for path in options.paths for one in _results(path)], []
    else:
        first, of = options.shard
        every = judge.recordings_in(options.paths)
        others = judge.others_in(options.paths, every) if options.all else []
        paths = every[first - 1 :: of]
        if not paths and of == 1:
            raise UserError(f"no recording in {', '.join(map(str, options.paths))}")
        results = []
        with progress("judge, recordings", len(paths)) as shown:
            ways = (judge.judge(path, robot) for path in paths)
            for one in ways if options.engine == Engine() else _side_by_side(paths, options):
                results.append(one)
                shown.update(len(results))
    results.sort(key=lambda one: one.name)
    if options.json is not None:
        _write(options.json, json.dumps([judge.to_json(one) for one in results], indent=1, sort_keys=True))
    verdicts = [_verdict(one, options) for one in results]
    for verdict in verdicts:
        print(verdict.line)
        for change in verdict.changes:
            print("  " + change.replace("\n", "\n  "))
    for path, what in others:
        print(f"{path}: not judged: {what}")
    good = sum(_passes(one, options) for one in verdicts)
    print(f"{good} of {len(verdicts)} recordings are as expected")
    if options.report is not None:
        _write(options.report, judge.markdown(verdicts, others))
    if options.junit is not None:
        _write(options.junit, judge.junit(verdicts, lambda one: _passes(one, options)))
    return 0 if good == len(verdicts) else 1


def _self_test(options: Namespace) -> int:
    """Return 0 if all that the judge claims is shown on each recording."""
    for name in ("update", "all", "expected", "within", "json", "junit", "against", "robot", "report"):
        if getattr(options, name):
            raise UserError(f"--self-test tries the judge itself: leave --{name} away")
    shown = []
    for path in [one for one in judge.recordings_in(options.paths) if judge.is_ours(one)]:
        checks = self_test(path)
        print("\n".join(map(escaped, [f"{path}:", *(f"  {one.line}" for one in checks)])))
        shown += [one.shown for one in checks]
    if not shown:
        raise UserError(f"no recording of this gateway in {', '.join(map(str, options.paths))}")
    return 0 if all(shown) else 1


def _only(options: Namespace) -> int:
    """Return 0 if one part alone makes of each recording what was recorded, or what it makes in another
    version (of the guard without one: allows it)."""
    found: list[tuple[Path, list[str], bool]] = []
    first, of = options.shard
    part, against = options.only, options.against
    logs = part == "guard" and against is None
    paths = [
        one for one in judge.recordings_in(options.paths) if judge.is_ours(one) or (logs and is_log(one))
    ]
    paths = paths[first - 1 :: of]
    if not paths:
        raise UserError(f"no recording of this gateway in {', '.join(map(str, options.paths))}")
    with ExitStack() as stack:
        before = None if against is None else stack.enter_context(version(against))
        shown = stack.enter_context(progress("judge, recordings", len(paths)))
        for path in paths:
            try:
                if before is None:
                    found.append((path, *only(path, options)))
                else:
                    apart = part_compared(path, before, part)
                    found.append((path, apart.lines(), apart.same))
            except GatewayError as error:
                found.append((path, [f"NOT RUN: {error}"], False))
            shown.update(len(found))
    lines = [line for path, told, _ in found for line in (f"{path}:", *(f"  {one}" for one in told))]
    good = sum(same for *_, same in found)
    what = (
        "would have been allowed" if logs else "give the same" + f" as in {against}" * (against is not None)
    )
    lines.append(f"{part} alone: {good} of {len(found)} recordings {what}")
    print("\n".join(map(escaped, lines)))
    if options.report is not None:
        _write(options.report, f"# {part} alone\n\n```\n" + "\n".join(lines) + "\n```\n")
    return 0 if good == len(found) else 1


def _against(options: Namespace, robot: Robot | None) -> int:
    """Compare two versions of the program, or two robot files: 0 if they send the same."""
    for name in ("update", "all", "expected", "within", "json", "junit"):
        if getattr(options, name):
            raise UserError(
                f"--against compares with another version, not with what is expected: leave --{name} away"
            )
    first, of = options.shard
    paths = [one for one in judge.recordings_in(options.paths) if judge.is_ours(one)][first - 1 :: of]
    if not paths:
        raise UserError(f"no recording of this gateway in {', '.join(map(str, options.paths))}")
    found, lines = [], list[str]()
    with version(options.against) as folder, progress("judge, recordings", len(paths)) as shown:
        for path in paths:
            try:
                found += [compared(path, folder)]
                found += [settings_apart(path, robot)] if robot is not None else []
            except RecordingError as error:
                found.append(Parted(str(path), error=str(error)))
            shown.update(len(found))
    lines = [line for one in found for line in one.lines()]
    print("\n".join(map(escaped, lines)))
    if options.report is not None:
        _write(options.report, f"# Against {options.against}\n\n```\n" + "\n".join(lines) + "\n```\n")
    return 0 if all(one.tick is None and not one.error for one in found) else 1


def _passes(one: Verdict, options: Namespace) -> bool:
    return one.status == "same" or (one.status == "within" and options.within)


def _verdict(one: Judged, options: Namespace) -> Verdict:
    file = judge.expected_file(Path(one.name), options.expected)
    expected = judge.read_expected(file)
    if options.update and not one.error:
        judge.write_expected(file, one, expected)
        expected = judge.read_expected(file)
    return judge.verdict(one, expected)


def _side_by_side(paths: Sequence[Path], options: Namespace, least: int = TASK) -> Iterator[Judged]:
    """Judge recordings in other processes, `least` bytes in each; where one dies, each of its recordings in
    one of its own: what kills that too has that as its error."""
    groups: list[list[Path]] = []
    size = least
    for path in paths:
        if size >= least:
            groups.append([])
            size = 0
        groups[-1].append(path)
        size += path.stat().st_size if path.is_file() else least
    more = () if options.robot is None else ("--robot", options.robot)
    tasks = [["judge", *map(str, group), *more] for group in groups]
    for group, (text, error) in zip(groups, run_tasks(tasks, options.engine), strict=True):
        if not error:
            yield from map(judge.from_json, json.loads(text))
        elif len(group) > 1:
            yield from _side_by_side(group, options, 0)
        else:
            yield Judged(str(group[0]), "", error=error)


def _results(path: Path) -> list[Judged]:
    try:
        return [judge.from_json(one) for one in json.loads(path.read_text())]
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(f"{path}: not what `gateway judge --json` writes: {error}") from error


def _write(path: Path, text: str) -> None:
    try:
        replace_with(path, text.encode())
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from error
