"""The host's end: what a servo is sent in each phase, and what its answers report.

Rules. A servo that is not commanded is only read. What a servo must hold before it is armed is written until
it reads back so, and then only is it given a goal, where it stands: a goal alone makes most servos go there,
whether they were armed or not.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.feetech import table as ft
from protocols.feetech.options import Options
from protocols.frames import Frame
from protocols.line import Exchange, Rank
from protocols.messages import MILLISECOND, SECOND, Command, Nanos
from protocols.toolkit.host import Host
from protocols.toolkit.memory_map import Values
from protocols.toolkit.servo_driver import Known, Motion, ServoAdapter
from protocols.toolkit.servo_packets import READ, Packet
from protocols.toolkit.turns import Turns

STATE: Nanos = 100 * MILLISECOND
"""Period in which the state is asked for;"""
UNSURE: Nanos = 20 * MILLISECOND
"""while it is not known, or about to change."""
LATE = 60_000
"""ns by which an answer may come later than the servo's delay"""
WHO = 0, 5
"""What a scan reads"""
DETAILS = {
    "ID": "give it this address in the robot file, too",
    "Baud_Rate": "restart it, and give the bus this rate",
}
"""What is still to be done when a register was written"""


@dataclass(slots=True)
class Servo(Known):
    """What is known of one servo beyond its phase. Plain data."""

    written_at: Nanos | None = None
    """When that was first written since it was last forgotten,"""
    confirmed: bool = False
    """and that it has read back so since then."""
    turns: Turns = field(default_factory=Turns)

    def zero(self, model: ft.Model) -> int | None:
        """Return the reported position of 0 rad [steps], None if it is not known: the servo subtracts its
        offset in mode position alone, in the others it reports its encoder. The mode is not known between
        its write and its reading."""
        mode, wanted = self.values.get("Operating_Mode", 0), self.set_up.get("Operating_Mode", 0)
        if mode != wanted and self.written_at is not None:
            return None
        offset = self.values.get("Homing_Offset") if mode else 0
        return None if offset is None else model.middle + offset

    def write(self, now: Nanos) -> None:
        """Note that the set-up is written."""
        self.written_at = now if self.written_at is None else self.written_at

    def put(self, t: Nanos, block: str, values: Values) -> None:
        """Record what is read; with another zero, turns are counted anew."""
        offset = self.values.get("Homing_Offset", 0)
        if values.get("Homing_Offset", offset) != offset:
            self.turns = Turns()
        Known.put(self, t, block, values)
        if "Torque_Enable" in values and self.written_at is not None and t > self.written_at:
            self.confirmed = not self.different(self.set_up)

    def forget(self) -> None:
        """Forget all of it."""
        Known.forget(self)
        self.written_at, self.confirmed, self.turns = None, False, Turns()


