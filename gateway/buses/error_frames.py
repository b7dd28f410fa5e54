"""SocketCAN's error frames (linux/can/error.h): the bus state that they report, and a description of each.

Rules. An error frame is never data: its id is a set of classes, and its eight bytes give details of each.
Some of it changes the bus state; the rest is counted and logged. Pure functions over tables.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from protocols.frames import BusState


@dataclass(frozen=True, slots=True)
class CanError:
    """An error frame: its classes, and its data (eight bytes)."""

    classes: int
    data: bytes


TX_TIMEOUT, LOST_ARBITRATION, CONTROLLER, PROTOCOL, TRANSCEIVER = 0x001, 0x002, 0x004, 0x008, 0x010
NO_ACK, BUS_OFF, BUS_ERROR, RESTARTED, COUNTERS = 0x020, 0x040, 0x080, 0x100, 0x200
"""The classes (CAN_ERR_*)."""
PASSIVE, WARNING, ACTIVE = 0x30, 0x0C, 0x40
"""In data[1], of receiver and transmitter alike: error-passive, error-warning; error-active again."""

_CONTROLLER = {
    0x01: "receive buffer overflow: frames are lost",
    0x02: "transmit buffer overflow: frames are lost",
    0x04: "error-warning while receiving",
    0x08: "error-warning while sending",
    0x10: "error-passive while receiving",
    0x20: "error-passive while sending",
    0x40: "error-active again",
}
_PROTOCOL = {
    0x01: "single bit error",
    0x02: "form error",
    0x04: "bit stuffing error",
    0x08: "a dominant bit could not be sent",
    0x10: "a recessive bit could not be sent",
    0x20: "bus overload",
    0x40: "active error announcement",
}
_SENDING = 0x80
"""In data[2]: it happened while sending."""
_PLACES = {
    0x03: "start of frame",
    0x02: "id bits 28 to 21",
    0x06: "id bits 20 to 18",
    0x04: "substitute remote bit",
    0x05: "id extension bit",
    0x07: "id bits 17 to 13",
    0x0F: "id bits 12 to 5",
    0x0E: "id bits 4 to 0",
    0x0C: "remote bit",
    0x0D: "reserved bit 1",
    0x09: "reserved bit 0",
    0x0B: "data length code",
    0x0A: "data",
    0x08: "checksum",
    0x18: "checksum delimiter",
    0x19: "acknowledge slot",
    0x1B: "acknowledge delimiter",
    0x1A: "end of frame",
    0x12: "intermission",
}
_TRANSCEIVER = {
    0x04: "CAN-H is not connected",
    0x05: "CAN-H is shorted to the battery",
    0x06: "CAN-H is shorted to the supply",
    0x07: "CAN-H is shorted to ground",
    0x40: "CAN-L is not connected",
    0x50: "CAN-L is shorted to the battery",
    0x60: "CAN-L is shorted to the supply",
    0x70: "CAN-L is shorted to ground",
    0x80: "CAN-L is shorted to CAN-H",
}


def state_of(error: CanError) -> BusState | None:
    """Return the bus state that an error frame reports; None if it reports none."""
    if error.classes & BUS_OFF:
        return BusState.OFF
    if error.classes & RESTARTED:
        return BusState.BACK
    if error.classes & CONTROLLER:
        if error.data[1] & PASSIVE:
            return BusState.PASSIVE
        if error.data[1] & (ACTIVE | WARNING):  # the warning level is reached from above, too
            return BusState.UP
    return None


def kinds(error: CanError) -> Iterator[str]:
    """Describe each error in the frame, without the counters, which differ from one frame to the next."""
    classes, data = error.classes, error.data
    if classes & TX_TIMEOUT:
        yield "transmit timeout of the controller"
    if classes & LOST_ARBITRATION:
        yield "arbitration lost"
    if classes & CONTROLLER:
        yield from (text for bit, text in _CONTROLLER.items() if data[1] & bit)
    if classes & PROTOCOL:
        yield from _protocol(data[2], data[3])
    if classes & TRANSCEIVER:
        halves = (data[4] & 0x0F, data[4] & 0xF0)
        yield from (_TRANSCEIVER.get(half, f"transceiver error 0x{half:02X}") for half in halves if half)
    if classes & NO_ACK:
        yield "no acknowledgement (no other node is active)"
    if classes & BUS_OFF:
        yield "bus-off"
    if classes & BUS_ERROR and not classes & (PROTOCOL | NO_ACK):
        yield "bus error"
    if classes & RESTARTED:
        yield "restarted after bus-off"


def _protocol(kind: int, place: int) -> Iterator[str]:
    where = f", at: {_PLACES[place]}" if place in _PLACES else ""
    when = " while sending" if kind & _SENDING else ""
    found = [text for bit, text in _PROTOCOL.items() if kind & bit] or ["protocol violation"]
    yield from (f"{text}{when}{where}" for text in found)


def describe(error: CanError) -> str:
    """Describe an error frame in one line, with the controller's error counters where the frame has them."""
    text = "; ".join(kinds(error)) or f"error frame of class 0x{error.classes:X}"
    if error.classes & COUNTERS:
        text += f" (error counters: {error.data[6]} sending, {error.data[7]} receiving)"
    return text
