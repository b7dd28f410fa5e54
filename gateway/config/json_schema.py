"""The keys of the files that a user writes, as a JSON schema and as tables, made from the settings.

Rules. Nothing is listed here that a dataclass states: type hints, `Bounds`, defaults, and the texts below its
fields. A schema is of draft 7, which editors' servers for TOML read. What a file may leave out because its
[defaults] or its URDF has it is required only where there are none. What a schema cannot say (a motor that a
body names but no table has) is left to `gateway check`.
"""

from __future__ import annotations

import ast
import inspect
import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import MISSING, Field, is_dataclass
from enum import Enum
from functools import cache, partial
from itertools import pairwise
from textwrap import dedent
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias, Union, cast, get_args, get_origin

from brain import doors, other_brain
from brain.perception.mount import Mount
from brain.reading import InvalidError, Read
from brain.settings import BrainSettings
from brain.skills import found as skills
from brain.skills.skill import Skill
from gateway.config import bodies
from gateway.config.map_file import MapKeys
from gateway.config.mission import REPEAT
from gateway.config.robot_file import LimbKeys, TopKeys
from gateway.config.sections import BusKeys, ConnectionKeys, SensorKeys
from gateway.config.urdf import UrdfKeys
from gateway.core.joint import JointSettings
from gateway.core.robot import BagTopics
from protocols import plugin
from protocols.bounds import bounds_of, hints, is_duration, keys
from protocols.entry_points import offered
from protocols.messages import MILLISECOND

Schema: TypeAlias = dict[str, Any]

BEFORE = "before all tables"
COMPLETE = ",complete"
NOTHING: Mapping[str, Schema] = MappingProxyType({})
DRAFT = "http://json-schema.org/draft-07/schema#"
_SIMPLE: dict[object, Schema] = {
    float: {"type": "number"},
    int: {"type": "integer"},
    str: {"type": "string"},
    bool: {"type": "boolean"},
    Any: {},
}


# -- one value, one table ------------------------------------------------------------------------


@cache
def texts(kind: type) -> Mapping[str, str]:
    """Return the text below each field of a dataclass; nothing where its source is not there."""
    found: dict[str, str] = {}
    for one in reversed(kind.__mro__[:-1]):
        try:
            (tree,) = ast.parse(dedent(inspect.getsource(one))).body
        except (OSError, TypeError, SyntaxError, ValueError):
            continue
        body = cast("ast.ClassDef", tree).body
        for field, below in pairwise(body):
            match field, below:
                case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                    found[name] = " ".join(text.split())
    return found


def default_of(field: Field[Any], hint: object) -> object:
    """Return the default as it is written in a file; MISSING if there is none that a file can hold."""
    value = field.default
    if field.default_factory is not MISSING:
        value = field.default_factory()
    if value is MISSING or value is None:
        return MISSING
    if isinstance(value, Enum):
        return value.value
    if is_duration(hint):
        return float(f"{value / MILLISECOND:g}")
    if isinstance(value, tuple):
        return [list(one) if isinstance(one, tuple) else one for one in value]
    return value if isinstance(value, bool | int | float | str | list | dict) and value == value else MISSING


def _unit(hint: object) -> str:
    return bounds.unit if (bounds := bounds_of(hint)) is not None else ""


