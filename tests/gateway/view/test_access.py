"""Who may connect to the live view."""

from __future__ import annotations

import pytest

from gateway.errors import UserError
from gateway.view.access import Access, Address, parse_address

TOKEN = "0123456789abcdef"


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("8000", Address("127.0.0.1", 8000)),
        (":8000", Address("127.0.0.1", 8000)),
        ("localhost", Address("127.0.0.1", 8765)),
        ("0.0.0.0:1", Address("0.0.0.0", 1)),
        ("[::1]:80", Address("::1", 80)),
        ("[::1]", Address("::1", 8765)),
        ("192.168.1.2", Address("192.168.1.2", 8765)),
    ],
)
def test_addresses(text: str, address: Address) -> None:
    assert parse_address(text) == address


@pytest.mark.parametrize("text", ["robot.local:80", "127.0.0.1:http", "1.2.3.4:70000", "::1:80:x", "-1"])
def test_what_is_no_address_gets_a_sentence(text: str) -> None:
    with pytest.raises(UserError, match=r"expected|IP address"):
        parse_address(text)


HERE = "127.0.0.1:8765"


@pytest.mark.parametrize(
    ("access", "path", "host", "origin", "status"),
    [
        (Access(), "/", HERE, None, 0),
        (Access(), "/", "localhost:8765", "http://localhost:8765", 0),
        (Access(), "/", "[::1]:8765", "http://[::1]:8765", 0),
        (Access(), "/", HERE, "http://evil.example", 403),
        (Access(), "/", HERE, "http://127.0.0.1:8766", 403),  # another program's page
        (Access(), "/", HERE, "null", 403),  # a file, or a sandbox
        (Access(), "/", "evil.example:8765", "http://evil.example:8765", 403),  # DNS rebinding
        (Access(origins=("https://app.example",)), "/", HERE, "https://app.example", 0),
        (Access(loopback=False, token=TOKEN), f"/?token={TOKEN}", "10.0.0.1:8765", "http://10.0.0.1:8765", 0),
        (Access(loopback=False, token=TOKEN), f"/x?a=b&token={TOKEN}", "robot:8765", None, 0),
        (Access(loopback=False, token=TOKEN), "/", "10.0.0.1:8765", None, 401),
        (Access(loopback=False, token=TOKEN), f"/?token={TOKEN}x", "10.0.0.1:8765", None, 401),
        (Access(loopback=False, token=TOKEN), "/?token=%C3%A9", "10.0.0.1:8765", None, 401),
        (
            Access(loopback=False, token=TOKEN),
            f"/?token={TOKEN}",
            "10.0.0.1:8765",
            "http://evil.example",
            403,
        ),
        (Access(token=TOKEN), "/", HERE, None, 401),
    ],
)
def test_connections(access: Access, path: str, host: str, origin: str | None, status: int) -> None:
    refused, reason = access.refused(path, host, origin)
    assert refused == status
    assert bool(reason) is bool(status)


def test_other_machines_need_a_token_that_is_long() -> None:
    with pytest.raises(UserError, match="needs a token"):
        Access(loopback=False)
    with pytest.raises(UserError, match="16 ASCII characters"):
        Access(token="short")
