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
            raise KeyboardInterrupt
        ran.append((seed, number))
        return number * number

    first = Campaign("a", 5, tmp_path)
    with pytest.raises(KeyboardInterrupt):
        first.run(case)
    with first.path.open("a") as file:
        file.write('{"case": 4, "res')  # the power went
    second = Campaign("a", 5, tmp_path)
    assert second.seed == first.seed
    ran.append((0, 0))
    assert second.run(case) == {0: 0, 1: 1, 2: 4, 3: 9, 4: 16}
    assert [number for _, number in ran] == [0, 1, 2, 0, 3, 4]
    assert "3 of 5 cases were done before" in capsys.readouterr().out
    assert Campaign("a", 5, tmp_path).done == {}


def test_a_case_that_fails_stops_no_other_and_is_listed_with_what_repeats_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[int] = []

    def case(_seed: int, number: int) -> int:
        ran.append(number)
        if number == 1:
            raise RuntimeError("it broke at\n1")
        if number == 3:
            pytest.fail("it broke at\n3")
        return number

    monkeypatch.setenv("PROVE_PART", "0/2")
    first = Campaign("a", 5, tmp_path)
    with pytest.raises(AssertionError) as caught:
        first.run(case)
    head, *lines = str(caught.value).splitlines()
    assert (head, ran) == ("a: 2 of 5 cases failed", [0, 1, 2, 3, 4])
    assert lines[::2] == ["case 1: RuntimeError: it broke at 1", "case 3: Failed: it broke at 3"]
    assert [{f"PROVE_SEED={first.seed}", f"PROVE_CASES=a:{at}", "PROVE_PART=0/2"} <= {*line.split()}
            for at, line in zip((1, 3), lines[1::2], strict=True)] == [True, True]  # fmt: skip
    assert all("./go prove" in line and "test_a_case_that_fails" in line for line in lines[1::2])
    assert isinstance(caught.value.__cause__, RuntimeError)
    ran.clear()
    with pytest.raises(AssertionError, match="2 of 2 cases failed"):
        Campaign("a", 5, tmp_path).run(case)
    assert ran == [1, 3]


def test_cases_are_repeated_alone_and_their_campaign_is_none_the_further(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[tuple[int, int]] = []

    def case(seed: int, number: int) -> None:
        ran.append((seed, number))

    before = Campaign("a", 5, tmp_path)
    monkeypatch.setenv("PROVE_SEED", "7")
    monkeypatch.setenv("PROVE_CASES", "a:4,12")
    with pytest.raises(pytest.skip.Exception, match="only 2 cases were repeated"):
        Campaign("a", 5, tmp_path).run(case)
    assert ran == [(7, 4), (7, 12)]
    assert Campaign("b", 1, tmp_path).run(case) == {0: None}
    monkeypatch.delenv("PROVE_SEED")
    monkeypatch.delenv("PROVE_CASES")
    assert (Campaign("a", 5, tmp_path).seed, Campaign("a", 5, tmp_path).done) == (before.seed, {})


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
