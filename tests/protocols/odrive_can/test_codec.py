"""Bytes of both firmware lines: cantools on the vendor's DBCs both ways, with their known bugs, the vendor's
client, edges of every field, and that the two lines are never taken for each other."""

from __future__ import annotations

import math
import struct
from typing import Any, cast

import can
import odrive_can.odrive
import pytest
from numpy.random import PCG64, Generator
from odrive_can.odrive import ODriveCAN

from protocols.frames import CanFrame
from protocols.odrive_can import codec, messages, plugin
from protocols.odrive_can.codec import (
    LINE05,
    TABLES,
    cmd_of,
    decode_from_device,
    decode_to_device,
    encode,
    node_of,
    remote_frame,
)
from protocols.odrive_can.layout import FLOAT_MAX, Layout
from protocols.odrive_can.messages import Message, RemoteRequest
from protocols.reference_vectors import vectors_of
from tests.protocols.odrive_can.dbc import DBCS, MESSAGES

VECTORS = {str(vector.name): vector for vector in vectors_of(plugin)}
NODE = 3
SERIAL = 0x385F34733330


def each(rows: list[tuple[str, Layout]]) -> pytest.MarkDecorator:
    """Parametrize a test by rows of the tables and their firmware lines."""
    return pytest.mark.parametrize(
        ("line", "row"), rows, ids=lambda x: x if isinstance(x, str) else x.message.__name__
    )


ROWS = [("0.6", row) for row in TABLES["0.6"].layouts] + [("0.5", row) for row in LINE05]
"""Every message once."""


def decoded(frame: CanFrame, direction: str, line: str = "0.6") -> Message | RemoteRequest | None:
    return (decode_to_device if direction == "to_device" else decode_from_device)(frame, line)


def close(a: Any, b: Any) -> bool:
    """Equal, floats to binary32."""
    if type(a) is not type(b) or a is None or b is None:
        return False
    pairs = [(getattr(a, name), getattr(b, name)) for name in a.__slots__]
    return all(x == y or math.isclose(x, y, rel_tol=2**-23, abs_tol=1e-9) for x, y in pairs)


# -- the vendor's client, and what no package encodes -------------------------------------------------

BY_HAND: dict[str, tuple[str, Message | RemoteRequest]] = {
    "discover_broadcast_rtr_address": ("0.6", RemoteRequest(0x06)),
    "assign_node_id_5": ("0.6", messages.Address(5, SERIAL)),
    "encoder_count05_negative": ("0.5", messages.GetEncoderCount(-5, 8187)),
    "motor_error05_unbalanced_phases": ("0.5", messages.GetMotorError(1 << 35)),
    "ask_adc_voltage05_gpio3": ("0.5", messages.RequestAdcVoltage(3)),
}
"""Vectors that `test_vectors` cannot regenerate, with their firmware line and meaning."""


@pytest.mark.parametrize("name", BY_HAND)
def test_a_vector_by_hand_is_encoded_and_decoded(name: str) -> None:
    vector, (line, message) = VECTORS[name], BY_HAND[name]
    assert isinstance(vector.frame, CanFrame)
    node = node_of(vector.frame)
    assert decoded(vector.frame, vector.direction, line) == message
    if isinstance(message, RemoteRequest):
        assert remote_frame(node, message.cmd) == vector.frame
    else:
        assert encode(node, message) == vector.frame


class Recorder:
    """In the place of a python-can bus: keeps what the client sends."""

    channel_info = "recorder"

    def __init__(self) -> None:
        self.frames: list[CanFrame] = []

    def send(self, message: can.Message) -> None:
        data, remote = bytes(message.data or b""), message.is_remote_frame
        self.frames.append(CanFrame(message.arbitration_id, data, message.is_extended_id, remote))

    def shutdown(self) -> None:
        """Nothing to close."""


