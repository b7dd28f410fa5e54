"""Doors: what other distributions add to the brain, found by entry points: bodies, skills, brains.

Rules. An object is imported when it is first asked for, and no other is. Where several distributions use a
name, ours has it; among others none has, since what moves a robot must not depend on the order of folders. A
distribution that cannot be read, or an object that cannot be imported, affects no other: who asks for it is
told why, in a sentence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib.metadata import EntryPoint
from typing import Any, NamedTuple

from protocols.entry_points import Offered, Unreadable, is_ours, owner, version


class Closed(LookupError):
    """Nothing comes through this door; the text says why."""


class NotFound(Closed):
    """Nothing of this name is installed; `known` is what is."""

    def __init__(
        self, what: str, name: str, known: Iterable[str], unreadable: Iterable[Unreadable] = ()
    ) -> None:
        self.known = sorted(known)
        unread = ", ".join(sorted(one.distribution for one in unreadable))
        self.unread = f"; the entry points of {unread} cannot be read" if unread else ""
        """Which distributions may have it, "" if none"""
        super().__init__(f"no {what} {name!r}: there is {', '.join(self.known) or 'none'}{self.unread}")


class Broken(Closed):
    """It is installed, and cannot be used."""


class Loaded(NamedTuple):
    """What an entry point leads to."""

    object: Any
    maker: str
    """The distribution that it belongs to, with its version"""


def load(among: Offered, what: str, name: str, mistake: Callable[[EntryPoint, Any], str]) -> Loaded:
    """Return the object of this name, and import no other. Raises NotFound or Broken.

    `what` it is, is for their texts; `mistake` returns what is wrong with the object, "" if nothing is."""
    point = _find(among, what, name)
    try:
        found = point.load()
        wrong = mistake(point, found)
    except KeyboardInterrupt:  # a person's, who wants to leave
        raise
    except BaseException as error:  # noqa: BLE001 -- another's module may raise anything, SystemExit too
        wrong = f"{type(error).__name__}: {error}"
    if wrong:
        of = "" if is_ours(point) else f" of {owner(point)}"
        raise Broken(f"{what} {name!r}{of} is broken: {wrong}")
    return Loaded(found, f"{owner(point)} {version(point)}")


def _find(among: Offered, what: str, name: str) -> EntryPoint:
    """Return the entry point of this name. Raises NotFound or Broken."""
    same = [point for point in among.points if point.name == name]
    if not same:
        raise NotFound(what, name, {point.name for point in among.points}, among.unreadable)
    if len(same) == 1:
        return same[0]
    ours = [point for point in same if is_ours(point)]
    if not ours:
        raise Broken(f"{what} {name!r} is {' and '.join(map(owner, same))}'s: uninstall one")
    return ours[0]
