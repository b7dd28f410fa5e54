"""That a campaign goes on where it was interrupted, and begins anew when it must. (Not a campaign itself.)"""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.recording import environment
from tests.prove.campaign import Campaign


def test_it_goes_on_with_the_same_seed_and_begins_anew_when_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ran: list[tuple[int, int]] = []

    def case(seed: int, number: int) -> int:
        if number == 3 and len(ran) == 3:
            raise RuntimeError("it broke")
        ran.append((seed, number))
        return number * number

    first = Campaign("a", 5, tmp_path)
    with pytest.raises(RuntimeError) as caught:
        first.run(case)
    assert f"PROVE_SEED={first.seed}" in caught.value.__notes__[0]
    with first.path.open("a") as file:
        file.write('{"case": 4, "res')  # the power went
    second = Campaign("a", 5, tmp_path)
    assert second.seed == first.seed
    ran.append((0, 0))
    assert second.run(case) == {0: 0, 1: 1, 2: 4, 3: 9, 4: 16}
    assert [number for _, number in ran] == [0, 1, 2, 0, 3, 4]
    assert "3 of 5 cases were done before" in capsys.readouterr().out
    assert Campaign("a", 5, tmp_path).done == {}


def test_it_begins_anew_when_a_source_has_changed_or_a_seed_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def one(_seed: int, number: int) -> int:
        if number:
            raise KeyboardInterrupt
        return 0

    monkeypatch.setattr(environment, "sources", lambda: "old")
    first = Campaign("a", 5, tmp_path)
    with pytest.raises(KeyboardInterrupt):
        first.run(one)
    assert Campaign("a", 5, tmp_path).done == {0: 0}
    monkeypatch.setattr(environment, "sources", lambda: "new")
    assert Campaign("a", 5, tmp_path).done == {}
    monkeypatch.setenv("PROVE_SEED", "42")
    assert Campaign("a", 5, tmp_path).seed == 42
