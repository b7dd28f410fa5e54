"""The device's end: what a servo obeys of what it receives, and its firmware.

Rules. A goal arms, as the torque switch does: the vendor's examples never switch it on. What is written while
Lock is 1 is not stored.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.feetech import table as ft
from protocols.feetech.options import Options, Settings
from protocols.messages import MILLISECOND, Mode, Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.memory_map import Target
from protocols.toolkit.servo import Encoder, Gains, clamp
from protocols.toolkit.servo_device import BusServo, ServoDecoder, ServoMemory
from protocols.toolkit.servo_packets import EVERYBODY, SYNC_READ, Packet, ServoPackets

SIZE = 128
SWITCH, MODE = 40, 33
AT_12_V = 12.0
PASSES: Nanos = 500 * MILLISECOND


@dataclass(slots=True)
class Memory(ServoMemory):
    """What one servo keeps of what it received."""

    options: Options

    def others(self, packets: ServoPackets, one: Packet) -> tuple[int, Sequence[Obeyed]]:
        if one.instruction != ft.RESET or one.data:
            return 0, ()
        self.image = self.delivered
        for name, value in {"ID": self.id, "Operating_Mode": 0, "Homing_Offset": 0}.items():
            self.put(name, value)
        return 0, (msg.Idle(self.name), msg.Kept(self.name, "RESET", 1.0))

    def wrote(self, before: bytes, at: int, size: int) -> Sequence[Obeyed]:
        does: list[Obeyed] = []
        end, touched = at + size, self.table.within(at, size)
        for register in touched:
            if not register.writable:
                self.place(register.number, before[register.number : register.number + register.size])
        names = [register.name for register in touched if register.writable]
        switch = self.image[SWITCH] if at <= SWITCH < end else None
        sts = "Operating_Mode" in self.table.by_name
        goal = self.options.goal_in(self.get("Operating_Mode"))
        if switch == ft.MIDDLE_HERE and sts:
            self.place(SWITCH, before[SWITCH : SWITCH + 1])
            does.append(msg.Zero(self.name))
        elif switch == 0:
            does.append(msg.Idle(self.name))
        other_mode = sts and before[MODE] != self.image[MODE] and self.image[SWITCH]
        if switch == 1 or (goal and goal.register in names) or other_mode:
            self.put("Torque_Enable", 1)
            does += self.does("Torque_Enable", 1)
        if switch not in (None, 0, 1, ft.MIDDLE_HERE):
            does.append(msg.Kept(self.name, "Torque_Enable", float(switch or 0)))
        for name in names:
            if name not in ("Torque_Enable", goal and goal.register):
                does += self.does(name, self.get(name))
        known = {n for r in touched if r.writable for n in range(r.number, r.number + r.size)}
        bare = [n for n in range(at, end) if n not in known]
        return does + [msg.Kept(self.name, f"register {n}", float(self.image[n])) for n in bare]


def memory_of(device: Device, **values: float) -> Memory:
    """Return the memory of a servo as delivered, as far as what it obeys depends on it, and `values`."""
    made = Memory(device.name, device.address, device.options)
    made.deliver(SIZE, {"Lock": 1, "ID": device.address} | values)
    return made


def decoder(devices: Sequence[Device]) -> ServoDecoder:
    """Return the decoder of the servos on one line."""
    return ServoDecoder(ft.PACKETS, [memory_of(each) for each in devices])


def delivered(options: Options, settings: Settings) -> dict[str, float]:
    """Return what the registers of a servo hold when it is switched on."""
    return {
        **ft.DATA["delivered"],
        "Model_Number": options.of.number,
        "Return_Delay_Time": settings.return_delay,
        "Max_Position_Limit": options.of.steps - 1,
        "Phase": 12 | 16 * settings.full_angle,
        "Homing_Offset": settings.offset,
        "Operating_Mode": settings.mode,
        "Goal_Position": options.of.middle,
    }


class FeetechTwin(BusServo):
    """One servo."""

    faults = ft.FAULTS
    passing = PASSES
    packets = ft.PACKETS
    level, levels = "Response_Status_Level", (0, 1)

    def __init__(self, device: Device, seed: int) -> None:
        settings: Settings = device.settings
        memory = memory_of(device, **delivered(device.options, settings))
        memory.place(2, bytes((device.options.table.order == "big",)))
        super().__init__(device, seed, Gains(torque_limit=settings.stall_torque), memory)
        self.model = device.options.of
        self.encoder = Encoder(counts=1e6)

    def status(self, number: int, error: int, data: bytes) -> bytes:
        return self.packets.packet(number, self.fault, data)

    def on_ping(self, t: Nanos, one: Packet) -> None:
        """Answer a ping, also one of everybody: that is how the id of a servo is found that is alone on its
        line (Feetech's manual of the protocol, broadcast id: of all instructions only PING is answered)."""
        super().on_ping(t, one._replace(id=self.memory.id) if one.id == EVERYBODY else one)

    def on_question(self, t: Nanos, one: Packet, wanted: Mapping[int, Target]) -> None:
        """SCS servos have no sync read: they do not answer it."""
        if one.instruction != SYNC_READ or self.model.sync_read:
            super().on_question(t, one, wanted)

    def obey(self, t: Nanos, obeyed: Obeyed) -> None:
        match obeyed:
            case msg.Zero():
                self.memory.put("Homing_Offset", self._actual() - self.model.middle)
            case msg.Idle():
                self.disarm()
            case msg.Kept() | msg.WriteParameter():
                self._configure()
            case _:
                super().obey(t, obeyed)

    def _configure(self) -> None:
        """Take over the limits."""
        settings: Settings = self.settings
        memory, step = self.memory, self.model.step
        slowed = memory.get("Operating_Mode") == 0 and memory.get("Goal_Velocity") > 0
        self.fastest = memory.get("Goal_Velocity") * step if slowed else math.inf
        self.speed_up = self.slow_down = memory.get("Acceleration") * 100.0 * step or math.inf
        limited = "Torque_Limit" in memory.table.by_name
        self.strongest = settings.stall_torque * (memory.get("Torque_Limit") / 1000.0 if limited else 1.0)
        share, stiff = (memory.get("P_Coefficient") or 32) / 32.0, settings.stiffness
        self.servo.tune(Gains(20.0 * share, stiff / 20.0, stiff / 2.0, settings.stall_torque))

    # -- the servo ------------------------------------------------------------------------------------

    def _actual(self) -> int:
        """Return the position without offset [steps], of the turn in which it is unless all are counted."""
        steps: int = round(self.encoder.shaft / self.model.step) + self.model.middle
        return steps % self.model.steps if self._within_a_turn() else steps

    def _offset(self) -> int:
        """Return what is subtracted from the position [steps]: in mode position alone (measured on STS3215:
        servolab 1.0.0, brukg/so_arm_100_hardware#13, matthieuvigne/STS_servos#9)."""
        bare = self.memory.get("Operating_Mode") != 0
        return 0 if bare else round(self.memory.get("Homing_Offset"))

    def _within_a_turn(self) -> bool:
        memory = self.memory
        counts = memory.get("Phase") & 16 and memory.get("Operating_Mode") == 0
        return "Operating_Mode" in memory.table.by_name and not counts

    def present(self) -> Mapping[str, float]:
        memory, model, settings = self.memory, self.model, self.settings
        position = self._actual() - self._offset()
        position = position % model.steps if self._within_a_turn() else position
        share = self.torque / settings.stall_torque
        low, high = model.ends
        return {
            "Present_Position": max(low, min(high, position)),
            "Present_Velocity": self.encoder.velocity / model.step,
            "Present_Load": clamp(share, 1.0) * 1000.0,
            "Present_Voltage": settings.supply * 10.0,
            "Present_Temperature": settings.temperature,
            "Async_Write": memory.waiting is not None,
            "Status": self.fault,
            "Moving": abs(self.encoder.velocity) > 0.02,
            "Present_Current": share * settings.stall_current / ft.AMPERE,
        }

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        """Run the loops: within what the supply can do at this velocity."""
        settings: Settings = self.settings
        self.encoder.set_position(self.encoder.shaft - self._offset() * self.model.step)
        torque = super().cycle(now, dt, position, velocity)
        if self.mode is not Mode.ARMED:
            return 0.0
        full = settings.stall_torque * settings.supply / AT_12_V
        back = settings.stall_torque * self.encoder.velocity / settings.no_load_speed
        if isinstance(self.goal, msg.Torque):  # no loop: a share of the supply
            return clamp(self.goal.torque - back, self.strongest + abs(back))
        return max(min(torque, full - back), -full - back)
