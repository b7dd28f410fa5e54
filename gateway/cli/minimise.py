"""`gateway minimise`: the fewest inputs of a recording that still do it; as fixture, golden and test."""

from __future__ import annotations

import os
import re
from argparse import ArgumentParser, Namespace
from contextlib import closing
from pathlib import Path

from gateway.cli import arguments
from gateway.cli.terminal.progress import progress
from gateway.cli.trim import add_anonymise
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.recording.new_file import create_with
from gateway.replay.anonymous import anonymous
from gateway.replay.input_log import MADE_FROM, input_log, write_run
from gateway.report import judge
from gateway.report.condition import EXAMPLES, Condition, condition
from gateway.report.minimise import TRIALS, minimise
from gateway.report.two_versions import Differs, version

TEST = '''\
"""Made by `gateway minimise`: what {shown} shows must not happen again.

Until it is mended this test fails. Then `gateway judge {shown} --update` makes anew what is expected of it.
"""

from pathlib import Path

from gateway.testing import holds

RECORDING = Path(__file__).with_name({name})


def test_{word}() -> None:
    assert not holds({condition}, RECORDING)
'''


TEST_OF_TWO = '''\
"""Made by `gateway minimise`: {shown} has what {rev} sent, and what is sent today must be the same."""

from pathlib import Path

from gateway.replay import replay_recording

RECORDING = Path(__file__).with_name({name})


def test_{word}() -> None:
    comparison = replay_recording(RECORDING)
    assert comparison.ok, comparison.text()
'''


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording of this gateway")
    text = f"what the rest must still do: {EXAMPLES}"
    parser.add_argument("--while", dest="condition", required=True, metavar="CONDITION", help=text)
    text = "with `--while differs`: another version of the program, a revision or a folder with its rooms"
    parser.add_argument("--against", metavar="REV", help=text)
    add_anonymise(parser)
    text = f"how often at most it is tried (default: {TRIALS})"
    trials = arguments.integer("a number from 10 to 100000", 10, 100_000)
    parser.add_argument("--trials", type=trials, default=TRIALS, metavar="N", help=text)
    text = "the new file, which must not exist yet (default: FILE with .minimal in it); the others lie beside"
    parser.add_argument("-o", "--out", type=Path, metavar="OUT", help=text)


def run(options: Namespace) -> int:
    """Write fixture, golden and test; return 1 if the condition does not hold of the recording."""
    path: Path = options.file
    target: Path = options.out or path.with_name(f"{path.stem}.minimal.mcap")
    word = re.sub(r"\W+", "_", target.name.removesuffix(".mcap"), flags=re.ASCII).strip("_").lower()
    golden, test = judge.expected_file(target, None), target.with_name(f"test_{word}.py")
    if there := [one for one in (target, golden, test) if os.path.lexists(one)]:
        raise UserError(f"{there[0]}: exists already; it is never overwritten: name another file with --out")
    if (options.condition == "differs") != (options.against is not None):
        raise UserError("`--while differs` and --against REV go together: from which version does it differ?")
    if options.against is None:
        return _minimise(options, condition(options.condition), (target, golden, test), word)
    with version(options.against) as folder, closing(Differs(folder)) as differs:
        return _minimise(options, differs, (target, golden, test), word)


def _minimise(options: Namespace, holds: Condition, files: tuple[Path, Path, Path], word: str) -> int:
    path, (target, golden, test) = options.file, files
    log, left_out = input_log(read_recording(path)), list[str]()
    if options.anonymise:
        log, left_out = anonymous(log)
    with progress("minimise, trials", options.trials) as shown:
        found = minimise(log, holds, options.trials, shown.update)
    if found is None:
        print(f"{path}: {holds.text!r} does not hold of it")
        print("\n".join(f"  {line}" for line in holds.why_not(log)))
        return 1
    name = _escaped(target.name)
    said = {"name": f'"{name}"', "shown": name, "word": word}
    made_from = "another recording" if options.anonymise else path.name
    if isinstance(holds, Differs):
        holds.write(found.log, target)
        text = TEST_OF_TWO.format(**said, rev=_escaped(options.against))
    else:
        write_run(target, found.log, {MADE_FROM: f"{made_from}, as small as {holds.text!r} allows"})
        judged = judge.judge(target)
        if not judged.error:
            judge.write_expected(golden, judged, None)
        text = TEST.format(**said, condition=f'"{_escaped(holds.text)}"')
    try:
        create_with(test, text.encode())
    except OSError as error:
        raise UserError(f"{test}: cannot be written: {error.strerror}") from error
    print("\n".join([found.text(), *left_out]))
    written = ", ".join(one.name for one in (golden, test) if one.exists())
    print(f"written: {target}, {written}\nrun it: pytest {test}")
    return 0


def _escaped(text: str) -> str:
    """Return a text as it stands between double quotes in a program, of which it cannot be the end."""
    return text.encode("unicode_escape").decode().replace('"', '\\"')
