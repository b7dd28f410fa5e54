"""State: equal inputs give equal outputs, and state can be copied between any two calls."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, cast

from protocols.conformance import bench as tools
from protocols.conformance.bench import Bench
from protocols.conformance.case import Case, Failure, difference
from protocols.conformance.random import Random
from protocols.frames import BusState
from protocols.plugin import CommandDecoder, Driver, Twin

OFTEN, SELDOM = 6, 25
"""One call in so many is made on a copy: ..."""
AT_FIRST = 400
"""... of the first calls, and of the later ones."""


def equal_inputs_give_equal_outputs(case: Case) -> None:
    """Two sets of driver, decoder and twins with the same inputs have the same outputs, in the same order."""
    if case.whole:  # With other options the clause "copies" tests the same.
        _compare(case, case.start(), "the first", "the second")


def copies_behave_the_same(case: Case) -> None:
    """State can be copied and put in place of the original between any two calls."""
    bench, random = case.start(), Random(case.seed)
    bench.driver = cast(Driver, _Copied(bench.driver, random))
    bench.decoder = cast(CommandDecoder, _Copied(bench.decoder, random))
    bench.twins = [cast(Twin, _Copied(twin, random)) for twin in bench.twins]
    _compare(case, bench, "the original", "the copy")


def _compare(case: Case, other: Bench, this: str, that: str) -> None:
    """Run the script on two benches, with a bus that changes its state."""
    one = case.start()
    if case.spec.bus == "serial":
        one.splitting, other.splitting = case.random(), case.random()
    states = [BusState.PASSIVE, BusState.UP, BusState.FULL, BusState.UP, BusState.OFF, BusState.BACK]
    for at, messages in enumerate(tools.script(case.spec, case.names)):
        if at % 97 == 96:
            for bench in (one, other):
                bench.driver.bus(bench.now, states[at // 97 % len(states)])
        left, right = one.step(messages), other.step(messages)
        if left != right:
            raise difference(left, right, f"from {this}", f"from {that}")
    if one.driver.counters != other.driver.counters:
        raise Failure(f"{one.driver.counters} of {this}, {other.driver.counters} of {that}")


@dataclass(slots=True)
class _Copied:
    """A driver, decoder or twin; before some calls it puts a copy in place of the original.

    The original is called too, and its result ignored: if the two share any state, the result of the copy
    is wrong."""

    original: Any
    random: Random
    calls: int = 0

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 -- whatever the original has
        if name in ("receive", "bus", "send", "decode", "step"):
            return lambda *arguments: self._call(name, *arguments)
        return getattr(self.original, name)

    def _call(self, method: str, *arguments: Any) -> Any:  # noqa: ANN401 -- of any method
        self.calls += 1
        if self.calls == 1 or self.random.below(OFTEN if self.calls < AT_FIRST else SELDOM) == 0:
            original = self.original
            try:
                self.original = copy.deepcopy(original)
            except Exception as error:
                text = f"{type(original).__name__} cannot be copied: {type(error).__name__}: {error}"
                raise Failure(text) from error
            getattr(original, method)(*arguments)
        return getattr(self.original, method)(*arguments)
