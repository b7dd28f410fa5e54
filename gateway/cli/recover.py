"""`gateway recover FILE [-o OUT]`: a recording that was cut off or damaged, made whole again."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path


def recover(options: Namespace) -> int:
    """Give back every tick that was written. Returns 0 if there is any, 1 if none; the input stays as it is.

    Raises RecordingError if it is no recording, or the new file is there already or cannot be written."""
    from gateway.recording.recover import is_whole, salvage

    path: Path = options.file
    if options.out is None and is_whole(path):
        print(f"{path} is whole: nothing to recover, nothing written")
        return 0
    target: Path = options.out or path.with_name(f"{path.stem}.recovered.mcap")
    found = salvage(path, target)
    print("\n".join(found.reported()))
    if not found.ticks:
        print("nothing could be recovered")
        return 1
    print(f"written: {target} ({target.stat().st_size / 1e6:.1f} MB)\nreplay it: gateway replay {target}")
    return 0
