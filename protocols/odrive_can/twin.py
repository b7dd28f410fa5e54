"""The device's end: what an axis obeys, and its firmware (README, "The twin of 0.6", "The twin of 0.5").

Rules. `Memory` is what one device keeps of the frames it received; command decoder and firmware run on the
same object, so they cannot disagree on what is obeyed. A frame that changes nothing gives no command: a
set-point to a disarmed axis is kept and takes effect when the axis arms. Broadcasts reach every device of
0.6.x for Reboot, Clear_Errors and Address, as in odriverobotics/ODriveResources@06dc846
`examples/can_enumerate.py`; in 0.5.x both axes of a board obey Reboot and Clear_Errors to either
(odriverobotics/ODrive@f9b5419 `communication/can/can_simple.cpp`). One twin is one axis; the sources of each
behaviour are in the README.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import SECOND, Nanos, Obeyed
from protocols.odrive_can import errors, table
from protocols.odrive_can.options import Settings, firmware_of, line_of, serial_of
from protocols.odrive_can.servo import GAINS, Servo, gains_of
from protocols.odrive_can.table import BROADCAST, CLOSED_LOOP, ControlMode, InputMode
from protocols.plugin import Device
from protocols.toolkit.firmware import NEVER, Firmware, milliseconds
from protocols.toolkit.table import Decoded, Values

BROADCASTS = ("Reboot", "Clear_Errors")
"""What a device of 0.6.x obeys on the broadcast node, beside assignments of node ids."""
BOARD = ("Reboot (0.5.x)", "Clear_Errors (0.5.x)")
"""What an axis of 0.5.x obeys on the node of the other axis on its board."""


def obeyed_as(decoded: Decoded) -> Decoded:
    """Return a message as it is obeyed: a remote frame (0.5.x) as if its data were zeros."""
    if not decoded.name.startswith("remote "):
        return decoded
    name = decoded.name.removeprefix("remote ")
    return Decoded(name, decoded.address, table.table_of("0.5").read(name, bytes(8)) or {})


@dataclass(slots=True)
class Memory:
    """What one axis keeps of the frames that it received. Turns, turns/s, N·m. It knows neither errors nor
    calibration, so it assumes that a request for closed loop succeeds."""

    motor: str
    line: str
    """Firmware line."""
    node: int
    other: int
    """The other axis on its board; −1: none."""
    serial: int
    control_mode: int
    input_mode: int
    armed: bool = False
    position: float | None = None
    """None: where the shaft was when the axis armed or entered position control."""
    velocity: float = 0.0
    torque: float = 0.0

    def command(self) -> Sequence[msg.Command]:
        """Return the command that mode and inputs amount to now."""
        if not self.armed or self.input_mode == InputMode.INACTIVE:
            return ()
        match self.control_mode:
            case ControlMode.TORQUE:
                return (msg.Torque(self.motor, self.torque),)
            case ControlMode.VELOCITY:
                return (msg.Velocity(self.motor, self.velocity * math.tau, self.torque),)
            case ControlMode.POSITION if self.position is None:
                return (msg.Hold(self.motor),)
            case ControlMode.POSITION:
                turned = (self.position or 0.0) * math.tau
                return (msg.Position(self.motor, turned, self.velocity * math.tau, self.torque),)
        return ()

    def addressed(self, decoded: Decoded) -> bool:
        """True if a message is for this axis."""
        if decoded.address == self.node:
            return True
        if decoded.address == BROADCAST and self.line == "0.6":
            return decoded.name in BROADCASTS
        return decoded.address == self.other and decoded.name in BOARD

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Apply a message to any address; return what the axis then does."""
        decoded = obeyed_as(decoded)
        name, values, motor = decoded.name, decoded.values, self.motor
        if name == "Address":
            return self._assign(values["Node_ID"], values["Serial_Number"])
        if name == "Set_Axis_Node_ID" and decoded.address == self.other:
            self.other = values["Axis_Node_ID"] & table.MAX_EXTENDED_NODE
        if not self.addressed(decoded):
            return ()
        written = {key: values[key] for key in table.WRITABLE.get(name, ())}
        match name.removesuffix(" (0.5.x)"):
            case "Set_Input_Pos":
                self.position, self.velocity, self.torque = values.values()
                return self.command()
            case "Set_Input_Vel":
                self.velocity, self.torque = values.values()
                return self.command()
            case "Set_Input_Torque":
                self.torque = values["Input_Torque"]
                return self.command()
            case "Set_Controller_Mode":
                return self._set_mode(*values.values())
            case "Set_Axis_State":
                return self.set_state(values["Axis_Requested_State"])
            case "Estop":
                self.disarm()
                return (msg.Estop(motor),)
            case "Reboot" | "Enter_DFU_Mode":
                self.disarm()
                return (msg.Reboot(motor),)
            case "Clear_Errors":
                return (msg.ClearFault(motor),)
            case "Set_Axis_Node_ID":
                self.node = values["Axis_Node_ID"] & table.MAX_EXTENDED_NODE
                return (msg.SetId("", self.serial, values["Axis_Node_ID"]),)
            case "Set_Absolute_Position" | "Set_Linear_Count" if not values["Position"]:
                return (msg.Zero(motor),)
            case "Set_Absolute_Position":
                written = {"Position": values["Position"] * math.tau}
            case "Set_Linear_Count":
                written = {"Linear_Count": float(values["Position"])}
            case "Start_Anticogging":  # a procedure of the device that turns the shaft
                return (msg.Home(motor),)
            case "RxSdo" if values["Opcode"] == 1:
                written = {f"endpoint {values['Endpoint_ID']}": float(values["Value"])}
        return tuple(msg.WriteParameter(motor, key, value) for key, value in written.items())

    def disarm(self) -> None:
        """Leave closed loop."""
        self.armed = False

    def set_state(self, state: int) -> Sequence[Obeyed]:
        """Apply a requested state; 0 is no request at all (ODrive@f9b5419 `MotorControl/axis.cpp`)."""
        if state == table.UNDEFINED:
            return ()
        if state != CLOSED_LOOP:
            self.disarm()
            return (msg.Home(self.motor),) if state == table.HOMING else (msg.Idle(self.motor),)
        if not self.armed or self.line == "0.5":  # 0.5.x leaves closed loop and enters it again
            # On arming in position control the firmware takes the present position as its input
            # (odriverobotics/ODrive@028a22b `MotorControl/axis.cpp` start_closed_loop_control).
            self.position = None
            self.armed = True
        return (msg.Arm(self.motor), *self.command())

    def _set_mode(self, control_mode: int, input_mode: int) -> Sequence[Obeyed]:
        if control_mode == ControlMode.POSITION and self.control_mode != ControlMode.POSITION:
            self.position = None
        self.control_mode, self.input_mode = control_mode, input_mode
        return self.command()

    def _assign(self, node: int, serial: int) -> Sequence[Obeyed]:
        """Apply an assignment: take the node id, or vacate it if another gets it."""
        if node > BROADCAST or self.line != "0.6":
            return ()
        if serial == self.serial:
            self.node = node
        elif node == self.node != BROADCAST:
            self.node = BROADCAST
        else:
            return ()
        return (msg.SetId("", self.serial, self.node),)


