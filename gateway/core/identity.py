"""Whether the device of a joint is the one that the robot file demands, by its serial number."""

from __future__ import annotations


class DeviceIdentity:
    """The identity of one device. State is plain data."""

    def __init__(self, demanded: str) -> None:
        """`demanded`: in hexadecimal digits; "": any device will do."""
        self._demanded = int(demanded, 16) if demanded else None
        self._serial: int | None = None
        """As read since it was last silent."""

    @property
    def unknown(self) -> bool:
        """Whether a serial number is demanded, and none has been read."""
        return self._demanded is not None and self._serial is None

    def take(self, serial: int) -> None:
        """Take the serial number that answers for the device; one that is wrong stays until it is silent."""
        if self._serial in (None, self._demanded):
            self._serial = serial

    def forget(self) -> None:
        """Forget what was read: it may be another device when it is back."""
        self._serial = None

    def wrong(self) -> str:
        """Return in words why it is another device; "" if it is not, as far as is known."""
        if self._demanded is None or self._serial in (None, self._demanded):
            return ""
        return f"serial number {self._serial:X}, the robot file demands {self._demanded:X}"
