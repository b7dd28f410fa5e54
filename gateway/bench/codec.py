"""One message to bytes and back: the codec of each language, cantools on the vendor's DBC, and bare `struct`.

Rules. A language that wants to be measured brings a module `bench` in its folder, with `SAMPLES` and `DBC`:
what the messages are is its own affair. cantools is used as its documentation shows first, by
`encode_message` and `decode_message` with the checks it makes by default. Ours makes a message and the whole
frame, and lets no number through that is not finite.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from gateway.bench.measure import Call, Effort, NotMeasured, Rival, in_turn, rival
from gateway.bench.rows import Row, Target, against
from protocols.plugin import installed

STRUCT = "bare struct"
TWICE = Target(ratio=2.0)


def codec(effort: Effort) -> list[Row]:
    """Encode and decode, language by language."""
    rows: list[Row] = []
    for name, module in languages():
        group = f"one message of {name} (cantools on the vendor's DBC)"
        cantools = database(module)
        rows += [_row(group, sample, cantools, effort.of(1000, 50)) for sample in module.SAMPLES]
    return rows


def languages() -> list[tuple[str, ModuleType]]:
    """The installed languages that bring samples, by name."""
    modules = [(point.name, f"{point.module}.bench") for point in installed()]
    return [(name, import_module(module)) for name, module in modules if find_spec(module)]


def database(language: ModuleType) -> Rival:
    """cantools with the language's DBC as its module, or why it is not there."""
    cantools = rival("cantools", "cantools")
    package, file = language.DBC
    found = find_spec(package)
    if cantools.why_not or found is None or found.origin is None:
        return Rival("cantools", None, cantools.why_not or f"{package}, which has the DBC, is not installed")
    known = cantools.module.database.load_file(Path(found.origin).parent / file)
    return Rival(cantools.name, known)


def _row(group: str, sample: Any, cantools: Rival, rounds: int) -> Row:  # noqa: ANN401 -- the language's own type
    contestants: dict[str, Call] = {"ours": sample.ours}
    if cantools.module is not None:
        contestants[cantools.name] = theirs(sample, cantools.module)
    contestants[STRUCT] = sample.struct
    found = in_turn(contestants, rounds)
    beside = against(found, cantools.name, missing=(cantools,)) + against(found, STRUCT)
    return Row(group, sample.what, found["ours"], beside, TWICE)


def theirs(sample: Any, known: Any) -> Call:  # noqa: ANN401 -- the language's own type; cantools has no types
    """What cantools does for a sample. Raises NotMeasured if it comes to something else."""
    number, data, values = sample.id, sample.data, sample.values
    if not values:
        return lambda: known.decode_message(number, data)
    said = known.encode_message(number, values)
    if said != data or sample.ours().data != data:
        raise NotMeasured(f"{sample.what}: ours {sample.ours()}, cantools {said.hex()}, wanted {data.hex()}")
    return lambda: known.encode_message(number, dict(values))
