"""The messages and faults of VESC controllers, in the vendor's units: ERPM, steps of the tachometer, A.

Source: vedderb/bldc@b9d287b3 `documentation/comm_can.md`, `comm/comm_can.c`, `comm/commands.c`,
`datatypes.h`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from protocols.plugin import FaultInfo
from protocols.toolkit.table import Field, Row, Table, const, sint, uint, unused

EVERY = 255
"""Address of all controllers on the bus."""
ADDRESSES = range(EVERY)
STEPS = 6
"""Steps of the tachometer in an electrical revolution."""

SETTERS: Mapping[str, tuple[int, float]] = {
    "SET_DUTY": (0, 1e-5),
    "SET_CURRENT": (1, 1e-3),
    "SET_CURRENT_BRAKE": (2, 1e-3),
    "SET_RPM": (3, 1.0),
    "SET_POS": (4, 1e-6),
    "SET_CURRENT_REL": (10, 1e-5),
    "SET_CURRENT_BRAKE_REL": (11, 1e-5),
    "SET_CURRENT_HANDBRAKE": (12, 1e-3),
    "SET_CURRENT_HANDBRAKE_REL": (13, 1e-5),
}
"""Number of a message with one number, and the unit of it: share of the voltage or of the largest current,
A, ERPM, degrees."""
SENT = frozenset({"SET_CURRENT", "SET_RPM"})
"""Those that are sent here."""
TUNNELLED = dict(enumerate([*list(SETTERS)[:5], "SET_CURRENT_HANDBRAKE"], 5))
"""The same as commands of the serial protocol, by their numbers there, which fit into a short buffer."""
SHORT_BUFFER, PING, PONG = 8, 17, 18
ALIVE, GET_VALUES_SELECTIVE = 30, 50
FAULT, STATE = 1 << 15, 1 << 21
"""Bits of GET_VALUES_SELECTIVE: the fault; whether the timeout has passed (1) and a kill switch is on (2)."""
STATUS: Mapping[str, tuple[int, tuple[Field, ...]]] = {
    "STATUS_1": (9, (sint("velocity", 32), sint("current", 16, 0.1), sint("duty", 16, 1e-3))),
    "STATUS_2": (14, (sint("ampere_hours", 32, 1e-4), sint("charged", 32, 1e-4))),
    "STATUS_3": (15, (sint("watt_hours", 32, 1e-4), sint("charged", 32, 1e-4))),
    "STATUS_4": (16, (*(sint(n, 16, 0.1) for n in ("fet", "motor", "supply")), sint("angle", 16, 0.02))),
    "STATUS_5": (27, (sint("position", 32), sint("voltage", 16, 0.1), unused(16))),
    "STATUS_6": (58, tuple(sint(name, 16, 1e-3) for name in ("adc1", "adc2", "adc3", "ppm"))),
}
"""Number and fields of each; the bit of its place switches it on in the controller."""


def _id(number: int, last: str = "address") -> tuple[Field, ...]:
    return const(0, 13), const(number, 8), uint(last)


def _setter(name: str, number: int, unit: float, *before: Field) -> Row:
    fields = *before, sint("value", 32, unit)
    return Row(name, _id(number), fields, order="big", fewest=sum(field.bits for field in fields) // 8)


def _values(bit: int) -> tuple[Field, ...]:
    return const(GET_VALUES_SELECTIVE), const(bit, 32)


def _reply(name: str, bit: int) -> Row:
    fields = uint("address"), uint("mode"), *_values(bit), uint("value")
    return Row(name, _id(SHORT_BUFFER, "host"), fields, "from_device", "big")


REPLIES: Mapping[int, int | None] = {0: 1, 2: None, 3: 0}
"""By the send mode of a command in a short buffer, that of the reply; None: it is not replied to. In another
mode the receiver does not obey: it passes on what it takes for a reply (1), or drops it."""
_SHORT = uint("host"), uint("mode")
"""Before a command of the serial protocol: the address to reply to, and the send mode."""
ROWS = (
    # The firmware reads a delay before the current; the vendor's page has it behind. Never sent here.
    _setter("SET_CURRENT delayed", 1, 1e-3, sint("delay", 16, 1e-3)),
    *(_setter(name, *each) for name, each in SETTERS.items()),
    *(
        _setter(f"COMM_{name}", SHORT_BUFFER, SETTERS[name][1], *_SHORT, const(number))
        for number, name in TUNNELLED.items()
    ),
    Row("COMM_ALIVE", _id(SHORT_BUFFER), (*_SHORT, const(ALIVE)), order="big"),
    Row("get fault", _id(SHORT_BUFFER), (*_SHORT, *_values(FAULT)), order="big", read_only=True),
    Row("get state", _id(SHORT_BUFFER), (*_SHORT, *_values(STATE)), order="big", read_only=True),
    Row("PING", _id(PING), (uint("host"),), read_only=True),
    Row("PONG", _id(PONG, "host"), (uint("address"), uint("hardware")), "from_device", fewest=1),
    _reply("fault", FAULT),
    _reply("state", STATE),
    *(Row(name, _id(at), fields, "from_device", "big") for name, (at, fields) in STATUS.items()),
)
TABLE = Table(replace(row, extended=True) for row in ROWS)

KILL, UNKNOWN = 0x100, 0xFF
"""Codes of ours: the kill switch, which is no fault of the vendor's; and faults of later firmware."""
# fmt: off
_NAMES = (
    "OVER_VOLTAGE UNDER_VOLTAGE DRV ABS_OVER_CURRENT OVER_TEMP_FET OVER_TEMP_MOTOR "
    "GATE_DRIVER_OVER_VOLTAGE GATE_DRIVER_UNDER_VOLTAGE MCU_UNDER_VOLTAGE BOOTING_FROM_WATCHDOG_RESET "
    "ENCODER_SPI ENCODER_SINCOS_BELOW_MIN_AMPLITUDE ENCODER_SINCOS_ABOVE_MAX_AMPLITUDE FLASH_CORRUPTION "
    "HIGH_OFFSET_CURRENT_SENSOR_1 HIGH_OFFSET_CURRENT_SENSOR_2 HIGH_OFFSET_CURRENT_SENSOR_3 "
    "UNBALANCED_CURRENTS BRK RESOLVER_LOT RESOLVER_DOS RESOLVER_LOS FLASH_CORRUPTION_APP_CFG "
    "FLASH_CORRUPTION_MC_CFG ENCODER_NO_MAGNET ENCODER_MAGNET_TOO_STRONG PHASE_FILTER ENCODER_FAULT "
    "LV_OUTPUT_FAULT ENCODER_SLIP OVERSPEED UNDERSPEED ABS_OVERSPEED"
)
"""Of code 1, 2 …"""
_WHY: Mapping[tuple[str, str], tuple[int, ...]] = {
    ("braking feeds back more than the supply takes", "brake more slowly, or use a battery"): (1,),
    ("the supply sags or is off", "check supply and cables"): (2, 8, 9),
    ("a shorted phase, or its power stage", "check the phase cables, then the controller"): (3, 7, 19, 27),
    ("a blocked shaft, a shorted phase, or its current loop", "free it; detect the motor anew"): (4,),
    ("too much current for too long", "let it cool; lower the current"): (5, 6),
    ("its firmware hung, and was restarted", "note what led to it; update its firmware"): (10,),
    ("the encoder's cable, magnet or supply", "check the encoder"): (11, 12, 13, 20, 21, 22, 25, 26, 28, 30),
    ("its memory is damaged", "write firmware and configuration anew"): (14, 23, 24),
    ("a current sensor is off, or a phase is open", "check the phase cables; calibrate"): (15, 16, 17, 18),
    ("a short circuit of its low-voltage output", "check what is connected there"): (29,),
    ("the load turned it, or its speed loop overshot", "check the load; lower the speed"): (31, 32, 33),
}
# fmt: on
FAULTS: Mapping[int, FaultInfo] = {
    **{
        code: FaultInfo(name, *why, latching=False)
        for code, name in enumerate(_NAMES.split(), 1)
        for why, codes in _WHY.items()
        if code in codes
    },
    KILL: FaultInfo("kill switch", "it was pressed, or its cable is broken", "release it", latching=False),
    UNKNOWN: FaultInfo("unknown fault", "it is of later firmware", "read it with VESC Tool", latching=False),
}
NO_STATUS, NO_ANSWER, NO_TIMEOUT, NOT_ARMED = 0x101, 0x102, 0x103, 0x104
"""Faults that the driver finds."""
_APP = "in VESC Tool, App Settings, General:"
ALL_FAULTS: Mapping[int, FaultInfo] = {
    **FAULTS,
    NO_STATUS: FaultInfo(
        "status messages are off",
        "they are, until they are switched on",
        f"{_APP} CAN Status Messages Rate 1 as in the robot file (feedback_ms), with STATUS_1, 4 and 5",
    ),
    NO_ANSWER: FaultInfo(
        "does not answer",
        "its CAN Mode is not VESC, its firmware is older than 5.3, or nothing that is sent reaches it",
        f"{_APP} CAN Mode VESC; update its firmware; check the cable",
    ),
    NO_TIMEOUT: FaultInfo(
        "its timeout does not pass",
        "it is off, longer than in the robot file, or another host commands the controller",
        f"{_APP} Timeout as in the robot file (timeout_ms); take the other host off the bus",
    ),
    NOT_ARMED: FaultInfo("does not obey", "its timeout stays passed under commands", f"{_APP} check the app"),
}
