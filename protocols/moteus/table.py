"""The tables of a moteus: registers with their names and scales, modes, faults.

Rules. A scale is given for 8, 16 and 32 bit integers; a binary32 holds the quantity itself, in the vendor's
units (revolutions at the output shaft, s, N·m, A, V, °C). Sources: mjbots/moteus@db1a762
`docs/protocol/registers.md`, checked against moteus 1.1.1 by a test; faults 49 and 50
`docs/reference/configuration.md`; the timeout `docs/troubleshooting/timeout-mode-11.md`. Fault codes from
0x100 on are the driver's.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import TypeAlias

from protocols.plugin import FaultInfo
from protocols.toolkit.faults import Faults

Scale: TypeAlias = tuple[float, float, float, float]
"""The value of one count, by resolution: int8, int16, int32, binary32."""
INTEGER: Scale = (1.0, 1.0, 1.0, 1.0)

_UNITS: Mapping[str, Scale] = {
    "": INTEGER,
    "rev": (0.01, 0.0001, 0.00001, 1.0),
    "rev/s": (0.1, 0.00025, 0.00001, 1.0),
    "rev/s²": (0.05, 0.001, 0.00001, 1.0),
    "Nm": (0.5, 0.01, 0.001, 1.0),
    "A": (1.0, 0.1, 0.001, 1.0),
    "V": (0.5, 0.1, 0.001, 1.0),
    "°C": (1.0, 0.1, 0.001, 1.0),
    "s": (0.01, 0.001, 0.000001, 1.0),
    "share": (1.0 / 127.0, 1.0 / 32767.0, 1.0 / 2147483647.0, 1.0),
    "W": (10.0, 0.05, 0.0001, 1.0),
}
_RUNS: Mapping[int, str] = {
    # number of the first register: name and unit of it and of those that follow
    0x000: "mode position:rev velocity:rev/s torque:Nm q_current:A d_current:A abs_position:rev power:W",
    0x00A: "motor_temperature:°C trajectory_complete home_state voltage:V temperature:°C fault",
    0x010: "pwm_phase_a:share pwm_phase_b:share pwm_phase_c:share",
    0x014: "voltage_phase_a:V voltage_phase_b:V voltage_phase_c:V",
    0x018: "vfoc_theta:share vfoc_voltage:V voltagedq_d:V voltagedq_q:V",
    0x01C: "command_q_current:A command_d_current:A vfoc_theta_rate:rev/s",
    0x020: "command_position:rev command_velocity:rev/s command_feedforward_torque:Nm",
    0x023: "command_kp_scale:share command_kd_scale:share command_position_max_torque:Nm",
    0x026: "command_stop_position:rev command_timeout:s",
    0x028: "command_velocity_limit:rev/s command_accel_limit:rev/s² command_fixed_voltage_override:V",
    0x02B: "command_ilimit_scale:share command_fixed_current_override:A command_ignore_position_bounds",
    0x030: "position_kp:Nm position_ki:Nm position_kd:Nm position_feedforward:Nm position_command:Nm",
    0x038: "control_position:rev control_velocity:rev/s control_torque:Nm",
    0x03B: "position_error:rev velocity_error:rev/s torque_error:Nm",
    0x040: "command_within_lower_bound:rev command_within_upper_bound:rev",
    0x042: "command_within_feedforward_torque:Nm command_within_kp_scale:share command_within_kd_scale:share",
    0x045: "command_within_max_torque:Nm command_within_timeout:s command_within_ilimit_scale:share",
    0x048: "command_within_ignore_position_bounds",
    0x050: "encoder_0_position:rev encoder_0_velocity:rev/s",
    0x058: "encoder_validity",
    0x070: "millisecond_counter",
    0x100: "model_number firmware_version register_map_version",
    0x110: "multiplex_id",
    0x120: "serial_number1 serial_number2 serial_number3",
    0x130: "set_output_nearest:rev set_output_exact:rev require_reindex recapture_position_velocity",
    0x140: "driver_fault1 driver_fault2",
    0x150: "uuid1 uuid2 uuid3 uuid4",
    0x154: "uuid_mask1 uuid_mask2 uuid_mask3 uuid_mask4 uuid_mask_capable",
}
_ALL = [
    (number, *item.partition(":")[::2])
    for start, run in _RUNS.items()
    for number, item in enumerate(run.split(), start)
]
NAMES: Mapping[int, str] = {number: name for number, name, _ in _ALL}
NUMBERS: Mapping[str, int] = {name: number for number, name, _ in _ALL}
SCALES: Mapping[int, Scale] = {number: _UNITS[unit] for number, _, unit in _ALL if unit}
"""Of the registers that hold a quantity; the others hold integers."""

MODE, POSITION, VELOCITY, TORQUE, Q_CURRENT = range(5)
MOTOR_TEMPERATURE, VOLTAGE, TEMPERATURE, FAULT = 0x00A, 0x00D, 0x00E, 0x00F
MODEL_NUMBER, FIRMWARE_VERSION = 0x100, 0x101
UUID = range(0x150, 0x154)
UUID_MASK = range(0x154, 0x158)
SET_OUTPUT_EXACT = 0x131
ACTIONS = range(0x130, 0x134)
"""Registers that act at once by being written."""
Mode = IntEnum(
    "Mode",
    "STOPPED FAULT ENABLING CALIBRATING CALIBRATION_COMPLETE PWM VOLTAGE VOLTAGE_FOC VOLTAGE_DQ CURRENT"
    " POSITION TIMEOUT ZERO_VELOCITY STAY_WITHIN MEASURE_IND BRAKE",
    start=0,
)
"""Values of the mode register."""
LATCHED = (Mode.FAULT, Mode.TIMEOUT)
"""Only a stop command leaves these."""
RISING = (Mode.ENABLING, Mode.CALIBRATING, Mode.CALIBRATION_COMPLETE)
"""On the way from stopped to any mode with torque."""
_MODE_NAMES = {int(mode): mode.name.lower().replace("_", " ") for mode in Mode}


def name_of(register: int) -> str:
    """Return the name of a register, or its number if it has none."""
    return NAMES.get(register, f"0x{register:03X}")


def register_of(parameter: str) -> int:
    """Return a register by the vendor's name (mode, motor_temperature, …) or number (0x058, 88); or −1."""
    known = NUMBERS.get(parameter.lower())
    try:
        number = int(parameter, 0) if known is None else known
    except ValueError:
        return -1
    return number if 0 <= number <= 0x7FFF else -1


