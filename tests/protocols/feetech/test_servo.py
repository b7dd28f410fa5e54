"""Servos below a gateway, on one wire in virtual time: requests, lost answers, one that is unplugged, or
another than it should be."""

from __future__ import annotations

import random
from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import pytest

from gateway import config
from gateway.buses.virtual.bus import HOST
from gateway.buses.virtual.halfduplex import HalfDuplex
from gateway.buses.virtual.medium import Transmission
from gateway.errors import ConfigError
from protocols import messages as msg
from protocols.feetech.twin import FeetechTwin
from protocols.messages import MILLISECOND, Event, Feedback, Mode, Position, Torque, Velocity
from tests.gateway.rig import Rig, notes_in

LINE = """
name = "rig"
rate_hz = 200
world = "bench"
[buses.line0]
kind = "serial"
baudrate = 1_000_000
interface = "twin"
[defaults.motors]
protocol = "feetech"
bus = "line0"
gear = 1.0
limits = { velocity = 4.0, acceleration = 20.0, torque = 2.5 }
options = { OPTIONS }
settings = { SETTINGS }
[motors.left]
address = 1
[motors.right]
address = 2
on_fault = "continue"
[brain]
body = "joints"
[brain.joints]
motors = ["left", "right"]
"""


def rig(options: str = "", settings: str = "stiffness = 20.0") -> Rig:
    return Rig(LINE.replace("OPTIONS", options).replace("SETTINGS", settings))


def events(bench: Rig, kind: type[Any]) -> list[Any]:
    return [event for tick in bench.ticks for event in tick.outputs.events if isinstance(event, kind)]


def twin(bench: Rig, name: str = "left") -> FeetechTwin:
    found = bench.world.twin(name)
    assert isinstance(found, FeetechTwin)
    return found


def mode(bench: Rig, name: str) -> Mode | None:
    return bench.gateway.joints[name].mode


def overlaps(bench: Rig) -> int:
    wire = bench.world.buses["line0"].from_devices
    assert isinstance(wire, HalfDuplex)
    return len(wire.collisions)


def answers(bench: Rig, request: msg.Request, seconds: float = 1.2) -> list[Event]:
    before = len(bench.ticks)
    bench.run(seconds, request)
    made = [event for tick in bench.ticks[before:] for event in tick.outputs.events]
    return [event for event in made if isinstance(event, msg.Done | msg.Refused | msg.Parameter | msg.Found)]


def test_a_position_is_reached_and_nothing_overlaps() -> None:
    bench = rig()
    bench.run(0.3)
    bench.run(1.5, Position("left", 1.0), Position("right", -0.5))
    for name, place in (("left", 1.0), ("right", -0.5)):
        assert bench.gateway.joints[name].mode is Mode.ARMED
        assert bench.gateway.joints[name].feedback.position == pytest.approx(place, abs=0.01)
    assert overlaps(bench) == 0
    assert bench.gateway.lines["line0"].lost <= 1  # before the first step of the world
    bench.leave()
    assert [twin(bench, name).mode for name in ("left", "right")] == [Mode.READY, Mode.READY]


def test_a_wheel_turns_beyond_its_turn() -> None:
    bench = rig('mode = "wheel"')
    bench.run(0.3)
    bench.run(3.0, Velocity("left", 3.0))
    joint = bench.gateway.joints["left"]
    assert joint.feedback.velocity == pytest.approx(3.0, abs=0.1)
    assert joint.feedback.position == pytest.approx(bench.world.world.shaft("left")[0], abs=0.05)
    assert bench.world.world.shaft("left")[0] > 6.4
    bench.leave()
    assert twin(bench).mode is Mode.READY  # nothing else would stop it


def test_a_share_of_the_supply_is_a_torque_where_it_stands() -> None:
    bench = rig('mode = "pwm"')
    bench.run(0.3)
    bench.run(0.5, Torque("left", 0.5))
    full, velocity = 2.94, bench.velocity("left")
    assert twin(bench).torque == pytest.approx(0.5 - full * velocity / (45 * 0.104719755), abs=0.1)


