"""Four controllers in one frame, and turns counted from an angle within one."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Feedback, Mode, Nanos, State
from protocols.plugin import Device, Driver
from protocols.robomaster import plugin
from protocols.robomaster.options import Options, Settings
from protocols.robomaster.table import COUNTS, RPM, TABLE

NAMES = [f"m{address}" for address in range(1, 9)]
COUNT = Options().torque
"""N·m of one count of current"""


def eight(only: Sequence[int] = range(1, 9)) -> Driver:
    """A driver of controllers with these addresses, all of which report."""
    driver = plugin.driver([Device(f"m{at}", at, Options(), Settings()) for at in only])
    report(driver, 0, only)
    return driver


def report(driver: Driver, t: Nanos, addresses: Sequence[int] = range(1, 9)) -> dict[str, Mode]:
    """Let controllers report that they stand still, without current. Returns the modes that change."""
    frames = [feedback(at, 0, 0) for at in addresses]
    events = [event for frame in frames for event in driver.receive(t, frame)]
    return {event.motor: event.mode for event in events if isinstance(event, State)}


def feedback(address: int, angle: int, rpm: int) -> Frame:
    return TABLE.encode(
        "feedback", number=address, angle=angle, velocity=rpm, current=0, temperature=30, error=0
    )


def torques(**counts: int) -> list[msg.Torque]:
    return [msg.Torque(name, count * COUNT) for name, count in counts.items()]


def sent(driver: Driver, now: Nanos, messages: Sequence[msg.Command]) -> dict[int, list[int]]:
    """The currents that are sent, by id."""
    frames = driver.send(now, messages)[1]
    found: dict[int, list[int]] = {}
    for frame in frames:
        assert isinstance(frame, CanFrame)
        assert frame.id not in found
        found[frame.id] = [
            int.from_bytes(frame.data[at : at + 2], "big", signed=True) for at in range(0, 8, 2)
        ]
    return found


def armed(*names: str) -> Driver:
    """A driver of all eight, of which these are armed."""
    driver = eight()
    driver.send(0, [msg.Torque(name, 0.0) for name in names])
    assert report(driver, MILLISECOND) == dict.fromkeys(names, Mode.ARMED)
    return driver


def test_a_step_sends_one_frame_for_a_group_with_the_newest_of_all() -> None:
    driver = armed(*NAMES)
    wanted = dict(zip(NAMES, (100, -200, 300, -400, 5, 6, 7, 8), strict=True))
    assert sent(driver, MILLISECOND, torques(**wanted)) == {
        0x200: [100, -200, 300, -400],
        0x1FF: [5, 6, 7, 8],
    }


def test_a_group_of_which_none_is_commanded_is_sent_nothing() -> None:
    driver = armed("m6")
    assert sent(driver, MILLISECOND, torques(m6=9)) == {0x1FF: [0, 9, 0, 0]}
    assert sent(driver, 2 * MILLISECOND, [msg.Idle(name) for name in NAMES]) == {0x1FF: [0, 0, 0, 0]}
    assert sent(eight(), 0, [msg.Idle(name) for name in NAMES]) == {}


def test_one_that_is_not_commanded_any_more_is_let_go_by_the_frame_of_the_others() -> None:
    driver = armed("m1", "m2")
    assert sent(driver, MILLISECOND, torques(m1=50, m2=60)) == {0x200: [50, 60, 0, 0]}
    assert sent(driver, 2 * MILLISECOND, torques(m1=50)) == {0x200: [50, 0, 0, 0]}
    assert report(driver, 3 * MILLISECOND) == {"m2": Mode.READY}


def test_a_slot_of_no_motor_of_ours_is_zero() -> None:
    driver = eight([2, 4])
    assert sent(driver, 0, torques(m2=50, m4=60)) == {0x200: [0, 1, 0, 1]}  # armed first
    report(driver, MILLISECOND, [2, 4])
    assert sent(driver, MILLISECOND, torques(m2=50, m4=60)) == {0x200: [0, 50, 0, 60]}


def test_a_late_torque_that_is_too_small_to_be_told_is_ended() -> None:
    """0.016 N·m are 0.02 A of a GM6020: less than `idle_current`, and obeyed until its timeout, 500 ms."""
    device = Device("m", 1, Options(model="GM6020"), Settings())
    driver, twin = plugin.driver([device]), plugin.twin(device, 0)
    up: Sequence[Frame] = ()
    late = TABLE.encode("0x1FE", first=118, second=0, third=0, fourth=0)
    obeyed = []
    for ms in range(2000):
        now = ms * MILLISECOND
        for frame in up:
            driver.receive(now, frame)
        command = msg.Torque("m", 0.1) if ms < 100 else msg.Idle("m")
        down = [*driver.send(now, [command])[1], *([late] if ms == 1500 else [])]
        for frame in down:
            twin.receive(now, frame)
        (torque,), up = twin.step(now, [Feedback("m", now, 0.0, 0.0)])
        obeyed += [ms] if torque.torque and ms >= 100 else []
    assert obeyed
    assert (obeyed[0], obeyed[-1] < 1550) == (1500, True)


@pytest.mark.parametrize("address", [0, 9])
def test_an_id_that_a_controller_cannot_have(address: int) -> None:
    with pytest.raises(ValueError, match="it must be 1 to 8"):
        plugin.spec(Device("m", address, Options(), Settings()))


def test_a_gm6020_and_a_c620_share_no_frame_and_no_id() -> None:
    gm6020 = Options(model="GM6020")
    wheel, low, high = Device("wheel", 5, Options(), Settings()), ("low", 1), ("high", 6)
    with pytest.raises(ValueError, match="low and wheel both report by 0x205"):
        plugin.driver([wheel, Device(*low, gm6020, Settings())])
    driver = plugin.driver([wheel, Device(*high, gm6020, Settings())])
    for number in (5, 10):
        driver.receive(0, feedback(number, 0, 0))
    assert sent(driver, 0, torques(wheel=50, high=0)) == {0x1FF: [1, 0, 0, 0], 0x2FE: [0, 1, 0, 0]}


def test_turns_are_counted_through_lost_frames() -> None:
    """A rotor at up to 4,500 rpm with up to 1,500 rad/s², of whose reports up to 20 in a row are lost."""
    seed = random.randrange(1 << 30)
    print(f"{seed=}")
    rng = random.Random(seed)
    driver, position, velocity, reported = eight([1]), 0.0, 0.0, 0.0
    push, lost, most = 0.0, 0, 450.0
    for ms in range(1, 20_000):
        push = rng.uniform(-1500.0, 1500.0) if rng.random() < 0.01 else push
        velocity = max(-most, min(most, velocity + 1e-3 * push))
        position += 1e-3 * velocity
        lost = rng.randrange(21) if lost == 0 and rng.random() < 0.02 else max(lost - 1, 0)
        if lost:
            continue
        angle = round(position * COUNTS / math.tau) % COUNTS
        events = driver.receive(ms * MILLISECOND, feedback(1, angle, round(velocity / RPM)))
        (reported,) = [e.position for e in events if isinstance(e, Feedback) and e.position is not None]
        assert reported == pytest.approx(position, abs=math.tau / COUNTS)
