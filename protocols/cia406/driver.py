"""The host's end: it reads, by SDO, and writes nothing.

Rules. How many units a turn has is read when the encoder appears, and again from time to time; until that is
known, and where it is not what the robot file states, there is no reading. Nor is there while the encoder
has the alarm that its position is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

from protocols.bounds import Bounds, check
from protocols.canopen import sdo, services
from protocols.canopen.client import DOUBLED, Job, Outcome, Purpose, SdoClient
from protocols.canopen.objects import DEVICE_TYPE, Key, from_bytes
from protocols.canopen.services import NODE_MASK, NmtState, sdo_rx_id
from protocols.cia406 import table as enc
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, SECOND, Command, Mode, Nanos, ShaftReading
from protocols.plugin import Device
from protocols.toolkit.host import Host, Report
from protocols.toolkit.motor_driver import Adapter, MotorDriver, Rx

EXPECTED = (services.SDO_TX_BASE, services.HEARTBEAT_BASE, services.EMCY_BASE)
"""Bases of the identifiers that are understood."""
ALARMS: Nanos = 200 * MILLISECOND
"""Period in which its alarms are read,"""
AGAIN: Nanos = 5 * SECOND
"""and what it is;"""
SOON: Nanos = 500 * MILLISECOND
"""as long as that is not known."""


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    units: Annotated[int, Bounds(2, 2**30)] = 4096
    """Per turn: another number than the encoder's own is said, and then nothing is read"""
    turns: Annotated[int, Bounds(1, 65_536)] = 4096
    """After which its position begins anew; 1: a single-turn encoder"""
    feedback_ms: Annotated[float, Bounds(1.0, 10_000.0)] = 10.0
    """Period of the position"""
    sdo_timeout_ms: Annotated[float, Bounds(1.0, 5000.0)] = 50.0
    """Time after which a request without an answer is repeated"""
    offline_ms: Annotated[float, Bounds(20.0, 60_000.0)] = 500.0
    """Time without an answer after which it is offline"""

    def __post_init__(self) -> None:
        check(self)


@dataclass(slots=True)
class Encoder:
    """What is known of one encoder. Plain data."""

    client: SdoClient
    known: dict[Key, int] = field(default_factory=dict)
    next: Nanos = 0
    """When its position is read next,"""
    alarms_at: Nanos = 0
    again_at: Nanos = 0

    def forget(self) -> None:
        """Forget what it told: it may have restarted, or be another one."""
        self.known.clear()
        self.next = self.alarms_at = self.again_at = 0

    @property
    def units(self) -> int:
        """Of a turn, as it tells; 0: it is not known yet"""
        if not all(key in self.known for key in enc.ONCE):
            return 0
        return self.known[enc.UNITS if self.known[enc.PARAMETERS] & enc.SCALED else enc.PHYSICAL]

    @property
    def failed(self) -> bool:
        """True if it has the alarm that its position is wrong."""
        return bool(self.known.get(enc.ALARMS, 0) & enc.POSITION_ERROR)

    def wrong(self, options: Options) -> str:
        """Return why its positions mean nothing here; "" if they do."""
        if not (units := self.units):
            return "is asked what it is"
        if self.known[DEVICE_TYPE] & 0xFFFF != enc.PROFILE:
            return f"is no encoder by CiA 406: its device type is {self.known[DEVICE_TYPE]:#x}"
        if units != options.units:
            return f"has {units} units per turn, and the robot file says {options.units}: it is not read"
        return ""

    def ask(self, now: Nanos, options: Options) -> sdo.Request | None:
        """Return the request that is due."""
        if now >= self.again_at:
            self.again_at = now + (AGAIN if self.units else SOON)
            self.client.drop(Purpose.STARTUP)
            self.client.put(*(Job(Purpose.STARTUP, key) for key in enc.ONCE))
        if self.units and now >= self.alarms_at:
            self.alarms_at = now + ALARMS
            self.client.put(Job(Purpose.CHECK, enc.ALARMS))
        if self.units and now >= self.next and not self.client.has(Purpose.POLL):
            self.next = now + round(options.feedback_ms * MILLISECOND)
            self.client.put(Job(Purpose.POLL, enc.POSITION))
        request, outcome = self.client.poll(now)
        if outcome is not None:
            self.learn(outcome)
        return request

    def learn(self, outcome: Outcome) -> int | None:
        """Keep what was read; return a position that is one. What an encoder does not have is 0."""
        key = outcome.job.key
        value = from_bytes(enc.OBJECTS[key].type, outcome.value)
        if outcome.abort is not None:
            value = None if outcome.abort == sdo.TIMEOUT or key == enc.POSITION else 0
        if value is not None:
            self.known[key] = value
        return value if key == enc.POSITION else None

    def due(self) -> Nanos:
        """Return when `ask` next has something to do."""
        return min(self.client.due(), self.again_at, *((self.next, self.alarms_at) if self.units else ()))


class EncoderAdapter(Adapter[Encoder]):
    """What encoders are asked, and what they report."""

    name, faults = enc.NAME, enc.FAULTS

    def own(self, device: Device) -> Encoder:
        return Encoder(SdoClient(round(device.options.sdo_timeout_ms * MILLISECOND)))

    def forget(self, now: Nanos, host: Host[Encoder]) -> None:
        host.own.client.forget(now)
        host.own.forget()

    def resend(self, host: Host[Encoder]) -> None:
        host.own.client.resend()

    def refuse(self, host: Host[Encoder], command: Command) -> str:
        return "a sensor takes no commands"

    def release(self, now: Nanos, host: Host[Encoder]) -> Sequence[Frame]:
        return ()

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Encoder]) -> Sequence[Report[Encoder] | Rx]:
        if not services.is_classic(frame) or (host := driver.at.get(frame.id & NODE_MASK)) is None:
            return (Rx.IGNORED,)
        own, function = host.own, frame.id & ~NODE_MASK
        if function not in EXPECTED:
            return (Rx.IGNORED,)
        position: int | None = None
        if function == services.SDO_TX_BASE:
            response = sdo.decode_response(frame.data)
            if response is None:
                return (Rx.MALFORMED,)
            outcome = own.client.handle(t, response)
            position = None if outcome is None else own.learn(outcome)
        elif (message := services.decode(frame)) is None:
            return (Rx.MALFORMED,)
        elif message == services.Heartbeat(host.address, NmtState.INITIALISING):
            own.forget()
            own.client.resend()  # what was sent before is lost
        return (self._report(t, host, position),)

    def _report(self, t: Nanos, host: Host[Encoder], position: int | None) -> Report[Encoder]:
        own, options = host.own, host.options
        wrong, failed = own.wrong(options), own.failed
        twice = "every request is answered twice" if own.client.doubled >= DOUBLED else ""
        angle = None if position is None or wrong or failed else position * math.tau / own.units
        return Report(
            host,
            host.address,
            Mode.FAULT if failed else Mode.READY,
            wrong or f"alarms {own.known.get(enc.ALARMS, 0):#06x}" * failed or "reads",
            (enc.POSITION_ERROR,) if failed else (),
            duplicate=twice,
            events=() if angle is None else (ShaftReading(host.name, t, angle),),
        )

    def poll(self, now: Nanos, host: Host[Encoder]) -> Sequence[Frame]:
        request = host.own.ask(now, host.options)
        return () if request is None else (CanFrame(sdo_rx_id(host.address), sdo.encode(request)),)

    def poll_due(self, host: Host[Encoder]) -> Nanos:
        return host.own.due()

    def awaits(self, host: Host[Encoder]) -> bool:
        return host.own.client.awaits()
