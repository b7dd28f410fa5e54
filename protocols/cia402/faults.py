"""Error codes of a CiA 402 drive (603F, and the same in EMCY) and faults that the driver detects: cause,
remedy.

Rules. `FAULTS` has the codes with a meaning of their own; any other code is described by its class, then by
its family, so that `fault_info` always has a text. Names follow CiA 402's wording of the codes; drives add
their own below the same families, which the maker's manual lists. Codes above 16 bits are not a drive's: the
driver has detected the fault.

Source: codes of CiA 402-1 "error codes" and CiA 301 "emergency error codes"; families as in package canopen
2.4.1 `emcy.py`. Causes and remedies are this project's. CiA 402's list was not at hand as a document: drives
vary.
"""

from __future__ import annotations

from collections.abc import Mapping

from protocols.plugin import FaultInfo

NO_ERROR = 0x0000
OVERCURRENT = 0x2310
SHORT_CIRCUIT = 0x2320
DC_OVERVOLTAGE = 0x3210
DC_UNDERVOLTAGE = 0x3220
DRIVE_OVERTEMPERATURE = 0x4310
ENCODER = 0x7305
HEARTBEAT_LOST = 0x8130
RPDO_TIMEOUT = 0x8250
FOLLOWING_ERROR = 0x8611

_MOTOR_LOAD = "reduce the load or the acceleration, check that the shaft turns freely"
_SUPPLY = "check the supply's voltage at the drive's terminals, and its wiring"
_WIRING = "power off, check motor and cable for shorts and for a fault to earth"
_CAN = "check cable, termination (120 Ω at both ends), bitrate, and that the host runs"

FAULTS: Mapping[int, FaultInfo] = {
    0x1000: FaultInfo("generic error", "the drive gives no details", "look it up with the maker's tool"),
    0x2220: FaultInfo("continuous over current inside the device", "the load asks too much", _MOTOR_LOAD),
    0x2250: FaultInfo("short circuit inside the device", "the power stage is damaged", "replace the drive"),
    OVERCURRENT: FaultInfo(
        "continuous over current on the output", "motor jammed, load or gains too high", _MOTOR_LOAD
    ),
    SHORT_CIRCUIT: FaultInfo("short circuit or earth leakage on the output", "motor or its cable", _WIRING),
    0x2330: FaultInfo("earth leakage on the output", "insulation of motor or cable", _WIRING),
    0x3110: FaultInfo("mains over voltage", "the supply is too high", _SUPPLY),
    0x3120: FaultInfo("mains under voltage", "the supply is too weak, or its wiring too thin", _SUPPLY),
    DC_OVERVOLTAGE: FaultInfo(
        "DC link over voltage",
        "braking feeds back more than the supply can take",
        "brake more slowly, or fit a brake resistor",
    ),
    DC_UNDERVOLTAGE: FaultInfo(
        "DC link under voltage", "the supply sags under load, or is off (safe torque off, contactor)", _SUPPLY
    ),
    0x3331: FaultInfo("field circuit interrupted", "a motor phase is open", "check the motor's plugs"),
    0x4110: FaultInfo("excess ambient temperature", "the cabinet is too hot", "cool it"),
    0x4210: FaultInfo("excess temperature device", "load too high, cooling too weak", "let it cool, cool it"),
    DRIVE_OVERTEMPERATURE: FaultInfo(
        "excess temperature drive", "load too high for too long, cooling too weak", "let it cool; reduce load"
    ),
    0x5112: FaultInfo("supply low voltage, electronics", "the logic supply fails", _SUPPLY),
    0x5441: FaultInfo("contacts, safe torque off", "a safety input is open", "close the safety circuit"),
    0x5530: FaultInfo(
        "data storage, non-volatile memory", "parameters are damaged", "restore and save the parameters"
    ),
    0x6010: FaultInfo("software reset, watchdog", "the drive's firmware hung", "update the firmware"),
    0x6320: FaultInfo(
        "parameter error", "a parameter contradicts another", "check the parameters written last"
    ),
    0x7121: FaultInfo("motor blocked", "the shaft does not turn under torque", "free the shaft"),
    0x7122: FaultInfo(
        "motor error or commutation malfunction", "phases or encoder are swapped", "run the commissioning"
    ),
    0x7300: FaultInfo("sensor", "the encoder gives no sensible signal", "check the encoder's plug and cable"),
    ENCODER: FaultInfo(
        "incremental sensor 1", "encoder signal lost or wrong", "check the encoder's plug, cable and shield"
    ),
    0x7500: FaultInfo("communication", "the drive's communication failed", _CAN),
    0x8110: FaultInfo("CAN overrun", "more frames than the drive takes", "lower the bus load or SYNC rate"),
    0x8120: FaultInfo("CAN in error passive mode", "many frames are damaged", _CAN),
    HEARTBEAT_LOST: FaultInfo(
        "life guard or heartbeat error", "the host stopped sending, or its cable is off", _CAN
    ),
    0x8140: FaultInfo("recovered from bus off", "the bus was disturbed", _CAN),
    0x8210: FaultInfo(
        "PDO not processed due to length error", "a PDO is shorter than its mapping", "restart the gateway"
    ),
    RPDO_TIMEOUT: FaultInfo("RPDO timeout", "set-points stopped coming", _CAN),
    0x8311: FaultInfo("excess torque", "the load pushes back more than allowed", _MOTOR_LOAD),
    0x8400: FaultInfo("velocity speed controller", "the speed is not followed", "check gains and limits"),
    0x8500: FaultInfo("position controller", "the position is not followed", "check gains and limits"),
    FOLLOWING_ERROR: FaultInfo(
        "following error",
        "the shaft lags behind its set-point by more than object 6065",
        "move more slowly, free the shaft, check gains; or widen 6065",
    ),
    0x8612: FaultInfo("reference limit", "a set-point lies beyond 607D", "stay inside the position limits"),
    0x8613: FaultInfo("homing error", "no home was found", "check 6098 and the switches, home again"),
    0x9000: FaultInfo(
        "external error", "an input of the drive reports an error", "check the device connected to it"
    ),
}
"""By error code: the faults that a drive may report. `Spec.faults`."""