PASS = "PASSTHROUGH"
CLIENT_CALLS: dict[str, dict[str, tuple[Any, ...]]] = {
    "0.6": {
        "set_controller_mode_position_passthrough": (
            "set_controller_mode",
            "POSITION_CONTROL",
            "PASSTHROUGH",
        ),
        "set_controller_mode_velocity_passthrough": (
            "set_controller_mode",
            "VELOCITY_CONTROL",
            "PASSTHROUGH",
        ),
        "set_controller_mode_torque_passthrough": ("set_controller_mode", "TORQUE_CONTROL", PASS),
        "set_input_pos_1.5turn_vff0.25_tff-0.5": ("set_input_pos", 1.5, 0.25, -0.5),
        "set_input_pos_vff_edges": ("set_input_pos", -2.0, 32.767, -32.768),
        "set_input_pos_vff_beyond_int8": ("set_input_pos", 0.5, 0.128, -0.129),
        "set_input_vel_-2.25tps_tff0.1": ("set_input_vel", -2.25, 0.1),
        "set_input_torque_0.75": ("set_input_torque", 0.75),
        "set_limits_10tps_20A": ("set_limits", 10.0, 20.0),
        "set_traj_vel_limit": ("set_traj_vel_limit", 5.0),
        "set_traj_accel_limits": ("set_traj_accel_limits", 2.0, 3.0),
        "set_traj_inertia": ("set_traj_inertia", 0.5),
        "reboot": ("reboot",),
        "clear_errors": ("clear_errors",),
        "set_axis_state_idle": ("set_axis_state_no_wait", "IDLE"),
        "set_axis_state_closed_loop": ("set_axis_state_no_wait", "CLOSED_LOOP_CONTROL"),
        "set_pos_gain": ("set_pos_gain", 20.0),
        "set_vel_gains": ("set_vel_gains", 0.16, 0.32),
        "set_absolute_position_1.25turn": ("set_linear_count", 1.25),
        "rtr_get_bus_voltage_current": ("_send_message", "Get_Bus_Voltage_Current", None, True),
    },
    "0.5": {
        "set_axis_node_id05_5": ("set_axis_node_id", 5),
        "clear_errors05": ("clear_errors",),
        "reboot05": ("reboot",),
        # Its own set_linear_count looks up the message of 0.6.x in its DBC, which does not have it.
        "set_linear_count05_client": ("_send_message", "Set_Linear_Count", {"Position": -8192}),
        "rtr_get_motor_error05": ("_send_message", "Get_Motor_Error", None, True),
        "rtr_get_controller_error05": ("_send_message", "Get_Controller_Error", None, True),
    },
}
"""By firmware line and vector: the call of the client that makes its bytes."""


