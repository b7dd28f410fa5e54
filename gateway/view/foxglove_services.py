"""The services that a Foxglove client can call: JSON → lines of the operator's language."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from gateway.view.foxglove_wire import WireError, real, string
from gateway.view.scene import Json


@dataclass(frozen=True, slots=True)
class Service:
    """What a client can call. It answers with the field `message`, or fails with the reason."""

    name: str
    fields: Mapping[str, str]
    """JSON types of what a call brings."""
    required: tuple[str, ...]
    line: Callable[[Json], str]
    """Returns what the call asks, as a line; raises WireError."""

    def advertised(self, number: int) -> Json:
        """Return it as it is advertised to clients."""
        request = {
            "type": "object",
            "properties": {name: {"type": kind} for name, kind in self.fields.items()},
            "required": list(self.required),
        }
        answer = {"type": "object", "properties": {"message": {"type": "string"}}}
        return {
            "id": number,
            "name": self.name,
            "type": f"gateway{self.name}",
            "request": _schema(f"gateway{self.name}_Request", request),
            "response": _schema("gateway/Answer", answer),
        }


def word(text: str, what: str) -> str:
    """Return a text that is one word of a line; raises WireError."""
    if not text or "#" in text or "," in text or len(text.split()) != 1:
        raise WireError(f"{text[:100]!r} is no {what}")
    return text


def _schema(name: str, schema: Json) -> Json:
    text = json.dumps(schema)
    return {"encoding": "json", "schemaName": name, "schemaEncoding": "jsonschema", "schema": text}


def _stop(asked: Json) -> str:
    return f"stop {string(asked, 'reason')}" if "reason" in asked else "stop"


def _release(_: Json) -> str:
    return "release"


def _clear(asked: Json) -> str:
    return f"clear {word(string(asked, 'motor'), 'motor')}" if "motor" in asked else "clear"


def _goal(asked: Json) -> str:
    yaw = f" {real(asked['yaw'], 'yaw')!r}rad" if "yaw" in asked else ""
    return f"goal {real(asked.get('x'), 'x')!r} {real(asked.get('y'), 'y')!r}{yaw}"


def _ask(asked: Json) -> str:
    return string(asked, "line")


SERVICES = (
    Service("/stop", {"reason": "string"}, (), _stop),
    Service("/release", {}, (), _release),
    Service("/clear", {"motor": "string"}, (), _clear),
    Service("/goal", {"x": "number", "y": "number", "yaw": "number"}, ("x", "y"), _goal),
    Service("/ask", {"line": "string"}, ("line",), _ask),
)
"""The first is the one of a view that is only looked at."""
