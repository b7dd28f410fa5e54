"""The client of package odrive-can 2.1.0, in its 0.5.6 dialect, drives our twin of that line.

On the wall clock for the same reason as `test_vendor_client`. Every public call of the client is listed
there; those that this dialect cannot make are named here with what they raise.
"""

from __future__ import annotations

import math

import odrive_can.odrive
import pytest
from odrive_can.utils import get_dbc

from protocols.odrive_can import errors
from protocols.odrive_can.firmware import Twin05
from protocols.odrive_can.options import Options
from tests.protocols.odrive_can.helpers import device
from tests.protocols.odrive_can.test_vendor_client import OTHER_LINE, RUN
from tests.protocols.odrive_can.vendor import NODE, SETTINGS, Session, hold, until

# Its DBC for 0.5.6 has the message Set_Linear_Count; the client looks up Set_Absolute_Position in it.
BROKEN = {"set_linear_count": KeyError}
RUN05 = (RUN | set(OTHER_LINE)) - set(BROKEN)


async def drive(session: Session[Twin05]) -> None:
    """A session with every call of the client that requests something or moves a motor of 0.5.6."""
    bench, client, twin, call = session.bench, session.client, session.bench.twin, session.call
    await session.begin()
    assert (await call("get_adc_voltage"))["ADC_Voltage"] == 0.0
    assert (await call("get_sensorless_estimates"))["Sensorless_Vel_Estimate"] == 0.0
    for name in ("motor", "encoder", "sensorless", "controller"):
        assert list((await call(f"get_{name}_error")).values()) == ["NONE"]
    await session.set_gains()
    await session.steer()
    counts = (await call("get_encoder_count"))["Shadow_Count"]
    assert counts == pytest.approx(bench.shaft.position / math.tau * 16384, abs=16384)
    await fail_and_recover(session)

    with pytest.raises(BROKEN["set_linear_count"]):
        client.set_linear_count(4)
    client._send_message("Set_Linear_Count", {"Position": -8192})
    await until(lambda: abs(twin.servo.encoder.position + 0.5) < 1e-3, "the position is called anew")

    await call("reboot")
    await until(lambda: bench.behind < twin.silent_until, "it restarts")
    await until(lambda: bench.behind > twin.silent_until, "it is back")
    await session.end()
    await call("set_axis_node_id", 5)
    await until(lambda: twin.memory.node == 5, "the node id changes at once")


async def fail_and_recover(session: Session[Twin05]) -> None:
    """Errors of every part, as the client reads them, and what clears them."""
    client, twin, call = session.client, session.bench.twin, session.call
    twin.trip(twin.raised["CURRENT_LIMIT_VIOLATION"])
    twin.trip(errors.ENCODER.code("NO_RESPONSE"))
    twin.trip(errors.SENSORLESS.code("UNSTABLE_GAIN"))
    assert (await call("get_motor_error"))["Motor_Error"] == "CURRENT_LIMIT_VIOLATION"
    assert (await call("get_encoder_error"))["Encoder_Error"] == "NO_RESPONSE"
    assert (await call("get_sensorless_error"))["Sensorless_Error"] == "UNSTABLE_GAIN"
    assert (await call("get_controller_error"))["Controller_Error"] == "NONE"
    # 448: MOTOR_FAILED, ENCODER_FAILED and the sensorless estimator's.
    await until(lambda: "448" in session.error(), "the client sees the errors")
    beat = client._last_heartbeat
    assert beat is not None
    flags = [beat.data[f"{part}_Error_Flag"] for part in ("Motor", "Encoder", "Controller")]
    assert flags == [1, 1, 0]
    await call("clear_errors")
    await until(lambda: not twin.words, "errors are cleared")
    await session.arm_again()


def test_the_client_drives_the_twin_of_0_5(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(odrive_can.odrive, "dbc", get_dbc("odrive-cansimple-0.5.6"))
    twin = Twin05(device(address=NODE, settings=SETTINGS, options=Options(firmware="0.5")), 0)
    assert hold("odrive-can-client05", twin, drive) == RUN05
