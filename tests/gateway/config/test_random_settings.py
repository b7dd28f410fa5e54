"""A sample of the campaign `./go prove -k settings` (`random_settings`)."""

from __future__ import annotations

from tests.gateway.config import random_settings


def test_random_numbers_are_refused_in_words_or_the_robot_runs() -> None:
    results = [random_settings.run(f"sample {number}") for number in range(12)]
    assert 1 < results.count("ran") < 11
    assert all(one == "ran" or one.startswith("refused: robot.toml:") for one in results)
