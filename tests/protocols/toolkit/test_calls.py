"""How much work a frame is that reports a motor's motion, and changes nothing else: at most 16 calls."""

from __future__ import annotations

import sys
from types import FrameType
from typing import Any

import pytest

from protocols import messages as msg
from protocols.messages import MILLISECOND
from protocols.plugin import Device, load

OPTIONS: dict[str, dict[str, Any]] = {
    "cia402": {},
    "damiao": {},
    "moteus": {},
    "odrive_can": {},
    "plain": {"kind": "motor"},
}
AT_MOST = 16


@pytest.mark.parametrize("name", OPTIONS)
def test_a_received_frame_passes_few_calls(name: str) -> None:
    plugin = load(name)
    device = Device("left", 1, plugin.options(**OPTIONS[name]), plugin.settings())
    driver, twin = plugin.driver([device]), plugin.twin(device, 0)
    called: list[str] = []
    found: list[list[str]] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            called.append(frame.f_code.co_qualname)

    for at in range(2000):
        now = (1000 + at) * MILLISECOND
        commands = [msg.Velocity("left", 0.5)] if at > 1000 and at % 5 == 0 else []
        for frame in driver.send(now, commands)[1] if at % 5 == 0 else ():
            twin.receive(now, frame)
        for frame in twin.step(now, [msg.Feedback("left", now, 0.5, 0.1)])[1]:
            called.clear()
            before = sys.getprofile()
            sys.setprofile(note)
            try:
                events = driver.receive(now, frame)
            finally:
                sys.setprofile(before)
            if at > 1500 and events and all(isinstance(event, msg.Feedback) for event in events):
                found.append([*called])
    assert len(found) > 50
    usual = sorted(found, key=len)[len(found) // 2]
    assert len(usual) <= AT_MOST, "\n".join(usual)
