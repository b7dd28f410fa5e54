"""The contract over everything installed, and the contract itself over plugins broken on purpose."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import pytest

from protocols.conformance import CLAUSES, Clause, Result, check, table, variants
from protocols.conformance.bench import Bench, Shaft, close, finite, make_bench, shortest
from protocols.conformance.case import Case, Failure, Inapplicable
from protocols.conformance.random import Random
from protocols.frames import CanFrame, Frame
from protocols.messages import Feedback, LaserScan, Velocity
from protocols.plain import plugin as plain
from protocols.plugin import Plugin, Range, load_all
from tests.protocols.broken import HoldsAGenerator, motors, sensors
from tests.protocols.broken_all import BROKEN
from tests.protocols.sound import SOUND
from tests.sampled import sampled

INSTALLED, UNLOADABLE = load_all()
NAMES = [clause.name for clause in CLAUSES]
ROOT = Path(__file__).parents[2]
OURS = {path.parent.name for path in (ROOT / "protocols").glob("*/driver.py")}
PAGE = (ROOT / "docs" / "contract.md").read_text("utf-8")


def clauses(names: Sequence[str]) -> list[Clause]:
    return [clause for clause in CLAUSES if clause.name in names]


def summary(name: str, results: Sequence[Result]) -> str:
    """The row of docs/contract.md for a protocol, up to its sources."""
    outcomes = [result.outcome for result in results]
    inapplicable = [f"`{result.clause}`" for result in results if result.outcome == "not applicable"]
    passed, failed = outcomes.count("passed"), outcomes.count("failed")
    return f"| `{name}` | {passed} | {failed} | {len(inapplicable)}: {', '.join(inapplicable)} |"


@pytest.mark.parametrize("plugin", INSTALLED, ids=lambda plugin: str(plugin.name))
def test_every_installed_plugin_keeps_the_contract(plugin: Plugin) -> None:
    results = check(plugin, options=[plugin.tried()], brief=True)  # whole, with all options: ./go prove
    print(table(results))
    assert [result.clause for result in results] == NAMES
    assert not [result for result in results if result.outcome == "failed"], table(results)


@pytest.mark.prove
@pytest.mark.parametrize("plugin", INSTALLED, ids=lambda plugin: str(plugin.name))
def test_with_all_of_its_options_it_keeps_the_contract_as_the_page_says(plugin: Plugin) -> None:
    results = check(plugin)
    assert not [result for result in results if result.outcome == "failed"], table(results)
    if plugin.name in OURS:
        assert summary(plugin.name, results) in PAGE, f"docs/contract.md shows other results of {plugin.name}"
    if plugin.name == "odrive_can":
        assert table(results) in PAGE, f"docs/contract.md shows another table of {plugin.name}"


def test_the_page_lists_every_clause() -> None:
    reported = re.findall(r"^\| `(\w+)` \| [^|]+ \| [^|]+ \|$", PAGE, re.M)
    assert sorted(reported) == sorted(NAMES)
    assert f"The {len(NAMES)} clauses" in PAGE
    assert f"{len(BROKEN)} of them" in PAGE


def test_the_page_lists_every_built_in_plugin() -> None:
    assert sorted(re.findall(r"^\| `(\w+)` \| \d+ \|", PAGE, re.M)) == sorted(OURS)


def test_every_built_in_plugin_is_installed() -> None:
    assert not UNLOADABLE
    assert {plugin.name for plugin in INSTALLED} >= OURS


ONE_EACH = {finders[0]: plugin for plugin, finders in reversed(BROKEN) if len(finders) == 1}
FOUND = [
    pytest.param(
        plugin,
        finders,
        id=plugin.name,
        marks=() if plugin in ONE_EACH.values() else pytest.mark.prove,
    )
    for plugin, finders in BROKEN
]
"""One defect for each clause is shown here; all of them by `./go prove`."""


@pytest.mark.sample(20)
@pytest.mark.parametrize(("plugin", "finders"), FOUND)
def test_a_broken_plugin_is_found_and_shown(plugin: Plugin, finders: tuple[str, ...]) -> None:
    for result in check(plugin, clauses=clauses(finders)):
        assert result.outcome == "failed", result
        assert result.text
        assert check(plugin, clauses=clauses([result.clause]))[0].outcome == "failed"  # it comes again


PART = 20
"""One in so many of the other clauses is tried here; all of them by `./go prove`."""


@pytest.mark.sample(10)
@pytest.mark.parametrize("name", NAMES)
def test_for_each_clause_there_is_a_defect_that_others_do_not_find(name: str) -> None:
    others = [clause.name for clause in CLAUSES if clause.name != name]
    results = check(ONE_EACH[name], clauses=clauses(others[NAMES.index(name) % PART :: PART]))
    assert [result.clause for result in results if result.outcome == "failed"] == []


@pytest.mark.prove
@pytest.mark.parametrize("name", NAMES)
def test_for_each_clause_there_is_a_defect_that_only_it_finds(name: str) -> None:
    results = check(ONE_EACH[name])
    assert [result.clause for result in results if result.outcome == "failed"] == [name]


@pytest.mark.prove
@pytest.mark.parametrize("seed", [2**63])
@pytest.mark.parametrize("plugin", [motors, sensors], ids=["motors", "sensors"])
def test_a_sound_plugin_passes_with_any_seed(plugin: Plugin, seed: int) -> None:
    results = check(plugin, seed)
    assert not [result for result in results if result.outcome == "failed"], table(results)


@pytest.mark.sample(1)
@pytest.mark.parametrize("plugin", sampled(SOUND, 2), ids=lambda plugin: str(plugin.name))
def test_a_sound_plugin_of_an_unusual_kind_passes(plugin: Plugin) -> None:
    results = check(plugin)
    assert not [result for result in results if result.outcome == "failed"], table(results)


# -- results and tables --------------------------------------------------------------------------------


def test_what_does_not_apply_names_the_part_of_the_spec() -> None:
    (commands,) = check(sensors, clauses=clauses(["commands"]))
    assert (commands.outcome, commands.text) == ("not applicable", "the spec lists no commands")


def test_the_table_shows_frames_and_messages_of_a_failure_only() -> None:
    message, frame = Velocity("alpha", 1.0), CanFrame(0x123, b"\1\2")
    results = [
        Result("one", "passed", "fine", 7, (frame,), (message,)),
        Result("another", "failed", "wrong", 7, (frame, b"\xa5\0", b""), (message,)),
    ]
    assert table(results).splitlines() == [
        "one      passed          fine",
        "another  failed          wrong",
        "                           123#0102",
        "                           a5 00",
        "                           (no bytes)",
        "                           Velocity(motor='alpha', velocity=1.0, torque=0.0)",
        "                           again with seed 7",
    ]
    assert table([]) == ""


def test_a_plugin_that_raises_anywhere_is_a_failure_with_the_place() -> None:
    def spec(_: object) -> Any:
        raise RuntimeError("boom")

    for result in check(replace(motors, spec=spec)):
        assert result.outcome == "failed"
        assert "RuntimeError: boom" in result.text
        assert "spec, line" in result.text


def test_a_failure_in_one_variant_is_a_failure_and_names_it() -> None:
    def judge(case: Case) -> None:
        raise Failure("bad") if case.options.kind == "motor" else Inapplicable("not for sensors")

    (failed,) = check(plain, clauses=[Clause("x", "all is well", judge)])
    assert (failed.outcome, failed.text) == ("failed", "bad [Options(kind='motor')]")


def test_a_clause_that_applies_to_one_variant_only_is_passed() -> None:
    def judge(case: Case) -> None:
        if case.options.kind != "motor":
            raise Inapplicable("not for sensors")

    (passed,) = check(plain, clauses=[Clause("x", "all is well", judge)])
    assert (passed.outcome, passed.text) == ("passed", "all is well")


@dataclass(frozen=True)
class ManyOptions:
    line: Literal["a", "b", "c"] = "b"
    fast: bool = False
    size: int = 3

    def __post_init__(self) -> None:
        if self.line == "c":
            raise ValueError("c needs more")


def test_variants_are_the_default_and_each_other_value_alone() -> None:
    assert list(variants(replace(motors, options=ManyOptions))) == [
        ManyOptions(),
        ManyOptions(line="a"),
        ManyOptions(fast=True),
    ]


def test_other_addresses_can_be_given() -> None:
    assert all(
        r.outcome != "failed" for r in check(motors, addresses=(17, 200, 255), clauses=clauses(["commands"]))
    )
    bad = check(motors, addresses=(1, 2, 256), clauses=clauses(["foreign"]))
    assert "1 … 255" in bad[0].text


# -- the bench ------------------------------------------------------------------------------------------


def test_shortest_keeps_only_what_still_fails() -> None:
    def fails(raw: Frame) -> bool:
        data = raw.data if isinstance(raw, CanFrame) else raw
        return b"\7" in data and len(data) >= 3

    assert shortest(b"abc\7defgh\7ij", fails) in (b"\0\7\0", b"\0\0\7", b"\7\0\0")
    frame = shortest(CanFrame(5, b"1234\0067\7"), fails)
    assert isinstance(frame, CanFrame)
    assert (frame.id, len(frame.data), sum(frame.data)) == (5, 3, 7)


def test_random_numbers_are_those_of_the_paper_and_repeat() -> None:
    # The first numbers of seed 1234567, as in the reference implementation's well-known test.
    random = Random(1234567)
    assert [random.bits() for _ in range(3)] == [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
    ]
    assert Random(5).bytes(20) == Random(5).bytes(20)
    assert sorted(Random(5).shuffled(range(50))) == list(range(50))
    assert Random(5).shuffled(range(50)) != list(range(50))
    assert {Random(n).below(3) for n in range(50)} == {0, 1, 2}
    assert all(2.0 <= Random(n).uniform(2.0, 3.0) < 3.0 for n in range(50))


@pytest.mark.parametrize(
    ("sent", "received", "bounds", "near"),
    [
        (1.0, 1.0, Range(-1.0, 1.0, 0.0), True),
        (1.0, 1.01, Range(-1.0, 1.0, 0.01), True),
        (1.0, 1.0101, Range(-1.0, 1.0, 0.01), False),
        (1000.0, 1000.9, Range(-1.0, 1.0, 0.0, 0.001), True),
        (1000.0, 1001.1, Range(-1.0, 1.0, 0.0, 0.001), False),
        (0.0, float("nan"), Range(-1.0, 1.0, 1.0), False),
        (0.0, None, Range(-1.0, 1.0, 1.0), False),
    ],
)
def test_close(sent: float, received: float | None, bounds: Range, near: bool) -> None:
    assert close(sent, received, bounds) is near


def test_finite_looks_into_everything() -> None:
    scan = LaserScan("l", 0, 0.0, 0.1, 0.1, 10.0, (1.0, 2.0))
    assert finite(scan)
    assert not finite(replace(scan, ranges=(1.0, float("inf"))))
    assert not finite(replace(scan, angle_min=float("nan")))
    assert finite(Feedback("m", 0))


def test_a_shaft_follows_newton_and_stands_still_when_locked() -> None:
    shaft = Shaft(inertia=0.5, friction=0.0)
    for _ in range(1000):
        shaft.turn(2.0, 1_000_000)
    assert shaft.velocity == pytest.approx(4.0)
    assert shaft.position == pytest.approx(2.0, rel=2e-3)
    shaft.locked = True
    shaft.turn(2.0, 1_000_000)
    assert shaft.velocity == pytest.approx(4.0)
    rubbed = Shaft(inertia=1.0, friction=0.5)
    for _ in range(20_000):
        rubbed.turn(1.0, 1_000_000)
    assert rubbed.velocity == pytest.approx(2.0, rel=1e-3)
    rubbed.turn(float("nan"), 1_000_000)
    assert rubbed.velocity == pytest.approx(2.0, rel=1e-3)


def test_split_messages_all_arrive_in_order() -> None:
    whole, split = _bench(), _bench()
    split.splitting = Random(3)
    one = [frame for _ in range(300) for frame in whole.step([Velocity("alpha", 1.0)]).down]
    other = [frame for _ in range(300) for frame in split.step([Velocity("alpha", 1.0)]).down]
    assert len(set(map(len, map(str, other)))) > 3
    stream = b"".join(frame for frame in other if isinstance(frame, bytes)) + split.split_off["down"]
    assert stream == b"".join(frame for frame in one if isinstance(frame, bytes))


def _bench() -> Bench:
    return make_bench(motors, motors.options(), (1, 2), ("alpha", "beta"))


def test_arming_ends_when_a_device_does_not_arm() -> None:
    unarmed = replace(
        motors, decoder=motors.decoder, twin=lambda device, seed: sensors.twin(_as_sensor(device), seed)
    )
    (commands,) = check(unarmed, clauses=clauses(["commands"]))
    assert commands.outcome == "failed"
    assert "does not arm" in commands.text


def _as_sensor(device: Any) -> Any:
    return replace(device, options=sensors.options())


def test_state_that_cannot_be_copied_is_named() -> None:
    plugin = next(plugin for plugin, _ in BROKEN if plugin.name == HoldsAGenerator.__name__)
    (result,) = check(plugin, clauses=clauses(["copies"]))
    assert "HoldsAGenerator cannot be copied" in result.text
