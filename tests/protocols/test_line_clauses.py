"""The clauses for serial lines find what is broken, and pass what is sound."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from protocols.conformance import CLAUSES, check
from protocols.conformance.lines import DISTURBED
from protocols.plugin import Plugin
from tests.protocols.broken import motors
from tests.protocols.broken_lines import BROKEN_LINES, sound

NAMES = ("turns", "awaited", "lost", "dead", "newest", "later", "wrong")
OF_LINES = [clause for clause in CLAUSES if clause.name in NAMES]


def failing(plugin: Plugin, seed: int, names: Sequence[str] = NAMES) -> dict[str, str]:
    clauses = [clause for clause in OF_LINES if clause.name in names]
    results = check(plugin, seed, clauses=clauses, options=[plugin.options()])
    return {each.clause: each.text for each in results if each.outcome == "failed"}


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", range(2))
def test_a_sound_plugin_keeps_them(seed: int) -> None:
    assert failing(sound, seed) == {}


@pytest.mark.sample(5)
@pytest.mark.parametrize(("plugin", "clauses"), BROKEN_LINES, ids=[plugin.name for plugin, _ in BROKEN_LINES])
def test_what_is_broken_is_found(plugin: Plugin, clauses: tuple[str, ...]) -> None:
    assert set(failing(plugin, 0, clauses)) == set(clauses)


def test_each_clause_finds_something() -> None:
    assert {clause for _, clauses in BROKEN_LINES for clause in clauses} == set(NAMES)


def test_they_do_not_apply_where_each_sends_when_it_likes() -> None:
    results = check(motors, clauses=OF_LINES, options=[motors.options()])
    assert {each.outcome for each in results} == {"not applicable"}


def test_what_an_answer_may_suffer() -> None:
    assert {what: change(b"abcdef", b"uvw") for what, change in DISTURBED.items()} == {
        "late": ((4_000_000, b"abcdef"),),
        "doubled": ((0, b"abcdef"), (200_000, b"abcdef")),
        "preceded by another device's": ((0, b"uvw"), (100_000, b"abcdef")),
        "cut": ((0, b"abcd"),),
        "behind garbage": ((0, b"\x00\xffuabcdef"),),
        "in two pieces": ((0, b"abc"), (100_000, b"def")),
    }
