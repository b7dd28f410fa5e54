"""A running robot to which hostile texts are sent, by every way in which a text reaches it: it runs on."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

import pytest

import gateway
from gateway.config import load_mission, load_robot, parse_robot
from gateway.errors import ConfigError, GatewayError, UserError
from gateway.operator import Operator
from gateway.operator.commands import RejectedLine, parse
from gateway.runtime.configuration import read_dump
from gateway.sim.load import load_plant, load_world
from gateway.view import Address, parse_address
from tests.gateway.hostile_texts import FILES, line, message, write_files
from tests.gateway.view.clients import Browser
from tests.gateway.view.test_foxglove import SDK, App

ROBOTS = ("diffbot", "arm", "bench")
COCKPIT = ["ask", "held", "id", "record", "play", "x"]
FOXGLOVE = ["op", "id", "subscriptions", "channelIds", "parameterNames", "parameters", "channels", "name"]
OPS = ["subscribe", "unsubscribe", "advertise", "unadvertise", "getParameters", "setParameters"]
SEEDS = [*range(2), *(pytest.param(seed, marks=pytest.mark.prove) for seed in range(2, 60))]


@dataclass
class Clients:
    """A page and an app, which come back when their connection was ended."""

    address: Address
    random: Random
    words: list[str]
    page: Browser = field(init=False)
    app: App = field(init=False)

    def __post_init__(self) -> None:
        self.page, self.app = Browser(self.address), App(self.address, SDK)

    def send(self) -> None:
        random, asked = self.random, line(self.random, self.words)
        if self.page.open:
            self.page.send(random.choice([json.dumps({"ask": asked}), message(random, COCKPIT, [asked])]))
        if self.app.open:
            self.app.send(message(random, FOXGLOVE, [*OPS, *self.words]))
            head = struct.pack("<BI", random.randrange(5), random.randrange(4))
            self.app.send(head + random.randbytes(60))
        self.page.poll()
        self.app.poll()
        if self.page.code:
            self.page.close()
            self.page = Browser(self.address)

    def close(self) -> None:
        self.page.close()
        self.app.close()


@pytest.mark.parametrize("seed", SEEDS)
def test_no_text_ends_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.chdir(tmp_path)  # recordings that a text has begun
    random, files = Random(seed), write_files(tmp_path / "files")
    with (
        gateway.open_session(ROBOTS[seed % len(ROBOTS)], simulated=True) as session,
        Operator(session.robot, tmp_path / "run", terminal=None) as operator,
        socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as terminal,
    ):
        terminal.connect(str(operator.path))
        url = session.view("127.0.0.1:0", steer=True)
        words = [*session.robot.motors, *session.robot.buses, "all", "left", "for", *map(str, files)]
        answers = ""
        with closing(
            Clients(parse_address(url.partition("//")[2].partition("/")[0]), random, words)
        ) as clients:
            for tick in session.run(1.0, poll=lambda: operator.poll(lambda: "well")):
                asked = [one for one in (line(random, words) for _ in range(4)) if not one.startswith("quit")]
                terminal.sendall("".join(f"{one}\n" for one in asked).encode())
                answers += terminal.recv(1 << 20, socket.MSG_DONTWAIT).decode() if tick.number > 1 else ""
                clients.send()
            told = [*clients.page.of("answer"), *clients.app.messages]
        assert tick.number > 90
        assert session.view_url
        assert "defect" not in f"{answers}{told}"


@pytest.mark.parametrize("read", [load_robot, load_world, load_plant, load_mission])
def test_every_file_is_refused_in_a_sentence_that_names_it(
    tmp_path: Path, read: Callable[[str], object]
) -> None:
    """But for a mission that can be begun: it waits for hundreds of digits of seconds."""
    for path in write_files(tmp_path / "files"):
        with pytest.raises((ConfigError, UserError)) as refused:
            read(str(path))
        assert path.name[:20] in str(refused.value)
        assert str(refused.value).count("cannot be read") <= 1


def test_an_operator_is_told_what_is_wrong_with_a_mission_file(tmp_path: Path) -> None:
    robot = load_robot("bench")
    for path in write_files(tmp_path / "files"):
        told = parse(f"mission {path}", robot)
        assert isinstance(told, RejectedLine)
        assert path.name[:20] in told.reason
        assert "defect" not in told.reason


@pytest.mark.parametrize("wrong", FILES)
def test_a_dump_and_a_urdf_are_read_the_same_way(tmp_path: Path, wrong: str) -> None:
    file = tmp_path / "dump.toml"
    file.write_bytes(FILES[wrong])
    with pytest.raises(GatewayError, match=r"dump\.toml"):
        read_dump(file, load_robot("diffbot"))
    (tmp_path / "robot.toml").write_text(
        f"urdf = 'dump.toml'\n{load_robot('diffbot').text}", encoding="utf-8"
    )
    with pytest.raises(ConfigError, match=r"(dump|robot)\.toml"):
        load_robot(tmp_path / "robot.toml")


def test_a_mark_before_the_first_character_is_no_part_of_the_text(tmp_path: Path) -> None:
    """Some editors write one."""
    text = load_robot("diffbot").text
    (tmp_path / "robot.toml").write_text(text, encoding="utf-8-sig")
    assert load_robot(tmp_path / "robot.toml").text == parse_robot(text).text
