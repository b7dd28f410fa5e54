"""damiao-motor 1.0.6 drives our twin. Its thread is left out: the bus that it sends on answers at once."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import can
import pytest
from damiao_motor.core.motor import REGISTER_TABLE, DaMiaoMotor

from protocols.damiao import plugin
from protocols.damiao.options import Options, Settings
from protocols.damiao.twin import DamiaoTwin
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Feedback, Mode
from protocols.plugin import Device


class Bus:
    """A bus with one twin on it, whose shaft has 0.01 kg·m²; each frame takes a millisecond."""

    def __init__(self, twin: DamiaoTwin) -> None:
        self.twin, self.now = twin, 0
        self.position = self.velocity = 0.0
        self.on_answer: Callable[[bytes, int], None] = lambda data, at: None
        self.step()

    def send(self, message: can.Message, **_: Any) -> None:
        self.twin.receive(self.now, CanFrame(message.arbitration_id, bytes(message.data)))
        self.step()

    def step(self, count: int = 1) -> None:
        for _ in range(count):
            self.now += MILLISECOND
            truth = [Feedback("left", self.now, self.position, self.velocity)]
            (torque,), frames = self.twin.step(self.now, truth)
            self.velocity += torque.torque / 0.01 * 1e-3
            self.position += self.velocity * 1e-3
            for frame in frames:
                assert isinstance(frame, CanFrame)
                self.on_answer(frame.data, frame.id)


@pytest.fixture
def bus() -> Bus:
    twin = plugin.twin(Device("left", 1, Options(), Settings()), 0)
    assert isinstance(twin, DamiaoTwin)
    return Bus(twin)


@pytest.fixture
def client(bus: Bus) -> DaMiaoMotor:
    client = DaMiaoMotor(1, 0x11, bus, motor_type="4310")
    client._controller = bus
    bus.on_answer = lambda data, at: client.process_feedback_frame(data, arbitration_id=at)
    return client


def registers(client: DaMiaoMotor, *numbers: int) -> list[float]:
    """Read registers anew; the client keeps what it read before."""
    client.registers.clear()
    return [client.get_register(number) for number in numbers]


def test_enable_move_and_disable(client: DaMiaoMotor, bus: Bus) -> None:
    client.enable()
    assert client.get_states()["status"] == "ENABLED"
    for _ in range(2000):
        client.send_cmd_mit(1.0, 0.0, 20.0, 1.0, 0.0)
    states = client.get_states()
    assert states["pos"] == pytest.approx(1.0, abs=0.01)
    assert bus.position == pytest.approx(states["pos"], abs=1e-3)
    client.disable()
    assert client.get_states()["status"] == "DISABLED"
    assert bus.twin.torque == 0.0


@pytest.mark.parametrize("mode", ["POS_VEL", "VEL", "FORCE_POS"])
def test_its_other_modes(client: DaMiaoMotor, bus: Bus, mode: str) -> None:
    client.write_register(10, {"POS_VEL": 2, "VEL": 3, "FORCE_POS": 4}[mode])
    client.enable()
    fastest = 0.0
    for _ in range(3000):
        match mode:
            case "POS_VEL":
                client.send_cmd_pos_vel(1.5, 3.0)
            case "VEL":
                client.send_cmd_vel(2.0)
            case _:
                client.send_cmd_force_pos(1.5, 3.0, 0.5)
        fastest = max(fastest, abs(bus.velocity))
    if mode == "VEL":
        assert client.get_states()["vel"] == pytest.approx(2.0, abs=0.05)
    else:
        assert client.get_states()["pos"] == pytest.approx(1.5, abs=0.02)
        assert fastest < 3.5


def test_frames_of_another_mode_are_ignored(client: DaMiaoMotor, bus: Bus) -> None:
    client.enable()
    for _ in range(50):
        client.send_cmd_vel(5.0)
    assert bus.velocity == 0.0


def test_its_watchdog(client: DaMiaoMotor, bus: Bus) -> None:
    client.set_can_timeout(50)
    client.enable()
    bus.step(49)
    assert bus.twin.mode is Mode.ARMED
    bus.step(3)
    client.request_motor_feedback()
    assert client.get_states()["status"] == "LOST_COMM"
    client.enable()
    assert client.get_states()["status"] == "LOST_COMM"
    client.clear_error()
    assert client.get_states()["status"] == "DISABLED"


def test_zero(client: DaMiaoMotor, bus: Bus) -> None:
    bus.position = 2.0
    bus.step()
    client.set_zero_position()
    client.request_motor_feedback()
    assert client.get_states()["pos"] == pytest.approx(0.0, abs=1e-3)


def test_every_register_that_it_writes_is_read_back(client: DaMiaoMotor) -> None:
    written = {n: r for n, r in REGISTER_TABLE.items() if r.access == "RW" and n not in (7, 8, 10, 35)}
    for number, register in written.items():
        value = 12.5 if register.data_type == "float" else 2000
        client.write_register(number, value)
        assert registers(client, number) == [value]
    client.write_register(10, 9)
    assert registers(client, 10) == [1]


def test_a_number_beyond_the_range_ends_there(client: DaMiaoMotor, bus: Bus) -> None:
    bus.position = 40.0
    bus.step()
    client.request_motor_feedback()
    assert client.get_states()["pos"] == pytest.approx(12.5)
    (turned,) = registers(client, 81)
    assert math.isclose(turned, 40.0, rel_tol=1e-6)
