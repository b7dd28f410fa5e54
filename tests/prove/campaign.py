"""A long campaign of numbered cases: seeded, and resumed where it was interrupted.

Its progress stands in `.prove/NAME.jsonl`: the seed and a digest of our sources first, then one line per case
that held. The same command goes on with the same seed, and begins anew, with a new seed, when all cases are
done, when a source has changed, or when PROVE_SEED asks for a seed. A case that fails stops nothing: all
that failed are listed at the end, each with the command that repeats it alone, and tried again the next time.
"""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TextIO

import pytest

from gateway.cli.terminal.progress import Progress
from gateway.recording import environment


def terminal() -> TextIO:
    """The terminal behind pytest's capture; what leads nowhere if there is none."""
    try:
        return Path("/dev/tty").open("w")
    except OSError:
        return Path(os.devnull).open("w")


FOLDER = Path(__file__).parent.parent.parent / ".prove"


ENOUGH = 300
"""Characters of what is said of a case that failed."""


class Campaign:
    """`run` runs the cases that are not done yet. PROVE_CASES=NAME:3,17 has it run these alone."""

    def __init__(self, name: str, count: int, folder: Path = FOLDER) -> None:
        self.path = folder / f"{name}.jsonl"
        self.count = count
        self.done: dict[int, Any] = {}
        asked = os.environ.get("PROVE_SEED")
        chosen, _, numbers = os.environ.get("PROVE_CASES", "").rpartition(":")
        self.repeated = [int(number) for number in numbers.split(",")] if chosen == name else []
        sources = environment.sources()
        head, lines = self._read()
        same = head.get("sources") == sources and asked in (None, str(head.get("seed")))
        if same and (self.repeated or len(lines) < count):
            self.seed = int(head["seed"])
            self.done = lines
            return
        self.seed = int(asked) if asked is not None else int.from_bytes(os.urandom(4), "little")
        if not self.repeated:
            folder.mkdir(exist_ok=True)
            self.path.write_text(json.dumps({"seed": self.seed, "sources": sources, "count": count}) + "\n")

    def run(self, case: Callable[[int, int], Any]) -> dict[int, Any]:
        """Call `case(seed, number)` for what is left; all results by number. Raises AssertionError at the end
        if cases failed, with how to repeat each."""
        left = self.repeated or [number for number in range(self.count) if number not in self.done]
        done = "" if self.repeated else f", {len(self.done)} of {self.count} cases were done before"
        print(f"\n{self.path.stem}: seed {self.seed}{done}")
        failed: dict[int, BaseException] = {}
        with Path(os.devnull if self.repeated else self.path).open("a") as file, terminal() as screen:
            file.write("\n")  # the last line may be torn
            screen.write("\n")  # below the line of pytest that names the test
            shown = Progress(f"{self.path.stem}, cases", len(left), screen)
            for ran, number in enumerate(left):
                shown.update(ran)
                try:
                    self.done[number] = case(self.seed, number)
                except (Exception, pytest.fail.Exception) as error:  # noqa: BLE001 -- the others go on
                    failed[number] = error
                    continue
                file.write(json.dumps({"case": number, "result": self.done[number]}) + "\n")
                file.flush()
            shown.clear()
        if failed:
            raise AssertionError(self._report(failed, len(left))) from next(iter(failed.values()))
        if self.repeated:
            pytest.skip(f"of {self.path.stem} only {len(left)} cases were repeated: they held")
        return self.done

    def _report(self, failed: Mapping[int, BaseException], ran: int) -> str:
        lines = [f"{self.path.stem}: {len(failed)} of {ran} cases failed"]
        for number, error in failed.items():
            text = " ".join(f"{type(error).__name__}: {error}".split())[:ENOUGH]
            lines.append(f"case {number}: {text}\n    {self.command(number)}")
        return "\n".join(lines)

    def command(self, number: int) -> str:
        """Return the command that repeats a case alone."""
        test = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" (")[0]
        own = {"PROVE_SEED": str(self.seed), "PROVE_CASES": f"{self.path.stem}:{number}"}
        variables = {name: value for name, value in os.environ.items() if name.startswith("PROVE_")} | own
        words = [f"{name}={shlex.quote(value)}" for name, value in variables.items()]
        return " ".join([*words, "./go prove", shlex.quote(test)])

    def _read(self) -> tuple[dict[str, Any], dict[int, Any]]:
        """Its head and its cases; a torn last line counts as none."""
        head: dict[str, Any] = {}
        lines: dict[int, Any] = {}
        try:
            texts = self.path.read_text().splitlines()
        except FileNotFoundError:
            return head, lines
        for text in texts:
            try:
                line = json.loads(text)
            except json.JSONDecodeError:
                continue
            if "seed" in line:
                head = line
            else:
                lines[line["case"]] = line["result"]
        return head, lines
