"""Bodies by name: classes found by their entry points. A new one is installed, not listed."""

from __future__ import annotations

from importlib.metadata import EntryPoint

from brain import doors
from brain.bodies.body import Body
from gateway.config.errors import unknown
from gateway.errors import UserError
from protocols.entry_points import offered

GROUP = "motor_gateway.bodies"
"""Entry points: the body's name in the robot file = MODULE:CLASS."""


def names() -> list[str]:
    """Return the names of the installed bodies."""
    return sorted({point.name for point in offered(GROUP).points})


def load_body(name: str) -> type[Body]:
    """Return the class of this body, and import no other. Raises UserError: unknown, or broken."""
    try:
        found: type[Body] = doors.load(offered(GROUP), "body", name, _mistake).object
    except doors.NotFound as error:
        raise UserError(unknown("body", name, error.known) + error.unread) from error
    except doors.Broken as error:
        raise UserError(str(error)) from error
    return found


def _mistake(point: EntryPoint, found: object) -> str:
    """Return what is wrong with what an entry point leads to."""
    if not (isinstance(found, type) and issubclass(found, Body)):
        return f"{point.value} is not a brain.bodies.body.Body"
    if lacking := sorted(getattr(found, "__abstractmethods__", ())):
        return f"{point.value} lacks {', '.join(lacking)}"
    return "" if found.kind == point.name else f"it calls itself {found.kind!r}"
