"""Which object of a device is next to be read or written by SDO, and when.

Rules. One transfer at a time per device; what presses most goes first. Set-points take turns with feedback
(`feedback` knows what is due), and so does what is read of a device at first, or written before it is armed.
Nothing is written to a device that was not commanded, but for what an operator asks.
"""

from __future__ import annotations

from protocols.cia402 import objects as o
from protocols.cia402.client import Job, Purpose
from protocols.cia402.feedback import NEVER, Reasons
from protocols.cia402.node import Node
from protocols.cia402.objects import OBJECTS, Key, from_bytes, to_bytes
from protocols.messages import MILLISECOND, SECOND, Nanos

ROLL_CALL = SECOND
"""A device's serial number is read again so often: to notice another one in its place, or two."""
ROLL_CALL_AGAIN = 100 * MILLISECOND
"""... and so often when an answer came twice."""


def next_job(node: Node, now: Nanos) -> Job | None:
    """What is to be begun now; None if nothing is due, or the client is at work."""
    client = node.client
    if node.urgent and client.free(Purpose.RELEASE):
        return node.urgent.pop(0)
    if not client.free(Purpose.POLL):
        return None
    poll = node.polls.next(now, _reasons(node), node.absent)
    if node.setup and (node.owned or node.commanded_at == now) and (poll is None or not node.took_turn):
        node.took_turn = True
        return node.setup.pop(0)
    setpoint = _setpoint(node, now)
    if setpoint is not None and (poll is None or not node.took_turn):
        node.took_turn = True
        return setpoint
    turn_taken, node.took_turn = node.took_turn, False
    if node.questions:
        return node.questions.pop(0)
    key = node.next_key()
    if key is not None and (poll is None or not turn_taken):
        node.took_turn = True
        return Job(Purpose.READING, key)
    if poll is not None:
        node.polls.begin(now, poll, node.absent)
        return Job(Purpose.POLL, poll)
    if now >= node.roll_call and node.received_at is not None:
        node.roll_call = now + (ROLL_CALL_AGAIN if client.doubled or client.repeated else ROLL_CALL)
        return Job(Purpose.ROLL_CALL, o.DEVICE_TYPE if o.SERIAL_NUMBER in node.absent else o.SERIAL_NUMBER)
    return None


def _setpoint(node: Node, now: Nanos) -> Job | None:
    """A set-point that stands in no PDO, while the device is commanded."""
    if not node.values or node.insist is not None or not (node.commanded_at == now or node.homing):
        return None
    wanted = node.outlet.by_sdo(now, node.values, node.target)
    if wanted is None:
        return None
    key, value = wanted
    return Job(Purpose.SETPOINT, key, to_bytes(OBJECTS[key].type, value))


def _reasons(node: Node) -> Reasons:
    """What presses to ask for feedback."""
    changing = node.trying_since is not None or node.insist is not None or node.clearing
    return Reasons(changing, node.wants_error, node.units is not None)


def due(node: Node) -> Nanos:
    """When `next_job` next has something for a free client."""
    if node.urgent or node.setup or node.questions or node.next_key() is not None:
        return 0
    return min(node.polls.due(_reasons(node)), node.roll_call if node.received_at is not None else NEVER)


def polled(key: Key, data: bytes) -> int | None:
    """What an upload of the feedback tells; None if it is not as long as its type."""
    return from_bytes(OBJECTS[key].type, data)
