"""The rules about imports, as data and one pure function, for tests/test_house.py.

import-linter holds the layers among our own rooms (pyproject.toml); here are the outside modules, each with
the few places that may import it, and what a room may lean on at all.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator

RECORDINGS = ("gateway.recording", "gateway.rosbag")

ONLY: dict[str, tuple[str, ...]] = {
    "asyncio": ("gateway.runtime.asynchronous",),
    "can": ("gateway.buses",),
    "canopen": ("protocols.cia402.data_sheet",),
    "cantools": ("protocols.dbc.database",),
    "concurrent": ("gateway.runtime.asynchronous",),
    "cv2": ("gateway.vision.camera",),
    "distributed": ("gateway.cli.tasks",),
    "filterpy": ("brain.perception.engine", "benchmarks"),
    "matplotlib": ("gateway.cli.picture",),
    "lz4": RECORDINGS,
    "mcap": RECORDINGS,
    "mujoco": ("gateway.sim",),
    "multiprocessing": (),
    "pandas": ("gateway.replay.signal_log",),
    "pytest": ("gateway.testing",),
    "queue": (),
    "random": (),
    "rosbags": (*RECORDINGS, "gateway.ros.types"),
    "ruamel": ("gateway.config.map_file",),
    "scipy": (
        "brain.perception.graph",
        "brain.perception.keyframes",
        "brain.planning.blocks",
        "gateway.bench",
    ),
    "secrets": ("gateway.cli.live",),
    "serial": ("gateway.buses",),
    "signal": ("gateway.runtime.process",),
    "socket": ("gateway.buses", "gateway.operator", "gateway.ros", "gateway.view"),
    "websockets": ("gateway.view",),
    "zenoh": ("gateway.ros.zenoh_carrier",),
    "zstandard": ("gateway.recording",),
    "threading": (
        "gateway.buses.camera",
        "gateway.buses.i2c",
        "gateway.buses.threaded",
        "gateway.recording.writer",
        "gateway.cli.terminal.output",
    ),
    "time": ("gateway.core.clock",),
    "uuid": (),
}
"""Outside modules, and the only places that may import them. Ruff's banned-api tells why (pyproject.toml)."""

# fmt: off
INPUT_OUTPUT = frozenset({
    "asyncio", "ctypes", "fcntl", "io", "logging", "mmap", "multiprocessing", "os", "pathlib", "pty", "queue",
    "select", "selectors", "shutil", "signal", "socket", "subprocess", "sys", "tempfile", "termios",
    "threading", "time",
})
# fmt: on
"""What nothing below the loop may import: the outside world comes in as arguments."""

INSTALLED = "protocols.entry_points"
"""Looks, before a run, for what is installed, and whether that has changed."""

OF_THE_BRAIN = ("protocols.messages", "protocols.bounds", INSTALLED)
"""What the brain may import of the protocols."""

OUTSIDE = {"protocols": {"msgpack", "canopen", "cantools"}, "brain": {"numpy", "filterpy", "scipy"}}
"""What a room may import beside the standard library and the rooms below it."""

STEP, CLOCK = "gateway.core", "gateway.core.clock"
"""The modules of the gateway that are the step itself, but one."""

CONTRACT = (
    "protocols.messages",
    "protocols.frames",
    "protocols.plugin",
    "protocols.line",
    "protocols.asked",
    "protocols.reference_vectors",
    "protocols.canopen",
    "protocols.toolkit",
    "protocols.message_codec",
    "protocols.sensors",
    "protocols.suggest",
    "protocols.bounds",
    "protocols.entry_points",
)
"""What a protocol may import of ours, beside its own folder."""

SHARED = (*CONTRACT, "protocols.wire", "protocols.conformance", "protocols.transcripts")
"""The modules of `protocols` that are no protocol."""


SAME_DEVICE = {
    "protocols.vesc_uart": "protocols.vesc",
    "protocols.odrive_ascii": "protocols.odrive_can",
}
"""Protocols of a device that is known by another transport already: they may import that one's folder, since
nothing of it is said twice."""


def imports(module: str, source: str, *, package: bool = False) -> Iterator[tuple[int, str]]:
    """Yield every import in a source as (line, dotted name), one in a function or by a constant name too, and
    every text that is the name of a package of ours.

    `from a import b` gives `a.b`; a relative import is resolved from `module`."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = module.split(".") + (["__init__"] if package else [])
            above = parts[: len(parts) - node.level] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            constants = [a.value for a in node.args if isinstance(a, ast.Constant)]
            yield from ((node.lineno, str(value)) for value in constants[:1])
        elif isinstance(node, ast.Constant) and re.fullmatch(r"(gateway|brain)(\.\w+)+", str(node.value)):
            yield node.lineno, str(node.value)


def within(name: str, *places: str) -> bool:
    """True if a dotted name is one of the places, or lies in one."""
    return any(name == place or name.startswith(place + ".") for place in places)


def protocol_of(module: str) -> str:
    """Return the protocol's folder that a module belongs to, "" if it belongs to none."""
    if not within(module, "protocols") or module == "protocols" or within(module, *SHARED):
        return ""
    return ".".join(module.split(".")[:2])


def violations(module: str, source: str, *, package: bool = False) -> list[str]:
    """Return what a source may not import, one line each: where, what, and the rule."""
    return [
        f"{module}:{line}: {name}: {rule}"
        for line, name in imports(module, source, package=package)
        for rule in _broken(module, name)
    ]


def _broken(module: str, name: str) -> Iterator[str]:
    top = name.split(".")[0]
    room = module.split(".")[0]
    places = ONLY.get(top)
    if places is not None and not within(module, *places):
        yield f"only in {', '.join(places) or 'no place at all'}"
    if room in OUTSIDE:
        if top not in sys.stdlib_module_names | OUTSIDE[room] | {"protocols", "brain", "gateway"}:
            yield f"{room} imports no {top}"
        if top in ("brain", "gateway") and top != room:
            yield f"{room} lies below {top}"
    below = room in OUTSIDE or (within(module, STEP) and not within(module, CLOCK))
    if below and top in INPUT_OUTPUT and not within(module, INSTALLED):
        yield "no clock, bus, thread or file below the loop"
    if room == "brain" and top == "protocols" and not within(name, *OF_THE_BRAIN):
        yield "the brain knows the messages alone, the bounds of settings, and what is installed"
    yield from _broken_by_protocol(module, name)


def _broken_by_protocol(module: str, name: str) -> Iterator[str]:
    protocol = protocol_of(module)
    if not protocol:
        if within(module, "protocols") and protocol_of(name):
            yield "what all protocols share knows none of them"
        return
    if within(name, "protocols") and not within(
        name, protocol, *CONTRACT, SAME_DEVICE.get(protocol, protocol)
    ):
        yield "a protocol imports the interface and its own folder"
    ends = ("driver", "twin")
    forbidden = {"driver": ("twin",), "twin": ("driver",), "codec": ends, "table": ends}
    for other in forbidden.get(module.removeprefix(protocol + "."), ()):
        if within(name, f"{protocol}.{other}"):
            yield "driver and twin meet only in their table"
