"""Transmit queues: what replaces what while it waits, in which order the rest is sent, and how much waits."""

from __future__ import annotations

from collections import Counter
from random import Random

import pytest

from gateway.buses.queues import MOST_WAITING, PATIENCE, FrameQueue, Patience
from protocols.frames import CanFrame
from protocols.plugin import Device, load


def queue_of(protocol: str, devices: int = 2) -> FrameQueue:
    plugin = load(protocol)
    made = (Device(f"m{at}", at, plugin.options(), plugin.settings()) for at in range(1, devices + 1))
    return FrameQueue([plugin.spec(device) for device in made])


class Wire:
    """Takes so many frames, and keeps them."""

    def __init__(self, room: int = 0) -> None:
        self.room = room
        self.sent: list[CanFrame] = []

    def send(self, frame: CanFrame) -> bool:
        taken = self.room > 0
        self.room -= taken
        self.sent += [frame] if taken else []
        return taken


def refuse(_: CanFrame) -> bool:
    return False


def frame_of(text: str) -> CanFrame:
    """A frame in candump's notation."""
    number, _, data = text.partition("#")
    remote = data == "R"
    return CanFrame(int(number, 16), b"" if remote else bytes.fromhex(data), len(number) > 3, remote)


SPEED, SLOWER, ANGLE = "141#A200000010270000", "141#A200000001000000", "141#9200000000000000"
SHUTDOWN, LOCK, FAULTS = "141#8000000000000000", "141#7800000000000000", "141#9A00000000000000"


@pytest.mark.parametrize(
    ("protocol", "writes", "sent"),
    [
        pytest.param("myactuator", [[SPEED, ANGLE]], [SPEED, ANGLE], id="two of one write"),
        pytest.param("myactuator", [[SHUTDOWN, LOCK]], [SHUTDOWN, LOCK], id="two commands of one write"),
        pytest.param("myactuator", [[SPEED, ANGLE], [SLOWER, ANGLE]], [SLOWER, ANGLE], id="a later write"),
        pytest.param(
            "myactuator",
            [[SHUTDOWN], [FAULTS], [ANGLE]],
            [SHUTDOWN, FAULTS, ANGLE],
            id="questions, and a command",
        ),
        pytest.param(
            "damiao",
            [["7FF#0100CC0000000000", "7FF#0200CC0000000000"], ["7FF#0100CC0000000000"]],
            ["7FF#0200CC0000000000", "7FF#0100CC0000000000"],
            id="questions to all by one id",
        ),
        pytest.param(
            "robstride",
            [["01800001#AA"], ["01812301#BB", "01812302#CC"], ["0187FF01#DD"]],
            ["0187FF01#DD", "01812302#CC"],
            id="a torque in the id",
        ),
        pytest.param(
            "odrive_can",
            [["027#01000000"], ["02B#0200000001000000", "02D#00", "027#08000000"]],
            ["02B#0200000001000000", "02D#00", "027#08000000"],
            id="order of the newest write",
        ),
        pytest.param(
            "robomaster",
            [["200#0001000100010001"], ["200#0002000200020002"]],
            ["200#0002000200020002"],
            id="shared",
        ),
        pytest.param(
            "vesc",
            [["123#01", "124#01"], ["123#02"], ["123#R"]],
            ["123#02", "123#R", "124#01"],
            id="not declared",
        ),
    ],
)
def test_a_later_write_replaces_what_waits_of_earlier_ones(
    protocol: str, writes: list[list[str]], sent: list[str]
) -> None:
    queue, wire = queue_of(protocol), Wire(100)
    for write in writes:
        queue.give([frame_of(text) for text in write], refuse)
    queue.drain(wire.send)
    assert list(map(str, wire.sent)) == sent
    assert queue.dropped == sum(map(len, writes)) - len(sent)


def test_of_three_hundred_set_points_with_a_torque_in_their_ids_one_waits() -> None:
    queue = queue_of("robstride")
    for torque in range(300):
        queue.give([CanFrame(0x0100_0001 | torque << 8, bytes(8), extended=True)], refuse)
    assert (len(queue), queue.dropped) == (1, 299)


@pytest.mark.parametrize("room", [1, 3, 10])
def test_devices_take_turns_on_a_bus_that_is_given_too_much(room: int) -> None:
    """Eight devices are given two frames each in a step, of which some are sent."""
    queue, wire = queue_of("odrive_can", 8), Wire()
    frames = [CanFrame(device << 5 | what, bytes(8)) for device in range(1, 9) for what in (0x0C, 0x0D)]
    for _ in range(1600):
        wire.room = room
        queue.drain(wire.send)
        queue.give(frames, wire.send)
    counts = Counter(frame.id >> 5 for frame in wire.sent)
    assert len(counts) == 8
    assert min(counts.values()) >= 0.98 * max(counts.values())


def test_what_waits_is_bounded_and_the_oldest_is_dropped() -> None:
    queue, wire = FrameQueue(), Wire(2)
    for number in range(MOST_WAITING + 3):
        queue.give([CanFrame(number)], refuse)
    queue.drain(wire.send)
    assert wire.sent == [CanFrame(3), CanFrame(4)]
    queue.clear()
    assert (len(queue), queue.dropped) == (0, 3 + MOST_WAITING - 2)
    queue.give([CanFrame(number) for number in range(2 * MOST_WAITING)], Wire(3).send)
    assert len(queue) == MOST_WAITING


def test_over_random_writes_a_devices_order_is_kept_and_the_newest_of_each_id_is_sent() -> None:
    """Ids of two devices, one that both share, and one of neither. Each frame carries a number."""
    ids = (0x021, 0x027, 0x02D, 0x047, 0x04D, 0x7E6, 0x123)
    for seed in range(100):
        random, queue, wire = Random(seed), queue_of("odrive_can"), Wire()
        given = list[CanFrame]()
        for _ in range(50):
            wire.room = random.randrange(6)
            queue.drain(wire.send)
            frames = [
                CanFrame(random.choice(ids), (len(given) + at).to_bytes(8, "big"))
                for at in range(random.randrange(8))
            ]
            queue.give(frames, wire.send, wait=random.random() < 0.2)
            given += frames
        wire.room = 1000
        queue.drain(wire.send)
        assert {f.id: f for f in wire.sent} == {f.id: f for f in given}, seed
        for device in (1, 2, 0x123 >> 5):
            numbers = [f.data for f in wire.sent if f.id >> 5 == device]
            assert numbers == sorted(numbers), seed
        assert len(wire.sent) + queue.dropped == len(given)


def test_patience_is_over_when_something_is_held_all_the_time() -> None:
    patience = Patience()
    held = [
        (0, False),
        (PATIENCE, True),
        (PATIENCE + 1, True),
        (PATIENCE + 2, False),
        (2 * PATIENCE + 2, True),
    ]
    assert [patience.is_over(now, holds=holds) for now, holds in held] == [False, False, True, False, False]
