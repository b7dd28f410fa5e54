"""What a CAN controller says of itself in SocketCAN's error frames (linux/can/error.h): in states, in words.

Rules. An error frame is never data: its id is a set of classes, and its eight bytes say more of each. Some of
it changes the bus's state; the rest is counted and told in words. Pure functions over tables.
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
"""In data[1], of the receiver and the transmitter alike: error-passive, warning; error-active again."""

_CONTROLLER = {
    0x01: "its receive buffer overflowed: frames are lost",
    0x02: "its transmit buffer overflowed: frames are lost",
    0x04: "many errors while receiving (warning)",
    0x08: "many errors while sending (warning)",
    0x10: "error-passive while receiving",
    0x20: "error-passive while sending",
    0x40: "error-active again",
}
_PROTOCOL = {
    0x01: "a single bit error",
    0x02: "a frame of a wrong form",
    0x04: "a bit stuffing error",
    0x08: "a dominant bit could not be sent",
    0x10: "a recessive bit could not be sent",
    0x20: "a bus overload",
    0x40: "an active error announcement",
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
    """The state that the line is in after this; None if it says nothing of that."""
    if error.classes & BUS_OFF:
        return BusState.OFF
    if error.classes & RESTARTED:
        return BusState.BACK
    if error.classes & CONTROLLER:
        if error.data[1] & PASSIVE:
            return BusState.PASSIVE
        if error.data[1] & (ACTIVE | WARNING):  # a warning level is reached from above, too
            return BusState.UP
    return None


def kinds(error: CanError) -> Iterator[str]:
    """What it says, a few words for each thing, without numbers that differ from one to the next."""
    classes, data = error.classes, error.data
    if classes & TX_TIMEOUT:
        yield "the controller did not send in time"
    if classes & LOST_ARBITRATION:
        yield "arbitration was lost"
    if classes & CONTROLLER:
        yield from (words for bit, words in _CONTROLLER.items() if data[1] & bit)
    if classes & PROTOCOL:
        yield from _protocol(data[2], data[3])
    if classes & TRANSCEIVER:
        halves = (data[4] & 0x0F, data[4] & 0xF0)
        yield from (_TRANSCEIVER.get(half, f"transceiver error 0x{half:02X}") for half in halves if half)
    if classes & NO_ACK:
        yield "nobody acknowledged what was sent"
    if classes & BUS_OFF:
        yield "bus-off"
    if classes & BUS_ERROR and not classes & (PROTOCOL | NO_ACK):
        yield "an error on the bus"
    if classes & RESTARTED:
        yield "restarted after bus-off"


def _protocol(kind: int, place: int) -> Iterator[str]:
    where = f", at: {_PLACES[place]}" if place in _PLACES else ""
    when = " while sending" if kind & _SENDING else ""
    found = [words for bit, words in _PROTOCOL.items() if kind & bit] or ["a protocol violation"]
    yield from (f"{words}{when}{where}" for words in found)


def counters(error: CanError) -> tuple[int, int] | None:
    """The controller's error counters (sending, receiving), where the frame brings them."""
    return (error.data[6], error.data[7]) if error.classes & COUNTERS else None


def sentence(error: CanError) -> str:
    """All of it in one line."""
    said = "; ".join(kinds(error)) or f"error frame of class 0x{error.classes:X}"
    count = counters(error)
    return f"{said} (error counters: {count[0]} sending, {count[1]} receiving)" if count else said
