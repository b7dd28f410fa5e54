"""Registers, models and packets of Feetech bus servos: STS and SMS (little-endian), SCS (big-endian).

Sources: the vendor's memory tables as published for STS and SCSCL; SMS_STS.cpp, SCSCL.cpp of
adityakamath/SCServo_Linux@da2ed3a; feetech-servo-sdk 1.0.0. Names of registers are those of lerobot.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

from protocols.toolkit.device_file import device_file
from protocols.toolkit.faults import Faults, faults
from protocols.toolkit.memory_map import MemoryMap, rows
from protocols.toolkit.serial import Framing, inverted_sum8
from protocols.toolkit.servo_packets import IDS, NAMES, ServoPackets

NAME = "feetech"
MIDDLE_HERE = 128
"""Written to Torque_Enable: the present position becomes the middle."""
DELAY_UNIT = 2_000
"""ns of Return_Delay_Time"""
LONGEST_DELAY = 254 * DELAY_UNIT

DATA: Mapping[str, Mapping[str, Any]] = device_file("protocols.feetech")
BLOCKS = {"who": (0, 40), "state": (33, 38), "motion": (56, 8)}
"""What is asked for at once: first register, and bytes."""
REGISTERS: Mapping[str, str] = DATA["registers"]
FAMILIES = {
    "sts": MemoryMap(rows(REGISTERS["common"], REGISTERS["sts"]), BLOCKS, stored=40),
    "scs": MemoryMap(
        rows(REGISTERS["common"], REGISTERS["scs"]), BLOCKS | {"state": (40, 27)}, stored=40, order="big"
    ),
}
AMPERE = 6.5e-3
"""A of one step of Present_Current"""


class Model(NamedTuple):
    """What differs between the servos of a family."""

    table: MemoryMap
    number: int
    """Model_Number; 0: not checked"""
    steps: int
    """Of the position in `span`"""
    span: float
    """rad"""
    ends: tuple[int, int]
    """Positions at or beyond which a reading is none."""
    sync_read: bool = True

    @property
    def step(self) -> float:
        """Return one step [rad]."""
        return self.span / self.steps

    @property
    def middle(self) -> int:
        """Return the position that is 0 rad."""
        return self.steps // 2

    @property
    def modes(self) -> tuple[int, ...]:
        """Return the values of Operating_Mode."""
        return (0, 1, 2) if "Operating_Mode" in self.table.by_name else (0,)


_FAMILY = {
    "sts": partial(Model, FAMILIES["sts"], steps=4096, span=2.0 * math.pi, ends=(-0x7FFF, 0x7FFF)),
    "scs": partial(
        Model, FAMILIES["scs"], steps=1024, span=math.radians(300.0), ends=(0, 1023), sync_read=False
    ),
}
MODELS: Mapping[str, Model] = {
    name: _FAMILY[family](number=number) for name, (family, number) in DATA["models"].items()
}
NUMBERS = {model.number: name for name, model in MODELS.items() if model.number}


def identified(data: bytes) -> str:
    """Return firmware and model from the first five registers, whatever the family: END (2) is its order."""
    number = int.from_bytes(data[3:5], "big" if data[2] else "little")
    return f"{NUMBERS.get(number, 'model')} ({number}), firmware {data[0]}.{data[1]}"


# -- packets -----------------------------------------------------------------------------------------------


RESET = 6
"""Instruction: what is stored becomes as delivered, but for the id (STS3215, firmware 3.10: servolab
1.0.0)."""
SYNC = b"\xff\xff"


def _body(head: bytes) -> int | None:
    return head[3] - 1 if head[3] >= 2 and head[2] != 0xFF else None


class Packets(ServoPackets):
    """Packets as in Dynamixel's protocol 1.0."""

    framing = Framing(SYNC, 4, _body, inverted_sum8, 1, covers=2)
    head, counted = struct.Struct(">2sBBB"), 2
    addresses = range(254)
    overhead = 6
    place, block = struct.Struct("B"), struct.Struct("BB")
    longest = 253
    names = NAMES | {RESET: "RESET"}
    maps = tuple(FAMILIES.values())

    def packet(self, address: int, instruction: int, data: bytes = b"") -> bytes:
        """Return what the framing makes of it, in less time: so few bytes are added up."""
        size = len(data) + 2
        check = ~(address + size + instruction + sum(data)) & 0xFF
        return b"".join((SYNC, IDS[address], IDS[size], IDS[instruction], data, IDS[check]))


PACKETS = Packets()


def disarms(number: int) -> bytes:
    """Return what takes the torque off one servo; nobody answers."""
    return PACKETS.sync_write(40, {number: b"\x00"})


# -- faults ------------------------------------------------------------------------------------------------

FAULTS = faults(DATA["faults"]["servo"])
ALL_FAULTS = Faults(FAULTS | faults(DATA["faults"]["driver"]))
(NOT_ARMED,) = faults(DATA["faults"]["driver"])


def faults_in(error: int) -> tuple[int, ...]:
    """Return the faults in the error byte of a status; bits without a name are none."""
    return tuple(bit for bit in FAULTS if error & bit) if error else ()
