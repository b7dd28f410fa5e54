"""The twin: one moteus, its registers, its console and its replies (README, "The twin").

Rules. `Memory` decides what is obeyed, `Loops` what the motor then does; here replies are made. A frame is
executed from left to right, and its queries are replied to as things are before the command in it takes
effect. Only frames with the reply bit get a reply. Queries do not feed the watchdog. A generated UUID comes
from address and seed.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from math import tau

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Nanos, Obeyed
from protocols.moteus import codec
from protocols.moteus.codec import INT32, POLL, READ, READ_ERROR, REPLY, TO_DEVICE, Raw, Subframe
from protocols.moteus.decoder import COMMAND_NAMES, UNKNOWN, memory
from protocols.moteus.loops import Loops
from protocols.moteus.table import FAULTS, NAMES, TIMEOUT
from protocols.plugin import Device
from protocols.toolkit.firmware import Firmware

MAX_REPLY = 64
"""Bytes of a reply: what does not fit is left out."""
MAX_CONSOLE, MAX_CONSOLE_REPLY = 512, 48
"""Bytes of console output that are kept, and of one poll."""


def uuid_of(device: Device, seed: int) -> bytes:
    """Return the 16 bytes of the UUID, as configured or generated."""
    if device.settings.uuid:
        return bytes.fromhex(device.settings.uuid)
    mixed = (device.address * 0x9E3779B97F4A7C15 + seed * 0xBF58476D1CE4E5B9 + 0x94D049BB133111EB) % 2**64
    return struct.pack(">QII", mixed, 0x6D6F7465, device.address << 16 | seed & 0xFFFF)


class MoteusTwin(Firmware):
    """One device."""

    faults = FAULTS

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self.uuid = uuid_of(device, seed)
        self.memory = memory(device, self.uuid)
        self.loops = Loops(self.settings, self.memory.command)
        self.reply_delay = self.settings.reply_delay_us * 1000
        self._console = b""
        """Console output that was not polled yet."""
        major, minor, micro = (int(part) for part in self.settings.firmware.split("."))
        self._identity: dict[str, int] = {
            "model_number": self.settings.model,
            "firmware_version": major << 16 | minor << 8 | micro,
            "register_map_version": self.settings.register_map,
            **dict(zip(("uuid1", "uuid2", "uuid3", "uuid4"), struct.unpack("<4i", self.uuid), strict=True)),
            **{
                f"serial_number{at + 1}": struct.unpack_from("<i", self.uuid[::-1], 4 * at)[0]
                for at in range(3)
            },
        }
        """Registers that are read as int32 only."""

    # -- the firmware ---------------------------------------------------------------------------------

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        self.loops.encoder.measure(dt or 1.0, position / tau, velocity / tau)
        if dt > 0.0:
            self.loops.step(dt)
        return self.loops.stage.torque

    def timeout(self) -> Nanos:
        return self.loops.timeout()

    def on_timeout(self) -> None:
        self.loops.trip(TIMEOUT)

    def trip(self, code: int) -> None:
        self.loops.trip(code)

    # -- frames ---------------------------------------------------------------------------------------

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        if not isinstance(frame, CanFrame) or not self.memory.is_addressed(frame):
            return
        subframes, uuid_fits = self.memory.chosen(frame.data)
        replies = [self._answer(each) for each in self.memory.obey(subframes)]
        if self.memory.begun:
            self.loops.take(self.memory.mode, {**self.memory.command})
            self.feed(t)
        if not (frame.id & codec.REPLY_BIT and uuid_fits):
            return
        data = b""
        for piece in (codec.encode(subframe) for reply in replies for subframe in reply):
            if len(data) + len(piece) > MAX_REPLY:
                break
            data += piece
        identifier = codec.reply_id(self.memory.address, frame.id >> 8 & 0x7F, self.memory.prefix)
        self.reply(t, codec.make_frame(identifier, data))

    def _answer(self, item: Obeyed | Subframe) -> list[Subframe]:
        """Do what is done at once. Returns what is replied to it."""
        match item:
            case msg.Zero():
                self.loops.set_output(0.0)
            case msg.WriteParameter(_, "set_output_exact" | "set_output_nearest", value):
                self.loops.set_output(value)
            case msg.WriteParameter(_, "recapture_position_velocity"):
                self.loops.recapture()
            case msg.WriteParameter(_, "require_reindex"):
                self.loops.reindex()
            case msg.SetId() | msg.WriteParameter():
                self._print("OK")
            case Subframe(code, data=b"conf get id.id") if code == TO_DEVICE:
                self._print(str(self.memory.address))
            case Subframe(code) if code == TO_DEVICE:
                self._print("ERR unknown command")
            case Subframe(code, register, number=most) if code == POLL and register == 1:
                most = min(most, MAX_CONSOLE_REPLY)
                piece, self._console = self._console[:most], self._console[most:]
                return [Subframe(codec.FROM_DEVICE, 1, data=piece)]
            case Subframe(code) if code == READ:
                return self._read(item)
            case Subframe(code) if code == codec.WRITE_ERROR:
                return [item]
        return []

    def _print(self, line: str) -> None:
        self._console = (self._console + f"{line}\r\n".encode("ascii"))[-MAX_CONSOLE:]

    def _read(self, query: Subframe) -> list[Subframe]:
        """Reply neighbouring registers in one subframe, and an error for each that cannot be read."""
        out, run, measured = list[Subframe](), list[Raw](), self._quantities()
        end = query.register + query.number
        for register in range(query.register, end + 1):
            raw = self._raw(register, query.resolution, measured) if register < end else None
            if raw is not None:
                run.append(raw)
                continue
            if run:
                out.append(Subframe(REPLY, register - len(run), query.resolution, tuple(run)))
            run = []
            if register < end:
                out.append(Subframe(READ_ERROR, register, number=UNKNOWN))
        return out

    def _raw(self, register: int, resolution: int, measured: Mapping[str, float]) -> Raw | None:
        """Return the encoded value of a register; None if it cannot be read at this resolution."""
        name = NAMES.get(register, "")
        if name in self._identity:
            return self._identity[name] if resolution == INT32 else None
        value = measured.get(name)
        if value is None:
            value = self.memory.command.get(COMMAND_NAMES.get(register, ""))
        if value is None:
            return None
        return codec.to_raw(register, resolution, value if math.isfinite(value) else None)

    def _quantities(self) -> dict[str, float]:
        """Return the registers that change by themselves; command registers hold what was written."""
        loops, stage, setpoint, encoder = (
            self.loops,
            self.loops.stage,
            self.loops.setpoint,
            self.loops.encoder,
        )
        return {
            "mode": loops.mode,
            "position": encoder.position,
            "velocity": encoder.velocity,
            "torque": stage.torque,
            "q_current": stage.current,
            "d_current": 0.0,
            "abs_position": encoder.shaft,
            "power": stage.electrical,
            "motor_temperature": 0.0,
            "trajectory_complete": setpoint.done,
            "home_state": loops.home_state,
            "voltage": stage.voltage,
            "temperature": stage.stage_temperature,
            "fault": loops.fault or loops.limit,
            "position_kp": loops.terms[0],
            "position_ki": loops.integral,
            "position_kd": loops.terms[1],
            "position_feedforward": loops.command["command_feedforward_torque"],
            "position_command": loops.control_torque,
            "control_position": setpoint.position,
            "control_velocity": setpoint.velocity,
            "control_torque": loops.control_torque,
            "position_error": loops.error,
            "velocity_error": loops.velocity_error,
            "torque_error": stage.torque - loops.control_torque,
            "encoder_0_position": encoder.shaft,
            "encoder_0_velocity": encoder.velocity,
            "encoder_validity": 0x03,
            "millisecond_counter": (self.now or 0) // MILLISECOND % 2**15,
            "driver_fault1": 0.0,
            "driver_fault2": 0.0,
            "uuid_mask_capable": 1.0,
        }
