"""What a drive obeys: its dictionary, its power state as its host drives it, and the resulting commands.

Rules. `Memory` is the part of one drive's state that frames from the host determine, on top of its `Node`.
The command decoder has one per device, and the twin's firmware runs on the very same class, so the two cannot
disagree on what is obeyed. What only the firmware can know (a fault, standstill after a quick stop) the twin
enters; the memory of a decoder does not wait for standstill (`instant`), nor does it know of faults. A frame
that changes nothing yields no command: set-points to a drive that is not in OPERATION ENABLED are stored, and
yield a command when it is enabled.

Source: CiA 402-2 (states, modes, option codes, set-point handshake of profile position).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from protocols import messages as msg
from protocols.asked import waiting
from protocols.canopen import objects as co
from protocols.canopen import sdo, services
from protocols.canopen.dictionary import Dictionary, pdo_defaults
from protocols.canopen.lss import Slave
from protocols.canopen.node import Listeners, Node, Received
from protocols.canopen.objects import Key, title
from protocols.canopen.services import NMT_STATE, NmtCommand
from protocols.cia402 import objects as o
from protocols.cia402.objects import OBJECTS, SIGNATURES, TARGETS
from protocols.cia402.profile import POWERED, Control, Demand, Mode, PowerState, demand_of, supports
from protocols.cia402.settings import LOWEST, ONLY, SETTING_OBJECTS, Settings, twin_units
from protocols.cia402.state_machine import HOLDING_QUICK_STOPS, next_state
from protocols.cia402.units import READ
from protocols.frames import Frame
from protocols.messages import Command, Nanos, Obeyed
from protocols.plugin import Device

SYNC, HEARTBEAT, LSS, RESET = "SYNC", "heartbeat", "LSS", "NMT reset communication"
"""What stands for these of the host."""
IDENTITY = (co.VENDOR_ID, co.PRODUCT_CODE, co.REVISION, co.SERIAL_NUMBER)
NUMBER_OF: Mapping[Key, str] = {
    o.TARGET_POSITION: "position",
    **dict.fromkeys((o.TARGET_VELOCITY, o.VELOCITY_OFFSET), "velocity"),
    **dict.fromkeys((o.TARGET_TORQUE, o.TORQUE_OFFSET), "torque"),
}
"""The number of a command that each set-point is."""
DISCONNECTS = (NmtCommand.STOP, NmtCommand.RESET_COMMUNICATION)
"""With these the host is lost, to a drive that gives torque: the reaction is in 6007."""
MODES = {int(mode): mode for mode in Mode}
USUAL_RPDOS = ((o.CONTROLWORD, o.MODE, o.TARGET_POSITION), (o.TARGET_VELOCITY, o.TARGET_TORQUE))
USUAL_TPDOS = ((o.STATUSWORD, o.MODE_DISPLAY, o.POSITION), (o.VELOCITY, o.TORQUE, o.ERROR_CODE))
"""PDOs of a drive that is delivered with a mapping (`Settings.pdos`)."""
CONSTANTS: dict[Key, int] = {
    co.DEVICE_TYPE: 0x0002_0192,  # profile 402, servo drive
    o.ENCODER_REVOLUTIONS: 1,
    o.INTERPOLATION_INDEX: -3,
}


def refuse(values: Mapping[Key, int], key: Key, value: int) -> int:
    """Return the abort code with which the drive refuses a value, or 0."""
    if key == o.MODE:
        taken = value in MODES and supports(values[o.SUPPORTED_MODES], MODES[value])
    elif key in ONLY:
        taken = value in ONLY[key]
    else:
        taken = value >= LOWEST.get(key, value)
    return 0 if taken else sdo.BAD_VALUE


def dictionary_of(settings: Settings, node: int) -> Dictionary:
    """Return a drive's dictionary at power-on."""
    usual = settings.pdos == "usual"
    values = CONSTANTS | {key: getattr(settings, name) for name, key in SETTING_OBJECTS.items()}
    values[o.HOMING_SPEED_SWITCH] = settings.homing_speed
    values[co.SERIAL_NUMBER] = settings.serial_number or 0x0402_0000 + node
    values |= pdo_defaults(OBJECTS, node, USUAL_RPDOS, USUAL_TPDOS) if usual else pdo_defaults(OBJECTS, node)
    return Dictionary(
        OBJECTS,
        node,
        values,
        {co.DEVICE_NAME: settings.device_name, co.HARDWARE_VERSION: "twin", co.SOFTWARE_VERSION: "1"},
        refuse,
        volatile=TARGETS | {o.CONTROLWORD},
        lacks=frozenset(int(index, 16) for index in settings.lacks.split()),
    )