@pytest.mark.parametrize("line", CLIENT_CALLS)
def test_the_vectors_of_the_client_are_regenerated_from_it(
    line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(odrive_can.odrive, "dbc", DBCS[line])
    recorder = Recorder()
    client = ODriveCAN(axis_id=NODE, can_bus=cast("can.BusABC", recorder))
    theirs = {
        name: vector.frame
        for name, vector in VECTORS.items()
        if vector.source.startswith("odrive-can 2.1.0") and ("fw" in vector.entry) == (line == "0.5")
    }
    assert set(CLIENT_CALLS[line]) == set(theirs)
    for name, (method, *args) in CLIENT_CALLS[line].items():
        getattr(client, method)(*args)
        assert recorder.frames[-1] == theirs[name], name


# -- cantools with the vendor's DBC -------------------------------------------------------------------

KNOWN_BUGS = {
    messages.GetEncoderCount: "the DBC types the counts unsigned; the firmware's are int32",
    messages.GetMotorError: "the DBC has the lower 32 of the 64 bits, beside choices beyond them",
}
NOT_IN_THE_DBC = {"0.5": (messages.RequestAdcVoltage, messages.Estop), "0.6": ()}
SPANS = {
    "b": (0, 1),
    "7": (0, 1),
    "B": (0, 0xFF),
    "c": (0, 0),
    "H": (0, 0xFFFF),
    "i": (-(2**31), 2**31 - 1),
    "I": (0, 0xFFFFFFFF),
    "S": (0, (1 << 48) - 1),
}
SPANS_OF_BUGS = {messages.GetMotorError: (0, 2**32 - 1), messages.GetEncoderCount: (0, 2**31 - 1)}


def theirs_of(line: str, kind: type[Any]) -> Any:
    """The DBC's message: its name is ours, with underscores."""
    names = {name.replace("_", "").lower(): message for name, message in MESSAGES[line].items()}
    return names[kind.__name__.removesuffix("05").lower()]


def random_value(kind: type[Any], code: str, random: Generator) -> float | int:
    span = SPANS_OF_BUGS.get(kind) or SPANS.get(code)
    if span:
        return int(random.integers(*span, endpoint=True))
    if code == "m":
        return int(random.integers(-32768, 32767, endpoint=True)) * 0.001
    exponent = float(random.uniform(-30, 30))
    return float(math.copysign(10.0**exponent, random.uniform(-1, 1)))


@each([(line, r) for line in DBCS for r in TABLES[line].layouts if r.message not in NOT_IN_THE_DBC[line]])
def test_cantools_encodes_and_decodes_the_same(line: str, row: Layout) -> None:
    """100 random messages."""
    theirs = theirs_of(line, row.message)
    signals = [str(signal.name) for signal in sorted(theirs.signals, key=lambda s: int(s.start))]
    assert len(signals) == len(row.codes.replace("c", ""))
    seed = 20261121 + row.cmd
    random = Generator(PCG64(seed))
    directions = ["to_device", "from_device"] if row.direction == "both" else [row.direction]
    for turn in range(100):
        values = [random_value(row.message, code, random) for code in row.codes]
        message = row.message(*values)
        frame = encode(NODE, message)
        named = dict(zip(signals, values, strict=False))
        where = f"seed {seed}, turn {turn}: {message}"
        assert frame == CanFrame(theirs.frame_id, theirs.encode(named)), where
        if row.codes:
            back = theirs.decode(frame.data, decode_choices=False)
            for name, value in named.items():
                assert math.isclose(back[name], value, rel_tol=2**-23, abs_tol=1e-9), where
        for direction in directions:
            if frame.data or direction == "to_device":
                assert close(decoded(frame, direction, line), message), where


def test_the_known_bugs_of_the_dbc_are_still_there_and_not_ours() -> None:
    """When one is mended, it is time to compare the message in full."""
    for ours, theirs in (
        (messages.GetEncoderCount(-5, 3), {"Shadow_Count": 4294967291, "Count_in_CPR": 3}),
        (messages.GetMotorError(0x800000000), {"Motor_Error": 0}),
    ):
        frame = encode(NODE, ours)
        assert theirs_of("0.5", type(ours)).decode(frame.data, decode_choices=False) == theirs, KNOWN_BUGS
        assert decode_from_device(frame, "0.5") == ours

    # The units are turns/s and N·m in the frame.
    signals = sorted(MESSAGES["0.5"]["Set_Input_Vel"].signals, key=lambda s: int(s.start))
    assert [signal.unit for signal in signals] == ["rev", "rev/s"]
    assert "Set_Absolute_Position" not in MESSAGES["0.5"]


# -- edges ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "count"),
    [
        (0.0, 0),
        (0.0004, 0),
        (0.0006, 1),
        (-0.0006, -1),
        (0.127, 127),
        (0.128, 128),
        (-0.128, -128),
        (-0.129, -129),
        (1.0, 1000),
        (32.766, 32766),
        (32.767, 32767),
        (32.768, 32767),
        (65.536, 32767),
        (1e300, 32767),
        (-32.768, -32768),
        (-32.769, -32768),
        (-1e300, -32768),
    ],
)
def test_feed_forwards_saturate_and_never_wrap(value: float, count: int) -> None:
    frame = encode(NODE, messages.SetInputPos(0.0, value, value))
    assert struct.unpack("<fhh", frame.data)[1:] == (count, count)


@each([(line, row) for line, row in ROWS if set(row.codes) & set("fnm")])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_neither_encoded_nor_decoded(line: str, row: Layout, bad: float) -> None:
    for index, code in enumerate(row.codes):
        values = [1.0] * len(row.codes)
        good = bytearray(encode(NODE, row.message(*values)).data)
        values[index] = bad
        with pytest.raises(ValueError, match="not finite"):
            encode(NODE, row.message(*values))
        if code == "m":
            continue
        good[4 * index : 4 * index + 4] = struct.pack("<f", bad)
        got = decoded(CanFrame(NODE << 5 | row.cmd, bytes(good)), row.direction, line)
        if code == "n":
            assert got is not None
            assert getattr(got, row.message.__slots__[index]) is None
        else:
            assert got is None


