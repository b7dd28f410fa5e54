"""Every exception that a user of the gateway has to handle, as one tree.

    GatewayError
    ├── ConfigError          the robot file is wrong: every mistake in it, one line each
    ├── ProtocolNotFound     no installed plugin has this name, or the one that has it is broken
    ├── BusError             an interface cannot be opened, or cannot do what the robot file asks of it
    ├── RecordingError       a file cannot be written, or is no recording that this program can read
    ├── BagError             a bag of another program cannot be read, or lacks what is to be judged
    ├── OperatorError        a running robot cannot be reached, or its socket cannot be opened
    └── UserError            anything else that the caller can mend; its text is a sentence for a person

`str` of each is a sentence, or several lines of them: what, where, what was expected, what to do. Anything
else that is raised is a defect of the gateway. What comes in on a wire never raises.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gateway.config.errors import Mistake


class GatewayError(Exception):
    """Base class of all errors that the gateway raises on purpose."""


class ConfigError(GatewayError, ValueError):
    """The robot file is wrong; `mistakes` lists everything, in the order of the file."""

    def __init__(self, mistakes: Sequence[Mistake]) -> None:
        self.mistakes = tuple(mistakes)
        super().__init__("\n".join(str(mistake) for mistake in self.mistakes))


class ProtocolNotFound(GatewayError, LookupError):
    """No installed plugin has this name, or the one that has it is broken."""


class BusError(GatewayError):
    """An interface cannot be opened, or cannot do what the robot file asks of it."""


class RecordingError(GatewayError):
    """A file cannot be written, or is no recording that this program can read."""


class BagError(GatewayError):
    """A bag cannot be read, or lacks what is to be judged."""


class OperatorError(GatewayError):
    """A running robot cannot be reached, or its socket cannot be opened."""


class UserError(GatewayError):
    """Something else that the caller can mend; the text says what and how."""
