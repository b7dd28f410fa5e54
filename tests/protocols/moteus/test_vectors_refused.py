"""Requests and commands to the driver: refused, begun, or timed out, at every edge."""

from __future__ import annotations

from math import inf, nan, tau

import pytest

from protocols import messages as msg
from protocols.messages import SECOND, Command, Event, Request
from protocols.moteus.codec import FLOAT_MAX
from protocols.moteus.registers import NAMES
from tests.protocols.moteus.test_vectors import AT, VECTORS, Talk
from tests.protocols.moteus.test_vectors_requests import reported, talk

STILL = "it is armed, and would jump: send Idle first"
COMMANDS_OWN = "that register is what commands are for"
UNKNOWN = f"give its number (0x058), or one of {', '.join(NAMES)}"


def events_of(it: Talk, message: Command | Request) -> list[Event]:
    """The events of a message, at once."""
    return it.step(message)[0]


def write(parameter: str, value: float = 1.0) -> msg.WriteParameter:
    return msg.WriteParameter("left", parameter, value)


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (msg.Estop("left"), "a moteus has no Estop on its bus"),
        (msg.Home("left"), "a moteus has no Home on its bus"),
        (msg.Reboot("left"), "a moteus has no Reboot on its bus"),
        (msg.Reboot("right"), "moteus cannot do this, or knows no such motor"),
        (msg.ReadParameter("right", "power"), "moteus cannot do this, or knows no such motor"),
        (msg.ReadParameter("left", "pover"), f"no register 'pover': {UNKNOWN}"),
        (msg.ReadParameter("left", "0x8000"), f"no register '0x8000': {UNKNOWN}"),
        (msg.ReadParameter("left", "-1"), f"no register '-1': {UNKNOWN}"),
        (write("pover"), f"no register 'pover': {UNKNOWN}"),
        (write("conf_write", 0.0), "conf_write takes 1"),
        (write("conf_write", 2.0), "conf_write takes 1"),
        (write("require_reindex", nan), "nan is no finite number of 32 bits"),
        (write("require_reindex", inf), "inf is no finite number of 32 bits"),
        (write("0x030", 3.5e38), "3.5e+38 is no finite number of 32 bits"),
        (write("0x030", -3.5e38), "-3.5e+38 is no finite number of 32 bits"),
        (write("mode", 10.0), "the mode is what commands are for"),
        (write("multiplex_id", 9.0), "use SetId with the serial number"),
        (write("0x071", 1.0), "a trimmed clock may end all communication"),
        *((write(hex(r)), COMMANDS_OWN) for r in (0x010, 0x020, 0x02F, 0x040, 0x048)),
        *((write(hex(r)), "a mask of UUIDs is no parameter") for r in (0x154, 0x155, 0x156, 0x157)),
        *((msg.SetId("can0", 7, at), f"{at} is not an id: 1 to 126") for at in (-1, 0, 127, 128)),
        *((msg.SetId("can0", s, 9), f"{s} is no serial number of 64 bits") for s in (-1, 0, 1 << 64)),
        (msg.SetId("can0", 7, 5), "id 5 is held by serial number 0123456789ABCDEF"),
    ],
)
def test_what_is_refused(request_: Request, reason: str) -> None:
    it = talk()
    kind = type(request_).__name__
    of_whom = getattr(request_, "motor", "") or getattr(request_, "bus", "")
    assert events_of(it, request_) == [msg.Refused(it.now, kind, of_whom, reason)]
    assert reported(it, "reply_stopped", "reply_uuid", "reply_power") == []


