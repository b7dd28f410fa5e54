"""The faults of a device by code: something is known of every code, since the wire may bring any."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from protocols.plugin import FaultInfo


def unknown(code: int) -> FaultInfo:
    """Return what is known of a code that is not in the device's table."""
    return FaultInfo(f"fault {code}", "not known to this driver: newer firmware?", "look it up, then clear")


class Faults(dict[int, FaultInfo]):
    """The faults that are known, and what is known of any other code. A constant."""

    def __init__(self, known: Mapping[int, FaultInfo], other: Callable[[int], FaultInfo] = unknown) -> None:
        super().__init__(known)
        self._other = other

    def __missing__(self, code: int) -> FaultInfo:
        return self._other(code)

    def __deepcopy__(self, memo: object) -> Faults:
        return self


def faults(text: str, phrases: Mapping[str, str] | None = None) -> dict[int, FaultInfo]:
    """Return the faults of a text, by code: a line each, "code name: cause | remedy".

    Args:
        text: the lines; "~" before a code: the device withdraws it by itself (`FaultInfo.latching`).
        phrases: what several lines have in common, there in braces by its name.
    """
    found = {}
    for line in text.strip().splitlines():
        code, _, words = line.format_map(phrases or {}).partition(" ")
        name, _, why = words.partition(": ")
        cause, remedy = why.split(" | ")
        found[int(code.lstrip("~"), 0)] = FaultInfo(name, cause, remedy, latching=code[0] != "~")
    return found
