"""Recordings of this gateway in pairwise cover: each language moves each body on each bad day.

`robots` makes the robots of files that ship, `cover` chooses, `drive` makes one recording; `python -m
tests.matrix` makes those that are not there.
"""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).resolve().parents[2] / "fixtures" / "recordings" / "matrix"
