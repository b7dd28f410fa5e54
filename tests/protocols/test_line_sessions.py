"""A sample of the random sessions on lines of questions and answers; all: `./go prove -k line_sessions`."""

from __future__ import annotations

import pytest

from protocols.plugin import Plugin
from tests.protocols.line_sessions import QUESTIONED, LineSession


@pytest.mark.sample(8)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("plugin", QUESTIONED, ids=lambda plugin: str(plugin.name))
def test_a_session_with_bad_answers_ends_well(plugin: Plugin, seed: int) -> None:
    LineSession(plugin, seed).run()


@pytest.mark.parametrize(
    "seed", [2601008396, 2601008424, 2601010954, 2601015264], ids=("late", "late 2", "doubled", "late 3")
)
def test_an_answer_is_not_taken_for_another_questions(seed: int) -> None:
    """A DDSM115's two answers look alike; the angle of one is the other's temperature and coarse angle."""
    (ddsm,) = (plugin for plugin in QUESTIONED if plugin.name == "ddsm")
    LineSession(ddsm, seed).run()
