"""Plugins that are broken on purpose: what drivers get wrong on a line of questions and answers.

Rules. Each is the plugin of the template (`gateway protocols new NAME --bus serial`), with what its driver
gives altered on the way to the line, or what it is given on the way back."""

from __future__ import annotations

import binascii
import json
import struct
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from gateway.cli import scaffold
from protocols.conformance.bench import DriverWrapper, Messages
from protocols.frames import Frame
from protocols.line import Answer, Exchange, Rank
from protocols.messages import MILLISECOND, Event, Feedback, Nanos
from protocols.plugin import Plugin
from tests.protocols.broken import BROKEN

SUBJECT = "questioned"
"""Name of the sound plugin."""


_BODIES = {"stop": bytes(8), "run": struct.pack("<Bxhxxxx", 1, 250), "clear": b"\x02" + bytes(7)}
VECTORS = [
    {
        "name": name,
        "direction": "to_device",
        "bus": "serial",
        "data": (message + struct.pack("<H", binascii.crc_hqx(message, 0))).hex(),
        "meaning": {"velocity": 2.5} if name == "run" else {},
        "source": "made with struct and binascii of Python 3.11 alone",
    }
    for name, body in _BODIES.items()
    for message in (b"\xa5\x01\x05" + body,)
]


def _made() -> Any:
    """Return the package of the template on a serial line."""
    if SUBJECT not in sys.modules:
        folder = Path(mkdtemp())
        for path, text in scaffold.contents(SUBJECT, "serial").items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_text(text, encoding="utf-8")
        (folder / SUBJECT / "vectors.json").write_text(json.dumps(VECTORS), encoding="utf-8")
        sys.path.append(str(folder))
        import_module(f"{SUBJECT}.line")
    return sys.modules[SUBJECT]


sound: Plugin = _made().plugin
FRAMING = sys.modules[f"{SUBJECT}.line"].FRAMING
BROKEN_LINES: list[tuple[Plugin, tuple[str, ...]]] = []
"""The broken plugins of this file, as in `BROKEN`."""


class Altered(DriverWrapper):
    """Forwards every call; subclasses alter what is given, or what is answered."""

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        own, given = super().send(now, messages)
        return own, [self.change(each) for each in given if isinstance(each, Exchange)]

    def change(self, each: Exchange) -> bytes:
        return each

    def answer(self, t: Nanos, asked: Exchange, data: bytes) -> Sequence[Event]:
        driver: Any = self.driver
        answered: Sequence[Event] = driver.answer(t, asked, data)
        return answered


def found_by(*clauses: str) -> Callable[[type[Altered]], type[Altered]]:
    """Register a plugin with this driver."""

    def register(part: type[Altered]) -> type[Altered]:
        wrong = replace(sound, name=part.__name__, driver=lambda devices: part(sound.driver(devices)))
        BROKEN_LINES.append((wrong, clauses))
        BROKEN.append((wrong, clauses))
        return part

    return register


def again(each: Exchange, answer: Answer | None, **changes: Any) -> Exchange:
    """Return an exchange with another answer, rank or subject."""
    as_it_is: dict[str, Any] = {"rank": each.rank, "about": each.about, "tries": each.tries}
    return Exchange(bytes(each), answer, **as_it_is | changes)


def never(asked: bytes, held: bytes) -> None:
    """Nothing ends the answer."""


def head(asked: bytes, held: bytes) -> tuple[int, int] | None:
    """The head ends the answer."""
    return (0, 3) if len(held) >= 3 else None


def everything(asked: bytes, held: bytes) -> tuple[int, int] | None:
    """Whatever came ends the answer, once there is a message's length of it."""
    return (0, len(held)) if len(held) >= 13 else None


def raises(asked: bytes, held: bytes) -> tuple[int, int] | None:
    """An answer is where its first byte is."""
    at = held.index(b"\xa5")
    return (at, at + 13) if len(held) >= at + 13 else None


@found_by("turns", "awaited")
class Bare(Altered):
    """Gives frames, as on a line on which each sends when it likes."""

    def change(self, each: Exchange) -> bytes:
        return bytes(each)


@found_by("awaited", "lost")
class Hasty(Altered):
    """Expects fewer bytes than come, and no delay: it gives up while the device sends."""

    def change(self, each: Exchange) -> bytes:
        assert each.answer is not None
        return again(each, replace(each.answer, size=1, delay=-300_000))


