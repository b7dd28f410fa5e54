"""The tests, on every CPython that the project names and this machine has: each in a clone, set up by itself.

./go prove -k pythons                                    all of the tests, on each
PYTHONS_TESTS=tests/protocols/plain ./go prove -k pythons      some of them

A Python is looked for on the path, and among those of pyenv. One that is not there is named as not run.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MINORS = (11, 12, 13, 14)


def python(minor: int) -> str | None:
    """Return a CPython 3.`minor`; None if there is none."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = [shutil.which(f"python3.{minor}"), *map(str, sorted(pyenv.glob(f"3.{minor}.*/bin/python3")))]
    wanted = f"cpython 3.{minor}"
    ask = "import sys; print(sys.implementation.name, '%d.%d' % sys.version_info[:2])"
    for each in filter(None, found):
        done = subprocess.run([each, "-c", ask], capture_output=True, text=True, check=False)
        if done.returncode == 0 and done.stdout.strip() == wanted:
            return each
    return None


@pytest.mark.prove
@pytest.mark.parametrize("minor", MINORS)
def test_the_tests_pass_on_each_python(minor: int, tmp_path: Path) -> None:
    interpreter = python(minor)
    if interpreter is None:
        pytest.skip(f"NOT RUN: no CPython 3.{minor} on this machine")
    clone = tmp_path / "project"
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
    with (tmp_path / "log").open("w+") as log:
        command = [interpreter, "go", "test", "-q", *os.environ.get("PYTHONS_TESTS", "").split()]
        done = subprocess.run(command, cwd=clone, stdout=log, stderr=subprocess.STDOUT, check=False)
        log.seek(0)
        text = log.read()
    version = (clone / ".venv" / "pyvenv.cfg").read_text()
    sys.stdout.write(f"{version}\n{text[-20_000:]}")
    assert f"3.{minor}." in version
    assert done.returncode == 0