class FeetechAdapter(ServoAdapter[Servo]):
    """What servos are sent, and what they report."""

    name, kind = ft.NAME, Servo
    packets, supply, late = ft.PACKETS, "Present_Voltage", LATE
    faults, latch, not_armed = ft.ALL_FAULTS, True, ft.NOT_ARMED
    clearing = 2 * SECOND
    zero_tolerance = 0.02
    silence = ft.LONGEST_DELAY + MILLISECOND
    again = 20 * MILLISECOND
    details = DETAILS

    # -- received -------------------------------------------------------------------------------------

    def who(self, number: int) -> Exchange:
        return self.packets.asks({number: WHO}, f"scan {number}", ft.LONGEST_DELAY + LATE, Rank.BACKGROUND)

    def note(self, question: Packet, data: bytes) -> str:
        asked = question.instruction == READ and question.data == bytes(WHO)
        return ft.identified(data) if asked and len(data) == WHO[1] else ""

    def faults_in(self, host: Host[Servo], error: int, values: Values) -> Collection[int]:
        return ft.faults_in(error)

    def shaft(self, t: Nanos, host: Host[Servo], values: Values) -> Motion | None:
        if "Present_Position" not in values or "Present_Temperature" not in values:
            return None
        options: Options = host.options
        model, place, speed = options.of, values["Present_Position"], values["Present_Velocity"]
        velocity = None if abs(speed) >= 0x7FFF else speed * model.step
        zero = host.own.zero(model)
        if options.mode == "position":
            low, high = model.ends
            there = zero is not None and low < place < high
            return (place - (zero or 0)) * model.step if there else None, velocity
        # It goes on beyond the turn in which it is reported.
        half = model.steps // 2
        within = None if zero is None else ((place - zero + half) % model.steps - half) * model.step
        return host.own.turns.add(t, within, velocity, math.pi), velocity

    # -- commanded ------------------------------------------------------------------------------------

    def refuse(self, host: Host[Servo], command: Command) -> str:
        number, has = host.options.of.number, host.own.values.get("Model_Number")
        if not number or has in (None, number):
            return ""
        other = ft.NUMBERS.get(has or 0, "a model that is not known here")
        return f"Model_Number is {has} ({other}), not {number}, that of a {host.options.model}"

    def ready(self, host: Host[Servo]) -> bool:
        return host.position is not None and "Model_Number" in host.own.values

    def arm(self, now: Nanos, host: Host[Servo], command: Command) -> Sequence[Frame]:
        own = host.own
        if not own.confirmed:
            self._set_up(now, host)
        else:
            self.set_point(host, msg.Hold(host.name))  # or at rest
            self.put(host, {"Torque_Enable": 1})
        who = "Return_Delay_Time" in own.different(own.set_up)  # it is no part of the state
        return [*(self.ask(now, host, "who") if who else ()), *self.ask(now, host, "state")]

    def command(self, now: Nanos, host: Host[Servo], command: Command) -> Sequence[Frame]:
        own = host.own
        if not own.confirmed:
            wanted = own.set_up.get("Operating_Mode", 0)
            if own.values.get("Operating_Mode", 0) != wanted:  # another host's: it must stop first
                return self.release(now, host)
            self._set_up(now, host)
        self.set_point(host, command)
        return ()

    def _set_up(self, now: Nanos, host: Host[Servo]) -> None:
        """Write all of it, one after the other: behind Lock, nothing is stored."""
        host.own.write(now)
        for name, value in host.own.set_up.items():
            self.put(host, {name: value})

    # -- asked ----------------------------------------------------------------------------------------

    def chain(self, host: Host[Servo]) -> str | None:
        return "" if host.options.sync_read and host.options.of.sync_read else None

    def wanted(self, host: Host[Servo]) -> Iterable[tuple[str, Nanos]]:
        known = host.own.values
        found = [("state", STATE if (self.settled(host) and known) or host.offline else UNSURE)]
        if host.mode is not None and not host.offline:
            found += [("who", UNSURE)] if "Model_Number" not in known else []
            found.append(("motion", round(host.options.feedback_ms * MILLISECOND)))
        return found

    # -- requests -------------------------------------------------------------------------------------

    def clears(self, now: Nanos, host: Host[Servo]) -> Sequence[Frame]:
        return (Exchange(ft.disarms(host.own.id), None, Rank.RELEASE),)

    def zeroing(self, host: Host[Servo]) -> tuple[Sequence[Frame], None] | str:
        if self.zeroed not in host.options.table.by_name:
            return "a servo of this family has no offset"
        return (Exchange(self.packets.sync_write(40, {host.own.id: bytes((ft.MIDDLE_HERE,))})),), None

    def changes(self, host: Host[Servo], name: str, value: float) -> Sequence[tuple[str, float]]:
        """What is stored is unlocked, written, and locked again."""
        if not self.table(host).is_stored(name):
            return ((name, value),)
        return (("Lock", 0.0), (name, value), *([] if name == self.rate else [("Lock", 1.0)]))

    def change(self, host: Host[Servo], name: str, value: float) -> Exchange:
        if name == self.rate:  # acknowledged: it may be the last answer at this rate
            return super().change(host, name, value)
        ((at, data),) = host.options.table.runs({name: value})
        return Exchange(self.packets.sync_write(at, {host.own.id: data}))
