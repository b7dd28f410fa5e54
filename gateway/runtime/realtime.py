"""`--realtime`: what Linux grants a loop that must not wait: priority, memory, a processor, interrupts.

Rules. Each is asked for by itself, and what was granted or refused is said in a line. All threads of the
process get it: one that holds Python's lock must not be left waiting for a processor. At the end of the run
all is as before. The machine is not starved: a thread that does not sleep for `RUNAWAY` at this priority gets
SIGXCPU, and after twice that it is killed; and the kernel leaves 5 % of each processor to others, unless it
was set otherwise.
"""

from __future__ import annotations

import ctypes
import os
import re
import resource
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from gateway.buses.usb import resolved
from gateway.core.robot import TWIN, Robot
from gateway.errors import UserError

LOWEST, HIGHEST, DEFAULT = 1, 80, 40
"""Priorities: the kernel's own threads have 50 for interrupts, 99 for what must never wait."""
RUNAWAY = 3
"""s"""
_LOCKED = 1 | 2 | 4
"""MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT: what was once used stays; nothing is filled that is not used."""
_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23


@dataclass(frozen=True, slots=True)
class RealtimeWanted:
    """What is asked for."""

    priority: int = DEFAULT
    processor: int | None = None
    """The only one to run on; None: any."""
    required: bool = False
    """Whether the run is not to begin without it."""


def wanted_of(text: str | None) -> RealtimeWanted | None:
    """Return what PRIORITY, cpu=N and required ask for, each of which may be absent; None for None.

    Raises UserError for anything else."""
    if text is None:
        return None
    wanted = RealtimeWanted()
    for word in filter(None, text.split(",")):
        if word == "required":
            wanted = replace(wanted, required=True)
        elif re.fullmatch(r"cpu=[0-9]{1,4}", word):
            wanted = replace(wanted, processor=int(word[4:]))
        elif re.fullmatch(r"[0-9]{1,2}", word) and LOWEST <= int(word) <= HIGHEST:
            wanted = replace(wanted, priority=int(word))
        else:
            raise UserError(
                f"--realtime: {word!r} is no priority from {LOWEST} to {HIGHEST}, cpu=N or required, as in "
                "--realtime=40,cpu=1,required"
            )
    return wanted


@contextmanager
def realtime(
    wanted: RealtimeWanted | None, robot: Robot, say: Callable[[str], object] = print
) -> Iterator[None]:
    """While inside, have what is wanted, as far as it is granted; say what that is, in a line each.

    Raises UserError if it is required and was refused."""
    if wanted is None:
        yield
        return
    with ExitStack() as stack:
        refused: list[str] = []
        grants = (_processor(wanted.processor, stack), _memory(stack), _priority(wanted.priority, stack))
        for granted, text in grants:
            say(f"real time: {text}")
            if not granted:
                refused.append(text)
        if refused and wanted.required:
            raise UserError(f"--realtime is required: {'; '.join(refused)}")
        for bus in robot.buses.values():
            if bus.interface != TWIN:
                say(f"real time: {_interrupts(resolved(bus).interface, wanted.priority, stack)}")
        yield


def _threads() -> list[int]:
    return [int(one.name) for one in Path("/proc/self/task").iterdir()]


def _processor(wanted: int | None, stack: ExitStack) -> tuple[bool, str]:
    before = os.sched_getaffinity(0)
    if wanted is None:
        return True, f"any processor of {', '.join(map(str, sorted(before)))}"
    try:
        _on({wanted})
    except OSError as error:
        return False, f"processor {wanted} was not granted: {error.strerror}"
    stack.callback(_on, before)
    return True, f"processor {wanted} alone"


def _on(processors: set[int]) -> None:
    for thread in _threads():
        with suppress(ProcessLookupError):
            os.sched_setaffinity(thread, processors)


