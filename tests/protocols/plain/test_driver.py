from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from protocols import messages as msg
from protocols.conformance.bench import Bench
from protocols.frames import BusState, CanFrame
from protocols.messages import MILLISECOND, Command, Mode, Request
from protocols.plain import codec, plugin
from protocols.plain.driver import ANSWER, OFFLINE
from protocols.plugin import RxCounters
from tests.protocols.plain.bench import ask, bench, reported

T = 1_000_000_000


def received(stage: Bench, *messages: bytes, t: int = T) -> list[Any]:
    return [event for data in messages for event in stage.driver.receive(t, data)]


# -- up ------------------------------------------------------------------------------------------------


def test_measurements_are_stamped_with_the_packets_time_less_their_age() -> None:
    stage = bench(sensors=["imu"], motors=[])
    word = msg.Imu("", 400, (1.0, 2.0, 3.0), (0.0, 0.0, 9.81))
    assert received(stage, codec.encode(101, word, now=1000)) == [
        msg.Imu("imu", T - 600, word.angular_velocity, word.linear_acceleration)
    ]


def test_each_address_has_its_own_name() -> None:
    stage = bench(motors=["left", "right"])
    words = [codec.encode(address, msg.Feedback("", 0, float(address))) for address in (2, 1)]
    assert received(stage, *words) == [msg.Feedback("right", T, 2.0), msg.Feedback("left", T, 1.0)]


# Who says what, and how it is counted: heard, bad, foreign.
COUNTED: list[tuple[str, bytes | CanFrame, tuple[int, int, int]]] = [
    ("a motor's feedback", codec.encode(1, msg.Feedback("", 0, 1.0)), (1, 0, 0)),
    ("a sensor's scan", codec.encode(101, msg.LaserScan("", 0, 0.0, 0.1, 0.1, 10.0, (1.0,))), (1, 0, 0)),
    ("a motor's scan", codec.encode(1, msg.LaserScan("", 0, 0.0, 0.1, 0.1, 10.0, (1.0,))), (0, 1, 0)),
    ("a sensor's feedback", codec.encode(101, msg.Feedback("", 0, 1.0)), (0, 1, 0)),
    ("a stranger's feedback", codec.encode(77, msg.Feedback("", 0, 1.0)), (0, 0, 1)),
    ("rubbish from a motor", codec.frame(b"\1rubbish"), (0, 1, 0)),
    ("rubbish from a stranger", codec.frame(b"\7rubbish"), (0, 0, 1)),
    ("an address alone", codec.frame(b"\1"), (0, 1, 0)),
    ("an echo of our command", codec.encode(1, msg.Velocity("", 1.0)), (0, 0, 1)),
    ("an echo of our scan", codec.encode(0, msg.Scan("")), (0, 0, 1)),
    ("a stranger found", codec.encode(77, msg.Found(0, "plain", 77, 5)), (1, 0, 0)),
    ("one who says he is another", codec.encode(77, msg.Found(0, "plain", 78, 5)), (0, 0, 1)),
    ("our motor says it is another", codec.encode(1, msg.Found(0, "plain", 78, 5)), (0, 1, 0)),
    ("another language found", codec.encode(1, msg.Found(0, "odrive_can", 1, 5)), (0, 1, 0)),
    ("a wrong CRC", codec.encode(1, msg.Feedback("", 0, 1.0))[:-1] + b"\0", (0, 1, 0)),
    ("noise", b"noise", (0, 0, 1)),
    ("no bytes", b"", (0, 0, 0)),
    ("a CAN frame", CanFrame(1, b"\1"), (0, 0, 1)),
]


@pytest.mark.parametrize(("frame", "counters"), [c[1:] for c in COUNTED], ids=[c[0] for c in COUNTED])
def test_counted(frame: bytes | CanFrame, counters: tuple[int, int, int]) -> None:
    stage = bench(sensors=["lidar"])
    events = stage.driver.receive(T, frame)
    assert stage.driver.counters == RxCounters(*counters)
    assert len(events) == counters[0]