@pytest.mark.sample(1)
@pytest.mark.parametrize("sync", ["true", "false"])
def test_one_answer_in_a_hundred_lost_costs_readings_alone(sync: str) -> None:
    """No fault; what the shaft does is smooth as ever; the age of what is known shows it."""
    jerks: list[float] = []
    readings: list[int] = []
    for lost in (0.0, 0.01):
        bench = rig(f'mode = "wheel", feedback_ms = 5.0, sync_read = {sync}')
        chance = random.Random(7)

        def some(
            _: str, one: Transmission, chance: random.Random = chance, lost: float = lost
        ) -> Iterable[Transmission]:
            return () if one.sender != HOST and chance.random() < lost else (one,)

        bench.world.tamper.transmission = some
        bench.run(0.5)
        seen: list[float] = []
        for target in (3.0, -3.0, 2.0):
            bench.run(
                0.8, Velocity("left", target), Velocity("right", -target),
                at=lambda _, bench=bench, seen=seen: seen.append(bench.velocity("left")),  # type: ignore[misc]
            )  # fmt: skip
        pushed = [b - a for a, b in pairwise(seen)]
        jerks.append(max(abs(b - a) for a, b in pairwise(pushed)))
        assert bench.velocity("left") == pytest.approx(2.0, abs=0.1)
        assert not events(bench, msg.Fault)
        assert not [note for note in notes_in(bench.ticks) if "fault" in note.text]
        assert overlaps(bench) == 0
        times = [event.t for event in events(bench, Feedback) if event.motor == "right"]
        late = max(b - a for a, b in pairwise(times[20:]))
        assert late < 40 * MILLISECOND
        readings.append(len(times))
    assert readings[1] < readings[0]
    assert jerks[1] < 1.2 * jerks[0] + 1e-3


def test_one_that_is_unplugged_stops_alone_and_the_others_go_on() -> None:
    bench = rig('mode = "wheel"')
    bench.run(0.3)
    bench.run(1.0, Velocity("left", 2.0), Velocity("right", 2.0))
    bench.world.disconnect("right")
    before = len(bench.ticks)
    bench.run(1.5)
    left = bench.gateway.joints["left"]
    assert mode(bench, "right") is Mode.OFFLINE
    assert left.mode is Mode.ARMED
    assert left.feedback.velocity == pytest.approx(2.0, abs=0.1)
    ages = [b - a for a, b in pairwise(
        event.t for tick in bench.ticks[before:] for event in tick.outputs.events
        if isinstance(event, Feedback) and event.motor == "left"
    )]  # fmt: skip
    assert max(ages) < 30 * MILLISECOND
    bench.world.reconnect("right")
    bench.run(0.5)
    assert mode(bench, "right") is not Mode.OFFLINE
    assert overlaps(bench) == 0


def test_a_middle_is_set_and_stored_as_an_offset() -> None:
    bench = rig(settings="offset = 100")
    bench.run(0.3)
    assert bench.gateway.joints["left"].feedback.position == pytest.approx(
        -100 * 2 * 3.14159265 / 4096, abs=1e-3
    )
    assert [type(one) for one in answers(bench, msg.Zero("left"))] == [msg.Done]
    assert bench.gateway.joints["left"].feedback.position == pytest.approx(0.0, abs=1e-3)
    assert twin(bench).memory.get("Homing_Offset") == 0


@pytest.mark.parametrize(("name", "value"), [("Max_Torque_Limit", 700.0), ("Homing_Offset", -85.0)])
def test_what_is_stored_is_unlocked_written_and_locked_again(name: str, value: float) -> None:
    bench = rig()
    bench.run(0.3)
    (done,) = answers(bench, msg.WriteParameter("left", name, value))
    assert isinstance(done, msg.Done), done
    assert done.detail == "stored"
    (read,) = answers(bench, msg.ReadParameter("left", name))
    assert isinstance(read, msg.Parameter)
    assert read.value == value
    assert twin(bench).memory.get("Lock") == 1
    assert twin(bench).memory.get(name) == value


@pytest.mark.parametrize("name", ["Present_Velocity", "Present_Temperature"])
def test_what_is_measured_can_be_read_alone(name: str) -> None:
    bench = rig()
    bench.run(0.3)
    (read,) = answers(bench, msg.ReadParameter("left", name), 0.2)
    assert isinstance(read, msg.Parameter), read
    assert not bench.gateway.joints["left"].faults


@pytest.mark.parametrize("old", [True, False], ids=["answered for at the old one", "at the new one"])
def test_another_id_is_told_and_the_servo_answers_there(
    old: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = rig()
    if not old:
        monkeypatch.setattr(
            FeetechTwin, "status", lambda it, _, error, data: it.packets.packet(it.memory.id, it.fault, data)
        )
    bench.run(0.3)
    (done,) = answers(bench, msg.WriteParameter("left", "ID", 7.0))
    assert isinstance(done, msg.Done), done
    assert "robot file" in done.detail
    assert twin(bench).memory.id == 7
    assert twin(bench).memory.get("Lock") == 1


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("Max_Torque", 1.0, "Max_Torque_Limit"),
        ("Model_Number", 1.0, "read only"),
        ("ID", 300.0, "it is u8, 0 … 255"),
    ],
)
def test_what_cannot_be_written_is_refused(name: str, value: float, why: str) -> None:
    bench = rig()
    bench.run(0.3)
    (refused,) = answers(bench, msg.WriteParameter("left", name, value), 0.2)
    assert isinstance(refused, msg.Refused)
    assert why in refused.reason


