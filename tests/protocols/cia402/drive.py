"""A drive for transcripts: package canopen 2.4.1's LocalNode, and a firmware behind it.

Rules. SDO, NMT, heartbeat, EMCY, what PDOs hold and how values lie in bytes are canopen's; its table of CiA
402 (`State402.TRANSITIONTABLE`) moves the statusword. What the package does not implement is here, by CiA
402-2: READY and SWITCHED ON are left by a quick stop, too (transitions 7, 10), and READY goes to OPERATION
ENABLED at once (3 and 4); a quick stop with 605A below 5 ends in SWITCH ON DISABLED; synchronous RPDOs act
with the next SYNC; the bits of the modes (10, 12, 13). It stands at a quarter turn of 16384 increments, has
1 N·m, and responds a millisecond after a request, one request at a time.

What a transcript's `peer NAME …` lines demand of it (numbers decimal or 0x…):

    6064=-8192 1018:04=7 late=yes     objects, and the drive's own settings (`Drive`): `yes`, `no`, numbers
    1008 is "bytes"  6502 is ad03     an object's bytes
    has 60FF=2608 6061=9              it holds these values now
    state "OPERATION ENABLED"         it is in this state now
    pdo 1400 0x202 1 6040 607A        this PDO is set up: identifier, transmission type, objects, timer=ms
    lacks 60B1 6079                   it has no such objects
    rejects 1400 0x06010002           it refuses to have this written (6098=37: this value)
    stands "QUICK STOP ACTIVE" 8      another host has brought it into this state and mode
    trips 0x2310, trips 0x2310 quietly   a fault, with EMCY or without
    restarts                          it loses its supply for a moment: what was written is gone
    gets FRAME                        a frame that was not the driver's
    sends FRAME
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import canopen
from canopen.profiles.p402 import OperationMode, State402

from protocols.frames import CanFrame, Frame
from protocols.plugin import Device
from protocols.transcripts.notation import Frames, tokens
from tests.protocols.cia402.notation import address, notation
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
FORGOTTEN = (*(first + n for first in (0x1400, 0x1600, 0x1800, 0x1A00) for n in range(4)), 0x1016, 0x1017)
"""Written by a host, and not kept without supply; 6040 and 6060 neither."""
FRAMES = Frames({}, {}, notation)


class Drive:
    """The drive, stepped by milliseconds. A transcript sets its public attributes."""

    def __init__(self, device: Device) -> None:
        self.node = device.address
        self.slave = Slave(self.node)
        self.slave.take_sent()
        self.local: Any = self.slave.node
        self._state, self._control, self._ms, self._since = "SWITCH ON DISABLED", 0, 0, 0
        self.dead = False
        """It neither receives nor sends anything."""
        self.mute = False
        """It sends no SDO response."""
        self.deaf = False
        """It does not obey controlword and mode."""
        self.frozen = False
        """Its statusword stands as it was written."""
        self.modes_late = False
        """It does not change its mode yet."""
        self.slow = 0
        """ms that it needs for each SDO request."""
        self.keeps = 99
        """How many that come meanwhile it keeps, the newest."""
        self.late = 0
        """ms by which its SDO responses are delayed."""
        self.copies = 1
        """Copies of each SDO response on the bus."""
        self.echo = 0
        """ms after which every third SDO response comes once more."""
        self.unsized = False
        """Its expedited responses of four bytes have no size (CiA 301: s = 0; n means nothing)."""
        self.acknowledges, self.releases = True, True
        """PP: bit 12 rises with bit 4, and falls with it."""
        self.homing = "attained"
        """Or failed, or never."""
        self.deaf_to_nmt = 0
        """NMT commands that are lost."""
        self.started_late = 0
        """ms after which it obeys an NMT command."""
        self.resets = 1
        """Fault resets that it needs."""
        self._rejected: dict[tuple[tuple[int, int] | int, int | None], int] = {}
        self._sending: list[tuple[int, Frame]] = []
        self._late: list[tuple[int, CanFrame]] = []
        self._requests: list[CanFrame] = []
        """The first one is being served."""
        self._served_at = 0
        self._latched: dict[int, CanFrame] = {}
        self._mapped = False
        self._acknowledged = self._responses = 0
        for text in ("6064=4096", "6502=0x3AD", "6079=48000", "1018:04=4711", "60A9=0x00B50300"):
            self.change(text)
        self.local.add_write_callback(self._written)
        self._show()

    def enabled(self) -> bool:
        """It gives torque."""
        return self._state in ("OPERATION ENABLED", "QUICK STOP ACTIVE")

    # -- what a transcript demands -------------------------------------------------------------

    def change(self, text: str) -> str:
        """Do what a line demands, or return what is not as it says."""
        first, *rest = (token.strip('"') for token in tokens(text))
        if rest[:1] == ["is"]:
            data = rest[1].encode("latin-1") if f'"{rest[1]}"' in text else bytes.fromhex(rest[1])
            self.local.data_store.setdefault(int(first, 16), {})[0] = data
            return ""
        if "=" not in first:
            return getattr(self, f"_line_{first}")(rest) or ""
        for token in (first, *rest):
            self._set(*token.split("="))
        return ""

    def _set(self, name: str, text: str) -> None:
        if name in vars(self):
            setattr(self, name, {"yes": True, "no": False}.get(text, int(text) if text.isdigit() else text))
        else:
            self.put(*address(name), int(text, 0))

    def _line_has(self, wanted: Sequence[str]) -> str:
        pairs = [(name, int(text, 0)) for name, text in (token.split("=") for token in wanted)]
        return " ".join(f"{n}={self.get(*address(n))}" for n, v in pairs if self.get(*address(n)) != v)

    def _line_state(self, wanted: Sequence[str]) -> str:
        return "" if self._state == wanted[0] else self._state

    def _line_pdo(self, rest: Sequence[str]) -> None:
        first, identifier, kind, *entries = rest
        index = int(first, 16)
        timer = [int(entry[6:]) for entry in entries if entry.startswith("timer=")] or [0]
        mapped = [
            int(entry, 0) if entry[:2] == "0x" else self._entry(entry)
            for entry in entries
            if "=" not in entry
        ]
        for key, number in (
            ((index, 1), int(identifier, 0)),
            ((index, 2), int(kind)),
            ((index, 5), timer[0]),
        ):
            self.put(*key, number)
        for sub, number in enumerate((len(mapped), *mapped)):
            self.put(index + 0x200, sub, number)
        self._mapped = False

    def _entry(self, name: str) -> int:
        index, sub = address(name)
        return index << 16 | sub << 8 | len(self._variable(index, sub))

    def _line_lacks(self, names: Sequence[str]) -> None:
        own = self.local.object_dictionary
        for index in (int(name, 16) for name in names):
            if index in own:
                own.names.pop(own.indices.pop(index).name, None)
            self.local.data_store.pop(index, None)

    def _line_rejects(self, rest: Sequence[str]) -> None:
        name, _, number = rest[0].partition("=")
        key = address(name) if ":" in name else int(name, 16)
        self._rejected[key, int(number, 0) if number else None] = int(rest[1], 0)

    def _line_accepts(self, _: Sequence[str]) -> None:
        self._rejected.clear()

    def _line_stands(self, rest: Sequence[str]) -> None:
        self._control = State402.CW_COMMANDS_CODE.get(rest[0], 0) & DEMAND & ~0x80
        for index, number in ((0x6040, self._control), (0x6060, int(rest[1])), (0x6061, int(rest[1]))):
            self.put(index, 0, number)
        self._go(rest[0])

    def _line_trips(self, rest: Sequence[str]) -> None:
        self._go("FAULT")
        self.put(0x603F, 0, int(rest[0], 0))
        if "quietly" not in rest:
            self.local.emcy.send(int(rest[0], 0), 1, bytes(5))

    def _line_restarts(self, _: Sequence[str] = ()) -> None:
        self.slave.network.cyclic.clear()
        self.local.nmt.state = "INITIALISING"
        self.local.nmt.state = "PRE-OPERATIONAL"
        for index in (*FORGOTTEN, 0x6040, 0x6060):
            self.local.data_store.pop(index, None)
        self._control, self._mapped, self._requests = 0, False, []
        self._go("SWITCH ON DISABLED")

    def _line_gets(self, rest: Sequence[str]) -> None:
        frame = FRAMES.frame(" ".join(rest))
        assert isinstance(frame, CanFrame)
        self._handle(frame)

    def _line_sends(self, rest: Sequence[str]) -> None:
        self._sending.append((self._ms, FRAMES.frame(" ".join(rest))))

    # -- its dictionary -------------------------------------------------------------------------

    def _variable(self, index: int, sub: int) -> Any:
        found = self.local.object_dictionary[index]
        return found if isinstance(found, canopen.objectdictionary.ODVariable) else found[sub]

    def put(self, index: int, sub: int, value: int) -> None:
        """Put a value into its dictionary. A maker's object that it lacks is made, a byte."""
        own = self.local.object_dictionary
        if index not in own:
            made = canopen.objectdictionary.ODRecord(f"maker's {index:04X}", index)
            byte = canopen.objectdictionary.ODVariable(f"byte {sub}", index, sub)
            byte.data_type, byte.default = canopen.objectdictionary.datatypes.UNSIGNED8, 0
            made.add_member(byte)
            own.add_object(made)
        data = self._variable(index, sub).encode_raw(value)
        self.local.data_store.setdefault(index, {})[sub] = data

    def get(self, index: int, sub: int = 0) -> int:
        """Return a value of its dictionary."""
        return int(self._variable(index, sub).decode_raw(self.local.get_data(index, sub)))

    def _written(self, index: int, subindex: int, data: bytes, **_: Any) -> None:
        value = int.from_bytes(data, "little")
        for key in (((index, subindex), value), ((index, subindex), None), (index, value), (index, None)):
            if key in self._rejected:
                raise canopen.SdoAbortedError(self._rejected[key])
        self._mapped = self._mapped and not 0x1400 <= index < 0x1C00

    # -- the bus ------------------------------------------------------------------------------------

    def receive(self, frame: Frame) -> None:
        """Handle a frame of the driver."""
        assert isinstance(frame, CanFrame)
        if self.dead or frame.id == 0x700 + self.node:
            return
        if frame.id == 0 and self.deaf_to_nmt:
            self.deaf_to_nmt -= 1
        elif frame.id == 0 and self.started_late:
            self._late.append((self._ms + self.started_late, frame))
        elif frame.id == 0x600 + self.node and self.slow:
            if not self._requests:
                self._served_at = self._ms + self.slow
            waiting = [*self._requests[1:], frame]
            self._requests = [*self._requests[:1], *waiting[max(0, len(waiting) - self.keeps) :]] or [frame]
        else:
            self._handle(frame)

    def _handle(self, frame: CanFrame) -> None:
        if frame.id == 0 and frame.data[0] in (0x81, 0x82) and frame.data[1] in (0, self.node):
            self._line_restarts()
            return
        self.slave.receive(frame)
        self._on_pdo(frame)
        self._obey()
        if frame.id == 0x80:
            self._report(lambda pdo: 0 < pdo.trans_type <= 240 and self._ms // 10 % pdo.trans_type == 0)

    def _serve(self) -> None:
        """Serve SDO requests one after the other."""
        if self._requests and self._ms >= self._served_at:
            self._handle(self._requests.pop(0))
            self._served_at = self._ms + self.slow

    def step(self) -> list[Frame]:
        """Return what it sends in this millisecond."""
        self._ms += 1
        if self.dead:
            self.slave.take_sent()
            return []
        while self._late and self._late[0][0] <= self._ms:
            self._handle(self._late.pop(0)[1])
        self._serve()
        self._obey()
        self._report(
            lambda pdo: pdo.trans_type >= 254 and pdo.event_timer and self._ms % pdo.event_timer == 0
        )
        beat = self.get(0x1017)
        if beat and self._ms % beat == beat // 2:
            self.slave.network.sent += [CanFrame(i, bytes(d)) for i, d in self.slave.network.cyclic.items()]
        for frame in self.slave.take_sent():
            times = [0]
            if frame.id == 0x580 + self.node:
                times = [] if self.mute else [self.late] * self.copies
                self._responses += 1
                times += [self.late + self.echo] * (self.echo > 0 and self._responses % 3 == 0)
                if self.unsized and frame.data[0] == 0x43:
                    frame = CanFrame(frame.id, b"\x4e" + frame.data[1:])
            self._sending += [(self._ms + wait, frame) for wait in times]
        sent = [frame for at, frame in self._sending if at <= self._ms]
        self._sending = [(at, frame) for at, frame in self._sending if at > self._ms]
        return sent

    def _pdo(self, id_: int) -> Any:
        """Return the RPDO of an identifier, as the drive has it; None if it has none."""
        self._refresh()
        return next((pdo for pdo in self.local.rpdo.values() if pdo.enabled and pdo.cob_id == id_), None)

    def _refresh(self) -> None:
        if not self._mapped:
            for pdo in (*self.local.rpdo.values(), *self.local.tpdo.values()):
                pdo.read()
            self._mapped = True

    def _on_pdo(self, frame: CanFrame) -> None:
        if self.local.nmt.state != "OPERATIONAL":
            return
        if frame.id == 0x80:
            for each in [self._latched.pop(id_) for id_ in sorted(self._latched)]:
                self._take(each)
        elif 0x200 < frame.id < 0x580 and (pdo := self._pdo(frame.id)) is not None:
            if pdo.trans_type <= 240:
                self._latched[frame.id] = frame
            else:
                self._take(frame)

    def _take(self, frame: CanFrame) -> None:
        pdo = self._pdo(frame.id)
        if pdo is None or 8 * len(frame.data) < sum(variable.length for variable in pdo.map):
            return
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
            before, self._control = self._control, self.get(0x6040)
            rising = self._control & ~before & 0x80
            if self._state != "FAULT" or rising:
                self._demand(self._control & DEMAND)
            if not self.modes_late:
                self.put(0x6061, 0, self.get(0x6060))
        holds = 0x605A in self.local.object_dictionary and self.get(0x605A) >= 5
        if self._state == "QUICK STOP ACTIVE" and not holds and self._ms >= self._since + STOPPING_MS:
            self._go("SWITCH ON DISABLED")
        self._show()

    def _demand(self, control: int) -> None:
        if self._state == "FAULT":
            self.resets -= 1
            if self.resets > 0:
                return
            self.resets = 1
            self.put(0x603F, 0, 0)
        if (self._state, control) == ("QUICK STOP ACTIVE", 0x0F) and self.get(0x605A) < 5:
            return
        after = NEXT.get((self._state, control), self._state)
        if after != self._state:
            self._go(after)

    def _go(self, state: str) -> None:
        self._state, self._since = state, self._ms
        self._show()

    def _show(self) -> None:
        if not self.frozen and 0x6041 in self.local.object_dictionary:
            bits = self._mode_bits() if self._state == "OPERATION ENABLED" else 0
            self.put(0x6041, 0, STATUSWORDS[self._state] | bits)

    def _mode_bits(self) -> int:
        mode, bit4 = self.get(0x6061), self._control & 0x10
        if mode == OperationMode.HOMING:
            if not bit4:
                self._since = self._ms
                return 0x400
            if self.homing == "never" or self._ms < self._since + HOMING_MS:
                return 0
            if self.homing == "attained" and self._ms == self._since + HOMING_MS:
                self.put(0x6064, 0, self.get(0x607C))  # home is at 607C
            return 0x1400 if self.homing == "attained" else 0x2000
        if mode == OperationMode.PROFILED_POSITION:
            kept = self._acknowledged and not self.releases
            self._acknowledged = 0x1000 if (bit4 and self.acknowledges) or kept else 0
            return self._acknowledged
        return 0x1000 if mode in (8, 9, 10) else 0
