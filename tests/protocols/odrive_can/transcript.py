"""Transcripts: the frames and events of a driver, line by line, compared with an expectation.

Rules. An expectation is written by hand, from what is promised, and never taken from the driver. Times are ms
since the stage of the conversation began. A line is one of

    20 > 3:Set_Axis_State 1                 sent in one call of `send`, in this order
    20…100 > 3:Set_Input_Vel 1 0            sent in each call of `send` from here to there
    20…120/50 > 3:Set_Axis_State 1          sent again with this period [ms], and not in between
    20 < State left ready: IDLE             an event
    20 < Refused … (× 31)                   this number of equal lines

Where a time or a text is our own choice and no promise, the expectation has room: `100-200` for a time means
"from … to …", `*` in an event any text.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, fields

from protocols.messages import Done, Event, Fault, Feedback, Found, Parameter, Refused, State

TIME = r"\d+(?:-\d+)?"
LINE = re.compile(
    rf"(?P<first>{TIME})(?:…(?P<last>{TIME}))?(?:/(?P<step>{TIME}))? (?P<way>[<>]) (?P<text>.*?)"
    r"(?: \(× (?P<count>\d+)\))?"
)


@dataclass
class Line:
    """Frames or an event, once or repeatedly."""

    way: str
    text: str
    first: int
    last: int
    step: int = 0
    """ms from one to the next; 0: in each call of `send`."""
    count: int = 1

    def __str__(self) -> str:
        if self.way == "<":
            return f"{self.first} < {self.text}{f' (× {self.count})' if self.count > 1 else ''}"
        last = f"…{self.last}" if self.count > 1 else ""
        return f"{self.first}{last}{f'/{self.step}' if self.step else ''} > {self.text}"

    def again(self, text: str, now: int, without_pause: bool) -> bool:
        """Whether this goes on: the same text once more, after the same pause."""
        step = 0 if without_pause else now - self.last
        if self.way != ">" or text != self.text or (self.count > 1 and step != self.step):
            return False
        self.last, self.step, self.count = now, step, self.count + 1
        return True

    def is_as(self, wanted: str) -> bool:
        """Whether this is the line that was expected."""
        found = LINE.fullmatch(wanted)
        if found is None or found["way"] != self.way:
            return False
        text = ".*".join(map(re.escape, found["text"].split("*")))
        times = ((found["first"], self.first), (found["last"] or found["first"], self.last))
        return (
            bool(re.fullmatch(text, self.text))
            and all(_within(room, time) for room, time in times)
            and _within(found["step"] or "0", self.step)
            and (self.way == ">" or self.count == int(found["count"] or 1))
        )


def _within(room: str, time: int) -> bool:
    low, _, high = room.partition("-")
    return int(low) <= time <= int(high or low)


def expectation(text: str) -> list[str]:
    """The lines of an expectation; what is indented goes on with the line above, `#` is a remark."""
    lines: list[str] = []
    for line in textwrap.dedent(text).strip().splitlines():
        if line.startswith(" ") and lines:
            lines[-1] += " " + line.strip()
        elif line and not line.startswith("#"):
            lines.append(line)
    return lines


def difference(lines: Sequence[Line], wanted: Sequence[str]) -> str:
    """The first line that is not as expected, with the whole transcript; "" if none."""
    for at in range(max(len(lines), len(wanted))):
        line = lines[at] if at < len(lines) else None
        if line is None or at >= len(wanted) or not line.is_as(wanted[at]):
            meant = wanted[at] if at < len(wanted) else "nothing more"
            whole = "\n".join(map(str, lines))
            return f"line {at + 1} is\n{line or 'nothing'}\nand should be\n{meant}\nin\n{whole}"
    return ""


def reported(event: Event) -> str:
    """An event in a line."""
    match event:
        case Feedback(motor):
            values = [(f.name, getattr(event, f.name)) for f in fields(event)[2:]]
            return f"{motor} " + ", ".join(f"{name} {value:g}" for name, value in values if value is not None)
        case State(motor, _, mode, detail):
            return f"State {motor} {mode}: {detail}"
        case Fault(motor, _, code, name, cause, remedy):
            assert cause, name
            assert remedy, name
            return f"Fault {motor} {code:#x} {name}: {cause}"
        case Found(_, protocol, address, serial, detail, duplicate):
            assert protocol == "odrive_can"
            number = "?" if serial is None else f"{serial:012X}"
            return f"Found {address} {number}{' duplicate' if duplicate else ''}: {detail}"
        case Done(_, request, name, detail):
            return f"Done {request} {name}: {detail}"
        case Refused(_, request, name, reason):
            return f"Refused {request} {name}: {reason}"
        case Parameter(motor, _, parameter, value):
            return f"Parameter {motor} {parameter} {value:g}"
    raise TypeError(event)
