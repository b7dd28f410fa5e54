"""The vectors of mechanisms, computed anew by Pinocchio where it is installed (`pip install pin`)."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.brain.bodies.from_pinocchio import FILE, cases

pytestmark = pytest.mark.prove


def test_pinocchio_computes_the_same_as_in_the_file() -> None:
    pytest.importorskip("pinocchio")
    kept, new = json.loads(FILE.read_text(encoding="utf-8"))["cases"], cases()["cases"]
    assert [case["urdf"] for case in kept] == [case["urdf"] for case in new]
    for old_case, new_case in zip(kept, new, strict=True):
        for old, now in zip(old_case["states"], new_case["states"], strict=True):
            assert _flat(now) == pytest.approx(_flat(old), abs=1e-9)


def _flat(value: Any) -> list[float]:
    if isinstance(value, dict):
        value = [value[key] for key in sorted(value)]
    return [one for inner in value for one in _flat(inner)] if isinstance(value, list) else [value]
