"""Robots by other people's DBC files: the comma body and ODrives; and the numbers of a car."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cantools
import pytest

from gateway.buses.log_file import logged
from gateway.cli.main import main
from gateway.config import load_robot
from gateway.errors import ConfigError
from gateway.recording import read_recording
from gateway.replay import replay_recording
from gateway.runtime.session import open_session
from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.conformance.bench import make_bench
from protocols.dbc import plugin
from protocols.dbc.database import messages_of
from protocols.dbc.options import Commanded, Fed, Feedback, Options, Told
from protocols.frames import CanFrame
from protocols.messages import Goal
from protocols.odrive_can import plugin as odrive
from protocols.odrive_can.options import Options as OdriveOptions
from protocols.plugin import Device

ROOT = Path(__file__).resolve().parents[2]
ROBOTS = [("body_dbc", "dbc_eds/comma_body.dbc"), ("odrive_dbc", "dbc_eds/odrive-cansimple.dbc")]
ODRIVE = "dbc_eds/odrive-cansimple.dbc"


@pytest.fixture(params=ROBOTS, ids=lambda robot: str(robot[0]))
def robot(request: pytest.FixtureRequest, recording: Callable[[str], Path], tmp_path: Path) -> Path:
    """The robot file, with the DBC file beside it."""
    name, dbc = request.param
    shutil.copy(recording(dbc), tmp_path / Path(dbc).name)
    return Path(shutil.copy(ROOT / "examples/dbc" / f"{name}.toml", tmp_path))


def test_it_drives_a_metre_and_its_recording_replays_without_the_file(robot: Path, tmp_path: Path) -> None:
    made, file = load_robot(robot), tmp_path / "run.mcap"
    with open_session(made, simulated=True, record=file) as session:
        session.submit(Goal(1.0, 0.0))
        notes = [note for tick in session.run(4.0) for note in tick.outputs.notes]
        pose = session.pose
    assert pose is not None
    assert math.dist((pose.x, pose.y), (1.0, 0.0)) < 0.05
    assert not [note for note in notes if note.level == "error" or "block" in note.text]
    for each in tmp_path.glob("*.dbc"):
        each.unlink()
    comparison = replay_recording(read_recording(file), None)
    assert comparison.ok, comparison.text()


@pytest.mark.prove
def test_it_drives_the_tour(robot: Path, tmp_path: Path) -> None:
    assert main(["demo", "--fast", "--robot", str(robot), "--out", str(tmp_path / "out")]) == 0


def test_a_robot_file_whose_dbc_is_not_there_says_so(robot: Path) -> None:
    for each in robot.parent.glob("*.dbc"):
        each.unlink()
    with pytest.raises(ConfigError, match=r"motors\.left\.options\.file: there is no '[\w-]+\.dbc' beside"):
        load_robot(robot)


# -- ODrive: the same bytes as the plugin that knows it ------------------------------------------------


def by_dbc(text: str) -> Options:
    axis = "Axis{}_"

    def mode(number: int) -> tuple[str, ...]:
        return (
            f"{axis}Set_Controller_Mode.Control_Mode = {number}",
            f"{axis}Set_Controller_Mode.Input_Mode = 1",
        )

    return Options(
        f"odrive.dbc\n{text}",
        velocity=Commanded(f"{axis}Set_Input_Vel.Input_Vel", "rev/s", beside=mode(2)),
        position=Commanded(f"{axis}Set_Input_Pos.Input_Pos", "rev", beside=mode(3)),
        torque=Commanded(f"{axis}Set_Input_Torque.Input_Torque", "N·m", beside=mode(1)),
        enable=(f"{axis}Set_Axis_State.Axis_Requested_State = 8",),
        idle=(f"{axis}Set_Axis_State.Axis_Requested_State = 1",),
        clear=(f"{axis}Clear_Errors",),
        feedback=Feedback(
            position=Fed(f"{axis}Get_Encoder_Estimates.Pos_Estimate", "rev"),
            velocity=Fed(f"{axis}Get_Encoder_Estimates.Vel_Estimate", "rev/s"),
            state=Told(f"{axis}Heartbeat.Axis_State", ("8",), "1"),
        ),
        watchdog="acknowledged",
    )


def last_frames(which: Any, options: Any, *commands: msg.Command) -> list[dict[int, bytes]]:
    """The last frame of each id that a driver sends while it is given each of these commands."""
    bench, found = make_bench(which, options, (3,), ("one",)), list[dict[int, bytes]]()
    bench.steps(600)
    for command in commands:
        sent = [frame for step in bench.steps(400, [command]) for frame in step.down]
        found.append({each.id: each.data for each in sent if isinstance(each, CanFrame) and not each.remote})
    return found


GIVEN = [
    (msg.Velocity("one", 3.3), "Set_Input_Vel", "Input_Vel", 3.3 / math.tau),
    (msg.Velocity("one", -0.07), "Set_Input_Vel", "Input_Vel", -0.07 / math.tau),
    (msg.Torque("one", -0.02), "Set_Input_Torque", "Input_Torque", -0.02),
    (msg.Position("one", 1.5), "Set_Input_Pos", "Input_Pos", 1.5 / math.tau),
]


@pytest.mark.parametrize(("command", "name", "signal", "value"), GIVEN)
def test_the_bytes_are_those_of_the_plugin_for_it_and_cantools_reads_the_command_in_them(
    recording: Callable[[str], Path], command: msg.Command, name: str, signal: str, value: float
) -> None:
    path = recording(ODRIVE)
    known: Any = cantools.database.load_file(path, strict=False)
    by_file, idle = last_frames(plugin, by_dbc(path.read_text()), command, msg.Idle("one"))
    of_plugin, idle_of_plugin = last_frames(odrive, OdriveOptions(firmware="0.5"), command, msg.Idle("one"))
    names = {known.get_message_by_frame_id(number).name for number in by_file}
    assert names == {f"Axis3_{each}" for each in ("Set_Axis_State", "Set_Controller_Mode", name)}
    assert by_file == {number: of_plugin[number] for number in by_file}
    assert idle
    assert idle == {number: idle_of_plugin[number] for number in idle}
    setpoint = known.get_message_by_name(f"Axis3_{name}")
    assert setpoint.decode(by_file[setpoint.frame_id])[signal] == pytest.approx(value, rel=1e-6)
    state = known.get_message_by_name("Axis3_Set_Axis_State")
    assert state.decode(idle[state.frame_id], decode_choices=False) == {"Axis_Requested_State": 1}


# -- whole files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["dbc_eds/comma_body.dbc", "dbc_eds/LeafPowertrainBus.dbc", ODRIVE])
def test_every_message_of_a_vendors_file_is_encoded_as_cantools_does(
    recording: Callable[[str], Path], name: str
) -> None:
    path = recording(name)
    known: Any = cantools.database.load_file(path, strict=False)
    theirs = {one.name: one for one in known.messages}
    ours = messages_of(name, path.read_text("cp1252"))
    assert ours.keys() == theirs.keys()
    for key, one in ours.items():
        data = bytes((37 * at + 11) % 251 for at in range(one.length))
        raws = one.decode(CanFrame(one.id, data, one.extended))
        assert raws is not None
        wanted = theirs[key].decode(data, scaling=False, decode_choices=False)
        assert raws == dict(wanted)
        assert one.encode(raws).data == theirs[key].encode(wanted, scaling=False, strict=False)


def test_a_car_is_decoded_value_by_value_as_cantools_does(recording: Callable[[str], Path]) -> None:
    path = recording("rav4/_toyota_2017.dbc")
    known: Any = cantools.database.load_file(path, strict=False)
    theirs = {one.frame_id: one for one in known.messages}
    ours = {one.id: one for one in messages_of(path.name, path.read_text("cp1252")).values()}
    values = frames = 0
    for packet, _ in logged(recording("rav4/raw_can_src0.candump.log.gz")):
        frame = packet.frame
        if not isinstance(frame, CanFrame) or frame.id not in ours or frames % 7:
            frames += 1
            continue
        frames += 1
        raws = ours[frame.id].decode(frame)
        assert raws is not None, frame
        wanted = theirs[frame.id].decode(frame.data, decode_choices=False)
        signals = ours[frame.id].signals
        made = {key: raw * signals[key].factor + signals[key].offset for key, raw in raws.items()}
        assert made == pytest.approx(wanted, rel=1e-12, abs=1e-12)
        values += len(made)
    assert frames > 50_000
    assert values > 10_000


def test_a_message_that_a_car_has_under_another_name_is_suggested(recording: Callable[[str], Path]) -> None:
    path = recording("rav4/_toyota_2017.dbc")
    options = Options(
        f"{path.name}\n{path.read_text('cp1252')}",
        velocity=Commanded("WHEEL_SPEED.WHEEL_SPEED_FL", "rad/s"),
        idle=("STEERING_LKA.STEER_REQUEST = 0",),
        feedback=Feedback(velocity=Fed("WHEEL_SPEEDS.WHEEL_SPEED_FL")),
    )
    with pytest.raises(Invalid, match=r"did you mean 'WHEEL_SPEEDS'\?"):
        plugin.spec(Device("one", 1, options, plugin.settings()))
