"""The benchmarks as a command: `python -m benchmarks [--json FILE] [--quick]`, which `./go bench` runs.

Exit status: 0 everything was measured, whether or not the targets are met; 2 it could not be, and why.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmarks and return the exit status."""
    os.environ.setdefault(
        "OPENBLAS_NUM_THREADS", "1"
    )  # as the `gateway` command does, before numpy is loaded
    from benchmarks import bench
    from benchmarks.measure import NotMeasured

    parser = argparse.ArgumentParser(
        prog="benchmarks", description="Measure what this program costs, beside what else there is."
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures to FILE")
    parser.add_argument("--quick", action="store_true", help="take a few seconds, for rough figures")
    try:
        return bench(parser.parse_args(arguments))
    except (NotMeasured, OSError) as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
