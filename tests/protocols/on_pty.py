"""Vendors' software in a process of its own, on twins of one serial line, over a pty."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Sequence

from gateway.buses.adapters.pty import SerialPty
from gateway.core.robot import BusSettings
from protocols.messages import MILLISECOND, SECOND, Feedback
from protocols.plugin import Twin, join

WAIT = 0.001
"""s between two looks at the pty: only bytes make time pass for the twins."""


def run_client(source: str, twins: Sequence[Twin]) -> str:
    """Run a program with the path of the pty as its argument; return what it prints."""
    bus = SerialPty(BusSettings("line", "serial", "twin"))
    join(twins)
    now = SECOND
    for twin in twins:
        twin.step(now, [])
    command = [sys.executable, "-c", source, bus.pty.path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client:
        over = False
        while not over:
            over = client.poll() is not None  # what it sent last is read all the same
            packets = bus.read(now)[1]
            for packet in packets:
                now += MILLISECOND
                for twin in twins:
                    twin.receive(now, packet.frame)
                for twin in twins:
                    bus.write(now, twin.step(now, ())[1])
            if not packets:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    client.wait(WAIT)
        text, trouble = client.communicate()
    bus.close()
    assert client.returncode == 0, trouble
    return text


def put(twin: Twin, name: str, position: float, velocity: float) -> None:
    """Put the shaft of a twin somewhere, and let it measure that."""
    for at in range(100):
        twin.step(at * MILLISECOND, [Feedback(name, at, position, velocity)])
