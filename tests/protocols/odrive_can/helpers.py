"""A bench (`tests.protocols.helpers`) with an ODrive driver and twins of both firmware lines; one twin
alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from protocols.conformance.bench import Shaft
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Feedback, Nanos
from protocols.odrive_can import RANGES
from protocols.odrive_can import twin as make_twin
from protocols.odrive_can.codec import decode_from_device, encode
from protocols.odrive_can.driver import OdriveDriver
from protocols.odrive_can.messages import (
    ControlMode,
    InputMode,
    Message,
    SetAxisState,
    SetControllerMode,
)
from protocols.odrive_can.options import Options, Settings
from protocols.odrive_can.twin import OdriveTwin
from protocols.odrive_can.twin06 import Twin06
from protocols.plugin import Device
from tests.protocols.helpers import CanBench

V05 = Options(firmware="0.5")
CLOSED, IDLE = SetAxisState(8), SetAxisState(1)


def device(
    name: str = "left", address: int = 1, settings: Settings | None = None, options: Options | None = None
) -> Device:
    """A device of the robot file."""
    return Device(name, address, options or Options(), settings or Settings())


def free_shaft() -> Shaft:
    """Half of 5 kg on a wheel of 0.05 m behind a gear of 8, and the rotor."""
    return Shaft(inertia=2.5 * 0.05**2 / 64 + 2e-5, friction=1e-4)


class Bench(CanBench[OdriveDriver, OdriveTwin]):
    """An ODrive driver and its twins."""

    def __init__(self, devices: Sequence[Device]) -> None:
        twins = [make_twin(item, seed) for seed, item in enumerate(devices)]
        super().__init__(devices, OdriveDriver(devices, RANGES), twins, [free_shaft() for _ in devices])

    @property
    def twin(self) -> Twin06:
        """The first one, of firmware 0.6.x."""
        (first, *_) = self.twins
        assert isinstance(first, Twin06)
        return first


def ready(*devices: Device) -> Bench:
    """A bench whose devices are identified."""
    bench = Bench(devices or (device(),))
    bench.run(500 if any(item.options.firmware == "0.5" for item in bench.devices) else 300)
    assert all(axis.identity.line for axis in bench.driver.axes.values())
    return bench


class TwinRig:
    """One twin at node 1, its shaft, and the frames that it sent."""

    def __init__(
        self, settings: Settings | None = None, options: Options | None = None, seed: int = 0
    ) -> None:
        self.twin: Any = make_twin(device(settings=settings, options=options), seed)
        """A Twin05 or Twin06, by the settings and options."""
        self.line = self.twin.axis.line
        self.shaft = free_shaft()
        self.now: Nanos = 0
        self.frames: list[tuple[Nanos, CanFrame]] = []

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
        self.run(5)
        self.send(SetControllerMode(mode, input_mode), CLOSED)
        self.run(5)
        assert self.twin.axis.armed
        return self

    def sent(self, cmd: int) -> list[tuple[Nanos, CanFrame]]:
        """The twin's frames of a command, with their times."""
        return [(t, frame) for t, frame in self.frames if frame.id & 0x1F == cmd]

    def reply(self, cmd: int, frame: CanFrame | None = None) -> Any:
        """The twin's reply to a remote frame, or another one, of a command; None if there is none."""
        before = len(self.sent(cmd))
        self.receive(frame or CanFrame(0x20 | cmd, remote=True))
        self.run(1)
        new = self.sent(cmd)[before:]
        return decode_from_device(new[-1][1], self.line) if new else None

    def heartbeat(self) -> Any:
        """A heartbeat: in 0.6.x on request, in 0.5.x the next cyclic one."""
        if self.line == "0.6":
            return self.reply(0x01)
        before = len(self.sent(0x01))
        while len(self.sent(0x01)) == before:
            self.run(1)
        return decode_from_device(self.sent(0x01)[-1][1], self.line)
