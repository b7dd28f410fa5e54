"""Messages as text: `left: Velocity 3.142 rad/s`; and what others wrote, safe to be shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields

from protocols.messages import Measurement, Message
from protocols.sensors import kinds

UNITS = {
    "position": "rad",
    "velocity": "rad/s",
    "torque": "N·m",
    "stiffness": "N·m/rad",
    "damping": "N·m·s/rad",
    "current": "A",
    "voltage": "V",
    "temperature": "°C",
    "linear": "m/s",
    "angular": "rad/s",
    "x": "m",
    "y": "m",
    "yaw": "rad",
}
"""By the name of a field; those of readings are their kind's."""
_NAMES = ("motor", "sensor", "bus", "name")
_LIST = 8
"""Values of a long tuple that are shown."""


def escaped(text: str, keep: str = "") -> str:
    r"""Return a text without control of a terminal: what is not printable as `\x1b`, but for `keep`."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else ascii(c)[1:-1] for c in text)


def message_text(message: Message, digits: int = 4) -> str:
    """Return a message's subject, kind, and the fields that are not at their default."""
    names = [field.name for field in fields(message)]
    subject = next((name for name in _NAMES if name in names), None)
    kind = type(message).__name__
    units = _units(type(message))
    parts = []
    for field in fields(message):
        value = getattr(message, field.name)
        is_default = field.default is not MISSING and value == field.default
        if field.name in (subject, "t") or value is None or is_default:
            continue
        label = "" if field.name == kind.lower() else f"{field.name} "
        unit = f" {units[field.name]}" if units.get(field.name) else ""
        parts.append(f"{label}{_value(value, digits)}{unit}")
    about = f"{getattr(message, subject)}: " if subject and getattr(message, subject) else ""
    return escaped(f"{about}{kind} {', '.join(parts)}".rstrip())


def _units(kind: type[Message]) -> Mapping[str, str]:
    if issubclass(kind, Measurement) and (sensor := kinds().by_type.get(kind)):
        return {name: quantity.unit for name, quantity in sensor.quantities.items()}
    return UNITS


def _value(value: object, digits: int) -> str:
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    if isinstance(value, tuple):
        more = f", … {len(value)} in all" if len(value) > _LIST else ""
        return f"({', '.join(_value(v, digits) for v in value[:_LIST])}{more})"
    return str(value)
