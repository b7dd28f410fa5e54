"""The CAN interfaces themselves, which the tests in this folder rely on."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable

import pytest


def send_and_see(sender: str, listener: str) -> str:
    """What `candump` on one interface sees of a frame that `cansend` puts on another, again and again until
    it listens: the machine's clock goes on while its disk is waited for."""
    with subprocess.Popen(["candump", "-n1", "-T20000", listener], stdout=subprocess.PIPE, text=True) as dump:
        while dump.poll() is None:
            subprocess.run(["cansend", sender, "123#0102"], check=True)
            time.sleep(0.1)
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
