"""The vendor's `Controller` and `Transport` (package moteus 1.1.1) drive our twins over a python-can bus.

They wait on the wall clock, so these are some of the few tests on it: the twins are stepped by a task beside
them, a virtual millisecond at a time, as fast as frames come. Nothing here depends on how fast that is. Every
public call of the Controller is listed; a new one fails the test.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import can
import moteus
import pytest
from moteus import Mode, Register
from moteus import multiplex as mp
from moteus.device_info import DeviceAddress
from moteus.pythoncan_device import PythonCanDevice
from moteus.transport import Transport

from protocols.conformance.bench import Shaft
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Feedback
from protocols.moteus import plugin
from protocols.plugin import Device
from tests.gateway.processes import PATIENCE

CHANNEL = "moteus-vendor"
UUIDS = ("0123456789abcdeffedcba9876543210", "0123456789abcdef0011223344556677")
TIMEOUT = 2.0
"""s without a command until a twin's watchdog trips: virtual ones, of which no more pass than real ones."""
TRIES = 100
"""Searches until devices are found: each ends after some tenths of a second, whatever the machine does."""

# Calls that ask or move a motor, and run in `drive` or `dialogue`.
RAN = {
    "query",
    "custom_query",
    "set_stop",
    "set_position",
    "set_position_wait_complete",
    "set_current",
    "set_vfoc",
    "set_stay_within",
    "set_zero_velocity",
    "set_brake",
    "set_output",
    "set_output_nearest",
    "set_output_exact",
    "set_rezero",
    "set_require_reindex",
    "set_recapture_position_velocity",
    "send_diagnostic_write",
    "diagnostic_read",
    "diagnostic_read_flow",
    "flush_transport",
    "execute",
}
# Pins, PWM outputs and clock of the device: our twin has none and answers with an error, or not.
NONE_HERE = {"set_write_gpio", "read_gpio", "set_trim", "set_aux_pwm"}


class Bus:
    """The twins behind a virtual python-can bus."""

    def __init__(self) -> None:
        self.bus = can.Bus(interface="virtual", channel=CHANNEL, fd=True)
        self.now = 1_000_000 * MILLISECOND
        self.shafts = {name: Shaft(inertia=1.2e-4, friction=1e-3) for name in ("m5", "m6")}
        settings = [plugin.settings(uuid=uuid, default_timeout_s=TIMEOUT) for uuid in UUIDS]
        self.twins = {
            "m5": plugin.twin(Device("m5", 5, plugin.options(), settings[0]), 0),
            "m6": plugin.twin(Device("m6", 6, plugin.options(), settings[1]), 0),
        }

    def step(self) -> None:
        """A virtual millisecond."""
        while (message := self.bus.recv(0)) is not None:
            frame = CanFrame(
                message.arbitration_id,
                bytes(message.data),
                message.is_extended_id,
                fd=message.is_fd,
                brs=message.bitrate_switch,
            )
            for twin in self.twins.values():
                twin.receive(self.now, frame)
        for name, twin in self.twins.items():
            shaft = self.shafts[name]
            truth = Feedback(name, self.now, shaft.position, shaft.velocity)
            torques, frames = twin.step(self.now, [truth])
            shaft.turn(torques[0].torque, MILLISECOND)
            for raw in frames:
                assert isinstance(raw, CanFrame)
                self._send(raw)
        self.now += MILLISECOND

    def _send(self, frame: CanFrame) -> None:
        self.bus.send(
            can.Message(
                arbitration_id=frame.id,
                data=frame.data,
                is_extended_id=frame.extended,
                is_fd=frame.fd,
                bitrate_switch=frame.brs,
            )
        )

    async def pump(self) -> None:
        while True:
            self.step()
            await asyncio.sleep(0.0005)


@pytest.fixture
def bus() -> Iterator[Bus]:
    made = Bus()
    yield made
    made.bus.shutdown()


def _in(mode: Mode) -> Callable[[Any], bool]:
    return lambda values: bool(values[Register.MODE] == mode)


def session(bus: Bus, talk: Callable[[Transport], Awaitable[None]]) -> None:
    """A conversation with the twins, with the twins running beside it."""

    async def run() -> None:
        transport = Transport([PythonCanDevice(interface="virtual", channel=CHANNEL, fd=True)])
        pump = asyncio.create_task(bus.pump())
        try:
            await asyncio.wait_for(talk(transport), PATIENCE)
            assert not pump.done()
        finally:
            pump.cancel()
            transport.close()

    asyncio.run(run())


async def until(state: Callable[[], Awaitable[Any]], true: Callable[[Any], bool]) -> Any:
    """Query until it is so."""
    for _ in range(2000):
        reported = await state()
        if true(reported.values):
            return reported
    raise AssertionError(f"in 2000 answers not: {reported}")


def test_every_public_call_of_the_controller_is_known() -> None:
    calls = {
        name
        for name in vars(moteus.Controller)
        if not name.startswith(("_", "make_")) and callable(getattr(moteus.Controller, name))
    }
    assert calls == RAN | NONE_HERE


