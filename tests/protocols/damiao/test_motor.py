"""What a motor takes, keeps and answers, as shipped firmware has it; its limits; how it is found."""

from __future__ import annotations

from typing import Any

import pytest

from gateway import config
from gateway.errors import ConfigError
from protocols import messages as msg
from protocols.damiao import plugin
from protocols.damiao.options import Options, Settings
from protocols.damiao.table import ANY, about_register, table_of
from protocols.damiao.twin import DamiaoTwin
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Feedback, Mode, Obeyed
from protocols.plugin import Device
from tests.gateway.rig import BENCH
from tests.protocols.helpers import CanBench, bench_of, of

ROBOT = BENCH.replace('"odrive_can"', '"damiao"').replace('{ watchdog = "acknowledged" }', "{}")
ENABLE, CLEAR, DISABLE = (b"\xff" * 7 + bytes((last,)) for last in (0xFC, 0xFB, 0xFD))
VELOCITY = bytes.fromhex("00004040")
"""3.0"""


def twin_of(settings: Settings | None = None, **options: Any) -> DamiaoTwin:
    twin = plugin.twin(Device("left", 1, Options(**options), settings or Settings()), 0)
    assert isinstance(twin, DamiaoTwin)
    twin.step(0, [])
    return twin


def answers(twin: DamiaoTwin, *frames: CanFrame) -> list[CanFrame]:
    """Give it frames, a millisecond each; return what it answers."""
    found: list[Any] = []
    for frame in frames:
        now = (twin.now or 0) + MILLISECOND
        twin.receive(now, frame)
        found += twin.step(now, [])[1]
    return found


def bench(settings: Settings | None = None, **options: Any) -> CanBench[Any, Any]:
    return bench_of(plugin, Device("left", 1, Options(**options), settings or Settings()))


# -- ids and lengths -------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", range(8))
def test_a_word_is_obeyed_on_every_page_of_ids(page: int) -> None:
    twin, frame = twin_of(), CanFrame(page << 8 | 1, ENABLE)
    assert len(answers(twin, frame)) == 1
    assert twin.mode is Mode.ARMED
    assert plugin.decoder([twin.device]).decode(0, frame)[0] == msg.Arm("left")
    assert not answers(twin, CanFrame(page << 8 | 2, DISABLE))
    assert twin.mode is Mode.ARMED


@pytest.mark.parametrize("number", [0x101, 0x201, 0x301, 0x401, 0x701])
@pytest.mark.parametrize("size", [0, 4, 8])
def test_all_that_ends_in_its_id_is_answered_and_feeds_its_watchdog(number: int, size: int) -> None:
    twin = twin_of(Settings(timeout_ms=10.0))
    answers(twin, CanFrame(1, ENABLE))
    frame = CanFrame(number, bytes(range(0x40, 0x40 + size)))
    assert len(answers(twin, *[frame] * 30)) == 30
    assert (twin.mode, twin.torque) == (Mode.ARMED, 0.0)
    answers(twin, *[CanFrame(0x402, b"")] * 12)
    assert twin.mode is Mode.FAULT


def test_a_velocity_of_four_bytes_and_a_read_of_four_are_whole() -> None:
    twin = twin_of(Settings(mode=3))
    (_, answer) = answers(twin, CanFrame(0x201, ENABLE), CanFrame(0x201, VELOCITY))
    assert (twin.goal, answer.id) == (msg.Velocity("left", 3.0), 0x11)
    (answer,) = answers(twin, CanFrame(0x7FF, bytes.fromhex("0100330a")))
    assert answer.data == bytes.fromhex("0100330a03000000")


def test_ids_that_end_alike_are_a_mistake_across_protocols_too() -> None:
    config.parse_robot(ROBOT)
    for right, wrong in (
        ("address = 2\noptions = { reply_id = 0x301 }\n", "0x301 ('left' would obey what it reports there)"),
        ('address = 1\nprotocol = "myactuator"\n', "'left' would obey what it is sent"),
        ('address = 1\nprotocol = "zlac8015d"\n', "'left' would obey what it"),
    ):
        with pytest.raises(ConfigError) as caught:
            config.parse_robot(ROBOT.replace("address = 2\n", right))
        assert wrong in str(caught.value)
    with pytest.raises(ConfigError, match="the motor itself obeys that id"):
        config.parse_robot(ROBOT.replace("address = 2\n", "address = 2\noptions = { reply_id = 0x702 }\n"))


