"""What a monitor knows, as text: one page, or one line per packet. Pure functions.

Rules. A number stands with its unit; what was never measured is "-", what is too old is marked as such, and
nothing is rounded to look good. A packet's line begins as in candump's log: time, bus, frame.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from gateway.core.message_text import escaped, message_text
from gateway.monitor.decoder import BusMonitor
from gateway.monitor.state import BusRecord, DecodedPacket, DeviceRecord
from protocols.frames import BusState, CanFrame, Packet
from protocols.messages import (
    MILLISECOND,
    SECOND,
    Event,
    Fault,
    Feedback,
    Measurement,
    Nanos,
    State,
)
from protocols.sensors import kinds, reading_text

MAX_UNKNOWN = 12
"""Number of unknown ids on the page; the busiest."""
MAX_BYTES = 24
"""Number of bytes of a serial packet that are shown in its line."""
NEGATIVE_ZERO = re.compile(r"(?<![\d.e])-0(?:\.0*)?(?![\d.])")
QUANTITIES = (
    ("position", "rad", 3),
    ("velocity", "rad/s", 3),
    ("torque", "N·m", 3),
    ("current", "A", 2),
    ("voltage", "V", 1),
    ("temperature", "°C", 1),
)
"""Of Feedback: field, unit, number of decimals."""


# -- the page -------------------------------------------------------------------------------------


def page(monitor: BusMonitor, now: Nanos, title: str) -> list[str]:
    """Return everything that is known now: buses, devices, unknown ids, answers."""
    blocks = [[title], _buses(monitor, now), _devices(monitor, now), _unknown(monitor, now)]
    if monitor.notes:
        blocks.append(["answers and discoveries:", *(f"  {message_text(event)}" for event in monitor.notes)])
    failed = [f"  {name}: {text}" for name, text in monitor.failures.items()]
    blocks.append(["defects of protocols, to be reported with these frames:", *failed] if failed else [])
    return [line for block in blocks if block for line in [*block, ""]][:-1]


def _buses(monitor: BusMonitor, now: Nanos) -> list[str]:
    rows = [_bus(monitor, bus, now) for bus in monitor.buses.values()]
    return columns([("bus", "interface", "state", "load", "packets", "total", "not understood"), *rows])


def _bus(monitor: BusMonitor, bus: BusRecord, now: Nanos) -> tuple[str, ...]:
    settings = bus.settings
    head = (settings.name, settings.interface)
    if bus.left_out:
        return *head, "left out"
    bitrate = settings.baudrate or settings.bitrate
    unit = f"{bitrate / 1e6:g} Mbit/s" if bitrate >= 1_000_000 else f"{bitrate / 1e3:g} kbit/s"
    load = f"{100 * bus.busy.per_second(now) / SECOND:.1f} % of {unit}"
    total, not_understood = bus.packets.total, monitor.not_understood(settings.name)
    state = "silent" if bus.state is BusState.UP and not total else str(bus.state)
    return *head, state, load, f"{bus.packets.per_second(now):.1f}/s", str(total), str(not_understood)


def _devices(monitor: BusMonitor, now: Nanos) -> list[str]:
    found = list(monitor.found.values())
    if not found:
        return ["no device on these buses" if monitor.known else "no device has been found yet"]
    if not monitor.known:
        found.sort(key=lambda record: record.place)
    texts = [feedback_texts(record.joint.feedback) if record.joint else {} for record in found]
    measured = [name for name, _, _ in QUANTITIES if any(name in text for text in texts)]
    rows = [("device", "protocol", "at", "state", "last message", *measured)]
    for record, text in zip(found, texts, strict=True):
        bus, protocol, address = record.place
        head = (record.name, protocol, f"{bus} {address}", _state(record, now))
        values = (text.get(name, "-") for name in measured)
        rows.append((*head, age_text(record.received_at, now), *values))
    table = columns(rows)
    lines = table[:1]
    for line, record in zip(table[1:], found, strict=True):
        lines += [line, *(f"    {detail}" for detail in _details(monitor, record, now))]
    return lines


def _state(record: DeviceRecord, now: Nanos) -> str:
    if record.received_at is None:
        return "no message yet"
    if record.silent(now):
        return "SILENT"
    if record.joint is None or State.__name__ not in record.kinds:
        return "sending"
    mode, detail = record.joint.mode, record.joint.detail
    return f"{mode}: {detail}" if detail else str(mode)


def _details(monitor: BusMonitor, record: DeviceRecord, now: Nanos) -> list[str]:
    """Return the lines below a device: what it measures, sends and is commanded; its faults."""
    lines = []
    if record.measurement is not None:
        lines.append(f"measures: {measurement_text(record.measurement)}")
    sent = [f"{what} {rate:.1f}/s" for what, rate in monitor.message_rates(record, now) if rate >= 0.05]
    if sent:
        lines.append(f"sends: {', '.join(sent)}")
    if record.command is not None and record.commands is not None:
        text = message_text(record.command)
        text = text.partition(": ")[2] or text  # without the name
        rate, age = record.commands.per_second(now), age_text(record.commanded_at, now)
        lines.append(f"is commanded: {text}, {rate:.1f}/s, {age}")
    lines += [f"FAULT: {fault_text(fault)}" for fault in record.faults.values()]
    return lines + [f"had a fault {age_text(f.t, now)}: {f.name}" for f in record.past_faults.values()]


def _unknown(monitor: BusMonitor, now: Nanos) -> list[str]:
    ids = monitor.unknown(now)
    if not ids:
        return []
    rows = [("unknown id", "on", "rate", "frames", "last", "age", "could be")]
    for (bus, _, _, _), record in ids[:MAX_UNKNOWN]:
        head, _, data = str(record.last).partition("#")
        rate, age = f"{record.rate.per_second(now):.1f}/s", age_text(record.received_at, now)
        rows.append((head, bus, rate, str(record.rate.total), f"#{data}", age, ", ".join(record.could_be)))
    hidden = len(ids) - MAX_UNKNOWN
    return columns(rows) + ([f"… and {hidden} more unknown ids"] if hidden > 0 else [])


def measurement_text(event: Measurement) -> str:
    """Return what a sensor measured, in short."""
    return escaped(reading_text(kinds().by_type[type(event)], event))


def feedback_texts(feedback: Feedback) -> dict[str, str]:
    """Return the measured quantities with their units, by field."""
    return {
        name: f"{value:.{digits}f} {unit}"
        for name, unit, digits in QUANTITIES
        if (value := getattr(feedback, name)) is not None
    }


def fault_text(fault: Fault) -> str:
    """Return a fault's name, likely cause and remedy."""
    cause = f"; likely cause: {fault.cause}" if fault.cause else ""
    return f"{fault.name}{cause}{f'; {fault.remedy}' if fault.remedy else ''}"


