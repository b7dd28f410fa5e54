"""CANSimple of ODrive firmware 0.5.x and 0.6.x: the messages of either line, and how a host uses the line.

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
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cache
from typing import Any, TypeAlias

from protocols import messages as msg
from protocols.frames import CanFrame, Frame, IdMask
from protocols.odrive_can import errors
from protocols.odrive_can.errors import Word
from protocols.toolkit.table import Field, Row, Table, Values, const, f32, sint, uint, unused

BROADCAST = 0x3F  # Node id of a broadcast, and of a device that has no address yet (0.6.x).
MAX_NODE = 0x3E  # Highest node id that a device can be given.
MAX_EXTENDED_NODE = 0xFFFFFF
CMD_BITS = 5
LINES: Mapping[str, tuple[str, ...]] = {"auto": ("0.5", "0.6"), "0.5": ("0.5",), "0.6": ("0.6",)}
"""The firmware lines that a device may turn out to have, by the option."""
_STATES = (
    "UNDEFINED IDLE STARTUP_SEQUENCE FULL_CALIBRATION_SEQUENCE MOTOR_CALIBRATION - ENCODER_INDEX_SEARCH"
    " ENCODER_OFFSET_CALIBRATION CLOSED_LOOP_CONTROL LOCKIN_SPIN ENCODER_DIR_FIND HOMING"
    " ENCODER_HALL_POLARITY_CALIBRATION ENCODER_HALL_PHASE_CALIBRATION ANTICOGGING_CALIBRATION"
    " HARMONIC_CALIBRATION HARMONIC_CALIBRATION_COMMUTATION"
)
STATE_NAMES = {state: name for state, name in enumerate(_STATES.split()) if name != "-"}
"""`ODrive.Axis.AxisState`"""
UNDEFINED, IDLE, STARTUP, CLOSED_LOOP, HOMING = 0, 1, 2, 8, 11
FULL_CALIBRATION, MOTOR_CALIBRATION, OFFSET_CALIBRATION = 3, 4, 7
PROCEDURES = STATE_NAMES.keys() - {UNDEFINED, IDLE, STARTUP, CLOSED_LOOP, 9}
"""States in which the device does something by itself, and then goes to IDLE; most of them turn the shaft.
(LOCKIN_SPIN ends when its configuration has it, if ever.)"""
REBOOT, SAVING, ERASE, BOOT_LOADER = 0, 1, 2, 3  # Actions of Reboot (0.6.x).


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


# -- messages ---------------------------------------------------------------------------------------------


def _to(cmd: int, name: str, *fields: Field, sent: int = 8, fewest: int = 0) -> Row:
    """A message to a device. `sent`: its bytes; 0: as many as its fields have."""
    return Row(name, (uint("address", 6), const(cmd, CMD_BITS)), fields, sent=sent, fewest=fewest)


def _from(cmd: int, name: str, *fields: Field, fewest: int = -1) -> Row:
    return Row(name, (uint("address", 6), const(cmd, CMD_BITS)), fields, "from_device", fewest=fewest)


def _numbers(*names: str) -> tuple[Field, ...]:
    return tuple(map(f32, names))


COMMON = (
    _to(0x02, "Estop", sent=0),
    _to(0x07, "Set_Axis_State", uint("Axis_Requested_State", 32)),
    _from(0x09, "Get_Encoder_Estimates", *_numbers("Pos_Estimate", "Vel_Estimate")),
    _to(0x0B, "Set_Controller_Mode", uint("Control_Mode", 32), uint("Input_Mode", 32)),
    _to(0x0C, "Set_Input_Pos", f32("Input_Pos"), sint("Vel_FF", 16, 0.001), sint("Torque_FF", 16, 0.001)),
    _to(0x0D, "Set_Input_Vel", *_numbers("Input_Vel", "Input_Torque_FF")),
    _to(0x0E, "Set_Input_Torque", f32("Input_Torque")),
    _to(0x0F, "Set_Limits", *_numbers("Velocity_Limit", "Current_Limit")),
    _to(0x11, "Set_Traj_Vel_Limit", f32("Traj_Vel_Limit")),
    _to(0x12, "Set_Traj_Accel_Limits", *_numbers("Traj_Accel_Limit", "Traj_Decel_Limit")),
    _to(0x13, "Set_Traj_Inertia", f32("Traj_Inertia")),
    _from(0x14, "Get_Iq", *_numbers("Iq_Setpoint", "Iq_Measured")),
    _from(0x17, "Get_Bus_Voltage_Current", *_numbers("Bus_Voltage", "Bus_Current")),
    _to(0x1A, "Set_Pos_Gain", f32("Pos_Gain")),
    _to(0x1B, "Set_Vel_Gains", *_numbers("Vel_Gain", "Vel_Integrator_Gain")),
)
"""The same in both lines."""
_VERSION = (
    "Protocol_Version Hw_Version_Major Hw_Version_Minor Hw_Version_Variant"
    " Fw_Version_Major Fw_Version_Minor Fw_Version_Revision Fw_Version_Unreleased"
)
VERSION_SIGNALS = tuple(_VERSION.split())
VERSION = _from(0x00, "Get_Version", *map(uint, VERSION_SIGNALS))
# A connection id of firmware ≥ 0.6.11 is the eighth byte.
_ADDRESS = (uint("Node_ID"), uint("Serial_Number", 48))
ADDRESS = _from(0x06, "Address reply", *_ADDRESS, uint("Connection_ID"), fewest=7)
_STATE = (uint("Axis_Error", 32), uint("Axis_State"))
_RESULT = (uint("Procedure_Result"), uint("Trajectory_Done_Flag", 1), unused(15))
_FLAGS: tuple[Field, ...] = (uint("Motor_Error_Flag", 1), unused(7), uint("Encoder_Error_Flag", 1), unused(7))
_FLAGS += (uint("Controller_Error_Flag", 1), unused(6), uint("Trajectory_Done_Flag", 1))
_SDO = (uint("Endpoint_ID", 16), unused(), uint("Value", 32))
UNIDENTIFIED = (
    VERSION,
    _from(0x01, "Heartbeat", *_STATE, uint("Byte_5"), uint("Byte_6"), uint("Byte_7"), fewest=7),
    ADDRESS,
)
LINE06 = (
    VERSION,
    _from(0x01, "Heartbeat", *_STATE, *_RESULT, fewest=7),
    _from(0x03, "Get_Error", uint("Active_Errors", 32), uint("Disarm_Reason", 32)),
    replace(_to(0x04, "RxSdo read", const(0), *_SDO[:2], unused(32), fewest=4), read_only=True),
    _to(0x04, "RxSdo", const(1), *_SDO, fewest=4),
    _from(0x05, "TxSdo", unused(), *_SDO, fewest=4),
    ADDRESS,
    Row("Address", (const(BROADCAST, 6), const(0x06, CMD_BITS)), _ADDRESS, fewest=1),
    _from(0x15, "Get_Temperature", *(f32(f"{part}_Temperature", optional=True) for part in ("FET", "Motor"))),
    _to(0x16, "Reboot", uint("Action"), sent=0),
    _to(0x18, "Clear_Errors", uint("Identify"), sent=0),
    _to(0x19, "Set_Absolute_Position", f32("Position")),
    _from(0x1C, "Get_Torques", *_numbers("Torque_Target", "Torque_Estimate")),
    _from(0x1D, "Get_Powers", *_numbers("Electrical_Power", "Mechanical_Power")),
    _to(0x1F, "Enter_DFU_Mode", sent=0),
)
LINE05 = (
    # A device of this line never sends Get_Version: one that does is of another, which must be noticed.
    VERSION,
    _from(0x01, "Heartbeat", *_STATE, *_FLAGS),
    _from(0x03, "Get_Motor_Error", uint("Motor_Error", 64)),
    _from(0x04, "Get_Encoder_Error", uint("Encoder_Error", 32), unused(32)),
    _from(0x05, "Get_Sensorless_Error", uint("Sensorless_Error", 32), unused(32)),
    _to(0x06, "Set_Axis_Node_ID", uint("Axis_Node_ID", 32)),
    _from(0x0A, "Get_Encoder_Count", sint("Shadow_Count", 32), sint("Count_in_CPR", 32)),
    _to(0x10, "Start_Anticogging", sent=0),
    _from(0x15, "Get_Sensorless_Estimates", *_numbers("Sensorless_Pos_Estimate", "Sensorless_Vel_Estimate")),
    _to(0x16, "Reboot (0.5.x)", sent=0),
    _to(0x18, "Clear_Errors (0.5.x)", sent=0),
    _to(0x19, "Set_Linear_Count", sint("Position", 32)),
    _to(0x1C, "Ask_ADC_Voltage", uint("GPIO")),
    _from(0x1C, "Get_ADC_Voltage", f32("ADC_Voltage"), unused(32)),
    _from(0x1D, "Get_Controller_Error", uint("Controller_Error", 32), unused(32)),
)
SAVE = "save_configuration"  # A parameter: written with 1, the device saves its configuration and restarts.
_WRITE = ("Set_Axis_State", "Set_Limits", "Set_Traj", "Set_Pos_G", "Set_Vel_G", "Set_Absolute", "Set_Linear")
WRITABLE = {
    row.name: tuple(f.name for f in row.fields)
    for row in (*COMMON, *LINE06, *LINE05)
    if row.name.startswith(_WRITE)
}
"""The messages that write parameters, with their names."""
FORMS = ("request ", "empty ", "remote ", "raw ")
"""What the names of rows begin with that are another form of a message."""


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
    reply to a data frame only, and obeys remote frames as if their data were zeros. Inputs that are no
    numbers are taken, too: the form "raw" has their bits."""
    rows = (*COMMON, *{"0.5": LINE05, "0.6": LINE06, "": UNIDENTIFIED}[line])
    yield from _requests(rows, ("Get_Version", "Heartbeat", "Get_ADC_Voltage") if line == "0.5" else ())
    yield from rows
    for row in rows:
        if line == "0.5" and row.direction == "to_device":
            yield Row(f"remote {row.name}", row.id, (), remote=True)
        if row.name.startswith("Set_Input"):
            bits = tuple(uint(f.name, 32) if f.kind == "f32" else f for f in row.fields)
            yield replace(row, name=f"raw {row.name}", fields=bits)


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


