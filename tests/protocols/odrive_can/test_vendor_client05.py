"""The client of package odrive-can 2.1.0, in its 0.5.6 dialect, drives our twin of that line.

On the wall clock for the same reason as `test_vendor_client`. Every public call of the client is listed
there; those that this dialect cannot make are named here with what they raise.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import Any

import can
import odrive_can.odrive
import pytest
from odrive_can.odrive import DriveError, ODriveCAN
from odrive_can.utils import get_dbc

from protocols.odrive_can.codec import turns
from protocols.odrive_can.faults import Error
from protocols.odrive_can.faults05 import EncoderError, SensorlessError
from protocols.odrive_can.options import Options
from protocols.odrive_can.twin05 import Twin05
from tests.protocols.odrive_can.helpers import device
from tests.protocols.odrive_can.test_vendor_client import NODE, OTHER_LINE, RUN, SETTINGS, Bench, until

# Its DBC for 0.5.6 has the message Set_Linear_Count; the client asks it for Set_Absolute_Position.
BROKEN = {"set_linear_count": KeyError}
RUN05 = (RUN | set(OTHER_LINE)) - set(BROKEN)


async def drive(bench: Bench[Twin05], client: ODriveCAN, ran: set[str]) -> None:
    """A session with every call of the client that asks or moves a motor of 0.5.6."""
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
    assert (await call("get_adc_voltage"))["ADC_Voltage"] == 0.0
    assert (await call("get_sensorless_estimates"))["Sensorless_Vel_Estimate"] == 0.0
    for name in ("motor", "encoder", "sensorless", "controller"):
        assert list((await call(f"get_{name}_error")).values()) == ["NONE"]

    await call("set_limits", 35.0, 25.0)
    await call("set_pos_gain", 19.0)
    await call("set_vel_gains", 0.15, 0.3)
    await call("set_traj_vel_limit", 12.0)
    await call("set_traj_accel_limits", 30.0, 31.0)
    await call("set_traj_inertia", 0.001)
    await until(lambda: gains.inertia == pytest.approx(0.001), "the gains arrive")
    told = (gains.vel_limit, gains.current_soft_max, gains.pos_gain, gains.vel_gain)
    assert told == pytest.approx((35.0, 25.0, 19.0, 0.15))
    assert (gains.trap_vel_limit, gains.trap_accel_limit, gains.trap_decel_limit) == (12.0, 30.0, 31.0)

    await call("set_controller_mode", "VELOCITY_CONTROL", "PASSTHROUGH")
    await call("set_input_vel", 0.0)
    await call("set_axis_state", "CLOSED_LOOP_CONTROL")
    await call("set_input_vel", 5.0, 0.0)
    await until(lambda: abs(turns(shaft.velocity) - 5.0) < 0.02, "velocity is reached")
    assert (await call("get_encoder_estimates"))["Vel_Estimate"] == pytest.approx(5.0, abs=0.2)
    counts = (await call("get_encoder_count"))["Shadow_Count"]
    assert counts == pytest.approx(turns(shaft.position) * 16384, abs=16384)

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
    await fail_and_recover(bench, client, call)

    with pytest.raises(BROKEN["set_linear_count"]):
        client.set_linear_count(4)
    client._send_message("Set_Linear_Count", {"Position": -8192})
    await until(lambda: abs(twin.servo.position + 0.5) < 1e-3, "the position is called anew")

    await call("reboot")
    await until(lambda: bench.behind < twin.silent_until, "it restarts")
    await until(lambda: bench.behind > twin.silent_until, "it is back")
    await call("wait_for_heartbeat")
    await call("set_axis_state_no_wait", "CLOSED_LOOP_CONTROL")
    await until(lambda: twin.axis.armed, "it arms after the restart")
    await asyncio.to_thread(client.stop)
    ran.add("stop")
    await until(lambda: not twin.axis.armed, "stop disarms")
    await call("set_axis_node_id", 5)
    await until(lambda: twin.axis.node == 5, "the node id changes at once")


async def fail_and_recover(bench: Bench[Twin05], client: ODriveCAN, call: Any) -> None:
    """Errors of every part, as the client reads them, and what clears them."""
    twin = bench.twin
    twin.trip(Error.CURRENT_LIMIT_VIOLATION)
    twin.encoder_errors = EncoderError.NO_RESPONSE
    twin.sensorless_errors = SensorlessError.UNSTABLE_GAIN
    assert (await call("get_motor_error"))["Motor_Error"] == "CURRENT_LIMIT_VIOLATION"
    assert (await call("get_encoder_error"))["Encoder_Error"] == "NO_RESPONSE"
    assert (await call("get_sensorless_error"))["Sensorless_Error"] == "UNSTABLE_GAIN"
    assert (await call("get_controller_error"))["Controller_Error"] == "NONE"
    await call("wait_for_heartbeat")
    with pytest.raises(DriveError, match="MOTOR_FAILED"):
        client.check_errors()
    beat = client._last_heartbeat
    assert beat is not None
    flags = [beat.data[f"{part}_Error_Flag"] for part in ("Motor", "Encoder", "Controller")]
    assert flags == [1, 1, 0]
    await call("clear_errors")
    await until(lambda: not (twin.errors or twin.motor_errors or twin.encoder_errors), "errors are cleared")
    await call("set_axis_state_no_wait", "CLOSED_LOOP_CONTROL")
    await until(lambda: twin.axis.armed, "it arms again")
    await call("set_axis_state_no_wait", "IDLE")
    await until(lambda: not twin.axis.armed, "it disarms")


@pytest.mark.timeout(30)
def test_the_client_drives_the_twin_of_0_5(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(odrive_can.odrive, "dbc", get_dbc("odrive-cansimple-0.5.6"))
    ran: set[str] = set()

    async def session() -> None:
        twin = Twin05(device(address=NODE, settings=SETTINGS, options=Options(firmware="0.5")), 0)
        bench = Bench("odrive-can-client05", twin)
        client = ODriveCAN(axis_id=NODE, can_bus=can.Bus(interface="virtual", channel="odrive-can-client05"))
        pump = asyncio.create_task(bench.pump())
        try:
            await drive(bench, client, ran)
        finally:
            client._running = False
            pump.cancel()
            bench.bus.shutdown()
            client._bus.shutdown()

    asyncio.run(session())
    assert ran == RUN05
