"""The command decoder beside the twin, and the contract: read-only frames, message names, the spec.

What a drive obeys is in `test_conversation_vectors_obeyed`."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from protocols import messages as msg
from protocols.canopen import sdo
from protocols.canopen.names import messages, read_only
from protocols.canopen.services import Heartbeat, Nmt, NmtCommand, NmtState, Sync, encode, rpdo_id, sdo_rx_id
from protocols.cia402 import objects as o
from protocols.cia402 import plugin, spec
from protocols.cia402.memory import Cia402Decoder
from protocols.cia402.objects import OBJECTS, Key, to_bytes
from protocols.cia402.options import Options, Settings
from protocols.frames import CanFrame, Frame
from protocols.plugin import Device
from tests.protocols.cia402.twin_bench import NODE, TwinBench, device

SEED = 20261121


def two_drives(settings: Settings | None = None) -> Cia402Decoder:
    return Cia402Decoder([device(settings), device(settings, NODE + 1, "n")])


def download(key: Key, value: int, node: int = NODE) -> CanFrame:
    data = sdo.encode(sdo.Download(*key, to_bytes(OBJECTS[key].type, value)))
    return CanFrame(sdo_rx_id(node), data)


def test_each_drive_obeys_its_own_frames() -> None:
    decoder = two_drives()
    written = decoder.decode(0, download(o.PROFILE_VELOCITY, 7, NODE + 1))
    assert written == [msg.WriteParameter("n", "6081", 7.0)]
    assert decoder.decode(0, download(o.PROFILE_VELOCITY, 7, NODE + 2)) == []
    reset_all = encode(Nmt(NmtCommand.RESET_NODE, 0))
    assert decoder.decode(0, reset_all) == [msg.Reboot("m"), msg.Reboot("n")]


def test_decoder_and_twin_accept_the_same() -> None:
    """Random requests: both dictionaries stay the same, except for what only a drive knows."""
    random = np.random.Generator(np.random.PCG64(SEED))
    bench = TwinBench(Settings(pdos="usual"))
    decoder = two_drives(bench.settings)
    deadlines = {(0x1400 + n, o.EVENT_TIMER) for n in range(4)}  # what a drive does at one, it does alone
    rows = [row for row in OBJECTS.values() if row.bits and row.access == "rw" and row.key not in deadlines]
    known = {row.key for row in rows} - {(0x1003, 0)}
    for _ in range(1500):
        row = rows[int(random.integers(len(rows)))]
        value = int(
            random.choice([0, 1, 5, row.type.high, int(random.integers(row.type.low, row.type.high))])
        )
        frames = [
            download(row.key, value),
            encode(Nmt(NmtCommand(int(random.choice([1, 2, 0x80, 0x82]))), NODE)),
            encode(Sync()),
            CanFrame(rpdo_id(int(random.integers(1, 3)), NODE), random.bytes(8)),
        ]
        frame = frames[int(random.choice(4, p=[0.7, 0.1, 0.1, 0.1]))]
        before = dict(decoder.memories[0].node.dictionary.values)
        obeyed = decoder.decode(0, frame)
        bench.run(1, [frame])
        decoders, twins = decoder.memories[0].node.dictionary.values, bench.twin.memory.node.dictionary.values
        assert {k: v for k, v in decoders.items() if k in known} == {
            k: v for k, v in twins.items() if k in known
        }
        if not obeyed:
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
    ("devices", "error"),
    [
        ([device(address=0)], "1 to 127"),
        ([device(address=128)], "1 to 127"),
        ([device(address=127)], "host's own"),
        ([device(), device(name="n")], "is that of"),
        ([device(), Device("n", 6, Options(sync_ms=20), Settings())], r"sync_ms .* 10 for m and 20 for n"),
        ([device(), Device("n", 6, Options(host_id=100), Settings())], r"host_id .* 127 for m and 100 for n"),
        ([device(), Device("n", 6, Options(feedback="event", sync_ms=20), Settings())], ""),
        ([device(), Device("n", 6, Options(watchdog_ms=100), Settings())], ""),
        ([device(address=9), Device("n", 6, Options(host_id=9), Settings())], "host"),
    ],
)
def test_what_cannot_be_on_one_bus_is_refused(devices: list[Device], error: str) -> None:
    with pytest.raises(ValueError, match=error) if error else nullcontext():
        plugin.driver(devices)
