"""Types of ROS 2's messages, services and actions: CDR both ways, and the hashes by which others know them.

Rules. Messages are those of `gateway.recording.ros_views`; services and actions are in `definitions`, as
their files have them in Jazzy and Kilted alike, and what ROS 2 makes of them (requests, responses, events,
goals with an id) is made here as rosidl makes it. Nothing here knows a transport.

Sources: rcl_interfaces 2.0 (parameters, action_msgs), std_srvs 5.3, nav2_msgs 1.3, control_msgs 5.4 (the
actions); REP-2011 and rosidl_generator_type_description for RIHS01; design.ros2.org/articles/actions.html.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from typing import TYPE_CHECKING, Any

from gateway.recording.ros_views import typestore
from gateway.ros.definitions import ACTIONS, MESSAGES, SERVICES

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

NOTHING = "uint8 structure_needs_at_least_one_member"
"""What an empty message has on the wire."""
SLACK = 4
"""Bytes that may follow a message: some writers pad."""


class Malformed(ValueError):
    """Bytes that are no message of their type."""


@cache
def store() -> Typestore:
    """Return all types; it takes some tenths of a second."""
    from rosbags.typesys import get_types_from_msg

    known = typestore()
    for name, (constants, fields) in known.fielddefs.items():  # rosidl takes a char for a number, as CDR does
        if "'char'" in repr(fields):
            known.fielddefs[name] = (
                constants,
                _renamed(fields, lambda text: "uint8" if text == "char" else text),
            )
    for name, text in _made().items():
        if name not in known.types:
            found = get_types_from_msg(text, name)
            known.register(_renamed(found, lambda each: each.replace("/srv/msg/", "/srv/")))
    return known


def _renamed(part: Any, rename: Callable[[str], str]) -> Any:  # noqa: ANN401 -- of any type
    """Return a part of a definition with names changed."""
    if isinstance(part, str):
        return rename(part)
    if isinstance(part, dict):
        return {rename(key): _renamed(value, rename) for key, value in part.items()}
    if isinstance(part, list | tuple):
        return type(part)(_renamed(one, rename) for one in part)
    return part


def _made() -> dict[str, str]:
    """Return the definition of every message that services and actions are made of."""
    found = dict(MESSAGES)
    services = dict(SERVICES)
    for name, text in ACTIONS.items():
        goal, result, feedback = text.split("---")
        found |= {f"{name}_Goal": goal, f"{name}_Result": result, f"{name}_Feedback": feedback}
        found[f"{name}_FeedbackMessage"] = f"{UUID} goal_id\n{name}_Feedback feedback"
        services[f"{name}_SendGoal"] = (
            f"{UUID} goal_id\n{name}_Goal goal\n---\nbool accepted\nbuiltin_interfaces/Time stamp"
        )
        services[f"{name}_GetResult"] = f"{UUID} goal_id\n---\nint8 status\n{name}_Result result"
    for name, text in services.items():
        request, response = (part.strip() or NOTHING for part in text.split("---"))
        found |= {f"{name}_Request": request, f"{name}_Response": response}
        found[f"{name}_Event"] = f"{EVENT} info\n{name}_Request[<=1] request\n{name}_Response[<=1] response"
        found[name] = "\n".join(f"{name}_{part} {part.lower()}_message" for part in PARTS)
    return found


UUID = "unique_identifier_msgs/UUID"
EVENT = "service_msgs/ServiceEventInfo"
PARTS = "Request", "Response", "Event"


def make(type_: str, **fields: Any) -> Any:  # noqa: ANN401 -- of any type
    """Return a message. Fields that are not given are empty, 0 or false."""
    kind = store().types[type_]
    return kind(**{name: fields.get(name, _default(desc)) for name, desc in store().fielddefs[type_][1]})


def _default(desc: Any) -> Any:  # noqa: ANN401 -- of any type
    import numpy as np
    from rosbags.interfaces import Nodetype

    kind, of = desc
    if kind == Nodetype.NAME:
        return make(of)
    if kind == Nodetype.BASE:
        return "" if of[0] == "string" else False if of[0] == "bool" else 0.0 if "float" in of[0] else 0
    inner, count = of
    if inner[0] == Nodetype.BASE and inner[1][0] != "string":
        return np.zeros(count if kind == Nodetype.ARRAY else 0, inner[1][0].replace("octet", "uint8"))
    return [_default(inner) for _ in range(count)] if kind == Nodetype.ARRAY else []


def prepare(types: Iterable[str]) -> None:
    """Make what reads and writes messages of these types now: the first of each takes milliseconds."""
    for type_ in types:
        store().get_msgdef(type_)


def encode(message: Any) -> bytes:  # noqa: ANN401
    """Return a message as CDR, with its encapsulation."""
    return bytes(store().serialize_cdr(message, message.__msgtype__, little_endian=True))


def decode(type_: str, data: bytes) -> Any:  # noqa: ANN401
    """Return the message of some bytes. Raises Malformed if they are none."""
    if data[:2] not in (b"\x00\x00", b"\x00\x01"):
        raise Malformed(f"an encapsulation {data[:2].hex()}: plain CDR is expected")
    why: Exception | None = None
    for cut in range(min(SLACK, len(data)) + 1):
        try:
            return store().deserialize_cdr(data[: len(data) - cut], type_)
        except Exception as error:  # noqa: BLE001 -- whatever bytes of others make a codec raise
            why = why or error
    raise Malformed(f"no {type_}: {why}")


@cache
def type_hash(type_: str) -> str:
    """Return the hash of a message's, or service's, type."""
    return store().hash_rihs01(type_)
