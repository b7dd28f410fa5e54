"""The notation of transcripts: text to messages and frames, and back (docs/transcripts.md)."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from enum import Enum
from typing import Any, get_type_hints

from protocols import messages
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Nanos

MESSAGES: dict[str, type[Any]] = {
    name: kind for name, kind in vars(messages).items() if isinstance(kind, type) and is_dataclass(kind)
}
CAN = re.compile(r"([0-9A-Fa-f?]{3,8})(#|##[01])(R?)(?=[ 0-9A-Fa-f?*]|$)")
NUMBER = re.compile(r"(-?(?:\d+\.\d*(?:e-?\d+)?|nan|inf)|-?\d+(?=[iu]))(f|d|[iu](?:8|16|32|64))")
PACKED = {"f": "f", "d": "d", "8": "b", "16": "h", "32": "i", "64": "q"}
REPEATED = re.compile(r"([0-9A-Fa-f]{2})x(\d+)")
LITERAL = re.compile(rf'[0-9A-Fa-f?*]+|"[^"]*"|{NUMBER.pattern}|{REPEATED.pattern}')
RELATIVE = 1e-6
"""Relative tolerance of an expected number, unless one is written (`2±0.01`)."""


def tokens(text: str) -> list[str]:
    """Split at spaces that are not within quotation marks."""
    return re.findall(r'(?:[^\s"]|"[^"]*")+', text)


def number(text: str) -> float:
    """Return a number; `rev` after it makes radians of revolutions."""
    return float(text.removesuffix("rev")) * (math.tau if text.endswith("rev") else 1.0)


def close(written: str, actual: float | None) -> bool:
    """True if a number is as written."""
    if actual is None or written == "none":
        return actual is None and written == "none"
    middle, _, slack = written.partition("±")
    if slack:
        return abs(number(middle) - actual) <= number(slack)
    return math.isclose(number(middle), actual, rel_tol=RELATIVE)


def is_text(written: str, actual: str) -> bool:
    """True if a text is as written; `*` is any text."""
    parts = written.replace('"', "").split("*")
    return bool(re.fullmatch(".*".join(map(re.escape, parts)), actual))


def values_of(kind: type, written: Mapping[str, str]) -> dict[str, Any]:
    """Return the values of the fields of a dataclass that are written."""
    hints = get_type_hints(kind)
    return {name: _value(text, hints[name]) for name, text in written.items()}


def _value(written: str, hint: Any) -> Any:
    if written.startswith("["):
        items = [each for each in written.strip("[]").split(",") if each]
        return tuple(each.strip('"') if "str" in str(hint) else number(each) for each in items)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint(written)
    if hint is bool:
        return written == "yes"
    if "float" in str(hint):
        return number(written)
    return int(written, 0) if "int" in str(hint) else written.replace('"', "")


# -- messages ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pattern:
    """A message as it is written: its type, and its fields as text."""

    kind: type[Any] | None
    """None: any message (`*`)."""
    written: Mapping[str, str]
    rest: bool
    """The fields that are not written may have any value (`...`), else they have their defaults."""

    def build(self, t: Nanos) -> Any:
        """Return the message at time `t`."""
        assert self.kind is not None
        time = {"t": t} if "t" in get_type_hints(self.kind) else {}
        return self.kind(**values_of(self.kind, self.written), **time)

    def matches(self, now: Nanos, actual: Any) -> bool:
        """True if this message is as written."""
        if self.kind is None:
            return True
        return type(actual) is self.kind and all(
            self._fits(f.name, f.default, getattr(actual, f.name), now) for f in fields(actual)
        )

    def _fits(self, name: str, default: object, actual: object, now: Nanos) -> bool:
        written = self.written.get("age" if name == "t" else name)
        if name == "t" and (written or not self.rest):
            return actual == now - round(float(written or 0) * MILLISECOND)
        if written is None:
            return self.rest or actual == default
        if isinstance(actual, tuple):
            parts = [part for part in written.strip("[]").split(",") if part]
            return len(parts) == len(actual) and all(map(close, parts, actual))
        if isinstance(actual, bool) or not isinstance(actual, int | float):
            return is_text(written, _text(actual))
        return written == "*" or (
            close(written, actual) if isinstance(actual, float) else int(written, 0) == actual
        )


def message(text: str) -> Pattern:
    """Read a message: its type, values in the order of its fields (but the time), others by name."""
    first, *rest = tokens(text)
    if first == "*":
        return Pattern(None, {}, rest=True)
    names = [f.name for f in fields(MESSAGES[first])]
    order = iter([name for name in names if name != "t"])
    written = {}
    for token in rest:
        key, equals, value = token.partition("=")
        if equals and key in (*names, "age"):
            written[key] = value
        elif token != "...":  # noqa: S105 -- no password, but "any values"
            written[next(order)] = token
    return Pattern(MESSAGES[first], written, "..." in rest)


def shown(actual: Any, now: Nanos) -> str:
    """Return a message or frame as it is written."""
    if isinstance(actual, CanFrame | bytes):
        return candump(actual)
    parts = [type(actual).__name__]
    for f in fields(actual):
        value = getattr(actual, f.name)
        text = f'"{value}"' if isinstance(value, str) and (" " in value or not value) else _text(value)
        if f.name == "t":
            parts += [f"age={(now - value) / MILLISECOND:g}"] if value != now else []
        elif f.default is MISSING or value != f.default:
            parts.append(text if f.default is MISSING else f"{f.name}={text}")
    return " ".join(parts)


def _text(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{','.join(map(_text, value))}]"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "none" if value is None else f"{value:.9g}" if isinstance(value, float) else str(value)


# -- frames --------------------------------------------------------------------------------------------


def candump(frame: Frame) -> str:
    """Return a frame in candump's notation, serial bytes as hexadecimal digits."""
    return str(frame) if isinstance(frame, CanFrame) else frame.hex().upper()


