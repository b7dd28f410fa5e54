"""When the driver asks, repeats, gives up and tells silence, beside vectors; scans and ids."""

from __future__ import annotations

import pytest

from protocols import messages as msg
from protocols.frames import BusState, CanFrame
from protocols.messages import MILLISECOND, SECOND, Event, Mode, Nanos
from protocols.moteus import RANGES
from protocols.moteus.codec import reply_id
from protocols.moteus.driver import MoteusDriver
from protocols.moteus.options import Options, serial_of
from tests.protocols.moteus.from_package import UUID
from tests.protocols.moteus.helpers import device
from tests.protocols.moteus.test_vectors import AT, VECTORS, Talk
from tests.protocols.moteus.test_vectors_heard import reported, talk
from tests.protocols.moteus.test_vectors_told import frame, later

# -- silence and questions ---------------------------------------------------------------------------


def moments(
    options: Options, hears: bool, *, milliseconds: int, start: Nanos = 1000 * SECOND
) -> tuple[list[tuple[int, str]], list[Event]]:
    """When a driver asks what by itself, sending whenever it is due."""
    driver = MoteusDriver([device(address=5, options=options)], RANGES)
    now = start
    asked, events = list[tuple[int, str]](), list[Event]()
    while now < start + milliseconds * MILLISECOND:
        told_, frames = driver.send(now, ())
        events += told_
        asked += [((now - start) // MILLISECOND, w.data.hex()) for w in frames if isinstance(w, CanFrame)]
        if hears and frames:
            events += driver.receive(now, VECTORS["reply_stopped"])
        due = driver.due()
        assert due is not None
        assert due > now
        now = due
    return asked, events


FAST_ASKED, FULL_ASKED = "11001f01110f", "11001c040114060a"


def test_a_device_is_asked_as_in_vectors_when_it_is_due() -> None:
    options = Options(feedback_ms=20, details_ms=100, offline_ms=200)
    asked, _ = moments(options, hears=True, milliseconds=400)
    questions = [(at, what) for at, what in asked if what in (FAST_ASKED, FULL_ASKED)]
    assert questions == [(20 * i, FAST_ASKED if i % 5 else FULL_ASKED) for i in range(20)]
    identify = VECTORS["identify"]
    assert isinstance(identify, CanFrame)
    assert [at for at, what in asked if what == identify.data.hex()] == [20, 120, 220, 320]


@pytest.mark.parametrize("start", [0, 1000 * SECOND])
def test_silence_is_told_once_and_asked_after_beside_vectors(start: Nanos) -> None:
    options = Options(feedback_ms=20, details_ms=1000, offline_ms=90)
    asked, events = moments(options, hears=False, milliseconds=300, start=start)
    offline = msg.State("left", start + 90 * MILLISECOND, Mode.OFFLINE, "no reply")
    assert events == [offline]
    assert [at for at, _ in asked] == [0, 20, 40, 60, 80, 130, 180, 230, 280]
    assert MoteusDriver([], RANGES).due() is None
    assert MoteusDriver([device(address=5)], RANGES).due() == 0


def test_silence_after_a_vector_forgets_who_is_armed() -> None:
    it = Talk().running()
    it.say(msg.Hold("left"))
    received = it.now
    it.handle(AT)
    events: list[Event] = []
    while not events:
        it.now += MILLISECOND
        told_, frames = it.driver.send(it.now, [msg.Hold("left")])
        events += told_
        commands = [w for w in frames if getattr(w, "data", b"")[:3] == b"\x01\x00\x0a"]
        assert commands
    assert events == [msg.State("left", received + 200 * MILLISECOND, Mode.OFFLINE, "no reply")]
    assert [w for w in it.say(msg.Hold("left")) if w.data[:1] == b"\x01"] == []
    assert reported(it, "reply_stopped") == [msg.State("left", it.now, Mode.READY, "stopped")]
    assert [w.data[:3] for w in it.say(msg.Hold("left"))][:1] == [b"\x01\x00\x0a"]


def test_who_it_is_is_asked_again_when_it_comes_back_as_in_vectors() -> None:
    for state in (BusState.BACK, BusState.GONE, BusState.OFF):
        it = talk()
        assert VECTORS["identify"] not in it.say()
        it.driver.bus(it.now, state)
        it.handle(VECTORS["reply_stopped"])
        assert VECTORS["identify"] in it.say()
    it = talk()
    it.driver.bus(it.now, BusState.FULL)
    it.handle(VECTORS["reply_stopped"])
    assert VECTORS["identify"] not in it.say()


def test_requests_outlive_a_bus_that_comes_back_or_is_full_beside_vectors() -> None:
    for state in (BusState.BACK, BusState.FULL):
        it = talk()
        it.say(msg.ReadParameter("left", "power"))
        it.driver.bus(it.now, state)
        assert [type(event).__name__ for event in reported(it, "reply_power")] == ["Parameter"]
    it = talk()
    it.say(msg.ReadParameter("left", "power"))
    it.driver.bus(it.now, BusState.OFF)
    at = it.now
    assert it.driver.send(it.now + 1, ())[0] == [msg.Refused(at, "ReadParameter", "left", "the bus is off")]


# -- scan and ids ------------------------------------------------------------------------------------


def test_a_uuid_without_more_is_as_good_as_the_vector() -> None:
    it = talk()
    it.say(msg.Scan("can0"))
    printed = "01234567-89ab-cdef-fedc-ba9876543210"
    words = "2804d002" + UUID.hex()
    assert it.handle(frame(words, 0x900)) == [
        msg.Found(it.now, "moteus", 9, serial_of(UUID), f"UUID {printed}")
    ]
    assert it.handle(frame(words + "21d80200", 0xA00)) == []  # all zero bytes, perhaps: not to be told apart
    assert it.handle(frame("2803d002" + UUID[:12].hex(), 0xB00)) == []
    none = "31d00201" + "31d80201"
    assert it.handle(frame(none, 0xC00)) == [
        msg.Found(it.now, "moteus", 12, None, "it has no UUID: older firmware")
    ]
    assert it.handle(frame("300f02", 0xD00)) == []
    twice = f"UUID {'-'.join(('10325476', '98ba', 'dcfe', 'efcd', 'ab8967452301'))}; duplicate id 9"
    assert it.handle(frame("2804d002" + UUID[::-1].hex(), 0x900)) == [
        msg.Found(it.now, "moteus", 9, serial_of(UUID[::-1]), twice, True)
    ]


@pytest.mark.parametrize("identifier", [0x901, 0x8900, 0x980, 0x1_0900, 0x1ABC_0900, 0x87F], ids=hex)
def test_answers_to_others_are_not_found_beside_vectors(identifier: int) -> None:
    it = talk()
    it.say(msg.Scan("can0"))
    assert it.handle(frame("2804d002" + UUID.hex() + "21d80201", identifier)) == []


def test_what_a_scan_says_of_a_device_of_ours_beside_vectors() -> None:
    uuid = "UUID 01234567-89ab-cdef-fedc-ba9876543210"
    it = Talk()
    for data, title in (
        ("", "firmware not known yet"),
        ("298002" + "04030300", "firmware not known yet"),
        ("298102" + "04030100", "model 030304, firmware 1.3.4"),
    ):
        it.handle(frame(data))
        it.say(msg.Scan("can0"))
        (found,) = reported(it, "reply_uuid")
        assert isinstance(found, msg.Found)
        assert found.detail == f"left, {title}; {uuid}"
        while not any(isinstance(event, msg.Done) for event in later(it)):
            it.handle(VECTORS["reply_stopped"])
    other = Talk()
    other.handle(frame("298102" + "04030100"))
    other.say(msg.Scan("can0"))
    (found,) = reported(other, "reply_uuid")
    assert isinstance(found, msg.Found)
    assert found.detail == f"left, model 000000, firmware 1.3.4; {uuid}"


def test_when_a_scan_asks_and_ends_beside_vectors() -> None:
    it = talk()
    times, events, start = list[int](), list[Event](), it.now + 5 * MILLISECOND
    for at in range(170):
        it.now += 5 * MILLISECOND
        said, frames = it.driver.send(it.now, [msg.Scan("can0")] if not at else [])
        events += said
        times += [
            (it.now - start) // MILLISECOND for frame in frames if frame == VECTORS["discover_broadcast_0x7f"]
        ]
        it.handle(VECTORS["reply_stopped"])
    assert times == [0, 200, 400, 600]
    assert events == [msg.Done(start + 800 * MILLISECOND, "Scan", "can0", "0 devices")]
    it.say(msg.Scan("can0"))
    reported(it, "reply_uuid")
    ends = [e for _ in range(170) for e in later(it) if isinstance(e, msg.Done)]
    assert [e.detail for e in ends] == ["1 device"]


def test_when_an_id_is_given_beside_vectors() -> None:
    it = talk()
    times, events, start = list[int](), list[Event](), it.now + 5 * MILLISECOND
    for at in range(320):
        it.now += 5 * MILLISECOND
        said, frames = it.driver.send(it.now, [msg.SetId("can0", serial_of(UUID), 9)] if not at else [])
        events += said
        times += [(it.now - start) // MILLISECOND for frame in frames if frame == VECTORS["discover_by_uuid"]]
        it.handle(VECTORS["reply_stopped"])
    assert times == [150 * i for i in range(10)]
    reason = "no device with serial number 0123456789ABCDEF took the id"
    assert events == [msg.Refused(start + 1500 * MILLISECOND, "SetId", "can0", reason)]


def test_a_uuid_that_was_heard_long_ago_is_no_second_device_beside_vectors() -> None:
    for late, twice in ((10 * SECOND, True), (10 * SECOND + 1, False)):
        it = talk()
        it.now += late
        events = reported(it, "reply_uuid_other")
        assert any(isinstance(event, msg.Found) for event in events) == twice


def test_a_device_that_was_given_another_id_of_ours_is_no_second_one_beside_vectors() -> None:
    driver = MoteusDriver([device("left", 5), device("n", 9)], RANGES)
    now = 1000 * SECOND
    for vector in ("reply_stopped", "reply_uuid", "reply_uuid_id_9", "reply_uuid_other"):
        events = driver.receive(now, VECTORS[vector])
        assert [event for event in events if isinstance(event, msg.Found)] == []


def test_all_prefixes_in_use_are_asked_beside_vectors() -> None:
    options = Options(can_prefix=0x1ABC, host_id=3)
    driver = MoteusDriver([device("left", 5), device("far", 6, options=options), device("n", 7)], RANGES)
    frames = driver.send(1, [msg.Scan("can0")])[1]
    data = bytes.fromhex("1804d00211d802")
    assert [w.id for w in frames if isinstance(w, CanFrame) and w.data == data] == [0x807F, 0x1ABC837F]
    found = driver.receive(2, frame("2804d002" + UUID.hex(), 0x1ABC0903))
    assert [type(event) for event in found] == [msg.Found]
    assert reply_id(9, 3, 0x1ABC) == 0x1ABC0903
