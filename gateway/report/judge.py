"""Recordings as a test suite: what each gives with the code of today, and whether that is what is expected.

Rules. What is expected of NAME.mcap is in NAME.mcap.expected.toml: a digest of the bytes that were sent, for
each bus and second, and figures with the tolerance of each. It is made at a person's wish alone (`--update`),
and keeps the tolerances that were edited. A recording of another program has figures alone; a log of CAN has
those of what is in it, and by a robot file of what was heard of its devices. All is values: judged one after
the other or side by side, on one machine or several, the results are the same.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any, Literal, TypeAlias

from gateway.buses.log_file import READERS, LogSummary, is_log, logged, summary
from gateway.config.errors import Mistakes
from gateway.config.text import read_text, read_toml
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.errors import GatewayError, UserError
from gateway.monitor.candidates import of_robot
from gateway.monitor.decoder import BusMonitor
from gateway.monitor.heard import Heard, places
from gateway.recording import read_recording
from gateway.recording.catalogue import read_catalogue
from gateway.recording.new_file import replace_with
from gateway.recording.reader import is_recording
from gateway.replay import Observe, replay_recording
from gateway.report.junit import junit_xml
from gateway.report.watcher import Figure, Watcher
from gateway.rosbag import is_bag
from gateway.rosbag.evaluate import evaluate_file
from gateway.rosbag.survey import proposed_robot, survey
from gateway.rosbag.truth import read_truth
from protocols.frames import CanFrame
from protocols.messages import SECOND

EXPECTED = ".expected.toml"
SUFFIXES = (".mcap", ".bag", ".db3", ".clf", ".gz", ".bz2", ".xz", ".dat", ".mat", *READERS)
"""Files that a folder is searched for; what is none of our readers' is left out."""
OTHERS: Mapping[str, str] = {
    "a description of a device, no recording": r"\.(dbc|eds|dcf|xdd|xdc|urdf|toml|ya?ml|json)$",
    "text, no recording": r"(^|/)(LICEN[CS]E|README|COPYING|NOTICE)|\.(md|rst|html|pdf)$",
    "packed files, which are not looked into": r"\.(tar(\.\w+)?|tgz|zip|7z)$",
    "a truth, by which a recording of its name beside it is judged": r"\.(relations|tum)$",
    "an unfinished file": r"\.part$",
}
"""What the other files of a folder are, by their names"""
TRUTHS = (".relations", ".tum")
"""Of another program's recording, beside it and called as it is before its first dot"""
SHOWN = 5
"""Differences of a recording that are told"""

Status: TypeAlias = Literal["same", "within", "changed", "new", "unreadable"]
STATUS_TEXTS: Mapping[Status, str] = {
    "same": "as expected",
    "within": "other bytes, figures within their tolerances",
    "changed": "CHANGED",
    "new": "nothing is expected yet: --update writes it",
    "unreadable": "NOT READ",
}


@dataclass(frozen=True, slots=True)
class Judged:
    """What a recording gives with the code of today."""

    name: str
    """The file's path, as it was given or found"""
    source: str
    """Digest of the recording"""
    digests: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """By bus, of what was sent in each second"""
    figures: Mapping[str, Figure] = field(default_factory=dict)
    causes: Sequence[str] = ()
    """First differences from what was recorded, and their likely causes"""
    error: str = ""
    """Why it could not be read"""


@dataclass(frozen=True, slots=True)
class Expected:
    """What is expected of a recording."""

    source: str
    digests: Mapping[str, Sequence[str]]
    figures: Mapping[str, Figure]


@dataclass(frozen=True, slots=True)
class Verdict:
    """A recording's status, and what differs from what is expected."""

    judged: Judged
    status: Status
    changes: Sequence[str] = ()

    @property
    def line(self) -> str:
        """The verdict in one line."""
        return f"{self.judged.name}: {STATUS_TEXTS[self.status]}"


# -- one recording ------------------------------------------------------------------------------------


