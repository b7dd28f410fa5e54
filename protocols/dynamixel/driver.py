"""The host's end: what devices are sent in each phase, and what their answers report.

Rules. Before a device is armed its stored registers are read: it must be the model, and in the mode, that the
robot file has. What is set up reads back so, and its set-point is where it stands, before the torque is
switched on. With `indirect`, the motion is read with the state, where the addresses are known to be set.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.dynamixel import packets as dx
from protocols.dynamixel import table as dt
from protocols.dynamixel.memory import OFFSET_OF_ONE_TURN
from protocols.frames import Frame
from protocols.line import Exchange, Rank
from protocols.messages import MILLISECOND, SECOND, Command, Event, Mode, Nanos
from protocols.toolkit.host import Host, Report
from protocols.toolkit.memory_map import Target, Values
from protocols.toolkit.motor_driver import Pending
from protocols.toolkit.servo_driver import Known, Motion, ServoAdapter
from protocols.toolkit.servo_packets import PING, Packet, Targets

SLOWEST: Nanos = 254 * dt.DELAY_UNIT
"""Return_Delay_Time of a device that has not told it"""
REBOOT: Nanos = 3 * SECOND
"""Time for ClearFault"""
FRESH: Nanos = 500 * MILLISECOND
"""Age of what registers are known to hold, up to which a device is armed upon it."""
AGAIN: Nanos = 100 * MILLISECOND
"""Time after which a stored register is written again."""
SOON: Nanos = 20 * MILLISECOND
"""Period of what is not known, or about to change"""
MOST = (1 << 31) - 1
"""Steps at which a position or velocity ends"""
NEAR, MOVING = 0.003, 0.05
"""rad between shaft and set-point of a device that is armed, and s of its velocity beside"""
DETAILS = {
    "Baud_Rate": "it answers at the new rate from now on",
    "ID": "give it this address in the robot file, too",
}
"""What is still to be done when a register was written"""


@dataclass(slots=True)
class Own(Known):
    """What is known of one device beyond its phase. Plain data."""

    alert: bool = False
    """Its last answer says that it has a hardware error."""

    def warn(self, *, alert: bool) -> None:
        """Record what an answer says of hardware errors."""
        self.alert = alert


class DynamixelAdapter(ServoAdapter[Own]):
    """What devices are sent, and what they report."""

    name, kind = dt.NAME, Own
    packets, supply = dx.PACKETS, "Present_Input_Voltage"
    faults = dt.ALL_FAULTS
    not_armed = dt.NOT_ARMED
    commanded = dt.COMMANDED
    clearing = REBOOT
    silence = 3 * MILLISECOND
    arming = 3 * SECOND
    details = DETAILS

    # -- received -------------------------------------------------------------------------------------

    def who(self, number: int) -> Exchange:
        return self.packets.tells(number, PING, b"", f"{number} ping", SLOWEST, 3, Rank.BACKGROUND)

    def note(self, question: Packet, data: bytes) -> str:
        return dx.note(data) if question.instruction == PING and len(data) == 3 else ""

    def refusal(self, error: int) -> str:
        wrong = error & ~dx.ALERT
        return dt.ERRORS.get(wrong, f"error {wrong}") if wrong else ""

    def faults_in(self, host: Host[Own], error: int, values: Values) -> Collection[int] | None:
        host.own.warn(alert=bool(error & dx.ALERT))
        if not values.keys() >= {"Hardware_Error_Status", "Bus_Watchdog"}:  # of its state, or one alone
            return None
        bits, tripped = values["Hardware_Error_Status"], values["Bus_Watchdog"] == dt.TRIPPED
        return [bit for bit in dt.FAULTS if bits & bit] + [dt.WATCHDOG] * tripped

    def shaft(self, t: Nanos, host: Host[Own], values: Values) -> Motion | None:
        if "Present_Position" not in values or "Present_Velocity" not in values:
            return None
        model, position = host.options.of, values["Present_Position"]
        # Disarmed it counts on beyond its turn, and begins anew when it is armed: there it has no place.
        counts, speed = position - model.zero, values["Present_Velocity"]
        one_turn = host.options.mode == "position"
        known = -model.counts <= 2 * counts < model.counts if one_turn else abs(position) < MOST
        return counts * model.count if known else None, speed * model.step if abs(speed) < MOST else None

    # -- commands -------------------------------------------------------------------------------------

    def refuse(self, host: Host[Own], command: Command) -> str:
        options, known = host.options, host.own.values
        number, mode = known.get("Model_Number", options.of.number), options.operating_mode
        if number != options.of.number:
            return f"it is another model than the robot file has: {dt.BY_NUMBER.get(number, number)}"
        if host.mode is Mode.ARMED and known.get("Operating_Mode", mode) != mode:
            return f"it runs in Operating_Mode {known['Operating_Mode']}: disarm it first"
        for name, ours, option in (
            ("Velocity_Limit", options.velocity if options.mode == "velocity" else 0, "max_velocity"),
            ("Current_Limit", options.current if "current" in options.mode else 0, "max_current"),
        ):
            if known.get(name, ours) < ours:
                return f"its {name} is {known[name]}, and must be {ours}, or {option} lower"
        if isinstance(command, msg.Position) and options.mode == "position":
            model = options.of
            raw = command.position / model.count + model.zero
            least, most = known.get("Min_Position_Limit", raw), known.get("Max_Position_Limit", raw)
            if not least - 1 < raw < most + 1:
                ends = [(end - model.zero) * model.count for end in (least, most)]
                return f"position {command.position:.4g} lies outside its {ends[0]:.4g} … {ends[1]:.4g}"
        return ""

    def ready(self, host: Host[Own]) -> bool:
        return host.own.read_at.keys() >= {"stored", "state"}

    def arm(self, now: Nanos, host: Host[Own], command: Command) -> Sequence[Frame]:
        own, options = host.own, host.options
        if options.indirect and "indirect" not in own.read_at:
            return self.ask(now, host, "indirect")
        wrong = own.different(own.set_up)
        if "Operating_Mode" in wrong:
            if now >= own.due("mode", AGAIN):
                own.ask(now, "mode")
                self.put(host, {"Operating_Mode": wrong["Operating_Mode"]}, Rank.QUESTION)
            return self.ask(now, host, "stored")
        goal, there, near = own.goal, 0, 0.0
        if goal.command is msg.Position:  # it is armed where it stands
            there = round((host.position or 0.0) / goal.unit) + goal.zero
            near = (NEAR + MOVING * abs(own.values["Present_Velocity"] * options.of.step)) / goal.unit
        if abs(own.values.get(goal.register, 1 << 31) - there) > near:
            wrong[goal.register] = there
        if wrong:
            self.put(host, dict(sorted(wrong.items(), key=lambda each: options.table.target(each[0]))))
        elif now - own.read_at["state"] <= FRESH:
            self.put(host, {"Torque_Enable": 1})
        indirect = any(name.startswith("Indirect") for name in wrong)
        return [*self.ask(now, host, "state"), *(self.ask(now, host, "indirect") if indirect else ())]

    def command(self, now: Nanos, host: Host[Own], command: Command) -> Sequence[Frame]:
        own = host.own
        self.set_point(host, command)
        # One that runs already may have been set up by another host.
        if now < own.due("set-up", AGAIN) or not self.ready(host):
            return ()
        own.ask(now, "set-up")
        wrong = own.different(own.set_up)
        alive = {name: raw for name, raw in wrong.items() if name in ("Bus_Watchdog", "Goal_Current")}
        self.put(host, alive)
        return self.ask(now, host, "state") if alive else ()

    # -- by itself ------------------------------------------------------------------------------------

    def target(self, host: Host[Own], block: str) -> Target:
        own, options = host.own, host.options
        table: dt.ControlTable = options.table
        if block == "motion" and options.indirect and {"indirect", "stored"} <= own.read_at.keys():
            places = tuple(own.values.get(f"Indirect_Address_{k + 1}") for k in range(dt.INDIRECT))
            if places == table.indirect:
                return dt.data_of(options.of, own.values["Firmware_Version"]), len(places)
        return super().target(host, block)

    def chain(self, host: Host[Own]) -> str:
        return "fast" if host.options.fast else "one by one"

    def chained(self, chain: str, wanted: Targets, about: str, delay: Nanos) -> Exchange:
        return self.packets.chained(wanted, about, delay, fast=chain == "fast")

    def wanted(self, host: Host[Own]) -> Iterable[tuple[str, Nanos]]:
        own, options = host.own, host.options
        period = round(options.feedback_ms * MILLISECOND)
        found: list[tuple[str, Nanos]] = []
        soon = max(period, SOON)
        if "stored" not in own.read_at:
            found.append(("stored", soon))
        elif options.indirect and "indirect" not in own.read_at:
            found.append(("indirect", soon))
        with_state = self.target(host, "motion") != options.table.blocks["motion"]
        slow = round(options.state_ms * MILLISECOND) * (10 if with_state else 1)
        hurry = not self.settled(host) or own.alert != bool(host.active)
        found.append(("state", soon if hurry else slow))
        if host.mode is not None and not host.offline:
            found.append(("motion", period))
        return found

    # -- requests -------------------------------------------------------------------------------------

    def clears(self, now: Nanos, host: Host[Own]) -> Sequence[Frame]:
        """Return what restarts it: it is read again."""
        self.forget(now, host)
        own = host.own
        return (self.packets.tells(own.id, dx.REBOOT, b"", f"{own.id} reboot", self.delay(host)),)

    def zeroing(self, host: Host[Own]) -> tuple[Sequence[Frame], int] | str:
        """Return what writes the Homing_Offset with which it stands at zero, or why there is none."""
        known, options = host.own.values, host.options
        model: dt.Model = options.of
        if host.position is None or "Homing_Offset" not in known:
            return "its position is not known"
        offset = known["Homing_Offset"] - round(host.position / model.count)
        most = OFFSET_OF_ONE_TURN * model.counts // 4096 if options.mode == "position" else model.far
        if abs(offset) > most:
            return (
                f"Homing_Offset would be {offset}: in this mode it counts to {most} only; mount the horn anew"
            )
        return (self.change(host, "Homing_Offset", offset),), offset

    def answer(self, t: Nanos, pending: Pending[Own], report: Report[Own]) -> Event | None:
        rebooting = isinstance(pending.request, msg.ClearFault) and pending.host is not None
        if rebooting and pending.host and "stored" not in pending.host.own.read_at:
            return None  # it has not restarted yet, or is not known again
        return super().answer(t, pending, report)
