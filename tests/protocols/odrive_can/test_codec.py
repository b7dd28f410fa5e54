"""Bytes: the vendor's vectors both ways, cantools on the vendor's DBC both ways, edges of every field."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import can
import pytest
from numpy.random import PCG64, Generator
from odrive_can.odrive import ODriveCAN

import fixtures
from protocols.frames import CanFrame
from protocols.odrive_can import codec, messages
from protocols.odrive_can.codec import BY_TYPE, TABLES, cmd_of, decode_from_device, decode_to_device, encode
from protocols.odrive_can.layout import FLOAT_MAX, Layout
from protocols.odrive_can.messages import Message, RemoteRequest
from tests.protocols.odrive_can.conversation import DBCS

VECTORS: list[dict[str, Any]] = json.loads(
    (Path(fixtures.__file__).parent / "vectors" / "odrive_can.json").read_text()
)
OURS = [vector for vector in VECTORS if vector.get("fw", "0.6.10") == "0.6.10"]
NODE = 3
DBC = DBCS["0.6"]

# Field names of a vector's meaning, in the order of our messages' fields.
MEANINGS: dict[str, tuple[type[Any], tuple[str, ...]]] = {
    "Set_Controller_Mode": (messages.SetControllerMode, ("control_mode", "input_mode")),
    "Set_Input_Pos": (messages.SetInputPos, ("position_turns", "velocity_ff_turns_s", "torque_ff_nm")),
    "Set_Input_Vel": (messages.SetInputVel, ("velocity_turns_s", "torque_ff_nm")),
    "Set_Input_Torque": (messages.SetInputTorque, ("torque_nm",)),
    "Set_Limits": (messages.SetLimits, ("velocity_limit_turns_s", "current_limit_a")),
    "Set_Traj_Vel_Limit": (messages.SetTrajVelLimit, ("velocity_limit_turns_s",)),
    "Set_Traj_Accel_Limits": (messages.SetTrajAccelLimits, ("accel_turns_s2", "decel_turns_s2")),
    "Set_Traj_Inertia": (messages.SetTrajInertia, ("inertia",)),
    "Reboot": (messages.Reboot, ("action",)),
    "Set_Axis_State": (messages.SetAxisState, ("state",)),
    "Set_Pos_Gain": (messages.SetPosGain, ("pos_gain",)),
    "Set_Vel_Gains": (messages.SetVelGains, ("vel_gain", "vel_integrator_gain")),
    "Clear_Errors": (messages.ClearErrors, ("identify",)),
    "Set_Absolute_Position": (messages.SetAbsolutePosition, ("position_turns",)),
    "Estop": (messages.Estop, ()),
    "Enter_DFU_Mode": (messages.EnterDfuMode, ()),
    "Heartbeat": (messages.Heartbeat, ("axis_error", "axis_state", "procedure_result", "trajectory_done")),
    "Get_Version": (
        messages.GetVersion,
        (
            "protocol",
            "hw_line",
            "hw_version",
            "hw_variant",
            "fw_major",
            "fw_minor",
            "fw_revision",
            "fw_unreleased",
        ),
    ),
    "Get_Encoder_Estimates": (messages.GetEncoderEstimates, ("position_turns", "velocity_turns_s")),
    "Get_Error": (messages.GetError, ("active_errors", "disarm_reason")),
    "Get_Iq": (messages.GetIq, ("iq_setpoint_a", "iq_measured_a")),
    "Get_Temperature": (messages.GetTemperature, ("fet_temp_c", "motor_temp_c")),
    "Get_Bus_Voltage_Current": (messages.GetBusVoltageCurrent, ("bus_voltage_v", "bus_current_a")),
    "Get_Torques": (messages.GetTorques, ("torque_target_nm", "torque_estimate_nm")),
    "Get_Powers": (messages.GetPowers, ("electrical_w", "mechanical_w")),
}


def message_of(vector: dict[str, Any]) -> Message | RemoteRequest:
    """A vector's meaning as our message."""
    meaning = vector["meaning"]
    name = meaning.get("cmd") or meaning["msg"]
    if meaning.get("request"):
        return RemoteRequest(0x06 if name == "Address" else BY_TYPE[MEANINGS[name][0]].cmd)
    if name in ("RxSdo", "TxSdo"):
        raw = struct.unpack("<I", struct.pack("<f", meaning["value_f32"]))[0]
        if name == "RxSdo":
            return messages.RxSdo(meaning["opcode"], meaning["endpoint_id"], 0, raw)
        return messages.TxSdo(0, meaning["endpoint_id"], 0, raw)
    if name == "Address":
        if "new_node_id" in meaning:
            return messages.Address(meaning["new_node_id"], meaning["serial_number"])
        return messages.Address(meaning["node_id"], meaning["serial_number"], 0)
    kind, names = MEANINGS[name]
    # A Heartbeat's trajectory flag is left out of the meaning where it is 0.
    message: Message = kind(*(meaning.get(field, 0) for field in names))
    return message


