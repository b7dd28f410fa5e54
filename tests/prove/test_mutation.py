"""The machinery of mutation testing, on a toy language: what is killed, what survives, what is changed, what
is known.

(Not a campaign itself.) The toy is the plain language with a driver and an ear of its own, whose few lines
are mutated; each run is a process of its own, since the machinery forks.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gateway.cli.scores import Score, mutation_score, score_of
from tests.mutation import store
from tests.mutation.campaign import changed
from tests.mutation.languages import Language, installed_language, mutated_modules
from tests.mutation.mutants import Mutant, digest, source_of
from tests.mutation.runner import Verdict

ROOT = Path(__file__).resolve().parent.parent.parent
PLUGIN = """\
from dataclasses import replace
from protocols.plain import plugin as plain
from toyling.driver import ToyDriver
from toyling.ear import ToyEar

plugin = replace(plain, name="toyling", driver=ToyDriver, ear=ToyEar, vectors=None)
"""
DRIVER = """\
from protocols.plain.driver import PlainDriver
from toyling import codec
from toyling.codec import TABLE


class ToyDriver(PlainDriver):
    def receive(self, t, wire):
        return super().receive(t, codec.behind(wire, TABLE[0]))

    def wish(self):
        return 1


def hang(n):
    while n < 3:
        n += 1
    return n


class More(ToyDriver):
    def send(self, now, words):
        hang(0)
        return super().send(now, words)


ToyDriver = More
"""
CODEC = '''\
def behind(wire, start):
    """What of a wire of bytes stands from there on."""
    return wire[start + 0:] if isinstance(wire, bytes) else wire


def table():
    return (0, "two words")


TABLE = table()
'''
EAR = """\
from protocols.plain.ear import PlainEar


class ToyEar(PlainEar):
    def hear(self, t, wire):
        return super().hear(t, wire)
"""


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the toy's package in it."""
    folder = tmp_path_factory.mktemp("toy")
    package = folder / "toyling"
    package.mkdir()
    for name, text in (("__init__", PLUGIN), ("driver", DRIVER), ("codec", CODEC), ("ear", EAR)):
        (package / f"{name}.py").write_text(text)
    (package / "unused.py").write_text("def f():\n    return 1\n")
    return folder


