"""Packets of the vendor's SDK and of a package; cycles of packets; what a sensor obeys and sends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pytest

from protocols.messages import (
    MILLISECOND,
    SECOND,
    Event,
    Imu,
    Kept,
    Mode,
    ReadParameter,
    State,
    WriteParameter,
)
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from protocols.witmotion import plugin
from protocols.witmotion import table as wit
from protocols.witmotion.options import Options, Settings

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
SENT = {name for name, vector in VECTORS.items() if vector.direction == "from_device"}
START = 1_000_000 * MILLISECOND
FLAT = (0, 0, 2048, 0)
"""Counts of 1 g along z"""


def data_of(name: str) -> bytes:
    data = VECTORS[name].frame
    assert isinstance(data, bytes)
    return data


def sensor(line_rate: int = 0, settings: Settings | None = None, **options: Any) -> Device:
    return Device("imu", 1, Options(**options), settings or Settings(), line_rate)


def readings(events: Sequence[Event]) -> list[Imu]:
    return [event for event in events if isinstance(event, Imu)]


def cycle(
    pushed: Sequence[int] = FLAT, turning: Sequence[int] = (0, 0, 0, 0), **others: Sequence[int]
) -> bytes:
    """The packets of a cycle; `others`: words of angle and quaternion."""
    data = wit.packet(wit.ACCELERATION, pushed) + wit.packet(wit.ANGULAR_RATE, turning)
    for name, kind in (("angle", wit.ANGLE), ("quaternion", wit.QUATERNION)):
        data += wit.packet(kind, others[name]) if name in others else b""
    return data


# -- packets -----------------------------------------------------------------------------------------------

SCALES = {
    "accel_g": wit.G_MOST / wit.GRAVITY,
    "gyro_deg_s": math.degrees(wit.RATE_MOST),
    "q0_q1_q2_q3": 1.0,
}


@pytest.mark.parametrize(
    "name", sorted(name for name in SENT if SCALES.keys() & VECTORS[name].meaning.keys())
)
def test_words_and_scales_are_those_of_the_source(name: str) -> None:
    meaning = VECTORS[name].meaning
    words = wit.words_of(data_of(name)[:-1])
    assert list(words[: len(meaning["raw"])]) == meaning["raw"]
    for key, most in SCALES.items():
        if key in meaning:
            found = [word * most / wit.FULL for word in words[: len(meaning[key])]]
            assert found == pytest.approx(meaning[key], abs=1e-5)
    assert wit.packet(data_of(name)[1], words) == data_of(name)


@pytest.mark.parametrize(
    ("name", "accepted", "malformed"),
    [
        ("accel_bad_checksum", 0, 1),
        ("angle_payload_full_of_55_after_junk", 1, None),
        ("default_cycle_51_52_53_54", 4, 0),
        ("read_reply_rsw_rate_baud", 1, 0),
        ("time_2024-05-17", 1, 0),
    ],
)
def test_packets_in_a_stream_are_counted(name: str, accepted: int, malformed: int | None) -> None:
    driver = plugin.driver([sensor()])
    driver.receive(START, data_of(name))
    assert driver.counters.accepted == accepted
    assert malformed is None or driver.counters.malformed == malformed


COMMANDS = {
    "unlock": Kept("imu", "KEY", 46472.0),
    "rate_100hz": WriteParameter("imu", "RRATE", 9.0),
    "content_acc_gyro_angle_quat": WriteParameter("imu", "RSW", 526.0),
    "baud_115200": WriteParameter("imu", "BAUD", 6.0),
    "save": WriteParameter("imu", "SAVE", 0.0),
    "calibrate_acc_gyro_start": WriteParameter("imu", "CALSW", 1.0),
    "algorithm_6axis": WriteParameter("imu", "0x24", 1.0),
    "read_registers_from_0x02": ReadParameter("imu", "RSW"),
}


def test_a_decoder_names_what_a_tool_sends_and_obeys_nothing_while_it_is_locked() -> None:
    unlocked, locked = plugin.decoder([sensor()]), plugin.decoder([sensor()])
    for name, expected in COMMANDS.items():
        assert unlocked.decode(START, data_of(name)) == [expected]
        assert plugin.messages(data_of(name)) != ()
        reads = isinstance(expected, ReadParameter)
        assert plugin.spec(sensor()).read_only(data_of(name)) == reads
        if name != "unlock":
            assert locked.decode(START, data_of(name)) == ([expected] if reads else [])
    assert unlocked.decode(START + wit.OPEN + 1, data_of("rate_100hz")) == []


# -- readings ----------------------------------------------------------------------------------------------


def test_a_reading_is_of_one_cycle_and_has_the_time_of_its_beginning() -> None:
    driver = plugin.driver([sensor(9600)])
    events = driver.receive(START, cycle(FLAT, (0, -8192, 16384, 0), angle=(0, 0, 16384, 0)))
    (reading,) = readings(events)
    assert reading.t == START - 33 * 10 * SECOND // 9600
    assert reading.angular_velocity == pytest.approx((0.0, -8.726646, 17.453293))
    assert reading.linear_acceleration == pytest.approx((0.0, 0.0, 9.80665))
    assert reading.orientation == pytest.approx((0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)))


def test_a_packet_that_is_lost_costs_its_cycle_alone() -> None:
    driver, whole = plugin.driver([sensor()]), cycle(angle=(0, 0, 0, 0))
    for lost in range(3):
        events = driver.receive(START, whole[: 11 * lost] + whole[11 * (lost + 1) :])
        assert readings(events) == []
        assert len(readings(driver.receive(START, whole))) == 1


def test_a_sensor_that_is_not_configured_to_send_an_orientation_says_so() -> None:
    driver = plugin.driver([sensor(orientation="quaternion")])
    events = [e for at in range(5) for e in driver.receive(START + at * 5 * MILLISECOND, cycle())]
    assert [one.orientation for one in readings(events)] == [None] * 3
    said = [event.detail for event in events if isinstance(event, State)]
    assert said[-1] == "streams, no packet 59: no orientation"
    later = [START + at * 5 * MILLISECOND for at in (5, 6, 7)]
    events = [e for t in later for e in driver.receive(t, cycle(quaternion=(32767, 0, 0, 0)))]
    assert [one.orientation is None for one in readings(events)] == [True, False, False]
    assert [event.detail for event in events if isinstance(event, State)][-1] == "streams"


@pytest.mark.parametrize("at", range(3))
@pytest.mark.parametrize("end", wit.ENDS)
def test_what_stands_at_the_end_of_its_scale_is_no_reading(at: int, end: int) -> None:
    driver = plugin.driver([sensor(orientation="none")])
    words = [0, 0, 0, 0]
    words[at] = end
    for clipped in (cycle(words), cycle(FLAT, words)):
        assert readings(driver.receive(START, clipped)) == []
    said = [event for event in driver.receive(START, cycle()) if isinstance(event, State)]
    assert len(readings(driver.receive(START, cycle()))) == 1
    assert said[-1:] == [] or said[-1].mode is Mode.READY
    (host,) = driver.hosts.values()  # type: ignore[attr-defined]
    assert host.own.clipped == 2


def test_angles_and_quaternion_are_one_orientation() -> None:
    driver = {kind: plugin.driver([sensor(orientation=kind)]) for kind in ("angle", "quaternion")}
    settings = Settings(content=0x20E)
    twin = plugin.twin(sensor(settings=settings), 0)
    pushed = (-4.0, 3.0, 8.0)
    found: dict[str, list[Imu]] = {kind: [] for kind in driver}
    for step in range(600):
        now = START + step * MILLISECOND
        _, frames = twin.step(now, [Imu("imu", now, (0.0, 0.0, 1.5), pushed)])
        for kind, one in driver.items():
            found[kind] += [r for frame in frames for r in readings(one.receive(now, frame))]
    assert len(found["angle"]) == len(found["quaternion"]) == 6
    for angles, quaternion in zip(found["angle"], found["quaternion"], strict=True):
        assert angles.orientation is not None
        assert quaternion.orientation is not None
        assert angles.orientation == pytest.approx(quaternion.orientation, abs=2e-4)
    x, y, z, w = found["angle"][-1].orientation or (0.0, 0.0, 0.0, 1.0)
    up = (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z)
    assert up == pytest.approx([each / math.hypot(*pushed) for each in pushed], abs=1e-3)


# -- the twin ----------------------------------------------------------------------------------------------


def sent(twin: Any, start: int, steps: int = 1000) -> list[bytes]:
    found: list[bytes] = []
    for step in range(steps):
        now = start + step * MILLISECOND
        found += twin.step(now, [Imu("imu", now, (0.0, 0.0, 0.1), (0.0, 0.0, 9.81))])[1]
    return found


def test_a_sensor_obeys_what_is_written_once_it_is_unlocked() -> None:
    twin = plugin.twin(sensor(), 0)
    assert [frame[1] for frame in sent(twin, START)] == [0x51, 0x52, 0x53, 0x54] * 10
    twin.receive(START + SECOND, data_of("rate_100hz"))
    assert len(sent(twin, START + SECOND)) == 40
    twin.receive(START + 2 * SECOND, data_of("unlock") + data_of("rate_100hz"))
    twin.receive(START + 2 * SECOND, data_of("content_acc_gyro_angle_quat"))
    found = sent(twin, START + 3 * SECOND)
    assert len(found) in range(4 * 98, 4 * 101)
    assert {frame[1] for frame in found} == {0x51, 0x52, 0x53, 0x59}
    twin.receive(START + 4 * SECOND, data_of("read_registers_from_0x02"))
    (reply, *_) = sent(twin, START + 4 * SECOND, 1)
    assert wit.words_of(reply[:-1])[:2] == (526, 9)


def test_settings_that_a_sensor_cannot_have_are_refused() -> None:
    with pytest.raises(ValueError, match=r"rate_hz is 30: it has 0\.2, 0\.5"):
        Settings(rate_hz=30.0)
    with pytest.raises(ValueError, match="one sensor is on a line"):
        plugin.spec(Device("imu", 2, Options(), Settings()))
