"""What bytes look like that were sent at another baud rate than they are received at. Pure.

Why it can be seen. A receiver that is k times too fast sees each bit k times: behind the start bit, runs of k
equal bits. One that is much too fast sees little but zeros. One that is too slow samples across bits: its
bytes look random, and half of them lack their stop bit, which the driver of the port may count.
"""

from __future__ import annotations

from collections.abc import Sequence

ENOUGH = 24
"""Bytes that tell something."""
CLEAR = 0.85
"""Share of them that must fit."""
# fmt: off
STANDARD = (
    9600, 19200, 38400, 57600, 115200, 230400, 250000, 460800, 500000, 921600, 1000000, 1500000, 2000000,
    3000000, 4000000,
)
# fmt: on
"""bit/s that devices are delivered with."""
NEAR = 0.06
"""A rate this near to a standard one is that."""


def runs(data: bytes, times: int) -> float:
    """Return the share of bytes whose bits, from the start bit on, come in runs of this length."""
    if not data:
        return 0.0
    return sum(byte in _IN_RUNS[times] for byte in data) / len(data)


def _in_runs(times: int) -> frozenset[int]:
    bits = [[byte << 1 >> at & 1 for at in range(9)] for byte in range(256)]  # the first is the start bit
    groups = [slice(at, at + times) for at in range(0, 9, times)]
    return frozenset(byte for byte in range(256) if all(len(set(bits[byte][one])) == 1 for one in groups))


_IN_RUNS = {times: _in_runs(times) for times in range(2, 9)}


def sent_at(data: bytes, rate: int) -> Sequence[int]:
    """Return at which standard rates, lower than `rate`, bytes were sent that look like these; () if they do
    not look so."""
    if len(data) < ENOUGH:
        return ()
    if data.count(0) >= CLEAR * len(data):
        return [one for one in STANDARD if one * 7 < rate]
    for times in range(8, 1, -1):
        if runs(data, times) >= CLEAR:
            near = [one for one in STANDARD if abs(one * times / rate - 1.0) < NEAR]
            return near or [rate // times]
    return ()


def verdict(data: bytes, rate: int, errors: int = 0) -> str:
    """Return what bytes look like of which none is a message, received at `rate` bit/s; "": like nothing.

    `errors`: how many of them lacked their stop bit, as the port's driver counts."""
    if len(data) < ENOUGH:
        return ""
    if found := sent_at(data, rate):
        listed = ", ".join(map(str, found[-3:]))
        return f"they look like bytes sent at {listed} bit/s, and received at {rate}: another baud rate"
    if errors > 0.1 * len(data):
        return (
            f"{errors} of them lack their stop bit: they were sent at another baud rate than {rate} bit/s, "
            "most likely a higher one; or the line is noisy (termination, ground, bias)"
        )
    return ""
