"""Bytes of the vendor's and others' software; the conversation; turns of rays: where, when, what is lost."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from random import Random
from typing import Any

import pytest

from gateway.config import load_robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from protocols.conformance import check
from protocols.frames import Frame, Packet
from protocols.messages import (
    MILLISECOND,
    SECOND,
    Event,
    Fault,
    Idle,
    LaserScan,
    Leave,
    Mode,
    Nanos,
    State,
)
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from protocols.rplidar import capsules, plugin
from protocols.rplidar import table as rp
from protocols.rplidar.options import Options, Settings
from protocols.rplidar.table import Scan
from protocols.rplidar.wire import Wire
from protocols.toolkit.serial import Stream

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
BEAMS = 400
STREAMS = [*rp.RAYS]
ASKS = ["STOP", "GET_INFO", "GET_HEALTH", "GET_SAMPLERATE"]


def data_of(name: str) -> bytes:
    frame = VECTORS[name].frame
    assert isinstance(frame, bytes)
    return frame


def lidar(settings: Settings | None = None, **options: Any) -> Device:
    return Device("lidar", 1, Options(start=True, **options), settings or Settings(), 115_200)


# -- bytes -------------------------------------------------------------------------------------------------


def test_requests_are_those_of_others() -> None:
    ours = {
        "get_info": rp.request("GET_INFO"),
        "get_health": rp.request("GET_HEALTH"),
        "get_samplerate": rp.request("GET_SAMPLERATE"),
        "scan": rp.request("SCAN"),
        "force_scan": rp.request("FORCE_SCAN"),
        "stop": rp.request("STOP"),
        "reset": rp.request("RESET"),
        "express_scan_mode1": rp.express_scan(1),
        "set_motor_pwm_660": rp.pwm(660),
        "get_lidar_conf_desired_speed": rp.request("GET_LIDAR_CONF", b"\1\0\0\0"),
        "get_lidar_conf_us_per_sample_mode1": rp.request("GET_LIDAR_CONF", bytes.fromhex("710000000100")),
    }
    assert ours == {name: v.frame for name, v in VECTORS.items() if v.direction == "to_device"}
    for name, frame in ours.items():
        assert plugin.messages(frame) == (VECTORS[name].meaning["cmd"],)


def test_answers_of_a_twin_are_those_that_others_read() -> None:
    twin = plugin.twin(Device("lidar", 1, Options(), Settings()), 0)
    asked = {
        "GET_INFO": data_of("info_reply_a1m8"),
        "GET_HEALTH": data_of("health_reply_good"),
        "GET_SAMPLERATE": data_of("samplerate_reply"),
        "SCAN": data_of("scan_descriptor"),
    }
    for at, (command, answer) in enumerate(asked.items()):
        twin.receive(at * MILLISECOND, rp.request(command))
        assert twin.step(at * MILLISECOND, ())[1] == [answer]
    twin.receive(SECOND, rp.express_scan(0))
    assert twin.step(SECOND, ())[1] == [data_of("express_descriptor")]
    twin.provoke(2)
    twin.receive(SECOND, rp.request("SCAN") + rp.request("GET_HEALTH"))
    assert twin.step(SECOND, ())[1] == [data_of("health_reply_error_8001")]
    twin.receive(SECOND, rp.request("RESET"))
    assert list(twin.step(2 * SECOND, ())[1]) == [
        b"RP LIDAR System.\r\nFirmware Ver 1.29 - rtm, HW Ver 7\r\nModel: 18\r\n"
    ]


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ("70", "0400"),  # of modes: standard, and up to ultra
        ("7c", "0100"),
        ("75 0000", "81"),
        ("75 0100", "85"),
        ("75 0200", "83"),
        ("75 0300", "84"),
        ("71 0000", "00fc0100"),  # 508 µs · 256
        ("74 0100", "000c0000"),  # 12 m · 256
        ("7f 0300", "426f6f737400"),  # Boost
        ("01", "58029402"),  # 600 rpm, by a duty of 660
        ("7b", None),
    ],
)
def test_it_tells_the_vendors_software_what_that_asks_before_it_scans(asked: str, told: str | None) -> None:
    """Slamtec's SDK (pyrplidarsdk 0.1.2 carries it) starts no scan without; numbers by its sl_lidar_cmd.h."""
    number, *mode = (bytes.fromhex(part) for part in asked.split())
    kind = number + bytes(3)
    twin = plugin.twin(lidar(), 0)
    twin.receive(0, rp.request("GET_LIDAR_CONF", kind + b"".join(mode)))
    data = b"" if told is None else kind + bytes.fromhex(told)
    head = b"\xa5\x5a" + len(data).to_bytes(4, "little") + b"\x20"
    assert twin.step(0, [])[1] == ([head + data] if data else [])


