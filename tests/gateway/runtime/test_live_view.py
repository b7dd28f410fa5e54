"""A session, simulated devices and recordings in the live view, by its port."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from gateway.cli.live import view_on_demand
from gateway.config import load_robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs, Tick
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.replay import first_difference, replay_recording
from gateway.replay.player import Player
from gateway.runtime import replay_view
from gateway.runtime.replay_view import ReplayView
from gateway.runtime.session import Session, open_session
from gateway.view import Access, Address, parse_address
from gateway.view.requests import NO_ROBOT
from protocols.messages import MILLISECOND, SECOND, Goal, Instruction, Release, Stop
from tests.gateway.view.clients import Browser


def address_of(url: str) -> Address:
    return parse_address(url.partition("//")[2].partition("/")[0])


class Watched:
    """A session in simulated time with a page: each tick polls both."""

    def __init__(self, session: Session, *, steer: bool = True) -> None:
        self.session = session
        self.page = Browser(address_of(session.view("0", steer=steer)))
        self.ticks: Iterator[Tick] = iter(session.run())
        self.until(lambda: bool(self.page.of("state")) and self.page.of("state")[-1]["state"] == "ready")

    def until(self, what: Callable[[], bool], seconds: float = 60.0) -> None:
        for tick in self.ticks:
            self.page.poll()
            if what():
                return
            assert tick.seconds < seconds, self.page.messages[-20:]

    def ask(self, line: str) -> None:
        answers = len(self.page.of("answer"))
        self.page.send({"ask": line})
        self.until(lambda: len(self.page.of("answer")) > answers)


@pytest.fixture
def watched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Watched]:
    monkeypatch.chdir(tmp_path)
    with open_session("diffbot", simulated=True, record="drive.mcap") as session:
        made = Watched(session)
        yield made
        made.page.close()


def test_a_page_drives_the_robot_and_the_recording_replays_it(watched: Watched) -> None:
    page = watched.page
    watched.ask("goal 0.6 0.2")
    watched.until(lambda: watched.session.belief.reached == 1)
    x, y, _ = page.of("state")[-1]["pose"]
    assert abs(x - 0.6) < 0.1
    assert abs(y - 0.2) < 0.1
    assert page.of("tiles")
    assert page.of("scan")[-1]["lidars"][0]["count"] * 4 == len(page.of("scan")[-1]["bytes"])
    assert any(one["bytes"] for one in page.of("path"))
    watched.ask("set brain.pursuit.lookahead_time 0.9")
    watched.until(lambda: len(page.of("settings")) == 2)
    rows = {row["key"]: row for row in page.of("settings")[-1]["rows"]}
    assert rows["brain.pursuit.lookahead_time"]["value"] == 0.9
    watched.ask("stop enough")
    watched.until(lambda: page.of("state")[-1]["stopped"] == "enough")
    watched.session.close()
    assert replay_recording(read_recording(Path("drive.mcap"))).ok


def test_a_fault_is_explained_and_cleared_by_a_page(watched: Watched) -> None:
    page, session = watched.page, watched.session
    assert session.twins is not None
    device = next(one for one in session.twins.buses["can0"].devices if one.name == "left")
    code, info = next(iter(device.settings.spec.faults.items()))
    device.twin.provoke(code)
    watched.until(lambda: bool(page.of("state")[-1]["faults"]))
    [fault] = page.of("state")[-1]["faults"]
    assert (fault["joint"], fault["name"], fault["remedy"]) == ("left", info.name, info.remedy)
    assert page.of("joints")[-1]["rows"][0][-1] == 1
    watched.ask("clear left")
    watched.until(lambda: not page.of("state")[-1]["faults"])


def test_a_recording_is_switched_on_and_off(watched: Watched) -> None:
    page, session = watched.page, watched.session
    assert page.of("state")[-1]["recording"] == "drive.mcap"
    for on in (False, True):
        page.send({"record": on, "id": 1})
        watched.until(lambda on=on: bool(page.of("state")[-1]["recording"]) is on)  # type: ignore[misc]
    second = Path(page.of("state")[-1]["recording"])
    end = session.clock.now() + SECOND
    watched.until(lambda: session.clock.now() > end)
    session.close()
    first, later = read_recording(Path("drive.mcap")), read_recording(second)
    assert replay_recording(first).ok
    ticks = list(later.ticks)
    assert ticks[0].number > 0
    assert len(ticks) > 100
    comparison = replay_recording(later)
    assert not comparison.ok
    assert "under way" in comparison.text()


OPENED = """
import sys
import gateway
from gateway.recording import environment
from gateway.recording.ros_views import typestore
with gateway.open_session("bench", simulated=True) as session:
    session.view("0", steer=True)
    environment.digest_of = type(typestore()).generate_msgdef = None
    before = set(sys.modules)
    session.start_recording("a.mcap")
    for _ in session.run(0.1):
        pass
