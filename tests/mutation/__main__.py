"""The command line of a campaign: `python -m tests.mutation NAME ...`."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

from tests.mutation import campaign, store
from tests.mutation.languages import Language, installed_language


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("names", nargs="+", metavar="NAME", help="languages, as installed")
    parser.add_argument("--sample", type=int, help="so many mutants instead of all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--files", help="names of files, with commas between: only their mutants")
    parser.add_argument("--processes", type=int, default=1, choices=(1, 2))
    parser.add_argument("--seconds", type=float, help="try no further mutant after this time")
    parser.add_argument("--cpu", action="store_true", help="those seconds are of CPU time")
    parser.add_argument("--progress", type=Path, default=store.PROGRESS, help="folder of what is known")
    parser.add_argument(
        "--language", help="package:module:attribute:tests of a language that is not installed"
    )
    parser.add_argument(
        "--verdicts", type=Path, help="write the verdicts there instead of storing the result"
    )
    parser.add_argument(
        "--untraced", action="store_true", help="quick to begin: try every check on each mutant"
    )
    parser.add_argument("--quick", action="store_true", help="lean on the stored result; name new survivors")
    parser.add_argument("--clauses", help="names of clauses, with commas between: only they judge")
    asked = parser.parse_args(arguments)
    files = asked.files.split(",") if asked.files else None
    for name in asked.names:
        known = store.stored(name) if asked.quick else None
        clock = campaign.spent if asked.cpu else time.monotonic
        plan = campaign.Plan(
            asked.sample,
            asked.seed,
            files,
            asked.processes,
            asked.seconds,
            clock,
            traced=not asked.untraced,
            stored=known,
        )
        language = _language(name, asked.language)
        if asked.clauses:
            language = replace(language, clauses=tuple(asked.clauses.split(",")))
        found = campaign.run(language, plan, asked.progress)
        killed = sum(bool(verdict.killer) for verdict in found.verdicts)
        print(f"{name}: {killed} of {len(found.verdicts)} killed ({found.mutants} mutants)")
        if asked.verdicts or asked.quick:
            (asked.verdicts or Path(os.devnull)).write_text(json.dumps(_plain(found)), "utf-8")
        else:
            print(f"{name}: {store.save(found)}")
    return 0


def _language(name: str, described: str | None) -> Language:
    if described is None:
        return installed_language(name)
    package, module, attribute, tests = described.split(":")
    return Language(name, package, module, attribute, tests or None)


def _plain(found: store.Campaign) -> dict[str, object]:
    """A campaign's verdicts, for whoever reads them in another process."""
    rows = [
        {
            "file": verdict.mutant.file,
            "function": verdict.mutant.function,
            "diff": verdict.mutant.diff,
            "killer": verdict.killer,
            "text": verdict.text,
        }
        for verdict in found.verdicts
    ]
    return {
        "mutants": found.mutants,
        "chosen": found.chosen,
        "failing": found.judge["failing"],
        "verdicts": rows,
    }


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