def frame_of(vector: dict[str, Any]) -> CanFrame:
    return CanFrame(vector["id"], bytes.fromhex(vector["data"]), vector["extended"], vector.get("rtr", False))


def decoded(frame: CanFrame, direction: str, line: str = "0.6") -> Message | RemoteRequest | None:
    return (decode_to_device if direction == "to_device" else decode_from_device)(frame, line)


def close(a: Any, b: Any) -> bool:
    """Equal, floats to binary32."""
    if type(a) is not type(b) or a is None or b is None:
        return False
    pairs = [(getattr(a, name), getattr(b, name)) for name in a.__slots__]
    return all(x == y or math.isclose(x, y, rel_tol=2**-23, abs_tol=1e-9) for x, y in pairs)


@pytest.mark.parametrize("vector", OURS, ids=lambda vector: vector["name"])
def test_a_vector_is_encoded_and_decoded(vector: dict[str, Any]) -> None:
    message, frame = message_of(vector), frame_of(vector)
    assert close(decoded(frame, vector["direction"]), message)
    if isinstance(message, RemoteRequest):
        assert CanFrame(frame.id, remote=True) == frame
        return
    padded = encode(frame.id >> 5, message)
    assert padded.id == frame.id
    assert padded.data == frame.data
    assert not padded.extended
    assert not padded.remote


def test_every_vector_has_a_source_and_is_of_one_line_or_of_both() -> None:
    assert all(vector["source"] for vector in VECTORS)
    assert len(OURS) + len([v for v in VECTORS if v.get("fw") == "0.5.6"]) == len(VECTORS)
    assert len(OURS) >= 37


def test_no_vector_records_a_known_bug_of_a_package() -> None:
    """The day one is carried in, it must be asserted not to be sent."""
    wrong = [
        v["name"] for v in VECTORS if "KNOWN_SDK_BUG" in v["name"] or "BUG" in str(v["meaning"].get("note"))
    ]
    assert wrong == []


def test_every_message_has_an_independent_vector() -> None:
    """The units of Address (assign and answer) and of both SDOs are in the vectors, too."""
    covered = {type(message_of(vector)) for vector in OURS} - {RemoteRequest}
    assert covered == {layout.message for layout in TABLES["0.6"].layouts}


class Recorder:
    """In the place of a python-can bus: keeps what the client sends."""

    channel_info = "recorder"

    def __init__(self) -> None:
        self.frames: list[CanFrame] = []

    def send(self, message: Any) -> None:
        self.frames.append(
            CanFrame(
                message.arbitration_id,
                bytes(message.data or b""),
                message.is_extended_id,
                message.is_remote_frame,
            )
        )

    def shutdown(self) -> None:
        """Nothing to close."""


