"""All mutants of all our languages, resumable; what is found is stored in fixtures/mutation."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gateway.cli.scores import mutation_score
from tests.mutation import store
from tests.mutation.languages import ours

pytestmark = pytest.mark.prove
ROOT = Path(__file__).resolve().parent.parent.parent


@pytest.mark.parametrize("name", ours())
def test_the_contract_and_the_vectors_notice_nine_of_ten_mutants(name: str) -> None:
    subprocess.run([sys.executable, "-m", "tests.mutation", name, "--processes", "2"], cwd=ROOT, check=True)
    score, result = mutation_score(name), store.stored(name)
    assert score is not None
    assert result is not None
    print(f"{name}: {score}: {score.killed} of {score.tried}, {score.equivalent} equivalent")
    assert score.current
    assert not score.sampled
    unjudged = [row for row in result["survivors"] if not store.judged(row)]
    assert not unjudged, f"judge {len(unjudged)} survivors in fixtures/mutation/{name}.json"
    assert score.share >= store.floors().get(name, store.DEMANDED)
