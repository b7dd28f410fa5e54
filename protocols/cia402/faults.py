"""What a CiA 402 drive complains of: its error codes (603F, and the same in EMCY), causes, what to do.

Rules. `FAULTS` has the codes with a meaning of their own; any other code is told by its class, then by its
family, so that `complaint` always has a text. Names follow CiA 402's wording of the codes; drives add their
own below the same families, which the maker's manual lists. Codes above 16 bits are not a drive's: the
driver's own findings.

Source: codes of CiA 402-1 "error codes" and CiA 301 "emergency error codes"; families as in package canopen
2.4.1 `emcy.py`. The causes and cures are ours. CiA 402's list was not at hand as a document: drives vary.
"""

from __future__ import annotations

from collections.abc import Mapping

from protocols.plugin import Complaint

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
_SUPPLY = "check the supply's voltage at the drive's terminals, and its wires"
_WIRING = "power off, check motor and cable for shorts and for a fault to earth"
_CAN = "check cable, termination (120 Ω at both ends), bitrate, and that the host runs"

FAULTS: Mapping[int, Complaint] = {
    0x1000: Complaint("generic error", "the drive tells nothing closer", "look it up with the maker's tool"),
    0x2220: Complaint("continuous over current inside the device", "the load asks too much", _MOTOR_LOAD),
    0x2250: Complaint("short circuit inside the device", "the power stage is damaged", "replace the drive"),
    OVERCURRENT: Complaint(
        "continuous over current on the output", "motor jammed, load or gains too high", _MOTOR_LOAD
    ),
    SHORT_CIRCUIT: Complaint("short circuit or earth leakage on the output", "motor or its cable", _WIRING),
    0x2330: Complaint("earth leakage on the output", "insulation of motor or cable", _WIRING),
    0x3110: Complaint("mains over voltage", "the supply is too high", _SUPPLY),
    0x3120: Complaint("mains under voltage", "the supply is too weak, or its wires too thin", _SUPPLY),
    DC_OVERVOLTAGE: Complaint(
        "DC link over voltage",
        "braking feeds back more than the supply can take",
        "brake more slowly, or fit a brake resistor",
    ),
    DC_UNDERVOLTAGE: Complaint(
        "DC link under voltage", "the supply sags under load, or is off (safe torque off, contactor)", _SUPPLY
    ),
    0x3331: Complaint("field circuit interrupted", "a motor phase is open", "check the motor's plugs"),
    0x4110: Complaint("excess ambient temperature", "the cabinet is too hot", "cool it"),
    0x4210: Complaint("excess temperature device", "load too high, cooling too weak", "let it cool, cool it"),
    DRIVE_OVERTEMPERATURE: Complaint(
        "excess temperature drive", "load too high for too long, cooling too weak", "let it cool; reduce load"
    ),
    0x5112: Complaint("supply low voltage, electronics", "the logic supply fails", _SUPPLY),
    0x5441: Complaint("contacts, safe torque off", "a safety input is open", "close the safety circuit"),
    0x5530: Complaint(
        "data storage, non-volatile memory", "parameters are damaged", "restore and save the parameters"
    ),
    0x6010: Complaint("software reset, watchdog", "the drive's firmware hung", "update the firmware"),
    0x6320: Complaint(
        "parameter error", "a parameter contradicts another", "check the parameters written last"
    ),
    0x7121: Complaint("motor blocked", "the shaft does not turn under torque", "free the shaft"),
    0x7122: Complaint(
        "motor error or commutation malfunction", "phases or encoder are swapped", "run the commissioning"
    ),
    0x7300: Complaint("sensor", "the encoder gives no sensible signal", "check the encoder's plug and cable"),
    ENCODER: Complaint(
        "incremental sensor 1", "encoder signal lost or wrong", "check the encoder's plug, cable and shield"
    ),
    0x7500: Complaint("communication", "the drive's communication failed", _CAN),
    0x8110: Complaint("CAN overrun", "more frames than the drive takes", "lower the bus load or SYNC rate"),
    0x8120: Complaint("CAN in error passive mode", "many frames are damaged", _CAN),
    HEARTBEAT_LOST: Complaint(
        "life guard or heartbeat error", "the host fell silent, or its cable is off", _CAN
    ),
    0x8140: Complaint("recovered from bus off", "the bus was disturbed", _CAN),
    0x8210: Complaint(
        "PDO not processed due to length error", "a PDO is shorter than its mapping", "restart the gateway"
    ),
    RPDO_TIMEOUT: Complaint("RPDO timeout", "set-points stopped coming", _CAN),
    0x8311: Complaint("excess torque", "the load pushes back more than allowed", _MOTOR_LOAD),
    0x8400: Complaint("velocity speed controller", "the speed is not followed", "check gains and limits"),
    0x8500: Complaint("position controller", "the position is not followed", "check gains and limits"),
    FOLLOWING_ERROR: Complaint(
        "following error",
        "the shaft lags behind its set-point by more than object 6065",
        "move more slowly, free the shaft, check gains; or widen 6065",
    ),
    0x8612: Complaint("reference limit", "a set-point lies beyond 607D", "stay inside the position limits"),
    0x8613: Complaint("homing error", "no home was found", "check 6098 and the switches, home again"),
    0x9000: Complaint(
        "external error", "an input of the drive reports an error", "look at what is wired to it"
    ),
}
"""By error code: what a drive may complain of. `Spec.faults`."""

