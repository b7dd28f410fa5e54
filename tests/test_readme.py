"""README is executed: its Python runs, and every command in it is one that the command line knows."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from gateway.cli.main import parser

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
COMMANDS = re.findall(r"^\$ \./go (.+?)(?:\s+#.*)?$", README, re.MULTILINE)
GO_ALONE = {"test", "prove", "lock", "bench", "docs"}


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def test_the_python_in_it_is_short_and_runs() -> None:
    (code,) = blocks("python")
    assert len([line for line in code.splitlines() if line.strip()]) <= 15
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    assert "brain: goal 1 reached" in done.stdout
    assert re.search(r"Pose\(x=1\.[45]\d*, y=0\.[45]\d*", done.stdout)
    assert re.search(r"left: [\d.]+ rad", done.stdout)


def test_there_are_commands_in_it() -> None:
    assert len(COMMANDS) >= 8


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_in_it_is_known(command: str) -> None:
    words = shlex.split(command)
    if words[0] not in GO_ALONE:
        assert parser(words[0]).parse_args(words).command == words[0]


def test_every_file_that_it_names_is_there() -> None:
    for name in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / name).exists(), name
    for name in re.findall(r"`((?:fixtures|protocols|gateway|brain|docs)/[\w./-]+)`", README):
        assert (ROOT / name).exists(), name
