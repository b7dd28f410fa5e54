"""What does not go as it should on a line whose devices speak only when asked: each kind once in the log.

Rules. Once a second each line's counters are compared with those of a second before. What is told names what
was counted, and the likeliest cause; each kind once in a run. Nothing here changes anything.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping

from gateway.buses import Bus
from gateway.buses.serial.garbage import verdict
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from protocols.line import SILENT, Line
from protocols.messages import MILLISECOND, SECOND, Nanos

log = logging.getLogger("gateway")

PERIOD: Nanos = SECOND
FEW = 8
"""Answers, or bytes, in a period that are no matter."""
SHARE = 0.02
"""Share of the answers that may be lost without a word: a line is no ideal one."""
BY_CHANCE = 0.05
"""Share of questions that garbage answers by chance: one in 256 places of it fits a checksum of 8 bits."""
KEPT = 512
"""Bytes of a line that are looked at."""
_COUNTED = ("answered", "lost", "cut", "late", "stray")


class LineTroubles:
    """Watches the lines of a run."""

    def __init__(self, gateway: Gateway, buses: Mapping[str, Bus]) -> None:
        self._gateway, self._buses = gateway, buses
        self._next: Nanos | None = None
        self._before = {name: _counted(line) for name, line in gateway.lines.items()}
        self._heard = dict.fromkeys(gateway.lines, b"")
        self._came = dict.fromkeys(gateway.lines, 0)
        """Bytes in this period."""
        self.told: dict[tuple[str, str], str] = {}
        """What was said, by line and kind."""

    def take(self, tick: Tick) -> None:
        """Take in a tick; log what is wrong, once."""
        for packet in tick.inputs.packets:
            if packet.bus in self._heard and isinstance(packet.frame, bytes):
                self._heard[packet.bus] = (self._heard[packet.bus] + packet.frame)[-KEPT:]
                self._came[packet.bus] += len(packet.frame)
        if self._next is None or tick.now < self._next:
            self._next = tick.now + PERIOD if self._next is None else self._next
            return
        self._next = tick.now + PERIOD
        for name, line in self._gateway.lines.items():
            before, self._before[name] = self._before[name], _counted(line)
            new = {key: self._before[name][key] - before[key] for key in _COUNTED}
            kind, text = self._look(name, line, new)
            if text and (name, kind) not in self.told:
                self.told[name, kind] = text
                log.warning("%s: %s", name, text)
            self._came[name] = 0

    def _look(self, name: str, line: Line, new: Mapping[str, int]) -> tuple[str, str]:
        """Return what kind of trouble there is, and what to say; ("", "") if there is none."""
        lost, asked, bus = new["lost"], new["lost"] + new["answered"], self._gateway.robot.buses[name]
        if lost >= FEW and lost > SHARE * asked and 2 * new["late"] >= lost:
            allowed = f"latency_ms = {bus.latency / MILLISECOND:g}"
            return "late", (
                f"{new['late']} of {asked} answers in a second came when they had been given up: raise "
                f"{allowed} under [buses.{name}], or lower the latency timer of its adapter"
            )
        if lost >= FEW and lost > SHARE * asked and 2 * new["cut"] >= lost:
            return (
                "cut",
                f"{new['cut']} of {asked} answers in a second are garbage: {self._why(name, line, new)}",
            )
        if new["stray"] >= FEW and new["stray"] > SHARE * self._came[name]:
            return "stray", (
                f"{new['stray']} bytes in a second that nobody asked for: a device that speaks by itself, "
                "another host, or noise (termination, bias, ground)"
            )
        return "", ""

    def _why(self, name: str, line: Line, new: Mapping[str, int]) -> str:
        """Return the likeliest cause of garbage in place of answers."""
        if new["answered"] <= BY_CHANCE * (new["lost"] + new["answered"]):
            rate, errors = line.rate, getattr(self._buses.get(name), "errors", 0)
            return (
                verdict(self._heard[name], rate, errors)
                or "another baud rate, or two that always send at once"
            )
        bad = self._silent(name, line)
        if bad and len(bad) <= 2:
            return (
                f"all about {', '.join(map(repr, bad))}: an id twice on the line (both answer at once), or a "
                "device that answers for another id"
            )
        return "noise, a loose connector, an adapter that cuts packets, or another host on the line"

    def _silent(self, name: str, line: Line) -> list[str]:
        """Return the devices that do not answer any more, by what they are called in questions: motors by
        their names, others as they are asked about."""
        motors = [each for each in self._gateway.robot.motors.values() if each.bus == name]
        called = {word: each.name for each in motors for word in (str(each.device.address), each.name)}
        silent = dict[str, None]()
        for (_, key), (lost, _) in sorted(line.silence.items(), key=str):
            about = str(key[1] if isinstance(key, tuple) else key)
            known = [called[word] for word in about.split() if word in called]
            silent |= dict.fromkeys(known or [about]) if lost >= SILENT else {}
        return list(silent)


def _counted(line: Line) -> dict[str, int]:
    return {key: getattr(line, key) for key in _COUNTED}
