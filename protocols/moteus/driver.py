"""The host's end: what a moteus is sent in each phase, and what its replies report.

Rules. A device gets one frame a cycle, which commands and queries at once. Arming is position control at the
measured position, for a torque stay-within without any, until the device reports such a mode. A velocity
starts from the measured position too, until a reply came to that: the device's own set-point may be
anywhere. Since a stop clears faults, a device in
fault or timeout is sent none until ClearFault, not for Idle either: in fault it gives no torque, and in
timeout it damps its shaft, as its owner configured. What is written is read back in the same frame: the reply
to that holds this register alone, and must hold what was written. Nothing that drops a load or moves a
running shaft is sent to an armed device. An id is set over the console of the device whose UUID begins with
the serial number.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isclose, isnan, nan, tau
from typing import Annotated, Any, Literal

from protocols import messages as msg
from protocols.bounds import Bounds, check
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, SECOND, Command, Event, Mode, Nanos, Request
from protocols.moteus import codec
from protocols.moteus import messages as mt
from protocols.moteus import table as tb
from protocols.moteus.codec import ADDRESS_MAX, F32, INT32, SERIAL_BYTES, make_frame
from protocols.moteus.table import LATCHED, NUMBERS, RISING
from protocols.plugin import Device
from protocols.toolkit.host import Host, Phase, Report
from protocols.toolkit.motor_driver import ARMED, NEVER, Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.requests import subject
from protocols.toolkit.table import FLOAT_MAX, TINY

OFFLINE_PERIOD = 50 * MILLISECOND  # of queries to a device that is offline
IDENTIFY_PERIOD = 5 * SECOND  # of queries for the UUID, to notice a duplicate id
IDENTIFY_RETRY = 100 * MILLISECOND  # … until the device is known
LIMITED = SECOND  # how long what limited the output is reported after it did
PLACED = 3
"""Replies after which the start of a velocity must have arrived: earlier ones may have been on their way."""
SAVE = "conf_write"
"""Parameter that saves the device's configuration when 1 is written."""
MODES: Mapping[int, Mode] = {
    tb.Mode.STOPPED: Mode.READY,
    **dict.fromkeys(RISING, Mode.READY),
    **dict.fromkeys(LATCHED, Mode.FAULT),
}
"""All others are armed. A device that enables, as it does on every arming, is ready."""
LIMITS: Mapping[int, tuple[str, float]] = {
    NUMBERS["command_position_max_torque"]: ("max_torque", 1.0),
    NUMBERS["command_velocity_limit"]: ("velocity_limit", tau),
    NUMBERS["command_accel_limit"]: ("acceleration_limit", tau),
}
"""Registers whose writing changes an option: from then on every command holds it."""
NOT_WRITTEN: Mapping[int, str] = {
    tb.MODE: "the mode is what commands are for",
    NUMBERS["multiplex_id"]: "use SetId with the serial number",
    0x071: "a trimmed clock may end all communication",
    **dict.fromkeys(tb.UUID_MASK, "a mask of UUIDs is no parameter"),
    **dict.fromkeys((*range(0x010, 0x030), *range(0x040, 0x049)), "that register is what commands are for"),
}


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver. It never repeats what the device knows, except to be stricter."""

    host_id: Annotated[int, Bounds(0, 126)] = 0
    """our own id, to which devices reply: another one for each host"""
    can_prefix: Annotated[int, Bounds(0, 0x1FFF)] = 0
    """The upper 13 bits of the device's identifiers"""
    timeout_ms: Annotated[int, Bounds(10, 10_000)] = 100
    """Of the watchdog, written with every command"""
    max_torque: Annotated[float, Bounds(0.0, 1e6)] = 0.0
    """N·m, in every command; 0: as configured on the device"""
    velocity_limit: Annotated[float, Bounds(0.0, 1e6)] = 0.0
    """rad/s of the device's own trajectories, likewise"""
    acceleration_limit: Annotated[float, Bounds(0.0, 1e9)] = 0.0
    """rad/s², likewise"""
    kp: Annotated[float, Bounds(0.0, 1e6)] = 0.0
    """N·m/rev, servo.pid_position.kp of the device, for Impedance"""
    kd: Annotated[float, Bounds(0.0, 1e6)] = 0.0
    """N·m/(rev/s), likewise; 0: not known, and Impedance is refused"""
    within_min: Annotated[float, Bounds(-1e5, 1e5, nan="none")] = nan
    """rad: a Torque does not push further"""
    within_max: Annotated[float, Bounds(-1e5, 1e5, nan="none")] = nan
    """rad, likewise"""
    at_rest: Literal["hold", "damp", "brake"] = "hold"
    """What Velocity 0 is: position control, damping by kd (mode 12), or shorted phases (mode 15)."""
    feedback_ms: Annotated[int, Bounds(1, 1000)] = 10
    """Period of queries to a device that is not commanded"""
    details_ms: Annotated[int, Bounds(1, 60_000)] = 200
    """Period of queries for current, voltage and temperatures as well"""
    offline_ms: Annotated[int, Bounds(20, 10_000)] = 200
    """Time without a reply after which it is offline"""

    def __post_init__(self) -> None:
        late = f"offline_ms ({self.offline_ms}) must be at least twice feedback_ms ({self.feedback_ms})"
        inverted = f"within_min ({self.within_min}) must be below within_max ({self.within_max})"
        check(
            self,
            ("offline_ms", late if self.offline_ms < 2 * self.feedback_ms else ""),
            ("within_min", inverted if self.within_min >= self.within_max else ""),
        )

    @property
    def gains(self) -> tuple[float, float]:
        """Stiffness [N·m/rad] and damping [N·m·s/rad] at scale 1; 0: not known."""
        return self.kp / tau, self.kd / tau

    @property
    def stated(self) -> dict[str, float]:
        """The registers that are the same in all commands of position control and stay-within."""
        limits = {
            "command_position_max_torque": self.max_torque,
            "command_velocity_limit": self.velocity_limit / tau,
            "command_accel_limit": self.acceleration_limit / tau,
        }
        return {n: each for n, each in limits.items() if each} | {"command_timeout": self.timeout_ms / 1000}

    @property
    def most(self) -> dict[str, float]:
        """The highest values of the limits in commands, which may be lowered by request."""
        limits = {tb.NAMES[number]: (getattr(self, name), unit) for number, (name, unit) in LIMITS.items()}
        return {name: (most or 1e6) / unit for name, (most, unit) in limits.items()}

    def setpoints(self) -> mt.Setpoints:
        """Return what is the same in all commands."""
        limits = (self.max_torque, self.velocity_limit / tau, self.acceleration_limit / tau)
        bounds = [None if isnan(bound) else bound / tau for bound in (self.within_min, self.within_max)]
        return mt.Setpoints(self.timeout_ms / 1000, limits, bounds, self.gains)