def _acts(key: Key, command: Command) -> bool:
    """True if a command is another by an object: a target of another mode is only kept."""
    return key not in NUMBER_OF or hasattr(command, NUMBER_OF[key])


class Memory:
    """The state of one drive, as far as its host determines it. Plain data."""

    def __init__(self, device: Device, instant: bool) -> None:
        self.motor, self.instant = device.name, instant
        self._settings = device.settings
        dictionary = dictionary_of(device.settings, device.address)
        one: Any = tuple(dictionary.values[key] for key in IDENTITY)
        slave = Slave(None if instant else one, addressed=instant or device.settings.has_node_id)
        self.node = Node(dictionary, device.address, slave)
        self.demanded_position = 0
        """The base of a relative set-point while none is active; a decoder does not know it."""
        self._start()

    def _start(self) -> None:
        """Set the state after power-on."""
        self.state = PowerState.SWITCH_ON_DISABLED
        self.control = 0
        """The last controlword."""
        self.goal: int | None = None
        """The active set-point of profile position."""
        self.next_goal: int | None = None
        """The one after it."""
        self.homing_requested = False
        """The firmware is to begin homing."""
        self._latched: dict[Key, int] = {}
        """What waits for the next SYNC."""
        self.units = twin_units(self.values)
        self._mode_before = self.mode

    @property
    def values(self) -> dict[Key, int]:
        """Values of the dictionary."""
        return self.node.dictionary.values

    @property
    def mode(self) -> Mode:
        """6061."""
        return MODES[self.values[o.MODE]]

    @property
    def enabled(self) -> bool:
        """True in OPERATION ENABLED."""
        return self.state is PowerState.OPERATION_ENABLED

    @property
    def acknowledged(self) -> bool:
        """Bit 12 of the statusword in profile position."""
        return bool(self.control & Control.NEW_SETPOINT) or self.next_goal is not None

    # -- the firmware's part --------------------------------------------------------------------------

    def enter(self, state: PowerState) -> None:
        """Change the power state, which ends profile position's set-points."""
        self.state, self.goal, self.next_goal = state, None, None

    def settle(self, position: int) -> None:
        """Note the demanded position."""
        self.demanded_position = position

    def finish_setpoint(self) -> None:
        """Go on to the next set-point of profile position: the active one is reached."""
        self.goal, self.next_goal = self.next_goal, None

    def take_homing(self) -> bool:
        """Return whether homing was requested, once."""
        requested, self.homing_requested = self.homing_requested, False
        return requested

    # -- obeying ------------------------------------------------------------------------------------------

    def obey(self, received: Received) -> Sequence[Obeyed]:
        """React to what a frame did to the node."""
        if received.lss is not None:
            node = self.node.lss.node if self.node.lss is not None else 0
            return (msg.Kept(self.motor, LSS, float(node)),) if received.lss_sets else ()
        taken = self._take_address(received.node) if received.node else ()
        if received.command is NmtCommand.RESET_NODE:
            self._start()
            return msg.Reboot(self.motor), *taken
        if received.command is None:
            if received.sync:
                self._latched.clear()
            obeyed = self._on_written(received.written) if received.written else ()
            return obeyed or (self._waits(received.latched) if received.latched else ())
        obeyed = list(self.lose_connection()) if received.command in DISCONNECTS else []
        resets = received.command is NmtCommand.RESET_COMMUNICATION
        kind = msg.WriteParameter if received.changed or resets else msg.Kept
        obeyed.append(kind(self.motor, NMT_STATE, float(self.node.nmt)))
        return [*obeyed, *taken, msg.Kept(self.motor, RESET, 1.0)] if resets else obeyed

    def _take_address(self, node: int) -> Sequence[Obeyed]:
        """Take the node id that LSS has given, and the identifiers that follow from it."""
        settings = replace(self._settings, serial_number=self.values[co.SERIAL_NUMBER])
        self.node.move(node, dictionary_of(settings, node))
        return (msg.SetAddress(self.motor, node),)

    def lose_connection(self) -> Sequence[Obeyed]:
        """React to a lost host as object 6007 demands; the fault of option 1 is the firmware's part."""
        option = self.values[o.ABORT_CONNECTION]
        if self.state not in POWERED or not option:
            return ()
        if option == 1:
            if self.instant:
                self.enter(PowerState.FAULT)
            return (msg.Idle(self.motor),)
        return self._demand(Demand.QUICK_STOP if option == 3 else Demand.DISABLE_VOLTAGE)

    def _on_written(self, keys: Sequence[Key]) -> Sequence[Obeyed]:
        """React to objects that were written at the same time."""
        changed = self.mode is not self._mode_before
        if changed:
            self._mode_before, self.goal, self.next_goal = self.mode, None, None
        acting = [key for key in keys if key in TARGETS or key in (o.CONTROLWORD, o.MODE)]
        obeyed: list[Obeyed] = [self._written(key) for key in keys if key not in acting]
        if any(key in READ for key in keys):
            self.units = twin_units(self.values)
        if o.CONTROLWORD in acting:
            obeyed += self._on_controlword(self.values[o.CONTROLWORD])
        if not acting:
            return obeyed
        found = self.command()
        if any(_acts(key, one) for key in acting for one in found):
            obeyed += found if self.enabled else waiting(*found)
        # What else it keeps of these: nothing of it acts by itself.
        if o.CONTROLWORD in acting and not (obeyed and self.enabled):
            obeyed.append(self._kept(o.CONTROLWORD))
        if o.MODE in acting and (changed or not obeyed):
            obeyed.append(self._kept(o.MODE))
        return obeyed or [self._number(key) for key in acting]

    def _waits(self, latched: Mapping[Key, int]) -> Sequence[Obeyed]:
        """Return what the next SYNC makes of set-points: their numbers, and a controlword and a mode."""
        values = self.values
        self._latched |= latched
        before = {key: values[key] for key in self._latched if key in values}
        values.update((key, each) for key, each in self._latched.items() if key != o.MODE or each in MODES)
        names = {NUMBER_OF[key] for key in latched if key in NUMBER_OF}
        found = [each for each in waiting(*self.command()) if each.name.partition(".")[2] in names]
        kept = [
            self._kept(key)
            for key, value in latched.items()
            if key == o.CONTROLWORD or (key == o.MODE and value != before.get(key))
        ]
        values.update(before)
        return [*found, *kept] or (msg.Kept(self.motor, SYNC, 0.0),)

    def _number(self, key: Key) -> msg.Kept:
        """Return that a target of another mode was written, as the number of that mode's command."""
        units, value = self.units, self.values[key]
        match key:
            case o.TARGET_POSITION:
                return msg.Kept(self.motor, "Position.position", units.position(value))
            case o.TARGET_VELOCITY:
                return msg.Kept(self.motor, "Velocity.velocity", units.velocity(value))
            case o.TARGET_TORQUE:
                return msg.Kept(self.motor, "Torque.torque", units.torque(value))
        return self._kept(key)

    def _kept(self, key: Key) -> msg.Kept:
        """Return that an object was written which acts with others."""
        return msg.Kept(self.motor, title(key), float(self.values[key]))

    def _written(self, key: Key) -> msg.WriteParameter:
        """Return that an object was written; by its name, with 1, if it takes nothing but a signature."""
        for name, (signed, _) in SIGNATURES.items():
            if key == signed:
                return msg.WriteParameter(self.motor, name, 1.0)
        return msg.WriteParameter(self.motor, title(key), float(self.values[key]))

    def _on_controlword(self, control: int) -> Sequence[Obeyed]:
        before, self.control = self.control, control
        obeyed = list(self._demand(demand_of(control, before)))
        if self.enabled and control & ~before & Control.NEW_SETPOINT:
            if self.mode is Mode.PP:
                self._accept_setpoint(control)
            elif self.mode is Mode.HM:
                self.homing_requested = True
                obeyed.append(msg.Home(self.motor))
        return obeyed

    def _demand(self, demand: Demand | None) -> Sequence[Obeyed]:
        option, before = self.values[o.QUICK_STOP_OPTION], self.state
        state = next_state(before, demand, option)
        if state is not before:
            self.enter(state)
        if demand is Demand.FAULT_RESET:
            return (msg.ClearFault(self.motor),)
        if state is before:
            return ()
        if state is PowerState.QUICK_STOP:
            if self.instant and option not in HOLDING_QUICK_STOPS:
                self.state = PowerState.SWITCH_ON_DISABLED
            return (msg.Estop(self.motor),)
        if self.enabled:
            return (msg.Arm(self.motor),)
        return (msg.Idle(self.motor),) if before in POWERED else ()

    def _accept_setpoint(self, control: int) -> None:
        """Take a new set-point of profile position: at once, or after the active one."""
        target = self.values[o.TARGET_POSITION]
        if control & Control.RELATIVE:
            base = self.demanded_position if self.goal is None else self.goal
            target += base if self.next_goal is None else self.next_goal
        if self.goal is None or self.instant or control & Control.CHANGE_IMMEDIATELY:
            self.goal, self.next_goal = target, None
        elif self.next_goal is None:
            self.next_goal = target

    def command(self) -> Sequence[Command]:
        """Return the command that the present set-points amount to; () if there is none."""
        value, units, motor = self.values, self.units, self.motor
        if self.control & Control.HALT:
            return (msg.Velocity(motor, 0.0),)
        torque = units.torque(value[o.TORQUE_OFFSET])
        match self.mode:
            case Mode.PP:
                goal = self.goal if self.next_goal is None else self.next_goal
                return () if goal is None else (msg.Position(motor, units.position(goal)),)
            case Mode.PV:
                return (msg.Velocity(motor, units.velocity(value[o.TARGET_VELOCITY])),)
            case Mode.PT:
                return (msg.Torque(motor, units.torque(value[o.TARGET_TORQUE])),)
            case Mode.CSP:
                velocity = units.velocity(value[o.VELOCITY_OFFSET])
                return (msg.Position(motor, units.position(value[o.TARGET_POSITION]), velocity, torque),)
            case Mode.CSV:
                velocity = units.velocity(value[o.TARGET_VELOCITY] + value[o.VELOCITY_OFFSET])
                return (msg.Velocity(motor, velocity, torque),)
            case Mode.CST:
                return (msg.Torque(motor, units.torque(value[o.TARGET_TORQUE] + value[o.TORQUE_OFFSET])),)
        return ()


class Cia402Decoder:
    """The drives of one bus, as receivers of commands."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self.memories = [Memory(device, instant=True) for device in devices]
        self._listeners = Listeners([memory.node for memory in self.memories])
        self._first, self._host = devices[0].name, devices[0].options.host_id

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return the commands and requests that the devices would obey; [] if none would do anything."""
        obeyed: list[Obeyed] = []
        for at in self._listeners.of(frame):
            memory = self.memories[at]
            received = memory.node.receive(t, frame)
            obeyed += [] if received is None else memory.obey(received)
        return obeyed or self._of_all(frame)

    def _of_all(self, frame: Frame) -> Sequence[Obeyed]:
        """Return what a host sends to all drives: it makes none do anything but go on."""
        match services.decode(frame):
            case services.Sync():
                return (msg.Kept(self._first, SYNC, 0.0),)
            case services.Heartbeat(node, state) if node == self._host:
                return (msg.Kept(self._first, HEARTBEAT, float(state)),)
        return ()
