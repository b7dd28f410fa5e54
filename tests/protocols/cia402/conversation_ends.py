"""The other ends of the conversations of vectors, of package canopen 2.4.1: a drive's firmware, and a host.

Rules. `Firmware` is canopen's LocalNode with a state machine of CiA 402 behind it: it moves the statusword by
the controlword, and tells by TPDO what its PDO parameters ask for. `host` is what canopen's RemoteNode says.
Run as a program, it records all conversations anew.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

import canopen

from protocols.cia402 import objects as o
from protocols.wire import CanFrame
from tests.protocols.cia402 import conversations
from tests.protocols.cia402.conversations import FILE, NODE, SCRIPTS, Script, frame_of, obeyed, play
from tests.protocols.cia402.stack import Joined, Slave, dictionary
from tests.protocols.cia402.tables import TABLES

UP = {(0x250, 6): 0x231, (0x231, 7): 0x233, (0x233, 15): 0x237, (0x231, 15): 0x237, (0x217, 15): 0x237}


class Firmware:
    """A drive: a LocalNode, and what lies behind it."""

    def __init__(self) -> None:
        self.slave = Slave(NODE)
        self.slave.said()
        self.quiet = self.mute = self.deaf = self.twice = False
        self.stubborn = 0
        self.beating = self.acknowledges = True
        self.strangers = False
        self.others = [Slave(5), Slave(7), Slave(126)]
        self.extra: list[CanFrame] = []
        """Of nobody, or of another: said beside its own frames."""
        self.homes: bool | None = True
        self.beats: list[int] = []
        self.refused: dict[tuple[int, int | None], int] = {}
        self.control = 0
        self.homed_at: int | None = None
        self.ms = 0
        for key, value in ((o.STATUSWORD, 0x250), (o.POSITION, 4096), (o.SUPPORTED_MODES, 0x3AD)):
            self.put(key, value)
        self.put(o.VELOCITY, -20)
        self.put(o.DC_VOLTAGE, 48_000)
        self.put(o.SERIAL_NUMBER, 4711)
        self.slave.node.add_write_callback(self._refuse)

    def put(self, key: o.Key, value: int) -> None:
        """Put a value into its dictionary."""
        data = o.to_bytes(o.OBJECTS[key].type, value)
        self.slave.node.data_store.setdefault(key[0], {})[key[1]] = data

    def get(self, key: o.Key) -> int:
        """What stands in it."""
        try:
            return self.slave.value(*key)
        except canopen.SdoAbortedError:
            return 0

    def lose(self, index: int) -> None:
        """It has no such object."""
        own = self.slave.node.object_dictionary
        own.names.pop(own.indices.pop(index).name, None)
        self.slave.node.data_store.pop(index, None)

    def _refuse(self, index: int, subindex: int, data: bytes, **_: Any) -> None:
        value = int.from_bytes(data, "little")
        for key in ((index, value), (index, None)):
            if key in self.refused:
                raise canopen.SdoAbortedError(self.refused[key])

    def fail(self, code: int) -> None:
        """Trip a fault."""
        self.put(o.STATUSWORD, 0x218)
        self.put(o.ERROR_CODE, code)
        self.slave.node.emcy.send(code, 2, bytes(5))

    def restart(self) -> None:
        """Switch it off and on."""
        self.slave.network.cyclic.clear()
        self.slave.node.nmt.state = "INITIALISING"
        self.slave.node.nmt.state = "PRE-OPERATIONAL"
        for number in (1, 2, 3, 4):
            for first in (0x1400, 0x1800, 0x1600, 0x1A00):
                self.slave.node.data_store.pop(first + number - 1, None)
        self.slave.node.data_store.pop(0x1017, None)
        self.put(o.STATUSWORD, 0x250)

    def nmt(self, command: int) -> None:
        """Somebody else's NMT command."""
        self.slave.receive(CanFrame(0, bytes((command, NODE))))

    def up(self, ms: int, down: Sequence[str], script: Script) -> list[CanFrame]:
        """A millisecond: hear, move, speak."""
        self.ms = ms
        if ms in script.acts:
            script.acts[ms](self)
        for text in () if self.quiet else down:
            frame = frame_of(text)
            if frame.id == 0x700 + NODE:
                continue
            if frame.id == 0 and frame.data in (b"\x81\x02", b"\x82\x02"):
                self.restart()
                continue
            self.slave.receive(frame)
            self._rpdo(frame)
            self._obey()
            if frame.id == 0x80:
                self._tell(lambda pdo: 0 < pdo.trans_type <= 240)
        if self.quiet:
            self.slave.said()
            return []
        if ms % 10 == 5:
            self._tell(lambda pdo: pdo.trans_type >= 254 and bool(pdo.event_timer))
        self.put(o.POSITION, 4096 + ms // 7)
        if ms % 100 == 50:
            for id_, data in self.slave.network.cyclic.items():
                self.slave.network.sent.append(CanFrame(id_, bytes(data)))
        if self.beats and ms % 10 == 0:
            self.slave.network.sent.append(CanFrame(0x700 + NODE, bytes((self.beats.pop(0),))))
        own = [frame for frame in self.slave.said() if self.beating or frame.id != 0x700 + NODE]
        own += self._of_others(down) if self.strangers else []
        own += [self.extra.pop(0) for _ in range(min(3, len(self.extra)))]
        said = [frame for frame in own if not (self.mute and frame.id == 0x580 + NODE)]
        return [frame for frame in said for _ in range(1 + (self.twice and frame.id == 0x580 + NODE))]

    def _of_others(self, down: Sequence[str]) -> list[CanFrame]:
        """Of two drives at 5 and 7 (the second is two), and one at 126 that tells little of itself."""
        for other in self.others:
            other.said()
        self.others[2].node.object_dictionary.indices.pop(0x1018, None)
        for text in down:
            for other in self.others:
                other.receive(frame_of(text))
        told = [other.said() for other in self.others]
        return [*told[0], *told[1], *told[1], *told[2]]

    def _rpdo(self, frame: CanFrame) -> None:
        """LocalNode leaves what its PDOs mean to the firmware: its own PdoMap reads them."""
        for number in (1, 2, 3, 4):
            if frame.id != 0x100 + 0x100 * number + NODE or self.slave.node.nmt.state != "OPERATIONAL":
                continue
            known = self.slave.node.rpdo[number]
            known.read()
            known.on_message(frame.id, bytearray(frame.data), 0.0)
            for variable in known.map:
                self.slave.node.data_store.setdefault(variable.index, {})[variable.subindex] = bytes(
                    variable.get_data()
                )

    def _tell(self, which: Any) -> None:
        if self.slave.node.nmt.state != "OPERATIONAL":
            return
        for number in (1, 2, 3, 4):
            known = self.slave.node.tpdo[number]
            known.read()
            if known.enabled and which(known):
                for variable in known.map:
                    variable.raw = self.slave.node.sdo[variable.index].raw
                known.transmit()

    def _obey(self) -> None:
        control, before, self.control = self.get(o.CONTROLWORD), self.control, self.get(o.CONTROLWORD)
        if self.deaf:
            return
        status = self.get(o.STATUSWORD) & 0x27F
        if status == 0x218:
            if control & ~before & 0x80:
                self.stubborn -= 1
                if self.stubborn <= 0:
                    self.put(o.ERROR_CODE, 0)
                    status = 0x250
        elif not control & 2:
            status = 0x250
        elif not control & 4:
            status = 0x217 if status in (0x217, 0x237) else 0x250
        elif control & 15 == 6 and status != 0x217:
            status = 0x231
        else:
            status = UP.get((status, control & 15), status)
        self.put(o.MODE_DISPLAY, self.get(o.MODE))
        self.put(o.STATUSWORD, status | self._mode_bits(status, control))

    def _mode_bits(self, status: int, control: int) -> int:
        mode = self.get(o.MODE)
        if status != 0x237:
            return 0
        if mode == 6:
            if not control & 16:
                self.homed_at = None
                return 0x400
            self.homed_at = self.ms if self.homed_at is None else self.homed_at
            if self.homes is None or self.ms < self.homed_at + 40:
                return 0
            return 0x1400 if self.homes else 0x2000
        if mode == 1:
            return 0x1000 if control & 16 and self.acknowledges else 0
        return 0x1000 if mode in (8, 9, 10) else 0


# -- a host ---------------------------------------------------------------------------------------------


class Host:
    """A RemoteNode whose frames are kept; whatever answers."""

    def __init__(self) -> None:
        self.network = Joined()
        self.slave = Slave(NODE)
        self.node: Any = canopen.RemoteNode(NODE, dictionary(NODE))
        self.network.add_node(self.node)
        self.network.on_sent = self.slave.receive
        self.slave.network.on_sent = self.network.hear

    def write(self, index: int, value: int, sub: int = 0, size: int = 0) -> None:
        """Write an object, in another length if so asked."""
        data = value.to_bytes(size, "little", signed=value < 0) if size else self._encoded(index, sub, value)
        with contextlib.suppress(canopen.SdoAbortedError):
            self.node.sdo.download(index, sub, data)

    def _encoded(self, index: int, sub: int, value: int) -> bytes:
        known = self.node.object_dictionary[index]
        variable = known if isinstance(known, canopen.objectdictionary.ODVariable) else known[sub]
        return bytes(variable.encode_raw(value))

    def read(self, index: int, sub: int = 0) -> None:
        """Read an object."""
        with contextlib.suppress(canopen.SdoAbortedError, canopen.SdoCommunicationError):
            self.node.sdo.upload(index, sub)

    def frames(self) -> list[CanFrame]:
        """What it has said."""
        sent, self.network.sent = self.network.sent, []
        return sent

    def enable(self, mode: int) -> None:
        """Up to OPERATION ENABLED."""
        self.write(0x6060, mode)
        for word in (6, 7, 15):
            self.write(0x6040, word)


def pp(host: Host) -> None:
    """Profile position: absolute and relative set-points, at once and one after the other, halt."""
    host.enable(1)
    for target, word in (
        (500, 0x1F), (500, 0x0F), (700, 0x1F), (700, 0x0F), (50, 0x5F), (50, 0x0F), (90, 0x7F), (90, 0x0F),
        (-40, 0x5F), (-40, 0x0F), (-40, 0x5F), (-40, 0x1F), (7, 0x3F), (7, 0x0F), (7, 0x10F), (9, 0x11F),
        (9, 0x0F), (11, 0x3F), (11, 0x3F), (11, 0x07), (11, 0x0F), (12, 0x5F),
    ):  # fmt: skip
        host.write(0x607A, target)
        host.write(0x6040, word)
    host.write(0x6060, 3)
    host.write(0x60FF, -777)
    host.write(0x6060, 1)
    host.write(0x6040, 0x06)


def modes(host: Host) -> None:
    """Every mode with its set-points and offsets, before and while it is enabled."""
    for mode in (8, 9, 10, 3, 4, 6, 0, 7, 2, -1):
        host.write(0x6040, 0x00)
        for index, value in ((0x607A, -1234), (0x60FF, 4321), (0x6071, -250), (0x60B1, 100), (0x60B2, 50)):
            host.write(index, value)
        host.enable(mode)
        for index, value in ((0x607A, 99), (0x60FF, -98), (0x6071, 97), (0x60B1, -96), (0x60B2, 95)):
            host.write(index, value)
        host.write(0x6040, 0x1F)
        host.write(0x6040, 0x10F)
        host.write(0x6040, 0x0F)


def power(host: Host) -> None:
    """Every demand in every state, with every option of a quick stop; faults reset; the host is lost."""
    words = (0x00, 0x06, 0x07, 0x0F, 0x02, 0x80, 0x8F, 0x06, 0x0F, 0x07, 0x06, 0x07, 0x02, 0x07, 0x0F, 0x00)
    for option in (0, 1, 2, 3, 5, 6, 7, 8, -1):
        host.write(0x605A, option)
        for word in (*words, 6, 7, 15, 2, 15, 2, 6, 2, 0):
            host.write(0x6040, word)
    for option in (0, 1, 2, 3, 4):
        host.write(0x6007, option)
        for command in (2, 0x82, 0x81):
            host.node.nmt.send_command(1)
            host.enable(8)
            host.node.nmt.send_command(command)
            host.write(0x6040, 0x80)
            host.write(0x6040, 0x00)
            host.node.nmt.send_command(0x80)
    host.network.sent.append(CanFrame(0, bytes((1, 0))))
    host.network.sent.append(CanFrame(0, bytes((2, 9))))


def pdos(host: Host) -> None:
    """RPDOs of every kind: at once, with SYNC, of no use; in each NMT state."""
    node = host.node
    for number, kind, keys in (
        (1, 255, (0x6040, 0x6060, 0x607A)),
        (2, 1, (0x60FF, 0x6071)),
        (3, 0, (0x60B1, 0x60B2)),
        (4, 240, (0x607A,)),
    ):
        known = node.rpdo[number]
        known.read()
        known.clear()
        known.trans_type, known.enabled = kind, True
        for index in keys:
            known.add_variable(index)
        known.save()
    for state in (0x80, 1, 2, 1):
        node.nmt.send_command(state)
        for control, mode in ((6, 8), (7, 8), (15, 8), (15, 9), (15, 10), (0, 8)):
            for number, values in (
                (2, (1000 + mode, -mode)),
                (3, (-3, 4)),
                (1, (control, mode, -555)),
                (4, (5,)),
            ):
                for variable, value in zip(node.rpdo[number].map, values, strict=True):
                    variable.raw = value
                node.rpdo[number].transmit()
            host.network.sync.transmit()
        host.network.sync.transmit()
    host.network.sent += [CanFrame(0x202, b"\x06"), CanFrame(0x203, bytes(7)), CanFrame(0x202, bytes(8))]
    host.network.sent += [CanFrame(0x77F, b"\x05"), CanFrame(0x704, b"\x05")]
    host.write(0x1016, 0x7F01F4, 1)
    host.network.sent += [CanFrame(0x77F, b"\x05"), CanFrame(0x701, b"\x05"), CanFrame(0x77F, b"\x00")]
    for number, kind in ((1, 241), (2, 253), (3, 254), (4, 255)):
        node.rpdo[number].cob_id = 0x200 + NODE if number < 3 else 0x400
        node.rpdo[number].trans_type = kind
        node.rpdo[number].save()
    host.write(0x1600, 0, 0)
    host.write(0x1400, 0x8000_0202, 1)
    host.write(0x1600, 1, 0)
    host.write(0x1600, 0, 0)
    for word in (0x6041_0010, 0x6040_0008, 0x5FFF_0010, 0x607A_0020, 0x0005_0008, 0x1000_0020):
        host.write(0x1600, word, 1)
    host.write(0x1600, 9, 0)
    host.write(0x1600, 2, 0)


def objects(host: Host) -> None:
    """Every object read, and written in its own length with some values, and in wrong ones."""
    for index, sub in o.OBJECTS:
        if 0x1401 <= index <= 0x1403 or 0x1601 <= index <= 0x1603 or 0x1801 <= index <= 0x1A7F:
            continue
        host.read(index, sub)
        for value, size in ((1, 1), (7, 2), (0x1234, 4), (-1, 1), (-1, 2), (-1, 4)):
            host.write(index, value, sub, size)
        host.read(index, sub)
    for index, sub in ((0x5FFF, 0), (0x1018, 9), (0x6041, 1), (0x608F, 3), (0x2000, 0), (0x1018, 0)):
        host.read(index, sub)
        host.write(index, 1, sub, 2)
    host.write(0x1008, 0x41424344454647, 0, 7)
    host.write(0x6081, 0x41424344454647, 0, 8)


def units(host: Host) -> None:
    """Units written, then set-points in them; the objects that may be written only as they stand."""
    host.enable(8)
    host.node.nmt.send_command(1)
    for index, sub, value in (
        (0x608F, 1, 1000),
        (0x608F, 2, 3),
        (0x6091, 1, 5),
        (0x6091, 2, 2),
        (0x6092, 1, 720),
        (0x6092, 2, 7),
        (0x6076, 0, 2500),
        (0x6075, 0, 900),
        (0x608F, 1, 0),
    ):
        host.write(index, value, sub)
        for mode, target in ((8, 0x607A), (9, 0x60FF), (10, 0x6071)):
            host.write(0x6060, mode)
            host.write(target, 333)
    for value in (0x80, 0x4000_0080, 0x81, 0x80):
        host.write(0x1005, value)
        host.read(0x1005)


def pieces(host: Host) -> None:
    """Transfers in segments: whole, with a wrong toggle bit, without a beginning, broken off."""
    say = host.network.sent.append

    def raw(text: str) -> None:
        say(CanFrame(0x600 + NODE, bytes.fromhex(text)))

    start, first, second = "4008100000000000", "6000000000000000", "7000000000000000"
    host.read(0x1008)
    for told in (
        (start, first, first, second),
        (start, second, first),
        (start, first, second, second, first),
        (first, second),
        (start, "8008100000000405", first),
        (start, start, first, second, first),
        (start, "4000100000000000", first),
    ):
        for text in told:
            raw(text)
    begin, one, two, last = "2181600008000000", "0001020304050607", "1D08000000000000", "1108000000000000"
    host.write(0x6081, 1234, 0, 8)
    for told in (
        (begin, one, one),
        (begin, one, two),
        (begin, two, one),
        (begin, one, last, two),
        (one, two),
        (begin, "8081600000000405", one),
        (begin, first, one, two),
        ("2181600004000000", "0701020304000000"),
        ("2081600000000000", "0701020304000000"),
        ("2181600005000000", "0701020304000000"),
    ):
        for text in told:
            raw(text)
        host.read(0x6081)


HOSTS = {
    "host, pp": pp,
    "host, modes": modes,
    "host, power": power,
    "host, pdos": pdos,
    "host, objects": objects,
    "host, units": units,
    "host, pieces": pieces,
}


def host_frames(name: str) -> list[CanFrame]:
    """What canopen's host says."""
    host = Host()
    host.frames()
    HOSTS[name](host)
    return host.frames()


def _talk(script: Script) -> list[str]:
    device = Firmware()
    script.acts.get(-1, lambda _: None)(device)
    return [str(line) for line in play(script, lambda ms, down: device.up(ms, down, script))]


def recorded() -> dict[str, list[str]]:
    """All conversations anew, with the package."""
    found = {name: _talk(script) for name, script in SCRIPTS.items()}
    for name in HOSTS:
        frames = host_frames(name)
        ends = ("ear", "twin") if name in ("host, pp", "host, power") else ("ear", "usual ear")
        found |= {f"{name}, {end}": obeyed(frames, end) for end in ends[: 1 + (name != "host, objects")]}
    found |= {name: list(table()) for name, table in TABLES.items()}
    return found


if __name__ == "__main__":
    text = [line for name, lines in recorded().items() for line in (f"== {name}", *lines)]
    FILE.write_text("\n".join(text) + "\n", "utf-8")
    print(conversations.FILE)
