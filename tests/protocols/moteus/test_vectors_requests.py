"""Every independent vector to a device at the decoder, and its name; requests and their replies."""

from __future__ import annotations

from math import tau

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import Command, Event, Mode, Nanos, Obeyed, Request
from protocols.moteus import plugin
from protocols.moteus.decoder import MoteusDecoder
from protocols.moteus.faults import FAULTS
from protocols.moteus.messages import names
from protocols.moteus.options import Settings, serial_of
from protocols.reference_vectors import vectors_of
from tests.protocols.moteus.from_package import UUID
from tests.protocols.moteus.helpers import device, obeyed
from tests.protocols.moteus.test_vectors import AT, VECTORS, Talk

KT = 8.27 / 304
FIFTH, EIGHTH = 0.20000000298023224, 0.30000001192092896
"""0.2 and 0.3 as binary32."""
WORDS: dict[str, tuple[str, list[Command | Request]]] = {
    # name of the vector → name of its messages, what device 5 would do
    "query_default": ("read", []),
    "position_0.5rev_vel0.2_tq1.5_query": (
        "position 020 021 025, read",
        [msg.Position("m", 0.5 * tau, FIFTH * tau, 0.0)],
    ),
    # It leaves the integrator on, which holds the place; "torque only" is the name of the vendor's example.
    "torque_only_kp0_kd0_ff0.3": ("torque 020 022 023 024, read", [msg.Velocity("m", 0.0, EIGHTH)]),
    "position_with_watchdog_nan": ("position 020 027, read", [msg.Position("m", 0.25 * tau, 0.0, 0.0)]),
    "brake": ("brake, read", [msg.Velocity("m", 0.0)]),
    "current_q2A": ("current 01C 01D, read", [msg.Torque("m", 2.0 * KT)]),
    "rezero_nearest_0": ("write 130, read", [msg.Zero("m")]),
    "stop_no_reply": ("stop", [msg.Idle("m")]),
    "position_int16_0.0096rev_0.072hz_-1.76nm": (
        "position 020 021 022, read",
        [msg.Position("m", 0.0095 * tau, 0.072 * tau, -1.76)],  # it truncates
    ),
    "position_watchdog_0.1s": (
        "position 020 021 022 027, read",
        [msg.Position("m", 0.25 * tau, -1.5 * tau, 0.125)],
    ),
    "velocity_watchdog_0.1s": ("velocity 020 021 022 027, read", [msg.Velocity("m", -1.5 * tau, 0.125)]),
    "torque_watchdog_0.1s": ("torque 020 021 022 023 024 027 02B, read", [msg.Torque("m", 0.125)]),
    "position_limited": (
        "position 020 021 022 025 027 028 029, read",
        [msg.Position("m", 0.25 * tau, -1.5 * tau, 0.125)],
    ),
    "torque_limited": ("torque 020 021 022 023 024 025 027 028 029 02B, read", [msg.Torque("m", 0.125)]),
    "zero_velocity": ("zero velocity 024", [msg.Velocity("m", 0.0)]),
    "stay_within": ("stay within 040 041", [msg.Torque("m", 0.0)]),
    "vfoc": ("voltage foc 018 019, read", [msg.WriteParameter("m", "mode", 7.0)]),
    "set_output_exact_0": ("write 131, read", [msg.Zero("m")]),
    "set_output_nearest_0.5": ("write 130", [msg.WriteParameter("m", "set_output_nearest", 0.5)]),
    "write_output_exact_1.5_read_back": (
        "write 131, read",
        [msg.WriteParameter("m", "set_output_exact", 1.5)],
    ),
    "require_reindex": ("write 132", [msg.WriteParameter("m", "require_reindex", 1.0)]),
    "recapture": ("write 133", [msg.WriteParameter("m", "recapture_position_velocity", 1.0)]),
    "read_parameters": ("read", []),
    "console_conf_write": ("console: conf write", [msg.WriteParameter("m", "conf_write", 1.0)]),
    "console_conf_write_read_back": (
        "console: conf write, read",
        [msg.WriteParameter("m", "conf_write", 1.0)],
    ),
    "console_read": ("console: read", []),
    "set_id_by_uuid": ("write 154 155, console: conf set id.id", [msg.SetId("", serial_of(UUID), 9)]),
    "discover_by_uuid": ("write 154 155, read", []),
    "stop_by_whole_uuid": ("stop 154 155 156 157, read", [msg.Idle("m")]),
    "discover_broadcast_0x7f": ("read", []),
    "identify": ("read", []),
}