def memory(device: Device, node: int | None = None) -> Memory:
    """Return the memory of a device after power-on. `node`: as saved, if not as configured."""
    settings: Settings = device.settings
    at = device.address if node is None else node
    serial, modes = serial_of(settings, device.address), (settings.control_mode, settings.input_mode)
    return Memory(device.name, line_of(device), at, settings.other_axis, serial, *modes)


CYCLIC = {
    "Get_Version": "version_msg_rate_ms",
    "Heartbeat": "heartbeat_msg_rate_ms",
    "Get_Encoder_Estimates": "encoder_msg_rate_ms",
    "Get_Motor_Error": "motor_error_rate_ms",
    "Get_Encoder_Error": "encoder_error_rate_ms",
    "Get_Controller_Error": "controller_error_rate_ms",
    "Get_Sensorless_Error": "sensorless_error_rate_ms",
    "Get_Encoder_Count": "encoder_count_rate_ms",
    "Get_Iq": "iq_msg_rate_ms",
    "Get_Sensorless_Estimates": "sensorless_rate_ms",
    "Get_Error": "error_msg_rate_ms",
    "Get_Temperature": "temperature_msg_rate_ms",
    "Get_Bus_Voltage_Current": "bus_voltage_msg_rate_ms",
    "Get_Torques": "torques_msg_rate_ms",
}
"""The cyclic messages of both lines, and the settings that hold their periods."""
GPIO_COUNT = 17


