"""What a drive obeys: its dictionary, NMT and power state as its host drives them, and the resulting
commands.

Rules. `Axis` is the part of one drive's state that frames from the host determine. The command decoder has
one per device, and the twin's firmware runs on the very same class, so the two cannot disagree on what is
obeyed. What only the firmware can know (a fault, standstill after a quick stop) the twin sets from outside;
the axis of a decoder does not wait for standstill (`instant`). A frame that changes nothing yields no
command: set-points to a drive that is not in OPERATION ENABLED are stored, and yield a command when it is
enabled. PDOs are received in NMT operational only, SDO not in NMT stopped.

Source: CiA 301 (NMT, PDO, SYNC); CiA 402-2 (modes, set-point handshake of profile position).
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum, auto

from protocols import messages as msg
from protocols.canopen import sdo
from protocols.canopen import services as codec
from protocols.canopen.pdo import DISABLED, is_synchronous
from protocols.canopen.server import SdoServer
from protocols.canopen.services import NmtCommand, NmtState
from protocols.cia402 import objects as o
from protocols.cia402.dictionary import Dictionary
from protocols.cia402.objects import TARGETS, Key, title
from protocols.cia402.options import Settings
from protocols.cia402.profile import Control, Demand, Mode, PowerState, demand_of
from protocols.cia402.state_machine import HOLDING_QUICK_STOPS, next_state
from protocols.cia402.units import READ, Units, units_of
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Nanos, Obeyed
from protocols.plugin import Device

MODES = {int(mode): mode for mode in Mode}
NMT_STATE = "NMT state"
"""The parameter that an NMT command changes."""
COMMUNICATION_END = 0x2000
"""The objects below it are communication parameters."""
NEXT_STATE = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}


class Signal(Enum):
    """Events that the firmware behind an axis handles."""

    SYNC = auto()
    RESET_NODE = auto()
    RESET_COMMUNICATION = auto()
    CONNECTION_LOST = auto()
    """NMT stopped or reset: the reaction is in object 6007."""


class Axis:
    """The state of one drive, as far as its host determines it. Plain data."""

    def __init__(self, device: Device, instant: bool) -> None:
        self.settings: Settings = device.settings
        self.motor, self.node = device.name, device.address
        self.instant = instant
        self.signals: list[Signal] = []
        """For the firmware, in order."""
        self.responses: list[sdo.Response] = []
        """To SDO requests, in order."""
        self.position = 0
        """The base of a relative set-point while none is active; a decoder does not know it."""
        self.fault_persists = False
        """The cause of a fault is present: it cannot be reset."""
        self.start()

    def start(self) -> None:
        """Set the state after power-on."""
        self.dictionary = Dictionary(self.settings, self.node)
        self.server = SdoServer()
        self.nmt = NmtState.PRE_OPERATIONAL
        self.state = PowerState.SWITCH_ON_DISABLED
        self.control = 0
        """The last controlword."""
        self.mode_before = self.mode
        self.latched: dict[int, tuple[int, ...]] = {}
        """Values of synchronous RPDOs that wait for a SYNC, by the index of the PDO."""
        self.received: dict[int, Nanos] = {}
        """When each RPDO came last."""
        self.host_beat: Nanos | None = None
        """When the heartbeat that object 1016 names came last."""
        self.goal: int | None = None
        """The active set-point of profile position."""
        self.next_goal: int | None = None
        """The one after it."""
        self.homing_requested = False
        """The firmware is to begin homing."""
        self.units = self._units()
        self._ids = self._rpdo_ids()

    def _units(self) -> Units:
        units = units_of({key: self.dictionary.values[key] for key in READ})
        if isinstance(units, str):
            raise ValueError("the dictionary keeps 608F, 6091 and 6092 above zero")
        return units

    def _rpdo_ids(self) -> dict[int, list[int]]:
        """Return the RPDOs of each identifier, by their index."""
        ids: dict[int, list[int]] = {}
        for number in o.PDO_NUMBERS:
            index = o.RPDO_COMMUNICATION + number - 1
            cob = self.dictionary.values[index, o.COB_ID]
            if not cob & DISABLED:
                ids.setdefault(cob & 0x7FF, []).append(index)
        return ids

    # -- receiving ----------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Handle a frame; return what the drive obeys."""
        if not isinstance(frame, CanFrame) or not codec.is_classic(frame):
            return ()
        if frame.id == codec.sdo_rx_id(self.node):
            return self._on_sdo(frame.data)
        if frame.id in self._ids:
            return [each for index in self._ids[frame.id] for each in self._on_rpdo(t, index, frame.data)]
        if frame.id > codec.SYNC_ID and frame.id & ~codec.NODE_MASK != codec.HEARTBEAT_BASE:
            return ()
        match codec.decode(frame):
            case codec.Nmt(command, node) if node in (0, self.node):
                return self._on_nmt(command)
            case codec.Sync():
                return self._on_sync()
            case codec.Heartbeat(node, _) if (
                node == self.dictionary.values[o.CONSUMER_HEARTBEAT] >> 16 & 0x7F
            ):
                self.host_beat = t
        return ()

    def _on_nmt(self, command: NmtCommand) -> Sequence[Obeyed]:
        if command is NmtCommand.RESET_NODE:
            self.signals.append(Signal.RESET_NODE)
            self.start()
            return (msg.Reboot(self.motor),)
        obeyed: list[Obeyed] = []
        if command in (NmtCommand.STOP, NmtCommand.RESET_COMMUNICATION):
            obeyed += self.lose_connection()
        if command is NmtCommand.RESET_COMMUNICATION:
            self.signals.append(Signal.RESET_COMMUNICATION)
            self._forget_communication()
        before, self.nmt = self.nmt, NEXT_STATE.get(command, NmtState.PRE_OPERATIONAL)
        if self.nmt is not before or command is NmtCommand.RESET_COMMUNICATION:
            obeyed.append(msg.WriteParameter(self.motor, NMT_STATE, float(self.nmt)))
        if self.nmt is not NmtState.OPERATIONAL:
            self.latched.clear()
            self.received.clear()
        return obeyed

    def _forget_communication(self) -> None:
        fresh = Dictionary(self.settings, self.node)
        kept = {key: value for key, value in self.dictionary.values.items() if key[0] >= COMMUNICATION_END}
        fresh.values |= kept
        self.dictionary, self.server, self.host_beat = fresh, SdoServer(), None
        self._ids = self._rpdo_ids()

    def lose_connection(self) -> Sequence[Obeyed]:
        """React to a lost host as object 6007 demands."""
        option = self.dictionary.values[o.ABORT_CONNECTION]
        if self.state not in _TORQUE or not option:
            return ()
        self.signals.append(Signal.CONNECTION_LOST)
        if option == 3:
            return self._demand(Demand.QUICK_STOP)
        if option == 2:
            return self._demand(Demand.DISABLE_VOLTAGE)
        if self.instant:
            self.state = PowerState.FAULT
        return (msg.Idle(self.motor),)

    def _on_sdo(self, data: bytes) -> Sequence[Obeyed]:
        request = sdo.decode_request(data)
        if request is None or self.nmt is NmtState.STOPPED:
            return ()
        response = self.server.handle(self.dictionary, request)
        if response is not None:
            self.responses.append(response)
        return self._on_written(self.server.written)

    def _on_rpdo(self, t: Nanos, index: int, data: bytes) -> Sequence[Obeyed]:
        packing = self.dictionary.active(index)
        if packing is None or self.nmt is not NmtState.OPERATIONAL:
            return ()
        values = packing.unpack(data)
        if values is None:
            return ()
        self.received[index] = t
        if is_synchronous(self.dictionary.values[index, o.TRANSMISSION]):
            self.latched[index] = values
            return ()
        return self._on_written(self._take(index, values))

    def _on_sync(self) -> Sequence[Obeyed]:
        if self.nmt is not NmtState.OPERATIONAL:
            return ()
        self.signals.append(Signal.SYNC)
        latched, self.latched = self.latched, {}
        # Synchronous RPDOs act together, at the SYNC (CiA 301 "transmission type").
        return self._on_written(
            [key for index in sorted(latched) for key in self._take(index, latched[index])]
        )

    def _take(self, index: int, values: tuple[int, ...]) -> list[Key]:
        """Write the values of an RPDO to the dictionary; return the objects that accepted them."""
        packing = self.dictionary.active(index)
        if packing is None:
            return []
        pairs = [(entry.key, value) for entry, value in zip(packing.entries, values, strict=True)]
        return [key for key, value in pairs if self.dictionary.take(key, value)]

    # -- obeying ------------------------------------------------------------------------------

    @property
    def mode(self) -> Mode:
        """6061."""
        return MODES[self.dictionary.values[o.MODE]]

    @property
    def enabled(self) -> bool:
        """True in OPERATION ENABLED."""
        return self.state is PowerState.OPERATION_ENABLED

    def _on_written(self, keys: Sequence[Key]) -> Sequence[Obeyed]:
        """React to objects that were written at the same time."""
        if self.mode is not self.mode_before:
            self.mode_before = self.mode
            self._drop_setpoints()
        values = self.dictionary.values
        parameters = [key for key in keys if key not in TARGETS and key not in (o.CONTROLWORD, o.MODE)]
        obeyed: list[Obeyed] = [
            msg.WriteParameter(self.motor, title(key), float(values[key])) for key in parameters
        ]
        if any(key[0] < COMMUNICATION_END for key in keys):
            self._ids = self._rpdo_ids()
        if o.CONSUMER_HEARTBEAT in keys:
            self.host_beat = None  # monitored from the next heartbeat on (CiA 301 "heartbeat consumer")
        if any(key in READ for key in keys):
            self.units = self._units()
        if o.CONTROLWORD in keys:
            obeyed += self._on_controlword()
        if self.enabled and any(key in TARGETS or key in (o.CONTROLWORD, o.MODE) for key in keys):
            obeyed += self.command()
        return obeyed

    def _on_controlword(self) -> Sequence[Obeyed]:
        control = self.dictionary.values[o.CONTROLWORD]
        before, self.control = self.control, control
        obeyed = list(self._demand(demand_of(control, before)))
        rising = control & ~before
        if self.enabled and rising & Control.NEW_SETPOINT:
            if self.mode is Mode.PP:
                self._accept_setpoint(control)
            elif self.mode is Mode.HM:
                self.homing_requested = True
                obeyed.append(msg.Home(self.motor))
        return obeyed

    def _demand(self, demand: Demand | None) -> Sequence[Obeyed]:
        if demand is Demand.FAULT_RESET and self.fault_persists:
            return ()
        option = self.dictionary.values[o.QUICK_STOP_OPTION]
        before, self.state = self.state, next_state(self.state, demand, option)
        if demand is Demand.FAULT_RESET:
            return (msg.ClearFault(self.motor),)
        if self.state is before:
            return ()
        self._drop_setpoints()
        if self.state is PowerState.QUICK_STOP:
            if self.instant and option not in HOLDING_QUICK_STOPS:
                self.state = PowerState.SWITCH_ON_DISABLED
            return (msg.Estop(self.motor),)
        if self.enabled:
            return (msg.Arm(self.motor),)
        return (msg.Idle(self.motor),) if before in _TORQUE and self.state not in _TORQUE else ()

    def _drop_setpoints(self) -> None:
        self.goal = self.next_goal = None

    def _accept_setpoint(self, control: int) -> None:
        """Take a new set-point of profile position: at once, or after the active one."""
        target = self.dictionary.values[o.TARGET_POSITION]
        if control & Control.RELATIVE:
            base = self.position if self.goal is None else self.goal
            target += base if self.next_goal is None else self.next_goal
        if self.goal is None or self.instant or control & Control.CHANGE_IMMEDIATELY:
            self.goal, self.next_goal = target, None
        elif self.next_goal is None:
            self.next_goal = target

    @property
    def acknowledged(self) -> bool:
        """Bit 12 of the statusword in profile position."""
        return bool(self.control & Control.NEW_SETPOINT) or self.next_goal is not None

    def command(self) -> Sequence[Command]:
        """Return the command that the present set-points amount to; () if there is none."""
        value, units = self.dictionary.values, self.units
        if self.control & Control.HALT:
            return (msg.Velocity(self.motor, 0.0),)
        match self.mode:
            case Mode.PP:
                goal = self.goal if self.next_goal is None else self.next_goal
                return () if goal is None else (msg.Position(self.motor, units.position(goal)),)
            case Mode.PV:
                return (msg.Velocity(self.motor, units.velocity(value[o.TARGET_VELOCITY])),)
            case Mode.PT:
                return (msg.Torque(self.motor, units.torque(value[o.TARGET_TORQUE])),)
            case Mode.CSP:
                position = units.position(value[o.TARGET_POSITION])
                velocity = units.velocity(value[o.VELOCITY_OFFSET])
                return (msg.Position(self.motor, position, velocity, units.torque(value[o.TORQUE_OFFSET])),)
            case Mode.CSV:
                speed = units.velocity(value[o.TARGET_VELOCITY] + value[o.VELOCITY_OFFSET])
                return (msg.Velocity(self.motor, speed, units.torque(value[o.TORQUE_OFFSET])),)
            case Mode.CST:
                torque = units.torque(value[o.TARGET_TORQUE] + value[o.TORQUE_OFFSET])
                return (msg.Torque(self.motor, torque),)
        return ()


_TORQUE = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP)
"""The states in which a drive gives torque."""
