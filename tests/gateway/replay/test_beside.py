"""Two recordings beside each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from gateway.core.tick import Note, Tick
from gateway.recording import Recorder, Recording, read_recording
from gateway.replay import Beside, Difference, first_difference
from protocols import messages as msg
from protocols.frames import BusState
from tests.gateway import little
from tests.gateway.little import Little

LATER = 7_000_000_000


def recorded(path: Path, alter: Callable[[Tick], Tick | None] = lambda tick: tick) -> Recording:
    with Recorder(path, little.ROBOT, {}, little.MOUNTS) as recorder:
        for tick, belief in little.life(200):
            changed = alter(tick)
            if changed is not None:
                recorder.record(changed, belief, patient=True)
    return read_recording(path)


def shifted(tick: Tick, by: int = LATER) -> Tick:
    """The same at another time."""
    packets = [
        tuple(replace(p, t=p.t + by) for p in side) for side in (tick.inputs.packets, tick.outputs.packets)
    ]
    events = tuple(replace(event, t=event.t + by) for event in tick.outputs.events)
    return replace(
        tick,
        now=tick.now + by,
        inputs=replace(tick.inputs, packets=packets[0]),
        outputs=replace(tick.outputs, packets=packets[1], events=events),
    )


def at(number: int, change: Callable[[Tick], Tick | None]) -> Callable[[Tick], Tick | None]:
    return lambda tick: change(tick) if tick.number == number else tick


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return recorded(tmp_path_factory.mktemp("one") / "a.mcap")


def test_the_same_at_another_time_is_the_same(one: Recording, tmp_path: Path) -> None:
    two = recorded(tmp_path / "b.mcap", shifted)
    beside = Beside(one, two)
    assert not beside.advance(150)
    assert beside.advance(100)
    assert (beside.ticks, beside.found, beside.times, beside.settings) == (200, (), None, [])
    assert first_difference(one, two) is None


CHANGES: dict[str, tuple[Callable[[Tick], Tick], str]] = {
    "states": (
        lambda t: replace(t, inputs=replace(t.inputs, states=(("can0", BusState.OFF),))),
        "state of a bus\n  in the first:  nothing more\n  in the second: can0: ",
    ),
    "received": (
        lambda t: replace(t, inputs=replace(t.inputs, packets=t.inputs.packets[1:])),
        "received\n  in the first:  can0: frame ",
    ),
    "instructions": (
        lambda t: replace(t, inputs=replace(t.inputs, instructions=(msg.Stop("enough"),))),
        "instruction\n  in the first:  nothing more\n  in the second: Stop",
    ),
    "events": (
        lambda t: replace(t, outputs=replace(t.outputs, events=())),
        "event of a device\n  in the first:  left: Feedback position 0.8415 rad\n  in the second: ",
    ),
    "packets": (
        lambda t: replace(t, outputs=replace(t.outputs, packets=t.outputs.packets * 2)),
        "sent\n  in the first:  nothing more\n  in the second: can0: frame ",
    ),
    "notes": (
        lambda t: replace(t, outputs=replace(t.outputs, notes=(Note("error", "left", "\x1b[2J"),))),
        "note\n  in the first:  nothing more\n  in the second: left: \\x1b[2J (error)",
    ),
    "times": (lambda t: shifted(t, 1000), "time since the start\n  in the first:  0.500000000 s\n"),
}


@pytest.mark.parametrize("kind", CHANGES)
def test_the_first_difference_is_named(kind: str, one: Recording, tmp_path: Path) -> None:
    change, text = CHANGES[kind]
    two = recorded(tmp_path / "b.mcap", at(100, change))
    found = first_difference(one, two)
    assert found is not None
    assert (found.kind, found.tick, found.since) == (kind, 100, 100 * little.PERIOD)
    assert found.text.startswith(text), found.text
    beside = Beside(one, two)
    assert beside.advance(1000)
    assert beside.ticks == (200 if kind == "times" else 100)


def test_other_time_stamps_are_not_what_ends_it(one: Recording, tmp_path: Path) -> None:
    def late(tick: Tick) -> Tick:
        tick = shifted(tick, tick.number)
        return CHANGES["notes"][0](tick) if tick.number == 150 else tick

    beside = Beside(one, recorded(tmp_path / "b.mcap", late))
    assert beside.advance(1000)
    assert [(each.kind, each.tick) for each in beside.found] == [("notes", 150)]
    assert beside.times is not None
    assert (beside.times.kind, beside.times.tick) == ("times", 1)


def test_one_that_ends_sooner(one: Recording, tmp_path: Path) -> None:
    two = recorded(tmp_path / "b.mcap", lambda tick: tick if tick.number < 150 else None)
    expected = ("recording", 150, 150 * little.PERIOD)
    for pair, text in (
        ((one, two), "what follows\n  in the first:  tick 150\n  in the second: its end"),
        ((two, one), "what follows\n  in the first:  its end\n  in the second: tick 150"),
    ):
        found = first_difference(*pair)
        assert isinstance(found, Difference)
        assert (found.kind, found.tick, found.since, found.text) == (*expected, text)


def test_one_that_is_damaged(one: Recording, tmp_path: Path) -> None:
    data = bytearray(one.path.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "b.mcap").write_bytes(data)
    found = first_difference(one, read_recording(tmp_path / "b.mcap"))
    assert found is not None
    assert found.kind == "recording"
    assert "in the second: nothing that can be read: " in found.text


def test_other_settings_are_listed(one: Recording, tmp_path: Path) -> None:
    text = little.ROBOT.replace("gain = 2.0", "gain = 3.0")
    with Recorder(tmp_path / "b.mcap", text, {}, little.MOUNTS) as recorder:
        for tick, belief in little.life(200, Little(gain=3.0)):
            recorder.record(tick, belief, patient=True)
    beside = Beside(one, read_recording(tmp_path / "b.mcap"))
    assert beside.settings == ["brain.gain: 2.0 in the first, 3.0 in the second"]
    assert beside.advance(10)
    assert [each.kind for each in beside.found] == ["packets"]
