"""Values ↔ packets, both ways: those of pyvesc-fix 1.0.3, and the vendor's layouts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pytest

from protocols import messages as msg
from protocols.conformance import CLAUSES, check, table
from protocols.conformance.bench import make_bench
from protocols.conformance.random import Random
from protocols.frames import Frame
from protocols.line import Exchange
from protocols.messages import MILLISECOND, Feedback, Obeyed
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.serial import Stream
from protocols.vesc_uart import plugin
from protocols.vesc_uart.options import Options, Settings
from protocols.vesc_uart.table import (
    DIRECT,
    EVERYTHING,
    FORMAT,
    MOTION,
    PACKETS,
    decode_values,
    decode_version,
    encode_values,
    unpack,
)
from tests.protocols.helpers import acts

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
DEVICE = Device("left", 23, Options(pole_pairs=5, torque_constant=0.1, uart_id=23), Settings())
FORWARDED = Device("left", 23, Options(pole_pairs=5, torque_constant=0.1), Settings())
SENT: dict[str, tuple[str, int, dict[str, Any], Obeyed | None]] = {
    "uart_set_duty_0.5": ("SET_DUTY", DIRECT, {"value": 0.5}, msg.Velocity("left", 120.0)),
    "uart_set_current_5.25": ("SET_CURRENT", DIRECT, {"value": 5.25}, msg.Torque("left", 0.525)),
    "uart_set_brake_2A": ("SET_CURRENT_BRAKE", DIRECT, {"value": 2.0}, msg.Velocity("left", 0.0)),
    "uart_set_erpm_3000": ("SET_RPM", DIRECT, {"value": 3000}, msg.Velocity("left", 20.0 * math.pi)),
    "uart_set_pos_90": ("SET_POS", DIRECT, {"value": 90.0}, msg.Position("left", math.pi / 2)),
    "uart_alive": ("ALIVE", DIRECT, {}, None),
    "uart_get_values_request": ("GET_VALUES", DIRECT, {}, None),
    "uart_fw_version_request": ("FW_VERSION", DIRECT, {}, None),
    "uart_set_current_-1.5_by_id_7": ("SET_CURRENT", 7, {"value": -1.5}, None),
    "uart_forward_erpm_3000_to_23": ("SET_RPM", 23, {"value": 3000}, msg.Velocity("left", 20.0 * math.pi)),
    "uart_forward_get_values_to_23": ("GET_VALUES", 23, {}, None),
    "uart_set_handbrake_3A": ("SET_CURRENT_HANDBRAKE", DIRECT, {"value": 3.0}, msg.Hold("left")),
    "uart_set_current_rel_-0.5": ("SET_CURRENT_REL", DIRECT, {"value": -0.5}, msg.Torque("left", -1.0)),
    "uart_reboot": ("REBOOT", DIRECT, {}, msg.Reboot("left")),
    "uart_ping_can": ("PING_CAN", DIRECT, {}, None),
    "uart_get_values_selective_request": ("GET_VALUES_SELECTIVE", DIRECT, {"mask": MOTION}, None),
}
WRONG = "uart_forward_erpm_3000_to_23_KNOWN_SDK_BUG"
REPORTED = {
    "uart_get_values_response_fw5plus_by_id_1",
    "uart_get_values_selective_response",
    "uart_fw_version_response_6.06",
    "uart_ping_can_response_7_23",
}
GIVEN = {
    "temp_fet": 41.5,
    "temp_motor": 36.5,
    "avg_motor_current": 12.25,
    "avg_input_current": -3.5,
    "avg_id": -0.25,
    "avg_iq": 12.0,
    "duty_cycle_now": 0.375,
    "rpm": -12345,
    "v_in": 24.5,
    "amp_hours": 1.5,
    "amp_hours_charged": 0.25,
    "watt_hours": 36.5,
    "watt_hours_charged": 2.0,
    "tachometer": -4242,
    "tachometer_abs": 98765,
    "fault_code": 3,
    "pid_pos_now": 270.5,
    "controller_id": 1,
    "temp_mos1": 40.0,
    "temp_mos2": 41.0,
    "temp_mos3": 42.0,
    "avg_vd": 1.5,
    "avg_vq": -2.5,
    "status": 1,
}
"""What the vendor's answer to GET_VALUES holds."""


