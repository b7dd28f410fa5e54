"""A CANopen device: what it makes of the frames that it receives, and what it sends.

Rules. `Node` is the part of a device's communication that the host determines: NMT, SDO, RPDOs, SYNC, the
host's heartbeat. A command decoder has one per device, and the twin runs on the very same class. PDOs are
received in NMT operational only, SDO not in NMT stopped; synchronous RPDOs act together at the SYNC. `Sender`
is the other part: boot-up, heartbeat, SDO responses, EMCY, TPDOs. Both are plain data; what objects mean is
the device's own matter.

Source: CiA 301 (NMT, PDO, SYNC, heartbeat, EMCY). What counts as an event of a TPDO is the maker's choice: a
change of a state object, or of any object if there is no event timer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from protocols.canopen import objects as o
from protocols.canopen import services
from protocols.canopen.dictionary import Dictionary
from protocols.canopen.lss import ASKS, MASTER, SLAVE, Slave, is_message
from protocols.canopen.objects import Key
from protocols.canopen.pdo import NO_RTR, is_synchronous
from protocols.canopen.server import SdoServer
from protocols.canopen.services import NmtCommand, NmtState
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Nanos

HEARTBEAT_LOST = 0x8130
"""EMCY codes."""
RPDO_TIMEOUT = 0x8250
RPDOS = [o.RPDO_COMMUNICATION + number - 1 for number in o.PDO_NUMBERS]
TPDOS = [o.TPDO_COMMUNICATION + number - 1 for number in o.PDO_NUMBERS]
"""Indices of their communication parameters."""
COMMUNICATION_END = 0x2000
"""The objects below it are communication parameters."""
INHIBIT_UNIT: Nanos = MILLISECOND // 10
RESETS = (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION)
NEXT_STATE = {NmtCommand.START: NmtState.OPERATIONAL, NmtCommand.STOP: NmtState.STOPPED}
"""By command; by all others the node becomes pre-operational."""
LOST_STATES = {0: NmtState.PRE_OPERATIONAL, 2: NmtState.STOPPED}
"""By object 1029:01: the NMT state after the host is lost."""


@dataclass(frozen=True, slots=True)
class Received:
    """What a frame did to a node."""

    written: Sequence[Key] = ()
    """The objects that it wrote, all at the same time."""
    latched: Mapping[Key, int] = field(default_factory=dict)
    """What waits for a SYNC."""
    command: NmtCommand | None = None
    changed: bool = False
    """The NMT state is another one than before."""
    response: bytes | None = None
    """Of the SDO server."""
    sync: bool = False
    lss: bytes | None = None
    """The answer to a message of LSS; b"": there is none."""
    lss_sets: bool = False
    """The message does not only ask."""
    node: int = 0
    """The node id that it has got by LSS with this reset; 0: none."""


class Node:
    """A device as a receiver."""

    def __init__(self, dictionary: Dictionary, address: int, lss: Slave | None = None) -> None:
        self.dictionary, self.address, self.lss = dictionary, address, lss
        self.start()

    def start(self, below: int = 0x1_0000) -> None:
        """Start with the stored values of the objects below an index: of all, or of communication's."""
        self.dictionary.start(below)
        self.server = SdoServer()
        self.nmt = NmtState.PRE_OPERATIONAL
        self.latched: dict[int, tuple[int, ...]] = {}
        """Values of synchronous RPDOs that wait for a SYNC, by the index of the PDO."""
        self.received: dict[int, Nanos] = {}
        """When each RPDO came last."""
        self.host_beat: Nanos | None = None
        """When the heartbeat that object 1016 names came last."""

    def move(self, address: int, dictionary: Dictionary) -> None:
        """Take another node id, and the dictionary that goes with it; what is no parameter of communication
        keeps its value."""
        before, self.address, self.dictionary = self.dictionary.values, address, dictionary
        kept = {key: value for key, value in before.items() if key[0] >= COMMUNICATION_END}
        dictionary.values.update(kept)

    def receive(self, t: Nanos, frame: Frame) -> Received | None:
        """Handle a frame; None if it did nothing that a device would react to."""
        if not services.is_classic(frame):
            return None
        if self.lss is not None and not self.lss.addressed and not is_message(frame):
            return None  # it hears LSS alone
        if frame.id == services.sdo_rx_id(self.address):
            return self._on_sdo(frame.data)
        if self.lss is not None and is_message(frame):
            answer = self.lss.receive(frame.data, self.address)
            if self.lss.begins:
                return self._on_nmt(NmtCommand.RESET_COMMUNICATION)
            return Received(lss=answer, lss_sets=frame.data[0] not in ASKS)
        values = self.dictionary.values
        if indices := [index for index in RPDOS if values[index, o.COB_ID] & ~NO_RTR == frame.id]:
            return self._on_rpdos(t, indices, frame.data)
        if frame.id > services.SYNC_ID and frame.id & ~services.NODE_MASK != services.HEARTBEAT_BASE:
            return None
        match services.decode(frame):
            case services.Nmt(command, node) if node in (0, self.address):
                return self._on_nmt(command)
            case services.Nmt(command) if command in RESETS and self.lss and self.lss.identity is None:
                self.lss.take()  # it was another device's
            case services.Sync() if self.nmt is NmtState.OPERATIONAL:
                latched, self.latched = self.latched, {}
                written = [key for index in sorted(latched) for key in self._take(index, latched[index])]
                return Received(written, sync=True)
            case services.Heartbeat(node, _) if (
                node == values[o.CONSUMER_HEARTBEAT] >> 16 & services.NODE_MASK
            ):
                self.host_beat = t
        return None

    def _on_nmt(self, command: NmtCommand) -> Received:
        before = self.nmt
        if command is NmtCommand.RESET_NODE:
            self.start()
        elif command is NmtCommand.RESET_COMMUNICATION:
            self.start(COMMUNICATION_END)
        self._enter(NEXT_STATE.get(command, NmtState.PRE_OPERATIONAL))
        node = self.lss.take() if self.lss is not None and command in RESETS else 0
        return Received(command=command, changed=self.nmt is not before, node=node)

    def _enter(self, state: NmtState) -> None:
        self.nmt = state
        if state is not NmtState.OPERATIONAL:
            self.latched.clear()
            self.received.clear()

    def _on_sdo(self, data: bytes) -> Received | None:
        if self.nmt is NmtState.STOPPED:
            return None
        response, key = self.server.handle(self.dictionary, data)
        if key == o.CONSUMER_HEARTBEAT:
            self.host_beat = None  # monitored from the next heartbeat on (CiA 301 "heartbeat consumer")
        return Received(() if key is None else (key,), response=response)

    def _on_rpdos(self, t: Nanos, indices: Sequence[int], data: bytes) -> Received | None:
        written: list[Key] = []
        latched: dict[Key, int] = {}
        for index in indices if self.nmt is NmtState.OPERATIONAL else ():
            packing = self.dictionary.active(index)
            values = packing.unpack(data) if packing else None
            if packing is None or values is None:
                continue
            self.received[index] = t
            if is_synchronous(self.dictionary.values[index, o.TRANSMISSION]):
                self.latched[index] = values
                latched |= zip((each.key for each in packing.entries), values, strict=False)
            else:
                written += self._take(index, values)
        return Received(written, latched) if written or latched else None

    def _take(self, index: int, values: Sequence[int]) -> list[Key]:
        """Write the values of an RPDO to the dictionary; return the objects that accepted them."""
        packing = self.dictionary.active(index)
        keys = [entry.key for entry in packing.entries] if packing else []
        return [key for key, value in zip(keys, values, strict=False) if self.dictionary.take(key, value)]

    # -- the host is lost ---------------------------------------------------------------------------

    def overdue(self, now: Nanos) -> list[int]:
        """Return the EMCY codes of what did not come in time, each once: the heartbeat of 1016, RPDOs."""
        codes = []
        timeout = self.heartbeat_timeout
        if timeout and self.host_beat is not None and now - self.host_beat > timeout:
            self.host_beat = None
            codes.append(HEARTBEAT_LOST)
        for index, received in sorted(self.received.items()):
            deadline = self.dictionary.values[index, o.EVENT_TIMER] * self.dictionary.timer_unit
            if deadline and now - received > deadline:
                del self.received[index]
                codes.append(RPDO_TIMEOUT)
        return codes

    @property
    def heartbeat_timeout(self) -> Nanos:
        """Consumer heartbeat time; 0: none."""
        return (self.dictionary.values[o.CONSUMER_HEARTBEAT] & 0xFFFF) * MILLISECOND

    def lose_host(self) -> None:
        """Enter the NMT state that object 1029 demands."""
        if self.nmt is NmtState.OPERATIONAL:
            self._enter(LOST_STATES.get(self.dictionary.values[o.ERROR_BEHAVIOUR], self.nmt))


