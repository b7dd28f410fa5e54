"""The vendor's robstride-dynamics 0.0.1, robstride 0.1.0 and pycybergear 1.0.0 drive our twin, each on a bus
that answers at once. robstride decodes a running motor as at rest and misses one fault: neither is asked."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import can
import cybergear
import pytest
import robstride
from robstride_dynamics import Motor, RobstrideBus
from robstride_dynamics.protocol import ParameterType as Parameter

from protocols.frames import CanFrame
from protocols.messages import Mode
from protocols.plugin import Device
from protocols.robstride import plugin
from protocols.robstride.options import Model, Options, Settings
from protocols.robstride.table import DETAIL, HALL, REGISTERS, faults_of
from protocols.robstride.twin import RobStrideTwin
from tests.protocols.motorbridge import Bench

ADDRESS = 5
SERIAL = bytes.fromhex("0500000000005352")


class Bus:
    """As much of python-can's bus as the clients use."""

    def __init__(self, model: Model = "RS02", address: int = ADDRESS) -> None:
        twin = plugin.twin(Device("left", address, Options(model=model), Settings()), 0)
        assert isinstance(twin, RobStrideTwin)
        self.twin, self.bench = twin, Bench(twin, "left")
        self._replies: list[CanFrame] = []

    def send(self, message: can.Message, **_: Any) -> None:
        assert message.is_extended_id
        self._replies += self.bench.exchange(
            CanFrame(message.arbitration_id, bytes(message.data), extended=True)
        )

    def recv(self, timeout: float | None = None) -> can.Message | None:
        del timeout
        self._replies += [] if self._replies else self.bench.step()
        if not self._replies:
            return None
        frame = self._replies.pop(0)
        return can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=True)

    def wait(self, milliseconds: int) -> None:
        for _ in range(milliseconds):
            self._replies += self.bench.step()

    def shutdown(self) -> None:
        """Nothing is open."""


@pytest.fixture
def bus() -> Bus:
    return Bus()


# -- robstride-dynamics ----------------------------------------------------------------------------------


@pytest.fixture(params=["RS02", "RS04"])
def vendor(request: pytest.FixtureRequest) -> Iterator[RobstrideBus]:
    client = RobstrideBus("", {"left": Motor(ADDRESS, request.param.lower().replace("rs", "rs-"))})
    client.channel_handler = Bus(request.param)
    yield client
    client.disconnect()


def test_it_finds_enables_moves_and_disables(vendor: RobstrideBus) -> None:
    bus = vendor.channel_handler
    assert vendor.ping_by_id(ADDRESS) == (ADDRESS, SERIAL)
    assert vendor.ping_by_id(ADDRESS + 1) is None
    vendor.enable("left")
    assert bus.twin.mode is Mode.ARMED
    for _ in range(1000):
        vendor.write_operation_frame("left", 1.0, 20.0, 2.0)
        position, velocity, torque, temperature = vendor.read_operation_frame("left")
    assert position == pytest.approx(1.0, abs=2e-3)
    assert position == pytest.approx(bus.bench.position, abs=1e-3)
    assert (velocity, torque) == (pytest.approx(0.0, abs=0.01), pytest.approx(0.0, abs=0.05))
    assert temperature == 30.0
    vendor.disable("left")
    assert (bus.twin.mode, bus.bench.torque) == (Mode.READY, 0.0)


def test_its_velocity_and_position_modes(vendor: RobstrideBus) -> None:
    bus = vendor.channel_handler
    vendor.write("left", Parameter.MODE, 2)
    vendor.enable("left")
    vendor.write("left", Parameter.VELOCITY_TARGET, 3.0)
    bus.wait(2000)
    assert vendor.read("left", Parameter.MECHANICAL_VELOCITY) == pytest.approx(3.0, abs=0.01)
    vendor.disable("left")
    vendor.write("left", Parameter.MODE, 5)
    vendor.write("left", Parameter.VELOCITY_LIMIT, 4.0)
    vendor.write("left", Parameter.POSITION_TARGET, 20.0)  # beyond what a status can tell
    vendor.enable("left")
    fastest = 0.0
    for _ in range(8000):
        bus.wait(1)
        fastest = max(fastest, bus.bench.velocity)
    assert vendor.read("left", Parameter.MECHANICAL_POSITION) == pytest.approx(20.0, abs=0.02)
    assert fastest < 5.0


def test_every_register_that_it_writes_is_read_back(vendor: RobstrideBus) -> None:
    written = 0
    for parameter in [value for key, value in vars(Parameter).items() if key.isupper()]:
        register = REGISTERS.by_number.get(parameter[0])
        if register is not None and register.writable:
            value = 12.5 if register.type == "f32" else 3
            vendor.write("left", parameter, value)
            assert vendor.read("left", parameter) == value
            written += 1
    assert written == 19


def test_its_watchdog(vendor: RobstrideBus) -> None:
    bus = vendor.channel_handler
    vendor.write("left", Parameter.CAN_TIMEOUT, 2000)
    vendor.enable("left")
    modes = []
    for milliseconds in (97, 5):
        bus.wait(milliseconds)
        modes.append(bus.twin.mode)
    assert modes == [Mode.ARMED, Mode.READY]


