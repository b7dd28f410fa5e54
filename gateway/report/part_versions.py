"""One part of the program in two versions, on what it was given in a recording: where they part.

Rules. Each version runs in a process of its own, from a folder with its rooms. The one is the version of
before; the other is that with files of today: the part's own, and what is of no one part, such as bodies, but
none of another part's, so that what comes before the part is the same in both. Whether it is, is compared,
too: a difference is the part's own as long as that is the same, and no further is looked. Where it is another
from the first on, the part's own files are put in alone; where they do not fit, it is the whole of today. The
guard is run whole in both: the frames are in the recording.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from gateway.errors import RecordingError
from gateway.recording import read_recording
from gateway.replay.input_log import input_log
from gateway.replay.one_part import PartAlone
from gateway.report import run_border
from gateway.report.two_versions import HERE, changed_files, copy_rooms, environment_of, swapped, write_inputs
from protocols.messages import Nanos

FILES: Mapping[str, tuple[str, ...]] = {
    "perception": ("brain/perception/",),
    "planning": ("brain/planning/", "brain/skills/", "brain/health.py"),
    "control": ("brain/control/",),
    "driver": ("protocols/", "gateway/core/"),
}
"""By part: what the names of its own files begin with"""
SHOWN = 5
"""Files that are told"""


def part_compared(path: Path, before: Path, part: str, now: Path = HERE) -> PartAlone:
    """Run a part of two versions on what it was given in a recording.

    Args:
        path: a recording of this gateway; for the guard with frames.
        before: the folder with the rooms of the one version;
        part: "perception", "planning", "control", "driver" or "guard";
        now: and of the other.

    Raises:
        RecordingError: it cannot be read, or the version of before cannot run it.
    """
    log = input_log(read_recording(path))
    times = [tick.now for tick in log.ticks]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        inputs, sides = folder / "inputs.mcap", (folder / "before.jsonl", folder / "now.jsonl")
        if part == "guard":
            inputs = path
        else:
            write_inputs(inputs, log)
        compiled, mixed = folder / "compiled", folder / "mixed"
        copy_rooms(before, mixed)
        if error := _run(mixed, compiled, inputs, sides[0], part):
            raise RecordingError(f"the version of before cannot run {part} alone: {error}")
        error, found = "", None
        for names, told in _mixtures(part, changed_files(before, now)):
            if names is None and found is not None:
                break  # its own files did fit
            with ExitStack() as stack:
                for each in names or ():
                    stack.enter_context(swapped(mixed / each, now / each))
                failed = _run(now if names is None else mixed, compiled, inputs, sides[1], part)
            if failed:
                error = failed if names is None or not error else error
                continue
            found = PartAlone(part, sides=("before", "now"), notes=[told.format(error)] * bool(told))
            _compare(found, sides, times)
            if not found.objection:
                return found
    if found is None:
        raise RecordingError(f"today's version cannot run {part} alone: {error}")
    return found


def _mixtures(part: str, changed: Sequence[str]) -> Iterator[tuple[Sequence[str] | None, str]]:
    """Yield which files of today to put into the version of before, until that shows what a part makes (None:
    all), and what is told of it."""
    if part in FILES:
        own = [name for name in changed if name.startswith(FILES[part])]
        others = tuple(start for each in FILES.values() for start in each if start not in FILES[part])
        shared = [name for name in changed if name not in own and not name.startswith(others)]
        none = "no file of its own has changed" * (not own)
        with_it = f"with it came what is of no one part: {_some(shared)}" * bool(shared)
        yield [*own, *shared], "; ".join(filter(None, (none, with_it)))
        yield own, f"its own files alone: {_some(own)}" if own else none
        yield None, "the whole of today's version: its own files do not fit into that of before ({})"
    else:
        yield None, ""


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:SHOWN]) + f" and {len(names) - SHOWN} more" * (len(names) > SHOWN)


def _run(folder: Path, compiled: Path, inputs: Path, values: Path, part: str) -> str:
    """Run a recording's inputs by the program in a folder; return why that cannot be, or ""."""
    command = [sys.executable, "-P", run_border.__file__, str(inputs), str(values), part]
    done = subprocess.run(
        command, capture_output=True, check=False, text=True, env=environment_of(folder, compiled)
    )
    try:
        answer: dict[str, Any] = json.loads(done.stdout)
    except ValueError:
        return (
            f"it ends: {(done.stderr or done.stdout).strip().rpartition(os.linesep)[2] or 'without a word'}"
        )
    return str(answer.get("error", ""))


class _Side:
    """The values of one version, step by step."""

    def __init__(self) -> None:
        self.given: dict[str, Any] = {}
        self.made: dict[str, Any] = {}

    def take(self, line: str) -> tuple[list[str], list[str]]:
        """Take a step; return the names of what is another in it, given and made."""
        touched = []
        for values, (other, gone) in zip((self.given, self.made), json.loads(line), strict=True):
            values |= other
            for name in gone:
                del values[name]
            touched.append([*other, *gone])
        return touched[0], touched[1]


def _compare(found: PartAlone, files: tuple[Path, Path], times: list[Nanos]) -> None:
    """Compare what both versions have written, until what the part was given is another."""
    sides = _Side(), _Side()
    given: dict[str, None] = {}
    made: dict[str, None] = {}
    with files[0].open(encoding="utf-8") as one, files[1].open(encoding="utf-8") as two:
        for tick, lines in enumerate(zip(one, two, strict=False)):
            for side, line in zip(sides, lines, strict=True):
                for apart, names in zip((given, made), side.take(line), strict=True):
                    apart |= dict.fromkeys(names)
            _keep_apart(given, sides[0].given, sides[1].given)
            _keep_apart(made, sides[0].made, sides[1].made)
            if given:
                name = next(iter(given))
                told = f"up to tick {tick}: what it is given is another from then on, too ({name})"
                if found.differing:
                    found.notes.append(f"compared {told}, since what it made came back")
                else:
                    found.objection = f"compared {told}"
                return
            found.take(times[tick] - times[0], _pairs(made, sides[0].made, sides[1].made))


def _keep_apart(names: dict[str, None], one: Mapping[str, Any], two: Mapping[str, Any]) -> None:
    """Keep of these names those whose values are apart."""
    for name in [name for name in names if _same(name, one, two)]:
        del names[name]


def _same(name: str, one: Mapping[str, Any], two: Mapping[str, Any]) -> bool:
    if name in one and name in two:
        a, b = one[name], two[name]
        return bool(a == b or (a != a and b != b))
    if name not in one and name not in two:
        return True
    # what is within something that the other has not, or has fewer of, is told by that
    return name.endswith("]") or any(
        each.get(outer, ...) is None for each in (one, two) for outer in _outer(name)
    )


def _outer(name: str) -> Iterator[str]:
    """Yield the names of all in which a value is."""
    for place, letter in enumerate(name):
        if letter in ".:[":
            yield name[:place]


def _pairs(
    names: Mapping[str, None], one: Mapping[str, Any], two: Mapping[str, Any]
) -> Iterator[tuple[str, object, object]]:
    return ((name, one.get(name), two.get(name)) for name in names)
