"""What ODrives would obey: mode and state are kept, a frame is decoded to the commands that it amounts to.

Rules. `Axis` is what one device keeps of the frames it received; the twin's firmware runs on the very same
object, so decoder and twin cannot disagree on what is obeyed. A frame that changes nothing gives no command:
a set-point to a disarmed axis is kept and takes effect when the axis arms. Broadcasts (node 0x3F) reach every
device of 0.6.x for Reboot, Clear_Errors and Address, as in odriverobotics/ODriveResources@06dc846
`examples/can_enumerate.py`; in 0.5.x both axes of a board obey Reboot and Clear_Errors to either
(odriverobotics/ODrive@f9b5419 `communication/can/can_simple.cpp`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Nanos, Obeyed, Request
from protocols.odrive_can import messages as m
from protocols.odrive_can.codec import (
    BROADCAST,
    EXTENDED,
    MAX_EXTENDED_NODE,
    WRITABLE,
    decode_to_device,
    node_of,
    radians,
)
from protocols.odrive_can.messages import AxisState, ControlMode, InputMode
from protocols.odrive_can.options import Settings, line_of, node_of_device, serial_of
from protocols.plugin import Device

BROADCASTS = (m.Reboot, m.ClearErrors, m.Address)
"""What a device of 0.6.x obeys on the broadcast node."""
BOARD = (m.Reboot05, m.ClearErrors05)
"""What an axis of 0.5.x obeys on the node of the other axis on its board."""


@dataclass(slots=True)
class Axis:
    """The commanded state of one device. Turns, turns/s, N·m."""

    motor: str
    line: str
    """Firmware line."""
    node: int
    other: int | None
    """The other axis on its board."""
    serial: int
    control_mode: int
    input_mode: int
    armed: bool = False
    position: float | None = None
    """None: where the shaft was when the axis armed or entered position control."""
    velocity: float = 0.0
    torque: float = 0.0

    def command(self) -> Sequence[Command]:
        """Return the command that mode and inputs amount to now."""
        if not self.armed or self.input_mode == InputMode.INACTIVE:
            return ()
        if self.control_mode == ControlMode.TORQUE:
            return (msg.Torque(self.motor, self.torque),)
        if self.control_mode == ControlMode.VELOCITY:
            return (msg.Velocity(self.motor, radians(self.velocity), self.torque),)
        if self.control_mode != ControlMode.POSITION:
            return ()
        if self.position is None:
            return (msg.Hold(self.motor),)
        return (msg.Position(self.motor, radians(self.position), radians(self.velocity), self.torque),)


def axis_of(device: Device) -> Axis:
    """Return the state of a device after power-on."""
    settings: Settings = device.settings
    other = None if settings.other_axis < 0 else node_of_device(device, settings.other_axis)
    return Axis(
        device.name,
        line_of(device),
        node_of_device(device, device.address),
        other,
        serial_of(settings, device.address),
        settings.control_mode,
        settings.input_mode,
    )


def obey(axis: Axis, message: m.Message) -> Sequence[Obeyed]:
    """Apply a message to an axis' own node; return what it then does."""
    match message:
        case m.SetInputPos(position, velocity, torque):
            axis.position, axis.velocity, axis.torque = position, velocity, torque
            return axis.command()
        case m.SetInputVel(velocity, torque):
            axis.velocity, axis.torque = velocity, torque
            return axis.command()
        case m.SetInputTorque(torque):
            axis.torque = torque
            return axis.command()
        case m.SetControllerMode(control_mode, input_mode):
            return _set_mode(axis, control_mode, input_mode)
        case m.SetAxisState(state):
            return _set_state(axis, state)
        case m.Estop():
            axis.armed = False
            return (msg.Estop(axis.motor),)
        case m.Reboot() | m.Reboot05() | m.EnterDfuMode():
            axis.armed = False
            return (msg.Reboot(axis.motor),)
        case m.ClearErrors() | m.ClearErrors05():
            return (msg.ClearFault(axis.motor),)
        case m.SetAxisNodeId(node):
            axis.node = _with_node_id(axis.node, node)
            return (msg.SetId("", axis.serial, node),)
    return _configure(axis.motor, message)


