"""Who may open the live view: an address, and the rules for what comes from elsewhere. Pure values.

Rules. On the loopback interface whoever has an account on the machine may look; on any other address only who
has the token. A browser sends the origin of the page that opens a connection (RFC 6455, 10.2): that must be
the view's own, or one that was allowed, else any page on the web could steer the robot of whoever visits it.
On loopback the name in the address must be a loopback one too, so that no foreign name can be made to point
here (DNS rebinding).
"""

from __future__ import annotations

from dataclasses import dataclass
from hmac import compare_digest
from ipaddress import ip_address
from urllib.parse import parse_qs

from gateway.errors import UserError

DEFAULT_PORT = 8765
LOOPBACK = "127.0.0.1"
LEAST_TOKEN = 16
"""Characters of a token."""


@dataclass(frozen=True, slots=True)
class Address:
    """Where the view listens."""

    host: str = LOOPBACK
    port: int = DEFAULT_PORT
    """0: one that is free."""

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach it."""
        return _is_loopback(self.host)

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def parse_address(text: str) -> Address:
    """Return the address in HOST:PORT, HOST, :PORT or PORT; an IPv6 address in brackets. Raises UserError."""
    host, colon, port = text.rpartition(":")
    if text.endswith("]") or (not colon and not text.isdigit()):
        host, port = text, str(DEFAULT_PORT)
    host = host.removeprefix("[").removesuffix("]") or LOOPBACK
    if not (port.isascii() and port.isdigit() and int(port) < 1 << 16):
        raise UserError(f"{text!r} is no address: HOST:PORT is expected, such as {LOOPBACK}:{DEFAULT_PORT}")
    if host != "localhost":
        try:
            ip_address(host)
        except ValueError:
            raise UserError(f"{text!r}: {host!r} is no IP address of this machine (or localhost)") from None
    return Address(LOOPBACK if host == "localhost" else host, int(port))


@dataclass(frozen=True, slots=True)
class Access:
    """Who may connect."""

    loopback: bool = True
    """Whether the address is a loopback one."""
    token: str = ""
    """What a connection must bring; "": nothing."""
    origins: tuple[str, ...] = ()
    """Foreign pages that may connect: "https://app.foxglove.dev"."""

    def __post_init__(self) -> None:
        if not self.loopback and not self.token:
            raise UserError("a view that other machines can reach needs a token")
        if self.token and (len(self.token) < LEAST_TOKEN or not self.token.isascii()):
            raise UserError(f"the token must have {LEAST_TOKEN} ASCII characters at least")

    def refused(self, path: str, host: str, origin: str | None) -> tuple[int, str]:
        """Return the HTTP status and the reason for which a connection is refused; (0, "") if it is not.

        Args:
            path: of the request, with its query.
            host: its header Host.
            origin: its header Origin; None: there is none, as from a program.
        """
        if self.loopback and not _is_loopback(_name(host)):
            return 403, f"the view of this machine is not {host!r}"
        if origin is not None and origin not in self.origins and origin.partition("://")[2] != host:
            return 403, f"pages of {origin!r} may not connect: allow them with --origin"
        given = parse_qs(path.partition("?")[2]).get("token", [""])[0]
        if self.token and not compare_digest(given.encode(errors="replace"), self.token.encode()):
            return 401, "the token is missing or wrong: open the address that the gateway printed"
        return 0, ""


def _name(host: str) -> str:
    """Return the name in a header Host, without its port."""
    name = host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]
    return name.lower()


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