class Writer:
    """Makes the schemas of values; those of dataclasses once each, under "definitions"."""

    def __init__(self) -> None:
        self.definitions: dict[str, Schema] = {}
        self._made: dict[str, str] = {}
        """By the name asked for, that under which it is"""

    def table(
        self,
        kind: type,
        *,
        complete: bool,
        also: Mapping[str, Schema] = NOTHING,
        without: Iterable[str] = (),
    ) -> Schema:
        """Return the schema of the table that fills a dataclass.

        Args:
            kind: the dataclass.
            complete: whether what has no default must be there.
            also: further keys, or another schema of one.
            without: fields that are not in the file.
        """
        known, meanings = hints(kind), texts(kind)
        own = {k: field for k, field in keys(kind).items() if field.name not in without and k not in also}
        made: Schema = {"type": "object", "properties": dict(also), "additionalProperties": False}
        for key, field in own.items():
            hint = known[field.name]
            one = self.value(hint, complete=complete)
            if text := meanings.get(field.name) or _unit(hint):
                one = {"allOf": [one]} if "$ref" in one else one  # beside a reference draft 7 reads nothing
                one = {**one, "description": text}
            if (default := default_of(field, hint)) is not MISSING and default not in ({}, []):
                one = {**one, "default": default}
            made["properties"][key] = one
        needed = [
            key for key, field in own.items() if field.default is MISSING and field.default_factory is MISSING
        ]
        return {**made, "required": needed} if complete and needed else made

    def reference(self, kind: type, *, complete: bool) -> Schema:
        """Return a reference to the schema of a dataclass, which is made if it is not there."""
        name = f"{kind.__module__}.{kind.__qualname__}"
        return self.define(name, lambda whole: self.table(kind, complete=whole), complete=complete)

    def define(self, name: str, make: Callable[[bool], Schema], *, complete: bool) -> Schema:
        """Return a reference to a schema by its name; what is complete as it is has one schema alone."""
        own = name + COMPLETE * complete
        if own not in self._made:
            self._made[own] = name  # it may hold itself
            made = make(complete)
            if complete:
                self.define(name, make, complete=False)
            if not complete or made != self.definitions[name]:
                self.definitions[own] = made
                self._made[own] = own
        return {"$ref": f"#/definitions/{self._made[own]}"}

    def value(self, hint: object, *, complete: bool) -> Schema:
        """Return the schema of what a type hint takes; raise TypeError for one that no file can fill."""
        origin, args = get_origin(hint), get_args(hint)
        if hint in _SIMPLE:
            return dict(_SIMPLE[hint])
        if origin is Annotated:
            inner = {"type": "number"} if is_duration(hint) else self.value(args[0], complete=complete)
            bounds = bounds_of(hint) if "type" in inner and inner["type"] in ("number", "integer") else None
            unit = "ms" if is_duration(hint) else bounds.unit if bounds else ""
            inner |= {"$comment": unit} if unit else {}
            return {**inner, "minimum": bounds.least, "maximum": bounds.most} if bounds else inner
        if origin is Literal:
            return {"enum": list(args)}
        if isinstance(hint, type) and issubclass(hint, Enum):
            return {"enum": [one.value for one in hint]}
        if origin in (Union, UnionType):
            each = [self.value(one, complete=complete) for one in args if one is not NoneType]
            return each[0] if len(each) == 1 else {"anyOf": each}
        if origin is tuple:
            items = [self.value(one, complete=complete) for one in args if one is not Ellipsis]
            if Ellipsis in args:
                return {"type": "array", "items": items[0]}
            count = {"minItems": len(items), "maxItems": len(items)}
            return {"type": "array", "items": items, **count}
        if origin is dict:
            return {"type": "object", "additionalProperties": self.value(args[1], complete=complete)}
        if isinstance(hint, type) and is_dataclass(hint):
            return self.reference(hint, complete=complete)
        raise TypeError(f"no value of a file is a {hint!r}")

    def done(self, title: str, top: Schema) -> Schema:
        """Return a whole schema."""
        return {"$schema": DRAFT, "title": title, **top, "definitions": self.definitions}


# -- the files -----------------------------------------------------------------------------------


def robot() -> Schema:
    """Return the schema of a robot file: of every protocol, body and brain that is installed."""
    write = Writer()
    top = write.table(TopKeys, complete=False, also=_robot_tables(write, complete=False))
    top["properties"]["body"] = {"enum": bodies.names(), "description": "In a file of a recording alone"}
    recorded = {"required": ["bag"], "not": _any_of("buses", "motors")}
    must = {"required": ["name", "buses", "motors"], **_any_of("brain", "limbs")}
    whole = {"properties": _robot_tables(write, complete=True)}
    return write.done(
        "A robot file of Motor Gateway",
        {**top, "if": recorded, "else": {**must, "if": _any_of("urdf", "defaults"), "else": whole}},
    )


def _robot_tables(write: Writer, *, complete: bool) -> dict[str, Schema]:
    """Return the tables of a robot file. `complete`: nothing that they need is in [defaults] or a URDF."""
    found = {name: bodies.load_body(name) for name in bodies.names()}
    own = {name: write.reference(one, complete=complete) for name, one in found.items()}
    place = write.table(LimbKeys, complete=False)["properties"]
    place["body"] = {**place["body"], "enum": list(found)}
    body = {"enum": list(found), "description": "Its own table has this name"}
    also = {"body": body, **own, **_other_brains(write)}
    brain = write.table(BrainSettings, complete=False, also=also, without=("body", "other", "saved"))
    limbs = {name: write.table(one, complete=complete, also=place) for name, one in found.items()}
    named = write.table(UrdfKeys, complete=False)["properties"]
    joint = {"urdf_joint": named["urdf_joint"]}
    on_robot = write.table(Mount, complete=False, also={"link": named["link"]})
    mount = {"mount": write.define("sensor.mount", lambda _: on_robot, complete=False)}
    groups = {
        "buses": write.reference(BusKeys, complete=complete),
        "motors": write.define("motor", partial(_connected, write, JointSettings, joint), complete=complete),
        "sensors": write.define("sensor", partial(_connected, write, SensorKeys, mount), complete=complete),
    }
    tables: dict[str, Schema] = {name: _named(one) for name, one in groups.items()}
    by_body = [_when("body", name, one) for name, one in limbs.items()]
    limb: Schema = {"type": "object", "required": ["body"], "properties": place, "allOf": by_body}
    tables |= {"brain": brain, "limbs": _named(limb)}
    if not complete:
        text = "What every bus, motor or sensor has that says nothing else"
        own_keys = {"type": "object", "properties": groups, "additionalProperties": False}
        tables["defaults"] = {**own_keys, "description": text}
        tables["bag"] = write.reference(BagTopics, complete=True)
        tables["map"] = write.reference(MapKeys, complete=True)
        text = "The URDF and what else is named, in the file of a recording"
        tables["files"] = {**_named({"type": "string"}), "description": text}
    return tables