@dataclass(slots=True)
class Motor:
    """What is known of one device beyond its phase. Plain data."""

    options: Options
    setpoints: mt.Setpoints
    command_id: int
    mode: int | None = None  # the mode register
    detail: str = ""  # the vendor's name of the mode, and what limits the output
    title: str = ""  # hardware and firmware
    limited: dict[int, Nanos] = field(default_factory=dict)  # when each of `LIMITS` last limited its output
    placed: int | None = None
    """Replies since a velocity is sent with the measured position; None: something else was sent."""
    queried_at: Nanos = -NEVER
    details_at: Nanos = 0
    identify_at: Nanos = 0

    def on_reply(self, t: Nanos, values: Mapping[int, float | None]) -> None:
        """Record the registers in a reply."""
        if tb.MODEL_NUMBER in values and tb.FIRMWARE_VERSION in values:
            model, version = (int(values[at] or 0) for at in (tb.MODEL_NUMBER, tb.FIRMWARE_VERSION))
            dotted = ".".join(str(version >> shift & 0xFF) for shift in (16, 8, 0))
            self.title = f"model {model:06X}, firmware {dotted}"
        mode, fault = values.get(tb.MODE), values.get(tb.FAULT)
        if mode is None:
            return
        if self.placed is not None:
            self.placed = None if mode in LATCHED else self.placed + (mode == tb.Mode.POSITION)
        if mode != self.mode or self.limited or fault in tb.LIMITS:
            self.mode = int(mode)
            # What limits it may come and go with every reply.
            recent = {code: at for code, at in self.limited.items() if t - at < LIMITED}
            active = {int(fault or 0): t} if fault in tb.LIMITS else {}
            self.limited = {} if self.mode in MODES else recent | active
            limits = " and ".join(tb.LIMITS[code] for code in sorted(self.limited))
            self.detail = tb.mode_name(self.mode) + (f", limited by {limits}" if limits else "")

    def limit(self, options: Options) -> None:
        """Take other limits."""
        self.options, self.setpoints = options, options.setpoints()

    def place(self, replies: int | None) -> None:
        """Note a set-point: of a velocity, or None."""
        self.placed = replies

    def frame(self, now: Nanos, data: bytes = b"") -> tuple[Frame]:
        """Return a frame with these data, which queries as well."""
        self.queried_at, query = now, mt.FAST
        if now >= self.details_at:
            self.details_at, query = now + self.options.details_ms * MILLISECOND, mt.FULL
        return (make_frame(self.command_id, data + query),)

    def identify(self, at: Nanos) -> None:
        """Ask for the UUID from then on."""
        self.identify_at = at

    def forget(self) -> None:
        """Forget what may have changed while it was away."""
        self.mode, self.placed, self.identify_at = None, None, 0
        self.limited.clear()