@pytest.mark.parametrize("name", [n for n in VECTORS if n.startswith("scan_node")])
def test_nodes_are_those_of_others(name: str) -> None:
    data, meaning = data_of(name), VECTORS[name].meaning
    assert rp.is_node(data, 0) == (not VECTORS[name].wrong)
    if VECTORS[name].wrong:
        return
    one = rp.node(data)
    assert (one.first, one.quality) == (meaning["new_scan"], meaning["quality"])
    assert (one.angle, one.distance) == (meaning["angle_deg"], meaning["distance_mm"])
    assert rp.encode_node(one) == data


def capsule(data: bytes, scan: str, after: bytes = b"") -> capsules.Capsule:
    return capsules.Capsule(*capsules.head(data), *capsules.rays(data, scan, after))


def test_capsules_are_those_of_others() -> None:
    data, meaning = data_of("express_capsule_pair_wrap")[:84], VECTORS["express_capsule_pair_wrap"].meaning
    one = capsule(data, "express")
    said = meaning["capsule1"]
    assert (one.first, one.start) == (said["start_of_stream"], said["start_deg"])
    assert (list(one.distances), list(one.offsets)) == (said["distance_mm"], said["offset_deg"])
    assert capsules.is_sound(data, "express")
    assert capsules.encode_capsule(one, "express") == data
    assert not capsules.is_sound(data_of("express_capsule_bad_checksum")[:84], "express")
    pair = data_of("dense_capsule_pair")
    one, two = capsule(pair[:84], "dense"), capsule(pair[84:], "dense")
    nodes = VECTORS["dense_capsule_pair"].meaning["nodes_of_capsule1"]
    assert [float(each) for each in one.distances[: len(nodes)]] == [each["distance_mm"] for each in nodes]
    for at, each in enumerate(nodes):
        assert one.start + at * (two.start - one.start) / 40 == pytest.approx(each["angle_deg"], abs=0.03)
    assert capsules.encode_capsule(one, "dense") + capsules.encode_capsule(two, "dense") == pair


def test_ultra_capsules_are_those_of_the_vendors_software() -> None:
    pair, meaning = data_of("ultra_capsule_pair"), VECTORS["ultra_capsule_pair"].meaning
    first, then = pair[:132], pair[132:]
    assert capsules.is_sound(first, "ultra")
    assert capsules.is_sound(then, "ultra")
    one = capsule(first, "ultra", then)
    said = meaning["capsule1"]
    assert (one.first, one.start) == (said["start_of_stream"], said["start_deg"])
    step = (meaning["capsule2"]["start_deg"] - one.start) % 360.0 / 96
    nodes = meaning["nodes_of_capsule1"]
    assert [each * 4 for each in one.distances] == [each["dist_mm_q2"] for each in nodes]
    assert len({each for each in one.distances if each}) > 60
    for at, each in enumerate(nodes):
        off = one.start + at * step - one.offsets[at] - each["angle_z_q14"] * 90.0 / 16384.0
        assert abs((off + 180.0) % 360.0 - 180.0) < 0.03
    after = capsule(then, "ultra").distances[0]
    assert capsules.encode_capsule(one, "ultra", after) == first


def test_packets_of_hq_are_those_of_the_vendors_software() -> None:
    data, nodes = data_of("hq_packet"), VECTORS["hq_packet"].meaning["nodes"]
    assert capsules.is_sound(data, "hq")
    angles, found = capsules.packet(data)
    assert [angle * 16384.0 / 90.0 for angle in angles] == [each["angle_z_q14"] for each in nodes]
    assert [mm * 4.0 for mm in found] == [each["dist_mm_q2"] for each in nodes]
    told = [(each["flag"] & 1 == 1, each["quality"]) for each in nodes]
    rays = [rp.Node(*one, *ray) for one, ray in zip(told, zip(angles, found, strict=True), strict=True)]
    assert capsules.encode_packet(123456789, rays) == data
    assert not capsules.is_sound(data[:300] + bytes((data[300] ^ 8,)) + data[301:], "hq")


