"""Bodies by name: classes found by their entry points. A new one is installed, not listed."""

from __future__ import annotations

from importlib.metadata import entry_points

from brain.bodies.body import Body
from gateway.config.errors import unknown
from gateway.errors import UserError

GROUP = "motor_gateway.bodies"
"""Entry points: the body's name in the robot file = MODULE:CLASS."""


def names() -> list[str]:
    """Return the names of the installed bodies."""
    return sorted({point.name for point in entry_points(group=GROUP)})


def load_body(name: str) -> type[Body]:
    """Return the class of this body, and import no other. Raises UserError: unknown, or broken."""
    points = {point.name: point for point in entry_points(group=GROUP)}
    if name not in points:
        raise UserError(unknown("body", name, sorted(points)))
    try:
        found = points[name].load()
    except Exception as error:
        raise UserError(f"body {name!r} is broken: {type(error).__name__}: {error}") from error
    if not (isinstance(found, type) and issubclass(found, Body)):
        raise UserError(f"body {name!r} is broken: {points[name].value} is not a brain.bodies.body.Body")
    if lacking := sorted(getattr(found, "__abstractmethods__", ())):
        raise UserError(f"body {name!r} is broken: {points[name].value} lacks {', '.join(lacking)}")
    if found.kind != name:
        raise UserError(f"body {name!r} is broken: it calls itself {found.kind!r}")
    return found
