"""Values ↔ bytes, both ways: those of feetech-servo-sdk 1.0.0, with a recorder in the place of its port."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any

import pytest
import scservo_sdk as sdk

from protocols import messages as msg
from protocols.feetech import plugin
from protocols.feetech import table as ft
from protocols.feetech.options import Options, Settings
from protocols.feetech.table import FAMILIES, PACKETS
from protocols.messages import Obeyed
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from protocols.toolkit.servo_packets import EVERYBODY, PING, SYNC_WRITE, WRITE

packet, writes, asks = PACKETS.packet, PACKETS.sync_write, PACKETS.asks
VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
STS, SCS = FAMILIES["sts"], FAMILIES["scs"]
STEP = 2.0 * math.pi / 4096
SENT: dict[str, tuple[dict[str, Any], bytes, tuple[Obeyed, ...]]] = {
    "ping_id1": ({}, packet(1, PING), ()),
    "mode_wheel": (
        {}, packet(1, WRITE, b"\x21" + STS.data("Operating_Mode", 1)),
        (msg.WriteParameter("m", "Operating_Mode", 1.0),),
    ),
    "goal_position_3072": (
        {}, packet(1, WRITE, b"\x2a" + STS.data("Goal_Position", 3072)),
        (msg.Arm("m"), msg.Position("m", 0.5 * math.pi)),
    ),
    "goal_speed_-500": (
        {"mode": "wheel"}, packet(1, WRITE, b"\x2e" + STS.data("Goal_Velocity", -500)),
        (msg.Arm("m"), msg.Velocity("m", -500 * STEP)),
    ),
    "sync_write_pos": (
        {}, writes(42, {1: STS.data("Goal_Position", 2048), 2: STS.data("Goal_Position", 1024)}),
        (msg.Arm("m"), msg.Position("m", 0.0)),
    ),
    "sync_write_speed": (
        {"mode": "wheel"},
        writes(46, {1: STS.data("Goal_Velocity", 1500), 2: STS.data("Goal_Velocity", -500)}),
        (msg.Arm("m"), msg.Velocity("m", 1500 * STEP)),
    ),
    "sync_write_pwm": (
        {"mode": "pwm"}, writes(44, {1: STS.data("Goal_Time", 500), 2: STS.data("Goal_Time", -250)}),
        (msg.Arm("m"), msg.Torque("m", -0.5 * 2.94)),
    ),
    "sync_write_torque_on": (
        {}, writes(40, {1: b"\x01", 2: b"\x01"}), (msg.Arm("m"), msg.Position("m", 0.0)),
    ),
    "sync_write_torque_off_id1": ({}, writes(40, {1: b"\x00"}), (msg.Idle("m"),)),
    "sync_write_middle_id1": ({}, writes(40, {1: b"\x80"}), (msg.Zero("m"),)),
    "sync_write_lock": ({}, writes(55, {1: b"\x01"}), (msg.WriteParameter("m", "Lock", 1.0),)),
    "write_offset_-85_id1": (
        {}, packet(1, WRITE, b"\x1f" + STS.data("Homing_Offset", -85)),
        (msg.WriteParameter("m", "Homing_Offset", -85.0),),
    ),
    "unlock_eeprom": ({}, packet(1, WRITE, b"\x37\x00"), (msg.WriteParameter("m", "Lock", 0.0),)),
    "write_pos_ex_acc50_pos1000_speed1500": (
        {},
        packet(1, WRITE, b"\x29" + b"".join(
            STS.data(name, value) for name, value in (
                ("Acceleration", 50), ("Goal_Position", 1000), ("Goal_Time", 0), ("Goal_Velocity", 1500)
            )
        )),
        (
            msg.Arm("m"), msg.Position("m", (1000 - 2048) * STEP),
            msg.WriteParameter("m", "Acceleration", 50.0),
            msg.WriteParameter("m", "Goal_Time", 0.0), msg.WriteParameter("m", "Goal_Velocity", 1500.0),
        ),
    ),
    "read_motion_id1": ({}, bytes(asks({1: (56, 8)}, "", 0)), ()),
    "read_state_id1": ({}, bytes(asks({1: STS.blocks["state"]}, "", 0)), ()),
    "sync_read_motion": ({}, bytes(asks(dict.fromkeys((1, 2, 3), (56, 8)), "", 0)), ()),
    "scs_goal_position_700": (
        {"model": "scs0009"}, packet(1, WRITE, b"\x2a" + SCS.data("Goal_Position", 700)),
        (msg.Arm("m"), msg.Position("m", math.radians(188 * 300 / 1024))),
    ),
    "scs_sync_write_pos": (
        {"model": "scs0009"},
        writes(42, {1: SCS.data("Goal_Position", 512), 2: SCS.data("Goal_Position", 300)}),
        (msg.Arm("m"), msg.Position("m", 0.0)),
    ),
}  # fmt: skip
"""Options, our bytes, and what a servo with the id 1 obeys that is in the mode already."""


def device(**options: Any) -> Device:
    return Device("m", 1, Options(**options), Settings())


@pytest.mark.parametrize("name", SENT)
def test_bytes_to_a_servo(name: str) -> None:
    options, ours, obeyed = SENT[name]
    assert ours == VECTORS[name].frame
    decoder = plugin.decoder([device(**options)])
    given = device(**options).options
    if "Operating_Mode" in given.set_up:
        decoder.decode(0, writes(33, {1: bytes([given.set_up["Operating_Mode"]])}))
    middle = given.table.data("Goal_Position", given.of.middle)
    if name == "sync_write_torque_on":
        decoder.decode(0, writes(42, {1: middle}))
    decoded = decoder.decode(0, ours)
    assert [type(one) for one in decoded] == [type(one) for one in obeyed]
    for one, other in zip(decoded, obeyed, strict=True):
        for number in ("position", "velocity", "torque", "value"):
            assert getattr(one, number, 0.0) == pytest.approx(getattr(other, number, 0.0), abs=1e-9)


def test_a_block_of_measurements() -> None:
    meant = VECTORS["read_block_56_15"].meaning["result"]
    assert "[0, 8, 150, 128, 200, 4, 121, 36, 0, 0, 1, 0, 0, 25, 0]" in str(meant)
    data = bytes([0, 8, 150, 128, 200, 4, 121, 36, 0, 0, 1, 0, 0, 25, 0])
    assert STS.values(56, data) == {
        "Present_Position": 2048,
        "Present_Velocity": -150,
        "Present_Load": -200,
        "Present_Voltage": 121,
        "Present_Temperature": 36,
        "Async_Write": 0,
        "Status": 0,
        "Moving": 1,
        "Present_Current": 25,
    }


def test_the_error_bits_of_a_status() -> None:
    (one,), whole = PACKETS.in_frame(VECTORS["status_error_overload_voltage"].frame)
    assert whole
    assert [ft.FAULTS[code].name for code in ft.faults_in(one.instruction)] == ["voltage", "overload"]


class Recorder:
    """In the place of the SDK's port."""

    is_using = False

    def __init__(self) -> None:
        self.sent = b""

    def clearPort(self) -> None: ...  # noqa: N802

    def setPacketTimeout(self, size: int) -> None: ...  # noqa: N802

    def writePort(self, data: list[int]) -> int:  # noqa: N802
        self.sent += bytes(data)
        return len(data)