print(*set(sys.modules) - before)
"""


def test_a_recording_that_is_switched_on_has_nothing_to_prepare(tmp_path: Path) -> None:
    """What a process does only once would take tens of ms in a step."""
    done = subprocess.run(
        [sys.executable, "-c", OPENED], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout.strip()) == (0, ""), done
    assert read_recording(tmp_path / "a.mcap").whole


def test_a_view_that_may_not_steer(tmp_path: Path) -> None:
    with open_session("diffbot", simulated=True) as session:
        watched = Watched(session, steer=False)
        for line in ("goal 1 1", "release"):
            watched.ask(line)
        watched.page.send({"record": True})
        watched.until(lambda: len(watched.page.of("answer")) == 3)
        assert {one["ok"] for one in watched.page.of("answer")} == {False}
        assert {"read-only" in one["text"] for one in watched.page.of("answer")} == {True}
        watched.ask("stop")
        watched.until(lambda: bool(watched.page.of("state")[-1]["stopped"]))
        watched.page.close()


def test_a_view_on_demand_is_not_opened_while_a_motor_is_armed() -> None:
    with open_session("diffbot", simulated=True) as session:
        watched = Watched(session)
        assert view_on_demand(session, "127.0.0.1:0 steer").startswith("http://127.0.0.1:")
        url = session.view_url
        assert "is no address" in view_on_demand(session, "127.0.0.1:x")
        assert view_on_demand(session, "") == url  # the one that is open, as it is
        watched.page.close()
        watched = Watched(session)
        watched.page.send({"ask": "goal 1 0"})
        watched.until(lambda: session.joints["left"].armed)
        assert "armed" in view_on_demand(session, "127.0.0.1:0")
        watched.page.close()


def jogged(session: Session) -> Watched:
    """Return a page that has held a jog until the joint turns."""
    watched = Watched(session)

    def turns() -> bool:
        watched.page.hold("velocity left 2")
        feedback = session.joints["left"].feedback
        return feedback is not None and (feedback.velocity or 0.0) > 1.0

    watched.until(turns)
    return watched


def stands(session: Session) -> bool:
    feedback = session.joints["left"].feedback
    return feedback is not None and abs(feedback.velocity or 0.0) < 0.05


def test_what_is_held_ends_with_the_view() -> None:
    with open_session("bench", simulated=True) as session:
        watched = jogged(session)
        session.view("0", steer=True)
        watched.until(lambda: stands(session))
        watched.page.close()


def test_a_view_that_fails_is_closed_and_keeps_nothing_from_the_robot(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with open_session("bench", simulated=True) as session:
        watched = jogged(session)
        view = session._view
        assert view is not None

        def fail() -> list[Instruction]:
            raise ZeroDivisionError

        close = view.close

        def fail_to_close() -> None:
            close()
            raise OSError

        monkeypatch.setattr(view, "poll", fail)
        monkeypatch.setattr(view, "close", fail_to_close)
        watched.until(lambda: stands(session))
        assert session.view_url == ""
        assert "the live view has failed" in caplog.text
        watched.page.close()


def test_a_stop_holds_until_it_is_released_after_it(watched: Watched) -> None:
    watched.session.submit(Stop("enough"), Release())
    watched.until(lambda: bool(watched.page.of("state")[-1]["stopped"]))
    watched.ask("release")
    watched.until(lambda: not watched.page.of("state")[-1]["stopped"])


def test_an_address_that_others_can_reach_needs_a_token_and_one_that_is_taken_is_named() -> None:
    with open_session("bench", simulated=True) as session, open_session("bench05", simulated=True) as other:
        with pytest.raises(UserError, match="needs a token"):
            session.view("0.0.0.0:0")
        taken = address_of(session.view("0"))
        with pytest.raises(UserError, match=f"cannot listen on {taken}"):
            other.view(str(taken))
        assert session.view("0.0.0.0:0", token="0123456789abcdef").endswith("?token=0123456789abcdef")


# -- recordings ----------------------------------------------------------------------------------------


class Shown:
    """Recordings in a view, and its page; time is counted."""

    def __init__(self, *files: Path) -> None:
        self.players = [Player(read_recording(file)) for file in files]
        self.view = ReplayView(self.players, Address(port=0), Access())
        self.page = Browser(address_of(self.view.url))
        self.times = count(0, 10 * MILLISECOND)

    def until(self, what: Callable[[], bool], slices: int = 20_000) -> None:
        for now, _ in zip(self.times, range(slices), strict=False):
            if what():
                return
            self.page.poll()
            self.view.slice(now)
        raise AssertionError(self.page.of("state")[-1])

    @property
    def state(self) -> dict[str, object]:
        return self.page.of("state")[-1] if self.page.of("state") else {}

    @property
    def playback(self) -> dict[str, Any]:
        playback = self.state.get("playback", {})
        assert isinstance(playback, dict)
        return playback

    def play(self, **how: float) -> None:
        self.page.send({"play": how})

    def close(self) -> None:
        self.page.close()
        self.view.close()
        for player in self.players:
            player.close()


def recorded(file: Path, seed: int) -> Path:
    with open_session("diffbot", simulated=True, record=file, seed=seed) as session:
        session.submit(Goal(0.6, 0.2))
        for _ in session.run(seconds=3.0):
            pass
    return file


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("drive") / "drive.mcap", 1)


@pytest.fixture
def shown(drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Shown]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made = Shown(drive)
    yield made
    made.close()


def test_a_recording_is_played_paused_stepped_and_sought(shown: Shown) -> None:
    page = shown.page
    shown.until(lambda: shown.playback.get("prepared") == 1.0)
    assert page.of("hello")[0]["mode"] == "replay"
    player = shown.players[0]
    ticks = read_recording(player.recording.path).ticks
    moved = next(tick.now for tick in ticks if tick.inputs.instructions) - player.start
    shown.until(lambda: shown.playback["t"] > 0.0)  # it is shown where it moves,
    shown.until(lambda: not shown.playback["under_way"])
    assert 1.0 <= shown.playback["t"] - moved / SECOND < 1.3
    assert not shown.playback["playing"]  # and waits there
    assert 2.9 < shown.playback["length"] < 4.5
    shown.play(rate=4.0)
    shown.play(playing=True)
    shown.until(lambda: shown.playback["t"] > 1.5)
    shown.play(playing=False)
    shown.until(lambda: not shown.playback["playing"])
    at = shown.playback["due"]
    shown.until(lambda: abs(shown.playback["t"] - at) < 0.02)
    before = shown.state["ticks"]
    assert isinstance(before, int)
    for steps, tick in ((1, before + 1), (-3, before - 2), (2, before)):
        shown.play(step=steps)
        shown.until(lambda tick=tick: shown.state["ticks"] == tick)  # type: ignore[misc]
    shown.play(seek=2.5)
    shown.until(lambda: abs(shown.playback["t"] - 2.5) < 0.02)
    late = shown.state["pose"]
    shown.play(seek=0.5)
    shown.until(lambda: abs(shown.playback["t"] - 0.5) < 0.02)
    shown.until(lambda: shown.state["pose"] != late)
    scans = len(page.of("scan"))
    shown.until(lambda: len(page.of("scan")) > scans)
    assert shown.playback["differences"] == []
    assert shown.players[0].comparison.ok


def test_the_buses_are_shown_as_they_were_where_it_is_sought(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    file = tmp_path / "lost.mcap"
    with open_session("diffbot", simulated=True, record=file) as session:
        assert session.twins is not None
        for tick in session.run(seconds=3.0):
            if tick.number == 150:
                session.twins.buses["sensors"].lose()
    with closing(Shown(file)) as shown:
        shown.until(lambda: shown.playback.get("prepared") == 1.0)
        for seek, states in ((2.9, {"sensors": "gone"}), (0.2, {}), (2.8, {"sensors": "gone"})):
            shown.play(seek=seek)
            shown.until(lambda seek=seek: abs(shown.playback["t"] - seek) < 0.02)  # type: ignore[misc]
            assert shown.state["bus_states"] == states


@pytest.mark.parametrize("far", [1e12, 1e300])
def test_a_seek_to_beyond_an_end_goes_to_that_end(shown: Shown, far: float) -> None:
    shown.until(lambda: shown.playback.get("prepared") == 1.0)
    for where, end in ((far, shown.playback["length"]), (-far, 0.0)):
        shown.play(seek=where)
        shown.until(lambda end=end: abs(shown.playback["t"] - end) < 0.02)  # type: ignore[misc]
        assert shown.playback["due"] == end


@pytest.mark.parametrize("asked", [{"seek": "x"}, {"rate": 1e400}, {"faster": 1}, 7, {"step": None}])
def test_what_is_no_playback_gets_a_sentence(shown: Shown, asked: object) -> None:
    shown.until(lambda: bool(shown.page.of("state")))
    shown.page.send('{"play": {"rate": 1e400}}' if asked == {"rate": 1e400} else {"play": asked})
    shown.until(lambda: bool(shown.page.of("answer")))
    assert shown.page.of("answer")[-1]["ok"] is False
    shown.page.send({"ask": "goal 1 1"})
    shown.until(lambda: len(shown.page.of("answer")) == 2)
    assert shown.page.of("answer")[-1]["text"] == NO_ROBOT


def test_the_work_of_a_slice_is_counted(shown: Shown, monkeypatch: pytest.MonkeyPatch) -> None:
    [player] = shown.players
    shown.until(lambda: shown.playback.get("prepared") == 1.0)
    shown.until(lambda: shown.playback["t"] > 0.0 and not shown.playback["under_way"])  # where it moves
    assert player.tick is not None
    last = player.tick.number
    shown.play(rate=100.0)
    shown.play(playing=True)
    while shown.playback["t"] < shown.playback["length"] - 0.02:
        shown.page.poll()
        shown.view.slice(next(shown.times))
        number = player.tick.number if player.tick is not None else 0
        assert 0 <= number - last <= replay_view.SLICE
        last = number
    steps = 0
    step = Gateway.step

    def counted(self: Gateway, now: int, inputs: Inputs) -> Outputs:
        nonlocal steps
        steps += 1
        return step(self, now, inputs)

    monkeypatch.setattr(Gateway, "step", counted)
    shown.play(step=-replay_view.MOST_STEPS)
    while shown.state["ticks"] != 0:
        shown.page.poll()
        steps = 0
        shown.view.slice(next(shown.times))
        assert steps <= replay_view.SLICE


def test_it_waits_while_it_is_under_way_to_what_was_not_compared_yet(
    shown: Shown, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replay_view, "SLICE", 2)
    shown.until(lambda: bool(shown.playback))
    player = shown.players[0]
    shown.play(playing=True)
    shown.play(seek=2.0)
    shown.until(lambda: shown.playback["under_way"])
    before = shown.playback["prepared"]
    shown.until(lambda: shown.playback["prepared"] > before)
    assert (shown.playback["under_way"], shown.playback["due"], shown.playback["t"]) == (True, 2.0, 0.0)
    for steps in (-1, -2, 1):
        shown.play(step=steps)
    shown.until(lambda: not shown.playback["playing"])
    assert (shown.playback["under_way"], shown.playback["due"]) == (True, 2.0)
    up_to = [tick.number for tick in player.recording.ticks if tick.now <= player.start + 2 * SECOND]
    shown.until(lambda: shown.state["ticks"] == up_to[-3])
    shown.until(lambda: shown.playback["due"] == shown.playback["t"])


def test_two_recordings_are_at_the_same_time_since_their_beginnings(shown: Shown, tmp_path: Path) -> None:
    other = recorded(tmp_path / "other.mcap", 9)
    pair = Shown(shown.players[0].recording.path, other)
    second = Browser(address_of(pair.view.url), "/cockpit/2")
    pair.until(lambda: bool(pair.page.of("state")))
    pair.play(seek=1.0)
    pair.until(lambda: pair.playback["t"] > 0.98)

    def beside() -> bool:
        second.poll()
        states = second.of("state")
        return bool(states) and abs(states[-1]["playback"]["t"] - pair.playback["t"]) < 0.02

    pair.until(beside)
    assert second.of("state")[-1]["recording"].endswith("other.mcap")
    pair.until(lambda: bool(pair.playback["differences"]))
    expected = first_difference(*(player.recording for player in pair.players))
    assert expected is not None
    [found] = pair.playback["differences"]
    assert (found["kind"], found["t"]) == (
        f"{expected.kind}, beside the other recording",
        expected.since / SECOND,
    )
    second.close()
    pair.close()


def test_the_robot_file_is_the_recorded_one_unless_another_is_named(shown: Shown) -> None:
    assert shown.players[0].robot.name == load_robot("diffbot").name
