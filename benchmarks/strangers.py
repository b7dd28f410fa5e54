"""All recordings of a folder, without a robot file: `python -m benchmarks.strangers [FOLDER]`.

Rules. What can be read is replayed as `gateway inspect` proposes it, with the relations beside it as its
truth if there are any; the table of docs/foreign-bags.md is what this prints. The folder is that of
MOTOR_GATEWAY_DATA, if none is given. What is no recording of a robot's motion is named, with the reason.
"""

from __future__ import annotations

import os
import sys
from math import degrees
from pathlib import Path

from gateway.errors import GatewayError
from gateway.rosbag import is_bag
from gateway.rosbag.evaluate import ESTIMATED, NOT_JUDGED, PASSED, WHEELS, Evaluation, evaluate_file
from gateway.rosbag.survey import proposed_robot, survey
from gateway.rosbag.truth import read_truth

HEADS = (
    "recording",
    "judged by",
    "dead reckoning",
    "estimated",
    "NIS per degree of freedom",
    "scans lost",
    "said",
)
SAID = {PASSED: "judged", NOT_JUDGED: "not judged: no truth"}


def main(arguments: list[str] | None = None) -> int:
    """Print the table; return 2 without a folder."""
    given = sys.argv[1:] if arguments is None else arguments
    folder = Path(given[0] if given else os.environ.get("MOTOR_GATEWAY_DATA", ""))
    if not (given or os.environ.get("MOTOR_GATEWAY_DATA")) or not folder.is_dir():
        print("strangers: name a folder of recordings, or set MOTOR_GATEWAY_DATA", file=sys.stderr)
        return 2
    print(f"| {' | '.join(HEADS)} |\n|{' --- |' * len(HEADS)}", flush=True)
    left: list[str] = []
    for path in sorted(one for one in folder.rglob("*") if one.is_file()):
        name = str(path.relative_to(folder))
        if not is_bag(path):
            left.append(name)
            continue
        try:
            print(row(name, evaluated(path)), flush=True)
        except GatewayError as error:
            why = str(error).splitlines()[0].removeprefix(f"{path}: ").partition(": expected")[0]
            print(f"| {name} |{' - |' * (len(HEADS) - 2)} {why} |", flush=True)
    print(f"\nNo recordings of a robot's motion, or of no layout that is known: {', '.join(left)}")
    return 0


def evaluated(path: Path) -> Evaluation:
    """Replay one recording as it is proposed."""
    beside = path.with_name(f"{path.name.partition('.')[0]}.relations")
    truth = read_truth(beside) if beside.is_file() else None
    return evaluate_file(path, proposed_robot(survey(path)), None, truth)


def row(name: str, one: Evaluation) -> str:
    """Return a row of the table."""
    judged, rolled, found = "-", "-", "-"
    if one.relations:
        judged = f"{one.relations[ESTIMATED].count} relations: mean; within 30 s"
        rolled, found = (relation(one, path) for path in (WHEELS, ESTIMATED))
    elif one.estimated is not None and one.wheels is not None:
        judged = f"{one.estimated.count} positions: RMS"
        rolled, found = f"{one.wheels.rms:.2f} m", f"{one.estimated.rms:.2f} m"
    nis = ", ".join(f"{sensor} {each.mean:.2f}" for sensor, each in one.nis.items()) or "-"
    lost = f"{one.lost} of {one.scans}" if one.scans else "-"
    said = SAID.get(one.status) or "; ".join(one.objections())
    way = f"{one.driven:.0f} m, {one.duration / 1e9:.0f} s"
    return f"| {name} ({way}) | {judged} | {rolled} | {found} | {nis} | {lost} | {said} |"


def relation(one: Evaluation, path: str) -> str:
    """Return the errors of a path against relations."""
    error = one.relations[path]
    far = f"{error.mean:.3f} m, {degrees(error.mean_turn):.2f}°"
    return f"{far}; {error.close_mean:.3f} m, {degrees(error.close_turn):.2f}°"


if __name__ == "__main__":
    sys.exit(main())
