"""The host's end: what a drive is sent in each phase, and what it reports.

Rules. Until it is commanded, a drive is only read, by SDO. Then its watchdog, mode, ramps and PDOs are
written and read back, and it is started: from then on the set-point of both motors is one RPDO; each motor's
position and velocity, and state and fault code of both, are TPDOs. Controlwords are written by SDO, so that
each is confirmed. All motors of a drive that are in the robot file share one `Drive`: it is enabled only
while all of them are commanded, with a set-point of zero; one at Idle, or in fault, disarms all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

from protocols import messages as msg
from protocols.canopen import objects as o
from protocols.canopen import pdo, sdo, services
from protocols.canopen.client import DOUBLED, Job, Outcome, Purpose, SdoClient
from protocols.canopen.mapping import Setup, Write
from protocols.canopen.objects import Key, from_bytes, to_bytes
from protocols.canopen.services import NODE_MASK, Nmt, NmtCommand, NmtState, rpdo_id, sdo_rx_id, tpdo_id
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Event, Feedback, Nanos, Request
from protocols.plugin import Device
from protocols.toolkit.host import Host, Report
from protocols.toolkit.motor_driver import NEVER, Adapter, MotorDriver, Pending, Rx
from protocols.zlac8015d import table as z
from protocols.zlac8015d.options import Options

ARMING, ANSWER, RETRY = 15_000 * MILLISECOND, 2000 * MILLISECOND, 300 * MILLISECOND
START: Nanos = 50 * MILLISECOND
"""Period in which a node is started that sends no TPDO."""
STARTS = 10
"""NMT starts without TPDOs after which it is set up anew."""
CHECK: Nanos = 1000 * MILLISECOND
"""Period in which the COB-ID of the RPDO is read back."""
MISSED = 10
"""Periods without a TPDO after which it is read by SDO again."""
TPDOS: Mapping[int, pdo.Packing] = {
    **{n: pdo.packing(z.OBJECTS, pdo.mapping(z.OBJECTS, *z.motion(n))) for n in z.SIDES},
    z.BOTH: pdo.packing(z.OBJECTS, pdo.mapping(z.OBJECTS, z.STATUS, z.FAULT_CODE)),
}
"""By number: each motor's motion, and what both share."""
KEYS = {number: [entry.key for entry in packing.entries] for number, packing in TPDOS.items()}
NUMBERS = {tpdo_id(number, 0): number for number in TPDOS}
RPDO = 2
RPDO_COB_ID = (o.RPDO_COMMUNICATION + RPDO - 1, o.COB_ID)
EXPECTED = (services.SDO_TX_BASE, services.HEARTBEAT_BASE, services.EMCY_BASE, *NUMBERS)
"""Bases of the identifiers that a drive sends."""
Motor: TypeAlias = "tuple[Drive, int]"
"""A drive, and one side of it."""


def _write(purpose: Purpose, key: Key, value: int) -> Job:
    return Job(purpose, key, to_bytes(z.OBJECTS[key].type, value))


def _pdo(communication: int, cob: int, entries: Sequence[pdo.Entry], timer: int = 0) -> list[Write]:
    """Return what configures a PDO. That a mapped PDO is disabled meanwhile is CiA 301's, and not every
    drive's, demand."""
    mapped = communication + o.MAPPING_OFFSET
    return [
        Write((communication, o.COB_ID), cob | pdo.DISABLED, optional=True),
        Write((mapped, 0), 0),
        *(Write((mapped, n), pdo.encode_entry(entry)) for n, entry in enumerate(entries, 1)),
        Write((communication, o.TRANSMISSION), pdo.EVENT),
        *([Write((communication, o.EVENT_TIMER), timer)] if timer else []),
        Write((mapped, 0), len(entries)),
        Write((communication, o.COB_ID), cob, optional=True),
    ]


