"""Fetching from a server that cuts, knows no ranges, or has another file: kept is only the right one."""

from __future__ import annotations

import hashlib
import re
import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from socketserver import ThreadingTCPServer
from typing import Any

import pytest

from gateway.cli.main import main
from gateway.errors import ConfigError, UserError
from gateway.recording.catalogue import CatalogueEntry, check_file, chosen, read_catalogue
from gateway.recording.fetch import ATTEMPTS, fetch

BODY = bytes(range(256)) * 5000


@dataclass
class Server:
    """A server of one file, with its faults."""

    body: bytes = BODY
    cut: int = 0
    """Bytes after which each connection ends; 0: none does"""
    ranges: bool = True
    status: int = 0
    """Of every answer, in place of the file"""
    length: bool = True
    asked: list[str] = field(default_factory=list)
    """The range of each request"""
    port: int = 0

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/a%20file"

    def answer(self, handler: BaseHTTPRequestHandler) -> None:
        wanted = handler.headers.get("Range", "")
        self.asked.append(wanted)
        if self.status:
            handler.send_error(self.status)
            return
        at = int(wanted.removeprefix("bytes=").removesuffix("-")) if wanted and self.ranges else 0
        handler.send_response(206 if wanted and self.ranges else 200)
        if wanted and self.ranges:
            handler.send_header("Content-Range", f"bytes {at}-{len(self.body) - 1}/{len(self.body)}")
        if self.length:
            handler.send_header("Content-Length", str(len(self.body) - at))
        handler.end_headers()
        handler.wfile.write(self.body[at : at + self.cut] if self.cut else self.body[at:])


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setenv("no_proxy", "*")
    served = Server()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            served.answer(self)

        def log_message(self, *_: Any) -> None:
            pass

    http = ThreadingTCPServer(("127.0.0.1", 0), Handler)  # HTTPServer asks for the machine's name
    http.daemon_threads = True
    served.port = http.server_address[1]
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    yield served
    http.shutdown()
    thread.join()
    http.server_close()


@pytest.fixture
def entry(server: Server) -> CatalogueEntry:
    digest = hashlib.sha256(BODY).hexdigest()
    return CatalogueEntry("a/b.bin", "w", "derived from x", "MIT", len(BODY), digest, url=server.url)


def test_a_file_is_fetched_once(server: Server, entry: CatalogueEntry, tmp_path: Path) -> None:
    seen: list[int] = []
    path, anew = fetch(entry, tmp_path, seen.append)
    assert anew
    assert path.read_bytes() == BODY
    assert seen[-1] == len(BODY)
    assert seen == sorted(seen)
    assert fetch(entry, tmp_path) == (path, False)
    assert server.asked == [""]
    assert [one.name for one in path.parent.iterdir()] == ["b.bin"]


@pytest.mark.parametrize("length", [True, False])
def test_what_was_cut_off_goes_on_where_it_ended(
    server: Server, entry: CatalogueEntry, tmp_path: Path, length: bool
) -> None:
    server.cut, server.length = len(BODY) // 2 + 1, length
    path, _ = fetch(entry, tmp_path)
    assert path.read_bytes() == BODY
    assert server.asked == ["", f"bytes={server.cut}-"]


def test_a_part_of_before_is_gone_on_with(server: Server, entry: CatalogueEntry, tmp_path: Path) -> None:
    part = tmp_path / "a" / "b.bin.part"
    part.parent.mkdir()
    part.write_bytes(BODY[:1000])
    assert fetch(entry, tmp_path)[0].read_bytes() == BODY
    assert server.asked == ["bytes=1000-"]


@pytest.mark.parametrize("there", [BODY[:1000], BODY + b"more"])
def test_a_server_without_ranges_begins_anew(
    server: Server, entry: CatalogueEntry, tmp_path: Path, there: bytes
) -> None:
    server.ranges = False
    part = tmp_path / "a" / "b.bin.part"
    part.parent.mkdir()
    part.write_bytes(there)
    assert fetch(entry, tmp_path)[0].read_bytes() == BODY


def test_one_without_ranges_that_always_cuts_is_given_up(
    server: Server, entry: CatalogueEntry, tmp_path: Path
) -> None:
    server.ranges, server.cut = False, 1000
    with pytest.raises(UserError, match=f"1000 of {len(BODY)} bytes are kept in .*b.bin.part: ask again"):
        fetch(entry, tmp_path)
    assert len(server.asked) == 1 + ATTEMPTS


@pytest.mark.parametrize("body", [bytes(len(BODY)), BODY[:-1] + b"\0\0\0", BODY + b"more"])
def test_another_file_is_not_kept(server: Server, entry: CatalogueEntry, tmp_path: Path, body: bytes) -> None:
    server.body = body
    if body[: len(BODY)] == BODY:
        assert fetch(entry, tmp_path)[0].read_bytes() == BODY  # no more is taken than there is
        return
    with pytest.raises(UserError, match=r"what came is another file: .* has sha256 .* it was not kept"):
        fetch(entry, tmp_path)
    assert [*(tmp_path / "a").iterdir()] == []


def test_a_wrong_file_that_is_there_stays(server: Server, entry: CatalogueEntry, tmp_path: Path) -> None:
    path = tmp_path / "a" / "b.bin"
    path.parent.mkdir()
    path.write_bytes(b"mine")
    with pytest.raises(UserError, match=r"has 4 bytes, and the catalogue's a/b\.bin has"):
        fetch(entry, tmp_path)
    assert path.read_bytes() == b"mine"
    assert not server.asked


