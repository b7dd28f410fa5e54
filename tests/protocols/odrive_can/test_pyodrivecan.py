"""The client of package pyodrivecan 0.1.3 drives our twin of 0.6, which its bus steps while it waits."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest
from pyodrivecan import ODriveCAN

from protocols.frames import CanFrame
from protocols.odrive_can.options import Settings
from tests.protocols.odrive_can.helpers import TwinRig

CYCLIC = Settings(
    iq_msg_rate_ms=20,
    error_msg_rate_ms=20,
    temperature_msg_rate_ms=20,
    bus_voltage_msg_rate_ms=20,
    torques_msg_rate_ms=20,
    procedure_ms=300,
)
LOCAL = {"initCanBus", "setup_can_interface", "try_candump", "can_setup_done", "ERROR_CODES"}
"""What sets up the interface of a Raspberry Pi, and a table."""


class Bus:
    """In the place of the client's python-can bus: the twin behind it runs while the client waits."""

    def __init__(self, rig: TwinRig) -> None:
        self.rig = rig
        self.read = 0

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        self.rig.receive(CanFrame(message.arbitration_id, bytes(message.data), message.is_extended_id))

    def recv(self, timeout: float = 0.0) -> can.Message | None:
        for _ in range(1 + round(1000 * timeout)):
            if self.read < len(self.rig.frames):
                self.read += 1
                _, frame = self.rig.frames[self.read - 1]
                return can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=frame.extended)
            self.rig.run(1)
        return None

    def shutdown(self) -> None:
        """Nothing to close."""


@pytest.fixture
def client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.setattr(ODriveCAN, "can_setup_done", True)
    with pytest.warns(DeprecationWarning, match="bustype"):
        client = ODriveCAN(
            1, canBusID="pyodrivecan", canBusType="virtual", database=str(tmp_path / "data.db")
        )
    client.canBus.shutdown()
    client.canBus = Bus(TwinRig(CYCLIC))
    yield client
    client.database.conn.close()


async def listen(client: Any, milliseconds: int) -> None:
    """The client's own loop, for a time of the twin."""
    end = client.canBus.rig.now + milliseconds * 1_000_000

    async def stop() -> None:
        await client.get_velocity()
        while client.canBus.rig.now < end:
            message = client.canBus.recv()
            client.process_can_message(message) if message else None
        client.running = False

    await client.loop(stop())
    client.running = True


def test_the_client_drives_the_twin(client: Any, capsys: pytest.CaptureFixture[str]) -> None:
    bus, rig = client.canBus, client.canBus.rig
    servo = rig.twin.servo
    client.flush_can_buffer()
    assert client.is_odrive_idle()
    client.set_controller_mode("velocity_control")
    client.set_limits(35.0, 25.0)
    client.set_velocity(5.0, 0.001)
    client.setAxisState()
    assert "Confirmation received" in capsys.readouterr().out
    rig.run(1000)
    assert rig.shaft.velocity / math.tau == pytest.approx(5.0, abs=0.05)

    client.set_controller_mode("position_control", "trap_traj")
    client.set_traj_vel_limit(4.0)
    client.set_traj_accel_limits(30.0, 31.0)
    client.set_traj_inertia(0.001)
    goal = rig.shaft.position / math.tau + 6.0
    client.set_position(goal)
    rig.run(800)
    assert rig.shaft.velocity / math.tau == pytest.approx(4.0, abs=0.1)
    rig.run(1200)
    assert rig.shaft.position / math.tau == pytest.approx(goal, abs=0.02)
    client.set_controller_mode("position_control", "pos_filter")
    client.set_position(goal - 1.0, 0, 0)
    rig.run(1500)
    assert rig.shaft.position / math.tau == pytest.approx(goal - 1.0, abs=0.02)
    limits = ("vel_limit", "current_soft_max", "trap_accel_limit", "trap_decel_limit", "inertia")
    assert [servo.gains[name] for name in limits] == pytest.approx([35.0, 25.0, 30.0, 31.0, 0.001])

    rig.shaft.velocity, rig.shaft.locked = 0.0, True
    client.set_controller_mode("torque_control")
    client.set_torque(0.2)
    client.run(listen(client, 300))
    measured = (client.torque_estimate, client.iq_measured, client.bus_voltage, client.motor_temp)
    assert measured == pytest.approx((0.2, 0.2 * 270 / 8.27, 24.0, 25.0), rel=0.01)
    assert client.position == pytest.approx(goal - 1.0, abs=0.1)

    client.estop()
    client.run(listen(client, 300))
    assert (client.active_error, client.disarm_reason) == ("ESTOP_REQUESTED", "ESTOP_REQUESTED")
    client.clear_errors(identify=False)
    client.set_absolute_position(4.25)
    rig.run(30)
    assert servo.encoder.position == pytest.approx(4.25, abs=1e-3)
    client.setAxisState("full_calibration_sequence")
    assert "is now in state full_calibration_sequence" in capsys.readouterr().out
    for action in ("save", "dfu"):
        rig.run(2000)
        client.flush_can_buffer()
        client.reboot_save(action)
        assert rig.now < rig.twin.silent_until
    bus.read = len(rig.frames)
    assert bus.recv(2.0) is None
    client.bus_shutdown()


def test_its_public_calls_are_all_known() -> None:
    public = {name for name, _ in inspect.getmembers(ODriveCAN) if not name.startswith("_")}
    source = inspect.getsource(test_the_client_drives_the_twin) + inspect.getsource(listen)
    called = {name for name in public if f"client.{name}(" in source}
    assert public - called == LOCAL | {"recv_all", "save_data"}  # which are its loop
