"""`gateway trim`: a stretch replays to the bytes that it had in the whole; and names nobody, if asked."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest

import gateway as gw
from gateway.cli.main import main
from gateway.config import load_robot, resources
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs, Tick
from gateway.errors import RecordingError
from gateway.recording import Recording, read_recording
from gateway.replay import replay_recording
from gateway.replay.anonymous import anonymous, anonymous_text
from gateway.replay.input_log import RecordingFile, input_log
from gateway.replay.trim import stretch_around, stretch_between, trim
from protocols.messages import SECOND
from tests.sampled import sampled


@pytest.fixture(scope="module")
def waited(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench that waits for 2.2 s, turns, is stopped at 2.8 s, and waits until 3.2 s."""
    path = tmp_path_factory.mktemp("trim") / "waited.mcap"
    with gw.open_session("bench", simulated=True, record=path) as session:
        for tick in session.run(3.2):
            if 2.2 * SECOND < tick.now < 2.8 * SECOND:
                session.submit(gw.Velocity("left", 3.0))
            if tick.now == 2.8 * SECOND:
                session.submit(gw.Stop("enough"))
    return path


def of(path: Path) -> tuple[Recording, list[Tick]]:
    recording = read_recording(path)
    return recording, list(recording.ticks)


def sent(ticks: list[Tick]) -> list[object]:
    return [(tick.now, tick.outputs) for tick in ticks]


# fmt: off
STRETCHES = [
    # from, to: s; how many ticks at most lead to it
    (2.1, 2.6, 220),  # in which it is first commanded: of what was before, devices are found in a second
    (0.0, 0.5, 0),    # the beginning
    (2.5, 2.7, 500),  # turning: that it was armed is a part of the state
]
# fmt: on


@pytest.mark.parametrize(("begin", "end", "most"), sampled(STRETCHES, 3))
def test_a_stretch_replays_from_its_own_beginning_to_the_bytes_of_the_whole(
    begin: float, end: float, most: int, waited: Path, tmp_path: Path
) -> None:
    whole, ticks = of(waited)
    stretch = stretch_between(whole, begin, end)
    trimmed = trim(whole, stretch, tmp_path / "part.mcap")
    part, found = of(tmp_path / "part.mcap")
    assert trimmed.lead <= most
    assert len(found) == trimmed.lead + trimmed.ticks < len(ticks)
    assert sent(found[trimmed.lead :]) == sent(ticks[stretch.first : stretch.last + 1])
    assert [tick.number for tick in found] == list(range(len(found)))
    assert replay_recording(part).text().startswith("the same, byte for byte")
    views = [len(step.views) for step in part.steps]
    of_whole = [len(step.views) for step in islice(whole.steps, stretch.first, stretch.last + 1)]
    assert sum(views[trimmed.lead :]) == pytest.approx(sum(of_whole), abs=12)  # periods begin anew
    assert not any(views[1 : trimmed.lead])


@pytest.mark.prove
def test_a_trimmed_file_is_trimmed_again(waited: Path, tmp_path: Path) -> None:
    part, again = tmp_path / "part.mcap", tmp_path / "again.mcap"
    whole, ticks = of(waited)
    trim(whole, stretch_between(whole, 2.1, 2.9), part)
    recording = read_recording(part)
    late = [tick.now - next(iter(recording.ticks)).now for tick in recording.ticks][-20] / SECOND
    trim(recording, stretch_between(recording, late, None), again)
    assert sent(of(again)[1])[-20:] == sent(of(part)[1])[-20:]
    assert sent(of(part)[1])[-1] in sent(ticks)
    assert replay_recording(again).ok


