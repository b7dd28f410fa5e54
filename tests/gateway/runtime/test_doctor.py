"""What the doctor says: each cause is provoked on twins, and its finding has what to do."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeAlias

import pytest
import serial

from gateway import config
from gateway.buses import Bus, interfaces, open_bus
from gateway.buses.adapters.pty import Pty
from gateway.buses.netlink import NetLink
from gateway.buses.serial import bus as serial_bus
from gateway.buses.serial.opening import holds_back
from gateway.buses.socketcan.bus import SocketcanBus
from gateway.buses.socketcan.raw_socket import RawSocket
from gateway.buses.troubles import of_writes
from gateway.buses.virtual.bus import TwinWorld, open_world
from gateway.core.clock import SimulatedClock
from gateway.core.robot import BusSettings, Robot
from gateway.errors import BusError
from gateway.runtime.doctor import Finding, examine, of_machine, of_opening, of_trouble
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import SECOND, Nanos
from tests.gateway.buses.test_socketcan import LINK, End, Kernel, error_frame
from tests.gateway.rig import BENCH
from tests.gateway.runtime.doctor_page import holds

Cause = Callable[[TwinWorld], None]


class Machine(NamedTuple):
    """What stands in for the files of the system."""

    folder: Path
    patch: pytest.MonkeyPatch


Provoked: TypeAlias = Callable[[Machine], list[Finding]]


class Overheard:
    """A bus that keeps what is sent."""

    def __init__(self, bus: Bus) -> None:
        self.name, self.sent = bus.name, list[Frame]()
        self.read, self.close = bus.read, bus.close
        self._bus = bus

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        self.sent += frames
        self._bus.write(now, frames)


def examined(truth: Robot, *causes: Cause, believed: Robot | None = None) -> list[Finding]:
    """Examine a robot whose twins are as `truth` says, after these causes."""
    world, clock = open_world(truth, 1), SimulatedClock()
    clock.wait(SECOND)
    for bus in world.buses.values():
        bus.read(clock.now())  # its devices run, each in its own phase
    for cause in causes:
        cause(world)
    return examine(believed or truth, world.buses, clock).findings()


def bench(*replaced: str) -> Robot:
    """Return the bench with pieces of its file replaced: old, new, old, new …"""
    text = BENCH
    for old, new in zip(replaced[::2], replaced[1::2], strict=True):
        assert old in text
        text = text.replace(old, new)
    return config.parse_robot(text)


def trip(world: TwinWorld) -> None:
    spec = bench().motors["left"].spec
    world.twin("left").provoke(next(iter(spec.faults)))


def lose(state: BusState) -> Cause:
    return lambda world: world.buses["can0"].lose(state)


# -- what provokes each cause ----------------------------------------------------------------------------


def opened(settings: BusSettings, **changed: object) -> list[Finding]:
    """Return what the doctor makes of a bus that cannot be opened."""
    with pytest.raises(BusError) as error:
        open_bus(replace(settings, **changed), SimulatedClock())  # type: ignore[arg-type]
    return [of_opening(settings.name, error.value)]


CAN0 = bench().buses["can0"]
LINE = BusSettings("line", "serial", "serial:/dev/ttyUSB7", baudrate=115_200)


def interface(folder: Path, flags: int) -> Callable[..., str]:
    """Return `missing` of a machine with one CAN interface, can0, up or down."""
    (folder / "can0").mkdir()
    for name, text in (("type", "280"), ("dev_port", "0"), ("flags", f"{flags:#x}")):
        (folder / "can0" / name).write_text(text)
    return partial(interfaces.missing, net=folder)


def no_interface(machine: Machine) -> list[Finding]:
    machine.patch.setattr(interfaces, "kernel_has_can", lambda: False)
    return opened(CAN0, interface="socketcan:can0")


def down(machine: Machine) -> list[Finding]:
    machine.patch.setattr(interfaces, "kernel_has_can", lambda: True)
    machine.patch.setattr(interfaces, "missing", interface(machine.folder, 0x80))
    return opened(CAN0, interface="socketcan:can0")


def forbidden(machine: Machine) -> list[Finding]:
    path = machine.folder / "ttyUSB7"
    path.touch(mode=0o600)

    def refuse(_: serial.Serial) -> None:
        raise serial.SerialException(errno.EACCES, "Permission denied")

    machine.patch.setattr(serial.Serial, "open", refuse)
    return opened(LINE, interface=f"serial:{path}")


def other_rate(_: Machine) -> list[Finding]:
    with pytest.raises(BusError) as error:
        interfaces.check_fit(CAN0, replace(LINK, bitrate=500_000))
    return [of_opening("can0", error.value)]


def usb(machine: Machine) -> list[Finding]:
    for name, text in (("idVendor", "1d50"), ("idProduct", "606f"), ("product", "candleLight")):
        (machine.folder / "1-1").mkdir(exist_ok=True)
        (machine.folder / "1-1" / name).write_text(f"{text}\n")
    (machine.folder / "1-1:1.0").mkdir()
    real = replace(bench(), buses={"can0": replace(CAN0, interface="socketcan:can0")})
    return of_machine(real, machine.folder, limited(machine.folder, 40))


def limited(folder: Path, priority: int) -> Path:
    """Return a /proc in which a process may have a priority."""
    (folder / "self").mkdir()
    (folder / "self/limits").write_text(f"Max realtime priority     {priority}     {priority}      \n")
    (folder / "self/status").write_text("CapEff:\t0000000000000000\n")
    return folder


def no_priority(machine: Machine) -> list[Finding]:
    real = replace(bench(), buses={"can0": replace(CAN0, interface="socketcan:can0")})
    return of_machine(real, machine.folder / "none", limited(machine.folder, 0))


def on_kernel(link: NetLink = LINK, *received: bytes, fails: int = 0) -> Provoked:
    """Return a robot on SocketCAN's bus, with a kernel that says this of itself, sends this, and lets writes
    fail with an errno."""

    def provoke(_: Machine) -> list[Finding]:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        for raw in received:
            theirs.send(raw)
        clock = SimulatedClock()
        settings = replace(CAN0, interface="socketcan:can0")
        with closing(SocketcanBus(settings, clock, End(ours), Kernel(link_=link))) as bus, theirs:
            if fails:
                bus._socket = Refusing(End(ours), fails)
            return examine(bench(), {"can0": bus}, clock).findings()

    return provoke


class Refusing(RawSocket):
    """A socket whose writes fail."""

    def __init__(self, end: End, number: int) -> None:
        super().__init__(end)
        self.number = number

    def send(self, frame: CanFrame) -> None:
        raise OSError(self.number, os.strerror(self.number))


def holding_back(machine: Machine) -> list[Finding]:
    with closing(Pty()) as pty:
        (machine.folder / Path(pty.path).name).mkdir()
        (machine.folder / Path(pty.path).name / "latency_timer").write_text("16\n")
        slow = partial(holds_back, devices=machine.folder)
        machine.patch.setattr(serial_bus, "holds_back", slow)
        lidar = config.load_robot("diffbot_rplidar")
        settings = replace(lidar.buses["lidar"], interface=f"serial:{pty.path}")
        with closing(serial_bus.open_serial(settings)) as bus:
            return [of_trouble("sensors", one) for one in bus.troubles()]


class Both:
    """Two buses as one wire."""

    def __init__(self, *buses: Bus) -> None:
        self.name, self._buses = buses[0].name, buses

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        found = [bus.read(now) for bus in self._buses]
        return [s for states, _ in found for s in states], sorted(
            (p for _, packets in found for p in packets), key=lambda one: one.t
        )

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        for bus in self._buses:
            bus.write(now, frames)

    def close(self) -> None:
        """Close nothing: the worlds are simulated."""


class Lossy(Both):
    """A wire of which one in eight frames arrives."""

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        states, packets = super().read(now)
        self.count = getattr(self, "count", 0) + len(packets)
        return states, [one for at, one in enumerate(packets, self.count) if at % 8 == 0]


def lossy(_: Machine) -> list[Finding]:
    clock = SimulatedClock()
    return examine(bench(), {"can0": Lossy(open_world(bench(), 1).buses["can0"])}, clock).findings()


def two_of_one_address(_: Machine) -> list[Finding]:
    clock = SimulatedClock()
    worlds = [open_world(serialled(number), 1).buses["can0"] for number in (5, 7)]
    clock.wait(SECOND)
    for bus in worlds:
        bus.read(clock.now())
    return examine(bench(), {"can0": Both(*worlds)}, clock).findings()


def serialled(number: int) -> Robot:
    """Return the bench with a left motor of this serial number."""
    return bench("address = 1\n", f"address = 1\nsettings = {{ serial_number = {number} }}\n")


def on_twins(truth: Robot, *causes: Cause, believed: Robot | None = None) -> Provoked:
    return lambda _: examined(truth, *causes, believed=believed)


def with_third(protocol: str) -> Robot:
    """Return the bench with a motor that no file knows."""
    text, own = BENCH, 'options = { watchdog = "acknowledged" }\n'
    for old, new in (
        (own, ""),
        ("address = 1\n", f"address = 1\n{own}"),
        ("address = 2\n", f"address = 2\n{own}"),
        ("[brain]\n", f'[motors.third]\nprotocol = "{protocol}"\naddress = 3\n[brain]\n'),
        ('"right"]', '"right", "third"]'),
        ("interface =", 'shared_bus = "acknowledged"\ninterface ='),
    ):
        text = text.replace(old, new)
    return config.parse_robot(text)


def of_settings(text: str) -> Robot:
    """Return the bench whose left motor is configured so."""
    return bench("address = 1\n", f"address = 1\nsettings = {{ {text} }}\n")


AT_0 = of_settings("bus_voltage = 2.0, dc_bus_undervoltage_trip_level = 0.0")
NARROW = bench("torque = 2.0 }", "torque = 2.0, position = [0.5, 1.0] }")
VESC = bench('"odrive_can"', '"vesc"', 'options = { watchdog = "acknowledged" }', "")
DAMAGED = tuple(error_frame(0x088, 0, 0, 0x04, 0x0A) for _ in range(20))
ALONE = tuple(error_frame(0x020) for _ in range(20))
LEFT_OUT = bench('[motors.right]\naddress = 2\non_fault = "continue"\n', "", ', "right"]', "]")


@dataclass(frozen=True)
class Case:
    """A cause, or two, and what must be said: of what, part of what was seen, part of what to type."""

    provoke: Provoked
    said: tuple[tuple[str, str, str], ...]
    when: float | None = 6.0
    """s after which it is told; None: opening tells it"""
    alone: bool = True
    """Whether nothing else may be said"""


def one(provoke: Provoked, about: str, seen: str, todo: str, when: float | None = 6.0) -> Case:
    return Case(provoke, ((about, seen, todo),), when)


UNPLUGGED = ("left", "nothing is heard of it at address 1 on can0", "gateway scan")
CASES: dict[str, Case] = {
    "driver module of the adapter": one(
        usb, "adapter", "no driver of the kernel has taken it", "sudo modprobe gs_usb", None
    ),
    "kernel without CAN": one(
        no_interface, "can0", "kernel has no CAN (errno 97", "sudo modprobe can_raw", None
    ),
    "interface down": one(down, "can0", "can0 is down", "sudo ip link set can0 up", None),
    "interface has another bit rate": one(
        other_rate,
        "can0",
        "can0 has a bitrate of 500000 bit/s, the robot file has 1000000",
        "type can bitrate 1000000",
        None,
    ),
    "adapter not plugged in": one(
        lambda _: opened(CAN0, interface="slcan:usb-0483:5740:99"),
        "can0",
        "that adapter is not there",
        "gateway scan",
        None,
    ),
    "no permission": one(forbidden, "line", "no permission: ", "gateway scan", None),
    "priority of real time": one(
        no_priority, "machine", "no priority of real time is allowed", "rtprio 40", None
    ),
    "latency of the adapter": one(
        holding_back, "sensors", "holds back what it receives for up to 16 ms", "latency_timer", None
    ),
    "interface listens only": one(
        on_kernel(replace(LINK, listen_only=True, restart_ms=100)),
        "can0",
        "in listen-only mode",
        "listen-only off",
    ),
    "nobody acknowledges": one(
        on_kernel(replace(LINK, counters=(128, 0), restart_ms=100), *ALONE),
        "can0",
        "no other node acknowledges what is sent (20 × no acknowledgement",
        "check supply and cable of the devices",
    ),
    "termination": one(
        on_kernel(replace(LINK, counters=(120, 96), restart_ms=100), *DAMAGED),
        "can0",
        "frames are damaged on the wire (20 × bit stuffing error",
        "60 ohms",
    ),
    "writes fail": one(
        on_kernel(replace(LINK, restart_ms=100), fails=errno.EPERM),
        "can0",
        "writes failed with errno 1 (EPERM",
        "ip -details link show can0",
    ),
    "bus-off": one(on_twins(bench(), lose(BusState.OFF)), "can0", "bus-off", "60 ohms"),
    "interface vanished": one(on_twins(bench(), lose(BusState.GONE)), "can0", "vanished", "supply"),
    "unplugged": one(on_twins(bench(), lambda world: world.disconnect("left")), *UNPLUGGED),
    "no supply": one(on_twins(AT_0), "left", "its supply reads 2.0 V", "switch its supply on"),
    "in fault": one(on_twins(bench(), trip), "left", "fault ", "clear left"),
    "reports too seldom": Case(
        lossy,
        (
            ("left", "times a second, 100 are expected", "gateway motor diff rig"),
            ("right", "times a second, 100 are expected", "gateway motor diff rig"),
        ),
    ),
    "turn lost": Case(
        on_twins(NARROW),
        (
            ("left", "it reads 0 rad, limits [0.5, 1.0]", "zero left (or home left, or confirm left)"),
            ("right", "it reads", "zero right"),
        ),
    ),
    "scale assumed": Case(
        on_twins(VESC), (("left", "options.pole_pairs = 7 is assumed", "options.pole_pairs = "),), alone=False
    ),
    "wrong address": Case(
        on_twins(bench(), believed=bench("address = 2", "address = 5")),
        (
            ("right", "that looks like odrive_can at address 2", "--protocol odrive_can"),
            ("odrive_can", "a device at address 2 is not in the robot file", "add it, or unplug it"),
        ),
    ),
    "wrong protocol": Case(
        on_twins(VESC, believed=bench()),
        (
            ("left", "that looks like vesc at address", "--protocol vesc"),
            ("right", "that looks like vesc at address", "--protocol vesc"),
        ),
    ),
    "ids that are not in the file": one(
        on_twins(with_third("vesc"), believed=bench()),
        "can0",
        "of no device in the robot file are heard: 0x903",
        "--protocol vesc",
    ),
    "two devices with one address": one(
        two_of_one_address, "left", "two devices have address 1", "setid can0"
    ),
    "older firmware": one(
        on_twins(
            of_settings('firmware = "0.5.6"'),
            believed=bench('"acknowledged" }', '"acknowledged", firmware = "0.6" }'),
        ),
        "left",
        "fault firmware 0.5.x",
        "or update the device",
    ),
    "unplugged, and another in fault": Case(
        on_twins(bench(), lambda world: world.disconnect("right"), trip),
        (("left", "fault ", "clear left"), ("right", "nothing is heard of it at address 2", "gateway scan")),
    ),
    "in fault, and another that is not in the file": Case(
        on_twins(with_third("vesc"), trip, believed=LEFT_OUT),
        (
            ("left", "fault ", "clear left"),
            ("odrive_can", "a device at address 2 is not in the robot file", "add it"),
        ),
        alone=False,
    ),
}


@pytest.mark.sample(9)
@pytest.mark.parametrize("cause", CASES)
def test_a_cause_is_said_with_what_to_do_as_the_page_has_it(
    cause: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = CASES[cause]
    findings = case.provoke(Machine(tmp_path, monkeypatch))
    holds(cause, case.said, findings, case.when)
    assert not case.alone or len(findings) == len(case.said), findings
    assert all(each.matters for each in findings)


def test_a_healthy_robot_has_no_findings_and_its_traffic_is_counted() -> None:
    world, clock = open_world(bench(), 1), SimulatedClock()
    seen = examine(bench(), world.buses, clock)
    assert seen.findings() == []
    assert all(each.sent > 0 and each.heard >= each.reported > 500 for each in seen.traffic.values())
    world.disconnect("left")
    assert str(examine(bench(), world.buses, clock).traffic["left"]).endswith("0 heard, silent")


@pytest.mark.parametrize(
    "number",
    [errno.ENOBUFS, errno.EAGAIN, errno.ENETDOWN, errno.ENODEV, errno.EIO, errno.EINVAL, errno.EACCES],
)
def test_each_errno_of_a_write_is_named_with_what_to_do(number: int) -> None:
    (said,) = of_writes({number: 3}, "can0")
    assert said.seen.startswith(f"3 writes failed with errno {number} ({errno.errorcode[number]}: ")
    assert said.todo
    assert "{" not in said.todo


def test_nothing_is_sent_but_what_only_reads_and_no_sensor_is_started() -> None:
    """Defect: a lidar that its robot file has started began to turn while the doctor looked."""
    robot = config.load_robot("diffbot_rplidar")
    world, clock = open_world(robot, 1), SimulatedClock()
    buses = {name: Overheard(bus) for name, bus in world.buses.items()}
    assert examine(robot, buses, clock).findings() == []
    sent = [(name, frame) for name, bus in buses.items() for frame in bus.sent]
    assert sent
    for name, frame in sent:
        assert all(one.spec.read_only(frame) for one in robot.devices_on(name)), (name, frame)
