"""motorbridge 0.5.6 drives our twin, and its frames are those of our table."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.myactuator import plugin
from protocols.myactuator.options import Options, Settings
from protocols.myactuator.table import ANY
from protocols.myactuator.twin import RmdTwin
from protocols.plugin import Device
from tests.protocols.motorbridge import Bench, connected, drive, received

DEVICE = Device("left", 5, Options(brake=True), Settings())


def test_it_releases_the_brake_and_turns_a_motor() -> None:
    twin = RmdTwin(DEVICE, 0)
    bench = Bench(twin, "left")
    with connected(bench) as controller:
        motor = controller.add_myactuator_motor(5, 0x245, "X8")

        def sent(act: Callable[[], None]) -> CanFrame:
            (frame,) = received(bench, 1, act)
            return frame

        assert not twin.memory.released
        assert sent(motor.enable) == ANY.encode("release brake", 5)
        assert (twin.memory.released, twin.mode) == (True, msg.Mode.READY)
        drive(bench, lambda: motor.send_vel(3.0))
        assert bench.velocity == pytest.approx(3.0, abs=0.05)
        assert sent(lambda: motor.send_vel(3.0)) == ANY.encode("speed", 5, value=math.degrees(3.0))
        assert sent(motor.request_feedback) == ANY.encode("read status 2", 5)
        there = ANY.encode("position", 5, fastest=round(math.degrees(5.0)), position=math.degrees(2.0))
        assert sent(lambda: motor.send_pos_vel(2.0, 5.0)) == there
        drive(bench, lambda: motor.send_pos_vel(2.0, 5.0), 600)
        assert bench.position == pytest.approx(2.0, abs=0.01)
        controller.poll_feedback_once()
        state = motor.get_state()
        assert state is not None
        # It takes the angle, which counts degrees by the manual, as hundredths of a degree.
        assert state.pos == pytest.approx(bench.position / 100.0, abs=math.radians(0.01))
        assert sent(motor.disable) == ANY.encode("shutdown", 5)
        assert (twin.mode, bench.torque) == (msg.Mode.READY, 0.0)


def test_its_clearing_of_errors_is_a_stop_which_clears_nothing_and_holds() -> None:
    bench = Bench(plugin.twin(DEVICE, 0), "left")
    with connected(bench) as controller:
        motor = controller.add_myactuator_motor(5, 0x245, "X8")
        assert received(bench, 1, motor.clear_error) == [ANY.encode("stop", 5)]
