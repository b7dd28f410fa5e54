"""The device's end: what a motor obeys, and its firmware.

Rules. Each frame to it is answered (but for a reset), and feeds its watchdog. A set-point starts it, there
is no word that enables it. What the loops inside do, how long a restart takes and when faults pass is ours.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from protocols import messages as msg
from protocols.asked import waiting
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Nanos, Obeyed
from protocols.myactuator import table as rmd
from protocols.myactuator.options import Options, Settings
from protocols.plugin import Device
from protocols.toolkit.firmware import ServoFirmware, milliseconds
from protocols.toolkit.mit import commanded
from protocols.toolkit.servo import Gains
from protocols.toolkit.table import Decoded, Table, Values

TURN = 2.0 * math.pi
GAINS = dict(zip(rmd.GAINS, (85, 25) * 3, strict=True))
"""As delivered: the manual's example."""
RUNNING = {msg.Torque: 1, msg.Velocity: 2, msg.Position: 3}
"""The loop that runs, by what it is sent."""
BOOT, PASSES = 300 * MILLISECOND, 500 * MILLISECOND
"""How long a restart takes, and after which time a fault of level 2 passes."""


@dataclass(slots=True)
class Memory:
    """What a motor keeps of the frames that it received: whether its brake is open."""

    name: str
    address: int
    options: Options
    released: bool
    zeroed: bool = False
    """It is zero where it stands, from the next start on."""

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Return what the motor does on this message."""
        name, values = self.name, decoded.values
        if decoded.address != self.address and not decoded.name.endswith("every id"):
            return ()
        match decoded.name:
            case "set id" | "set every id":
                self.address = values["id"] & 0x3F
                return (msg.SetAddress(name, values["id"]),)
            case "shutdown":
                return (msg.Idle(name),)
            case "reset":
                self.lock()
                zeroed, self.zeroed = (msg.Zero(name),) if self.zeroed else (), False
                return msg.Idle(name), msg.ClearFault(name), *zeroed
            case "release brake":
                self.released = True
                return (msg.Kept(name, "release brake", 1.0),)
            case written if written in rmd.WRITTEN:
                self.zeroed = self.zeroed or written == "zero here"
                return (msg.Kept(name, written, float(values.get("value", 0))),)
            case "lock brake" if self.options.brake:
                self.lock()
                return (msg.Idle(name),)
            case "torque" if not self.released:  # alone of all set-points it does not open the brake
                return waiting(msg.Torque(name, values["value"] * self.options.torque_constant))
        self.released = self.released or decoded.name in ("motion", *rmd.SET_POINTS)
        match decoded.name:
            case "stop":
                return msg.Arm(name), msg.Hold(name)
            case "torque":
                return msg.Arm(name), msg.Torque(name, values["value"] * self.options.torque_constant)
            case "speed":
                return msg.Arm(name), msg.Velocity(name, math.radians(values["value"]))
            case "position" | "single turn" | "increment":  # the last from where it stands
                goal = msg.Position(name, math.radians(values["position"]))
                own = decoded.name == "position" and values["fastest"] == self.options.fastest
                # Never sent here: beside it, what is unusual.
                other = () if own else (msg.Kept(name, decoded.name, float(values["fastest"])),)
                return msg.Arm(name), *other, goal
            case "motion":
                return msg.Arm(name), commanded(name, values)
        return ()

    def lock(self) -> None:
        """Lock the brake, if it has one."""
        self.released = not self.options.brake


def memory_of(device: Device) -> Memory:
    """Return that of a motor."""
    return Memory(device.name, device.address, device.options, not device.options.brake)


class RmdTwin(ServoFirmware):
    """One motor."""

    faults = rmd.FAULTS
    passing = PASSES

    def __init__(self, device: Device, seed: int) -> None:
        settings: Settings = device.settings
        super().__init__(device, seed, Gains(torque_limit=settings.torque_limit))
        self.memory = memory_of(device)
        self.table: Table = device.options.table
        self.watchdog = settings.timeout_ms
        self.gains = self.servo.gains
        self.loops = dict(GAINS)
        self.accelerations = [settings.acceleration] * 4
        """Degrees per second²: of the way to a position up and down, of a speed up and down"""
        self.zero: float | None = None
        """rad of the shaft where its zero is from its next start on"""

    # -- watchdog, faults and brake -------------------------------------------------------------------

    def timeout(self) -> Nanos:
        return milliseconds(self.watchdog) if self.mode is msg.Mode.ARMED else 0

    def on_timeout(self) -> None:
        self.disarm()
        self.memory.lock()

    # -- messages -------------------------------------------------------------------------------------

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        decoded, memory = self.table.decode_once(frame), self.memory
        if decoded is None or not decoded.name:
            return
        name, values, all_of_them = decoded.name, decoded.values, decoded.name.endswith("every id")
        if decoded.address != memory.address and not all_of_them:
            return
        here, does = self.encoder.position, memory.obey(decoded)
        if name == "reset":
            self.restart(t, BOOT)
            if self.zero is not None:
                self.encoder.set_position(self.encoder.shaft - self.zero)
            return
        for obeyed in does:
            if name == "increment" and isinstance(obeyed, msg.Position):
                obeyed = msg.Position(memory.name, here + obeyed.position)
            self.obey(t, obeyed)
        if name in rmd.SET_POINTS:
            self.fastest = math.radians(values.get("fastest", 0)) or math.inf
            up, down = self.accelerations[2:] if name == "speed" else self.accelerations[:2]
            self.speed_up, self.slow_down = math.radians(up), math.radians(down)
        self.feed(t)
        self._write(name, values)
        self.reply(t, self._answer(t, name.replace("every id", "id"), values))

    def _write(self, name: str, values: Values) -> None:
        """Keep what is written; its zero counts from the next start on."""
        match name:
            case "set timeout":
                self.watchdog = values["value"]
            case "set acceleration" if values["index"] < len(self.accelerations):
                self.accelerations[values["index"]] = values["value"]
            case "set gains" | "store gains":
                self.loops = {loop: values[loop] for loop in GAINS}
                shares = (values[loop] / GAINS[loop] for loop in ("position_kp", "speed_kp", "speed_ki"))
                self.servo.tune(self.gains.scaled(*shares))
            case "set zero":
                self.zero = values["value"] * TURN / rmd.COUNTS
            case "zero here":
                self.zero = self.encoder.shaft

    def _answer(self, t: Nanos, name: str, values: Values) -> Frame:
        settings, encoder, address = self.settings, self.encoder, self.memory.address
        current = self.torque / self.memory.options.torque_constant
        shaft, turned = round(encoder.shaft / TURN * rmd.COUNTS), round(encoder.offset / TURN * rmd.COUNTS)
        measured = {
            "temperature": round(settings.temperature),
            "current": current,
            "velocity": round(math.degrees(encoder.velocity)),
            "angle": round(math.degrees(encoder.position)),
        }
        state = {
            "temperature": measured["temperature"],
            "released": int(self.memory.released),
            "voltage": settings.supply,
            "errors": 0x0400 if self.fault == rmd.UNKNOWN else self.fault,
        }
        numbers: Mapping[str, Mapping[str, Any]] = {
            "motion": {"motor": address, **self.measured()},
            **dict.fromkeys(rmd.WRITTEN, values),
            "zero here": {"value": shaft},
            "set id": {"reading": 0, "id": values.get("id", 0)},
            "read id": {"reading": 1, "id": 0x240 | address},
            "read angle": {"position": math.degrees(encoder.position)},
            "read status 1": state,
            "read status 2": measured,
            "read runtime": {"ms": (t - self.silent_until) // MILLISECOND & 0xFFFFFFFF},
            "read version": {"date": settings.version},
            "read status 3": {
                "temperature": measured["temperature"],
                **{f"phase_{n}": current * share for n, share in (("a", 1.0), ("b", -0.5), ("c", -0.5))},
            },
            "read gains": self.loops,
            "read acceleration": {"index": 0, "value": self.accelerations[0]},
            "read encoder": {"counts": shaft - turned},
            "read raw encoder": {"counts": shaft},
            "read zero": {"counts": turned},
            "read operating mode": {
                "running": RUNNING.get(type(self.goal), 0) * (self.mode is msg.Mode.ARMED)
            },
            "read power": {"watts": abs(self.torque * encoder.velocity)},
            "read turn encoder": {
                f"{n}_counts": each % rmd.COUNTS
                for n, each in (("zeroed", shaft - turned), ("raw", shaft), ("zero", turned))
            },
            "read turn angle": {"degrees": math.degrees(encoder.position) % 360.0},
            "read model": {"text": int.from_bytes(rmd.MODEL, "little")},
            **dict.fromkeys(rmd.SET_POINTS, measured),
        }
        answer = name.removeprefix("read ") if name.startswith("read ") else f"{name} reply"
        answer = "id" if name == "set id" else answer
        return self.table.encode(answer, address, **numbers.get(name, {}))