def test_a_fault_is_told_once_until_it_is_gone() -> None:
    stage = bench()
    fault = codec.encode(1, msg.Fault("", 0, 4, "too hot"))
    other = codec.encode(1, msg.Fault("", 0, 5, "too cold"))
    in_fault, ready = (codec.encode(1, msg.State("", 0, mode)) for mode in (Mode.FAULT, Mode.READY))
    assert received(stage, fault, fault) == [msg.Fault("m", T, 4, "too hot")]
    assert received(stage, other, fault, in_fault, fault) == [
        msg.Fault("m", T, 5, "too cold"),
        msg.State("m", T, Mode.FAULT),
    ]
    assert received(stage, ready, fault) == [msg.State("m", T, Mode.READY), msg.Fault("m", T, 4, "too hot")]


def test_a_line_that_was_away_loses_the_message_begun_and_tells_faults_again() -> None:
    stage = bench()
    fault, feedback = (
        codec.encode(1, msg.Fault("", 0, 4, "too hot")),
        codec.encode(1, msg.Feedback("", 0, 1.0)),
    )
    received(stage, fault, feedback[:10])
    stage.driver.bus(T, BusState.GONE)
    stage.driver.bus(T, BusState.BACK)
    assert [type(event) for event in received(stage, feedback, fault)] == [msg.Feedback, msg.Fault]
    assert stage.driver.counters == RxCounters(accepted=3)


def test_a_full_queue_does_not_break_the_message_begun() -> None:
    stage, feedback = bench(), codec.encode(1, msg.Feedback("", 0, 1.0))
    received(stage, feedback[:10])
    stage.driver.bus(T, BusState.FULL)
    assert received(stage, feedback[10:]) == [msg.Feedback("m", T, 1.0)]


# -- down ----------------------------------------------------------------------------------------------


def sent(stage: Bench, *words: Command | Request) -> list[Any]:
    return list(stage.driver.send(T, words)[1])


def test_idle_goes_only_to_whom_we_have_claimed() -> None:
    stage = bench(motors=["left", "right"])
    assert sent(stage, msg.Idle("left"), msg.Idle("right")) == []
    assert len(sent(stage, msg.Velocity("left", 1.0), msg.Idle("right"))) == 1
    assert sent(stage, msg.Idle("left"), msg.Idle("right")) == [codec.encode(1, msg.Idle(""))]


COMMANDS: list[Command] = [
    msg.Hold("m"),
    msg.Position("m", 1.0, 2.0, 3.0),
    msg.Velocity("m", 1.0, 2.0),
    msg.Torque("m", 1.0),
]


@pytest.mark.parametrize("word", COMMANDS, ids=repr)
def test_a_command_becomes_one_message(word: Command) -> None:
    stage = bench()
    assert sent(stage, word) == [codec.encode(1, word)]
    assert stage.decoder.decode(T, codec.encode(1, word)) == [word]


REFUSED: list[tuple[Command | Request, str]] = [
    (msg.Velocity("m", float("nan")), "not in"),
    (msg.Velocity("m", 1e9), "not in"),
    (msg.Velocity("nobody", 1.0), "no motor 'nobody'"),
    (msg.Velocity("lidar", 1.0), "no motor 'lidar'"),
    (msg.ClearFault("lidar"), "no motor 'lidar'"),
    (msg.Home("m"), "cannot do that"),
    (msg.Release(), "cannot do that"),
    (msg.WriteParameter("m", "velocity_gain", float("inf")), "not finite"),
    (msg.WriteParameter("m", "x" * 20_000, 1.0), "a body of"),
    (msg.SetId("line", 2**70, 1), "64 bits"),
]


@pytest.mark.parametrize(("word", "reason"), REFUSED, ids=[type(word).__name__ for word, _ in REFUSED])
def test_refused_at_once_and_nothing_goes_out(word: Command | Request, reason: str) -> None:
    stage = bench(sensors=["lidar"])
    events, frames = stage.driver.send(T, [word])
    (refused,) = events
    assert isinstance(refused, msg.Refused)
    assert refused.request == type(word).__name__
    assert reason in refused.reason
    assert frames == []
    assert sent(stage, msg.Idle("m")) == []  # it has not been claimed either