def _named(one: Schema) -> Schema:
    """Return the schema of tables with names of the user's own."""
    return {"type": "object", "additionalProperties": one}


def _connected(
    write: Writer,
    kind: type,
    also: Mapping[str, Schema],
    complete: bool,
) -> Schema:
    """Return the table of a motor or a sensor: its options and settings are those of its protocol."""
    place = write.table(ConnectionKeys, complete=complete)
    made = write.table(kind, complete=complete, also={**place["properties"], **also})
    protocols, _ = plugin.load_all()
    made["properties"]["protocol"] = {
        **made["properties"]["protocol"],
        "enum": [one.name for one in protocols],
    }
    needed = [*place.get("required", ()), *made.get("required", ())]
    by_protocol = [
        _when(
            "protocol",
            one.name,
            {
                "properties": {
                    "options": write.reference(one.options, complete=complete),
                    "settings": write.reference(one.settings, complete=complete),
                }
            },
        )
        for one in protocols
    ]
    return {**made, "allOf": by_protocol} | ({"required": needed} if needed else {})


def _other_brains(write: Writer) -> dict[str, Schema]:
    """Return the key that names another's brain, and the tables of those installed; a broken one is left
    out."""
    found: dict[str, Schema] = {}
    for name in sorted({point.name for point in offered(other_brain.GROUP).points}):
        with suppress(doors.Closed):
            found[name] = write.reference(other_brain.load(name)[0].settings, complete=True)
    return {**found, "kind": {"enum": list(found)}} if found else {}


def mission() -> Schema:
    """Return the schema of a mission file: the keys of each skill. Their values are left to their own
    readers, which tell what is wrong when the mission is read."""
    kinds = [skills.load(name) for name in skills.names()]
    failure = {
        "anyOf": [{"enum": ["stop", "skip"]}, {"$ref": "#/definitions/steps"}],
        "description": "What is done if it fails; steps: these, then the next",
    }
    readers: dict[str, Read] = {key: read for kind in kinds for key, read in kind.keys.items()}
    own: dict[str, Schema] = {
        key: {"title": _expected(read), "description": f"Of {' and '.join(_steps_with(key))}"}
        for key, read in readers.items()
    }
    own |= {kind.name: {"title": _expected(kind.own), "description": _meaning(kind)} for kind in kinds}
    often = {"description": "How often its steps are done; 0: no end"}
    step = {
        "type": "object",
        "properties": {
            **own,
            REPEAT: {"type": "integer", "minimum": 0, **often},
            "steps": {"$ref": "#/definitions/steps"},
            "on_failure": failure,
        },
        "additionalProperties": False,
        **_any_of(*(kind.name for kind in kinds), REPEAT),
    }
    return {
        "$schema": DRAFT,
        "title": "A mission file of Motor Gateway",
        "type": "object",
        "properties": {
            "name": {"type": "string", "minLength": 1, "description": "By default that of the file"},
            "on_failure": {"enum": ["stop", "skip"], "description": "Of every step that says nothing else"},
            "steps": {"$ref": "#/definitions/steps"},
        },
        "required": ["steps"],
        "additionalProperties": False,
        "definitions": {"steps": {"type": "array", "items": step}},
    }


def _expected(read: Read) -> str:
    """Return what a reader takes: what it says of that which nothing takes."""
    try:
        read(object())
    except InvalidError as error:
        return str(error)
    return "any value"


def _steps_with(key: str) -> list[str]:
    return [name for name in skills.names() if key in skills.load(name).keys]


def _meaning(kind: Skill[Any]) -> str:
    """Return what a step does: what the first line of its file says behind its example."""
    module = inspect.getmodule(kind.perform)
    line = (inspect.getdoc(module) or "").partition("\n")[0]
    return line.rpartition("`: ")[2].rstrip(".")


