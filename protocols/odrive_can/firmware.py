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

import copy
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.asked import set_id, waiting
from protocols.frames import CanFrame, Frame
from protocols.messages import SECOND, Nanos, Obeyed
from protocols.odrive_can import errors, table
from protocols.odrive_can.options import (
    SETTING_OF,
    AxisSettings,
    firmware_of,
    line_of,
    saved,
    serial_of,
    used,
)
from protocols.odrive_can.servo import GAINS, Servo, gains_of
from protocols.odrive_can.table import BROADCAST, CLOSED_LOOP, ControlMode, InputMode
from protocols.plugin import Device, FaultInfo
from protocols.toolkit.firmware import NEVER, Firmware, milliseconds
from protocols.toolkit.registers import Registers
from protocols.toolkit.servo import clamp
from protocols.toolkit.table import FLOAT_MAX, Decoded, Values

BROADCASTS = ("Reboot", "Clear_Errors")
"""What a device of 0.6.x obeys on the broadcast node, beside assignments of node ids."""
BOARD = ("Reboot (0.5.x)", "Clear_Errors (0.5.x)")
"""What an axis of 0.5.x obeys on the node of the other axis on its board."""
FOLLOWED: Mapping[int, tuple[bool, bool, bool]] = {
    InputMode.INACTIVE: (False, False, False),
    InputMode.PASSTHROUGH: (True, True, True),
    InputMode.VEL_RAMP: (False, True, False),
    InputMode.POS_FILTER: (True, True, False),
    InputMode.TRAP_TRAJ: (True, False, False),
    InputMode.TORQUE_RAMP: (False, False, True),
    InputMode.TUNING: (True, True, True),
}
"""Whether each input mode follows position, velocity and torque. (ODrive@f9b5419
`MotorControl/controller.cpp` update.)"""
# Looked up once: a look at a member of an enumeration takes five times as long as one at a name.
PASSTHROUGH, TRAP_TRAJ = InputMode.PASSTHROUGH, InputMode.TRAP_TRAJ
TORQUE, VELOCITY, POSITION = ControlMode.TORQUE, ControlMode.VELOCITY, ControlMode.POSITION
COMMANDS: Sequence[Callable[..., msg.Command]] = (msg.Idle, msg.Torque, msg.Velocity, msg.Position)
"""By control mode."""
TO_A_POSITION = (InputMode.POS_FILTER, TRAP_TRAJ)
NOT_A_NUMBER = "MODULATION_IS_NAN"
INPUT_FAULTS = ("INVALID_MIRROR_AXIS", "INVALID_INPUT_MODE", NOT_A_NUMBER)
"""The errors of mode and inputs in closed loop, by their names in 0.5.x."""


def obeyed_as(decoded: Decoded) -> Decoded:
    """Return a message as it is obeyed: a remote frame (0.5.x) as if its data were zeros; of inputs that are
    no numbers infinity as the largest, since limits apply to it."""
    form, _, name = decoded.name.partition(" ")
    if form == "remote":
        return Decoded(name, decoded.address, table.table_of("0.5").read(name, bytes(8)) or {})
    if form == "raw":
        values = {key: _f32(x) if isinstance(x, int) else x for key, x in decoded.values.items()}
        return Decoded(name, decoded.address, values)
    return decoded


def _f32(bits: int) -> float:
    value: float = struct.unpack("<f", bits.to_bytes(4, "little"))[0]
    return value if math.isnan(value) else clamp(value, FLOAT_MAX)


