"""The device's end: what a servo obeys of what it receives, and its firmware.

Rules. Decoder and twin run on the same memory, an image of the registers. A goal arms, as the torque switch
does: the vendor's examples never switch it on. What is written while Lock is 1 is not stored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

from protocols import messages as msg
from protocols.feetech import table as ft
from protocols.feetech.options import Options, Settings
from protocols.feetech.table import EVERYBODY, Family, Packet
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Command, Mode, Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.firmware import ServoFirmware
from protocols.toolkit.serial import Stream
from protocols.toolkit.servo import Encoder, Gains, clamp

SIZE = 128
GOALS = {0: (42, 2), 1: (46, 2), 2: (44, 2)}
"""First byte and size of the goal of each mode."""
AT_12_V = 12.0
PASSES: Nanos = 500 * MILLISECOND


@dataclass(slots=True)
class Memory:
    """What one servo keeps of what it received. Plain data."""

    name: str
    id: int
    options: Options
    image: bytes = bytes(SIZE)
    """Its registers"""
    waiting: tuple[int, bytes] | None = None
    """What a reg write keeps for the next action."""

    @property
    def family(self) -> Family:
        """Its registers' family."""
        return self.options.of_model.family

    def value(self, name: str) -> int:
        """Return the value of a register."""
        register = self.family.registers.get(name)
        if register is None:
            return 0
        raw = self.image[register.at : register.at + register.size]
        return register.value(int.from_bytes(raw, self.family.order))

    def put(self, at: int, data: bytes) -> None:
        """Write bytes into the image."""
        self.image = (self.image[:at] + data + self.image[at + len(data) :])[:SIZE]

    def assign(self, name: str, value: float) -> None:
        """Write a register."""
        self.put(self.family.registers[name].at, self.family.data(name, value))

    def obey(self, one: Packet) -> Sequence[Obeyed]:
        """Apply an instruction to any id; return what the servo then does."""
        if one.instruction == ft.ACTION and one.id in (self.id, EVERYBODY) and self.waiting:
            (at, data), self.waiting = self.waiting, None
            return self._write(at, data)
        each = ft.written(one)
        found = each.get(self.id) or (each.get(EVERYBODY) if one.instruction != ft.SYNC_WRITE else None)
        if found is None or found[0] + len(found[1]) > SIZE:
            return ()
        if one.instruction == ft.REG_WRITE:
            self.waiting = found
            return (msg.Kept(self.name, f"reg write {found[0]}", float(len(found[1]))),)
        return self._write(*found)

    def _write(self, at: int, data: bytes) -> Sequence[Obeyed]:
        before, end = self.image, at + len(data)
        self.put(at, data)
        self.id = self.image[5] if at <= 5 < end else self.id
        for register in self.family.registers.values():
            if not register.writable:
                self.put(register.at, before[register.at : register.at + register.size])
        first: list[Obeyed] = []
        switch = self.image[40] if at <= 40 < end else None
        mode = self.value("Operating_Mode")
        place, size = GOALS.get(mode, (SIZE, 0))
        aimed = place < end and at < place + size
        if switch == ft.MIDDLE_HERE and self.family.name == "sts":
            self.put(40, before[40:41])
            first.append(msg.Zero(self.name))
        elif switch == 0:
            first.append(msg.Idle(self.name))
        if (
            switch == 1
            or aimed
            or (before[33] != self.image[33] and self.family.name == "sts" and self.image[40])
        ):
            self.put(40, b"\x01")
            first += [msg.Arm(self.name), *self.goal()]
        done = {40, *(range(place, place + size) if aimed else ())}
        if switch not in (None, 0, 1, ft.MIDDLE_HERE):
            first.append(msg.Kept(self.name, "Torque_Enable", float(switch or 0)))
        return (*first, *self._kept(at, end, done))

    def _kept(self, at: int, end: int, done: set[int]) -> Sequence[Obeyed]:
        """Return the other registers that are written, each as it is now."""
        kept: list[Obeyed] = []
        for register in self.family.registers.values():
            if register.writable and register.at < end and at < register.at + register.size:
                if register.at not in done:
                    kept.append(
                        msg.WriteParameter(self.name, register.name, float(self.value(register.name)))
                    )
                done |= set(range(register.at, register.at + register.size))
        return kept + [
            msg.Kept(self.name, f"register {n}", float(self.image[n]))
            for n in range(at, end)
            if n not in done
        ]

    def goal(self) -> Sequence[Command]:
        """Return what the goal of the present mode is."""
        model, name = self.options.of_model, self.name
        match self.value("Operating_Mode"):
            case 0:
                return (msg.Position(name, (self.value("Goal_Position") - model.middle) * model.step),)
            case 1:
                return (msg.Velocity(name, self.value("Goal_Velocity") * model.step),)
            case 2:
                duty = self.value("Goal_Time") / 1000.0
                return (msg.Torque(name, duty * self.options.stall_torque),)
        return ()


