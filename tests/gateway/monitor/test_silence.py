"""What is said of a device that is not heard: the nearest cause, once, whatever the body."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing

import pytest

from gateway import config
from gateway.buses import Bus
from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.buses.adapters.pty import SerialPty
from gateway.buses.can import open_can
from gateway.buses.virtual.bus import open_world
from gateway.core.clock import SimulatedClock
from gateway.core.robot import BusSettings
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Tick
from gateway.monitor.silence import LISTENED, Silence
from gateway.runtime.loop import read, write
from gateway.runtime.session import open_session
from protocols.camera import table
from protocols.frames import BusState, CanFrame, Packet
from protocols.messages import MILLISECOND, SECOND, Imu, Marker
from protocols.plain.table import encode
from tests.gateway.rig import BENCH

STEP = 5 * MILLISECOND
END = 5 * SECOND
"""When the search for what it looks like has ended."""


def told(
    text: str, buses: Mapping[str, Bus], caplog: pytest.LogCaptureFixture, begin: Inputs | None = None
) -> list[str]:
    """Run a robot on buses; what is said of silent devices."""
    gateway = Gateway(config.parse_robot(text))
    silence = Silence(gateway, buses)
    for number in range(END // STEP):
        now = number * STEP
        states, packets = read(buses, now)
        inputs = begin if number == 0 and begin is not None else Inputs(tuple(states), tuple(packets))
        outputs = gateway.step(now, inputs)
        write(buses, now, outputs.packets)
        silence.take(Tick(number, now, inputs, outputs))
        if now < LISTENED:
            assert not caplog.messages
        elif caplog.messages:  # all is said at once
            break
    return [message for message in caplog.messages if "nothing is heard of it" in message]


@pytest.fixture
def empty() -> dict[str, Bus]:
    """A bus that nobody else is on."""
    return {"can0": open_can(BusSettings("can0", "can", "virtual:test_silence", 1_000_000), SimulatedClock())}


def world(text: str) -> Mapping[str, Bus]:
    robot = config.parse_robot(text)
    return open_world(robot, robot.seed).buses


def test_on_a_silent_bus_each_motor_is_named_once(
    empty: dict[str, Bus], caplog: pytest.LogCaptureFixture
) -> None:
    what = "nothing at all is: check supply, cable, termination and bit rate"
    assert told(BENCH, empty, caplog) == [
        f"left: nothing is heard of it at address 1 on can0: {what}",
        f"right: nothing is heard of it at address 2 on can0: {what}",
    ]


@pytest.mark.parametrize(
    ("state", "cause"),
    [
        (BusState.OFF, "the bus is off: check the wiring"),
        (BusState.PASSIVE, "the bus is error-passive"),
        (BusState.GONE, "the interface has vanished"),
    ],
)
def test_of_a_dead_bus_that_is_said(
    state: BusState, cause: str, empty: dict[str, Bus], caplog: pytest.LogCaptureFixture
) -> None:
    lines = told(BENCH, empty, caplog, Inputs(states=(("can0", state),)))
    assert len(lines) == 2
    assert all(f"on can0: {cause}" in line for line in lines)


def test_a_motor_at_another_address_is_found_there(caplog: pytest.LogCaptureFixture) -> None:
    lines = told(BENCH, world(BENCH.replace("address = 2", "address = 5")), caplog)
    assert len(lines) == 1
    assert lines[0].startswith("right: nothing is heard of it at address 2 on can0: the bus is alive (")
    assert " in the robot file: 0x0A1, 0x0A6, " in lines[0]
    assert "0x021" not in lines[0]  # of the motor that is there
    assert lines[0].endswith("; that looks like odrive_can at address 5")


def test_another_protocol_is_named(caplog: pytest.LogCaptureFixture) -> None:
    other = BENCH.replace("odrive_can", "damiao").replace('options = { watchdog = "acknowledged" }', "")
    lines = told(other, world(BENCH.replace("address = 2", "address = 9")), caplog)
    assert [line.partition(":")[0] for line in lines] == ["left", "right"]
    assert all(line.endswith("looks like odrive_can at address 1, odrive_can at address 9") for line in lines)


def test_frames_of_no_known_protocol_are_shown_by_their_ids(
    empty: dict[str, Bus], caplog: pytest.LogCaptureFixture
) -> None:
    strange = tuple(Packet(0, "can0", CanFrame(0x7A0 + number, b"?")) for number in range(12))
    (line, _) = told(BENCH, empty, caplog, Inputs(packets=strange))
    assert "the bus is alive (12 ids are heard), of no other device in the robot file: 0x7A0, 0x7A1, " in line
    assert "0x7A8" not in line
    assert "looks like" not in line


LINE = """
[buses.line]
kind = "serial"
baudrate = 115_200
interface = "twin"
[sensors.front]
protocol = "plain"
bus = "line"
address = 1
[sensors.rear]
protocol = "plain"
bus = "line"
address = 2
"""


@pytest.mark.parametrize(
    ("sent", "cause"),
    [
        (
            encode(1, Imu("", 0, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))),
            "front is, on the same line: check its supply",
        ),
        (bytes(range(60, 90)), "the line is alive, 30 bytes came: another baud rate, protocol or address"),
        (
            bytes(30),
            "the line is alive, 30 bytes came: they look like bytes sent at 9600 bit/s, and received",
        ),
        (b"", "nothing at all is: check supply, cable"),
    ],
)
def test_a_sensor_on_a_line(
    sent: bytes, cause: str, empty: dict[str, Bus], caplog: pytest.LogCaptureFixture
) -> None:
    with closing(SerialPty(BusSettings("line", "serial", "twin", baudrate=115_200))) as line:
        packets = (Packet(0, "line", sent),) if sent else ()
        lines = told(BENCH + LINE, {**empty, "line": line}, caplog, Inputs(packets=packets))
    (rear,) = [one for one in lines if one.startswith("rear: ")]
    assert f"at address 2 on line: {cause}" in rear
    assert len(lines) == (3 if "front" in cause else 4)  # with the two motors


EYE = """
[buses.eye]
kind = "camera"
interface = "twin"
[sensors.eye]
protocol = "camera"
bus = "eye"
address = 1
"""


@pytest.mark.parametrize(
    ("faults", "cause"),
    [
        (table.SIZE, "it answers, but measures nothing: 320 × 240, 30.0 pictures per second, grey 100"),
        (None, "no picture has come: see whether another program shows any, and its cable"),
    ],
)
def test_a_camera_without_a_picture_that_is_looked_at(
    faults: int | None, cause: str, empty: dict[str, Bus], caplog: pytest.LogCaptureFixture
) -> None:
    picture = table.Picture(1, 0, 320, 240, 3000, 100, faults or 0)
    packets = (Packet(0, "eye", table.encode(picture, Marker("eye", 0, None))),) if faults else ()
    with closing(SerialPty(BusSettings("eye", "serial", "twin", baudrate=115_200))) as line:
        lines = told(BENCH + EYE, {**empty, "eye": line}, caplog, Inputs(packets=packets))
    assert f"eye: nothing is heard of it at address 1 on eye: {cause}" in lines


def test_an_adapter_that_refuses_is_named(caplog: pytest.LogCaptureFixture) -> None:
    """It is set to another bit rate than the bus has."""
    with closing(AdapterPty(BusSettings("can0", "can", "twin", 500_000))) as adapters:
        settings = BusSettings("can0", "can", f"slcan:{adapters.paths[0]}", 1_000_000)
        with closing(open_can(settings, SimulatedClock())) as host:
            host.write(0, [CanFrame(1)])
            while not host.refused:
                adapters.read(0)
                host.read(0)
            lines = told(BENCH, {"can0": host}, caplog)
    assert len(lines) == 2
    assert all("its adapter refuses what it is sent (1 so far)" in line for line in lines)


def test_what_is_there_is_not_spoken_of(caplog: pytest.LogCaptureFixture) -> None:
    with open_session("diffbot", simulated=True) as session:
        for _ in session.run(2.1):
            pass
    assert "nothing is heard" not in caplog.text
