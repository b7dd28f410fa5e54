"""Run variations and print each row as it ends: `python -m tests.robustness [NAMES…] [options]`.

A NAME selects the variations that contain it; without any, the whole table runs.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

from tests.robustness.judge import HEADER, Case, Row, mean_nees, mean_nis, run
from tests.robustness.variations import MORE, TABLE, WORLDS, carried, drawn, screen, world

DRAWN = {"screens": screen, "moves": carried, "drawn": drawn}


def cases(asked: argparse.Namespace) -> Iterator[tuple[Case, int]]:
    """Yield what is asked for, with a seed each."""
    for seed in range(asked.seed, asked.seed + asked.seeds):
        if asked.world or asked.draw:
            yield from ((world(name), seed) for name in asked.world)
            yield from ((DRAWN[name](seed), seed) for name in asked.draw)
            continue
        for number, case in enumerate((*TABLE, *MORE)):
            if not asked.names or any(name.lower() in case.name.lower() for name in asked.names):
                yield case, 1000 * seed + number


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.robustness", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--seeds", type=int, default=1, help="how many, one after the other")
    parser.add_argument("--seed", type=int, default=1, help="the first")
    parser.add_argument("--world", action="append", choices=WORLDS, default=[], help="the tour of a world")
    parser.add_argument("--draw", action="append", choices=[*DRAWN], default=[], help="cases drawn at random")
    parser.add_argument("--instant", action="store_true", help="a lidar that takes all beams at one instant")
    asked = parser.parse_args()
    chosen = list(cases(asked))
    if not chosen:
        parser.error(
            f"no variation's name contains {' or '.join(map(repr, asked.names))}, or no seed is asked for"
        )
    rows: list[Row] = []
    print(HEADER)
    for case, seed in chosen:
        figures = replace(case.figures, sweep=False) if asked.instant else case.figures
        rows.append(run(replace(case, figures=figures), seed))
        print(rows[-1].line(), flush=True)
    nis = ", ".join(f"{sensor} {mean:.2f}" for sensor, mean in mean_nis(rows).items())
    print(f"\n{sum(row.good for row in rows)} of {len(rows)} good; NEES {mean_nees(rows):.2f}; NIS {nis}")


if __name__ == "__main__":
    main()