@found_by("awaited", "lost")
class Early(Altered):
    """Takes an answer for over at its head."""

    def change(self, each: Exchange) -> bytes:
        assert each.answer is not None
        return again(each, replace(each.answer, find=head))


@found_by("awaited", "lost")
class Endless(Altered):
    """Awaits more than comes."""

    def change(self, each: Exchange) -> bytes:
        assert each.answer is not None
        return again(each, replace(each.answer, find=never))


@found_by("awaited")
class Raises(Altered):
    """Looks for an answer in a way that raises where there is none."""

    def change(self, each: Exchange) -> bytes:
        assert each.answer is not None
        return again(each, replace(each.answer, find=raises))


@found_by("turns")
class ForgetsAnAnswer(Altered):
    """Gives what clears a fault as a frame that nobody answers."""

    def change(self, each: Exchange) -> bytes:
        return bytes(each) if each.about.endswith("clear") else each


@found_by("dead")
class Insists(Altered):
    """Waits longer for who has not answered, and asks it under other names, as often as the others."""

    def __init__(self, driver: Any) -> None:
        super().__init__(driver)
        self.lost, self.count = dict[int, int](), 0

    def change(self, each: Exchange) -> bytes:
        assert each.answer is not None
        if self.lost.get(each[2], 0) < 5:
            return each
        self.count += 1
        answer = replace(each.answer, delay=6 * MILLISECOND)
        return again(each, answer, about=f"{each.about} {self.count}")

    def answer(self, t: Nanos, asked: Exchange, data: bytes) -> Sequence[Event]:
        self.lost[asked[2]] = 0 if data else self.lost.get(asked[2], 0) + 1
        return super().answer(t, asked, data)


@found_by("newest")
class AsksTooMuch(Altered):
    """Asks each question four times, whether the last was answered or not."""

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        own, given = super().send(now, messages)
        asked = [e for e in given if isinstance(e, Exchange) and e.about.endswith("ask")]
        return own, [*given, *(again(each, each.answer, about="") for each in asked for _ in range(3))]


@found_by("dead", "lost")
class Patient(Altered):
    """Awaits every answer for 100 ms."""

    def change(self, each: Exchange) -> bytes:
        assert each.answer is not None
        return again(each, replace(each.answer, delay=100 * MILLISECOND))


@found_by("newest", "later")
class Hoarder(Altered):
    """Lets every set-point and question wait."""

    def change(self, each: Exchange) -> bytes:
        return again(each, each.answer, about="", rank=max(each.rank, Rank.QUESTION))


@found_by("later")
class Keeper(Altered):
    """Lets what arms wait, as a question does."""

    def change(self, each: Exchange) -> bytes:
        return again(each, each.answer, rank=max(each.rank, Rank.QUESTION))


@found_by("lost")
class Sulks(Altered):
    """After an answer that is lost, sends the device nothing for 6 ms."""

    def __init__(self, driver: Any) -> None:
        super().__init__(driver)
        self.until: dict[int, Nanos] = {}

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        own, given = super().send(now, messages)
        return own, [e for e in given if isinstance(e, bytes) and now >= self.until.get(e[2], 0)]

    def answer(self, t: Nanos, asked: Exchange, data: bytes) -> Sequence[Event]:
        if not data:
            self.until[asked[2]] = t + 6 * MILLISECOND
        return super().answer(t, asked, data)


@found_by("wrong")
class Trusting(Altered):
    """Takes any answer for that of the device that was asked."""

    def change(self, each: Exchange) -> bytes:
        assert each.answer is not None
        return again(each, replace(each.answer, find=everything))

    def answer(self, t: Nanos, asked: Exchange, data: bytes) -> Sequence[Event]:
        at = data.find(b"\xa5\x02")
        if at >= 0 and len(data) >= at + 13:
            data = FRAMING.frame(data[at : at + 2] + asked[2:3] + data[at + 3 : at + 11])
        return super().answer(t, asked, data)


@found_by("wrong")
class TakesItForAFault(Altered):
    """Reports a position of zero where an answer cannot be read."""

    def answer(self, t: Nanos, asked: Exchange, data: bytes) -> Sequence[Event]:
        events = super().answer(t, asked, data)
        if data and not events:
            name = {1: "alpha", 2: "beta"}[asked[2]]
            return [Feedback(name, t, 0.0, 0.0)]
        return events
