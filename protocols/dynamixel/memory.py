"""What a device keeps of what it was sent, and obeys: the same object in the command decoder and in the twin.

Rules. A write is refused whole, or done whole. Stored registers are written with the torque off only, none
beyond its limits, and a set-point not beyond those that are stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.dynamixel import packets as dx
from protocols.dynamixel.options import STORED, Options
from protocols.dynamixel.table import BAUD_RATES, DATA, DEVICE, INDIRECT, TRIPPED, Model, data_of, modes_of
from protocols.messages import Obeyed
from protocols.plugin import Device
from protocols.toolkit import servo_packets as sp
from protocols.toolkit.servo_device import ServoDecoder, ServoMemory
from protocols.toolkit.servo_packets import Packet, ServoPackets

RESULT_FAIL, INSTRUCTION, RANGE, LENGTH, LIMIT, ACCESS = 1, 2, 4, 5, 6, 7
OFFSET_OF_ONE_TURN = 1024
"""Homing_Offset of a turn of 4096 counts, beyond which it counts for nothing in Operating_Mode 3."""
SIZE = 1024
"""Bytes of the image: no model has a register behind"""
FIRST_DATA = min(DATA)
"""Below it there are no indirect data, in no model."""
LIMITS = {"Goal_Velocity": "Velocity_Limit", "Goal_Current": "Current_Limit"}


@dataclass(slots=True)
class Memory(ServoMemory):
    """What one device keeps."""

    options: Options

    @property
    def model(self) -> Model:
        """The model."""
        return self.options.of

    def others(self, packets: ServoPackets, one: Packet) -> tuple[int, Sequence[Obeyed]]:
        match one.instruction:
            case sp.WRITE:
                return LENGTH, ()
            case sp.ACTION:
                return RESULT_FAIL, ()
            case dx.REBOOT if not one.data:
                self.restart()
                return 0, (msg.Idle(self.name), msg.ClearFault(self.name))
            case dx.FACTORY_RESET | dx.CLEAR:
                return INSTRUCTION, (msg.Kept(self.name, dx.NAMES[one.instruction], 1.0),)
        return 0, ()

    # -- indirect addresses ---------------------------------------------------------------------------

    def places(self, at: int, size: int) -> Sequence[int]:
        """Return the addresses of a run of bytes: of indirect data, those that they stand for."""
        first = data_of(self.model, self.get("Firmware_Version"))
        if not first <= at < first + INDIRECT:
            return range(at, at + size)
        places = [self.get(f"Indirect_Address_{at - first + k + 1}") for k in range(size)]
        return [SIZE if first <= place < first + INDIRECT else place for place in places]

    def read(self, at: int, size: int) -> bytes:
        if at + size <= FIRST_DATA:
            return ServoMemory.read(self, at, size)
        return bytes(self.image[place] if place < SIZE else 0 for place in self.places(at, size))

    def write(self, at: int, data: bytes) -> tuple[int, Sequence[Obeyed]]:
        if at + len(data) <= FIRST_DATA:
            return ServoMemory.write(self, at, data)
        places = self.places(at, len(data))
        in_a_row = list(places) == list(range(places[0], places[0] + len(data)))
        return ServoMemory.write(self, places[0], data) if in_a_row else (ACCESS, ())

    # -- writes ---------------------------------------------------------------------------------------

    def wrong(self, at: int, data: bytes) -> int:
        values = self.table.values(at, data)
        if not values or not self.table.layout(at, len(data)).whole:
            return ACCESS
        return next(filter(None, (self._wrong(*each) for each in values.items())), 0)

    def _wrong(self, name: str, value: int) -> int:
        """Return the error of writing a value, 0 if it can be written."""
        register, get, far = self.table.by_name[name], self.get, self.model.far
        if not register.writable or (self.armed and self.table.is_stored(name)):
            return ACCESS
        least, most = DEVICE["ends"].get(name, register.ends())
        if name == "Baud_Rate":
            most = 9 if self.model.family == "P" else 7
        if not least <= value <= most or (name == "Operating_Mode" and value not in modes_of(self.model)):
            return RANGE
        if name.startswith("Goal_") and get("Bus_Watchdog") == TRIPPED:
            return RANGE
        if name in LIMITS:
            return LIMIT if abs(value) > get(LIMITS[name]) else 0
        if name == "Goal_Position":
            one_turn = get("Operating_Mode") == 3
            least, most = (get("Min_Position_Limit"), get("Max_Position_Limit")) if one_turn else (-far, far)
            return 0 if least <= value <= most else LIMIT
        return 0

    def does(self, name: str, value: int) -> Sequence[Obeyed]:
        if name == "Operating_Mode":
            self.put("Goal_Velocity", 0)
            self.put("Goal_Current", 0)
        return ServoMemory.does(self, name, value)


def memory_of(device: Device, mode: int | None = None) -> Memory:
    """Return that of a device as it is when switched on; `mode`: its Operating_Mode, if not as in its
    settings."""
    settings, options = device.settings, device.options
    model: Model = options.of
    delivered: dict[str, int] = {name: getattr(settings, setting) for name, setting in STORED.items()}
    delivered |= DEVICE["delivered"] | {
        "Model_Number": settings.model_number or model.number,
        "Firmware_Version": settings.firmware,
        "ID": device.address,
        "Velocity_Limit": settings.velocity_limit or max(model.velocity, options.velocity),
        "Current_Limit": settings.current_limit or max(model.current, options.current),
        "Goal_Position": model.zero,
        "Goal_Current": settings.current_limit or model.current,
    }
    if not settings.max_position_limit and not settings.min_position_limit:
        ends = (-(model.counts // 2), model.counts // 2) if model.family == "P" else (0, model.counts - 1)
        delivered |= {"Min_Position_Limit": ends[0], "Max_Position_Limit": ends[1]}
    if device.line_rate in BAUD_RATES:
        delivered["Baud_Rate"] = BAUD_RATES.index(device.line_rate)
    data = data_of(model, settings.firmware)
    delivered |= {f"Indirect_Address_{k + 1}": data + k for k in range(INDIRECT)}
    if mode is not None:
        delivered["Operating_Mode"] = mode
    made = Memory(device.name, device.address, options)
    made.deliver(SIZE, delivered)
    return made


def decoder(devices: Sequence[Device]) -> ServoDecoder:
    """Return what the devices on one bus would obey. Their modes are taken to be those that the driver asks
    for, until others are written: it arms none with another mode."""
    return ServoDecoder(dx.PACKETS, [memory_of(each, each.options.operating_mode) for each in devices])