CLASSES: Mapping[int, Complaint] = {
    0x21: Complaint("current, device input side", "the supply's side draws too much", _SUPPLY),
    0x22: Complaint("current inside the device", "load too high, or the drive is damaged", _MOTOR_LOAD),
    0x23: Complaint("current, device output side", "motor, cable or load", _MOTOR_LOAD),
    0x31: Complaint("mains voltage", "the supply is outside its range", _SUPPLY),
    0x32: Complaint("DC link voltage", "the supply or braking", _SUPPLY),
    0x33: Complaint("output voltage", "motor or cable", _WIRING),
    0x41: Complaint("ambient temperature", "too hot, or too cold, around the drive", "mend the climate"),
    0x42: Complaint("device temperature", "load or cooling", "let it cool; reduce load"),
    0x43: Complaint("drive temperature", "load or cooling", "let it cool; reduce load"),
    0x44: Complaint("supply temperature", "the supply is overloaded", "reduce load"),
    0x61: Complaint("internal software", "the firmware failed", "restart the drive, update its firmware"),
    0x62: Complaint("user software", "a program on the drive failed", "look at the program"),
    0x63: Complaint("data record", "parameters are wrong or damaged", "check the parameters"),
    0x71: Complaint("additional modules: power", "brake, chopper or motor", "look at motor and brake"),
    0x73: Complaint("additional modules: sensor", "encoder or its cable", "check the encoder's plug"),
    0x81: Complaint("monitoring: communication", "frames are lost or damaged", _CAN),
    0x82: Complaint("monitoring: protocol", "a PDO is not as it was mapped", "restart the gateway"),
    0x83: Complaint("monitoring: torque", "the torque is out of bounds", _MOTOR_LOAD),
    0x84: Complaint("monitoring: velocity", "the velocity is out of bounds", "check gains and limits"),
    0x86: Complaint("monitoring: positioning", "the position is out of bounds", "check gains and limits"),
}
"""By the upper byte of an error code."""

_LOOK_UP = "look the code up in the maker's manual"
FAMILIES: Mapping[int, Complaint] = {
    0x0: Complaint("no error", "", ""),
    0x1: Complaint("generic error", "the drive tells nothing closer", _LOOK_UP),
    0x2: Complaint("current", "motor, cable or load", _LOOK_UP),
    0x3: Complaint("voltage", "the supply or braking", _LOOK_UP),
    0x4: Complaint("temperature", "load or cooling", _LOOK_UP),
    0x5: Complaint("device hardware", "the drive itself", _LOOK_UP),
    0x6: Complaint("device software", "firmware or parameters", _LOOK_UP),
    0x7: Complaint("additional modules", "motor, encoder or brake", _LOOK_UP),
    0x8: Complaint("monitoring", "communication, or what the drive watches over", _LOOK_UP),
    0x9: Complaint("external error", "what is wired to the drive's inputs", _LOOK_UP),
    0xF: Complaint("additional functions", "the maker's own", _LOOK_UP),
}
"""By the highest four bits of an error code."""
UNKNOWN = Complaint("unknown error", "the code is none of CiA 301 or CiA 402", _LOOK_UP)

_REGISTER = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0xF: 0x80}
"""Bits of the error register 1001 beside bit 0, by family; 0x81 and 0x82 are communication (bit 4)."""
GENERIC = 0x01
COMMUNICATION = 0x10


def complaint(code: int) -> Complaint:
    """What an error code means. The code's number stands in its name unless it has one of its own."""
    known = FAULTS.get(code)
    if known is not None:
        return known
    near = CLASSES.get(code >> 8) or FAMILIES.get(code >> 12, UNKNOWN)
    return Complaint(f"{near.name} ({code:#06x})", near.cause, _LOOK_UP)


def register_of(code: int) -> int:
    """The error register 1001 while an error code stands."""
    if not code:
        return 0
    if code >> 8 in (0x81, 0x82):
        return GENERIC | COMMUNICATION
    return GENERIC | _REGISTER.get(code >> 12, 0)