WORDS = {
    0x01: "is undervoltage",
    0x02: "is overcurrent",
    0x04: "is overtemperature",
    0x08: "has a magnetic encoder fault",
    0x10: "is stalled",
    0x20: "is uncalibrated",
}


@pytest.mark.parametrize("code", WORDS)
def test_it_names_the_faults_of_a_status(
    vendor: RobstrideBus, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    vendor.channel_handler.twin.provoke(code)
    vendor.disable("left")
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if "left" in line] == [f"WARNING: left {WORDS[code]}"]


DETAILS = {
    0: "overtemperature",
    1: "drive gate fault",
    2: "undervoltage",
    3: "overvoltage",
    7: "uncalibrated",
}


@pytest.mark.parametrize("bit", DETAILS)
def test_it_names_the_faults_of_a_message(
    vendor: RobstrideBus, bit: int, capsys: pytest.CaptureFixture[str]
) -> None:
    vendor.channel_handler.twin.provoke(DETAIL + bit)
    with pytest.raises(RuntimeError, match="Received fault frame from left"):
        vendor.disable("left")
    assert f"FAULT: left {DETAILS[bit]}" in capsys.readouterr().out


# -- robstride -------------------------------------------------------------------------------------------


def test_robstride_reads_turns_and_disables(bus: Bus) -> None:
    client = robstride.Client(bus)
    assert client.read_param(ADDRESS, "vbus") == 48.0
    client.write_param(ADDRESS, "run_mode", robstride.RunMode.Speed)
    assert client.read_param(ADDRESS, "run_mode") is robstride.RunMode.Speed
    client.enable(ADDRESS)
    for _ in range(1000):
        state = client.write_param(ADDRESS, "spd_ref", -2.5)
    assert state.velocity == pytest.approx(-2.5, abs=0.01)
    assert client.read_param(ADDRESS, "mechpos") == pytest.approx(bus.bench.position, abs=0.01)
    assert (state.errors, state.temp) == ([], 30.0)
    bus.twin.provoke(0x04)
    assert [error.name for error in client.disable(ADDRESS).errors] == ["Overtemp"]
    assert bus.bench.torque == 0.0


# -- pycybergear -----------------------------------------------------------------------------------------


@pytest.fixture
def motor(monkeypatch: pytest.MonkeyPatch) -> tuple[Bus, cybergear.CyberGear, cybergear.Motor]:
    bus = Bus("cybergear", 0x7F)
    monkeypatch.setattr(cybergear.can.interface, "Bus", lambda **_: bus)
    client = cybergear.CyberGear()
    assert client.ping_motor(0x7F)
    return bus, client, client.init_motor(0x7F)


def test_pycybergear_turns_positions_and_clears(motor: tuple[Bus, Any, Any]) -> None:
    bus, client, left = motor
    left.set_run_mode(cybergear.CyberGear.MODE_SPEED)
    left.enable_motor()
    left.send_speed_command(6.0)
    bus.wait(2000)
    left.send_speed_command(6.0)
    client.process_packet()
    _, velocity, torque, temperature = left.get_motor_status()
    assert (velocity, temperature) == (pytest.approx(6.0, abs=0.02), pytest.approx(30.0))
    assert torque == pytest.approx(0.0, abs=0.1)
    left.stop_motor()
    assert bus.twin.mode is Mode.READY
    left.set_run_mode(cybergear.CyberGear.MODE_POSITION)
    left.set_speed_limit(4.0)
    left.send_position_command(1.5)
    left.enable_motor()
    bus.wait(6000)
    left.send_position_command(1.5)
    client.process_packet()
    assert left.get_motor_status()[0] == pytest.approx(1.5, abs=0.01)
    bus.twin.provoke(HALL)
    left.enable_motor()
    modes = [bus.twin.mode]
    left.stop_motor(fault=True)
    assert [*modes, bus.twin.mode] == [Mode.FAULT, Mode.READY]
    left.set_mech_position_to_zero()
    client.process_packet()
    assert left.get_motor_status()[0] == pytest.approx(0.0, abs=1e-3)


def test_a_cybergear_takes_no_bit_rate_for_a_request_to_save() -> None:
    """Type 22 is `save` to the others; its first byte, 1, would be 1 Mbit/s here."""
    frame = CanFrame(0x1600FD7F, bytes(range(1, 9)), extended=True)
    assert plugin.messages(frame) == ("save",)
    assert len(Bus("RS02", 0x7F).bench.exchange(frame)) == 1
    assert not Bus("cybergear", 0x7F).bench.exchange(frame)


def test_the_faults_of_the_dialect() -> None:
    assert faults_of("cybergear").keys() - faults_of("RS02").keys() == {HALL}
    assert faults_of("RS02").keys() - faults_of("cybergear").keys() == {0x10, DETAIL + 8, DETAIL + 9}
