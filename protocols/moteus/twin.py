"""The twin: one moteus, its registers, its console and its answers (README, "the twin").

Rules. The ear's `Axis` decides what is obeyed, `Servo` what the motor then does; here is what is told. A
frame is taken from left to right, and what it asks for is answered as things stand before the command in it
takes effect. Only frames with the reply bit are answered, `reply_delay_us` later and at the earliest at the
next step. Questions do not feed the watchdog. Before its first step it has not started, and hears nothing.
Time is an argument; a made-up UUID comes from address and seed.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence

from protocols.frames import CanFrame, Frame
from protocols.messages import SECOND, Event, Feedback, Nanos, Torque, seconds
from protocols.moteus.codec import (
    F32,
    FROM_DEVICE,
    INT32,
    POLL,
    READ_ERROR,
    REPLY,
    REPLY_BIT,
    TO_DEVICE,
    WRITE_ERROR,
    Ask,
    Error,
    Raw,
    Stream,
    Subframe,
    Values,
    encode,
    framed,
    quantity,
    raw_of,
    reply_id,
)
from protocols.moteus.decoder import DEFAULTS, SHADOWS, UNKNOWN, addressed, axis_of, effective, for_another
from protocols.moteus.faults import FAULTS, TIMEOUT
from protocols.moteus.options import Settings, firmware_number, uuid_of
from protocols.moteus.registers import Mode, Register
from protocols.moteus.servo import WATCHED, Servo
from protocols.plugin import Device

MOST = 64
"""Bytes of an answer: what does not fit is left out."""
CONSOLE_MOST = 512
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
        self.axis = axis_of(device, self.uuid)
        self.servo = Servo(settings, dict(DEFAULTS))
        self._now: Nanos | None = None
        self._shaft = (0.0, 0.0)
        self._answers: list[tuple[Nanos, CanFrame]] = []
        self._console = b""
        """What the console has to say."""

    # -- the wire -----------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> None:
        """A wire reached the device; what is not for it changes nothing."""
        if self._now is None or not isinstance(frame, CanFrame) or not addressed(self.axis, frame):
            return
        commanded, out = False, list[Subframe]()
        for subframe in effective(self.axis, frame.data):
            match subframe:
                case Values():
                    commanded |= self._write(subframe, out)
                case Ask():
                    self._read(subframe, out)
                case Stream():
                    self._stream(subframe, out)
        if commanded:
            self.servo.take(self.axis.mode, dict(self.axis.command))
        if frame.id & REPLY_BIT and not for_another(self.axis, frame.data):
            self._answer(t, frame.id >> 8 & 0x7F, out)

    def _write(self, subframe: Values, out: list[Subframe]) -> bool:
        """Whether a command began."""
        commanded = False
        for i, raw in enumerate(subframe.raw):
            register = subframe.start + i
            value = quantity(register, subframe.resolution, raw)
            number = self.axis.write(register, value)
            if number:
                out.append(Error(WRITE_ERROR, register, number))
                continue
            commanded |= register == Register.MODE
            self._act(register, value)
        return commanded

    def _act(self, register: int, value: float | None) -> None:
        if register in (Register.SET_OUTPUT_EXACT, Register.SET_OUTPUT_NEAREST) and value is not None:
            self.servo.call_position(value)
        elif register == Register.RECAPTURE_POSITION_VELOCITY:
            self.servo.recapture()
        elif register == Register.REQUIRE_REINDEX:
            self.servo.homed = 0

    def _read(self, subframe: Ask, out: list[Subframe]) -> None:
        """Neighbours are told together, as they were asked for; what cannot be told is an error each."""
        run, start = list[Raw](), subframe.start
        for register in range(subframe.start, subframe.start + subframe.count):
            value = self.report(register, subframe.resolution)
            if value is None:
                if run:
                    out.append(Values(REPLY, start, subframe.resolution, tuple(run)))
                run, start = [], register + 1
                out.append(Error(READ_ERROR, register, UNKNOWN))
            else:
                run.append(value)
        if run:
            out.append(Values(REPLY, start, subframe.resolution, tuple(run)))

    def _answer(self, t: Nanos, host: int, said: Sequence[Subframe]) -> None:
        data = b""
        for subframe in said:
            piece = encode(subframe)
            if len(data) + len(piece) > MOST:
                break
            data += piece
        identifier = reply_id(self.axis.address, host, self.axis.prefix)
        self._answers.append((t + self.settings.reply_delay_us * 1000, framed(identifier, data)))

    # -- the console ----------------------------------------------------------------------------

    def _stream(self, subframe: Stream, out: list[Subframe]) -> None:
        if subframe.channel != 1:
            return
        if subframe.code == TO_DEVICE:
            for line in self.axis.console(subframe.data):
                self._console = (self._console + self._typed(line))[-CONSOLE_MOST:]
        elif subframe.code == POLL:
            most = min(subframe.most, 48)
            said, self._console = self._console[:most], self._console[most:]
            out.append(Stream(FROM_DEVICE, subframe.channel, said))

    def _typed(self, line: str) -> bytes:
        if self.axis.renamed(line) or line == "conf write":
            return b"OK\r\n"
        if line == "conf get id.id":
            return f"{self.axis.address}\r\n".encode("ascii")
        return b"ERR unknown command\r\n"

    # -- what is told -----------------------------------------------------------------------------

    def report(self, register: int, resolution: int) -> Raw | None:
        """A register as it stands on the wire; None if it cannot be read so."""
        if register in INT32_ONLY:
            return self._number(register) if resolution == INT32 else None
        reports = _REPORTS.get(register)
        if reports is not None:
            return _reported(register, resolution, reports(self))
        command = self.axis.command.get(SHADOWS.get(register, register))
        return None if command is None else _reported(register, resolution, command)

    def _number(self, register: int) -> int:
        if Register.UUID1 <= register <= Register.UUID4:
            at = 4 * (register - Register.UUID1)
            word: int = struct.unpack_from("<i", self.uuid, at)[0]
            return word
        if Register.SERIAL_NUMBER1 <= register <= Register.SERIAL_NUMBER3:
            at = 4 * (register - Register.SERIAL_NUMBER1)
            part: int = struct.unpack_from("<i", self.uuid[::-1], at)[0]
            return part
        numbers = {
            Register.MODEL_NUMBER: self.settings.model,
            Register.FIRMWARE_VERSION: firmware_number(self.settings),
        }
        return numbers.get(Register(register), self.settings.register_map)

    def milliseconds(self) -> int:
        """The counter of register 0x070."""
        return (self._now or 0) // 1_000_000 % 2**15

    # -- time ---------------------------------------------------------------------------------

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Run the firmware up to `now`; the shaft's Feedback [rad, rad/s] is what the encoder sees."""
        for event in truth:
            self._see(event)
        dt = 0.0 if self._now is None else seconds(max(0, now - self._now))
        first, self._now = self._now is None, now
        shaft, velocity = self._shaft[0] / math.tau, self._shaft[1] / math.tau
        if first:
            self.servo.measure(1.0, shaft, velocity)
        elif dt > 0.0:
            self.servo.measure(dt, shaft, velocity)
            self.servo.step(dt)
        due = [frame for at, frame in self._answers if at <= now]
        self._answers = [(at, frame) for at, frame in self._answers if at > now]
        return (Torque(self.device.name, self.servo.torque()),), due

    def _see(self, event: Event) -> None:
        if isinstance(event, Feedback) and event.motor == self.device.name:
            position = self._shaft[0] if event.position is None else event.position
            velocity = self._shaft[1] if event.velocity is None else event.velocity
            if math.isfinite(position) and math.isfinite(velocity):
                self._shaft = (position, velocity)

    def due(self) -> Nanos | None:
        """When an answer goes out, or the watchdog expires."""
        times = [at for at, _ in self._answers]
        left = self.servo.timeout
        if self._now is not None and left is not None and self.servo.mode in WATCHED:
            times.append(self._now + round(left * SECOND) + 1)
        return min(times, default=None)

    def provoke(self, code: int) -> None:
        """The firmware trips this fault by itself."""
        if code not in FAULTS:
            raise ValueError(f"a moteus has no fault {code}; it has {', '.join(map(str, FAULTS))}")
        if code == TIMEOUT:
            self.servo.mode, self.servo.stopping = Mode.TIMEOUT, False
        else:
            self.servo.trip(code)
            self.servo.stopping = False


def _reported(register: int, resolution: int, value: float) -> Raw:
    """Rounded and saturated; what is not a number is "not given"."""
    if resolution == F32 and not math.isfinite(value):
        return math.nan
    return raw_of(register, resolution, value if math.isfinite(value) else None)


_REPORTS: dict[int, Callable[[MoteusTwin], float]] = {
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
    Register.HOME_STATE: lambda twin: twin.servo.homed,
    Register.VOLTAGE: lambda twin: twin.servo.bus_voltage,
    Register.TEMPERATURE: lambda twin: twin.servo.temperature,
    Register.FAULT: lambda twin: twin.servo.reply(),
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
"""The quantities that change by themselves; command registers are told as they were written."""