# -- clearing, zero, saving ------------------------------------------------------------------------------


def test_clearing_disarms_a_motor_and_is_not_asked_of_one_that_runs() -> None:
    rig = bench()
    rig.shaft.locked = True
    rig.run(200, msg.Torque("left", 0.5))
    assert rig.twins[0].mode is Mode.ARMED
    (answer,) = of(msg.Done, rig.ask(msg.ClearFault("left"), 50))
    assert answer.detail == "it is armed: nothing to clear"
    assert rig.twins[0].mode is Mode.ARMED
    obeyed: list[Obeyed] = [*plugin.decoder(rig.devices).decode(0, CanFrame(1, CLEAR))]
    assert obeyed == [msg.Idle("left"), msg.ClearFault("left")]
    answers(twin := twin_of(), CanFrame(1, ENABLE), CanFrame(1, CLEAR))
    assert twin.mode is Mode.READY


def test_a_zero_is_taken_while_it_is_enabled() -> None:
    twin = twin_of()
    twin.step(MILLISECOND, [Feedback("left", 0, 2.0, 0.0)])
    answers(twin, CanFrame(1, ENABLE), ANY.encode("zero", 1))
    assert twin.encoder.position == 0.0


def test_it_is_asked_once_to_save_and_its_answer_of_four_bytes_says_that_it_did() -> None:
    rig = bench()
    rig.run(100)
    answer = of(msg.Done, rig.ask(msg.WriteParameter("left", "save_parameters", 1.0), 190))
    assert [each.request for each in answer] == ["WriteParameter"]
    saves = [frame for _, frame in rig.sent if plugin.messages(frame) == ("save",)]
    assert len(saves) == 1
    assert len([frame for _, frame in rig.received if len(frame.data) == 4]) == 1
    lost = bench()
    lost.to_device = lambda frame: plugin.messages(frame) != ("save",)
    lost.run(100)
    assert of(msg.Refused, lost.ask(msg.WriteParameter("left", "save_parameters", 1.0), 250))
    assert len([frame for _, frame in lost.sent if plugin.messages(frame) == ("save",)]) == 1


def test_a_save_while_it_is_enabled_does_nothing() -> None:
    twin = twin_of()
    assert len(answers(twin, CanFrame(1, ENABLE), about_register("save", 1, "TIMEOUT"))) == 1


# -- ranges and ids that it was given --------------------------------------------------------------------


def test_other_ends_of_a_range_count_at_once() -> None:
    twin = twin_of()
    decoder = plugin.decoder([twin.device])
    for frame in (about_register("write", 1, "PMAX", 25.0), CanFrame(1, ENABLE)):
        answers(twin, frame)
        decoder.decode(0, frame)
    wide = table_of("4310", position=25.0)
    frame = wide.encode("MIT", 1, position=20.0, velocity=0.0, torque=0.0, stiffness=1.0, damping=1.0)
    twin.step((twin.now or 0) + MILLISECOND, [Feedback("left", 0, 15.0, 0.0)])
    (answer,) = answers(twin, frame)
    assert getattr(twin.goal, "position", 0.0) == pytest.approx(20.0, abs=1e-3)
    assert getattr(decoder.decode(0, frame)[0], "position", 0.0) == pytest.approx(20.0, abs=1e-3)
    values = wide.read("feedback", answer.data)
    assert values is not None
    assert values["position"] == pytest.approx(15.0, abs=1e-3)


def test_a_j4340_with_a_vmax_of_8_needs_an_option_which_is_named() -> None:
    older = Options(model="4340", velocity_end=8.0)
    rig = bench(model="4340")
    rig.twins[0] = plugin.twin(Device("left", 1, older, Settings()), 0)
    (refused,) = of(msg.Refused, rig.run(100, msg.Torque("left", 0.5)))
    assert "VMAX is 8, not 10; if it is the right one, write velocity_end = 8 under options" in refused.reason
    assert rig.twins[0].mode is Mode.READY
    rig = bench(model="4340", velocity_end=8.0)
    rig.run(100, msg.Velocity("left", 6.0))
    rig.run(1500)
    measured = [each.velocity for each in of(Feedback, rig.events) if each.velocity is not None]
    assert measured[-1] == pytest.approx(rig.shaft.velocity, abs=0.01)


