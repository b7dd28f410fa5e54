"""A listener in words: one page for a person, one line for each packet. Pure functions.

Rules. A number stands with its unit; what was never measured is "-", what is too old is said to be so, and
nothing is rounded to look well. A packet's line begins as candump's log does: time, bus, frame.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from math import sqrt

from gateway.monitor.decoder import Listener
from gateway.monitor.state import Heard, Measured, Seen, SeenBus
from gateway.replay.diff import say
from protocols.frames import BusState, CanFrame, Packet
from protocols.messages import MILLISECOND, SECOND, Event, Fault, Imu, LaserScan, Nanos, State

MOST_UNKNOWN = 12
"""Unknown ids on the page; the busiest."""
MOST_BYTES = 24
"""Of a serial packet in its line."""
NEGATIVE_ZERO = re.compile(r"(?<![\d.e])-0(?:\.0*)?(?![\d.])")
QUANTITIES = (
    ("position", "rad", 3),
    ("velocity", "rad/s", 3),
    ("torque", "N·m", 3),
    ("current", "A", 2),
    ("voltage", "V", 1),
    ("temperature", "°C", 1),
)
"""Of Feedback: field, unit, digits behind the point."""


# -- the page -------------------------------------------------------------------------------------


def page(listener: Listener, now: Nanos, title: str) -> list[str]:
    """All that is known now."""
    blocks = [[title], _buses(listener, now), _devices(listener, now), _unknown(listener, now)]
    notes = [f"  {say(event)}" for event in listener.notes]
    if notes:
        blocks.append(["told on the buses:", *notes])
    return [line for block in blocks if block for line in [*block, ""]][:-1]


def _buses(listener: Listener, now: Nanos) -> list[str]:
    rows = [_bus(listener, bus, now) for bus in listener.buses.values()]
    return columns([("bus", "interface", "state", "load", "packets", "in all", "not understood"), *rows])


def _bus(listener: Listener, bus: SeenBus, now: Nanos) -> tuple[str, ...]:
    settings = bus.settings
    head = (settings.name, settings.interface)
    if bus.trouble:
        return *head, bus.trouble
    bits = settings.baudrate or settings.bitrate
    load = f"{100 * bus.busy.per_second(now) / SECOND:.1f} % of {_bits(bits)}"
    total, strange = bus.packets.total, listener.not_understood(settings.name)
    state = "silent" if bus.state is BusState.UP and not total else str(bus.state)
    return *head, state, load, f"{bus.packets.per_second(now):.1f}/s", str(total), str(strange)


def _bits(rate: int) -> str:
    return f"{rate / 1e6:g} Mbit/s" if rate >= 1_000_000 else f"{rate / 1e3:g} kbit/s"


def _devices(listener: Listener, now: Nanos) -> list[str]:
    found = list(listener.found.values())
    if not listener.known:
        found.sort(key=lambda seen: (seen.party.bus, seen.party.protocol, seen.party.address))
    if not found:
        return ["no device has been found yet" if not listener.known else "no device on these buses"]
    measured = [q for q in QUANTITIES if any(_value(seen, q[0]) is not None for seen in found)]
    heads = ("device", "language", "on", "state", "heard", *(f"{name}" for name, _, _ in measured))
    table = columns([heads, *(_device(seen, now, measured) for seen in found)])
    lines = table[:1]
    for line, seen in zip(table[1:], found, strict=True):
        lines += [line, *(f"    {more}" for more in _more(listener, seen, now))]
    return lines


def _device(seen: Seen, now: Nanos, measured: Sequence[tuple[str, str, int]]) -> tuple[str, ...]:
    party = seen.party
    place = f"{party.bus} at {party.address}"
    cells = [party.name, party.protocol, place, _state(seen, now), age(seen.received_at, now)]
    for name, unit, digits in measured:
        value = _value(seen, name)
        cells.append("-" if value is None else f"{value:.{digits}f} {unit}")
    return tuple(cells)


def _value(seen: Seen, quantity: str) -> float | None:
    value: float | None = getattr(seen.joint.feedback, quantity) if seen.joint else None
    return value


def _state(seen: Seen, now: Nanos) -> str:
    if seen.received_at is None:
        return "never heard"
    if seen.silent(now):
        return "SILENT"
    if seen.joint is None or State.__name__ not in seen.says:
        return "speaks"
    mode, detail = seen.joint.mode, seen.joint.detail
    return f"{mode}: {detail}" if detail else str(mode)


def _more(listener: Listener, seen: Seen, now: Nanos) -> list[str]:
    """Below a device: what it measures, says, was told, and complains of."""
    lines = []
    if seen.measured is not None:
        lines.append(f"measures: {measurement(seen.measured)}")
    said = [f"{what} {rate:.1f}/s" for what, rate in listener.messages(seen, now) if rate >= 0.05]
    if said:
        lines.append(f"says: {', '.join(said)}")
    if seen.command is not None and seen.commands is not None:
        rate, since = seen.commands.per_second(now), age(seen.commanded_at, now)
        lines.append(f"is told: {_without_name(say(seen.command))}, {rate:.1f}/s, {since}")
    lines += [f"FAULT: {fault(one)}" for one in seen.faults.values()]
    lines += [f"had a fault {age(one.t, now)}: {one.name}" for one in seen.past.values()]
    return lines


def _unknown(listener: Listener, now: Nanos) -> list[str]:
    ids = listener.unknown(now)
    if not ids:
        return []
    rows = [("unknown id", "on", "rate", "heard", "last", "age", "could be")]
    for (bus, _, _, _), seen in ids[:MOST_UNKNOWN]:
        head, _, data = str(seen.last).partition("#")
        rate, guess = f"{seen.rate.per_second(now):.1f}/s", ", ".join(seen.could_be)
        rows.append((head, bus, rate, str(seen.rate.total), f"#{data}", age(seen.at, now), guess))
    lines = columns(rows)
    return (
        lines if len(ids) <= MOST_UNKNOWN else [*lines, f"… and {len(ids) - MOST_UNKNOWN} more unknown ids"]
    )


def measurement(event: Measured) -> str:
    """What a sensor measured, short."""
    if isinstance(event, Imu):
        x, y, z = event.linear_acceleration
        turning = ", ".join(f"{rate:.3f}" for rate in event.angular_velocity)
        return f"turning {turning} rad/s, accelerated {x:.2f}, {y:.2f}, {z:.2f} m/s²"
    if isinstance(event, LaserScan):
        valid = [r for r in event.ranges if event.range_min <= r < event.range_max]
        nearest = f", the nearest at {min(valid):.3f} m" if valid else ""
        return f"{len(event.ranges)} beams, {len(valid)} hit something{nearest}"
    error = "" if event.variance is None else f", ±{sqrt(event.variance):.2f} m"
    return f"{event.latitude:.7f}°, {event.longitude:.7f}°{error}"


def fault(event: Fault) -> str:
    """A fault as its device's language tells it: name, likely cause, what to do."""
    cause = f"; likely cause: {event.cause}" if event.cause else ""
    return f"{event.name}{cause}{f'; {event.remedy}' if event.remedy else ''}"


