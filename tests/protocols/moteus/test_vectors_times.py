"""When the driver queries, repeats, times out and reports offline; scans and ids."""

from __future__ import annotations

import pytest

from protocols import messages as msg
from protocols.frames import BusState, CanFrame
from protocols.messages import MILLISECOND, SECOND, Event, Mode, Nanos, Request
from protocols.moteus import RANGES
from protocols.moteus.codec import reply_id
from protocols.moteus.driver import MoteusDriver
from protocols.moteus.options import Options, serial_of
from tests.protocols.moteus.from_package import UUID
from tests.protocols.moteus.helpers import device, frame
from tests.protocols.moteus.test_vectors import AT, VECTORS, Talk
from tests.protocols.moteus.test_vectors_requests import reported, talk

# -- silence and periodic ---------------------------------------------------------------------------


def moments(
    options: Options, replies: bool, *, milliseconds: int, start: Nanos = 1000 * SECOND
) -> tuple[list[tuple[int, str]], list[Event]]:
    """The queries that a driver sends by itself, and when, called whenever it is due."""
    driver = MoteusDriver([device(address=5, options=options)], RANGES)
    now = start
    queries, events = list[tuple[int, str]](), list[Event]()
    while now < start + milliseconds * MILLISECOND:
        own, frames = driver.send(now, ())
        events += own
        queries += [((now - start) // MILLISECOND, w.data.hex()) for w in frames if isinstance(w, CanFrame)]
        if replies and frames:
            events += driver.receive(now, VECTORS["reply_stopped"])
        due = driver.due()
        assert due is not None
        assert due > now
        now = due
    return queries, events


FAST_QUERY, FULL_QUERY = "11001f01110f", "11001c040114060a"


def test_the_periods_of_queries() -> None:
    options = Options(feedback_ms=20, details_ms=100, offline_ms=200)
    queries, _ = moments(options, replies=True, milliseconds=400)
    periodic = [(at, what) for at, what in queries if what in (FAST_QUERY, FULL_QUERY)]
    assert periodic == [(20 * i, FAST_QUERY if i % 5 else FULL_QUERY) for i in range(20)]
    identify = VECTORS["identify"]
    assert isinstance(identify, CanFrame)
    assert [at for at, what in queries if what == identify.data.hex()] == [20, 120, 220, 320]


@pytest.mark.parametrize("start", [0, 1000 * SECOND])
def test_offline_is_reported_once_and_queried_less_often(start: Nanos) -> None:
    options = Options(feedback_ms=20, details_ms=1000, offline_ms=90)
    queries, events = moments(options, replies=False, milliseconds=300, start=start)
    offline = msg.State("left", start + 90 * MILLISECOND, Mode.OFFLINE, "no reply")
    assert events == [offline]
    assert [at for at, _ in queries] == [0, 20, 40, 60, 80, 130, 180, 230, 280]
    assert MoteusDriver([], RANGES).due() is None
    assert MoteusDriver([device(address=5)], RANGES).due() == 0


def test_a_device_that_was_offline_is_armed_anew() -> None:
    it = Talk().running()
    it.send(msg.Hold("left"))
    received = it.now
    it.handle(AT)
    events: list[Event] = []
    while not events:
        it.now += MILLISECOND
        own, frames = it.driver.send(it.now, [msg.Hold("left")])
        events += own
        commands = [w for w in frames if getattr(w, "data", b"")[:3] == b"\x01\x00\x0a"]
        assert commands
    assert events == [msg.State("left", received + 200 * MILLISECOND, Mode.OFFLINE, "no reply")]
    assert [w for w in it.send(msg.Hold("left")) if w.data[:1] == b"\x01"] == []
    assert reported(it, "reply_stopped") == [msg.State("left", it.now, Mode.READY, "stopped")]
    assert [w.data[:3] for w in it.send(msg.Hold("left"))][:1] == [b"\x01\x00\x0a"]


def test_a_device_is_identified_again_after_the_bus_was_away() -> None:
    for state in (BusState.BACK, BusState.GONE, BusState.OFF):
        it = talk()
        assert VECTORS["identify"] not in it.send()
        it.driver.bus(it.now, state)
        it.handle(VECTORS["reply_stopped"])
        assert VECTORS["identify"] in it.send()
    it = talk()
    it.driver.bus(it.now, BusState.FULL)
    it.handle(VECTORS["reply_stopped"])
    assert VECTORS["identify"] not in it.send()


def test_requests_outlive_a_bus_that_comes_back_or_is_full() -> None:
    for state in (BusState.BACK, BusState.FULL):
        it = talk()
        it.send(msg.ReadParameter("left", "power"))
        it.driver.bus(it.now, state)
        assert [type(event).__name__ for event in reported(it, "reply_power")] == ["Parameter"]
    for state in (BusState.OFF, BusState.GONE):
        it = talk()
        it.send(msg.ReadParameter("left", "power"))
        it.driver.bus(it.now, state)
        refused = msg.Refused(it.now, "ReadParameter", "left", f"the bus is {state.value}")
        assert it.step()[0] == [refused]


# -- scan and ids ------------------------------------------------------------------------------------


def test_what_replies_to_a_scan_count_as_devices() -> None:
    it = talk()
    it.send(msg.Scan("can0"))
    printed = "01234567-89ab-cdef-fedc-ba9876543210"
    messages = "2804d002" + UUID.hex()
    assert it.handle(frame(messages, 0x900)) == [
        msg.Found(it.now, "moteus", 9, serial_of(UUID), f"UUID {printed}")
    ]
    assert (
        it.handle(frame(messages + "21d80200", 0xA00)) == []
    )  # all zero bytes, perhaps: not to be told apart
    assert it.handle(frame("2803d002" + UUID[:12].hex(), 0xB00)) == []
    none = "31d00201" + "31d80201"
    assert it.handle(frame(none, 0xC00)) == [
        msg.Found(it.now, "moteus", 12, None, "it has no UUID: older firmware")
    ]
    assert it.handle(frame("300f02", 0xD00)) == []
    duplicate = f"UUID {'-'.join(('10325476', '98ba', 'dcfe', 'efcd', 'ab8967452301'))}; duplicate id 9"
    assert it.handle(frame("2804d002" + UUID[::-1].hex(), 0x900)) == [
        msg.Found(it.now, "moteus", 9, serial_of(UUID[::-1]), duplicate, True)
    ]


@pytest.mark.parametrize("identifier", [0x901, 0x8900, 0x980, 0x1_0900, 0x1ABC_0900, 0x87F], ids=hex)
def test_replies_to_others_are_not_found(identifier: int) -> None:
    it = talk()
    it.send(msg.Scan("can0"))
    assert it.handle(frame("2804d002" + UUID.hex() + "21d80201", identifier)) == []


def test_the_details_that_a_scan_reports_of_a_known_device() -> None:
    uuid = "UUID 01234567-89ab-cdef-fedc-ba9876543210"
    it = Talk()
    for data, title in (
        ("", "firmware not known yet"),
        ("298002" + "04030300", "firmware not known yet"),
        ("298102" + "04030100", "model 030304, firmware 1.3.4"),
    ):
        it.handle(frame(data))
        it.send(msg.Scan("can0"))
        (found,) = reported(it, "reply_uuid")
        assert isinstance(found, msg.Found)
        assert found.detail == f"left, {title}; {uuid}"
        while not any(isinstance(event, msg.Done) for event in it.step()[0]):
            it.handle(VECTORS["reply_stopped"])
    other = Talk()
    other.handle(frame("298102" + "04030100"))
    other.send(msg.Scan("can0"))
    (found,) = reported(other, "reply_uuid")
    assert isinstance(found, msg.Found)
    assert found.detail == f"left, model 000000, firmware 1.3.4; {uuid}"


def queried(it: Talk, request: Request, vector: str, milliseconds: int) -> tuple[list[int], list[Event]]:
    """When [ms] a frame goes out after a request, and the events."""
    times, events, start = list[int](), list[Event](), it.now + 5 * MILLISECOND
    for at in range(milliseconds // 5):
        own, frames = it.step(*[] if at else [request])
        events += own
        times += [(it.now - start) // MILLISECOND for frame in frames if frame == VECTORS[vector]]
        it.handle(VECTORS["reply_stopped"])
    return times, events


def test_the_times_of_a_scan() -> None:
    it = talk()
    start = it.now + 5 * MILLISECOND
    times, events = queried(it, msg.Scan("can0"), "discover_broadcast_0x7f", 850)
    assert times == [0, 200, 400, 600]
    assert events == [msg.Done(start + 800 * MILLISECOND, "Scan", "can0", "0 devices")]
    it.send(msg.Scan("can0"))
    reported(it, "reply_uuid")
    ends = [e for _ in range(170) for e in it.step()[0] if isinstance(e, msg.Done)]
    assert [e.detail for e in ends] == ["1 device"]


def test_the_times_of_setting_an_id() -> None:
    it = talk()
    start = it.now + 5 * MILLISECOND
    times, events = queried(it, msg.SetId("can0", serial_of(UUID), 9), "discover_by_uuid", 1600)
    assert times == [150 * i for i in range(10)]
    reason = "no device with serial number 0123456789ABCDEF took the id"
    assert events == [msg.Refused(start + 1500 * MILLISECOND, "SetId", "can0", reason)]


def test_a_uuid_of_long_ago_is_no_duplicate() -> None:
    for late, duplicate in ((10 * SECOND, True), (10 * SECOND + 1, False)):
        it = talk()
        it.now += late
        events = reported(it, "reply_uuid_other")
        assert any(isinstance(event, msg.Found) for event in events) == duplicate


def test_a_device_that_moved_to_another_id_of_ours_is_no_duplicate() -> None:
    driver = MoteusDriver([device("left", 5), device("n", 9)], RANGES)
    now = 1000 * SECOND
    for vector in ("reply_stopped", "reply_uuid", "reply_uuid_id_9", "reply_uuid_other"):
        events = driver.receive(now, VECTORS[vector])
        assert [event for event in events if isinstance(event, msg.Found)] == []


def test_a_scan_queries_all_prefixes_in_use() -> None:
    options = Options(can_prefix=0x1ABC, host_id=3)
    driver = MoteusDriver([device("left", 5), device("far", 6, options=options), device("n", 7)], RANGES)
    frames = driver.send(1, [msg.Scan("can0")])[1]
    data = bytes.fromhex("1804d00211d802")
    assert [w.id for w in frames if isinstance(w, CanFrame) and w.data == data] == [0x807F, 0x1ABC837F]
    found = driver.receive(2, frame("2804d002" + UUID.hex(), 0x1ABC0903))
    assert [type(event) for event in found] == [msg.Found]
    assert reply_id(9, 3, 0x1ABC) == 0x1ABC0903
