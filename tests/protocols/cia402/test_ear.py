"""What the ear hears: the words that drives obey, by SDO and PDO, with and without SYNC."""

from __future__ import annotations

import math

import numpy as np
import pytest

from protocols import messages as msg
from protocols.cia402 import messages, plugin, read_only, sdo, spec
from protocols.cia402 import objects as o
from protocols.cia402.codec import Heartbeat, Nmt, NmtCommand, NmtState, Sync, encode, rpdo_id, sdo_rx_id
from protocols.cia402.decoder import Cia402Decoder
from protocols.cia402.objects import OBJECTS, Key, to_bytes
from protocols.cia402.options import Options, Settings
from protocols.cia402.pdo import mapping, packing
from protocols.cia402.profile import Mode
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Request
from protocols.plugin import Device
from tests.protocols.cia402.bench import NODE, Bench, device

SEED = 20261121
TURN = 16_384


class Listener:
    """An ear for one drive, and a host that speaks."""

    def __init__(self, settings: Settings | None = None) -> None:
        self.decoder = Cia402Decoder([device(settings), device(settings, NODE + 1, "n")])
        self.settings = settings

    def handle(self, frame: Frame) -> list[Command | Request]:
        return list(self.decoder.decode(0, frame))

    def put(self, key: Key, value: int, node: int = NODE) -> list[Command | Request]:
        data = sdo.encode(sdo.Download(*key, to_bytes(OBJECTS[key].type, value)))
        return self.handle(CanFrame(sdo_rx_id(node), data))

    def enable(self, mode: Mode) -> list[Command | Request]:
        assert self.put(o.MODE, mode) == []
        return [word for value in (0x06, 0x07, 0x0F) for word in self.put(o.CONTROLWORD, value)]