@pytest.mark.parametrize(("status", "times"), [(404, 1), (403, 1), (503, ATTEMPTS), (429, ATTEMPTS)])
def test_what_a_server_refuses_is_told(
    server: Server, entry: CatalogueEntry, tmp_path: Path, status: int, times: int
) -> None:
    server.status = status
    with pytest.raises(UserError, match=f"{re.escape(server.url)}: the server answers {status}"):
        fetch(entry, tmp_path)
    assert len(server.asked) == times


def test_without_a_network_it_is_told(server: Server, entry: CatalogueEntry, tmp_path: Path) -> None:
    nobody = replace(entry, url="http://127.0.0.1:1/x")
    with pytest.raises(UserError, match=r"127\.0\.0\.1:1/x: no connection: Connection refused"):
        fetch(nobody, tmp_path)


def test_without_room_nothing_is_fetched(server: Server, entry: CatalogueEntry, tmp_path: Path) -> None:
    huge = replace(entry, bytes=shutil.disk_usage(tmp_path).total + 1)
    with pytest.raises(UserError, match=f"needs {huge.bytes} bytes, \\d+ are free"):
        fetch(huge, tmp_path)
    assert not server.asked


def test_what_has_no_address_is_told(entry: CatalogueEntry, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no file of a repository that could be fetched: derived from x"):
        fetch(replace(entry, url=""), tmp_path)


def test_a_link_is_not_followed(server: Server, entry: CatalogueEntry, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b.bin.part").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match=r"b\.bin\.part: Too many levels of symbolic links"):
        fetch(entry, tmp_path)
    assert not (tmp_path / "elsewhere").exists()


# -- the catalogue ------------------------------------------------------------------------------------


def test_the_address_is_that_of_the_source() -> None:
    found = read_catalogue()
    base = "https://raw.githubusercontent.com/cra-ros-pkg/robot_localization/7bebbed62c44"
    assert found["husky/husky.bag"].address == f"{base}/test/test1.bag"
    without = [one.source for one in found.values() if not one.address]
    assert all(one.startswith(("derived from", "facontidavide")) for one in without)
    assert len(without) == 4


def test_folders_and_files_are_chosen_each_once() -> None:
    found = read_catalogue()
    assert [one.file for one in chosen(found, ["husky", "husky/husky.bag"])] == ["husky/husky.bag"]
    assert {one.file.split("/")[0] for one in chosen(found, ["carmen/"])} == {"carmen"}
    with pytest.raises(UserError, match=r"did you mean 'husky/husky.bag'"):
        chosen(found, ["husky/huski.bag"])


ROW = (
    "[[recordings]]\nfile = 'a/b'\nwhat = 'w'\nsource = 's'\nlicence = 'MIT'\nbytes = 3\n"
    f"sha256 = '{hashlib.sha256(b'abc').hexdigest()}'\nurl = 'http://x/y'\n"
)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", r"expected tables \[\[recordings\]\]"),
        (ROW.replace("what = 'w'\n", ""), "what: missing; expected a string"),
        (ROW.replace("a/b", "../b"), "file: expected a path below"),
        (ROW.replace("http:", "file:"), "url: expected https"),
        (ROW.replace("sha256 = '", "sha256 = 'x"), "sha256: expected 64 hexadecimal digits"),
        (ROW + ROW, "'a/b' is there twice"),
    ],
)
def test_a_wrong_catalogue_is_told(text: str, why: str, tmp_path: Path) -> None:
    file = tmp_path / "catalogue.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=why):
        read_catalogue(file)


def test_the_command_lists_verifies_and_fetches(
    server: Server, entry: CatalogueEntry, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, to = tmp_path / "catalogue.toml", tmp_path / "to"
    to.mkdir()
    file.write_text(
        f"[[recordings]]\nfile = 'a/b.bin'\nwhat = 'w'\nsource = 'derived from x'\nlicence = 'CC-BY-4.0'\n"
        f"bytes = {entry.bytes}\nsha256 = '{entry.sha256}'\nattribution = 'Somebody'\nurl = '{server.url}'\n"
    )
    mine = ["--catalogue", str(file)]
    assert main(["fixtures", "list", *mine]) == 0
    assert server.url in capsys.readouterr().out
    assert main(["fixtures", "verify", str(to), *mine]) == 1
    assert "a/b.bin: absent" in capsys.readouterr().out
    assert main(["fixtures", "fetch", "a", "--to", str(to), *mine]) == 0
    printed = capsys.readouterr()
    assert "fetched, as catalogued; CC-BY-4.0\n  attribution: Somebody" in printed.out
    assert not printed.err  # no terminal
    assert main(["fixtures", "verify", str(to), *mine]) == 0
    assert "1 of 1 are there and as catalogued, 0 are wrong" in capsys.readouterr().out
    (to / "a" / "b.bin").write_bytes(b"spoilt")
    assert main(["fixtures", "verify", str(to), *mine]) == 1
    assert "WRONG" in capsys.readouterr().out
    assert main(["fixtures", "fetch", "a/b.bin", "--to", str(to), *mine]) == 1
    assert "NOT FETCHED" in capsys.readouterr().out


def test_verify_reads_what_the_catalogue_says(entry: CatalogueEntry, tmp_path: Path) -> None:
    file = tmp_path / "x"
    file.write_bytes(BODY)
    check_file(file, entry)
    file.write_bytes(BODY[:-1] + b"\0")
    with pytest.raises(UserError, match="has sha256"):
        check_file(file, entry)
