"""The device's end: what a motor of a board obeys, and the board's firmware.

Rules. A twin is one motor; the two of a board receive the same messages, and the first of them answers (the
second, if it is alone). Any message to the board feeds its serial timeout, which ends what is commanded by
a duty of 0. What the loops inside do is ours; a duty is a share of the supply on the motor. A position that
is to wait behind what is under way is taken at once: the buffer is not simulated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from protocols import messages as msg
from protocols.messages import MILLISECOND, Mode, Nanos, Obeyed
from protocols.plugin import Device, Twin
from protocols.roboclaw import table as rt
from protocols.roboclaw.options import Options, Settings
from protocols.toolkit.packets import PacketFirmware
from protocols.toolkit.servo import Encoder, Gains, clamp
from protocols.toolkit.table import Decoded, Values

VERSION = "USB Roboclaw 2x15a v4.2.3\n"
PACKET_SERIAL = 3
"""What `config` holds. What is written there is kept, and means nothing here."""
FAULT_PASSES: Nanos = 500 * MILLISECOND


@dataclass(slots=True)
class Motor:
    """What a motor makes of a message; it keeps nothing of earlier ones."""

    name: str
    address: int
    options: Options
    settings: Settings

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Return what it does on a message."""
        name, unit = self.name, self.options.unit
        own = rt.BOARDS.own(self.address, decoded)
        match own and rt.duty_of(own):
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
            case _ if own and own.keys() <= rt.PARAMETERS.keys():
                return tuple(msg.WriteParameter(name, key, float(value)) for key, value in own.items())
            case {"key": key}:
                return (msg.WriteParameter(name, rt.SAVE, 1.0),) if key == rt.NVM_KEY else ()
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


class RoboclawTwin(PacketFirmware):
    """One motor, and its half of the board."""

    faults = rt.FAULTS
    passing = FAULT_PASSES
    messages, gap = rt.PACKETS, rt.GAP

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed, Gains(torque_limit=device.settings.max_torque), motor_of(device))
        self.board, self.side = rt.BOARDS.board(device.address), rt.BOARDS.side(device.address)
        self.encoder = Encoder(1.0 / device.options.unit, bandwidth=1000.0)
        self.held: Values = {name: getattr(device.settings, name, 0) for name in rt.PARAMETERS}
        self.held[rt.CONFIG] = PACKET_SERIAL
        """Its parameters."""
        self.duty: float | None = None
        """The share of the supply on the motor, if that is commanded."""
        self.other: RoboclawTwin | None = None
        """The other motor of the board."""

    def join(self, others: Sequence[Twin]) -> None:
        """Find the other motor of the board among the twins of its line."""
        twins = [each for each in others if isinstance(each, RoboclawTwin) and each.board == self.board]
        self.other = next((each for each in twins if each.side != self.side), None)

    # -- serial timeout and faults --------------------------------------------------------------------

    def timeout(self) -> Nanos:
        timeout = self.held["timeout"] * rt.TIMEOUT_UNIT_MS * MILLISECOND
        return timeout if self.mode is Mode.ARMED else 0

    def on_timeout(self) -> None:
        self.disarm()

    def provoke(self, code: int) -> None:
        super().provoke(code)
        if self.other is not None and not code & rt.OF_MOTOR:
            self.other.trip(code)

    # -- messages -------------------------------------------------------------------------------------

    def takes(self, decoded: Decoded) -> bool:
        return decoded.address == self.board

    def on_message(self, t: Nanos, message: bytes, decoded: Decoded) -> None:
        self.feed(t)
        super().on_message(t, message, decoded)
        own = rt.BOARDS.own(self.device.address, decoded)
        if own is not None and decoded.name not in rt.QUESTIONS:
            self._take(rt.duty_of(own))
        if self.other is None or self.side == 1:
            self.reply(t, self._answer(message, decoded.name))

    def obey(self, t: Nanos, obeyed: Obeyed) -> None:
        if isinstance(obeyed, msg.Zero):  # while it is driven, too
            self.encoder.set_position(0.0)
        super().obey(t, obeyed)

    def _take(self, own: Values) -> None:
        """Take over what is no command of its own: timeout, gains, duty, and the path to a position."""
        unit = self.device.options.unit
        self.held |= {name: value for name, value in own.items() if name in self.held}
        if "duty" in own or "speed" in own or "position" in own:
            self.duty = own["duty"] / rt.FULL if "duty" in own else None
            self.speed_up = own.get("accel", 0) * unit or math.inf
            self.slow_down = own.get("deccel", own.get("accel", 0)) * unit or math.inf
            self.fastest = (
                own["speed"] * unit if "position" in own and "speed" in own else self.held["qpps"] * unit
            )
        if own.get("count"):
            count = own["count"]
            self.encoder.set_position((count - (count >> 31 << 32)) * unit)

    def _answer(self, message: bytes, name: str) -> bytes:
        if not rt.is_question(message):
            return rt.ACK
        if name == "GETVERSION":
            return rt.version(message, VERSION)
        first, second = (self, self.other) if self.side == 1 else (self.other, self)
        if name == "GETERROR" and self.settings.older_status:
            return rt.older_status(message, rt.older(_status(first, second)))
        one = (second if "2" in name.removesuffix("TEMP2") else first) or self
        values: dict[str, Any] = one.held | one.measured() | dict.fromkeys(("buffer1", "buffer2"), 0x80)
        values |= {"voltage": self.settings.supply, "temperature": self.settings.temperature}
        values["status"] = _status(first, second) if name == "GETERROR" else values["backwards"] << 1
        for side, each in ((1, first), (2, second)):
            measured = dict.fromkeys(values, 0) if each is None else each.measured()
            values |= {f"{what}{side}": value for what, value in measured.items()}
            values |= {f"{what}{side}": values[what] for what in ("voltage", "temperature")}
        fields = rt.ANSWERS.row(name).fields
        return rt.answer(message, name, **{each.name: values[each.name] for each in fields})

    # -- measured -------------------------------------------------------------------------------------

    def measured(self) -> dict[str, float]:
        """Return what it reports of its motion, by name."""
        settings, encoder = self.settings, self.encoder
        speed, current = round(encoder.velocity * encoder.counts), self.torque / settings.torque_constant
        voltage = current * settings.resistance + encoder.velocity * settings.torque_constant
        duty = clamp(voltage / settings.supply, 1.0) if self.duty is None else self.duty
        return {
            "count": round(encoder.position * encoder.counts) % (1 << 32),
            "speed": speed,
            "backwards": speed < 0,
            "duty": round(duty * rt.FULL) if self.mode is Mode.ARMED else 0,
            "current": current,
        }

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
    status = 0
    for at, each in enumerate((first, second)):
        code = 0 if each is None else each.fault
        status |= code << at if code & rt.OF_MOTOR else code
    return status
