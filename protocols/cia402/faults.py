"""Error codes of a CiA 402 drive (603F, and the same in EMCY) and faults that the driver detects: cause,
remedy.

Rules. One line per code, class (two digits) or family (one digit): code, name | cause | remedy. A code
without a line is described by its class, then by its family, so that `fault_info` always has a text. Names
follow CiA 402's wording of the codes; drives add their own below the same families, which the maker's manual
lists. Codes above 16 bits are not a drive's: the driver has detected the fault.

Source: codes of CiA 402-1 "error codes" and CiA 301 "emergency error codes"; families as in package canopen
2.4.1 `emcy.py`. Causes and remedies are this project's. CiA 402's list was not at hand as a document: drives
vary.
"""

from __future__ import annotations

from collections.abc import Mapping

from protocols.plugin import FaultInfo

FOLLOWING_ERROR = 0x8611
NOT_ARMED = 0x1_0001
DUPLICATE_NODE = 0x1_0002
WRONG_DEVICE = 0x1_0003
QUICK_STOPPED = 0x1_0004
NOT_CONFIGURED = 0x1_0005
HOMING_FAILED = 0x1_0006
SETPOINT_STUCK = 0x1_0007

_PHRASES = {
    "can": "check cable, termination (120 Ω at both ends), bitrate, and that the host runs",
    "encoder": "check the encoder's plug, cable and shield",
    "gains": "check gains and limits",
    "load": "reduce the load or the acceleration, check that the shaft turns freely",
    "look": "look the code up in the maker's manual",
    "supply": "check the supply's voltage at the drive's terminals, and its wiring",
    "wiring": "power off, check motor and cable for shorts and for a fault to earth",
}
"""What several lines have in common."""
_TEXT = """
0 no error | |
1 generic error | the drive gives no details | {look}
1000 generic error | the drive gives no details | look it up with the maker's tool
2 current | motor, cable or load | {look}
21 current, device input side | the supply side draws too much | {supply}
22 current inside the device | load too high, or the drive is damaged | {load}
2220 continuous over current inside the device | the load asks too much | {load}
2250 short circuit inside the device | the power stage is damaged | replace the drive
23 current, device output side | motor, cable or load | {load}
2310 continuous over current on the output | motor jammed, load or gains too high | {load}
2320 short circuit or earth leakage on the output | motor or its cable | {wiring}
2330 earth leakage on the output | insulation of motor or cable | {wiring}
3 voltage | the supply or braking | {look}
31 mains voltage | the supply is outside its range | {supply}
3110 mains over voltage | the supply is too high | {supply}
3120 mains under voltage | the supply is too weak, or its wiring too thin | {supply}
32 DC link voltage | the supply or braking | {supply}
3210 DC link over voltage | braking feeds back too much | brake gently, or fit a brake resistor
3220 DC link under voltage | the supply sags, or is off (safe torque off, contactor) | {supply}
33 output voltage | motor or cable | {wiring}
3331 field circuit interrupted | a motor phase is open | check the motor's plugs
4 temperature | load or cooling | {look}
41 ambient temperature | too hot, or too cold, around the drive | heat or cool the cabinet
4110 excess ambient temperature | the cabinet is too hot | cool it
42 device temperature | load or cooling | let it cool; reduce load
4210 excess temperature device | load too high, cooling too weak | let it cool, cool it
43 drive temperature | load or cooling | let it cool; reduce load
4310 excess temperature drive | load too high for too long, cooling too weak | let it cool; reduce load
44 supply temperature | the supply is overloaded | reduce load
5 device hardware | the drive itself | {look}
5112 supply low voltage, electronics | the logic supply fails | {supply}
5441 contacts, safe torque off | a safety input is open | close the safety circuit
5530 data storage, non-volatile memory | parameters are damaged | restore and save the parameters
6 device software | firmware or parameters | {look}
61 internal software | the firmware failed | restart the drive, update its firmware
6010 software reset, watchdog | the drive's firmware hung | update the firmware
62 user software | a program on the drive failed | look at the program
63 data record | parameters are wrong or damaged | check the parameters
6320 parameter error | a parameter contradicts another | check the parameters written last
7 additional modules | motor, encoder or brake | {look}
71 additional modules: power | brake, chopper or motor | look at motor and brake
7121 motor blocked | the shaft does not turn under torque | free the shaft
7122 motor error or commutation malfunction | phases or encoder are swapped | run the commissioning
73 additional modules: sensor | encoder or its cable | {encoder}
7300 sensor | the encoder gives no sensible signal | {encoder}
7305 incremental sensor 1 | encoder signal lost or wrong | {encoder}
7500 communication | the drive's communication failed | {can}
8 monitoring | communication, or a value that the drive monitors | {look}
81 monitoring: communication | frames are lost or damaged | {can}
8110 CAN overrun | more frames than the drive takes | lower the bus load or SYNC rate
8120 CAN in error passive mode | many frames are damaged | {can}
8130 life guard or heartbeat error | the host stopped sending, or its cable is off | {can}
8140 recovered from bus off | the bus was disturbed | {can}
82 monitoring: protocol | a PDO is not as it was mapped | restart the gateway
8210 PDO not processed due to length error | a PDO is shorter than its mapping | restart the gateway
8250 RPDO timeout | set-points stopped coming | {can}
83 monitoring: torque | the torque is out of bounds | {load}
8311 excess torque | the load pushes back more than allowed | {load}
84 monitoring: velocity | the velocity is out of bounds | {gains}
8400 velocity speed controller | the speed is not followed | {gains}
8500 position controller | the position is not followed | {gains}
86 monitoring: positioning | the position is out of bounds | {gains}
8611 following error | the shaft lags by more than object 6065 | go slower, free the shaft; or widen 6065
8612 reference limit | a set-point lies beyond 607D | stay inside the position limits
8613 homing error | no home was found | check 6098 and the switches, home again
9 external error | a signal at the drive's inputs | {look}
9000 external error | an input of the drive reports an error | check the device connected to it
F additional functions | manufacturer-specific | {look}
10001 operation not enabled | the drive did not follow the controlword: no supply, safe torque off, or\
 another host | check its statusword with the maker's tool, then clear
10002 duplicate node id | two devices respond to it | take one off the bus, or give it another node id
10003 no CiA 402 drive that can be commanded | its objects do not suffice | check node id and robot file
10004 quick stop | an operator asked for the emergency stop | clear it when it is safe
10005 not configured | the drive refused an object that must be written before it is armed | set it with the\
 maker's tool, or under options watchdog_ms = 0 if it is 1016, else mapping = "keep"; then clear
10006 homing did not end | no switch, no index, or a speed of zero | check 6098, 6099, switches; then clear
10007 set-point not taken | bit 12 of its statusword does not fall in profile position | set modes = "cyclic"
"""


