"""How a serial port is opened: for this program alone, at any rate; and why it cannot be, in words.

Rules. Each reason names what helps: the group, the rule or the program. A port is marked as ours twice, by a
lock for programs that ask (flock), and by TIOCEXCL for those that do not; root is refused by neither.
"""

from __future__ import annotations

import errno
import fcntl
import grp
import os
import pwd
import stat
import termios
from contextlib import suppress
from pathlib import Path

import serial
from serial.rs485 import RS485Settings

from gateway.buses import ports, usb
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.messages import MILLISECOND

PROC = Path("/proc")
USB_SERIAL = Path("/sys/bus/usb-serial/devices")
TRANSFER = 2 * MILLISECOND
"""What an adapter on USB takes beside its timer: a frame of the bus each way."""
MODEM_MANAGER = (
    "it looks for modems on every new port: `sudo systemctl disable --now ModemManager`, or for this adapter "
    'a udev rule with ENV{ID_MM_DEVICE_IGNORE}="1"'
)


def open_port(settings: BusSettings) -> serial.Serial:
    """Open the port of a bus; nothing old is in it. Raises BusError with what is missing and what helps."""
    path = usb.resolved(settings).interface.partition(":")[2]
    try:
        port = serial.Serial(None, settings.baudrate, timeout=0, write_timeout=0, exclusive=True)
        port.dtr, port.port = settings.dtr == "on", path
        port.open()
    except (OSError, ValueError, termios.error) as error:
        raise BusError(f"{_head(settings)}: {_reason(settings, path, error)}") from error
    try:
        if settings.rs485 != "off":
            _switch_direction(settings, path, port)
    except BusError:
        port.close()
        raise
    with suppress(OSError):
        fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
    with suppress(OSError, ValueError):  # most adapters have no such mode
        port.set_low_latency_mode(True)
    ports.purge(port.fileno())
    return port


def close_port(settings: BusSettings, port: serial.Serial) -> None:
    """Close a port. A DTR that was off while it was open is on from here: the kernel is not to drop it, as it
    does when the last program closes a port."""
    if settings.dtr == "off":
        with suppress(OSError, termios.error):  # a pty has no such line; a port that has vanished, nothing
            attributes = termios.tcgetattr(port.fileno())
            attributes[2] &= ~termios.HUPCL
            termios.tcsetattr(port.fileno(), termios.TCSANOW, attributes)
            port.dtr = True
    with suppress(OSError):  # a port that has vanished cannot be closed either
        port.close()


def _head(settings: BusSettings) -> str:
    return f"bus {settings.name!r} cannot be opened as {settings.interface!r}"


def _switch_direction(settings: BusSettings, path: str, port: serial.Serial) -> None:
    """Have the kernel switch the direction of RS-485 by RTS. Its delays are whole milliseconds: none."""
    high = settings.rs485 == "rts_high"
    try:
        port.rs485_mode = RS485Settings(high, not high, loopback=False, delay_before_tx=0, delay_before_rx=0)
    except (OSError, ValueError) as error:
        why = f"the driver of {path} cannot switch the direction of RS-485 by RTS ({error})"
        text = f"{why}. Adapters on USB do it by themselves: leave rs485 out, and see whether they echo"
        raise BusError(f"{_head(settings)}: {text}.") from error


