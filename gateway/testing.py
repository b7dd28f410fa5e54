"""A plugin of pytest: recordings and scenarios as tests, and a robot's session as a fixture.

`pytest --replay FOLDER` runs recordings, as `gateway judge` does: each in the folder (or each file that is
named) is a test. Its inputs go through the code of today, and bytes and figures are compared with what is
expected of it (`gateway judge --update` writes that). `pytest --scenario FOLDER` runs scenarios, as `gateway
scenario` does. In tests of your own:

    @pytest.mark.scenarios("scenarios")          # a folder or files, beside the test's own
    def test_the_robot(scenario):                # one test for each
        scenario.run()                           # raises, unless all that must hold held

    @pytest.mark.robot("diffbot")                # this, and what else is given, as `open_session` takes it
    def test_it_drives(session):                 # simulated, and as fast as the machine can
        session.submit(Goal(1.0, 0.0))

Nothing of the gateway is imported unless something of this is used.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from gateway.runtime.scenario import ScenarioResult
    from gateway.runtime.scenario_file import Scenario
    from gateway.runtime.session import Session


class UnexpectedError(Exception):
    """A recording, or a scenario, is not as expected."""

    def __init__(self, line: str, details: Sequence[str]) -> None:
        super().__init__("\n  ".join([line, *details]))


def holds(condition: str, recording: Path | str) -> bool:
    """Return whether a condition holds of a recording's inputs, with the code of today.

    Args:
        condition: as `gateway minimise --while` takes it: "tells silent", "raises", "final x < 0.5".
        recording: of this gateway.
    """
    from gateway.recording import read_recording
    from gateway.replay.input_log import input_log
    from gateway.report.condition import condition as condition_of

    return condition_of(condition).first(input_log(read_recording(recording))) is not None


class FileItem(pytest.Item):
    """A file that is a test."""

    kind = ""

    def __init__(self, *, file: Path, **known: Any) -> None:  # noqa: ANN401 -- of pytest
        super().__init__(**known)
        self.file = file

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:  # noqa: ANN401
        """Return what differs, without a traceback."""
        if isinstance(excinfo.value, UnexpectedError):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, None, str]:
        """Return what it is called in a report."""
        return self.file, None, f"{self.kind} {self.file}"


class Replayed(FileItem):
    """One recording."""

    kind = "recording"

    def runtest(self) -> None:
        """Judge it."""
        from gateway.report import judge

        folder = self.config.getoption("--replay-expected")
        expected = judge.read_expected(judge.expected_file(self.file, folder))
        verdict = judge.verdict(judge.judge(self.file), expected)
        passes = ("same", "within") if self.config.getoption("--replay-within") else ("same",)
        if verdict.status not in passes:
            raise UnexpectedError(verdict.line, verdict.changes)


class RunScenario(FileItem):
    """One scenario file."""

    kind = "scenario"

    def runtest(self) -> None:
        """Run it."""
        ScenarioRun(self.file).run()


class ScenarioRun:
    """A scenario file, as a test has it."""

    def __init__(self, file: Path) -> None:
        self.file = file

    @property
    def scenario(self) -> Scenario:
        """What the file says. Raises ConfigError for a wrong one."""
        from gateway.runtime.scenario_file import load_scenario

        return load_scenario(self.file)

    def run(self, record: Path | None = None) -> ScenarioResult:
        """Run it, and record that if a file is named.

        Raises UnexpectedError unless all that must hold held."""
        from gateway.runtime.scenario import run_scenario

        result = run_scenario(self.scenario, record)
        if not result.passed:
            raise UnexpectedError(result.line, result.details)
        return result


def pytest_configure(config: pytest.Config) -> None:
    """Declare the marks."""
    config.addinivalue_line("markers", "scenarios(*paths): the files and folders of the fixture `scenario`")
    config.addinivalue_line("markers", "robot(robot, **more): of the fixture `session`, as `open_session`")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Make one test of each scenario file."""
    mark = metafunc.definition.get_closest_marker("scenarios")
    if mark is None or "scenario" not in metafunc.fixturenames:
        return
    files = _scenario_files([_beside(path, metafunc.definition.path) for path in mark.args])
    metafunc.parametrize("scenario", files, ids=[file.stem for file in files], indirect=True)


def _beside(path: str | Path, file: Path) -> str | Path:
    """Return a path as it counts from a file's folder; the name of what ships as it is."""
    beside = file.parent / path
    return beside if beside.exists() else path


@pytest.fixture
def scenario(request: pytest.FixtureRequest) -> ScenarioRun:
    """Return one of the scenarios of the mark `scenarios`."""
    if not hasattr(request, "param"):
        raise pytest.UsageError("the fixture `scenario` needs @pytest.mark.scenarios(FOLDER)")
    return ScenarioRun(request.param)


@pytest.fixture
def session(request: pytest.FixtureRequest) -> Iterator[Session]:
    """Return an open session of the robot of the mark `robot`, closed at the end."""
    from gateway.runtime.session import open_session

    mark = request.node.get_closest_marker("robot")
    if mark is None or len(mark.args) != 1:
        raise pytest.UsageError("the fixture `session` needs @pytest.mark.robot(ROBOT)")
    robot = _beside(mark.args[0], request.path) if isinstance(mark.args[0], str) else mark.args[0]
    with open_session(robot, **{"simulated": True, **mark.kwargs}) as opened:
        yield opened


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("motor-gateway", "recordings and scenarios as tests")
    text = "run these scenarios, or those in this folder, as tests; may be given several times"
    group.addoption("--scenario", action="append", default=[], metavar="FOLDER", help=text)
    text = "run these recordings, or those in this folder, as tests; may be given several times"
    group.addoption("--replay", action="append", default=[], type=Path, metavar="FOLDER", help=text)
    text = "where what is expected is (default: beside each recording)"
    group.addoption("--replay-expected", type=Path, default=None, metavar="FOLDER", help=text)
    text = "other bytes pass, too, if every figure is within its tolerance"
    group.addoption("--replay-within", action="store_true", help=text)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(session: pytest.Session, items: list[pytest.Item]) -> None:
    """Add a test for each recording, and for each scenario."""
    if names := session.config.getoption("--scenario"):
        items += [
            RunScenario.from_parent(session, name=f"scenario[{one}]", file=one)
            for one in _scenario_files(names)
        ]
    if paths := session.config.getoption("--replay"):
        items += _recordings(session, paths)


def _scenario_files(names: Sequence[str | Path]) -> list[Path]:
    from gateway.errors import GatewayError
    from gateway.runtime.scenario_file import scenarios_in

    try:
        return scenarios_in(names)
    except GatewayError as error:
        raise pytest.UsageError(f"scenarios: {error}") from error


def _recordings(session: pytest.Session, paths: list[Path]) -> Iterator[Replayed]:
    from gateway.errors import GatewayError
    from gateway.report import judge

    try:
        found = judge.recordings_in(paths)
    except GatewayError as error:
        raise pytest.UsageError(f"--replay: {error}") from error
    if not found:
        raise pytest.UsageError(f"--replay: no recording in {', '.join(map(str, paths))}")
    for file in found:
        yield Replayed.from_parent(session, name=f"replay[{file}]", file=file)
