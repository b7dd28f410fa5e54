"""Two boards and a stranger's on one line, every tenth answer lost: none is taken for another's."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import pytest

from protocols import messages as msg
from protocols.line import Exchange, Line, Rank
from protocols.messages import MILLISECOND, Feedback, Mode, Nanos, Velocity
from protocols.plugin import Device, join
from protocols.roboclaw import plugin
from protocols.roboclaw import table as rt
from protocols.roboclaw.options import Options, Settings
from protocols.toolkit.motor_driver import MotorDriver

STEP: Nanos = MILLISECOND // 2
OPTIONS = Options(counts=8192, timeout_ms=500, offline_ms=400, feedback_ms=5)
SPEEDS = {"a1": 1.0, "a2": -2.0, "b1": 3.0, "b2": -4.0}
"""rad/s of each shaft: an answer that is taken for another's shows at once."""
ADDRESSES = {"a1": 0x80, "a2": 0x88, "b1": 0x81, "b2": 0x89}


@dataclass
class Rig:
    """A line with four motors of two boards and a third board that another driver asks."""

    lose: int = 0
    """One in so many answers is lost,"""
    late: int = 0
    """and one in so many comes 30 ms late."""
    now: Nanos = 1_000 * MILLISECOND
    answers: int = 0
    events: list[msg.Event] = field(default_factory=list)
    arriving: list[tuple[Nanos, bytes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        devices = [Device(name, at, OPTIONS, Settings()) for name, at in ADDRESSES.items()]
        self.driver = plugin.driver(devices)
        self.stranger = plugin.driver([Device("s1", 0x82, OPTIONS, Settings())])
        self.line = Line(460_800, half_duplex=False)
        self.twins = [plugin.twin(each, at) for at, each in enumerate(devices)]
        self.twins.append(plugin.twin(Device("s1", 0x82, OPTIONS, Settings()), 9))
        join(self.twins)
        self.places = dict.fromkeys((*ADDRESSES, "s1"), 0.0)

    def step(self, commands: list[Velocity]) -> None:
        """Advance; the shafts turn as they are told, exactly."""
        self.now += STEP
        now = self.now
        while self.arriving and self.arriving[0][0] <= now:
            ended, _ = self.line.receive(now, self.arriving.pop(0)[1])
            for each in ended:
                self._answer(each.owner, each.exchange, each.data)
        for each in self.line.expire(now):
            self._answer(each.owner, each.exchange, each.data)
        if now % (5 * MILLISECOND) == 0:
            for owner, (driver, given) in enumerate(((self.driver, commands), (self.stranger, []))):
                events, frames = driver.send(now, given)
                self.events += events
                self.line.put(owner, [frame for frame in frames if isinstance(frame, bytes)])
        sent = self.line.take(now)
        for name, twin in zip(self.places, self.twins, strict=True):
            self.places[name] += SPEEDS.get(name, 50.0) * STEP * 1e-9
            for _, frame in sent:
                twin.receive(now, bytes(frame))
            truth = Feedback(name, now, self.places[name], SPEEDS.get(name, 50.0))
            for answer in twin.step(now, [truth])[1]:
                self._comes(answer)

    def _comes(self, answer: object) -> None:
        assert isinstance(answer, bytes)
        self.answers += 1
        if self.lose and self.answers % self.lose == 0:
            return
        late = 30 * MILLISECOND if self.late and self.answers % self.late == 0 else 0
        self.arriving = sorted([*self.arriving, (self.now + STEP + late, answer)])

    def _answer(self, owner: int, asked: Exchange, data: bytes) -> None:
        driver = (self.driver, self.stranger)[owner]
        assert isinstance(driver, MotorDriver)
        events = driver.answer(self.now, asked, data)
        self.events += [] if owner else events


@pytest.mark.parametrize(("lose", "late"), [(0, 0), (10, 0), (0, 10), (10, 7)])
def test_no_answer_is_taken_for_another(lose: int, late: int) -> None:
    rig = Rig(lose, late)
    for at in range(2400):
        rig.step([Velocity(name, speed) for name, speed in SPEEDS.items()] if at > 500 else [])
    modes = {each.motor: each.mode for each in rig.events if isinstance(each, msg.State)}
    assert modes == dict.fromkeys(ADDRESSES, Mode.ARMED)
    assert not [each for each in rig.events if isinstance(each, msg.Fault)]
    measured = [each for each in rig.events if isinstance(each, Feedback)]
    assert len(measured) > 400
    for name, speed in SPEEDS.items():
        own = [each for each in measured if each.motor == name]
        turning = [each.velocity for each in own if each.velocity is not None]
        assert turning == pytest.approx([speed] * len(turning), abs=OPTIONS.unit)
        places = [(each.t, each.position) for each in own if each.position is not None]
        began = 1_000 * MILLISECOND
        slack = 0.001 + abs(speed) * (0.04 if late else 0.01)
        assert all(abs(place - speed * (t - began) * 1e-9) < slack for t, place in places)
        gaps = [after - before for (before, _), (after, _) in pairwise(places)]
        assert max(gaps) < (80 if late else 40) * MILLISECOND  # a lost one costs one, and the turns of others


def test_both_motors_of_a_board_go_in_one_message() -> None:
    rig = Rig()
    for at in range(2000):
        rig.step([Velocity(name, speed) for name, speed in SPEEDS.items()] if at > 500 else [])
    rig.line.drop()
    driver = rig.driver
    _, frames = driver.send(rig.now + 5 * MILLISECOND, [Velocity(name, 1.0) for name in SPEEDS])
    points = [each for each in frames if isinstance(each, Exchange) and each.rank is Rank.SET_POINT]
    assert [rt.PACKETS.names(bytes(each)) for each in points] == [("MIXEDSPEED",)] * 2
    _, frames = driver.send(rig.now + 10 * MILLISECOND, [Velocity("a1", 1.0), msg.Idle("a2")])
    names = [rt.PACKETS.names(each) for each in frames]
    assert ("M1SPEED",) in names
    assert ("M2DUTY",) in names


def test_counts_go_on_beyond_32_bits() -> None:
    driver = plugin.driver([Device("a1", 0x80, OPTIONS, Settings())])
    assert isinstance(driver, MotorDriver)
    question = rt.PACKETS.encode("GETM1ENC", 0x80)
    raw = (0, 0x7000_0000, 0xE000_0000, 0x4000_0000, 0xFFFF_FFFF, 0x8000_0000, 0x1000_0000)
    places = []
    for at, count in enumerate(raw):
        answer = rt.answer(question, "GETM1ENC", count=count, status=0)
        events = driver.answer(at, Exchange(question), answer)
        places += [each.position for each in events if isinstance(each, Feedback)]
    counts = [round((place or 0.0) / OPTIONS.unit) for place in places]
    assert counts == [0, 0x7000_0000, 0xE000_0000, 0x1_4000_0000, 0xFFFF_FFFF, 0x8000_0000, 0x1000_0000]


def test_an_acknowledgement_is_the_last_byte() -> None:
    written = rt.PACKETS.encode("M1SPEED", 0x80, speed=1)
    assert rt.find_answer(written, b"\xff") == (0, 1)
    assert rt.find_answer(written, b"\0\x54\xff") == (2, 3)
    for other in (b"", b"\xfe", b"\xff\xff\xcf\xc7\x82\x94\xbe"):
        assert rt.find_answer(written, other) is None


def test_a_pause_ends_a_message() -> None:
    device = Device("a1", 0x80, OPTIONS, Settings())
    whole = rt.PACKETS.encode("M1SPEED", 0x80, speed=1000)
    for pause, obeyed in ((9 * MILLISECOND, True), (11 * MILLISECOND, False)):
        decoder = plugin.decoder([device])
        assert not decoder.decode(MILLISECOND, whole[:5])
        assert bool(decoder.decode(MILLISECOND + pause, whole[5:])) is obeyed