def judge(path: Path, robot: Robot | None = None) -> Judged:
    """Run a recording through the code of today.

    Args:
        path: of this gateway, or another program's.
        robot: another robot than the recorded one.

    Returns:
        Judged: bytes and figures; `error` if it cannot be read. Never raises for what is in the file.
    """
    try:
        source = _file_digest(path)
    except OSError as error:
        return Judged(str(path), "", error=f"{error.strerror}")
    try:
        if is_bag(path):
            return Judged(str(path), source, figures=_of_another(path, robot))
        if is_log(path):
            return Judged(str(path), source, figures=_of_can(path, robot))
        return _of_ours(path, source, robot)
    except GatewayError as error:
        return Judged(str(path), source, error=str(error))
    except Exception as error:  # noqa: BLE001 -- a step that fails is what the code of today makes of it
        return Judged(str(path), source, error=f"the program fails: {type(error).__name__}: {error}")


def _of_ours(path: Path, source: str, robot: Robot | None) -> Judged:
    watchers: list[Watcher] = []

    def watch(gateway: Gateway) -> Observe:
        watchers.append(Watcher(gateway))
        return watchers[0].take

    comparison = replay_recording(read_recording(path), robot, watch, views=False)
    causes = () if comparison.ok else (*comparison.objections(), *comparison.causes)
    return Judged(str(path), source, watchers[0].digests(), watchers[0].figures(), causes)


def _of_another(path: Path, robot: Robot | None) -> dict[str, Figure]:
    beside = (path.with_name(path.name.partition(".")[0] + suffix) for suffix in TRUTHS)
    truth = next((read_truth(one) for one in beside if one.is_file()), None)
    read_as = proposed_robot(survey(path)) if robot is None else robot
    found = evaluate_file(path, read_as, truth=truth)
    figures = {"driven": Figure(found.driven, 0.01 * found.driven, "m")}
    for name, error in found.errors.items():
        figures[f"{name}: RMS error"] = Figure(error.rms, 0.02, "m")
    for name, relation in found.relations.items():
        figures[f"{name}: mean error"] = Figure(relation.mean, 0.02, "m")
        figures[f"{name}: mean error of a turn"] = Figure(relation.mean_turn, 0.01, "rad")
    for sensor, nis in found.nis.items():
        figures[f"{sensor}: NIS per degree of freedom"] = Figure(nis.mean, 0.1)
    if found.scans:
        figures["scans while lost"] = Figure(100.0 * found.lost / found.scans, 0.5, "%")
    unused = sum(sum(reasons.values()) for reasons in found.anomalies.values())
    return figures | {"measurements not used": Figure(unused, max(5.0, 0.02 * unused))}


def _of_can(path: Path, robot: Robot | None) -> dict[str, Figure]:
    """Return what is in a log of CAN."""
    log = summary(path)
    frames, end, ids = Counter[str](), log.began, defaultdict[str, set[tuple[int, bool]]](set)
    with suppress(UserError):  # it was told by the summary
        for packet, _ in logged(path):
            frames[packet.bus] += 1
            end = packet.t
            if isinstance(packet.frame, CanFrame):
                ids[packet.bus].add((packet.frame.id, packet.frame.extended))
    found = {"lasts": Figure((end - log.began) / SECOND, 0.001, "s"), "cut short": Figure(bool(log.error), 0)}
    for bus, count in frames.items():
        found[f"{bus}: frames"] = Figure(count, 0)
        found[f"{bus}: identifiers"] = Figure(len(ids[bus]), 0)
    return found if robot is None else found | _heard(path, robot, log)


def _heard(path: Path, robot: Robot, log: LogSummary) -> dict[str, Figure]:
    """Return what was heard in a log of CAN of a robot's devices."""
    buses = places(robot, log, path)
    settings = {bus: robot.buses[bus] for bus in buses.values()}
    monitor = BusMonitor(settings, of_robot(robot, [*settings]), log.began, known=True, window=None)
    heard, found = Heard(robot, buses, log.began), dict[str, Figure]()
    with suppress(UserError):
        for packet, sent in logged(path):
            if packet.bus in buses:
                heard.take(monitor.decode(replace(packet, bus=buses[packet.bus]), sent=sent or None))
    for name, (events, wrong) in heard.counts().items():
        found[f"{name}: messages"] = Figure(events, 0)
        found[f"{name}: findings"] = Figure(wrong, 0)
    return found


def _file_digest(path: Path) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for one in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if one.is_file():
            with one.open("rb") as file:
                while block := file.read(1 << 20):
                    digest.update(block)
    return digest.hexdigest()


