"""The device's end over a serial line: the firmware is that of `protocols.odrive_can`.

Rules. A twin is one axis; what concerns the board each obeys, and the one that was spoken to last answers. An
answer has a checksum if the question had one. Set-points and `u` feed the watchdog, and nothing else does.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import Nanos, Obeyed
from protocols.odrive_ascii import table as at
from protocols.odrive_can import errors
from protocols.odrive_can.firmware import Memory, OdriveTwin, Twin05, Twin06, memory
from protocols.odrive_can.options import SETTING_OF, firmware_of, line_of, serial_of
from protocols.odrive_can.servo import gains_of
from protocols.odrive_can.table import ERASE, SAVING
from protocols.plugin import Device, FaultInfo, Twin
from protocols.toolkit.serial import Stream
from protocols.toolkit.table import Decoded

HARDWARE = {"0.5": "3.6-56V", "0.6": "5.2-0V"}
_NAMED = re.compile(r"[pqvctfu] (\d{1,6})$|[rw] axis(\d)\.")
ANSWER: Nanos = 200_000
"""Until an answer is sent"""


@dataclass(slots=True)
class AxisMemory:
    """What one axis makes of lines."""

    axis: Memory

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Return what the axis does on a line."""
        motor, values = self.axis.motor, decoded.values
        if decoded.address not in (self.axis.node, at.BOARD):
            return ()
        if decoded.name == "w":
            return (msg.WriteParameter(motor, values["name"], values["value"]),)
        limits = [
            msg.WriteParameter(motor, name, values[name])
            for name in ("vel_limit", "torque_lim")
            if name in values
        ]
        return *self.axis.obey(decoded._replace(address=self.axis.node)), *limits


def memory_of(device: Device) -> AxisMemory:
    """Return an axis as it is when switched on."""
    return AxisMemory(memory(device))


