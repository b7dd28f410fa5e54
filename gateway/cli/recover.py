"""`gateway recover`: a recording, or an MCAP bag, that was cut off or damaged, repaired."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from gateway.recording.recover import is_whole, recover


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument(
        "-o", "--out", type=Path, metavar="OUT", help="the new file (default: FILE with .recovered in it)"
    )


def run(options: Namespace) -> int:
    """Write every complete tick, of a bag every message, to a new file; return 1 without any. FILE itself is
    only read."""
    path: Path = options.file
    if options.out is None and is_whole(path):
        print(f"{path} is whole: nothing to recover, nothing written")
        return 0
    target: Path = options.out or path.with_name(f"{path.stem}.recovered.mcap")
    found = recover(path, target)
    print("\n".join(found.summary()))
    if not found.anything:
        print("nothing could be recovered")
        return 1
    robot = " --robot ROBOT" if found.bag else ""
    print(
        f"written: {target} ({target.stat().st_size / 1e6:.1f} MB)\nreplay it: gateway replay {target}{robot}"
    )
    return 0
