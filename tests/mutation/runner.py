"""Mutants and the judge, one process for each mutant.

Rules. The process that forks has everything imported but the language and its tests; a child imports these,
with one module mutated. Each check has a limit of CPU time, ten times what the sound language takes: a mutant
may hang. A mutant meets only those checks in which the sound language runs its function (all, if it is run at
import), and of a clause that is not cheap only the first such variant: a score is what is killed at least.
Checks that killed the function's other mutants come first, then those that take least for each mutant that
they have killed. At most `processes` children at a time.
"""

from __future__ import annotations

import gc
import importlib.abc
import importlib.machinery
import json
import os
import resource
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

from tests.mutation.judge import Check, checks, vector_tests
from tests.mutation.languages import Language
from tests.mutation.mutants import Mutant, Source

MEMORY = 4 << 30
PATIENCE = 10.0
CHEAP = 0.15
"""s; what takes longer is tried on the first variant only that runs the function."""
LEAST = 2.0
"""s of CPU time that every check is given."""
HANGS = {signal.SIGPROF, signal.SIGXCPU, signal.SIGSEGV}
"""Signals that are a mutant's own fault: it did not end, or it overflowed the stack."""


@dataclass(frozen=True, slots=True)
class Baseline:
    """What the sound language does."""

    cost: Mapping[str, float]
    """s of CPU time, by check."""
    runs: Mapping[str, frozenset[str]] | None
    """By check, the functions that it runs, as "module:Class.name"; None if that is not known."""
    at_import: frozenset[str]
    failing: Mapping[str, str]
    """Checks that the language fails as it is, with what is wrong: these judge nothing."""

    def relevant(self, module: str, function: str) -> list[str]:
        """The checks that are worth trying on a function's mutants, the cheapest first."""
        key = f"{module}:{function}"
        every = self.runs is None or key in self.at_import
        names = [name for name in self.cost if every or key in (self.runs or {})[name]]
        first = {name.partition("[")[0]: name for name in reversed(names)}
        worth = [n for n in names if self.cost[n] <= CHEAP or first[n.partition("[")[0]] == n]
        return sorted(worth, key=lambda name: (self.cost[name], name))


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of a mutant."""

    mutant: Mutant
    killer: str
    """The check that failed; "" if the mutant survived."""
    text: str
    seconds: float
    """CPU time."""


# -- what a child does ----------------------------------------------------------------------------------


def in_child(work: Callable[[Callable[[Any], None]], None]) -> tuple[int, int]:
    """Fork; the child does the work, and says things by the function that it is given. (pid, pipe's end)."""
    reads, writes = os.pipe()
    pid = os.fork()
    if pid:
        os.close(writes)
        return pid, reads
    status = 1
    try:
        os.close(reads)
        silence = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(silence, stream)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

        def say(thing: Any) -> None:
            os.write(writes, json.dumps(thing).encode() + b"\n")

        work(say)
        status = 0
    finally:
        os._exit(status)


def heard(pid: int, pipe: int) -> tuple[list[Any], int, float]:
    """What a child has said until its end, the signal that ended it (0 if none), and its CPU time."""
    with os.fdopen(pipe, "rb") as file:
        lines = [json.loads(line) for line in file.read().splitlines()]
    _, status, used = os.wait4(pid, 0)
    ended = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    return lines, ended, used.ru_utime + used.ru_stime


def _limit(seconds: float) -> None:
    """The kernel ends this process after so much CPU time."""
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_PROF, seconds)


def attempt(check: Check) -> str:
    """What a check finds wrong; what it raises is wrong, too."""
    try:
        return check.run()
    except BaseException as error:  # noqa: BLE001 -- a mutant may raise anything, pytest's outcomes included
        return f"{type(error).__name__}: {error}"


def prepare(language: Language) -> None:
    """Import what the language and its tests lean on, and forget these: no child has to import it again."""
    checks(language)
    for _ in vector_tests(language):
        pass
    language.forget()