def test_the_controller_drives_a_twin(bus: Bus) -> None:
    shaft = bus.shafts["m5"]

    async def drive(transport: Transport) -> None:
        c = moteus.Controller(id=5, transport=transport)
        reported = await c.query()
        assert reported.id == 5
        assert (reported.values[Register.MODE], reported.values[Register.FAULT]) == (Mode.STOPPED, 0)
        assert reported.values[Register.VOLTAGE] == pytest.approx(24.0, abs=0.5)
        position: Callable[[], Awaitable[Any]] = lambda: c.set_position(position=0.5, query=True)  # noqa: E731
        reported = await until(position, lambda v: abs(v[Register.POSITION] - 0.5) < 0.02)
        assert reported.values[Register.MODE] == Mode.POSITION
        turning: Callable[[], Awaitable[Any]] = lambda: c.set_position(  # noqa: E731
            position=math.nan, velocity=1.5, maximum_torque=1.0, query=True
        )
        await until(turning, lambda v: abs(v[Register.VELOCITY] - 1.5) < 0.05)
        await c.set_position_wait_complete(position=0.25, velocity_limit=2.0, accel_limit=20.0)
        assert abs(shaft.position - 0.25 * math.tau) < 0.05 * math.tau
        c.position_resolution.position = mp.INT16
        await c.set_position(position=0.3, velocity=0.0, query=True)
        c.position_resolution.position = mp.F32
        reported = await c.custom_query({Register.COMMAND_POSITION: mp.F32})
        assert reported.values[Register.COMMAND_POSITION] == pytest.approx(0.3, abs=1.1e-4)  # it truncates
        shaft.locked, shaft.velocity = True, 0.0
        pushing: Callable[[], Awaitable[Any]] = lambda: c.set_position(  # noqa: E731
            position=math.nan,
            kp_scale=0.0,
            kd_scale=0.0,
            ilimit_scale=0.0,  # else what the integrator has gathered goes on pushing
            feedforward_torque=0.125,
            query=True,
        )
        await until(pushing, lambda v: abs(v[Register.TORQUE] - 0.125) < 1e-3)
        await c.set_recapture_position_velocity()
        current: Callable[[], Awaitable[Any]] = lambda: c.set_current(q_A=2.0, d_A=0.0, query=True)  # noqa: E731
        await until(current, lambda v: v[Register.MODE] == Mode.CURRENT)
        reported = await c.custom_query({Register.COMMAND_Q_CURRENT: mp.F32})
        assert reported.values[Register.COMMAND_Q_CURRENT] == 2.0
        shaft.locked = False
        calls: list[tuple[Callable[[], Awaitable[Any]], Mode]] = [
            (lambda: c.set_stay_within(lower_bound=-9.0, upper_bound=9.0, query=True), Mode.STAY_WITHIN),
            (lambda: c.set_vfoc(theta=0.0, voltage=0.5, query=True), Mode.VOLTAGE_FOC),
            (lambda: c.set_zero_velocity(query=True), Mode.ZERO_VELOCITY),
            (lambda: c.set_brake(query=True), Mode.BRAKE),
            (lambda: c.set_stop(query=True), Mode.STOPPED),
        ]
        for call, mode in calls:
            await until(call, _in(mode))
        await c.set_output_exact(position=3.0, query=True)
        assert (await c.query()).values[Register.POSITION] == pytest.approx(3.0, abs=0.01)
        await c.set_output_nearest(position=1.0)
        await c.set_rezero(rezero=0.5)
        await c.set_output(position=0.25, cmd=Register.SET_OUTPUT_EXACT, query=True)
        await c.set_require_reindex()
        wanted = {Register.HOME_STATE: mp.INT8, Register.MILLISECOND_COUNTER: mp.INT32}
        reported = await c.custom_query(wanted)
        assert reported.values[Register.HOME_STATE] == 0

    session(bus, drive)


def test_faults_and_timeouts_are_seen_and_left_by_a_stop(bus: Bus) -> None:
    twin = bus.twins["m5"]

    async def drive(transport: Transport) -> None:
        c = moteus.Controller(id=5, transport=transport)
        held: Callable[[], Awaitable[Any]] = lambda: c.set_position(position=0.0, query=True)  # noqa: E731
        await until(held, lambda v: v[Register.MODE] == Mode.POSITION)
        twin.provoke(38)
        reported = await until(held, lambda v: v[Register.MODE] == Mode.FAULT)
        assert reported.values[Register.FAULT] == 38
        with pytest.raises(moteus.FaultError, match="code=38"):
            await c.set_position_wait_complete(position=0.0)
        await c.set_stop()
        await until(c.query, lambda v: v[Register.MODE] == Mode.STOPPED)
        await c.set_position(position=0.0, watchdog_timeout=0.02)
        await until(c.query, lambda v: v[Register.MODE] == Mode.TIMEOUT)
        await until(held, lambda v: v[Register.MODE] == Mode.TIMEOUT)  # it latches
        await c.set_stop()
        await until(c.query, lambda v: v[Register.MODE] == Mode.STOPPED)

    session(bus, drive)