# -- a lidar and its driver --------------------------------------------------------------------------------


@dataclass
class Rig:
    """A driver, a twin, and what that sees; bytes arrive in the next ms, or `late`."""

    device: Device
    see: Callable[[float], float] = lambda _: 3.0
    """m by degrees clockwise from ahead"""
    hertz: float = 10.0
    late: Callable[[], Nanos] = lambda: 0
    lose: Callable[[bytes], bytes] = lambda data: data

    def __post_init__(self) -> None:
        self.driver, self.twin = plugin.driver([self.device]), plugin.twin(self.device, 0)
        self.now: Nanos = 0
        self.sent: list[Frame] = []
        self.events: list[Event] = []
        self.way: list[tuple[Nanos, bytes]] = []
        self.arrived: Nanos = 0

    def run(self, seconds: float, messages: Sequence[Idle] = ()) -> list[Event]:
        """Go on; return what is reported."""
        before = len(self.events)
        for _ in range(round(seconds * 1000)):
            self.step(messages)
        return self.events[before:]

    def step(self, messages: Sequence[Idle]) -> None:
        self.now += MILLISECOND
        while self.way and self.way[0][0] <= self.now:
            t, data = self.way.pop(0)
            self.events += self.driver.receive(t, data)
        own, frames = self.driver.send(self.now, messages)
        self.events += own
        self.sent += frames
        for frame in frames:
            self.twin.receive(self.now, frame)
        for each in self.twin.step(self.now, [self.part()])[1]:
            assert isinstance(each, bytes)
            self.arrived = max(self.arrived, self.now + len(each) * 86_806 + self.late())
            if data := self.lose(each):
                self.way.append((self.arrived, data))

    def part(self) -> LaserScan:
        """What the rays of the last ms have seen."""
        apart, width = SECOND / self.hertz / BEAMS, 360.0 / BEAMS
        numbers = range(math.ceil((self.now - MILLISECOND) / apart), math.ceil(self.now / apart))
        ranges = tuple(self.see(number * width % 360.0) for number in reversed(numbers))
        first, last = (round(number * apart) for number in (numbers[0], numbers[-1]))
        angle = math.radians(-numbers[-1] * width)
        return LaserScan("lidar", last, angle, math.radians(width), 0.1, 20.0, ranges, first - last)

    def names(self) -> list[str]:
        return [name for frame in self.sent for name in plugin.messages(frame)]


def scans(events: Sequence[Event]) -> list[LaserScan]:
    return [event for event in events if isinstance(event, LaserScan)]


def at(scan: LaserScan, degrees: float) -> float:
    """The range of a beam, by degrees to the left of ahead."""
    return scan.ranges[
        round((math.radians(degrees) - scan.angle_min) / scan.angle_increment) % len(scan.ranges)
    ]


def test_by_default_nothing_is_sent() -> None:
    rig = Rig(Device("lidar", 1, Options(), Settings(), 115_200))
    rig.run(5.0)
    assert rig.sent == []
    assert "start = true" in plugin.spec(rig.device).caution


@pytest.mark.parametrize("scan", STREAMS)
def test_it_is_asked_then_scans_counter_clockwise(scan: Scan) -> None:
    rig = Rig(lidar(scan=scan), lambda angle: 1.0 if 60.0 < angle < 120.0 else 5.0)
    events = rig.run(2.0)
    begins = "SCAN" if scan == "standard" else "EXPRESS_SCAN"
    assert rig.names() == [*ASKS, "GET_HEALTH", begins]
    found = scans(events)
    assert len(found) >= 11
    for each in found:
        assert (len(each.ranges), each.angle_min) == (400, -math.pi)
        assert [at(each, degrees) for degrees in (-90.0, 0.0, 90.0, 180.0)] == [1.0, 5.0, 5.0, 5.0]
        assert 64 <= each.ranges.count(1.0) <= 69
    assert [each.detail for each in events if isinstance(each, State)][-1] == "scans"


