"""Fault codes of a moteus: the vendor's name, likely cause and remedy.

Sources: codes and names mjbots/moteus@db1a762 `docs/protocol/registers.md` (0x00f) and, for 49 and 50,
`docs/reference/configuration.md`; the timeout `docs/troubleshooting/timeout-mode-11.md`. Codes 96 to 103 mean
that something limits the output at the moment, without a fault: they are reported with the state. Codes from
0x100 on are the driver's.
"""

from __future__ import annotations

from collections.abc import Mapping

from protocols.moteus.registers import Mode
from protocols.plugin import FaultInfo

TIMEOUT = int(Mode.TIMEOUT)
"""The device's watchdog: not a code of the fault register, but a mode that latches like one."""
DUPLICATE_ID = 0x100
NOT_ARMED = 0x101

FAULTS: Mapping[int, FaultInfo] = {
    TIMEOUT: FaultInfo(
        "timeout",
        "no command came in time: this host, its load or the bus paused longer than the watchdog allows",
        "find out what paused (or raise timeout_ms), then clear; until then the device damps its shaft",
    ),
    32: FaultInfo(
        "calibration fault",
        "the encoder sensed no magnet, or the current sensors were off zero while enabling",
        "check magnet and encoder, keep the shaft still while arming, calibrate with moteus_tool",
    ),
    33: FaultInfo(
        "motor driver fault",
        "most often the supply sagged below what the gate driver needs; else a short on a phase",
        "check supply, cable and phases; read driver_fault1 and driver_fault2 before clearing",
    ),
    34: FaultInfo(
        "over voltage",
        "the bus voltage exceeded servo.max_voltage: the motor braked into a supply that takes no power back",
        "use a battery or a brake resistor, set servo.flux_brake_margin_voltage, or brake more gently",
    ),
    35: FaultInfo(
        "encoder fault",
        "the encoder's readings do not look like a magnet",
        "check the distance and position of the magnet, and the encoder's cable",
    ),
    36: FaultInfo(
        "motor not configured",
        "moteus_tool --calibrate was never run on this motor",
        "calibrate the motor with the vendor's tool",
    ),
    37: FaultInfo(
        "pwm cycle overrun",
        "an internal error of the firmware",
        "update the firmware; report it to the vendor",
    ),
    38: FaultInfo(
        "over temperature",
        "board or motor got hotter than servo.fault_temperature or servo.motor_fault_temperature",
        "let it cool down; lower load or servo.max_current_A, or improve the cooling",
    ),
    39: FaultInfo(
        "outside limit",
        "control began while the shaft was outside servopos.position_min … position_max",
        "turn the shaft back inside by hand, or correct the limits or the zero",
    ),
    40: FaultInfo("under voltage", "the supply is too low", "check battery, supply and connectors"),
    41: FaultInfo(
        "config changed",
        "a configuration value that needs a stop was changed while running",
        "clear; do not configure a device that runs",
    ),
    42: FaultInfo(
        "theta invalid",
        "no commutation encoder has a valid angle",
        "check the encoder's configuration (motor_position.sources) and cable",
    ),
    43: FaultInfo(
        "position invalid",
        "no output encoder has a valid position",
        "check the output encoder, or search its index first",
    ),
    44: FaultInfo(
        "driver enable fault",
        "the gate driver could not be enabled",
        "check the supply; if it stays, the board is damaged",
    ),
    45: FaultInfo(
        "stop position deprecated",
        "a stop position was commanded together with limits of velocity or acceleration",
        "another host commands this device: this driver never writes a stop position",
    ),
    46: FaultInfo(
        "timing violation",
        "the firmware missed a deadline of its own",
        "update the firmware; report it to the vendor",
    ),
    47: FaultInfo(
        "bemf feedforward no accel",
        "servo.bemf_feedforward is set and no limit of acceleration is",
        "set acceleration_limit under options, or servo.default_accel_limit on the device",
    ),
    48: FaultInfo(
        "invalid limits",
        "servopos.position_min or position_max lies outside what the device can count",
        "compare the device's configuration with moteus_tool --dump-config, then clear",
    ),
    49: FaultInfo(
        "position control error",
        "the shaft was further from its set-point than servo.fault_position_error",
        "look for a blocked or overloaded shaft, or command more gently",
    ),
    50: FaultInfo(
        "velocity control error",
        "the shaft's velocity was further from its set-point than servo.fault_velocity_error",
        "look for a blocked or overloaded shaft, or command more gently",
    ),
}
LIMITS: Mapping[int, str] = {
    96: "servo.max_velocity",
    97: "servo.max_power_W",
    98: "the maximum system voltage",
    99: "servo.max_current_A",
    100: "servo.fault_temperature",
    101: "servo.motor_fault_temperature",
    102: "the commanded maximum torque",
    103: "servopos.position_min or servopos.position_max",
}
"""What limits the output, by the content of the fault register in a mode that is not fault."""


def fault_info_of(code: int) -> FaultInfo:
    """Return the description of a fault code, also of an unknown one."""
    unknown = FaultInfo(
        f"fault {code}",
        "a code that this driver does not know: newer firmware?",
        "look it up in the vendor's register reference, then clear",
    )
    return FAULTS.get(code, unknown)