def packet(name: str) -> bytes:
    return raw(VECTORS[name].frame)


def raw(frame: Frame) -> bytes:
    assert isinstance(frame, bytes)
    return frame


def payload(name: str) -> bytes:
    (found,) = Stream(FORMAT).messages(packet(name))
    return found


def test_no_vector_is_left_out() -> None:
    assert VECTORS.keys() == SENT.keys() | REPORTED | {WRONG}


@pytest.mark.parametrize("name", SENT)
def test_what_a_host_sends_and_a_controller_obeys(name: str) -> None:
    message, address, values, does = SENT[name]
    assert PACKETS.encode(message, address, **values) == packet(name)
    device = DEVICE if address == DIRECT else FORWARDED
    obeyed = acts(plugin.decoder([device]).decode(0, packet(name)))
    if does is None:
        assert not obeyed
        return
    assert type(obeyed[-1]) is type(does)
    for number in ("velocity", "torque", "position"):
        assert getattr(obeyed[-1], number, 0.0) == pytest.approx(getattr(does, number, 0.0))
    other = FORWARDED if address == DIRECT else DEVICE
    assert not acts(plugin.decoder([other]).decode(0, packet(name)))


def test_what_pyvesc_forwards_is_another_command() -> None:
    """It sends 33, which asks for a joystick."""
    assert unpack(payload(WRONG)) == (DIRECT, 33, payload(WRONG)[1:])
    assert not plugin.decoder([FORWARDED, DEVICE][:1]).decode(0, packet(WRONG))


def test_the_whole_answer_both_ways() -> None:
    answer = payload("uart_get_values_response_fw5plus_by_id_1")
    decoded = decode_values(answer)
    assert decoded is not None
    assert decoded[0] == EVERYTHING
    assert decoded[1] == pytest.approx(GIVEN)
    assert encode_values(EVERYTHING, GIVEN, selective=False) == answer


def test_a_part_of_it_both_ways_and_what_a_driver_reports_of_it() -> None:
    name = "uart_get_values_selective_response"
    values = {"avg_motor_current": 12.25, "duty_cycle_now": -0.375, "rpm": -12345, "tachometer": -4242}
    values |= {"fault_code": 3, "controller_id": 1, "status": 2}
    decoded = decode_values(payload(name))
    assert decoded is not None
    assert decoded[0] == MOTION
    assert decoded[1] == pytest.approx(values)
    assert encode_values(MOTION, values, selective=True) == payload(name)
    device = Device("left", 1, Options(pole_pairs=5, torque_constant=0.1), Settings())
    events = plugin.driver([device]).receive(0, packet(name))
    (feedback,) = [event for event in events if isinstance(event, Feedback)]
    assert feedback.velocity == pytest.approx(-12345 * math.pi / 30 / 5)
    assert feedback.torque == pytest.approx(-1.225)  # driven backwards, it takes power
    assert feedback.position == pytest.approx(-4242 * math.tau / 30)


