"""The device's end of servos on a bus: what one keeps and obeys, the command decoder, and the base of twins.

Rules. Decoder and twin run on the same memory, an image of the registers, of which those are stored that the
map says. A write is checked, then done whole: what it makes the device do is the protocol's. An instruction
ends what was not finished of the one before: a chain of answers whose turn has not come.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any

from protocols import messages as msg
from protocols.asked import waiting
from protocols.frames import Frame
from protocols.messages import Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.firmware import ServoFirmware
from protocols.toolkit.memory_map import GoalRegister, MemoryMap, Target
from protocols.toolkit.serial import Stream
from protocols.toolkit.servo import Gains
from protocols.toolkit.servo_packets import (
    ACTION,
    EVERYBODY,
    PING,
    REG_WRITE,
    SYNC_WRITE,
    Packet,
    ServoPackets,
    Status,
    only_answers,
    read_by,
    read_packet,
    written_by,
)

BEYOND = 1
"""Error of a write behind the end of the image, where nothing is"""


@dataclass(slots=True)
class ServoMemory:
    """What one servo keeps of what it received."""

    name: str
    id: int
    options: Any
    """With `table`, its `MemoryMap`, and `goal_in`: the register of the set-point in an Operating_Mode."""
    delivered: bytes = b""
    """The registers when it is switched on,"""
    image: bytes = b""
    """and now."""
    waiting: tuple[int, bytes] | None = None
    """What a reg write keeps for the next action."""
    table: MemoryMap = field(init=False)
    """The registers"""

    def __post_init__(self) -> None:
        self.table = self.options.table

    # -- the protocol's own -------------------------------------------------------------------------------

    def wrong(self, at: int, data: bytes) -> int:
        """Return the error of a write, 0 if it can be done."""
        return 0

    def wrote(self, before: bytes, at: int, size: int) -> Sequence[Obeyed]:
        """Return what the device does upon a write, that is done; `before`: the image before."""
        written = self.table.values(at, self.image[at : at + size])
        return [each for name, value in written.items() for each in self.does(name, value)]

    def does(self, name: str, value: int) -> Sequence[Obeyed]:
        """Return what the device does upon one register that was written."""
        goal: GoalRegister | None = self.options.goal_in(self.get("Operating_Mode"))
        if name == "Torque_Enable":
            if not value:
                return (msg.Idle(self.name),)
            goals = (goal.obeyed(self.name, self.get(goal.register)),) if goal is not None else ()
            return msg.Arm(self.name), *goals
        if goal is not None and name == goal.register:
            obeyed = goal.obeyed(self.name, value)
            return (obeyed,) if self.armed else waiting(obeyed)
        self.id = value if name == "ID" else self.id
        return (msg.WriteParameter(self.name, name, float(value)),)

    def others(self, packets: ServoPackets, one: Packet) -> tuple[int, Sequence[Obeyed]]:
        """Obey an instruction to it of the protocol's own."""
        return 0, ()

    @property
    def armed(self) -> bool:
        """Whether the torque is on."""
        return bool(self.get("Torque_Enable"))

    # -- registers ----------------------------------------------------------------------------------------

    def deliver(self, size: int, values: Mapping[str, float]) -> None:
        """Make the image of a servo that is switched on."""
        self.image = bytes(size)
        for name, value in values.items():
            self.put(name, value)
        self.delivered = self.image

    def get(self, name: str) -> int:
        """Return what a register holds; 0 if there is no such register."""
        return self.table.held(name, self.image)

    def put(self, name: str, value: float) -> None:
        """Change a register from inside, if there is such a register."""
        if name in self.table.by_name:
            self.place(self.table.by_name[name].number, self.table.data(name, value))

    def place(self, at: int, data: bytes) -> None:
        """Change bytes of the image."""
        self.image = self.image[:at] + data + self.image[at + len(data) :]

    def read(self, at: int, size: int) -> bytes:
        """Return bytes of the image, as they are read; there are zeros behind its end."""
        return self.image[at : at + size].ljust(size, b"\0")

    def restart(self) -> None:
        """Forget what is not stored."""
        stored = self.table.stored
        self.image, self.waiting = self.image[:stored] + self.delivered[stored:], None

    # -- instructions -------------------------------------------------------------------------------------

    def obey(self, packets: ServoPackets, one: Packet) -> tuple[int, Sequence[Obeyed]]:
        """Apply an instruction to any device: return the error of its status, and what the device then
        does."""
        writes, to_it = written_by(packets, one), one.id in (self.id, EVERYBODY)
        if one.instruction == REG_WRITE and to_it and writes:
            _, at, data = writes[0]
            self.waiting = at, data
            return 0, (msg.Kept(self.name, f"reg write {at}", float(len(data))),)
        if one.instruction == ACTION and to_it and self.waiting:
            (at, data), self.waiting = self.waiting, None
            return self.write(at, data)
        mine = (self.id,) if one.instruction == SYNC_WRITE else (self.id, EVERYBODY)
        obeyed: list[Obeyed] = []
        error, found = 0, False
        for address, at, data in writes:
            if address in mine:
                error, does = self.write(at, data)
                obeyed, found = [*obeyed, *does], True
        return (error, obeyed) if found or not to_it else self.others(packets, one)

    def write(self, at: int, data: bytes) -> tuple[int, Sequence[Obeyed]]:
        """Write bytes of the image, if they can be written."""
        error = self.wrong(at, data) if at + len(data) <= len(self.image) else BEYOND
        if error:
            return error, ()
        before = self.image
        self.place(at, data)
        return 0, self.wrote(before, at, len(data))


