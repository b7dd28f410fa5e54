"""Models, and their control tables: registers by address, which protocol 2.0 reads and writes.

Rules. Names are those of the e-Manual, with underscores. Registers below 64 are stored, and written with the
torque off only. Velocities are in steps of the model, positions in counts, of which `zero` is 0 rad.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

from protocols.toolkit.device_file import device_file
from protocols.toolkit.faults import faults
from protocols.toolkit.memory_map import FORMS, MemoryMap, Values, rows

NAME = "dynamixel"
BAUD_RATES = (
    9600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000, 6_000_000, 10_500_000
)  # fmt: skip
"""bit/s by the value of Baud_Rate"""
DELAY_UNIT = 2_000
"""ns of Return_Delay_Time"""
WATCHDOG_UNIT_MS = 20
TRIPPED = 0xFF
"""Bus_Watchdog, when it has tripped (−1)"""
INDIRECT = 16
"""Indirect addresses that are used: every model has as many."""

Family = Literal["X", "X330", "P"]


@dataclass(frozen=True, slots=True)
class Model:
    """One model: what its registers count in, and their limits as delivered."""

    number: int
    current: int
    """Current_Limit; 0: it measures a load only, and has no modes for current."""
    velocity: int
    """Velocity_Limit"""
    torque: float
    """N·m/A, from stall torque and current; of one without current: its stall torque"""
    family: Family = "X"
    ampere: float = 2.69e-3
    """A of one step"""
    counts: int = 4096
    """Of a turn"""

    @property
    def step(self) -> float:
        """rad/s"""
        return 0.0010471976 if self.family == "P" else 0.0239691227

    @property
    def count(self) -> float:
        """rad"""
        return math.tau / self.counts

    @property
    def zero(self) -> int:
        """The position that is 0 rad."""
        return 0 if self.family == "P" else self.counts // 2

    @property
    def far(self) -> int:
        """The largest position beyond one turn, either way."""
        return (1 << 31) - 1 if self.family == "P" else 1_048_575

    @property
    def table(self) -> ControlTable:
        """The control table."""
        return table_of(self.family, current=self.current > 0)

    @property
    def strongest(self) -> float:
        """N·m"""
        return self.torque * self.current * self.ampere if self.current else self.torque


DEVICE = device_file("protocols.dynamixel")
MODELS = {name: Model(*row) for name, row in DEVICE["models"].items()}
BY_NUMBER = {model.number: name for name, model in MODELS.items()}

MODES = {"current": 0, "velocity": 1, "position": 3, "extended_position": 4, "current_position": 5}
COMMANDED = frozenset({"Torque_Enable", "Goal_PWM", "Goal_Current", "Goal_Velocity", "Goal_Position"})
"""Registers that commands write, not requests."""
FEEDBACK = (
    "Torque_Enable", "Hardware_Error_Status", "Bus_Watchdog", "Present_Current", "Present_Velocity",
    "Present_Position", "Present_Input_Voltage", "Present_Temperature",
)  # fmt: skip
DATA = frozenset({208, 224, 634})
"""Where the indirect data begin, in one model or another."""


class ControlTable(MemoryMap):
    """The registers of one kind of model."""

    def __init__(self, family: Family, *, current: bool) -> None:
        shift, texts = 448 if family == "P" else 0, DEVICE["registers"]
        super().__init__(
            [
                *rows(texts["stored"], texts["current_limit"] if current else "", texts[family]),
                *rows(texts["volatile"], texts["current" if current else "load"], shift=shift),
                *([] if family == "P" else rows(texts["led"])),
                *rows("|".join(f"{168 + 2 * k} u16 Indirect_Address_{k + 1}" for k in range(INDIRECT))),
            ],
            {
                "stored": (0, 64),
                "state": (64 + shift, 83),
                "motion": (126 + shift, 10),
                "indirect": (168, 2 * INDIRECT),
            },
            stored=64,
        )
        names = ["Present_Load" if name == "Present_Current" and not current else name for name in FEEDBACK]
        form = "<" + "".join(FORMS[self.by_name[name].type] for name in names)
        self.feedback = struct.Struct(form), tuple(names)
        """What indirect addresses make one block of,"""
        places = [(self.by_name[name].number, self.by_name[name].size) for name in names]
        self.indirect = tuple(at + k for at, size in places for k in range(size))
        """and what they are set to for it."""

    def values(self, at: int, data: bytes) -> Values:
        form, names = self.feedback
        if at in DATA and len(data) == form.size:
            return dict(zip(names, form.unpack(data), strict=True))
        return super().values(at, data)


@cache
def table_of(family: Family, *, current: bool) -> ControlTable:
    """Return the control table of a kind of model."""
    return ControlTable(family, current=current)


TABLES = table_of("X330", current=True), table_of("P", current=True)
"""In which everything that can be written is."""


def data_of(model: Model, firmware: int) -> int:
    """Return where the indirect data begin."""
    new = firmware >= 52  # SDK: xl330_m288.model, xl330_m288_fw52.model
    return {"X": 224, "X330": 208 if new else 224, "P": 634}[model.family]


def modes_of(model: Model) -> Sequence[int]:
    """Return the operating modes of a model."""
    if not model.current:
        return 1, 3, 4, 16
    return (0, 1, 3, 4, 16) if model.family == "P" else (0, 1, 3, 4, 5, 16)


_KNOWN: Mapping[str, Any] = DEVICE["faults"]
FAULTS = faults(_KNOWN["device"], _KNOWN["phrases"])
_OWN = faults(_KNOWN["driver"], _KNOWN["phrases"])
WATCHDOG, NOT_ARMED = _OWN
ALL_FAULTS = FAULTS | _OWN
ERRORS = {int(code): text for code, text in DEVICE["errors"].items()}
