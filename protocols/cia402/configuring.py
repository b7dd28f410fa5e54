"""What a device must be told before it is armed: its heartbeat, its PDOs, our heartbeat to be watched.

Rules. Functions on a `Node`, which leave jobs for its SDO client. It is planned at the first command and not
before; what the device has is left where it fits. Once all is written we speak and listen by it. A PDO that
the device does not let us write stays disabled, and what it held goes by SDO; what else it refuses keeps it
from being armed.
"""

from __future__ import annotations

from protocols.cia402 import mapping
from protocols.cia402 import objects as o
from protocols.cia402.client import Job, Purpose
from protocols.cia402.mapping import Pdo
from protocols.cia402.node import Node
from protocols.cia402.objects import OBJECTS, Key, to_bytes
from protocols.cia402.profile import Mode as Operation
from protocols.cia402.setpoint import TARGET_OF
from protocols.cia402.startup import Known
from protocols.messages import MILLISECOND


def configured(node: Node) -> bool:
    """Whether all is written that comes before arming; plans it at first."""
    if node.setup is None:
        node.setup = _plan(node)
    if node.setup or (node.client.job is not None and node.client.job.purpose is Purpose.SETUP):
        return False
    if not node.configured:
        _adopt(node)
        node.configured = True
    return True


def _plan(node: Node) -> list[Job]:
    options, jobs = node.options, list[Job]()

    def write(key: Key, value: int) -> None:
        jobs.append(Job(Purpose.SETUP, key, to_bytes(OBJECTS[key].type, value)))

    if options.heartbeat_ms and not node.read.get(o.PRODUCER_HEARTBEAT):
        write(o.PRODUCER_HEARTBEAT, options.heartbeat_ms)
    node.writing = _unfitting(node) if options.mapping == "auto" else ()
    for pdo in node.writing:
        before = node.read.get((mapping.FIRST[pdo.way][0] + pdo.number - 1, o.COB_ID), 0)
        jobs += [Job(Purpose.SETUP, key, data) for key, data in mapping.writes(pdo, before)]
    if options.watchdog_ms:
        write(o.CONSUMER_HEARTBEAT, options.host_id << 16 | options.watchdog_ms)
    return jobs


def _unfitting(node: Node) -> tuple[Pdo, ...]:
    """The PDOs that must be written anew."""
    known, options = node.known, node.options
    if known is None:
        return ()
    synced = options.feedback == "sync"
    sync = options.sync_ms * MILLISECOND
    wanted = mapping.wanted(node.address, options, synced, node.absent)
    if mapping.commands_fit(node.usable("to"), targets_of(known, options.modes)):
        wanted = [pdo for pdo in wanted if pdo.way == "from"]
    # Where somebody else produces SYNC, nobody here knows its period: once in ten periods must do.
    most = 10 * max(sync, options.feedback_ms * MILLISECOND)
    if mapping.feedback_fits(node.usable("from"), sync or options.feedback_ms * MILLISECOND, most):
        wanted = [pdo for pdo in wanted if pdo.way == "to"]
    have = {(pdo.way, pdo.number): pdo for pdo in known.pdos}
    there = [p for p in wanted if (p.way, p.number) in have]
    return tuple(p for p in there if not mapping.same(have[p.way, p.number], p))


def targets_of(known: Known, prefer: str) -> set[Key]:
    """The set-points of the modes that would be used."""
    cyclic = (Operation.CSP, Operation.CSV, Operation.CST)
    profile = (Operation.PP, Operation.PV, Operation.PT)
    first, second = (cyclic, profile) if prefer == "cyclic" else (profile, cyclic)
    used = [known.mode(*pair) for pair in zip(first, second, strict=True)]
    return {TARGET_OF[mode] for mode in used if mode is not None}


def _adopt(node: Node) -> None:
    """The PDOs are as they were written: speak and listen by them."""
    if node.known is None:
        return
    pdos = {(pdo.way, pdo.number): pdo for pdo in node.known.pdos}
    pdos |= {(pdo.way, pdo.number): pdo for pdo in node.writing}
    node.known = Known(node.known.units, node.known.modes, node.known.serial, tuple(pdos.values()))
    node.writing = ()
    node.listen(node.known.pdos)
    reported = {key: node.read[key] for key in (o.VELOCITY_OFFSET, o.TORQUE_OFFSET) if key in node.read}
    node.outlet.configure(node.usable("to"))
    node.outlet.reported |= reported


def wrote(node: Node, job: Job, abort: int | None) -> bool:
    """A job of the setup has ended; False if it may not have failed.

    A PDO that the device does not let us write stays disabled: what it held goes by SDO."""
    key = job.key
    if abort is None:
        if key == o.CONSUMER_HEARTBEAT:
            node.watched = any(job.data or b"")
        return True
    if key[1] == o.INHIBIT and o.TPDO_COMMUNICATION <= key[0] < o.TPDO_MAPPING:
        return True
    failed = [p for p in node.writing if key[0] in (i + p.number - 1 for i in mapping.FIRST[p.way])]
    if not failed:
        return key == o.PRODUCER_HEARTBEAT
    (pdo,) = failed
    node.writing = tuple(p for p in node.writing if p is not pdo)
    indices = [first + pdo.number - 1 for first in mapping.FIRST[pdo.way]]
    node.setup = [job for job in node.setup or [] if job.key[0] not in indices]
    if node.known is not None:
        gone = tuple(p for p in node.known.pdos if (p.way, p.number) != (pdo.way, pdo.number))
        node.known = Known(node.known.units, node.known.modes, node.known.serial, gone)
    return True