@pytest.mark.parametrize(
    ("mode", "key", "value", "word"),
    [
        (Mode.CSP, o.TARGET_POSITION, TURN // 4, msg.Position("m", math.tau / 4)),
        (Mode.CSV, o.TARGET_VELOCITY, -TURN, msg.Velocity("m", -math.tau)),
        (Mode.CST, o.TARGET_TORQUE, 250, msg.Torque("m", 0.25)),
        (Mode.PV, o.TARGET_VELOCITY, TURN, msg.Velocity("m", math.tau)),
        (Mode.PT, o.TARGET_TORQUE, -100, msg.Torque("m", -0.1)),
    ],
    ids=lambda v: getattr(v, "name", None),
)
def test_a_set_point_is_a_word_once_the_drive_is_enabled(
    mode: Mode, key: Key, value: int, word: Command
) -> None:
    host = Listener()
    assert host.put(key, value) == []
    assert host.enable(mode) == [word], "and what stood there is obeyed at once"
    assert host.put(key, value) == [word]
    assert host.put(o.CONTROLWORD, 0x0F) == [word]
    assert host.put(o.CONTROLWORD, 0x06) == [msg.Idle("m")]
    assert host.put(key, value) == []


def test_offsets_are_feed_forward() -> None:
    host = Listener()
    host.enable(Mode.CSP)
    host.put(o.VELOCITY_OFFSET, TURN)
    assert host.put(o.TORQUE_OFFSET, 500) == [msg.Position("m", 0.0, math.tau, 0.5)]
    assert host.put(o.MODE, Mode.CSV) == [msg.Velocity("m", math.tau, 0.5)]
    assert host.put(o.MODE, Mode.CST) == [msg.Torque("m", 0.5)]


def test_profile_position_takes_a_set_point_with_bit_4() -> None:
    host = Listener()
    assert host.enable(Mode.PP) == []
    assert host.put(o.TARGET_POSITION, TURN) == []
    assert host.put(o.CONTROLWORD, 0x1F) == [msg.Position("m", math.tau)]
    host.put(o.CONTROLWORD, 0x0F)
    host.put(o.TARGET_POSITION, TURN // 2)
    assert host.put(o.CONTROLWORD, 0x5F) == [msg.Position("m", 1.5 * math.tau)]


def test_requests_are_heard() -> None:
    host = Listener()
    host.enable(Mode.HM)
    assert host.put(o.CONTROLWORD, 0x1F) == [msg.Home("m")]
    assert host.put(o.CONTROLWORD, 0x0F) == []
    assert host.put(o.CONTROLWORD, 0x02) == [msg.Estop("m")]
    assert host.put(o.CONTROLWORD, 0x80) == [msg.ClearFault("m")]
    assert host.put(o.CONTROLWORD, 0x80) == []
    assert host.put(o.PROFILE_VELOCITY, 99) == [msg.WriteParameter("m", "6081", 99.0)]
    assert host.put(o.PROFILE_VELOCITY, 0) == [], "refused: not obeyed"
    assert host.put((0x1400, o.TRANSMISSION), 1) == [msg.WriteParameter("m", "1400:02", 1.0)]
    assert host.handle(encode(Nmt(NmtCommand.RESET_NODE, 0))) == [msg.Reboot("m"), msg.Reboot("n")]


def test_the_other_drive_hears_its_own() -> None:
    host = Listener()
    assert host.put(o.PROFILE_VELOCITY, 7, NODE + 1) == [msg.WriteParameter("n", "6081", 7.0)]
    assert host.put(o.PROFILE_VELOCITY, 7, NODE + 2) == []


def test_after_a_quick_stop_the_way_back_is_heard_either_way() -> None:
    """Whether the drive still slows down the ear cannot know: it hears what may be obeyed."""
    for option, words in ((2, (0x06, 0x07, 0x0F)), (6, (0x0F,))):
        host = Listener(Settings(quick_stop_option=option))
        host.enable(Mode.CSV)
        host.put(o.CONTROLWORD, 0x02)
        assert [word for value in words for word in host.put(o.CONTROLWORD, value)] == [
            msg.Velocity("m", 0.0)
        ]


@pytest.mark.parametrize("transmission", [0, 1, 240, 254, 255])
def test_an_rpdo_is_heard_when_it_takes_effect(transmission: int) -> None:
    host = Listener(Settings(pdos="usual"))
    host.put((0x1400, o.TRANSMISSION), transmission)
    pack = packing(mapping(o.CONTROLWORD, o.MODE, o.TARGET_POSITION))

    def rpdo(word: int, position: int) -> list[Command | Request]:
        frame = CanFrame(rpdo_id(1, NODE), pack.pack((word, Mode.CSP, position)))
        return [*host.handle(frame), *(host.handle(encode(Sync())) if transmission <= 240 else [])]

    assert rpdo(0x06, 0) == [], "not in operational"
    host.handle(encode(Nmt(NmtCommand.START, NODE)))
    assert rpdo(0x06, 5) == rpdo(0x07, 5) == []
    assert rpdo(0x0F, 5) == [msg.Position("m", 5 * math.tau / TURN)]
    if transmission <= 240:
        assert host.handle(encode(Sync())) == [], "what was taken over waits no more"
        host.handle(CanFrame(rpdo_id(1, NODE), pack.pack((0x0F, Mode.CSP, 6))))
        latest = pack.pack((0x0F, Mode.CSP, 7))
        assert host.handle(CanFrame(rpdo_id(1, NODE), latest)) == []
        assert host.handle(encode(Sync())) == [msg.Position("m", 7 * math.tau / TURN)]
    assert rpdo(0x00, 5) == [msg.Idle("m")]


def test_ear_and_twin_take_the_same_things_to_heart() -> None:
    """Random requests: the twin's dictionary and the ear's stay the same, but for what only a drive knows."""
    random = np.random.Generator(np.random.PCG64(SEED))
    bench, host = Bench(Settings(pdos="usual")), Listener(Settings(pdos="usual"))
    deadlines = {(0x1400 + n, o.EVENT_TIMER) for n in range(4)}  # what a drive does at one, it does alone
    rows = [row for row in OBJECTS.values() if row.bits and row.access == "rw" and row.key not in deadlines]
    known = {row.key for row in rows}
    for _ in range(1500):
        row = rows[int(random.integers(len(rows)))]
        value = int(
            random.choice([0, 1, 5, row.type.high, int(random.integers(row.type.low, row.type.high))])
        )
        data = sdo.encode(sdo.Download(*row.key, to_bytes(row.type, value)))
        frames = [
            CanFrame(sdo_rx_id(NODE), data),
            encode(Nmt(NmtCommand(int(random.choice([1, 2, 0x80, 0x82]))), NODE)),
            encode(Sync()),
            CanFrame(rpdo_id(int(random.integers(1, 3)), NODE), random.bytes(8)),
        ]
        frame = frames[int(random.choice(4, p=[0.7, 0.1, 0.1, 0.1]))]
        before = dict(host.decoder.axes[0].dictionary.values)
        words = host.handle(frame)
        bench.run(1, [frame] if isinstance(frame, CanFrame) else [])
        decoders, twins = host.decoder.axes[0].dictionary.values, bench.twin.axis.dictionary.values
        assert {k: v for k, v in decoders.items() if k in known} == {
            k: v for k, v in twins.items() if k in known
        }
        if not words:
            quiet = (o.CONTROLWORD, o.MODE, *o.TARGETS)
            assert {k: v for k, v in decoders.items() if k not in quiet} == {
                k: v for k, v in before.items() if k not in quiet
            }


# -- the contract ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "harmless", "name"),
    [
        (CanFrame(0x605, sdo.encode(sdo.Upload(0x1000, 0))), True, "SDO upload"),
        (CanFrame(0x605, sdo.encode(sdo.UploadSegment(True))), True, "SDO upload segment"),
        (CanFrame(0x605, sdo.encode(sdo.Abort(0x1000, 0, sdo.TIMEOUT))), True, "SDO abort"),
        (CanFrame(0x605, sdo.encode(sdo.Download(0x6040, 0, b"\x06\0"))), False, "SDO download 6040"),
        (CanFrame(0x605, sdo.encode(sdo.DownloadStart(0x1008, 0, 9))), False, "SDO segmented download 1008"),
        (CanFrame(0x605, sdo.encode(sdo.DownloadSegment(False, b"x", True))), False, "SDO download segment"),
        (CanFrame(0x605, b"\x40"), False, ""),
        (CanFrame(0x605, bytes((0xC0, 0, 0, 0, 0, 0, 0, 0))), False, ""),
        (CanFrame(0x585, sdo.encode(sdo.Downloaded(0x6040, 0))), False, ""),
        (encode(Nmt(NmtCommand.START, 5)), False, "NMT start"),
        (encode(Nmt(NmtCommand.RESET_NODE, 5)), False, "NMT reset node"),
        (encode(Sync()), False, "SYNC"),
        (encode(Heartbeat(127, NmtState.OPERATIONAL)), False, "heartbeat"),
        (CanFrame(0x305, b"1234"), False, "RPDO2"),
        (CanFrame(0x185, b"1234"), False, ""),
        (CanFrame(0x605, sdo.encode(sdo.Upload(0x1000, 0)), extended=True), False, ""),
        (b"bytes", False, ""),
    ],
    ids=str,
)
def test_what_is_read_only_and_what_it_is_called(frame: Frame, harmless: bool, name: str) -> None:
    assert read_only(frame) is harmless
    assert tuple(messages(frame)) == ((name,) if name else ())


def test_the_spec_follows_options_and_settings() -> None:
    usual = spec(device())
    assert usual.watchdog.enabled
    assert usual.watchdog.timeout == 500_000_000
    assert not usual.watchdog.note
    assert not usual.holds_unattended
    assert {"Position.velocity", "Velocity.torque"} <= set(usual.ranges)
    profile = spec(Device("m", NODE, Options(modes="profile"), Settings()))
    assert "Position.velocity" not in profile.ranges
    bare = spec(Device("m", NODE, Options(watchdog_ms=0), Settings(supported_modes=0x100)))
    assert bare.commands == {msg.Idle, msg.Hold, msg.Velocity}
    assert bare.watchdog.timeout is None
    assert "keeps its last set-point" in bare.watchdog.note
    assert bare.holds_unattended


@pytest.mark.parametrize(
    ("devices", "said"),
    [
        ([device(address=0)], "1 to 127"),
        ([device(address=128)], "1 to 127"),
        ([device(address=127)], "host's own"),
        ([device(), device(name="n")], "given twice"),
        ([device(), Device("n", 6, Options(sync_ms=20), Settings())], "sync_ms must be the same"),
        ([device(address=9), Device("n", 6, Options(host_id=9), Settings())], "host"),
    ],
)
def test_what_cannot_be_on_one_bus_is_told(devices: list[Device], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        plugin.driver(devices)
