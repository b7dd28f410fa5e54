"""Conversations of vectors: node ids given out, and discovery.

What vouches: answers and assignments are as vectors address_reply06 and assign_node_id_5 have them
(odriverobotics/ODriveResources@06dc846 `examples/can_enumerate.py`); heartbeats are cantools'; what is
expected is derived by hand from the README ("Two firmware lines", "What it does": requests) and the
docstrings of `requests`. See `talk`.
"""

from __future__ import annotations

import pytest

from protocols.frames import CanFrame
from protocols.messages import Scan, SetId
from tests.protocols.odrive_can.conversation import DISCOVERED, SERIAL, device
from tests.protocols.odrive_can.talk import Talk, standing, standing05


@pytest.mark.parametrize(("serial", "address"), [(0, 5), (1 << 48, 5), (1, -1), (1, 63)])
def test_vectors_of_node_ids_that_cannot_be(serial: int, address: int) -> None:
    talk = standing()
    talk.ask(SetId("can0", serial, address))
    talk.reports("0 < Refused SetId can0: *is not a *")


@pytest.mark.parametrize(
    ("serial", "address", "data"),
    [
        (1, 62, "3e010000000000"),
        ((1 << 48) - 1, 0, "00ffffffffffff"),
        (SERIAL, 5, "05303373345f38"),
    ],
)
def test_vectors_of_a_node_id_that_no_device_takes(serial: int, address: int, data: str) -> None:
    """Given out on the broadcast node, and asked who is who; given up after 1.5 s."""
    talk = standing()
    talk.shown = frozenset({"Address"})
    talk.ask(SetId("can0", serial, address))
    talk.run(1600)
    talk.reports(f"""
        0…1200-1499/200-300 > 63:0x06 {data} | 63?Address
        1500 < Refused SetId can0: no device with serial number {serial:012X} took the node id
    """)


def test_vectors_of_a_node_id_that_is_taken() -> None:
    talk = standing()
    talk.handle(DISCOVERED)
    talk.ask(SetId("can0", SERIAL, 5))
    talk.handle(CanFrame(0xA6, bytes.fromhex("05303373345f3900")))  # another serial number at 5
    talk.handle(CanFrame(0xC6, bytes.fromhex("06303373345f3800")))  # this one, elsewhere
    talk.reports("0 > 63:0x06 05303373345f38")
    talk.handle(CanFrame(0xA6, bytes.fromhex("05303373345f3800")))
    talk.reports("""
        0 < Found 5 385F34733330 duplicate: *
        0 < Found 5 395F34733330 duplicate: *
        0 < Done SetId can0: not saved yet: write save_configuration 1 to keep it after power-off
    """)


def test_vectors_of_a_node_id_that_another_holds() -> None:
    talk = standing()
    talk.handle(DISCOVERED)
    talk.ask(SetId("can0", SERIAL + 1, 3))
    talk.reports("0 < Refused SetId can0: node id 3 is held by serial number 385F34733330")
    talk.ask(SetId("can0", SERIAL, 3))  # its own
    talk.handle(DISCOVERED)
    talk.reports("""
        0 > 63:0x06 03303373345f38
        0 < Done SetId can0: not saved yet*
    """)


def test_vectors_of_what_looks_like_a_reply() -> None:
    talk = standing()
    talk.handle(CanFrame(0x66, bytes.fromhex("05303373345f3800")))  # a host's, to node 3
    talk.handle(CanFrame(0x66, bytes.fromhex("0330337334")))  # cut off
    talk.reports("", bad=1, foreign=1)


def test_vectors_of_a_scan() -> None:
    talk = Talk([device(poll_ms=0), device("right", 4, poll_ms=0)], shown=frozenset({"Address"}))
    talk.up()
    talk.up(4)
    talk.run(200)
    talk.stage()
    talk.ask(Scan("can0"))
    talk.handle(DISCOVERED, DISCOVERED)
    talk.handle(CanFrame(0x7E6, bytes.fromhex("3f303373345f39")))
    talk.handle(CanFrame(0xE6, bytes.fromhex("07303373345f36")))
    talk.reports("""
        0 > 63?Address
        0 < Found 3 385F34733330: left, firmware 0.6.10
        0 < Found 63 395F34733330: has no node id yet
        0 < Found 7 365F34733330:*
    """)
    talk.report("Heartbeat", 7, Axis_State=1)
    talk.report("Heartbeat", 8, Axis_State=1)
    talk.report("Heartbeat", 3, extended=True, Axis_State=1)
    talk.report("Heartbeat", 20, extended=True, Axis_State=1)
    talk.report("Get_Encoder_Estimates", 21)
    talk.handle(CanFrame(0x2C1, b"\0\0\0\0\1\0"))  # too short for a heartbeat
    talk.run(1850)
    # Heartbeats tell of who answers no discovery; 7 has answered. Right is known, heard, and did not answer.
    mute = "sends heartbeats, but did not answer discovery: firmware 0.5.x?"
    talk.reports(
        f"""
        600…1200/600 > 63?Address
        1800 < Found 4 ?: right, firmware 0.6.10
        1800 < Found 8 ?: {mute}
        1800 < Found 3 ?: {mute}, extended identifiers
        1800 < Found 20 ?: {mute}, extended identifiers
        1800 < Done Scan can0: 7 devices
        """,
        foreign=6,
    )
    talk.mute(4)
    talk.run(300)
    talk.stage()
    talk.ask(Scan("can0"), Scan("can0"))
    talk.handle(DISCOVERED)
    talk.run(1850)
    # Each is answered on its own; who is offline is not there.
    talk.reports("""
        0 > 2 × 63?Address
        0 < Found 3 385F34733330: left, firmware 0.6.10 (× 2)
        600…1200/600 > 2 × 63?Address
        1800 < Done Scan can0: 1 devices (× 2)
    """)


def test_vectors_of_a_scan_for_one_whose_firmware_is_not_known() -> None:
    talk = Talk([device(poll_ms=0), device("right", 4, poll_ms=0)])
    talk.beat()
    talk.beat(node=4)
    talk.run(10)
    talk.stage()
    talk.ask(Scan("can0"))
    talk.handle(DISCOVERED)
    talk.reports("0 < Found 3 385F34733330: left, firmware not known yet")
    talk.run(1800)
    talk.run(10)
    reported = [line.text for line in talk.lines if line.text.startswith(("Found", "Done"))]
    assert reported == [
        "Found 4 ?: sends heartbeats, but did not answer discovery: firmware 0.5.x?",
        "Done Scan can0: 2 devices",
    ]


def test_vectors_of_a_scan_of_0_5() -> None:
    """There is no discovery: who is heard is there."""
    talk = standing05(4)
    talk.ask(Scan("can0"))
    talk.report("Heartbeat", 9, Axis_State=1)
    talk.run(1850)
    talk.reports(
        """
        1800 < Found 3 ?: axis3, firmware 0.5.x
        1800 < Found 4 ?: axis4, firmware 0.5.x
        1800 < Found 9 ?: sends heartbeats, but did not answer discovery: firmware 0.5.x?
        1800 < Done Scan can0: 3 devices
        """,
        foreign=1,
    )
    assert "63?Address" not in talk.requests