class MoteusAdapter(Adapter[Motor]):
    """What moteus controllers are sent, and what they report."""

    name = "moteus"
    faults = tb.REPORTED
    not_armed, duplicate, latch = tb.NOT_ARMED, tb.DUPLICATE_ID, True
    needs_idle, zero_tolerance = (msg.Zero,), 0.01 * tau
    set_id_detail = f"not saved yet: write {SAVE} 1 to keep it after power-off"

    def __init__(self) -> None:
        self._names: dict[int, str] = {}
        """Our devices by the identifiers of their replies."""
        self._hosts: set[tuple[int, int]] = set()
        """Our ids and prefixes, for queries to all."""

    def own(self, device: Device) -> Motor:
        options: Options = device.options
        host = (options.host_id, options.can_prefix)
        self._hosts |= {host}
        self._names |= {codec.reply_id(device.address, *host): device.name}
        return Motor(options, options.setpoints(), codec.command_id(device.address, *host))

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        if not isinstance(frame, CanFrame) or not frame.fd or frame.remote:
            return (Rx.IGNORED,)
        if frame.extended != (frame.id > codec.STANDARD_MAX):
            return (Rx.IGNORED,)
        name = self._names.get(frame.id)
        if name is None:
            return (self._unknown_device(frame, driver),)
        reply = codec.decode(frame.data)
        return (Rx.MALFORMED if reply is None else _report(t, driver.hosts[name], reply),)

    def _unknown_device(self, frame: CanFrame, driver: MotorDriver[Motor]) -> Report[Motor] | Rx:
        """Return what a device that the robot file does not know replies to a query to all."""
        host = (frame.id & 0x7F, frame.id >> 16)
        if frame.id & (codec.REPLY_BIT | 0x80) or host not in self._hosts:
            return Rx.IGNORED
        reply = codec.decode(frame.data) if any(each.host is None for each in driver.queue) else None
        if reply is None or tb.MODEL_NUMBER in reply.values:  # it replies to another host's query
            return Rx.IGNORED
        serial, note = _identity(reply)
        return Report(None, frame.id >> 8 & 0x7F, serial=serial, note=note)

    # -- sent -----------------------------------------------------------------------------------------

    def refuse(self, host: Host[Motor], command: Command) -> str:
        if isinstance(command, msg.Impedance) and not all(host.options.gains):
            return "its gains are scaled, not set: give kp and kd under options, as on the device"
        at, low, high = host.position, host.options.within_min, host.options.within_max
        outside = at is not None and (at < low or at > high)
        if outside and isinstance(command, msg.Torque) and host.mode is not Mode.ARMED:
            return "it stands outside within_min … within_max: the device would pull it back"
        return ""

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        motor, setpoints = host.own, host.own.setpoints
        # The set-point of arming is where the shaft is: a velocity may go on from there.
        motor.place(PLACED if isinstance(command, msg.Velocity) else None)
        if isinstance(command, msg.Torque):
            return motor.frame(now, setpoints.torque(0.0))
        return motor.frame(now, setpoints.position((host.position or 0.0) / tau, 0.0, 0.0))

    def command(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        motor, at_rest = host.own, mt.AT_REST.get(host.own.options.at_rest)
        placed = motor.placed or 0
        motor.place(placed if isinstance(command, msg.Velocity) else None)
        match command:
            case msg.Position(_, position, velocity, torque):
                data = motor.setpoints.position(position / tau, velocity / tau, torque)
            case msg.Velocity(_, velocity, torque) if at_rest and max(abs(velocity), abs(torque)) < TINY:
                motor.place(None)
                data = at_rest
            case msg.Velocity(_, velocity, torque):
                at = (host.position or 0.0) / tau if placed < PLACED else None
                data = motor.setpoints.position(at, velocity / tau, torque)
            case msg.Torque(_, torque):
                data = motor.setpoints.torque(torque)
            case msg.Impedance(_, position, velocity, torque, stiffness, damping):
                data = motor.setpoints.spring(position / tau, velocity / tau, torque, stiffness, damping)
            case _:
                data = motor.setpoints.position((host.held or 0.0) / tau, 0.0, 0.0)
        return motor.frame(now, data)

    def release(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        host.own.place(None)
        return () if host.own.mode in LATCHED else host.own.frame(now, mt.STOP)

    def poll(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        frames: list[Frame] = []
        motor = host.own
        if now >= self.poll_due(host):
            frames += motor.frame(now)
        if motor.mode is not None and now >= motor.identify_at:
            motor.identify(now + (IDENTIFY_PERIOD if motor.title else IDENTIFY_RETRY))
            frames.append(make_frame(motor.command_id, mt.IDENTIFY))
        return frames

    def poll_due(self, host: Host[Motor]) -> Nanos:
        period = OFFLINE_PERIOD if host.offline else host.own.options.feedback_ms * MILLISECOND
        return host.own.queried_at + period

    def resend(self, host: Host[Motor]) -> None:
        host.own.place(None)

    # -- requests -------------------------------------------------------------------------------------

    def running(self, host: Host[Motor]) -> bool:
        """True if it gives torque, or may do so soon: what has tripped does not once it is released."""
        if host.own.mode in LATCHED:
            return host.owned and host.phase is not Phase.RELEASING
        return host.running or host.own.mode in RISING

    def begin(
        self, now: Nanos, request: Request, host: Host[Motor] | None, driver: MotorDriver[Motor]
    ) -> Pending[Motor] | str:
        if host is None:
            return self._for_all(now, request, driver)
        register, data = tb.register_of(getattr(request, "parameter", "")), b""
        match request:
            case msg.ClearFault():
                host.own.identify(now)
            case msg.Zero():  # read back, so that the reply shows that this frame arrived
                register = tb.SET_OUTPUT_EXACT
                data = codec.write(register, 0.0) + codec.read(register) + mt.FAST
            case msg.WriteParameter(_, name, value) if name == SAVE:
                register = NUMBERS["multiplex_id"]
                data = mt.console("conf write") + codec.read(register, INT32)
                if value != 1 or self.running(host):
                    return f"{SAVE} takes 1" if value != 1 else ARMED
            case msg.ReadParameter(_, name) | msg.WriteParameter(_, name) if register < 0:
                return f"no register {name!r}: give its number (0x058), or one of {', '.join(NUMBERS)}"
            case msg.ReadParameter():  # quantities are read as binary32, the rest as int32
                data = codec.read(register, F32 if register in tb.SCALES else INT32)
            case msg.WriteParameter(_, _, value) if register in LIMITS:
                name, unit = LIMITS[register]
                most = getattr(host.options, name) or 1e6
                if not 0.0 < value * unit <= most:
                    return f"{value} is not above 0 and at most {most / unit:g}, as the robot file allows"
                limited: Any = {name: value * unit}
                host.own.limit(replace(host.own.options, **limited))
                data = codec.read(register)
            case msg.WriteParameter(_, _, value):
                if not abs(value) <= FLOAT_MAX:
                    return f"{value} is no finite number of 32 bits"
                if register in tb.ACTIONS and (self.running(host) or host.own.mode is None):
                    return ARMED
                if register in NOT_WRITTEN:
                    return NOT_WRITTEN[register]
                data = codec.write(register, value) + codec.read(register)
            case _:
                return f"a moteus has no {type(request).__name__} on its bus"
        frames, until = (make_frame(host.own.command_id, data),), now + 600 * MILLISECOND
        notes = {"register": register}
        return Pending(request, host.name, now, until, now, host, frames, 60 * MILLISECOND, notes)

    def _for_all(self, now: Nanos, request: Request, driver: MotorDriver[Motor]) -> Pending[Motor] | str:
        """Begin a request to all devices, which is sent once for each prefix in use."""
        data, until, period = [mt.DISCOVER], 800, 200
        if isinstance(request, msg.SetId):
            if wrong := driver.wrong_id(request, range(1, ADDRESS_MAX + 1), 8 * SERIAL_BYTES):
                return wrong
            uuid = request.serial.to_bytes(SERIAL_BYTES, "big")
            line = mt.console(f"conf set id.id {request.address}")
            data, until, period = [mt.masked(uuid, line), mt.masked(uuid, mt.DISCOVER)], 1500, 150
        ids = [codec.command_id(codec.BROADCAST, *host) for host in sorted(self._hosts)]
        frames = tuple(make_frame(each, piece) for piece in data for each in ids)
        deadline = now + until * MILLISECOND
        return Pending(request, subject(request), now, deadline, now, None, frames, period * MILLISECOND)

    def frames(self, now: Nanos, pending: Pending[Motor]) -> Sequence[Frame]:
        if pending.host is None or not isinstance(pending.request, msg.ClearFault):
            return pending.frames
        motor = pending.host.own
        return motor.frame(now, mt.STOP if motor.mode in LATCHED else b"")

    def answer(self, t: Nanos, pending: Pending[Motor], report: Report[Motor]) -> Event | None:
        reply: codec.Reply = report.content
        values, notes, register = reply.values, pending.notes, pending.notes["register"]
        alone = {*values, *(error.register for error in reply.errors)} == {register}
        unreadable = reply.error(codec.READ_ERROR, register)
        if number := reply.error(codec.WRITE_ERROR, register):
            why = "read only" if number == 2 else f"error {number}: no such register?"
            return pending.refuse(t, f"the device does not accept it ({why})")
        match pending.request:
            case msg.Zero() if register in values or unreadable:
                notes.update(taken=True)  # a position near zero may be from before
            case msg.Zero() if "taken" not in notes:
                return None
            case msg.ClearFault() | msg.Zero():
                return super().answer(t, pending, report)
            case msg.ReadParameter() if unreadable:
                return pending.refuse(t, "the device has no such register, or cannot read it so")
            case msg.ReadParameter(motor, name) if register in values:
                value = values[register]
                if value is None:
                    return pending.refuse(t, "the device replies that it is not given")
                return msg.Parameter(motor, t, name, float(value))
            case msg.WriteParameter() if register in LIMITS:
                return pending.done(t, "each command holds it from now on")
            case msg.WriteParameter(_, name, value) if alone:  # others may have been on their way before
                reads = values.get(register)
                if name == SAVE or reads is None or isclose(reads, value, rel_tol=2.0**-23, abs_tol=TINY):
                    return pending.done(t)
                notes.update(reads=reads)
        return None

    def give_up(self, now: Nanos, pending: Pending[Motor]) -> str:
        if isinstance(pending.request, msg.WriteParameter) and "reads" in pending.notes:
            return f"the device holds {pending.notes['reads']:.6g} there, not {pending.request.value:.6g}"
        return super().give_up(now, pending)


def _report(t: Nanos, host: Host[Motor], reply: codec.Reply) -> Report[Motor]:
    values, motor = reply.values, host.own
    motor.on_reply(t, values)
    reported, fault = values.get(tb.MODE), values.get(tb.FAULT)
    mode, codes = None, None
    if reported is not None:
        mode = MODES.get(int(reported), Mode.ARMED)
        latched = reported if reported == tb.TIMEOUT else fault
        codes = () if mode is not Mode.FAULT else None if latched is None else (int(latched),)
    serial, note = _identity(reply) if tb.UUID.start in values or reply.errors else (None, "")
    note = f"{motor.title or 'firmware not known yet'}; {note}" if note else ""
    measured = _feedback(host.name, t, values)
    return Report(
        host, host.address, mode, motor.detail, codes, measured, serial=serial, note=note, content=reply
    )


def _feedback(name: str, t: Nanos, values: Mapping[int, float | None]) -> msg.Feedback | None:
    """Return the measurements in a reply."""
    get = values.get
    position, velocity, torque, voltage = get(tb.POSITION), get(tb.VELOCITY), get(tb.TORQUE), get(tb.VOLTAGE)
    board, winding = get(tb.TEMPERATURE), get(tb.MOTOR_TEMPERATURE)
    hottest = board if winding is None or (board is not None and board > winding) else winding
    if position is velocity is torque is voltage is hottest is None:
        return None
    position = None if position is None else position * tau
    velocity = None if velocity is None else velocity * tau
    return msg.Feedback(name, t, position, velocity, torque, get(tb.Q_CURRENT), voltage, hottest)


def _identity(reply: codec.Reply) -> tuple[int | None, str]:
    """Return the serial number in a reply, and the UUID as it is printed on the packaging; or the remark
    that there is none; None and "" if the reply is about something else."""
    numbers = [reply.values.get(register) for register in tb.UUID]
    if None in numbers or not reply.values.get(NUMBERS["uuid_mask_capable"], 1):
        none = any(error.register in tb.UUID for error in reply.errors)
        return None, "it has no UUID: older firmware" if none else ""
    uuid = struct.pack("<4I", *(int(number or 0) & 0xFFFFFFFF for number in numbers))
    digits = uuid.hex()
    printed = "-".join((digits[:8], digits[8:12], digits[12:16], digits[16:20], digits[20:]))
    return codec.serial_of(uuid), f"UUID {printed}"
