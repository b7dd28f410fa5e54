"""Run the tests of a real CAN, or anything else, where there is one.

python -m tests.real_can                       the whole tier
python -m tests.real_can pytest FILE ...       these tests, inside the machine
python -m tests.real_can run COMMAND ...       any command, inside the machine
python -m tests.real_can prepare               fetch and build what the machine needs; say what is missing
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from tests.real_can.machine import Missing, prepare, run

PYTEST = [
    sys.executable,
    "-m",
    "pytest",
    "-m",
    "real_can",
    "-p",
    "no:cacheprovider",
    "-p",
    "no:xdist",
    "-v",
    "--color=no",
]
TIER = "tests/real_can"


def main(words: Sequence[str]) -> int:
    """The exit status of what ran inside; 2 where it could not be run."""
    word, rest = (words[0], words[1:]) if words else ("tier", ())
    try:
        parts = prepare()
    except Missing as missing:
        print(missing, flush=True)
        return 2
    if word == "prepare":
        return 0
    if word == "tier":
        return run(parts, [*PYTEST, TIER])
    if word == "pytest":
        return run(parts, [*PYTEST, *rest])
    if word == "run" and rest:
        return run(parts, rest)
    print(__doc__)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
