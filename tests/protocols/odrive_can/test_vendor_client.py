"""The client of package odrive-can 2.1.0 drives our twin over a python-can bus.

One of the few tests on the wall clock (`vendor` has the reason). A public call that is new in the client
fails the test.
"""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Awaitable
from typing import Any

import pytest
from odrive_can.odrive import CommandId, HeartbeatError, ODriveCAN

from protocols.odrive_can.firmware import Twin06
from tests.protocols.odrive_can.helpers import device
from tests.protocols.odrive_can.vendor import NODE, SETTINGS, Session, hold, until

# Calls for messages of firmware 0.5 that the client's own DBC for 0.6 does not have: KeyError in the client.
OTHER_LINE: dict[str, tuple[Any, ...]] = {
    "get_motor_error": (),
    "get_encoder_error": (),
    "get_sensorless_error": (),
    "get_encoder_count": (),
    "get_sensorless_estimates": (),
    "get_adc_voltage": (),
    "get_controller_error": (),
    "set_axis_node_id": (5,),
}
# Neither requests anything nor moves a motor.
LOCAL = {"check_alive", "check_errors", "ignore_message", "allow_message", "axis_id", "axis_state"}
PUBLIC = {name for name, _ in inspect.getmembers(ODriveCAN) if not name.startswith("_")}
RUN = PUBLIC - set(OTHER_LINE) - LOCAL


async def drive(session: Session[Twin06]) -> None:
    """A session with every call of the client that requests something or moves a motor."""
    bench, client, twin, call = session.bench, session.client, session.bench.twin, session.call
    await session.begin()
    assert (await call("get_iq"))["Iq_Measured"] == 0.0
    await session.set_gains()
    await session.steer()

    twin.trip(twin.raised["ESTOP_REQUESTED"])
    await until(lambda: "ESTOP_REQUESTED" in session.error(), "the client sees the error")
    await call("clear_errors")
    await until(lambda: not twin.words, "errors are cleared")
    await session.arm_again()
    await call("set_linear_count", 4.25)
    await until(lambda: abs(twin.servo.encoder.position - 4.25) < 1e-3, "the position is called anew")

    for name, args in OTHER_LINE.items():
        with pytest.raises(KeyError):
            await call_other(client, name, args)
    client.ignore_message(CommandId.ENCODER_ESTIMATE)
    client.allow_message(CommandId.ENCODER_ESTIMATE)

    await call("reboot")
    await until(lambda: bench.behind < twin.silent_until, "it restarts")
    await asyncio.sleep(0.55)
    with pytest.raises(HeartbeatError):
        client.check_alive()
    await until(lambda: bench.behind > twin.starts_until, "it is back")
    await session.end()


async def call_other(client: ODriveCAN, name: str, args: tuple[Any, ...]) -> None:
    answer = getattr(client, name)(*args)
    if isinstance(answer, Awaitable):
        await answer


def test_the_client_drives_the_twin() -> None:
    twin = Twin06(device(address=NODE, settings=SETTINGS), 0)
    assert hold("odrive-can-client", twin, drive) == RUN
