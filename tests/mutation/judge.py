"""The judge: the language's tests of independent vectors, and each clause of the contract on each variant.

Rules. A check is run on the language as it is imported at that moment. The tests of vectors are the functions
in the language's tests whose name has "vector" in it and whose only arguments are those of `parametrize`;
they are run without pytest. A clause is run on one set of options at a time; only a failure counts, not that
it no longer applies. What raises is a failure.
"""

from __future__ import annotations

import importlib
import itertools
import pkgutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from types import ModuleType
from typing import Any

import protocols
from protocols.conformance import CLAUSES, Clause, variants
from protocols.conformance.bench import ADDRESSES
from protocols.conformance.case import Case, Failure
from tests.mutation.languages import Language, mutated_modules
from tests.mutation.mutants import digest

VECTORS = "vectors"
SEED = 0


@dataclass(frozen=True, slots=True)
class Check:
    """One question to a language."""

    name: str
    """"vectors", or a clause and the number of its variant: "counts[1]"."""
    run: Callable[[], str]
    """What is wrong, or ""."""


def checks(language: Language, alone: bool = False) -> list[Check]:
    """All checks of a language; it is imported if it is not yet.

    The clauses on one set of options share what their case works out once; `alone` each has its own, so that
    a check runs all that it rests on."""
    plugin = language.plugin()
    found = [Check(VECTORS, lambda: _vectors(language))] if language.tests else []
    cases = [Case(plugin, options, SEED, ADDRESSES) for options in variants(plugin)]
    for clause in CLAUSES:
        if language.clauses is None or clause.name in language.clauses:
            for at, case in enumerate(cases):
                own = replace(case, kept={}) if alone else case
                found.append(Check(f"{clause.name}[{at}]", partial(_clause, clause, own)))
    return found


def judged_by(language: Language) -> str:
    """A digest of everything that judges: interface, kit, twin and contract, vectors and their tests.

    The mutated files are not in it: they are what is judged."""
    room = Path(next(iter(protocols.__path__)))
    kit = sorted((room / "conformance").glob("*.py"))
    mutated = set(mutated_modules(language).values())
    own = [path for path in _sources(language.package) if path not in mutated]
    tests = _sources(language.tests) if language.tests else []
    told = [path for path in tests if "vector" in path.read_text("utf-8")]
    parts = [*room.glob("*.py"), *kit, *own, *told]
    texts = [path.read_text("utf-8") for path in sorted(set(parts))]
    vectors = language.plugin().vectors
    if vectors:
        texts.append((files(vectors[0]) / vectors[1]).read_text("utf-8"))
    return digest(*texts, *(language.clauses or ()))


def _sources(package: str) -> list[Path]:
    module = importlib.import_module(package)
    return sorted(path for folder in module.__path__ for path in Path(folder).rglob("*.py"))


def _clause(clause: Clause, case: Case) -> str:
    verdict = clause.check(case)
    return verdict.text or "failed" if isinstance(verdict, Failure) else ""


# -- tests of vectors ----------------------------------------------------------------------------------


def _vectors(language: Language) -> str:
    for _, run in vector_tests(language):
        run()
    return ""


def vector_tests(language: Language) -> Iterator[tuple[str, Callable[[], None]]]:
    """Each call of each test of vectors, with the test's name."""
    for module in _test_modules(language):
        for name, test in vars(module).items():
            if name.startswith("test_") and "vector" in name and callable(test):
                for values in _calls(test):
                    yield f"{module.__name__}.{name}", partial(test, **values)


def _test_modules(language: Language) -> Iterator[ModuleType]:
    package = importlib.import_module(language.tests) if language.tests else None
    for info in pkgutil.iter_modules(package.__path__ if package else ()):
        path = Path(next(iter(package.__path__))) / f"{info.name}.py" if package else Path()
        if info.name.startswith("test_") and _has_vectors(path):
            yield importlib.import_module(f"{language.tests}.{info.name}")


def _has_vectors(path: Path) -> bool:
    text = path.read_text("utf-8")
    return any(line.startswith("def test_") and "vector" in line for line in text.splitlines())


def _calls(test: Callable[..., None]) -> Iterator[dict[str, Any]]:
    """The arguments of each call that `parametrize` asks for; none if the test needs a fixture."""
    marks = [mark for mark in getattr(test, "pytestmark", []) if mark.name == "parametrize"]
    rows = [list(_rows(*mark.args[:2])) for mark in marks]
    for combination in itertools.product(*rows):
        values = {name: value for row in combination for name, value in row.items()}
        if set(values) == set(test.__code__.co_varnames[: test.__code__.co_argcount]):
            yield values


def _rows(names: str | tuple[str, ...], values: list[Any]) -> Iterator[dict[str, Any]]:
    split = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    for value in values:
        plain = getattr(value, "values", value) if hasattr(value, "marks") else value
        single = len(split) == 1 and not hasattr(value, "marks")
        yield dict(zip(split, [plain] if single else plain, strict=True))