@dataclass(slots=True)
class Memory:
    """What one axis keeps of the frames that it received. Turns, turns/s, N·m. Of errors it knows only those
    of its inputs, and nothing of calibration, so it assumes that a request for closed loop succeeds."""

    motor: str
    line: str
    node: int
    other: int  # The other axis on its board; −1: none.
    serial: int
    control_mode: int
    input_mode: int
    registers: Registers = field(repr=False)  # The endpoints that have a name.
    endpoints: dict[int, int]  # What endpoints hold, in bits.
    armed: bool = False
    position: float | None = None  # None: where the shaft was when it armed or entered position control.
    velocity: float = 0.0
    torque: float = 0.0

    def __copy__(self) -> Memory:
        """Copy it as `copy.copy` does, in a fourth of the time."""
        return Memory(*[getattr(self, name) for name in Memory.__slots__])

    @property
    def control(self) -> ControlMode:
        """The outermost loop: voltage control is torque control, and what is above the last is the last. A
        trajectory ends in position control, and a filter leads to a position, whatever the control mode."""
        if self.input_mode in TO_A_POSITION or self.control_mode >= POSITION:
            return POSITION
        return TORQUE if self.control_mode <= TORQUE else VELOCITY

    @property
    def fault(self) -> str:
        """The error of mode and inputs, one of `INPUT_FAULTS`; "": none."""
        return self._fault_of(self._inputs(self.control))

    @property
    def trips(self) -> bool:
        """True if that is an error now: inputs that are no numbers are none before closed loop."""
        fault = self.fault
        return fault != "" and (self.armed or fault != NOT_A_NUMBER)

    def _fault_of(self, inputs: Sequence[float]) -> str:
        if self.input_mode in FOLLOWED:
            return NOT_A_NUMBER if math.isnan(sum(inputs)) else ""  # the others are finite, and so small
        return "INVALID_MIRROR_AXIS" if self.input_mode == InputMode.MIRROR else "INVALID_INPUT_MODE"

    def _inputs(self, control: ControlMode) -> Sequence[float]:
        """Return the inputs that control and input mode follow, in the order of a command's fields."""
        inputs: tuple[float, ...] = (self.position or 0.0, self.velocity, self.torque)
        if self.input_mode != PASSTHROUGH:  # which follows all of them
            followed = zip(inputs, FOLLOWED.get(self.input_mode, ()), strict=False)
            inputs = tuple(value if follows else 0.0 for value, follows in followed)
        return inputs[POSITION - control :]

    def _command(self) -> Sequence[Obeyed]:
        """Return the command that mode and inputs amount to now; none if they change nothing. While it is not
        armed they wait."""
        control = self.control
        inputs = self._inputs(control)
        fault = self._fault_of(inputs)
        if fault and (self.armed or fault != NOT_A_NUMBER):
            self.disarm()
            return (msg.Idle(self.motor),)
        if not FOLLOWED[self.input_mode][POSITION - control]:
            return ()
        *turns, torque = inputs
        goal: msg.Command = msg.Hold(self.motor)
        if control is not POSITION or self.position is not None:
            goal = COMMANDS[control](self.motor, *[each * math.tau for each in turns], torque)
        return (goal,) if self.armed else waiting(goal)

    def addressed(self, decoded: Decoded) -> bool:
        """True if a message is for this axis."""
        if decoded.address == self.node:
            return True
        if decoded.address == BROADCAST and self.line == "0.6":
            return decoded.name in BROADCASTS
        return decoded.address == self.other and decoded.name in BOARD

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Apply a message to any address; return what the axis then does."""
        decoded = obeyed_as(decoded) if " " in decoded.name else decoded
        name, values, motor = decoded.name, decoded.values, self.motor
        if name == "Address":
            return self._assign(values["Node_ID"], values["Serial_Number"])
        if name == "Set_Axis_Node_ID" and decoded.address == self.other:
            self.other = values["Axis_Node_ID"] & table.MAX_EXTENDED_NODE
        if decoded.address != self.node and not self.addressed(decoded):
            return ()
        match name.removesuffix(" (0.5.x)"):
            case "Set_Input_Pos":
                self.position, self.velocity, self.torque = values.values()
                kept: msg.Command = msg.Position(motor, self.position * math.tau)
                return self._command() or waiting(kept)
            case "Set_Input_Vel":
                self.velocity, self.torque = values.values()
                kept = msg.Velocity(motor, self.velocity * math.tau, self.torque)
                return self._command() or waiting(kept)
            case "Set_Input_Torque":
                self.torque = values["Input_Torque"]
                return self._command() or waiting(msg.Torque(motor, self.torque))
            case "Set_Controller_Mode":
                return self._set_mode(*values.values())
            case "Input":
                return self._set_input(values)
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
                return (msg.SetAddress(motor, values["Axis_Node_ID"]),)
            case "Set_Absolute_Position" | "Set_Linear_Count" if not values["Position"]:
                return (msg.Zero(motor),)
            case "Start_Anticogging":  # a procedure of the device that turns the shaft
                return (msg.Home(motor),)
            case "RxSdo":
                number, bits = values["Endpoint_ID"], values["Value"]
                self.endpoints[number] = bits
                endpoint, value = self.registers.value(number, bits)
                written = {f"endpoint {number}": bits} if value is None else {endpoint: value}
            case _:
                written = {key: values[key] for key in table.WRITABLE.get(name, ())}
        return tuple(msg.WriteParameter(motor, key, float(value)) for key, value in written.items())

    def _set_input(self, values: Mapping[str, float]) -> Sequence[Obeyed]:
        """Apply a mode and its inputs at once, as the serial protocol has them: those not given stay, but for
        the position, which is the present one."""
        self.control_mode = int(values.get("Control_Mode", self.control_mode))
        self.input_mode = int(values.get("Input_Mode", self.input_mode))
        taken = "Control_Mode" in values and self.control_mode >= POSITION
        self.position = values.get("Input_Pos", None if taken else self.position)
        self.velocity = values.get("Input_Vel", self.velocity)
        self.torque = values.get("Input_Torque", self.torque)
        modes = [name for name in ("Control_Mode", "Input_Mode") if name in values]
        written = [msg.Kept(self.motor, name, float(values[name])) for name in modes]
        given = self._command()
        if not given and len(values) > len(modes):
            *turns, torque = self._inputs(self.control)
            given = waiting(COMMANDS[self.control](self.motor, *[x * math.tau for x in turns], torque))
        return *given, *written

    def disarm(self) -> None:
        """Leave closed loop."""
        self.armed = False

    def set_state(self, state: int) -> Sequence[Obeyed]:
        """Apply a requested state; 0 is no request at all (ODrive@f9b5419 `MotorControl/axis.cpp`)."""
        if state == table.UNDEFINED:
            return ()
        if state != CLOSED_LOOP or self.fault:
            self.disarm()
            if state in table.STATE_NAMES.keys() - {table.IDLE, CLOSED_LOOP, table.HOMING}:
                return (msg.WriteParameter(self.motor, "Axis_Requested_State", float(state)),)
            return (msg.Home(self.motor),) if state == table.HOMING else (msg.Idle(self.motor),)
        if not self.armed or self.line == "0.5":  # 0.5.x leaves closed loop and enters it again
            # On arming in position control the firmware takes the present position as its input
            # (odriverobotics/ODrive@028a22b `MotorControl/axis.cpp` start_closed_loop_control).
            self.position = None
            self.armed = True
        return (msg.Arm(self.motor), *self._command())

    def _set_mode(self, control_mode: int, input_mode: int) -> Sequence[Obeyed]:
        """Apply a mode: position control takes the present position as its input, even if it was on already
        (ODrive@f9b5419 `can_simple.cpp`, `controller.cpp` control_mode_updated); a trajectory goes on."""
        goes_on = self.input_mode == input_mode == TRAP_TRAJ
        if control_mode >= POSITION and not goes_on:
            self.position = None
        self.control_mode, self.input_mode = control_mode, input_mode
        modes = {"Control_Mode": control_mode, "Input_Mode": input_mode}
        written = [msg.Kept(self.motor, name, float(mode)) for name, mode in modes.items()]
        return *self._command(), *written

    def _assign(self, node: int, serial: int) -> Sequence[Obeyed]:
        """Apply an assignment: take the node id, or vacate it if another gets it."""
        if node > BROADCAST or self.line != "0.6":
            return ()
        if serial == self.serial:
            self.node = node
        elif node == self.node != BROADCAST:
            self.node = BROADCAST
        else:
            return (msg.Kept(self.motor, set_id(serial), float(node)),)
        return (msg.SetId("", serial, node),)


def memory(device: Device, node: int | None = None, endpoints: Mapping[int, int] | None = None) -> Memory:
    """Return the memory of a device after power-on; node id and endpoints as saved, if they are."""
    settings: AxisSettings = device.settings
    at = device.address if node is None else node
    serial, modes = serial_of(settings, device.address), (settings.control_mode, settings.input_mode)
    other = getattr(settings, "other_axis", -1)  # of CAN alone
    axis = (device.name, line_of(device), at, other, serial)
    held = saved(device.options, settings) if endpoints is None else dict(endpoints)
    return Memory(*axis, *modes, device.options.registers(), held)


_CYCLIC = (
    "Get_Version=version_msg Heartbeat=heartbeat_msg Get_Encoder_Estimates=encoder_msg"
    " Get_Motor_Error=motor_error Get_Encoder_Error=encoder_error Get_Controller_Error=controller_error"
    " Get_Sensorless_Error=sensorless_error Get_Encoder_Count=encoder_count Get_Iq=iq_msg"
    " Get_Sensorless_Estimates=sensorless Get_Error=error_msg Get_Temperature=temperature_msg"
    " Get_Bus_Voltage_Current=bus_voltage_msg Get_Torques=torques_msg"
)
CYCLIC = {name: f"{rate}_rate_ms" for name, _, rate in (each.partition("=") for each in _CYCLIC.split())}
"""The cyclic messages of both lines, and the settings that hold their periods."""
GPIO_COUNT = 17


class OdriveTwin(Firmware):
    """One axis: what the firmware lines do alike."""

    raised: Mapping[str, int]  # The codes of errors by their names in 0.6.x.
    feeds: tuple[str, ...] = ()  # Messages that feed its watchdog.

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self.memory = memory(device)
        self.table = table.table_of(self.memory.line, getattr(device.options, "is_extended", False))
        self.servo = Servo(device.settings, gains_of(device.settings))
        self._fields: dict[str, tuple[str, list[str]]] = {}
        """The rows of the messages that it has sent, and their fields."""
        self.words: dict[int, int] = {}  # Error bits by the base of their word.
        self.calibrated: bool = self.settings.calibrated
        self.procedure: int = 0
        """The state that is a procedure, while it runs; the shaft is not turned by it."""
        self.procedure_until: Nanos = 0
        self.disarm_reason = 0
        self.use(device.settings)

    def use(self, settings: AxisSettings) -> None:
        """Use these settings from now on; its gains are as last set."""
        self.settings = settings
        self.servo.use(settings)
        self.watchdog: Nanos = round(settings.watchdog_timeout * SECOND) if settings.enable_watchdog else 0
        """Its timeout as configured; 0: off."""
        sent = {row.name for row in self.table.rows if row.direction == "from_device"}
        periods = {name: getattr(settings, key, 0) for name, key in CYCLIC.items() if name in sent}
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
            "Axis_State": CLOSED_LOOP if self.memory.armed else self.procedure or table.IDLE,
            "Trajectory_Done_Flag": servo.set_point.done,
            "Pos_Estimate": encoder.position,
            "Vel_Estimate": encoder.velocity,
            "Iq_Setpoint": servo.current_set_point,
            "Iq_Measured": stage.current,
            "Bus_Voltage": stage.voltage,
            "Bus_Current": stage.supply_current,
        }

    def begin(self, t: Nanos, state: int, *, runs: bool) -> None:
        """Enter closed loop or begin a procedure, if it `runs`; else be idle."""
        if state == CLOSED_LOOP and runs:
            self.servo.start()
        self.procedure = state if runs and state != CLOSED_LOOP else 0
        self.procedure_until = t + milliseconds(self.settings.procedure_ms)
        self.memory.set_state(state if runs else table.IDLE)

    def end(self) -> None:
        """End a procedure as it should."""
        self.calibrated |= self.procedure in (table.FULL_CALIBRATION, table.OFFSET_CALIBRATION)
        self.procedure = 0

    def calibrated_for(self, state: int) -> bool:
        """True if it is calibrated, or a state calibrates it."""
        first = (table.FULL_CALIBRATION, table.MOTOR_CALIBRATION, table.OFFSET_CALIBRATION)
        return self.calibrated or state in first

    # -- what both do ---------------------------------------------------------------------------------

    def word(self, word: errors.Word) -> int:
        """Return the bits of an error word."""
        return self.words.get(word.base, 0)

    def trip(self, code: int) -> None:
        """Raise an error, which stays until Clear_Errors; the axis disarms."""
        base = code >> errors.BASE_SHIFT << errors.BASE_SHIFT
        self.words[base] = self.words.get(base, 0) | code - base
        self.on_trip()
        self.procedure = 0

    def on_timeout(self) -> None:
        self.trip(self.raised["WATCHDOG_TIMER_EXPIRED"])

    def restart_with(
        self, t: Nanos, node: int, gains: Mapping[str, float], endpoints: Mapping[int, int]
    ) -> None:
        """Restart with what was saved: silent at first, and disarmed."""
        self.use(used(self.device.options, self.device.settings, endpoints))
        self.restart(t, milliseconds(self.settings.reboot_ms))
        self.memory = memory(self.device, node, endpoints)
        # An absolute encoder knows its position within one turn only.
        self.servo = Servo(self.settings, gains, math.floor(self.servo.encoder.shaft))
        self.words.clear()
        self.procedure = 0

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        decoded = self.table.decode_once(frame)
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
                state = values["Axis_Requested_State"]
                if state == CLOSED_LOOP and self.memory.fault:
                    self.trip(self.raised[self.memory.fault])
                return self.request_state(t, state)
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
                self.servo.configure(zip(GAINS[name], values.values(), strict=True))
        after = copy.copy(self.memory)
        after.obey(decoded)
        if after.fault and (self.memory.armed or after.trips):
            self.trip(self.raised[after.fault])
            self.memory.obey(decoded)
        else:
            self.memory = after
        if name == "Set_Controller_Mode" and self.memory.position is None:
            self.servo.enter()
        return None

    def cyclic(self) -> Mapping[str, Nanos]:
        return self._periods

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        self.servo.encoder.measure(dt or 1.0, position / math.tau, velocity / math.tau)
        for name in self.servo.cycle(dt, self.memory) if dt else ():
            self.trip(self.raised[name])
        if self.procedure and now >= self.procedure_until:
            self.end()
        return self.servo.stage.torque if self.memory.armed else 0.0

    def report(self, name: str) -> Frame | None:
        fields = self._fields.get(name)
        if fields is None:
            row = self.table.row("Address reply" if name == "Address" else name)
            fields = self._fields[name] = row.name, [field.name for field in row.fields if field.name]
        signals, (message, names) = self.signals(), fields
        try:
            values = {each: signals[each] for each in names}
        except KeyError:  # a message that it does not send
            return None
        return self.table.encode(message, self.memory.node, **values)


class Twin06(OdriveTwin):
    """One device of firmware 0.6.x."""

    faults = errors.DEVICE06
    # 0.6.x has no errors of its own for these: assumed.
    raised = errors.ERRORS.bits | dict.fromkeys(INPUT_FAULTS, errors.ERRORS.bits["BAD_CONFIG"])
    # (odriverobotics/ODriveResources@fdb25dd `examples/can_watchdog.py`)
    feeds: tuple[str, ...] = ("Set_Input_Pos", "Set_Input_Vel", "Set_Input_Torque", "Set_Axis_State")

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self.result = errors.SUCCESS
        self.starts_until: Nanos = 0  # It reports INITIALIZING until then.
        self._flash = (self.memory.node, gains_of(self.settings), dict(self.memory.endpoints))
        """Node id, gains and endpoints as saved."""
        self._version = [int(part) for part in firmware_of(device).split(".")]
        version = (2, getattr(self.settings, "hw_line", 0), 1, 0, *self._version, 0)
        self._versions = dict(zip(table.VERSION_SIGNALS, version, strict=True))

    def timeout(self) -> Nanos:
        return self.watchdog if self.memory.armed else 0

    def on_request(self, t: Nanos, name: str, address: int) -> None:
        """Reply; discovery is on the broadcast node, and all that a device without an address answers."""
        discovery = name == "Address" and address == BROADCAST
        if discovery or address != BROADCAST:
            super().on_request(t, name, self.memory.node if discovery else address)

    def on_message(self, t: Nanos, decoded: Decoded) -> None:
        super().on_message(t, decoded)
        if decoded.name.startswith("RxSdo"):
            self._on_endpoint(t, decoded.values["Endpoint_ID"], written=decoded.name == "RxSdo")

    def _on_endpoint(self, t: Nanos, number: int, *, written: bool) -> None:
        """Reply with what an endpoint holds; before 0.6.11 not to a write. A setting that is known here takes
        effect at once; what else is written is kept, and nothing more."""
        registers, held = self.memory.registers, self.memory.endpoints.get(number, 0)
        name, value = registers.value(number, held)
        gain = SETTING_OF.get(name, name.rpartition(".")[2])
        if gain in self.servo.gains and written and value is not None:
            self.servo.configure([(gain, value)])
        elif written and name in SETTING_OF:
            self.use(used(self.device.options, self.device.settings, self.memory.endpoints))
        elif gain in self.servo.gains:
            held = registers.raw(name, self.servo.gains[gain])
        if not written or self._version >= [0, 6, 11]:
            self.reply(t, self.table.encode("TxSdo", self.memory.node, Endpoint_ID=number, Value=held))

    def report(self, name: str) -> Frame | None:
        """A device without an address sends nothing by itself."""
        return super().report(name) if name == "Address" or self.memory.node != BROADCAST else None

    def request_state(self, t: Nanos, state: int) -> None:
        results, was_armed = errors.RESULTS.bits, self.memory.armed
        if state == table.UNDEFINED or (state == CLOSED_LOOP and was_armed):
            return
        wanted = state in (CLOSED_LOOP, *table.PROCEDURES) and state != table.HOMING
        refused = "DISARMED" if self.active() else "" if self.calibrated_for(state) else "NOT_CALIBRATED"
        if wanted and refused:
            self.result = results[refused]
            self.disarm_reason = self.active() or self.disarm_reason
        elif wanted:
            self.result, self.disarm_reason = errors.BUSY, 0
        elif state == table.IDLE:
            ended = errors.SUCCESS if was_armed else self.result
            self.result = results["CANCELLED"] if self.procedure else ended
        else:
            self.result = results["HOMING_WITHOUT_ENDSTOP" if state == table.HOMING else "INVALID_STATE"]
        self.begin(t, state, runs=wanted and not refused)

    def end(self) -> None:
        super().end()
        self.result = errors.SUCCESS

    def on_trip(self) -> None:
        if self.memory.armed or self.procedure:
            self.memory.disarm()
            self.disarm_reason, self.result = self.active(), errors.RESULTS.bits["DISARMED"]

    def erased_node(self) -> int:
        """Return the node id of an axis whose configuration is erased: none."""
        return BROADCAST

    def reboot(self, t: Nanos, action: int) -> None:
        if action == table.SAVING:
            self._flash = (self.memory.node, dict(self.servo.gains), dict(self.memory.endpoints))
        elif action == table.ERASE:
            delivered = type(self.settings)()
            self._flash = (self.erased_node(), gains_of(delivered), saved(self.device.options, delivered))
        self.restart_with(t, *self._flash)
        self.starts_until = self.silent_until + milliseconds(self.settings.initializing_ms)
        self.silent_until = NEVER if action == table.BOOT_LOADER else self.silent_until
        self.disarm_reason, self.result = 0, errors.SUCCESS

    def active(self) -> int:
        """Return the bits of all errors, INITIALIZING among them."""
        return self.word(errors.ERRORS) | errors.INITIALIZING * ((self.now or 0) < self.starts_until)

    def signals(self) -> Values:
        servo, stage, active = self.servo, self.servo.stage, self.active()
        signals = super().signals()
        signals |= self._versions
        if self.memory.node <= BROADCAST:  # there is one byte for it
            signals |= {"Node_ID": self.memory.node, "Serial_Number": self.memory.serial, "Connection_ID": 0}
        signals |= {
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
        return signals


NEW_PROCEDURES = (14, 15, 16)  # States that 0.5.x does not have.
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

    faults: Mapping[int, FaultInfo] = errors.DEVICE05
    raised = (
        {name: errors.AXIS.code(name) for name in ("WATCHDOG_TIMER_EXPIRED", "ESTOP_REQUESTED")}
        | {name: errors.MOTOR.code(name) for name in ("CURRENT_LIMIT_VIOLATION", NOT_A_NUMBER)}
        | {name: errors.CONTROLLER.code(name) for name in ("SPINOUT_DETECTED", *INPUT_FAULTS[:2])}
        | {"VELOCITY_LIMIT_VIOLATION": errors.CONTROLLER.code("OVERSPEED")}
        | {"MOTOR_OVER_TEMP": errors.MOTOR.code("MOTOR_THERMISTOR_OVER_TEMP")}
        | {"INVERTER_OVER_TEMP": errors.MOTOR.code("FET_THERMISTOR_OVER_TEMP")}
        | {name: _SUPPLY for name in errors.ERRORS.bits if name.startswith("DC_BUS_")}
    )

    def timeout(self) -> Nanos:
        """It runs in every state; once expired there is nothing left to do."""
        expired = self.word(errors.AXIS) & errors.AXIS.bits["WATCHDOG_TIMER_EXPIRED"]
        return 0 if expired else self.watchdog

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
        wanted = state in (CLOSED_LOOP, *table.PROCEDURES) and state not in NEW_PROCEDURES
        if state == table.HOMING:
            self.trip(axis.code("HOMING_WITHOUT_ENDSTOP"))
        elif wanted and self.calibrated_for(state):
            self.feed(t)
        elif state not in (table.IDLE, table.STARTUP):
            self.trip(axis.code("INVALID_STATE"))
        self.begin(t, state, runs=wanted and not self.word(axis))

    def reboot(self, t: Nanos, action: int) -> None:
        """What was set over CAN cannot be saved over CAN: the node id, too, is as configured again."""
        self.restart_with(t, self.device.address, gains_of(self.settings), {})

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
