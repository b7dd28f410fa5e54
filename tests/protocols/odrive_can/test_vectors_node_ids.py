"""Conversations of vectors: node ids given out, and discovery."""

from __future__ import annotations

from protocols.wire import CanFrame
from protocols.words import (
    Scan,
    SetId,
)
from tests.protocols.odrive_can.conversation import (
    DISCOVERED,
    SERIAL,
    Talk,
    device,
    standing,
)


def test_vectors_of_node_ids_given_out() -> None:
    talk = standing()
    for serial, address in ((0, 5), (1, -1), (1, 63), (1, 62), (1 << 48, 5), ((1 << 48) - 1, 0)):
        talk.ask(SetId("can0", serial, address))
        talk.run(20)
    talk.run(1600)
    talk.hear(DISCOVERED)
    talk.ask(SetId("can0", SERIAL, 5))
    talk.ask(SetId("can0", SERIAL, 3))
    talk.ask(SetId("can0", SERIAL + 1, 3))
    talk.run(300)
    talk.hear(CanFrame(0xA6, bytes.fromhex("05303373345f3800")))
    talk.hear(CanFrame(0xA6, bytes.fromhex("05303373345f3900")))
    talk.hear(CanFrame(0xC6, bytes.fromhex("06303373345f3800")))
    talk.run(100)
    talk.hear(CanFrame(0x66, bytes.fromhex("03303373345f3800")))
    talk.hear(CanFrame(0x66, bytes.fromhex("05303373345f3800")))
    talk.hear(CanFrame(0x66, bytes.fromhex("0330337334")))
    talk.run(20)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        210 < Refused SetId can0 0 is not a serial number of 48 bits
        230 < Refused SetId can0 -1 is not a node id: 0 to 62
        250 < Refused SetId can0 63 is not a node id: 0 to 62
        270 > 63:0x06 3e010000000000 | 63?Address
        290 < Refused SetId can0 281474976710656 is not a serial number of 48 bits
        310 > 63:0x06 00ffffffffffff | 63?Address
        510 > 63:0x06 3e010000000000 | 63?Address
        550 > 63:0x06 00ffffffffffff | 63?Address
        750 > 63:0x06 3e010000000000 | 63?Address
        790 > 63:0x06 00ffffffffffff | 63?Address
        990 > 63:0x06 3e010000000000 | 63?Address
        1030 > 63:0x06 00ffffffffffff | 63?Address
        1230 > 63:0x06 3e010000000000 | 63?Address
        1270 > 63:0x06 00ffffffffffff | 63?Address
        1470 > 63:0x06 3e010000000000 | 63?Address
        1510 > 63:0x06 00ffffffffffff | 63?Address
        1710 > 63:0x06 3e010000000000 | 63?Address
        1750 > 63:0x06 00ffffffffffff | 63?Address
        1770 < Refused SetId can0 no device with serial number 000000000001 took the node id
        1810 < Refused SetId can0 no device with serial number FFFFFFFFFFFF took the node id
        1930 > 63:0x06 05303373345f38 | 63?Address
        1930 > 63:0x06 03303373345f38 | 63?Address
        1930 < Refused SetId can0 node id 3 is held by serial number 385F34733330
        2170 > 63:0x06 05303373345f38 | 63?Address | 63:0x06 03303373345f38 | 63?Address
        2230 < Done SetId can0 not saved yet: write save_configuration 1 to keep it after power-off
        2230 < Found odrive_can 5 61981553013552 node id 5 is held twice: by 385F34733330 and 395F34733330
            True
        2230 < Found odrive_can 5 63081064641328 node id 5 is held twice: by 385F34733330 and 395F34733330
            True
        2330 < Done SetId can0 not saved yet: write save_configuration 1 to keep it after power-off
        heard 265, bad 1, foreign 1
        """)


def test_vectors_of_a_scan() -> None:
    talk = Talk([device(poll_ms=0), device("right", 4, poll_ms=0)], every=50)
    talk.up()
    talk.up(4)
    talk.run(220)
    talk.ask(Scan("can0"))
    for _ in range(2):
        talk.hear(DISCOVERED)
    talk.hear(CanFrame(0x7E6, bytes.fromhex("3f303373345f39")))
    talk.hear(CanFrame(0xE6, bytes.fromhex("07303373345f36")))
    talk.beat(node=8)
    talk.tell("Heartbeat", 0, extended=True, Axis_State=1)
    talk.tell("Heartbeat", 20, extended=True, Axis_State=1)
    talk.tell("Get_Encoder_Estimates", 21)
    talk.hear(CanFrame(0x2C1, b"\0\0\0\0\1\0"))
    talk.run(1850)
    talk.ask(Scan("can0"), Scan("can0"))
    talk.hear(CanFrame(0x86, bytes.fromhex("04303373345f37")))
    talk.run(1850)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 < State right initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 4?Get_Version | 4?Get_Bus_Voltage_Current |
            63?Address
        1 > 3?Get_Encoder_Estimates | 4?Get_Encoder_Estimates
        100 < State left ready IDLE
        100 < State right ready IDLE
        220 > 63?Address
        220 < Found odrive_can 3 61981553013552 left, firmware 0.6.10 False
        220 < Found odrive_can 63 63081064641328 has no node id yet False
        220 < Found odrive_can 7 59782529758000  False
        820 > 63?Address
        1420 > 63?Address
        2020 < Found odrive_can 4 None right, firmware 0.6.10 False
        2020 < Found odrive_can 8 None heard, but it did not answer discovery: firmware 0.5.x? False
        2020 < Found odrive_can 0 None heard, but it did not answer discovery: firmware 0.5.x?, extended
            identifiers False
        2020 < Found odrive_can 20 None heard, but it did not answer discovery: firmware 0.5.x?, extended
            identifiers False
        2020 < Done Scan can0 7 devices
        2070 > 2 × 63?Address
        2070 < Found odrive_can 4 60882041385776 right, firmware 0.6.10 False (× 2)
        2670 > 2 × 63?Address
        3270 > 2 × 63?Address
        3870 < Found odrive_can 3 None left, firmware 0.6.10 False
        3870 < Found odrive_can 8 None heard, but it did not answer discovery: firmware 0.5.x? False
        3870 < Done Scan can0 3 devices
        3870 < Found odrive_can 3 None left, firmware 0.6.10 False
        3870 < Found odrive_can 8 None heard, but it did not answer discovery: firmware 0.5.x? False
        3870 < Done Scan can0 3 devices
        heard 871, bad 0, foreign 41
        """)