DISCOVERY = requests_of("0.6", False).encode("discovery")


def ids_of_driver(firmware: str, extended: bool, address: int) -> tuple[IdMask, ...]:
    """Return the ids of what the driver may send to a device: requests, and messages of either line."""
    never = ["Enter_DFU_Mode", "Start_Anticogging", "Ask_ADC_Voltage"]
    never += [] if firmware == "0.5" else ["Set_Axis_Node_ID"]
    rows = [row for line in LINES[firmware] for row in table_of(line, extended).rows]
    sent = [row for row in rows if row.direction == "to_device" and not row.name.startswith((*never, *FORMS))]
    requested = requests_of(firmware, extended).rows
    return tuple(dict.fromkeys(row.ids().of(address) for row in (*requested, *sent)))


def names(frame: Frame) -> tuple[str, ...]:
    """Return the vendor's names of the one message to a device in this frame, as either line decodes it: of
    what its data is long enough for, the longest. (Clear_Errors has no data in 0.5.x, a byte in 0.6.x.)"""
    if not isinstance(frame, CanFrame):
        return ()
    sizes: dict[int, list[str]] = {}
    for table in [table_of("0.5", True)] if frame.extended else [table_of("0.6"), table_of("0.5")]:
        for name in table.names(frame):
            bits = sum(field.bits for field in table.row(name).fields)
            if bits <= 8 * len(frame.data) and not name.startswith(("empty ", "remote ")):
                sizes.setdefault(bits, []).append(name.removeprefix("raw ").removesuffix(" read"))
    return tuple(dict.fromkeys(sizes[max(sizes)])) if sizes else ()