BELOW = math.nextafter(2.0**-126, 0.0)
"""The largest denormal binary32, or just above it."""


@pytest.mark.parametrize("tiny", [-0.0, 1e-40, -1e-40, 2.0**-149, -(2.0**-127), BELOW, -BELOW])
def test_minus_zero_and_denormals_are_zero_both_ways(tiny: float) -> None:
    for kind, packed, values in (
        (messages.SetInputVel, "<ff", (tiny, 1.0)),
        (messages.SetInputVel, "<ff", (1.0, tiny)),
        (messages.SetInputPos, "<fhh", (tiny, 0, 0)),
        (messages.SetInputTorque, "<f", (tiny,)),
    ):
        zero = kind(*(0.0 if value is tiny else value for value in values))
        assert encode(NODE, kind(*values)) == encode(NODE, zero)
        if abs(tiny) != BELOW:  # which binary32 cannot carry
            data = struct.pack(packed, *values)
            assert repr(decode_to_device(CanFrame(NODE << 5 | cmd_of(kind), data))) == repr(
                decode_to_device(encode(NODE, zero))
            )


@pytest.mark.parametrize("value", [2.0**-126, 1e-30, 1.0, 3.4028234663852886e38, 1e39, 1e308])
@pytest.mark.parametrize("sign", [1, -1])
def test_floats_are_rounded_to_binary32_and_saturate(value: float, sign: int) -> None:
    given, expected = sign * value, sign * min(value, FLOAT_MAX)
    for message, offset in (
        (messages.SetInputTorque(given), 0),
        (messages.SetInputVel(given, 1.0), 0),
        (messages.SetInputVel(1.0, given), 4),
        (messages.SetInputPos(given, 0.0, 0.0), 0),
    ):
        (got,) = struct.unpack_from("<f", encode(NODE, message).data, offset)
        assert math.isclose(got, expected, rel_tol=2**-24)


REMOTE = "remote"


@pytest.mark.parametrize(
    ("line", "cmd", "data", "message"),
    [
        # Short data is read as if the rest were zeros.
        ("0.6", 0x07, "08000000", messages.SetAxisState(8)),
        ("0.6", 0x07, "08", messages.SetAxisState(8)),
        ("0.6", 0x0B, "0100000001", messages.SetControllerMode(1, 1)),
        ("0.6", 0x0E, "0000403f", messages.SetInputTorque(0.75)),
        ("0.6", 0x18, "", messages.ClearErrors(0)),
        ("0.6", 0x18, "01", messages.ClearErrors(1)),
        ("0.6", 0x16, "", messages.Reboot(0)),
        ("0.6", 0x0C, "0000c03f", messages.SetInputPos(1.5, 0.0, 0.0)),
        ("0.6", 0x0D, "000010c0", messages.SetInputVel(-2.25, 0.0)),
        ("0.6", 0x02, "", messages.Estop()),
        ("0.5", 0x18, "", messages.ClearErrors05()),
        ("0.5", 0x18, "01", messages.ClearErrors05()),
        ("0.5", 0x19, "ffff", messages.SetLinearCount(0xFFFF)),
        ("0.5", 0x1C, "03", messages.RequestAdcVoltage(3)),
        # Firmware before 0.6.11 leaves the connection id out (ODriveArduino `src/can_simple_messages.hpp`).
        ("0.6", 0x06, "03303373345f38", messages.Address(3, SERIAL, None)),
        ("0.6", 0x06, "03303373345f3800", messages.Address(3, SERIAL, 0)),
        ("0.6", 0x06, "03303373345f3807", messages.Address(3, SERIAL, 7)),
        # Requests.
        ("0.6", 0x09, "", RemoteRequest(0x09)),
        ("0.6", 0x17, "", RemoteRequest(0x17)),
        ("0.6", 0x17, REMOTE, RemoteRequest(0x17)),
        ("0.6", 0x01, REMOTE, RemoteRequest(0x01)),
        ("0.5", 0x03, "", RemoteRequest(0x03)),
        ("0.5", 0x03, REMOTE, RemoteRequest(0x03)),
        ("0.5", 0x1D, "01", RemoteRequest(0x1D)),
        ("0.5", 0x1D, "00" * 8, RemoteRequest(0x1D)),
        # 0.5.x obeys remote frames.
        ("0.5", 0x07, REMOTE, messages.SetAxisState(0)),
        ("0.5", 0x02, REMOTE, messages.Estop()),
        ("0.5", 0x16, REMOTE, messages.Reboot05()),
        ("0.5", 0x06, REMOTE, messages.SetAxisNodeId(0)),
        ("0.5", 0x1C, REMOTE, messages.RequestAdcVoltage(0)),
        # Ignored.
        ("0.6", 0x07, REMOTE, None),
        ("0.6", 0x1D, "01", None),
        ("0.6", 0x08, "00" * 8, None),
        ("0.6", 0x09, "00" * 8, None),
        ("0.6", 0x10, "00" * 8, None),
        ("0.5", 0x00, REMOTE, None),
        ("0.5", 0x01, REMOTE, None),
        ("0.5", 0x03, "00" * 8, None),
        ("0.5", 0x1F, "00" * 8, None),
    ],
)
def test_what_a_device_decodes(
    line: str, cmd: int, data: str, message: Message | RemoteRequest | None
) -> None:
    identifier = NODE << 5 | cmd
    if data == REMOTE:
        assert decode_to_device(CanFrame(identifier, remote=True), line) == message
        return
    frame = CanFrame(identifier, bytes.fromhex(data))
    assert decode_to_device(frame, line) == message
    assert decode_to_device(CanFrame(identifier, frame.data, fd=True), line) is None