def run(folder: Path, *arguments: str) -> tuple[dict[str, Any], str]:
    """The verdicts of a run over the toy, and what it printed."""
    verdicts = folder / "verdicts.json"
    done = subprocess.run(
        [
            *(sys.executable, "-m", "tests.mutation", "toyling", "--language", "toyling:toyling:plugin:"),
            *("--clauses", "commands"),
            *("--progress", str(folder / "progress"), "--verdicts", str(verdicts), *arguments),
        ],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(verdicts.read_text())
    return found, done.stdout


def outcome(found: dict[str, Any], function: str, part: str) -> str:
    """What killed the one mutant of a function whose difference has this part in it."""
    (row,) = [r for r in found["verdicts"] if r["function"] == function and part in r["diff"]]
    return str(row["killer"])


def test_a_campaign_on_a_toy(toy: Path) -> None:
    found, said = run(toy)
    assert found["failing"] == {}
    assert {row["file"] for row in found["verdicts"]} == {"codec.py", "driver.py", "ear.py"}
    # What the contract must notice:
    assert outcome(found, "behind", "start + 1:") == "commands[1]"
    assert outcome(found, "ToyEar.hear", "hear(t, None)") == "commands[1]"
    # A mutant of what runs at import is seen, though nothing calls it later:
    assert outcome(found, "table", "+ return (1,") == "commands[1]"
    # One that does not end is ended:
    (hang,) = [r for r in found["verdicts"] if "- n += 1\n+ n -= 1" in r["diff"]]
    assert hang["killer"] != ""
    assert "SIGPROF" in hang["text"]
    # What nobody runs is named:
    assert outcome(found, "ToyDriver.wish", "return 2") == ""
    assert "survives: driver.py ToyDriver.wish" in said
    # Another wording of a sentence is left out, and nothing else of that line:
    assert not [r for r in found["verdicts"] if "two words" in r["diff"] and "XX" in r["diff"]]

    again, said = run(toy)
    assert f"{len(found['verdicts'])} of them known" in said
    assert "survives" not in said
    assert again == found

    codec = toy / "toyling" / "codec.py"
    codec.write_text(CODEC.replace("wire[start + 0:]", "wire[0 + start:]"))
    try:
        third, said = run(toy)
    finally:
        codec.write_text(CODEC)
    known = sum(row["function"] != "behind" for row in found["verdicts"])
    assert f"{known} of them known" in said  # the function that was touched is tried anew, and no other
    assert outcome(third, "behind", "1 + start:") == "commands[1]"


def test_a_sample_is_the_same_with_the_same_seed(toy: Path, tmp_path: Path) -> None:
    one, _ = run(toy, "--sample", "3", "--seed", "5", "--files", "codec.py")
    other, _ = run(toy, "--sample", "3", "--seed", "5", "--files", "codec.py")
    assert one == other
    assert len(one["verdicts"]) == 3
    assert {row["file"] for row in one["verdicts"]} == {"codec.py"}
    none, _ = run(toy, "--progress", str(tmp_path), "--sample", "3", "--seconds", "0")
    assert len(none["verdicts"]) == 1  # the first is tried, however late it is


# -- without a campaign ---------------------------------------------------------------------------------


def test_what_is_mutated_follows_from_driver_and_ear() -> None:
    odrive = mutated_modules(installed_language("odrive_can"))
    names = {name.rpartition(".")[2] for name in odrive}
    assert names >= {"codec", "driver", "ear", "node", "layout", "messages", "requests"}
    assert not names & {"twin", "twin05", "twin06", "servo", "bench", "options", "odrive_can"}
    plain = mutated_modules(installed_language("plain"))
    assert [path.name for path in plain.values()] == ["codec.py", "driver.py", "ear.py", "line.py"]


SOURCE = '''\
"""A module."""


class Box:
    # what it holds
    @staticmethod
    def twice(x: int, words: str = "a b") -> int:
        """Twice."""
        return x * 2


def words(n: int) -> str:
    if n > 1:
        raise KeyError("more than one", n)
    note("one or more", "key")
    return f"{n} of them"
'''


def test_mutants_stand_in_the_place_of_their_function(tmp_path: Path) -> None:
    path = tmp_path / "box.py"
    path.write_text(SOURCE)
    source = source_of("box", path)
    texts = {mutant.diff: source.with_mutant(mutant) for mutant in source.mutants}
    doubled = texts["- return x * 2\n+ return x * 3"]
    assert doubled == SOURCE.replace("x * 2", "x * 3")
    assert any(diff.endswith('note("one or more", "KEY")') for diff in texts)
    assert any(diff.endswith('note(None, "key")') for diff in texts)  # no text at all is no wording
    assert any(diff.endswith('raise KeyError("more than one", None)') for diff in texts)
    assert not any("KeyError(None, n)" in diff or "XXone or" in diff for diff in texts)
    assert source.wordings == 8  # of each sentence: XX, all large; of the exception also None, and without
    assert len({mutant.identity for mutant in source.mutants}) == len(source.mutants)
    for text in texts.values():
        compile(text, "box.py", "exec")
        assert text != SOURCE


def test_a_changed_file_is_noticed(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(toy))
    language = Language("toyling", "toyling", "toyling", "plugin")
    known = {path.name: digest(path.read_text()) for path in mutated_modules(language).values()}
    assert set(known) == {"codec.py", "driver.py", "ear.py"}
    assert changed(language, known) == []
    assert changed(language, known | {"ear.py": "0"}) == ["ear.py"]
    assert changed(language, {name: known[name] for name in ("codec.py", "ear.py")}) == ["driver.py"]
    language.forget()
    assert "toyling.ear" not in sys.modules


# -- what is stored -------------------------------------------------------------------------------------


def mutant(function: str, diff: str, file: str = "a.py") -> Mutant:
    return Mutant("m.a", file, function, diff, digest(file, function, diff), "")


ALIVE, DEAD = mutant("f", "- 1\n+ 2"), mutant("g", "- a\n+ b")


def campaign(*verdicts: Verdict, seed: int | None = None) -> store.Campaign:
    judge = {"digest": "j", "checks": {"vectors": 0.1}, "failing": {}}
    return store.Campaign("toy", {"a.py": digest("x = 1\n")}, judge, 5, 1, seed, 5, verdicts)


def test_a_judgement_is_kept_as_long_as_its_survivor_is_the_same(tmp_path: Path) -> None:
    twin = replace(ALIVE, identity="another")
    store.save(campaign(Verdict(ALIVE, "", "", 1.0), Verdict(DEAD, "vectors", "no", 0.1)), tmp_path)
    first = store.stored("toy", tmp_path)
    assert first is not None
    assert (first["killed"], first["tried"], first["mutants"]) == (1, 2, 5)
    (row,) = first["survivors"]
    assert row == {"file": "a.py", "function": "f", "diff": "- 1\n+ 2", "judgement": store.UNJUDGED}
    assert not store.judged(row)
    row["judgement"] = "equivalent: nobody counts it"
    assert store.judged(row)
    assert not store.judged(row | {"judgement": "missed: "})
    (tmp_path / "toy.json").write_text(json.dumps(first))
    both = campaign(Verdict(ALIVE, "", "", 1.0), Verdict(twin, "", "", 1.0), Verdict(DEAD, "", "", 1.0))
    store.save(both, tmp_path)
    second = store.stored("toy", tmp_path)
    assert second is not None
    said = [row["judgement"] for row in second["survivors"]]
    assert said == ["equivalent: nobody counts it", store.UNJUDGED, store.UNJUDGED]
    assert store.named(second) == {("a.py", "f", "- 1\n+ 2"), ("a.py", "g", "- a\n+ b")}
    assert store.stored("other", tmp_path) is None


def test_progress_is_kept_by_function_and_judge(tmp_path: Path) -> None:
    path = tmp_path / "new" / "p.jsonl"
    progress = store.Progress(path, "judge")
    progress.keep(Verdict(DEAD, "counts[0]", "a count", 0.25))
    with path.open("a") as file:
        file.write('{"mutant": "torn')
    store.Progress(path, "judge").keep(Verdict(ALIVE, "", "", 3.0))
    again = store.Progress(path, "judge")
    assert again.before(DEAD) == Verdict(DEAD, "counts[0]", "a count", 0.25)
    assert again.before(ALIVE) == Verdict(ALIVE, "", "", 3.0)
    other = store.Progress(path, "another judge")
    assert other.before(DEAD) is None
    assert other.killers == {DEAD.identity: "counts[0]"}  # it is the first to be asked


def test_a_score_is_read_by_name(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("x = 1\n")
    store.save(campaign(Verdict(ALIVE, "", "", 1.0), Verdict(DEAD, "vectors", "no", 0.1), seed=3), tmp_path)
    result = store.stored("toy", tmp_path)
    assert result is not None
    score = score_of(result, tmp_path)
    assert score == Score(killed=1, tried=2, equivalent=0, judged=0, total=5, current=True)
    assert str(score) == "50 % of 2 tried (5 in all)"
    (tmp_path / "a.py").write_text("x = 2\n")
    result["survivors"][0]["judgement"] = "equivalent: it is"
    assert score_of(result, tmp_path) == Score(1, 2, 1, 1, 5, current=False)
    (tmp_path / "a.py").unlink()
    assert str(score_of(result | {"mutants": 2}, tmp_path)) == "50 % of 2 tried, sources changed since"
    assert mutation_score("no_such_language") is None
    assert mutation_score("../plain") is None