class _OnLines(OdriveTwin):
    """What both firmware lines do with lines of text."""

    feeds: tuple[str, ...] = ("Input",)
    reply_delay = ANSWER

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self._stream = Stream(at.TO_DEVICE)
        self.line = line_of(device)
        self.axes = {self.memory.node}
        """Of its board,"""
        self.addressed = self.memory.node
        """and the one that was spoken to last."""
        self.written: dict[str, float] = {}
        """Properties that were written, and mean nothing here."""

    def join(self, others: Sequence[Twin]) -> None:
        """Find the other axes of the board."""
        self.axes = {self.memory.node, *(each.memory.node for each in others if isinstance(each, _OnLines))}
        self.addressed = min(self.axes)

    @property
    def answers_for_board(self) -> bool:
        """True if it is this axis that answers what is asked of the board."""
        return self.addressed == self.memory.node

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        for message in self._stream.messages(frame) if isinstance(frame, bytes) else ():
            words = at.words_of(message)
            for answer in self._on_line(t, words, message) if words else ():
                checksum = b"*" in message.partition(b";")[0]
                text = answer.encode("ascii")
                self.reply(t, at.FROM_DEVICE.frame(text) if checksum else text + at.FROM_DEVICE.end)

    def cyclic(self) -> Mapping[str, Nanos]:
        return {}

    def _on_line(self, t: Nanos, words: Sequence[str], message: bytes) -> Sequence[str]:
        """Obey a line; return the answers."""
        decoded = at.LINES.decode(message)
        named = _NAMED.match(" ".join(words[:2]))
        if named is not None and (axis := int(named[1] or named[2])) in self.axes:
            self.addressed = axis
        board = self.answers_for_board
        match words[0]:
            case "f" | "u" | "p" | "q" | "v" | "c" | "t":
                if len(words) < 2 or not words[1].isdigit() or (decoded is None and words[0] not in "fu"):
                    return ["invalid command format"] * board
                axis = int(words[1][:6])
                if axis != self.memory.node:
                    return [f"invalid motor {axis}"] * (board and axis not in at.AXES)
            case "i":
                return self._info() if board else ()
            case "r" if len(words) > 1:
                return self._read(words[1])
        if words[0] == "f":
            encoder = self.servo.encoder
            return [f"{encoder.position:.6f} {encoder.velocity:.6f}"]
        if words[0] == "u":
            self.feed(t)
        elif decoded is not None and decoded.address in (self.memory.node, at.BOARD):
            return self._obey(t, decoded)
        elif decoded is None and board:
            known = at.LINES.name(message) or words[0] in ("w", "r")
            return ["invalid command format" if known else "unknown command"]
        return ()

    def _obey(self, t: Nanos, decoded: Decoded) -> Sequence[str]:
        values = decoded.values
        limits = {name: values.pop(name) for name in ("vel_limit", "torque_lim") if name in values}
        if "vel_limit" in limits:
            self.servo.configure([("vel_limit", limits["vel_limit"])])
        if decoded.name == "w":
            return self._write(values["name"], values["value"])
        self.on_message(t, decoded._replace(address=self.memory.node))
        return ()

    # -- properties -----------------------------------------------------------------------------------

    def _info(self) -> list[str]:
        serial = serial_of(self.settings, min(self.axes))
        return [
            f"Hardware version: {HARDWARE[self.line]}",
            f"Firmware version: {firmware_of(self.device)}",
            f"Serial number: {serial:012X}",
        ]

    def _read(self, name: str) -> Sequence[str]:
        found = re.fullmatch(r"axis(\d)\.(\S+)", name)
        board = self.answers_for_board
        if found is not None and int(found[1]) != self.memory.node:
            return ["invalid property"] * (board and int(found[1]) not in at.AXES)
        if found is None and not board:
            return ()
        value = self.properties().get(name if found is None else found[2], self.written.get(name))
        if value is None:
            return ["invalid property"]
        if isinstance(value, str):
            return [value]
        text = f"{value:.6f}" if isinstance(value, float) else f"{int(value)}"
        return [text[: at.CUT_OFF] if self.line == "0.5" else text]

    def properties(self) -> dict[str, float | str]:
        """Return what can be read, of the board and (without its name) of the axis."""
        names, signals, stage = at.PROPERTIES[self.line], self.signals(), self.servo.stage
        major, minor, revision = map(int, firmware_of(self.device).split("."))
        found: dict[str, float | str] = {
            "fw_version_major": major,
            "fw_version_minor": minor,
            "fw_version_revision": revision,
            at.SUPPLY: signals["Bus_Voltage"],
            "ibus": signals["Bus_Current"],
            "current_state": signals["Axis_State"],
            names["errors"]: signals["Axis_Error"],
            names["current"]: signals["Iq_Measured"],
            names["temperature"]: stage.stage_temperature,
            "motor.motor_thermistor.temperature": stage.motor_temperature,
            "controller.config.control_mode": self.memory.control_mode,
            "controller.config.input_mode": self.memory.input_mode,
        }
        for path, setting in SETTING_OF.items():
            value = getattr(self.settings, setting, None)  # None: of CAN alone
            if value is not None:
                found[path.removeprefix("axis0.")] = self.servo.gains.get(setting, value)
        return found

    def _write(self, name: str, value: float) -> Sequence[str]:
        local = name.removeprefix(f"axis{self.memory.node}.")
        setting = SETTING_OF.get(f"axis0.{local}", SETTING_OF.get(name, ""))
        if local not in self.properties():
            return ["invalid property"] if self.answers_for_board else ()
        if setting in self.servo.gains:
            self.servo.configure([(setting, value)])
        elif setting:
            kind = type(getattr(self.settings, setting))
            try:
                self.use(replace(self.settings, **{setting: kind(value)}))
            except ValueError:
                return ()
        return ()

    def restart(self, t: Nanos, silent: Nanos) -> None:
        """Restart: what was half received is lost."""
        super().restart(t, silent)
        self._stream.drop()


class Ascii06(_OnLines, Twin06):
    """An axis of firmware 0.6.x."""

    def properties(self) -> dict[str, float | str]:
        signals = self.signals()
        return super().properties() | {
            "disarm_reason": signals["Disarm_Reason"],
            "procedure_result": signals["Procedure_Result"],
        }

    def erased_node(self) -> int:
        """Return its number on the board, which stays."""
        return self.device.address


REPORTED05: Mapping[int, FaultInfo] = {
    code: info for code, info in errors.DEVICE05.items() if code not in errors.MOTOR.faults
}
"""The error word of a motor is a number of 64 bits, which this firmware does not print."""


class Ascii05(_OnLines, Twin05):
    """An axis of firmware 0.5.x."""

    faults = REPORTED05

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self._saved = gains_of(self.settings)

    def properties(self) -> dict[str, float | str]:
        signals, names = self.signals(), at.PROPERTIES["0.5"]
        words = {
            names[f"Get_{part}_Error"]: signals[f"{part}_Error"]
            for part in ("Encoder", "Controller", "Sensorless")
        }
        return super().properties() | words | {names["Get_Motor_Error"]: "lu"}

    def reboot(self, t: Nanos, action: int) -> None:
        """Restart with what was saved: over this line it can be."""
        if action == SAVING:
            self._saved = dict(self.servo.gains)
        elif action == ERASE:
            self._saved = gains_of(type(self.settings)())
        self.restart_with(t, self.device.address, self._saved, {})


def twin(device: Device, seed: int) -> OdriveTwin:
    """Return the twin of one axis, of the firmware line that it is configured to have."""
    return Ascii05(device, seed) if line_of(device) == "0.5" else Ascii06(device, seed)
