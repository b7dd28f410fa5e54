"""docs/adding-a-protocol.md and the tutorials are executed from first line to last, in a clean folder."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.guide import ROOT, Comparison, GuideRunner, blocks, commands

TEXT = (ROOT / "docs" / "adding-a-protocol.md").read_text()
EXAMPLE = ROOT / "examples" / "robstride_can"
PACKAGE = EXAMPLE / "robstride_can"
UPDATE = "`python -m tests.guide docs/adding-a-protocol.md` updates outputs"


@pytest.fixture(scope="module")
def executed(tmp_path_factory: pytest.TempPathFactory) -> tuple[GuideRunner, list[Comparison]]:
    runner = GuideRunner(tmp_path_factory.mktemp("guide"))
    return runner, [result for block in blocks(TEXT) for result in runner.execute(block)]


def test_outputs_and_files_are_as_it_shows(executed: tuple[GuideRunner, list[Comparison]]) -> None:
    _, results = executed
    assert len(results) >= 20
    for result in results:
        text = f"{result.subject}\n{result.actual}-- but the guide shows:\n{result.expected}-- {UPDATE}"
        assert result.matches(), text


@pytest.mark.parametrize("page", ["first-drive", "first-test"])
def test_a_tutorial_is_as_it_shows(page: str, tmp_path: Path) -> None:
    runner, text = GuideRunner(tmp_path), (ROOT / "docs" / f"{page}.md").read_text()
    for result in (each for block in blocks(text) for each in runner.execute(block)):
        assert result.matches(), f"{result.subject}\n{result.actual}-- but {page} shows:\n{result.expected}"


def test_it_ends_with_a_plugin_that_keeps_the_contract(
    executed: tuple[GuideRunner, list[Comparison]],
) -> None:
    _, results = executed
    checks = [each.actual for each in results if each.subject.startswith("$ gateway protocols check")]
    assert any("failed  " in check for check in checks), "it shows no mistake that the contract finds"
    assert any(", 0 failed, " in check for check in checks)


@pytest.mark.parametrize("tool", [["ruff", "format", "--check", "--no-cache"], ["mypy"]], ids=" ".join)
def test_what_it_builds_is_formatted_and_typed(
    executed: tuple[GuideRunner, list[Comparison]], tool: list[str]
) -> None:
    runner, _ = executed
    more = ["--follow-imports=silent", "--cache-dir=/dev/null"] if tool == ["mypy"] else []
    completed = subprocess.run(
        [sys.executable, "-m", *tool, *more],
        cwd=runner.folder,
        env=runner.environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert completed.returncode == 0, completed.stdout + completed.stderr


def test_every_command_that_it_shows_is_run() -> None:
    shown = re.findall(r"^\$ (.+)$", TEXT, re.MULTILINE)
    assert shown == [
        command for block in blocks(TEXT) if not block.path for command, _ in commands(block.body)
    ]


def test_every_file_is_quoted_and_its_lines_are_counted() -> None:
    quoted = {block.path for block in blocks(TEXT) if block.path}
    code = {f"robstride_can/{path.name}" for path in PACKAGE.glob("*.py")}
    tests = {"tests/test_robstride.py", "tests/driver.txt"}
    assert quoted == {*code, *tests, "robstride_can/vectors.json", "arm.toml", "drive.py"}
    assert f"**{_lines(code)} lines of Python in four files**" in TEXT
    assert f"**{_lines({'robstride_can/vectors.json'}) - 2} vectors**" in TEXT
    assert f"**{_lines(tests)} lines of tests**" in TEXT
    assert len(TEXT.splitlines()) <= 500


def _lines(paths: set[str]) -> int:
    return sum(len((EXAMPLE / path).read_text().splitlines()) for path in paths)


def test_the_files_that_it_links_to_exist() -> None:
    for name in re.findall(r"\]\(([^)#:]+)\)", TEXT):
        assert (ROOT / "docs" / name).exists(), name


# -- the runner itself ---------------------------------------------------------------------------------

SAMPLE = """\
```console
$ printf 'one\\ntwo\\nthree\\n' > a.txt
$ cat a.txt
one
…
three
```

**`a.txt`**, in part:

```text
…
two
…
```

```console
$ cd ..
$ test -d work
```

```text
for the reader
```
"""


def test_commands_and_quotations_are_executed_in_order(tmp_path: Path) -> None:
    runner = GuideRunner(tmp_path)
    results = [each for block in blocks(SAMPLE) for each in runner.execute(block)]
    assert [each.subject for each in results][1:] == ["$ cat a.txt", "a.txt", "$ cd ..", "$ test -d work"]
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
        ("a\n    # …\nd\n", "a\nb\nd\n", True),
        ("a.c\n", "abc\n", False),
    ],
)
def test_what_matches(expected: str, actual: str, matches: bool) -> None:
    assert Comparison("", expected, actual).matches() is matches