@pytest.mark.parametrize(("rate", "seconds"), [("1_000_000", 1.5), ("38_400", 5.0)])
def test_a_scan_finds_every_servo_with_model_and_firmware(rate: str, seconds: float) -> None:
    text = LINE.replace("OPTIONS", "feedback_ms = 20.0").replace("SETTINGS", "")
    bench = Rig(text.replace("1_000_000", rate).replace("rate_hz = 200", "rate_hz = 50"))
    bench.run(0.3)
    made = answers(bench, msg.Scan("line0"), seconds)
    found = [one for one in made if isinstance(one, msg.Found)]
    assert isinstance(made[-1], msg.Done), made
    assert sorted(one.address for one in found) == [1, 2]
    assert all("sts3215 (777), firmware 3.10" in one.detail for one in found)
    assert overlaps(bench) == 0


def test_another_model_than_in_the_robot_file_is_named_and_not_commanded() -> None:
    bench = rig('model = "sts3250"')
    number = twin(bench).memory
    number.place(3, (777).to_bytes(2, "little"))
    bench.run(0.3)
    bench.run(0.5, Position("left", 0.5))
    told = [note.text for note in notes_in(bench.ticks)]
    assert any("Model_Number is 777 (sts3215), not 2825, that of a sts3250" in text for text in told), told
    assert twin(bench).mode is Mode.READY


@pytest.mark.parametrize(("code", "name"), [(0x20, "overload"), (0x04, "overheat"), (0x01, "voltage")])
def test_an_error_is_reported_in_words_and_it_is_disarmed(code: int, name: str) -> None:
    bench = rig()
    bench.run(0.3)
    bench.run(0.5, Position("left", 0.5))
    bench.world.twin("left").provoke(code)
    bench.run(0.3)
    assert any(fault.name == name for fault in events(bench, msg.Fault))
    assert twin(bench).mode is not Mode.ARMED
    assert bench.gateway.joints["right"].mode is not Mode.FAULT


def test_scs_servos_are_read_one_after_the_other() -> None:
    bench = rig('model = "scs0009"')
    bench.run(0.3)
    bench.run(1.5, Position("left", 0.8))
    assert bench.gateway.joints["left"].feedback.position == pytest.approx(0.8, abs=0.01)
    packets = [packet.frame for tick in bench.ticks for packet in tick.outputs.packets]
    sent = {frame[4] for frame in packets if isinstance(frame, bytes)}
    assert 0x82 not in sent
    assert overlaps(bench) == 0


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (LINE.replace("OPTIONS", 'model = "scs0009", mode = "wheel"'), "a scs0009 has no mode wheel"),
        (LINE.replace("OPTIONS", "").replace("address = 2", "address = 254"), "must be 0 to 253"),
    ],
)
def test_what_cannot_be_is_refused_at_start(text: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        config.parse_robot(text.replace("SETTINGS", ""))


def position(bench: Rig) -> float:
    """Where it is said to be [rad]."""
    place = bench.gateway.joints["left"].feedback.position
    assert place is not None
    return place


def shaft(bench: Rig) -> float:
    """Where it truly is, from the zero of its offset [rad]."""
    return bench.world.world.shaft("left")[0] - twin(bench).memory.get("Homing_Offset") * 6.283185307 / 4096


@pytest.mark.parametrize(("wanted", "stored"), [("wheel", 0), ("pwm", 1), ("position", 1)])
def test_its_offset_counts_in_each_mode_although_it_subtracts_it_in_one_alone(
    wanted: str, stored: int
) -> None:
    bench = rig(f'mode = "{wanted}"', f"offset = 500, mode = {stored}, stiffness = 20.0")
    bench.run(0.5)
    seen: list[float] = []
    command: Velocity | Torque | Position = Position("left", 0.4)
    if wanted != "position":
        command = Velocity("left", 1.0) if wanted == "wheel" else Torque("left", 0.1)

    def look(_: object) -> None:
        seen.append(abs(position(bench) - shaft(bench)))

    look(None)
    bench.run(1.0, command, at=look)
    assert mode(bench, "left") is Mode.ARMED
    assert twin(bench).memory.get("Operating_Mode") == {"position": 0, "wheel": 1, "pwm": 2}[wanted]
    assert max(seen) < 0.1


def test_a_positive_share_of_the_supply_is_a_negative_number_on_the_wire() -> None:
    """And the servo then turns towards larger positions."""
    bench = rig('mode = "pwm"')
    bench.run(0.3)
    before = position(bench)
    bench.run(0.5, Torque("left", 0.5))
    assert twin(bench).memory.get("Goal_Time") == round(-0.5 / 2.94 * 1000)
    assert position(bench) > before + 0.1