def client_calls(client: ODriveCAN) -> dict[str, Any]:
    """By vector: the call of odrive-can's client that makes its bytes."""
    return {
        "set_controller_mode_position_passthrough": lambda: client.set_controller_mode(
            "POSITION_CONTROL", "PASSTHROUGH"
        ),
        "set_controller_mode_velocity_passthrough": lambda: client.set_controller_mode(
            "VELOCITY_CONTROL", "PASSTHROUGH"
        ),
        "set_controller_mode_torque_passthrough": lambda: client.set_controller_mode(
            "TORQUE_CONTROL", "PASSTHROUGH"
        ),
        "set_input_pos_1.5turn_vff0.25_tff-0.5": lambda: client.set_input_pos(1.5, 0.25, -0.5),
        "set_input_pos_vff_edges": lambda: client.set_input_pos(-2.0, 32.767, -32.768),
        "set_input_pos_vff_beyond_int8": lambda: client.set_input_pos(0.5, 0.128, -0.129),
        "set_input_vel_-2.25tps_tff0.1": lambda: client.set_input_vel(-2.25, 0.1),
        "set_input_torque_0.75": lambda: client.set_input_torque(0.75),
        "set_limits_10tps_20A": lambda: client.set_limits(10.0, 20.0),
        "set_traj_vel_limit": lambda: client.set_traj_vel_limit(5.0),
        "set_traj_accel_limits": lambda: client.set_traj_accel_limits(2.0, 3.0),
        "set_traj_inertia": lambda: client.set_traj_inertia(0.5),
        "reboot": client.reboot,
        "clear_errors": client.clear_errors,
        "set_axis_state_idle": lambda: client.set_axis_state_no_wait("IDLE"),
        "set_axis_state_closed_loop": lambda: client.set_axis_state_no_wait("CLOSED_LOOP_CONTROL"),
        "set_pos_gain": lambda: client.set_pos_gain(20.0),
        "set_vel_gains": lambda: client.set_vel_gains(0.16, 0.32),
        "set_absolute_position_1.25turn": lambda: client.set_linear_count(
            1.25  # type: ignore[arg-type]  # annotated for the counts of 0.5.x; 0.6.x takes turns
        ),
        "rtr_get_bus_voltage_current": lambda: client._send_message("Get_Bus_Voltage_Current", rtr=True),
    }


def of_client(vector: dict[str, Any]) -> bool:
    return str(vector["source"]).startswith("odrive-can 2.1.0")


def test_the_vectors_of_the_client_are_regenerated_from_it() -> None:
    recorder = Recorder()
    calls = client_calls(ODriveCAN(axis_id=NODE, can_bus=cast("can.BusABC", recorder)))
    theirs = {v["name"]: frame_of(v) for v in VECTORS if of_client(v) and "fw" not in v}
    assert set(calls) == set(theirs)
    for name, call in calls.items():
        call()
        assert recorder.frames[-1] == theirs[name], name


# -- cantools with the vendor's DBC -------------------------------------------------------------------

DBC_NAMES = {
    messages.GetVersion: "Get_Version",
    messages.RxSdo: "RxSdo",
    messages.TxSdo: "TxSdo",
    messages.Address: "Address",
} | {kind: name for name, (kind, _) in MEANINGS.items()}
DBC_FIELDS: dict[type[Any], tuple[str, ...]] = {
    messages.GetVersion: (
        "Protocol_Version",
        "Hw_Version_Major",
        "Hw_Version_Minor",
        "Hw_Version_Variant",
        "Fw_Version_Major",
        "Fw_Version_Minor",
        "Fw_Version_Revision",
        "Fw_Version_Unreleased",
    ),
    messages.Heartbeat: ("Axis_Error", "Axis_State", "Procedure_Result", "Trajectory_Done_Flag"),
    messages.RxSdo: ("Opcode", "Endpoint_ID", "Reserved", "Value"),
    messages.TxSdo: ("Reserved0", "Endpoint_ID", "Reserved1", "Value"),
    messages.Address: ("Node_ID", "Serial_Number"),
}
Make = Callable[[str, Generator], float]
SPANS = {"b": 1, "B": 0xFF, "c": 0, "H": 0xFFFF, "I": 0xFFFFFFFF, "S": (1 << 48) - 1}


def random_value(code: str, random: Generator) -> float | int:
    if code in SPANS:
        return int(random.integers(0, SPANS[code], endpoint=True))
    if code == "m":
        return int(random.integers(-32768, 32767, endpoint=True)) * 0.001
    exponent = float(random.uniform(-30, 30))
    return float(math.copysign(10.0**exponent, random.uniform(-1, 1)))


def compare_with_cantools(row: Layout, line: str, theirs: Any, signals: tuple[str, ...], make: Make) -> None:
    """Encode and decode 100 random messages as cantools does; `make` gives a random value by field code."""
    seed = 20261121 + row.cmd
    random = Generator(PCG64(seed))
    signals = signals or tuple(s.name for s in sorted(theirs.signals, key=lambda s: int(s.start)))
    directions = ["to_device", "from_device"] if row.direction == "both" else [row.direction]
    for turn in range(100):
        values = [make(code, random) for code in row.codes]
        message = row.message(*values)
        frame = encode(NODE, message)
        reported = dict(zip(signals, values[: len(signals)], strict=True))
        where = f"seed {seed}, turn {turn}: {message}"
        assert frame.id == theirs.frame_id, where
        assert frame.data == theirs.encode(reported), where
        if row.codes:
            back = theirs.decode(frame.data, decode_choices=False)
            for name, value in reported.items():
                assert math.isclose(back[name], value, rel_tol=2**-23, abs_tol=1e-9), where
        for direction in directions:
            if frame.data or direction == "to_device":
                assert close(decoded(frame, direction, line), message), where


