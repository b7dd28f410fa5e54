"""The device's end: the firmware of one servo, as far as the e-Manual tells it.

Rules. Each instruction ends what was not finished of the one before: a chain of answers whose turn has not
come. What the loops inside do is ours: the manual has their gains, not their form.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from protocols import messages as msg
from protocols.dynamixel import packets as dx
from protocols.dynamixel import table as dt
from protocols.dynamixel.memory import OFFSET_OF_ONE_TURN, RESULT_FAIL, memory_of
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Event, Mode, Nanos
from protocols.plugin import Device
from protocols.toolkit.firmware import ServoFirmware
from protocols.toolkit.serial import Stream
from protocols.toolkit.servo import Encoder, Gains

RESTART: Nanos = 300 * MILLISECOND
SLOT: Nanos = 3 * MILLISECOND
"""Of each id, after a ping to all (the SDK waits as long)"""


class DynamixelTwin(ServoFirmware):
    """One servo."""

    faults, lost = dt.FAULTS, dt.WATCHDOG

    def __init__(self, device: Device, seed: int) -> None:
        self.memory = memory_of(device)
        self.model, self.table = self.memory.model, self.memory.table
        most, stiff = self.model.strongest, min(max(self.model.strongest / 4.0, 1.0), 30.0)
        super().__init__(device, seed, Gains(torque_limit=most).scaled(1.0, stiff, 2.0 * stiff))
        self.encoder = Encoder(counts=1.0 / self.model.count, bandwidth=1000.0)
        self.rate = device.line_rate
        self._stream = Stream(dx.FRAMING)
        self._heard = b""
        """What followed the last instruction."""
        self._behind: tuple[int, dx.Target] | None = None
        """In a chain: the device whose answer it waits for, and what it will answer."""
        self._fast: tuple[int, dx.Target, bytes] | None = None
        """In a fast one: the bytes that come before its own, what it will answer, and with what head."""
        self._offset = 0
        self._restarts = False
        """It restarts when it has answered."""
        self._configure()

    # -- what it is ------------------------------------------------------------------------------------

    def _configure(self) -> None:
        """Take over what is stored, and the limits."""
        get, model = self.memory.get, self.model
        self.reply_delay = get("Return_Delay_Time") * dt.DELAY_UNIT
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
        steps = self.memory.get("Bus_Watchdog")
        on = self.mode is Mode.ARMED and 0 < steps < dt.TRIPPED
        return steps * dt.WATCHDOG_UNIT_MS * MILLISECOND if on else 0

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

    def trip(self, code: int) -> None:
        super().trip(code)
        self.memory.put("Torque_Enable", 0)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        torques, frames = super().step(now, truth)
        if self._restarts and not self._replies:
            self._restarts, self.goal = False, msg.Idle(self.device.name)
            self.memory.restart()
            self.restart(now, RESTART)
            self._one_turn()
        return torques, frames

    # -- what it hears -----------------------------------------------------------------------------------

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        data = frame if isinstance(frame, bytes) else b""
        while data:  # packet by packet
            at = data.find(dx.HEADER, 1)
            piece, data = (data, b"") if at < 0 else (data[:at], data[at:])
            self._take(t, piece)

    def _take(self, t: Nanos, piece: bytes) -> None:
        """Take bytes of one packet, or a part of it."""
        self._heard += piece
        for message in self._stream.messages(piece):
            one = dx.unpack(message)
            if one.instruction != dx.STATUS:
                self._heard = b""
                self._instruction(t, one)
            elif self._behind is not None and one.id == self._behind[0]:
                (_, target), self._behind = self._behind, None
                self._answer(t, 0, self._read(*target))
        if self._fast is not None and len(self._heard) == self._fast[0]:
            (_, target, head), self._fast = self._fast, None
            self._block(t, self._heard + head, len(self._heard), target)

    def _instruction(self, t: Nanos, one: dx.Packet) -> None:
        self._behind = self._fast = None
        memory = self.memory
        to_it = memory.address in {one.id, *dx.targets(one), *(address for address, _, _ in dx.writes(one))}
        if to_it or (one.id == dx.ALL and one.instruction in (dx.PING, dx.ACTION, dx.REBOOT)):
            self.feed(t)
        here, level = one.id == memory.address, memory.get("Status_Return_Level")
        wrong = memory.get("Baud_Rate")
        if self.rate in dt.BAUD_RATES and self.rate != dt.BAUD_RATES[wrong]:
            return  # noise, to a device that listens at another rate
        if one.instruction in dx.READS:
            if level:
                self._asked(t, one, dx.targets(one))
        elif one.instruction == dx.PING:
            if here or one.id == dx.ALL:
                data = self._read(0, 2) + self._read(6, 1)
                self._answer(t if here else t + SLOT * memory.address, 0, data)
        else:
            if one.instruction == dx.REBOOT and here and level == 2:
                self._answer(t, 0, b"")
            enables = not memory.armed
            error = self._obey(t, one)
            if enables and memory.armed and self.mode is not Mode.ARMED:
                memory.put("Torque_Enable", 0)
                error = RESULT_FAIL
            if here and level == 2 and one.instruction not in (dx.ACTION, dx.REBOOT):
                self._answer(t, error, b"")
            if one.instruction == dx.REBOOT and (here or one.id == dx.ALL):
                self._restarts = True

    def _obey(self, t: Nanos, one: dx.Packet) -> int:
        error, obeyed = self.memory.obey(one)
        for each in obeyed:
            if isinstance(each, msg.Arm) and self.memory.get("Operating_Mode") == 3:
                self._one_turn()
            self.obey(t, each)
        if obeyed:
            self._configure()
        return error

    # -- what it answers -----------------------------------------------------------------------------------

    def _alert(self, error: int) -> bytes:
        return bytes((error | (dx.ALERT if self.fault else 0),))

    def _answer(self, t: Nanos, error: int, data: bytes) -> None:
        self.reply(t, dx.packet(self.memory.address, dx.STATUS, self._alert(error) + data))

    def _asked(self, t: Nanos, one: dx.Packet, wanted: dx.Targets) -> None:
        """Answer a reading, or wait for one's turn."""
        order, mine = list(wanted), self.memory.address
        if mine not in wanted:
            return
        at, target = order.index(mine), wanted[mine]
        if one.instruction in dx.FAST:
            size = 1 + sum(4 + length for _, length in wanted.values())
            head = b"" if at else dx.HEADER + bytes((dx.ALL, size & 0xFF, size >> 8, dx.STATUS))
            before = 8 * bool(at) + sum(4 + wanted[each][1] for each in order[:at])
            self._fast = before, target, head
        elif at:
            self._behind = order[at - 1], target
        else:
            self._answer(t, 0, self._read(*target))

    def _block(self, t: Nanos, before: bytes, sent: int, target: dx.Target) -> None:
        """Send one's part of the answer to a fast read, behind what was sent of it."""
        whole = before + self._alert(0) + bytes((self.memory.address,)) + self._read(*target)
        self.reply(t, whole[sent:] + dx.CRC(whole).to_bytes(2, "little"))

    def _read(self, start: int, length: int) -> bytes:
        """Return a run of bytes of the control table."""
        first = dt.data_of(self.model, self.memory.get("Firmware_Version"))
        if first <= start < first + dt.INDIRECT:
            places = (self.memory.get(f"Indirect_Address_{start - first + k + 1}") for k in range(length))
            return b"".join(
                self._read(place, 1) if not first <= place < first + 16 else b"\0" for place in places
            )
        now = self._present()
        form, names = self.table.inside(start, length)
        if not names and length < 4:  # a part of a register
            register = max(
                (r for r in self.table.by_name.values() if r.number <= start), key=lambda r: r.number
            )
            whole = self._read(register.number, self.table.size(register.name))
            return (whole[start - register.number :] + bytes(length))[:length]
        return form.pack(*(now[name] if name in now else self.memory.get(name) for name in names))

    def _present(self) -> Mapping[str, int]:
        model = self.model
        position = round(self.encoder.position / model.count) + model.zero
        current = round(self.torque / model.torque / model.ampere)
        return {
            "Torque_Enable": int(self.mode is Mode.ARMED),
            "Hardware_Error_Status": self.fault & 0xFF,
            "Registered_Instruction": int(bool(self.memory.registered)),
            "Present_Velocity": _within(round(self.encoder.velocity / model.step), 31),
            "Present_Position": _within(position, 31),
            "Present_Current": _within(current, 15),
            "Present_Load": round(1000.0 * self.torque / model.strongest),
            "Present_Input_Voltage": 50 if model.family == "X330" else 240 if model.family == "P" else 120,
            "Present_Temperature": 30,
            "Moving": int(abs(self.encoder.velocity) > 10 * model.step),
        }


def _within(value: int, bits: int) -> int:
    return max(-(1 << bits), min((1 << bits) - 1, value))
