"""The device's end: what one motor of a drive obeys, and its firmware.

Rules. A drive is one node with two motors, and a twin is one motor: the two halves of a drive obey the same
frames. The right one responds about its side, the left one about all else; on a CAN bus each receives what
the other sends, and so has its faults. A half without another one responds about all. Only the velocity mode
moves a motor; the loops inside are ours. Its ramps are between 0 and the driver's largest velocity: no source
says of which velocity the times are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from protocols import messages as msg
from protocols.asked import waiting
from protocols.canopen import services
from protocols.canopen.dictionary import Dictionary, pdo_defaults
from protocols.canopen.node import Listeners, Node, Received, Sender
from protocols.canopen.objects import DEVICE_TYPE, Key, Type, title
from protocols.canopen.services import NMT_STATE, NODE_MASK, NmtCommand
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Event, Mode, Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.firmware import ServoFirmware
from protocols.toolkit.servo import Encoder, Gains, approach
from protocols.zlac8015d import table as z

# fmt: off
TRANSITIONS: Mapping[int, Mapping[int, int]] = {
    z.OFF: {z.SHUTDOWN: z.READY},
    z.READY: {z.DISABLE: z.OFF, z.STOP: z.OFF, z.SWITCH_ON: z.SWITCHED_ON, z.ENABLE: z.ENABLED},
    z.SWITCHED_ON: {z.DISABLE: z.OFF, z.STOP: z.OFF, z.SHUTDOWN: z.READY, z.ENABLE: z.ENABLED},
    z.ENABLED: {z.DISABLE: z.OFF, z.STOP: z.QUICK_STOP, z.SHUTDOWN: z.READY, z.SWITCH_ON: z.SWITCHED_ON},
    z.QUICK_STOP: {z.DISABLE: z.OFF, z.ENABLE: z.ENABLED},
    z.FAULT: {},
}
# fmt: on
"""By power state and what a controlword demands: the next state. Any other demand changes nothing."""
REGISTERS = {z.LEFT: 0x01, z.RIGHT: 0x81}
"""Error register in the EMCY of each half."""
DEVICE = 0x2000
"""Objects from here on may have sides."""
ENERGISED = (z.ENABLED, z.QUICK_STOP)


def demand_of(word: int) -> int:
    """Return what a controlword demands, but for RESET, which is an edge and leads from FAULT to OFF."""
    if not word & 0x02:
        return z.DISABLE
    if not word & 0x04:
        return z.STOP
    return word & 0x0F if word & 0x01 else z.SHUTDOWN


class Half:
    """What one motor of a drive keeps of the frames that it receives."""

    def __init__(self, device: Device) -> None:
        self.motor, self.side = device.name, z.side_of(device.address)
        self.unit = z.RPM / device.options.steps_per_rpm
        """rad/s in a step of the target velocity"""
        address = device.address & NODE_MASK
        values = {DEVICE_TYPE: 0x20192, z.OFFLINE_TIME: device.settings.offline_time_ms}
        values |= pdo_defaults(z.OBJECTS, address)
        dictionary = Dictionary(z.OBJECTS, address, values, lacks=z.LACKS, timer_unit=z.TIMER_UNIT)
        self.node = Node(dictionary, address)
        self.state, self.word, self.target = z.OFF, 0, 0

    def receive(self, t: Nanos, frame: Frame) -> tuple[Received | None, Sequence[Obeyed]]:
        """Handle a frame; return what it did to the node, and what the motor then does."""
        received = self.node.receive(t, frame)
        if received is None:
            return None, ()
        if received.command in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
            self.enter(z.OFF)
            return received, (msg.Idle(self.motor), msg.Reboot(self.motor))
        if received.command is not None:
            return received, (msg.Kept(self.motor, NMT_STATE, float(self.node.nmt)),)
        return received, [each for key in received.written for each in self._on_written(key)]

    def enter(self, state: int) -> None:
        """Enter a power state without a controlword."""
        self.state = state

    def _on_written(self, key: Key) -> Sequence[Obeyed]:
        value = self.node.dictionary.values[key]
        if key == z.CONTROL:
            return self._on_control(value)
        if key == (z.TARGET, self.side):
            self.target = value
        elif key == z.SET_POINT:
            self.target = z.part(value, self.side)
        elif key in ((z.TARGET, side) for side in z.SIDES):
            return ()
        elif key != z.MODE:
            return (msg.Kept(self.motor, title(key), float(value)),)
        moves = self._moves()
        obeyed = (moves,) if self.state == z.ENABLED else waiting(moves)
        return obeyed if key != z.MODE else (*obeyed, msg.Kept(self.motor, title(key), float(value)))

    def _moves(self) -> msg.Velocity:
        steps = self.target if self.node.dictionary.values[z.MODE] == z.VELOCITY_MODE else 0
        return msg.Velocity(self.motor, steps * self.unit)

    def _on_control(self, word: int) -> Sequence[Obeyed]:
        before, demand, resets = self.state, demand_of(word), word & z.RESET and not self.word & z.RESET
        after = TRANSITIONS[before].get(demand, before)
        self.state, self.word = z.OFF if resets and before == z.FAULT else after, word
        cleared = (msg.ClearFault(self.motor),) if resets else ()
        if self.state in ENERGISED:
            moves = self._moves() if self.state == z.ENABLED else msg.Velocity(self.motor, 0.0)
            return (*cleared, moves) if before in ENERGISED else (msg.Arm(self.motor), moves)
        if before in ENERGISED or demand == z.DISABLE:
            return *cleared, msg.Idle(self.motor)
        return cleared or (msg.Kept(self.motor, title(z.CONTROL), float(word)),)


class ZlacDecoder:
    """The motors of one bus, as receivers of commands. They know of no fault."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self.halves = [Half(device) for device in devices]
        self._listeners = Listeners([half.node for half in self.halves])

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what the motors would obey in this frame; [] if nothing."""
        return [each for at in self._listeners.of(frame) for each in self.halves[at].receive(t, frame)[1]]


class ZlacTwin(ServoFirmware):
    """One motor, and its half of the drive."""

    faults = z.FAULTS

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed, Gains(torque_limit=device.settings.max_torque))
        self.half = Half(device)
        self.sender = Sender(self.half.node, seed, frozenset())
        self.other = z.LEFT + z.RIGHT - self.half.side
        """The other side."""
        self.alone = True
        """There is no other half on the bus."""
        self.encoder = Encoder(device.options.counts / math.tau)
        self.ramp = 0.0
        """rad/s on the way to the target"""
        self.codes = dict.fromkeys(z.SIDES, 0)
        """Bits of object 603F."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        message = services.decode(frame)
        ours = getattr(message, "node", 0) == self.half.node.address
        if ours and isinstance(message, services.Heartbeat):
            self.alone = False
        elif isinstance(message, services.Emcy) and (ours, message.register) == (True, REGISTERS[self.other]):
            self._fail(self.other, message.code)
        super().receive(t, frame)

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        if self.sender.loses(frame):
            return
        self._measure()
        received, obeyed = self.half.receive(t, frame)
        if received is None:
            return
        self.sender.note(t, received)
        if received.command is NmtCommand.RESET_NODE:
            self.sender.restart()
        self.feed(t)
        for each in obeyed:
            self.obey(t, each)
        self.codes = self.codes if self.mode is Mode.FAULT else dict.fromkeys(z.SIDES, 0)

    def provoke(self, code: int) -> None:
        super().provoke(code)
        elsewhere = code == z.OTHER_MOTOR
        bits = min(z.FAULTS.keys() - {1, 2}) if elsewhere else code
        self._fail(self.other if elsewhere else self.half.side, bits)
        self.sender.error(bits, REGISTERS[self.half.side])

    def _fail(self, side: int, bits: int) -> None:
        self.codes[z.LEFT if bits & z.OF_DRIVE else side] |= bits
        self.trip(bits)
        self.half.enter(z.FAULT)

    def timeout(self) -> Nanos:
        timeout = self.half.node.dictionary.values[z.OFFLINE_TIME] * MILLISECOND
        return timeout if self.mode is Mode.ARMED else 0

    def on_timeout(self) -> None:
        self.disarm()
        self.half.enter(z.OFF)

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        goal = self.goal
        if self.mode is not Mode.ARMED or not isinstance(goal, msg.Velocity):
            self.ramp = self.encoder.velocity
            return super().cycle(now, dt, position, velocity)
        self.ramp = approach(
            dt, self.ramp, goal.velocity, self._slope(z.ACCELERATION), self._slope(z.DECELERATION)
        )
        self.goal = replace(goal, velocity=self.ramp)
        torque = super().cycle(now, dt, position, velocity)
        self.goal = goal
        return torque

    def _slope(self, index: int) -> float:
        """Return a ramp, rad/s²."""
        time = self.half.node.dictionary.values[index, self.half.side]
        return 1000.0 * self.device.options.max_rpm * z.RPM / time if time else math.inf

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        torques, _ = super().step(now, truth)
        self._measure()
        return torques, [frame for frame in self.sender.frames(now) if self._sends(frame)]

    def due(self) -> Nanos | None:
        times = [each for each in (super().due(), self.sender.due()) if each is not None]
        return min(times, default=None)

    def _sends(self, frame: CanFrame) -> bool:
        """True if this half sends a frame of the drive."""
        function = frame.id & ~NODE_MASK
        if self.alone or function in (services.HEARTBEAT_BASE, services.EMCY_BASE):
            return True
        index, sub = int.from_bytes(frame.data[1:3], "little"), frame.data[3:4] == bytes((z.RIGHT,))
        right = function == services.tpdo_id(z.RIGHT, 0)
        if function == services.SDO_TX_BASE:
            right = sub and (index, z.RIGHT) in z.OBJECTS and index > DEVICE
        return right == (self.half.side == z.RIGHT)

    def _measure(self) -> None:
        """Put what the drive measures of itself into its dictionary."""
        side, state, encoder = self.half.side, self.half.state, self.encoder
        counts = round(encoder.position * encoder.counts)
        self.half.node.dictionary.measure(
            {
                z.STATUS: z.combine(state, state),
                z.FAULT_CODE: z.combine(self.codes[z.LEFT], self.codes[z.RIGHT]),
                (z.POSITION, side): max(Type.I32.low, min(Type.I32.high, counts)),
                (z.VELOCITY, side): round(encoder.velocity / z.RPM * 10),
            }
        )