CLASSES: Mapping[int, FaultInfo] = {
    0x21: FaultInfo("current, device input side", "the supply side draws too much", _SUPPLY),
    0x22: FaultInfo("current inside the device", "load too high, or the drive is damaged", _MOTOR_LOAD),
    0x23: FaultInfo("current, device output side", "motor, cable or load", _MOTOR_LOAD),
    0x31: FaultInfo("mains voltage", "the supply is outside its range", _SUPPLY),
    0x32: FaultInfo("DC link voltage", "the supply or braking", _SUPPLY),
    0x33: FaultInfo("output voltage", "motor or cable", _WIRING),
    0x41: FaultInfo(
        "ambient temperature", "too hot, or too cold, around the drive", "heat or cool the cabinet"
    ),
    0x42: FaultInfo("device temperature", "load or cooling", "let it cool; reduce load"),
    0x43: FaultInfo("drive temperature", "load or cooling", "let it cool; reduce load"),
    0x44: FaultInfo("supply temperature", "the supply is overloaded", "reduce load"),
    0x61: FaultInfo("internal software", "the firmware failed", "restart the drive, update its firmware"),
    0x62: FaultInfo("user software", "a program on the drive failed", "look at the program"),
    0x63: FaultInfo("data record", "parameters are wrong or damaged", "check the parameters"),
    0x71: FaultInfo("additional modules: power", "brake, chopper or motor", "look at motor and brake"),
    0x73: FaultInfo("additional modules: sensor", "encoder or its cable", "check the encoder's plug"),
    0x81: FaultInfo("monitoring: communication", "frames are lost or damaged", _CAN),
    0x82: FaultInfo("monitoring: protocol", "a PDO is not as it was mapped", "restart the gateway"),
    0x83: FaultInfo("monitoring: torque", "the torque is out of bounds", _MOTOR_LOAD),
    0x84: FaultInfo("monitoring: velocity", "the velocity is out of bounds", "check gains and limits"),
    0x86: FaultInfo("monitoring: positioning", "the position is out of bounds", "check gains and limits"),
}
"""By the upper byte of an error code."""

