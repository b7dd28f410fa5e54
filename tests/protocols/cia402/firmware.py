"""A drive for conversations of vectors: package canopen 2.4.1's LocalNode, and a firmware behind it.

Rules. SDO, NMT, heartbeat, EMCY, what PDOs hold and how values lie in bytes are canopen's; its table of CiA
402 (`State402.TRANSITIONTABLE`) moves the statusword. What the package does not implement is here, by CiA
402-2: READY and SWITCHED ON are left by a quick stop, too (transitions 7, 10), and READY goes to OPERATION
ENABLED at once (3 and 4); a quick stop with 605A below 5 ends in SWITCH ON DISABLED; synchronous RPDOs act
with the next SYNC; the bits of the modes (10, 12, 13). It responds a millisecond after a request.
"""

from __future__ import annotations

from typing import Any

import canopen
from canopen.profiles.p402 import OperationMode, State402

from protocols.frames import CanFrame
from tests.protocols.cia402.stack import Slave

STATUSWORDS = {name: value | 0x210 for name, (_, value) in State402.SW_MASK.items()}
"""Statuswords: voltage is enabled (bit 4), and it is remote controlled (bit 9)."""
NEXT: dict[tuple[str, int], str] = {
    (before, word): after for (before, after), word in State402.TRANSITIONTABLE.items() if after != "FAULT"
} | {
    ("READY TO SWITCH ON", 0x02): "SWITCH ON DISABLED",
    ("SWITCHED ON", 0x02): "SWITCH ON DISABLED",
    ("READY TO SWITCH ON", 0x0F): "OPERATION ENABLED",
}
STOPPING_MS = 20
"""Duration of a quick stop that does not hold."""
HOMING_MS = 40
DEMAND = 0x8F
"""The bits of a controlword that demand a state."""


