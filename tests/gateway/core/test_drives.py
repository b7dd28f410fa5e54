"""The same robot over each protocol, and over three on one bus: arrives, and replays to the byte."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gateway import config
from gateway.config import resources
from gateway.recording import read_recording
from protocols.frames import CanFrame
from protocols.messages import Goal, Mode, Position, Velocity
from tests.gateway.cli.test_demo import gateway
from tests.gateway.rig import BENCH, Rig

ROBOTS = {
    "diffbot_cia402": {"cia402"},
    "diffbot_cubemars": {"cubemars"},
    "diffbot_damiao": {"damiao"},
    "diffbot_feetech": {"feetech"},
    "diffbot_robomaster": {"robomaster"},
    "diffbot_robstride": {"robstride"},
    "diffbot_vesc": {"vesc"},
    "diffbot_zlac8015d": {"zlac8015d"},
    "diffbot_moteus": {"moteus"},
    "diffbot_myactuator": {"myactuator"},
    "diffbot_dynamixel": {"dynamixel"},
    "diffbot_ddsm": {"ddsm"},
    "diffbot_roboclaw": {"roboclaw"},
    "diffbot_sabertooth": {"sabertooth"},
    "diffbot_hoverboard": {"hoverboard"},
    "diffbot_sensors": {"odrive_can"},
    "diffbot_rplidar": {"odrive_can"},
    "diffbot_gnss": {"odrive_can"},
    "diffbot_encoder": {"odrive_can"},
    "diffbot_vesc_uart": {"vesc_uart"},
    "diffbot_odrive_ascii": {"odrive_ascii"},
    "car": {"vesc", "maestro"},
    "skid_steer_vesc": {"vesc"},
    "diffbot_mixed": {"cia402", "moteus", "odrive_can"},
    "diffbot_mixed_can": {"vesc", "robstride", "cubemars"},
}
"""The protocols on the bus of the motors, by robot file."""


OFTEN = {"diffbot_mixed", "diffbot_mixed_can", "diffbot_feetech"}
"""Several protocols at once, and a line; `./go prove` drives the others, and all keep the contract."""
DRIVEN = [pytest.param(one, marks=[] if one in OFTEN else [pytest.mark.prove]) for one in ROBOTS]


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", DRIVEN)
def test_the_goal_is_reached_and_the_recording_replays_to_the_same_bytes(name: str, tmp_path: Path) -> None:
    robot = config.load_robot(name)
    assert {motor.plugin.name for motor in robot.motors.values()} == ROBOTS[name]
    done = gateway("demo", "--fast", "--robot", name, "--goal", "1.6,0.6", "--out", str(tmp_path))
    text = done.stdout + done.stderr
    assert done.returncode == 0, text
    assert "by the true pose: 1 of 1" in text
    assert "touched: 0" in text
    recording = tmp_path / "demo.mcap"
    frames = [packet.frame for tick in read_recording(recording).ticks for packet in tick.outputs.packets]
    fd = {frame.fd for frame in frames if isinstance(frame, CanFrame)}
    assert not fd or fd == {protocol == "moteus" for protocol in ROBOTS[name]}
    judged = gateway("replay", str(recording))
    assert judged.returncode == 0, judged.stdout + judged.stderr
    assert "the same, byte for byte" in judged.stdout
    compared = re.search(r"(\d+) packets", judged.stdout)
    assert compared
    assert int(compared[1]) > 500  # one frame may have several set-points


@pytest.mark.parametrize("name", [name for name in ROBOTS if name.startswith("diffbot_mixed")])
def test_three_protocols_move_at_once_on_one_bus(name: str) -> None:
    """Wheels and mast; each driver accepts only its own frames, and ignores those of the others."""
    rig = Rig(resources.find("robots", name).read_text("utf-8"))
    rig.run(1.5)
    rig.run(0.01, Position("mast", 0.5))
    rig.run(2.5, Goal(0.4, 0.0))
    modes = {motor: joint.mode for motor, joint in rig.gateway.joints.items()}
    assert modes == dict.fromkeys(("left", "right", "mast"), Mode.ARMED)
    assert rig.world.world.shaft("mast")[0] == pytest.approx(0.5, abs=0.01)
    assert rig.world.world.truth().x > 0.2
    counted = {protocol: counters for bus, protocol, counters in rig.gateway.rx_counters() if bus == "can0"}
    assert set(counted) == ROBOTS[name]
    for counters in counted.values():
        assert counters.malformed == 0
        assert min(counters.accepted, counters.ignored) > 100


def test_a_loop_asks_for_no_more_torque_than_the_device_gives() -> None:
    """C620: 6 N·m behind this gear, where the joint's limit is 10."""
    text = BENCH.replace('"odrive_can"', '"robomaster"').replace("gear = 8.0", "gear = 19.2")
    text = text.replace("acceleration = 60.0, torque = 2.0", "acceleration = 10000.0, torque = 10.0")
    text = text.replace('watchdog = "acknowledged"', 'model = "C620"')
    rig = Rig(text.replace("[motors.left]", "[defaults.motors.loop]\nvelocity_gain = 0.5\n[motors.left]"))
    rig.run(0.5)
    ticks = rig.run(0.5, Velocity("left", 15.0))
    currents = [
        int.from_bytes(packet.frame.data[:2], "big", signed=True)
        for tick in ticks
        for packet in tick.outputs.packets
        if isinstance(packet.frame, CanFrame)
    ]
    assert max(currents) == 16384
    assert rig.world.world.shaft("left")[1] == pytest.approx(15.0, rel=0.1)
    assert not rig.gateway.joints["left"].faults


def test_every_shipped_variant_of_the_demo_is_driven() -> None:
    """Every shipped robot that drives the office with another protocol than the demo's is tried above; so is
    the car, of whose body there is no other, and a base on four wheels with sensors that are bought."""
    found = {
        path.stem for path in Path(str(resources.find("robots", "diffbot"))).parent.glob("diffbot_*.toml")
    }
    assert found - {"diffbot_camera"} | {"car", "skid_steer_vesc"} == set(
        ROBOTS
    )  # which drives where there are tags to see