class OdriveTwin(Firmware):
    """One axis: what the firmware lines do alike."""

    raised: Mapping[str, int]
    """The codes of errors by their names in 0.6.x."""
    feeds: tuple[str, ...] = ()
    """Messages that feed its watchdog."""

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self.memory = memory(device)
        self.table = table.table_of(self.memory.line, device.options.is_extended)
        self.servo = Servo(device.settings, gains_of(device.settings))
        self.words: dict[int, int] = {}
        """Error bits by the base of their word."""
        self.disarm_reason = 0
        sent = {row.name for row in self.table.rows if row.direction == "from_device"}
        periods = {name: getattr(self.settings, key) for name, key in CYCLIC.items() if name in sent}
        self._periods = {name: milliseconds(period) for name, period in periods.items() if period}

    # -- the firmware's own ---------------------------------------------------------------------------

    def request_state(self, t: Nanos, state: int) -> None:
        """Do what a request of a state does."""
        raise NotImplementedError

    def reboot(self, t: Nanos, action: int) -> None:
        """Restart the processor."""
        raise NotImplementedError

    def on_trip(self) -> None:
        """Do what follows from an error."""
        raise NotImplementedError

    def signals(self) -> Values:
        """Return what it reports, by the vendor's names."""
        servo, stage, encoder = self.servo, self.servo.stage, self.servo.encoder
        return {
            "Axis_State": CLOSED_LOOP if self.memory.armed else table.IDLE,
            "Trajectory_Done_Flag": servo.set_point.done,
            "Pos_Estimate": encoder.position,
            "Vel_Estimate": encoder.velocity,
            "Iq_Setpoint": servo.current_set_point,
            "Iq_Measured": stage.current,
            "Bus_Voltage": stage.voltage,
            "Bus_Current": stage.supply_current,
        }

    # -- what both do ---------------------------------------------------------------------------------

    def word(self, word: errors.Word) -> int:
        """Return the bits of an error word."""
        return self.words.get(word.base, 0)

    def trip(self, code: int) -> None:
        """Raise an error, which stays until Clear_Errors; the axis disarms."""
        base = code >> errors.BASE_SHIFT << errors.BASE_SHIFT
        self.words[base] = self.words.get(base, 0) | code - base
        self.on_trip()

    def on_timeout(self) -> None:
        self.trip(self.raised["WATCHDOG_TIMER_EXPIRED"])

    def watchdog(self) -> Nanos:
        """Return the timeout as configured; 0: off."""
        return round(self.settings.watchdog_timeout * SECOND) if self.settings.enable_watchdog else 0

    def restart_with(self, t: Nanos, node: int, gains: Mapping[str, float]) -> None:
        """Restart with the saved node id and gains: silent at first, and disarmed."""
        self.restart(t, milliseconds(self.settings.reboot_ms))
        self.memory = memory(self.device, node)
        # An absolute encoder knows its position within one turn only.
        self.servo = Servo(self.settings, gains, math.floor(self.servo.encoder.shaft))
        self.words.clear()

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        decoded = self.table.decode(frame, "to_device")
        if decoded is None or not decoded.name:
            return
        requested = decoded.name.partition("request for ")[2]
        if requested:
            self.on_request(t, requested, decoded.address)
        elif decoded.name == "Address" or not self.memory.addressed(decoded):
            if self.memory.obey(decoded):
                self.on_request(t, "Address", BROADCAST)
        else:
            self.on_message(t, obeyed_as(decoded))

    def on_request(self, t: Nanos, name: str, address: int) -> None:
        """Send a message that was requested of a node."""
        frame = self.report(name) if address == self.memory.node else None
        self.reply(t, *([] if frame is None else [frame]))

    def on_message(self, t: Nanos, decoded: Decoded) -> None:
        """Obey a message to this axis."""
        name, values, encoder = decoded.name, decoded.values, self.servo.encoder
        if name in self.feeds:
            self.feed(t)
        match name.removesuffix(" (0.5.x)"):
            case "Set_Axis_State":
                return self.request_state(t, values["Axis_Requested_State"])
            case "Reboot":
                return self.reboot(t, values.get("Action", 0))
            case "Estop":
                self.trip(self.raised["ESTOP_REQUESTED"])
            case "Clear_Errors":
                self.words.clear()
                self.disarm_reason = 0
            case "Enter_DFU_Mode":
                self.silent_until = NEVER
            case "Set_Absolute_Position":
                encoder.set_position(values["Position"])
            case "Set_Linear_Count":
                encoder.set_position(values["Position"] / self.settings.encoder_cpr)
            case "Ask_ADC_Voltage" if values["GPIO"] < GPIO_COUNT:
                self.on_request(t, "Get_ADC_Voltage", self.memory.node)
            case _ if name in GAINS:
                self.servo.configure(name, values.values())
        self.memory.obey(decoded)
        return None

    def cyclic(self) -> Mapping[str, Nanos]:
        return self._periods

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        self.servo.encoder.measure(dt or 1.0, position / math.tau, velocity / math.tau)
        for name in list(self.servo.cycle(dt, self.memory)) if dt else ():
            self.trip(self.raised[name])
        return self.servo.stage.torque if self.memory.armed else 0.0

    def report(self, name: str) -> Frame | None:
        row = self.table.row("Address reply" if name == "Address" else name)
        signals = self.signals()
        names = [field.name for field in row.fields if field.name]
        if not signals.keys() >= set(names):  # a message that it does not send
            return None
        return self.table.encode(row.name, self.memory.node, **{each: signals[each] for each in names})