class Drive:
    """A drive at a quarter turn of 16384 increments, which stands still."""

    def __init__(self, node: int = 2) -> None:
        self.node = node
        self.slave = Slave(node)
        self.slave.take_sent()
        self.local: Any = self.slave.node
        self.state, self.control, self.ms = "SWITCH ON DISABLED", 0, 0
        self.since = 0
        """When it came into its state, or began to home."""
        self.dead = False
        """It neither receives nor sends anything."""
        self.mute = False
        """It sends no SDO response."""
        self.deaf = False
        """It does not obey controlword and mode."""
        self.modes_late = False
        """It does not change its mode yet."""
        self.copies = 1
        """Copies of each SDO response on the bus."""
        self.unsized = False
        """Its expedited responses of four bytes have no size (CiA 301: s = 0; n means nothing)."""
        self.late = 0
        """ms by which its SDO responses are delayed."""
        self.acknowledges, self.homes = True, "attained"
        self.starts = 0
        """NMT commands that are lost."""
        self.resets = 1
        """Fault resets that it needs."""
        self.refused: dict[tuple[int, int | None], int] = {}
        self.extra: list[CanFrame] = []
        """More frames to be sent next."""
        self.delayed: list[tuple[int, CanFrame]] = []
        self.latched: dict[int, CanFrame] = {}
        self._fresh = False
        self.put(0x6064, 4096)
        self.put(0x6502, 0x3AD)  # PP, PV, PT, HM, CSP, CSV, CST
        self.put(0x6079, 48_000)
        self.put(0x1018, 4711, 4)
        self.local.add_write_callback(self._written)
        self._show()

    # -- its dictionary -------------------------------------------------------------------------

    def _variable(self, index: int, sub: int) -> Any:
        found = self.local.object_dictionary[index]
        return found if isinstance(found, canopen.objectdictionary.ODVariable) else found[sub]

    def put(self, index: int, value: int, sub: int = 0) -> None:
        """Put a value into its dictionary, if it has the object."""
        if index not in self.local.object_dictionary:
            return
        data = self._variable(index, sub).encode_raw(value)
        self.local.data_store.setdefault(index, {})[sub] = data

    def put_bytes(self, index: int, data: bytes) -> None:
        """Put bytes into it, of any length."""
        self.local.data_store.setdefault(index, {})[0] = data

    def get(self, index: int, sub: int = 0) -> int:
        """Return a value of its dictionary."""
        return int(self._variable(index, sub).decode_raw(self.local.get_data(index, sub)))

    def lack(self, *indices: int) -> None:
        """Remove these objects."""
        own = self.local.object_dictionary
        for index in indices:
            own.names.pop(own.indices.pop(index).name, None)
            self.local.data_store.pop(index, None)

    def own(self, index: int, sub: int) -> None:
        """Give it a manufacturer-specific object, a byte."""
        made = canopen.objectdictionary.ODRecord(f"maker's {index:04X}", index)
        byte = canopen.objectdictionary.ODVariable(f"byte {sub}", index, sub)
        byte.data_type, byte.default = canopen.objectdictionary.datatypes.UNSIGNED8, 0
        made.add_member(byte)
        self.local.object_dictionary.add_object(made)

    def refuse(self, index: int, code: int, value: int | None = None) -> None:
        """Let it refuse to have this object written (with this value)."""
        self.refused[index, value] = code

    def map(self, first: int, cob: int, kind: int, *entries: int, timer: int = 0) -> None:
        """Give it this PDO as delivered."""
        self.put(first, cob, 1)
        self.put(first, kind, 2)
        self.put(first, timer, 5)
        self.put(first + 0x200, len(entries), 0)
        for sub, entry in enumerate(entries, 1):
            self.put(first + 0x200, entry, sub)
        self._fresh = False

    def _written(self, index: int, subindex: int, data: bytes, **_: Any) -> None:
        value = int.from_bytes(data, "little")
        for key in ((index, value), (index, None)):
            if key in self.refused:
                raise canopen.SdoAbortedError(self.refused[key])
        self._fresh = self._fresh and not 0x1400 <= index < 0x1C00

    # -- what becomes of it -----------------------------------------------------------------------

    def trip(self, code: int, emcy: bool = True) -> None:
        """A fault."""
        self._go("FAULT")
        self.put(0x603F, code)
        if emcy:
            self.say_emcy(code)

    def say_emcy(self, code: int) -> None:
        """An emergency message: a fault's, or a warning."""
        self.local.emcy.send(code, 1, bytes(5))

    def restart(self) -> None:
        """It loses its supply for a moment: what was written is gone."""
        self.slave.network.cyclic.clear()
        self.local.nmt.state = "INITIALISING"
        self.local.nmt.state = "PRE-OPERATIONAL"
        for first in (0x1400, 0x1600, 0x1800, 0x1A00):
            for number in range(4):
                self.local.data_store.pop(first + number, None)
        for index in (0x1016, 0x1017, 0x6040, 0x6060):
            self.local.data_store.pop(index, None)
        self.control, self._fresh = 0, False
        self._go("SWITCH ON DISABLED")

    def stand(self, state: str, mode: int) -> None:
        """Another host has brought it into this state."""
        self.control = State402.CW_COMMANDS_CODE.get(state, 0) & DEMAND & ~0x80
        self.put(0x6040, self.control)
        self.put(0x6060, mode)
        self.put(0x6061, mode)
        self._go(state)

    def nmt(self, command: int) -> None:
        """Handle another host's NMT command."""
        self.slave.receive(CanFrame(0, bytes((command, self.node))))

    # -- the bus ------------------------------------------------------------------------------------

    def handle(self, frame: CanFrame) -> None:
        """A frame of the host."""
        if self.dead or frame.id == 0x700 + self.node:
            return
        if frame.id == 0 and self.starts:
            self.starts -= 1
            return
        if frame.id == 0 and frame.data[0] in (0x81, 0x82) and frame.data[1] in (0, self.node):
            self.restart()
            return
        self.slave.receive(frame)
        self._on_pdo(frame)
        self._obey()
        if frame.id == 0x80:
            self._report(lambda pdo: 0 < pdo.trans_type <= 240 and self._nth(pdo.trans_type))

    def _nth(self, every: int) -> bool:
        return self.ms // 10 % every == 0

    def speak(self, ms: int) -> list[CanFrame]:
        """Return what it sends in this millisecond."""
        self.ms = ms
        if self.dead:
            self.slave.take_sent()
            return []
        self._obey()
        self._report(lambda pdo: pdo.trans_type >= 254 and pdo.event_timer and ms % pdo.event_timer == 0)
        beat = self.get(0x1017)
        if beat and ms % beat == beat // 2:
            self.slave.network.sent += [CanFrame(i, bytes(d)) for i, d in self.slave.network.cyclic.items()]
        frames = [frame for at, frame in self.delayed if at <= ms]
        self.delayed = [(at, frame) for at, frame in self.delayed if at > ms]
        for frame in self.slave.take_sent():
            if self.unsized and frame.id == 0x580 + self.node and frame.data[0] == 0x43:
                frame = CanFrame(frame.id, b"\x4e" + frame.data[1:])
            if frame.id != 0x580 + self.node:
                frames.append(frame)
            elif self.late:
                self.delayed.append((ms + self.late, frame))
            else:
                frames += [frame] * (0 if self.mute else self.copies)
        more, self.extra = self.extra, []
        return frames + more

    def rpdo(self, id_: int) -> Any:
        """The RPDO of an identifier, as the drive has it; None if it has none."""
        self._refresh()
        found = [pdo for pdo in self.local.rpdo.values() if pdo.enabled and pdo.cob_id == id_]
        return found[0] if found else None

    def _refresh(self) -> None:
        if not self._fresh:
            for pdo in (*self.local.rpdo.values(), *self.local.tpdo.values()):
                pdo.read()
            self._fresh = True

    def _on_pdo(self, frame: CanFrame) -> None:
        if self.local.nmt.state != "OPERATIONAL":
            return
        if frame.id == 0x80:
            for each in [self.latched.pop(id_) for id_ in sorted(self.latched)]:
                self._take(each)
        elif 0x200 < frame.id < 0x580 and (pdo := self.rpdo(frame.id)) is not None:
            if pdo.trans_type <= 240:
                self.latched[frame.id] = frame
            else:
                self._take(frame)

    def _take(self, frame: CanFrame) -> None:
        pdo = self.rpdo(frame.id)
        pdo.on_message(frame.id, bytearray(frame.data), 0.0)
        for variable in pdo.map:
            store = self.local.data_store.setdefault(variable.index, {})
            store[variable.subindex] = bytes(variable.get_data())

    def _report(self, which: Any) -> None:
        if self.local.nmt.state != "OPERATIONAL":
            return
        self._refresh()
        for pdo in self.local.tpdo.values():
            if pdo.enabled and which(pdo):
                for variable in pdo.map:
                    variable.set_data(self.local.get_data(variable.index, variable.subindex))
                pdo.transmit()

    # -- CiA 402 --------------------------------------------------------------------------------------

    def _obey(self) -> None:
        if not self.deaf:
            before, self.control = self.control, self.get(0x6040)
            rising = self.control & ~before & 0x80
            if self.state != "FAULT" or rising:
                self._demand(self.control & DEMAND)
            if not self.modes_late:
                self.put(0x6061, self.get(0x6060))
        holds = self.get(0x605A) >= 5
        if self.state == "QUICK STOP ACTIVE" and not holds and self.ms >= self.since + STOPPING_MS:
            self._go("SWITCH ON DISABLED")
        self._show()

    def _demand(self, control: int) -> None:
        if self.state == "FAULT":
            self.resets -= 1
            if self.resets > 0:
                return
            self.put(0x603F, 0)
        if (self.state, control) == ("QUICK STOP ACTIVE", 0x0F) and self.get(0x605A) < 5:
            return
        after = NEXT.get((self.state, control), self.state)
        if after != self.state:
            self._go(after)

    def _go(self, state: str) -> None:
        self.state, self.since = state, self.ms
        self._show()

    def _show(self) -> None:
        bits = self._mode_bits() if self.state == "OPERATION ENABLED" else 0
        self.put(0x6041, STATUSWORDS[self.state] | bits)

    def _mode_bits(self) -> int:
        mode, bit4 = self.get(0x6061), self.control & 0x10
        if mode == OperationMode.HOMING:
            if not bit4:
                self.since = self.ms
                return 0x400
            if self.homes == "never" or self.ms < self.since + HOMING_MS:
                return 0
            if self.homes == "attained" and self.ms == self.since + HOMING_MS:
                self.put(0x6064, self.get(0x607C))  # home is at 607C
            return 0x1400 if self.homes == "attained" else 0x2000
        if mode == OperationMode.PROFILED_POSITION:
            return 0x1000 if bit4 and self.acknowledges else 0
        return 0x1000 if mode in (8, 9, 10) else 0
