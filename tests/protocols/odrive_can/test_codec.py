"""Bytes of both firmware lines: cantools on the vendor's DBCs both ways, with their known bugs, the vendor's
client, and how a device reads what is short, remote, empty or not finite."""

from __future__ import annotations

import importlib.util
import math
import struct
from typing import Any, Literal, cast

import can
import odrive_can.odrive
import pytest
from numpy.random import PCG64, Generator
from odrive_can.odrive import ODriveCAN

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.odrive_can import plugin, table
from protocols.odrive_can.table import FORMS, STATE_NAMES, table_of
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from protocols.toolkit.table import Row
from tests.protocols.odrive_can.dbc import DBCS, MESSAGES, choices_of
from tests.protocols.odrive_can.helpers import encode, fields, to

VECTORS = {str(vector.name): vector for vector in vectors_of(plugin)}
NODE = 3
SERIAL = 0x385F34733330


@pytest.fixture(scope="module")
def anew() -> Any:
    """The module `table`, made again: its rows are constants, made when it is imported."""
    assert table.__spec__ is not None
    module = importlib.util.module_from_spec(table.__spec__)
    assert table.__spec__.loader is not None
    table.__spec__.loader.exec_module(module)
    return module


# -- the vendor's client, and what no package encodes -------------------------------------------------


@pytest.mark.parametrize("data", ["000054007F0001", "00000400000000"])
def test_a_cut_heartbeat_with_an_error_of_0_5_alone_does_not_decide_the_firmware(data: str) -> None:
    device = Device("left", 1, plugin.options(), plugin.settings())
    driver = plugin.driver([device])
    events = driver.receive(0, CanFrame(0x021, bytes.fromhex(data)))
    assert [type(event) for event in events] == [msg.State]
    assert driver.counters.accepted == 1
    whole = driver.receive(1, CanFrame(0x021, bytes.fromhex(data) + b"\0"))
    assert {type(event) for event in whole} == {msg.Fault, msg.State}


@pytest.mark.parametrize(
    ("name", "line", "message", "numbers"),
    [
        ("assign_node_id_5", "0.6", "Address", (5, SERIAL)),
        ("encoder_count05_negative", "0.5", "Get_Encoder_Count", (-5, 8187)),
        ("motor_error05_unbalanced_phases", "0.5", "Get_Motor_Error", (1 << 35,)),
        ("discover_broadcast_rtr_address", "0.6", "request for Address", ()),
    ],
)
def test_a_vector_by_hand_is_encoded_and_decoded(
    anew: Any, name: str, line: str, message: str, numbers: tuple[int, ...]
) -> None:
    """Those that `test_vectors` cannot regenerate."""
    frame, table = VECTORS[name].frame, anew.table_of(line)
    assert isinstance(frame, CanFrame)
    named = fields(message, *numbers, line=line)
    assert table.encode(message, frame.id >> 5, **named) == frame
    decoded = table.decode(frame, VECTORS[name].direction)
    assert decoded is not None
    assert (decoded.name, decoded.values) == (message, named)


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
        "set_controller_mode_position_passthrough": ("set_controller_mode", "POSITION_CONTROL", PASS),
        "set_controller_mode_velocity_passthrough": ("set_controller_mode", "VELOCITY_CONTROL", PASS),
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

NOT_IN_THE_DBC = {"0.5": {"Get_Version", "Ask_ADC_Voltage", "Estop"}, "0.6": {"Address", "Address reply"}}
"""(Address and its reply share a message of the DBC, without the connection id.)"""
BUGS = {"Motor_Error": (0, 2**32 - 1), "Shadow_Count": (0, 2**31 - 1), "Count_in_CPR": (0, 2**31 - 1)}
"""The DBC has the lower 32 bits of 64, and types the counts unsigned; the firmware's are int32."""


def rows(line: str) -> list[tuple[str, Row]]:
    """The messages of a line, without their other forms."""
    return [(line, row) for row in table_of(line).rows if not row.name.startswith(FORMS)]