class Twin06(OdriveTwin):
    """One device of firmware 0.6.x."""

    faults = errors.DEVICE06
    raised = errors.ERRORS.bits
    # (odriverobotics/ODriveResources@fdb25dd `examples/can_watchdog.py`)
    feeds = ("Set_Input_Pos", "Set_Input_Vel", "Set_Input_Torque", "Set_Axis_State")

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self.result = errors.SUCCESS
        self.starts_until: Nanos = 0
        """It reports INITIALIZING until then."""
        self._flash = (self.memory.node, gains_of(self.settings))
        """Node id and gains as saved."""
        self._version = [int(part) for part in firmware_of(device).split(".")]

    def timeout(self) -> Nanos:
        return self.watchdog() if self.memory.armed else 0

    def on_request(self, t: Nanos, name: str, address: int) -> None:
        """Reply; discovery is on the broadcast node, and all that a device without an address answers."""
        discovery = name == "Address" and address == BROADCAST
        if discovery or address != BROADCAST:
            super().on_request(t, name, self.memory.node if discovery else address)

    def report(self, name: str) -> Frame | None:
        """A device without an address sends nothing by itself."""
        return super().report(name) if name == "Address" or self.memory.node != BROADCAST else None

    def request_state(self, t: Nanos, state: int) -> None:
        results, was_armed = errors.RESULTS.bits, self.memory.armed
        if state == CLOSED_LOOP:
            if was_armed:
                return
            if self.active() or not self.settings.calibrated:
                self.result = results["DISARMED" if self.active() else "NOT_CALIBRATED"]
                self.disarm_reason = self.active() or self.disarm_reason
                return
            self.servo.start()
            self.result, self.disarm_reason = errors.BUSY, 0
        elif state == table.IDLE:
            self.result = errors.SUCCESS if was_armed else self.result
        elif state != table.UNDEFINED:
            self.result = results["HOMING_WITHOUT_ENDSTOP" if state == table.HOMING else "INVALID_STATE"]
        self.memory.set_state(state)

    def on_trip(self) -> None:
        if self.memory.armed:
            self.memory.disarm()
            self.disarm_reason, self.result = self.active(), errors.RESULTS.bits["DISARMED"]

    def reboot(self, t: Nanos, action: int) -> None:
        if action == table.SAVE:
            self._flash = (self.memory.node, dict(self.servo.gains))
        elif action == table.ERASE:
            self._flash = (BROADCAST, gains_of(Settings()))
        self.restart_with(t, *self._flash)
        self.starts_until = self.silent_until + milliseconds(self.settings.initializing_ms)
        self.disarm_reason, self.result = 0, errors.SUCCESS

    def active(self) -> int:
        """Return the bits of all errors, INITIALIZING among them."""
        return self.word(errors.ERRORS) | errors.INITIALIZING * ((self.now or 0) < self.starts_until)

    def signals(self) -> Values:
        servo, stage, active = self.servo, self.servo.stage, self.active()
        version = (2, self.settings.hw_line, 1, 0, *self._version, 0)
        signals = super().signals() | dict(zip(table.VERSION_SIGNALS, version, strict=True))
        if self.memory.node <= BROADCAST:  # there is one byte for it
            signals |= {"Node_ID": self.memory.node, "Serial_Number": self.memory.serial, "Connection_ID": 0}
        return signals | {
            "Axis_Error": active,
            "Active_Errors": active,
            "Disarm_Reason": self.disarm_reason,
            "Procedure_Result": self.result,
            "FET_Temperature": stage.stage_temperature,
            "Motor_Temperature": stage.motor_temperature,
            "Torque_Target": servo.torque_target,
            "Torque_Estimate": stage.torque,
            "Electrical_Power": stage.electrical,
            "Mechanical_Power": stage.mechanical,
        }


