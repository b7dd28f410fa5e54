"""What did not run for want of something outside (a recording, a kernel's driver) is told last, by name.

A test says so by skipping with a reason that begins with "NOT RUN: ".

`--shuffle SEED` and `--busy N` show that no test depends on the order, or on the schedule of the machine."""

from __future__ import annotations

import logging
import os
import random
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from tests import runs

settings.register_profile("busy", deadline=None)  # no test judges the clock: the machine may be busy
settings.load_profile("busy")

PREFIX = "NOT RUN: "
LONGEST = (
    "gateway/ros/test_judges.py",
    "test_guide.py",
    "protocols/test_conformance.py",
    "gateway/cli/test_demo.py",
    "gateway/monitor/test_decoder.py",
    "gateway/runtime/test_live_view.py",
    "brain/skills/test_found.py",
    "gateway/ros/test_bridge.py",
    "gateway/report/test_judge.py",
    "matrix/test_matrix.py",
    "faults/test_faults.py",
    "gateway/runtime/test_twin_process.py",
    "gateway/runtime/test_real_devices.py",
    "gateway/cli/test_scaffold.py",
)
"""Files whose tests are long, or wait: they begin first, so that no worker ends long after the others."""


def not_run(reasons: list[str]) -> list[str]:
    """Each thing that did not run, once, with how many tests were about it."""
    reported = [reason.removeprefix("Skipped: ") for reason in reasons]
    named = [reason for reason in reported if reason.startswith(PREFIX)]
    counts = {reason: named.count(reason) for reason in dict.fromkeys(named)}
    return [f"{reason} ({count} test{'s' * (count > 1)})" for reason, count in counts.items()]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--shuffle", type=int, metavar="SEED", help="files, and the tests of each, in any order")
    parser.addoption("--busy", type=int, default=0, metavar="N", help="beside N processes that compute")


@pytest.hookimpl(tryfirst=True)  # before what is left out by its marks is
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in beyond_their_sample(items):
        item.add_marker("prove")
    here, last = Path(__file__).parent, len(LONGEST)
    places = {here / name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path, last))
    seed = config.getoption("--shuffle")
    if seed is not None:
        dice = random.Random(seed)
        files = {path: dice.random() for path in dict.fromkeys(item.path for item in items)}
        items.sort(key=lambda item: (files[item.path], dice.random()))


def beyond_their_sample(items: Iterable[pytest.Item]) -> list[pytest.Item]:
    """Return the tests with a mark `sample(N)` beyond the N of their function that are spread evenly over its
    parameters. A function without parameters, or with fewer, is whole."""
    families: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("sample") is not None:
            families.setdefault(item.nodeid.partition("[")[0], []).append(item)
    rest: list[pytest.Item] = []
    for family in families.values():
        mark = family[0].get_closest_marker("sample")
        count = min(mark.args[0] if mark else 0, len(family))
        kept = {(2 * n + 1) * len(family) // (2 * count) for n in range(count)}
        rest += [item for at, item in enumerate(family) if at not in kept]
    return rest


def pytest_configure(config: pytest.Config) -> None:
    """Keep the machine busy, in the process that has the workers of pytest-xdist."""
    for _ in range(0 if hasattr(config, "workerinput") else config.getoption("--busy")):
        code = f"import os\nwhile os.getppid() == {os.getpid()}:\n    sum(range(10**6))"
        config.add_cleanup(subprocess.Popen([sys.executable, "-c", code]).kill)


@pytest.fixture(autouse=True)
def level_of_the_log() -> Iterator[None]:
    """Put back what a command that ran in this process has set: the next test reads the log, too."""
    log = logging.getLogger("gateway")
    before = log.level
    yield
    log.setLevel(before)


@pytest.fixture(autouse=True)
def ended_runs() -> Iterator[None]:
    with runs.ended():
        yield


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
