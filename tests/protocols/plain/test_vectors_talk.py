"""Conversations: what the driver sends and reports, moment by moment, and what devices obey.

On the line are the motors left (1) and right (2) and the sensor lidar (101). The bytes are those of
`published`, which knows nothing of the code under test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pytest

from protocols import messages as msg
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import Command, Event, Mode, Obeyed, Request
from protocols.plain.decoder import PlainDecoder
from protocols.plain.driver import Options, PlainDriver
from protocols.plain.twin import Settings
from protocols.plugin import Device, RxCounters
from tests.protocols.plain.published import encoded, framed, ranges

T = 1_000_000_000
MS = 1_000_000
LEFT, RIGHT, LIDAR = 1, 2, 101


def at(ms: float) -> int:
    return T + round(ms * MS)


def devices() -> list[Device]:
    kinds = (("left", LEFT, "motor"), ("right", RIGHT, "motor"), ("lidar", LIDAR, "sensor"))
    return [
        Device(name, address, Options("motor" if kind == "motor" else "sensor"), Settings(serial=address))
        for name, address, kind in kinds
    ]


@dataclass(frozen=True)
class Turn:
    """One moment: the frames received, the messages to send, and the frames and events expected."""

    ms: float
    up: Sequence[Frame] = ()
    messages: Sequence[Command | Request] = ()
    down: Sequence[bytes] = ()
    reported: Sequence[Event] = ()
    due: float | None = None
    """ms; None: not looked at."""
    bus: BusState | None = None


READY = encoded(LEFT, "State", "", 0, "ready", "")
IN_FAULT = encoded(LEFT, "State", "", 0, "fault", "")
HOT = encoded(LEFT, "Fault", "", 0, 4, "too hot", "", "")
COLD = encoded(LEFT, "Fault", "", 0, 5, "too cold", "", "")
PLACE = encoded(LEFT, "Feedback", "", 600, 1.5, None, None, None, None, None)
READS, WRITES = msg.ReadParameter("left", "supply"), msg.WriteParameter("left", "supply", 12.0)


def offline(name: str, ms: float) -> msg.State:
    return msg.State(name, at(ms), Mode.OFFLINE, "no message for 250 ms")


def late(message: str, name: str, ms: float) -> msg.Refused:
    return msg.Refused(at(ms), message, name, "no answer in 200 ms")


TALKS: dict[str, list[Turn]] = {
    "no message from the beginning is offline once": [
        Turn(0, due=250),
        Turn(249.999999, due=250),
        Turn(250, reported=[offline("left", 250), offline("right", 250)]),
        Turn(251),
        Turn(900),
    ],
    "a device that sends is not offline, and may be offline again": [
        Turn(0),
        Turn(100, up=[PLACE], reported=[msg.Feedback("left", at(100) - 600, 1.5)], due=250),
        Turn(250, reported=[offline("right", 250)], due=350),
        Turn(350, reported=[offline("left", 350)]),
        Turn(600, up=[READY], reported=[msg.State("left", at(600), Mode.READY)], due=850),
        Turn(849.9),
        Turn(850, reported=[offline("left", 850)]),
    ],
    "each request is given up, at its own time": [
        Turn(0, messages=[msg.ClearFault("left")], down=[encoded(LEFT, "ClearFault", "")], due=200),
        Turn(1, messages=[msg.Estop("right")], down=[encoded(RIGHT, "Estop", "")], due=200),
        Turn(
            2,
            messages=[msg.Zero("left"), READS],
            down=[encoded(LEFT, "Zero", ""), encoded(LEFT, "ReadParameter", "", "supply")],
        ),
        Turn(3, messages=[WRITES], down=[encoded(LEFT, "WriteParameter", "", "supply", 12.0)]),
        Turn(4, messages=[msg.Reboot("left")], down=[encoded(LEFT, "Reboot", "")]),
        Turn(199.999999),
        Turn(200, reported=[late("ClearFault", "left", 200)], due=201),
        Turn(201, reported=[late("Estop", "right", 201)], due=202),
        Turn(202, reported=[late("Zero", "left", 202), late("ReadParameter", "left", 202)]),
        Turn(204, reported=[late("WriteParameter", "left", 204), late("Reboot", "left", 204)], due=250),
        Turn(205),
    ],
    "what is answered is not given up": [
        Turn(
            0,
            messages=[msg.Zero("left"), READS],
            down=[encoded(LEFT, "Zero", ""), encoded(LEFT, "ReadParameter", "", "supply")],
        ),
        Turn(
            5,
            up=[encoded(LEFT, "Done", 0, "Zero", "", ""), encoded(LEFT, "Parameter", "", 0, "supply", 24.0)],
            reported=[msg.Done(at(5), "Zero", "left"), msg.Parameter("left", at(5), "supply", 24.0)],
        ),
        Turn(6, messages=[WRITES], down=[encoded(LEFT, "WriteParameter", "", "supply", 12.0)]),
        Turn(
            7,
            up=[encoded(LEFT, "Refused", 0, "WriteParameter", "", "no such parameter")],
            reported=[msg.Refused(at(7), "WriteParameter", "left", "no such parameter")],
        ),
        Turn(210, up=[READY], reported=[msg.State("left", at(210), Mode.READY)]),
    ],
    "an answer without a request is reported": [
        Turn(0, up=[encoded(LEFT, "Done", 0, "Zero", "", "")], reported=[msg.Done(at(0), "Zero", "left")]),
        Turn(
            1,
            up=[encoded(LEFT, "Parameter", "", 0, "supply", 24.0)],
            reported=[msg.Parameter("left", at(1), "supply", 24.0)],
        ),
    ],
    "a fault is reported once, until it is gone or the line was away": [
        Turn(0, up=[HOT, HOT], reported=[msg.Fault("left", at(0), 4, "too hot", "", "")]),
        Turn(1, up=[COLD, HOT], reported=[msg.Fault("left", at(1), 5, "too cold", "", "")]),
        Turn(2, up=[IN_FAULT, HOT], reported=[msg.State("left", at(2), Mode.FAULT)]),
        Turn(
            3,
            up=[READY, HOT],
            reported=[msg.State("left", at(3), Mode.READY), msg.Fault("left", at(3), 4, "too hot")],
        ),
        Turn(4, bus=BusState.FULL, up=[HOT]),
        Turn(5, bus=BusState.GONE, up=[HOT], reported=[msg.Fault("left", at(5), 4, "too hot")]),
        Turn(6, bus=BusState.OFF, up=[HOT], reported=[msg.Fault("left", at(6), 4, "too hot")]),
        Turn(7, bus=BusState.BACK, up=[HOT], reported=[msg.Fault("left", at(7), 4, "too hot")]),
    ],
    "a message begun is lost where the line was away, and not where it was full": [
        Turn(0, up=[PLACE[:9]]),
        Turn(1, bus=BusState.FULL),
        Turn(2, up=[PLACE[9:]], reported=[msg.Feedback("left", at(2) - 600, 1.5)]),
        Turn(3, up=[PLACE[:9]]),
        Turn(4, bus=BusState.BACK),
        Turn(5, up=[PLACE], reported=[msg.Feedback("left", at(5) - 600, 1.5)]),
    ],
    "Idle is for owned motors": [
        Turn(0, messages=[msg.Idle("left"), msg.Idle("right")]),
        Turn(1, messages=[msg.Hold("left"), msg.Idle("right")], down=[encoded(LEFT, "Hold", "")]),
        Turn(2, messages=[msg.Idle("right"), msg.Idle("left")], down=[encoded(LEFT, "Idle", "")]),
        Turn(3, messages=[msg.Idle("left")], down=[encoded(LEFT, "Idle", "")]),
        Turn(4, messages=[msg.Zero("right"), msg.Idle("right")], down=[encoded(RIGHT, "Zero", "")]),
    ],
    "a stop makes all motors owned, and what comes with it goes out": [
        Turn(
            0,
            messages=[msg.Stop(), msg.Idle("left"), msg.Idle("right")],
            down=[encoded(LEFT, "Idle", ""), encoded(RIGHT, "Idle", "")],
        )
    ],
    "commands, each to its own": [
        Turn(
            0,
            messages=[
                msg.Position("left", 1.0, 2.0, 3.0),
                msg.Velocity("right", -1.0, 0.5),
                msg.Torque("left", 0.25),
            ],
            down=[
                encoded(LEFT, "Position", "", 1.0, 2.0, 3.0),
                encoded(RIGHT, "Velocity", "", -1.0, 0.5),
                encoded(LEFT, "Torque", "", 0.25),
            ],
        ),
        Turn(
            1,
            messages=[msg.Impedance("right", 1.0, 2.0, 3.0, 4.0, 5.0)],
            down=[encoded(RIGHT, "Impedance", "", 1.0, 2.0, 3.0, 4.0, 5.0)],
        ),
    ],
    "what is refused leaves no trace, and what follows goes out": [
        Turn(
            0,
            messages=[
                msg.Velocity("missing", 1.0),
                msg.Velocity("lidar", 1.0),
                msg.Home("left"),
                msg.Release(),
                msg.Hold("right"),
            ],
            down=[encoded(RIGHT, "Hold", "")],
            reported=[
                msg.Refused(at(0), "Velocity", "missing", "no motor 'missing' on this line"),
                msg.Refused(at(0), "Velocity", "lidar", "no motor 'lidar' on this line"),
                msg.Refused(at(0), "Home", "left", "a plain device cannot do that"),
                msg.Refused(at(0), "Release", "", "a plain device cannot do that"),
            ],
        ),
        Turn(
            1,
            messages=[msg.Velocity("left", 1e9), msg.SetId("line", 2**70, 1), msg.Idle("left")],
            reported=[
                msg.Refused(
                    at(1), "Velocity", "left", "Velocity: velocity 1000000000.0 is not in -100000 … 100000"
                ),
                msg.Refused(at(1), "SetId", "line", f"SetId: {2**70} is not an integer of 64 bits"),
            ],
        ),
    ],
    "a scan reports each device, and how many": [
        Turn(0, messages=[msg.Scan("line")], down=[encoded(0, "Scan", "")], due=200),
        Turn(
            1,
            up=[
                encoded(LEFT, "Found", 0, "plain", LEFT, 10, "motor", False),
                encoded(77, "Found", 0, "plain", 77, None, "motor", False),
                encoded(LIDAR, "Found", 0, "plain", LIDAR, 30, "sensor"),
            ],
            reported=[
                msg.Found(at(1), "plain", LEFT, 10, "motor"),
                msg.Found(at(1), "plain", 77, None, "motor"),
                msg.Found(at(1), "plain", LIDAR, 30, "sensor"),
            ],
        ),
        Turn(199.999999, due=200),
        Turn(200, reported=[msg.Done(at(200), "Scan", "line", "2 found")]),
        Turn(201),
        Turn(202, messages=[msg.Scan("line")], down=[encoded(0, "Scan", "")]),
        Turn(
            210,
            up=[encoded(LEFT, "Found", 0, "plain", LEFT, 11, "motor", False)],
            reported=[msg.Found(at(210), "plain", LEFT, 11, "motor")],
        ),
        Turn(
            402,
            reported=[
                offline("left", 402),
                offline("right", 402),
                msg.Done(at(402), "Scan", "line", "1 found"),
            ],
        ),
    ],
    "a duplicate address is reported": [
        Turn(0, messages=[msg.Scan("line")], down=[encoded(0, "Scan", "")]),
        Turn(
            1,
            up=[encoded(9, "Found", 0, "plain", 9, serial, "motor", False) for serial in (5, 6, 6)],
            reported=[
                msg.Found(at(1), "plain", 9, 5, "motor"),
                msg.Found(at(1), "plain", 9, 6, "motor; address 9 is also held by 5", duplicate_address=True),
                msg.Found(at(1), "plain", 9, 6, "motor"),
            ],
        ),
        Turn(
            2,
            messages=[msg.SetId("line", 5, 9)],
            up=[encoded(9, "Found", 0, "plain", 9, 5, "motor", False)],
            down=[encoded(0, "SetId", "", 5, 9)],
            reported=[
                msg.Found(at(2), "plain", 9, 5, "motor; address 9 is also held by 6", duplicate_address=True)
            ],
        ),
        Turn(
            3,
            up=[encoded(9, "Found", 0, "plain", 9, 7, "motor", False)],
            reported=[
                msg.Found(at(3), "plain", 9, 7, "motor; address 9 is also held by 5", duplicate_address=True)
            ],
        ),
    ],
    "an address is set, by serial number, once": [
        Turn(0, messages=[msg.SetId("line", 20, 9)], down=[encoded(0, "SetId", "", 20, 9)], due=200),
        Turn(
            1,
            up=[
                encoded(9, "Found", 0, "plain", 9, 21, "motor", False),
                encoded(8, "Found", 0, "plain", 8, 20, "motor", False),
            ],
            reported=[msg.Found(at(1), "plain", 9, 21, "motor"), msg.Found(at(1), "plain", 8, 20, "motor")],
        ),
        Turn(2, messages=[msg.SetId("other", 21, 10)], down=[encoded(0, "SetId", "", 21, 10)]),
        Turn(
            3,
            up=[encoded(10, "Found", 400, "plain", 10, 21, "sensor", False)],
            reported=[
                msg.Found(at(3) - 400, "plain", 10, 21, "sensor"),
                msg.Done(at(3) - 400, "SetId", "other", "21 is now at 10"),
            ],
        ),
        Turn(200, reported=[msg.Refused(at(200), "SetId", "line", "no device has serial number 20")]),
        Turn(202),
    ],
    "of two alike one is answered by one": [
        Turn(
            0,
            messages=[msg.SetId("one", 5, 9), msg.SetId("two", 5, 9)],
            down=[encoded(0, "SetId", "", 5, 9)] * 2,
        ),
        Turn(
            1,
            up=[encoded(9, "Found", 0, "plain", 9, 5, "", False)],
            reported=[msg.Found(at(1), "plain", 9, 5), msg.Done(at(1), "SetId", "one", "5 is now at 9")],
        ),
        Turn(200, reported=[msg.Refused(at(200), "SetId", "two", "no device has serial number 5")]),
    ],
    "measurements of a sensor": [
        Turn(
            0,
            up=[encoded(LIDAR, "Imu", "", 1000, [1.0, 2.0, 3.0], [0.0, 0.0, 9.81], None)],
            reported=[msg.Imu("lidar", at(0) - 1000, (1.0, 2.0, 3.0), (0.0, 0.0, 9.81))],
        ),
        Turn(
            1,
            up=[encoded(LIDAR, "LaserScan", "", 0, 0.0, 0.5, 0.1, 10.0, ranges(1.0, 0.0, 2.0))],
            reported=[msg.LaserScan("lidar", at(1), 0.0, 0.5, 0.1, 10.0, (1.0, 0.0, 2.0))],
        ),
        Turn(
            2,
            up=[encoded(LIDAR, "Fix", "", 0, 48.0, 11.0, None, 4.0)],
            reported=[msg.Fix("lidar", at(2), 48.0, 11.0, None, 4.0)],
        ),
    ],
}


@pytest.mark.parametrize("talk", TALKS.values(), ids=TALKS)
def test_conversation(talk: list[Turn]) -> None:
    driver = PlainDriver(devices())
    for turn in talk:
        now = at(turn.ms)
        if turn.bus is not None:
            driver.bus(now, turn.bus)
        reported = [event for frame in turn.up for event in driver.receive(now, frame)]
        own, down = driver.send(now, turn.messages)
        assert list(down) == list(turn.down), turn.ms
        assert [*reported, *own] == list(turn.reported), turn.ms
        if turn.due is not None:
            assert driver.due() == at(turn.due), turn.ms


def test_sensors_alone_are_never_due() -> None:
    driver = PlainDriver(devices()[2:])
    assert driver.send(T, ()) == ([], [])
    assert driver.due() is None
    assert driver.send(at(900), ()) == ([], [])


# A message, and how it is counted: accepted, malformed, ignored.
COUNTED: dict[str, tuple[Frame, tuple[int, int, int]]] = {
    "a motor's feedback": (PLACE, (1, 0, 0)),
    "a sensor's fix": (encoded(LIDAR, "Fix", "", 0, 48.0, 11.0, None, None), (1, 0, 0)),
    "a motor's fix": (encoded(LEFT, "Fix", "", 0, 48.0, 11.0, None, None), (0, 1, 0)),
    "a sensor's state": (encoded(LIDAR, "State", "", 0, "ready", ""), (0, 1, 0)),
    "a stranger's state": (encoded(77, "State", "", 0, "ready", ""), (0, 0, 1)),
    "rubbish of a motor": (framed(b"\1rubbish"), (0, 1, 0)),
    "rubbish of a stranger": (framed(b"\7rubbish"), (0, 0, 1)),
    "an address alone": (framed(b"\1"), (0, 1, 0)),
    "an echo of a command": (encoded(LEFT, "Velocity", "", 1.0, 0.0), (0, 0, 1)),
    "an echo of a scan": (encoded(0, "Scan", ""), (0, 0, 1)),
    "a stranger found": (encoded(77, "Found", 0, "plain", 77, 5, "", False), (1, 0, 0)),
    "a stranger with the address of another": (encoded(77, "Found", 0, "plain", 78, 5, "", False), (0, 0, 1)),
    "our motor with another address": (encoded(LEFT, "Found", 0, "plain", 78, 5, "", False), (0, 1, 0)),
    "another language found": (encoded(LEFT, "Found", 0, "odrive_can", 1, 5, "", False), (0, 1, 0)),
    "a wrong CRC": (PLACE[:-1] + bytes((PLACE[-1] ^ 1,)), (0, 1, 0)),
    "noise": (b"noise", (0, 0, 1)),
    "nothing": (b"", (0, 0, 0)),
    "a CAN frame": (CanFrame(1, b"\1"), (0, 0, 1)),
}


@pytest.mark.parametrize(("frame", "counters"), COUNTED.values(), ids=COUNTED)
def test_how_a_message_is_counted(frame: Frame, counters: tuple[int, int, int]) -> None:
    driver = PlainDriver(devices())
    driver.counters = RxCounters(2, 3, 4)
    assert len(driver.receive(T, frame)) == counters[0]
    assert driver.counters == RxCounters(2 + counters[0], 3 + counters[1], 4 + counters[2])


# What stands on the line, and what the devices would obey of it.
OBEYED: dict[str, tuple[Frame, list[Obeyed]]] = {
    "a command": (
        encoded(LEFT, "Velocity", "", 1.0, 0.5),
        [msg.Arm("left"), msg.Velocity("left", 1.0, 0.5)],
    ),
    "a request": (encoded(RIGHT, "Zero", ""), [msg.Zero("right")]),
    "two at once": (
        encoded(RIGHT, "Idle", "") + encoded(LEFT, "Estop", ""),
        [msg.Idle("right"), msg.Estop("left")],
    ),
    "to a sensor": (encoded(LIDAR, "Idle", ""), []),
    "to a stranger": (encoded(77, "Idle", ""), []),
    "a command to all": (encoded(0, "Idle", ""), []),
    "a scan": (encoded(0, "Scan", ""), [msg.Scan("")]),
    "an address to be set": (encoded(0, "SetId", "", 20, 9), [msg.SetId("", 20, 9)]),
    "a scan of one": (encoded(LEFT, "Scan", ""), []),
    "an address set by one": (encoded(LEFT, "SetId", "", 20, 9), []),
    "what a motor sends": (PLACE, []),
    "what no motor does": (framed(b"\1" + bytes.fromhex("921ba0")), []),
    "rubbish": (framed(b"\1rubbish"), []),
    "a CAN frame": (CanFrame(1, b"\1"), []),
}


@pytest.mark.parametrize(("frame", "messages"), OBEYED.values(), ids=OBEYED)
def test_what_devices_obey(frame: Frame, messages: list[Obeyed]) -> None:
    assert list(PlainDecoder(devices()).decode(T, frame)) == messages


def test_the_decoder_follows_a_device_to_its_new_address() -> None:
    decoder = PlainDecoder(devices())
    decoder.follow(Device("left", 9, Options("motor"), Settings(serial=1)))
    assert decoder.decode(T, encoded(LEFT, "Idle", "") + encoded(RIGHT, "Idle", "")) == [msg.Idle("right")]
    assert decoder.decode(T, encoded(9, "Idle", "")) == [msg.Idle("left")]