def test_one_that_was_cut_off_is_taken_as_far_as_it_goes_which_is_told(
    waited: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = waited.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    log = input_log(read_recording(tmp_path / "cut.mcap"))
    assert 0 < len(log.ticks) < len(input_log(read_recording(waited)).ticks)
    assert [one.getMessage() for one in caplog.records] == [
        f"{tmp_path / 'cut.mcap'}: it was cut off before its end: what is there of it is taken"
    ]
    assert main(["trim", str(tmp_path / "cut.mcap"), "--to", "0.2"]) == 1  # as `replay` of it does
    assert replay_recording(tmp_path / "cut.trimmed.mcap").ok


def test_what_replays_otherwise_is_cut_as_it_was_written_and_still_does(
    waited: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A defect is put in: from 2.4 s on, no frame but the first of a step goes out."""
    step = Gateway.step

    def defective(self: Gateway, now: int, inputs: Inputs) -> Outputs:
        outputs = step(self, now, inputs)
        return replace(outputs, packets=outputs.packets[:1]) if now > 2.4 * SECOND else outputs

    monkeypatch.setattr(Gateway, "step", defective)
    whole, ticks = of(waited)
    first = replay_recording(whole).first
    assert first is not None
    stretch = stretch_around(whole, "difference", 0.1)
    assert ticks[stretch.first].now < first.since < ticks[stretch.last].now
    trimmed = trim(whole, stretch, tmp_path / "part.mcap")
    part, found = of(tmp_path / "part.mcap")
    assert trimmed.lead == stretch.first
    assert sent(found) == sent(ticks[: stretch.last + 1])
    again = replay_recording(part).first
    assert again is not None
    assert (again.kind, again.tick, again.text) == (first.kind, first.tick, first.text)


def test_around_a_stop_on_the_command_line(
    waited: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "stop.mcap"
    assert main(["trim", str(waited), "--around", "stop", "--margin", "0.2", "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert re.search(
        r"^8\d ticks; \d+ ticks \(\d\.\d\d s\) before them lead to the state there; \d+ ", printed
    )
    assert any(tick.inputs.instructions == (gw.Stop("enough"),) for tick in of(out)[1][-60:])
    assert main(["replay", str(out)]) == 0


# fmt: off
WRONG = [
    # arguments, and what is told
    (["{file}"], r"which stretch\? --from S, --to S, or --around fault\|warning\|stop\|difference"),
    (["{file}", "--around", "stop", "--to", "3"], r"--around says where the stretch is"),
    (["{file}", "--around", "lunch"], r"invalid choice: 'lunch'"),
    (["{file}", "--around", "difference"], r"there is no difference in it; --from and --to name a stretch"),
    (["{file}", "--from", "90"], r"no tick from 90 s to 3\.35 s: it is 3\.35 s long"),
    (["{file}", "--from", "3", "--to", "2"], r"no tick from 3 s to 2 s"),
    (["{file}", "--from", "-1"], r"'-1' is not a number of seconds"),
    (["{file}", "--from", "3", "-o", "{file}"], r"exists already; it is never overwritten"),
    (["{format1}", "--from", "0"], r"of format 1, which said things differently; format 3 can be trimmed"),
    (["{toml}", "--from", "0"], r"not a recording of this gateway"),
]
# fmt: on


@pytest.mark.parametrize(("given", "told"), WRONG)
def test_wrong_arguments_are_told(
    given: list[str], told: str, waited: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    toml = resources.find("robots", "bench")
    names = {"file": waited, "format1": toml.parents[1] / "recordings/format1.mcap", "toml": toml}
    before = sorted(waited.parent.iterdir())
    status: object
    try:
        status = main(["trim", *(one.format(**names) for one in given)])
    except SystemExit as error:
        status = error.code
    assert status == 2
    assert re.search(told, capsys.readouterr().err)
    assert sorted(waited.parent.iterdir()) == before


# -- anonymous ----------------------------------------------------------------------------------------

PRIVATE = """\
# of Ada's robot, number 17
name = "x"  # at home
[buses.can0]
interface = "serial:/dev/serial/by-id/usb-Ada_0123456789-if00"
[buses.can1]
interface = 'socketcan:can_of_ada'
note = "interface of # nothing"
[brain.gnss]
latitude = 47.285233
longitude = -8.5
[motors.left.options]
serial_number = 0x3855_1234
"""


def test_a_robot_file_names_nobody() -> None:
    text = anonymous_text(PRIVATE)
    assert not re.search(r"[Aa]da|17|home|0123|47\.28|8\.5|3855", text)
    assert 'interface = "serial:1"' in text
    assert "interface = 'socketcan:2'" in text
    assert 'note = "interface of # nothing"' in text
    assert "latitude = 0\nlongitude = 0\n" in text


def test_an_anonymous_recording_sends_the_same_at_other_times(waited: Path, tmp_path: Path) -> None:
    out = tmp_path / "anonymous.mcap"
    assert main(["trim", str(waited), "--to", "2.6", "--anonymise", "-o", str(out)]) == 0
    recording, found = of(out)
    assert found[0].now == SECOND
    frames = [[packet.frame for packet in tick.outputs.packets] for tick in found]
    assert frames == [
        [packet.frame for packet in tick.outputs.packets] for tick in of(waited)[1][: len(found)]
    ]
    assert replay_recording(recording).ok
    assert {"date", "platform"} <= read_recording(waited).facts.keys()
    assert "date" not in recording.facts
    assert "waited" not in str(recording.facts)
    assert "#" not in recording.robot_text


def test_what_somebody_has_is_not_removed(waited: Path, tmp_path: Path) -> None:
    out, theirs = tmp_path / "out.mcap", tmp_path / "out.mcap.named.part"
    theirs.write_text("kept")
    assert main(["trim", str(waited), "--from", "1", "--to", "1.1", "--anonymise", "-o", str(out)]) == 2
    assert theirs.read_text() == "kept"
    assert [one.name for one in tmp_path.iterdir()] == [theirs.name]


def test_a_name_that_is_taken_meanwhile_is_left_to_who_has_it_and_nothing_else_remains(
    waited: Path, tmp_path: Path
) -> None:
    log, out = input_log(read_recording(waited)), tmp_path / "out.mcap"
    file = RecordingFile(out, log, {})
    out.write_text("kept")
    with pytest.raises(RecordingError, match="exists already"):
        file.finish()
    assert out.read_text() == "kept"
    assert [one.name for one in tmp_path.iterdir()] == [out.name]


@pytest.mark.prove
def test_places_on_the_earth_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "gnss.mcap"
    with gw.open_session(load_robot("diffbot_gnss"), simulated=True, record=path) as session:
        for _ in session.run(0.3):
            pass
    log, told = anonymous(input_log(read_recording(path)))
    assert told == ["left out: all of bus gnss, on which gnss told places on the earth"]
    assert {packet.bus for given in log.ticks for packet in given.inputs.packets} >= {"can0", "imu"}
    assert not any(packet.bus == "gnss" for given in log.ticks for packet in given.inputs.packets)
