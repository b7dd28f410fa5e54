"""feetech-servo-sdk 1.0.0 as the client of our twins, over a pty, in a process of its own: its byte order is
a global of the module."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from typing import Any

import pytest

from gateway.buses.adapters.pty import Pty
from protocols.feetech import plugin
from protocols.feetech.options import Options, Settings
from protocols.messages import MILLISECOND, Feedback, Mode
from protocols.plugin import Device

CLIENT = """
import json, sys
import scservo_sdk as fs

order, path = int(sys.argv[1]), sys.argv[2]
port = fs.PortHandler(path)
port.setPacketTimeout = lambda size: port.setPacketTimeoutMillis(60_000)
assert port.openPort() and port.setBaudRate(1_000_000)
ph = fs.PacketHandler(order)
got = {"ping": ph.ping(port, 1), "nobody": order and 0}
got["who"] = ph.readTxRx(port, 1, 0, 5)
got["unlock"] = ph.write1ByteTxRx(port, 1, 48 if order else 55, 0)
got["limits"] = ph.write2ByteTxRx(port, 1, 9, 100), ph.read2ByteTxRx(port, 1, 9)
got["goal"] = ph.write2ByteTxRx(port, 1, 42, 700)
got["torque"] = ph.write1ByteTxRx(port, 1, 40, 1), ph.read1ByteTxRx(port, 1, 40)
got["position"] = ph.read2ByteTxRx(port, 2, 56)
got["reg write"] = ph.regWriteTxRx(port, 2, 42, 2, [fs.SCS_LOBYTE(600), fs.SCS_HIBYTE(600)])
got["before"] = ph.read2ByteTxRx(port, 2, 42)
ph.action(port, 2)
got["after"] = ph.read2ByteTxRx(port, 2, 42)
writer = fs.GroupSyncWrite(port, ph, 42, 2)
for n, goal in ((1, 512), (2, 400)):
    writer.addParam(n, [fs.SCS_LOBYTE(goal), fs.SCS_HIBYTE(goal)])
got["sync write"] = writer.txPacket()
got["goals"] = [ph.read2ByteTxRx(port, n, 42)[0] for n in (1, 2)]
if not order:
    reader = fs.GroupSyncRead(port, ph, 56, 8)
    for n in (1, 2):
        reader.addParam(n)
    got["sync read"] = reader.txRxPacket(), [reader.getData(n, 56, 2) for n in (1, 2)]
    got["middle"] = ph.write1ByteTxRx(port, 2, 40, 128), ph.read2ByteTxRx(port, 2, 56)