@pytest.mark.parametrize("duty", [0.2, -0.2])
def test_the_supply_gives_current_to_whatever_drives_and_steps_without_sign_only_grow(duty: float) -> None:
    """As the firmware: power into the motor is positive in both directions, what it brakes negative."""
    twin = plugin.twin(DEVICE, 0)
    position = velocity = 0.0
    seen: list[Mapping[str, Any]] = []
    for ms in range(1, 400):
        now = ms * MILLISECOND
        twin.step(now, [Feedback("left", now, position, velocity)])
        sent = duty if ms < 200 else 0.1 * duty
        twin.receive(now, PACKETS.encode("SET_DUTY", DIRECT, value=sent))
        twin.receive(now, PACKETS.encode("GET_VALUES", DIRECT))
        (torque,), answers = twin.step(now + MILLISECOND // 2, [])
        velocity += torque.torque / 0.01 * 1e-3
        position += velocity * 1e-3
        decoded = [decode_values(answer) for each in answers for answer in Stream(FORMAT).messages(raw(each))]
        seen += [each[1] for each in decoded if each is not None]
    driving, braking = seen[20], seen[210]
    assert driving["avg_motor_current"] > 1.0 > 0.0 < driving["avg_input_current"]
    assert braking["avg_motor_current"] < -1.0 < 0.0 > braking["avg_input_current"]
    steps = [each["tachometer_abs"] for each in seen]
    assert steps == sorted(steps)
    assert steps[-1] == pytest.approx(abs(seen[-1]["tachometer"]), abs=1)


def test_the_version() -> None:
    answer = decode_version(payload("uart_fw_version_response_6.06"))
    assert answer == ("firmware 6.06, hardware TWIN", 0x000102030405060708090A0B)


def test_a_late_answer_is_not_taken_for_what_is_so_now() -> None:
    driver = plugin.driver([Device("left", 1, Options(), Settings())])
    driver.send(0, ())
    assert not driver.receive(0, packet("uart_get_values_selective_response"))
    assert driver.counters.accepted == 1


def test_lengths_of_one_and_of_two_bytes() -> None:
    for size, start in ((1, "0201"), (255, "02ff"), (256, "030100"), (512, "030200")):
        message = bytes(range(256)) * 2
        framed = FORMAT.frame(message[:size])
        assert framed.hex().startswith(start)
        assert Stream(FORMAT).feed(framed) == [message[:size]]
    for size in (0, 513):
        with pytest.raises(ValueError, match="1 to 512"):
            FORMAT.frame(bytes(size))
    assert Stream(FORMAT).feed(bytes.fromhex("03 0010") + bytes(16)) == [Rx.IGNORED]


def test_behind_any_garbage_a_packet_is_found() -> None:
    random, good = Random(1), packet("uart_get_values_selective_response")
    found = 0
    for _ in range(200):
        stream = Stream(FORMAT)
        noise = random.bytes(1 + random.below(40))
        # What a false beginning waits for ends at the latest with as much as it may claim.
        found += payload("uart_get_values_selective_response") in stream.messages(noise + 20 * good)
    assert found == 200


def test_the_end_of_the_line_must_be_agreed_on() -> None:
    devices = [Device(name, at, Options(uart_id=at), Settings()) for name, at in (("left", 1), ("right", 2))]
    with pytest.raises(ValueError, match="must be the same"):
        plugin.driver(devices)


def test_one_that_tells_its_id_through_the_can_is_not_at_the_end_of_the_line() -> None:
    bench = make_bench(plugin, Options(), (1,), ("left",))
    bench.steps(100)
    read = bench.steps(1, (msg.ReadParameter("left", "controller_id"),)) + bench.steps(50)
    assert [e.value for one in read for e in one.events if isinstance(e, msg.Parameter)] == [1.0]
    restarted = bench.steps(1, (msg.Reboot("left"),)) + bench.steps(600)
    events = [event for one in restarted for event in one.events]
    assert bench.modes["left"] is msg.Mode.OFFLINE
    assert not [event for event in events if isinstance(event, msg.Fault)]


@pytest.mark.sample(2)
@pytest.mark.parametrize("clause", ["scan", "foreign", "obeyed", "answers", "disarm"])
def test_the_contract_where_one_is_at_the_end_of_the_line(clause: str) -> None:
    results = check(plugin, 1, (0, 1, 2), [each for each in CLAUSES if each.name == clause])
    assert results[0].outcome == "passed", table(results)


def test_an_exchange_is_a_frame() -> None:
    spec = plugin.spec(DEVICE)
    _, frames = plugin.driver([DEVICE]).send(0, ())
    assert all(isinstance(frame, Exchange) and spec.read_only(frame) for frame in frames)
