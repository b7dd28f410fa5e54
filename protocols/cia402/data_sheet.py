"""The electronic data sheet of a drive (EDS or DCF, CiA 306): what it says that the drive has and can.

Rules. The library canopen reads it; here it is held against what the driver needs. What it does not say is
left to the drive: it is asked. A DCF's own value counts before the default.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from protocols import messages as msg
from protocols.bounds import Invalid, Wrong, named_text
from protocols.canopen.objects import Key, title
from protocols.cia402 import objects as o
from protocols.cia402.options import Options
from protocols.messages import Command
from protocols.plugin import Setting

NEEDED = (o.CONTROLWORD, o.STATUSWORD, o.MODE, o.MODE_DISPLAY)
"""Objects without which no drive is driven"""
TARGETS: Mapping[type[Command], tuple[Key, Key]] = {
    msg.Position: (o.TARGET_POSITION, o.POSITION),
    msg.Velocity: (o.TARGET_VELOCITY, o.VELOCITY),
    msg.Torque: (o.TARGET_TORQUE, o.TORQUE),
}
"""By command: the set-point, and what is measured of it"""
TURN = (o.ENCODER_INCREMENTS, o.FEED, o.POSITION_UNIT)
"""Objects of which one says what a turn of the shaft is in position units"""
RPDO_MAPPING, TPDO_MAPPING, PDOS = 0x1600, 0x1A00, 4


@dataclass(frozen=True, slots=True)
class Entry:
    """One object."""

    default: int | None
    least: int | None
    most: int | None
    mappable: bool


@dataclass(frozen=True, slots=True)
class DataSheet:
    """What a file says."""

    name: str
    entries: Mapping[Key, Entry]

    def __contains__(self, key: Key) -> bool:
        return key in self.entries

    @property
    def modes(self) -> int | None:
        """The modes that it supports, as object 6502 has them; None: it does not say."""
        entry = self.entries.get(o.SUPPORTED_MODES)
        return None if entry is None else entry.default

    def commands(self, able: set[type[Command]], options: Options) -> set[type[Command]]:
        """Return those of these commands for which it has a set-point, and a unit of it."""
        without = set() if o.RATED_TORQUE in self or options.rated_torque else {msg.Torque}
        return {kind for kind in able - without if kind not in TARGETS or TARGETS[kind][0] in self}

    def mapped(self) -> list[tuple[int, list[Key]]]:
        """Return the objects in each PDO as delivered, by the index of its mapping, but for empty ones."""
        found = []
        for index in (base + at for base in (RPDO_MAPPING, TPDO_MAPPING) for at in range(PDOS)):
            count = self.entries.get((index, 0))
            most = min((count and count.default) or 0, 8)
            numbers = [self.entries.get((index, at + 1)) for at in range(most)]
            keys = [(one.default >> 16, one.default >> 8 & 0xFF) for one in numbers if one and one.default]
            found += [(index, keys)] if keys else []
        return found


class _Text:
    """A text as canopen reads a file."""

    def __init__(self, name: str, text: str) -> None:
        self.name = name if name.lower().endswith((".eds", ".dcf")) else f"{name}.eds"
        self._text = text

    def read(self) -> str:
        """Return all of it."""
        return self._text

    def __iter__(self) -> Iterator[str]:
        return iter(self._text.splitlines(keepends=True))


@lru_cache(16)
def read(value: str) -> DataSheet:
    """Return the data sheet of an option `eds`. Raises ValueError in words."""
    name, text = named_text(value)
    if not text:
        raise ValueError(f"there is no text of {name!r}: it comes there by loading the robot file")
    try:
        import canopen
    except ImportError as error:
        raise ValueError(f"{name}: reading it needs canopen: pip install 'motor-gateway[eds]'") from error
    try:
        file: Any = _Text(name, text)
        found: Any = canopen.import_od(file)
    except Exception as error:  # of its parser many
        raise ValueError(
            f"{name}: not read as an EDS or DCF file: {type(error).__name__}: {error}"
        ) from error
    entries = {}
    for index, one in found.items():
        for sub, each in one.items() if hasattr(one, "items") else ((0, one),):
            stated = getattr(each, "value", None)
            default = each.default if stated is None else stated  # a DCF's own value
            least, most = (limit if isinstance(limit, int) else None for limit in (each.min, each.max))
            number = default if isinstance(default, int) else None
            entries[index, sub] = Entry(number, least, most, bool(each.pdo_mappable))
    if not entries:
        raise ValueError(f"{name}: there is no object in it: is it an EDS or DCF file?")
    return DataSheet(name, entries)


def check(
    sheet: DataSheet, options: Options, configuration: Mapping[str, Setting], usual: Mapping[str, Setting]
) -> Mapping[str, Setting]:
    """Return the configuration as far as the drive has it, within its limits. Raises Invalid with every
    mistake.

    Args:
        sheet: of the drive.
        options: of the driver.
        configuration: as in `Spec`, by what the robot file states.
        usual: the same where it states nothing.
    """
    keep = options.mapping == "keep"
    wrong = [
        ("options.eds", f"{sheet.name} has no {_named(key)}: no drive of CiA 402 is without")
        for key in NEEDED
        if key not in sheet
    ]
    if not wrong and not any(target in sheet for target, _ in TARGETS.values()):
        several = ", ".join(_named(target) for target, _ in TARGETS.values())
        wrong.append(("options.eds", f"{sheet.name} has no set-point: expected one of {several}"))
    wrong += [] if wrong else _unmapped(sheet, keep)
    if not wrong and not options.counts_per_turn and not any(key in sheet for key in TURN):
        text = f"{sheet.name} has none of {_several(TURN)}: expected the position units per turn of the shaft"
        wrong.append(("options.counts_per_turn", text))
    kept: dict[str, Setting] = {}
    for name, setting in configuration.items():
        key = o.OBJECTS.find(name)
        entry = None if key is None else sheet.entries.get(key)
        if key is None or (entry is None and not 0x6000 <= key[0] < 0xA000):
            kept[name] = setting  # of communication, or a name of its own
        elif entry is None and setting.expected not in (None, usual[name].expected):
            wrong.append(("settings", f"{name} is stated, and {sheet.name} has no {_named(key)}"))
        elif entry is not None:
            kept[name] = _within(setting, entry)
            if setting.expected is not None and not kept[name].low <= setting.expected <= kept[name].high:
                bounds = f"{kept[name].low:g} to {kept[name].high:g}"
                wrong.append(
                    ("settings", f"{name} is {setting.expected:g}, and {sheet.name} has it from {bounds}")
                )
    if wrong:
        raise Invalid(*wrong)
    return kept


def _within(setting: Setting, entry: Entry) -> Setting:
    low = setting.low if entry.least is None else max(setting.low, float(entry.least))
    high = setting.high if entry.most is None else min(setting.high, float(entry.most))
    return replace(setting, low=low, high=high)


def _unmapped(sheet: DataSheet, keep: bool) -> list[Wrong]:
    """Return what is wrong with its PDOs: as delivered, and what can be mapped in them."""
    wrong: list[Wrong] = []
    for index, keys in sheet.mapped():
        wrong += [
            ("options.eds", f"{sheet.name}: {index:04X} maps {_named(key)}, which it has not")
            for key in keys
            if key[0] >= 0x1000 and key not in sheet
        ]
    driven = [keys for index, keys in sheet.mapped() if index < TPDO_MAPPING]
    flat = {key for keys in driven for key in keys}
    targets = [target for target, _ in TARGETS.values() if target in sheet]
    if keep and flat and not flat & {o.CONTROLWORD, *targets}:
        text = (
            f'mapping = "keep", and no receive PDO of {sheet.name} has {_several(targets)}: all goes by SDO'
        )
        wrong.append(("options.mapping", text))
    if not keep and not any(sheet.entries[target].mappable for target in targets):
        text = (
            f'none of {_several(targets)} can be mapped in a PDO of {sheet.name}: expected mapping = "keep"'
        )
        wrong.append(("options.mapping", text))
    return wrong


def _named(key: Key) -> str:
    name = o.OBJECTS[key].name if key in o.OBJECTS else ""
    return f"{title(key)} ({name})" if name else title(key)


def _several(keys: Sequence[Key]) -> str:
    return ", ".join(map(_named, keys))
