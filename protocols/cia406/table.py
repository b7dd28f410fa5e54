"""The objects of encoders by CiA 406 that are read here, and the fault that they tell.

Source: CiA 406 through manuals of TR-Electronic (CEH, CEV, CM, LA), Kübler (9080), Lika (IF55).
"""

from __future__ import annotations

from collections.abc import Mapping

from protocols.canopen.objects import DEVICE_TYPE, Object, Objects, Type
from protocols.plugin import FaultInfo

NAME = "cia406"
PROFILE = 406
"""Low word of the device type"""
PARAMETERS, UNITS, RANGE, PRESET = (0x6000, 0), (0x6001, 0), (0x6002, 0), (0x6003, 0)
POSITION, CYCLE = (0x6004, 0), (0x6200, 0)
PHYSICAL, TURNS, ALARMS = (0x6501, 0), (0x6502, 0), (0x6503, 0)
SCALED = 4
"""Bit of the parameters: positions are in `UNITS` for each turn, not in physical ones"""
POSITION_ERROR = 1
"""Bit of the alarms"""
EMCY = 0x5000
"""Code of device hardware, with which an alarm is sent"""
FAULTS: Mapping[int, FaultInfo] = {
    POSITION_ERROR: FaultInfo(
        "position error",
        "its disc, magnet or light has failed, or its shaft turned too fast while it was switched on",
        "see its manual for the alarms of object 6503; switch it off and on",
        latching=False,
    )
}
ONCE = DEVICE_TYPE, PARAMETERS, UNITS, PHYSICAL
"""What is read when it appears"""
OBJECTS = Objects(
    [
        Object(PARAMETERS, "Operating parameters", Type.U16),
        Object(UNITS, "Measuring units per revolution", Type.U32),
        Object(RANGE, "Total measuring range in measuring units", Type.U32),
        Object(PRESET, "Preset value", Type.U32),
        Object(POSITION, "Position value", Type.U32, "ro", mappable=True),
        Object(CYCLE, "Cyclic timer", Type.U16, unit="ms"),
        Object(PHYSICAL, "Single-turn resolution", Type.U32, "ro"),
        Object(TURNS, "Number of distinguishable revolutions", Type.U16, "ro"),
        Object(ALARMS, "Alarms", Type.U16, "ro", mappable=True),
    ]
)