class Drive:
    """One node, and what is wanted of it. Plain data."""

    def __init__(self, node: int, options: Options, sides: Sequence[int]) -> None:
        self.node, self.options, self.sides = node, options, sides
        self.period = options.feedback_ms * MILLISECOND
        self.client = SdoClient(options.sdo_timeout_ms * MILLISECOND)
        self.targets: dict[int, int] = {}
        """Steps of velocity, by side; of those that are commanded."""
        self.forget(0)

    def forget(self, now: Nanos) -> None:
        """Forget what it reported: it may have restarted."""
        self.states: dict[int, int] = {}
        """Power states, by side."""
        self.code = 0
        """Object 603F."""
        self.received: dict[int, Nanos] = {}
        """When each TPDO came."""
        self.next = self.start_at = now
        """When it is read, and started, next."""
        self.client.forget(now)
        self.targets.clear()
        self._begin()

    def _begin(self) -> None:
        """Begin to set it up."""
        self.stopped = False
        """It was made pre-operational for that."""
        self.starts = 0
        """NMT starts since then."""
        self.check_at: Nanos = 0
        """When the COB-ID of its RPDO is read back next."""
        self.setup = Setup(z.OBJECTS, self._plan())

    def _plan(self) -> list[Write]:
        options, node = self.options, self.node
        ramps = {z.ACCELERATION: options.acceleration_ms, z.DECELERATION: options.deceleration_ms}
        whole = {z.OFFLINE_TIME: options.timeout_ms, z.SYNCHRONOUS: 1, z.MODE: z.VELOCITY_MODE}
        plan = [Write(key, value) for key, value in whole.items()]
        plan += [Write((index, side), value) for index, value in ramps.items() for side in self.sides]
        set_point = pdo.mapping(z.OBJECTS, z.SET_POINT)
        plan += _pdo(RPDO_COB_ID[0], rpdo_id(RPDO, node), set_point)
        timer = options.feedback_ms * MILLISECOND // z.TIMER_UNIT
        for number in (*self.sides, z.BOTH):
            entries = TPDOS[number].entries
            plan += _pdo(o.TPDO_COMMUNICATION + number - 1, tpdo_id(number, node), entries, timer)
        return plan

    def flows(self, now: Nanos) -> bool:
        """True if its TPDOs come: it is operational."""
        oldest = min(self.received.get(number, -NEVER) for number in (*self.sides, z.BOTH))
        return now - oldest < MISSED * self.period

    # -- wanted -----------------------------------------------------------------------------------------

    def want(self, side: int, steps: int) -> bool:
        """Record a command to one motor. Returns whether all of them are commanded."""
        self.targets[side] = steps
        return self.targets.keys() >= set(self.sides)

    def arm(self, now: Nanos) -> Sequence[Frame]:
        """Bring it one step nearer to being enabled."""
        if not self.stopped:
            self.stopped = True
            return (services.encode(Nmt(NmtCommand.ENTER_PRE_OPERATIONAL, self.node)),)
        job = self.setup.job()
        state = next((each for each in z.ARMING if each in self.states.values()), None)
        if self.client.has(Purpose.SETUP):
            return ()
        if job is not None:
            self.client.put(job)
        elif self.setup.done and not self.flows(now):
            if now >= self.start_at:
                self.start_at, self.starts = now + START, self.starts + 1
                if self.starts > STARTS:
                    self._begin()  # a late copy of a write may have disabled its TPDOs
                return (services.encode(Nmt(NmtCommand.START, self.node)),)
        elif self.setup.done and state is not None:
            self.client.put(_write(Purpose.SETUP, z.SET_POINT, 0))
            self.control(Purpose.SETUP, z.ARMING[state])
        return ()

    def aim(self, now: Nanos) -> Sequence[Frame]:
        """Return the set-point of an enabled drive. One that this host has not set up, or that is not known
        to receive RPDOs, is disabled first."""
        if not (self.setup.done and self.flows(now)) or z.QUICK_STOP in self.states.values():
            self.release()
        if not self.targets.keys() >= set(self.sides):
            return ()
        goal = z.combine(self.targets.get(z.LEFT, 0), self.targets.get(z.RIGHT, 0))
        return (CanFrame(rpdo_id(RPDO, self.node), goal.to_bytes(4, "little")),)

    def release(self) -> None:
        """Disable it."""
        self.targets.clear()
        self.client.drop(Purpose.SETUP)
        self.control(Purpose.URGENT, z.DISABLE)

    def control(self, purpose: Purpose, *words: int) -> None:
        """Write controlwords, and read the state after them. A set-up that failed is begun anew by Idle."""
        if purpose is Purpose.URGENT and self.setup.failed:
            self._begin()
        if purpose is Purpose.SETUP or not self.client.has(purpose):
            self.client.put(*(_write(purpose, z.CONTROL, word) for word in words), Job(purpose, z.STATUS))

    # -- sent and received ------------------------------------------------------------------------------

    def send(self, now: Nanos) -> Sequence[Frame]:
        """Return the request that is due, if any."""
        if now >= self.next and not self.client.has(Purpose.POLL):
            flows = self.flows(now)
            self.next = now + self.period * (MISSED if flows else 1)
            motion = [key for side in self.sides for key in z.motion(side)]
            if not flows:
                self.client.put(*(Job(Purpose.POLL, key) for key in (z.FAULT_CODE, z.STATUS, *motion)))
        if self.setup.done and now >= self.check_at:
            self.check_at = now + CHECK
            self.client.put(Job(Purpose.CHECK, RPDO_COB_ID))
        request, outcome = self.client.poll(now)
        if outcome is not None:
            self.on_outcome(outcome)
        return () if request is None else (CanFrame(sdo_rx_id(self.node), sdo.encode(request)),)

    def due(self) -> Nanos:
        """Return when `send` next has something to do."""
        return min(self.client.due(), NEVER if self.client.has(Purpose.POLL) else self.next)

    def on_outcome(self, outcome: Outcome) -> dict[Key, int]:
        """Keep what a transfer brought; return the values that were read."""
        key, data = outcome.job.key, outcome.value
        if outcome.job == self.setup.job():
            self.setup.on_outcome(outcome)
            return {}
        if key == RPDO_COB_ID:
            if self.setup.done and int.from_bytes(data, "little") & pdo.DISABLED:
                self.release()  # a late copy of a write has disabled it: set-points do not arrive
                self._begin()
            return {}
        if key == z.STATUS and len(data) == 2:
            data *= 2  # both motors have the same
        value = from_bytes(z.OBJECTS[key].type, data)
        return {} if value is None else self.on_values({key: value})

    def on_values(self, values: dict[Key, int], t: Nanos = 0, tpdo: int = 0) -> dict[Key, int]:
        """Keep values of its objects, and when a TPDO brought them."""
        self.received[tpdo] = t
        self.code = values.get(z.FAULT_CODE, self.code)
        if z.STATUS in values:
            self.states = {side: z.state_of(z.part(values[z.STATUS], side)) for side in self.sides}
            if z.FAULT in self.states.values() and self.targets:
                self.release()
        return values

    def report(self, t: Nanos, host: Host[Motor], values: Mapping[Key, int]) -> dict[str, Any]:
        """Return what values report of one motor."""
        known: dict[str, Any] = {}
        side = host.own[1]
        if z.STATUS in values:
            failed = z.FAULT in self.states.values()
            mode, name = z.STATES[z.FAULT if failed else self.states[side]]
            waits = "waits for the other motor" if 0 < len(self.targets) < len(self.sides) else ""
            detail = ", ".join(filter(None, (name, self.setup.failed, waits)))
            faults = z.faults_of(self.code, side) if self.code else None
            known = {"mode": mode, "detail": detail, "faults": faults if failed else ()}
        position, velocity = values.get((z.POSITION, side)), values.get((z.VELOCITY, side))
        if position is not None or velocity is not None:
            inside = position is not None and o.Type.I32.low < position < o.Type.I32.high
            at = (position or 0) * math.tau / self.options.counts if inside else None
            speed = None if velocity is None else velocity * z.RPM / 10
            known["feedback"] = Feedback(host.name, t, at, speed)
        return known


