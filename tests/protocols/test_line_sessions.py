"""A sample of the random sessions on lines of questions and answers; all: `./go prove -k line_sessions`."""

from __future__ import annotations

import pytest

from protocols.plugin import Plugin
from tests.protocols.line_sessions import QUESTIONED, LineSession


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("plugin", QUESTIONED, ids=lambda plugin: str(plugin.name))
def test_a_session_with_bad_answers_ends_well(plugin: Plugin, seed: int) -> None:
    LineSession(plugin, seed).run()
