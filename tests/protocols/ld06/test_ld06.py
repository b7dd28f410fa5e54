"""Packets of the vendor's manuals and SDK; and turns of rays: what is lost, damaged, late or too slow."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from random import Random
from typing import Any

import pytest
from crccheck.crc import Crc

from brain.health import Health, HealthLevel, HealthSettings
from protocols.ld06 import plugin, table
from protocols.ld06.options import Options
from protocols.ld06.table import RAYS, Packet
from protocols.messages import MILLISECOND, SECOND, Event, Fault, LaserScan, Mode, Nanos, State
from protocols.plugin import Device
from protocols.reference_vectors import Vector, vectors_of

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
WHOLE = [
    name
    for name, vector in VECTORS.items()
    if "angles_deg" in vector.meaning and "packets" not in vector.meaning
]
STREAMS = {
    "resync_garbage_packet_partial": (1, 0),
    "stray_54_before_packet": (1, 0),
    "health_motor_blocked_then_data": (1, 0),
    "bad_crc_one_bit": (0, 1),
    "span_20deg_dropped": (1, 0),
}
"""Accepted and malformed packets, of what is more or less than one sound packet."""
START: Nanos = 1_000_000 * MILLISECOND
SAMPLES = 4500
CRC = Crc(8, 0x4D, 0, reflect_input=False, reflect_output=False, xor_output=0)


def data_of(vector: Vector) -> bytes:
    assert isinstance(vector.frame, bytes)
    return vector.frame


def lidar(line_rate: int = 0, **options: Any) -> Device:
    return Device("ld06", 1, Options(**options), plugin.settings(), line_rate)


# -- packets -----------------------------------------------------------------------------------------------


def test_no_vector_is_left_out() -> None:
    assert {*WHOLE, *STREAMS} == set(VECTORS)


@pytest.mark.parametrize("name", WHOLE)
def test_a_packet_is_read_and_written_as_the_source_does(name: str) -> None:
    data, meaning = data_of(VECTORS[name]), VECTORS[name].meaning
    packet = table.decode(data[:-1])
    assert packet is not None
    assert (packet.speed, packet.stamp) == (meaning["speed_deg_s"], meaning["timestamp_ms"])
    assert (packet.start / 100, packet.end / 100) == (meaning["start_deg"], meaning["end_deg"])
    assert list(packet.distances) == meaning["distance_mm"]
    assert list(packet.intensities) == meaning["intensity"]
    cut = 0.11 if "angle_note" in meaning else 1e-3  # the SDK cuts the step to 0.01°
    angles = [(packet.start / 100 + ray * packet.step) % 360.0 for ray in range(RAYS)]
    assert angles == pytest.approx(meaning["angles_deg"], abs=cut)
    assert table.encode(packet) == data


def test_the_checksum_is_that_of_a_package_too() -> None:
    assert table.CRC8(b"123456789") == CRC.calc(b"123456789") == 0xC3
    for vector in VECTORS.values():
        assert table.CRC8(data_of(vector)) == CRC.calc(data_of(vector))


@pytest.mark.parametrize("name", STREAMS)
def test_packets_in_a_stream_are_counted(name: str) -> None:
    driver = plugin.driver([lidar()])
    driver.receive(START, data_of(VECTORS[name]))
    assert (driver.counters.accepted, driver.counters.malformed) == STREAMS[name]


def test_an_angle_or_time_that_there_is_not_is_no_packet() -> None:
    packet = table.decode(data_of(VECTORS["nominal_10hz_10deg"])[:-1])
    assert packet is not None
    driver = plugin.driver([lidar()])
    wrong = [packet._replace(start=36_000), packet._replace(end=36_000), packet._replace(stamp=30_001)]
    for each in wrong:
        assert driver.receive(START, table.encode(each)) == []
    assert (driver.counters.accepted, driver.counters.malformed) == (0, 3)


def test_one_lidar_is_on_a_line_which_has_its_baud_rate() -> None:
    assert plugin.spec(lidar(230_400)).kind == "sensor"
    with pytest.raises(ValueError, match="one sensor is on a line"):
        plugin.spec(Device("ld06", 2, Options(), plugin.settings()))
    with pytest.raises(ValueError, match="sends with 921600 baud, not 230400"):
        plugin.spec(lidar(230_400, model="STL-27L"))


# -- turns -------------------------------------------------------------------------------------------------


@dataclass
class Sent:
    """A packet on its way."""

    t: Nanos
    """When its last ray was measured"""
    data: bytes


def turning(
    seconds: float, see: Callable[[float], float], hertz: float = 10.0, first: float = 123.4
) -> Iterator[Sent]:
    """Yield what a lidar sends; `see`: m by degrees clockwise from ahead."""
    for number in range(round(seconds * SAMPLES / RAYS)):
        times = [(number * RAYS + ray) / SAMPLES for ray in range(RAYS)]
        angles = [(first + 360.0 * hertz * at) % 360.0 for at in times]
        distances = tuple(round(1000.0 * see(angle)) for angle in angles)
        ends = (round(100.0 * angle) % table.TURN for angle in (angles[0], angles[-1]))
        at = START + round(times[-1] * SECOND)
        start, end = ends
        stamp = (at // MILLISECOND + 29_000) % table.ROUND
        packet = Packet(round(360.0 * hertz), start, distances, bytes(RAYS * (200,)), end, stamp)
        yield Sent(at, table.encode(packet))


def received(
    packets: Sequence[Sent], late: Callable[[], Nanos] = lambda: 0, driver: Any = None
) -> tuple[list[Event], Any]:
    """Return what a driver reports of these packets, which come in order."""
    driver, events, last = driver or plugin.driver([lidar()]), list[Event](), START
    for sent in packets:
        last = max(last, sent.t + late())
        events += driver.receive(last, sent.data)
    return events, driver


def scans(events: Sequence[Event]) -> list[LaserScan]:
    return [event for event in events if isinstance(event, LaserScan)]


def at(scan: LaserScan, degrees: float) -> float:
    """The range of a beam, by degrees to the left of ahead."""
    return scan.ranges[
        round((math.radians(degrees) - scan.angle_min) / scan.angle_increment) % len(scan.ranges)
    ]


def test_a_scan_goes_counter_clockwise_and_a_lidar_does_not() -> None:
    events, _ = received(list(turning(0.5, lambda angle: 1.0 if 60.0 < angle < 120.0 else 5.0)))
    found = scans(events)
    assert len(found) == 4  # the first turn was not whole
    for scan in found:
        assert (len(scan.ranges), scan.angle_min) == (450, -math.pi)
        assert scan.angle_increment == pytest.approx(math.tau / 450)
        assert [at(scan, degrees) for degrees in (-90.0, 0.0, 90.0, 180.0)] == [1.0, 5.0, 5.0, 5.0]
        assert set(scan.ranges) == {1.0, 5.0}
        assert 74 <= scan.ranges.count(1.0) <= 76


def test_a_scan_has_the_time_of_its_rays() -> None:
    """The ranges are the time: a ray has 1 m, and 1 mm for each 0.1 ms of its turn."""
    random = Random(3)
    packets = list(turning(3.0, lambda angle: 1.0 + ((angle - 180.0) % 360.0) / 360.0, first=180.0))
    late = lambda: round(random.random() ** 2 * 8 * MILLISECOND)  # noqa: E731 -- a machine's
    found = scans(received(packets, late)[0])[5:]
    assert len(found) >= 23
    for scan in found:
        assert scan.duration == pytest.approx(-100 * MILLISECOND * 449 / 450, abs=10_000)
        late_by = (scan.t - START + 50 * MILLISECOND) % (100 * MILLISECOND) - 50 * MILLISECOND
        assert abs(late_by) < 2 * MILLISECOND
        for beam in range(3, 447, 37):
            before = -scan.duration / SECOND * beam / 449
            assert scan.ranges[beam] == pytest.approx(2.0 - 10.0 * before, abs=0.006)
    assert {round((after.t - one.t) / SECOND, 1) for one, after in pairwise(found)} == {0.1}


def test_what_a_packet_takes_on_the_line_is_no_part_of_a_rays_time() -> None:
    rate = 230_400
    carried = 10 * table.PACKET_BYTES * SECOND // rate
    packets = list(turning(3.0, lambda _: 3.0, first=180.0))
    events, _ = received(packets, lambda: carried, plugin.driver([lidar(rate)]))
    found = scans(events)[5:]
    assert len(found) >= 23
    for scan in found:  # each turn ends at the rear, where the first began; stamps are whole ms
        late_by = (scan.t - START + 50 * MILLISECOND) % (100 * MILLISECOND) - 50 * MILLISECOND
        assert abs(late_by) <= MILLISECOND


def test_two_rays_on_one_surface_have_the_beam_between_them() -> None:
    def wall(angle: float) -> float:
        """One to the right, 2 m away."""
        off = math.cos(math.radians(angle - 90.0))
        return 2.0 / off if off > 0.3 else 0.0

    events, _ = received(list(turning(1.0, wall)), driver=plugin.driver([lidar(beams=360)]))
    for scan in scans(events)[1:]:
        for beam, found in enumerate(scan.ranges):
            angle = -math.degrees(scan.angle_min + beam * scan.angle_increment)
            if wall(angle - 1.0) and wall(angle + 1.0):
                assert found == pytest.approx(wall(angle), abs=0.003)


def test_what_is_lost_and_what_is_damaged_is_counted_and_costs_its_rays_alone() -> None:
    random, driver = Random(7), plugin.driver([lidar()])
    lost = damaged = 0
    sent = list[Sent]()
    packets = list(turning(4.0, lambda _: 3.0))
    for number, packet in enumerate(packets):
        chance = random.random()
        if 5 < number < len(packets) - 5 and chance < 0.05:
            lost += 1
        elif 5 < number < len(packets) - 5 and chance < 0.1:
            damaged += 1
            data = bytearray(packet.data)
            data[random.randrange(6, 46)] ^= 1 << random.randrange(8)
            sent.append(Sent(packet.t, bytes(data)))
        else:
            sent.append(packet)
    events, driver = received(sent, driver=driver)
    assert min(lost, damaged) > 40
    assert driver.counters.malformed == damaged
    assert driver.counters.accepted == len(packets) - lost - damaged
    (host,) = driver.hosts.values()
    assert host.own.lost == lost + damaged
    said = [event.detail for event in events if isinstance(event, State)]
    assert said[-1] == f"turns, {lost + damaged} packets lost"
    found = scans(events)
    assert len(found) >= 38
    gone = sum(scan.ranges.count(0.0) for scan in found)
    assert all(set(scan.ranges) <= {0.0, 3.0} for scan in found)
    assert 8 * (lost + damaged) < gone < 12 * (lost + damaged)


@pytest.mark.parametrize("gap", [30, 40, 56, 75, 90])
def test_a_gap_of_more_than_a_turn_is_counted_and_mixes_no_turns(gap: int) -> None:
    packets = list(turning(1.0, lambda _: 3.0))
    packets[:150] = list(turning(0.4, lambda _: 2.0))
    events, driver = received(packets[:150] + packets[150 + gap :])
    (host,) = driver.hosts.values()
    assert host.own.lost == gap
    assert all(len(set(scan.ranges)) == 1 for scan in scans(events) if gap > 37)
    last = max(scan.t for scan in scans(events) if scan.ranges[0] == 2.0)
    assert last <= packets[149].t


def test_a_turn_of_which_half_is_lost_is_none() -> None:
    packets = list(turning(0.6, lambda _: 3.0, first=180.0))
    events, _ = received([sent for number, sent in enumerate(packets) if not 80 < number < 105])
    assert len(scans(events)) == 3  # of four that are whole


def test_a_reading_beyond_what_the_model_measures_is_none() -> None:
    see = {0: 0.01, 1: 0.02, 2: 12.0, 3: 12.01, 4: 65.535, 5: 0.0}
    events, _ = received(list(turning(0.5, lambda angle: see[int(angle // 60.0)])))
    scan = scans(events)[-1]
    assert [at(scan, -30.0 - 60.0 * sector) for sector in see] == [0.0, 0.02, 12.0, 0.0, 0.0, 0.0]


def test_a_lidar_that_comes_back_begins_a_turn_anew() -> None:
    packets = list(turning(2.0, lambda _: 3.0))
    events, driver = received(packets[:200])
    before = scans(events)
    own, _ = driver.send(START + 3 * SECOND, [])
    assert [event.mode for event in own if isinstance(event, State)] == [Mode.OFFLINE]
    later = [Sent(sent.t + 7 * SECOND, sent.data) for sent in packets[200:400]]
    events, _ = received(later, driver=driver)
    assert [event.mode for event in events if isinstance(event, State)] == [Mode.READY]
    assert len(scans(events)) in (len(before) - 1, len(before), len(before) + 1)
    assert all(scan.t > START + 7 * SECOND for scan in scans(events))


# -- speed -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hertz", [0.0, 3.0, 14.0])
def test_a_speed_out_of_range_is_a_fault_once_it_lasts_until_it_is_well_again(hertz: float) -> None:
    driver = plugin.driver([lidar()])
    events, _ = received(list(turning(1.0, lambda _: 3.0)), driver=driver)
    assert not [event for event in events if isinstance(event, Fault)]
    wrong = [Sent(sent.t + SECOND, sent.data) for sent in turning(1.0, lambda _: 3.0, hertz=hertz)]
    events, _ = received(wrong, driver=driver)
    (fault,) = (event for event in events if isinstance(event, Fault))
    assert fault.name == "speed out of range"
    assert 450 * MILLISECOND < fault.t - START - SECOND < 550 * MILLISECOND
    (state,) = (event for event in events if isinstance(event, State))
    assert (state.mode, state.detail) == (Mode.FAULT, f"turns at {hertz:.1f} Hz")
    assert bool(scans(events)) == (hertz > 0.0)
    well = [Sent(sent.t + 2 * SECOND, sent.data) for sent in turning(0.1, lambda _: 3.0)]
    events, _ = received(well, driver=driver)
    assert [event.mode for event in events if isinstance(event, State)][:1] == [Mode.READY]


def test_health_stands_for_a_lidar_in_fault_and_is_slow_if_it_is_only_helpful() -> None:
    scan = LaserScan("ld06", SECOND, -math.pi, 0.1, 0.02, 12.0, (1.0, 2.0), -MILLISECOND)
    for helpful, level in (((), HealthLevel.HALT), (("ld06",), HealthLevel.SLOW)):
        health = Health([], ["ld06"], {"ld06": 500 * MILLISECOND}, HealthSettings(), helpful)
        health.observe([scan])
        assert health.assess(SECOND, {}).level is HealthLevel.OK
        health.observe([State("ld06", SECOND, Mode.FAULT, "turns at 3.0 Hz")])
        found = health.assess(SECOND, {})
        assert (found.level, found.reason) == (level, "ld06 is in fault: turns at 3.0 Hz")
        health.observe([State("ld06", SECOND, Mode.READY, "turns")])
        assert health.source(SECOND, "ld06").level is HealthLevel.OK


# -- the twin ----------------------------------------------------------------------------------------------


def test_what_a_twin_sees_is_what_its_driver_reports() -> None:
    device = lidar()
    twin, driver = plugin.twin(device, 0), plugin.driver([device])
    true = {number: 1.0 + number % 450 / 450 for number in range(2250)}
    events: list[Event] = []
    for step in range(500):
        first, end = (-(-each * 4500 // 1000) for each in (step, step + 1))
        times = [START + number * SECOND // 4500 for number in (first, end - 1)]
        ranges = tuple(true[number] for number in reversed(range(first, end)))
        angle, width = math.pi - math.tau * (end - 1) / 450, math.tau / 450
        part = LaserScan("ld06", times[1], angle, width, 0.02, 12.0, ranges, times[0] - times[1])
        now = START + (step + 1) * MILLISECOND
        _, frames = twin.step(now, [part])
        events += [event for frame in frames for event in driver.receive(now, frame)]
    found = scans(events)
    assert len(found) == 3
    for scan in found:
        expected = [true[450 - beam if beam else 0] for beam in range(450)]
        assert list(scan.ranges[1:]) == pytest.approx(expected[1:], abs=0.002)
        turn = round((scan.t - START) / (100 * MILLISECOND))
        assert abs(scan.t - START - turn * 100 * MILLISECOND) < 2 * MILLISECOND
