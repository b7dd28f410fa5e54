"""What a process needs around a loop: signals, a quiet garbage collector."""

from __future__ import annotations

import gc
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

WAY_OUT = {
    "SIGINT": "Ctrl-C",
    "SIGTERM": "a supervisor, or kill",
    "SIGHUP": "the terminal is closed; under nohup it stays ignored",
    "SIGQUIT": "Ctrl-backslash",
    "SIGTSTP": "Ctrl-Z: a process that is stopped would leave its motors turning",
    "SIGUSR1": "a supervisor's or batch system's own: it wants something that nobody here knows",
    "SIGUSR2": "the same",
    "SIGALRM": "a timer that a library has set",
    "SIGVTALRM": "the same",
    "SIGPROF": "the same: a profiler's that has gone",
    "SIGIO": "a file that a library has asked about (SIGPOLL)",
    "SIGSTKFLT": "no kernel sends it: somebody's kill",
    "SIGXCPU": "the processor time is used up, and SIGKILL follows",
    "SIGPWR": "the power fails",
    "SIGABRT": "systemd's watchdog; where the C library aborts, it does so after the handler",
    "SIGTRAP": "a breakpoint without a debugger",
    "SIGSYS": "a system call that a filter forbids",
}
"""Signals that end or stop a process, and who sends them: here they are reasons to leave, and so are the
real-time signals, which have no meaning of their own."""
IGNORED = {
    "SIGPIPE": "the write says so, by EPIPE",
    "SIGXFSZ": "the write says so, by EFBIG",
    "SIGTTIN": "the terminal is not read in the background",
    "SIGTTOU": "writing to it from the background must not stop the process",
}
"""Signals that would do so, and need not."""
BEYOND = {
    "SIGKILL": "no process can handle it",
    "SIGSTOP": "the same",
    "SIGSEGV": "a handler would return to the instruction that failed, for ever",
    "SIGBUS": "the same",
    "SIGFPE": "the same",
    "SIGILL": "the same",
}
"""Signals that take no way out: the watchdog process sends the stop action, where it can
(`gateway.runtime.watchdog`)."""
HARMLESS = ("SIGCHLD", "SIGCONT", "SIGURG", "SIGWINCH")
"""Signals that end nothing."""
SELDOM = 50_000
"""Objects allocated and not freed after which the garbage collector runs: by default 700."""
_OURS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")
"""Those that are handled whatever the program has set for them; of the others, those only that would end or
stop it."""
_BACKGROUND = ("SIGTSTP", "SIGTTIN", "SIGTTOU")
"""Signals of a terminal's job control."""


def signal_name(number: int) -> str:
    """Return the name of a signal, as in the tables above; "SIGRTMIN+3" for a real-time one."""
    if signal.SIGRTMIN <= number <= signal.SIGRTMAX:
        return f"SIGRTMIN+{number - signal.SIGRTMIN}"
    return signal.Signals(number).name


@contextmanager
def signals(received: Callable[[str], object], *, suspend: bool = True) -> Iterator[None]:
    """While inside, every signal that would end this process calls `received` with its name, or is ignored,
    as the tables above have it; none raises.

    Without `suspend`, SIGTSTP does so, too, and using the terminal from the background does not stop the
    process: one that is stopped, as one whose terminal is closed (SIGHUP), must not leave motors turning.
    Under nohup SIGHUP stays ignored. Only the main thread can handle signals: in another one this does
    nothing."""

    def handler(number: int, _frame: object) -> None:
        received(signal_name(number))

    with ExitStack() as stack:
        for number in sorted(signal.valid_signals()):
            name = signal_name(number)
            if name in BEYOND or name in HARMLESS or (suspend and name in _BACKGROUND):
                continue
            before = signal.getsignal(number)  # None: of another language
            if name in _OURS:
                kept = before is None or (name == "SIGHUP" and before is signal.SIG_IGN)
            else:
                kept = before is not signal.SIG_DFL
            if kept:
                continue
            try:
                signal.signal(number, signal.SIG_IGN if name in IGNORED else handler)
            except ValueError:  # not the main thread: that one handles the signals
                break
            stack.callback(signal.signal, number, before)
        yield


def ignore_signals() -> None:
    """Ignore every signal that can be: of a process that ends when it is told to, by its pipe."""
    for number in signal.valid_signals():
        if signal_name(number) not in BEYOND:
            signal.signal(number, signal.SIG_IGN)


@contextmanager
def quiet_collector(*, paced: bool = True) -> Iterator[None]:
    """Keep the garbage collector from scanning what was allocated before the loop began, and from running in
    every third step: what a step allocates is freed without it.

    `paced`: whether a step must not be late. In simulated time none is, and what was allocated before may be
    scanned now and then: to collect and set aside all of it takes as long as half a second of a run."""
    before = gc.get_threshold()
    if paced:
        gc.collect()
        gc.freeze()
    gc.set_threshold(SELDOM, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
        if paced:
            gc.unfreeze()


def fine_timers() -> None:
    """Have the kernel end this thread's sleeps on time, where it can: by default up to 50 µs late (prctl(2),
    PR_SET_TIMERSLACK), which is half of what is left of a line between an answer and the next question."""
    with suppress(OSError):
        Path("/proc/self/timerslack_ns").write_text("1000")
