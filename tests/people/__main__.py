"""Run seeds and print what came of each: `python -m tests.people SEED…`."""

from __future__ import annotations

import sys

from tests.people.crossing import run

for seed in map(int, sys.argv[1:]):
    print(run(seed).line(), flush=True)