_SUPPLY = errors.MOTOR.code("SYSTEM_LEVEL")
"""A fault of the supply is the board's error, which CANSimple does not report."""
COMPONENTS05 = {
    "Motor_Error": (errors.MOTOR, "MOTOR_FAILED"),
    "Encoder_Error": (errors.ENCODER, "ENCODER_FAILED"),
    "Controller_Error": (errors.CONTROLLER, "CONTROLLER_FAILED"),
    "Sensorless_Error": (errors.SENSORLESS, "SENSORLESS_ESTIMATOR_FAILED"),
}
"""By signal: the components' error words, and the axis' bit for each."""


class Twin05(OdriveTwin):
    """One axis of firmware 0.5.x."""

    faults = errors.DEVICE05
    raised = MappingProxyType(
        {
            "WATCHDOG_TIMER_EXPIRED": errors.AXIS.code("WATCHDOG_TIMER_EXPIRED"),
            "ESTOP_REQUESTED": errors.AXIS.code("ESTOP_REQUESTED"),
            "CURRENT_LIMIT_VIOLATION": errors.MOTOR.code("CURRENT_LIMIT_VIOLATION"),
            "MOTOR_OVER_TEMP": errors.MOTOR.code("MOTOR_THERMISTOR_OVER_TEMP"),
            "INVERTER_OVER_TEMP": errors.MOTOR.code("FET_THERMISTOR_OVER_TEMP"),
            **{f"DC_BUS_{name}": _SUPPLY for name in ("UNDER_VOLTAGE", "OVER_VOLTAGE")},
            **{f"DC_BUS_{name}": _SUPPLY for name in ("OVER_CURRENT", "OVER_REGEN_CURRENT")},
            "VELOCITY_LIMIT_VIOLATION": errors.CONTROLLER.code("OVERSPEED"),
            "SPINOUT_DETECTED": errors.CONTROLLER.code("SPINOUT_DETECTED"),
        }
    )

    def timeout(self) -> Nanos:
        """It runs in every state; once expired there is nothing left to do."""
        expired = self.word(errors.AXIS) & errors.AXIS.bits["WATCHDOG_TIMER_EXPIRED"]
        return 0 if expired else self.watchdog()

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        """Any frame to the axis feeds its watchdog, also one that is ignored otherwise."""
        if isinstance(frame, CanFrame) and not frame.fd and frame.extended == self.device.options.is_extended:
            if frame.id >> table.CMD_BITS == self.memory.node:
                self.feed(t)
            super().on_frame(t, frame)

    def request_state(self, t: Nanos, state: int) -> None:
        axis = errors.AXIS
        if state == table.UNDEFINED:
            return
        self.words[axis.base] = self.word(axis) & ~axis.bits["INVALID_STATE"]
        closed_loop = state == CLOSED_LOOP
        if closed_loop and self.settings.calibrated:
            self.feed(t)
        elif state not in (table.IDLE, table.STARTUP):
            self.trip(axis.code("HOMING_WITHOUT_ENDSTOP" if state == table.HOMING else "INVALID_STATE"))
        arms = closed_loop and not self.word(axis)
        if arms:
            self.servo.start()
        self.memory.set_state(CLOSED_LOOP if arms else table.IDLE)

    def reboot(self, t: Nanos, action: int) -> None:
        """What was set over CAN cannot be saved over CAN: the node id, too, is as configured again."""
        self.restart_with(t, self.device.address, gains_of(self.settings))

    def on_trip(self) -> None:
        for word, name in COMPONENTS05.values():
            if self.word(word):
                self.words[errors.AXIS.base] = self.word(errors.AXIS) | errors.AXIS.bits[name]
        self.memory.disarm()

    def signals(self) -> Values:
        cpr, encoder = self.settings.encoder_cpr, self.servo.encoder
        shadow, within = (math.floor(turns * cpr + 0.5) for turns in (encoder.position, encoder.shaft))
        words = {name: self.word(word) for name, (word, _) in COMPONENTS05.items()}
        return {
            **super().signals(),
            "Axis_Error": self.word(errors.AXIS),
            "ADC_Voltage": 0.0,
            **words,
            **{f"{name}_Flag": word != 0 for name, word in words.items()},
            "Shadow_Count": (shadow + 2**31) % 2**32 - 2**31,
            "Count_in_CPR": within % cpr,
            "Sensorless_Pos_Estimate": 0.0,
            "Sensorless_Vel_Estimate": 0.0,
        }
