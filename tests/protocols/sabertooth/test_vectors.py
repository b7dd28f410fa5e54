"""Values ↔ bytes, both ways: those of pysabertooth 0.4.0."""

from __future__ import annotations

import pytest

from protocols import messages as msg
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from protocols.sabertooth import plugin
from protocols.sabertooth.options import Options, Settings
from protocols.sabertooth.table import PACKETS
from tests.protocols.helpers import acts

DEVICE = Device("left", 128, Options(full_scale=12.7), Settings())
VECTORS = {vector.name: vector.frame for vector in vectors_of(plugin)}
SENT: dict[str, tuple[list[tuple[str, int]], msg.Command | None]] = {
    "open_autobaud_and_setbaud": ([("AUTOBAUD", 0)] * 2 + [("BAUD", 2), ("AUTOBAUD", 0)], None),
    "m1_forward_50pct": ([("M1FORWARD", 63)], msg.Velocity("left", 6.3)),
    "m1_reverse_100pct": ([("M1REVERSE", 127)], msg.Velocity("left", -12.7)),
    "m2_reverse_25pct": ([("M2REVERSE", 31)], None),
    "stop_both": ([("M1FORWARD", 0), ("M2FORWARD", 0)], msg.Idle("left")),
    "serial_timeout_500ms": ([("SERIALTIMEOUT", 5)], None),
    "mixed_forward_64": ([("MIXEDFORWARD", 64)], None),
    "mixed_right_10": ([("MIXEDRIGHT", 10)], None),
}
"""Messages, and what the first motor of the board then does."""


def test_no_vector_is_left_out() -> None:
    assert {name for name in VECTORS if not name.startswith("also_")} == SENT.keys()


@pytest.mark.parametrize("name", SENT)
def test_what_a_host_sends_and_a_motor_obeys(name: str) -> None:
    messages, does = SENT[name]
    made = [
        PACKETS.encode(each, 128) if each == "AUTOBAUD" else PACKETS.encode(each, 128, value=value)
        for each, value in messages
    ]
    assert b"".join(made) == VECTORS[name]
    assert [each.name for each in PACKETS.in_frame(VECTORS[name])[0] if each] == [
        each for each, _ in messages
    ]
    obeyed = acts(plugin.decoder([DEVICE]).decode(0, VECTORS[name]))
    commands = [one for one in obeyed if isinstance(one, msg.COMMANDS)]
    assert [type(one) for one in commands] == ([type(does)] if does else [])
    for one in commands:
        assert getattr(one, "velocity", 0.0) == pytest.approx(getattr(does, "velocity", 0.0))
