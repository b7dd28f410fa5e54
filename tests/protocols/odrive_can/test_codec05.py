"""Bytes of firmware 0.5.x: vectors both ways, cantools on the vendor's DBC with its known bugs, edges, and
that the two lines are never taken for each other."""

from __future__ import annotations

import struct
from typing import Any, cast

import can
import odrive_can.odrive
import pytest
from numpy.random import PCG64, Generator
from odrive_can.odrive import ODriveCAN

from protocols.frames import CanFrame
from protocols.odrive_can import messages
from protocols.odrive_can.codec import (
    COMMON,
    EXTENDED,
    LINE05,
    TABLES,
    decode_from_device,
    decode_to_device,
    encode,
    node_of,
)
from protocols.odrive_can.layout import Layout
from protocols.odrive_can.messages import Message, RemoteRequest
from tests.protocols.odrive_can.conversation import DBCS
from tests.protocols.odrive_can.test_codec import (
    MEANINGS,
    NODE,
    VECTORS,
    Recorder,
    close,
    compare_with_cantools,
    decoded,
    frame_of,
    message_of,
    of_client,
    random_value,
)

DBC = DBCS["0.5"]
VECTORS05 = [vector for vector in VECTORS if vector.get("fw") == "0.5.6"]
SHARED = [
    vector
    for vector in VECTORS
    if "fw" not in vector and vector["id"] & 0x1F in {row.cmd for row in COMMON} and vector["id"] >> 5 == NODE
]
"""Vectors of messages that both lines have."""

MEANINGS05: dict[str, tuple[type[Any], tuple[str, ...]]] = {
    "Heartbeat": (
        messages.Heartbeat05,
        (
            "axis_error",
            "axis_state",
            "motor_error_flag",
            "encoder_error_flag",
            "controller_error_flag",
            "trajectory_done",
        ),
    ),
    "Get_Motor_Error": (messages.GetMotorError, ("motor_error",)),
    "Get_Encoder_Error": (messages.GetEncoderError, ("encoder_error",)),
    "Get_Sensorless_Error": (messages.GetSensorlessError, ("sensorless_error",)),
    "Get_Controller_Error": (messages.GetControllerError, ("controller_error",)),
    "Get_Encoder_Count": (messages.GetEncoderCount, ("shadow_count", "count_in_cpr")),
    "Get_Sensorless_Estimates": (
        messages.GetSensorlessEstimates,
        ("position_turns", "velocity_turns_s"),
    ),
    "Get_ADC_Voltage": (messages.GetAdcVoltage, ("voltage_v",)),
    "Ask_ADC_Voltage": (messages.RequestAdcVoltage, ("gpio",)),
    "Set_Axis_Node_ID": (messages.SetAxisNodeId, ("new_node_id",)),
    "Set_Linear_Count": (messages.SetLinearCount, ("position_counts",)),
    "Start_Anticogging": (messages.StartAnticogging, ()),
    "Clear_Errors": (messages.ClearErrors05, ()),
    "Reboot": (messages.Reboot05, ()),
}


def message05_of(vector: dict[str, Any]) -> Message | RemoteRequest:
    meaning = vector["meaning"]
    kind, names = MEANINGS05[meaning.get("cmd") or meaning["msg"]]
    if meaning.get("request"):
        return RemoteRequest(next(row.cmd for row in LINE05 if row.message is kind))
    message: Message = kind(*(meaning.get(field, 0) for field in names))
    return message


@pytest.mark.parametrize("vector", VECTORS05, ids=lambda vector: vector["name"])
def test_a_vector_is_encoded_and_decoded(vector: dict[str, Any]) -> None:
    message, frame = message05_of(vector), frame_of(vector)
    assert close(decoded(frame, vector["direction"], "0.5"), message)
    if isinstance(message, RemoteRequest):
        assert CanFrame(frame.id, remote=True) == frame
    else:
        assert encode(NODE, message) == frame


@pytest.mark.parametrize("vector", SHARED, ids=lambda vector: vector["name"])
def test_what_both_lines_have_is_the_same_in_both(vector: dict[str, Any]) -> None:
    frame = frame_of(vector)
    assert close(decoded(frame, vector["direction"], "0.5"), message_of(vector))


def test_every_message_of_the_line_has_an_independent_vector() -> None:
    covered = {type(message05_of(vector)) for vector in VECTORS05} - {RemoteRequest}
    assert covered == {row.message for row in LINE05}
    assert len(VECTORS05) == 22


