"""Three protocols on one CAN FD bus: each driver gets every frame, its own devices and the bus's states."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from mcap.reader import make_reader

from gateway import config
from gateway.cli.main import main
from gateway.core.guard import decoder_of
from gateway.errors import ConfigError
from protocols.frames import BusState, CanFrame
from protocols.messages import Command, Feedback, Home, Idle, Mode, Velocity
from tests.gateway.rig import Rig, notes_in

MIXED = """
name = "mixed"
rate_hz = 200
world = "bench"
[buses.can0]
kind = "canfd"
bitrate = 1_000_000
data_bitrate = 5_000_000
shared_bus = "acknowledged"
interface = "twin"
[defaults.motors]
bus = "can0"
on_fault = "continue"
feedback_timeout_ms = 300
limits = { velocity = 20.0, acceleration = 60.0, torque = 2.0 }
[motors.servo]
protocol = "moteus"
address = 1
options = { can_prefix = 1 }
[motors.drive]
protocol = "cia402"
address = 2
[motors.arm]
protocol = "odrive_can"
address = 3
options = { watchdog = "acknowledged" }
[brain]
body = "joints"
[brain.joints]
motors = ["servo", "drive", "arm"]
"""
MOTORS = {"servo": "moteus", "drive": "cia402", "arm": "odrive_can"}


@pytest.fixture
def rig() -> Rig:
    """All ready."""
    made = Rig(MIXED)
    made.run(1.2)
    assert {name: joint.mode for name, joint in made.gateway.joints.items()} == dict.fromkeys(
        MOTORS, Mode.READY
    )
    return made


def test_a_request_that_a_protocol_does_not_know_is_refused_before_it_reaches_a_driver(rig: Rig) -> None:
    texts = [f"{note.source}: {note.text}" for note in notes_in(rig.run(0.1, Home("servo")))]
    assert "servo: Home: refused: its protocol cannot do this" in texts


def test_each_motor_obeys_its_own_commands_only(rig: Rig) -> None:
    for turning in MOTORS:
        ticks = rig.run(1.5, Velocity(turning, 2.0))  # a CANopen drive is set up first
        assert rig.velocity(turning) == pytest.approx(2.0, abs=0.1)
        assert all(abs(rig.velocity(name)) < 0.02 for name in MOTORS if name != turning)
        decoder = decoder_of(rig.robot, "can0")
        obeyed = {
            message.motor
            for tick in ticks
            for packet in tick.outputs.packets
            for message in decoder.decode(packet.t, packet.frame)
            if isinstance(message, Command) and not isinstance(message, Idle)
        }
        assert obeyed == {turning}
        rig.run(0.5, Idle(turning))
    assert [note for note in notes_in(rig.ticks) if note.level == "error"] == []


def test_every_frame_is_counted_once_by_every_protocol_and_accepted_by_one(rig: Rig) -> None:
    rig.run(0.5, *(Velocity(name, 1.0) for name in MOTORS))
    received = sum(len(tick.inputs.packets) for tick in rig.ticks)
    rx_counters = {protocol: counters for _, protocol, counters in rig.gateway.rx_counters()}
    assert list(rx_counters) == list(MOTORS.values())
    assert [
        counters.accepted + counters.malformed + counters.ignored for counters in rx_counters.values()
    ] == [received] * 3
    assert sum(counters.accepted for counters in rx_counters.values()) == received
    assert all(counters.malformed == 0 and counters.accepted > 200 for counters in rx_counters.values())
    for packets in ("inputs", "outputs"):
        frames = [p.frame for tick in rig.ticks for p in getattr(tick, packets).packets]
        kinds = {(w.fd, w.brs, w.extended) for w in frames if isinstance(w, CanFrame)}
        assert kinds == {(False, False, False), (True, True, True)}


def test_a_bus_that_vanishes_and_comes_back_is_reported_to_all_drivers(rig: Rig) -> None:
    rig.run(0.5, *(Velocity(name, 1.0) for name in MOTORS))
    rig.world.buses["can0"].lose()
    ticks = rig.run(1.0)
    assert [state for tick in ticks for _, state in tick.inputs.states] == [BusState.GONE]
    assert all(rig.gateway.joints[name].mode in (Mode.OFFLINE, Mode.FAULT) for name in MOTORS)
    rig.world.buses["can0"].restore()
    ticks = rig.run(1.5)
    assert [state for tick in ticks for _, state in tick.inputs.states] == [BusState.BACK]
    received = {e.motor for tick in ticks[-100:] for e in tick.outputs.events if isinstance(e, Feedback)}
    assert received == set(MOTORS)
    assert all(abs(rig.velocity(name)) < 0.05 for name in ("servo", "drive"))  # their watchdogs saw to that


def test_a_recording_of_both_kinds_of_frames_replays_to_the_same_bytes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot, recording = tmp_path / "mixed.toml", tmp_path / "mixed.mcap"
    robot.write_text(MIXED)
    assert main(["run", str(robot), "--fast", "--seconds", "1", "--record", str(recording)]) == 0
    assert main(["replay", str(recording)]) == 0
    assert "the same, byte for byte" in capsys.readouterr().out
    with recording.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    ways = ("to_can_bus", "to_can_bus_fd", "from_can_bus", "from_can_bus_fd")
    assert {f"/can0/{way}" for way in ways} <= topics


@pytest.mark.parametrize(
    ("change", "text"),
    [
        # a moteus without a prefix heeds every id whose low byte is its own, whatever kind of frame it is
        (("can_prefix = 1", "can_prefix = 0"), "drive.*0x601.*'servo' would obey what it is sent"),
        # 0x080 is SYNC, and the version of an ODrive's node 4
        (("address = 3", "address = 4"), "arm.*0x082 .*0x080 .'drive' would obey what it reports there"),
        # 0x000 is NMT, and all of node 0's
        (("address = 3", "address = 0"), "arm.*0x000 .'drive' would obey what it reports there"),
        # 0x202 is RPDO1 of node 2, and Estop of node 16
        (("address = 3", "address = 16"), "arm.*0x202"),
    ],
)
def test_clashing_ids_are_reported(change: tuple[str, str], text: str) -> None:
    with pytest.raises(ConfigError) as raised:
        config.parse_robot(MIXED.replace(*change))
    assert any(re.search(text, str(mistake)) for mistake in raised.value.mistakes), str(raised.value)


def test_all_clashes_are_reported_at_once() -> None:
    text = MIXED.replace("can_prefix = 1", "can_prefix = 0").replace("address = 3", "address = 4")
    with pytest.raises(ConfigError) as raised:
        config.parse_robot(text)
    assert len(raised.value.mistakes) == 2


def test_the_bus_load_includes_frames_of_both_kinds() -> None:
    """Each motor 200 commands and 100 reports a second: 52 µs each of moteus, 125 µs each of the others."""
    text = config.describe(config.parse_robot(MIXED))
    assert re.search(r"can0 +canfd +1000000 bit/s, data 5000000 bit/s +twin +at least 9 %", text)
