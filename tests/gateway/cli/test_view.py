"""The live view by the commands that open it: processes of their own, their pages, and how they end."""

from __future__ import annotations

import re
import signal
from contextlib import closing
from pathlib import Path
from urllib.request import ProxyHandler, build_opener

import pytest

from gateway.cli.main import main
from gateway.view import parse_address
from tests.gateway.processes import PATIENCE, Process, eventually
from tests.gateway.view.clients import Browser


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir(mode=0o700)
    return folder


def address(text: str) -> str:
    """Return the address that a command has printed."""
    found = re.search(r"http://\S+", text)
    assert found is not None, text
    return found[0]


def greeted(url: str) -> Browser:
    """Return a page's client at this address, once it has been told what the robot is."""
    with build_opener(ProxyHandler({})).open(url, timeout=PATIENCE) as page:  # whatever the environment has
        assert page.status == 200
        assert "cockpit.js" in page.read().decode()
    client = Browser(parse_address(url.removeprefix("http://").rstrip("/")))

    def told() -> bool:
        client.poll()
        return bool(client.messages)

    assert eventually(told)
    return client


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("command", "begun", "mode", "status"),
    [
        ("demo --out {out}", " m/s", "live", 1),  # it has not reached its goals
        ("twin bench", "gateway run", "twin", 0),
        ("run bench", "is running", "live", 0),
    ],
)
def test_a_command_shows_its_page_and_ends_as_without(
    folder: Path, command: str, begun: str, mode: str, status: int
) -> None:
    words, others = (command.format(out=folder / out).split() for out in ("out", "other"))
    with Process(folder, *words) as plain, Process(folder, *others, "--view", "0") as shown:
        plain.until(begun)
        shown.until(begun)
        with closing(greeted(shown.find(r"(http://\S+)"))) as client:
            assert client.of("hello")[0]["mode"] == mode
            for one in (shown, plain):  # while nobody reads the page
                ended, text = one.end(signal.SIGINT)
                assert ended == status, text
                assert "leaving: SIGINT" in text
                assert "Traceback" not in text
            client.poll()
            assert (client.code, client.reason) == (1001, "the gateway ends")


def test_the_view_of_a_running_robot_is_opened_and_found_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    with Process(folder, "run", "bench", "-v") as robot:
        robot.until("brain: ready")
        assert main(["view", "bench", "--at", "127.0.0.1:0", "--steer"]) == 0
        url = address(capsys.readouterr().out)
        with closing(greeted(url)) as client:
            assert (client.of("hello")[0]["robot"], client.of("hello")[0]["steer"]) == ("bench", True)
            client.send({"ask": "velocity left 4"})
            client.poll()
            robot.until("left: armed")
            assert main(["view", "bench"]) == 0
            assert address(capsys.readouterr().out) == url
            assert main(["view", "bench", "--at", "127.0.0.1:0"]) == 1
            assert "a motor is armed" in capsys.readouterr().out
        status, text = robot.end(signal.SIGINT)
    assert status == 0, text
    assert "Traceback" not in text
