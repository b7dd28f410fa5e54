"""pydamiao 0.1.4 drives our twin behind the vendor's serial adapter; the port, ours, answers at once."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
from pydamiao.bus import SerialBus
from pydamiao.motor import Motor
from pydamiao.structs import MOTOR_LIMITS, ControlMode, MotorFault, MotorReg, MotorType

from gateway.buses.adapters.dm_serial import EmulatedAdapter
from protocols import messages as msg
from protocols.damiao import plugin
from protocols.damiao.options import Options, Settings
from protocols.damiao.table import MODELS
from protocols.damiao.twin import DamiaoTwin
from protocols.plugin import Device
from tests.protocols.motorbridge import Bench

PATIENT = 60.0
"""s that it waits for an answer: no test judges how fast the machine is."""


class Port:
    """As much of a serial port as it uses; what is written is answered before `write` returns. What nothing
    drives comes to rest."""

    def __init__(self, bench: Bench) -> None:
        self.bench, self.adapter, self.is_open = bench, EmulatedAdapter(1_000_000), True
        self._held, self._filled = b"", threading.Condition()

    def open(self) -> None:
        self.is_open = True

    def close(self) -> None:
        self.is_open = False

    def write(self, data: bytes) -> int:
        frames, replies = self.adapter.feed(data)
        answers = [answer for frame in frames for answer in self.bench.exchange(frame)]
        self.bench.velocity *= 0.5 if not self.bench.torque else 1.0
        with self._filled:
            self._held += replies + b"".join(self.adapter.report(self.bench.now, each) for each in answers)
            self._filled.notify_all()
        return len(data)

    def read(self, size: int = 1) -> bytes:
        with self._filled:
            self._filled.wait_for(lambda: bool(self._held), 0.05)
            taken, self._held = self._held[:size], self._held[size:]
        return taken


@pytest.fixture
def twin() -> DamiaoTwin:
    made = plugin.twin(Device("left", 1, Options(), Settings()), 0)
    assert isinstance(made, DamiaoTwin)
    return made


@pytest.fixture
def bench(twin: DamiaoTwin) -> Bench:
    return Bench(twin, "left")


@pytest.fixture
def motor(bench: Bench) -> Iterator[Motor]:
    bus = SerialBus(Port(bench))
    yield Motor(bus, MotorType.DM4310, slave_id=1, master_id=0x11, auto_disable=False)
    bus.close()


def test_it_reads_writes_and_saves(motor: Motor, bench: Bench, twin: DamiaoTwin) -> None:
    assert motor.read_param(MotorReg.PMAX, PATIENT).value == 12.5
    assert motor.write_param(MotorReg.MAX_SPD, 20.0, PATIENT).value == 20.0
    assert motor.write_param(MotorReg.TIMEOUT, 2000, PATIENT).value == 2000
    read = {each: motor.read_param(each, PATIENT) for each in MotorReg if not 50 <= each <= 55}
    assert [each.name for each, result in read.items() if not result.is_ok] == []
    before = len(bench.received)
    assert motor.save_params().is_ok
    assert [plugin.messages(frame) for frame in bench.received[before:]] == [("save",)]
    assert twin.memory.registers["MAX_SPD"] == 20.0


def test_it_turns_a_motor_in_four_modes(motor: Motor, bench: Bench, twin: DamiaoTwin) -> None:
    for mode in ControlMode:
        assert motor.set_mode(mode, PATIENT).value is mode
        assert motor.enable().is_ok
        assert twin.mode is msg.Mode.ARMED
        for _ in range(400):
            match mode:
                case ControlMode.MIT:
                    sent = motor.set_mit(1.0, 0.0, 20.0, 1.0, 0.0)
                case ControlMode.POS_VEL:
                    sent = motor.set_pos_vel(2.0, 5.0)
                case ControlMode.VEL:
                    sent = motor.set_velocity(3.0)
                case ControlMode.POS_FORCE:
                    sent = motor.set_pos_force(1.5, 500, 5000)
            assert sent.is_ok
        state = motor.refresh_state(PATIENT).value
        assert state is not None
        assert state.pos == pytest.approx(bench.position, abs=0.03)
        if mode is ControlMode.VEL:
            assert state.vel == pytest.approx(3.0, abs=0.05)
        else:
            goals = {ControlMode.MIT: 1.0, ControlMode.POS_VEL: 2.0, ControlMode.POS_FORCE: 1.5}
            assert state.pos == pytest.approx(goals[mode], abs=0.05)
        assert motor.disable(PATIENT).is_ok
        assert (twin.mode, bench.torque) == (msg.Mode.READY, 0.0)


def test_it_clears_a_fault_and_sets_a_zero(motor: Motor, bench: Bench, twin: DamiaoTwin) -> None:
    twin.provoke(0xA)
    motor.refresh_state(PATIENT)
    assert motor.fault is MotorFault.OVER_CURRENT
    assert motor.clean_error().is_ok
    bench.position = 2.0
    motor.refresh_state(PATIENT)
    motor.set_zero()
    state = motor.refresh_state(PATIENT).value
    assert state is not None
    assert state.pos == pytest.approx(0.0, abs=1e-3)
    assert twin.mode is msg.Mode.READY


def test_its_ends_are_ours_but_for_an_older_motor() -> None:
    names = {
        "DM4310_48V": "4310P",
        "DM4340_48V": "4340P",
        "DMH3510": "H3510",
        "DMH6215": "G6215",
        "DMG6220": "H6220",
    }
    differing = {
        kind.name
        for kind, ends in MOTOR_LIMITS.items()
        if tuple(ends) != MODELS[names.get(kind.name, kind.name.removeprefix("DM"))]
    }
    assert differing == {"DM4340"}  # 8 rad/s: `velocity_end`