@pytest.mark.parametrize("layout", TABLES["0.6"].layouts, ids=lambda layout: layout.message.__name__)
def test_cantools_encodes_and_decodes_the_same(layout: Layout) -> None:
    theirs = DBC.get_message_by_name(f"Axis{NODE}_{DBC_NAMES[layout.message]}")
    compare_with_cantools(layout, "0.6", theirs, DBC_FIELDS.get(layout.message, ()), random_value)


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


FLOATS = [layout for layout in TABLES["0.6"].layouts if set(layout.codes) & set("fnm")]


@pytest.mark.parametrize("layout", FLOATS, ids=lambda layout: layout.message.__name__)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_neither_encoded_nor_decoded(layout: Layout, bad: float) -> None:
    for index, code in enumerate(layout.codes):
        values = [1.0 if c in "fnm" else 1 for c in layout.codes]
        values[index] = bad
        with pytest.raises(ValueError, match="not finite"):
            encode(NODE, layout.message(*values))
        if code == "m":
            continue
        good = bytearray(encode(NODE, layout.message(*[1.0 for _ in layout.codes])).data)
        good[4 * index : 4 * index + 4] = struct.pack("<f", bad)
        frame = CanFrame(NODE << 5 | layout.cmd, bytes(good))
        got = decoded(frame, layout.direction)
        if code == "n":
            assert got is not None
            assert getattr(got, layout.message.__slots__[index]) is None
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


@pytest.mark.parametrize(
    ("cmd", "data", "message"),
    [
        (0x07, "08000000", messages.SetAxisState(8)),
        (0x07, "08", messages.SetAxisState(8)),
        (0x0E, "0000403f", messages.SetInputTorque(0.75)),
        (0x18, "", messages.ClearErrors(0)),
        (0x18, "01", messages.ClearErrors(1)),
        (0x16, "", messages.Reboot(0)),
        (0x0C, "0000c03f", messages.SetInputPos(1.5, 0.0, 0.0)),
        (0x0D, "000010c0", messages.SetInputVel(-2.25, 0.0)),
        (0x02, "", messages.Estop()),
        (0x09, "", RemoteRequest(0x09)),
        (0x17, "", RemoteRequest(0x17)),
    ],
)
def test_a_device_reads_short_frames_as_if_the_rest_were_zero(cmd: int, data: str, message: Message) -> None:
    assert decode_to_device(CanFrame(NODE << 5 | cmd, bytes.fromhex(data))) == message


def test_a_device_ignores_fd_and_unknown_frames() -> None:
    state = encode(NODE, messages.SetAxisState(8))
    assert decode_to_device(CanFrame(state.id, state.data, fd=True)) is None
    assert decode_to_device(CanFrame(state.id, remote=True)) is None
    assert decode_to_device(CanFrame(NODE << 5 | 0x08, bytes(8))) is None
    assert decode_to_device(CanFrame(NODE << 5 | 0x10, bytes(8))) is None
    assert decode_to_device(CanFrame(NODE << 5 | 0x09, bytes(8))) is None


@pytest.mark.parametrize(
    "layout",
    [lay for lay in TABLES["0.6"].layouts if lay.direction != "to_device"],
    ids=lambda lay: lay.message.__name__,
)
def test_a_short_or_long_frame_of_a_device_is_malformed(layout: Layout) -> None:
    full = bytes([NODE]) + bytes(7)
    assert decode_from_device(CanFrame(NODE << 5 | layout.cmd, full[: layout.dlc])) is not None
    for length in (*range(layout.dlc), 9):
        assert decode_from_device(CanFrame(NODE << 5 | layout.cmd, (full + b"\0")[:length])) is None


def test_turns_and_radians() -> None:
    assert codec.radians(1.5) == pytest.approx(9.42477796076938)
    assert codec.turns(-14.137166941154069) == pytest.approx(-2.25)
    for vector in OURS:
        meaning = vector["meaning"]
        if "position_rad" in meaning:
            assert codec.radians(meaning["position_turns"]) == pytest.approx(meaning["position_rad"])
