"""Bytes and texts of Foxglove's protocol: the snapshots of foxglove-sdk, and what its 0.30.3 answered."""

from __future__ import annotations

import json

import pytest

from gateway.view import foxglove_wire as wire
from gateway.view.foxglove_services import SERVICES
from gateway.view.foxglove_wire import Binary, Call, Play, Published, WireError

FROM_CLIENTS: list[tuple[str, Binary]] = [  # rust/foxglove/src/protocol/v1/snapshots, of the client
    ("01 1e000000 7b226b6579223a202276616c7565227d", Published(30, b'{"key": "value"}')),
    (
        "02 0a000000 0c000000 04000000 6a736f6e 7b226b6579223a202276616c7565227d",
        Call(10, 12, b"json", b'{"key": "value"}'),
    ),
    ("03 00 0000803f 00 0000000000000000 07000000 736f6d652d6964", Play(True, 1.0, None, b"some-id")),
    ("03 01 0000803f 00 0000000000000000 07000000 736f6d652d6964", Play(False, 1.0, None, b"some-id")),
    ("03 00 0000803f 01 15cd5b0700000000 07000000 736f6d652d6964", Play(True, 1.0, 123456789, b"some-id")),
]
FROM_SERVERS: list[tuple[bytes, str]] = [
    # of the server
    (wire.time(1234567890), "02 d202964900000000"),
    (
        wire.playback(wire.PLAYING, 12345, 1.0, sought=False),
        "05 00 3930000000000000 0000803f 00 00000000",
    ),
    (wire.playback(wire.PLAYING, 12345, 1.0, sought=True), "05 00 3930000000000000 0000803f 01 00000000"),
    (
        wire.playback(wire.PLAYING, 12345, 1.0, sought=False, request=b"i-am-a-request"),
        "05 00 3930000000000000 0000803f 00 0e000000 692d616d2d612d72657175657374",
    ),
    (
        wire.response(10, 12, {"key": "value"}),
        "03 0a000000 0c000000 04000000 6a736f6e 7b226b6579223a202276616c7565227d",
    ),
    # what a server of it sent
    (wire.data(5, 123, b"\0\1\0\0\1\0\0\0"), "01 05000000 7b00000000000000 0001000001000000"),
    (
        wire.playback(wire.PLAYING, 7, 2.0, sought=False, request=b"r1"),
        "05 00 0700000000000000 00000040 00 02000000 7231",
    ),
]


@pytest.mark.parametrize(("text", "message"), FROM_CLIENTS)
def test_bytes_of_a_client(text: str, message: Binary) -> None:
    data = bytes.fromhex(text)
    assert wire.read_binary(data) == message
    fixed = len(data) - len(message.payload if isinstance(message, Published | Call) else b"")
    for end in range(1, fixed):
        with pytest.raises(WireError, match="too short"):
            wire.read_binary(data[:end])


@pytest.mark.parametrize(("data", "text"), FROM_SERVERS)
def test_bytes_of_a_server(data: bytes, text: str) -> None:
    assert data == bytes.fromhex(text)


@pytest.mark.parametrize(("t", "clamped"), [(-1, 0), (0, 0), (2**64 - 1, 2**64 - 1), (2**64, 2**64 - 1)])
def test_times_have_64_bits(t: int, clamped: int) -> None:
    assert wire.time(t) == b"\2" + clamped.to_bytes(8, "little")
    assert wire.data(0, t, b"")[5:] == clamped.to_bytes(8, "little")


def test_a_status_is_bounded_and_may_have_a_name() -> None:
    assert json.loads(wire.status(wire.ERROR, "x" * 10_000)) == {
        "op": "status",
        "level": 2,
        "message": "x" * wire.MAX_TEXT,
    }
    assert json.loads(wire.status(wire.INFO, "\ud800", "a"))["id"] == "a"


def test_a_service_is_told_as_the_reference_tells_its_own() -> None:
    """{"id":1,"name":"/stop","type":"Stop","request":{"encoding":"json","schemaName":"StopRequest", …"""
    for number, service in enumerate(SERVICES, 1):
        told = service.advertised(number)
        assert told.keys() == {"id", "name", "type", "request", "response"}
        for part in (told["request"], told["response"]):
            assert part.keys() == {"encoding", "schemaName", "schemaEncoding", "schema"}
            assert (part["encoding"], part["schemaEncoding"]) == ("json", "jsonschema")
            assert json.loads(part["schema"])["type"] == "object"
        required = json.loads(told["request"]["schema"])["required"]
        assert set(required) <= service.fields.keys()


@pytest.mark.parametrize(
    ("payload", "velocities"),
    [
        (b"{}", (0.0, 0.0, 0.0)),
        (b'{"linear": {"x": 1, "y": -2, "z": 9}, "angular": {"z": 3}}', (1.0, -2.0, 3.0)),
    ],
)
def test_a_twist_in_json(payload: bytes, velocities: tuple[float, ...]) -> None:
    assert wire.twist("json", payload) == velocities


def test_what_is_no_real_number() -> None:
    for value in ("1", None, [1], float("nan"), float("inf"), 10**400):
        with pytest.raises(WireError, match="x must be a finite number"):
            wire.real(value, "x")
    assert [wire.real(one, "x") for one in (True, 2, -0.5)] == [1.0, 2.0, -0.5]
