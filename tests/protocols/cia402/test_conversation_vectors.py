"""Conversations of independent bytes, as they were kept: our driver, and what ear and twin lean on, in them.

See `conversations` for what they are. That package canopen still says what was kept is tested last.
"""

from __future__ import annotations

import pytest

from tests.protocols.cia402.conversation_ends import HOSTS, recorded
from tests.protocols.cia402.conversations import SCRIPTS, again, frame_of, kept, obeyed
from tests.protocols.cia402.tables import TABLES

KEPT = kept()


@pytest.mark.parametrize("name", sorted(SCRIPTS))
def test_the_driver_in_a_conversation_of_vectors(name: str) -> None:
    assert again(SCRIPTS[name], KEPT[name]) == KEPT[name]


@pytest.mark.parametrize("name", sorted(name for name in KEPT if name.startswith("host, ")))
def test_vectors_of_a_host_are_obeyed(name: str) -> None:
    frames = [frame_of(line.split(" | ")[0]) for line in KEPT[name]]
    assert obeyed(frames, name) == KEPT[name]


@pytest.mark.parametrize("name", sorted(TABLES))
def test_tables_of_vectors(name: str) -> None:
    assert list(TABLES[name]()) == KEPT[name]


def test_the_package_says_all_of_them_still() -> None:
    now = recorded()
    assert list(now) == list(KEPT)
    for name, lines in now.items():
        assert lines == KEPT[name], name
    assert {name.rpartition(", ")[0] for name in KEPT if name.startswith("host, ")} == set(HOSTS)