_LOOK_UP = "look the code up in the maker's manual"
FAMILIES: Mapping[int, FaultInfo] = {
    0x0: FaultInfo("no error", "", ""),
    0x1: FaultInfo("generic error", "the drive gives no details", _LOOK_UP),
    0x2: FaultInfo("current", "motor, cable or load", _LOOK_UP),
    0x3: FaultInfo("voltage", "the supply or braking", _LOOK_UP),
    0x4: FaultInfo("temperature", "load or cooling", _LOOK_UP),
    0x5: FaultInfo("device hardware", "the drive itself", _LOOK_UP),
    0x6: FaultInfo("device software", "firmware or parameters", _LOOK_UP),
    0x7: FaultInfo("additional modules", "motor, encoder or brake", _LOOK_UP),
    0x8: FaultInfo("monitoring", "communication, or a value that the drive monitors", _LOOK_UP),
    0x9: FaultInfo("external error", "a signal at the drive's inputs", _LOOK_UP),
    0xF: FaultInfo("additional functions", "manufacturer-specific", _LOOK_UP),
}
"""By the highest four bits of an error code."""
UNKNOWN = FaultInfo("unknown error", "the code is none of CiA 301 or CiA 402", _LOOK_UP)

# -- detected by the driver -------------------------------------------------------------------------------

NOT_ARMED = 0x1_0001
DUPLICATE_NODE = 0x1_0002
WRONG_DEVICE = 0x1_0003
QUICK_STOPPED = 0x1_0004
NOT_CONFIGURED = 0x1_0005
HOMING_FAILED = 0x1_0006

DRIVER_FAULTS: Mapping[int, FaultInfo] = {
    NOT_ARMED: FaultInfo(
        "operation not enabled",
        "the drive did not follow the controlword in time: no supply, safe torque off, or another host",
        "check its statusword with the maker's tool, then clear",
    ),
    DUPLICATE_NODE: FaultInfo(
        "duplicate node id",
        "two devices respond to it",
        "take one off the bus, or give it another node id",
    ),
    WRONG_DEVICE: FaultInfo(
        "no CiA 402 drive that can be commanded",
        "its objects do not suffice",
        "check the node id and the options in the robot file",
    ),
    QUICK_STOPPED: FaultInfo(
        "quick stop", "an operator asked for the emergency stop", "clear it when it is safe"
    ),
    NOT_CONFIGURED: FaultInfo(
        "not configured",
        "the drive refused an object that must be written before it is armed",
        'set it with the maker\'s tool, or set mapping = "keep" under options; then clear',
    ),
    HOMING_FAILED: FaultInfo(
        "homing did not end",
        "no switch, no index, or a speed of zero",
        "check 6098, 6099 and the switches; then clear",
    ),
}

_REGISTER = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0xF: 0x80}
"""Bits of the error register 1001 beside bit 0, by family; 0x81 and 0x82 are communication (bit 4)."""
GENERIC = 0x01
COMMUNICATION = 0x10


def fault_info(code: int) -> FaultInfo:
    """Describe an error code. A code without a name of its own has its number in the name."""
    known = FAULTS.get(code) or DRIVER_FAULTS.get(code)
    if known is not None:
        return known
    near = CLASSES.get(code >> 8) or FAMILIES.get(code >> 12, UNKNOWN)
    return FaultInfo(f"{near.name} ({code:#06x})", near.cause, _LOOK_UP)


def register_of(code: int) -> int:
    """Return the error register (1001) for an error code."""
    if not code:
        return 0
    if code >> 8 in (0x81, 0x82):
        return GENERIC | COMMUNICATION
    return GENERIC | _REGISTER.get(code >> 12, 0)