def beside(register: str) -> str:
    """Return the name of a command register that is written with a command, and is none of its numbers."""
    return f"{register} of a command"


def decoded(parameter: str) -> str:
    """Return the name that the command decoder has for a parameter, as `Spec.decoded` does."""
    register = register_of(parameter)
    return parameter if register < 0 else name_of(register)


def mode_name(mode: int) -> str:
    """Return the vendor's name of a mode."""
    return _MODE_NAMES.get(mode, f"mode {mode}")


# -- faults --------------------------------------------------------------------------------------------

TIMEOUT = int(Mode.TIMEOUT)
"""The device's watchdog: not a code of the fault register, but a mode that latches like one."""
FAULTS: Mapping[int, FaultInfo] = {
    TIMEOUT: FaultInfo("timeout", "no command came in time: this host or the bus paused for too long",
        "find out what paused (or raise timeout_ms), then clear; until then the device damps its shaft"),
    32: FaultInfo("calibration fault", "no magnet, or the current sensors were off zero while enabling",
        "check magnet and encoder, keep the shaft still while arming, calibrate with moteus_tool"),
    33: FaultInfo("motor driver fault", "the supply sagged, or there is a short circuit at a phase",
        "check supply, cable and phases; read driver_fault1 and driver_fault2 before clearing"),
    34: FaultInfo("over voltage", "above servo.max_voltage: braking into a supply that takes no power back",
        "use a battery or a brake resistor, set servo.flux_brake_margin_voltage, or brake more gently"),
    35: FaultInfo("encoder fault", "the encoder's readings do not look like a magnet",
        "check the distance and position of the magnet, and the encoder's cable"),
    36: FaultInfo("motor not configured", "it was never calibrated", "run moteus_tool --calibrate"),
    37: FaultInfo("pwm cycle overrun", "an internal error", "update the firmware; report it"),
    38: FaultInfo("over temperature", "above servo.fault_temperature or servo.motor_fault_temperature",
        "let it cool down; lower load or servo.max_current_A, or improve the cooling"),
    39: FaultInfo("outside limit", "control began outside servopos.position_min … position_max",
        "turn the shaft back inside by hand, or correct the limits or the zero"),
    40: FaultInfo("under voltage", "the supply is too low", "check battery, supply and connectors"),
    41: FaultInfo("config changed", "a value that needs a stop was changed while it ran",
        "clear; do not configure a device that runs"),
    42: FaultInfo("theta invalid", "no commutation encoder has a valid angle",
        "check the encoder's configuration (motor_position.sources) and cable"),
    43: FaultInfo("position invalid", "no output encoder has a valid position",
        "check the output encoder, or search its index first"),
    44: FaultInfo("driver enable fault", "the gate driver could not be enabled",
        "check the supply; if it stays, the board is damaged"),
    45: FaultInfo("stop position deprecated", "a stop position was commanded together with other limits",
        "another host commands this device: this driver never writes a stop position"),
    46: FaultInfo("timing violation", "the firmware was late", "update the firmware; report it"),
    47: FaultInfo("bemf feedforward no accel", "servo.bemf_feedforward is set, and no limit of acceleration",
        "set acceleration_limit under options, or servo.default_accel_limit on the device"),
    48: FaultInfo("invalid limits", "servopos.position_min or position_max is beyond what it can count",
        "compare the device's configuration with moteus_tool --dump-config, then clear"),
    49: FaultInfo("position control error", "further from the set-point than servo.fault_position_error",
        "look for a blocked or overloaded shaft, or command more gently"),
    50: FaultInfo("velocity control error", "further from the set-point than servo.fault_velocity_error",
        "look for a blocked or overloaded shaft, or command more gently"),
}  # fmt: skip
"""Those of the device."""
NOT_ARMED, DUPLICATE_ID = 0x101, 0x100


REPORTED = Faults(FAULTS)
"""Those of the device, of which newer firmware may have more, and one of the driver's."""
REPORTED[NOT_ARMED] = FaultInfo("did not arm", "it replies, but did not enter position mode within a second",
    "look at it with the vendor's tool (tview), then clear")  # fmt: skip
LIMITS: Mapping[int, str] = dict(enumerate((
    "servo.max_velocity", "servo.max_power_W", "the maximum system voltage", "servo.max_current_A",
    "servo.fault_temperature", "servo.motor_fault_temperature", "the commanded maximum torque",
    "servopos.position_min or servopos.position_max",
), 96))  # fmt: skip
"""What limits the output, by the content of the fault register in a mode that is not fault."""