# -- what the host does differently by firmware line ------------------------------------------------------

Message: TypeAlias = tuple[str, Mapping[str, Any]]  # The name of a message, and its fields.
COMMON_ACTIONS: Mapping[object, Message] = {
    msg.Estop: ("Estop", {}),
    msg.Home: ("Set_Axis_State", {"Axis_Requested_State": HOMING}),
}


@dataclass(frozen=True, slots=True)
class Dialect:
    """One firmware line as the host uses it. A constant; no other code of the driver tests for the line."""

    line: str
    polled: tuple[str, ...] = ()  # Messages requested every `poll_ms`.
    disarm_reasons: tuple[str, ...] = ()  # Messages that report why an axis disarmed by itself.
    word: Word | None = None  # The heartbeat's error bits; None while their meaning is not known.
    components: Mapping[str, Word] = field(default_factory=dict)  # The error words of components, by message.
    messages: Mapping[object, Message] = field(default_factory=lambda: COMMON_ACTIONS)
    """What is sent for a request, by its type or parameter; what is not here cannot be done over CAN."""
    starting: int = 0  # The heartbeat's bit of a device that is starting.
    boards: bool = False
    """Clearing and rebooting affect every axis of a board; a heartbeat cannot be requested."""

    def __deepcopy__(self, memo: object) -> Dialect:
        """A dialect is a constant."""
        return self

    def bit(self, name: str) -> int:
        """Return the heartbeat's bit of an error; 0: it has none, or it is not known."""
        return 0 if self.word is None else self.word.bits.get(name, 0)

    def codes(self, errors: int, words: Mapping[str, int]) -> list[int]:
        """Return the codes of the error bits of the axis, and of the words of its components, by message."""
        codes = [] if self.word is None else [*self.word.codes(errors & ~self.starting)]
        for name, word in words.items():
            codes += self.components[name].codes(word)
        return codes

    def mode(self, state: int, errors: int, faulty: bool) -> msg.Mode:
        """Return what an axis in this state, with these error bits, is to the host."""
        if not self.line or errors & self.starting:
            return msg.Mode.INITIALISING
        if faulty:
            return msg.Mode.FAULT
        if state == CLOSED_LOOP:
            return msg.Mode.ARMED
        return msg.Mode.READY if state == IDLE else msg.Mode.INITIALISING

    def writable(self) -> dict[str, str]:
        """Return the messages by the vendor's names of the parameters that they write."""
        rows = {row.name for row in table_of(self.line).rows} & WRITABLE.keys()
        return {name: row for row in WRITABLE if row in rows for name in WRITABLE[row]}

    def readable(self) -> dict[str, str]:
        """Return the messages by the vendor's names of the signals that they carry."""
        rows = [row for row in table_of(self.line).rows if row.direction == "from_device"]
        left_out = ("Address reply", "TxSdo", "Get_ADC_Voltage", "Get_Version" if self.boards else "")
        return {f.name: row.name for row in rows if row.name not in left_out for f in row.fields if f.name}