def _memory(stack: ExitStack) -> tuple[bool, str]:
    """Lock it, unless it is limited: then what is allocated later would fail."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit != resource.RLIM_INFINITY and not _capable(_CAP_IPC_LOCK):
        return False, (
            f"memory was not locked, since at most {limit // 1024} kB may be: run with CAP_IPC_LOCK, or add "
            "'@realtime - memlock unlimited' to /etc/security/limits.conf for your group"
        )
    kernel = ctypes.CDLL(None, use_errno=True)
    if kernel.mlockall(_LOCKED):
        return False, f"memory was not locked: {os.strerror(ctypes.get_errno())}"
    stack.callback(kernel.munlockall)
    return True, "memory locked"


def unallowed(proc: Path = Path("/proc")) -> str:
    """Return why this process would not get a priority of real time; "" if it would. Changes nothing."""
    limits = (proc / "self/limits").read_text()
    found = re.search(r"(?m)^Max realtime priority\s+(\w+)", limits)
    allowed = found[1] if found else "0"
    if allowed == "unlimited" or int(allowed) >= DEFAULT or _capable(_CAP_SYS_NICE, proc):
        return ""
    return f"no priority of real time is allowed (at most {allowed}, {DEFAULT} is usual)"


def _capable(capability: int, proc: Path = Path("/proc")) -> bool:
    effective = re.search(r"(?m)^CapEff:\s*(\w+)", (proc / "self/status").read_text())
    return effective is not None and bool(int(effective[1], 16) >> capability & 1)


def _priority(priority: int, stack: ExitStack) -> tuple[bool, str]:
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    limits = resource.getrlimit(resource.RLIMIT_RTTIME)
    try:
        _bound(RUNAWAY * 1_000_000, 2 * RUNAWAY * 1_000_000)
        stack.callback(_bound, *limits)
        stack.callback(_schedule, policy, parameter)
        _schedule(os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return False, (
            f"priority {priority} was not allowed: run with CAP_SYS_NICE, or add "
            f"'@realtime - rtprio {priority}' to /etc/security/limits.conf for your group"
        )
    except OSError as error:
        return False, f"priority {priority} was not granted: {error.strerror}"
    return True, f"priority {priority} (SCHED_FIFO)"


def _bound(soft: int, hard: int) -> None:
    """Bound the time [µs] that a thread may run with this priority without a sleep. Only with
    CAP_SYS_RESOURCE can it be raised again; it bounds nothing at other priorities."""
    with suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_RTTIME, (soft, hard))


def _schedule(policy: int, parameter: os.sched_param) -> None:
    for thread in _threads():
        with suppress(ProcessLookupError):
            os.sched_setscheduler(thread, policy, parameter)


# -- interrupts -------------------------------------------------------------------------------------


def _interrupts(interface: str, priority: int, stack: ExitStack) -> str:
    """Put the threads of an adapter's interrupts above the loop, where it has any."""
    name = os.path.realpath(interface.partition(":")[2]) if ":/" in interface else interface.partition(":")[2]
    numbers = interrupts(Path(name).name)
    if not numbers:
        return f"interrupts of {interface}: none were found"
    texts = []
    for number in numbers:
        threads = interrupt_threads(number)
        texts += [f"{number}, at once"] * (not threads)
        texts += [f"{number}, its thread {_raised(thread, priority, stack)}" for thread in threads]
    return f"interrupts of {interface}: {'; '.join(texts)}"


def _raised(thread: int, priority: int, stack: ExitStack) -> str:
    try:
        policy, parameter = os.sched_getscheduler(thread), os.sched_getparam(thread)
        if parameter.sched_priority <= priority:
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority + 1))
            stack.callback(_lowered, thread, policy, parameter)
        return f"with priority {os.sched_getparam(thread).sched_priority}"
    except OSError as error:
        return f"as it was: {error.strerror}"


def _lowered(thread: int, policy: int, parameter: os.sched_param) -> None:
    with suppress(OSError):
        os.sched_setscheduler(thread, policy, parameter)


def interrupts(name: str, sys: Path = Path("/sys"), proc: Path = Path("/proc")) -> list[int]:
    """Return the interrupts of a network interface or a serial port: by its name, else of the controller
    (PCI, USB host) that it hangs on."""
    found: set[int] = set()
    known = [sys / "class" / kind / name for kind in ("net", "tty")]
    for place in filter(Path.exists, known):
        device = (place / "device").resolve()
        found |= _named(name, proc) or next(filter(None, map(_of_device, [device, *device.parents])), set())
    return sorted(found)


def _named(name: str, proc: Path) -> set[int]:
    """Return the interrupts that a driver has requested by the interface's name."""
    with suppress(OSError):
        lines = [line.strip().partition(":") for line in (proc / "interrupts").read_text().splitlines()]
        return {int(number) for number, _, rest in lines if name in re.split(r"[\s,]+", rest)}
    return set()


def _of_device(place: Path) -> set[int]:
    """Return the interrupts that a device's folder names; none if it names none."""
    with suppress(OSError, ValueError):
        return {int(one.name) for one in (place / "msi_irqs").iterdir()}
    with suppress(OSError, ValueError):
        return {int((place / "irq").read_text())} - {0}
    return set()


def interrupt_threads(number: int, proc: Path = Path("/proc")) -> list[int]:
    """Return the kernel's threads of an interrupt; none where interrupts are not threaded."""
    found = []
    for one in proc.glob("[0-9]*"):
        with suppress(OSError):
            if (one / "comm").read_text().startswith(f"irq/{number}-"):
                found.append(int(one.name))
    return sorted(found)