def test_a_command_that_is_refused_anew_is_told_once_until_one_was_not() -> None:
    stage = bench()
    said = [msg.Velocity("m", 1e9), msg.Velocity("m", 1e9), msg.Velocity("m", 1.0), msg.Velocity("m", 1e9)]
    assert [len(stage.driver.send(T, [word])[0]) for word in said] == [1, 0, 0, 1]
    assert [len(stage.driver.send(T, [msg.Home("m")])[0]) for _ in range(2)] == [1, 1]


def test_an_operators_stop_lets_idle_through_to_a_motor_that_was_not_claimed() -> None:
    stage = bench()
    assert sent(stage, msg.Idle("m")) == []
    assert sent(stage, msg.Stop()) == []
    assert sent(stage, msg.Idle("m")) == [codec.encode(1, msg.Idle("m"))]


REQUESTS: list[Request] = [
    msg.ClearFault("m"),
    msg.Estop("m"),
    msg.Zero("m"),
    msg.ReadParameter("m", "supply"),
    msg.WriteParameter("m", "supply", 12.0),
    msg.Reboot("m"),
]


@pytest.mark.parametrize("request_", REQUESTS, ids=lambda word: type(word).__name__)
def test_a_request_without_an_answer_is_refused_in_time(request_: Request) -> None:
    stage = bench()
    sent(stage, request_)
    assert stage.driver.due() is not None
    assert stage.driver.send(T + ANSWER - 1, ())[0] == []
    (refused,) = stage.driver.send(T + ANSWER, ())[0]
    assert refused == msg.Refused(T + ANSWER, type(request_).__name__, "m", "no answer in 200 ms")
    assert stage.driver.send(T + ANSWER + 1, ())[0] == []


@pytest.mark.parametrize("request_", REQUESTS, ids=lambda word: type(word).__name__)
def test_a_request_is_answered_by_the_device_and_then_no_more(request_: Request) -> None:
    stage = bench()
    stage.steps(5)
    said = ask(stage, request_, steps=400)
    (answer,) = reported(said, (msg.Done, msg.Refused, msg.Parameter))
    assert isinstance(answer, msg.Parameter if isinstance(request_, msg.ReadParameter) else msg.Done)


def test_silence_is_offline_once_and_speaking_ends_it() -> None:
    stage = bench(sensors=["lidar"])
    assert stage.driver.due() is None
    assert stage.driver.send(T, ())[0] == []
    assert stage.driver.due() == T + OFFLINE
    assert stage.driver.send(T + OFFLINE - 1, ())[0] == []
    assert stage.driver.send(T + OFFLINE, ())[0] == [
        msg.State("m", T + OFFLINE, Mode.OFFLINE, "no message for 250 ms")
    ]
    assert stage.driver.due() is None
    assert stage.driver.send(T + 2 * OFFLINE, ())[0] == []
    received(stage, codec.encode(1, msg.Feedback("", 0, 1.0)), t=T + 2 * OFFLINE)
    assert stage.driver.send(T + 3 * OFFLINE - 1, ())[0] == []
    (again,) = stage.driver.send(T + 3 * OFFLINE, ())[0]
    assert again == msg.State("m", T + 3 * OFFLINE, Mode.OFFLINE, "no message for 250 ms")


# -- the whole line ------------------------------------------------------------------------------------


def test_scan_finds_motors_and_sensors_and_ends() -> None:
    stage = bench(sensors=["lidar"], motors=["left", "right"])
    said = ask(stage, msg.Scan("line"), steps=250)
    assert [(f.address, f.serial, f.detail) for f in reported(said, msg.Found)] == [
        (1, 10, "motor"),
        (2, 20, "motor"),
        (101, 1010, "sensor"),
    ]
    assert [(d.request, d.name, d.detail) for d in reported(said, msg.Done)] == [("Scan", "line", "3 found")]
    assert {state.mode for state in reported(said, msg.State)} == {Mode.READY}


