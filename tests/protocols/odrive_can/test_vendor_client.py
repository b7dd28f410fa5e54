"""The client of package odrive-can 2.1.0 drives our twin over a python-can bus.

It waits with its own timers and a thread, so this is one of the few tests on the wall clock: the twin is
stepped by it. Every public call of the client is listed; a new one fails the test.
"""

from __future__ import annotations

import asyncio
import inspect
import time
from collections.abc import Awaitable, Callable
from typing import Any, Generic, TypeVar

import can
import pytest
from odrive_can.odrive import CommandId, DriveError, HeartbeatError, ODriveCAN

from protocols.odrive_can.codec import turns
from protocols.odrive_can.faults import Error
from protocols.odrive_can.options import Settings
from protocols.odrive_can.twin import OdriveTwin
from protocols.odrive_can.twin06 import Twin06
from protocols.wire import CanFrame
from protocols.words import Feedback
from tests.protocols.odrive_can.helpers import device, free_shaft

NODE = 3

# What asks or moves a motor on firmware 0.6, in the order in which it runs; see `drive`.
RUN = {
    "start",
    "wait_for_heartbeat",
    "get_encoder_estimates",
    "get_iq",
    "get_bus_voltage_current",
    "set_limits",
    "set_pos_gain",
    "set_vel_gains",
    "set_traj_vel_limit",
    "set_traj_accel_limits",
    "set_traj_inertia",
    "set_controller_mode",
    "set_input_vel",
    "set_input_pos",
    "set_input_torque",
    "set_axis_state",
    "set_axis_state_no_wait",
    "set_linear_count",
    "clear_errors",
    "reboot",
    "stop",
}
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
# Neither asks nor moves a motor.
LOCAL = {"check_alive", "check_errors", "ignore_message", "allow_message", "axis_id", "axis_state"}


TwinKind = TypeVar("TwinKind", bound=OdriveTwin)
# Without cyclic estimates: the client takes the next frame of the same id for the answer, keeps a second one
# for the next request, and would then read a message that it did not ask for.
SETTINGS = Settings(encoder_msg_rate_ms=0)


class Bench(Generic[TwinKind]):
    """The twin behind a virtual python-can bus, stepped by the wall clock."""

    def __init__(self, channel: str, twin: TwinKind) -> None:
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.twin = twin
        self.shaft = free_shaft()
        self.behind = time.monotonic_ns()

    async def pump(self) -> None:
        """Hand frames over and let the firmware catch up with the clock, a millisecond at a time."""
        while True:
            self.catch_up()
            await asyncio.sleep(0.002)

    def catch_up(self) -> None:
        now = time.monotonic_ns()
        while (message := self.bus.recv(0)) is not None:
            frame = CanFrame(
                message.arbitration_id, bytes(message.data), message.is_extended_id, message.is_remote_frame
            )
            self.twin.receive(self.behind, frame)
        while self.behind < now:
            truth = Feedback("left", self.behind, position=self.shaft.position, velocity=self.shaft.velocity)
            torques, wires = self.twin.step(self.behind, [truth])
            self.shaft.step(torques[0].torque)
            self.behind += 1_000_000
            for wire in wires:
                assert isinstance(wire, CanFrame)
                self.bus.send(can.Message(arbitration_id=wire.id, data=wire.data, is_extended_id=False))


async def until(true: Callable[[], bool], what: str) -> None:
    """Wait at most two seconds of the wall clock."""
    for _ in range(400):
        if true():
            return
        await asyncio.sleep(0.005)
    raise AssertionError(what)


