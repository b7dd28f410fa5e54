"""Make the recordings of the matrix that are not there; what is expected: `gateway judge --update FOLDER`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gateway.recording.matrix import FILE, read_matrix
from tests.matrix import FOLDER
from tests.matrix.cover import cover
from tests.matrix.drive import record
from tests.matrix.robots import file_of


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.matrix", description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER, help=f"with its {FILE}")
    folder: Path = parser.parse_args().folder
    there = read_matrix(folder)
    for cell in cover(there.levels, there.recordings):
        path = file_of(folder, *cell)
        record(there.levels, cell, path)
        print(f"{path.name}: {path.stat().st_size} bytes", flush=True)
    print("\n".join(read_matrix(folder).lines()))


if __name__ == "__main__":
    main()
