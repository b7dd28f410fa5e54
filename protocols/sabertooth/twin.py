"""The device's end: what a motor of a board obeys, and the board's firmware.

Rules. The board puts a share of its supply on the motor, whatever that then does: the speed sags under load.
Any message to the board feeds its serial timeout, if it has one. Mixed commands are obeyed once both of a
pair have come, as on the board. It never sends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.messages import MILLISECOND, Mode, Nanos, Obeyed
from protocols.plugin import Device, FaultInfo
from protocols.sabertooth import table as st
from protocols.sabertooth.options import Options
from protocols.toolkit.packets import PacketFirmware
from protocols.toolkit.servo import Gains, clamp
from protocols.toolkit.table import Decoded

SENT = frozenset({"M1FORWARD", "M1REVERSE", "M2FORWARD", "M2REVERSE"})
"""Those that are sent here."""


@dataclass(slots=True)
class Motor:
    """What a motor makes of the bytes on its line."""

    name: str
    address: int
    options: Options
    mixed: dict[str, float] = field(default_factory=dict)
    """Shares of "drive" and "turn", as far as they have come."""

    def share(self, decoded: Decoded) -> float | None:
        """Return the share of the power that a message puts on the motor; None: it changes nothing."""
        name, side = decoded.name, str(st.BOARDS.side(self.address))
        value = decoded.values.get("value", 0) / st.FULL
        centred = max(2.0 * decoded.values.get("value", 0) - 2 * 64, -st.FULL) / (st.FULL - 1)
        if name.startswith("MIXED"):
            drive = name.endswith(("FORWARD", "REVERSE", "DRIVE"))
            signed = centred if name.endswith(("DRIVE", "TURN")) else value
            signed = -signed if name.endswith(("REVERSE", "LEFT")) else signed
            self.mixed["drive" if drive else "turn"] = signed
            if len(self.mixed) < 2:
                return None
            turn = self.mixed["turn"] if side == "1" else -self.mixed["turn"]
            return clamp(self.mixed["drive"] + turn, 1.0)
        if not name.startswith(f"M{side}"):
            return None
        return (
            clamp(centred, 1.0)
            if name.endswith("7BIT")
            else -value or 0.0
            if name.endswith("REVERSE")
            else value
        )

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Return what it does on a message."""
        if decoded.name == "AUTOBAUD" or decoded.address != st.BOARDS.board(self.address):
            return ()
        name, share = self.name, self.share(decoded)
        if decoded.name == "SERIALTIMEOUT":
            return (msg.Kept(name, decoded.name, float(decoded.values["value"])),)
        if share is None:
            other = decoded.name[:2] in ("M1", "M2")
            return () if other else (msg.Kept(name, decoded.name, float(decoded.values["value"])),)
        unused = () if decoded.name in SENT else (msg.Kept(name, decoded.name, share),)
        if not share and not decoded.name.endswith("REVERSE"):
            return *unused, msg.Idle(name)
        return *unused, msg.Arm(name), msg.Velocity(name, share * self.options.full_scale)


def motor_of(device: Device) -> Motor:
    """Return a motor as it is when its board is switched on."""
    return Motor(device.name, device.address, device.options)


class SabertoothTwin(PacketFirmware):
    """One motor, and its half of the board."""

    faults: Mapping[int, FaultInfo] = {}
    messages = st.PACKETS

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed, Gains(torque_limit=device.settings.max_torque), motor_of(device))
        self.serial_timeout = 0
        """0.1 s; 0: off"""

    def timeout(self) -> Nanos:
        timeout = self.serial_timeout * st.TIMEOUT_UNIT_MS * MILLISECOND
        return timeout if self.mode is Mode.ARMED else 0

    def takes(self, decoded: Decoded) -> bool:
        return decoded.address == st.BOARDS.board(self.device.address)

    def on_message(self, t: Nanos, message: bytes, decoded: Decoded) -> None:
        self.feed(t)
        if decoded.name == "SERIALTIMEOUT":
            self.serial_timeout = decoded.values["value"]
        super().on_message(t, message, decoded)

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        super().cycle(now, dt, position, velocity)
        if self.mode is not Mode.ARMED or not isinstance(self.goal, msg.Velocity):
            return 0.0
        settings = self.settings
        behind = self.goal.velocity * settings.share - velocity
        torque: float = settings.torque_constant**2 / settings.resistance * behind
        return clamp(torque, settings.max_torque)
