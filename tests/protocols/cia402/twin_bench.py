"""A twin on a simple shaft, and a host that sends it messages: the bench of the twin's tests.

Rules. Virtual time, one step a millisecond. The host has no driver: the test sends its messages.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from protocols.canopen import sdo
from protocols.canopen.pdo import Packing, encode_entry, mapping, packing
from protocols.canopen.services import (
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
from protocols.cia402 import objects as o
from protocols.cia402.objects import OBJECTS, Key, from_bytes, to_bytes
from protocols.cia402.options import Options
from protocols.cia402.profile import Mode, PowerState, state_of
from protocols.cia402.settings import Settings, units_of_settings
from protocols.cia402.twin import Cia402Twin
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Feedback, Nanos, seconds
from protocols.plugin import Device
from tests.protocols.cia402.transfer import Transfer

NODE = 5
HOST = 127
START: Nanos = 1_000_000 * MILLISECOND


def device(settings: Settings | None = None, address: int = NODE, name: str = "m") -> Device:
    """A device with default options."""
    return Device(name, address, Options(), settings or Settings())


class TwinBench:
    """One twin, its shaft and its host; velocities in increments per second, accelerations in those per s."""

    def __init__(self, settings: Settings | None = None, seed: int = 0, *, as_it_is: bool = False) -> None:
        self.settings = settings or Settings()
        if not as_it_is:
            self.settings = replace(self.settings, velocity_unit=0x00B5_0300, acceleration_unit=0)
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
        self.sent: list[CanFrame] = []
        """All frames of the twin."""
        self.beat_every: Nanos = 0
        """The host's heartbeat, if it has one."""
        self.run(2)

    # -- time ---------------------------------------------------------------------------------

    def run(self, steps: int, frames: Sequence[CanFrame] = ()) -> list[CanFrame]:
        """Advance by milliseconds; return the twin's frames. The given frames reach it in the first step."""
        received: list[CanFrame] = []
        for step in range(steps):
            self.now += MILLISECOND
            for frame in frames if step == 0 else ():
                self.twin.receive(self.now, frame)
            if self.beat_every and self.now % self.beat_every < MILLISECOND:
                self.twin.receive(self.now, CanFrame(heartbeat_id(HOST), b"\x05"))
            torques, sent = self.twin.step(self.now, (Feedback("m", self.now, self.position, self.velocity),))
            self.torque = sum(torque.torque for torque in torques)
            received += [frame for frame in sent if isinstance(frame, CanFrame)]
            self._turn(seconds(MILLISECOND))
        self.sent += received
        return received

    def _turn(self, dt: float) -> None:
        if self.locked:
            self.velocity = 0.0
            return
        pushed = self.velocity + (self.torque + self.load) / self.inertia * dt
        self.velocity = pushed / (1.0 + self.friction / self.inertia * dt)
        self.position += self.velocity * dt

    # -- sending ------------------------------------------------------------------------------

    def send(self, message: Message, steps: int = 1) -> list[CanFrame]:
        """Send a message of CANopen."""
        return self.run(steps, [encode(message)])

    def nmt(self, command: NmtCommand, node: int = NODE) -> list[CanFrame]:
        """Send an NMT command."""
        return self.send(Nmt(command, node))

    def sync(self, steps: int = 1) -> list[CanFrame]:
        """Send SYNC."""
        return self.send(Sync(), steps)

    def rpdo(self, number: int, pack: Packing, *values: int) -> list[CanFrame]:
        """Send an RPDO of the predefined connection set."""
        return self.run(1, [CanFrame(rpdo_id(number, NODE), pack.pack(values))])

    def request(self, request: sdo.Request) -> sdo.Response | None:
        """Send an SDO request; return its response."""
        for frame in self.run(1, [CanFrame(sdo_rx_id(NODE), sdo.encode(request))]):
            if frame.id == sdo_tx_id(NODE):
                return sdo.decode_response(frame.data)
        return None

    def transfer(self, transfer: Transfer) -> Transfer:
        """Run a whole SDO transfer."""
        request: sdo.Request | None = transfer.first()
        while request is not None:
            response = self.request(request)
            assert response is not None, f"no response to {request}"
            request = transfer.handle(response)
        return transfer

    def read(self, key: Key) -> int:
        """Read an object."""
        got = self.transfer(Transfer(*key))
        assert got.abort is None, sdo.abort_text(got.abort or 0)
        value = from_bytes(OBJECTS[key].type, got.value)
        assert value is not None
        return value

    def write(self, key: Key, value: int) -> int:
        """Write an object; return the abort code, or 0."""
        return self.transfer(Transfer(*key, to_bytes(OBJECTS[key].type, value))).abort or 0

    def put(self, key: Key, value: int) -> None:
        """Write an object that must be accepted."""
        code = self.write(key, value)
        assert not code, f"{o.title(key)} = {value}: {sdo.abort_text(code)}"

    def map_pdo(self, index: int, cob: int, transmission: int, *keys: Key, timer: int = 0) -> Packing:
        """Configure a PDO, in the order that CiA 301 demands."""
        self.put((index, o.COB_ID), cob | 1 << 31)
        self.put((index, o.TRANSMISSION), transmission)
        self.put((index, o.EVENT_TIMER), timer)
        self.put((index + 0x200, 0), 0)
        for sub, entry in enumerate(mapping(OBJECTS, *keys), 1):
            self.put((index + 0x200, sub), encode_entry(entry))
        self.put((index + 0x200, 0), len(keys))
        self.put((index, o.COB_ID), cob)
        return packing(OBJECTS, mapping(OBJECTS, *keys))

    # -- the profile --------------------------------------------------------------------------

    def control(self, controlword: int, steps: int = 1) -> PowerState | None:
        """Write the controlword; return the state after some steps."""
        self.put(o.CONTROLWORD, controlword)
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
        """Arm: OPERATION ENABLED at the present position."""
        self.put(o.MODE, mode)
        self.put(o.TARGET_POSITION, self.read(o.POSITION))
        for control in (0x06, 0x07, 0x0F):
            self.control(control)
        assert self.state is PowerState.OPERATION_ENABLED

    # -- what the twin has sent -----------------------------------------------------------------

    def emergencies(self) -> list[int]:
        """Return the error codes of all EMCY."""
        return [m.code for frame in self.sent if isinstance(m := decode(frame), Emcy)]

    def beats(self) -> list[int]:
        """Return the NMT states of all heartbeats."""
        return [m.state for frame in self.sent if isinstance(m := decode(frame), Heartbeat)]

    def tpdo(self, number: int, frames: Sequence[CanFrame]) -> list[bytes]:
        """Return the data of a TPDO among frames."""
        return [frame.data for frame in frames if frame.id == tpdo_id(number, NODE)]

    def increments(self) -> float:
        """Return the true position in position units."""
        return self.position * self.units.per_turn / math.tau