class Mutated(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from a text instead of its file."""

    def __init__(self, module: str, path: Path, text: str) -> None:
        self.module, self.path, self.text = module, path, text

    def find_spec(
        self, fullname: str, path: Any, target: Any = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != self.module:
            return None
        return importlib.machinery.ModuleSpec(fullname, self, origin=str(self.path))

    def exec_module(self, module: ModuleType) -> None:
        module.__file__ = str(self.path)
        exec(compile(self.text, str(self.path), "exec", dont_inherit=True), module.__dict__)


def _tried(
    language: Language, source: Source, mutant: Mutant, names: Sequence[str], cost: Mapping[str, float]
) -> Any:
    def work(say: Callable[[Any], None]) -> None:
        gc.disable()
        language.forget()
        sys.meta_path.insert(0, Mutated(mutant.module, source.path, source.with_mutant(mutant)))
        say("import")
        _limit(PATIENCE)
        try:
            found = {check.name: check for check in checks(language)}
        except BaseException as error:  # noqa: BLE001 -- as above
            say({"killer": "import", "text": f"{type(error).__name__}: {error}"[:300]})
            return
        for name in names:
            if name not in found:
                continue
            say(name)
            _limit(max(LEAST, PATIENCE * cost[name]))
            wrong = attempt(found[name])
            if wrong:
                say({"killer": name, "text": wrong[:300]})
                return
        say({"killer": "", "text": ""})

    return work


def _verdict(mutant: Mutant, lines: list[Any], ended: int, seconds: float) -> Verdict:
    last = lines[-1] if lines else None
    if isinstance(last, dict):
        return Verdict(mutant, last["killer"], last["text"], seconds)
    if isinstance(last, str) and ended in HANGS:
        return Verdict(mutant, last, f"ended by {signal.Signals(ended).name}", seconds)
    raise RuntimeError(f"{mutant.module}:{mutant.function} ended by signal {ended} after {last!r}")


# -- the sound language ---------------------------------------------------------------------------------


def baseline(language: Language, modules: Mapping[str, Path], traced: bool = True) -> Baseline:
    """The checks on the sound language, in a child: their cost, and, if traced, which functions each runs."""
    names = {str(path): module for module, path in modules.items()}

    def work(say: Callable[[Any], None]) -> None:
        language.forget()
        with _Ran(names) as at_import:
            every = checks(language, alone=True)
        say(["import", 0.0, "", sorted(at_import)])
        costs: dict[str, tuple[float, str]] = {}
        for check in every:
            began = time.process_time()
            wrong = attempt(check)
            cost = time.process_time() - began
            costs[check.name] = (cost, wrong)
        for check in checks(language, alone=True):
            with _Ran(names) as ran:
                if traced:
                    attempt(check)
            say([check.name, *costs[check.name], sorted(ran)])

    lines, ended, _ = heard(*in_child(work))
    if ended or not lines:
        raise RuntimeError(f"the checks of {language.name} ended by signal {ended} after {lines[-1:]}")
    first, *rest = lines
    sound = [line for line in rest if not line[2]]
    return Baseline(
        {name: cost for name, cost, _, _ in sound},
        {name: frozenset(ran) for name, _, _, ran in sound} if traced else None,
        frozenset(first[3]),
        {name: wrong for name, _, wrong, _ in rest if wrong},
    )


class _Ran:
    """The functions of some files that are called meanwhile."""

    def __init__(self, modules: Mapping[str, str]) -> None:
        self.modules = modules
        self.codes: set[CodeType] = set()

    def __enter__(self) -> _Ran:
        sys.settrace(self._note)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)

    def __iter__(self) -> Iterator[str]:
        for code in self.codes:
            module = self.modules.get(code.co_filename)
            if module:
                yield f"{module}:{code.co_qualname.partition('.<locals>')[0]}"

    def _note(self, frame: FrameType, _event: str, _: object) -> None:
        """Called for each new frame; it asks for no more than that."""
        self.codes.add(frame.f_code)


# -- all of them ----------------------------------------------------------------------------------------


@dataclass(slots=True)
class Runner:
    """Tries mutants, some at a time."""

    language: Language
    sources: Mapping[str, Source]
    baseline: Baseline
    processes: int = 1
    killers: dict[str, list[str]] = field(default_factory=dict)
    """By function, the checks that have killed its mutants, the last first."""
    kills: Counter[str] = field(default_factory=Counter)
    """By check, how many mutants it has killed."""

    def run(self, mutants: Iterable[Mutant], hints: Mapping[str, str] | None = None) -> Iterator[Verdict]:
        """The verdicts, in the order of the mutants. `hints`: by identity, what killed a mutant before."""
        gc.collect()
        gc.freeze()
        ahead: list[tuple[Mutant, tuple[int, int]]] = []
        for mutant in mutants:
            names = self._order(mutant, (hints or {}).get(mutant.identity, ""))
            source = self.sources[mutant.module]
            work = _tried(self.language, source, mutant, names, self.baseline.cost)
            ahead.append((mutant, in_child(work)))
            if len(ahead) >= self.processes:
                yield self._next(ahead)
        while ahead:
            yield self._next(ahead)

    def _next(self, ahead: list[tuple[Mutant, tuple[int, int]]]) -> Verdict:
        mutant, child = ahead.pop(0)
        verdict = _verdict(mutant, *heard(*child))
        if verdict.killer in self.baseline.cost:
            self.kills[verdict.killer] += 1
            known = self.killers.setdefault(f"{mutant.module}:{mutant.function}", [])
            known[:] = [verdict.killer, *(name for name in known if name != verdict.killer)]
        return verdict

    def _order(self, mutant: Mutant, hint: str) -> list[str]:
        names = self.baseline.relevant(mutant.module, mutant.function)
        names.sort(key=lambda name: self.baseline.cost[name] / (1 + self.kills[name]))
        known = [hint, *self.killers.get(f"{mutant.module}:{mutant.function}", [])]
        first = [name for name in dict.fromkeys(known) if name in names]
        return [*first, *(name for name in names if name not in first)]
