"""The host's end: what a Damiao motor is sent in each phase, and what its answers report.

Rules. A motor sends only answers, one to each frame. Registers answer with the id of the feedback, and that
of a disabled motor near −PMAX looks the same: such a frame is the answer about a register if that register
was asked for just before, and reports nothing if it was not (another host may have asked). Before a motor is
enabled, the ranges in it must be those of the model in the robot file (every number would be scaled wrongly
otherwise), its mode the option's and its watchdog on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from protocols import messages as msg
from protocols.damiao import table as dm
from protocols.damiao.options import Options
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Feedback, Mode, Nanos
from protocols.plugin import Device
from protocols.toolkit.host import Host, Report
from protocols.toolkit.mit import encoded
from protocols.toolkit.motor_driver import MotorDriver, Pending, Rx
from protocols.toolkit.register_motor import Motor, RegisterAdapter
from protocols.toolkit.requests import ANSWER

STATES: dict[int, tuple[Mode, str]] = {
    dm.DISABLED: (Mode.READY, "disabled"),
    dm.ENABLED: (Mode.ARMED, "enabled"),
    **{code: (Mode.FAULT, info.name) for code, info in dm.FAULTS.items()},
}


class DamiaoAdapter(RegisterAdapter):
    """What Damiao motors are sent, and what they report."""

    name = "damiao"
    faults = dm.ALL_FAULTS
    not_armed, duplicate = dm.NOT_ENABLED, dm.DUPLICATE
    registers, addresses = dm.REGISTERS, dm.ADDRESSES
    serial, save, turns, actions = "SN", dm.SAVE, "xout", dm.REQUESTS

    def __init__(self) -> None:
        self.replies: dict[int, str] = {}
        """By the id of its answers: the motor's name."""

    def own(self, device: Device) -> Motor:
        reply = device.options.reply(device.address)
        other = self.replies.setdefault(reply, device.name)
        if other != device.name:
            raise ValueError(
                f"{other} and {device.name} would both answer by {reply:#05x}, and destroy each other's "
                "frames: give each a reply_id (MST_ID) of its own"
            )
        return super().own(device)

    def expected(self, options: Options) -> Mapping[str, float]:
        return options.ends

    def written(self, options: Options) -> Mapping[str, float]:
        return {
            "CTRL_MODE": dm.MODES[options.mode],
            "TIMEOUT": round(options.timeout_ms / dm.TIMEOUT_UNIT_MS),
        }

    def polled(self, options: Options) -> Sequence[str]:
        return ("xout",) if options.position == "xout" else ()

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        if not isinstance(frame, CanFrame) or frame.extended or frame.remote or frame.fd:
            return (Rx.IGNORED,)
        if frame.id == dm.ALL_MOTORS:
            return self._found(frame, driver)
        # The first byte of a feedback has the lower four bits of ESC_ID, that of a register all of it.
        host = driver.at.get(frame.data[0] & 0xF) if frame.data else None
        ours = host is not None and frame.id == host.options.reply(host.address)
        about = frame.data[2:3] in dm.REGISTER_BYTES
        name, value, written = dm.register_in(frame) if about else ("", None, False)
        if host is None or not ours:
            usual = name == "SN" and frame.id in (0, dm.REPLY_BASE + frame.data[0], *self.replies)
            sn = usual and driver.scanning(frame.data[0])
            note = f"answers with {frame.id:03X}"
            return (Report(None, frame.data[0], serial=int(value or 0), note=note) if sn else Rx.IGNORED,)
        if not name:
            return (self._feedback(t, frame, host) or Rx.MALFORMED,)
        if value is None or not host.own.is_asked(t, name):
            return (Report(host, host.address),)
        return (self.register_report(t, host, name, value, written=written),)

    def _found(self, frame: CanFrame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        """Return what the answer to a discovery reports."""
        values = dm.ANY.read("found", frame.data) if driver.scanning() else None
        if values is None:
            return (Rx.IGNORED,)
        note = f"answers with {values['reply']:03X}: that is to be its reply_id"
        return Rx.EXPECTED, Report(None, values["found"], note=note, messages=0)

    def _feedback(self, t: Nanos, frame: CanFrame, host: Host[Motor]) -> Report[Motor] | None:
        values = host.options.table.read("feedback", frame.data)
        if values is None:
            return None
        status = values["status"] if values["status"] in STATES else dm.UNKNOWN
        mode, detail = STATES[status]
        position = None if host.options.position == "xout" else values["position"]
        hottest = float(max(values["mos"], values["rotor"]))
        feedback = Feedback(host.name, t, position, values["velocity"], values["torque"], None, None, hottest)
        faults, many = (status,) if mode is Mode.FAULT else (), host.own.reported(t)
        return Report(host, host.address, mode, detail, faults, feedback, many)

    # -- sent -----------------------------------------------------------------------------------------

    def refuse(self, host: Host[Motor], command: Command) -> str:
        wrong, own = super().refuse(host, command), host.own
        ends = ", ".join(f"{dm.RANGES[name]} = {own.known[name]:g}" for name in own.wrong)
        return f"{wrong}; if it is the right one, write {ends} under options" if wrong else ""

    def frames(self, now: Nanos, pending: Pending[Motor]) -> Sequence[Frame]:
        if not isinstance(pending.request, msg.Scan) or pending.found:
            return super().frames(now, pending)
        # Last of all: one motor with any MST_ID. Several would destroy each other's answers.
        asked_all = pending.sent == len(pending.frames) and now >= pending.deadline - ANSWER // 2
        return (dm.ANY.encode("discover"),) if asked_all else super().frames(now, pending)

    def about(self, operation: str, address: int, name: str, value: float = 0.0) -> Sequence[Frame]:
        return (dm.about_register(operation, address, name, value),)

    def readdress(self, host: Host[Motor], address: int) -> Sequence[Frame]:
        at, own = host.address, host.options.reply_id
        replies = () if own else self.about("write", at, "MST_ID", dm.REPLY_BASE + address)
        return *replies, *self.about("write", at, "ESC_ID", address)

    def ask(self, host: Host[Motor]) -> Sequence[Frame]:
        return (dm.ANY.encode("refresh", motor=host.address, number=0, value=0),)

    def message(self, name: str, address: int) -> Frame:
        return dm.ANY.encode(name, address)

    def set_point(self, host: Host[Motor], command: Command) -> Frame:
        options: Options = host.options
        at, table, fastest = host.address, options.table, options.max_velocity
        goal = host.held if isinstance(command, msg.Hold) else getattr(command, "position", 0.0)
        match options.mode:
            case "vel":
                return table.encode("VEL", at, velocity=getattr(command, "velocity", 0.0))
            case "pos_vel":
                return table.encode("POS_VEL", at, position=goal, fastest=fastest)
            case "force_pos":
                return table.encode("FORCE_POS", at, position=goal, fastest=fastest, force=options.max_force)
        five = options.gains.impedance(command, host.held)
        return encoded(table.encoder("MIT"), at, five, dm.SPECIAL_DATA)
