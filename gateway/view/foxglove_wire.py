"""The bytes and texts of the Foxglove WebSocket protocol. Pure functions; numbers are little-endian.

After foxglove/ws-protocol, docs/spec.md (subprotocol foxglove.websocket.v1), and foxglove/foxglove-sdk, which
answers to foxglove.sdk.v1: the same, and playback. Lengths, ids and numbers of a client are checked here;
what is wrong raises `WireError`, whose text is for the client.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from math import atan2, isfinite
from typing import Any, TypeAlias

from gateway.config.text import read_json as json_object
from gateway.view.scene import Json
from protocols.messages import SECOND, Nanos

SDK, V1 = "foxglove.sdk.v1", "foxglove.websocket.v1"
SUBPROTOCOLS = (SDK, V1)
INFO, WARNING, ERROR = 0, 1, 2
"""Levels of a status."""
PLAYING, PAUSED, ENDED = 0, 1, 3
"""States of a playback."""
UINT32, UINT64 = 2**32 - 1, 2**64 - 1
MAX_TEXT = 500
"""Characters of a status."""
MAX_ROWS = 100
"""Subscriptions, channels or parameters in one message: each may be answered."""

_MESSAGE = struct.Struct("<BIQ")
_TIME = struct.Struct("<BQ")
_SERVICE = struct.Struct("<BIII")
_CHANNEL = struct.Struct("<BI")
_PLAY = struct.Struct("<BBfBQI")
_PLAYBACK = struct.Struct("<BBQfBI")


class WireError(ValueError):
    """A client's message that is none, and why."""


# -- to a client ----------------------------------------------------------------------------------


def text(op: str, content: Json) -> str:
    """Return a message in JSON."""
    return json.dumps({"op": op} | content, separators=(",", ":"), allow_nan=False, default=float)


def status(level: int, message: str, name: str = "") -> str:
    """Return a status; of those of one name, the newest counts."""
    content = {"level": level, "message": message[:MAX_TEXT]}
    return text("status", content | {"id": name} if name else content)


def data(subscription: int, t: Nanos, payload: bytes) -> bytes:
    """Return a message of a channel."""
    return _MESSAGE.pack(1, subscription, clamp(t)) + payload


def time(t: Nanos) -> bytes:
    """Return the time that it is."""
    return _TIME.pack(2, clamp(t))


def response(service: int, call: int, answer: Json) -> bytes:
    """Return the answer to a call."""
    return _SERVICE.pack(3, service, call, 4) + b"json" + json.dumps(answer).encode()


def playback(state: int, t: Nanos, rate: float, *, sought: bool, request: bytes = b"") -> bytes:
    """Return where a playback is; `request`: what that answers."""
    return _PLAYBACK.pack(5, state, clamp(t), rate, sought, len(request)) + request


def seconds(t: Nanos) -> dict[str, int]:
    """Return a time as JSON has it."""
    return dict(zip(("sec", "nsec"), divmod(clamp(t), SECOND), strict=True))


def clamp(t: Nanos) -> Nanos:
    """Return a time that fits 64 bits unsigned."""
    return max(0, min(UINT64, t))


# -- from a client --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Published:
    """A message that a client publishes."""

    channel: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Call:
    """A call of a service."""

    service: int
    call: int
    encoding: bytes
    payload: bytes


@dataclass(frozen=True, slots=True)
class Play:
    """What is asked of a playback."""

    playing: bool
    rate: float
    seek: Nanos | None
    request: bytes


Binary: TypeAlias = Published | Call | Play


def read_text(message: str) -> Json:
    """Return a message in JSON: an object with an `op`."""
    asked = read_json(message)
    if not isinstance(asked.get("op"), str):
        raise WireError("an op is expected")
    return asked


def read_json(message: str | bytes) -> Json:
    """Return a JSON object."""
    asked = json_object(message)
    if asked is None:
        raise WireError("JSON is expected: an object")
    return asked


def read_binary(message: bytes) -> Binary:
    """Return a binary message, which is not empty."""
    try:
        match message[0]:
            case 1:
                return Published(_CHANNEL.unpack_from(message)[1], message[_CHANNEL.size :])
            case 2:
                return _call(message)
            case 3:
                return _play(message)
    except struct.error:
        raise WireError("it is too short") from None
    raise WireError(f"there is no opcode {message[0]}")


def _call(message: bytes) -> Call:
    _, service, call, length = _SERVICE.unpack_from(message)
    encoding, payload = _split(message[_SERVICE.size :], length)
    return Call(service, call, encoding, payload)


def _play(message: bytes) -> Play:
    _, command, rate, sought, seek, length = _PLAY.unpack_from(message)
    if command > 1 or not isfinite(rate):
        raise WireError(f"there is no playback command {command} at rate {rate}")
    request, _ = _split(message[_PLAY.size :], length)
    return Play(command == 0, rate, seek if sought else None, request)