def memory_of(device: Device) -> Memory:
    """Return the memory of a servo as delivered."""
    made = Memory(device.name, device.address, device.options)
    made.assign("Lock", 1)
    return made


class FeetechDecoder:
    """What the servos on one line would obey."""

    def __init__(self, memories: Sequence[Memory], stream: Stream) -> None:
        self._memories = tuple(memories)
        self._stream = stream

    def __deepcopy__(self, memo: object) -> FeetechDecoder:
        """The guard copies it every few frames: all that a memory holds is constant."""
        return FeetechDecoder([replace(each) for each in self._memories], copy(self._stream))

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what the servos would obey in this frame; [] if nothing."""
        obeyed: list[Obeyed] = []
        for message in self._stream.messages(frame) if isinstance(frame, bytes) else ():
            one = ft.unpacked(message)
            for memory in self._memories:
                obeyed += memory.obey(one)
        return obeyed


def decoder(devices: Sequence[Device]) -> FeetechDecoder:
    """Return the decoder of the servos on one line."""
    return FeetechDecoder([memory_of(each) for each in devices], Stream(ft.FRAMING))


class FeetechTwin(ServoFirmware):
    """One servo."""

    faults = ft.FAULTS
    passing = PASSES

    def __init__(self, device: Device, seed: int) -> None:
        settings: Settings = device.settings
        super().__init__(device, seed, Gains(torque_limit=settings.stall_torque))
        self.memory = memory_of(device)
        self._stream = Stream(ft.FRAMING)
        self._chain: tuple[bytes, int, int] = b"", 0, 0
        """In a sync read: the servos before it, after the last of which it answers, and what with."""
        self.encoder = Encoder(counts=1e6)
        self._delivered(settings)

    def _delivered(self, settings: Settings) -> None:
        memory, model = self.memory, self.device.options.of_model
        scs = model.family.name == "scs"
        stored = {
            "Firmware_Major_Version": 3,
            "Firmware_Minor_Version": 10,
            "Model_Number": model.number,
            "ID": self.device.address,
            "Return_Delay_Time": settings.return_delay,
            "Response_Status_Level": 1,
            "Max_Position_Limit": model.steps - 1,
            "Max_Temperature_Limit": 70,
            "Max_Voltage_Limit": 140,
            "Min_Voltage_Limit": 40,
            "Max_Torque_Limit": 1000,
            "Phase": 12 | 16 * settings.full_angle,
            "Unloading_Condition": 44,
            "LED_Alarm_Condition": 47,
            "P_Coefficient": 32,
            "D_Coefficient": 32,
            "Protection_Current": 500,
            "Angular_Resolution": 1,
            "Homing_Offset": settings.offset,
            "Operating_Mode": settings.mode,
            "Protective_Torque": 20,
            "Protection_Time": 200,
            "Overload_Torque": 80,
            "Torque_Limit": 1000,
            "Goal_Position": model.middle,
            "Lock": 1,
        }
        for name, value in stored.items():
            if name in model.family.registers:
                memory.assign(name, value)
        memory.put(2, bytes((scs,)))

    # -- instructions ---------------------------------------------------------------------------------

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        if not isinstance(frame, bytes):
            return
        for message in self._stream.messages(frame):
            self._hear(t, ft.unpacked(message))

    def _hear(self, t: Nanos, one: Packet) -> None:
        memory, (before, at, size) = self.memory, self._chain
        if before and one.id in before and len(one.data) == size:
            if one.id == before[-1]:
                self._chain = b"", 0, 0
                self._status(t, memory.image[at : at + size])
            return
        self._chain = b"", 0, 0  # an instruction ends what was not finished
        mine = one.id == memory.id
        match one.instruction:
            case ft.PING if mine:
                self._status(t)
            case ft.READ if mine and len(one.data) == 2:
                self._measure()
                self._status(t, memory.image[one.data[0] : one.data[0] + one.data[1]])
            case ft.SYNC_READ if self.device.options.of_model.sync_read and len(one.data) > 2:
                self._queue(t, one.data)
            case ft.WRITE | ft.REG_WRITE | ft.ACTION | ft.SYNC_WRITE:
                for obeyed in memory.obey(one):
                    self.obey(t, obeyed)
                if mine and one.instruction != ft.SYNC_WRITE and memory.value("Response_Status_Level"):
                    self._status(t)

    def _queue(self, t: Nanos, data: bytes) -> None:
        at, size, order = data[0], data[1], data[2:]
        if (place := order.find(self.memory.id)) < 0:
            return
        self._measure()
        if place:
            self._chain = order[:place], at, size
        else:
            self._status(t, self.memory.image[at : at + size])

    def _status(self, t: Nanos, data: bytes = b"") -> None:
        wait = self.memory.value("Return_Delay_Time") * 2000
        self.reply(t + wait, ft.packet(self.memory.id, self.fault, data))

    # -- the servo ------------------------------------------------------------------------------------

    def obey(self, t: Nanos, obeyed: Obeyed) -> None:
        settings: Settings = self.settings
        match obeyed:
            case msg.Zero():
                offset = self._actual() - self.device.options.of_model.middle
                self.memory.assign("Homing_Offset", offset)
            case msg.Idle():
                self.disarm()
            case msg.Kept() | msg.WriteParameter():
                memory, model = self.memory, self.device.options.of_model
                self.fastest = math.inf
                if memory.value("Operating_Mode") == 0 and memory.value("Goal_Velocity") > 0:
                    self.fastest = memory.value("Goal_Velocity") * model.step
                acceleration = memory.value("Acceleration") * 100.0 * model.step or math.inf
                self.speed_up = self.slow_down = acceleration
                self.strongest = settings.stall_torque
                if "Torque_Limit" in model.family.registers:
                    self.strongest *= memory.value("Torque_Limit") / 1000.0
                share = (memory.value("P_Coefficient") or 32) / 32.0
                self.servo.tune(self._gains(settings, share))
            case _:
                super().obey(t, obeyed)

    @staticmethod
    def _gains(settings: Settings, share: float = 1.0) -> Gains:
        stiff = settings.stiffness
        return Gains(20.0 * share, stiff / 20.0, stiff / 2.0, settings.stall_torque)

    def trip(self, code: int) -> None:
        super().trip(code)
        self.memory.put(40, b"\x00")

    def _actual(self) -> int:
        """Return the position without offset [steps], of the turn in which it is unless all are counted."""
        model = self.device.options.of_model
        steps: int = round(self.encoder.shaft / model.step) + model.middle
        return steps % model.steps if self._within_a_turn() else steps

    def _within_a_turn(self) -> bool:
        memory = self.memory
        counts = memory.value("Phase") & 16 and memory.value("Operating_Mode") == 0
        return memory.family.name == "sts" and not counts

    def _measure(self) -> None:
        """Write what is measured into its registers."""
        memory, model, settings = self.memory, self.device.options.of_model, self.settings
        position = self._actual() - memory.value("Homing_Offset")
        position = position % model.steps if self._within_a_turn() else position
        share = self.torque / settings.stall_torque
        low, high = model.ends
        measured = {
            "Present_Position": max(low, min(high, position)),
            "Present_Velocity": self.encoder.velocity / model.step,
            "Present_Load": clamp(share, 1.0) * 1000.0,
            "Present_Voltage": settings.supply * 10.0,
            "Present_Temperature": settings.temperature,
            "Status": self.fault,
            "Moving": abs(self.encoder.velocity) > 0.02,
            "Present_Current": share * settings.stall_current / 6.5e-3,
        }
        for name, value in measured.items():
            if name in model.family.registers:
                memory.assign(name, value)

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        """Run the loops: within what the supply can do at this velocity."""
        settings: Settings = self.settings
        offset = self.memory.value("Homing_Offset") * self.device.options.of_model.step
        self.encoder.set_position(self.encoder.shaft - offset)
        torque = super().cycle(now, dt, position, velocity)
        if self.mode is not Mode.ARMED:
            return 0.0
        full = settings.stall_torque * settings.supply / AT_12_V
        back = settings.stall_torque * self.encoder.velocity / settings.no_load_speed
        if isinstance(self.goal, msg.Torque):  # no loop: a share of the supply
            return clamp(self.goal.torque - back, self.strongest + abs(back))
        return max(min(torque, full - back), -full - back)
