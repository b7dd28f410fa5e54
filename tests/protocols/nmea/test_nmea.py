"""Sentences as pynmea2 reads and writes them; fixes by quality; their time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from random import Random
from typing import Any

import pytest

from protocols.messages import MILLISECOND, SECOND, Event, Fix, State
from protocols.nmea import plugin, table
from protocols.nmea.options import Options, Settings
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}


def data_of(name: str) -> bytes:
    frame = VECTORS[name].frame
    assert isinstance(frame, bytes)
    return frame


def receiver(**options: Any) -> Device:
    return Device("gps", 1, Options(**options), Settings(), 38_400)


def reported(*frames: bytes, **options: Any) -> Sequence[Event]:
    driver = plugin.driver([receiver(**options)])
    return [event for frame in frames for event in driver.receive(SECOND, frame)]


@pytest.mark.parametrize("name", [name for name in VECTORS if name.startswith("gga")])
def test_a_fix_is_that_of_another_reader(name: str) -> None:
    meaning, fixes = VECTORS[name].meaning, [e for e in reported(data_of(name)) if isinstance(e, Fix)]
    if VECTORS[name].wrong or not meaning["gps_qual"]:
        assert fixes == []
        return
    (fix,) = fixes
    assert fix.latitude == pytest.approx(meaning["latitude"], abs=1e-12)
    assert fix.longitude == pytest.approx(meaning["longitude"], abs=1e-12)
    assert fix.altitude == pytest.approx(meaning["altitude"] + float(meaning.get("geo_sep", 0.0)))
    sigma = {1: 2.5, 4: 0.02, 5: 0.4}[meaning["gps_qual"]] * float(meaning["horizontal_dil"])
    assert fix.variance == pytest.approx(sigma**2)


def test_speed_and_course_are_those_of_another_reader() -> None:
    fields = data_of("rmc_worked_example")[1:-5].decode().split(",")
    motion, meaning = table.rmc(fields), VECTORS["rmc_worked_example"].meaning
    assert motion is not None
    assert (motion.valid, motion.course) == (True, meaning["true_course"])
    assert motion.speed == pytest.approx(meaning["spd_over_grnd"] * 0.514444, rel=1e-5)
    assert table.rmc(data_of("rmc_void")[1:-5].decode().split(",")) == table.Motion(
        False, None, None, table.day_time("083600.00")
    )
    vtg = table.vtg(data_of("vtg_worked_example")[1:-5].decode().split(","))
    assert vtg is not None
    assert (vtg.course, vtg.speed) == (motion.course, motion.speed)


def test_what_is_not_used_is_accepted_and_a_wrong_checksum_is_not() -> None:
    driver = plugin.driver([receiver()])
    for vector in VECTORS.values():
        driver.receive(SECOND, vector.frame)
    right = [vector for vector in VECTORS.values() if not vector.wrong]
    assert (driver.counters.accepted, driver.counters.malformed) == (len(right), len(VECTORS) - len(right))


def test_a_quality_below_the_worst_is_no_fix_and_is_said() -> None:
    events = reported(data_of("gga_worked_example"), worst="float")
    assert [event.detail for event in events if isinstance(event, State)] == ["fix, which is not used"]
    assert len([e for e in reported(data_of("gga_rtk_south_west"), worst="float") if isinstance(e, Fix)]) == 1


def test_a_fix_has_the_time_of_the_receiver_not_of_the_line() -> None:
    random, driver = Random(1), plugin.driver([receiver(latency_ms=50.0)])
    twin = plugin.twin(receiver(), 0)
    late, fixes = list[int](), list[Fix]()
    for number in range(200):
        t = 86_399 * SECOND + number * 100 * MILLISECOND  # over midnight
        true = Fix("gps", t, 48.0 + number * 1e-6, 11.0, 500.0, 0.0004)
        _, frames = twin.step(t, [true])
        for frame in frames:
            came = t + 50 * MILLISECOND + round(random.random() ** 2 * 40 * MILLISECOND)
            assert isinstance(frame, bytes)
            came += len(frame) * 10 * SECOND // 38_400
            fixes += [e for e in driver.receive(came, frame) if isinstance(e, Fix)]
        late.append(fixes[-1].t - t)
        assert fixes[-1].latitude == pytest.approx(true.latitude, abs=1e-7)
        assert math.sqrt(fixes[-1].variance or 0.0) == pytest.approx(0.02)
    assert len(fixes) == 200
    assert max(late[20:]) < 4 * MILLISECOND
    assert min(late) >= 0


def test_places_are_written_as_minutes_and_read_back() -> None:
    for value in (0.0, -1e-9, 59.9999999999, -33.5, 89.99999999, -0.999999999):
        text, side = table.place(value, 2, "NS", 7).split(",")
        assert table.degrees(text, side, "NS", 90.0) == pytest.approx(value, abs=1e-9)
    assert table.place(179.99999999999, 3, "EW", 5) == "18000.00000,E"


def test_a_cut_sentence_costs_itself_alone() -> None:
    whole = data_of("gga_worked_example")
    events = reported(whole[:30] + whole, whole[20:] + whole, b"$" * 500 + whole)
    assert len([event for event in events if isinstance(event, Fix)]) == 3
