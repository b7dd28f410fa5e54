"""Boards that drive two motors each, at addresses in a row.

Rules. A motor has an address of its own in the robot file: the first of a board that of its board, the second
that and the number of boards there may be on a line, an address that no board has.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from protocols.bounds import Invalid
from protocols.plugin import Device
from protocols.toolkit.table import Decoded, Values

SIDES = 1, 2


@dataclass(frozen=True, slots=True)
class Boards:
    """The boards that can be on a line."""

    addresses: range
    """Of boards"""

    @property
    def motors(self) -> range:
        """Addresses of motors"""
        return range(self.addresses.start, self.addresses.stop + len(self.addresses))

    def board(self, motor: int) -> int:
        """Return the address of the board of a motor."""
        return motor - len(self.addresses) * (motor >= self.addresses.stop)

    def side(self, motor: int) -> int:
        """Return which motor of its board an address is: 1 or 2."""
        return 1 + (motor >= self.addresses.stop)

    def motor(self, board: int, side: int) -> int:
        """Return the address of a motor of a board."""
        return board + len(self.addresses) * (side - 1)

    def check(self, device: Device) -> None:
        """Raise ValueError if no motor can have this address."""
        low, middle, high = self.addresses.start, self.addresses.stop, self.motors.stop - 1
        if device.address not in self.motors:
            text = (
                f"address {device.address} of {device.name}: it must be its board's, {low} to {middle - 1}, "
            )
            text += f"or for the board's second motor that and {len(self.addresses)}, {middle} to {high}"
            raise Invalid(("address", text))

    def own(self, motor: int, decoded: Decoded) -> Values | None:
        """Return the numbers of a message that are for a motor, without its side in their names; None if it
        is for others: messages and numbers for one motor have 1 or 2 in their names."""
        sides = [int(each) for each in decoded.name if each in "12"]
        if decoded.address != self.board(motor) or (sides and self.side(motor) not in sides):
            return None
        other = str(sum(SIDES) - self.side(motor))
        return {name.rstrip("12"): v for name, v in decoded.values.items() if not name.endswith(other)}


def both(motors: Mapping[int, Mapping[str, float]]) -> dict[str, float]:
    """Return the numbers of a message for both motors of a board, from those of each, by side."""
    return {f"{name}{side}": value for side, each in motors.items() for name, value in each.items()}
