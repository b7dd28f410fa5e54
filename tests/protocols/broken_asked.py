"""Plugins that are broken on purpose: drivers that send what nobody asked for, one for each protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from protocols import messages as msg
from protocols.conformance.bench import ALPHA, DriverWrapper, Messages
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Event, Nanos
from protocols.plain import table
from protocols.plugin import Device, Driver, Plugin, load
from tests.protocols.broken import BROKEN, motors


@dataclass
class Meddles(DriverWrapper):
    """Sends one more frame with each command."""

    more: Frame = b""

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Encode, and meddle."""
        events, frames = self.driver.send(now, messages)
        commanded = any(
            isinstance(each, msg.COMMANDS) and not isinstance(each, msg.Idle) for each in messages
        )
        return events, [*frames, self.more] if commanded else frames


@dataclass
class Clings(DriverWrapper):
    """Goes on with a set-point while it is to hold, or to stand."""

    last: tuple[Command, ...] = ()

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Encode the last velocities in place of Hold."""
        velocities = tuple(each for each in messages if isinstance(each, msg.Velocity) and each.velocity)
        self.last = velocities or self.last
        holds = any(isinstance(each, msg.Hold) for each in messages)
        return self.driver.send(now, self.last if holds and self.last else messages)


def register(plugin: Plugin, name: str, driver: Callable[[Driver], Driver]) -> None:
    """Register a plugin with another driver, which this clause finds."""

    def made(devices: Sequence[Device]) -> Driver:
        return driver(plugin.driver(devices))

    BROKEN.append((replace(plugin, name=name, driver=made), ("asked",)))


def can(text: str, *, fd: bool = False) -> CanFrame:
    """Return a frame by candump's notation."""
    number, _, data = text.partition("#")
    return CanFrame(int(number, 16), bytes.fromhex(data), len(number) > 3, False, fd, fd)


UNASKED: dict[str, tuple[str, Frame]] = {
    "odrive_can": ("raises_its_limits", can("02F#0024744900247449")),
    "cia402": ("raises_its_torque", can("601#2B726000FF7F0000")),
    "moteus": ("applies_voltage", can("00008001#010008", fd=True)),
    "damiao": ("switches_its_watchdog_off", can("7FF#0100550900000000")),
    "robstride": ("raises_its_torque", can("1200FD01#0B70000000247449")),
    "vesc": ("restarts_it", can("00000801#00001D")),
    "cubemars": ("brakes_by_current", can("00000201#0000EA60")),
    "myactuator": ("switches_its_watchdog_off", can("141#B300000000000000")),
    "robomaster": ("pushes", can("200#4000400000000000")),
    "zlac8015d": ("switches_its_watchdog_off", can("601#2B00200000000000")),
}
"""By protocol: what its driver does, and the frame."""
for _protocol, (_does, _frame) in UNASKED.items():
    register(load(_protocol), f"{_protocol}_{_does}", lambda driver, frame=_frame: Meddles(driver, frame))  # type: ignore[misc]
_WRITE = table.encode(1, msg.WriteParameter(ALPHA, "torque_limit", 99.0))
register(motors, "plain_raises_its_torque", lambda driver: Meddles(driver, _WRITE))
register(motors, "plain_goes_on_while_it_is_to_hold", Clings)