@pytest.mark.parametrize("name", WORDS)
def test_what_a_device_obeys_of_a_vector(name: str) -> None:
    named, given = WORDS[name]
    messages = obeyed(given)
    assert ", ".join(names(VECTORS[name])) == named
    for uuid in ("", UUID.hex()):
        received = MoteusDecoder([device("m", 5, Settings(uuid=uuid))]).decode(0, VECTORS[name])
        assert [type(message) for message in received] == [type(message) for message in messages]
        for one, other in zip(received, messages, strict=True):
            assert _plain(one) == pytest.approx(_plain(other))
    if name not in ("set_id_by_uuid", "stop_by_whole_uuid"):
        return
    for uuid in ("f" * 32, UUID[:4].hex() + "f" * 24, "f" * 8 + UUID[4:].hex()):
        assert MoteusDecoder([device("m", 5, Settings(uuid=uuid))]).decode(0, VECTORS[name]) == []


def _plain(message: Obeyed) -> dict[str, str | float]:
    return {name: getattr(message, name) for name in message.__slots__}


def test_every_vector_that_a_device_obeys_is_in_the_table() -> None:
    others = {"stop_id_100", "stop_prefix", "doc_example_request_id1"}  # to other devices
    same = {"stop_with_query", "stop_host_3", "velocity_limited", "position_full_query", "query_fast"}
    same |= {"position_limited_no_accel", "write_output_exact_0_read_back", "query_full"}
    same |= {"read_power", "read_home_state"}
    to_device = {vector.name for vector in vectors_of(plugin) if vector.direction == "to_device"}
    assert to_device == set(WORDS) | others | same


def test_vectors_to_other_devices_are_ignored() -> None:
    decoder = MoteusDecoder([device("m", 5), device("n", 6)])
    for name in ("stop_id_100", "stop_prefix", "doc_example_request_id1", "reply_fast"):
        assert decoder.decode(0, VECTORS[name]) == []
    assert decoder.decode(0, VECTORS["stop_no_reply"]) == [msg.Idle("m")]


# -- conversations -------------------------------------------------------------------------------------


def talk() -> Talk:
    """At rest, its identity known."""
    it = Talk()
    it.handle(VECTORS["reply_stopped"])
    assert VECTORS["identify"] in it.send()
    assert it.handle(VECTORS["reply_identity"]) == []
    return it


def reported(it: Talk, *frames: str) -> list[Event]:
    """The events of the vectors, without measurements."""
    events = [event for frame in frames for event in it.handle(VECTORS[frame])]
    return [event for event in events if not isinstance(event, msg.Feedback)]