@pytest.mark.parametrize("scan", STREAMS)
def test_a_scan_has_the_time_of_its_rays(scan: Scan) -> None:
    """The ranges are the time: 1 m at the rear, and 1 cm more for each ms of the turn."""
    random = Random(3)
    rig = Rig(lidar(scan=scan), lambda angle: 1.0 + (angle - 180.0) % 360.0 / 360.0)
    rig.late = lambda: round(random.random() ** 2 * 8 * MILLISECOND)
    found = scans(rig.run(6.0))[10:]
    assert len(found) >= 40
    for each in found:
        assert each.duration == pytest.approx(-100 * MILLISECOND * 399 / 400, rel=0.03)
        for beam in range(5, 395, 38):
            t = each.t + each.duration * beam / 399
            turned = (t / SECOND * 3600.0 - 180.0) % 360.0  # by a true clock
            off = each.ranges[beam] - 1.0 - turned / 360.0
            # 4 ms; of the twin of an ultra scan 12° more, since it waits for what near rays see
            assert abs((off + 0.5) % 1.0 - 0.5) < 0.04 + 0.033 * (scan == "ultra")


def test_with_pwm_its_motor_is_started_first() -> None:
    rig = Rig(lidar(Settings(motor="pwm"), motor="pwm", model="A2M8"))
    rig.run(3.0)
    names = rig.names()
    assert names[:5] == [*ASKS, "SET_MOTOR_PWM"]
    assert names[-1] == "EXPRESS_SCAN"
    assert len(scans(rig.events)) > 10


def test_given_idle_it_stops_scan_and_motor_until_it_is_given_no_more() -> None:
    rig = Rig(lidar(Settings(motor="pwm"), motor="pwm", model="A2M8"))
    rig.run(2.0)
    rig.sent.clear()
    events = rig.run(1.0, [Idle("lidar")])
    assert rig.sent[:2] == [rp.request("STOP"), rp.pwm(0)]
    assert set(rig.sent) == {rp.request("STOP"), rp.pwm(0)}
    assert len(rig.sent) == 100  # each 20 ms: one may be lost
    assert len(scans(events)) <= 1
    assert len(scans(rig.run(3.0))) > 10


def test_what_was_not_started_is_not_stopped() -> None:
    rig = Rig(lidar())
    rig.lose = lambda _: b""
    rig.run(1.0)
    before = len(rig.sent)
    rig.run(1.0, [Idle("lidar")])
    assert rig.sent[before:] == []


def test_the_end_of_a_run_stops_it_through_the_guard() -> None:
    gateway = Gateway(load_robot("diffbot_rplidar"))
    answers = ["info_reply_a1m8", "health_reply_good", "samplerate_reply"]
    now, sent = SECOND, list[Frame]()

    def step(*data: bytes, leave: bool = False) -> list[Frame]:
        nonlocal now
        now += 40 * MILLISECOND
        packets = tuple(Packet(now, "lidar", each) for each in data)
        made = gateway.step(now, Inputs((), packets, (Leave("done"),) if leave else ()))
        return [packet.frame for packet in made.packets if packet.bus == "lidar"]

    for name in (None, None, *answers):
        sent += step(*([data_of(name)] if name else []))
    assert sent[-1] == rp.pwm(660)
    assert step(leave=True) == [rp.request("STOP"), rp.pwm(0)]
    assert [p.frame for p in gateway.leave(now + SECOND) if p.bus == "lidar"] == [
        rp.request("STOP"),
        rp.pwm(0),
    ]
    assert gateway.stopped == "done"  # and no driver has failed, no frame was blocked


def test_its_protection_stop_is_a_fault_that_ends_when_it_is_well_again() -> None:
    rig = Rig(lidar())
    rig.run(2.0)
    rig.twin.provoke(2)
    events = rig.run(1.0)
    (fault,) = (event for event in events if isinstance(event, Fault))
    assert fault.name == "protection stop"
    (state,) = (event for event in events if isinstance(event, State) and event.mode is Mode.FAULT)
    assert state.detail == "is asked how it is, health 2, error 0x8001"
    assert not scans(rig.run(2.0))
    rig.twin.receive(rig.now, rp.request("RESET"))  # as switched off and on
    assert len(scans(rig.run(4.0))) > 10
    assert rig.driver.hosts["lidar"].mode is Mode.READY  # type: ignore[attr-defined]