@dataclass(slots=True)
class Tpdo:
    """When one TPDO is sent, and with what."""

    index: int
    """Of its communication parameter."""
    syncs: int = 0
    """SYNCs since it was sent."""
    sent: Nanos | None = None
    """None: not since the device became operational."""
    values: dict[Key, int] | None = None
    """As sent last."""

    def is_timed(self, dictionary: Dictionary) -> bool:
        """True if it is sent without SYNC."""
        transmission = dictionary.values[self.index, o.TRANSMISSION]
        return not is_synchronous(transmission) and dictionary.active(self.index) is not None

    def timer(self, dictionary: Dictionary) -> Nanos:
        """Return its period; 0: none."""
        return dictionary.values[self.index, o.EVENT_TIMER] * dictionary.timer_unit

    def sample(
        self, now: Nanos, dictionary: Dictionary, events: frozenset[Key], *, sync: bool
    ) -> list[CanFrame]:
        """Return the frame if one is due now, with a SYNC or without; `events`: the state objects."""
        transmission = dictionary.values[self.index, o.TRANSMISSION]
        packing = dictionary.active(self.index) if sync is is_synchronous(transmission) else None
        if packing is None:
            return []
        keys = [entry.key for entry in packing.entries]
        values = {key: dictionary.values.get(key, 0) for key in keys}
        changed = self.values is None or self.values != values
        self.syncs += sync
        if sync:
            due = self.syncs >= transmission if transmission else changed
        elif self.sent is not None and self.values is not None:
            elapsed, timer = now - self.sent, self.timer(dictionary)
            if timer and self.values.keys() == values.keys():
                changed = any(self.values[key] != values[key] for key in events & values.keys())
            inhibited = elapsed < dictionary.values[self.index, o.INHIBIT] * INHIBIT_UNIT
            due = not inhibited and (changed or 0 < timer <= elapsed)
        else:
            due = True
        if not due:
            return []
        self.values, self.sent, self.syncs = values, now, 0
        cob = dictionary.values[self.index, o.COB_ID] & 0x7FF
        return [CanFrame(cob, packing.pack([values[key] for key in keys]))]


