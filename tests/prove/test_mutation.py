"""What the contract and a protocol's own tests notice: mutmut on its host's end and on what its devices obey;
and what the tests of the modules that keep the robot safe notice.

    MUTANTS=300 ./go prove -k "mutation and plain"      300 of them, drawn by MUTANTS_SEED; by default all

The tool works on a copy of the project, configured for one protocol. A mutant that no test notices has
survived, equivalent ones included; at least nine of ten must be noticed.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from random import Random

import pytest

ROOT = Path(__file__).resolve().parents[2]
LEFT_OUT = shutil.ignore_patterns("__pycache__")
COPIED = ("protocols", "brain", "gateway", "benchmarks", "fixtures", "tests", "pyproject.toml")
LEFT = ("__init__", "twin", "options", "settings", "servo", "loops", "errors", "faults")
"""Modules that are not mutated: the device's end, texts, and what only assembles."""
TESTS = {"toolkit": ["toolkit", "damiao", "plain"]}
"""Folders of tests that are run, where it is not the protocol's alone."""
CONTRACTS = {"toolkit": "damiao"}
"""The plugin whose contract is checked, where it is not the protocol's."""
FLOOR = 0.9
SAFETY = {"guard": (["gateway/core/guard.py"], ["tests/gateway/core/test_guard.py"])}
"""Of the gateway: files that are mutated, and the tests that must notice."""
SAFETY_FLOOR = 0.95
CONTRACT = """
from protocols.conformance import check, table
from protocols.plugin import load

def test_the_contract_is_kept() -> None:
    results = check(load({name!r}))
    assert not [result for result in results if result.outcome == "failed"], table(results)
"""
CONFIGURATION = """\
[tool.mutmut]
source_paths = ["{source}"]
only_mutate = {files}
also_copy = {others}
pytest_add_cli_args = [
    "-p", "no:cacheprovider", "-p", "no:xdist", "-x", "-q", "--ignore=tests/protocols/toolkit/test_calls.py"
]
pytest_add_cli_args_test_selection = {tests}
"""


def project(folder: Path, name: str) -> None:
    """A copy of the project, configured for the mutants of one protocol, or of a part of the gateway."""
    for part in COPIED:
        if (ROOT / part).is_dir():
            shutil.copytree(
                ROOT / part, folder / part, symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
            )
        else:
            shutil.copy(ROOT / part, folder)
    source = "gateway" if name in SAFETY else "protocols"
    files, tests = SAFETY.get(name) or _of_protocol(folder, name)
    others = [part for part in COPIED if part != source]
    text = re.sub(r"\[tool\.mutmut\][^\[]*", "", (folder / "pyproject.toml").read_text())
    (folder / "pyproject.toml").write_text(
        text + CONFIGURATION.format(source=source, files=files, others=others, tests=tests)
    )


def _of_protocol(folder: Path, name: str) -> tuple[list[str], list[str]]:
    """Return the files and the tests of a protocol, its contract included."""
    contract = f"tests/prove/contract_of_{name}.py"
    (folder / contract).write_text(CONTRACT.format(name=CONTRACTS.get(name, name)))
    modules = sorted(path.stem for path in (ROOT / "protocols" / name).glob("*.py"))
    files = [f"protocols/{name}/{module}.py" for module in modules if module not in LEFT]
    return files, [*(f"tests/protocols/{each}" for each in TESTS.get(name, [name])), contract]


def mutmut(folder: Path, *arguments: str) -> str:
    """Run the tool in a folder; what it printed."""
    command = [sys.executable, "-m", "mutmut", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONWARNINGS": "ignore"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def results(folder: Path) -> dict[str, str]:
    """Each mutant's name and state."""
    lines = mutmut(folder, "results", "--all", "true").splitlines()
    return dict(re.findall(r"^\s+(\S+__mutmut_\d+): (.+)$", "\n".join(lines), re.MULTILINE))


@pytest.mark.prove
@pytest.mark.parametrize("name", ["plain", "moteus", "odrive_can", "cia402", "damiao", "toolkit", *SAFETY])
def test_mutation(name: str, tmp_path: Path) -> None:
    project(tmp_path, name)
    made = mutmut(tmp_path, "run", "none.of_this_name")
    mutants = sorted(results(tmp_path))
    assert mutants, made
    drawn = Random(int(os.environ.get("MUTANTS_SEED", "0"))).sample(
        mutants, min(len(mutants), int(os.environ.get("MUTANTS", len(mutants))))
    )
    output = mutmut(tmp_path, "run", *drawn)
    states = results(tmp_path)
    found = Counter(states[mutant] for mutant in drawn)
    survived = [mutant for mutant in drawn if states[mutant] in ("survived", "no tests")]
    print(f"\n{name}: {len(drawn)} of {len(mutants)} mutants: {dict(found)}", *survived, sep="\n  ")
    assert found["not checked"] == 0, output
    assert 1 - len(survived) / len(drawn) >= (SAFETY_FLOOR if name in SAFETY else FLOOR)