def state_text(state: int, result: int) -> str:
    """Return the vendor's names of a state, and of the result of the last procedure, if it was not good."""
    text = STATE_NAMES.get(state) or f"axis state {state}"
    if result in (errors.SUCCESS, errors.BUSY):
        return text
    return f"{text}, {errors.RESULT_NAMES.get(result) or f'procedure result {result}'}"


_06, _05 = errors.ERRORS.bits, errors.AXIS.bits
DIALECTS = {
    "": Dialect(""),
    "0.6": Dialect(
        "0.6",
        polled=("Get_Iq", "Get_Bus_Voltage_Current", "Get_Temperature", "Get_Torques"),
        disarm_reasons=("Get_Error",),
        starting=errors.INITIALIZING,
        word=errors.ERRORS,
        messages={
            **COMMON_ACTIONS,
            msg.ClearFault: ("Clear_Errors", {"Identify": 0}),
            msg.Reboot: ("Reboot", {"Action": REBOOT}),
            SAVE: ("Reboot", {"Action": SAVING}),
            msg.Zero: ("Set_Absolute_Position", {"Position": 0.0}),
        },
    ),
    "0.5": Dialect(
        "0.5",
        polled=("Get_Iq", "Get_Bus_Voltage_Current"),
        word=errors.AXIS,
        components={
            "Get_Motor_Error": errors.MOTOR,
            "Get_Encoder_Error": errors.ENCODER,
            "Get_Controller_Error": errors.CONTROLLER,
            "Get_Sensorless_Error": errors.SENSORLESS,
        },
        messages={
            **COMMON_ACTIONS,
            msg.ClearFault: ("Clear_Errors (0.5.x)", {}),
            msg.Reboot: ("Reboot (0.5.x)", {}),
            msg.Zero: ("Set_Linear_Count", {"Position": 0}),
        },
        boards=True,
    ),
}


def flagged(heartbeat: Values) -> tuple[str, ...]:
    """Return the components whose errors a heartbeat of 0.5.x points to, by message. The sensorless estimator
    has no flag, but a bit of the axis' errors."""
    components = [name for name in ("Motor", "Encoder", "Controller") if heartbeat[f"{name}_Error_Flag"]]
    components += ["Sensorless"] if heartbeat["Axis_Error"] & _05["SENSORLESS_ESTIMATOR_FAILED"] else []
    return tuple(f"Get_{name}_Error" for name in components)


ONLY05 = sum(set(_05.values()) - set(_06.values()))
ONLY06 = sum(set(_06.values()) - set(_05.values()))


def line_by_form(heartbeat: Values) -> str:
    """Return the firmware line that alone can have sent a heartbeat of the table "", or "".

    0.5.x has three bytes of flags, of which only the first bit (and of the last byte the eighth) is used, and
    a component's flag is never set without its bit in the axis' errors, nor in closed loop. 0.6.x has a
    result, a flag and an empty byte. (ODrive@f9b5419 `can_simple.cpp` send_heartbeat.)"""
    error, result, flag = heartbeat["Axis_Error"], heartbeat["Byte_5"], heartbeat["Byte_6"]
    if heartbeat["Byte_7"] or error & ONLY05:
        return "0.5" if not error & ONLY06 and result <= 1 and flag <= 1 else ""
    if error & ONLY06 or result > 1 or (heartbeat["Axis_State"] == CLOSED_LOOP and result == 1):
        return "0.6"
    return "0.6" if flag and not error & _05["ENCODER_FAILED"] else ""