async def drive(bench: Bench[Twin06], client: ODriveCAN, ran: set[str]) -> None:
    """A session with every call of the client that asks or moves a motor."""
    twin, shaft, gains = bench.twin, bench.shaft, bench.twin.servo.gains

    async def call(name: str, *args: object) -> Any:
        ran.add(name)
        answer = getattr(client, name)(*args)
        return await answer if isinstance(answer, Awaitable) else answer

    await call("start")
    await call("wait_for_heartbeat")
    client.check_alive()
    client.check_errors()
    assert client.axis_state == "IDLE"
    assert (await call("get_bus_voltage_current"))["Bus_Voltage"] == pytest.approx(24.0)
    assert (await call("get_iq"))["Iq_Measured"] == 0.0

    await call("set_limits", 35.0, 25.0)
    await call("set_pos_gain", 19.0)
    await call("set_vel_gains", 0.15, 0.3)
    await call("set_traj_vel_limit", 12.0)
    await call("set_traj_accel_limits", 30.0, 31.0)
    await call("set_traj_inertia", 0.001)
    await until(lambda: gains.inertia == pytest.approx(0.001), "the gains arrive")
    told = (
        gains.vel_limit,
        gains.current_soft_max,
        gains.pos_gain,
        gains.vel_gain,
        gains.vel_integrator_gain,
    )
    assert told == pytest.approx((35.0, 25.0, 19.0, 0.15, 0.3))
    assert (gains.trap_vel_limit, gains.trap_accel_limit, gains.trap_decel_limit) == (12.0, 30.0, 31.0)

    await call("set_controller_mode", "VELOCITY_CONTROL", "PASSTHROUGH")
    await call("set_input_vel", 0.0)
    await call("set_axis_state", "CLOSED_LOOP_CONTROL")
    await call("set_input_vel", 5.0, 0.0)
    await until(lambda: abs(turns(shaft.velocity) - 5.0) < 0.02, "velocity is reached")
    assert (await call("get_encoder_estimates"))["Vel_Estimate"] == pytest.approx(5.0, abs=0.2)

    await call("set_controller_mode", "POSITION_CONTROL", "PASSTHROUGH")
    goal = turns(shaft.position) + 2.0
    await call("set_input_pos", goal, 0.0, 0.0)
    await until(lambda: abs(turns(shaft.position) - goal) < 0.02, "position is reached")

    await call("set_input_torque", 0.0)
    await call("set_controller_mode", "TORQUE_CONTROL", "PASSTHROUGH")
    shaft.velocity, shaft.held = 0.0, True
    await call("set_input_torque", 0.1)
    await until(lambda: abs(twin.servo.torque() - 0.1) < 1e-3, "torque is given")
    assert (await call("get_iq"))["Iq_Measured"] == pytest.approx(0.1 * 270 / 8.27, rel=0.01)

    twin.trip(Error.ESTOP_REQUESTED)
    await call("wait_for_heartbeat")
    with pytest.raises(DriveError, match="ESTOP_REQUESTED"):
        client.check_errors()
    await call("clear_errors")
    await until(lambda: not twin.errors, "errors are cleared")
    await call("set_axis_state_no_wait", "CLOSED_LOOP_CONTROL")
    await until(lambda: twin.axis.armed, "it arms again")
    await call("set_axis_state_no_wait", "IDLE")
    await until(lambda: not twin.axis.armed, "it disarms")
    await call("set_linear_count", 4.25)
    await until(lambda: abs(twin.servo.position - 4.25) < 1e-3, "the position is called anew")

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
    await until(lambda: bench.behind > twin.initializing_until, "it is back")
    await call("wait_for_heartbeat")
    await call("set_axis_state_no_wait", "CLOSED_LOOP_CONTROL")
    await until(lambda: twin.axis.armed, "it arms after the restart")
    await asyncio.to_thread(client.stop)
    ran.add("stop")
    await until(lambda: not twin.axis.armed, "stop disarms")


async def call_other(client: ODriveCAN, name: str, args: tuple[Any, ...]) -> None:
    answer = getattr(client, name)(*args)
    if isinstance(answer, Awaitable):
        await answer


def test_the_client_s_public_calls_are_all_known() -> None:
    public = {name for name, _ in inspect.getmembers(ODriveCAN) if not name.startswith("_")}
    assert public == RUN | set(OTHER_LINE) | LOCAL


@pytest.mark.timeout(30)
def test_the_client_drives_the_twin() -> None:
    ran: set[str] = set()

    async def session() -> None:
        bench = Bench("odrive-can-client", Twin06(device(address=NODE, settings=SETTINGS), 0))
        client = ODriveCAN(axis_id=NODE, can_bus=can.Bus(interface="virtual", channel="odrive-can-client"))
        pump = asyncio.create_task(bench.pump())
        try:
            await drive(bench, client, ran)
        finally:
            client._running = False
            pump.cancel()
            bench.bus.shutdown()
            client._bus.shutdown()

    asyncio.run(session())
    assert ran == RUN