def test_limits_scales_and_bounds_of_a_command(bus: Bus) -> None:
    shaft, nowhere = bus.shafts["m5"], math.nan

    async def drive(transport: Transport) -> None:
        c = moteus.Controller(id=5, transport=transport)
        velocity = {Register.CONTROL_VELOCITY: mp.F32}

        async def reached(command: Any, true: Callable[[Any], bool], query: Any = None) -> None:
            """Give a command until it is so."""

            async def given() -> Any:
                await transport.cycle([command])
                return await (c.query() if query is None else c.custom_query(query))

            await until(given, true)

        turning = c.make_position(position=nowhere, velocity=3.0, velocity_limit=1.5, accel_limit=50.0)
        await reached(turning, lambda v: v[Register.CONTROL_VELOCITY] == 1.5, velocity)
        shaft.locked, shaft.position, shaft.velocity = True, 0.0, 0.0
        soft: dict[str, Any] = {"kp_scale": 0.5, "kd_scale": 0.25, "ilimit_scale": 0.0, "query": True}
        await reached(c.make_position(position=0.05, **soft), lambda v: abs(v[Register.TORQUE] - 0.25) < 1e-3)
        shaft.velocity = 0.5 * math.tau  # kd is not limited by kp
        damped = c.make_position(position=nowhere, **{**soft, "kp_scale": 0.0}, velocity=0.0)
        await reached(damped, lambda v: abs(v[Register.TORQUE] + 0.05) < 1e-3)
        slow = c.make_zero_velocity(kd_scale=0.5, query=True)
        await reached(slow, lambda v: abs(v[Register.TORQUE] + 0.1) < 1e-3)
        pushed: dict[str, Any] = {"feedforward_torque": 0.125, "watchdog_timeout": 0.05}
        free = c.make_stay_within(lower_bound=nowhere, upper_bound=nowhere, **pushed)
        await reached(free, lambda v: abs(v[Register.TORQUE] - 0.125) < 1e-3)
        await until(c.query, lambda v: v[Register.MODE] == Mode.TIMEOUT)
        await until(c.query, lambda v: abs(v[Register.TORQUE] + 0.2) < 1e-3)  # it damps
        await c.set_stop()
        shaft.velocity, shaft.position = 0.0, -0.5 * math.tau
        within = c.make_stay_within(lower_bound=-0.45, upper_bound=nowhere, maximum_torque=0.3)
        await reached(within, lambda v: abs(v[Register.TORQUE] - 0.3) < 1e-3)
        stopping = c.make_position(position=nowhere, velocity=-1.0, stop_position=1.0, velocity_limit=-1.0)
        await reached(stopping, lambda v: v[Register.CONTROL_VELOCITY] == 1.0, velocity)
        await c.set_position(position=nowhere, stop_position=1.0, accel_limit=1.0)
        await until(c.query, lambda v: (v[Register.MODE], v[Register.FAULT]) == (Mode.FAULT, 45))

    session(bus, drive)


def test_discovery_and_uuids(bus: Bus) -> None:
    async def dialogue(transport: Transport) -> None:
        found: list[Any] = []
        for _ in range(TRIES):
            found = await transport.discover()
            if len(found) == len(UUIDS):
                break
        assert [(info.can_id, info.uuid.hex()) for info in found] == list(zip((5, 6), UUIDS, strict=True))
        assert [info.address.can_id for info in found] == [5, 6]
        # Eight bytes are the same here: the package needs the third number to tell them apart.
        one = moteus.Controller(id=DeviceAddress(uuid=bytes.fromhex(UUIDS[1])), transport=transport)
        await one.send_diagnostic_write(data=b"conf set id.id 5\n")
        duplicates: list[Any] = []
        for _ in range(TRIES):  # until it has taken the id
            duplicates = await transport.discover(timeout=0.05)
            if [info.can_id for info in duplicates] == [5, 5]:
                break
        assert sorted(info.uuid.hex() for info in duplicates) == sorted(UUIDS)
        assert all(info.address.can_id is None for info in duplicates)

    session(bus, dialogue)


def test_the_console_and_registers_that_the_twin_has_not(bus: Bus) -> None:
    async def dialogue(transport: Transport) -> None:
        c = moteus.Controller(id=6, transport=transport)
        await c.send_diagnostic_write(data=b"conf get id.id\n")
        (answer,) = await c.diagnostic_read(48)
        assert answer.data == b"6\r\n"
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(c.diagnostic_read_flow(), 0.1)
        await c.flush_transport()
        (reply,) = await transport.cycle([c.make_custom_query({0x060: mp.F32})])
        assert moteus.protocol.parse_registers(reply.data).errors == [(0x060, 1)]

    session(bus, dialogue)
