"""Marks every test in this folder `real_can`, and gives them CAN interfaces of their own.

Left out by default; `python -m tests.real_can` runs them where there is a CAN.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.buses.interfaces import kernel_has_can

HERE = Path(__file__).parent
NO_CAN = "this kernel has no CAN: `python -m tests.real_can pytest ...` runs these tests where there is one"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The hook is given the whole collection: mark what lies in this folder."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.real_can)


def ip(*arguments: str) -> str:
    """Run `ip` and return its output; the test fails if it does."""
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.fail(f"ip {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout


@pytest.fixture(scope="session", autouse=True)
def _kernel() -> None:
    if not kernel_has_can():
        pytest.fail(NO_CAN)


@contextmanager
def virtual() -> Iterator[Callable[[], str]]:
    """A maker of new interfaces vcan0, vcan1 … (CAN FD, mtu 72), up; all are deleted at the end."""
    made: list[str] = []

    def make() -> str:
        name = f"vcan{len(made)}"
        ip("link", "add", "dev", name, "type", "vcan")
        made.append(name)
        ip("link", "set", name, "mtu", "72", "up")
        return name

    try:
        yield make
    finally:
        for name in made:
            subprocess.run(["ip", "link", "delete", name], check=False)


@contextmanager
def two_controllers() -> Iterator[Callable[[int], tuple[str, str]]]:
    """Brings up two controllers on one bus at a bit rate; they are down before and after."""
    names = ("can0", "can1")

    def bring_up(bitrate: int) -> tuple[str, str]:
        for name in names:
            ip("link", "set", name, "up", "type", "can", "bitrate", str(bitrate))
        return names

    try:
        yield bring_up
    finally:
        for name in names:
            ip("link", "set", name, "down")


@contextmanager
def bus_ends(bitrate: int) -> Iterator[tuple[str, str]]:
    """Two interfaces on one bus: of two controllers at that bit rate; with 0, a virtual interface twice."""
    if bitrate:
        with two_controllers() as bring_up:
            yield bring_up(bitrate)
    else:
        with virtual() as make:
            name = make()
            yield name, name


@pytest.fixture
def vcan() -> Iterator[Callable[[], str]]:
    """A maker of new virtual CAN interfaces, for one test."""
    with virtual() as make:
        yield make


@pytest.fixture
def vcan0(vcan: Callable[[], str]) -> str:
    """One new virtual CAN interface by that name."""
    return vcan()


@pytest.fixture
def controllers() -> Iterator[Callable[[int], tuple[str, str]]]:
    """Two controllers on one bus, `can0` and `can1`, once they are brought up at a bit rate."""
    with two_controllers() as bring_up:
        yield bring_up
