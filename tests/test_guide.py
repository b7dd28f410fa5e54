"""docs/adding-a-protocol.md is executed from its first line to its last, in a clean folder."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.guide import ROOT, CommandResult, GuideRunner, apply_diff, blocks, commands

TEXT = (ROOT / "docs" / "adding-a-protocol.md").read_text()


@pytest.fixture(scope="module")
def executed(tmp_path_factory: pytest.TempPathFactory) -> tuple[GuideRunner, list[CommandResult]]:
    runner = GuideRunner(tmp_path_factory.mktemp("guide"))
    return runner, [result for block in blocks(TEXT) for result in runner.execute(block)]


def test_its_commands_print_what_it_shows(executed: tuple[GuideRunner, list[CommandResult]]) -> None:
    _, results = executed
    assert len(results) >= 12
    for result in results:
        text = f"$ {result.command}\n{result.actual}-- but the guide shows:\n{result.expected}"
        assert result.matches(), f"{text}-- `python -m tests.guide docs/adding-a-protocol.md` updates it"


def test_it_ends_with_a_plugin_that_is_complete(executed: tuple[GuideRunner, list[CommandResult]]) -> None:
    runner, results = executed
    checks = [each.actual for each in results if each.command.startswith("gateway protocols check")]
    assert ", 0 failed, " in checks[-1]
    assert any("failed  " in check for check in checks[:-1]), "it shows no mistake that the contract finds"
    package = runner.root / "work" / "ddsm115"
    files = [path for path in package.rglob("*.*") if "egg-info" not in str(path) and path.is_file()]
    assert not [path for path in files if "FILL IN" in path.read_text(errors="replace")]


@pytest.mark.parametrize("tool", [["ruff", "check"], ["ruff", "format", "--check"], ["mypy"]], ids=" ".join)
def test_what_it_builds_passes_lint_and_types(
    executed: tuple[GuideRunner, list[CommandResult]], tool: list[str]
) -> None:
    runner, _ = executed
    more = ["--no-cache"] if tool[0] == "ruff" else ["--follow-imports=silent", "--cache-dir=/dev/null"]
    completed = subprocess.run(
        [sys.executable, "-m", *tool, *more],
        cwd=runner.root / "work" / "ddsm115",
        env=runner.environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert completed.returncode == 0, completed.stdout + completed.stderr


def test_every_command_that_it_shows_is_run() -> None:
    shown = re.findall(r"^\$ (.+)$", TEXT, re.MULTILINE)
    run = [
        command for block in blocks(TEXT) if block.kind == "console" for command, _ in commands(block.body)
    ]
    assert shown == run


def test_the_files_that_it_links_to_exist() -> None:
    for name in re.findall(r"\]\(([^)#:]+)\)", TEXT):
        assert (ROOT / "docs" / name).exists(), name


# -- the runner itself ---------------------------------------------------------------------------------

EXAMPLE = """\
**`a.txt`**

```text
one
two
```

**`a.txt`**, continued:

```text
three
```

**`a.txt`**

```diff
 one
-two
+2
```

```console
$ cat a.txt
one
…
three
$ cd ..
$ test -d work
```

```text
for the reader
```
"""


def test_files_diffs_and_commands_are_executed_in_order(tmp_path: Path) -> None:
    runner = GuideRunner(tmp_path)
    results = [each for block in blocks(EXAMPLE) for each in runner.execute(block)]
    assert (tmp_path / "work" / "a.txt").read_text() == "one\n2\n\n\nthree\n"
    assert [each.command for each in results] == ["cat a.txt", "cd ..", "test -d work"]
    assert all(each.matches() for each in results)


@pytest.mark.parametrize(
    ("expected", "actual", "matches"),
    [
        ("a\n", "a\n", True),
        ("a\n", "b\n", False),
        ("", "a\n", False),
        ("a\n…\n", "a\n", True),
        ("a\n…\nd\n", "a\nb\nc\nd\n", True),
        ("a\n…\nd\n", "a\nb\nc\n", False),
        ("…\nd\n", "d\n", True),
        ("a.c\n", "abc\n", False),
    ],
)
def test_what_matches(expected: str, actual: str, matches: bool) -> None:
    assert CommandResult("", expected, actual).matches() is matches


def test_a_diff_that_does_not_fit_raises() -> None:
    assert apply_diff("a\nb\n", " a\n-b\n+c\n") == "a\nc\n"
    with pytest.raises(ValueError, match="2 times"):
        apply_diff("b\nb\n", "-b\n+c\n")
