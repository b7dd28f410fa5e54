"""The independent vectors at the driver: messages become the package's bytes, and its bytes become events."""

from __future__ import annotations

from dataclasses import replace
from math import tau

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Event, Mode, Request
from protocols.moteus import RANGES, plugin
from protocols.moteus.codec import make_frame, reply_id
from protocols.moteus.driver import MoteusDriver
from protocols.moteus.options import Options
from protocols.reference_vectors import vectors_of
from tests.protocols.helpers import of
from tests.protocols.moteus.helpers import device, rev

VECTORS = {vector.name: vector.frame for vector in vectors_of(plugin)}
LIMITED = Options(max_torque=1.5, velocity_limit=4.0 * tau, acceleration_limit=20.0 * tau)
NO_ACCEL = replace(LIMITED, acceleration_limit=0.0)
AT = "21000a" + "2f010000803e0000000000000000" + "210f00"
"""Running, at 0.25 rev."""


class Talk:
    """A driver of device 5, which receives the replies of the device as bytes."""

    def __init__(self, options: Options | None = None, address: int = 5) -> None:
        self.options = options or Options()
        self.driver = MoteusDriver([device(address=address, options=self.options)], RANGES)
        self.now = 1_000_000 * MILLISECOND
        self.reply = reply_id(address, self.options.host_id, self.options.can_prefix)
        self.send()

    def handle(self, data: str | Frame) -> list[Event]:
        frame = make_frame(self.reply, bytes.fromhex(data)) if isinstance(data, str) else data
        return list(self.driver.receive(self.now, frame))

    def step(self, *messages: Command | Request) -> tuple[list[Event], list[CanFrame]]:
        """What the driver reports and sends 5 ms on."""
        self.now += 5 * MILLISECOND
        events, sent = self.driver.send(self.now, messages)
        return list(events), [frame for frame in sent if isinstance(frame, CanFrame)]

    def send(self, *messages: Command | Request) -> list[CanFrame]:
        return self.step(*messages)[1]

    def running(self) -> Talk:
        """In position control, and its details known for now."""
        self.handle(AT)
        self.send()
        self.handle(AT)
        return self


POSITION = msg.Position("left", rev(0.25), rev(-1.5), 0.125)
VELOCITY = msg.Velocity("left", rev(-1.5), 0.125)
TORQUE = msg.Torque("left", 0.125)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("position_watchdog_0.1s", Options(), POSITION),
        ("velocity_watchdog_0.1s", Options(), VELOCITY),
        ("torque_watchdog_0.1s", Options(), TORQUE),
        ("position_limited", LIMITED, POSITION),
        ("position_limited_no_accel", NO_ACCEL, POSITION),
        ("velocity_limited", LIMITED, VELOCITY),
    ],
)
def test_a_command_is_the_vector_of_its_values(name: str, options: Options, message: Command) -> None:
    talk = Talk(options).running()
    for _ in range(5):
        talk.send(message)
        talk.handle(AT)
    assert talk.send(message) == [VECTORS[name]]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [("position_full_query", Options(), POSITION), ("torque_limited", LIMITED, TORQUE)],
)
def test_now_and_then_the_details_are_queried_for(name: str, options: Options, message: Command) -> None:
    talk = Talk(options).running()
    sent: list[Frame] = []
    for _ in range(41):  # 205 ms
        sent += talk.send(message)
        talk.handle(AT)
    assert sent.count(VECTORS[name]) == 1


@pytest.mark.parametrize(
    ("name", "options", "address"),
    [
        ("stop_with_query", Options(), 5),
        ("stop_id_100", Options(), 100),
        ("stop_host_3", Options(host_id=3), 5),
        ("stop_prefix", Options(can_prefix=0x1ABC), 5),
    ],
)
def test_a_stop_is_the_vector(name: str, options: Options, address: int) -> None:
    talk = Talk(options, address).running()
    talk.send(POSITION)
    talk.handle(AT)
    assert talk.send(msg.Idle("left"))[0] == VECTORS[name]
    talk.handle(AT.replace("21000a", "210001", 1))  # in fault meanwhile: no other stop goes out ...
    assert VECTORS[name] not in [f for _ in range(20) for f in talk.send(msg.Idle("left"))]
    assert VECTORS[name] in talk.send(msg.ClearFault("left"))  # ... but the operator's


def test_queries_are_the_vectors() -> None:
    talk = Talk()
    sent = [frame for _ in range(60) for frame in talk.send()]
    assert set(sent) == {VECTORS["query_fast"], VECTORS["query_full"]}


def test_vectors_of_replies_are_reported_in_si() -> None:
    talk = Talk()
    motion = msg.Feedback("left", talk.now, -0.125 * tau, 1.5 * tau, -0.75)
    assert talk.handle(VECTORS["reply_fast"]) == [
        motion,
        msg.State("left", talk.now, Mode.ARMED, "position"),
    ]
    (detailed,) = talk.handle(VECTORS["reply_full"])
    assert isinstance(detailed, msg.Feedback)
    assert detailed.temperature == pytest.approx(41.3)
    assert replace(detailed, temperature=None) == replace(motion, current=10.0, voltage=24.5)
    (plain,) = talk.handle(VECTORS["query_default_reply"])
    assert plain == replace(motion, voltage=24.5, temperature=41.0)


def test_values_that_are_not_given_report_nothing() -> None:
    talk = Talk()
    assert of(msg.Feedback, talk.handle(VECTORS["reply_nan"])) == []
    assert not [f for f in talk.send(POSITION) if f.data[:1] == b"\x01"]  # where it is, is not known
    assert talk.handle(VECTORS["reply_int8_nan"]) == []
    assert talk.driver.counters.accepted == 2