@dataclass(frozen=True)
class Frames:
    """How a file writes frames: by its own names, the vectors' names, the protocol's notation, or bytes."""

    names: Mapping[str, str]
    vectors: Mapping[str, Frame]
    notation: Callable[[str], Frame | str] | None
    """Returns a frame, or one in candump's notation."""

    def text(self, written: str) -> str:
        """Return a frame in candump's notation, `*` and `?` for any digits as they are."""
        first, *rest = tokens(written)
        if "$" in self.names.get(first, ""):
            return self.text(re.sub(r"\$(\d)", lambda found: rest[int(found[1]) - 1], self.names[first]))
        if any(token in self.names for token in (first, *rest)):
            return self.text(" ".join(self.names.get(token, token) for token in (first, *rest)))
        if first in self.vectors:
            return candump(self.vectors[first])
        if can := CAN.match(written):
            identifier, mark, remote = can.groups()
            identifier = identifier if len(identifier) == 3 else identifier.zfill(8)
            return f"{identifier.upper()}{mark}{remote}{''.join(map(digits, tokens(written[can.end() :])))}"
        if self.notation is not None and not all(map(LITERAL.fullmatch, (first, *rest))):
            found = self.notation(written)
            return found if isinstance(found, str) else candump(found)
        return "".join(map(digits, (first, *rest)))

    def frame(self, written: str) -> Frame:
        """Return the frame that is written."""
        text = self.text(written)
        can = CAN.match(text)
        if can is None:
            return bytes.fromhex(text)
        identifier, mark, remote = can.groups()
        data = bytes.fromhex(text[can.end() :])
        return CanFrame(
            int(identifier, 16), data, len(identifier) > 3, bool(remote), mark != "#", mark == "##1"
        )

    def matches(self, written: str, actual: Frame) -> bool:
        """True if a frame is as written."""
        pattern = re.escape(self.text(written)).replace(r"\*", ".*").replace(r"\?", ".")
        return bool(re.fullmatch(pattern, candump(actual)))


def digits(token: str) -> str:
    """Return hexadecimal digits, of a number (`0.25f`, `-3i16`), a text (`"conf"`) or repetition (`50x9`)."""
    if found := NUMBER.fullmatch(token):
        code = PACKED[found[2].lstrip("iu")]
        value = float(found[1]) if code in "fd" else int(found[1])
        return struct.pack("<" + (code.upper() if found[2][0] == "u" else code), value).hex().upper()
    if found := REPEATED.fullmatch(token):
        return found[1].upper() * int(found[2])
    if not LITERAL.fullmatch(token):
        raise ValueError(f"{token!r} is no bytes")
    return token.strip('"').encode().hex().upper() if token.startswith('"') else token.upper()
