"""One message to bytes and back: the codec of each language, what its devices are usually spoken to with, and
bare `struct`.

Rules. The samples of a protocol are the module of its name in `benchmarks.samples`, or `bench` in its own
package, with `RIVAL`, `prepared` and `SAMPLES` (class `Language`): what the messages are, and which package
is the vendor's or the usual one, is its own affair. One whose licence keeps it out of our process is a
script, `ELSEWHERE`, which is measured in a process of its own. A package is used as its documentation shows
first, with the checks it makes by default. Ours makes a message and the whole frame, and lets no number
through that is not finite. All sides of a sample must come to the same, or it is not measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Protocol, cast

from benchmarks.measure import Call, Effort, NotMeasured, Rival, in_turn, rival, rival_elsewhere
from benchmarks.rows import Row, Target, against
from protocols.plugin import installed

STRUCT = "bare struct"
TWICE = Target(ratio=2.0)


class Sample(Protocol):
    """One message in one direction."""

    @property
    def what(self) -> str:
        """Direction and message, e.g. "encode Set_Input_Vel"."""
        ...

    @property
    def ours(self) -> Call:
        """Our codec does it."""
        ...

    @property
    def struct(self) -> Call:
        """`struct` does it: it knows the message beforehand, checks nothing and makes no frame."""
        ...

    def theirs(self, known: Any) -> Call:  # noqa: ANN401 -- a package without types
        """The rival does it; `known` is what `Language.prepared` made."""
        ...

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- the language's own types
        """Whether what the three calls gave is the same message."""
        ...


class Language(Protocol):
    """The samples module of a protocol."""

    RIVAL: tuple[str, str, str]
    """Module and distribution of the vendor's or usual package, and how it is used here."""
    SAMPLES: Sequence[Sample]

    def prepared(self, package: Any) -> Any:  # noqa: ANN401 -- a package without types
        """What the rival's calls need, made once from its imported module. ImportError if another package
        that it needs is not installed."""
        ...


def codec(effort: Effort) -> list[Row]:
    """Encode and decode, language by language."""
    rows: list[Row] = []
    for name, language in languages():
        group = f"one message of {name} ({language.RIVAL[2]})"
        other = opened(language)
        rows += [_row(group, sample, other, effort.of(1000, 50)) for sample in language.SAMPLES]
    return rows


def languages() -> list[tuple[str, Language]]:
    """The installed languages that bring samples, by name."""
    found: list[tuple[str, Language]] = []
    for point in installed():
        for module in (f"benchmarks.samples.{point.name}", f"{point.module}.bench"):
            if find_spec(module):
                found.append((point.name, cast(Language, import_module(module))))
                break
    return found


def opened(language: Language) -> Rival:
    """What the language is measured against, prepared; or why it is not there."""
    module, distribution, _ = language.RIVAL
    script = getattr(language, "ELSEWHERE", "")
    found = rival_elsewhere(distribution, script) if script else rival(module, distribution)
    if found.why_not:
        return found
    try:
        return Rival(found.name, language.prepared(found.module))
    except ImportError as error:
        return Rival(distribution, None, f"{error.name or error} is not installed")


def _row(group: str, sample: Sample, other: Rival, rounds: int) -> Row:
    contestants: dict[str, Call] = {"ours": sample.ours}
    if other.module is not None:
        contestants[other.name] = theirs(sample, other.module)
    contestants[STRUCT] = sample.struct
    found = in_turn(contestants, rounds)
    beside = against(found, other.name, missing=(other,)) + against(found, STRUCT)
    return Row(group, sample.what, found["ours"], beside, TWICE)


def theirs(sample: Sample, known: object) -> Call:
    """What the rival does for a sample. Raises NotMeasured if it comes to something else."""
    call = sample.theirs(known)
    ours, other, bare = sample.ours(), call(), sample.struct()
    if not sample.alike(ours, other, bare):
        raise NotMeasured(f"{sample.what}: ours {ours}, theirs {other}, bare struct {bare}")
    return call
