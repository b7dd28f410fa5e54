"""The host's end: what a drive is sent in each phase, and what its responses report.

Rules. Everything is an SDO transfer, one at a time, so that each is confirmed. All motors of a drive that are
in the robot file share one `Drive`: it is enabled only while all of them are commanded, and one that is at
Idle, or in fault, disarms all. Before it is enabled, its watchdog, mode and ramps are written and read back,
and the set-point is zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

from protocols import messages as msg
from protocols.canopen import sdo, services
from protocols.canopen.client import DOUBLED, Job, Outcome, Purpose, SdoClient
from protocols.canopen.mapping import Setup, Write
from protocols.canopen.objects import Key, from_bytes, to_bytes
from protocols.canopen.services import NODE_MASK, NmtState
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Feedback, Nanos, Request
from protocols.plugin import Device
from protocols.toolkit.host import Host, Report, Timing
from protocols.toolkit.motor_driver import NEVER, Adapter, MotorDriver, Pending, Rx
from protocols.zlac8015d import table as z
from protocols.zlac8015d.options import Options

ARMING, ANSWER, RETRY = 5000 * MILLISECOND, 2000 * MILLISECOND, 300 * MILLISECOND
EXPECTED = (services.SDO_TX_BASE, services.HEARTBEAT_BASE, services.EMCY_BASE)
"""Bases of the identifiers that a drive sends."""
MEASURED: Mapping[int, tuple[str, float]] = {
    z.POSITION: ("position", math.tau),
    z.VELOCITY: ("velocity", z.RPM / 10),
    z.CURRENT: ("current", 0.1),
    z.TEMPERATURE: ("temperature", 0.1),
}
"""The field of Feedback, and the unit, of an object; of positions: of all counts of a revolution."""


def _write(purpose: Purpose, key: Key, value: int) -> Job:
    return Job(purpose, key, to_bytes(z.OBJECTS[key].type, value))


class Drive:
    """One node, and what is wanted of it. Plain data."""

    def __init__(self, node: int, options: Options, sides: Sequence[int]) -> None:
        self.node, self.options, self.sides = node, options, sides
        self.client = SdoClient(options.sdo_timeout_ms * MILLISECOND)
        self.targets: dict[int, int] = {}
        """Steps of velocity, by side; of those that are commanded."""
        self.forget(0)

    def forget(self, now: Nanos) -> None:
        """Forget what it reported: it may have restarted."""
        self.states: dict[int, int] = {}
        """Power states, by side."""
        self.next = now
        """When it is read next."""
        self.client.forget(now)
        self._begin()

    def _begin(self) -> None:
        """Forget what was wanted, and what it was set up with."""
        options = self.options
        whole = {z.OFFLINE_TIME: options.timeout_ms, z.SYNCHRONOUS: 1, z.MODE: z.VELOCITY_MODE}
        ramps = {z.ACCELERATION: options.acceleration_ms, z.DECELERATION: options.deceleration_ms}
        sided = {(index, side): value for index, value in ramps.items() for side in self.sides}
        plan = [Write(key, value) for key, value in (whole | sided).items()]
        self.setup = Setup(z.OBJECTS, [*plan, Write(z.SET_POINT, 0, optional=True)])
        self.targets.clear()

    @property
    def failed(self) -> bool:
        """True if a motor is in fault."""
        return z.FAULT in self.states.values()

    # -- wanted -----------------------------------------------------------------------------------------

    def want(self, side: int, steps: int) -> bool:
        """Record a command to one motor. Returns whether all of them are commanded."""
        self.targets[side] = steps
        return self.targets.keys() >= set(self.sides)

    def arm(self) -> None:
        """Bring it one step nearer to being enabled."""
        job = self.setup.job()
        state = next((each for each in z.ARMING if each in self.states.values()), None)
        if self.client.has(Purpose.SETUP):
            return
        if job is not None:
            self.client.put(job)
        elif self.setup.done and state is not None:
            self.control(Purpose.SETUP, z.ARMING[state])

    def aim(self) -> None:
        """Write the set-point of an enabled drive. One that this host has not set up is disabled first."""
        goal = z.combine(self.targets.get(z.LEFT, 0), self.targets.get(z.RIGHT, 0))
        if not self.setup.done or z.QUICK_STOP in self.states.values():
            self.release()
        elif self.targets.keys() >= set(self.sides):
            self.client.drop(Purpose.SETPOINT)
            if not self.client.has(Purpose.SETPOINT):
                self.client.put(_write(Purpose.SETPOINT, z.SET_POINT, goal))

    def release(self) -> None:
        """Disable it."""
        self.client.drop(Purpose.SETUP, Purpose.SETPOINT)
        self.control(Purpose.URGENT, z.DISABLE)
        self._begin()

    def control(self, purpose: Purpose, *words: int) -> None:
        """Write controlwords, and read the state after them."""
        if not self.client.has(purpose):
            self.client.put(*(_write(purpose, z.CONTROL, word) for word in words), Job(purpose, z.STATUS))

    # -- sent and received ------------------------------------------------------------------------------

    def send(self, now: Nanos) -> Sequence[Frame]:
        """Return the request that is due, if any."""
        if now >= self.next and not self.client.has(Purpose.POLL):
            self.next = now + self.options.feedback_ms * MILLISECOND
            sided = [(index, side) for side in self.sides for index in MEASURED]
            self.client.put(*(Job(Purpose.POLL, key) for key in (z.STATUS, *sided)))
        request, outcome = self.client.poll(now)
        if outcome is not None:
            self.on_outcome(now, outcome)
        return () if request is None else (CanFrame(services.sdo_rx_id(self.node), sdo.encode(request)),)

    def due(self) -> Nanos:
        """Return when `send` next has something to do."""
        return min(self.client.due(), NEVER if self.client.has(Purpose.POLL) else self.next)

    def on_outcome(self, t: Nanos, outcome: Outcome) -> None:
        """Keep what a transfer brought."""
        if outcome.job == self.setup.job():
            self.setup.on_outcome(outcome)
        elif outcome.job.key == z.STATUS and len(outcome.value) in (2, 4):
            word = int.from_bytes(outcome.value * (4 // len(outcome.value)), "little")
            self.states = {side: z.state_of(z.part(word, side)) for side in self.sides}
            if self.failed and not self.client.has(Purpose.CHECK):
                self.client.put(Job(Purpose.CHECK, z.FAULT_CODE))
            if self.failed and self.targets:
                self.release()

    def report(self, t: Nanos, host: Host[tuple[Drive, int]], outcome: Outcome) -> dict[str, Any]:
        """Return what a transfer reports of one motor."""
        key, side = outcome.job.key, host.own[1]
        kind = z.OBJECTS[key].type
        value = from_bytes(kind, outcome.value)
        if key == z.STATUS and self.states:
            mode, name = z.STATES[z.FAULT if self.failed else self.states[side]]
            waits = "waits for the other motor" if 0 < len(self.targets) < len(self.sides) else ""
            detail = ", ".join(filter(None, (name, self.setup.failed, waits)))
            return {"mode": mode, "detail": detail, "faults": None if self.failed else ()}
        if key == z.FAULT_CODE and value is not None and self.failed:
            return {"faults": z.faults_of(value, side)}
        if key[0] in MEASURED and value is not None and kind.low < value < kind.high:
            name, unit = MEASURED[key[0]]
            unit /= self.options.counts if key[0] == z.POSITION else 1
            return {"feedback": Feedback(host.name, t, **{name: value * unit})}
        return {}


Motor: TypeAlias = tuple[Drive, int]
"""A drive, and one side of it."""


class ZlacAdapter(Adapter[Motor]):
    """What the drives of a bus are sent, and what they report."""

    name = "zlac8015d"
    faults = z.ALL_FAULTS
    not_armed, duplicate = z.NOT_ENABLED, z.DUPLICATE

    def __init__(self, devices: Sequence[Device]) -> None:
        sides: dict[int, list[int]] = {}
        for device in devices:
            sides.setdefault(device.address & NODE_MASK, []).append(z.side_of(device.address))
        options = {device.address & NODE_MASK: device.options for device in devices}
        self.drives = {node: Drive(node, options[node], held) for node, held in sides.items()}

    def own(self, device: Device) -> Motor:
        return self.drives[device.address & NODE_MASK], z.side_of(device.address)

    def timing(self, options: Options) -> Timing:
        return Timing(options.offline_ms * MILLISECOND, arming=ARMING)

    def forget(self, now: Nanos, host: Host[Motor]) -> None:
        host.own[0].forget(now)

    def resend(self, host: Host[Motor]) -> None:
        host.own[0].client.resend()

    # -- received ---------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        drive = self.drives.get(frame.id & NODE_MASK) if isinstance(frame, CanFrame) else None
        if drive is None or not isinstance(frame, CanFrame) or not services.is_classic(frame):
            return (Rx.IGNORED,)
        function, outcome = frame.id & ~NODE_MASK, None
        if function == services.SDO_TX_BASE:
            response = sdo.decode_response(frame.data)
            if response is None:
                return (Rx.MALFORMED,)
            outcome = drive.client.handle(t, response)
        elif function in EXPECTED:
            message = services.decode(frame)
            if message is None:
                return (Rx.MALFORMED,)
            if message == services.Heartbeat(drive.node, NmtState.INITIALISING):
                drive.forget(t)
        else:
            return (Rx.IGNORED,)
        return self._reports(t, drive, outcome, driver)

    def _reports(
        self, t: Nanos, drive: Drive, outcome: Outcome | None, driver: MotorDriver[Motor]
    ) -> list[Report[Motor]]:
        """Return a report of each motor that a transfer was about; without one, that they are there."""
        if outcome is not None:
            drive.on_outcome(t, outcome)
        twice = "every request is answered twice" if drive.client.doubled >= DOUBLED else ""
        sub = 0 if outcome is None else outcome.job.key[1]
        reports: list[Report[Motor]] = []
        for side in (sub,) if sub in drive.sides else drive.sides:
            host = driver.at[drive.node + z.RIGHT_OFFSET * (side == z.RIGHT)]
            about = {} if outcome is None else drive.report(t, host, outcome)
            reports.append(Report(host, host.address, duplicate=twice, counted=not reports, **about))
        return reports

    # -- sent -------------------------------------------------------------------------------------------

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        drive, side = host.own
        if drive.want(side, 0):
            drive.arm()
        else:
            host.wait(now)
        return ()

    def command(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        drive, side = host.own
        drive.want(side, round(getattr(command, "velocity", 0.0) / z.RPM * host.options.steps_per_rpm))
        drive.aim()
        return ()

    def release(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        host.own[0].release()
        return ()

    def poll(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        return host.own[0].send(now)

    def poll_due(self, host: Host[Motor]) -> Nanos:
        return host.own[0].due()

    # -- requests ---------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: Host[Motor] | None, driver: MotorDriver[Motor]
    ) -> Pending[Motor] | str:
        if host is None or not isinstance(request, msg.ClearFault):
            return "the drive cannot do that on this bus"
        return Pending(request, host.name, now, now + ANSWER, now, host, (), RETRY, sent=1)

    def frames(self, now: Nanos, pending: Pending[Motor]) -> Sequence[Frame]:
        if pending.host is not None:
            pending.host.own[0].control(Purpose.URGENT, z.DISABLE, z.RESET)
        return ()