def test_one_wrong_bit_in_its_health_is_no_fault() -> None:
    rig = Rig(lidar())
    wrong = [data_of("health_reply_error_8001")]
    rig.lose = lambda data: wrong.pop() if wrong and data == data_of("health_reply_good") else data
    events = rig.run(2.0)
    assert not wrong
    assert not [event for event in events if isinstance(event, Fault)]
    assert len(scans(events)) > 10


def test_another_model_than_stated_is_said() -> None:
    rig = Rig(lidar(model="A2M8"))
    events = rig.run(2.0)
    assert [e.detail for e in events if isinstance(e, State)][-1] == "scans, is no A2M8: model 0x18"


@pytest.mark.parametrize(("scan", "size", "rays"), [("express", 84, 32), ("ultra", 132, 96), ("hq", 781, 96)])
def test_what_is_lost_or_damaged_costs_its_rays_alone_and_is_counted(
    scan: Scan, size: int, rays: int
) -> None:
    random, rig = Random(7), Rig(lidar(scan=scan))
    gone = 0

    def lose(data: bytes) -> bytes:
        nonlocal gone
        if len(data) != size or random.random() > 0.05:
            return data
        gone += 1
        broken = bytearray(data)
        broken[random.randrange(2, size)] ^= 1 << random.randrange(8)
        return bytes(broken) if gone % 2 else b""

    rig.run(2.0)
    rig.lose = lose
    events = rig.run(8.0)
    assert gone > 9
    rig.lose = lambda data: data
    rig.run(0.1)
    assert rig.driver.counters.malformed == (gone + 1) // 2
    assert rig.driver.hosts["lidar"].own.turn.lost == gone  # type: ignore[attr-defined]
    found = scans(events)
    assert len(found) >= 78
    assert all(set(each.ranges) <= {0.0, 3.0} for each in found)
    assert 0.75 * rays * gone < sum(each.ranges.count(0.0) for each in found) < 1.25 * rays * gone


def test_the_place_among_nodes_is_found_again_behind_lost_bytes() -> None:
    """Nodes have no checksum: what is read wrongly in between are a few at most."""
    random, wire = Random(5), Stream(Wire("standard"))
    true = [rp.Node(at % 400 == 0, 47, at * 0.9 % 360.0, 1000.0 + at % 400) for at in range(4000)]
    known, stream = {rp.encode_node(each) for each in true}, b""
    for each in true:
        data = rp.encode_node(each)
        cut = random.random() < 0.01
        stream += data[: random.randrange(5)] if cut else data
    got = [one for at in range(0, len(stream), 7) for one in wire.feed(stream[at : at + 7])]
    nodes = [one for one in got if isinstance(one, bytes)]
    assert len([one for one in nodes if one not in known]) < 16
    assert len([one for one in nodes if one in known]) > 3900


@dataclass(frozen=True)
class Express(Options):
    """As by a robot file that has it started."""

    start: bool = True


@dataclass(frozen=True)
class Standard(Express):
    """The same, without capsules."""

    scan: Scan = "standard"


@dataclass(frozen=True)
class Dense(Express):
    """The same, in capsules that are dense."""

    scan: Scan = "dense"


@dataclass(frozen=True)
class Ultra(Express):
    """The same, in ultra capsules."""

    scan: Scan = "ultra"


@dataclass(frozen=True)
class Hq(Express):
    """The same, in packets of HQ."""

    scan: Scan = "hq"


@pytest.mark.parametrize(
    "options",
    [Express, *(pytest.param(each, marks=pytest.mark.prove) for each in (Standard, Dense, Ultra, Hq))],
)
def test_started_it_keeps_the_contract(options: type[Options]) -> None:
    """That of all plugins is by default options: silent."""
    results = check(replace(plugin, options=options), options=[options()], brief=True)
    # An ultra capsule cannot tell a step of some metres from ray to ray: those of the clause are no readings.
    beyond = {"measurements"} if options is Ultra else set()
    assert {result.clause for result in results if result.outcome == "failed"} == beyond
    passed = {result.clause for result in results if result.outcome == "passed"}
    assert {"counts", "faults", "measurements", "checksums"} - beyond <= passed
