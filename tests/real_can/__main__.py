"""Run the tests of a real CAN, or anything else, where there is one.

    python -m tests.real_can [FILE]                the whole tier; into FILE, what could not run and why
    python -m tests.real_can pytest FILE ...       these tests, inside the machine, campaigns among them
    python -m tests.real_can run COMMAND ...       any command, inside the machine
    python -m tests.real_can prepare               fetch and build the machine; print what is missing

Rules. Where the host's kernel has CAN and lets us make interfaces, what needs `vcan` alone runs on the host,
in a network namespace of its own; the rest, or all of it, runs in the machine, which is booted once.
Exit status: 0 all that could run has passed (with FILE; without it, all has); 1 a test failed, or none was
found, or the machine did; 2 not all could run.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.real_can.machine import ROOT, Missing, prepare, run

PYTEST = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", "-v", "--color=no"]
TIER = "tests/real_can"
EVERYTHING = "real_can and not prove"
VIRTUAL, CONTROLLERS = f"{EVERYTHING} and not controllers", f"{EVERYTHING} and controllers"


def main(arguments: Sequence[str]) -> int:
    """Run the command; return the exit status."""
    command, rest = (arguments[0], arguments[1:]) if arguments else ("", ())
    if command in ("pytest", "run", "prepare"):
        try:
            parts = prepare()
        except Missing as missing:
            print(missing, flush=True)
            return 2
        jobs = {"pytest": [*PYTEST, "-m", "real_can", *rest], "run": list(rest)}
        return run(parts, jobs[command]) if command in jobs else 0
    if len(arguments) > 1 or command.startswith("-"):
        print(__doc__)
        return 2
    return tier(Path(command) if command else None)


def tier(absent: Path | None) -> int:
    """Every test, wherever it can run."""
    status = 0
    here = own_network()
    if here is not None:
        status = subprocess.run([*here, *job(VIRTUAL)], cwd=ROOT, check=False).returncode
    try:
        status = run(prepare(), job(EVERYTHING if here is None else CONTROLLERS)) or status
    except Missing as missing:
        what = "none of its tests" if here is None else "the tests on two controllers"
        sentence = f"{what}: {missing}"
        print(f"NOT RUN: {sentence}", flush=True)
        if absent is None:
            return 1 if status else 2
        absent.write_text(sentence + "\n")
    return 1 if status else 0


def job(which: str) -> list[str]:
    """Pytest on the tests with these marks."""
    return [*PYTEST, "-m", which, "--durations=10", "--durations-min=1", TIER]


def own_network() -> list[str] | None:
    """What starts a command in a network of its own, with CAN in it; None if this host has no CAN."""
    root = [] if os.geteuid() == 0 else ["--map-root-user"]
    enter = ["unshare", "--net", *root, "sh", "-c", 'ip link set lo up && exec "$@"', "sh"]
    probe = [*enter, "sh", "-c", "ip link add dev vcan0 type vcan && ip link set vcan0 up"]
    try:
        done = subprocess.run(probe, capture_output=True, check=False)
    except FileNotFoundError:
        return None
    return enter if done.returncode == 0 else None


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