class Sender:
    """A device as a sender."""

    def __init__(
        self, node: Node, seed: int, events: frozenset[Key], sdo_delay: Nanos = 0, sdo_waiting: int = 100
    ) -> None:
        self.node = node
        self.events = events
        """State objects: with an event timer, a change of these sends a TPDO at once."""
        self.sdo_delay = sdo_delay
        """Time in which it serves an SDO request, one after the other."""
        self.sdo_waiting = sdo_waiting
        """How many requests wait meanwhile; others are lost."""
        self._phase = (seed * 7919 + node.address * 31) % 1000
        self.restart()

    def restart(self) -> None:
        """Forget what was to be sent: the boot-up message is next."""
        self.booted = False
        self.tpdos = [Tpdo(index) for index in TPDOS]
        self._syncs = 0
        self._out: list[CanFrame] = []
        self._responses: list[tuple[Nanos, CanFrame]] = []
        """SDO responses, and when each is due."""
        self._period: Nanos = 0
        self._beat: Nanos | None = None
        """When the next heartbeat is due."""

    @property
    def addressed(self) -> bool:
        """Whether it has a node id; without one it answers LSS alone."""
        return self.node.lss is None or self.node.lss.addressed

    def loses(self, frame: Frame) -> bool:
        """True for a frame that the device cannot take now: before it has booted, or an SDO request while too
        many wait."""
        if len(self._responses) <= self.sdo_waiting:
            return not self.booted and self.addressed
        return isinstance(frame, CanFrame) and frame.id == services.sdo_rx_id(self.node.address)

    def note(self, t: Nanos, received: Received) -> None:
        """Take what a frame did to the node: respond, count SYNCs, boot."""
        if received.response is not None:
            begin = max([t, *(due for due, _ in self._responses)])
            frame = CanFrame(services.sdo_tx_id(self.node.address), received.response)
            self._responses.append((begin + self.sdo_delay, frame))
        if received.lss:
            self._out.append(CanFrame(SLAVE, received.lss))
        self._syncs += received.sync
        if received.command is NmtCommand.START and received.changed:
            self.tpdos = [Tpdo(index) for index in TPDOS]
        elif received.command is NmtCommand.RESET_COMMUNICATION:
            self.booted, self._beat = False, None

    def error(self, code: int, register: int) -> None:
        """Note an error (0: there is none any more) and send it as EMCY."""
        self.node.dictionary.log_error(code, register)
        if self.node.nmt is not NmtState.STOPPED:
            self._out.append(services.encode(services.Emcy(self.node.address, code, register)))

    def frames(self, now: Nanos, measure: Callable[[], None] | None = None) -> list[CanFrame]:
        """Return what is due; `measure` updates the measured objects, if TPDOs may need them."""
        frames, self._out = self._out, []
        if not self.addressed:
            return [frame for frame in frames if frame.id == SLAVE]
        if not self.booted:
            self.booted, self._period = True, 0
            boot = services.Heartbeat(self.node.address, NmtState.INITIALISING)
            frames.insert(0, services.encode(boot))
        frames += [frame for due, frame in self._responses if due <= now]
        self._responses = [each for each in self._responses if each[0] > now]
        syncs, self._syncs = self._syncs, 0
        dictionary, operational = self.node.dictionary, self.node.nmt is NmtState.OPERATIONAL
        timed = [tpdo for tpdo in self.tpdos if operational and tpdo.is_timed(dictionary)]
        if measure and operational and (syncs or timed):
            measure()
        for tpdo in self.tpdos if operational and syncs else timed:
            for sync in (*[True] * syncs, False):
                frames += tpdo.sample(now, dictionary, self.events, sync=sync)
        return frames + self._heartbeat(now)

    def _heartbeat(self, now: Nanos) -> list[CanFrame]:
        """Return the heartbeat, by the producer time of 1017; the seed shifts its phase."""
        period = self.node.dictionary.values[o.PRODUCER_HEARTBEAT] * MILLISECOND
        if self._period != period:
            self._period, self._beat = period, now + period * self._phase // 1000 if period else None
        if self._beat is None or now < self._beat:
            return []
        self._beat += self._period * (1 + (now - self._beat) // self._period)
        return [services.encode(services.Heartbeat(self.node.address, self.node.nmt))]

    def due(self) -> Nanos | None:
        """Return when there is next something to send, or the host's heartbeat is overdue."""
        node, dictionary = self.node, self.node.dictionary
        times = [due for due, _ in self._responses]
        times += [self._beat] if self._beat is not None else []
        if node.nmt is NmtState.OPERATIONAL:
            for tpdo in self.tpdos:
                if tpdo.sent is not None and tpdo.timer(dictionary) and tpdo.is_timed(dictionary):
                    times.append(tpdo.sent + tpdo.timer(dictionary))
        if node.heartbeat_timeout and node.host_beat is not None:
            times.append(node.host_beat + node.heartbeat_timeout + 1)
        return min(times, default=None)


class Listeners:
    """The nodes that one end speaks for, by the ids of the frames that each looks at: there may be 127."""

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._nodes = tuple(nodes)
        self._ids: list[tuple[int, ...]] = [()] * len(self._nodes)
        self._by_id: dict[int, list[int]] = {}
        self._stale = set(range(len(self._nodes)))
        """Nodes whose ids may have changed"""

    def of(self, frame: Frame) -> Sequence[int]:
        """Return the places of the nodes to which a frame may mean something; it is given to them next."""
        if not services.is_classic(frame):
            return ()
        for at in self._stale:
            self._index(at)
        self._stale = set()
        if frame.id in (services.NMT_ID, services.SYNC_ID, MASTER):
            self._stale = set(range(len(self._nodes))) if frame.id != services.SYNC_ID else set()
            return range(len(self._nodes))
        found = self._by_id.get(frame.id, ())
        if frame.id & ~services.NODE_MASK == services.SDO_RX_BASE:
            self._stale.update(found)
        return found

    def _index(self, at: int) -> None:
        for number in self._ids[at]:
            self._by_id[number].remove(at)
        node = self._nodes[at]
        values = node.dictionary.values
        beat = services.HEARTBEAT_BASE | values.get(o.CONSUMER_HEARTBEAT, 0) >> 16 & services.NODE_MASK
        ids = {services.sdo_rx_id(node.address), beat, *(values[one, o.COB_ID] & ~NO_RTR for one in RPDOS)}
        self._ids[at] = tuple(sorted(ids))
        for number in self._ids[at]:
            self._by_id.setdefault(number, []).append(at)
            self._by_id[number].sort()