def _parse(text: str) -> dict[str, FaultInfo]:
    """Return what is known of each code, class and family, by its digits."""
    known = {}
    for line in text.format(**_PHRASES).strip().splitlines():
        digits, _, rest = line.partition(" ")
        name, cause, remedy = rest.split("|")
        known[digits] = FaultInfo(name.strip(), cause.strip(), remedy.strip())
    return known


_KNOWN = _parse(_TEXT)
_UNKNOWN = FaultInfo("unknown error", "the code is none of CiA 301 or CiA 402", _PHRASES["look"])
FAULTS: Mapping[int, FaultInfo] = {
    int(digits, 16): info for digits, info in _KNOWN.items() if len(digits) == 4
}
"""By error code: the faults that a drive may report. `Spec.faults`."""

_REGISTER = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0xF: 0x80}
"""Bits of the error register 1001 beside bit 0, by family; 0x81 and 0x82 are communication (bit 4)."""
GENERIC = 0x01
COMMUNICATION = 0x10


def fault_info(code: int) -> FaultInfo:
    """Describe an error code. A code without a name of its own has its number in the name."""
    digits = f"{code:04X}"
    if digits in _KNOWN:
        return _KNOWN[digits]
    near = _KNOWN.get(digits[:-2]) or _KNOWN.get(digits[:-3], _UNKNOWN)
    return FaultInfo(f"{near.name} ({code:#06x})", near.cause, _PHRASES["look"])


def register_of(code: int) -> int:
    """Return the error register (1001) for an error code."""
    if not code:
        return 0
    if code >> 8 in (0x81, 0x82):
        return GENERIC | COMMUNICATION
    return GENERIC | _REGISTER.get(code >> 12, 0)