got["id"] = ph.write1ByteTxRx(port, 2, 5, 9), ph.ping(port, 9)[0]
print(json.dumps(got))
"""


def talk(order: int, model: Any, shafts: tuple[float, float]) -> tuple[dict[str, Any], list[Any]]:
    """Return what the SDK was answered by two servos, and these."""
    pty, now = Pty(), 0
    devices = [Device(f"m{n}", n, Options(model=model), Settings(return_delay=0)) for n in (1, 2)]
    twins = [plugin.twin(each, 0) for each in devices]
    places = [Feedback(each.name, 0, at, 0.0) for each, at in zip(devices, shafts, strict=True)]
    for twin, place in zip(twins, places, strict=True):
        twin.step(now, [place])
    command = [sys.executable, "-c", CLIENT, str(order), pty.path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client:
        while client.poll() is None:
            data = pty.read()
            if not data:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    client.wait(0.002)
                continue
            now += MILLISECOND
            heard = [data]
            while heard:  # on one wire all hear all
                answers: list[bytes] = []
                for one in heard:
                    for twin in twins:
                        twin.receive(now, one)
                for twin, place in zip(twins, places, strict=True):
                    answers += [each for each in twin.step(now, [place])[1] if isinstance(each, bytes)]
                for each in answers:
                    pty.write(each)
                heard = answers
        text, trouble = client.communicate()
    pty.close()
    assert client.returncode == 0, trouble
    return json.loads(text), twins


@pytest.mark.parametrize(("order", "model", "number"), [(0, "sts3215", 777), (1, "scs0009", 1284)])
def test_the_vendors_software_reads_and_writes(order: int, model: str, number: int) -> None:
    got, twins = talk(order, model, (0.0, 0.1))
    steps = 2048 + round(0.1 / 6.283185307 * 4096) if not order else 512 + round(0.1 / 5.235987756 * 1024)
    assert got["ping"] == [number, 0, 0]
    assert got["unlock"] == [0, 0]
    assert got["limits"] == [[0, 0], [100, 0, 0]]
    assert got["goal"] == [0, 0]
    assert got["torque"] == [[0, 0], [1, 0, 0]]
    assert got["position"] == [steps, 0, 0]
    assert got["reg write"] == [0, 0]
    assert got["before"][0] == 2048 // (4 if order else 1)
    assert got["after"] == [600, 0, 0]
    assert got["sync write"] == 0
    assert got["goals"] == [512, 400]
    assert got["id"] == [[0, 0], number]
    assert twins[0].mode is Mode.ARMED
    if not order:
        assert got["sync read"] == [0, [2048, steps]]
        assert got["middle"] == [[0, 0], [2048, 0, 0]]


def test_a_ping_of_everybody_is_answered_and_nothing_else_of_everybody_is() -> None:
    """As programs find the id of a servo that is alone on its line."""
    device = Device("m", 7, Options(model="sts3215"), Settings(return_delay=0))
    twin, place = plugin.twin(device, 0), Feedback("m", 0, 0.0, 0.0)
    answered = []
    for now, asked in enumerate(("", "ff ff fe 02 01 fe", "ff ff fe 04 02 38 02 c1", "ff ff 07 02 01 f5")):
        twin.receive(now * MILLISECOND, bytes.fromhex(asked))
        frames = twin.step(now * MILLISECOND, [place])[1]
        answered.append([frame.hex(" ") for frame in frames if isinstance(frame, bytes)])
    assert answered == [[], ["ff ff 07 02 00 f6"], [], ["ff ff 07 02 00 f6"]]


@pytest.mark.parametrize("model", ["sts3215", "scs0009"])
def test_a_reset_stores_what_was_delivered_but_for_the_id_and_it_tells_what_waits_for_an_action(
    model: Any,
) -> None:
    device = Device("m", 1, Options(model=model), Settings(return_delay=0, offset=-85, mode=1))
    twin, place = plugin.twin(device, 0), Feedback("m", 0, 0.0, 0.0)
    now = 0

    def asks(*packet: int) -> str:
        nonlocal now
        now += MILLISECOND
        body = bytes(packet)
        twin.receive(now, b"\xff\xff" + body + bytes((~sum(body) & 0xFF,)))
        answers = twin.step(now, [place])[1]
        return b"".join(each for each in answers if isinstance(each, bytes)).hex(" ")

    for _ in range(3):
        asks(7, 2, 1)  # another's ping
    nothing = asks(1, 4, 3, 5, 9)  # its id becomes 9
    assert asks(9, 4, 3, 21, 20) == asks(9, 4, 3, 40, 1) == nothing.replace(" 01 02 00 fc", " 09 02 00 f4")
    assert asks(9, 4, 2, 40, 1) == "ff ff 09 03 00 01 f2"  # armed
    assert asks(9, 2, 6) == "ff ff 09 02 00 f4"
    assert asks(9, 4, 2, 40, 1) == "ff ff 09 03 00 00 f3"  # and it has let go
    assert asks(9, 4, 2, 21, 1) == "ff ff 09 03 00 20 d3"  # P_Coefficient as delivered
    if model == "sts3215":
        assert asks(9, 4, 2, 31, 3) == "ff ff 09 05 00 00 00 00 f1"  # no offset, and mode position
    assert asks(9, 5, 4, 42, 0, 3).startswith("ff ff 09")  # a goal that waits
    assert asks(9, 4, 2, 64, 1) == "ff ff 09 03 00 01 f2"
    assert asks(9, 2, 5) == "ff ff 09 02 00 f4"
    assert asks(9, 4, 2, 64, 1) == "ff ff 09 03 00 00 f3"


@pytest.mark.parametrize(("model", "answer"), [("sts3215", "ff ff 01 04 00 00 08 f2"), ("scs0009", None)])
def test_a_scs_servo_has_no_sync_read(model: Any, answer: str | None) -> None:
    """rustypot 1.13.1, which knows that, asks for it all the same."""
    twin = plugin.twin(Device("m", 1, Options(model=model), Settings(return_delay=0)), 0)
    place = Feedback("m", 0, 0.0, 0.0)
    twin.step(0, [place])
    twin.receive(MILLISECOND, bytes.fromhex("ff ff fe 05 82 38 02 01 3f"))
    frames = twin.step(MILLISECOND, [place])[1]
    assert [each.hex(" ") for each in frames if isinstance(each, bytes)] == ([answer] if answer else [])