def test_the_vectors_of_the_client_are_regenerated_from_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(odrive_can.odrive, "dbc", DBC)
    recorder = Recorder()
    client = ODriveCAN(axis_id=NODE, can_bus=cast("can.BusABC", recorder))
    calls: dict[str, Any] = {
        "set_axis_node_id05_5": lambda: client.set_axis_node_id(5),
        "clear_errors05": client.clear_errors,
        "reboot05": client.reboot,
        # Its own set_linear_count looks up the message of 0.6.x in its DBC, which does not have it.
        "set_linear_count05_client": lambda: client._send_message("Set_Linear_Count", {"Position": -8192}),
        "rtr_get_motor_error05": lambda: client._send_message("Get_Motor_Error", rtr=True),
        "rtr_get_controller_error05": lambda: client._send_message("Get_Controller_Error", rtr=True),
    }
    theirs = {v["name"]: frame_of(v) for v in VECTORS05 if of_client(v)}
    assert set(calls) == set(theirs)
    for name, call in calls.items():
        call()
        assert recorder.frames[-1] == theirs[name], name


# -- cantools with the vendor's DBC -------------------------------------------------------------------

KNOWN_BUGS = {
    messages.GetEncoderCount: "the DBC types the counts unsigned; the firmware's are int32",
    messages.GetMotorError: "the DBC has the lower 32 of the 64 bits, beside choices beyond them",
}
UNITS = {
    "Axis3_Set_Input_Vel": ("rev", "rev/s"),
}
"""Units that the DBC has wrong: turns/s and N·m in the frame."""
NAMES = {kind: name for name, (kind, _) in (*MEANINGS.items(), *MEANINGS05.items())}
SPANS: dict[type[Any], tuple[int, int]] = {
    messages.GetMotorError: (0, 2**32 - 1),
    messages.GetEncoderCount: (0, 2**31 - 1),
    messages.SetLinearCount: (-(2**31), 2**31 - 1),
}
NOT_IN_THE_DBC = (messages.RequestAdcVoltage, messages.Estop)
ORDER05 = {
    messages.Heartbeat05: (
        "Axis_Error",
        "Axis_State",
        "Motor_Error_Flag",
        "Encoder_Error_Flag",
        "Controller_Error_Flag",
        "Trajectory_Done_Flag",
    ),
}


@pytest.mark.parametrize(
    "row",
    [row for row in COMMON + LINE05 if row.message not in NOT_IN_THE_DBC],
    ids=lambda row: row.message.__name__,
)
def test_cantools_encodes_and_decodes_the_same(row: Layout) -> None:
    theirs = DBC.get_message_by_name(f"Axis{NODE}_{NAMES[row.message]}")
    assert len(theirs.signals) == len(row.codes)

    def make(code: str, random: Generator) -> float:
        return random05(row.message, code, random)

    compare_with_cantools(row, "0.5", theirs, ORDER05.get(row.message, ()), make)


def random05(kind: type[Any], code: str, random: Generator) -> float | int:
    if kind in SPANS:
        low, high = SPANS[kind]
        return int(random.integers(low, high, endpoint=True))
    if code == "7":
        return int(random.integers(0, 2))
    return random_value(code, random)


def test_the_known_bugs_of_the_dbc_are_still_there_and_not_ours() -> None:
    """When one is mended, it is time to compare the message in full."""
    counts = encode(NODE, messages.GetEncoderCount(-5, 3))
    theirs = DBC.get_message_by_name(f"Axis{NODE}_Get_Encoder_Count").decode(counts.data)
    assert theirs == {"Shadow_Count": 4294967291, "Count_in_CPR": 3}, KNOWN_BUGS
    assert decoded(counts, "from_device", "0.5") == messages.GetEncoderCount(-5, 3)

    motor = encode(NODE, messages.GetMotorError(0x800000000))
    theirs = DBC.get_message_by_name(f"Axis{NODE}_Get_Motor_Error").decode(motor.data, decode_choices=False)
    assert theirs == {"Motor_Error": 0}, KNOWN_BUGS
    assert decoded(motor, "from_device", "0.5") == messages.GetMotorError(0x800000000)

    for name, units in UNITS.items():
        signals = sorted(DBC.get_message_by_name(name).signals, key=lambda s: int(s.start))
        assert tuple(signal.unit for signal in signals) == units
    assert "Axis3_Set_Absolute_Position" not in {message.name for message in DBC.messages}


