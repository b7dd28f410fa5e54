"""Package canopen 2.4.1 as the encoder's host, and as the encoder; what is withheld, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes

from protocols.canopen.objects import DEVICE_TYPE, Type
from protocols.cia406 import plugin
from protocols.cia406 import table as enc
from protocols.cia406.driver import Options
from protocols.cia406.twin import Settings
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Event, Fault, Kept, ShaftReading, State
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from tests.protocols.cia402.stack import Joined

NODE = 5
TYPES = {Type.U16: datatypes.UNSIGNED16, Type.U32: datatypes.UNSIGNED32}


def dictionary() -> Any:
    """The objects, as the package has them."""
    made: Any = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
    for key in (DEVICE_TYPE, *(each for each in enc.OBJECTS if each[0] >= 0x6000)):
        row = enc.OBJECTS[key]
        variable = ODVariable(row.name, *key)
        variable.data_type, variable.access_type = TYPES[row.type], "rw" if row.access == "rw" else "ro"
        made.add_object(variable)
    return made


def encoder(**options: Any) -> Device:
    return Device("axle", NODE, Options(**options), Settings())


class Rig:
    """A driver, and a device of the package or the twin behind it, in steps of 1 ms."""

    def __init__(self, device: Any = None, **options: Any) -> None:
        self.driver, self.now = plugin.driver([encoder(**options)]), 10**9
        self.twin = plugin.twin(encoder(), 0) if device is None else None
        self.network = Joined()
        if device is not None:
            self.network.add_node(device)
        self.angle = 0.0
        self.sent: list[CanFrame] = []

    def run(self, steps: int) -> Sequence[Event]:
        events: list[Event] = []
        for _ in range(steps):
            self.now += MILLISECOND
            _, frames = self.driver.send(self.now, [])
            for frame in frames:
                assert isinstance(frame, CanFrame)
                self.sent.append(frame)
                self.network.handle(frame)
                if self.twin is not None:
                    self.twin.receive(self.now, frame)
            back, self.network.sent = list(self.network.sent), []
            if self.twin is not None:
                truth = [ShaftReading("axle", self.now, self.angle)]
                back += [each for each in self.twin.step(self.now, truth)[1] if isinstance(each, CanFrame)]
            for frame in back:
                events += self.driver.receive(self.now, frame)
        return events


def angles(events: Sequence[Event]) -> list[float]:
    return [event.position for event in events if isinstance(event, ShaftReading)]


def told(events: Sequence[Event]) -> list[str]:
    return [event.detail for event in events if isinstance(event, State)]


def test_the_driver_reads_an_encoder_of_the_package_and_writes_nothing() -> None:
    device: Any = canopen.LocalNode(NODE, dictionary())
    values = {0x1000: 0x00020196, 0x6000: enc.SCALED, 0x6001: 8192, 0x6501: 65_536, 0x6503: 0, 0x6004: 2048}
    for index, value in values.items():
        device.sdo[index].raw = value
    rig = Rig(device, units=8192)
    assert angles(rig.run(500))[-1] == pytest.approx(math.pi / 2.0)
    assert all(plugin.spec(encoder()).read_only(frame) for frame in rig.sent)
    device.sdo[0x6503].raw = enc.POSITION_ERROR
    events = rig.run(500)
    assert [event.code for event in events if isinstance(event, Fault)] == [enc.POSITION_ERROR]
    assert angles(rig.run(100)) == []
    device.sdo[0x6503].raw = 0
    assert len(angles(rig.run(500))) > 20


def test_the_package_reads_and_presets_the_twin() -> None:
    twin, network, now = plugin.twin(encoder(), 0), Joined(), 10**9
    node: Any = network.add_node(canopen.RemoteNode(NODE, dictionary()))

    def pass_on(frame: CanFrame) -> None:
        nonlocal now
        now += MILLISECOND
        twin.receive(now, frame)
        for each in twin.step(now, [ShaftReading("axle", now, -0.25 * math.tau)])[1]:
            assert isinstance(each, CanFrame)
            network.notify(each.id, bytearray(each.data), now / 1e9)

    twin.step(now, [])
    network.on_sent = pass_on
    sdo = node.sdo
    assert (sdo[0x1000].raw, sdo[0x6501].raw, sdo[0x6502].raw) == (0x20196, 4096, 4096)
    assert sdo[0x6004].raw == 4096 * 4096 - 1024
    sdo[0x6003].raw = 1000
    assert sdo[0x6004].raw == 1000
    with pytest.raises(canopen.SdoAbortedError):
        sdo[0x6004].raw = 1


def test_what_a_host_would_write_is_decoded_as_such() -> None:
    decoder, vectors = plugin.decoder([encoder()]), {v.name: v.frame for v in vectors_of(plugin)}
    assert decoder.decode(0, vectors["read_position"]) == []
    assert decoder.decode(0, vectors["preset_1000"]) == [Kept("axle", "6003", 1000.0)]
    assert not plugin.spec(encoder()).read_only(vectors["preset_1000"])


def test_other_units_than_stated_are_said_and_nothing_is_read() -> None:
    rig = Rig(units=1000)
    events = rig.run(300)
    assert angles(events) == []
    assert told(events)[-1] == "has 4096 units per turn, and the robot file says 1000: it is not read"


def test_another_device_is_said() -> None:
    device: Any = canopen.LocalNode(NODE, dictionary())
    device.sdo[0x1000].raw = 0x00020192
    for index in (0x6000, 0x6001, 0x6501, 0x6503, 0x6004):
        device.sdo[index].raw = 4096 * (index == 0x6501)
    assert told(Rig(device).run(300))[-1] == "is no encoder by CiA 406: its device type is 0x20192"


def test_one_that_restarts_is_asked_anew() -> None:
    rig = Rig()
    rig.angle = 1.0
    assert angles(rig.run(200))[-1] == pytest.approx(1.0, abs=1e-3)
    rig.twin = plugin.twin(encoder(), 1)
    rig.angle = 2.0
    asked = len(rig.sent)
    assert angles(rig.run(200))[-1] == pytest.approx(2.0, abs=1e-3)
    assert [f for f in rig.sent[asked:] if f.data[1:4] == bytes.fromhex("001000")]
