"""The twin: one moteus, its registers, its console and its replies (README, "The twin").

Rules. `Memory` decides what is obeyed, `Loops` what the motor then does; here replies are made. A frame is
executed from left to right, and its queries are replied to as things are before the command in it takes
effect. Only frames with the reply bit get a reply. Queries do not feed the watchdog. A generated UUID comes
from address and seed.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from math import isfinite, tau
from operator import attrgetter

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Nanos, Obeyed
from protocols.moteus import codec
from protocols.moteus.codec import INT32, POLL, READ, READ_ERROR, REPLY, TO_DEVICE, WRITE_ERROR, Raw, Subframe
from protocols.moteus.decoder import COMMAND_NAMES, UNKNOWN, Memory
from protocols.moteus.loops import Loops, Settings
from protocols.moteus.table import FAULTS, NAMES, TIMEOUT
from protocols.plugin import Device
from protocols.toolkit.firmware import Firmware

MAX_REPLY = 64  # bytes: what does not fit is left out
MAX_CONSOLE, MAX_CONSOLE_REPLY = 512, 48  # bytes of console output that are kept, and of one poll
_MEASURED = (
    "mode position=encoder.position velocity=encoder.velocity torque=stage.torque q_current=stage.current"
    " abs_position=encoder.shaft power=stage.electrical motor_temperature trajectory_complete=setpoint.done"
    " home_state voltage=stage.voltage temperature=stage.stage_temperature fault position_kp=proportional"
    " position_ki=integral position_kd=derivative position_feedforward=feedforward"
    " position_command=control_torque control_position=setpoint.position control_velocity=setpoint.velocity"
    " control_torque position_error=error velocity_error torque_error"
    " encoder_0_position=encoder.shaft encoder_0_velocity=encoder.velocity"
)
_PAIRS = [each.partition("=") for each in _MEASURED.split()]
MEASURED = {name: attrgetter(where or name) for name, _, where in _PAIRS}
"""Registers that change by themselves, and where in the loops they are, if not under their name."""
CONSTANT: Mapping[str, int] = {
    **dict.fromkeys(("d_current", "driver_fault1", "driver_fault2"), 0),
    "encoder_validity": 0x03,
    "uuid_mask_capable": 1,
}


class MoteusTwin(Firmware):
    """One device."""

    faults, lost = FAULTS, TIMEOUT

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        settings: Settings = device.settings
        mixed = (device.address * 0x9E3779B97F4A7C15 + seed * 0xBF58476D1CE4E5B9 + 0x94D049BB133111EB) % 2**64
        generated = struct.pack(">QII", mixed, 0x6D6F7465, device.address << 16 | seed & 0xFFFF)
        uuid = bytes.fromhex(settings.uuid) or generated
        self.memory = Memory(device, uuid)
        self.loops = Loops(settings, self.memory.command)
        self.reply_delay = settings.reply_delay_us * 1000
        self._console = b""  # output that was not polled yet
        major, minor, micro = map(int, settings.firmware.split("."))
        self._identity = {  # registers that are read as int32 only
            "model_number": settings.model,
            "firmware_version": major << 16 | minor << 8 | micro,
            "register_map_version": settings.register_map,
            **{f"uuid{at}": part for at, part in enumerate(struct.unpack("<4i", uuid), 1)},
            **{f"serial_number{at}": part for at, part in enumerate(struct.unpack("<3i", uuid[:3:-1]), 1)},
        }

    # -- the firmware ---------------------------------------------------------------------------------

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        self.loops.encoder.measure(dt or 1.0, position / tau, velocity / tau)
        if dt > 0.0:
            self.loops.step(dt, now - self.fed)
        return self.loops.stage.torque

    def timeout(self) -> Nanos:
        return self.loops.timeout()

    def trip(self, code: int) -> None:
        self.loops.trip(code)

    # -- frames ---------------------------------------------------------------------------------------

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        if not isinstance(frame, CanFrame) or not self.memory.is_addressed(frame):
            return
        replies = [reply for each in self.memory.obey(frame.data) for reply in self._do(each)]
        if self.memory.begun:
            self.loops.take(self.memory.mode, {**self.memory.command})
            self.feed(t)
        if frame.id & codec.REPLY_BIT and self.memory.chosen:
            data = b""
            for piece in map(codec.encode, replies):
                if len(data) + len(piece) > MAX_REPLY:
                    break
                data += piece
            identifier = codec.reply_id(self.memory.address, frame.id >> 8 & 0x7F, self.memory.prefix)
            self.reply(t, codec.make_reply(identifier, data, frame))

    def _do(self, item: Obeyed | Subframe) -> list[Subframe]:
        """Do what is done at once. Returns what is replied to it."""
        if isinstance(item, Subframe):
            return self._answer(item)
        match item:
            case msg.Zero():
                self.loops.set_output(0.0)
            case msg.WriteParameter(_, "set_output_exact" | "set_output_nearest", value):
                self.loops.set_output(value)
            case msg.WriteParameter(_, "recapture_position_velocity"):
                self.loops.recapture()
            case msg.WriteParameter(_, "require_reindex"):
                self.loops.reindex()
            case _:
                self._print("OK")
        return []

    def _answer(self, subframe: Subframe) -> list[Subframe]:
        if subframe.code == READ:
            return self._read(subframe)
        if subframe.code == TO_DEVICE:
            asked = subframe.data == b"conf get id.id"
            self._print(str(self.memory.address) if asked else "ERR unknown command")
        elif subframe.code == POLL and subframe.register == 1:
            most = min(subframe.number, MAX_CONSOLE_REPLY)
            piece, self._console = self._console[:most], self._console[most:]
            return [Subframe(codec.FROM_DEVICE, 1, data=piece)]
        return [subframe] if subframe.code == WRITE_ERROR else []

    def _print(self, line: str) -> None:
        self._console = (self._console + f"{line}\r\n".encode("ascii"))[-MAX_CONSOLE:]

    def _read(self, query: Subframe) -> list[Subframe]:
        """Reply neighbouring registers in one subframe, and an error for each that cannot be read."""
        out: list[Subframe] = []
        for register in range(query.register, query.register + query.number):
            raw = self._raw(register, query.resolution)
            if raw is None:
                out.append(Subframe(READ_ERROR, register, number=UNKNOWN))
            elif out and out[-1].code == REPLY:
                out[-1] = out[-1]._replace(raw=(*out[-1].raw, raw))
            else:
                out.append(Subframe(REPLY, register, query.resolution, (raw,)))
        return out

    def _raw(self, register: int, resolution: int) -> Raw | None:
        """Return the encoded value of a register; None if it cannot be read at this resolution."""
        name = NAMES.get(register, "")
        if name in self._identity:
            return self._identity[name] if resolution == INT32 else None
        if name in MEASURED:
            value: float = MEASURED[name](self.loops)
        elif register in COMMAND_NAMES:
            value = self.memory.command[COMMAND_NAMES[register]]
        elif name == "millisecond_counter":
            value = (self.now or 0) // MILLISECOND % 2**15
        else:
            return CONSTANT.get(name)
        return codec.to_raw(register, resolution, value if isfinite(value) else None)
