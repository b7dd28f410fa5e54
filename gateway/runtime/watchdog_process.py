"""The watchdog process: `python -m gateway.runtime.watchdog_process`, started by `gateway.runtime.watchdog`.

Rules. It knows buses and frames, and makes none of its own: it sends what the loop has handed over, if the
loop dies (its pipe is closed) or hangs (no line comes for the limit). If nothing was handed over, since
nothing was commanded or the loop has left, it sends nothing. Before each round it looks for a line: a loop
that lives is not fought. It ignores every signal that can be ignored, and ends with the pipe.

The lines are JSON: first the limit [ns] and the buses; then, each a sign of life, the frames of a driver in
place of those before, or none of them; null when the loop has left.
"""

from __future__ import annotations

import json
import os
import select
import sys
from contextlib import suppress

from gateway.buses import Bus, open_bus
from gateway.core.clock import WallClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from gateway.runtime.process import ignore_signals
from protocols.frames import EXTENDED_BIT, CanFrame
from protocols.messages import MILLISECOND, SECOND, Nanos

ROUNDS, PERIOD = 10, 50 * MILLISECOND
"""How often the frames are sent, lest one be lost, and how soon again."""
NOTHING = ((EXTENDED_BIT | 0x1FFF_FFFF, EXTENDED_BIT | 0x1FFF_FFFF),)
"""A receive filter: of no device."""


class Pipe:
    """Lines from the loop."""

    def __init__(self, file: int) -> None:
        self.closed = False
        self._file, self._rest = file, b""

    def read(self, timeout: Nanos | None) -> list[bytes] | None:
        """Wait for so long at most; return the lines that are complete, None if nothing came."""
        seconds = None if timeout is None else timeout / SECOND
        if self.closed or not (self._waits(seconds) or self._waits(0)):  # it may have come while we waited
            return None
        data = os.read(self._file, 1 << 16)
        self.closed = not data
        *complete, self._rest = (self._rest + data).split(b"\n")
        return complete if data else None

    def _waits(self, seconds: float | None) -> bool:
        return bool(select.select([self._file], [], [], seconds)[0])


class Watch:
    """What was handed over, and the buses to send it on."""

    def __init__(self, pipe: Pipe, limit: Nanos, buses: dict[str, Bus], clock: WallClock) -> None:
        self._pipe, self._limit, self._buses, self._clock = pipe, limit, buses, clock
        self._frames: dict[str, list[tuple[str, CanFrame]]] = {}
        """By driver, with their buses."""
        self._sent = False
        """Whether they were sent since the last line."""

    def run(self) -> None:
        """Watch until the pipe is closed."""
        while not self._pipe.closed:
            self._look(self._limit if self._frames and not self._sent else None)

    def _look(self, timeout: Nanos | None) -> bool:
        """Wait for the loop, for so long at most; send the frames if nothing comes. True if it lives."""
        lines = self._pipe.read(timeout)
        if lines is None:
            if self._frames and not self._sent:
                self._sent = True
                self._send()
            return False
        self._sent = False
        for line in lines:
            self._take(json.loads(line))
        for bus in self._buses.values():  # notes when an interface goes, and when it is back
            bus.read(self._clock.now())
        return True

    def _take(self, line: dict[str, list[list[object]]] | None) -> None:
        if line is None:
            self._frames.clear()
            return
        for driver, frames in line.items():
            self._frames[driver] = [(str(bus), _frame(*parts)) for bus, *parts in frames]

    def _send(self) -> None:
        """Send the frames, round by round, until the loop lives again."""
        why = "has died" if self._pipe.closed else f"stands for more than {self._limit / MILLISECOND:g} ms"
        given = [each for frames in self._frames.values() for each in frames]
        for _ in range(ROUNDS):
            now = self._clock.now()
            for name, bus in self._buses.items():
                bus.read(now)
                bus.write(now, [frame for at, frame in given if at == name])
            if self._pipe.closed:
                self._clock.wait(now + PERIOD)
            elif self._look(PERIOD):
                break
        used = ", ".join(dict.fromkeys(at for at, _ in given))
        _tell(f"WARNING: watchdog: the loop {why}: the stop action was sent on {used}\n")


def _frame(number: object, data: object, *flags: object) -> CanFrame:
    assert isinstance(number, int)
    return CanFrame(number, bytes.fromhex(str(data)), *map(bool, flags))


def _tell(text: str) -> None:
    """Write to the error stream, unless that would wait."""
    with suppress(OSError):
        if select.select([], [2], [], 0)[1]:
            os.write(2, text.encode())


def main() -> int:
    """Watch the loop at the other end of the standard input; return 1 if a bus cannot be opened."""
    ignore_signals()
    pipe, clock = Pipe(0), WallClock()
    head: list[bytes] = []
    while not head:
        lines = pipe.read(None)
        if lines is None:
            return 1
        head = lines
    first = json.loads(head[0])
    buses: dict[str, Bus] = {}
    try:
        for name, kind, interface, bitrate, data_bitrate in first["buses"]:
            settings = BusSettings(name, kind, interface, bitrate, data_bitrate, receive_filter=NOTHING)
            buses[name] = open_bus(settings, clock)
    except BusError as error:
        print(str(error).partition("\n")[0], flush=True)
        return 1
    print("ready", flush=True)
    Watch(pipe, first["limit"], buses, clock).run()
    for bus in buses.values():
        bus.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