def recorded(order: int, call: Callable[[Any, Recorder], object]) -> bytes:
    port = Recorder()
    call(sdk.PacketHandler(order), port)
    sdk.PacketHandler(0)  # the byte order is a global of its module
    return port.sent


@pytest.mark.parametrize("order", [0, 1])
def test_any_write_is_the_bytes_of_the_sdk(order: int) -> None:
    family, chance = (STS, SCS)[order], random.Random(order)
    for register in family.by_name.values():
        for _ in range(20):
            value = chance.randint(*map(int, register.ends()))
            raw = sdk.scservo_def.SCS_TOSCS(value, register.sign) if register.sign else value
            number = chance.randrange(254)

            def write(
                handler: Any, port: Recorder, n: int = number, r: int = raw, at: Any = register
            ) -> None:
                call = handler.write2ByteTxOnly if at.size == 2 else handler.write1ByteTxOnly
                call(port, n, at.number, r)

            ours = packet(number, WRITE, bytes((register.number,)) + family.data(register.name, value))
            assert ours == recorded(order, write)
            assert family.values(register.number, family.data(register.name, value))[register.name] == value


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="Goal_Velocity"):
        STS.data("Goal_Velocity", value)


@pytest.mark.parametrize(
    "wrong",
    [
        writes(40, {1: b"\x01"})[:-1] + b"\x00",
        packet(1, SYNC_WRITE, bytes((40, 1, 1, 1))),  # it goes to everybody, or to nobody
        packet(EVERYBODY, SYNC_WRITE, bytes((40, 2, 1, 1))),
        packet(EVERYBODY, SYNC_WRITE, bytes((40, 0, 1))),
        packet(EVERYBODY, SYNC_WRITE, bytes((40, 1, 255, 1))),
        packet(1, WRITE, bytes((127, 1, 1))),
        packet(2, WRITE, bytes((40, 1))),
        packet(1, WRITE, bytes((40,))),
    ],
)
def test_what_is_no_write_to_it_is_not_obeyed(wrong: bytes) -> None:
    assert not plugin.decoder([device()]).decode(0, wrong)
