"""A session of package odrive-can 2.1.0's client with one of our twins, over a virtual python-can bus.

The client waits with its own timers and a thread, so the twin is stepped by the wall clock. Here stands what
a session does in the dialect of either firmware line.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import can
import pytest
from odrive_can.odrive import DriveError, HeartbeatError, ODriveCAN

from protocols.frames import CanFrame
from protocols.messages import Feedback
from protocols.odrive_can.firmware import OdriveTwin
from protocols.odrive_can.options import Settings
from tests.protocols.odrive_can.helpers import free_shaft

NODE = 3
MOST = 10_000_000
"""ns that pass for the twin in one turn, at most."""
TwinKind = TypeVar("TwinKind", bound=OdriveTwin)
# Without cyclic estimates: the client takes the next frame of the same id for the answer, keeps a second one
# for the next request, and would then read a message that it did not request.
SETTINGS = Settings(encoder_msg_rate_ms=0)


class Bench(Generic[TwinKind]):
    """The twin behind a virtual python-can bus, stepped by the wall clock; in slow motion on a busy machine:
    no time passes for it in which the client did not run."""

    def __init__(self, channel: str, twin: TwinKind) -> None:
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.twin = twin
        self.shaft = free_shaft()
        self.behind = time.monotonic_ns()
        self.lost = 0
        """ns of the wall clock that did not pass here."""

    async def pump(self) -> None:
        """Hand frames over and let the firmware catch up with the clock, a millisecond at a time."""
        while True:
            self.catch_up()
            await asyncio.sleep(0.002)

    def catch_up(self) -> None:
        self.lost = max(self.lost, time.monotonic_ns() - self.behind - MOST)
        now = time.monotonic_ns() - self.lost
        while (message := self.bus.recv(0)) is not None:
            frame = CanFrame(
                message.arbitration_id, bytes(message.data), message.is_extended_id, message.is_remote_frame
            )
            self.twin.receive(self.behind, frame)
        while self.behind < now:
            truth = Feedback("left", self.behind, position=self.shaft.position, velocity=self.shaft.velocity)
            torques, frames = self.twin.step(self.behind, [truth])
            self.shaft.turn(torques[0].torque, 1_000_000)
            self.behind += 1_000_000
            for raw in frames:
                assert isinstance(raw, CanFrame)
                self.bus.send(can.Message(arbitration_id=raw.id, data=raw.data, is_extended_id=False))


async def until(true: Callable[[], bool], what: str) -> None:
    """Wait, with the twin, at most for 2,000 of its turns."""
    for _ in range(2_000):
        if true():
            return
        await asyncio.sleep(0.005)
    raise AssertionError(what)


@dataclass
class Session(Generic[TwinKind]):
    """The client, the twin, and which of its calls the client has made."""

    bench: Bench[TwinKind]
    client: ODriveCAN
    ran: set[str] = field(default_factory=set)

    async def call(self, name: str, *args: object) -> Any:
        """Call the client by name, and wait where that is what it does; again if that was
        too short for a busy machine."""
        self.ran.add(name)
        for _ in range(100):
            answer = getattr(self.client, name)(*args)
            with suppress(TimeoutError):
                return await answer if isinstance(answer, Awaitable) else answer
        raise AssertionError(f"{name} is not answered")

    def error(self) -> str:
        """What the client says of the last heartbeat, which may be one from before an error."""
        try:
            self.client.check_errors()
        except DriveError as error:
            return str(error)
        return ""

    async def begin(self) -> None:
        """Receive frames of a device without errors, idle, on 24 V."""
        await self.call("start")
        for _ in range(100):
            await self.call("wait_for_heartbeat")
            with suppress(HeartbeatError):  # it is older than half a second by now
                self.client.check_alive()
                break
        self.client.check_errors()
        assert self.client.axis_state == "IDLE"
        assert (await self.call("get_bus_voltage_current"))["Bus_Voltage"] == pytest.approx(24.0)

    async def set_gains(self) -> None:
        """Gains and limits arrive at the device."""
        gains = self.bench.twin.servo.gains
        await self.call("set_limits", 35.0, 25.0)
        await self.call("set_pos_gain", 19.0)
        await self.call("set_vel_gains", 0.15, 0.3)
        await self.call("set_traj_vel_limit", 12.0)
        await self.call("set_traj_accel_limits", 30.0, 31.0)
        await self.call("set_traj_inertia", 0.001)
        await until(lambda: gains["inertia"] == pytest.approx(0.001), "the gains arrive")
        reported = (gains["vel_limit"], gains["current_soft_max"], gains["pos_gain"], gains["vel_gain"])
        assert (*reported, gains["vel_integrator_gain"]) == pytest.approx((35.0, 25.0, 19.0, 0.15, 0.3))
        assert (gains["trap_vel_limit"], gains["trap_accel_limit"], gains["trap_decel_limit"]) == (
            12.0,
            30.0,
            31.0,
        )

    async def steer(self) -> None:
        """A velocity, a position, and a torque on a shaft that is held."""
        servo, shaft = self.bench.twin.servo, self.bench.shaft
        await self.call("set_controller_mode", "VELOCITY_CONTROL", "PASSTHROUGH")
        await self.call("set_input_vel", 0.0)
        await self.call("set_axis_state", "CLOSED_LOOP_CONTROL")
        await self.call("set_input_vel", 5.0, 0.0)
        await until(lambda: abs(shaft.velocity / math.tau - 5.0) < 0.02, "velocity is reached")
        assert (await self.call("get_encoder_estimates"))["Vel_Estimate"] == pytest.approx(5.0, abs=0.2)

        await self.call("set_controller_mode", "POSITION_CONTROL", "PASSTHROUGH")
        goal = shaft.position / math.tau + 2.0
        await self.call("set_input_pos", goal, 0.0, 0.0)
        await until(lambda: abs(shaft.position / math.tau - goal) < 0.02, "position is reached")

        await self.call("set_input_torque", 0.0)
        await self.call("set_controller_mode", "TORQUE_CONTROL", "PASSTHROUGH")
        shaft.velocity, shaft.locked = 0.0, True
        await self.call("set_input_torque", 0.1)
        await until(lambda: abs(servo.stage.torque - 0.1) < 1e-3, "torque is given")
        assert (await self.call("get_iq"))["Iq_Measured"] == pytest.approx(0.1 * 270 / 8.27, rel=0.01)

    async def arm_again(self) -> None:
        """Armed and let go, without waiting for either."""
        axis = self.bench.twin.memory
        await self.call("set_axis_state_no_wait", "CLOSED_LOOP_CONTROL")
        await until(lambda: axis.armed, "it arms again")
        await self.call("set_axis_state_no_wait", "IDLE")
        await until(lambda: not axis.armed, "it disarms")

    async def end(self) -> None:
        """After a restart it arms, and the client's stop disarms."""
        axis = self.bench.twin.memory
        await self.call("wait_for_heartbeat")
        await self.call("set_axis_state_no_wait", "CLOSED_LOOP_CONTROL")
        await until(lambda: axis.armed, "it arms after the restart")
        await asyncio.to_thread(self.client.stop)
        self.ran.add("stop")
        await until(lambda: not axis.armed, "stop disarms")


def hold(channel: str, twin: TwinKind, drive: Callable[[Session[TwinKind]], Awaitable[None]]) -> set[str]:
    """Hold a session; the calls that the client made."""

    async def session() -> set[str]:
        bench = Bench(channel, twin)
        client = ODriveCAN(axis_id=NODE, can_bus=can.Bus(interface="virtual", channel=channel))
        held = Session(bench, client)
        pump = asyncio.create_task(bench.pump())
        try:
            await drive(held)
        finally:
            client._running = False
            pump.cancel()
            bench.bus.shutdown()
            client._bus.shutdown()
        return held.ran

    return asyncio.run(session())
