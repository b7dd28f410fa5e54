"""The gateway with real drivers, on twins in simulated time: instructions, faults and invalid values."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import pytest

from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs, Tick
from protocols import messages as msg
from protocols.frames import CanFrame, Packet
from protocols.messages import Mode
from tests.gateway.rig import BENCH, Rig, notes_in, sent_commands

DRIVEN = (msg.Velocity("left", 5.0), msg.Velocity("right", -5.0))


@pytest.fixture
def rig() -> Rig:
    """Feedback from both motors, nothing commanded."""
    made = Rig()
    made.run(0.3)
    return made


@pytest.fixture
def driven(rig: Rig) -> Rig:
    """Both motors turning."""
    rig.run(1.0, *DRIVEN)
    assert rig.velocity("left") == pytest.approx(5.0, abs=0.1)
    assert rig.velocity("right") == pytest.approx(-5.0, abs=0.1)
    return rig


def only_idle(rig: Rig, ticks: Sequence[Tick], *motors: str) -> bool:
    """True if nothing but Idle was commanded, to these motors or to any."""
    commands = [command for _, command in sent_commands(rig.robot, ticks)]
    return all(isinstance(one, msg.Idle) for one in commands if not motors or one.motor in motors)


def test_until_commanded_only_read_only_frames_are_sent(rig: Rig) -> None:
    spec = rig.robot.motors["left"].spec
    sent = [packet.frame for tick in rig.ticks for packet in tick.outputs.packets]
    assert sent
    assert all(spec.read_only(frame) for frame in sent)
    assert all(joint.mode is Mode.READY for joint in rig.gateway.joints.values())


def test_velocity_position_and_torque_reach_the_shaft_through_gear_and_sign(rig: Rig) -> None:
    rig.run(1.0, msg.Velocity("left", 5.0))
    assert rig.velocity("left") == pytest.approx(5.0, abs=0.1)
    assert rig.velocity("right") == 0.0
    rig.run(2.0, msg.Position("left", 1.0))
    assert rig.world.world.shaft("left")[0] == pytest.approx(1.0, abs=0.02)
    rig.run(0.5, msg.Torque("left", 0.5))
    assert rig.velocity("left") > 5.0


def test_a_motor_mounted_the_other_way_round_turns_the_same_way() -> None:
    rig = Rig(BENCH.replace("address = 2", "address = 2\nsign = -1"))
    rig.run(0.3)
    rig.run(1.0, *DRIVEN)
    assert rig.velocity("right") == pytest.approx(-5.0, abs=0.1)
    assert rig.gateway.joints["right"].feedback.velocity == pytest.approx(-5.0, abs=0.1)


def test_stop_latches_above_every_joint_until_release(driven: Rig) -> None:
    ticks = driven.run(0.5, msg.Stop("a hand in the way"))
    assert sent_commands(driven.robot, ticks[:1]) == [
        (ticks[0].now, msg.Idle("left")),
        (ticks[0].now, msg.Idle("right")),
    ]
    assert only_idle(driven, driven.run(0.5, *DRIVEN))
    assert driven.gateway.why_stopped() == "a hand in the way"
    assert only_idle(driven, driven.run(0.5, msg.Release()))  # nothing starts by itself
    driven.run(1.0, *DRIVEN)
    assert driven.velocity("left") == pytest.approx(5.0, abs=0.1)


def test_lost_feedback_is_a_fault_and_the_rest_goes_on_with_on_fault_continue(driven: Rig) -> None:
    driven.world.disconnect("right")  # on_fault = "continue"
    ticks = driven.run(1.0)
    (fault,) = [n for n in notes_in(ticks, "right") if n.level == "error"]
    assert "silent: no feedback for" in fault.text
    assert "cable" in fault.text
    first = next(t for t in ticks if fault in t.outputs.notes)
    assert first.now - ticks[0].now < 150_000_000
    assert driven.velocity("left") == pytest.approx(5.0, abs=0.1)
    assert driven.gateway.why_stopped() == ""


def test_lost_feedback_stops_the_robot_with_on_fault_stop(driven: Rig) -> None:
    driven.world.disconnect("left")  # on_fault = "stop"
    ticks = driven.run(1.0)
    assert "left: silent" in driven.gateway.why_stopped()
    assert only_idle(driven, ticks[-100:])
    assert driven.gateway.joints["right"].mode is Mode.READY


def test_a_motor_that_comes_back_does_not_start_by_itself(driven: Rig) -> None:
    driven.world.disconnect("right")
    driven.run(0.5)
    driven.world.reconnect("right")
    ticks = driven.run(1.0)
    assert only_idle(driven, ticks, "right")
    driven.run(0.3, msg.ClearFault("right"))
    assert not driven.gateway.joints["right"].faults
    driven.run(1.0, msg.Velocity("right", 2.0))
    assert driven.velocity("right") == pytest.approx(2.0, abs=0.1)


def test_a_motor_that_restarts_is_a_fault_and_gets_the_stop_command(driven: Rig) -> None:
    driven.world.reset("left")
    ticks = driven.run(1.0)
    (fault,) = [n for n in notes_in(ticks, "left") if n.level == "error"]
    assert "disarmed itself" in fault.text
    assert "a restart" in fault.text
    assert driven.gateway.joints["right"].mode is Mode.READY  # left stops the robot


def test_late_copies_of_arming_frames_turn_a_motor_for_a_moment_and_are_a_fault(rig: Rig) -> None:
    ticks = rig.run(0.5, msg.Velocity("right", 5.0))
    read_only = rig.robot.motors["right"].spec.read_only
    copies = [p.frame for tick in ticks for p in tick.outputs.packets if not read_only(p.frame)]
    rig.run(3.0, msg.Idle("right"))
    rig.world.buses["can0"].write(rig.clock.now(), copies)
    turned: list[float] = []
    ticks = rig.run(1.0, at=lambda _: turned.append(rig.velocity("right")))
    assert max(turned) > 1.0
    assert turned[60:] == sorted(turned[60:], reverse=True)  # 0.3 s later it coasts
    (fault,) = [n for n in notes_in(ticks, "right") if n.level == "error"]
    assert "armed without being commanded" in fault.text
    assert only_idle(rig, rig.run(0.2, msg.Velocity("right", 5.0)), "right")


def test_a_second_node_at_the_same_address_is_a_fault_and_gets_the_stop_command(driven: Rig) -> None:
    driven.world.duplicate("left")
    ticks = driven.run(1.0)
    faults = [n for n in notes_in(ticks, "left") if n.level == "error"]
    assert any("duplicate address" in n.text for n in faults)
    warned = [n.text for n in notes_in(ticks, "scan") if n.level == "warning"]
    assert warned
    assert all("more than one device holds this address" in text for text in warned)
    assert only_idle(driven, ticks[-50:])


def test_estop_is_a_fault_with_the_vendors_name_until_it_is_cleared(driven: Rig) -> None:
    ticks = driven.run(0.5, msg.Estop("left"))
    assert any("ESTOP_REQUESTED" in n.text for n in notes_in(ticks, "left"))
    assert "ESTOP_REQUESTED" in driven.gateway.why_stopped()
    assert only_idle(driven, driven.run(1.0, *DRIVEN))
    driven.run(0.5, msg.ClearFault("all"))
    assert driven.gateway.why_stopped() == ""
    driven.run(1.0, *DRIVEN)
    assert driven.velocity("left") == pytest.approx(5.0, abs=0.1)


def test_requests_are_answered_done_or_refused_with_the_reason(rig: Rig) -> None:
    ticks = rig.run(
        3.0,
        msg.Reboot("left"),
        msg.Reboot("lefft"),
        msg.ClearFault("right"),
        msg.Scan("can0"),
    )
    texts = [f"{n.source}: {n.text}" for n in notes_in(ticks)]
    assert any(t.startswith("left: Reboot: done") for t in texts)
    assert "lefft: Reboot: refused: there is no motor 'lefft'; there are left, right" in texts
    assert any(t.startswith("right: ClearFault: done") for t in texts)
    assert sum("odrive_can at address" in t for t in texts) == 2


def test_limits_and_gains_are_set_while_it_runs_or_refused_with_the_reason(driven: Rig) -> None:
    ticks = driven.run(
        1.0,
        msg.Set("left.limits.velocity", 2.0),
        msg.Set("left.limits.torque", -1.0),
        msg.Set("wing", 1.0),
    )
    assert driven.velocity("left") == pytest.approx(2.0, abs=0.1)
    texts = [n.text for n in notes_in(ticks, "operator")]
    assert texts[0] == "left.limits.velocity = 2"
    assert "from 0.1 to the robot file's 2" in texts[1]
    assert "begins with none of brain, left, right" in texts[2]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_request_with_a_number_that_is_not_finite_is_refused_and_reaches_no_driver(
    driven: Rig, bad: float
) -> None:
    requests: list[msg.Request] = [
        msg.WriteParameter("left", "Pos_Gain", bad),
        msg.Set("left.limits.torque", bad),
    ]
    ticks = driven.run(0.5, *requests)
    answers = [e for tick in ticks for e in tick.outputs.events if isinstance(e, msg.Refused | msg.Done)]
    assert [(e.request, e.name) for e in answers] == [("WriteParameter", "left"), ("Set", "")]
    wanted = f"its value is {bad}, and must be finite"
    assert [e.reason for e in answers if isinstance(e, msg.Refused)] == [wanted, wanted]


@pytest.mark.parametrize(
    "refused", [msg.WriteParameter("left", "no_such", 1.0), msg.Set("left.no_such", 1.0), msg.Zero("none")]
)
def test_a_refusal_that_comes_with_every_step_is_noted_once_a_second(rig: Rig, refused: msg.Request) -> None:
    ticks = [tick for _ in range(500) for tick in rig.run(0.005, refused)]
    notes = [note.text for note in notes_in(ticks) if "refused" in note.text]
    assert 2 <= len(notes) <= 4
    assert notes[1] == f"{notes[0]} (199 times more in the meantime)"


def test_a_lost_bus_and_its_return_are_reported_and_nothing_starts_by_itself(driven: Rig) -> None:
    driven.world.buses["can0"].lose()
    ticks = driven.run(0.5)
    assert any("has vanished" in n.text for n in notes_in(ticks, "can0"))
    driven.world.buses["can0"].restore()
    ticks = driven.run(1.0)
    assert any("is back" in n.text for n in notes_in(ticks, "can0"))
    assert only_idle(driven, ticks)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_command_that_is_not_finite_moves_nothing_and_is_reported(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, bad: float
) -> None:
    commands = [msg.Velocity("left", bad), msg.Torque("right", bad)]
    monkeypatch.setattr(rig.gateway.brain, "step", lambda *_: commands)
    ticks = rig.run(0.3)
    assert any("not finite" in n.text and n.level == "error" for n in notes_in(ticks, "left"))
    assert all(rig.robot.motors["left"].spec.read_only(p.frame) for t in ticks for p in t.outputs.packets)


def test_a_command_for_a_body_is_refused_by_bare_joints(rig: Rig) -> None:
    ticks = rig.run(0.2, msg.Drive(0.1, 0.0))
    assert any("efused" in n.text for n in notes_in(ticks, "brain"))


def test_a_copy_of_the_gateway_goes_on_the_same(driven: Rig) -> None:
    twin = copy.deepcopy(driven.gateway)
    ticks = driven.run(0.5, msg.Set("left.limits.velocity", 3.0), msg.Estop("right"))
    again = [twin.step(tick.now, tick.inputs) for tick in ticks]
    assert again == [tick.outputs for tick in ticks]


def test_the_same_inputs_give_the_same_outputs(driven: Rig) -> None:
    fresh = Gateway(driven.robot)
    outputs: list[Outputs] = [fresh.step(tick.now, tick.inputs) for tick in driven.ticks]
    assert outputs == [tick.outputs for tick in driven.ticks]


def test_a_brain_without_commands_times_out(driven: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driven.gateway.brain, "step", lambda *_: [])
    ticks = driven.run(0.5)
    assert sent_commands(driven.robot, ticks)[-1][1] in (msg.Idle("left"), msg.Idle("right"))
    assert not any(joint.mode is Mode.ARMED for joint in driven.gateway.joints.values())


def test_an_unknown_bus_in_the_inputs_is_a_defect_of_the_caller(rig: Rig) -> None:
    with pytest.raises(KeyError):
        rig.gateway.step(0, Inputs(packets=(Packet(0, "can9", CanFrame(1)),)))


def test_an_operators_stop_also_disarms_a_motor_that_another_host_has_armed(driven: Rig) -> None:
    ours, theirs = Gateway(driven.robot), driven.gateway
    assert theirs.joints["left"].mode is Mode.ARMED
    ticks = driven.run(0.3)
    for tick in ticks:  # a second host receives the same bus, and has commanded nothing
        received = ours.step(tick.now, Inputs(packets=tick.inputs.packets))
        assert not _idles(driven, received)
    last = driven.clock.now()
    assert ours.joints["left"].mode is Mode.ARMED
    assert _idles(driven, ours.step(last, Inputs(instructions=(msg.Stop(),)))) == ["left", "right"]


def test_leaving_sends_nothing_to_a_motor_that_another_host_has_armed(driven: Rig) -> None:
    ours = Gateway(driven.robot)
    for tick in driven.run(0.3):
        ours.step(tick.now, Inputs(packets=tick.inputs.packets))
    assert ours.joints["left"].mode is Mode.ARMED
    assert not _idles(driven, ours.step(driven.clock.now(), Inputs(instructions=(msg.Leave("the end"),))))


def _idles(rig: Rig, outputs: Outputs) -> list[str]:
    """Return the motors that would obey an Idle in these outputs."""
    commands = sent_commands(rig.robot, [Tick(0, 0, Inputs(), outputs)])
    return [command.motor for _, command in commands if isinstance(command, msg.Idle)]
