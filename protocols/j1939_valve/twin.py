"""The device's end: what a valve obeys, its spool, and the cylinder that it moves.

Rules. A command feeds the time-out, after which the spool is let go to its middle. The spool follows with a
lag, and may stick: then it stays where it is, whatever is commanded. What flows moves the cylinder with no
more force than the relief valve lets; closed ports hold the load if they are tight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.frames import Frame
from protocols.j1939_valve import table as jt
from protocols.j1939_valve.options import Options
from protocols.messages import MILLISECOND, Mode, Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.firmware import ServoFirmware
from protocols.toolkit.servo import Gains, lag
from protocols.toolkit.table import Decoded

CLOSED = 1e-4
"""Share of its way at which a spool is in its middle"""


@dataclass(slots=True)
class Valve:
    """What a valve makes of a message; it keeps nothing of earlier ones."""

    name: str
    address: int
    options: Options

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Return what it does on a message."""
        if decoded.name == "address claimed":
            return (msg.Kept(self.name, "ADDRESS_CLAIM", float(decoded.values["host"])),)
        if decoded.name != "command" or decoded.address != self.address:
            return ()
        state, flow = decoded.values["state"], decoded.values["flow"]
        velocity = self.options.velocity(flow)
        match state:
            case jt.BLOCK:
                return (msg.Idle(self.name),)
            case jt.EXTEND | jt.RETRACT if flow <= jt.MOST:
                sign = -1.0 if state == jt.RETRACT else 1.0
                return msg.Arm(self.name), msg.Velocity(self.name, sign * velocity or 0.0)
            case jt.FLOAT:
                return msg.Kept(self.name, "FLOAT", 1.0), msg.Idle(self.name)
        return ()


def valve_of(device: Device) -> Valve:
    """Return a valve as it is when switched on."""
    return Valve(device.name, device.address, device.options)


class ValveTwin(ServoFirmware):
    """One valve, and its cylinder."""

    faults = jt.FAULTS

    def __init__(self, device: Device, seed: int) -> None:
        settings = device.settings
        super().__init__(device, seed, Gains(1.0, settings.stiffness, settings.oil, settings.force))
        self.options: Options = device.options
        self.memory = valve_of(device)
        self.passing = round(settings.fault_ms * MILLISECOND)
        self.spool = 0.0
        """Share of its way, to the side that extends"""
        self.opened = 0.0
        """The same as commanded"""
        self.sticks = False

    def stick(self) -> None:
        """Let the spool stick where it is."""
        self.sticks = True

    def obey(self, t: Nanos, obeyed: Obeyed) -> None:
        if isinstance(obeyed, msg.Arm):
            self.arm(t)  # what the oil carries stays
        else:
            super().obey(t, obeyed)

    def timeout(self) -> Nanos:
        return self.options.timeout_ms * MILLISECOND if self.mode is Mode.ARMED else 0

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        decoded = jt.TABLE.decode_once(frame)
        if decoded is None or decoded.name != "command" or decoded.address != self.device.address:
            return
        for obeyed in self.memory.obey(decoded):
            self.obey(t, obeyed)
            self.feed(t)
            side = -1.0 if decoded.values["state"] == jt.RETRACT else 1.0
            self.opened = side * min(decoded.values["flow"], jt.MOST) / jt.MOST

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        self.encoder.measure(dt or 1.0, position, velocity)
        settings, driven = self.settings, self.mode is Mode.ARMED
        if not self.sticks:
            wanted = self.opened if driven else 0.0
            share = lag(dt, 1000.0 / settings.lag_ms) if settings.lag_ms else 1.0
            self.spool += share * (wanted - self.spool)
        free = max(0.0, abs(self.spool) - settings.dead_band) / (1.0 - settings.dead_band)
        flows = self.options.full_flow * settings.flow * (free if self.spool > 0.0 else -free)
        if free <= CLOSED and not (driven or settings.tight):
            self.servo.reset()
            return 0.0
        return self.servo.turn(dt, flows, velocity)

    def cyclic(self) -> Mapping[str, Nanos]:
        period = round(self.options.feedback_ms * MILLISECOND)
        return {"estimated flow": period, "measured position": period}

    def report(self, name: str) -> Frame:
        at, ecu = self.device.address, self.options.ecu
        side = jt.RETRACT if self.opened < 0.0 else jt.EXTEND
        state = jt.ERROR if self.mode is Mode.FAULT else side if self.mode is Mode.ARMED else jt.BLOCK
        if name == "measured position":
            share = (self.encoder.position - self.options.retracted) / self.options.stroke
            raw = round(share / jt.STROKE)
            raw = raw if 0 <= raw <= jt.MOST_POSITION else 0xFFFF
            return jt.TABLE.encode(name, at, ecu=ecu, position=raw, state=state)
        flow = round((self.opened - jt.OFFSET) / jt.PERCENT)
        other = round((-self.opened - jt.OFFSET) / jt.PERCENT)
        values = {"extend": flow, "retract": other, "state": state, "fail_safe": 0, "limit": 0}
        return jt.TABLE.encode(name, at, ecu=ecu, **values)