ROWS = rows("0.5") + rows("0.6")


def random_number(row: Row, name: str, random: Generator) -> float | int:
    field = row.field(name)
    if field.kind == "f32":
        return float(math.copysign(10.0 ** float(random.uniform(-30, 30)), random.uniform(-1, 1)))
    low, high = BUGS.get(name) or (round(end / field.unit) for end in field.ends())
    return int(random.integers(low, high, endpoint=True)) * (field.unit if field.unit != 1.0 else 1)


@pytest.mark.parametrize(
    ("line", "row"),
    [(line, row) for line, row in ROWS if row.name not in NOT_IN_THE_DBC[line]],
    ids=lambda x: x if isinstance(x, str) else x.name,
)
def test_cantools_encodes_and_decodes_the_same(anew: Any, line: str, row: Row) -> None:
    """100 random messages, by the names of the DBC."""
    theirs = MESSAGES[line][row.name.removesuffix(" (0.5.x)").removesuffix(" read")]
    names = [field.name for field in row.fields if field.name]
    unused = {"RxSdo": {"Opcode": 1}, "RxSdo read": {"Opcode": 0, "Value": 0}}.get(row.name, {})
    reserved = unused | {signal.name: 0 for signal in theirs.signals if signal.name.startswith("Reserved")}
    assert {*names, *reserved} == {signal.name for signal in theirs.signals}
    table, seed = anew.table_of(line), 20261121
    random = Generator(PCG64(seed))
    for turn in range(100):
        values = {name: random_number(row, name, random) for name in names}
        frame = table.encode(row.name, NODE, **values)
        where = f"seed {seed}, turn {turn}: {values}"
        assert frame == CanFrame(theirs.frame_id, theirs.encode(values | reserved)), where
        decoded = table.decode(frame, row.direction) if frame.data or not names else None
        assert decoded is not None, where
        assert decoded.values == pytest.approx(values, rel=2**-23, abs=1e-9), where


def test_the_known_bugs_of_the_dbc_are_still_there_and_not_ours() -> None:
    """When one is mended, it is time to compare the message in full."""
    for name, numbers, theirs in (
        ("Get_Encoder_Count", (-5, 3), {"Shadow_Count": 4294967291, "Count_in_CPR": 3}),
        ("Get_Motor_Error", (0x800000000,), {"Motor_Error": 0}),
    ):
        frame = table_of("0.5").encode(name, NODE, **fields(name, *numbers, line="0.5"))
        assert MESSAGES["0.5"][name].decode(frame.data, decode_choices=False) == theirs
    # The units are turns/s and N·m in the frame.
    signals = sorted(MESSAGES["0.5"]["Set_Input_Vel"].signals, key=lambda s: int(s.start))
    assert [signal.unit for signal in signals] == ["rev", "rev/s"]
    assert "Set_Absolute_Position" not in MESSAGES["0.5"]


def test_states_have_the_vendor_s_names() -> None:
    theirs = choices_of("0.6", "Heartbeat", "Axis_State")
    assert {state: name for state, name in theirs.items() if state in STATE_NAMES} == {
        state: name for state, name in STATE_NAMES.items() if state in theirs
    }


# -- how a device reads what comes --------------------------------------------------------------------

REMOTE = "remote"


