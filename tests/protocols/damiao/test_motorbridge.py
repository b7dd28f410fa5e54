"""motorbridge 0.5.6 drives our twin behind the vendor's serial adapter; its frames are those of our table."""

from __future__ import annotations

import pytest
from motorbridge import Mode

from protocols import messages as msg
from protocols.damiao import plugin
from protocols.damiao.options import Options, Settings
from protocols.damiao.table import ANY, about_register, table_of
from protocols.damiao.twin import DamiaoTwin
from protocols.plugin import Device
from tests.protocols.motorbridge import WAIT_MS, Bench, connected, drive, received, set_mode


@pytest.fixture
def twin() -> DamiaoTwin:
    twin = plugin.twin(Device("left", 1, Options(), Settings()), 0)
    assert isinstance(twin, DamiaoTwin)
    return twin


@pytest.fixture
def bench(twin: DamiaoTwin) -> Bench:
    return Bench(twin, "left")


def test_it_sets_up_and_moves_a_motor_in_three_modes(bench: Bench, twin: DamiaoTwin) -> None:
    with connected(bench, dm_serial=True) as controller:
        motor = controller.add_damiao_motor(1, 0x11, "4310")
        assert motor.get_register_f32(21, WAIT_MS) == 12.5
        set_mode(motor, Mode.MIT)
        assert motor.get_register_u32(10, WAIT_MS) == 1
        assert ANY.encode("enable", 1) in received(bench, 1, motor.enable)
        (frame,) = received(bench, 1, lambda: motor.send_mit(1.0, -2.0, 50.0, 1.5, 3.0))
        decoded = table_of("4310").decode(frame, "to_device")
        assert decoded is not None
        given = {"position": 1.0, "velocity": -2.0, "stiffness": 50.0, "damping": 1.5, "torque": 3.0}
        for name, value in given.items():
            assert decoded.values[name] == pytest.approx(value, abs=ANY.row("MIT").field(name).step)
        drive(bench, lambda: motor.send_mit(1.0, 0.0, 20.0, 1.0, 0.0), 300)
        assert bench.position == pytest.approx(1.0, abs=0.02)
        assert ANY.encode("disable", 1) in received(bench, 1, motor.disable)
        set_mode(motor, Mode.VEL)
        motor.enable()
        drive(bench, lambda: motor.send_vel(3.0))
        assert bench.velocity == pytest.approx(3.0, abs=0.05)
        motor.disable()
        set_mode(motor, Mode.POS_VEL)
        motor.enable()
        drive(bench, lambda: motor.send_pos_vel(4.0, 5.0))
        assert bench.position == pytest.approx(4.0, abs=0.05)
        motor.disable()
    assert (twin.mode, bench.torque) == (msg.Mode.READY, 0.0)


def test_clearing_zero_saving_and_the_watchdog_are_our_bytes(bench: Bench) -> None:
    with connected(bench, dm_serial=True) as controller:
        motor = controller.add_damiao_motor(1, 0x11, "4310")
        assert ANY.encode("clear", 1) in received(bench, 1, motor.clear_error)
        assert ANY.encode("zero", 1) in received(bench, 1, motor.set_zero_position)
        assert about_register("write", 1, "TIMEOUT", 2000.0) in received(
            bench, 1, lambda: motor.set_can_timeout_ms(100)
        )
        assert about_register("save", 1, "TIMEOUT") in received(bench, 1, motor.store_parameters)
