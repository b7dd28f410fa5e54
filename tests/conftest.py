"""What did not run for want of something outside (a recording, a kernel's driver) is told last, by name.

A test says so by skipping with a reason that begins with "NOT RUN: "."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import settings

settings.register_profile("busy", deadline=None)  # no test judges the clock: the machine may be busy
settings.load_profile("busy")

PREFIX = "NOT RUN: "


def not_run(reasons: list[str]) -> list[str]:
    """Each thing that did not run, once, with how many tests were about it."""
    reported = [reason.removeprefix("Skipped: ") for reason in reasons]
    named = [reason for reason in reported if reason.startswith(PREFIX)]
    counts = {reason: named.count(reason) for reason in dict.fromkeys(named)}
    return [f"{reason} ({count} test{'s' * (count > 1)})" for reason, count in counts.items()]


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Iterator[None]:
    """After pytest's own summary; also from the workers of pytest-xdist, whose reports come here."""
    yield
    skipped = terminalreporter.stats.get("skipped", [])
    reasons = [str(report.longrepr[2]) for report in skipped if isinstance(report.longrepr, tuple | list)]
    if lines := not_run(reasons):
        terminalreporter.section("not run", yellow=True, bold=True)
        for line in sorted(lines):
            terminalreporter.line(line)
