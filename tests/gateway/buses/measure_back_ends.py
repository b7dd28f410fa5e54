"""Measure back ends of python-can on ptys, as they are and behind this bus: docs/adapters.md has the table.

$ python -m tests.gateway.buses.measure_back_ends
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import closing

import can

from gateway.buses.adapters.slcan import line_of
from gateway.buses.can import open_can
from gateway.core.clock import SimulatedClock
from gateway.core.robot import BusSettings
from protocols.frames import CanFrame
from tests.gateway.buses.adapter_helpers import raw_pty
from tests.gateway.buses.test_back_ends import FRAME, robotell, seeedstudio, serial

READS = 20


def slcan(frame: CanFrame) -> bytes:
    return line_of(frame).encode() + b"\r"


ENCODE = {"serial": serial, "seeedstudio": seeedstudio, "robotell": robotell, "slcan": slcan}


def costs(read: Callable[[], object]) -> Iterator[float]:
    """How long reads take that find nothing, in ms."""
    for _ in range(READS):
        began = time.perf_counter()
        read()
        yield (time.perf_counter() - began) * 1e3


def tried(read: Callable[[], object]) -> str:
    try:
        return repr(read())
    except Exception as error:  # noqa: BLE001 -- that is what is measured
        return f"{type(error).__name__}: {error}"


def measure(kind: str, encode: Callable[[CanFrame], bytes]) -> None:
    device, host = raw_pty()
    began = time.perf_counter()
    with can.Bus(interface=kind, channel=os.ttyname(host), bitrate=1_000_000, ignore_config=True) as raw:
        opening = time.perf_counter() - began
        worst = max(costs(lambda: raw.recv(0)))
        os.write(device, encode(FRAME)[:6])
        half = [tried(lambda: raw.recv(0)) for _ in range(3)]
        print(
            f"{kind}: opened in {opening:.2f} s, an empty read at most {worst:.1f} ms, half a frame: {half}"
        )
    device, host = raw_pty()
    settings = BusSettings("can0", "can", f"{kind}:{os.ttyname(host)}", 1_000_000)
    with closing(open_can(settings, SimulatedClock())) as bus:
        print(f"  this bus: an empty read at most {max(costs(lambda: bus.read(0))):.2f} ms")


if __name__ == "__main__":
    for name, how in ENCODE.items():
        measure(name, how)
