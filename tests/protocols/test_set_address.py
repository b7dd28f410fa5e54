"""SetAddress: the bytes that give a device another address, both ways, and what independent clients send for
it. That a device is found there, and that an address which another one has is refused, is the contract's."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import can
import pytest
from damiao_motor.core.motor import DaMiaoMotor
from robstride.client import Client

from protocols import messages as msg
from protocols.conformance.bench import make_bench
from protocols.frames import CanFrame
from protocols.messages import Event
from protocols.plugin import Device, load

ROWS: tuple[tuple[str, dict[str, Any], int, int, tuple[str, ...]], ...] = (
    # Set_Axis_Node_ID: protocols/odrive_can/vectors.json, set_axis_node_id05_5 (odrive-can 2.1.0)
    ("odrive_can", {"firmware": "0.5"}, 3, 5, ("066#0500000000000000",)),
    # MST_ID, then ESC_ID; with an MST_ID of one's own, ESC_ID alone
    ("damiao", {}, 1, 5, ("7FF#0100550715000000", "7FF#0100550805000000")),
    ("damiao", {"reply_id": 0x123}, 1, 5, ("7FF#0100550805000000",)),
    # type 7: robstride 0.1.0, below
    ("robstride", {}, 1, 5, ("0705FD01#0000000000000000",)),
    # 79h, and 76h: where a motor takes it when it is restarted (vendor's manual V4.2)
    ("myactuator", {}, 1, 5, ("141#7900000000000500", "141#7600000000000000")),
)


def shown(frame: CanFrame) -> str:
    return f"{frame.id:0{8 if frame.extended else 3}X}#{frame.data.hex()}"


def parsed(text: str) -> CanFrame:
    number, _, data = text.partition("#")
    return CanFrame(int(number, 16), bytes.fromhex(data), extended=len(number) == 8)


@pytest.mark.parametrize(("protocol", "options", "address", "new", "frames"), ROWS)
def test_the_bytes_both_ways(
    protocol: str, options: dict[str, Any], address: int, new: int, frames: tuple[str, ...]
) -> None:
    plugin = load(protocol)
    bench = make_bench(plugin, plugin.options(**options), (address,), ("motor",))
    bench.steps(500)
    steps = [bench.step([msg.SetAddress("motor", new)]), *bench.steps(2500)]
    written = [
        frame
        for step in steps
        for frame in step.down
        if isinstance(frame, CanFrame) and not bench.specs[0].read_only(frame)
    ]
    assert tuple(map(shown, written)) == frames
    events: list[Event] = [event for step in steps for event in step.events]
    assert [event.request for event in events if isinstance(event, msg.Done)] == ["SetAddress"]
    decoder = plugin.decoder([Device("motor", address, plugin.options(**options), plugin.settings())])
    obeyed = [one for text in frames for one in decoder.decode(0, parsed(text))]
    assert msg.SetAddress("motor", new) in obeyed
    assert not [one for one in obeyed if isinstance(one, msg.Arm)]


@pytest.mark.parametrize(
    ("new", "why"),
    [
        (1, "it answers at 1 already"),
        (2, "address 2 is that of other"),
        (3, "another device has address 3"),
        (99, "99 is not an address: 1 to 15"),
    ],
)
def test_an_address_that_is_not_free_is_refused_and_nothing_is_written(new: int, why: str) -> None:
    plugin = load("damiao")
    bench = make_bench(plugin, plugin.options(), (1, 2, 3), ("motor", "other", "stranger"))
    bench.driver = plugin.driver(bench.devices[:2])
    bench.steps(200)
    steps = [bench.step([msg.SetAddress("motor", new)]), *bench.steps(2500)]
    refused = [e for step in steps for e in step.events if isinstance(e, msg.Refused)]
    assert [one.reason for one in refused] == [why]
    assert all(bench.specs[0].read_only(frame) for step in steps for frame in step.down)


def test_one_that_does_not_take_it_is_told() -> None:
    plugin = load("robstride")
    bench = make_bench(plugin, plugin.options(), (1,), ("motor",))
    bench.steps(200)
    bench.twins.clear()
    steps = [bench.step([msg.SetAddress("motor", 5)]), *bench.steps(4000)]
    (refused,) = [e for step in steps for e in step.events if isinstance(e, msg.Refused)]
    assert refused.reason == "it was sent, and nothing is heard at address 5"


# -- what others send ------------------------------------------------------------------------------------


@dataclass
class Wire:
    """A python-can bus that keeps what is sent."""

    sent: list[str] = field(default_factory=list)

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        frame = CanFrame(message.arbitration_id, bytes(message.data), extended=message.is_extended_id)
        self.sent.append(shown(frame))

    def recv(self, timeout: float | None = None) -> can.Message:
        return can.Message(arbitration_id=0x5FE, data=bytes(8), is_extended_id=True)


def test_robstride_gives_an_address_by_the_same_bytes() -> None:
    wire = Wire()
    Client(wire, host_can_id=0xFD).update_id(1, 5)
    assert tuple(wire.sent) == ROWS[3][-1]


def test_damiao_motor_gives_an_address_by_the_same_bytes() -> None:
    wire = Wire()
    motor = DaMiaoMotor(1, 0x11, wire, motor_type="4310")
    motor.write_register(7, 0x15)
    motor.write_register(8, 5)
    assert tuple(wire.sent) == ROWS[1][-1]