def test_a_new_mst_id_is_where_it_answers_from_then_on_and_is_never_written_here() -> None:
    twin = twin_of()
    frame = CanFrame(0x7FF, bytes.fromhex("0100550723000000"))
    assert [answer.id for answer in answers(twin, frame, ANY.encode("disable", 1))] == [0x23, 0x23]
    rig = bench()
    rig.run(50)
    (answer,) = of(msg.Refused, rig.ask(msg.WriteParameter("left", "MST_ID", 5.0), 50))
    assert answer.reason == "MST_ID is read only"


def test_a_motor_that_answers_by_id_0_runs_if_that_is_said() -> None:
    rig = bench(reply_id=-1)
    rig.run(200, msg.Torque("left", 0.5))
    assert {frame.id for _, frame in rig.received} == {0}
    assert rig.twins[0].mode is Mode.ARMED
    two = ROBOT.replace("options = {}", "options = { reply_id = -1 }")
    with pytest.raises(ConfigError, match="would both answer by 0x000"):
        config.parse_robot(two)


@pytest.mark.parametrize(
    ("reply", "note"), [(0x000, "answers with 000"), (0x123, "that is to be its reply_id")]
)
def test_a_scan_finds_a_motor_whatever_its_mst_id_is(reply: int, note: str) -> None:
    rig = bench()
    other = Options(reply_id=reply or -1)
    rig.twins[0] = plugin.twin(Device("left", 3, other, Settings()), 0)
    rig.run(200)
    events = rig.ask(msg.Scan("can0"), 400)
    (found,) = of(msg.Found, events)
    assert (found.address, note in found.detail) == (3, True)
    (done,) = of(msg.Done, events)
    assert done.detail == "1 device"


def test_a_scan_asks_none_to_present_itself_where_one_was_found() -> None:
    rig = bench()
    rig.run(100)
    assert of(msg.Found, rig.ask(msg.Scan("can0"), 400))
    assert not [frame for _, frame in rig.sent if plugin.messages(frame) == ("discover",)]


# -- limits ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        (Settings(OT_Value=80.0, temperature=90), 0xC),
        (Settings(UV_Value=30.0), 0x9),
        (Settings(OV_Value=20.0), 0x8),
    ],
)
def test_its_protections_trip_also_after_they_were_cleared(settings: Settings, code: int) -> None:
    twin = twin_of(settings)
    for word in (ENABLE, CLEAR):
        answers(twin, CanFrame(1, word))
        assert (twin.mode, twin.fault) == (Mode.FAULT, code)


def turned(settings: Settings, milliseconds: int, *, locked: bool = False) -> tuple[float, float]:
    """Return velocity and torque after some time at 20 rad/s, in mode vel."""
    rig = bench(settings, mode="vel")
    rig.run(100)
    rig.shaft.locked = locked
    rig.run(milliseconds, msg.Velocity("left", 20.0))
    return rig.shaft.velocity, rig.twins[0].torque


def test_its_limits_hold() -> None:
    free, _ = turned(Settings(), 2000)
    assert free == pytest.approx(20.0, abs=0.1)
    limited, _ = turned(Settings(MAX_SPD=7.0), 2000)
    assert limited == pytest.approx(7.0, abs=0.1)
    slow, _ = turned(Settings(ACC=5.0), 1020)
    assert 4.0 < slow < 5.5
    _, blocked = turned(Settings(), 3000, locked=True)
    _, weak = turned(Settings(OC_Value=0.1), 3000, locked=True)
    assert [blocked, weak] == pytest.approx([9.8, 1.0])
    _, soft = turned(Settings(KI_ASR=0.0, KP_ASR=0.002), 1000, locked=True)
    assert soft == pytest.approx(3.0, abs=0.1)
