"""The host's end over a serial line: what is asked, and what the answers report.

Rules. Motion, fault and timeout are one question: its answer names its sender, so that none is taken for
another's. An answer that nobody asked for, such as a late one, shows that a device is there, and nothing
else: what it tells of the timeout may be from before the last command. A host that asks nothing, and only
receives, decodes all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from protocols import messages as msg
from protocols.frames import Frame
from protocols.line import Answer, Exchange, Rank
from protocols.messages import MILLISECOND, SECOND, Event, Feedback, Mode, Nanos, Request
from protocols.toolkit.host import Host, Report
from protocols.toolkit.lines import LineAdapter
from protocols.toolkit.motor_driver import MotorDriver, Pending, Rx
from protocols.toolkit.requests import subject
from protocols.toolkit.serial import Stream
from protocols.vesc.controller import Controller, ControllerAdapter, inside
from protocols.vesc_uart import table as ut
from protocols.vesc_uart.options import Options

DELAY: Nanos = 15 * MILLISECOND
"""Until an answer begins at the latest, through the other CAN too."""
LONGEST_VERSION = 80
"""Bytes of the packet with the firmware's version."""
SEARCH: Nanos = SECOND
"""Period in which the id at the end of the line is asked for, while a controller does not answer."""
SCAN: Nanos = 4500 * MILLISECOND
"""A controller pings all addresses in 2.5 s, if none answers."""
SCAN_AGAIN: Nanos = 2 * SECOND
PERIOD: Nanos = 50 * MILLISECOND
"""Period in which it is looked whom a scan has found."""
READ: Nanos = 600 * MILLISECOND
BOOT: Nanos = 6 * SECOND
RESTARTED: Nanos = 250 * MILLISECOND
"""Silence that shows a restart."""

VescHost: TypeAlias = Host[Controller]
VescDriver: TypeAlias = MotorDriver[Controller]
VescReport: TypeAlias = Report[Controller]


