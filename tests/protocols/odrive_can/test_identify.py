"""Identification of the firmware line, beside the conversations (`test_vectors_firmware`): a device of
another line than stated, and the form of heartbeats."""

from __future__ import annotations

import itertools
from typing import Literal

import pytest

from protocols.frames import any_matches
from protocols.messages import ClearFault, Fault, Mode, State, Velocity
from protocols.odrive_can import plugin
from protocols.odrive_can.codec import decode_from_device, encode
from protocols.odrive_can.faults import WRONG_FIRMWARE, Error
from protocols.odrive_can.faults05 import AxisError
from protocols.odrive_can.identify import line_by_form
from protocols.odrive_can.messages import Heartbeat, Heartbeat05, Message, UnidentifiedHeartbeat
from protocols.odrive_can.options import Options, Settings
from tests.protocols.helpers import of
from tests.protocols.odrive_can.helpers import Bench, device

Line = Literal["0.5", "0.6"]


def only_reads(bench: Bench) -> bool:
    """True if nothing was sent but remote frames that no line obeys.

    0.5 obeys remote frames: one of 0x06 would change its node id, one of 0x16 restart it."""
    spec = plugin.spec(bench.devices[0])
    cmds = {frame.id & 0x1F for _, frame in bench.sent if frame.id != 0x7E6}
    allowed = all(spec.read_only(frame) and any_matches(spec.sends, frame) for _, frame in bench.sent)
    return allowed and bool(cmds) and not cmds & {0x02, 0x06, 0x07, 0x16, 0x18, 0x1B}


@pytest.mark.parametrize(
    ("firmware", "stated", "name", "remedy"),
    [
        ("0.5.6", "0.6", "firmware 0.5.x", 'firmware = "0.5"'),
        ("0.6.10", "0.5", "firmware 0.6.10", 'firmware = "0.6"'),
    ],
)
def test_another_line_than_stated_is_a_fault_and_only_requests_are_sent(
    firmware: str, stated: Line, name: str, remedy: str
) -> None:
    bench = Bench([device(settings=Settings(firmware=firmware), options=Options(firmware=stated))])
    bench.run(3000, Velocity("left", 5.0))
    (fault,) = of(Fault, bench.events)
    assert (fault.code, fault.name) == (WRONG_FIRMWARE, name)
    assert fault.cause
    assert remedy in fault.remedy
    assert of(State, bench.events)[-1].mode is Mode.FAULT
    assert only_reads(bench)
    assert bench.driver.axes[1].identity.line == firmware[:3]
    events = bench.ask(ClearFault("left"), 1500)
    assert [fault.code for fault in of(Fault, events)] == [WRONG_FIRMWARE]
    assert not bench.twins[0].axis.armed


# -- a host that only listens -------------------------------------------------------------------------


def form(message: Message) -> str:
    """The line that the form of a heartbeat implies."""
    heartbeat = decode_from_device(encode(1, message), "")
    assert isinstance(heartbeat, UnidentifiedHeartbeat)
    return line_by_form(heartbeat)


def test_no_heartbeat_that_a_line_can_send_has_the_form_of_the_other() -> None:
    """Every combination of one error bit, state, result and flags; those that a line never sends left out."""
    for error, state, result, done in itertools.product((0, *Error), (1, 8), range(16), (0, 1)):
        if state == 8 and (error or result != 1):
            continue
        heartbeat = Heartbeat(error, state, result, done)
        assert form(heartbeat) != "0.5", heartbeat
    flags = (0, 1)
    for error, state, motor, encoder, done in itertools.product((0, *AxisError), (1, 8), flags, flags, flags):
        if state == 8 and (error or motor or encoder):
            continue
        failed = motor * AxisError.MOTOR_FAILED | encoder * AxisError.ENCODER_FAILED
        heartbeat05 = Heartbeat05(error | failed, state, motor, encoder, 0, done)
        assert form(heartbeat05) != "0.6", heartbeat05
