"""The device's end: what a motor of a board obeys, and the board's firmware.

Rules. A twin is one motor; the two of a board receive the same messages, and the first of them answers (the
second, if it is alone). Any message to the board feeds its serial timeout, which ends what is commanded by
a duty of 0. What the loops inside do is ours; a duty is a share of the supply on the motor. A position that
is to wait behind what is under way is taken at once: the buffer is not simulated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Mode, Nanos, Obeyed
from protocols.plugin import Device, Twin
from protocols.roboclaw import table as rt
from protocols.roboclaw.driver import SAVE
from protocols.roboclaw.options import Options, Settings
from protocols.toolkit.firmware import ServoFirmware
from protocols.toolkit.serial import Stream
from protocols.toolkit.servo import Encoder, Gains, clamp
from protocols.toolkit.table import Decoded, Values

VERSION = "USB Roboclaw 2x15a v4.2.3\n"
FAULT_PASSES: Nanos = 500 * MILLISECOND
GAP: Nanos = rt.GAP_MS * MILLISECOND


@dataclass(slots=True)
class Line:
    """The bytes to the boards of a line, as every board reads them."""

    stream: Stream = field(default_factory=lambda: Stream(rt.Requests()))
    at: Nanos = 0

    def read(self, t: Nanos, frame: Frame) -> list[tuple[bytes, Decoded]]:
        """Return the messages that a frame completes: as they came, and decoded."""
        if not isinstance(frame, bytes):
            return []
        if t - self.at > GAP:
            self.stream.drop()
        self.at = t
        found = ((each, rt.PACKETS.decode(each, "to_device")) for each in self.stream.messages(frame))
        return [(each, decoded) for each, decoded in found if decoded is not None and decoded.name]


@dataclass(slots=True)
class Motor:
    """What a motor makes of a message; it keeps nothing of earlier ones."""

    name: str
    address: int
    options: Options
    settings: Settings

    @property
    def board(self) -> int:
        """Address of its board."""
        return rt.board_of(self.address)

    @property
    def side(self) -> int:
        """Which of its board's motors it is."""
        return rt.side_of(self.address)

    def own(self, decoded: Decoded) -> Values | None:
        """Return what of a message is for this motor; None: nothing."""
        numbers = [int(each) for each in decoded.name if each.isdigit()]
        if decoded.address != self.board or (numbers and self.side not in numbers):
            return None
        other = str(sum(rt.SIDES) - self.side)
        values = {name: value for name, value in decoded.values.items() if not name.endswith(other)}
        return {name.rstrip("12"): value for name, value in values.items()}

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Return what it does on a message."""
        own, name, unit = self.own(decoded), self.name, self.options.unit
        match own:
            case None:
                return ()
            case {"position": counts}:
                return msg.Arm(name), msg.Position(name, counts * unit)
            case {"duty": 0}:
                return (msg.Idle(name),)
            case {"duty": duty}:  # what a motor without load does at that voltage
                unloaded = duty / rt.FULL * self.settings.supply / self.settings.torque_constant
                used = msg.Kept(name, decoded.name, duty / rt.FULL)
                return used, msg.Arm(name), msg.Velocity(name, unloaded)
            case {"speed": speed} if decoded.name not in rt.QUESTIONS:
                return msg.Arm(name), msg.Velocity(name, speed * unit)
            case {"timeout": timeout}:
                return (msg.WriteParameter(name, "timeout", float(timeout)),)
            case {"qpps": _}:
                return tuple(msg.WriteParameter(name, key, float(value)) for key, value in own.items())
            case {"key": key}:
                return (msg.WriteParameter(name, SAVE, 1.0),) if key == rt.NVM_KEY else ()
            case {"count": 0}:
                return (msg.Zero(name),)
            case {"count": count}:
                return (msg.Kept(name, decoded.name, float(count)),)
        match decoded.name:
            case "RESETENC":
                return (msg.Zero(name),)
            case "RESETESTOP":
                return (msg.ClearFault(name),)
        return ()


def motor_of(device: Device) -> Motor:
    """Return a motor as it is when its board is switched on."""
    return Motor(device.name, device.address, device.options, device.settings)


class RoboclawDecoder:
    """The motors of one line, as receivers of commands."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._line = Line()
        self._motors = [motor_of(device) for device in devices]

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what the motors would obey in this frame; [] if nothing."""
        found = [decoded for _, decoded in self._line.read(t, frame)]
        return [each for decoded in found for motor in self._motors for each in motor.obey(decoded)]


class RoboclawTwin(ServoFirmware):
    """One motor, and its half of the board."""

    faults = rt.FAULTS
    passing = FAULT_PASSES

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed, Gains(torque_limit=device.settings.max_torque))
        self.memory = motor_of(device)
        self.line = Line()
        self.encoder = Encoder(1.0 / device.options.unit, bandwidth=1000.0)
        self.pid: Values = {name: getattr(device.settings, name) for name in rt.PID}
        self.serial_timeout: int = device.settings.timeout
        self.duty: float | None = None
        """The share of the supply on the motor, if that is commanded."""
        self.other: RoboclawTwin | None = None
        """The other motor of the board."""

    def join(self, others: Sequence[Twin]) -> None:
        """Find the other motor of the board among the twins of its line."""
        mine = self.memory.board, sum(rt.SIDES) - self.memory.side
        twins = [each for each in others if isinstance(each, RoboclawTwin)]
        self.other = next((each for each in twins if (each.memory.board, each.memory.side) == mine), None)

    # -- serial timeout and faults --------------------------------------------------------------------

    def timeout(self) -> Nanos:
        timeout = self.serial_timeout * rt.TIMEOUT_UNIT_MS * MILLISECOND
        return timeout if self.mode is Mode.ARMED else 0

    def on_timeout(self) -> None:
        self.disarm()

    def provoke(self, code: int) -> None:
        super().provoke(code)
        if self.other is not None and not code & rt.OF_MOTOR:
            self.other.trip(code)

    # -- messages -------------------------------------------------------------------------------------

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        for message, decoded in self.line.read(t, frame):
            if decoded.address != self.memory.board:
                continue
            self.feed(t)
            own = self.memory.own(decoded)
            for obeyed in self.memory.obey(decoded):
                if isinstance(obeyed, msg.Zero):  # while it is driven, too
                    self.encoder.set_position(0.0)
                self.obey(t, obeyed)
            if own is not None and decoded.name not in rt.QUESTIONS:
                self._take(own)
            if self.other is None or self.memory.side == 1:
                self.reply(t, self._answer(message, decoded.name))

    def _take(self, own: Values) -> None:
        """Take over what is no command of its own: timeout, gains, duty, and the path to a position."""
        unit = self.device.options.unit
        self.serial_timeout = own.get("timeout", self.serial_timeout)
        if "qpps" in own:
            self.pid = own
        if "duty" in own or "speed" in own or "position" in own:
            self.duty = own["duty"] / rt.FULL if "duty" in own else None
            self.speed_up = own.get("accel", 0) * unit or math.inf
            self.slow_down = own.get("deccel", own.get("accel", 0)) * unit or math.inf
            self.fastest = (
                own["speed"] * unit if "position" in own and "speed" in own else self.pid["qpps"] * unit
            )
        if own.get("count"):
            count = own["count"]
            self.encoder.set_position((count - (count >> 31 << 32)) * unit)

    def _answer(self, message: bytes, name: str) -> bytes:
        if not rt.is_question(message):
            return rt.ACK
        if name == "GETVERSION":
            return rt.version(message, VERSION)
        first, second = (self, self.other) if self.memory.side == 1 else (self.other, self)
        if name == "GETERROR" and self.settings.older_status:
            return rt.older_status(message, rt.older(_status(first, second)))
        asked = second if "2" in name.removesuffix("TEMP2") else first
        one = asked or self
        values: dict[str, Any] = {
            "timeout": self.serial_timeout,
            "voltage": self.settings.supply,
            "temperature": self.settings.temperature,
            "status": _status(first, second) if name == "GETERROR" else one.backwards << 1,
            "count": one.counted,
            "speed": one.turning,
            "backwards": one.backwards,
            **one.pid,
            "buffer1": 0x80,
            "buffer2": 0x80,
        }
        for side, each in ((1, first), (2, second)):
            measured = (
                (0, 0.0, 0, 0) if each is None else (each.put, each.current, each.counted, each.turning)
            )
            values |= zip(
                (f"duty{side}", f"current{side}", f"count{side}", f"speed{side}"), measured, strict=True
            )
        fields = rt.ANSWERS.row(name).fields
        return rt.answer(message, name, **{each.name: values[each.name] for each in fields})

    # -- measured -------------------------------------------------------------------------------------

    @property
    def counted(self) -> int:
        """Its encoder's count, in 32 bits."""
        return round(self.encoder.position * self.encoder.counts) % (1 << 32)

    @property
    def turning(self) -> int:
        """counts/s"""
        return round(self.encoder.velocity * self.encoder.counts)

    @property
    def backwards(self) -> bool:
        """It turns backwards."""
        return self.turning < 0

    @property
    def current(self) -> float:
        """A"""
        constant: float = self.settings.torque_constant
        return self.torque / constant

    @property
    def put(self) -> int:
        """The duty that is put on the motor."""
        if self.mode is not Mode.ARMED:
            return 0
        if self.duty is not None:
            return round(self.duty * rt.FULL)
        voltage = (
            self.current * self.settings.resistance + self.encoder.velocity * self.settings.torque_constant
        )
        return round(clamp(voltage / self.settings.supply, 1.0) * rt.FULL)

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        torque = super().cycle(now, dt, position, velocity)
        if self.duty is None or self.mode is not Mode.ARMED:
            return torque
        self.servo.reset()
        constant, settings = self.settings.torque_constant, self.settings
        current = (self.duty * settings.supply - constant * velocity) / settings.resistance
        return clamp(current * constant, self.servo.gains.torque_limit)


def _status(first: RoboclawTwin | None, second: RoboclawTwin | None) -> int:
    """Return the bits of the faults of both motors."""
    codes = (each.fault if each is not None else 0 for each in (first, second))
    status = 0
    for side, code in enumerate(codes):
        status |= code << side if code & rt.OF_MOTOR else code
    return status
