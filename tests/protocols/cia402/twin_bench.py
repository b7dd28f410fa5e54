"""A twin on a simple shaft, and a host that speaks to it in messages: what the tests of the drive play with.

Rules. Virtual time, one step a millisecond. The host has no driver in it: what it says is said by the test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from protocols.cia402 import objects as o
from protocols.cia402 import sdo
from protocols.cia402.codec import (
    Emcy,
    Heartbeat,
    Message,
    Nmt,
    NmtCommand,
    Sync,
    decode,
    encode,
    heartbeat_id,
    rpdo_id,
    sdo_rx_id,
    sdo_tx_id,
    tpdo_id,
)
from protocols.cia402.objects import OBJECTS, Key, from_bytes, to_bytes
from protocols.cia402.options import Options, Settings, units_of_settings
from protocols.cia402.pdo import Packing, encode_entry, mapping, packing
from protocols.cia402.profile import Mode, PowerState, state_of
from protocols.cia402.transfer import Transfer
from protocols.cia402.twin import Cia402Twin
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Feedback, Nanos, seconds
from protocols.plugin import Device

NODE = 5
HOST = 127
START: Nanos = 1_000_000 * MILLISECOND


def device(settings: Settings | None = None, address: int = NODE, name: str = "m") -> Device:
    """A device with default options."""
    return Device(name, address, Options(), settings or Settings())


class TwinBench:
    """One twin, its shaft and its host."""

    def __init__(self, settings: Settings | None = None, seed: int = 0) -> None:
        self.settings = settings or Settings()
        self.units = units_of_settings(self.settings)
        self.twin = Cia402Twin(device(self.settings), seed)
        self.now = START
        self.position = 0.0
        self.velocity = 0.0
        self.inertia = 2e-3
        self.friction = 1e-3
        self.load = 0.0
        """N·m from outside."""
        self.locked = False
        self.torque = 0.0
        self.said: list[CanFrame] = []
        """Everything that the twin has said."""
        self.beat_every: Nanos = 0
        """The host's heartbeat, if it has one."""
        self.run(2)

    # -- time ---------------------------------------------------------------------------------

    def run(self, steps: int, frames: Sequence[CanFrame] = ()) -> list[CanFrame]:
        """Steps of a millisecond; what the twin said in them. The wires reach it in the first one."""
        received: list[CanFrame] = []
        for step in range(steps):
            self.now += MILLISECOND
            for frame in frames if step == 0 else ():
                self.twin.receive(self.now, frame)
            if self.beat_every and self.now % self.beat_every < MILLISECOND:
                self.twin.receive(self.now, CanFrame(heartbeat_id(HOST), b"\x05"))
            torques, said = self.twin.step(self.now, (Feedback("m", self.now, self.position, self.velocity),))
            self.torque = sum(torque.torque for torque in torques)
            received += [frame for frame in said if isinstance(frame, CanFrame)]
            self._turn(seconds(MILLISECOND))
        self.said += received
        return received

    def _turn(self, dt: float) -> None:
        if self.locked:
            self.velocity = 0.0
            return
        pushed = self.velocity + (self.torque + self.load) / self.inertia * dt
        self.velocity = pushed / (1.0 + self.friction / self.inertia * dt)
        self.position += self.velocity * dt

    # -- saying -------------------------------------------------------------------------------

    def say(self, message: Message, steps: int = 1) -> list[CanFrame]:
        """Say a message of CANopen."""
        return self.run(steps, [encode(message)])

    def nmt(self, command: NmtCommand, node: int = NODE) -> list[CanFrame]:
        """An NMT command."""
        return self.say(Nmt(command, node))

    def sync(self, steps: int = 1) -> list[CanFrame]:
        """A SYNC."""
        return self.say(Sync(), steps)

    def rpdo(self, number: int, pack: Packing, *values: int) -> list[CanFrame]:
        """An RPDO of the predefined connection set."""
        return self.run(1, [CanFrame(rpdo_id(number, NODE), pack.pack(values))])

    def ask(self, request: sdo.Request) -> sdo.Response | None:
        """An SDO request, and its answer."""
        for frame in self.run(1, [CanFrame(sdo_rx_id(NODE), sdo.encode(request))]):
            if frame.id == sdo_tx_id(NODE):
                return sdo.decode_response(frame.data)
        return None

    def transfer(self, transfer: Transfer) -> Transfer:
        """A whole SDO transfer."""
        request: sdo.Request | None = transfer.first()
        while request is not None:
            answer = self.ask(request)
            assert answer is not None, f"no answer to {request}"
            request = transfer.handle(answer)
        return transfer

    def read(self, key: Key) -> int:
        """An object's value."""
        got = self.transfer(Transfer(*key))
        assert got.abort is None, sdo.abort_text(got.abort or 0)
        value = from_bytes(OBJECTS[key].type, got.value)
        assert value is not None
        return value

    def write(self, key: Key, value: int) -> int:
        """Write an object; the abort code, or 0."""
        return self.transfer(Transfer(*key, to_bytes(OBJECTS[key].type, value))).abort or 0

    def put(self, key: Key, value: int) -> None:
        """Write an object that must be taken."""
        code = self.write(key, value)
        assert not code, f"{o.title(key)} = {value}: {sdo.abort_text(code)}"

    def map_pdo(self, index: int, cob: int, transmission: int, *keys: Key, timer: int = 0) -> Packing:
        """Configure a PDO, in the order that CiA 301 demands."""
        self.put((index, o.COB_ID), cob | 1 << 31)
        self.put((index, o.TRANSMISSION), transmission)
        self.put((index, o.EVENT_TIMER), timer)
        self.put((index + 0x200, 0), 0)
        for sub, entry in enumerate(mapping(*keys), 1):
            self.put((index + 0x200, sub), encode_entry(entry))
        self.put((index + 0x200, 0), len(keys))
        self.put((index, o.COB_ID), cob)
        return packing(mapping(*keys))

    # -- the profile --------------------------------------------------------------------------

    def control(self, word: int, steps: int = 1) -> PowerState | None:
        """Write the controlword; the state after some steps."""
        self.put(o.CONTROLWORD, word)
        self.run(steps)
        return self.state

    @property
    def status(self) -> int:
        """The statusword."""
        return self.read(o.STATUSWORD)

    @property
    def state(self) -> PowerState | None:
        """The state of the power drive system."""
        return state_of(self.status)

    def enable(self, mode: Mode) -> None:
        """Into OPERATION ENABLED, where the shaft stands."""
        self.put(o.MODE, mode)
        self.put(o.TARGET_POSITION, self.read(o.POSITION))
        for word in (0x06, 0x07, 0x0F):
            self.control(word)
        assert self.state is PowerState.OPERATION_ENABLED

    # -- what was said --------------------------------------------------------------------------

    def emergencies(self) -> list[int]:
        """The error codes of all EMCY so far."""
        return [m.code for frame in self.said if isinstance(m := decode(frame), Emcy)]

    def beats(self) -> list[int]:
        """The NMT states of all heartbeats so far."""
        return [m.state for frame in self.said if isinstance(m := decode(frame), Heartbeat)]

    def tpdo(self, number: int, frames: Sequence[CanFrame]) -> list[bytes]:
        """The data of a TPDO among frames."""
        return [frame.data for frame in frames if frame.id == tpdo_id(number, NODE)]

    def increments(self) -> float:
        """The true position, in position units."""
        return self.position * self.units.per_turn / math.tau
