"""`gateway fixtures`: public recordings, listed, verified and fetched; what our own cover, in pairs."""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping
from pathlib import Path

from gateway.cli.terminal.progress import progress
from gateway.errors import UserError
from gateway.recording.catalogue import CatalogueEntry, WrongFile, check_file, chosen, read_catalogue
from gateway.recording.fetch import fetch
from gateway.recording.matrix import read_matrix

FOLDER = "MOTOR_GATEWAY_DATA"
"""The variable that says where public recordings are"""


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    kinds = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    kinds.add_parser("list", help="each public recording: its size, licence and source")
    text = "compare the files in a folder with the catalogue, by size and sha256"
    verify = kinds.add_parser("verify", help=text, description=text)
    where = f"the folder of the recordings (default: that of {FOLDER}, else the working folder)"
    verify.add_argument("folder", nargs="?", type=Path, metavar="DIR", help=where)
    text = "fetch public recordings; what was cut off goes on where it ended"
    fetched = kinds.add_parser("fetch", help=text, description=text)
    text = "files of the catalogue, or folders of them"
    fetched.add_argument("names", nargs="+", metavar="NAME", help=text)
    fetched.add_argument("--to", dest="folder", type=Path, metavar="DIR", help=where)
    text = "what the recordings of this gateway in a folder cover, in pairs"
    matrix = kinds.add_parser("matrix", help=text, description=text)
    matrix.add_argument("folder", type=Path, metavar="DIR", help="recordings, and their matrix.toml")
    for one in kinds.choices.values():
        if one is not matrix:
            text = "another catalogue than the one that ships"
            one.add_argument("--catalogue", type=Path, metavar="FILE", help=text)


def run(options: Namespace) -> int:
    """Return 1 if a file is not what the catalogue says, or a pair is not covered."""
    if options.action == "matrix":
        found = read_matrix(options.folder)
        print("\n".join(found.lines()))
        return 0 if found.complete else 1
    catalogue = read_catalogue(options.catalogue)
    folder: Path = Path(os.environ.get(FOLDER) or ".") if options.action != "list" else Path()
    if getattr(options, "folder", None) is not None:
        folder = options.folder
    does: dict[str, Callable[[], int]] = {
        "list": lambda: _list(catalogue),
        "verify": lambda: _verify(catalogue, folder),
        "fetch": lambda: _fetch(chosen(catalogue, options.names), folder),
    }
    return does[options.action]()


def _list(catalogue: Mapping[str, CatalogueEntry]) -> int:
    for one in catalogue.values():
        print(f"{one.file}: {one.bytes} bytes, {one.licence}: {one.what}")
        print(f"  {one.address or f'not to be fetched: {one.source}'}")
        if one.attribution:
            print(f"  attribution: {one.attribution}")
    return 0


def _verify(catalogue: Mapping[str, CatalogueEntry], folder: Path) -> int:
    if not folder.is_dir():
        raise UserError(f"{folder}: there is no such folder")
    wrong = right = 0
    for one in catalogue.values():
        path = folder / one.file
        try:
            check_file(path, one)
        except FileNotFoundError:
            print(f"{one.file}: absent")
            continue
        except (WrongFile, OSError) as error:
            wrong += 1
            print(f"{one.file}: WRONG: {error}")
            continue
        right += 1
        print(f"{one.file}: as catalogued")
    print(f"{right} of {len(catalogue)} are there and as catalogued, {wrong} are wrong")
    return 0 if right and not wrong else 1


def _fetch(entries: list[CatalogueEntry], folder: Path) -> int:
    failed = 0
    for one in entries:
        with progress(f"fetch {one.file}, bytes", one.bytes) as shown:
            try:
                path, anew = fetch(one, folder, shown.update)
            except UserError as error:
                failed += 1
                shown.clear()
                print(f"NOT FETCHED: {error}")
                continue
        print(f"{path}: {'fetched' if anew else 'was there'}, as catalogued; {one.licence}")
        if one.attribution:
            print(f"  attribution: {one.attribution}")
    if len(entries) > 1:
        print(f"{len(entries) - failed} of {len(entries)} are there")
    return 1 if failed else 0
