"""`gateway scenario`: what happens to a robot when, and what must hold, from files; as a test suite."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from gateway.cli import arguments
from gateway.cli.terminal.progress import progress
from gateway.config import with_interfaces
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.recording.new_file import replace_with
from gateway.report.junit import junit_xml
from gateway.runtime.scenario import ScenarioResult, run_scenario
from gateway.runtime.scenario_file import Scenario, load_scenario, scenarios_in


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = "scenario files, folders of them, and names of scenarios that ship with the gateway"
    parser.add_argument("paths", nargs="+", metavar="FILE", help=text)
    arguments.add_bus(parser, "put a bus on another interface: can0=socketcan:vcan0")
    arguments.add_real(parser)
    parser.add_argument("--junit", type=Path, metavar="FILE", help="write the results as JUnit's XML")
    text = "record each run in this folder, as SCENARIO.mcap, which must not exist yet"
    parser.add_argument("--record", type=Path, metavar="FOLDER", help=text)


def run(options: Namespace) -> int:
    """Return 1 unless all that must hold held in every scenario."""
    if options.record is not None and not options.record.is_dir():
        raise UserError(f"--record {options.record}: there is no such folder")

    def adapt(robot: Robot) -> Robot:
        return with_interfaces(robot, dict(options.bus))

    loaded = [load_scenario(path, adapt, options.real) for path in scenarios_in(options.paths)]
    results: list[ScenarioResult] = []
    with progress("scenarios", len(loaded)) as shown:
        for one in loaded:
            results.append(run_scenario(one, _recording(one, options.record)))
            shown.update(len(results))
    for result in results:
        print("\n  ".join([result.line, *result.details, *result.latencies]))
    good = sum(one.passed for one in results)
    print(f"{good} of {len(results)} scenarios went as they must")
    if options.junit is not None:
        _write_junit(options.junit, results)
    return 0 if good == len(results) else 1


def _recording(scenario: Scenario, folder: Path | None) -> Path | None:
    return None if folder is None else folder / f"{scenario.path.stem}.mcap"


def _write_junit(path: Path, results: list[ScenarioResult]) -> None:
    cases = [(str(one.scenario.path), "" if one.passed else one.line, one.details) for one in results]
    try:
        replace_with(path, junit_xml("gateway scenario", "scenarios", cases).encode())
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from error
