"""Two versions of the program on one recording: where they part, and which files or settings make that.

Rules. Each version runs in a process of its own, from a folder with its rooms; so does each mixture of both:
the version of before with one file of today. What is compared is the packets of each step. A mixture is asked
only up to the first step in which the two versions part. A file that cannot be put in alone says why.
"""

from __future__ import annotations

import filecmp
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np

from brain.belief import Floats
from gateway.config import parse_robot
from gateway.config.errors import Mistakes
from gateway.config.one_setting import with_setting
from gateway.config.text import read_toml
from gateway.core.guard import decoder_of
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Outputs
from gateway.errors import GatewayError, UserError
from gateway.recording import read_recording
from gateway.recording.environment import ROOMS
from gateway.replay import compare, diff, partings
from gateway.replay.input_log import InputLog, RecordingFile, input_log, inputs_alone, run
from gateway.report import run_inputs
from protocols.messages import SECOND

HERE = Path(__file__).resolve().parents[2]
"""The folder that has the rooms of today"""
MOST_FILES = 200
SHOWN = 5
"""Signals that are told"""
SWAPPED = 1
"""When what is swapped in was changed [s], so that what was compiled of the file before does not count"""


@dataclass(frozen=True, slots=True)
class Parted:
    """How two versions part on one recording."""

    name: str
    tick: int | None = None
    """The first in which they send something else; None: in none"""
    since: float = 0.0
    """s after the first tick"""
    first: str = ""
    """The first difference, in words"""
    signals: Sequence[str] = ()
    """That part, in order of time"""
    files: Mapping[str, str] = field(default_factory=dict)
    """By changed file or setting, what it does alone"""
    error: str = ""

    def lines(self) -> list[str]:
        """Return it in words."""
        if self.error:
            return [f"{self.name}: NOT COMPARED: {self.error}"]
        if self.tick is None:
            return [f"{self.name}: the same packets in both versions"]
        lines = [f"{self.name}: other packets from tick {self.tick} on, {self.since:.3f} s after the start"]
        lines += [f"  {line}" for line in self.first.splitlines()]
        lines += [f"  signal {line}" for line in self.signals]
        lines += [f"  {file}: {what}" for file, what in self.files.items()]
        if self.files and ALONE not in self.files.values():
            lines.append(
                "  none of them makes it alone: several do together, or something else that has changed"
            )
        return lines


ALONE, NOT_ALONE = "alone makes the difference", "makes no difference alone"


@contextmanager
def version(given: str) -> Iterator[Path]:
    """Yield a folder with the rooms of a version: a folder, or a revision of the repository that runs.

    Raises UserError if it is neither."""
    # of a folder that lacks a room, python would take the installed one, and compare that with itself
    if given and all((Path(given) / room / "__init__.py").is_file() for room in ROOMS):
        yield Path(given).resolve()
        return
    if not given or given.startswith("-"):  # git would take it for an option, of which some write files
        raise UserError(f"--against {given}: neither a folder with the rooms nor a revision")
    command = ["git", "-C", str(HERE), "archive", "--format=tar", given, "--", *ROOMS]
    try:
        done = subprocess.run(command, capture_output=True, check=False)
    except OSError as error:
        raise UserError(f"--against {given}: git cannot be run: {error.strerror}") from error
    if done.returncode:
        why = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise UserError(f"--against {given}: neither a folder with the rooms nor a revision of {HERE}: {why}")
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=BytesIO(done.stdout)) as archive:
            archive.extractall(folder, filter="data")
        yield Path(folder)


def environment_of(folder: Path, compiled: Path) -> dict[str, str]:
    """Return the environment of a process that runs the program in a folder, and keeps in another what it has
    compiled: nothing is written into the folder itself."""
    own = {"PYTHONPATH": str(folder), "OPENBLAS_NUM_THREADS": "1", "PYTHONPYCACHEPREFIX": str(compiled)}
    return {**os.environ, "PYTHONDONTWRITEBYTECODE": "", **own}


class Version:
    """A process that runs inputs by the program in a folder.

    Args:
        folder: that has the rooms.
        compiled: a folder for what is compiled of them.
    """

    def __init__(self, folder: Path, compiled: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", run_inputs.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment_of(folder, compiled),
        )
        self._answer()

    def run(self, inputs: Path, outputs: Path | None = None, signals: Path | None = None) -> dict[str, Any]:
        """Run the inputs of a recording; return digests, or "error"."""
        asked = {"inputs": inputs, "outputs": outputs or "", "signals": signals or ""}
        stdin: IO[str] = self._process.stdin  # type: ignore[assignment]  # a pipe
        try:
            stdin.write(json.dumps({name: str(path) for name, path in asked.items()}) + "\n")
            stdin.flush()
        except OSError:
            return {"error": "its process has ended"}
        return self._answer()

    def close(self) -> None:
        """End the process."""
        with suppress(OSError):
            self._process.communicate()

    def _answer(self) -> dict[str, Any]:
        stdout: IO[str] = self._process.stdout  # type: ignore[assignment]  # a pipe
        line = stdout.readline()
        try:
            answer: dict[str, Any] = json.loads(line)
        except ValueError:
            return {"error": f"it ends: {line.strip() or 'without a word'}"}
        return answer


