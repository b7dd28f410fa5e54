"""A campaign over a language: which mutants, what is known of them already, and the result.

Rules. A sample is drawn with a seed from all mutants (of some files, if so asked) in their order. A campaign
goes on where it was interrupted. A deadline, if there is one, is looked at between mutants.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.random import PCG64, Generator

from tests.mutation import store
from tests.mutation.judge import judged_by
from tests.mutation.languages import Language, mutated_modules
from tests.mutation.mutants import Mutant, Source, digest, source_of
from tests.mutation.runner import Baseline, Runner, Verdict, baseline, prepare


@dataclass(frozen=True, slots=True)
class Plan:
    """How much of it."""

    sample: int | None = None
    """How many mutants; None: all."""
    seed: int = 0
    files: Collection[str] | None = None
    """Names of the files to be mutated; None: all."""
    processes: int = 1
    deadline: float | None = None
    """s after which no further mutant is tried; the first is, always."""
    clock: Callable[[], float] = time.monotonic
    """What the deadline is measured by [s]: `spent` is as long on a busy machine as on an idle one."""
    traced: bool = True
    """Whether to find out first which functions each check runs: slow to begin, quicker for each mutant."""
    stored: Mapping[str, Any] | None = None
    """A stored result to lean on, to be quick: what checks cost, and which survivors are not tried again."""


def run(
    language: Language, plan: Plan, progress: Path = store.PROGRESS, tell: Callable[[str], None] = print
) -> store.Campaign:
    """Try the mutants of a plan that are not known yet."""
    modules = mutated_modules(language)
    judge = judged_by(language)
    prepare(language)
    wanted = None if plan.stored is None else plan.files  # to be quick, and nothing is stored
    sources = {m: source_of(m, path) for m, path in modules.items() if wanted is None or path.name in wanted}
    files = {s.path.name: s for s in sources.values()}
    chosen = _chosen(list(sources.values()), plan)
    kept = store.Progress(progress / f"mutation-{language.name}.jsonl", judge)
    known = [verdict for mutant in chosen if (verdict := kept.before(mutant))]
    tell(f"{language.name}: {len(chosen)} mutants, {len(known)} of them known")
    base = baseline(language, modules, plan.traced) if plan.stored is None else _assumed(plan.stored)
    for name, wrong in base.failing.items():
        tell(f"{language.name}: {name} fails without any mutation, and judges nothing: {wrong}")
    ends = plan.clock() + plan.deadline if plan.deadline is not None else math.inf
    runner = Runner(language, sources, base, plan.processes)
    verdicts = list(_verdicts(runner, chosen, kept, lambda: plan.clock() > ends, tell))
    return store.Campaign(
        language.name,
        {name: source.digest for name, source in sorted(files.items())},
        _judge(judge, base),
        sum(len(source.mutants) for source in sources.values()),
        sum(source.wordings for source in sources.values()),
        None if plan.sample is None and plan.files is None and plan.deadline is None else plan.seed,
        len(chosen),
        verdicts,
    )


def spent() -> float:
    """CPU time of this process and of its children that have ended [s]."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def changed(language: Language, result: dict[str, str]) -> list[str]:
    """The files that driver and ear lean on whose digest is not this (or has none)."""
    now = {path.name: digest(path.read_text("utf-8")) for path in mutated_modules(language).values()}
    return sorted(name for name, value in now.items() if result.get(name) != value)


def _judge(judge: str, base: Baseline) -> dict[str, object]:
    cost = {name: round(seconds, 2) for name, seconds in base.cost.items()}
    return {"digest": judge, "checks": cost, "failing": dict(base.failing)}


def _assumed(stored: Mapping[str, Any]) -> Baseline:
    """What the checks cost when the result was stored; which functions each runs is not known."""
    return Baseline(stored["judge"]["checks"], None, frozenset(), {})


def _chosen(sources: Sequence[Source], plan: Plan) -> list[Mutant]:
    every = [m for s in sources for m in s.mutants if plan.files is None or m.file in plan.files]
    if plan.stored:
        known = store.named(plan.stored)
        every = [m for m in every if (m.file, m.function, m.diff) not in known]
    if plan.sample is None:
        return every
    picked = Generator(PCG64(plan.seed)).choice(len(every), min(plan.sample, len(every)), replace=False)
    return [every[at] for at in picked]  # as they were drawn: the first of them are a sample, too


def _verdicts(
    runner: Runner,
    chosen: list[Mutant],
    kept: store.Progress,
    late: Callable[[], bool],
    tell: Callable[[str], None],
) -> Iterator[Verdict]:
    """What is known, then what is found; each is kept at once."""
    ahead = []
    for mutant in chosen:
        known = kept.before(mutant)
        if known:
            yield known
        else:
            ahead.append(mutant)

    def in_time() -> Iterator[Mutant]:
        for at, mutant in enumerate(ahead):
            if at and late():
                return
            yield mutant

    for count, verdict in enumerate(runner.run(in_time(), kept.killers), 1):
        kept.keep(verdict)
        if not verdict.killer:
            tell(f"  survives: {described(verdict.mutant)}")
        if count % 100 == 0:
            tell(f"  {count} of {len(ahead)}")
        yield verdict


def described(mutant: Mutant) -> str:
    """A mutant in a few lines."""
    return "\n    ".join([f"{mutant.file} {mutant.function}", *mutant.diff.split("\n")])