def age(t: Nanos | None, now: Nanos) -> str:
    """How long ago that was; "-" if it never was."""
    if t is None:
        return "-"
    span = max(0, now - t)
    return f"{span / MILLISECOND:.0f} ms ago" if span < SECOND else f"{span / SECOND:.1f} s ago"


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines, each cell as wide as its column; a row that ends early does not widen the rest."""
    count = max(len(row) for row in rows)
    full = [row for row in rows if len(row) == count]
    widths = [max(len(row[i]) for row in full) for i in range(count)]
    lines = ("  ".join(f"{cell:<{widths[i]}}" for i, cell in enumerate(row)) for row in rows)
    return [line.rstrip() for line in lines]


# -- the line ---------------------------------------------------------------------------------------


def line(received: Heard) -> str:
    """One packet: time, bus, frame, direction, and what it means."""
    arrow = {"from": "<-", "to": "->", "": " ?"}[received.direction]
    return f"{start(received.packet)}  {arrow} {meaning(received)}".rstrip()


def start(packet: Packet) -> str:
    """`(12.345678) can0 029#0000803F00000000`"""
    return f"{stamp(packet.t)} {packet.bus} {_frame(packet)}"


def stamp(t: Nanos) -> str:
    """`(12.345678)`: seconds, to the microsecond."""
    return f"({t // SECOND}.{t % SECOND // 1000:06d})"


def _frame(packet: Packet) -> str:
    if isinstance(packet.frame, CanFrame):
        return str(packet.frame)
    shown = packet.frame[:MOST_BYTES].hex(" ").upper()
    return shown if len(packet.frame) <= MOST_BYTES else f"{shown} … {len(packet.frame)} bytes"


def meaning(received: Heard) -> str:
    """What a packet says or orders, in words."""
    words = [_event(event) for event in received.said] + [say(word) for word in received.reported]
    words += [f"{_event(event)} (a guess)" for event in received.guessed]
    return NEGATIVE_ZERO.sub("0", "; ".join(words)) or ", ".join(received.names)


def _event(event: Event) -> str:
    match event:
        case Imu() | LaserScan():
            return f"{event.sensor}: {measurement(event)}"
        case Fault():
            return f"{event.motor}: FAULT {fault(event)}"
    return say(event)


def _without_name(text: str) -> str:
    return text.partition(": ")[2] or text
