"""The twin: one moteus, its registers, its console and its replies (README, "The twin").

Rules. The decoder's `CommandState` decides what is obeyed, `Servo` what the motor then does; here replies are
made. A frame is executed from left to right, and its queries are replied to as things are before the command
in it takes effect. Only frames with the reply bit get a reply, `reply_delay_us` later and at the earliest
with the next step. Queries do not feed the watchdog. Before its first step the device has not started, and
receives nothing. Time is an argument; a generated UUID comes from address and seed.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence

from protocols.frames import CanFrame, Frame
from protocols.messages import SECOND, Event, Feedback, Nanos, Torque, seconds
from protocols.moteus import codec
from protocols.moteus.codec import F32, INT32, Console, Error, Query, Raw, Subframe, Values
from protocols.moteus.decoder import DEFAULTS, SHADOWS, UNKNOWN, command_state, effective, is_addressed
from protocols.moteus.faults import FAULTS, TIMEOUT
from protocols.moteus.options import Settings, firmware_number, uuid_of
from protocols.moteus.registers import Mode, Register
from protocols.moteus.servo import WATCHDOG_MODES, Servo
from protocols.plugin import Device

MAX_REPLY = 64
"""Bytes of a reply: what does not fit is left out."""
MAX_CONSOLE = 512
"""Bytes of console output that are kept, ..."""
MAX_CONSOLE_REPLY = 48
"""... and of one poll."""
INT32_ONLY = frozenset(
    {Register.MODEL_NUMBER, Register.FIRMWARE_VERSION, Register.REGISTER_MAP_VERSION}
    | {Register.SERIAL_NUMBER1, Register.SERIAL_NUMBER2, Register.SERIAL_NUMBER3}
    | {Register.UUID1, Register.UUID2, Register.UUID3, Register.UUID4}
)


class MoteusTwin:
    """One device. Its state is plain data."""

    def __init__(self, device: Device, seed: int) -> None:
        settings: Settings = device.settings
        self.device = device
        self.settings = settings
        self.uuid = uuid_of(device, seed)
        self.state = command_state(device, self.uuid)
        self.servo = Servo(settings, dict(DEFAULTS))
        self._now: Nanos | None = None
        self._shaft = (0.0, 0.0)
        """rad, rad/s"""
        self._replies: list[tuple[Nanos, CanFrame]] = []
        """Replies and when they are due."""
        self._console = b""
        """Console output that was not polled yet."""

    # -- receiving ----------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Execute a frame and prepare the reply; what is not for this device changes nothing."""
        if self._now is None or not isinstance(frame, CanFrame) or not is_addressed(self.state, frame):
            return
        commanded, out = False, list[Subframe]()
        subframes, uuid_fits = effective(self.state, frame.data)
        for subframe in subframes:
            match subframe:
                case Values():
                    commanded |= self._write(subframe, out)
                case Query():
                    self._read(subframe, out)
                case Console(channel=1):
                    self._console_subframe(subframe, out)
        if commanded:
            self.servo.take(self.state.mode, dict(self.state.command))
        if frame.id & codec.REPLY_BIT and uuid_fits:
            self._reply(t, frame.id >> 8 & 0x7F, out)

    def _write(self, subframe: Values, out: list[Subframe]) -> bool:
        """Write registers. Returns True if the mode is among them: that begins a command."""
        commanded = False
        for register, raw in enumerate(subframe.raw, subframe.start):
            value = codec.from_raw(register, subframe.resolution, raw)
            number = self.state.write(register, value)
            if number:
                out.append(Error(codec.WRITE_ERROR, register, number))
                continue
            commanded |= register == Register.MODE
            self._act(register, value)
        return commanded

    def _act(self, register: int, value: float | None) -> None:
        if register in (Register.SET_OUTPUT_EXACT, Register.SET_OUTPUT_NEAREST) and value is not None:
            self.servo.set_output(value)
        elif register == Register.RECAPTURE_POSITION_VELOCITY:
            self.servo.recapture()
        elif register == Register.REQUIRE_REINDEX:
            self.servo.home_state = 0

    def _read(self, subframe: Query, out: list[Subframe]) -> None:
        """Reply neighbouring registers in one subframe, and an error for each that cannot be read."""
        run, start = list[Raw](), subframe.start
        for register in range(subframe.start, subframe.start + subframe.count):
            value = self.read(register, subframe.resolution)
            if value is None:
                if run:
                    out.append(Values(codec.REPLY, start, subframe.resolution, tuple(run)))
                run, start = [], register + 1
                out.append(Error(codec.READ_ERROR, register, UNKNOWN))
            else:
                run.append(value)
        if run:
            out.append(Values(codec.REPLY, start, subframe.resolution, tuple(run)))

    def _reply(self, t: Nanos, host: int, subframes: Sequence[Subframe]) -> None:
        data = b""
        for subframe in subframes:
            piece = codec.encode(subframe)
            if len(data) + len(piece) > MAX_REPLY:
                break
            data += piece
        identifier = codec.reply_id(self.state.address, host, self.state.prefix)
        frame = codec.make_frame(identifier, data)
        self._replies.append((t + self.settings.reply_delay_us * 1000, frame))

    def _console_subframe(self, subframe: Console, out: list[Subframe]) -> None:
        if subframe.code == codec.TO_DEVICE:
            for line in self.state.console_lines(subframe.data):
                self._console = (self._console + self._execute(line))[-MAX_CONSOLE:]
        elif subframe.code == codec.POLL:
            most = min(subframe.most, MAX_CONSOLE_REPLY)
            data, self._console = self._console[:most], self._console[most:]
            out.append(Console(codec.FROM_DEVICE, subframe.channel, data))

    def _execute(self, line: str) -> bytes:
        """Execute a console line. Returns its output."""
        if self.state.set_id(line) or line == "conf write":
            return b"OK\r\n"
        if line == "conf get id.id":
            return f"{self.state.address}\r\n".encode("ascii")
        return b"ERR unknown command\r\n"

    # -- registers ----------------------------------------------------------------------------

    def read(self, register: int, resolution: int) -> Raw | None:
        """Return the encoded value of a register; None if it cannot be read at this resolution."""
        if register in INT32_ONLY:
            return self._identity(register) if resolution == INT32 else None
        quantity = _QUANTITIES.get(register)
        if quantity is not None:
            value = quantity(self)
        else:
            command = self.state.command.get(SHADOWS.get(register, register))
            if command is None:
                return None
            value = command
        if not math.isfinite(value):
            return math.nan if resolution == F32 else codec.NOT_GIVEN[resolution]
        return codec.to_raw(register, resolution, value)

    def _identity(self, register: int) -> int:
        """Return a register of UUID, serial number, model or version."""
        if Register.UUID1 <= register <= Register.UUID4:
            return _int32(self.uuid, register - Register.UUID1)
        if Register.SERIAL_NUMBER1 <= register <= Register.SERIAL_NUMBER3:
            return _int32(self.uuid[::-1], register - Register.SERIAL_NUMBER1)
        if register == Register.MODEL_NUMBER:
            return self.settings.model
        if register == Register.FIRMWARE_VERSION:
            return firmware_number(self.settings)
        return self.settings.register_map

    def milliseconds(self) -> int:
        """Return the counter of register 0x070."""
        return (self._now or 0) // 1_000_000 % 2**15

    # -- time ---------------------------------------------------------------------------------

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Run the firmware up to `now`; the shaft's Feedback [rad, rad/s] is what the encoder measures."""
        for event in truth:
            if isinstance(event, Feedback) and event.motor == self.device.name:
                position = self._shaft[0] if event.position is None else event.position
                velocity = self._shaft[1] if event.velocity is None else event.velocity
                if math.isfinite(position) and math.isfinite(velocity):
                    self._shaft = (position, velocity)
        dt = 0.0 if self._now is None else seconds(max(0, now - self._now))
        first, self._now = self._now is None, now
        shaft, velocity = self._shaft[0] / math.tau, self._shaft[1] / math.tau
        if first:
            self.servo.measure(1.0, shaft, velocity)
        elif dt > 0.0:
            self.servo.measure(dt, shaft, velocity)
            self.servo.step(dt)
        due = [frame for at, frame in self._replies if at <= now]
        self._replies = [(at, frame) for at, frame in self._replies if at > now]
        return (Torque(self.device.name, self.servo.torque()),), due

    def due(self) -> Nanos | None:
        """Return when the next reply is due, or the watchdog expires."""
        times = [at for at, _ in self._replies]
        left = self.servo.timeout
        if self._now is not None and left is not None and self.servo.mode in WATCHDOG_MODES:
            times.append(self._now + round(left * SECOND) + 1)
        return min(times, default=None)

    def provoke(self, code: int) -> None:
        """Trip a fault. Raises ValueError for an unknown code."""
        if code not in FAULTS:
            raise ValueError(f"a moteus has no fault {code}; it has {', '.join(map(str, FAULTS))}")
        self.servo.stop_pending = False
        if code == TIMEOUT:
            self.servo.mode = Mode.TIMEOUT
        else:
            self.servo.trip(code)


