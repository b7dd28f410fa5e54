"""What is known of a kind of sensor: one table, read by what records, shows, carries or checks readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields
from typing import Any, TypeAlias, get_args, get_origin, get_type_hints

from protocols.messages import Measurement, Nanos

FIXED = (int, int | None, bool, str)
"""Types of the fields of a reading beside those of floats: `float`, `float | None`, and tuples of them."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """What a number of a reading is."""

    unit: str
    low: float
    high: float
    """The least and the greatest that is taken for a number, and not for damage."""


Content: TypeAlias = tuple[Sequence[float], Sequence[Sequence[float]]]
"""Numbers, then arrays of float32, in the order of a ROS message's definition."""


@dataclass(frozen=True, slots=True)
class RosView:
    """Readings as a ROS 2 message: a std_msgs/Header, numbers, and at the end arrays of float32."""

    topic: str
    type: str
    """package/msg/Name"""
    numbers: str
    """Types of the numbers after the header, by the letters of `struct`, without padding: "bH12dB"."""
    content: Callable[[Any], Content]
    """Of a reading. A number that does not fit its type is clamped."""
    frame: str = ""
    """In which the reading is; "": the sensor's own."""
    definition: str = ""
    """Of a type that is not among ROS 2's own: the text of its .msg file."""


@dataclass(frozen=True, slots=True)
class SensorKind:
    """One kind of sensor: the object that an entry point names."""

    name: str
    message: type[Measurement]
    """The class of its readings, made by `protocols.messages.value`."""
    quantities: Mapping[str, Quantity]
    """By field: every float, and those integers that are measured."""
    sample: Callable[[str, Nanos, int], Measurement]
    """Return what a sensor of this name measures at a time, with other numbers for each count, and nothing
    left out: for the contract, and whoever shows what a reading looks like."""
    text: Callable[[Any], str] | None = None
    """Return a reading in short; None: its numbers with their units."""
    ros: RosView | None = None
    code: int | None = None
    """First element of a packed reading; None: its name, as of every kind that is not ours."""
    agrees: Callable[[Any, Any, float], bool] | None = None
    """Return whether a reading is what a device that measures at places of its own reports of a true one,
    each number within an error; None: each of its numbers is the true one."""
    added: tuple[object, ...] = field(default=())
    """Defaults of fields that were added at the end of the message: older recordings lack them."""


def reading_text(kind: SensorKind, reading: Measurement) -> str:
    """Return what a sensor measured, in short; what is wrong with the kind's own text, if that raises."""
    try:
        return kind.text(reading) if kind.text else _numbers_text(kind, reading)
    except Exception as error:  # noqa: BLE001 -- a third party's function may raise anything
        return f"(the text of {kind.name} fails: {type(error).__name__}: {error})"


def _numbers_text(kind: SensorKind, reading: Measurement) -> str:
    parts = []
    for name, quantity in kind.quantities.items():
        value = getattr(reading, name)
        if isinstance(value, tuple):
            shown = ", ".join(f"{number:.4g}" for number in value[:4]) + (", …" if len(value) > 4 else "")
        else:
            shown = "" if value is None else f"{value:.4g}"
        parts += [f"{name} {shown} {quantity.unit}".rstrip()] if shown else []
    return ", ".join(parts)


def mistake(kind: object, name: str) -> str:
    """Return what is wrong with an object that an entry point of this name leads to, "" if nothing. Raises
    whatever its sample, text and ROS view raise."""
    if not isinstance(kind, SensorKind):
        return "it is not a protocols.sensors.SensorKind"
    if kind.name != name:
        return f"its entry point is called {name!r}, and it calls itself {kind.name!r}"
    if kind.code is not None:
        return "it has a code, as only our own kinds have: its readings are recorded by its name"
    message = kind.message
    if not (isinstance(message, type) and issubclass(message, Measurement) and "__slots__" in vars(message)):
        return "its message is not a class made by protocols.messages.value from a Measurement"
    if hasattr(message, "__post_init__"):
        return f"{message.__name__} has a __post_init__: a message is a value, and checks nothing"
    return _mistake_in_fields(kind) or _mistake_in_samples(kind)


def _mistake_in_fields(kind: SensorKind) -> str:
    message = kind.message
    hints = get_type_hints(message)
    own = fields(message)
    if [f.name for f in own[:2]] != ["sensor", "t"]:
        return f"the first fields of {message.__name__} are not sensor and t"
    for f in own[2:]:
        if not (_of_floats(hints[f.name]) or hints[f.name] in FIXED):
            return f"{message.__name__}.{f.name} is a {hints[f.name]}: no message can hold that"
        if _of_floats(hints[f.name]) and f.name not in kind.quantities:
            return f"{message.__name__}.{f.name} has no unit, and no least and greatest value"
        if f.name == "duration" and hints[f.name] is not int:
            return f"{message.__name__}.duration is no int, of nanoseconds"
    unknown = kind.quantities.keys() - {f.name for f in own}
    return f"{message.__name__} has no {sorted(unknown)[0]}" if unknown else ""


def _of_floats(hint: object) -> bool:
    parts = [part for part in get_args(hint) if part is not type(None)]
    if hint is float or parts == [float]:
        return True
    if get_origin(hint) is tuple:
        return all(item in (float, Ellipsis) for item in get_args(hint))
    return len(parts) == 1 and get_origin(parts[0]) is tuple and _of_floats(parts[0])


def _mistake_in_samples(kind: SensorKind) -> str:
    """Try what is the third party's own: sample, text, ROS view."""
    reading = kind.sample("sensor", 0, 1)
    if type(reading) is not kind.message:
        return f"its sample is a {type(reading).__name__}, not a {kind.message.__name__}"
    if kind.text is not None and not isinstance(kind.text(reading), str):
        return "its text is no string"
    if kind.ros is not None:
        kind.ros.content(reading)
    return ""


def shaped(kind: SensorKind, sensor: str, t: Nanos, values: Mapping[str, float]) -> Measurement:
    """Return a reading with these numbers, of a tuple's items every other one half of it; what may be left
    out and is not among them is."""
    made: Any = kind.sample(sensor, t, 1)
    changes = {f.name: _shaped(kind, made, f, values) for f in fields(made)[2:]}
    return kind.message(sensor, t, **changes)


def _shaped(kind: SensorKind, made: Measurement, f: Field[Any], values: Mapping[str, float]) -> object:
    sample = getattr(made, f.name)
    if f.name not in values:
        return sample if f.name not in kind.quantities or f.default is MISSING else f.default
    value, quantity = values[f.name], kind.quantities[f.name]
    if isinstance(sample, tuple):
        halves = [value * (1.0, 0.5)[at % 2] for at in range(len(sample))]
        return tuple(max(quantity.low, min(quantity.high, each)) for each in halves)
    return round(value) if isinstance(sample, int) else value
