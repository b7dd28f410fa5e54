"""The sentences of satellite receivers, NMEA 0183: GGA, RMC, VTG.

A sentence is `$`, two letters of the talker (GP, GN, GL, GA, GB …), three of its kind, fields behind commas,
`*`, the XOR of all between `$` and `*` in two hexadecimal figures, CR LF. A field that is not known is empty.

    GGA,time,latitude,N,longitude,E,quality,satellites,HDOP,altitude,M,geoid above the ellipsoid,M,age,station
    RMC,time,A or V,latitude,N,longitude,E,knots,course,date,variation,E,mode
    VTG,course,T,course,M,knots,N,km/h,K,mode

Source: pynmea2 1.19.0; fields as in the u-blox 8 / M8 receiver description, from memory.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

from protocols.messages import MILLISECOND, SECOND, Nanos
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.serial import xor8

NAME = "nmea"
LONGEST = 120
"""Bytes of a sentence; the standard has 82, some receivers more"""
DAY: Nanos = 86_400 * SECOND
KNOT = 1852.0 / 3600.0
"""m/s"""
QUALITIES = {
    0: "no fix",
    1: "fix",
    2: "DGPS fix",
    3: "PPS fix",
    4: "RTK fix",
    5: "float RTK fix",
    6: "dead reckoning",
    7: "entered by hand",
    8: "simulated",
}
FIXES = frozenset({1, 2, 3, 4, 5})
"""Qualities that are measured"""
_TEXT = re.compile(rb"[ -~]*")
_TIME = re.compile(r"([01]\d|2[0-3])([0-5]\d)([0-5]\d|60)(?:\.(\d{1,9}))?")
_PLACE = re.compile(r"(\d{2,3})([0-5]\d)(?:\.(\d{1,9}))?")
_NUMBER = re.compile(r"-?\d{1,7}(?:\.\d{1,9})?")


@dataclass(frozen=True, slots=True)
class Sentences:
    """How sentences stand on the line: a message is one between `$` and `*`."""

    def frame(self, message: bytes) -> bytes:
        """Return a sentence as it stands on the line."""
        return b"$%b*%02X\r\n" % (message, xor8(message))

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on, as every `FrameFormat`."""
        if held[at] != 0x24:
            found = held.find(b"$", at)
            return Rx.IGNORED, found if found >= 0 else len(held)
        end = held.find(b"\n", at, at + LONGEST)
        if end < 0 and len(held) - at <= LONGEST:
            return None, at
        last = held.rfind(b"$", at + 1, end if end >= 0 else at + LONGEST)
        if end < 0:
            return Rx.MALFORMED, last if last > 0 else at + LONGEST
        if last > 0 and _sound(held[last + 1 : end + 1]) is not None:
            return Rx.MALFORMED, last  # the one before has lost its end
        text = _sound(held[at + 1 : end + 1])
        return (Rx.MALFORMED if text is None else text), end + 1


def _sound(sentence: bytes) -> bytes | None:
    """Return what is before the checksum of a sentence, if it is right."""
    text, _, check = sentence.rpartition(b"*")
    return text if check == b"%02X\r\n" % xor8(text) and _TEXT.fullmatch(text) else None


SENTENCES = Sentences()


class Gga(NamedTuple):
    """Where it is, and how well that is known."""

    time: Nanos
    """UTC, of the day"""
    quality: int
    satellites: int
    hdop: float | None
    latitude: float
    longitude: float
    """Degrees"""
    altitude: float | None
    """m above the ellipsoid"""


class Motion(NamedTuple):
    """How it moves, of RMC and VTG."""

    valid: bool
    """RMC: A; VTG: there is a speed"""
    speed: float | None
    """m/s"""
    course: float | None
    """Degrees clockwise from true north"""
    time: Nanos | None = None
    """UTC, of the day: of RMC"""


def kind_of(fields: list[str]) -> str:
    """Return the kind of a sentence, of whatever talker; "" of one that is none of the standard."""
    head = fields[0]
    return head[2:] if len(head) == 5 and head.isalpha() and head[0] != "P" else ""


def gga(fields: list[str]) -> Gga | None:
    """Decode a GGA; None if it is none, or has a number that there is not. Without a fix its place is 0."""
    if len(fields) < 15:
        return None
    time, quality = day_time(fields[1]), number(fields[6])
    if time is None or quality is None or quality not in QUALITIES:
        return None
    latitude = degrees(fields[2], fields[3], "NS", 90.0)
    longitude = degrees(fields[4], fields[5], "EW", 180.0)
    satellites = round(number(fields[7]) or 0.0)
    if latitude is None or longitude is None:
        return None if int(quality) in FIXES else Gga(time, int(quality), satellites, None, 0.0, 0.0, None)
    above, geoid = number(fields[9]), number(fields[11])
    altitude = None if above is None else above + (geoid or 0.0)
    return Gga(time, int(quality), satellites, number(fields[8]), latitude, longitude, altitude)


def rmc(fields: list[str]) -> Motion | None:
    """Decode an RMC; None if it is none."""
    if len(fields) < 10 or fields[2] not in ("A", "V"):
        return None
    knots = number(fields[7])
    speed = None if knots is None else knots * KNOT
    return Motion(fields[2] == "A", speed, number(fields[8]), day_time(fields[1]))


def vtg(fields: list[str]) -> Motion | None:
    """Decode a VTG; None if it is none."""
    if len(fields) < 9 or fields[8] not in ("K", ""):
        return None
    knots = number(fields[5])
    return Motion(knots is not None, None if knots is None else knots * KNOT, number(fields[1]))


def day_time(text: str) -> Nanos | None:
    """Return hhmmss.ss as the time of the day."""
    found = _TIME.fullmatch(text)
    if found is None:
        return None
    hours, minutes, seconds, part = found.groups()
    nanos = int((part or "0").ljust(9, "0"))
    return (int(hours) * 3600 + int(minutes) * 60 + int(seconds)) * SECOND + nanos


def degrees(text: str, side: str, sides: str, most: float) -> float | None:
    """Return (d)ddmm.mmmm and its side as degrees; to the north and the east positive."""
    found = _PLACE.fullmatch(text)
    if found is None or side not in tuple(sides):
        return None
    whole, minutes, part = found.groups()
    value = int(whole) + float(f"{minutes}.{part or 0}") / 60.0
    if value > most:
        return None
    return (value if side == sides[0] else -value) or 0.0


def number(text: str) -> float | None:
    """Return a number; None if there is none."""
    return (float(text) or 0.0) if _NUMBER.fullmatch(text) else None


# -- as a receiver sends them ----------------------------------------------------------------------------


def clock(time: Nanos) -> str:
    """Return a time of the day as hhmmss.sss."""
    millis = time % DAY // MILLISECOND
    seconds, part = divmod(millis, 1000)
    return f"{seconds // 3600:02d}{seconds // 60 % 60:02d}{seconds % 60:02d}.{part:03d}"


def place(value: float, width: int, sides: str, decimals: int) -> str:
    """Return degrees as (d)ddmm.mmmm and their side; `width`: figures of whole degrees."""
    unit = 10**decimals
    whole, rest = divmod(round(abs(value) * 60.0 * unit), 60 * unit)
    minutes, part = divmod(rest, unit)
    return f"{whole:0{width}d}{minutes:02d}.{part:0{decimals}d},{sides[value < 0.0]}"


def encode(text: str) -> bytes:
    """Return a sentence as it stands on the line."""
    return SENTENCES.frame(text.encode("ascii"))