class ServoDecoder:
    """What the servos on one line would obey."""

    def __init__(
        self, packets: ServoPackets, memories: Sequence[ServoMemory], stream: Stream | None = None
    ) -> None:
        self._packets, self._memories = packets, tuple(memories)
        self._stream = stream or Stream(packets.framing)

    def __deepcopy__(self, memo: object) -> ServoDecoder:
        """The guard copies it every few frames: all that a memory holds is constant."""
        return ServoDecoder(self._packets, [replace(each) for each in self._memories], copy(self._stream))

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what the servos would obey in this frame; [] if nothing."""
        obeyed: list[Obeyed] = []
        for message in self._stream.messages(frame) if isinstance(frame, bytes) else ():
            one = read_packet(self._packets, message)
            for memory in self._memories:
                obeyed += memory.obey(self._packets, one)[1]
        return obeyed


class BusServo(ServoFirmware):
    """One servo."""

    packets: ServoPackets
    switch: str = "Torque_Enable"
    level: str
    """The register that decides what is answered:"""
    levels: tuple[int, int] = (1, 2)
    """from where on readings are, and from where on writes are, too."""
    unanswered: frozenset[int] = frozenset({SYNC_WRITE})
    """Instructions to it that are not answered all the same"""
    delay: tuple[str, Nanos] = ("Return_Delay_Time", 2_000)
    """The register that decides how long it waits before it answers, and its unit"""
    who: tuple[Target, ...] = ()
    """What a ping is answered with"""

    def __init__(self, device: Device, seed: int, gains: Gains, memory: ServoMemory) -> None:
        super().__init__(device, seed, gains)
        self.memory = memory
        self._stream = Stream(self.packets.framing)
        self._turn: tuple[Mapping[int, int], Target] | None = None
        """In a chain: the sizes that the servos before it answer, behind the last of whom it answers this."""

    # -- the protocol's own -------------------------------------------------------------------------------

    def present(self) -> Mapping[str, float]:
        """Return what registers hold that are measured."""
        raise NotImplementedError

    def status(self, number: int, error: int, data: bytes) -> bytes:
        """Return a status of this servo, as that of an id."""
        raise NotImplementedError

    def does(self, t: Nanos, one: Packet) -> int:
        """Obey an instruction to any device; return the error of its status."""
        error, obeyed = self.memory.obey(self.packets, one)
        for each in obeyed:
            self.obey(t, each)
        return error

    # -- received -----------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> None:
        if self.waits() or self._stream.held or not only_answers(self.packets, frame):
            super().receive(t, frame)  # what others answer is of no concern, and most of what comes

    def waits(self) -> bool:
        """Return whether it waits for its turn to answer."""
        return self._turn is not None

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        for message in self._stream.messages(frame) if isinstance(frame, bytes) else ():
            self.on_packet(t, read_packet(self.packets, message))

    def on_packet(self, t: Nanos, one: Packet) -> None:
        """Obey an instruction, or take one's turn behind another servo's status."""
        status = self.packets.status(one) if self._turn is not None else None
        if (status is not None and self._takes_turn(t, status)) or one.instruction not in self.packets.names:
            return
        self._turn = None
        mine, level = one.id == self.memory.id, self.memory.get(self.level)
        reads, writes = (level >= least for least in self.levels)
        wanted = read_by(self.packets, one)
        if wanted:
            self.on_question(t, one, wanted if reads else {})
        elif one.instruction == PING:
            self.on_ping(t, one)
        else:
            error = self.does(t, one)
            if mine and writes and one.instruction not in self.unanswered:
                # A new id, too, is answered for at the old one: the vendors' SDKs look for it there. Some
                # firmware is reported to answer at the new one; the driver takes either.
                self.reply(t, self.status(one.id, error, b""))

    def _takes_turn(self, t: Nanos, status: Status) -> bool:
        """Return whether a status is of one before it in a chain; behind the last of them it answers."""
        if self._turn is None:
            return False
        before, target = self._turn
        number, _, data = status
        if before.get(number) != len(data):
            return False
        if number == next(reversed(before)):
            self._turn = None
            self.answer(t, 0, self.reads(target))
        return True

    def on_ping(self, t: Nanos, one: Packet) -> None:
        """Answer a ping."""
        if one.id == self.memory.id:
            self.answer(t, 0, b"".join(map(self.reads, self.who)))

    def on_question(self, t: Nanos, one: Packet, wanted: Mapping[int, Target]) -> None:
        """Answer a question, or wait for one's turn."""
        order, mine = list(wanted), self.memory.id
        if mine in wanted:
            at = order.index(mine)
            if at:
                self._turn = {number: wanted[number][1] for number in order[:at]}, wanted[mine]
            else:
                self.answer(t, 0, self.reads(wanted[mine]))

    def reads(self, target: Target) -> bytes:
        """Return the bytes that are read."""
        for name, value in self.present().items():
            self.memory.put(name, value)
        return self.memory.read(*target)

    def reply(self, t: Nanos, *frames: Frame) -> None:
        name, unit = self.delay
        super().reply(t + self.memory.get(name) * unit, *frames)

    def answer(self, t: Nanos, error: int, data: bytes = b"") -> None:
        """Send a status."""
        self.reply(t, self.status(self.memory.id, error, data))

    def trip(self, code: int) -> None:
        super().trip(code)
        self.memory.put(self.switch, 0)
