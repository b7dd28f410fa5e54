"""The environment of a recording: program, versions, processor, arithmetic.

A replay must be equal to the byte on the processor and packages that recorded; elsewhere BLAS may round
differently. So the comparison must be able to name what is different.
"""

from __future__ import annotations

import os
import platform
import sys
from functools import cache
from hashlib import blake2b
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from brain import other_brain
from brain.skills import found as skills
from gateway.config import bodies
from protocols import entry_points, plugin, sensors

PROGRAM = "program sources"
ROOMS = ("protocols", "brain", "gateway")
PACKAGES = (
    "motor-gateway",
    "filterpy",
    "lz4",
    "mcap",
    "msgpack",
    "mujoco",
    "numpy",
    "pyserial",
    "python-can",
    "rosbags",
    "scipy",
)
PACKAGE, SENSOR = "package ", "sensor "
"""Before the names of packages, and of kinds of sensors of others"""
PLUGIN = "plugin "
"""Before the name of another distribution that adds something, with its version."""
_DOORS = (plugin.GROUP, sensors.GROUP, bodies.GROUP, skills.GROUP, other_brain.GROUP)
_ENVIRONMENT = ("OPENBLAS_CORETYPE", "OPENBLAS_NUM_THREADS", "PYTHONHASHSEED")
_CPU_KEYS = ("model name", "Hardware", "CPU implementer", "CPU part", "flags", "Features")


def facts(cpuinfo: Path = Path("/proc/cpuinfo")) -> dict[str, str]:
    """Return name to value: sources, packages, others' kinds of sensors, Python, BLAS, processor, platform,
    environment variables."""
    found = {PROGRAM: sources()} | {
        f"{PACKAGE}{name}": number for name in PACKAGES if (number := _version(name))
    }
    found |= _plugins() | {f"{SENSOR}{name}": whose for name, whose in sensors.versions().items()}
    found["python"] = sys.version.replace("\n", " ")
    found["platform"] = platform.platform()
    found["machine"] = platform.machine()
    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    found["numpy blas"] = " ".join(
        str(blas.get(key, "")) for key in ("name", "version", "openblas configuration")
    )
    found |= {f"processor {key}": value for key, value in _processor(cpuinfo).items()}
    found |= {f"environment {name}": os.environ[name] for name in _ENVIRONMENT if name in os.environ}
    return found


@cache
def _plugins() -> dict[str, str]:
    """Return the other distributions that add protocols, bodies, skills or brains, each with its version."""
    others = (
        point
        for group in _DOORS
        for point in entry_points.offered(group).points
        if not entry_points.is_ours(point)
    )
    return {f"{PLUGIN}{entry_points.owner(point)}": entry_points.version(point) for point in others}


@cache
def sources() -> str:
    """Return the digest of this program. Read once: what runs is what was there then."""
    return digest_of(Path(__file__).parent.parent.parent)


def digest_of(root: Path) -> str:
    """Return a digest of every source file, since two programs of one version may differ."""
    digest = blake2b(digest_size=16)
    for room in ROOMS:
        for file in sorted((root / room).rglob("*.py")):
            digest.update(f"{file.relative_to(root).as_posix()}\0".encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


@cache
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _processor(cpuinfo: Path) -> dict[str, str]:
    """Return model and flags of the first core (Linux); elsewhere what Python knows."""
    try:
        lines = cpuinfo.read_text().partition("\n\n")[0].splitlines()
    except OSError:
        return {"model name": platform.processor() or platform.machine()}
    pairs = (line.partition(":") for line in lines)
    return {key.strip(): value.strip() for key, _, value in pairs if key.strip() in _CPU_KEYS}
