"""Transcripts as files: their blocks and lines (docs/transcripts.md)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.resources.abc import Traversable

from protocols.messages import MILLISECOND, Nanos

_NUMBER = r"(\d+(?:\.\d+)?)"
TIME = re.compile(rf"(\+?){_NUMBER}(?:\.\.{_NUMBER})?(?: every {_NUMBER}(?:\.\.{_NUMBER})?)?\s+(\S.*)")
HEAD = ("protocol", "source", "tests", "device", "name", "cycle", "cyclic", "reply", "peer", "background")
STIMULI = ("host", "bus", "cyclic", "reply", "peer", "silence", "shaft", "fault", "measure", "end")


@dataclass(frozen=True)
class TranscriptLine:
    """One line. Times are from the beginning of its block."""

    place: str
    text: str
    kind: str
    body: str
    results: tuple[str, ...] = ()
    """What follows `=>`."""
    start: Nanos = 0
    stop: Nanos = 0
    gap: tuple[Nanos, Nanos] | None = None
    """Shortest and longest time to the next repetition."""

    def __str__(self) -> str:
        return f"{self.place}: {self.text}"

    def next(self, after: Nanos) -> Nanos | None:
        """Return when it next happens; None: never again."""
        if self.gap is None or self.start > after:
            return self.start if self.start > after else None
        t = after + self.gap[0] - (after - self.start) % self.gap[0]
        return t if t <= self.stop else None


@dataclass(frozen=True, repr=False)
class Block:
    """One test."""

    file: Traversable
    title: str
    head: tuple[TranscriptLine, ...]
    """Of the file, then of the block."""
    lines: tuple[TranscriptLine, ...] = ()
    table: bool = False
    """Each line is run by itself."""
    after: Block | None = None

    def __str__(self) -> str:
        return f"{self.file.name.removesuffix('.txt')}: {self.title}"

    def runs(self) -> list[tuple[TranscriptLine, ...]]:
        """Return the lines of each run: all of them, or each of its own after those of the blocks before."""
        if not self.table:
            return [self.timeline()[0]]
        before, end = self.after.timeline() if self.after else ((), 0)
        return [(*before, _moved(line, end)) for line in self.lines]

    def timeline(self) -> tuple[tuple[TranscriptLine, ...], Nanos]:
        """Return the lines of the blocks before it and its own, and when the last one ends."""
        before, end = self.after.timeline() if self.after else ((), 0)
        lines = (*before, *(_moved(line, end) for line in self.lines))
        return lines, max((line.stop for line in lines), default=0)


def _moved(line: TranscriptLine, by: Nanos) -> TranscriptLine:
    return replace(line, start=line.start + by, stop=line.stop + by)


# -- reading a file ------------------------------------------------------------------------------------


def blocks(folder: Traversable) -> list[Block]:
    """Return the blocks of the transcripts in a folder (*.txt), file by file."""
    files = {file.name: file for file in folder.iterdir() if file.name.endswith(".txt")}
    return [block for name in sorted(files) for block in read(files[name])]


def read(file: Traversable) -> list[Block]:
    """Return the blocks of a file. Raises ValueError for a line that cannot be read."""
    head: tuple[TranscriptLine, ...] = ()
    found: dict[str, Block] = {}
    first: str | None = None
    for place, text in _logical_lines(file):
        title = text.removeprefix("== ")
        if title in found:
            raise ValueError(f"{place}: there is a block of this title")
        if title != text:
            found[title] = Block(file, title, head, after=found[first] if first else None)
        elif text == "before all others":
            first = next(reversed(found))
        elif found:
            last = next(reversed(found))
            found[last] = _with(found[last], place, text, found)
        else:
            head = (*head, _line(place, text, ()))
    return list(found.values())


def _logical_lines(file: Traversable) -> Iterator[tuple[str, str]]:
    """Yield places and lines, without remarks; what ends with a backslash goes on in the next line."""
    begun = ""
    for at, text in enumerate(file.read_text("utf-8-sig").splitlines(), 1):
        text = begun + text.partition(" -- ")[0].strip()
        begun = text.removesuffix("\\") if text.endswith("\\") else ""
        if text and not begun and not text.startswith("#"):
            yield f"{file.name}:{at}", text


def _with(block: Block, place: str, text: str, found: dict[str, Block]) -> Block:
    """Return a block with one more line."""
    if text == "each line by itself":
        return replace(block, table=True)
    if text == "without background":
        return replace(block, head=tuple(line for line in block.head if line.kind != "background"))
    if text.startswith("after "):
        title = text.split(None, 1)[1]
        return replace(block, after=None if title == "nothing" else found[title])
    line = _line(place, text, block.lines)
    if line.kind in HEAD and line.kind not in STIMULI:
        return replace(block, head=(*block.head, line))
    return replace(block, lines=(*block.lines, line))


def _line(place: str, text: str, before: Sequence[TranscriptLine]) -> TranscriptLine:
    found = TIME.fullmatch(text)
    plus, start, stop, low, high, rest = found.groups() if found else ("", "0", None, None, None, text)
    kind, _, rest = rest.partition(" ")
    if kind not in (*HEAD, *STIMULI, "tx", "rx", "event", "obeys"):
        raise ValueError(f"{place}: {text}: a line begins with a time and what happens")
    body, arrow, results = rest.partition("=> ")
    zero = before[-1].start if plus else 0
    gap = (nanos(low), nanos(high or low)) if low else None
    parts = tuple(part.strip() for part in results.split(" ; ")) if arrow else ()
    times = (zero + nanos(start), zero + nanos(stop or start))
    return TranscriptLine(place, text, kind, body.strip(), parts, *times, gap)


def nanos(milliseconds: str) -> Nanos:
    """Return a time in ms, as it is written."""
    return round(float(milliseconds) * MILLISECOND)