def of_kinds(title: str, kinds: Mapping[str, type]) -> Schema:
    """Return the schema of a file whose key `kind` chooses the dataclass that it fills."""
    write = Writer()
    each = [_when("kind", name, write.reference(one, complete=True)) for name, one in kinds.items()]
    chosen = {
        "properties": {
            "kind": {"enum": list(kinds), "description": "What it is: the other keys follow from it"}
        },
        "required": ["kind"],
    }
    return write.done(title, {"type": "object", **chosen, "allOf": each})


def _any_of(*names: str) -> Schema:
    return {"anyOf": [{"required": [name]} for name in names]}


def _when(key: str, value: str, then: Schema) -> Schema:
    return {"if": {"properties": {key: {"const": value}}, "required": [key]}, "then": then}


# -- as tables -----------------------------------------------------------------------------------


class Row(NamedTuple):
    """One key of a table of a file."""

    key: str
    what: str
    """What it takes: type and bounds, or its values"""
    default: str
    text: str
    where: str = ""
    """The file whose settings it is one of; "": the robot file's reader alone"""


def rows_of(schema: Schema) -> dict[str, list[Row]]:
    """Return the keys of a file by the heading of their table; what fills several tables is listed once."""
    found: dict[str, list[Row]] = {}
    listed: dict[str, str] = {}

    def list_table(path: str, node: Schema, heading: str = "", name: str = "") -> None:
        heading, where = heading or f"[{path}]", _file_of(name)
        rows = found.setdefault(heading, [])
        for key, one in node.get("properties", {}).items():
            below = f"{path}.{key}" if path else key
            table, name = _resolved(schema, one)
            if isinstance(each := table.get("additionalProperties"), dict):
                (table, name), below = _resolved(schema, each), f"{below}.NAME"
            elif isinstance(each := table.get("items"), dict):
                (table, one_name), below = _resolved(schema, each), f"[{below}]"
                name = one_name or name
            text = one.get("description", "")
            if "properties" not in table and "allOf" not in table:
                default = _shown(one["default"]) if "default" in one else ""
                needed = "required" if key in node.get("required", ()) else default
                rows.append(Row(key, _what(_resolved(schema, one)[0]), needed, text, where))
            elif _kind(name) in listed:
                rows.append(Row(key, f"table, as {listed[_kind(name)]}", "", text, where))
            else:
                if name:
                    listed[_kind(name)] = f"[{below}]"
                rows.append(Row(key, f"table [{below}]", "", text, where))
                list_table(below, table, name=name)
        for case in node.get("allOf", ()):
            ((key, chosen),) = case["if"]["properties"].items()
            then, name = _resolved(schema, case["then"])
            parts = {path: (then, name)} if name else _parts(schema, path, then)
            for below, (table, name) in parts.items():
                if name and _kind(name) not in listed and table.get("properties"):
                    listed[_kind(name)] = f'[{below}] of {key} = "{chosen["const"]}"'.removeprefix("[] of ")
                    list_table(below, table, listed[_kind(name)], name)

    whole = schema.get("else", {}).get("else", {}).get("properties", {})
    list_table("", {**schema, "properties": {**schema.get("properties", {}), **whole}}, BEFORE)
    return {heading: rows for heading, rows in found.items() if rows}


def _parts(schema: Schema, path: str, node: Schema) -> dict[str, tuple[Schema, str]]:
    return {f"{path}.{key}": _resolved(schema, one) for key, one in node["properties"].items()}


def _resolved(schema: Schema, one: Schema) -> tuple[Schema, str]:
    """Return what a schema refers to, and the name of that; itself and "" if it refers to nothing."""
    match one:
        case {"allOf": [{"$ref": _} as inner]}:
            one = inner
    if "$ref" not in one:
        return one, ""
    name = one["$ref"].rpartition("/")[2]
    return schema["definitions"][name], name


def _file_of(name: str) -> str:
    """Return the file of a dataclass, by the name of its schema; "" if that is of several."""
    module, _, kind = _kind(name).rpartition(".")
    return f"{module.replace('.', '/')}.py" if "." in module and kind.isidentifier() else ""


def _kind(name: str) -> str:
    return name.removesuffix(COMPLETE)


def _shown(value: object) -> str:
    return f"{value:.10g}" if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def _what(one: Schema) -> str:
    """Return what a key takes, in words."""
    match one:
        case {"enum": values}:
            return ", ".join(map(_shown, values))
        case {"anyOf": several}:
            return " or ".join(map(_what, several))
        case {"type": "array", "items": list(items)}:
            return f"{len(items)} of: {', '.join(dict.fromkeys(map(_what, items)))}"
        case {"type": "array", "items": dict(item)}:
            return f"array of {_what(item)}"
        case {"type": str(kind), "minimum": least, "maximum": most}:
            return f"{kind}, {least:.10g} to {most:.10g} {one.get('$comment', '')}".rstrip()
        case {"type": "object"} | {"$ref": _}:
            return "table"
    return str(one.get("type", one.get("title", "any value")))
