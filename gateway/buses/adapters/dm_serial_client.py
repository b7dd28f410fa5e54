"""The host's end of Damiao's serial CAN adapter, as an interface of python-can, which has none for it.

Rules. Frames are sent without a report. What is no packet is malformed, whatever its length; each kind of
error that the adapter reports is logged once. Its bit rate is its own configuration, and is not checked.
"""

from __future__ import annotations

import logging
from collections import deque

from gateway.buses.adapters.dm_serial import (
    ERRORS,
    FROM_ADAPTER,
    NOT_SENT,
    RECEIVED,
    PacketSplitter,
    decode_received,
    encode_send,
)
from gateway.buses.adapters.port import AdapterInterface
from protocols.frames import CanFrame

log = logging.getLogger("gateway")

BAUDRATE = 921_600


class DmSerialInterface(AdapterInterface):
    """An open adapter."""

    def __init__(self, channel: str) -> None:
        """Open the port exclusively. Raises OSError or ValueError."""
        super().__init__(channel, BAUDRATE)
        self._splitter = PacketSplitter(FROM_ADAPTER)
        self._frames: deque[CanFrame] = deque()
        """Received, not yet handed on."""
        self._logged: set[int] = set()
        self.channel_info = f"dm-serial {channel}"

    def _encode(self, frame: CanFrame) -> bytes:
        return encode_send(frame)

    def _feed(self, data: bytes) -> None:
        skipped = self._splitter.skipped
        for packet in self._splitter.feed(data):
            command, frame = decode_received(packet)
            if command == RECEIVED:
                self._frames.append(frame)
            elif command in ERRORS:
                self.refusals.refused += command == NOT_SENT
                self._log(command, packet)
        if self._splitter.skipped > skipped:
            raise ValueError(f"{self._splitter.skipped - skipped} bytes of no packet")

    def _log(self, command: int, packet: bytes) -> None:
        if command not in self._logged:
            self._logged.add(command)
            log.warning("%s reports: %s (%s)", self.channel_info, ERRORS[command], packet.hex(" "))

    def _next_frame(self) -> CanFrame | None:
        return self._frames.popleft() if self._frames else None