class UartAdapter(ControllerAdapter, LineAdapter[Controller]):
    """What controllers are sent, and what they report."""

    name = "vesc_uart"
    faults = ut.FAULTS
    restarted = RESTARTED

    def __init__(self) -> None:
        super().__init__(ut.FORMAT)
        self._slow_at: dict[str, Nanos] = {}
        """When temperature and voltage were last asked for, by name."""
        self._modes: dict[str, Mode] = {}
        """What was reported last, by name: of the messages in one piece the host sees the last."""
        self._search_at: Nanos = 0
        """When the id at the end of the line is asked for next,"""
        self._end: int | None = None
        """and what it was."""
        self._silent = False
        """A controller does not answer."""

    def forget(self, now: Nanos, host: VescHost) -> None:
        super().forget(now, host)
        self._modes.pop(host.name, None)

    # -- received -------------------------------------------------------------------------------------

    def unasked(self, t: Nanos, message: bytes, driver: VescDriver) -> Sequence[VescReport | Rx]:
        if message[0] == ut.PING_CAN:
            return (self._pinged(message, driver),)
        decoded = ut.decode_values(message)
        sender = decoded[1].get("controller_id") if decoded is not None else None
        host = None if sender is None else driver.at.get(int(sender))
        if decoded is None or host is None:
            return (Rx.IGNORED if ut.decode_version(message) is None else Rx.EXPECTED,)
        answers = host.own.answers
        if answers.sent_at < 0:
            return (self._values(t, host, *decoded),)
        twice = answers.add(t) if decoded[0] == ut.MOTION else ""
        return (Report(host, host.address, duplicate=twice),)

    def _pinged(self, payload: bytes, driver: VescDriver) -> Rx:
        """Note whom a ping has found: each is asked for its version."""
        for pending in driver.queue.waiting:
            if isinstance(pending.request, msg.Scan):
                there = pending.notes.setdefault("there", {})
                there |= {each: False for each in payload[1:] if each not in there and each not in driver.at}
        return Rx.EXPECTED

    def collected(self, pending: Pending[Controller], driver: VescDriver) -> Sequence[VescReport]:
        found = [address for address, _ in pending.found]
        silent = [each for each in pending.notes.get("there", ()) if each not in found]
        return [Report(None, each, note="answers a ping, and tells no version") for each in silent]

    def heard(self, t: Nanos, asked: Exchange, data: bytes, driver: VescDriver) -> Sequence[VescReport | Rx]:
        question, _ = ut.FORMAT.read(asked, 0)
        unpacked = ut.unpack(question) if isinstance(question, bytes) else None
        address = unpacked[0] if unpacked is not None else ut.DIRECT
        found = [self._answer(t, address, one, driver) for one in Stream(ut.FORMAT).messages(data)]
        return found or ((Rx.MALFORMED,) if data else ())

    def _answer(self, t: Nanos, address: int, payload: bytes, driver: VescDriver) -> VescReport | Rx:
        """Return what an answer of a controller reports; `address`: as it was asked."""
        end = _end_of(driver)
        at = end if address == ut.DIRECT else address
        version = ut.decode_version(payload)
        if version is not None:
            note, serial = version
            if address == ut.DIRECT:
                at, note = end if self._end is None else self._end, f"{note}, at the end of the line"
            return Report(driver.at.get(at), at, note=note, serial=serial)
        decoded = ut.decode_values(payload)
        if decoded is None:
            return Rx.MALFORMED
        mask, values = decoded
        sender = values.get("controller_id")
        if mask == ut.WHO and sender is not None and address == ut.DIRECT:
            self._end = int(sender)
        host = driver.at.get(at)
        if host is None or (sender is not None and sender != at):
            return Rx.EXPECTED if mask == ut.WHO else Rx.IGNORED
        return self._values(t, host, mask, values)

    def _values(self, t: Nanos, host: VescHost, mask: int, values: dict[str, float | None]) -> VescReport:
        own, address = host.own, host.address
        known = {name: value for name, value in values.items() if value is not None}
        if mask & ut.MOTION == ut.MOTION:
            own.see(t, "STATUS_1", {"current": known.get("avg_motor_current", 0.0)})
            own.see(t, "fault", {"value": int(known.get("fault_code", 0))})
            if "status" in known:
                own.see(t, "state", {"value": int(known["status"])})
            mode, detail = own.mode(self._modes.get(host.name))
            self._modes[host.name] = mode
            reported = mode if own.faults or "status" in known else None
            feedback = self._motion(t, host, known)
            return Report(
                host, address, reported, detail, own.faults, feedback, own.answers.add(t), parameters=known
            )
        feedback = None
        if mask & ut.SLOW == ut.SLOW:
            hottest = max(known["temp_fet"], known["temp_motor"])
            feedback = Feedback(host.name, t, temperature=hottest, voltage=known["v_in"])
        return Report(host, address, feedback=feedback, parameters=known)

    def _motion(self, t: Nanos, host: VescHost, known: dict[str, float]) -> Feedback | None:
        """Return the motion; None if a number of it is beyond what can be known."""
        if not {"rpm", "avg_motor_current", "tachometer"} <= known.keys():
            return None
        position = inside(int(known["tachometer"]), host.options.step)
        return self.motion(
            t, host, int(known["rpm"]), known["avg_motor_current"], known["duty_cycle_now"], position
        )

    def notice(self, now: Nanos, host: VescHost) -> Sequence[Event]:
        end, uart_id = self._end, host.options.uart_id
        if host.offline:
            self._silent = True
            if end is not None and end != uart_id and not host.tripped:
                cause = f"VESC ID {end} is at the end of the line, not {uart_id}"
                return host.trip(now, ut.OTHER_END, cause)
        return super().notice(now, host)

    # -- sent -----------------------------------------------------------------------------------------

    def _place(self, address: int, options: Options) -> int:
        """Return how a controller is reached."""
        return ut.DIRECT if address == options.uart_id else address

    def set(self, host: VescHost, name: str, value: float, *, release: bool = False) -> Frame:
        frame = ut.PACKETS.encode(name, self._place(host.address, host.options), value=value)
        return Exchange(frame, None, Rank.RELEASE if release else Rank.SET_POINT, host.name)

    def ask(self, now: Nanos, host: VescHost, *, hurry: bool = False) -> Sequence[Frame]:
        frames: list[Frame] = []
        options, answers = host.options, host.own.answers
        if now - answers.sent_at >= options.feedback_ms * MILLISECOND:
            frames += answers.sent(now, (self._get(host, ut.MOTION, Rank.QUESTION),))
        if now - self._slow_at.get(host.name, -SECOND * 3600) >= options.slow_ms * MILLISECOND:
            self._slow_at[host.name] = now
            frames.append(self._get(host, ut.SLOW, Rank.BACKGROUND))
        return frames

    def poll_due(self, host: VescHost) -> Nanos:
        at: Nanos = host.own.answers.sent_at + host.options.feedback_ms * MILLISECOND
        return at

    def _get(self, host: VescHost, mask: int, rank: Rank) -> Exchange:
        place = self._place(host.address, host.options)
        return _question(place, mask, rank, f"{host.name} {mask:x}", host.address)

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        if not self._silent or now < self._search_at:
            return ()
        self._silent, self._search_at = False, now + SEARCH
        return (WHO_IS_THERE,)

    # -- requests -------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: VescHost | None, driver: VescDriver
    ) -> Pending[Controller] | str:
        match request:
            case msg.Scan():
                forwarded = [each for each in driver.at if each != _end_of(driver)]
                ping = Exchange(ut.PACKETS.encode("PING_CAN", ut.DIRECT), about="ping")
                frames = (ping, WHO_IS_THERE, *map(_version, (ut.DIRECT, *forwarded)))
                return Pending(request, request.bus, now, now + SCAN, now, None, frames, PERIOD)
            case msg.Reboot() if host is not None:
                frame = ut.PACKETS.encode("REBOOT", self._place(host.address, host.options))
                frames = (Exchange(frame, about=f"{host.name} reboot"),)
                return Pending(request, host.name, now, now + BOOT, now, host, frames, 2 * BOOT)
            case msg.ReadParameter(_, name) if host is not None:
                if name not in ut.BIT:
                    return f"it does not report {name!r}; it reports {', '.join(ut.BIT)}"
                place, mask = self._place(host.address, host.options), ut.BIT[name] | ut.WHO
                frames = (_question(place, mask, Rank.QUESTION, f"{host.name} {name}", host.address),)
                return Pending(request, subject(request), now, now + READ, now, host, frames)
        return super().begin(now, request, host, driver)

    def frames(self, now: Nanos, pending: Pending[Controller]) -> Sequence[Frame]:
        host = pending.host
        if host is not None and isinstance(pending.request, msg.ClearFault):
            return host.own.answers.sent(now, (self._get(host, ut.MOTION, Rank.QUESTION),))
        if host is not None:
            return pending.frames
        again = now >= pending.notes.get("again", 0)
        if again:
            pending.notes.update(again=now + SCAN_AGAIN)
        there: dict[int, bool] = pending.notes.get("there", {})
        new = [each for each, asked in there.items() if not asked or again]
        there |= dict.fromkeys(new, True)
        return [*(pending.frames if again else ()), *map(_version, new)]


def _end_of(driver: VescDriver) -> int:
    options: Options = next(iter(driver.hosts.values())).options
    return options.uart_id


def _question(place: int, mask: int, rank: Rank, about: str, sender: int | None = None) -> Exchange:
    frame = ut.PACKETS.encode("GET_VALUES_SELECTIVE", place, mask=mask)
    return Exchange(frame, Answer(ut.size_of(mask), ut.finds(sender), DELAY), rank, about)


def _version(place: int) -> Exchange:
    frame = ut.PACKETS.encode("FW_VERSION", place)
    return Exchange(
        frame, Answer(LONGEST_VERSION, ut.finds(None), DELAY), Rank.BACKGROUND, f"version of {place}"
    )


WHO_IS_THERE = _question(ut.DIRECT, ut.WHO, Rank.BACKGROUND, "end of the line")