# -- what only this line does -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "understood"),
    [
        (CanFrame(0x67, remote=True), messages.SetAxisState(0)),
        (CanFrame(0x62, remote=True), messages.Estop()),
        (CanFrame(0x76, remote=True), messages.Reboot05()),
        (CanFrame(0x66, remote=True), messages.SetAxisNodeId(0)),
        (CanFrame(0x78), messages.ClearErrors05()),
        (CanFrame(0x78, b"\x01"), messages.ClearErrors05()),
        (CanFrame(0x79, b"\xff\xff"), messages.SetLinearCount(0xFFFF)),
        (CanFrame(0x63, remote=True), RemoteRequest(0x03)),
        (CanFrame(0x63), RemoteRequest(0x03)),
        (CanFrame(0x63, bytes(8)), None),
        (CanFrame(0x7D, bytes(8)), RemoteRequest(0x1D)),
        (CanFrame(0x7C, b"\x03"), messages.RequestAdcVoltage(3)),
        (CanFrame(0x7C, remote=True), messages.RequestAdcVoltage(0)),
        (CanFrame(0x61, remote=True), None),
        (CanFrame(0x60, remote=True), None),
        (CanFrame(0x67, bytes(8), fd=True), None),
        (CanFrame(0x7F, bytes(8)), None),
    ],
    ids=lambda value: str(value) if isinstance(value, CanFrame) else "",
)
def test_what_a_device_decodes(frame: CanFrame, understood: Message | RemoteRequest | None) -> None:
    assert decode_to_device(frame, "0.5") == understood


@pytest.mark.parametrize(
    "row", [row for row in LINE05 if row.direction == "from_device"], ids=lambda row: row.message.__name__
)
def test_a_short_or_long_frame_of_a_device_is_malformed(row: Layout) -> None:
    assert decode_from_device(CanFrame(NODE << 5 | row.cmd, bytes(8)), "0.5") is not None
    for length in (*range(8), 9):
        assert decode_from_device(CanFrame(NODE << 5 | row.cmd, bytes(length)), "0.5") is None


def test_the_flags_of_the_last_byte_are_apart() -> None:
    for controller in (0, 1):
        for done in (0, 1):
            beat = messages.Heartbeat05(0, 8, 0, 0, controller, done)
            frame = encode(NODE, beat)
            assert frame.data[7] == controller | done << 7
            assert decoded(frame, "from_device", "0.5") == beat
    noise = CanFrame(0x61, struct.pack("<IBBBB", 7, 1, 0xFE, 0xFE, 0x7E))
    assert decoded(noise, "from_device", "0.5") == messages.Heartbeat05(7, 1, 0, 0, 0, 0)


@pytest.mark.parametrize("address", [0, 3, 0x3F, 0x40, 0xFEDCBA, 0xFFFFFF])
def test_extended_identifiers_have_the_same_shift_and_are_another_node(address: int) -> None:
    node = address | EXTENDED
    frame = encode(node, messages.SetAxisState(8))
    assert (frame.id, frame.extended) == (address << 5 | 0x07, True)
    assert node_of(frame) == node
    assert node_of(CanFrame(frame.id & 0x7FF, frame.data)) != node
    assert decode_to_device(frame, "0.5") == messages.SetAxisState(8)


def test_a_line_that_is_not_known_holds_only_what_both_mean_the_same_by() -> None:
    """Each message of a device means the same under "" and under the line that sent it, or nothing."""
    random = Generator(PCG64(5))
    for line in ("0.5", "0.6"):
        for row in TABLES[line].layouts:
            if row.direction == "to_device":
                continue
            data = bytes([NODE]) + struct.pack("<ff", *random.uniform(-9, 9, 2))[1:]
            frame = CanFrame(NODE << 5 | row.cmd, data)
            feedback_lost, known = decode_from_device(frame, ""), decode_from_device(frame, line)
            if isinstance(feedback_lost, messages.UnidentifiedHeartbeat):
                assert isinstance(known, messages.Heartbeat | messages.Heartbeat05)
                assert (feedback_lost.error, feedback_lost.state) == (known.error, known.state)
            elif row.cmd not in (0x00, 0x06):
                assert feedback_lost is None or feedback_lost == known
