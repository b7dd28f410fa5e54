"""Values ↔ bytes, both ways: those of the vendor's SDK."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from protocols import messages as msg
from protocols.dynamixel import packets as dx
from protocols.dynamixel import plugin
from protocols.dynamixel.options import Options, Settings
from protocols.dynamixel.packets import PACKETS
from protocols.plugin import Device
from protocols.reference_vectors import Vector, vectors_of
from protocols.toolkit.serial import Stream
from protocols.toolkit.servo_packets import EVERYBODY, WRITE

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
SOUND = [vector for vector in VECTORS.values() if not vector.wrong]
CODES = {name.upper(): code for code, name in dx.NAMES.items()}


def data_of(vector: Vector) -> bytes:
    assert isinstance(vector.frame, bytes)
    return vector.frame


def parameters(cmd: str, meaning: dict[str, Any]) -> bytes:
    """Build the parameters of an instruction from what it means, by the layout of the e-Manual."""
    if cmd in ("SYNC_READ", "FAST_SYNC_READ"):
        return struct.pack("<HH", meaning["addr"], meaning["len"]) + bytes(meaning["ids"])
    if cmd in ("BULK_READ", "FAST_BULK_READ"):
        return b"".join(struct.pack("<BHH", int(each), *at) for each, at in meaning["reads"].items())
    if cmd == "READ":
        return struct.pack("<HH", meaning["addr"], meaning["len"])
    if cmd == "SYNC_WRITE":
        given = meaning.get("data") or meaning["goals"]
        each = {int(a): v if isinstance(v, int) else bytes.fromhex(v) for a, v in given.items()}
        length = meaning["len"]
        raw = {
            a: v if isinstance(v, bytes) else v.to_bytes(length, "little", signed=v < 0)
            for a, v in each.items()
        }
        return struct.pack("<HH", meaning["addr"], length) + b"".join(bytes((a,)) + d for a, d in raw.items())
    return b""


@pytest.mark.parametrize("vector", SOUND, ids=lambda vector: vector.name)
def test_each_is_one_packet_and_made_again(vector: Vector) -> None:
    (message,) = Stream(PACKETS.framing).messages(data_of(vector))
    one = PACKETS.unpacked(message)
    assert PACKETS.packet(one.id, one.instruction, one.data) == data_of(vector)
    cmd = str(vector.meaning.get("cmd", ""))
    if vector.direction == "to_device":
        assert one.instruction == CODES[cmd]
        if made := parameters(cmd, dict(vector.meaning)):
            assert one.data == made
    else:
        assert one.instruction == dx.STATUS


def test_what_the_sdk_does_not_stuff_is_no_packet() -> None:
    (wrong,) = (vector for vector in VECTORS.values() if vector.wrong and vector.direction == "to_device")
    assert Stream(PACKETS.framing).messages(data_of(wrong)) == []
    right = PACKETS.packet(1, WRITE, bytes.fromhex("7400fffffd00"))
    assert right.hex() == "fffffd00010a00037400fffffdfd00" + dx.CRC(right[:-2]).to_bytes(2, "little").hex()


OBEYED: dict[str, list[Any]] = {
    "sync_write_goal_velocity": [
        msg.Velocity("one", 100 * 0.0239691227),
        msg.Velocity("two", -230 * 0.0239691227),
    ],
    "sync_write_torque_enable": [msg.Arm("one"), msg.Velocity("one", 0.0), msg.Idle("two")],
    "sync_write_bus_watchdog": [
        msg.WriteParameter("one", "Bus_Watchdog", 5), msg.WriteParameter("two", "Bus_Watchdog", 0)
    ],
    "reboot_id1": [msg.Idle("one"), msg.ClearFault("one")],
    "factory_reset": [msg.Kept("one", "factory_reset", 1.0)],
    "sync_read_motion_12": [],
}  # fmt: skip


@pytest.mark.parametrize("name", OBEYED)
def test_what_devices_obey(name: str) -> None:
    options = Options(model="XM540-W150")
    devices = [Device(each, at, options, Settings()) for at, each in enumerate(("one", "two"), 1)]
    decoder = plugin.decoder(devices)
    if "velocity" in name:
        decoder.decode(0, PACKETS.sync_write(64, {1: b"\1", 2: b"\1"}))
    assert list(decoder.decode(0, VECTORS[name].frame)) == OBEYED[name]


@pytest.mark.parametrize("broken", range(1, 4))
def test_blocks_of_a_fast_answer_up_to_where_it_breaks(broken: int) -> None:
    wanted = dict.fromkeys((1, 2, 3), (126, 10))
    whole, ends = dx.HEADER + bytes((EVERYBODY, 43, 0, dx.STATUS)), list[int]()
    for each in wanted:
        whole += bytes((0, each)) + bytes([each] * 10)
        whole += dx.CRC(whole).to_bytes(2, "little")
        ends.append(len(whole))
    asked = PACKETS.question(PACKETS.chained(wanted, "", 0, fast=True))
    found, rest = PACKETS.answered(wanted, asked, whole[: ends[broken - 1]])
    assert ([number for number, _, _ in found], rest) == ([1, 2, 3][:broken], b"")
    assert found[-1][1:] == (0, bytes([broken] * 10))
    damaged = bytearray(whole)
    damaged[ends[broken - 1] - 3] ^= 0x10
    assert [one[0] for one in PACKETS.answered(wanted, asked, bytes(damaged))[0]] == [1, 2, 3][: broken - 1]
    if broken == 3:
        assert Stream(PACKETS.framing).messages(whole) == [whole[:-2]]  # to the SDK it is one packet
