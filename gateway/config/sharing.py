"""Several languages on one bus: which CAN ids mean something to two of its devices, and what else to know.

Rules. On a CAN bus nobody is addressed: whatever bears an id that a device listens to is obeyed by it,
whoever meant it for whom. So two languages may share no id, in either direction: a command would be obeyed by
a stranger (0x080 calls all of a bus in one language, and is a node's own in another), a report be taken for
a command or for somebody else's report, and two that send the same id at once destroy each other's frames.
An 11-bit id and a 29-bit one of the same number are two ids. Devices of one language are its own matter.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import permutations
from typing import TypeAlias

from gateway.core.robot import BusSettings, Motor, Sensor
from protocols.plugin import Spec

Part: TypeAlias = Motor | Sensor
Id: TypeAlias = tuple[int, bool]
"""A CAN id, and whether it is a 29-bit one."""
MOST_NAMED = 4
"""Ids of one kind that a sentence lists."""


def clash(first: Part, second: Part) -> str:
    """What is wrong with two devices of different languages on one bus, from the second one's side; or ""."""
    ours, theirs, name = second.spec, first.spec, repr(first.name)
    obeyed, obeyed_there = _obeyed(ours, _sent(theirs)), _obeyed(theirs, _sent(ours))
    kinds = (
        (_obeyed(ours, _reported(theirs)), f"it would obey what {name} reports there"),
        (_obeyed(theirs, _reported(ours)), f"{name} would obey what it reports there"),
        (obeyed & obeyed_there, "each would obey what the other is sent"),
        (obeyed, f"it would obey what {name} is sent"),
        (obeyed_there, f"{name} would obey what it is sent"),
        (_reported(ours) & _reported(theirs), "both report there"),
    )
    reported: list[str] = []
    seen: set[Id] = set()
    for shared, why in kinds:
        if new := shared - seen:
            reported.append(f"{_list(new)} ({why})")
            seen |= new
    if not reported:
        return ""
    return f"uses CAN ids of {name} ({first.plugin.name}) on bus {first.bus!r}: {'; '.join(reported)}"


def mixed(buses: Mapping[str, BusSettings], parts: Sequence[Part]) -> list[str]:
    """What a person must be told of each bus that languages share, unless its table acknowledges it."""
    reported: list[str] = []
    for name, bus in buses.items():
        here = [part for part in parts if part.bus == name]
        if bus.kind != "serial" and not bus.acknowledged:
            reported += [*_fd_beside_classic(name, here), *_mistaken(here)]
    return reported


def _fd_beside_classic(bus: str, parts: Sequence[Part]) -> list[str]:
    """A controller that knows no CAN FD answers each FD frame with an error frame (ISO 11898-1:2015, which
    calls the one that does not "FD tolerant")."""
    classic, fd = _of_kind(parts, "can"), _of_kind(parts, "canfd")
    if not (classic and fd):
        return []
    who = f"{', '.join(fd)} speak{'s' * (len(fd) == 1)} CAN FD, and {', '.join(classic)} classic CAN alone"
    what = (
        f"the controller of {' and of '.join(classic)} must tolerate CAN FD, or it destroys every such frame"
    )
    return [f'{bus}: {who}; {what}. If so, write shared_bus = "acknowledged" under [buses.{bus}]']


def _of_kind(parts: Sequence[Part], kind: str) -> list[str]:
    return [part.name for part in parts if part.spec.bus == kind]


def _mistaken(parts: Sequence[Part]) -> list[str]:
    """Reports that a driver of another language takes for those of a device that the file does not name."""
    reported: dict[tuple[str, str], str] = {}
    for listener, speaker in permutations(parts, 2):
        key = listener.plugin.name, speaker.name
        if listener.plugin.name == speaker.plugin.name or key in reported:
            continue
        taken = {one for one in _reported(speaker.spec) if _matches(listener.spec.receives_also, one[0])}
        if taken:
            said = f"{listener.plugin.name} takes what it sends on {_list(taken)} for words of its own kind"
            remedy = f'an address of its own, or shared_bus = "acknowledged" under [buses.{speaker.bus}]'
            reported[key] = f"{speaker.name}: {said}, and a scan may find what is not there; {remedy}"
    return list(reported.values())


def _sent(spec: Spec) -> frozenset[Id]:
    """What its driver sends it, with the format of each id."""
    return frozenset((number, spec.is_extended(number)) for number in spec.sends)


def _reported(spec: Spec) -> frozenset[Id]:
    """What it sends."""
    return frozenset((number, spec.is_extended(number)) for number in spec.expects)


def _obeyed(spec: Spec, ids: frozenset[Id]) -> frozenset[Id]:
    """Those of somebody's ids that it would heed."""
    return (_sent(spec) & ids) | {one for one in ids if _matches(spec.obeys_also, one[0] | one[1] << 31)}


def _matches(choices: Iterable[tuple[int, int]], number: int) -> bool:
    return any(number & mask == bits for bits, mask in choices)


def _list(ids: Iterable[Id]) -> str:
    ordered = sorted(ids)
    shown = [f"0x{number:08X}" if extended else f"0x{number:03X}" for number, extended in ordered]
    return ", ".join(shown[:MOST_NAMED]) + (", …" if len(shown) > MOST_NAMED else "")