class Differs:
    """As a condition of a run: two versions of the program send something else.

    Args:
        before: the folder with the rooms of the one version;
        now: and of the other.
    """

    text = "differs"

    def __init__(self, before: Path, now: Path = HERE) -> None:
        self._compiled = tempfile.TemporaryDirectory()
        compiled = Path(self._compiled.name)
        self._versions = Version(before, compiled), Version(now, compiled)

    def first(self, log: InputLog) -> int | None:
        """Return the first step in which they do."""
        with tempfile.TemporaryDirectory() as folder:
            inputs = Path(folder, "inputs.mcap")
            write_inputs(inputs, log)
            old, new = (each.run(inputs) for each in self._versions)
        if "error" in old or "error" in new:
            return None
        return _first_difference(old["digests"], new["digests"])

    def why_not(self, log: InputLog) -> list[str]:
        """Return why there is no answer, if there is none."""
        with tempfile.TemporaryDirectory() as folder:
            inputs = Path(folder, "inputs.mcap")
            write_inputs(inputs, log)
            errors = [each.run(inputs).get("error", "") for each in self._versions]
        return [f"not compared: {error}" for error in errors if error] or [
            "both versions send the same packets"
        ]

    def write(self, log: InputLog, target: Path) -> None:
        """Write a recording of what the version of before makes of inputs, which must not exist yet."""
        with tempfile.TemporaryDirectory() as folder:
            inputs = Path(folder, "inputs.mcap")
            write_inputs(inputs, log)
            self._versions[0].run(inputs, target)

    def close(self) -> None:
        """End both processes."""
        for one in self._versions:
            one.close()
        self._compiled.cleanup()


def compared(path: Path, before: Path, now: Path = HERE) -> Parted:
    """Run a recording's inputs by two versions, and find which changed files make them part.

    Args:
        path: a recording of this gateway.
        before: the folder with the rooms of the one version;
        now: and of the other.
    """
    with tempfile.TemporaryDirectory() as folder:
        names = ("inputs.mcap", "before.mcap", "now.mcap", "before.npz", "now.npz", "short.mcap", "compiled")
        inputs, recorded, recorded_now, signals, signals_now, short, compiled = (
            Path(folder, name) for name in names
        )
        log = input_log(read_recording(path))
        write_inputs(inputs, log)
        old = _run_once(before, compiled, inputs, recorded, signals)
        new = _run_once(now, compiled, inputs, recorded_now, signals_now)
        if error := old.get("error") or new.get("error"):
            return Parted(str(path), error=str(error))
        tick = _first_difference(old["digests"], new["digests"])
        if tick is None:
            return Parted(str(path))
        at = log.ticks[tick]
        since = (at.now - log.ticks[0].now) / SECOND
        write_inputs(short, log.with_ticks(log.ticks[: tick + 1]))
        sides = (("before", old), ("now", new))
        failed = [f"{side} fails: {each['failed']}" for side, each in sides if each["failed"]]
        first = "\n".join(failed) or _first_packet(log.robot, recorded, recorded_now)
        told = [one.text() for one in partings(_Signals(signals), _Signals(signals_now))[:SHOWN]]
        found = _by_turns(before, now, short, old["digests"][: tick + 1])
        return Parted(str(path), tick, since, first, told, found)


def _run_once(
    folder: Path, compiled: Path, inputs: Path, outputs: Path | None = None, signals: Path | None = None
) -> dict[str, Any]:
    one = Version(folder, compiled)
    try:
        return one.run(inputs, outputs, signals)
    finally:
        one.close()


def write_inputs(path: Path, log: InputLog) -> None:
    """Write a recording of inputs alone, which must not exist yet."""
    file = RecordingFile(path, log, {}, anew=False)
    for tick, belief in inputs_alone(log):
        file.add(tick, belief)
    file.finish()


def _first_difference(one: Sequence[str], two: Sequence[str]) -> int | None:
    for place, (a, b) in enumerate(zip(one, two, strict=False)):
        if a != b:
            return place
    return None if len(one) == len(two) else min(len(one), len(two))