@pytest.mark.parametrize(
    ("line", "cmd", "data", "name", "numbers"),
    [
        # Short data is read as if the rest were zeros.
        ("0.6", 0x07, "08", "Set_Axis_State", (8,)),
        ("0.6", 0x0B, "0100000001", "Set_Controller_Mode", (1, 1)),
        ("0.6", 0x0C, "0000c03f", "Set_Input_Pos", (1.5, 0.0, 0.0)),
        ("0.6", 0x18, "", "Clear_Errors", (0,)),
        ("0.6", 0x16, "", "Reboot", (0,)),
        ("0.6", 0x02, "", "Estop", ()),
        ("0.5", 0x18, "01", "Clear_Errors (0.5.x)", ()),
        ("0.5", 0x19, "ffff", "Set_Linear_Count", (0xFFFF,)),
        ("0.5", 0x1C, "03", "Ask_ADC_Voltage", (3,)),
        # Requests: remote, or empty; of the controller's error, in 0.5.x, any.
        ("0.6", 0x09, "", "empty request for Get_Encoder_Estimates", ()),
        ("0.6", 0x17, REMOTE, "request for Get_Bus_Voltage_Current", ()),
        ("0.6", 0x01, REMOTE, "request for Heartbeat", ()),
        ("0.5", 0x03, "", "empty request for Get_Motor_Error", ()),
        ("0.5", 0x1D, "00" * 8, "empty request for Get_Controller_Error", ()),
        # 0.5.x obeys remote frames.
        ("0.5", 0x07, REMOTE, "remote Set_Axis_State", ()),
        ("0.5", 0x06, REMOTE, "remote Set_Axis_Node_ID", ()),
        # Inputs that are no numbers, in bits; all else that is none is ignored.
        ("0.6", 0x0C, "0000c07fe8030000", "raw Set_Input_Pos", (0x7FC00000, 1.0, 0.0)),
        ("0.5", 0x0D, "0000803f000080ff", "raw Set_Input_Vel", (0x3F800000, 0xFF800000)),
        ("0.6", 0x0E, "0000c0ff", "raw Set_Input_Torque", (0xFFC00000,)),
        ("0.6", 0x0F, "0000c07f00000000", "", ()),
        # Ignored: another message's, a device's own, too long.
        ("0.6", 0x07, REMOTE, None, ()),
        ("0.6", 0x1D, "01", "", ()),
        ("0.6", 0x08, "00" * 8, None, ()),
        ("0.6", 0x09, "00" * 8, "", ()),
        ("0.6", 0x0D, "00" * 9, "", ()),
        ("0.5", 0x00, REMOTE, None, ()),
        ("0.5", 0x01, REMOTE, None, ()),
        ("0.5", 0x1F, "00" * 8, None, ()),
    ],
)
def test_what_a_device_decodes(
    anew: Any, line: str, cmd: int, data: str, name: str | None, numbers: tuple[float, ...]
) -> None:
    identifier = NODE << 5 | cmd
    remote = data == REMOTE
    frame = CanFrame(identifier, b"" if remote else bytes.fromhex(data), remote=remote)
    decoded = anew.table_of(line).decode(frame, "to_device")
    assert (decoded.name if decoded else None) == name
    if decoded and name:
        assert decoded.values == fields(name, *numbers, line=line)
    assert anew.table_of(line).decode(CanFrame(identifier, frame.data, fd=True), "to_device") is None


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("line", ["0.5", "0.6"])
def test_each_message_of_a_device_is_requested_by_a_remote_frame_and_one_of_a_host_by_none(
    anew: Any, line: str, extended: bool
) -> None:
    """By the messages of the DBC, at node 3."""
    made, requests = anew.table_of(line, extended), anew.requests_of(line, extended)
    for name, message in MESSAGES[line].items():
        reports = any("ODrive" in sender for sender in message.senders)
        frame = CanFrame(NODE << 5 | message.frame_id & 0x1F, extended=extended, remote=True)
        cyclic = line == "0.5" and name in ("Heartbeat", "Get_ADC_Voltage")
        decoded = made.decode(frame, "to_device")
        assert made.read_only(frame) == (reports and not cyclic), name
        assert made.decode(CanFrame(frame.id, extended=not extended, remote=True), "to_device") is None
        if reports and not cyclic:
            asked = f"request for {name}"
            assert decoded == (asked, NODE, {}), name
            assert requests.encode(asked, NODE) == made.encode(asked, NODE) == frame
            empty = made.decode(CanFrame(frame.id, extended=extended), "to_device")
            assert empty == (f"empty {asked}", NODE, {})
            assert not made.read_only(CanFrame(frame.id, extended=extended))
        elif line == "0.5" and name != "Heartbeat":
            own = f"{name} (0.5.x)" if name in ("Reboot", "Clear_Errors") else name
            own = own.replace("Get_ADC", "Ask_ADC")
            assert decoded == (f"remote {own}", NODE, {}), name
        else:
            assert decoded is None, name