# -- what is expected ---------------------------------------------------------------------------------


def expected_file(path: Path, folder: Path | None) -> Path:
    """Return where what is expected of a recording is: beside it, or in a folder of its own."""
    return (path.parent if folder is None else folder) / f"{path.name}{EXPECTED}"


def read_expected(file: Path) -> Expected | None:
    """Return what is expected; None if there is no such file. Raises ConfigError for a wrong one."""
    if not file.exists():
        return None
    text = read_text(file)
    mistakes = Mistakes(str(file), text)
    table = read_toml(text, mistakes, times=50)
    figures: dict[str, Figure] = {}
    for name, row in table.get("figures", {}).items():
        match row:
            case [int() | float() as value, int() | float() as tolerance, str(unit)] if tolerance >= 0:
                figures[name] = Figure(float(value), float(tolerance), unit)
            case _:
                mistakes.add(("figures", name), "expected [value, tolerance of at least 0, unit]")
    digests = table.get("bytes", {})
    source = table.get("recording", "")
    if not isinstance(source, str) or not isinstance(digests, dict):
        mistakes.add((), "expected recording, [bytes] and [figures], as --update writes them")
    mistakes.check()
    return Expected(source, digests, figures)


def write_expected(file: Path, judged: Judged, before: Expected | None) -> None:
    """Write what a recording gives now as what is expected of it, with the tolerances of before."""
    kept = before.figures if before is not None else {}
    lines = [
        "# What `gateway judge` expects of this recording; `--update` makes it anew.",
        "# Figures: value, tolerance, unit; an edited tolerance stays.",
        f"recording = {json.dumps(judged.source)}",
        "",
        "[figures]",
    ]
    for name, (value, tolerance, unit) in judged.figures.items():
        allowed = kept[name].tolerance if name in kept else tolerance
        row = f"[{_number(value)}, {_number(allowed)}, {json.dumps(unit, ensure_ascii=False)}]"
        lines.append(f"{json.dumps(name, ensure_ascii=False)} = {row}")
    if judged.digests:
        lines += ["", "[bytes]  # that were sent, a digest for each second"]
        for bus, digests in judged.digests.items():
            rows = [" ".join(digests[at : at + 10]) for at in range(0, len(digests), 10)]
            lines.append(f"{json.dumps(bus)} = [")
            lines += [f"    {json.dumps(row)}," for row in rows]
            lines.append("]")
    try:
        replace_with(file, ("\n".join(lines) + "\n").encode())
    except OSError as error:
        raise UserError(f"{file}: cannot be written: {error.strerror}") from error


def _number(value: float) -> str:
    return f"{value:.6g}" if isfinite(value) else "nan"


def verdict(judged: Judged, expected: Expected | None) -> Verdict:
    """Compare what a recording gives with what is expected of it."""
    if judged.error:
        return Verdict(judged, "unreadable", (judged.error,))
    if expected is None:
        return Verdict(judged, "new")
    changes = [f"it is another recording than was judged before: {judged.source}"]
    changes = changes * (judged.source != expected.source)
    changes += [*_changed_figures(judged.figures, expected.figures)]
    others = [*_other_bytes(judged.digests, expected.digests)]
    status: Status = "changed" if changes else "within" if others else "same"
    causes = judged.causes[:SHOWN] if changes or others else ()
    return Verdict(judged, status, (*changes, *others, *causes))


def _changed_figures(now: Mapping[str, Figure], before: Mapping[str, Figure]) -> list[str]:
    changes = [f"{name}: there is no such figure any more" for name in before if name not in now]
    changes += [f"{name}: is new" for name in now if name not in before]
    for name in (name for name in now if name in before):
        is_now, (was, tolerance, unit) = float(_number(now[name].value)), before[name]
        if not abs(is_now - was) <= tolerance and not (is_now != is_now and was != was):
            text = f"{is_now:.6g} {unit}, expected {was:.6g} within {tolerance:.6g}"
            changes.append(f"{name}: {text}".replace(" ,", ","))
    return changes