def _int32(data: bytes, index: int) -> int:
    number: int = struct.unpack_from("<i", data, 4 * index)[0]
    return number


_QUANTITIES: dict[int, Callable[[MoteusTwin], float]] = {
    Register.MODE: lambda twin: twin.servo.mode,
    Register.POSITION: lambda twin: twin.servo.position,
    Register.VELOCITY: lambda twin: twin.servo.velocity,
    Register.TORQUE: lambda twin: twin.servo.torque(),
    Register.Q_CURRENT: lambda twin: twin.servo.iq,
    Register.D_CURRENT: lambda _: 0.0,
    Register.ABS_POSITION: lambda twin: twin.servo.shaft,
    Register.POWER: lambda twin: twin.servo.power,
    Register.MOTOR_TEMPERATURE: lambda _: 0.0,
    Register.TRAJECTORY_COMPLETE: lambda twin: float(twin.servo.setpoint.done),
    Register.HOME_STATE: lambda twin: twin.servo.home_state,
    Register.VOLTAGE: lambda twin: twin.servo.bus_voltage,
    Register.TEMPERATURE: lambda twin: twin.servo.temperature,
    Register.FAULT: lambda twin: twin.servo.fault_register(),
    Register.POSITION_KP: lambda twin: twin.servo.terms[0],
    Register.POSITION_KI: lambda twin: twin.servo.terms[1],
    Register.POSITION_KD: lambda twin: twin.servo.terms[2],
    Register.POSITION_FEEDFORWARD: lambda twin: twin.servo.command[Register.COMMAND_FEEDFORWARD_TORQUE],
    Register.POSITION_COMMAND: lambda twin: twin.servo.control_torque,
    Register.CONTROL_POSITION: lambda twin: (
        math.nan if twin.servo.setpoint.position is None else twin.servo.setpoint.position
    ),
    Register.CONTROL_VELOCITY: lambda twin: twin.servo.setpoint.velocity,
    Register.CONTROL_TORQUE: lambda twin: twin.servo.control_torque,
    Register.POSITION_ERROR: lambda twin: twin.servo.error,
    Register.VELOCITY_ERROR: lambda twin: twin.servo.velocity_error,
    Register.TORQUE_ERROR: lambda twin: twin.servo.torque() - twin.servo.control_torque,
    Register.ENCODER_0_POSITION: lambda twin: twin.servo.shaft,
    Register.ENCODER_0_VELOCITY: lambda twin: twin.servo.velocity,
    Register.ENCODER_VALIDITY: lambda _: 0x03,
    Register.MILLISECOND_COUNTER: lambda twin: twin.milliseconds(),
    Register.DRIVER_FAULT1: lambda _: 0.0,
    Register.DRIVER_FAULT2: lambda _: 0.0,
    Register.UUID_MASK_CAPABLE: lambda _: 1.0,
}
"""The quantities that change by themselves; command registers hold what was written."""
