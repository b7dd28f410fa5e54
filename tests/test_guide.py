"""docs/adding-a-protocol.md is done from its first line to its last, in a clean folder."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.guide import ROOT, Reader, Said, blocks, changed, commands

TEXT = (ROOT / "docs" / "adding-a-protocol.md").read_text()


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Reader, list[Said]]:
    reader = Reader(tmp_path_factory.mktemp("guide"))
    return reader, [said for block in blocks(TEXT) for said in reader.do(block)]


def test_its_commands_say_what_it_says(done: tuple[Reader, list[Said]]) -> None:
    assert len(done[1]) >= 12
    for said in done[1]:
        text = f"$ {said.command}\n{said.actual}-- but the guide says:\n{said.expected}"
        assert said.agrees(), f"{text}-- `python -m tests.guide docs/adding-a-protocol.md` puts it right"


def test_it_ends_with_a_plugin_that_is_whole(done: tuple[Reader, list[Said]]) -> None:
    reader, said = done
    checks = [each.actual for each in said if each.command.startswith("gateway protocols check")]
    assert ", 0 failed, " in checks[-1]
    assert any("failed  " in check for check in checks[:-1]), "it shows no mistake that the contract finds"
    package = reader.root / "work" / "ddsm115"
    marked = [path for path in package.rglob("*.*") if "egg-info" not in str(path) and path.is_file()]
    assert not [path for path in marked if "FILL IN" in path.read_text(errors="replace")]


@pytest.mark.parametrize("tool", [["ruff", "check"], ["ruff", "format", "--check"], ["mypy"]], ids=" ".join)
def test_what_it_builds_passes_lint_and_types(done: tuple[Reader, list[Said]], tool: list[str]) -> None:
    reader, _ = done
    more = ["--no-cache"] if tool[0] == "ruff" else ["--follow-imports=silent", "--cache-dir=/dev/null"]
    found = subprocess.run(
        [sys.executable, "-m", *tool, *more],
        cwd=reader.root / "work" / "ddsm115",
        env=reader.environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stdout + found.stderr


def test_every_command_in_it_of_ours_is_one_that_is_run() -> None:
    shown = re.findall(r"^\$ (.+)$", TEXT, re.MULTILINE)
    run = [
        command for block in blocks(TEXT) if block.kind == "console" for command, _ in commands(block.body)
    ]
    assert shown == run


def test_the_files_that_it_points_to_are_there() -> None:
    for name in re.findall(r"\]\(([^)#:]+)\)", TEXT):
        assert (ROOT / "docs" / name).exists(), name


# -- the reader itself ---------------------------------------------------------------------------------

LITTLE = """\
**`a.txt`**

```text
one
two
```

**`a.txt`**, further down:

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


def test_files_changes_and_commands_are_done_in_order(tmp_path: Path) -> None:
    reader = Reader(tmp_path)
    said = [each for block in blocks(LITTLE) for each in reader.do(block)]
    assert (tmp_path / "work" / "a.txt").read_text() == "one\n2\n\n\nthree\n"
    assert [each.command for each in said] == ["cat a.txt", "cd ..", "test -d work"]
    assert all(each.agrees() for each in said)


@pytest.mark.parametrize(
    ("expected", "actual", "agrees"),
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
def test_what_agrees(expected: str, actual: str, agrees: bool) -> None:
    assert Said("", expected, actual).agrees() is agrees


def test_a_change_that_does_not_fit_is_told() -> None:
    assert changed("a\nb\n", " a\n-b\n+c\n") == "a\nc\n"
    with pytest.raises(ValueError, match="2 times"):
        changed("b\nb\n", "-b\n+c\n")
