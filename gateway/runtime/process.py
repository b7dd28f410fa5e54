"""What a process needs around a loop: signals, a quiet garbage collector."""

from __future__ import annotations

import gc
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager


@contextmanager
def signals(received: Callable[[str], object], *, suspend: bool = True) -> Iterator[None]:
    """While inside, SIGINT, SIGTERM, SIGHUP and SIGQUIT call `received` with their name; none raises.

    Without `suspend`, SIGTSTP does so, too, and using the terminal from the background does not stop the
    process: one that is stopped, as one whose terminal is closed (SIGHUP), must not leave motors turning.
    Under nohup SIGHUP stays ignored. Only the main thread can handle signals: in another one this does
    nothing."""

    def handler(number: int, _frame: object) -> None:
        received(signal.Signals(number).name)

    handlers: dict[signal.Signals, Callable[[int, object], None] | signal.Handlers]
    handlers = dict.fromkeys((signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT), handler)
    if not suspend:
        handlers[signal.SIGTSTP] = handler
        handlers[signal.SIGTTIN] = handlers[signal.SIGTTOU] = signal.SIG_IGN
    with ExitStack() as stack:
        for number, new in handlers.items():
            if number is signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue
            try:
                before = signal.signal(number, new)
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
