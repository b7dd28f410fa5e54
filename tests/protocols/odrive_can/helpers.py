"""One ODrive's twin alone, and messages to and from it by the vendor's names."""

from __future__ import annotations

from typing import Any, TypeAlias

from protocols.conformance.bench import Shaft
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Feedback, Nanos
from protocols.odrive_can import errors
from protocols.odrive_can import twin as make_twin
from protocols.odrive_can.options import Options, Settings
from protocols.odrive_can.table import ControlMode, InputMode, table_of
from protocols.plugin import Device
from protocols.toolkit.table import Values

V05 = Options(firmware="0.5")
ERROR = errors.ERRORS.bits
AXIS, MOTOR, CONTROLLER = errors.AXIS.bits, errors.MOTOR.bits, errors.CONTROLLER.bits

Message: TypeAlias = tuple[str, Values]
OF_05 = {row.name for row in table_of("0.5").rows} - {row.name for row in table_of("0.6").rows}


def fields(name: str, *numbers: float, line: str = "0.6") -> Values:
    """The fields of a message, in order."""
    row = table_of(line).row(name)
    return dict(zip((field.name for field in row.fields if field.name), numbers, strict=True))


def to(name: str, *numbers: float) -> Message:
    """A message to a device."""
    return name, fields(name, *numbers, line="0.5" if name in OF_05 else "0.6")


def encode(node: int, message: Message, extended: bool = False) -> CanFrame:
    """A message to a node."""
    name, numbers = message
    table = table_of("0.5" if extended or name in OF_05 else "0.6", extended)
    return table.encode(name, node, **numbers)


CLOSED, IDLE = to("Set_Axis_State", 8), to("Set_Axis_State", 1)


def device(
    name: str = "left", address: int = 1, settings: Settings | None = None, options: Options | None = None
) -> Device:
    """A device of the robot file."""
    return Device(name, address, options or Options(), settings or Settings())


def free_shaft() -> Shaft:
    """Half of 5 kg on a wheel of 0.05 m behind a gear of 8, and the rotor."""
    return Shaft(inertia=2.5 * 0.05**2 / 64 + 2e-5, friction=1e-4)


class TwinRig:
    """One twin at node 1, its shaft, and the frames that it sent."""

    def __init__(
        self, settings: Settings | None = None, options: Options | None = None, seed: int = 0
    ) -> None:
        self.twin: Any = make_twin(device(settings=settings, options=options), seed)
        """A Twin05 or Twin06, by the settings and options."""
        self.shaft = free_shaft()
        self.now: Nanos = 0
        self.frames: list[tuple[Nanos, CanFrame]] = []
        self.run(1)

    def send(self, *messages: Message, node: int = 1) -> None:
        """Send messages to a node."""
        for message in messages:
            self.receive(encode(node, message))

    def receive(self, frame: Frame) -> None:
        """Let the twin receive a frame."""
        self.twin.receive(self.now, frame)

    def run(self, milliseconds: int) -> None:
        """Step twin and shaft."""
        for _ in range(milliseconds):
            truth = Feedback("left", self.now, position=self.shaft.position, velocity=self.shaft.velocity)
            torques, frames = self.twin.step(self.now, [truth])
            self.frames += [(self.now, frame) for frame in frames if isinstance(frame, CanFrame)]
            self.shaft.turn(torques[0].torque, MILLISECOND)
            self.now += MILLISECOND

    def armed(self, mode: int = ControlMode.VELOCITY, input_mode: int = InputMode.PASSTHROUGH) -> TwinRig:
        """Arm the twin."""
        self.send(to("Set_Controller_Mode", mode, input_mode), CLOSED)
        self.run(5)
        assert self.twin.memory.armed
        return self

    def sent(self, cmd: int) -> list[tuple[Nanos, CanFrame]]:
        """The twin's frames of a command, with their times."""
        return [(t, frame) for t, frame in self.frames if frame.id & 0x1F == cmd]

    def reply(self, cmd: int, frame: CanFrame | None = None) -> Any:
        """The fields of the twin's reply to a remote frame, or another one, of a command; None: no reply."""
        before = len(self.sent(cmd))
        self.receive(frame or CanFrame(0x20 | cmd, remote=True))
        self.run(1)
        new = self.sent(cmd)[before:]
        return self.decoded(new[-1][1]) if new else None

    def decoded(self, frame: CanFrame) -> Any:
        """The fields of a message of the twin."""
        decoded = self.twin.table.decode(frame, "from_device")
        return decoded.values if decoded is not None else None

    def heartbeat(self) -> Any:
        """A heartbeat: in 0.6.x on request, in 0.5.x the next cyclic one."""
        if self.twin.memory.line == "0.6":
            return self.reply(0x01)
        before = len(self.sent(0x01))
        while len(self.sent(0x01)) == before:
            self.run(1)
        return self.decoded(self.sent(0x01)[-1][1])

    def outcome(self) -> tuple[int, int, str]:
        """Errors, state and result of a heartbeat of 0.6.x."""
        beat = self.heartbeat()
        result = errors.RESULT_NAMES[beat["Procedure_Result"]]
        return beat["Axis_Error"], beat["Axis_State"], result
