"""motorbridge 0.5.6 drives our twin, and its frames are those of our table."""

from __future__ import annotations

import pytest
from motorbridge import Mode

from protocols import messages as msg
from protocols.plugin import Device
from protocols.robstride import plugin
from protocols.robstride.options import Model, Options, Settings
from protocols.robstride.table import ANY, HOST, table_of
from protocols.robstride.twin import RobStrideTwin
from tests.protocols.motorbridge import WAIT_MS, Bench, connected, drive, received, set_mode


def bench_of(model: Model) -> Bench:
    return Bench(plugin.twin(Device("left", 5, Options(model=model), Settings()), 0), "left")


def mode_of(bench: Bench) -> msg.Mode:
    assert isinstance(bench.twin, RobStrideTwin)
    return bench.twin.mode


@pytest.mark.parametrize("model", ["RS02", "RS04"])
def test_it_finds_sets_up_and_moves_a_motor(model: Model) -> None:
    bench, table = bench_of(model), table_of(model)
    with connected(bench) as controller:
        motor = controller.add_robstride_motor(5, HOST, model.lower().replace("rs", "rs-"))
        assert motor.robstride_ping_host_id(0xFD, WAIT_MS) == (5, 0xFE)
        assert motor.robstride_get_param_f32(0x701C, WAIT_MS) == 48.0
        assert motor.robstride_get_param_i8(0x7005, WAIT_MS) == 0
        (frame,) = received(bench, 1, motor.enable)
        assert frame == ANY.encode("enable", 5)
        (frame,) = received(bench, 1, lambda: motor.send_mit(1.0, -2.0, 20.0, 1.5, 3.0))
        decoded = table.decode(frame, "to_device")
        assert decoded is not None
        given = {"position": 1.0, "velocity": -2.0, "stiffness": 20.0, "damping": 1.5, "torque": 3.0}
        for name, value in given.items():
            step = table.row("control").field(name).step
            assert decoded.values[name] == pytest.approx(value, rel=4e-4, abs=2 * step)
        drive(bench, lambda: motor.send_mit(1.0, 0.0, 20.0, 1.0, 0.0), 300)
        assert bench.position == pytest.approx(1.0, abs=0.01)
        controller.poll_feedback_once()
        state = motor.get_state()
        assert state is not None
        assert state.pos == pytest.approx(bench.position, abs=0.02)
        (frame,) = received(bench, 1, motor.disable)
        assert frame == ANY.encode("disable", 5)
    assert (mode_of(bench), bench.torque) == (msg.Mode.READY, 0.0)


def test_its_velocity_and_position_modes() -> None:
    bench = bench_of("RS02")
    with connected(bench) as controller:
        motor = controller.add_robstride_motor(5, HOST, "rs-02")
        set_mode(motor, Mode.VEL)
        motor.enable()
        drive(bench, lambda: motor.send_vel(3.0))
        assert bench.velocity == pytest.approx(3.0, abs=0.05)
        motor.disable()
        set_mode(motor, Mode.ROBSTRIDE_POS_VEL_CSP)
        motor.enable()
        drive(bench, lambda: motor.robstride_send_pos_vel_csp(4.0, 5.0), 250)
        assert bench.position == pytest.approx(4.0, abs=0.05)


def test_clearing_zero_saving_and_reports_are_our_bytes() -> None:
    bench = bench_of("RS02")
    with connected(bench) as controller:
        motor = controller.add_robstride_motor(5, HOST, "rs-02")
        for act, message in ((motor.clear_error, "clear"), (motor.store_parameters, "save")):
            assert received(bench, 1, act) == [ANY.encode(message, 5)]
        zero, zero_sta = received(bench, 2, motor.set_zero_position)
        assert zero == ANY.encode("zero", 5)
        assert zero_sta == ANY.encode("write", 5, number=0x7029, value=1)
        # It writes milliseconds where the motor counts 50 µs: 100 ms would be 5.
        (timeout,) = received(bench, 1, lambda: motor.set_can_timeout_ms(100))
        assert timeout == ANY.encode("write", 5, number=0x7028, value=100)