@each([(line, row) for line, row in ROWS if row.direction != "to_device"])
def test_a_short_or_long_frame_of_a_device_is_malformed(line: str, row: Layout) -> None:
    full = bytes([NODE]) + bytes(8)
    assert decode_from_device(CanFrame(NODE << 5 | row.cmd, full[: row.dlc]), line) is not None
    for length in (*range(row.dlc), 9):
        assert decode_from_device(CanFrame(NODE << 5 | row.cmd, full[:length]), line) is None


@pytest.mark.parametrize(("last", "connection"), [("", None), ("00", 0), ("07", 7)])
def test_an_address_with_and_without_a_connection(last: str, connection: int | None) -> None:
    frame = CanFrame(0x66, bytes.fromhex("03303373345f38" + last))
    assert decode_from_device(frame) == messages.Address(3, SERIAL, connection)


def test_noise_beside_the_flags_of_0_5_is_ignored() -> None:
    noise = CanFrame(0x61, struct.pack("<IBBBB", 7, 1, 0xFE, 0xFE, 0x7E))
    assert decode_from_device(noise, "0.5") == messages.Heartbeat05(7, 1, 0, 0, 0, 0)


def test_a_line_that_is_not_known_holds_only_what_both_mean_the_same_by() -> None:
    """Each message of a device means the same under "" and under the line that sent it, or nothing."""
    random = Generator(PCG64(5))
    for line in ("0.5", "0.6"):
        for row in TABLES[line].layouts:
            if row.direction == "to_device":
                continue
            data = bytes([NODE]) + struct.pack("<ff", *random.uniform(-9, 9, 2))[1:]
            frame = CanFrame(NODE << 5 | row.cmd, data)
            unidentified, known = decode_from_device(frame, ""), decode_from_device(frame, line)
            if isinstance(unidentified, messages.UnidentifiedHeartbeat):
                assert isinstance(known, messages.Heartbeat | messages.Heartbeat05)
                assert (unidentified.error, unidentified.state) == (known.error, known.state)
            elif row.cmd not in (0x00, 0x06):
                assert unidentified is None or unidentified == known


def test_turns_and_radians() -> None:
    assert codec.radians(1.5) == pytest.approx(9.42477796076938)
    assert codec.turns(-14.137166941154069) == pytest.approx(-2.25)
