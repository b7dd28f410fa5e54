"""The CAN interfaces themselves, which the tests in this folder rely on."""

from __future__ import annotations

import subprocess
from collections.abc import Callable

import pytest


def send_and_see(sender: str, listener: str) -> str:
    """What `candump` on one interface sees of a frame that `cansend` puts on another."""
    with subprocess.Popen(["candump", "-n1", "-T2000", listener], stdout=subprocess.PIPE, text=True) as dump:
        subprocess.run(["sh", "-c", f"sleep 0.5; cansend {sender} 123#0102"], check=True)
        output, _ = dump.communicate()
    return output.split(maxsplit=1)[1].strip() if output else ""


def test_vcan_carries_a_frame(vcan0: str) -> None:
    assert send_and_see(vcan0, vcan0) == "123   [2]  01 02"


@pytest.mark.controllers
@pytest.mark.parametrize("bitrate", [500_000, 1_000_000])
def test_controllers_share_a_bus(controllers: Callable[[int], tuple[str, str]], bitrate: int) -> None:
    one, other = controllers(bitrate)
    assert send_and_see(one, other) == "123   [2]  01 02"
    assert send_and_see(other, one) == "123   [2]  01 02"