def waits(it: Talk, milliseconds: int, reply: str = "reply_stopped", *commands: Command) -> list[Event]:
    """The device sends this reply every 5 ms; the events of the driver, without measurements."""
    events: list[Event] = []
    for _ in range(milliseconds // 5):
        events += it.step(*commands)[0] + reported(it, reply)
    return events


READ = msg.ReadParameter("left", "power")
WRITE = msg.WriteParameter("left", "set_output_exact", 1.5)
SAVE = msg.WriteParameter("left", "conf_write", 1.0)
NO_REGISTER = "the device has no such register, or cannot read it so"


@pytest.mark.parametrize(
    ("request_", "vector", "answer", "expected"),
    [
        (READ, "read_power", "reply_power", [msg.Parameter("left", 0, "power", 12.5)]),
        (READ, "read_power", "reply_power_unknown", [msg.Refused(0, "ReadParameter", "left", NO_REGISTER)]),
        (
            READ,
            "read_power",
            "reply_power_not_given",
            [msg.Refused(0, "ReadParameter", "left", "the device replies that it is not given")],
        ),
        (
            WRITE,
            "write_output_exact_1.5_read_back",
            "reply_output_taken",
            [msg.Done(0, "WriteParameter", "left")],
        ),
        (
            WRITE,
            "write_output_exact_1.5_read_back",
            "reply_output_refused",
            [msg.Refused(0, "WriteParameter", "left", "the device does not accept it (read only)")],
        ),
        (
            SAVE,
            "console_conf_write_read_back",
            "reply_id_unreadable",
            [msg.Done(0, "WriteParameter", "left")],
        ),
    ],
)
def test_a_request_and_its_reply(request_: Request, vector: str, answer: str, expected: list[Event]) -> None:
    it = talk()
    assert VECTORS[vector] in it.send(request_)
    assert reported(it, "reply_stopped", "reply_uuid") == []
    assert reported(it, answer) == [_at(it.now, event) for event in expected]
    assert reported(it, answer) == []
    assert VECTORS[vector] not in it.send()


def _at(t: Nanos, event: Event) -> Event:
    values = {name: getattr(event, name) for name in event.__slots__}
    return type(event)(**{**values, "t": t})


def test_zero() -> None:
    it = talk()
    frame = VECTORS["write_output_exact_0_read_back"]
    assert isinstance(frame, CanFrame)
    sent = it.send(msg.Zero("left"))
    assert any(f.data.startswith(frame.data.rstrip(b"\x50")) for f in sent)
    assert reported(it, "reply_zeroed") == []  # from before
    assert reported(it, "reply_output_taken", "reply_stopped") == []
    assert reported(it, "reply_zeroed") == [msg.Done(it.now, "Zero", "left")]
    it.send(msg.Zero("left"))
    refused = msg.Refused(it.now, "Zero", "left", "the device does not accept it (read only)")
    assert reported(it, "reply_output_refused") == [refused]
    it.send(msg.Zero("left"))
    reason = "its position did not become zero: is it turning?"
    assert waits(it, 600) == [msg.Refused(it.now, "Zero", "left", reason)]


def test_clearing_a_fault() -> None:
    it = talk()
    text = FAULTS[38]
    fault = msg.Fault("left", it.now, 38, text.name, text.cause, text.remedy)
    assert reported(it, "reply_fast_fault") == [fault, msg.State("left", it.now, Mode.FAULT, "fault")]
    assert reported(it, "reply_fast_fault") == []
    stopped = VECTORS["stop_with_query"]
    assert stopped not in [*it.send(msg.Idle("left")), *it.send(msg.Hold("left"))]
    assert stopped in it.send(msg.ClearFault("left"))
    assert reported(it, "reply_fast_fault") == []
    ready = msg.State("left", it.now, Mode.READY, "stopped")
    no_more = msg.State("left", it.now, Mode.FAULT, "stopped, not cleared yet")
    assert reported(it, "reply_stopped") == [no_more, ready, msg.Done(it.now, "ClearFault", "left")]
    text = FAULTS[11]
    timeout = msg.Fault("left", it.now, 11, text.name, text.cause, text.remedy)
    assert reported(it, "reply_timeout") == [timeout, msg.State("left", it.now, Mode.FAULT, "timeout")]
    it.send(msg.ClearFault("left"))
    events = waits(it, 600, "reply_timeout")
    assert msg.Refused(it.now, "ClearFault", "left", "still in fault: timeout") in events
    assert len([e for e in events if isinstance(e, msg.Fault)]) <= 1


def test_a_device_that_does_not_arm() -> None:
    it = talk()
    events = waits(it, 1100, "reply_enabling", msg.Hold("left"))
    (fault,) = (e for e in events if isinstance(e, msg.Fault))
    assert (fault.motor, fault.code, fault.name) == ("left", 0x101, "did not arm")
    assert fault.cause == "it stayed in mode enabling for 1000 ms"
    assert fault.remedy == "look at it with the vendor's tool (tview), then clear"
    states = [(s.mode, s.detail) for s in events if isinstance(s, msg.State)]
    assert states == [(Mode.READY, "enabling"), (Mode.FAULT, "enabling, not cleared yet")]
    assert 1_000_000_000 < fault.t - it.now + 220 * 5_000_000 <= 1_020_000_000


def test_a_scan() -> None:
    it = talk()
    it.send(msg.Scan("can0"))
    printed = "01234567-89ab-cdef-fedc-ba9876543210"
    ours = f"left, model 030404, firmware 1.3.4; UUID {printed}"
    assert reported(it, "reply_uuid") == [msg.Found(it.now, "moteus", 5, serial_of(UUID), ours)]
    other = msg.Found(it.now, "moteus", 9, serial_of(UUID), f"UUID {printed}")
    assert reported(it, "reply_identity_id_9") == []  # another host's question
    assert reported(it, "reply_uuid_id_9", "reply_uuid_id_9") == [other]
    assert reported(it, "reply_id_100") == []
    (done,) = waits(it, 800)
    assert done == msg.Done(it.now, "Scan", "can0", "2 devices")
    assert reported(it, "reply_uuid_id_9") == []


def test_an_id_is_set() -> None:
    it = talk()
    sent = it.send(msg.SetId("can0", serial_of(UUID), 9))
    assert VECTORS["discover_by_uuid"] in sent
    given = VECTORS["set_id_by_uuid"]
    assert isinstance(given, CanFrame)
    assert given.data in [frame.data for frame in sent]  # the vector's id has no reply bit
    assert reported(it, "reply_uuid") == []
    detail = "not saved yet: write conf_write 1 to keep it after power-off"
    assert reported(it, "reply_uuid_id_9") == [msg.Done(it.now, "SetId", "can0", detail)]


def test_a_duplicate_id_is_reported_once() -> None:
    it = talk()
    one, other = "01234567-89ab-cdef-fedc-ba9876543210", "10325476-98ba-dcfe-efcd-ab8967452301"
    detail = f"duplicate id 5: UUIDs {one} and {other}"
    cause = f"two devices reply to it: UUIDs {one} and {other}"
    remedy = "take one off the bus, or give it another id (SetId with its serial number)"
    assert reported(it, "reply_uuid_other") == [
        msg.Found(it.now, "moteus", 5, serial_of(UUID), detail, True),
        msg.Found(it.now, "moteus", 5, serial_of(UUID[::-1]), detail, True),
        msg.Fault("left", it.now, 0x100, "duplicate id 5", cause, remedy),
    ]
    assert reported(it, "reply_uuid", "reply_uuid_other") == []


def test_a_device_is_identified_again_every_five_seconds() -> None:
    it = Talk()
    before = 0
    for _ in range(60):  # 300 ms, and no answer to this
        it.handle(VECTORS["reply_stopped"])
        before += VECTORS["identify"] in it.send()
    assert before == 3
    it.handle(VECTORS["reply_identity"])
    after = 0
    for _ in range(2200):  # 11 s
        after += VECTORS["identify"] in it.send()
        it.handle(VECTORS["reply_stopped"])
    assert after == 3


def test_a_device_without_a_uuid_is_not_asked_for_it_all_the_time() -> None:
    it = Talk()
    it.handle(VECTORS["reply_stopped"])
    missing = "".join(f"31{register}01" for register in ("d002", "d102", "d202", "d302", "d802"))
    it.handle("2b8002" + "04040300" + "04030100" + "05000000" + missing + "50" * 13)
    count = 0
    for _ in range(400):  # 2 s
        count += VECTORS["identify"] in it.send()
        it.handle(VECTORS["reply_stopped"])
    assert count <= 1
    assert it.driver.controllers[it.reply].firmware == 0x010304


def test_a_duplicate_id_is_reported_again_after_clear() -> None:
    it = talk()
    assert len(reported(it, "reply_uuid_other")) == 3
    it.send(msg.ClearFault("left"))
    assert [type(e) for e in reported(it, "reply_stopped")] == [msg.Done]
    assert reported(it, "reply_uuid") == []
    assert len(reported(it, "reply_uuid_other")) == 3


def test_a_stop_ends_with_its_second_reply() -> None:
    it = Talk().running()
    it.send(msg.Hold("left"))
    stop = VECTORS["stop_with_query"]
    assert it.send(msg.Idle("left"))[0] == stop
    it.handle(AT)  # how things stood before it
    sent = [frame for _ in range(4) for frame in it.send(msg.Idle("left"))]
    assert sent.count(stop) == 1  # every 20 ms
    it.handle(VECTORS["reply_stopped"])
    assert stop in [
        frame for _ in range(4) for frame in it.send(msg.Idle("left"))
    ]  # one answer may be an old one
    it.handle(VECTORS["reply_stopped"])
    assert stop not in [frame for _ in range(40) for frame in it.send(msg.Idle("left"))]


def test_a_mode_that_is_not_given_reports_no_state() -> None:
    for name, mode in (("reply_fast", 2), ("reply_full", 2)):
        frame = VECTORS[name]
        assert isinstance(frame, CanFrame)
        data = frame.data[:mode] + b"\x80" + frame.data[mode + 1 :]
        events = Talk().handle(CanFrame(frame.id, data, False, False, True, True))
        assert [type(event) for event in events] == [msg.Feedback]
