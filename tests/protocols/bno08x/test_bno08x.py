"""Packets as another reader decodes them; rates that are those of the heading; gaps."""

from __future__ import annotations

import math
from typing import Any

import pytest

from protocols.bno08x import plugin, table
from protocols.bno08x.driver import Options
from protocols.bno08x.table import Packet
from protocols.bno08x.twin import Settings
from protocols.messages import MILLISECOND, SECOND, Imu, State
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}


def sensor(**options: Any) -> Device:
    return Device("imu", 1, Options(**options), Settings(), 115_200)


@pytest.mark.parametrize("name", [name for name, vector in VECTORS.items() if not vector.wrong])
def test_a_packet_is_that_of_another_reader(name: str) -> None:
    data, meaning = VECTORS[name].frame, VECTORS[name].meaning
    assert isinstance(data, bytes)
    packet = table.decode(data[:-1])
    assert packet is not None
    said = [meaning[each] for each in ("yaw_deg", "pitch_deg", "roll_deg")]
    assert [each / 100.0 for each in packet[1:4]] == pytest.approx(said)
    pushed = [meaning[each] for each in ("x_m_s2", "y_m_s2", "z_m_s2")]
    assert [each * table.MG for each in packet[4:]] == pytest.approx(pushed, rel=1e-5)  # 0.0098067
    assert (packet.number, table.encode(packet)) == (meaning["index"], data)


def test_a_wrong_checksum_is_counted() -> None:
    driver, wrong = plugin.driver([sensor()]), VECTORS["bad_checksum"].frame
    assert driver.receive(SECOND, wrong) == []
    assert (driver.counters.accepted, driver.counters.malformed) == (0, 1)


@pytest.mark.parametrize(("yaw", "sign"), [("counter-clockwise", 1.0), ("clockwise", -1.0)])
def test_the_rates_add_up_to_the_heading_over_gaps_and_a_turn(yaw: str, sign: float) -> None:
    driver: Any = plugin.driver([sensor(yaw=yaw)])
    sum_of_rates, last, readings = 0.0, 0, list[Imu]()
    for number in range(600):
        if number % 50 in (7, 8) or 300 < number < 306:
            continue  # lost
        heading = round(math.remainder(1.2 * number, 360.0) * 100.0)
        t = SECOND + number * 10 * MILLISECOND
        packet = table.encode(Packet(number % 256, heading, 0, 0, 0, 0, 1000))
        for event in driver.receive(t, packet):
            if isinstance(event, Imu):
                readings.append(event)
                sum_of_rates += event.angular_velocity[2] * (number - last) * 0.01
        last = number
    assert {round(each.angular_velocity[2] * sign, 3) for each in readings} == {round(math.radians(120.0), 3)}
    assert sum_of_rates == pytest.approx(sign * math.radians(1.2 * 599), abs=1e-6)
    assert readings[-1].linear_acceleration == pytest.approx((0.0, 0.0, 9.80665))
    (host,) = driver.hosts.values()
    assert host.own.lost == 24 + 5
    middle = SECOND + 599 * 10 * MILLISECOND - 5 * MILLISECOND
    assert abs(readings[-1].t - middle) < 2 * MILLISECOND


def test_what_stands_at_the_end_of_its_scale_is_no_reading() -> None:
    driver, events = plugin.driver([sensor()]), list[object]()
    for number, push in enumerate((0, 32767, 0)):
        packet = table.encode(Packet(number, 0, 0, 0, push, 0, 1000))
        events += driver.receive(SECOND + number * 10 * MILLISECOND, packet)
    assert len([event for event in events if isinstance(event, Imu)]) == 1
    assert [e.detail for e in events if isinstance(e, State)][
        -1
    ] == "streams, 1 readings at the end of a scale"


def test_a_tilted_sensor_that_turns_about_the_vertical_has_the_rates_of_its_axes() -> None:
    driver, found = plugin.driver([sensor()]), list[Imu]()
    for number in range(3):
        packet = table.encode(Packet(number, 100 * number, -3000, 0, 500, 0, 866))
        t = SECOND + number * 10 * MILLISECOND
        found += [event for event in driver.receive(t, packet) if isinstance(event, Imu)]
    turn = math.radians(100.0)
    expected = (turn * 0.5, 0.0, turn * math.cos(math.radians(30.0)))
    assert found[-1].angular_velocity == pytest.approx(expected, abs=1e-9)