COMMANDS = {0x02, 0x07, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F, 0x11, 0x12, 0x13, 0x16, 0x18, 0x19, 0x1A, 0x1B}
REQUESTED = {
    "0.5": {0x03, 0x04, 0x05, 0x09, 0x0A, 0x14, 0x15, 0x17, 0x1D},
    "0.6": {0x03, 0x04, 0x05, 0x06, 0x09, 0x14, 0x15, 0x17, 0x1C, 0x1D},
}
"""What a driver may send: commands and, by line, requests and SDOs."""


@pytest.mark.parametrize("firmware", ["0.5", "0.6", "auto"])
def test_the_ids_of_a_driver(anew: Any, firmware: str) -> None:
    lines = anew.LINES[firmware]
    commands = {0x00, 0x01} | COMMANDS.union(*(REQUESTED[line] for line in lines))
    commands -= {0x06} if firmware == "auto" else set()
    commands |= {0x06} if firmware == "0.5" else set()  # Set_Axis_Node_ID
    expected = {(NODE << 5 | cmd, 0x9FFFFFFF) for cmd in commands}
    expected |= {(0x7E6, 0x9FFFFFFF)} if "0.6" in lines else set()
    assert set(anew.ids_of_driver(firmware, False, NODE)) == expected


SHORTEST = {"Heartbeat": {"0.6": 7}, "Address reply": {"0.6": 7}, "TxSdo": {"0.6": 4}}


@pytest.mark.parametrize(
    ("line", "row"),
    [(line, row) for line, row in ROWS if row.direction == "from_device"],
    ids=lambda x: x if isinstance(x, str) else x.name,
)
def test_a_short_or_long_frame_of_a_device_is_malformed(anew: Any, line: str, row: Row) -> None:
    shortest = SHORTEST.get(row.name, {}).get(line, 8)
    made = anew.table_of(line)
    accepted = [n for n in range(10) if made.read(row.name, bytes([NODE]).ljust(n, b"\0")[:n])]
    assert accepted == list(range(shortest, 9))


def test_noise_beside_the_flags_of_0_5_is_ignored() -> None:
    values = table_of("0.5").read("Heartbeat", struct.pack("<IBBBB", 7, 1, 0xFE, 0xFE, 0x7E))
    assert values == fields("Heartbeat", 7, 1, 0, 0, 0, 0, line="0.5")


@pytest.mark.parametrize(("value", "count"), [(0.128, 128), (32.768, 32767), (-1e300, -32768)])
def test_feed_forwards_saturate_and_never_wrap(value: float, count: int) -> None:
    frame = encode(NODE, to("Set_Input_Pos", 0.0, value, value))
    assert struct.unpack("<fhh", frame.data)[1:] == (count, count)


@pytest.mark.parametrize("line", ["0.5", "0.6"])
def test_a_line_that_is_not_known_holds_only_what_both_mean_the_same_by(line: Literal["0.5", "0.6"]) -> None:
    """Each message of a device means the same under "" and under the line that sent it, or nothing."""
    for cmd in range(32):
        data = bytes([NODE]) + struct.pack("<ff", 1.5, -2.5)[1:]
        frame = CanFrame(NODE << 5 | cmd, data)
        known, found = (table_of(each).decode(frame, "from_device") for each in (line, ""))
        if known is not None and found is not None and found.name == "Heartbeat":
            same = ("Axis_Error", "Axis_State")
            assert [found.values[name] for name in same] == [known.values[name] for name in same]
        elif found is not None and cmd != 0x06:  # which only a device of 0.6.x sends
            assert found == known
