"""Which object of a device is next to be read or written by SDO, and when.

Rules. One transfer at a time per device; what presses most goes first. Set-points take turns with feedback,
and so does what is read of a device at first, or written before it is armed. What a TPDO tells is not asked
for. Nothing is written to a device that was not commanded, but for what an operator asks. Every question has
a period, whether it is answered or not.
"""

from __future__ import annotations

from protocols.cia402 import objects as o
from protocols.cia402.client import Job, Purpose
from protocols.cia402.node import NEVER, Node
from protocols.cia402.objects import OBJECTS, Key, from_bytes, to_bytes
from protocols.words import MILLISECOND, SECOND, Nanos

ROLL_CALL = SECOND
"""A device's serial number is read again so often: to notice another one in its place, or two."""
ROLL_CALL_AGAIN = 100 * MILLISECOND
"""... and so often when an answer came twice."""
POLLED: tuple[tuple[Key, int], ...] = (
    (o.POSITION, 1),
    (o.VELOCITY, 1),
    (o.STATUSWORD, 2),
    (o.TORQUE, 5),
    (o.MODE_DISPLAY, 10),
    (o.ERROR_CODE, 20),
    (o.CURRENT, 20),
    (o.DC_VOLTAGE, 20),
)
"""What is asked for, and how many feedback periods lie between."""
CHANGING = (o.STATUSWORD, o.MODE_DISPLAY)
"""What is asked for more often while it is to change."""
AHEAD = 5 * MILLISECOND
"""So long before a question is due its plan is made anew."""
UNTIMED = 100 * MILLISECOND
"""What an object is worth that came by a TPDO whose period is not known."""


def next_job(node: Node, now: Nanos) -> Job | None:
    """What is to be begun now; None if nothing is due, or the client is at work."""
    client = node.client
    if node.urgent and client.free(Purpose.RELEASE):
        return node.urgent.pop(0)
    if not client.free(Purpose.POLL):
        return None
    poll = _poll(node, now)
    if node.setup and (node.claimed or node.commanded_at == now) and (poll is None or not node.took_turn):
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
        node.asked[poll] = now
        node.poll_at = _plan(node)
        return Job(Purpose.POLL, poll)
    if now >= node.roll_call and node.heard_at is not None:
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


def _poll(node: Node, now: Nanos) -> Key | None:
    """What is most overdue of the feedback, in its own periods: on a slow line the motion comes first.

    What is heard meanwhile only puts a question off, so the plan is made anew shortly before one is due, or
    when another reason to ask comes up."""
    pressing = _pressing(node)
    if now + AHEAD < node.poll_at and pressing == node.poll_pressing:
        return None
    node.poll_pressing = pressing
    if node.units is None:
        node.poll_at = NEVER
        return None
    node.poll_at = _plan(node)
    late = [((now - _at(node, key, periods)) / periods, -at) for at, (key, periods) in enumerate(POLLED)]
    periods_late, which = max(late)
    return POLLED[-which][0] if periods_late >= 0 else None


def _plan(node: Node) -> Nanos:
    """When the next question is due."""
    return min(_at(node, key, periods) for key, periods in POLLED)


def _pressing(node: Node) -> tuple[bool, bool, bool]:
    """What changes the plan besides time."""
    changing = node.trying_since is not None or node.insist is not None or node.clearing
    return changing, node.wants_error, node.units is not None


def _at(node: Node, key: Key, periods: int) -> Nanos:
    """When an object is next to be asked for."""
    if key in node.absent or (key == o.ERROR_CODE and not node.wants_error):
        return NEVER
    if key in CHANGING and node.poll_pressing[0]:
        periods = 1
    asked = node.asked.get(key)
    again = 0 if asked is None else asked + periods * node.options.feedback_ms * MILLISECOND
    fresh = node.fresh.get(key)
    return again if fresh is None else max(again, fresh + node.worth.get(key, UNTIMED))


def due(node: Node) -> Nanos:
    """When `next_job` next has something for a free client."""
    if node.urgent or node.setup or node.questions or node.next_key() is not None:
        return 0
    polls = node.poll_at if _pressing(node) == node.poll_pressing else 0
    return min(polls, node.roll_call if node.heard_at is not None else NEVER)


def polled(key: Key, data: bytes) -> int | None:
    """What an upload of the feedback tells; None if it is not as long as its type."""
    return from_bytes(OBJECTS[key].type, data)
