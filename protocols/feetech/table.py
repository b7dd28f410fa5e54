"""Registers, models and packets of Feetech bus servos: STS and SMS (little-endian), SCS (big-endian).

Sources: the vendor's memory tables as published for STS and SCSCL; SMS_STS.cpp, SCSCL.cpp of
adityakamath/SCServo_Linux@da2ed3a; feetech-servo-sdk 1.0.0. Names of registers are those of lerobot.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from protocols.plugin import FaultInfo
from protocols.toolkit.faults import Faults
from protocols.toolkit.memory_map import MemoryMap, rows
from protocols.toolkit.serial import Framing, inverted_sum8
from protocols.toolkit.servo_packets import IDS, Packet, ServoPackets, Status, Targets

NAME = "feetech"
MIDDLE_HERE = 128
"""Written to Torque_Enable: the present position becomes the middle."""
DELAY_UNIT = 2_000
"""ns of Return_Delay_Time"""
LONGEST_DELAY = 254 * DELAY_UNIT

# -- registers ---------------------------------------------------------------------------------------------

COMMON = """
0 u8 Firmware_Major_Version r|1 u8 Firmware_Minor_Version r|3 u16 Model_Number r|5 u8 ID|6 u8 Baud_Rate
7 u8 Return_Delay_Time|8 u8 Response_Status_Level|9 u16 Min_Position_Limit|11 u16 Max_Position_Limit
13 u8 Max_Temperature_Limit|14 u8 Max_Voltage_Limit|15 u8 Min_Voltage_Limit|16 u16 Max_Torque_Limit
18 u8 Phase|19 u8 Unloading_Condition|20 u8 LED_Alarm_Condition|21 u8 P_Coefficient|22 u8 D_Coefficient
23 u8 I_Coefficient|24 u16 Minimum_Startup_Force|26 u8 CW_Dead_Zone|27 u8 CCW_Dead_Zone|40 u8 Torque_Enable
56 m15 Present_Position r|58 m15 Present_Velocity r|60 m10 Present_Load r|62 u8 Present_Voltage r
63 u8 Present_Temperature r|65 u8 Status r|66 u8 Moving r"""
STS = """
28 u16 Protection_Current|30 u8 Angular_Resolution|31 m11 Homing_Offset|33 u8 Operating_Mode
34 u8 Protective_Torque|35 u8 Protection_Time|36 u8 Overload_Torque|37 u8 Velocity_P_Coefficient
38 u8 Over_Current_Protection_Time|39 u8 Velocity_I_Coefficient|41 u8 Acceleration|42 m15 Goal_Position
44 m10 Goal_Time|46 m15 Goal_Velocity|48 u16 Torque_Limit|55 u8 Lock|69 m15 Present_Current r"""
SCS = """
37 u8 Protective_Torque|38 u8 Protection_Time|42 u16 Goal_Position|44 u16 Goal_Time|46 u16 Goal_Velocity
48 u8 Lock"""
BLOCKS = {"who": (0, 40), "state": (33, 38), "motion": (56, 8)}
"""What is asked for at once: first register, and bytes."""
FAMILIES = {
    "sts": MemoryMap(rows(COMMON + STS), BLOCKS, stored=40),
    "scs": MemoryMap(rows(COMMON + SCS), BLOCKS | {"state": (40, 27)}, stored=40, order="big"),
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


def _sts(number: int) -> Model:
    return Model(FAMILIES["sts"], number, 4096, 2.0 * math.pi, (-0x7FFF, 0x7FFF))


def _scs(number: int) -> Model:
    return Model(FAMILIES["scs"], number, 1024, math.radians(300.0), (0, 1023), sync_read=False)


MODELS: Mapping[str, Model] = {
    "sts3215": _sts(777),
    "sts3250": _sts(2825),
    "sm8512bl": _sts(11272),
    "sts": _sts(0),
    "scs0009": _scs(1284),
    "scs": _scs(0),
}
NUMBERS = {model.number: name for name, model in MODELS.items() if model.number}


def identified(data: bytes) -> str:
    """Return firmware and model from the first five registers, whatever the family: END (2) is its order."""
    number = int.from_bytes(data[3:5], "big" if data[2] else "little")
    return f"{NUMBERS.get(number, 'model')} ({number}), firmware {data[0]}.{data[1]}"


# -- packets -----------------------------------------------------------------------------------------------


SYNC = b"\xff\xff"
WHOLE = sum(SYNC) + 0xFF & 0xFF
"""The sum of all bytes of a packet"""


def _body(head: bytes) -> int | None:
    return head[3] - 1 if head[3] >= 2 and head[2] != 0xFF else None


class Packets(ServoPackets):
    """Packets as in Dynamixel's protocol 1.0. Of a status, the error stands in the place of the instruction:
    nothing tells a status from an instruction."""

    framing = Framing(SYNC, 4, _body, inverted_sum8, 1, covers=2)
    addresses = range(254)
    overhead = 6
    place, block = struct.Struct("B"), struct.Struct("BB")
    longest = 253
    maps = tuple(FAMILIES.values())

    def packet(self, address: int, instruction: int, data: bytes = b"") -> bytes:
        size = len(data) + 2
        check = ~(address + size + instruction + sum(data)) & 0xFF
        return b"".join((SYNC, IDS[address], IDS[size], IDS[instruction], data, IDS[check]))

    def unpacked(self, message: bytes) -> Packet:
        return Packet(message[2], message[4], message[5:])

    def status(self, one: Packet) -> Status:
        return one.id, one.instruction, one.data

    def answered(self, wanted: Targets, question: Packet, data: bytes) -> tuple[Sequence[Status], bytes]:
        """Return whole answers with nothing else between them: the usual case, which needs no search."""
        found: list[Status] = []
        at = 0
        for number, (_, size) in wanted.items():
            one = data[at : at + size + 6]
            if len(one) != size + 6 or one[:2] != SYNC or one[2] != number or one[3] != size + 2:
                break
            if sum(one) & 0xFF != WHOLE:
                break
            found.append((number, one[4], one[5:-1]))
            at += size + 6
        return found, data[at:]


PACKETS = Packets()


def disarms(number: int) -> bytes:
    """Return what takes the torque off one servo; nobody answers."""
    return PACKETS.sync_write(40, {number: b"\x00"})


# -- faults ------------------------------------------------------------------------------------------------

NOT_ARMED = 0x100
FAULTS = {
    bit: FaultInfo(name, cause, remedy, latching=False)
    for bit, name, cause, remedy in (
        (0x01, "voltage", "the supply is outside Min_ … Max_Voltage_Limit", "check supply and load"),
        (0x02, "angle", "the magnetic encoder or potentiometer",
         "restart it; if it comes again, replace the servo"),
        (0x04, "overheat", "hotter than Max_Temperature_Limit: too much load for too long", "let it cool"),
        (0x08, "current", "more than Protection_Current for too long", "free the shaft; look for a short"),
        (0x20, "overload", "more than Overload_Torque for Protection_Time", "free the shaft, or carry less"),
    )
}  # fmt: skip
ALL_FAULTS = Faults(
    FAULTS
    | {
        NOT_ARMED: FaultInfo(
            "does not obey", "it answers, and its registers do not become what is written",
            "check the wire to it (does it hear broadcasts?), its id, and whether another host writes to it",
        )
    }
)  # fmt: skip


def faults_in(error: int) -> tuple[int, ...]:
    """Return the faults in the error byte of a status; bits without a name are none."""
    return tuple(bit for bit in FAULTS if error & bit) if error else ()
