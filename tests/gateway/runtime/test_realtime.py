"""What Linux grants a run: asked for in a process of its own, whatever this one may have; adapters'
interrupts from folders as the kernel's documentation describes them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gateway.cli.main import main
from gateway.errors import UserError
from gateway.runtime.realtime import (
    DEFAULT,
    HIGHEST,
    LOWEST,
    RealtimeWanted,
    interrupt_threads,
    interrupts,
    wanted_of,
)
from tests.gateway.processes import PATIENCE


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (None, None),
        ("", RealtimeWanted(DEFAULT)),
        (f"{LOWEST}", RealtimeWanted(LOWEST)),
        (f"{HIGHEST},required", RealtimeWanted(HIGHEST, required=True)),
        ("required,cpu=1", RealtimeWanted(DEFAULT, 1, required=True)),
    ],
)
def test_what_can_be_wished(text: str | None, wanted: RealtimeWanted | None) -> None:
    assert wanted_of(text) == wanted


@pytest.mark.parametrize(
    "text", ["0", f"{HIGHEST + 1}", "-1", "5.0", "cpu=", "cpu=-1", "cpu=99999", "requird", "bench", "٣"]
)
def test_what_is_no_wish_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UserError, match=r"1 to 80, cpu=N or required, as in --realtime=40"):
        wanted_of(text)


ASKED = """
import os, resource, sys, threading, time
from gateway.config import load_robot
from gateway.errors import UserError
from gateway.runtime.realtime import realtime, wanted_of

def state():
    threads = [int(one) for one in os.listdir("/proc/self/task")]
    locked = next(line for line in open("/proc/self/status") if line.startswith("VmLck"))
    scheduled = {(os.sched_getscheduler(one), os.sched_getparam(one).sched_priority) for one in threads}
    affinity = {tuple(sorted(os.sched_getaffinity(one))) for one in threads}
    return len(threads), scheduled, affinity, int(locked.split()[1]) > 0

end = threading.Event()
threading.Thread(target=end.wait, daemon=True).start()
robot = load_robot("bench")
before = state()
try:
    with realtime(wanted_of(sys.argv[1]), robot):
        threads, scheduled, affinity, locked = state()
        limits = resource.getrlimit(resource.RLIMIT_RTTIME)
        print(threads > 1, sorted(scheduled), sorted(affinity), locked, limits)
except UserError as error:
    print(error)
print("as before", state() == before or (before, state()))
end.set()
"""


def asked(text: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", ASKED, text], capture_output=True, text=True, check=True, timeout=PATIENCE
    )
    return done.stdout.splitlines()


def test_what_is_said_to_be_granted_is_had_by_every_thread_and_given_back() -> None:
    """What is refused is said with the way to have it, and not had."""
    processor, memory, priority, had, after = asked("30,cpu=0")
    fifo = priority == "real time: priority 30 (SCHED_FIFO)"
    assert fifo or "limits.conf" in priority
    locked = memory == "real time: memory locked"
    assert locked or "limits.conf" in memory
    pinned = processor == "real time: processor 0 alone"
    assert pinned or "was not granted" in processor
    assert had.startswith(f"True {[(1, 30)] if fifo else [(0, 0)]} {'[(0,)]' if pinned else ''}")
    assert f" {locked} " in had
    assert not fifo or had.endswith("(3000000, 6000000)")  # the bound of a runaway, in µs
    assert after == "as before True"


def test_a_run_that_requires_what_is_refused_does_not_begin() -> None:
    *_, refusal, after = asked("required,cpu=4095")
    assert refusal.startswith("--realtime is required: ")
    assert "processor 4095 was not granted" in refusal
    assert after == "as before True"


@pytest.mark.parametrize("command", ["run bench --seconds 1", "twin bench --seconds 1"])
def test_a_command_that_requires_what_is_refused_ends_before_anything_is_armed(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([*command.split(), "--realtime=cpu=4095,required"]) == 2
    assert "processor 4095 was not granted" in capsys.readouterr().err


# -- interrupts ------------------------------------------------------------------------------------

TABLE = """\
           CPU0       CPU1
  5:         12          0  IO-APIC   5-edge      can1
 16:          9          0  IO-APIC  16-fasteoi   i801_smbus, can0
 28:          3          0  PCI-MSIX-0000:00:01.0   0-edge      xhci_hcd
NMI:          0          0   Non-maskable interrupts
"""


def test_interrupts_of_an_adapter_are_its_own_by_name_else_its_controllers(tmp_path: Path) -> None:
    sys, proc = tmp_path / "sys", tmp_path / "proc"
    controller = sys / "devices/pci0000:00/0000:00:14.0"
    (controller / "usb1/1-2/1-2:1.0").mkdir(parents=True)
    (controller / "irq").write_text("28\n")
    (sys / "devices/pci0000:00/0000:00:15.0/msi_irqs").mkdir(parents=True)
    for number in ("40", "41"):
        (sys / "devices/pci0000:00/0000:00:15.0/msi_irqs" / number).write_text("msix\n")
    for kind, name, device in (
        ("net", "can0", "devices/pci0000:00/0000:00:15.0"),
        ("net", "can2", "devices/pci0000:00/0000:00:15.0"),
        ("tty", "ttyACM0", "devices/pci0000:00/0000:00:14.0/usb1/1-2/1-2:1.0"),
    ):
        (sys / "class" / kind / name).mkdir(parents=True)
        (sys / "class" / kind / name / "device").symlink_to(sys / device)
    for name in ("can1", "vcan0"):
        (sys / "class/net" / name).mkdir()
    proc.mkdir()
    (proc / "interrupts").write_text(TABLE)
    found = {
        name: interrupts(name, sys, proc) for name in ("can0", "can1", "can2", "ttyACM0", "vcan0", "can")
    }
    assert found == {"can0": [16], "can1": [5], "can2": [40, 41], "ttyACM0": [28], "vcan0": [], "can": []}
    assert interrupts("can0", tmp_path / "none", tmp_path / "none") == []


def test_threads_of_an_interrupt_are_found_by_their_name(tmp_path: Path) -> None:
    for process, name in (
        (143, "irq/28-xhci_hcd"),
        (150, "irq/281-other"),
        (9, "irq/28-s-xhci"),
        (1, "init"),
    ):
        (tmp_path / f"{process}").mkdir()
        (tmp_path / f"{process}" / "comm").write_text(name + "\n")
    assert interrupt_threads(28, tmp_path) == [9, 143]
    assert interrupt_threads(2, tmp_path) == []
