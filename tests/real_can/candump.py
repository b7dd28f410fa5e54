"""What `candump` of can-utils sees, as frames."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from protocols.frames import CanFrame
from tests.gateway.processes import eventually

LINE = re.compile(r"\((\d+\.\d+)\) (\S+) ([0-9A-F]+)#(R|#[0-9A-F])?([0-9A-F]*)")
"""A line of `candump -L`: (seconds) interface ID#DATA; ID#R and perhaps the length asked for; of CAN FD ID##F
and the data, where F has the flags: 1 is the switched bit rate, 4 CAN FD itself."""


@dataclass(frozen=True, slots=True)
class Seen:
    """A frame on an interface, at a moment of the system's clock."""

    seconds: float
    frame: CanFrame


def parse(text: str) -> list[Seen]:
    """Every frame of a `candump -L`. Raises ValueError at a line that is none."""
    seen = []
    for line in text.splitlines():
        found = LINE.fullmatch(line)
        if found is None:
            raise ValueError(f"not a line of candump -L: {line!r}")
        seen.append(Seen(float(found[1]), _frame(found[3], found[4] or "", found[5])))
    return seen


def _frame(number: str, kind: str, data: str) -> CanFrame:
    remote, fd = kind == "R", kind.startswith("#")
    content = b"" if remote else bytes.fromhex(data)
    requested = int(data or "0") if remote else 0
    brs = fd and bool(int(kind[1:], 16) & 1)
    return CanFrame(int(number, 16), content, len(number) == 8, remote, fd, brs, requested)


@contextmanager
def candump(interface: str, log: Path) -> Iterator[None]:
    """While inside, all that is on the interface is written to a file."""
    before = listeners(interface)
    with (
        log.open("w") as output,
        subprocess.Popen(["candump", "-L", "-D", interface], stdout=output, stderr=subprocess.PIPE) as dump,
    ):
        try:
            assert eventually(lambda: listeners(interface) > before or dump.poll() is not None)
            yield
        finally:
            dump.terminate()


def listeners(interface: str) -> int:
    """Return how many programs receive all that is on an interface: the kernel's own list."""
    rows = Path("/proc/net/can/rcvlist_all").read_text().splitlines()
    return sum(row.split()[:1] == [interface] for row in rows)  # device, id, mask, …


def in_order(some: Sequence[CanFrame], frames: Sequence[CanFrame]) -> bool:
    """Whether the first ones are among the others, in that order."""
    rest = iter(frames)
    return all(any(frame == one for frame in rest) for one in some)
