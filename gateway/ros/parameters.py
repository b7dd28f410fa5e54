"""The parameter protocol of ROS 2: what can be set of the robot while it runs, as parameters of our node.

Rules. Parameters are the rows of `Scene.settings`: numbers with bounds. They are listed, read and described;
to set one is an operator's `set`, whose answer is whether it was accepted: what the robot makes of it is in
/rosout. A name that there is not is answered as rcl does: "not set".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from gateway.ros.types import make
from gateway.view.scene import Json

NOT_SET, DOUBLE, INTEGER = 0, 3, 2
Ask = Callable[[str], str]
"""Asks for a line; returns why not, or "".."""


def answer(service: str, request: Any, rows: Sequence[Json], ask: Ask) -> Any:  # noqa: ANN401 -- messages
    """Return the response of one of the services of a node's parameters."""
    known = {row["key"]: row for row in rows}
    response = f"rcl_interfaces/srv/{_camel(service)}_Response"
    match service:
        case "list_parameters":
            names = [n for n in known if _listed(n, request.prefixes, request.depth)]
            prefixes = sorted({n.rpartition(".")[0] for n in names if "." in n})
            result = make("rcl_interfaces/msg/ListParametersResult", names=names, prefixes=prefixes)
            return make(response, result=result)
        case "get_parameters":
            return make(response, values=[_value(known.get(name)) for name in request.names])
        case "get_parameter_types":
            import numpy as np

            return make(
                response, types=np.array([_type(known.get(name)) for name in request.names], np.uint8)
            )
        case "describe_parameters":
            return make(response, descriptors=[_described(name, known.get(name)) for name in request.names])
        case "set_parameters":
            return make(response, results=[_set(one, known, ask) for one in request.parameters])
    wrong = [why for one in request.parameters if (why := _wrong(one, known))]
    results = [_result(wrong[0])] if wrong else [_set(one, known, ask) for one in request.parameters]
    return make(response, result=next((one for one in results if not one.successful), _result("")))


def _camel(name: str) -> str:
    return "".join(part.capitalize() for part in name.split("_"))


def _listed(name: str, prefixes: Sequence[str], depth: int) -> bool:
    inner = [name.removeprefix(p + ".") for p in prefixes if name.startswith(p + ".") or name == p]
    rest = (name if not prefixes else inner[0]) if not prefixes or inner else None
    return rest is not None and (depth == 0 or rest.count(".") < depth)


def _type(row: Json | None) -> int:
    return NOT_SET if row is None else DOUBLE if isinstance(row["value"], float) else INTEGER


def _value(row: Json | None) -> Any:  # noqa: ANN401
    field = {DOUBLE: "double_value", INTEGER: "integer_value"}.get(_type(row))
    values = {field: row["value"]} if row is not None and field else {}
    return make("rcl_interfaces/msg/ParameterValue", type=_type(row), **values)


def _described(name: str, row: Json | None) -> Any:  # noqa: ANN401
    ranges = []
    if row is not None and _type(row) == DOUBLE and {"low", "high"} <= row.keys():
        ranges.append(
            make(
                "rcl_interfaces/msg/FloatingPointRange",
                from_value=float(row["low"]),
                to_value=float(row["high"]),
            )
        )
    text = "" if row is None else f"in the robot file: {row['file']:g}"
    return make(
        "rcl_interfaces/msg/ParameterDescriptor",
        name=name,
        type=_type(row),
        description=text,
        floating_point_range=ranges,
    )


def _number(value: Any) -> float | None:  # noqa: ANN401
    kind = int(value.type)
    return (
        float(value.double_value)
        if kind == DOUBLE
        else float(value.integer_value)
        if kind == INTEGER
        else None
    )


def _wrong(one: Any, known: Mapping[str, Json]) -> str:  # noqa: ANN401
    if one.name not in known:
        return f"there is no parameter {one.name[:60]!r}"
    return "" if _number(one.value) is not None else f"{one.name} is a number"


def _set(one: Any, known: Mapping[str, Json], ask: Ask) -> Any:  # noqa: ANN401
    return _result(_wrong(one, known) or ask(f"set {one.name} {_number(one.value)!r}"))


def _result(why: str) -> Any:  # noqa: ANN401
    return make("rcl_interfaces/msg/SetParametersResult", successful=not why, reason=why)
