"""The catalogue of others' recordings: complete, true where they lie here, and honest where they do not."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway.recording.catalogue import WrongFile
from gateway.report.judge import others_in, recordings_in
from tests.conftest import not_run
from tests.data.recordings import ROOT, WHERE, Absent, Recording, find, read, required

ENTRIES = read()
SMALL = Recording("a/b.bin", "w", "s", "l", 3, hashlib.sha256(b"abc").hexdigest())


@pytest.mark.parametrize("entry", ENTRIES.values(), ids=list(ENTRIES))
def test_every_entry_says_where_it_comes_from_and_what_may_be_done(entry: Recording) -> None:
    assert re.fullmatch(r"(derived from )?[\w.-]+/[\w.-]+:\S+ @[0-9a-f]{12}", entry.source)
    assert entry.what
    assert entry.licence
    assert entry.bytes > 0
    assert re.fullmatch(r"[0-9a-f]{64}", entry.sha256)
    assert bool(entry.attribution) == entry.licence.startswith("CC-BY")
    assert not Path(entry.file).is_absolute()


def test_who_uses_a_recording_is_who_names_it() -> None:
    tests = {f"tests/data/{p.name}": p.read_text() for p in (ROOT / "tests" / "data").glob("test_*.py")}
    del tests["tests/data/test_catalogue.py"]
    used = {(name, entry.file) for entry in ENTRIES.values() for name in entry.used_by}
    named = {(name, file) for name, text in tests.items() for file in ENTRIES if f'"{file}"' in text}
    assert used == named
    assert {name for name, _ in used} == set(tests)


@pytest.mark.parametrize("name", [entry.file for entry in ENTRIES.values() if entry.used_by])
def test_a_recording_is_what_the_catalogue_says(recording: Callable[[str], Path], name: str) -> None:
    assert recording(name).is_file()


def test_what_no_test_uses_yet_is_what_the_catalogue_says_where_it_is() -> None:
    for entry in ENTRIES.values():
        if not entry.used_by:
            with contextlib.suppress(Absent):
                find(entry, os.environ)


def test_every_file_where_they_lie_is_judged_or_named() -> None:
    """By `gateway judge DIR --all`; each once."""
    if not (where := os.environ.get(WHERE)):
        pytest.skip(f"NOT RUN: the folder of the recordings: {WHERE} is not set")
    folder = ROOT / where
    recordings = recordings_in([folder])
    others = dict(others_in([folder], recordings))
    assert not others.keys() & {*recordings}
    there = {folder / file for file in ENTRIES if (folder / file).is_file()}
    assert there <= others.keys() | {*recordings}
    assert all(others.values())


def test_no_recording_of_others_lies_in_the_project() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, stdout=subprocess.PIPE, check=False
    ).stdout.split(b"\0")
    files = [ROOT / os.fsdecode(name) for name in listed if name] or list(ROOT.glob("[!.]*/**/*"))
    sizes = {entry.bytes: entry for entry in ENTRIES.values()}
    same = [path for path in files if path.is_file() and path.stat().st_size in sizes]
    known = {entry.sha256 for entry in ENTRIES.values()}
    assert len(files) > 100
    assert not [path for path in same if hashlib.sha256(path.read_bytes()).hexdigest() in known]


def test_what_did_not_run_is_told_once_with_how_many_tests_it_was() -> None:
    reasons = [
        "Skipped: NOT RUN: a: why",
        "Skipped: other",
        "Skipped: NOT RUN: b: why",
        "Skipped: NOT RUN: a: why",
    ]
    assert not_run(reasons) == ["NOT RUN: a: why (2 tests)", "NOT RUN: b: why (1 test)"]


# -- the way to it --------------------------------------------------------------------------------


def test_a_recording_is_found(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b.bin").write_bytes(b"abc")
    assert find(SMALL, {WHERE: str(tmp_path)}) == tmp_path / "a" / "b.bin"
    beside = os.path.relpath(tmp_path, ROOT)
    assert find(SMALL, {WHERE: beside}).samefile(tmp_path / "a" / "b.bin")


def test_what_is_absent_is_told_with_the_reason(tmp_path: Path) -> None:
    for environ, why in (
        ({}, "MOTOR_GATEWAY_DATA is not set"),
        ({WHERE: ""}, "MOTOR_GATEWAY_DATA is not set"),
        ({WHERE: str(tmp_path)}, f"there is no {tmp_path}/a/b.bin"),
        ({WHERE: str(tmp_path / "none")}, "there is no"),
    ):
        with pytest.raises(Absent, match=re.escape(why)):
            find(SMALL, environ)


@pytest.mark.parametrize(("data", "why"), [(b"abd", "has sha256 "), (b"abcd", "has 4 bytes, and the cat")])
def test_a_wrong_one_is_told(tmp_path: Path, data: bytes, why: str) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b.bin").write_bytes(data)
    with pytest.raises(WrongFile, match=why):
        find(SMALL, {WHERE: str(tmp_path)})


@pytest.mark.parametrize(
    ("environ", "answer"),
    [
        ({}, False),
        ({"CI": "true"}, True),
        ({"CI": "True"}, True),
        ({"CI": "false"}, False),
        ({"CI": ""}, False),
        ({"MOTOR_GATEWAY_REQUIRE": "data"}, True),
        ({"MOTOR_GATEWAY_REQUIRE": "can,data"}, True),
        ({"MOTOR_GATEWAY_REQUIRE": "can data"}, True),
        ({"MOTOR_GATEWAY_REQUIRE": "can"}, False),
        ({"MOTOR_GATEWAY_REQUIRE": "database"}, False),
    ],
)
def test_when_they_are_required(environ: dict[str, str], answer: bool) -> None:
    assert required(environ) is answer


@pytest.mark.parametrize(("workers", "demanded"), [("0", False), ("2", True)])
def test_what_did_not_run_is_told_by_name_at_the_end(workers: str, demanded: bool) -> None:
    """And is a failure where it is required. With a real pytest, on the tests of one recording."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", workers]
    command.append("tests/data/test_catalogue.py::test_a_recording_is_what_the_catalogue_says")
    command += ["-k", "husky"]
    environ = {k: v for k, v in os.environ.items() if k not in (WHERE, "CI", "MOTOR_GATEWAY_REQUIRE")}
    there = {name: value for name, value in environ.items() if not name.startswith("PYTEST")}
    if demanded:
        there["MOTOR_GATEWAY_REQUIRE"] = "data"
    done = subprocess.run(command, cwd=ROOT, env=there, capture_output=True, text=True, check=False)
    assert done.returncode == int(demanded), done.stdout
    why = "husky/husky.bag: MOTOR_GATEWAY_DATA is not set"
    told = f"required, and absent: {why}" if demanded else f"NOT RUN: {why} (1 test)"
    assert told in done.stdout
