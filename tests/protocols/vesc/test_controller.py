"""A controller that is not configured as the robot file has it, below a gateway: what a person reads, and
what moves. Ids that collide."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from gateway import config
from gateway.errors import ConfigError
from protocols.conformance.bench import Shaft
from protocols.frames import Frame
from protocols.messages import MILLISECOND, ClearFault, Feedback, Mode, Position, Release, Stop, Velocity
from protocols.plugin import Device
from protocols.vesc import plugin
from protocols.vesc.options import Options, Settings
from tests.gateway.rig import BENCH, Rig, notes_in

VESC = (
    BENCH.replace('"odrive_can"', '"vesc"')
    .replace("gear = 8.0", "gear = 1.0")
    .replace("torque = 2.0", "torque = 0.5")
)
OPTIONS = '{ watchdog = "acknowledged" }'


def rig(options: str = "{ pole_pairs = 15 }", settings: str = "{}") -> Rig:
    return Rig(VESC.replace(OPTIONS, f"{options}\nsettings = {settings}"))


def told(rig: Rig) -> str:
    return "\n".join(note.text for note in notes_in(rig.ticks))


def test_it_turns_as_commanded() -> None:
    bench = rig()
    bench.run(0.3)
    bench.run(1.5, Velocity("left", 5.0))
    joint = bench.gateway.joints["left"]
    assert bench.velocity("left") == pytest.approx(5.0, abs=0.1)
    assert joint.feedback.velocity == pytest.approx(5.0, abs=0.1)
    assert joint.mode is Mode.ARMED


def test_a_position_is_reached_by_the_loop_of_the_joint() -> None:
    """To a step of the tachometer, 0.07 rad."""
    loop = "{ velocity_gain = 0.05, integral_gain = 0.3, integral_most = 0.3, position_gain = 10.0 }"
    bench = rig(options=f"{{ pole_pairs = 15, feedback_ms = 5 }}\nloop = {loop}")
    bench.run(0.4)
    bench.run(2.0, Position("left", 2.0))
    assert bench.gateway.joints["left"].feedback.position == pytest.approx(2.0, abs=0.07)


def test_one_as_delivered_sends_no_status_messages_and_is_not_commanded() -> None:
    bench = rig(settings="{ status_messages = 0 }")
    bench.run(1.2)
    bench.run(1.0, Velocity("left", 5.0))
    assert "STATUS_1, STATUS_4, STATUS_5: they are, until they are switched on" in told(bench)
    assert "CAN Status Messages Rate 1" in told(bench)
    assert bench.velocity("left") == 0.0


def test_a_timeout_longer_than_in_the_robot_file_is_a_fault_after_the_first_motion() -> None:
    bench = rig(settings="{ timeout_ms = 1000 }")
    bench.run(0.3)
    bench.run(0.5, Velocity("left", 5.0))
    assert "timeout" not in told(bench)
    bench.run(1.5, Stop())
    assert "its timeout does not pass" in told(bench)
    bench.run(1.0, Release(), ClearFault("left"))
    bench.run(0.5, Velocity("left", 5.0))
    assert bench.velocity("left") == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize(("velocity", "turned"), [(5.0, 0.0), (7.0, 7.0)])
def test_below_the_least_erpm_that_it_is_delivered_with_it_does_not_start(
    velocity: float, turned: float
) -> None:
    """900 ERPM with 15 pole pairs are 6.3 rad/s."""
    bench = rig(settings="{ min_erpm = 900.0 }")
    bench.run(0.3)
    bench.run(0.9, Velocity("left", velocity))
    assert bench.velocity("left") == pytest.approx(turned, abs=0.2)


@pytest.mark.parametrize("velocity", [5.0, 0.0])
def test_below_it_a_load_is_damped_and_not_held(velocity: float) -> None:
    """0.1 N·m on a shaft with shorted phases: 0.1 N·m · R / k² = 4 rad/s."""
    device = Device("left", 1, Options(min_erpm=900.0), Settings())
    driver, twin, shaft = plugin.driver([device]), plugin.twin(device, 0), Shaft(friction=0.0)
    frames: Sequence[Frame] = ()
    for ms in range(1, 3000):
        now = ms * MILLISECOND
        for frame in frames:
            driver.receive(now, frame)
        given = Velocity("left", 20.0 if ms < 1500 else velocity)
        for frame in driver.send(now, [given])[1]:
            twin.receive(now, frame)
        (torque,), frames = twin.step(now, [Feedback("left", now, shaft.position, shaft.velocity)])
        shaft.load = 0.1
        shaft.turn(torque.torque, MILLISECOND)
        if ms == 1499:
            assert shaft.velocity == pytest.approx(20.0, abs=0.1)
    assert shaft.velocity == pytest.approx(0.1 * 0.1 / 0.05**2, rel=0.02)


def test_what_it_does_below_it_is_said_at_every_start() -> None:
    bench = rig("{ pole_pairs = 15, torque_constant = 0.05, min_erpm = 900.0 }")
    said = [one for one in config.cautions(bench.robot) if "min_erpm" in one]
    assert len(said) == 2
    assert said[0].startswith("left: at less than 6.28 rad/s (min_erpm) it lets go of its velocity")
    assert not [
        one
        for one in config.cautions(rig("{ pole_pairs = 15, torque_constant = 0.05, min_erpm = 0.0 }").robot)
        if "erpm" in one
    ]


@pytest.mark.parametrize(
    ("left", "right", "wrong"),
    [
        ("254", "1", "it is the host_id"),
        ("255", "1", "it must be 0 to 254"),
        ("1", "1", "has address 1 on bus"),
        ("1", '1\nprotocol = "robstride"', "each would obey what the other is sent"),
    ],
)
def test_ids_that_collide_are_refused_at_start(left: str, right: str, wrong: str) -> None:
    text = VESC.replace(f"options = {OPTIONS}\n", "")
    text = text.replace("address = 1\n", f"address = {left}\n")
    text = text.replace("address = 2\n", f"address = {right}\n")
    with pytest.raises(ConfigError, match=wrong):
        config.parse_robot(text)
