"""A long campaign of numbered cases: seeded, and resumed where it was interrupted.

Its progress stands in `.prove/NAME.jsonl`: the seed and a digest of our sources first, then one line per case
that held. The same command goes on with the same seed, and begins anew, with a new seed, when all cases are
done, when a source has changed, or when PROVE_SEED asks for a seed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from gateway.cli.terminal.progress import Progress
from gateway.recording import environment


def terminal() -> TextIO:
    """The terminal behind pytest's capture; what leads nowhere if there is none."""
    try:
        return Path("/dev/tty").open("w")
    except OSError:
        return Path(os.devnull).open("w")


FOLDER = Path(__file__).parent.parent.parent / ".prove"


class Campaign:
    """`run` runs the cases that are not done yet; a case that fails is the first of the next attempt."""

    def __init__(self, name: str, count: int, folder: Path = FOLDER) -> None:
        self.path = folder / f"{name}.jsonl"
        self.count = count
        self.done: dict[int, Any] = {}
        asked = os.environ.get("PROVE_SEED")
        sources = environment.sources()
        head, lines = self._read()
        same = head.get("sources") == sources and asked in (None, str(head.get("seed")))
        if same and len(lines) < count:
            self.seed = int(head["seed"])
            self.done = lines
            return
        self.seed = int(asked) if asked is not None else int.from_bytes(os.urandom(4), "little")
        folder.mkdir(exist_ok=True)
        self.path.write_text(json.dumps({"seed": self.seed, "sources": sources, "count": count}) + "\n")

    def run(self, case: Callable[[int, int], Any]) -> dict[int, Any]:
        """Call `case(seed, number)` for what is left; all results by number. Prints how to repeat it."""
        print(
            f"\n{self.path.stem}: seed {self.seed}, {len(self.done)} of {self.count} cases were done before"
        )
        left = [number for number in range(self.count) if number not in self.done]
        with self.path.open("a") as file, terminal() as screen:
            file.write("\n")  # the last line may be torn
            screen.write("\n")  # below the line of pytest that names the test
            shown = Progress(f"{self.path.stem}, cases", len(left), screen)
            for ran, number in enumerate(left):
                shown.update(ran)
                try:
                    self.done[number] = case(self.seed, number)
                except BaseException as error:
                    error.add_note(
                        f"case {number} of {self.path.stem}; repeat it with PROVE_SEED={self.seed}"
                    )
                    raise
                file.write(json.dumps({"case": number, "result": self.done[number]}) + "\n")
                file.flush()
            shown.clear()
        return self.done

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