def _split(rest: bytes, length: int) -> tuple[bytes, bytes]:
    if length > len(rest):
        raise WireError("it is too short")
    return rest[:length], rest[length:]


def rows(asked: Json, key: str) -> list[Json]:
    """Return a list of objects."""
    found = asked.get(key)
    if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
        raise WireError(f"{key} must be a list of objects")
    return _few(found, key)


def names(asked: Json, key: str) -> list[str]:
    """Return a list of texts, each once."""
    found = asked.get(key)
    if not isinstance(found, list) or not all(isinstance(one, str) for one in found):
        raise WireError(f"{key} must be a list of texts")
    return list(dict.fromkeys(found))


def ids(asked: Json, key: str) -> list[int]:
    """Return a list of ids."""
    found = asked.get(key)
    if not isinstance(found, list):
        raise WireError(f"{key} must be a list of ids")
    return [number({key: one}, key) for one in _few(found, key)]


def _few(found: list[Any], key: str) -> list[Any]:
    if len(found) > MAX_ROWS:
        raise WireError(f"{key}: at most {MAX_ROWS} are expected in one message")
    return found


def number(asked: Json, key: str) -> int:
    """Return an id."""
    found = asked.get(key)
    if not isinstance(found, int) or isinstance(found, bool) or not 0 <= found <= UINT32:
        raise WireError(f"{key} must be an integer of 32 bits")
    return found


def string(asked: Json, key: str) -> str:
    """Return a text."""
    found = asked.get(key)
    if not isinstance(found, str):
        raise WireError(f"{key} must be a text")
    return found


def real(found: object, key: str) -> float:
    """Return a finite number; of a truth value, 0 or 1."""
    if isinstance(found, int | float):
        try:
            value = float(found)
        except OverflowError:  # an integer of hundreds of digits
            value = float("inf")
        if isfinite(value):
            return value
    raise WireError(f"{key} must be a finite number")


# -- what clients publish -------------------------------------------------------------------------


def pose(encoding: str, payload: bytes) -> tuple[str, float, float, float]:
    """Return frame, x, y [m] and yaw [rad] of a geometry_msgs/PoseStamped; raises WireError."""
    if encoding == "json":
        asked = read_json(payload)
        frame = str(_inner(asked, "header").get("frame_id", ""))
        at = _inner(asked, "pose")
        x, y = _reals(_inner(at, "position"), "xy")
        a, b, c, d = _reals(_inner(at, "orientation"), "xyzw")
    else:
        order, body = _cdr(payload)
        _, _, length = _unpack(f"{order}iII", body, 0)
        frame = body[12 : 12 + length].rstrip(b"\0").decode("utf-8", "replace")
        x, y, _, a, b, c, d = _unpack(f"{order}7d", body, -(-(12 + length) // 8) * 8)
    return frame, x, y, atan2(2.0 * (d * c + a * b), 1.0 - 2.0 * (b * b + c * c))


def twist(encoding: str, payload: bytes) -> tuple[float, float, float]:
    """Return velocities of a geometry_msgs/Twist: ahead, to the left [m/s], to the left [rad/s]."""
    if encoding == "json":
        asked = read_json(payload)
        x, y = _reals(_inner(asked, "linear"), "xy")
        (yaw,) = _reals(_inner(asked, "angular"), "z")
    else:
        order, body = _cdr(payload)
        x, y, _, _, _, yaw = _unpack(f"{order}6d", body, 0)
    return x, y, yaw


ENCODINGS = ("json", "cdr")
"""Of what clients publish."""


def _cdr(payload: bytes) -> tuple[str, bytes]:
    """Return the byte order and what follows it: plain CDR (DDSI-RTPS 10.2)."""
    if len(payload) < 4 or payload[0] != 0 or payload[1] > 1:
        raise WireError("plain CDR is expected")
    return "<" if payload[1] else ">", payload[4:]


def _unpack(format_: str, body: bytes, offset: int) -> tuple[Any, ...]:
    try:
        found = struct.unpack_from(format_, body, offset)
    except struct.error:
        raise WireError("it is too short") from None
    if not all(map(isfinite, found)):
        raise WireError("finite numbers are expected")
    return found


def _inner(asked: Json, key: str) -> Json:
    """Return an object in another; an empty one if it is not there."""
    found = asked.get(key, {})
    if not isinstance(found, dict):
        raise WireError(f"{key} must be an object")
    return found


def _reals(asked: Json, keys: str) -> list[float]:
    """Return numbers by their names; 0 for one that is not there."""
    return [real(asked.get(key, 0.0), key) for key in keys]