def _set_mode(axis: Axis, control_mode: int, input_mode: int) -> Sequence[Command]:
    if control_mode == ControlMode.POSITION and axis.control_mode != ControlMode.POSITION:
        axis.position = None
    axis.control_mode, axis.input_mode = control_mode, input_mode
    return axis.command()


def _set_state(axis: Axis, state: int) -> Sequence[Obeyed]:
    if state == AxisState.UNDEFINED:  # no request at all (ODrive@f9b5419 `MotorControl/axis.cpp`)
        return ()
    if state != AxisState.CLOSED_LOOP_CONTROL:
        axis.armed = False
        return (msg.Home(axis.motor),) if state == AxisState.HOMING else (msg.Idle(axis.motor),)
    if not axis.armed or axis.line == "0.5":  # 0.5.x leaves closed loop and enters it again
        # On arming in position control the firmware takes the present position as its input
        # (odriverobotics/ODrive@028a22b `MotorControl/axis.cpp` start_closed_loop_control).
        axis.position = None
        axis.armed = True
    return (msg.Arm(axis.motor), *axis.command())


def _configure(motor: str, message: m.Message) -> Sequence[Request]:
    match message:
        case m.SetAbsolutePosition(position):
            write = msg.WriteParameter(motor, "Position", radians(position))
            return (msg.Zero(motor),) if position == 0 else (write,)
        case m.SetLinearCount(count):
            write = msg.WriteParameter(motor, "Linear_Count", float(count))
            return (msg.Zero(motor),) if count == 0 else (write,)
        case m.StartAnticogging():  # a procedure of the device that turns the shaft
            return (msg.Home(motor),)
        case m.RxSdo(1, endpoint, _, value):
            return (msg.WriteParameter(motor, f"endpoint {endpoint}", float(value)),)
    names = WRITABLE.get(type(message), ())
    fields = zip(names, message.__slots__, strict=True) if names else ()
    return tuple(msg.WriteParameter(motor, name, getattr(message, slot)) for name, slot in fields)


class OdriveDecoder:
    """What the ODrives of one bus would obey."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self.axes = [axis_of(device) for device in devices]
        self._lines = sorted({axis.line for axis in self.axes})

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:  # noqa: ARG002 -- the interface's
        """Decode what the devices would obey; [] if no device would do anything."""
        if not isinstance(frame, CanFrame):
            return []
        node = node_of(frame)
        obeyed: list[Obeyed] = []
        for line in self._lines:
            message = decode_to_device(frame, line)
            if message is not None and not isinstance(message, m.RemoteRequest):
                obeyed += [c for axis in self.axes if axis.line == line for c in receive(axis, node, message)]
        return obeyed


def receive(axis: Axis, node: int, message: m.Message) -> Sequence[Obeyed]:
    """Apply a message to any node to an axis; return what it then does."""
    if isinstance(message, m.SetAxisNodeId) and node == axis.other:
        axis.other = _with_node_id(node, message.node)
    if isinstance(message, m.Address):
        return assign(axis, node, message)
    return obey(axis, message) if addressed(axis, node, message) else ()


def addressed(axis: Axis, node: int, message: m.Message) -> bool:
    """True if a message to this node is for this axis."""
    return (
        node == axis.node
        or (node == BROADCAST and isinstance(message, BROADCASTS))
        or (node == axis.other and isinstance(message, BOARD))
    )


def _with_node_id(node: int, node_id: int) -> int:
    """Return a node with another node id and the same format of identifiers."""
    return node_id & MAX_EXTENDED_NODE | node & EXTENDED


def assign(axis: Axis, node: int, message: m.Address) -> Sequence[msg.SetId]:
    """Apply an assignment on the broadcast node: take the node id, or vacate it if another gets it."""
    if node != BROADCAST or message.node > BROADCAST:
        return ()
    if message.serial == axis.serial:
        axis.node = message.node
        return (msg.SetId("", axis.serial, axis.node),)
    if message.node == axis.node and axis.node != BROADCAST:
        axis.node = BROADCAST
        return (msg.SetId("", axis.serial, BROADCAST),)
    return ()