def set_up(node: int, options: Options) -> dict[str, tuple[float, ...]]:
    """Return what is written to a drive, as `Spec.set_up` has it."""
    plan = [(write.key, write.value) for write in Drive(node, options, z.SIDES).setup.plan]
    words = [(z.CONTROL, word) for word in (z.SHUTDOWN, z.SWITCH_ON)]
    return o.declared((*plan, *words)) | {
        services.NMT_STATE: (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)
    }


class ZlacAdapter(Adapter[Motor]):
    """What the drives of a bus are sent, and what they report."""

    name = "zlac8015d"
    faults = z.ALL_FAULTS
    not_armed, duplicate, arming = z.NOT_ENABLED, z.DUPLICATE, ARMING

    def __init__(self, devices: Sequence[Device]) -> None:
        sides: dict[int, list[int]] = {}
        for device in devices:
            sides.setdefault(device.address & NODE_MASK, []).append(z.side_of(device.address))
        options = {device.address & NODE_MASK: device.options for device in devices}
        self.drives = {node: Drive(node, options[node], held) for node, held in sides.items()}
        self._aiming: dict[int, Drive] = {}
        """Those that are given a set-point in this step."""

    def own(self, device: Device) -> Motor:
        return self.drives[device.address & NODE_MASK], z.side_of(device.address)

    def forget(self, now: Nanos, host: Host[Motor]) -> None:
        host.own[0].forget(now)

    def resend(self, host: Host[Motor]) -> None:
        host.own[0].client.resend()

    # -- received ---------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        if not services.is_classic(frame) or frame.id & NODE_MASK not in self.drives:
            return (Rx.IGNORED,)
        drive = self.drives[frame.id & NODE_MASK]
        values: dict[Key, int] = {}
        function, outcome = frame.id & ~NODE_MASK, None
        if function in NUMBERS:
            number = NUMBERS[function]
            found = TPDOS[number].unpack(frame.data)
            if found is None:
                return (Rx.MALFORMED,)
            values = drive.on_values(dict(zip(KEYS[number], found, strict=True)), t, number)
        elif function == services.SDO_TX_BASE:
            response = sdo.decode_response(frame.data)
            if response is None:
                return (Rx.MALFORMED,)
            outcome = drive.client.handle(t, response)
            values = {} if outcome is None else drive.on_outcome(outcome)
        elif function in EXPECTED:
            message = services.decode(frame)
            if message is None:
                return (Rx.MALFORMED,)
            if message == services.Heartbeat(drive.node, NmtState.INITIALISING):
                drive.forget(t)
        else:
            return (Rx.IGNORED,)
        return self._reports(t, drive, values, driver, outcome)

    def _reports(
        self,
        t: Nanos,
        drive: Drive,
        values: Mapping[Key, int],
        driver: MotorDriver[Motor],
        outcome: Outcome | None,
    ) -> list[Report[Motor]]:
        """Return a report of each motor that values are about; without any, that they are there."""
        twice = "every request is answered twice" if drive.client.doubled >= DOUBLED else ""
        sub = next(iter(values), (0, 0))[1]
        reports: list[Report[Motor]] = []
        for side in (sub,) if sub in drive.sides else drive.sides:
            host = driver.at[drive.node + z.RIGHT_OFFSET * (side == z.RIGHT)]
            about = drive.report(t, host, values)
            reports.append(
                Report(
                    host, host.address, duplicate=twice, messages=int(not reports), content=outcome, **about
                )
            )
        return reports

    # -- sent -------------------------------------------------------------------------------------------

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        drive, side = host.own
        if drive.want(side, 0):
            return drive.arm(now)
        host.wait(now)
        return ()

    def command(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        drive, side = host.own
        drive.want(side, round(getattr(command, "velocity", 0.0) / z.RPM * host.options.steps_per_rpm))
        self._aiming[drive.node] = drive
        return ()

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        # One frame has both motors: it is made once it is known what becomes of each in this step.
        aiming, self._aiming = self._aiming, {}
        return [frame for drive in aiming.values() for frame in drive.aim(now)]

    def release(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        host.own[0].release()
        return ()

    def poll(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        return host.own[0].send(now)

    def poll_due(self, host: Host[Motor]) -> Nanos:
        return host.own[0].due()

    def awaits(self, host: Host[Motor]) -> bool:
        return host.own[0].client.awaits()

    # -- requests ---------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: Host[Motor] | None, driver: MotorDriver[Motor]
    ) -> Pending[Motor] | str:
        if host is None or not isinstance(request, msg.ClearFault | msg.ReadParameter):
            return "the drive cannot do that on this bus"
        job = None
        if isinstance(request, msg.ReadParameter):
            key = z.OBJECTS.find(request.parameter)
            if key is None or key not in z.OBJECTS or z.OBJECTS[key].type is o.Type.TEXT:
                return f"{request.parameter!r} is no object with a number that is known here"
            job = Job(Purpose.REQUEST, key, token=now)
            host.own[0].client.put(job)
        return Pending(request, host.name, now, now + ANSWER, now, host, (), RETRY, {"job": job}, sent=1)

    def frames(self, now: Nanos, pending: Pending[Motor]) -> Sequence[Frame]:
        if pending.host is not None and isinstance(pending.request, msg.ClearFault):
            pending.host.own[0].control(Purpose.URGENT, z.DISABLE, z.RESET)
        return ()

    def answer(self, t: Nanos, pending: Pending[Motor], report: Report[Motor]) -> Event | None:
        request, outcome = pending.request, report.content
        if not isinstance(request, msg.ReadParameter):
            return super().answer(t, pending, report)
        if not isinstance(outcome, Outcome) or outcome.job != pending.notes["job"]:
            return None
        value = from_bytes(z.OBJECTS[outcome.job.key].type, outcome.value)
        if outcome.abort is not None or value is None:
            return pending.refuse(t, sdo.abort_text(outcome.abort or sdo.LENGTH_MISMATCH))
        return msg.Parameter(pending.name, t, request.parameter, float(value))
