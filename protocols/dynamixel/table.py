"""Models, and their control tables: registers by address, which protocol 2.0 reads and writes.

Rules. Names are those of the e-Manual, with underscores. Registers below 64 are stored, and written with the
torque off only. Velocities are in steps of the model, positions in counts, of which `zero` is 0 rad.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

from protocols.plugin import FaultInfo
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


# fmt: off
MODELS = {
    "XL430-W250": Model(1060, 0, 265, 1.5),      "2XL430-W250": Model(1090, 0, 250, 1.4),
    "XC430-W150": Model(1070, 0, 460, 1.6),      "XC430-W240": Model(1080, 0, 306, 1.9),
    "2XC430-W250": Model(1160, 0, 250, 1.8),
    "XL330-M077": Model(1190, 1750, 1620, 0.146, "X330", 1e-3),
    "XL330-M288": Model(1200, 1750, 445, 0.354, "X330", 1e-3),
    "XC330-T181": Model(1210, 910, 601, 0.671, "X330", 1e-3),
    "XC330-T288": Model(1220, 910, 391, 0.967, "X330", 1e-3),
    "XC330-M181": Model(1230, 1750, 585, 0.333, "X330", 1e-3),
    "XC330-M288": Model(1240, 1750, 371, 0.517, "X330", 1e-3),
    "XH430-W350": Model(1000, 648, 135, 2.615),  "XH430-W210": Model(1010, 648, 210, 1.923),
    "XD430-T350": Model(1001, 648, 135, 2.615),  "XD430-T210": Model(1011, 648, 210, 1.923),
    "XH430-V350": Model(1040, 689, 130, 4.7, "X", 1.34e-3),
    "XH430-V210": Model(1050, 689, 230, 3.71, "X", 1.34e-3),
    "XM430-W350": Model(1020, 1193, 200, 1.783), "XM430-W210": Model(1030, 1193, 330, 1.304),
    "XW430-T333": Model(1270, 1193, 200, 1.7),   "XW430-T200": Model(1280, 1193, 330, 1.3),
    "XM540-W270": Model(1120, 2047, 128, 2.409), "XM540-W150": Model(1130, 2047, 230, 1.659),
    "XH540-W270": Model(1100, 2047, 128, 2.02),  "XH540-W150": Model(1110, 2047, 230, 1.673),
    "XD540-T270": Model(1101, 2047, 128, 2.02),  "XD540-T150": Model(1111, 2047, 230, 1.673),
    "XH540-V270": Model(1140, 1188, 128, 3.8),   "XH540-V150": Model(1150, 1188, 230, 2.9),
    "XW540-T260": Model(1170, 2047, 128, 1.94),  "XW540-T140": Model(1180, 2047, 230, 1.4),
    "PH42-020-S300": Model(2000, 4500, 2920, 3.4, "P", 1e-3, 607_500),
    "PH54-100-S500": Model(2010, 15_900, 2920, 4.6, "P", 1e-3, 1_003_846),
    "PH54-200-S500": Model(2020, 22_740, 2900, 4.8, "P", 1e-3, 1_003_846),
    "PM42-010-S260": Model(2100, 1461, 2600, 3.0, "P", 1e-3, 526_374),
    "PM54-040-S250": Model(2110, 4470, 2840, 3.0, "P", 1e-3, 502_834),
    "PM54-060-S250": Model(2120, 7980, 2830, 3.0, "P", 1e-3, 502_834),
}
# fmt: on
BY_NUMBER = {model.number: name for name, model in MODELS.items()}

STORED = """
0 u16 Model_Number r|2 u32 Model_Information r|6 u8 Firmware_Version r|7 u8 ID|8 u8 Baud_Rate
9 u8 Return_Delay_Time|10 u8 Drive_Mode|11 u8 Operating_Mode|12 u8 Secondary_ID|13 u8 Protocol_Type
20 i32 Homing_Offset|24 u32 Moving_Threshold|31 u8 Temperature_Limit|32 u16 Max_Voltage_Limit
34 u16 Min_Voltage_Limit|36 u16 PWM_Limit|44 u32 Velocity_Limit|48 i32 Max_Position_Limit
52 i32 Min_Position_Limit|63 u8 Shutdown"""
VOLATILE = """
64 u8 Torque_Enable|68 u8 Status_Return_Level|69 u8 Registered_Instruction r
70 u8 Hardware_Error_Status r|76 u16 Velocity_I_Gain|78 u16 Velocity_P_Gain|80 u16 Position_D_Gain
82 u16 Position_I_Gain|84 u16 Position_P_Gain|88 u16 Feedforward_2nd_Gain|90 u16 Feedforward_1st_Gain
98 u8 Bus_Watchdog|100 i16 Goal_PWM|104 i32 Goal_Velocity|108 u32 Profile_Acceleration
112 u32 Profile_Velocity|116 i32 Goal_Position|120 u16 Realtime_Tick r|122 u8 Moving r
123 u8 Moving_Status r|124 i16 Present_PWM r|128 i32 Present_Velocity r|132 i32 Present_Position r
136 i32 Velocity_Trajectory r|140 i32 Position_Trajectory r|144 u16 Present_Input_Voltage r
146 u8 Present_Temperature r"""
"""At the X series; the P series has these 448 further on."""

MODES = {"current": 0, "velocity": 1, "position": 3, "extended_position": 4, "current_position": 5}
COMMANDED = frozenset({"Torque_Enable", "Goal_PWM", "Goal_Current", "Goal_Velocity", "Goal_Position"})
"""Registers that commands write, not requests."""
FEEDBACK = (
    "Torque_Enable", "Hardware_Error_Status", "Bus_Watchdog", "Present_Current", "Present_Velocity",
    "Present_Position", "Present_Input_Voltage", "Present_Temperature",
)  # fmt: skip
DATA = frozenset({208, 224, 634})
"""Where the indirect data begin, in one model or another."""
MORE: dict[Family, list[str]] = {"X": [], "X330": ["62 u8 PWM_Slope"], "P": ["40 u32 Acceleration_Limit"]}


class ControlTable(MemoryMap):
    """The registers of one kind of model."""

    def __init__(self, family: Family, *, current: bool) -> None:
        shift = 448 if family == "P" else 0
        load = "126 i16 Present_Current r|102 i16 Goal_Current" if current else "126 i16 Present_Load r"
        stored = [STORED, *(["38 u16 Current_Limit"] if current else []), *MORE[family]]
        super().__init__(
            [
                *rows("|".join(stored)),
                *rows(f"{VOLATILE}|{load}", shift),
                *([] if family == "P" else rows("65 u8 LED")),
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


_REBOOT = "then clear: it restarts"
_SUPPLY = "the supply is outside of Min_ and Max_Voltage_Limit"
_ENCODER = "clear: it restarts; if it comes back, replace it"
_SHOCK = f"check supply and cables, {_REBOOT}"
FAULTS = {
    0x01: FaultInfo("input voltage", _SUPPLY, f"check it, {_REBOOT}"),
    0x04: FaultInfo("overheating", "hotter than Temperature_Limit", f"let it cool, {_REBOOT}"),
    0x08: FaultInfo("motor encoder", "the encoder of the motor", _ENCODER),
    0x10: FaultInfo("electrical shock", "the circuit, or too little power", _SHOCK),
    0x20: FaultInfo("overload", "more load than it can carry, for too long", f"free it, {_REBOOT}"),
}
"""Bits of Hardware_Error_Status: each switches the torque off."""
WATCHDOG, NOT_ARMED = 0x100, 0x200
_SILENT = "the host was silent for longer than timeout_ms"
_FIRMWARE = (
    "firmware without a bus watchdog (before 38) or without indirect addresses, or a line that loses much"
)
_OPTIONS = "update the firmware, or set timeout_ms = 0, indirect = false"
ALL_FAULTS = FAULTS | {
    WATCHDOG: FaultInfo("bus watchdog", _SILENT, f"find out why, {_REBOOT}"),
    NOT_ARMED: FaultInfo("not armed", f"a register does not become what is written: {_FIRMWARE}", _OPTIONS),
}
"""With what is none of the device's: it stops where it is, with the torque on, or does not arm."""
ERRORS = {
    1: "it failed to process the instruction", 2: "it does not know the instruction", 3: "the CRC was wrong",
    4: "the value is out of range", 5: "the length is wrong", 6: "the value is beyond a limit that is stored",
    7: "the register cannot be written now",
}  # fmt: skip
