"""A device's serial number that the robot file demands: without it nothing arms the device."""

from __future__ import annotations

import re

import pytest

from gateway import config
from gateway.config import resources
from gateway.core.faults import ANOTHER_DEVICE
from gateway.errors import ConfigError
from protocols import messages as msg
from protocols.messages import Mode
from tests.gateway.rig import BENCH, Rig, notes_in, sent_commands

LEFT = "385F34733301"
"""Of the simulated ODrive at address 1."""


def demanding(serial: str, text: str = BENCH) -> Rig:
    return Rig(text.replace("address = 1", f'address = 1\nserial = "{serial}"'))


def test_the_right_device_is_armed_once_its_serial_number_was_read() -> None:
    rig = demanding(LEFT)
    ticks = rig.run(1.5) + rig.run(1.0, msg.Velocity("left", 3.0))
    assert rig.gateway.joints["left"].mode is Mode.ARMED
    read = next(tick.now for tick in ticks if "serial number 385F34733301" in str(tick.outputs.notes))
    driven = [t for t, command in sent_commands(rig.robot, ticks) if isinstance(command, msg.Velocity)]
    assert read <= min(driven)
    assert not [note for note in notes_in(ticks) if note.level == "error"]


def test_another_device_is_never_armed_and_is_a_fault_that_clearing_does_not_end() -> None:
    rig = demanding("385F34733302")
    ticks = rig.run(2.0, msg.Velocity("left", 3.0))
    ticks += rig.run(1.0, msg.ClearFault("left"), msg.Release(), msg.Velocity("left", 3.0))
    assert [code for code, _ in rig.gateway.joints["left"].faults] == [ANOTHER_DEVICE]
    commanded = [command for _, command in sent_commands(rig.robot, ticks) if command.motor == "left"]
    assert not [command for command in commanded if not isinstance(command, msg.Idle)]
    (first, *_) = [note.text for note in notes_in(ticks, "left") if note.level == "error"]
    assert "is another device: serial number 385F34733301, the robot file demands 385F34733302" in first
    assert abs(rig.velocity("left")) < 1e-3


def test_a_device_that_does_not_tell_it_is_not_armed_and_that_is_said() -> None:
    """An ODrive of firmware 0.5, which answers no discovery."""
    rig = demanding(LEFT, BENCH.replace("gear = 8.0", 'gear = 8.0\nsettings = { firmware = "0.5.6" }'))
    ticks = rig.run(6.0)
    ticks += rig.run(1.0, msg.Velocity("left", 3.0))
    assert not [
        command for _, command in sent_commands(rig.robot, ticks) if not isinstance(command, msg.Idle)
    ]
    texts = [note.text for note in notes_in(ticks, "left")]
    assert texts.count("does not tell the serial number that is demanded: it is not armed") == 1


def test_devices_that_were_exchanged_while_silent_are_noticed() -> None:
    """What is at the other end of the cable when it is plugged in again may be another device."""
    rig = demanding(LEFT)
    rig.run(1.5)
    joint = rig.gateway.joints["left"]
    assert not joint.unidentified
    joint.on_event(msg.State("left", rig.clock.now(), Mode.OFFLINE))
    assert joint.unidentified


@pytest.mark.parametrize("name", ["damiao", "robstride", "moteus", "cia402"])
def test_each_protocol_that_tells_it_is_held_to_it(name: str) -> None:
    text = BENCH.replace("odrive_can", name).replace('options = { watchdog = "acknowledged" }', "")
    if name == "moteus":
        text = text.replace('kind = "can"', 'kind = "canfd"\ndata_bitrate = 5_000_000')
    lines = [line for line in text.splitlines() if line.startswith("address = ")][:2]
    wrong, right = text, text
    for line in lines:
        wrong = wrong.replace(line, f'{line}\nserial = "1"', 1)
    rig = Rig(wrong)
    rig.run(2.0)
    for line, (motor, joint) in zip(lines, rig.gateway.joints.items(), strict=True):
        (fault,) = [fault for (code, _), fault in joint.faults.items() if code == ANOTHER_DEVICE]
        found = re.search("serial number ([0-9A-F]+), the robot file demands 1$", fault.name)
        assert found is not None, motor
        right = right.replace(line, f'{line}\nserial = "{found[1]}"', 1)
    rig = Rig(right)
    rig.run(2.0)
    assert not any(joint.faults or joint.unidentified for joint in rig.gateway.joints.values())


def test_what_no_device_can_tell_is_a_mistake() -> None:
    text = resources.find("robots", "diffbot_cubemars").read_text()
    line = next(line for line in text.splitlines() if line.startswith("address"))
    with pytest.raises(ConfigError, match="but it cannot be read: with these options no cubemars tells it"):
        config.parse_robot(text.replace(line, f'{line}\nserial = "12"', 1))
    with pytest.raises(ConfigError, match="expected hexadecimal digits"):
        config.parse_robot(BENCH.replace("address = 1", 'address = 1\nserial = "0x12"'))
