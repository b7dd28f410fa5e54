"""Every exception that a user of the gateway has to handle, as one tree.

    GatewayError
    ├── ConfigError          a text file (robot, mission, world, plant, URDF, dump) is wrong: every mistake
    ├── ProtocolNotFound     no installed plugin has this name, or the plugin is broken
    ├── BusError             an interface cannot be opened, or cannot do what the robot file asks of it
    ├── RecordingError       a file cannot be written, or is no recording that this program can read
    ├── BagError             a bag of another program cannot be read, or lacks what the evaluation needs
    ├── OperatorError        a running robot cannot be reached, or its socket cannot be opened
    └── UserError            anything else that the caller can correct

`str` of each is one or more sentences for the user: what, where, what was expected, what to do. Anything
else that is raised is a defect of the gateway. What a bus delivers never raises.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import UnionType


class GatewayError(Exception):
    """Base class of all errors that the gateway raises on purpose."""


@dataclass(frozen=True, slots=True)
class Mistake:
    """One mistake in a text file."""

    file: str
    line: int
    """Counted from 1; 0 if the mistake concerns the file as a whole."""
    key: str
    """Dotted, as it would be written in the file; "" if the mistake concerns the file as a whole."""
    text: str
    """What was found, what was expected, and the nearest valid name."""

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place}: {self.key}: {self.text}" if self.key else f"{place}: {self.text}"


class ConfigError(GatewayError, ValueError):
    """A text file is wrong, or cannot be read; `mistakes` lists everything, in the order of the file."""

    def __init__(self, mistakes: Sequence[Mistake]) -> None:
        self.mistakes = tuple(mistakes)
        super().__init__("\n".join(str(mistake) for mistake in self.mistakes))


class ProtocolNotFound(GatewayError, LookupError):
    """No installed plugin has this name, or the plugin is broken."""


class BusError(GatewayError):
    """An interface cannot be opened, or cannot do what the robot file asks of it."""


class RecordingError(GatewayError):
    """A file cannot be written, or is no recording that this program can read."""


class BagError(GatewayError):
    """A bag cannot be read, or lacks what the evaluation needs."""


class OperatorError(GatewayError):
    """A running robot cannot be reached, or its socket cannot be opened."""


class UserError(GatewayError):
    """Something else that the caller can correct; the text says what and how."""


def expect(name: str, value: object, kinds: type | UnionType, wanted: str) -> None:
    """Raise UserError unless an argument is of one of these types, of which none is bool."""
    if isinstance(value, bool) or not isinstance(value, kinds):
        raise UserError(f"{name}: found {value!r}, a {type(value).__name__}; expected {wanted}")
