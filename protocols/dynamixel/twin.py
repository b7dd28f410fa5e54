"""The device's end: the firmware of one servo, as far as the e-Manual tells it.

Rules. Its part of a fast answer it sends behind the bytes of those before it, which it counts. What the loops
inside do is ours: the manual has their gains, not their form.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from protocols import messages as msg
from protocols.dynamixel import packets as dx
from protocols.dynamixel import table as dt
from protocols.dynamixel.memory import OFFSET_OF_ONE_TURN, RESULT_FAIL, Memory, memory_of
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Event, Mode, Nanos
from protocols.plugin import Device
from protocols.toolkit.memory_map import Target
from protocols.toolkit.servo import Encoder, Gains, clamp
from protocols.toolkit.servo_device import BusServo
from protocols.toolkit.servo_packets import ACTION, EVERYBODY, PING, SYNC_WRITE, Packet, concerned

RESTART: Nanos = 300 * MILLISECOND
SLOT: Nanos = 3 * MILLISECOND
"""Of each id, after a ping to all (the SDK waits as long)"""
SUPPLY = {"X330": 50, "X": 120, "P": 240}


class DynamixelTwin(BusServo):
    """One servo."""

    faults, lost = dt.FAULTS, dt.WATCHDOG
    packets = dx.PACKETS
    memory: Memory
    level = "Status_Return_Level"
    unanswered = frozenset({ACTION, SYNC_WRITE, dx.REBOOT, dx.BULK_WRITE})
    who = (0, 2), (6, 1)

    def __init__(self, device: Device, seed: int) -> None:
        memory = memory_of(device)
        self.model = memory.model
        most, stiff = self.model.strongest, min(max(self.model.strongest / 4.0, 1.0), 30.0)
        super().__init__(device, seed, Gains(torque_limit=most).scaled(1.0, stiff, 2.0 * stiff), memory)
        self.encoder = Encoder(counts=1.0 / self.model.count, bandwidth=1000.0)
        self.rate = device.line_rate
        self._heard = b""
        """In a fast chain: what followed the instruction."""
        self._fast: tuple[int, Target, bytes] | None = None
        """In a fast chain: the bytes that come before its own, what it will answer, and with what head."""
        self._offset = 0
        self._restarts = False
        """It restarts when it has answered."""
        self._configure()

    # -- what it is ------------------------------------------------------------------------------------

    def _configure(self) -> None:
        """Take over what is stored, and the limits."""
        get, model = self.memory.get, self.model
        mode, offset = get("Operating_Mode"), get("Homing_Offset")
        if mode == 3 and abs(offset) > OFFSET_OF_ONE_TURN * model.counts // 4096:
            offset = 0
        self.encoder.set_position(self.encoder.position + (offset - self._offset) * model.count)
        self._offset = offset
        self.strongest = get("Goal_Current") * model.ampere * model.torque if mode == 5 else model.strongest
        self.fastest = (get("Profile_Velocity") or model.velocity) * model.step

    def _one_turn(self) -> None:
        """Begin to count the position anew, within one turn."""
        position = self.encoder.position
        self.encoder.set_position(position - math.floor((position + math.pi) / math.tau) * math.tau)

    def timeout(self) -> Nanos:
        if self.mode is not Mode.ARMED:
            return 0
        steps = self.memory.get("Bus_Watchdog")
        return steps * dt.WATCHDOG_UNIT_MS * MILLISECOND if steps < dt.TRIPPED else 0

    def on_timeout(self) -> None:
        """Stop, with the torque on, and take no set-point any more."""
        self.memory.put("Bus_Watchdog", dt.TRIPPED)
        name = self.device.name
        match self.goal:
            case msg.Position():
                self.goal = msg.Position(name, self.encoder.position)
            case msg.Torque():
                self.goal = msg.Torque(name, 0.0)
            case _:
                self.goal = msg.Velocity(name, 0.0)

    def provoke(self, code: int) -> None:
        if code == dt.WATCHDOG:
            self.on_timeout()
        else:
            super().provoke(code)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        torques, frames = super().step(now, truth)
        if self._restarts and not self._replies:
            self._restarts, self.goal = False, msg.Idle(self.device.name)
            self.memory.restart()
            self.restart(now, RESTART)
            self._one_turn()
        return torques, frames

    # -- what it receives ------------------------------------------------------------------------------

    def waits(self) -> bool:
        return self._fast is not None or super().waits()

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        data = frame if isinstance(frame, bytes) else b""
        while data:  # packet by packet
            at = data.find(dx.HEADER, 1)
            piece, data = (data, b"") if at < 0 else (data[:at], data[at:])
            if self._fast is not None:
                self._heard += piece
            super().on_frame(t, piece)
            if self._fast is not None and len(self._heard) == self._fast[0]:
                (_, target, head), self._fast = self._fast, None
                self._block(t, self._heard + head, len(self._heard), target)

    def on_packet(self, t: Nanos, one: Packet) -> None:
        memory, instruction = self.memory, one.instruction
        if instruction != dx.STATUS:
            self._heard, self._fast = b"", None
            to_all = one.id == EVERYBODY and instruction in (PING, ACTION, dx.REBOOT)
            if to_all or memory.id in concerned(self.packets, one):
                self.feed(t)
            rate = dt.BAUD_RATES[memory.get("Baud_Rate")]
            if self.rate in dt.BAUD_RATES and self.rate != rate:
                return  # noise, to a device that listens at another rate
        super().on_packet(t, one)

    def on_ping(self, t: Nanos, one: Packet) -> None:
        at, own = (t + SLOT * self.memory.id, self.memory.id) if one.id == EVERYBODY else (t, one.id)
        super().on_ping(at, Packet(own, PING, b""))

    def does(self, t: Nanos, one: Packet) -> int:
        memory, here = self.memory, one.id == self.memory.id
        if one.instruction == dx.REBOOT and (here or one.id == EVERYBODY):
            if here and memory.get(self.level) == 2:
                self.answer(t, 0)
            self._restarts = True
        armed = memory.armed
        error = super().does(t, one)
        if memory.armed and not armed and self.mode is not Mode.ARMED:
            memory.put(self.switch, 0)
            error = RESULT_FAIL
        self._configure()
        return error

    def obey(self, t: Nanos, obeyed: msg.Obeyed) -> None:
        if isinstance(obeyed, msg.Arm) and self.memory.get("Operating_Mode") == 3:
            self._one_turn()
        super().obey(t, obeyed)

    # -- what it answers -------------------------------------------------------------------------------

    def _error(self, error: int) -> bytes:
        return bytes((error | (dx.ALERT if self.fault else 0),))

    def status(self, number: int, error: int, data: bytes) -> bytes:
        return self.packets.packet(number, dx.STATUS, self._error(error) + data)

    def on_question(self, t: Nanos, one: Packet, wanted: Mapping[int, Target]) -> None:
        if one.instruction not in dx.FAST:
            super().on_question(t, one, wanted)
        elif self.memory.id in wanted:
            order = list(wanted)
            at = order.index(self.memory.id)
            head = b"" if at else dx.fast_head(wanted)
            before = 8 * bool(at) + sum(4 + wanted[each][1] for each in order[:at])
            self._fast = before, wanted[self.memory.id], head

    def _block(self, t: Nanos, before: bytes, sent: int, target: Target) -> None:
        """Send one's part of the answer to a fast read, behind what was sent of it."""
        whole = before + self._error(0) + bytes((self.memory.id,)) + self.reads(target)
        self.reply(t, whole[sent:] + dx.CRC(whole).to_bytes(2, "little"))

    def present(self) -> Mapping[str, float]:
        model = self.model
        return {
            "Torque_Enable": self.mode is Mode.ARMED,
            "Hardware_Error_Status": self.fault & 0xFF,
            "Registered_Instruction": self.memory.waiting is not None,
            "Present_Velocity": self.encoder.velocity / model.step,
            "Present_Position": self.encoder.position / model.count + model.zero,
            "Present_Current": self.torque / model.torque / model.ampere,
            "Present_Load": clamp(self.torque / model.strongest, 1.0) * 1000.0,
            "Present_Input_Voltage": SUPPLY[model.family],
            "Present_Temperature": 30,
            "Moving": abs(self.encoder.velocity) > 10 * model.step,
        }