def age_text(t: Nanos | None, now: Nanos) -> str:
    """Return how long ago that was; "-" if it never was."""
    if t is None:
        return "-"
    span = max(0, now - t)
    return f"{span / MILLISECOND:.0f} ms ago" if span < SECOND else f"{span / SECOND:.1f} s ago"


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as aligned lines; a row with fewer cells does not widen the columns."""
    count = max(len(row) for row in rows)
    full = [row for row in rows if len(row) == count]
    widths = [max(len(row[i]) for row in full) for i in range(count)]
    lines = ("  ".join(f"{cell:<{widths[i]}}" for i, cell in enumerate(row)) for row in rows)
    return [line.rstrip() for line in lines]


# -- the line ---------------------------------------------------------------------------------------


def line(decoded: DecodedPacket) -> str:
    """Return `(12.345678) can0 029#0000803F00000000  <- ` and what it means."""
    packet = decoded.packet
    arrow = {"from": "<-", "to": "->", "": " ?"}[decoded.direction]
    return f"{time_text(packet.t)} {packet.bus} {_frame(packet)}  {arrow} {_meaning(decoded)}".rstrip()


def time_text(t: Nanos) -> str:
    """Return `(12.345678)`: seconds, to the microsecond."""
    return f"({t // SECOND}.{t % SECOND // 1000:06d})"


def _frame(packet: Packet) -> str:
    if isinstance(packet.frame, CanFrame):
        return str(packet.frame)
    shown = packet.frame[:MAX_BYTES].hex(" ").upper()
    return shown if len(packet.frame) <= MAX_BYTES else f"{shown} … {len(packet.frame)} bytes"


def _meaning(decoded: DecodedPacket) -> str:
    texts = [_event(event) for event in decoded.events] + [
        message_text(command) for command in decoded.commands
    ]
    texts += [f"{_event(event)} (a guess)" for event in decoded.guesses] + decoded.failures
    return NEGATIVE_ZERO.sub("0", "; ".join(texts)) or ", ".join(decoded.names)


def _event(event: Event) -> str:
    match event:
        case Measurement():
            return f"{event.sensor}: {measurement_text(event)}"
        case Fault():
            return f"{event.motor}: FAULT {fault_text(event)}"
    return message_text(event)
