"""What a process needs around a loop: signals, a quiet garbage collector, real-time priority."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager


@contextmanager
def signals(stop: Callable[[str], None]) -> Iterator[None]:
    """While inside, SIGINT, SIGTERM and SIGHUP call `stop` with their name.

    A second one raises KeyboardInterrupt. A terminal that is closed (SIGHUP) must not leave motors turning;
    under nohup the signal stays ignored. Only the main thread can handle signals: in another one this does
    nothing."""
    seen: list[int] = []

    def handler(number: int, _frame: object) -> None:
        if seen:
            raise KeyboardInterrupt
        seen.append(number)
        stop(signal.Signals(number).name)

    with ExitStack() as stack:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number is signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue
            try:
                before = signal.signal(number, handler)
            except ValueError:  # not the main thread: that one handles the signals
                break
            stack.callback(signal.signal, number, before)
        yield


@contextmanager
def quiet_collector() -> Iterator[None]:
    """Keep the garbage collector from scanning what was allocated before the loop began."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def request_realtime(priority: int) -> str:
    """Request the scheduling policy SCHED_FIFO; return "" if granted, else why not and what to do."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return (
            f"real-time priority {priority} was not allowed: run with CAP_SYS_NICE, or add "
            f"'@realtime - rtprio {priority}' to /etc/security/limits.conf for your group"
        )
    except OSError as error:
        return f"real-time priority {priority} was not granted: {error}"
    return ""
