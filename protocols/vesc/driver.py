"""The host's end over CAN: what of the status messages and answers reports what."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from protocols.frames import Frame
from protocols.messages import MILLISECOND, Feedback, Mode, Nanos
from protocols.toolkit.host import Host, Report
from protocols.toolkit.motor_driver import MotorDriver, Pending, Rx
from protocols.toolkit.table import Values
from protocols.vesc import table as vt
from protocols.vesc.controller import Controller, ControllerAdapter, inside

ASKED: Nanos = 10 * MILLISECOND
"""Period of questions while it is armed or released."""


class VescAdapter(ControllerAdapter):
    """What controllers are sent, and what they report."""

    name = "vesc"
    needed = ("STATUS_1", "STATUS_4", "STATUS_5", "state")

    # -- received -------------------------------------------------------------------------------------

    def receive(
        self, t: Nanos, frame: Frame, driver: MotorDriver[Controller]
    ) -> Sequence[Report[Controller] | Rx]:
        decoded = vt.TABLE.decode(frame, "from_device")
        if decoded is None:
            return (Rx.IGNORED,)
        name, address, values = decoded
        host = driver.at.get(address)
        if "host" in values and values["host"] not in {
            each.options.host_id for each in driver.hosts.values()
        }:
            return (Rx.IGNORED,)
        note = f"hardware type {values['hardware']}" if name == "PONG" else ""
        if note and (host is not None or driver.scanning()):
            return (Report(host, address, note=note),)
        if host is None or not name:
            return (Rx.EXPECTED if note else Rx.IGNORED if host is None else Rx.MALFORMED,)
        own = host.own
        own.see(t, name, values)
        mode, detail = own.mode(host.mode)
        if name in ("fault", "state"):
            known = mode if own.faults or name == "state" else None
            return (Report(host, address, known, detail, own.faults, duplicate=own.answers.add(t)),)
        late = mode if own.current and not own.driven and mode is Mode.ARMED else None
        return (Report(host, address, late, detail, feedback=self._measured(t, host, name, values)),)

    def _measured(self, t: Nanos, host: Host[Controller], name: str, values: Values) -> Feedback | None:
        motor, options = host.name, host.options
        match name:
            case "STATUS_1":
                return self.motion(t, host, values["velocity"], values["current"], values["duty"])
            case "STATUS_5":
                position = inside(values["position"], options.step)
                return Feedback(motor, t, position, voltage=values["voltage"])
            case "STATUS_4":
                return Feedback(motor, t, temperature=max(values["fet"], values["motor"]))
        return None

    # -- sent -----------------------------------------------------------------------------------------

    def set(self, host: Host[Controller], name: str, value: float, *, release: bool = False) -> Frame:
        return vt.TABLE.encode(name, host.address, value=value)

    def poll_due(self, host: Host[Controller]) -> Nanos:
        at: Nanos = host.own.answers.sent_at + host.options.poll_ms * MILLISECOND
        return at

    def ask(self, now: Nanos, host: Host[Controller], *, hurry: bool = False) -> Sequence[Frame]:
        answers = host.own.answers
        if now - answers.sent_at < (ASKED if hurry else host.options.poll_ms * MILLISECOND):
            return ()
        return answers.sent(now, (self._get("fault", host), self._get("state", host)))

    def _get(self, name: str, host: Host[Controller]) -> Frame:
        return vt.TABLE.encode(f"get {name}", host.address, host=host.options.host_id, mode=0)

    # -- requests -------------------------------------------------------------------------------------

    def questions(self, driver: MotorDriver[Controller]) -> Iterable[Frame]:
        reply = next(iter(driver.hosts.values())).options.host_id
        return (vt.TABLE.encode("PING", at, host=reply) for at in vt.ADDRESSES if at != reply)

    def frames(self, now: Nanos, pending: Pending[Controller]) -> Sequence[Frame]:
        host = pending.host
        if host is None:
            return pending.slice()
        host.own.answers.ask()
        return (self._get("state", host),)
