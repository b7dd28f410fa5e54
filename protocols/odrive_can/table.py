"""CANSimple of ODrive firmware 0.5.x and 0.6.x: the messages of either line as a table, and their enums.

Rules. Names of messages and fields are the vendor's, from its DBC; units turns, turns/s, N·m, A, V, °C, W.
The lines use the same identifiers with other payloads, so each has a table; that of line "" ("not known")
holds only what means the same in both, and what identifies the line. A device reads eight bytes whatever
came, as if the rest were zeros. Where both have a message to a device of one name, that of 0.5.x is marked.

Source: odriverobotics/ODriveArduino@f52eef5 `src/can_simple_messages.hpp`, `src/ODriveEnums.h`; the DBCs
`odrive-cansimple-0.6.10.dbc` and `odrive-cansimple-0.5.6.dbc` of package odrive-can 2.1.0 (but for its bugs:
README, "Trust"); odriverobotics/ODriveResources@06dc846 `examples/can_enumerate.py` (Address),
`examples/can_param_access.py` (SDO); odriverobotics/ODrive@f9b5419 `communication/can/can_simple.cpp`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from enum import IntEnum
from functools import cache

from protocols.frames import CanFrame, Frame, IdMask
from protocols.toolkit.table import Field, Row, Table, const, f32, sint, uint, unused

BROADCAST = 0x3F
"""Node id of a broadcast, and of a device that has no address yet (0.6.x)."""
MAX_NODE = 0x3E
"""Highest node id that a device can be given."""
MAX_EXTENDED_NODE = 0xFFFFFF
CMD_BITS = 5
LINES: Mapping[str, tuple[str, ...]] = {"auto": ("0.5", "0.6"), "0.5": ("0.5",), "0.6": ("0.6",)}
"""The firmware lines that a device may turn out to have, by the option."""


class AxisState(IntEnum):
    """`ODrive.Axis.AxisState`."""

    UNDEFINED = 0
    IDLE = 1
    STARTUP_SEQUENCE = 2
    FULL_CALIBRATION_SEQUENCE = 3
    MOTOR_CALIBRATION = 4
    ENCODER_INDEX_SEARCH = 6
    ENCODER_OFFSET_CALIBRATION = 7
    CLOSED_LOOP_CONTROL = 8
    LOCKIN_SPIN = 9
    ENCODER_DIR_FIND = 10
    HOMING = 11
    ENCODER_HALL_POLARITY_CALIBRATION = 12
    ENCODER_HALL_PHASE_CALIBRATION = 13
    ANTICOGGING_CALIBRATION = 14
    HARMONIC_CALIBRATION = 15
    HARMONIC_CALIBRATION_COMMUTATION = 16


class ControlMode(IntEnum):
    """`ODrive.Controller.ControlMode`: which of the cascaded loops is outermost."""

    VOLTAGE = 0
    TORQUE = 1
    VELOCITY = 2
    POSITION = 3


class InputMode(IntEnum):
    """`ODrive.Controller.InputMode`: how an input value becomes a set-point."""

    INACTIVE = 0
    PASSTHROUGH = 1
    VEL_RAMP = 2
    POS_FILTER = 3
    MIX_CHANNELS = 4
    TRAP_TRAJ = 5
    TORQUE_RAMP = 6
    MIRROR = 7
    TUNING = 8


STATE_NAMES = {int(state): state.name for state in AxisState}
REBOOT, SAVE, ERASE = 0, 1, 2
"""Actions of Reboot (0.6.x)."""


def _to_device(cmd: int, name: str, *fields: Field, sent: int = 8) -> Row:
    """A message of hosts. `sent`: its bytes; 0: as many as its fields have."""
    return Row(name, (uint("address", 6), const(cmd, CMD_BITS)), fields, sent=sent, fewest=0)


def _from_device(cmd: int, name: str, *fields: Field, fewest: int = -1) -> Row:
    return Row(name, (uint("address", 6), const(cmd, CMD_BITS)), fields, "from_device", fewest=fewest)


def _error_word(name: str) -> tuple[Field, Field]:
    return uint(name, 32), unused(32)


COMMON = (
    _to_device(0x02, "Estop", sent=0),
    _to_device(0x07, "Set_Axis_State", uint("Axis_Requested_State", 32)),
    _from_device(0x09, "Get_Encoder_Estimates", f32("Pos_Estimate"), f32("Vel_Estimate")),
    _to_device(0x0B, "Set_Controller_Mode", uint("Control_Mode", 32), uint("Input_Mode", 32)),
    _to_device(
        0x0C, "Set_Input_Pos", f32("Input_Pos"), sint("Vel_FF", 16, 0.001), sint("Torque_FF", 16, 0.001)
    ),
    _to_device(0x0D, "Set_Input_Vel", f32("Input_Vel"), f32("Input_Torque_FF")),
    _to_device(0x0E, "Set_Input_Torque", f32("Input_Torque")),
    _to_device(0x0F, "Set_Limits", f32("Velocity_Limit"), f32("Current_Limit")),
    _to_device(0x11, "Set_Traj_Vel_Limit", f32("Traj_Vel_Limit")),
    _to_device(0x12, "Set_Traj_Accel_Limits", f32("Traj_Accel_Limit"), f32("Traj_Decel_Limit")),
    _to_device(0x13, "Set_Traj_Inertia", f32("Traj_Inertia")),
    _from_device(0x14, "Get_Iq", f32("Iq_Setpoint"), f32("Iq_Measured")),
    _from_device(0x17, "Get_Bus_Voltage_Current", f32("Bus_Voltage"), f32("Bus_Current")),
    _to_device(0x1A, "Set_Pos_Gain", f32("Pos_Gain")),
    _to_device(0x1B, "Set_Vel_Gains", f32("Vel_Gain"), f32("Vel_Integrator_Gain")),
)
"""The same in both lines."""
VERSION = _from_device(
    *(0x00, "Get_Version", uint("Protocol_Version")),
    *(uint("Hw_Version_Major"), uint("Hw_Version_Minor"), uint("Hw_Version_Variant")),
    *(uint("Fw_Version_Major"), uint("Fw_Version_Minor"), uint("Fw_Version_Revision")),
    uint("Fw_Version_Unreleased"),
)
# A connection id of firmware ≥ 0.6.11 is the eighth byte.
_ADDRESS = (uint("Node_ID"), uint("Serial_Number", 48))
ADDRESS = _from_device(0x06, "Address reply", *_ADDRESS, uint("Connection_ID"), fewest=7)
_HEARTBEAT = (uint("Axis_Error", 32), uint("Axis_State"))

UNIDENTIFIED = (
    VERSION,
    _from_device(0x01, "Heartbeat", *_HEARTBEAT, uint("Byte_5"), uint("Byte_6"), uint("Byte_7"), fewest=7),
    ADDRESS,
)
LINE06 = (
    VERSION,
    _from_device(
        *(0x01, "Heartbeat", *_HEARTBEAT),
        *(uint("Procedure_Result"), uint("Trajectory_Done_Flag", 1), unused(15)),
        fewest=7,
    ),
    _from_device(0x03, "Get_Error", uint("Active_Errors", 32), uint("Disarm_Reason", 32)),
    _to_device(0x04, "RxSdo", uint("Opcode"), uint("Endpoint_ID", 16), unused(), uint("Value", 32)),
    _from_device(0x05, "TxSdo", unused(), uint("Endpoint_ID", 16), unused(), uint("Value", 32), fewest=4),
    ADDRESS,
    Row("Address", (const(BROADCAST, 6), const(0x06, CMD_BITS)), _ADDRESS, fewest=1),
    _from_device(
        0x15,
        "Get_Temperature",
        f32("FET_Temperature", optional=True),
        f32("Motor_Temperature", optional=True),
    ),
    _to_device(0x16, "Reboot", uint("Action"), sent=0),
    _to_device(0x18, "Clear_Errors", uint("Identify"), sent=0),
    _to_device(0x19, "Set_Absolute_Position", f32("Position")),
    _from_device(0x1C, "Get_Torques", f32("Torque_Target"), f32("Torque_Estimate")),
    _from_device(0x1D, "Get_Powers", f32("Electrical_Power"), f32("Mechanical_Power")),
    _to_device(0x1F, "Enter_DFU_Mode", sent=0),
)
LINE05 = (
    # A device of this line never sends Get_Version: one that does is of another, which must be noticed.
    VERSION,
    _from_device(
        *(0x01, "Heartbeat", *_HEARTBEAT, uint("Motor_Error_Flag", 1), unused(7)),
        *(uint("Encoder_Error_Flag", 1), unused(7)),
        *(uint("Controller_Error_Flag", 1), unused(6), uint("Trajectory_Done_Flag", 1)),
    ),
    _from_device(0x03, "Get_Motor_Error", uint("Motor_Error", 64)),
    _from_device(0x04, "Get_Encoder_Error", *_error_word("Encoder_Error")),
    _from_device(0x05, "Get_Sensorless_Error", *_error_word("Sensorless_Error")),
    _to_device(0x06, "Set_Axis_Node_ID", uint("Axis_Node_ID", 32)),
    _from_device(0x0A, "Get_Encoder_Count", sint("Shadow_Count", 32), sint("Count_in_CPR", 32)),
    _to_device(0x10, "Start_Anticogging", sent=0),
    _from_device(
        0x15, "Get_Sensorless_Estimates", f32("Sensorless_Pos_Estimate"), f32("Sensorless_Vel_Estimate")
    ),
    _to_device(0x16, "Reboot (0.5.x)", sent=0),
    _to_device(0x18, "Clear_Errors (0.5.x)", sent=0),
    _to_device(0x19, "Set_Linear_Count", sint("Position", 32)),
    _to_device(0x1C, "Ask_ADC_Voltage", uint("GPIO")),
    _from_device(0x1C, "Get_ADC_Voltage", f32("ADC_Voltage"), unused(32)),
    _from_device(0x1D, "Get_Controller_Error", *_error_word("Controller_Error")),
)
WRITABLE: Mapping[str, tuple[str, ...]] = {
    row.name: tuple(field.name for field in row.fields)
    for row in COMMON
    if row.name in ("Set_Limits", "Set_Pos_Gain", "Set_Vel_Gains") or row.name.startswith("Set_Traj")
}
"""The messages that write parameters, in both lines, with their names."""


# -- requests ---------------------------------------------------------------------------------------------


def _requests(rows: Iterable[Row], without: Collection[str] = ()) -> Iterator[Row]:
    """Yield the requests for the messages of devices: a remote frame, or an empty data frame."""
    for row in rows:
        if row.direction == "from_device" and row.name not in without:
            name = row.name.removesuffix(" reply")
            yield Row(f"request for {name}", row.id, (), read_only=True, remote=True)
            # 0.5.x replies to any frame with the number of Get_Controller_Error.
            fewest = 0 if name == "Get_Controller_Error" else -1
            yield Row(f"empty request for {name}", row.id, (), fewest=fewest)


def _rows(line: str) -> Iterator[Row]:
    """Yield the messages of a firmware line. 0.5.x sends a heartbeat cyclically only and an ADC's voltage in
    reply to a data frame only, and obeys remote frames as if their data were zeros."""
    rows = (*COMMON, *{"0.5": LINE05, "0.6": LINE06, "": UNIDENTIFIED}[line])
    yield from _requests(rows, ("Get_Version", "Heartbeat", "Get_ADC_Voltage") if line == "0.5" else ())
    yield from rows
    if line == "0.5":
        for row in rows:
            if row.direction == "to_device":
                yield Row(f"remote {row.name}", row.id, (), remote=True)


def _extended(row: Row) -> Row:
    return replace(row, id=(uint("address", 24), row.id[1]), extended=True)


@cache
def table_of(line: str, extended: bool = False) -> Table:
    """Return the messages of a firmware line ("": not known), with identifiers of 11 or 29 bits (0.5.x)."""
    return Table(map(_extended, _rows(line)) if extended else _rows(line))


@cache
def requests_of(firmware: str, extended: bool) -> Table:
    """Return the requests that no device obeys whose line may be one of an option's: 0.5.x would take a
    remote frame of Address for Set_Axis_Node_ID, but on the broadcast node, which is none of its axes."""
    lines = LINES[firmware]
    rows = [row for line in ("", *lines) for row in table_of(line, extended).rows if row.read_only]
    if "0.5" in lines:
        rows = [row for row in rows if row.name != "request for Address"]
    if "0.6" in lines:
        discovery = (const(BROADCAST, 6), const(0x06, CMD_BITS))
        rows.append(Row("discovery", discovery, (), read_only=True, remote=True))
    return Table(rows)


def ids_of_driver(firmware: str, extended: bool, address: int) -> tuple[IdMask, ...]:
    """Return the ids of what the driver may send to a device: requests, and messages of either line."""
    never = ("RxSdo", "Enter_DFU_Mode", "Set_Axis_Node_ID", "Start_Anticogging", "Ask_ADC_Voltage")
    forms = ("request ", "empty ", "remote ")
    rows = [row for line in LINES[firmware] for row in table_of(line, extended).rows]
    sent = [row for row in rows if row.direction == "to_device" and not row.name.startswith((*never, *forms))]
    requested = requests_of(firmware, extended).rows
    return tuple(dict.fromkeys(row.id_mask(address) for row in (*requested, *sent)))


DISCOVERY = requests_of("0.6", False).encode("discovery")


def names(frame: Frame) -> tuple[str, ...]:
    """Return the vendor's names of the one message to a device in this frame, as either line decodes it: of
    what its data is long enough for, the longest. (Clear_Errors has no data in 0.5.x, a byte in 0.6.x.)"""
    if not isinstance(frame, CanFrame):
        return ()
    tables = [table_of("0.5", True)] if frame.extended else [table_of("0.6"), table_of("0.5")]
    sizes: dict[int, list[str]] = {}
    for table in tables:
        for name in table.names(frame):
            bits = sum(field.bits for field in table.row(name).fields)
            if bits <= 8 * len(frame.data) and not name.startswith(("empty ", "remote ")):
                sizes.setdefault(bits, []).append(name)
    return tuple(dict.fromkeys(sizes[max(sizes)])) if sizes else ()