def _first_packet(robot: Robot, before: Path, now: Path) -> str:
    """Return the first packet that is another, with its meaning to the device."""
    outputs = (tick.outputs for tick in read_recording(now).ticks)
    found = compare(
        read_recording(before),
        lambda _now, _inputs: next(outputs, Outputs()),
        Gateway(robot).belief,
        lambda bus: decoder_of(robot, bus),
    )
    texts = [one.text for one in found.differences if one.kind == "packets"]
    return "\n".join(texts).replace("recorded:", "before:  ")


class _Signals:
    """The signals of a run of another version."""

    def __init__(self, path: Path) -> None:
        with np.load(path, allow_pickle=False) as found:
            self.t: Floats = found["t"]
            names = [str(one) for one in found["names"]]
            self.units = dict(zip(names, (str(one) for one in found["units"]), strict=True))
            self._table: dict[str, Floats] = dict(zip(names, found["table"], strict=True))

    def __getitem__(self, name: str) -> Floats:
        return self._table[name]


def changed_files(before: Path, now: Path) -> list[str]:
    """Return the source files that are not the same in two versions, by their names in them."""
    names = {
        str(file.relative_to(root))
        for root in (before, now)
        for room in ROOMS
        for kind in ("*.py", "*.toml", "*.json")
        for file in (root / room).rglob(kind)
        if "fixtures" not in file.parts
    }

    def same(name: str) -> bool:
        one, two = before / name, now / name
        return one.is_file() and two.is_file() and filecmp.cmp(one, two, shallow=False)

    return sorted(name for name in names if not same(name))


def _by_turns(before: Path, now: Path, inputs: Path, digests: Sequence[str]) -> dict[str, str]:
    """Put each changed file into the version of before, alone; return what it does."""
    names = changed_files(before, now)
    if len(names) > MOST_FILES:
        return {f"(all {len(names)})": f"more than {MOST_FILES} have changed: not tried by turns"}
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        mixed = Path(folder)
        copy_rooms(before, mixed)
        for name in names:
            with swapped(mixed / name, now / name):
                result = _run_once(mixed, mixed / "compiled", inputs)
            if "error" in result:
                found[name] = f"cannot be put in alone: {result['error']}"
            else:
                found[name] = NOT_ALONE if result["digests"] == digests else ALONE
    return dict(sorted(found.items(), key=lambda each: (each[1] != ALONE, each[0])))


def copy_rooms(version: Path, target: Path) -> None:
    """Copy the rooms of a version, without fixtures."""
    for room in ROOMS:
        ignored = shutil.ignore_patterns("__pycache__", "fixtures")
        shutil.copytree(version / room, target / room, ignore=ignored)


@contextmanager
def swapped(file: Path, other: Path) -> Iterator[None]:
    """Have another file in the place of one, for a while; both may be absent."""
    kept = file.with_name(file.name + ".kept")
    if file.is_file():
        file.rename(kept)
    try:
        if other.is_file():
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(other.read_bytes())
            os.utime(file, (SWAPPED, SWAPPED))
        yield
    finally:
        file.unlink(missing_ok=True)
        if kept.is_file():
            kept.rename(file)


def settings_apart(path: Path, robot: Robot) -> Parted:
    """Run a recording's inputs by the recorded robot file and by another, and find which settings, each put
    into the recorded file alone, make them part.

    Args:
        path: a recording of this gateway.
        robot: the other robot.
    """
    log = input_log(read_recording(path))
    old = _digests(log)
    place = _first_difference(old, _digests(replace(log, robot=robot)))
    if place is None:
        return Parted(str(path))
    found: dict[str, str] = {}
    texts = (log.robot_text, robot.text)
    one, two = (diff.flat(read_toml(text, Mistakes("robot.toml", text))) for text in texts)
    for key in sorted(key for key in {**one, **two} if one.get(key) != two.get(key)):
        value = two.get(key)
        try:
            if not isinstance(value, int | float | str | bool):
                raise UserError("it is no number or text, or is not there any more")
            text = with_setting(log.robot_text, key, value)
            tried = replace(log, robot=parse_robot(text, "robot.toml"), ticks=log.ticks[: place + 1])
            found[key] = NOT_ALONE if _digests(tried) == old[: place + 1] else ALONE
        except GatewayError as error:
            found[key] = f"cannot be put in alone: {error}"
    since = (log.ticks[place].now - log.ticks[0].now) / SECOND
    found = dict(sorted(found.items(), key=lambda each: (each[1] != ALONE, each[0])))
    return Parted(str(path), place, since, files=found)


def _digests(log: InputLog) -> list[str]:
    found: list[str] = []
    try:
        found += (run_inputs.digest(tick.outputs) for tick, _ in run(log))
    except Exception:  # noqa: BLE001 -- a step that fails is another result
        found.append("failed")
    return found
