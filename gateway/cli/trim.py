"""`gateway trim`: a stretch of a recording as a recording of its own, with what leads to its beginning."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from gateway.cli import arguments
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.replay.anonymous import anonymous
from gateway.replay.input_log import MADE_FROM, input_log, write_run
from gateway.replay.trim import AROUND, stretch_around, stretch_between, trim

MARGIN = 1.0


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording of this gateway")
    seconds = arguments.number("seconds", or_zero=True)
    text = "s since the first tick (default: its beginning, its end)"
    parser.add_argument("--from", dest="begin", type=seconds, metavar="S", help=text)
    parser.add_argument("--to", dest="end", type=seconds, metavar="S", help=text)
    text = "in place of times: the first of this, and what is around it"
    parser.add_argument("--around", choices=AROUND, help=text)
    text = f"s before and after it (default: {MARGIN:g})"
    parser.add_argument("--margin", type=seconds, default=MARGIN, metavar="S", help=text)
    add_anonymise(parser)
    text = "the new file, which must not exist yet (default: FILE with .trimmed in it)"
    parser.add_argument("-o", "--out", type=Path, metavar="OUT", help=text)


def add_anonymise(parser: ArgumentParser) -> None:
    """Add --anonymise."""
    text = "without date, ports, serial numbers, comments and places on the earth"
    parser.add_argument("--anonymise", action="store_true", help=text)


def run(options: Namespace) -> int:
    """Write the new recording; return 1 if the recording has no end, as `replay` does."""
    if options.around is not None and (options.begin is not None or options.end is not None):
        raise UserError("--around says where the stretch is: leave --from and --to away")
    if options.around is None and options.begin is None and options.end is None and not options.anonymise:
        raise UserError("which stretch? --from S, --to S, or --around " + "|".join(AROUND))
    path: Path = options.file
    target: Path = options.out or path.with_name(f"{path.stem}.trimmed.mcap")
    recording = read_recording(path)
    if options.around is None:
        stretch = stretch_between(recording, options.begin, options.end)
    else:
        stretch = stretch_around(recording, options.around, options.margin)
    if not options.anonymise:
        print(trim(recording, stretch, target).text())
    elif stretch.first:
        part = target.with_name(f"{target.name}.named.part")
        found = trim(recording, stretch, part)
        try:
            print(found.text())
            write_anonymous(part, target)
        finally:
            part.unlink(missing_ok=True)
    else:
        write_anonymous(path, target, stretch.last + 1)
    print(f"written: {target} ({target.stat().st_size / 1e6:.2f} MB)\nreplay it: gateway replay {target}")
    return 0 if recording.whole else 1


def write_anonymous(path: Path, target: Path, ticks: int | None = None) -> None:
    """Write a recording anew without what says when, where and of whom it is; its first ticks alone, if a
    number is given. Tells what was left out."""
    log = input_log(read_recording(path))
    log, left_out = anonymous(log.with_ticks(log.ticks[:ticks]))
    write_run(target, log, {MADE_FROM: "another recording, made anonymous"})
    print("\n".join(["anonymous: date, ports, serial numbers and comments are left out", *left_out]))