def _reason(settings: BusSettings, path: str, error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code in (errno.EAGAIN, errno.EBUSY):
        return in_use(path)
    if code in (errno.EACCES, errno.EPERM):
        return forbidden(path)
    if code in (errno.EIO, errno.ENODEV, errno.ENXIO):
        return f"{path} is there, but nothing behind it: its adapter was unplugged, or there is no such chip"
    if "baud" in str(error):
        return f"the driver of {path} has no rate of {settings.baudrate} bit/s ({error})"
    if "Could not configure" in str(error) or code == errno.ENOTTY:
        return f"{path} is no serial port ({error})"
    why = f"there is no {path}" if code == errno.ENOENT else str(error)
    return f"{why}. Serial ports of this machine: {usb.listed(usb.port_names())}."


def in_use(path: str, proc: Path = PROC) -> str:
    """Return which program has a port open."""
    found = holders(path, proc)
    if not found:
        return f"another program has {path} open, of another user: `sudo fuser -v {path}` names it"
    named = ", ".join(f"{name} (process {number})" for number, name in found)
    text = f"another program has {path} open: {named}"
    return f"{text}; {MODEM_MANAGER}" if any(name == "ModemManager" for _, name in found) else text


def holders(path: str, proc: Path = PROC) -> list[tuple[int, str]]:
    """Return number and name of the other processes that have a file open, as far as we may know."""
    real, found = str(Path(path).resolve()), list[tuple[int, str]]()
    for process in sorted(proc.glob("[0-9]*"), key=lambda one: int(one.name)):
        with suppress(OSError):
            opened = (_link(each) for each in (process / "fd").iterdir())
            if int(process.name) != os.getpid() and real in opened:
                found.append((int(process.name), (process / "comm").read_text().strip()))
    return found


def _link(path: Path) -> str:
    with suppress(OSError):
        return str(path.readlink())
    return ""


def forbidden(path: str, subsystem: str = "tty", usual: str = "dialout") -> str:
    """Return what permission is missing: which group, or which rule, of a kind of device and its usual
    group."""
    try:
        found = Path(path).stat()
    except OSError as error:
        return f"no permission: {error}"
    group, owner = _name(grp.getgrgid, found.st_gid), _name(pwd.getpwuid, found.st_uid)
    text = f"no permission: {path} is {owner}'s and of the group {group}, {stat.filemode(found.st_mode)[1:]}"
    both = stat.S_IRGRP | stat.S_IWGRP
    if found.st_mode & both != both or found.st_gid == 0:
        rule = f'SUBSYSTEM=="{subsystem}", KERNEL=="{Path(path).resolve().name}", MODE="0660"'
        return f'{text}: a udev rule gives it to a group: {rule}, GROUP="{usual}"'
    if found.st_gid in (os.getegid(), *os.getgroups()):
        return f"{text}: we are in it, so a rule of the system forbids it (a container, AppArmor)"
    user = _name(pwd.getpwuid, os.getuid())
    with suppress(KeyError):
        if user in grp.getgrgid(found.st_gid).gr_mem:
            return f"{text}: {user} is in it since after this login: log in again"
    return f"{text}: `sudo usermod -aG {group} {user}`, then log in again"


def _name(look: object, number: int) -> str:
    try:
        return str(look(number)[0])  # type: ignore[operator]
    except KeyError:
        return str(number)


def latency_timer(path: str, devices: Path = USB_SERIAL) -> int | None:
    """Return for how many ms an adapter holds back what it has received (FTDI); None if it has no timer."""
    try:
        return int((devices / Path(path).resolve().name / "latency_timer").read_text())
    except (OSError, ValueError):
        return None


def holds_back(settings: BusSettings, path: str, devices: Path = USB_SERIAL) -> str:
    """Return that a port delays answers, and what to do about it; "" if it does not."""
    timer = latency_timer(path, devices)
    if timer is None or timer <= 1:
        return ""
    chip = Path(path).resolve().name
    text = f"its adapter holds back what it receives for up to {timer} ms (its latency timer)"
    allowed = settings.latency - TRANSFER
    if settings.line != "free" and timer * MILLISECOND > allowed:
        needed = timer + TRANSFER // MILLISECOND
        text += f"; longer than latency_ms = {settings.latency / MILLISECOND:g}: answers will count as lost"
        text += f"; latency_ms = {needed} under [buses.{settings.name}], or better"
    else:
        text += ": each answer is that much older;"
    return (
        f"{text} a timer of 1 ms: `echo 1 | sudo tee {devices / chip / 'latency_timer'}`, for good by the "
        'udev rule ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"'
    )


_ICOUNT = 0x545D
"""TIOCGICOUNT (linux/serial.h): the driver's counters since the port is there."""


def line_errors(fileno: int) -> int:
    """Return how many bytes came without their stop bit, or as a break; 0 where the driver does not count."""
    try:
        counted = memoryview(fcntl.ioctl(fileno, _ICOUNT, bytes(80))).cast("i")
    except OSError:
        return 0
    return counted[6] + counted[9]  # rx 4, tx 5, frame 6, overrun 7, parity 8, brk 9
