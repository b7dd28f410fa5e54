"""`gateway protocols new`: what is written is clean, typed, found, and keeps what can be kept unseen."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gateway.cli import scaffold, templates
from gateway.cli.main import main
from gateway.cli.scaffold import BUSES, Kind
from gateway.errors import UserError
from protocols.conformance import CLAUSES, Result, check, table
from protocols.plugin import Broken, load
from tests.distributions import Site
from tests.sampled import sampled

ROOT = Path(__file__).resolve().parents[3]
KINDS: tuple[Kind, ...] = (*BUSES, "sensor")
NEEDS_THE_DEVICE = {"vectors"}
"""Clauses that ask for bytes of the real device."""


def names(results: tuple[Result, ...], outcome: str) -> set[str]:
    return {result.clause for result in results if result.outcome == outcome}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[Kind, Path]:
    into = tmp_path_factory.mktemp("new")
    return {bus: scaffold.new(f"a1_{bus}", bus, into).folder for bus in KINDS}


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    return Site(tmp_path / "site", monkeypatch)


# -- what is written -----------------------------------------------------------------------------------


@pytest.mark.parametrize("bus", KINDS)
def test_it_is_a_whole_small_distribution(tmp_path: Path, bus: Kind) -> None:
    name = f"a1_{bus}"
    folder = scaffold.new(name, bus, tmp_path).folder
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    package = scaffold.SENSOR if bus == "sensor" else scaffold.PACKAGE
    inside = {*package, "py.typed"} | ({"asked.py"} if bus == "serial" else set())
    assert found == {"pyproject.toml", "tests/test_contract.py", *(f"{name}/{file}" for file in inside)}
    project: dict[str, Any] = tomllib.loads((folder / "pyproject.toml").read_text())
    assert project["project"]["name"] == f"motor-gateway-a1-{bus}"
    assert project["project"]["entry-points"]["motor_gateway.protocols"] == {name: f"{name}:plugin"}
    assert not [path for path in folder.rglob("*.*") if re.search(r"\bblank\b|template", path.read_text())]


def test_its_lint_is_ours(written: dict[Kind, Path]) -> None:
    ours: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["ruff"]
    theirs: dict[str, Any] = tomllib.loads((written["can"] / "pyproject.toml").read_text())["tool"]["ruff"]
    for key in ("line-length", "target-version"):
        assert theirs[key] == ours[key]
    for key in ("select", "ignore"):
        assert theirs["lint"][key] == ours["lint"][key]
    assert theirs["lint"]["per-file-ignores"]["tests/**"] == ours["lint"]["per-file-ignores"]["tests/**"]


@pytest.mark.parametrize("arguments", [["check"], ["format", "--check"]], ids=["check", "format"])
def test_it_passes_lint(written: dict[Kind, Path], arguments: list[str]) -> None:
    for folder in written.values():
        command = [sys.executable, "-m", "ruff", *arguments, "--no-cache", "."]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


def test_it_passes_types(written: dict[Kind, Path], tmp_path: Path) -> None:
    packages = [str(folder / folder.name) for folder in written.values()]
    tests = str(written["can"] / "tests" / "test_contract.py")
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent"]
    command += ["--cache-dir", str(tmp_path), *packages, tests]
    environment = {"MYPYPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("bus", sampled(KINDS, 4))
def test_it_keeps_every_clause_that_needs_no_knowledge_of_the_device(
    written: dict[Kind, Path], site: Site, bus: Kind
) -> None:
    site.link(f"motor-gateway-a1-{bus}", f"a1_{bus} = a1_{bus}:plugin", written[bus])
    plugin = load(f"a1_{bus}")
    results = check(plugin)
    assert names(results, "failed") <= NEEDS_THE_DEVICE, table(results)
    assert plugin.spec.__module__ == f"a1_{bus}"
    assert len(names(results, "passed")) > (10 if bus == "sensor" else len(CLAUSES) // 2)
    assert site.spec(plugin).bus == ("serial" if bus == "sensor" else bus)


@pytest.mark.parametrize("bus", KINDS)
def test_each_place_to_fill_in_names_an_existing_clause(written: dict[Kind, Path], bus: Kind) -> None:
    known = {clause.name for clause in CLAUSES}
    for path in written[bus].rglob("*.py"):
        text = path.read_text()
        if path.parent.name == written[bus].name and "test" not in path.name:
            assert "FILL IN" in text, path
        for clauses in re.findall(r"clauses? ((?:\"\w+\"(?:,| and)?\s*)+)", text):
            assert set(re.findall(r"\w+", clauses)) - {"and"} <= known, (path, clauses)


def test_its_own_test_is_the_contract(written: dict[Kind, Path], site: Site) -> None:
    """As its author runs it: one pytest function, red until there are real bytes, if anything is."""
    site.link("motor-gateway-a1-can", "a1_can = a1_can:plugin", written["can"])
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--no-header"]
    done = subprocess.run(
        command, cwd=written["can"], env=site.environment(), capture_output=True, text=True, check=False
    )
    failed = names(check(load("a1_can")), "failed")
    assert done.returncode == (1 if failed else 0), done.stdout + done.stderr
    assert ("1 failed" if failed else "1 passed") in done.stdout


# -- what is refused -----------------------------------------------------------------------------------

REFUSED = [
    ("Foo", "such as 'foo'"),
    ("my-motor", "such as 'my_motor'"),
    ("a__b", "such as 'a_b'"),
    ("_a", "such as 'a'"),
    ("1a", "beginning with a letter"),
    ("", "lower-case letters"),
    ("a" * 41, "40 at most"),
    ("../x", "lower-case letters"),
    ("class", "is a keyword of Python"),
    ("match", "is a keyword of Python"),
    ("json", "is the name of a common module"),
    ("protocols", "is the name of a common module"),
    ("blank", "is the name of a common module"),
    ("plain", "is the name of an installed protocol"),
    ("numpy", "is the name of an installed package (numpy)"),
]


@pytest.mark.parametrize(("name", "reason"), REFUSED, ids=[name or "empty" for name, _ in REFUSED])
def test_a_bad_name_is_refused_with_the_reason(tmp_path: Path, name: str, reason: str) -> None:
    with pytest.raises(UserError, match=re.escape(reason)):
        scaffold.new(name, "can", tmp_path)
    assert not list(tmp_path.iterdir())


def test_what_is_there_is_not_overwritten(tmp_path: Path) -> None:
    scaffold.new("a1_motor", "can", tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(UserError, match="is there already: nothing was written"):
        scaffold.new("a1_motor", "serial", tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    (tmp_path / "a1_link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(UserError, match="is there already"):
        scaffold.new("a1_link", "can", tmp_path)


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not a folder"):
        scaffold.new("a1_motor", "can", tmp_path / "nowhere")
    with pytest.raises(UserError, match="cannot be written"):
        scaffold.new("a1_motor", "can", Path("/proc"))


# -- the command line ----------------------------------------------------------------------------------


def test_new_writes_and_prints_the_next_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["protocols", "new", "a1_motor", "--bus", "canfd", "--into", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert f"written: {tmp_path / 'a1_motor'}" in output
    assert "gateway protocols check a1_motor" in output
    assert main(["protocols", "new", "a1_motor", "--bus", "can", "--into", str(tmp_path)]) == 2
    assert "is there already" in capsys.readouterr().err


def test_check_takes_several_names_and_a_seed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.cli.protocols.load", lambda name: replace(templates.plugin, name=name))
    arguments = ["protocols", "check", "a1_one", "a1_two", "a1_one", "--seed", "5", "-q"]
    status = main(arguments)
    output = capsys.readouterr().out
    assert re.findall(r"^(\w+): FILL IN", output, re.MULTILINE) == ["a1_one", "a1_two"]
    assert output.count("(seed 5)") == 2
    assert output.endswith(f"\n{2 if status == 0 else 0} of 2 protocols keep the contract\n")


def test_check_prints_which_fails_and_ends_with_1(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = replace(templates.plugin, name="a1_bad", spec=_raising)
    monkeypatch.setattr(
        "gateway.cli.protocols.load", lambda name: bad if name == "a1_bad" else templates.plugin
    )
    assert main(["protocols", "check", "a1_bad", "-q"]) == 1
    output = capsys.readouterr().out
    assert re.search(r"^commands +failed +the plugin raises RuntimeError: no", output, re.MULTILINE)
    assert f"a1_bad: 0 passed, {len(CLAUSES)} failed" in output


def _raising(_: object) -> Any:
    raise RuntimeError("no")


def test_check_without_a_name_is_all_of_them_and_names_what_is_broken(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = ((replace(templates.plugin, name="a1_one"),), (Broken("a1_two", "acme", "no"),))
    monkeypatch.setattr("gateway.cli.protocols.load_all", lambda: loaded)
    assert main(["protocols", "check", "-q"]) == 1
    captured = capsys.readouterr()
    assert re.search(r"^a1_one: \d\d passed", captured.out, re.MULTILINE)
    assert re.search(r"^[01] of 2 protocols keep the contract$", captured.out, re.MULTILINE)
    assert captured.err == "a1_two: left out: acme is broken: no\n"
