"""Messages of a plain line made from the README's tables alone: msgpack in Python, struct, a bitwise CRC-32.

Nothing of `protocols.plain` is used, so that these bytes do not come from the code under test.
"""

from __future__ import annotations

import struct

from msgpack.fallback import Packer

from protocols.transcripts.notation import tokens

# fmt: off
CODES: dict[str, int] = {
    "Idle": 1, "Hold": 2, "Position": 3, "Velocity": 4, "Torque": 5, "Impedance": 6, "ClearFault": 22,
    "Estop": 23, "Scan": 24, "SetId": 25, "Zero": 26, "ReadParameter": 28, "WriteParameter": 29, "Reboot": 30,
    "Feedback": 70, "State": 71, "Fault": 72, "Found": 73, "Done": 74, "Refused": 75, "Parameter": 76,
    "Imu": 77, "LaserScan": 78, "Fix": 79, "PoseReading": 80, "Marker": 81,
    "ShaftReading": 82,
}
# fmt: on


def packed(message: str, *values: object) -> bytes:
    """A message with these fields."""
    data: bytes = Packer().pack([CODES[message], *values])
    return data


def encoded(address: int, message: str, *values: object) -> bytes:
    """A message to or from an address: names stand empty, times are ages, ranges are binary strings."""
    return framed(bytes((address,)) + packed(message, *values))


def framed(body: bytes) -> bytes:
    """A body between sync bytes, length and CRC."""
    head = b"\xa5\x57" + struct.pack("<HH", len(body), len(body) ^ 0xFFFF)
    return head + body + struct.pack("<I", bitwise_crc(body))


def notation(text: str) -> bytes:
    """Messages as transcripts have them: `1 Velocity "" 1.0 0.5 + 2 Idle ""`.

    `[:9]` before it are its first 9 bytes, `[9:]` the others; `bad` makes its CRC wrong; `1 body`
    has any bytes as its body; bytes are a text ("noise") or hexadecimal digits (xa557)."""
    frames = b""
    for part in text.split(" + "):
        first, *rest = tokens(part)
        start, colon, stop = first.strip("[]").partition(":")
        if colon:
            frames += notation(" ".join(rest))[int(start or 0) : int(stop) if stop else None]
        elif first == "bad":
            frames += notation(" ".join(rest))[:-1] + b"\0"
        elif first[0] in 'x"':
            frames += bytes.fromhex(first[1:]) if first[0] == "x" else first.strip('"').encode()
        elif rest[0] == "body":
            frames += framed(bytes((int(first),)) + (notation(" ".join(rest[1:])) if rest[1:] else b""))
        else:
            frames += encoded(int(first), rest[0], *map(_value, rest[1:]))
    return frames


def _value(text: str) -> object:
    """A value: none, yes, no, a text, an integer, a number, numbers in brackets, ranges in parentheses."""
    if text[0] in "[(":
        numbers = [float(each) for each in text[1:-1].split(",") if each]
        return numbers if text[0] == "[" else ranges(*numbers)
    if text.startswith('"'):
        return text.strip('"')
    if text in ("none", "yes", "no"):
        return None if text == "none" else text == "yes"
    return float(text) if "." in text or "e" in text else int(text)


def ranges(*values: float) -> bytes:
    """The ranges of a scan."""
    return struct.pack(f"<{len(values)}d", *values)


def bitwise_crc(data: bytes) -> int:
    """CRC-32 of Ethernet: reflected 0x04C11DB7, one bit at a time."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF
