"""Lines that moteus 1.1.1 exchanged with an fdcanusb, with checksums: the frames in them are ours."""

from __future__ import annotations

import json
from importlib.resources import files

from gateway.buses.adapters.fdcanusb import OK, Adapter, decode_received, split_checksum
from protocols.moteus.codec import make_frame, parse
from protocols.moteus.messages import names
from protocols.moteus.reply import decode

LINES = {
    entry["name"]: bytes.fromhex(entry["data"])
    for entry in json.loads((files("gateway.fixtures") / "vectors/fdcanusb.json").read_text("utf-8"))
}


def test_what_the_package_sends_is_a_frame_to_a_device() -> None:
    frames, answer = Adapter(1_000_000, 5_000_000).feed(LINES["fdcanusb_line#3"])
    assert [(f.id, f.extended, f.fd, f.brs) for f in frames] == [(0x8005, True, True, True)]
    assert names(frames[0]) == ("position 020 021", "read")
    assert parse(frames[0].data)[1]
    assert split_checksum(answer.rstrip()) == (OK.encode(), True)


def test_what_the_package_takes_is_a_frame_of_a_device() -> None:
    line, right = split_checksum(LINES["fdcanusb_line#2"].rstrip(b"\n"))
    assert right
    frame = decode_received(line.decode())
    assert frame is not None
    assert decode(frame.data) is None  # 22 bytes, as the package took them: no CAN FD frame has so many
    reported = decode(make_frame(frame.id, frame.data).data)
    assert reported is not None
    assert (frame.id, reported.values[1], reported.values[0x0D]) == (0x500, -0.125, 24.5)
