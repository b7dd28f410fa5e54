"""A plugin of pytest: `pytest --replay FOLDER` runs recordings as tests, as `gateway judge` does.

Each recording in the folder (or each file that is named) is a test: its inputs go through the code of today,
and bytes and figures are compared with what is expected of it (`gateway judge --update` writes that). Nothing
of the gateway is imported unless the option is given.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

    from gateway.report.judge import Verdict


class UnexpectedError(Exception):
    """A recording is not as expected."""

    def __init__(self, verdict: Verdict) -> None:
        self.verdict = verdict
        super().__init__(verdict.line)


class Replayed(pytest.Item):
    """One recording."""

    def __init__(self, *, file: Path, **known: Any) -> None:  # noqa: ANN401 -- of pytest
        super().__init__(**known)
        self.file = file

    def runtest(self) -> None:
        """Judge it."""
        from gateway.report import judge

        folder = self.config.getoption("--replay-expected")
        expected = judge.read_expected(judge.expected_file(self.file, folder))
        verdict = judge.verdict(judge.judge(self.file), expected)
        passes = ("same", "within") if self.config.getoption("--replay-within") else ("same",)
        if verdict.status not in passes:
            raise UnexpectedError(verdict)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:  # noqa: ANN401
        """Return what differs, without a traceback."""
        if isinstance(excinfo.value, UnexpectedError):
            verdict = excinfo.value.verdict
            return "\n".join([verdict.line, *("  " + change for change in verdict.changes)])
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, None, str]:
        """Return what it is called in a report."""
        return self.file, None, f"recording {self.file}"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("motor-gateway", "recordings as tests")
    text = "run these recordings, or those in this folder, as tests; may be given several times"
    group.addoption("--replay", action="append", default=[], type=Path, metavar="FOLDER", help=text)
    text = "where what is expected is (default: beside each recording)"
    group.addoption("--replay-expected", type=Path, default=None, metavar="FOLDER", help=text)
    text = "other bytes pass, too, if every figure is within its tolerance"
    group.addoption("--replay-within", action="store_true", help=text)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(session: pytest.Session, items: list[pytest.Item]) -> None:
    """Add a test for each recording."""
    if paths := session.config.getoption("--replay"):
        items += _recordings(session, paths)


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