@pytest.mark.parametrize(
    ("request_", "data"),
    [
        # a question for one register as binary32 (1D) or int32 (19); a write of one as binary32 (0D) and 1D
        (msg.ReadParameter("left", "POWER"), "1d07"),
        (msg.ReadParameter("left", "7"), "1d07"),
        (msg.ReadParameter("left", "0x0"), "1900"),
        (msg.ReadParameter("left", "0x7fff"), "19ffff01"),
        (msg.ReadParameter("left", "home_state"), "190c"),
        (msg.ReadParameter("left", "uuid1"), "19d002"),
        (write("0x030", FLOAT_MAX), "0d30ffff7f7f" + "1d30"),
        (write("0x00f", 0.0), "0d0f00000000" + "1d0f"),
        (write("0x03f", -2.0), "0d3f000000c0" + "1d3f"),
        (write("0x049", 0.5), "0d490000003f" + "1d49"),
        (write("0x153", 1.0), "0dd3020000803f" + "1dd302"),
        (write("0x158", 1.0), "0dd8020000803f" + "1dd802"),
        (write("set_output_nearest", 0.0), "0db00200000000" + "1db002"),
        (write("set_output_exact", 1.5), "0db1020000c03f" + "1db102"),
        (write("require_reindex", 1.0), "0db2020000803f" + "1db202"),
        (write("recapture_position_velocity", 1.0), "0db3020000803f" + "1db302"),
        (write("conf_write", 1.0), "40010b636f6e662077726974650a" + "199002"),
        (msg.Zero("left"), "0db10200000000" + "1db102"),
    ],
)
def test_a_request_is_sent_ten_times_and_refused_after_600_ms(request_: Request, data: str) -> None:
    it = talk()
    start = it.now + 5_000_000
    plain, times, events = bytes.fromhex(data), list[int](), list[Event]()
    another = VECTORS["reply_uuid" if data == "1d07" else "reply_power"]
    for at in range(130):
        own, frames = it.step(*[] if at else [request_])
        times += [it.now - start for frame in frames if frame.data.startswith(plain)]
        events += own + it.handle(another)
    assert times == [60_000_000 * i for i in range(10)]
    (refused,) = events
    assert isinstance(refused, msg.Refused)
    assert (refused.t - start, refused.name) == (600_000_000, "left")


def test_edges_of_ids_and_serial_numbers() -> None:
    it = talk()
    for serial in (1, (1 << 64) - 1):
        for address in (1, 126):
            assert events_of(it, msg.SetId("can0", serial, address)) == []


@pytest.mark.parametrize("mode", range(16))
def test_requests_in_each_mode(mode: int) -> None:
    it = Talk()
    it.handle(AT.replace("21000a", f"2100{mode:02x}", 1))
    running = mode not in (0, 1, 11)
    cases: tuple[tuple[Request, str, str], ...] = (
        (msg.Zero("left"), "left", STILL),
        (write("conf_write"), "left", "it is armed: send Idle first"),
        (write("set_output_nearest"), "left", STILL),
        (write("set_output_exact"), "left", STILL),
        (write("require_reindex"), "left", STILL),
        (write("recapture_position_velocity"), "left", STILL),
        (msg.SetId("can0", 7, 5), "can0", "left is armed: send Idle first"),
    )
    for request, name, reason in cases:
        refused = [msg.Refused(it.now + 5_000_000, type(request).__name__, name, reason)]
        assert events_of(it, request) == (refused if running else [])
    for allowed in (
        write("0x030"),
        msg.ReadParameter("left", "mode"),
        msg.ClearFault("left"),
        msg.SetId("can0", 7, 9),
    ):
        assert events_of(it, allowed) == []


def test_requests_before_the_first_reply() -> None:
    it = Talk()
    for allowed in (msg.Zero("left"), write("conf_write"), msg.SetId("can0", 7, 5), write("0x030")):
        assert events_of(it, allowed) == []
    for moving in ("set_output_nearest", "set_output_exact"):
        assert events_of(it, write(moving)) == [msg.Refused(it.now, "WriteParameter", "left", STILL)]


