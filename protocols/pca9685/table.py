"""The registers of NXP's PCA9685: 16 outputs, each high from one count of 4096 to another, all of one period.

Rules. A channel of the chip at 0x40, as delivered, has its number as address; of another chip 100 times the
chip's address and its own: 6503 is channel 3 of the chip at 0x41. A write begins with the register; with
auto-increment the bytes behind it go to those that follow. Outputs change when a transfer ends. The prescaler
takes a value only while the chip sleeps, and then no output is driven.

Source: NXP PCA9685 data sheet, Rev. 4, chapters 7.1 to 7.6.
"""

from __future__ import annotations

from collections.abc import Mapping

from protocols.frames import Frame
from protocols.toolkit import i2c

BOARD = 100
"""Addresses of one chip"""
CHANNELS = range(16)
FIRST_CHIP = 0x40
CHIPS = range(0x40, 0x80)
"""By six pins; 0x70 is that to which all answer, as delivered"""

MODE1, MODE2, LED0, ALL_LED, PRE_SCALE = 0x00, 0x01, 0x06, 0xFA, 0xFE
NAMES: Mapping[int, str] = {MODE1: "MODE1", MODE2: "MODE2", PRE_SCALE: "PRE_SCALE"} | {
    0x02: "SUBADR1",
    0x03: "SUBADR2",
    0x04: "SUBADR3",
    0x05: "ALLCALLADR",
    0xFF: "TestMode",
}
"""Of registers that are not of an output (7.3, table 4)."""
SLEEP, AUTO_INCREMENT, RESTART = 0x10, 0x20, 0x80
"""Bits of MODE1"""
AWAKE = AUTO_INCREMENT
"""What it is written to be: no sleep, auto-increment, no further addresses"""
RESET_VALUES: Mapping[int, int] = {
    MODE1: SLEEP | 0x01,
    MODE2: 0x04,
    0x02: 0xE2,
    0x03: 0xE4,
    0x04: 0xE8,
    0x05: 0xE0,
    PRE_SCALE: 0x1E,
    **{LED0 + 4 * channel + 3: 0x10 for channel in CHANNELS},
}
"""Those that are not 0 when it is switched on"""
SOFTWARE_RESET = 0x06
"""The byte to the general call by which all chips begin anew (7.6)"""
COUNTS = 4096
FULL = 1 << 12
"""In a register of an output: on, or off, all of the time; off wins."""
LEAST_SCALE, MOST_SCALE = 3, 255


def chip(address: int) -> int:
    """Return the chip of a channel."""
    return address // BOARD or FIRST_CHIP


def channel(address: int) -> int:
    """Return the number of a channel on its chip."""
    return address % BOARD


def prescale(oscillator: float, frequency: float) -> int:
    """Return the value of the prescaler that makes a frequency, both in Hz (7.3.5)."""
    return max(LEAST_SCALE, min(MOST_SCALE, round(oscillator / (COUNTS * frequency)) - 1))


def register(number: int) -> str:
    """Return the name of a register, without the number of an output."""
    if LED0 <= number < LED0 + 4 * len(CHANNELS):
        return "LED"
    return "ALL_LED" if ALL_LED <= number < PRE_SCALE else NAMES.get(number, "reserved")


def led(output: int, on: int, off: int) -> bytes:
    """Return what is written to an output: the counts at which it goes on and off."""
    return bytes((LED0 + 4 * output,)) + on.to_bytes(2, "little") + off.to_bytes(2, "little")


def names(frame: Frame) -> tuple[str, ...]:
    """Return the names of what is written in a transfer, as `Plugin.messages` does."""
    found = i2c.parse(frame)
    if found is None:
        return ()
    if found.address == i2c.GENERAL_CALL:
        return ("SWRST",) if found.written == bytes((SOFTWARE_RESET,)) else ()
    return (register(found.written[0]),) if found.address in CHIPS else ()


def read_only(frame: Frame) -> bool:
    """True if a transfer changes nothing: it writes no more than which register is read."""
    found = i2c.parse(frame)
    return found is not None and found.address in CHIPS and len(found.written) == 1