def test_an_address_held_twice_is_told() -> None:
    stage = bench()
    events = received(
        stage, *(codec.encode(9, msg.Found(0, "plain", 9, serial, "motor")) for serial in (5, 6, 6))
    )
    assert [event.detail for event in events] == [
        "motor",
        "motor; address 9 is also held by 5",
        "motor",
    ]


def test_set_id_moves_the_one_device_with_this_serial_number() -> None:
    stage = bench(motors=["left", "right"])
    stage.steps(5)
    said = ask(stage, msg.SetId("line", 20, 9), steps=300)
    assert [(f.address, f.serial) for f in reported(said, msg.Found)] == [(9, 20)]
    assert [(d.request, d.detail) for d in reported(said, msg.Done)] == [("SetId", "20 is now at 9")]
    assert {f.motor for f in reported(said[20:], msg.Feedback)} == {"left"}
    assert [(s.motor, s.mode) for s in reported(said, msg.State) if s.mode == Mode.OFFLINE] == [
        ("right", Mode.OFFLINE)
    ]


@pytest.mark.parametrize(("serial", "address"), [(99, 9), (10, 0), (10, 256)])
def test_set_id_that_nobody_follows_is_refused_in_time(serial: int, address: int) -> None:
    stage = bench()
    said = ask(stage, msg.SetId("line", serial, address), steps=300)
    (refused,) = reported(said, msg.Refused)
    assert refused.request == "SetId"
    assert reported(said, msg.Done) == []


def test_set_id_reaches_a_sensor_too() -> None:
    stage = bench(sensors=["gps"], motors=[])
    said = ask(stage, msg.SetId("line", 1010, 7))
    assert [f.address for f in reported(said, msg.Found)] == [7]


# -- the contract --------------------------------------------------------------------------------------


def test_a_sensor_is_what_a_plain_device_is_unless_told() -> None:
    spec = bench(sensors=["lidar"], motors=[]).specs[0]
    assert spec.kind == "sensor"
    assert not spec.commands
    assert spec.requests == frozenset[type[Request]]((msg.Scan, msg.SetId))
    assert plugin.options().kind == "sensor"
    assert {name.partition(".")[0] for name in spec.ranges} == {"Imu", "LaserScan", "Fix"}


@pytest.mark.parametrize(("watchdog", "enabled", "holds"), [(100.0, True, False), (0.0, False, True)])
def test_the_watchdog_decides_whether_a_motor_holds_unattended(
    watchdog: float, enabled: bool, holds: bool
) -> None:
    spec = bench(watchdog_ms=watchdog).specs[0]
    assert (spec.watchdog.enabled, spec.holds_unattended) == (enabled, holds)
    assert spec.watchdog.timeout == (round(watchdog * MILLISECOND) or None)


def test_an_address_out_of_range_is_an_error_of_configuration() -> None:
    device = bench().devices[0]
    for address in (0, 256, -1):
        with pytest.raises(ValueError, match="1 … 255"):
            plugin.spec(replace(device, address=address))


READ_ONLY: list[tuple[bytes | CanFrame, bool]] = [
    (codec.encode(0, msg.Scan("")), True),
    (codec.encode(1, msg.ReadParameter("", "supply")), True),
    (codec.encode(0, msg.Scan("")) + codec.encode(1, msg.ReadParameter("", "supply")), True),
    (codec.encode(0, msg.Scan("")) + codec.encode(1, msg.Idle("")), False),
    (codec.encode(1, msg.Idle("")), False),
    (codec.encode(1, msg.ClearFault("")), False),
    (codec.encode(0, msg.SetId("", 1, 2)), False),
    (codec.encode(0, msg.Scan("")) + codec.encode(1, msg.Idle(""))[:-1], False),
    (codec.encode(0, msg.Scan(""))[:-1], False),
    (b"x", False),
    (CanFrame(1, remote=True), False),
]


@pytest.mark.parametrize(("frame", "harmless"), READ_ONLY)
def test_read_only(frame: bytes | CanFrame, harmless: bool) -> None:
    assert bench().specs[0].read_only(frame) is harmless
