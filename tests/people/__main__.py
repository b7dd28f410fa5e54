"""Run seeds and print what came of each: `python -m tests.people SEED…`."""

from __future__ import annotations

import sys

from tests.people.crossing import alone, run

for seed in map(int, sys.argv[1:]):
    print(run(seed).line(alone(seed, seed % 2)[0].span), flush=True)
