"""`gateway diff`: two recordings: settings, the first difference, and the signals that part, in time."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from gateway.recording import read_recording
from gateway.replay import Beside, log_of, partings
from gateway.replay import diff as differences

SLICE = 1000
"""Ticks"""
SIDES = ("in the first", "in the second")


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("one", type=Path, metavar="FIRST", help="a recording of this gateway")
    parser.add_argument("two", type=Path, metavar="SECOND", help="another")


def run(options: Namespace) -> int:
    """Return 1 if they differ in anything but their time stamps."""
    one, two = read_recording(options.one), read_recording(options.two)
    beside = Beside(one, two)
    while not beside.advance(SLICE):
        pass
    for text in beside.settings:
        print(f"robot file: {text}")
    for text in differences.mappings(one.facts, two.facts, SIDES):
        print(f"made with: {text}")
    if beside.first is None:
        print(f"the same: {beside.ticks} ticks")
        return 0
    if not beside.found:
        print(f"the same but for time stamps: {beside.ticks} ticks; {beside.times}")
        return 0
    print(f"the same for {beside.ticks} ticks; then")
    for found in beside.found:
        print(f"  {found}".replace("\n", "\n  "))
    signals = partings(log_of(one), log_of(two))
    print("signals that part, in order of time:" if signals else "no signal parts by 2 % of its span")
    for signal in signals:
        print(f"  {signal.text()}")
    return 1
