"""What ODrives would obey: mode and state remembered, a frame becomes the words that it means.

Rules. `Axis` is what one device remembers of what it was told; the twin's firmware runs on the very same
object, so ear and twin cannot disagree on what is obeyed. A frame that changes nothing gives no word: a
set-point to a disarmed axis is remembered and says nothing until the axis arms. Broadcasts (node 0x3F)
reach every device of 0.6.x for Reboot, Clear_Errors and Address, as in odriverobotics/ODriveResources@06dc846
`examples/can_enumerate.py`; in 0.5.x both axes of a board hear Reboot and Clear_Errors of either
(odriverobotics/ODrive@f9b5419 `communication/can/can_simple.cpp`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Nanos, Request
from protocols.messages import Estop as EstopWord
from protocols.messages import Reboot as RebootWord
from protocols.odrive_can.codec import (
    BROADCAST,
    EXTENDED,
    MAX_EXTENDED_NODE,
    AnyMessage,
    decode_to_device,
    node_of,
    radians,
)
from protocols.odrive_can.messages import (
    Address,
    Ask,
    AxisState,
    ClearErrors,
    ControlMode,
    EnterDfuMode,
    Estop,
    InputMode,
    Reboot,
    RxSdo,
    SetAbsolutePosition,
    SetAxisState,
    SetControllerMode,
    SetInputPos,
    SetInputTorque,
    SetInputVel,
    SetLimits,
    SetPosGain,
    SetTrajAccelLimits,
    SetTrajInertia,
    SetTrajVelLimit,
    SetVelGains,
)
from protocols.odrive_can.messages05 import (
    ClearErrors05,
    Reboot05,
    SetAxisNodeId,
    SetLinearCount,
    StartAnticogging,
)
from protocols.odrive_can.options import Settings, line_of, node_of_device, serial_of
from protocols.plugin import Device

BROADCASTS = (Reboot, ClearErrors, Address)
"""What a device of 0.6.x takes from the broadcast node."""
BOARD = (Reboot05, ClearErrors05)
"""What an axis of 0.5.x takes from the other axis on its board."""


@dataclass(slots=True)
class Axis:
    """What one device remembers of what it was told. Turns, turns/s, N·m."""

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

    def word(self) -> Sequence[Command]:
        """The command that the inputs amount to now."""
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
    """A device as it stands after power-on."""
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


def obey(axis: Axis, message: AnyMessage) -> Sequence[Command | Request]:
    """Let an axis hear a message to its own node; what that makes it do, in words."""
    match message:
        case SetInputPos(position, velocity, torque):
            axis.position, axis.velocity, axis.torque = position, velocity, torque
            return axis.word()
        case SetInputVel(velocity, torque):
            axis.velocity, axis.torque = velocity, torque
            return axis.word()
        case SetInputTorque(torque):
            axis.torque = torque
            return axis.word()
        case SetControllerMode(control_mode, input_mode):
            return _set_mode(axis, control_mode, input_mode)
        case SetAxisState(state):
            return _set_state(axis, state)
        case Estop():
            axis.armed = False
            return (EstopWord(axis.motor),)
        case Reboot() | Reboot05() | EnterDfuMode():
            axis.armed = False
            return (RebootWord(axis.motor),)
        case ClearErrors() | ClearErrors05():
            return (msg.ClearFault(axis.motor),)
        case SetAxisNodeId(node):
            axis.node = renamed(axis.node, node)
            return (msg.SetId("", axis.serial, node),)
    return _configure(axis.motor, message)


def _set_mode(axis: Axis, control_mode: int, input_mode: int) -> Sequence[Command]:
    if control_mode == ControlMode.POSITION and axis.control_mode != ControlMode.POSITION:
        axis.position = None
    axis.control_mode, axis.input_mode = control_mode, input_mode
    return axis.word()


def _set_state(axis: Axis, state: int) -> Sequence[Command | Request]:
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
    return axis.word()


def _configure(motor: str, message: AnyMessage) -> Sequence[Request]:
    match message:
        case SetAbsolutePosition(position):
            return (
                (msg.Zero(motor),)
                if position == 0
                else (msg.WriteParameter(motor, "Position", radians(position)),)
            )
        case SetLinearCount(count):
            return (
                (msg.Zero(motor),)
                if count == 0
                else (msg.WriteParameter(motor, "Linear_Count", float(count)),)
            )
        case StartAnticogging():  # a procedure of the device's own that turns the shaft
            return (msg.Home(motor),)
        case SetLimits(velocity, current):
            return (
                msg.WriteParameter(motor, "Velocity_Limit", velocity),
                msg.WriteParameter(motor, "Current_Limit", current),
            )
        case SetVelGains(gain, integrator):
            return (
                msg.WriteParameter(motor, "Vel_Gain", gain),
                msg.WriteParameter(motor, "Vel_Integrator_Gain", integrator),
            )
        case SetTrajAccelLimits(acceleration, deceleration):
            return (
                msg.WriteParameter(motor, "Traj_Accel_Limit", acceleration),
                msg.WriteParameter(motor, "Traj_Decel_Limit", deceleration),
            )
        case SetPosGain(gain):
            return (msg.WriteParameter(motor, "Pos_Gain", gain),)
        case SetTrajVelLimit(velocity):
            return (msg.WriteParameter(motor, "Traj_Vel_Limit", velocity),)
        case SetTrajInertia(inertia):
            return (msg.WriteParameter(motor, "Traj_Inertia", inertia),)
        case RxSdo(1, endpoint, _, value):
            return (msg.WriteParameter(motor, f"endpoint {endpoint}", float(value)),)
    return ()


class OdriveDecoder:
    """What the ODrives of one bus would obey."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self.axes = [axis_of(device) for device in devices]
        self._lines = sorted({axis.line for axis in self.axes})

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:  # noqa: ARG002 -- the interface's
        """The words that the devices would obey; [] if none would do anything."""
        if not isinstance(frame, CanFrame):
            return []
        node = node_of(frame)
        words: list[Command | Request] = []
        for line in self._lines:
            message = decode_to_device(frame, line)
            if message is not None and not isinstance(message, Ask):
                words += [w for axis in self.axes if axis.line == line for w in decode(axis, node, message)]
        return words


def decode(axis: Axis, node: int, message: AnyMessage) -> Sequence[Command | Request]:
    """Let an axis hear a message to any node; what that makes it do."""
    if isinstance(message, SetAxisNodeId) and node == axis.other:
        axis.other = renamed(node, message.node)
    if isinstance(message, Address):
        return assign(axis, node, message)
    return obey(axis, message) if addressed(axis, node, message) else ()


def addressed(axis: Axis, node: int, message: AnyMessage) -> bool:
    """Whether a message to this node is for this axis."""
    return (
        node == axis.node
        or (node == BROADCAST and isinstance(message, BROADCASTS))
        or (node == axis.other and isinstance(message, BOARD))
    )


def renamed(node: int, to: int) -> int:
    """A node with another node id, and its kind of identifiers."""
    return to & MAX_EXTENDED_NODE | node & EXTENDED


def assign(axis: Axis, node: int, message: Address) -> Sequence[msg.SetId]:
    """A node id is given out on the broadcast node: take it, or vacate it if it is ours."""
    if node != BROADCAST or message.node > BROADCAST:
        return ()
    if message.serial == axis.serial:
        axis.node = message.node
        return (msg.SetId("", axis.serial, axis.node),)
    if message.node == axis.node and axis.node != BROADCAST:
        axis.node = BROADCAST
        return (msg.SetId("", axis.serial, BROADCAST),)
    return ()