def _other_bytes(now: Mapping[str, Sequence[str]], before: Mapping[str, Sequence[str]]) -> list[str]:
    found = []
    for bus in sorted(now.keys() | before.keys()):
        one, two = list(now.get(bus, ())), [each for row in before.get(bus, ()) for each in row.split()]
        second = next((at for at, pair in enumerate(zip(one, two, strict=False)) if pair[0] != pair[1]), -1)
        if second >= 0:
            count = sum(a != b for a, b in zip(one, two, strict=False))
            found.append(f"{bus}: other bytes from second {second} on, in {count} of {len(two)} seconds")
        elif len(one) != len(two):
            found.append(f"{bus}: bytes for {len(one)} seconds, expected {len(two)}")
    return found


# -- many ---------------------------------------------------------------------------------------------


def recordings_in(paths: Sequence[Path]) -> list[Path]:
    """Return the recordings of files and folders, in order of their names; each once."""
    found: dict[Path, None] = {}
    for path in paths:
        if not path.exists():
            raise UserError(f"{path}: there is no such file or folder")
        if path.is_dir() and not is_bag_folder(path):
            inside = [one for one in sorted(path.rglob("*")) if one.name.endswith(SUFFIXES)]
            folders = {one.parent for one in inside if is_bag_folder(one.parent)}
            inside = sorted({*(one for one in inside if one.parent not in folders), *folders})
            found |= dict.fromkeys(one for one in inside if is_bag(one) or is_ours(one) or _is_can(one))
        else:
            found[path] = None
    return list(found)


def is_bag_folder(path: Path) -> bool:
    """True for a folder that is one bag of ROS 2."""
    return (path / "metadata.yaml").is_file()


def others_in(paths: Sequence[Path], recordings: Sequence[Path]) -> list[tuple[Path, str]]:
    """Return the files of folders that are not judged, and what each is: by the catalogue, or by its name."""
    catalogue, judged = read_catalogue(), {*recordings}
    found: list[tuple[Path, str]] = []
    for path in (one for folder in paths for one in sorted(folder.rglob("*")) if folder.is_dir()):
        if not path.is_file() or judged & {path, *path.parents} or path.name.endswith(EXPECTED):
            continue
        name = path.as_posix()
        what = next((what for what, pattern in OTHERS.items() if re.search(pattern, name)), "")
        entry = next((one for file, one in catalogue.items() if name.endswith(f"/{file}")), None)
        told = f"{entry.what}; " if entry is not None else ""
        found.append((path, told + (what or "nothing that a reader of recordings knows")))
    return found


def _is_can(path: Path) -> bool:
    """Whether a file is a log of CAN with at least a frame."""
    try:
        return is_log(path) and next(logged(path), None) is not None
    except UserError:
        return False


def is_ours(path: Path) -> bool:
    """Whether a file is a recording of this gateway."""
    try:
        return path.suffix == ".mcap" and is_recording(path)
    except OSError:
        return False


def to_json(judged: Judged) -> dict[str, Any]:
    """Return a result for another process."""
    return asdict(judged) | {"figures": {name: list(one) for name, one in judged.figures.items()}}


def from_json(values: Mapping[str, Any]) -> Judged:
    """Return the result that another process has printed."""
    figures = {name: Figure(*one) for name, one in values["figures"].items()}
    return Judged(**{**values, "figures": figures})


def markdown(verdicts: Sequence[Verdict], others: Sequence[tuple[Path, str]] = ()) -> str:
    """Return the verdicts as a table, and what differs below it, for a pull request."""
    good = sum(one.status == "same" for one in verdicts)
    lines = [f"**{good} of {len(verdicts)} recordings are as expected**", "", "| recording | |", "|---|---|"]
    lines += [f"| {one.judged.name} | {STATUS_TEXTS[one.status]} |" for one in verdicts]
    lines += [f"| {path} | not judged: {what} |" for path, what in others]
    for one in verdicts:
        if one.changes:
            lines += ["", f"### {one.judged.name}", "", *(f"- {change}" for change in one.changes)]
    return "\n".join(lines) + "\n"


def junit(verdicts: Sequence[Verdict], passes: Callable[[Verdict], bool]) -> str:
    """Return the verdicts as JUnit's XML, as servers of continuous integration read it."""
    cases = [(one.judged.name, "" if passes(one) else one.line, one.changes) for one in verdicts]
    return junit_xml("gateway judge", "recordings", cases)
