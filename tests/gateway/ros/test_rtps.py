"""Participants that speak with each other by a network that loses, doubles and swaps what they send."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

import pytest

from gateway.ros import rtps, rtps_wire
from gateway.ros.rtps import Endpoint, Match, Participant, Qos, Sample
from gateway.ros.rtps_wire import Identity, Locator
from protocols.messages import MILLISECOND, SECOND, Nanos

STRING = "std_msgs::msg::dds_::String_"


@dataclass
class Net:
    """Participants, and datagrams between them, in simulated time."""

    loss: float = 0.0
    seed: int = 1
    now: Nanos = 0
    members: dict[int, Participant] = field(default_factory=dict)
    """By the port of discovery; the port of data is the next."""
    got: dict[Participant, list[Sample]] = field(default_factory=dict)
    matches: dict[Participant, dict[int, int]] = field(default_factory=dict)
    sent: int = 0

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)

    def join(self, *endpoints: Endpoint, domain: int = 0) -> Participant:
        port = 7410 + 2 * len(self.members)
        where = Locator("127.0.0.1", port), Locator("127.0.0.1", port + 1)
        targets = [Locator("127.0.0.1", 7410 + 2 * i) for i in range(8)]
        prefix = bytes([len(self.members) + 1] * 12)
        one = self.members[port] = Participant(prefix, domain, *where, endpoints, targets)
        self.got[one], self.matches[one] = [], {}
        return one

    def run(self, seconds: float) -> None:
        end = self.now + round(seconds * SECOND)
        while self.now < end:
            self.now += 5 * MILLISECOND
            way = []
            for one in self.members.values():
                one.step(self.now)
                way += one.outgoing()
            self.sent += len(way)
            way = [w for w in way if self.random.random() >= self.loss]
            if self.loss:
                way += [w for w in way if self.random.random() < 0.1]
                self.random.shuffle(way)
            for to, data in way:
                receiver = self.members.get(to.port & ~1)
                if receiver is not None:
                    self.got[receiver] += receiver.receive(self.now, data, "127.0.0.1")
            for one in self.members.values():
                self.matches[one] |= dict(one.matches())

    def payloads(self, one: Participant) -> list[bytes]:
        return [sample.payload for sample in self.got[one]]


def writes(topic: str, **qos: bool | int) -> Endpoint:
    return Endpoint(topic, STRING, True, Qos(**qos))  # type: ignore[arg-type]


def reads(topic: str, **qos: bool | int) -> Endpoint:
    return Endpoint(topic, STRING, False, Qos(**qos))  # type: ignore[arg-type]


def numbers(count: int) -> list[bytes]:
    return [b"\x00\x01\x00\x00" + bytes([i, 0, 0, 0]) for i in range(count)]


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_what_is_reliable_comes_whole_and_in_order(loss: float) -> None:
    net = Net(loss)
    writer, reader = net.join(writes("rt/a", depth=100)), net.join(reads("rt/a"))
    net.run(4.0)
    assert net.matches[writer] == net.matches[reader] == {0: 1}
    for payload in numbers(60):
        writer.publish(net.now, 0, payload)
        net.run(0.01)
    net.run(4.0)
    assert net.payloads(reader) == numbers(60)
    assert [sample.identity for sample in net.got[reader]][:2] == [
        Identity(writer.guid(0), 1),
        Identity(writer.guid(0), 2),
    ]


def test_best_effort_is_in_order_without_repetition() -> None:
    net = Net(0.3)
    writer, reader = net.join(writes("rt/a")), net.join(reads("rt/a", reliable=False))
    net.run(4.0)
    for payload in numbers(100):
        writer.publish(net.now, 0, payload)
        net.run(0.01)
    found = net.payloads(reader)
    assert 40 < len(found) < 100
    assert found == sorted(set(found))


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_a_large_sample_comes_in_fragments(loss: float) -> None:
    net = Net(loss)
    writer, reader = (
        net.join(writes("rt/a", transient=True, depth=1)),
        net.join(reads("rt/a", transient=True)),
    )
    large = b"\x00\x01\x00\x00" + random.Random(2).randbytes(300_000)
    writer.publish(net.now, 0, large)
    net.run(12.0)
    assert net.payloads(reader) == [large]


def test_who_comes_later_gets_what_is_kept_and_nothing_else() -> None:
    net = Net()
    writer = net.join(writes("rt/kept", transient=True, depth=1), writes("rt/other"))
    for payload in numbers(5):
        writer.publish(net.now, 0, payload)
        writer.publish(net.now, 1, payload)
    net.run(1.0)
    reader = net.join(reads("rt/kept", transient=True), reads("rt/other"))
    net.run(3.0)
    assert [(one.endpoint, one.payload) for one in net.got[reader]] == [(0, numbers(5)[-1])]
    writer.publish(net.now, 1, numbers(7)[-1])
    net.run(0.5)
    assert net.got[reader][-1][:2] == (1, numbers(7)[-1])


@pytest.mark.parametrize(
    ("offered", "wanted", "match"),
    [
        ({}, {}, True),
        ({}, {"reliable": False}, True),
        ({"reliable": False}, {}, False),
        ({"reliable": False}, {"reliable": False}, True),
        ({}, {"transient": True}, False),
        ({"transient": True}, {"transient": True}, True),
        ({"transient": True}, {}, True),
    ],
)
def test_what_is_offered_and_wanted(offered: dict[str, bool], wanted: dict[str, bool], match: bool) -> None:
    net = Net()
    writer, reader = net.join(writes("rt/a", **offered)), net.join(reads("rt/a", **wanted))
    net.run(2.0)
    assert net.matches[writer] == net.matches[reader] == ({0: 1} if match else {})


def test_another_topic_type_or_domain_is_no_match() -> None:
    net = Net()
    one = net.join(writes("rt/a"))
    others = [net.join(reads("rt/b")), net.join(Endpoint("rt/a", "x::msg::dds_::Y_", False, Qos()))]
    others.append(net.join(reads("rt/a"), domain=1))
    net.run(2.0)
    assert not any(net.matches[each] for each in (one, *others))


def test_a_reply_waits_for_its_client_and_names_the_request() -> None:
    net = Net()
    server = net.join(writes("rr/a"))
    client_guid = bytes([2] * 12) + b"\x00\x00\x01\x04"
    related = Identity(client_guid, 5)
    server.reply(net.now, 0, numbers(1)[0], related, client_guid, exact=True)
    server.reply(net.now, 0, numbers(2)[1], None, bytes([9] * 16), exact=False)  # whose client never comes
    net.run(0.5)
    client = net.join(reads("rr/a"))
    net.run(4.0)
    assert [(one.payload, one.related) for one in net.got[client]] == [(numbers(1)[0], related)]


def test_who_leaves_or_falls_silent_is_forgotten() -> None:
    net = Net()
    writer, polite, _ = net.join(writes("rt/a")), net.join(reads("rt/a")), net.join(reads("rt/a"))
    net.run(2.0)
    assert net.matches[writer] == {0: 2}
    polite.leave()
    goodbye = polite.outgoing()
    net.members = {port: one for port, one in net.members.items() if one is writer}
    for _, data in goodbye:
        writer.receive(net.now, data, "127.0.0.1")
    assert writer.matches() == [Match(0, 1)]
    net.run(rtps.LEASE_S + 3.0)
    assert net.matches[writer] == {0: 0}
    for _ in range(2):
        net.run(0.005)
    writer.publish(net.now, 0, numbers(1)[0])
    before = net.sent
    net.run(0.005)
    assert net.sent == before, "there is nobody to write to"


def test_a_reader_that_acknowledges_nothing_costs_little() -> None:
    net = Net()
    writer, reader = net.join(writes("rt/a", depth=10)), net.join(reads("rt/a"))
    net.run(2.0)
    reader.receive = lambda *_: []  # type: ignore[method-assign]
    before = net.sent
    for payload in numbers(200):
        writer.publish(net.now, 0, payload)
        net.run(0.005)
    net.run(2.0)
    assert net.sent - before < 200 + 100, "each once, then heartbeats"


def test_what_others_send_is_bounded() -> None:
    """A writer that leaves gaps, fragments that are never whole, strangers: nothing grows without an end."""
    net = Net()
    writer, reader = net.join(writes("rt/a")), net.join(reads("rt/a"))
    net.run(2.0)
    source = writer.prefix
    entity = writer.guid(0)[12:]
    chance = random.Random(3)
    for number in range(5, 4000, 2):
        data = rtps_wire.Data(bytes(4), entity, number, b"\x00\x01\x00\x00")
        part = rtps_wire.Fragment(bytes(4), entity, number + 10_000, 1, 1, 1000, 1 << 20, bytes(1000))
        gap = rtps_wire.Gap(bytes(4), entity, number, 2**40, (2**40 + 1,))
        parts = [rtps_wire.write(one) for one in (data, part, gap)]
        reader.receive(
            net.now, rtps_wire.datagram(source, bytes(12), parts[: 2 + (number > 3990)]), "127.0.0.1"
        )
        stranger = chance.randbytes(12)
        announced = rtps_wire.parameter_list([
            (rtps_wire.PARTICIPANT_GUID, stranger + rtps.PARTICIPANT),
            (0x0032, rtps_wire.locator(Locator("127.0.0.1", 9))),
        ])  # fmt: skip
        spdp = rtps_wire.Data(rtps.SPDP_READER, rtps.SPDP_WRITER, 1, announced)
        reader.receive(net.now, rtps_wire.datagram(stranger, bytes(12), [rtps_wire.write(spdp)]), "127.0.0.1")
    kept = reader._by_writer[writer.guid(0)][0][1]
    assert len(kept.waiting) <= rtps.MOST_WAITING
    assert len(kept.parts) <= 4
    assert len(reader._peers) <= rtps.MOST_PARTICIPANTS


def test_bytes_that_are_damaged_raise_nothing() -> None:
    net = Net()
    one, other = (
        net.join(writes("rt/a", transient=True), reads("rt/b")),
        net.join(reads("rt/a"), writes("rt/b")),
    )
    net.run(0.2)
    chance = random.Random(4)
    for _ in range(150):
        one.publish(net.now, 0, numbers(3)[2])
        net.now += 20 * MILLISECOND
        one.step(net.now)
        for _, data in one.outgoing():
            broken = bytearray(data)
            for _ in range(chance.randrange(1, 4)):
                broken[chance.randrange(len(broken))] ^= 1 << chance.randrange(8)
            other.receive(net.now, bytes(broken), "127.0.0.1")
    net.run(3.0)
    other.publish(net.now, 1, numbers(1)[0])
    net.run(1.0)
    assert net.payloads(one)[-1] == numbers(1)[0], "it still works"