def test_what_we_have_commanded_counts_as_armed_whatever_its_mode() -> None:
    it = talk()
    events_of(it, msg.Hold("left"))
    it.handle(VECTORS["reply_stopped"])
    assert events_of(it, msg.Zero("left")) == [msg.Refused(it.now, "Zero", "left", STILL)]
    assert events_of(it, write("set_output_exact")) == [msg.Refused(it.now, "WriteParameter", "left", STILL)]
    assert events_of(it, write("conf_write")) == [
        msg.Refused(it.now, "WriteParameter", "left", "it is armed: send Idle first")
    ]
    mine = msg.SetId("can0", 0x0123456789ABCDEF, 9)
    assert events_of(it, mine) == [msg.Refused(it.now, "SetId", "can0", "left is armed: send Idle first")]
    assert events_of(it, msg.SetId("can0", 7, 9)) == []


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (msg.Position("left", nan), "position is nan"),
        (msg.Position("left", 0.0, inf), "velocity is inf"),
        (msg.Position("left", 0.0, 0.0, -inf), "torque is -inf"),
        (msg.Position("left", 32769 * tau), "position 205894 lies outside -205887 … 205887"),
        (msg.Position("left", -32769 * tau), "position -205894 lies outside -205887 … 205887"),
        (msg.Velocity("left", 1001 * tau), "velocity 6289.47 lies outside -6283.19 … 6283.19"),
        (msg.Velocity("left", 0.0, 1000.5), "torque 1000.5 lies outside -1000 … 1000"),
        (msg.Torque("left", -1000.5), "torque -1000.5 lies outside -1000 … 1000"),
        (msg.Torque("right", 0.0), "no such motor on this bus"),
        (
            msg.Impedance("left", 0.0, 0.0, 0.0, 1.0, 1.0),
            "the device's gains are scaled, not set: it has no impedance in N·m/rad",
        ),
    ],
)
def test_a_command_out_of_range_is_refused_once(message: Command, reason: str) -> None:
    it = Talk().running()
    refused = [msg.Refused(it.now + 5_000_000, type(message).__name__, message.motor, reason)]
    assert events_of(it, message) == refused
    assert events_of(it, message) == []
    assert not any(frame.data[:1] == b"\x01" for frame in it.send(message))
    other = msg.Velocity(message.motor, nan)
    if message.motor == "left":
        assert events_of(it, other) == [msg.Refused(it.now, "Velocity", "left", "velocity is nan")]
        assert events_of(it, msg.Hold("left")) == []
    again = [msg.Refused(it.now + 5_000_000, type(message).__name__, message.motor, reason)]
    assert events_of(it, message) == (again if message.motor == "left" else [])
    assert events_of(it, msg.Idle("left")) == []


@pytest.mark.parametrize(
    "message",
    [
        *(msg.Position("left", sign * 32768 * tau, sign * 1e3 * tau, sign * 1e3) for sign in (1, -1)),
        *(msg.Velocity("left", sign * 1e3 * tau, sign * 1e3) for sign in (1, -1)),
        *(msg.Torque("left", sign * 1e3) for sign in (1, -1)),
    ],
)
def test_a_command_at_the_edge_of_its_range_is_sent(message: Command) -> None:
    it = Talk().running()
    events, frames = it.step(message)
    assert events == []
    assert [frame for frame in frames if frame.data.startswith(b"\x01\x00\x0a")] != []


def test_thirty_two_requests_are_pending_and_no_more() -> None:
    it = talk()
    reads: list[Request] = [msg.ReadParameter("left", "power")] * 33
    events, _ = it.step(*reads)
    reason = "too many requests are under way"
    assert events == [msg.Refused(it.now, "ReadParameter", "left", reason)]
    assert events_of(it, msg.Scan("can0")) == [msg.Refused(it.now, "Scan", "can0", reason)]
    assert len(reported(it, "reply_power")) == 32
    assert events_of(it, msg.Scan("can0")) == []


def test_a_reply_ends_only_its_own_request() -> None:
    it = talk()
    it.send(msg.ReadParameter("left", "power"), msg.ReadParameter("left", "voltage"), msg.ClearFault("left"))
    assert [type(event) for event in reported(it, "reply_stopped")] == [msg.Done]
    assert [getattr(event, "parameter", "") for event in reported(it, "reply_power")] == ["power"]
    it.now += SECOND
    reason = "no reply to this request"
    assert it.driver.send(it.now, ())[0][:1] == [msg.Refused(it.now, "ReadParameter", "left", reason)]
