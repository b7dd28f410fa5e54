"""What a device keeps of what it was told, and obeys: the same object in the command decoder and in the twin.

Rules. A write is refused whole, or done whole. Stored registers are written with the torque off only, none
beyond its limits, and a set-point not beyond those that are stored.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from protocols import messages as msg
from protocols.asked import waiting
from protocols.dynamixel import packets as dx
from protocols.dynamixel.options import STORED, Options
from protocols.dynamixel.table import (
    ADDRESSES,
    BAUD_RATES,
    GOALS,
    TRIPPED,
    ControlTable,
    Model,
    data_of,
    modes_of,
)
from protocols.frames import Frame
from protocols.messages import Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.serial import Stream

RESULT_FAIL, INSTRUCTION, RANGE, LENGTH, LIMIT, ACCESS = 1, 2, 4, 5, 6, 7
OFFSET_OF_ONE_TURN = 1024
"""Homing_Offset of a turn of 4096 counts, beyond which it counts for nothing in Operating_Mode 3."""


@dataclass(slots=True)
class Memory:
    """What one device keeps."""

    name: str
    address: int
    options: Options
    delivered: Mapping[str, int]
    """The registers when it is switched on. Never changed."""
    written: dict[str, int] = field(default_factory=dict)
    """Those that were written since."""
    armed: bool = False
    registered: bytes = b""
    """The write that waits for an action."""

    def get(self, name: str) -> int:
        """Return what a register holds."""
        return self.written.get(name, self.delivered.get(name, 0))

    @property
    def table(self) -> ControlTable:
        """The registers."""
        return self.options.table

    @property
    def model(self) -> Model:
        """The model."""
        return self.options.of

    def obey(self, one: dx.Packet) -> tuple[int, Sequence[Obeyed]]:
        """Apply an instruction to any device: return the error of its status, and what the device then
        does."""
        to_it, error, obeyed = one.id in (self.address, dx.ALL), 0, list[Obeyed]()
        for address, start, data in dx.writes(one):
            if address in (self.address, dx.ALL):
                error, does = self._write(start, data)
                obeyed += does
        if not to_it:
            return 0, obeyed
        match one.instruction:
            case dx.WRITE if not obeyed and not error:
                error = LENGTH
            case dx.REG_WRITE:
                self.registered = one.parameters
            case dx.ACTION if self.registered:
                registered, self.registered = self.registered, b""
                return self.obey(dx.Packet(self.address, dx.WRITE, registered))
            case dx.ACTION:
                error = RESULT_FAIL
            case dx.REBOOT if not one.parameters:
                self.restart()
                return 0, (msg.Idle(self.name), msg.ClearFault(self.name))
            case dx.FACTORY_RESET | dx.CLEAR:
                return INSTRUCTION, (msg.Kept(self.name, dx.NAMES[one.instruction], 1.0),)
        return error, obeyed

    def put(self, name: str, value: int) -> None:
        """Change a register from inside; without torque it is not armed."""
        self.written[name] = value
        self.armed = self.armed and (name != "Torque_Enable" or value == 1)

    def restart(self) -> None:
        """Forget what is not stored."""
        self.armed, self.registered = False, b""
        numbers = self.table.by_name
        self.written = {name: value for name, value in self.written.items() if numbers[name].number < 64}

    def _write(self, start: int, data: bytes) -> tuple[int, list[Obeyed]]:
        values = self._values(start, data)
        error = (
            ACCESS if not values else next(filter(None, (self._wrong(*each) for each in values.items())), 0)
        )
        return error, [] if error else [one for each in values.items() for one in self._set(*each)]

    def _values(self, start: int, data: bytes) -> Mapping[str, int]:
        """Return the registers that are written; {} if it is not these alone."""
        register = self.table.by_number.get(start)
        if register is not None and self.table.size(register.name) == len(data):
            return {register.name: int.from_bytes(data, "little", signed=register.type[0] == "i")}
        at = data_of(self.model, self.get("Firmware_Version"))
        if at <= start < at + 16:  # each byte goes where its indirect address says
            places = [self.get(f"Indirect_Address_{start - at + k + 1}") for k in range(len(data))]
            if (
                not places
                or places != list(range(places[0], places[0] + len(places)))
                or at <= places[0] < at + 16
            ):
                return {}
            return self._values(places[0], data)
        values = self.table.values(start, data)
        whole = sum(map(self.table.size, values)) == len(data)
        return values if whole else {}

    def _wrong(self, name: str, value: int) -> int:
        """Return the error of writing a value, 0 if it can be written."""
        register, get = self.table.by_name[name], self.get
        if not register.writable or (self.armed and register.number < 64):
            return ACCESS
        least, most = {
            "Torque_Enable": (0, 1),
            "ID": (0, ADDRESSES.stop - 1),
            "Baud_Rate": (0, 9 if self.model.family == "P" else 7),
            "Return_Delay_Time": (0, 254),
            "Status_Return_Level": (0, 2),
            "Bus_Watchdog": (0, 127),
        }.get(name, (-(1 << 31), (1 << 32) - 1))
        if not least <= value <= most or (name == "Operating_Mode" and value not in modes_of(self.model)):
            return RANGE
        if name.startswith("Goal_") and get("Bus_Watchdog") == TRIPPED:
            return RANGE
        limit = {"Goal_Velocity": get("Velocity_Limit"), "Goal_Current": get("Current_Limit")}.get(name)
        if limit is not None and abs(value) > limit:
            return LIMIT
        if name == "Goal_Position":
            one_turn = get("Operating_Mode") == 3
            least, most = get("Min_Position_Limit"), get("Max_Position_Limit")
            least, most = (least, most) if one_turn else (-self.model.far, self.model.far)
            return 0 if least <= value <= most else LIMIT
        return 0

    def _set(self, name: str, value: int) -> Sequence[Obeyed]:
        self.written[name] = value
        goal = GOALS.get(mode := self.get("Operating_Mode"))
        if name == "Torque_Enable":
            self.armed = value == 1
            return (msg.Arm(self.name), *self._goal(mode)) if self.armed else (msg.Idle(self.name),)
        if name == goal and (mode != 5 or name == "Goal_Position"):
            return self._goal(mode) if self.armed else waiting(*self._goal(mode))
        if name == "Operating_Mode":
            self.written |= dict.fromkeys(("Goal_Velocity", "Goal_Current"), 0)
        elif name == "ID":
            self.address = value
        return (msg.WriteParameter(self.name, name, float(value)),)

    def _goal(self, mode: int) -> Sequence[msg.Position | msg.Velocity | msg.Torque]:
        """Return what its set-point makes it do."""
        if mode not in GOALS:
            return ()
        value, model = self.get(GOALS[mode]), self.model
        if mode == 0:
            return (msg.Torque(self.name, value * self.options.newton_metre),)
        if mode == 1:
            return (msg.Velocity(self.name, value * model.step),)
        return (msg.Position(self.name, (value - model.zero) * model.count),)


def memory_of(device: Device, mode: int | None = None) -> Memory:
    """Return that of a device as it is when switched on; `mode`: its Operating_Mode, if not as in its
    settings."""
    settings, options = device.settings, device.options
    model: Model = options.of
    delivered = {name: int(getattr(settings, setting)) for name, setting in STORED.items()}
    delivered |= {
        "Model_Number": settings.model_number or model.number,
        "Firmware_Version": settings.firmware,
        "ID": device.address,
        "Protocol_Type": 2,
        "Secondary_ID": 255,
        "Velocity_Limit": settings.velocity_limit or max(model.velocity, options.velocity),
        "Current_Limit": settings.current_limit or max(model.current, options.current),
        "Position_P_Gain": 800,
        "Goal_Position": model.zero,
        "Goal_Current": settings.current_limit or model.current,
    }
    if not settings.max_position_limit and not settings.min_position_limit:
        ends = (-(model.counts // 2), model.counts // 2) if model.family == "P" else (0, model.counts - 1)
        delivered |= {"Min_Position_Limit": ends[0], "Max_Position_Limit": ends[1]}
    if device.line_rate in BAUD_RATES:
        delivered["Baud_Rate"] = BAUD_RATES.index(device.line_rate)
    data = data_of(model, settings.firmware)
    delivered |= {f"Indirect_Address_{k + 1}": data + k for k in range(16)}
    if mode is not None:
        delivered["Operating_Mode"] = mode
    return Memory(device.name, device.address, options, delivered)


class DynamixelDecoder:
    """What the devices on one bus would obey. Their modes are taken to be those that the driver asks for,
    until others are written: it arms none with another mode."""

    def __init__(
        self, devices: Sequence[Device], memories: Sequence[Memory] = (), stream: Stream | None = None
    ) -> None:
        self._memories = memories or [memory_of(each, each.options.operating_mode) for each in devices]
        self._stream = Stream(dx.FRAMING) if stream is None else replace(stream)

    def __deepcopy__(self, memo: object) -> DynamixelDecoder:
        """Copy what is written: all else is constant."""
        return DynamixelDecoder(
            (), [replace(m, written=m.written.copy()) for m in self._memories], self._stream
        )

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what the devices would obey in this frame; [] if nothing."""
        if not isinstance(frame, bytes):
            return ()
        found = [dx.unpack(message) for message in self._stream.messages(frame)]
        return [does for one in found for memory in self._memories for does in memory.obey(one)[1]]
