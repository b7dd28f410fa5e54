"""A small virtual machine with a CAN of its own, for hosts whose kernel has none: the host's side.

Rules. Nothing is installed and nothing of the host is changed: the kernel is Debian's, unpacked in a cache;
the guest sees the host's files read-only, with the project and its environment in memory above them. It is
emulated (no /dev/kvm) with `SPEED` instructions per nanosecond of its own time (`-icount shift=0,sleep=off`,
and a kernel configured for a faster processor), so that what happens inside does not depend on how busy the
host is. The job's exit status comes out in a file;
where there is none, the machine has failed. What is missing is a sentence (`Missing`).
"""

from __future__ import annotations

import compileall
import gzip
import hashlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
INIT = Path(__file__).with_name("init.sh")
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "motor-gateway" / "real-can"

PACKAGES = "qemu-system-x86 busybox-static cpio kmod e2fsprogs iproute2 can-utils"
PROGRAMS = "qemu-system-x86_64 busybox cpio modprobe depmod mke2fs ip candump cansend cangen apt-get dpkg"
INSIDE = "sh setsid env sleep cat ip tc candump cansend cangen modprobe"
"""Programs that tests start inside, and that are kept in memory there with Python and the libraries."""
FIRST_MODULES = ("virtio_pci", "9pnet_virtio", "9p", "overlay", "ext4", "nfit", "nd_pmem")
"""What the first file system must bring to reach the host's files and the image; the rest is there."""
LEFT_OUT = (".venv", ".git", "out", "build", "dist", ".[a-z]*_cache", ".hypothesis", "*.mcap")
MEMORY = "1536M"
SPARE = 128
"""MB of the image that are free, beside the space for what it holds."""
SPEED = int(os.environ.get("REAL_CAN_SPEED", "8"))
"""QEMU executes one instruction in a nanosecond and counts one for the processor's time stamp counter; the
kernel is configured so that it counts as many in a nanosecond. So a second inside is longer, and a robot of
200 Hz finds a processor about as fast as the host's. More of them are a faster processor."""
TIME_LIMIT = 5400.0
"""Seconds of the host from switching on to powering off: against hanging alone."""


class Missing(Exception):
    """Why the machine cannot be built here, in a sentence."""


@dataclass(frozen=True, slots=True)
class Parts:
    """What the machine is built from."""

    version: str
    tree: Path
    """The unpacked kernel package: boot/ and lib/modules/."""
    image: Path
    """The Python environment as an ext4 file system."""


def prepare() -> Parts:
    """Have everything at hand, fetching and building what is not. Raises Missing."""
    if os.uname().machine != "x86_64":
        raise Missing(
            f"the machine is an x86-64 one and shares this host's Python, which is {os.uname().machine}"
        )
    absent = [program for program in PROGRAMS.split() if _which(program) is None]
    if absent:
        raise Missing(f"{', '.join(absent)} missing: apt-get install --no-install-recommends {PACKAGES}")
    CACHE.mkdir(parents=True, exist_ok=True)
    tree = _kernel()
    return Parts(next((tree / "lib/modules").iterdir()).name, tree, _image())


def run(parts: Parts, job: Sequence[str], limit: float = TIME_LIMIT) -> int:
    """Boot, run the job in the project's folder, print what it prints; its exit status, or 1 for none."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="real-can-") as folder:
        share = Path(folder) / "share"
        share.mkdir()
        _fill_share(share, parts, job)
        initramfs = _initramfs(Path(folder), parts)
        reason = _boot(_qemu(parts, initramfs, share), limit)
        status = share / "status"
        reported = status.read_text().strip() if status.exists() else ""
    print(f"machine: {time.monotonic() - began:.0f} s in all", flush=True)
    if reported.isdigit() and not reason:
        return int(reported)
    print(f"machine: FAILED: {reason or 'it ended without a result'}", flush=True)
    return 1


# -- the parts ----------------------------------------------------------------------------------


def _which(program: str) -> str | None:
    return shutil.which(program, path=os.environ.get("PATH", os.defpath) + ":/usr/sbin:/sbin")


def _do(*command: str | Path, cwd: Path | None = None) -> str:
    """Run a tool and return its output. Raises Missing with its last line."""
    program = _which(str(command[0])) or str(command[0])
    done = subprocess.run([program, *command[1:]], cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        text = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
        raise Missing(f"`{shlex.join(map(str, command))}` failed: {text}")
    return done.stdout


def _kernel() -> Path:
    """Debian's kernel package, unpacked; the newest one that is in the cache, else fetched."""
    there = sorted(CACHE.glob("linux-image-*-amd64"), key=lambda path: path.stat().st_mtime)
    if there:
        return there[-1]
    found = re.search(r"Depends: (linux-image-\S+-amd64)\s", _do("apt-cache", "depends", "linux-image-amd64"))
    if found is None:
        raise Missing("apt knows no Debian kernel (linux-image-amd64): try apt-get update")
    with tempfile.TemporaryDirectory(dir=CACHE) as folder:
        _do("apt-get", "download", found[1], cwd=Path(folder))
        tree = Path(folder) / "tree"
        _do("dpkg", "-x", next(Path(folder).glob("*.deb")), tree)
        _do("depmod", "-b", tree, next((tree / "lib/modules").iterdir()).name)
        tree.rename(CACHE / found[1])
    return CACHE / found[1]


def _image() -> Path:
    """What tests read, as a file system in memory; made anew when it has changed.

    It holds the virtual environment, the standard library, and the programs with their libraries."""
    venv, stdlib = Path(sys.prefix), Path(sysconfig.get_path("stdlib"))
    name = hashlib.sha256("\n".join(_contents(venv, stdlib)).encode()).hexdigest()[:16]
    image = CACHE / f"image-{name}.ext4"
    if image.exists():
        return image
    for old in CACHE.glob("image-*.ext4"):
        old.unlink()
    with tempfile.TemporaryDirectory(dir=CACHE) as folder:
        stage = Path(folder) / "stage"
        _copy(venv, stage / "venv")
        _copy(stdlib, stage / "stdlib", "test", "site-packages", "config-*")
        for path in _system_files(stdlib):
            target = stage / "root" / path.relative_to("/")
            target.parent.mkdir(parents=True, exist_ok=True)
            _link(str(path), str(target))
        used = sum(path.lstat().st_blocks for path in stage.rglob("*")) // 2048
        size = f"{(used * 11 // 10 + SPARE) // 128 * 128 + 128}M"
        draft = Path(folder) / "image"
        _do("mke2fs", "-q", "-t", "ext4", "-O", "^has_journal", "-m", "0", "-d", stage, draft, size)
        draft.rename(image)
    return image


def _contents(venv: Path, stdlib: Path) -> Iterator[str]:
    """What distinguishes one image from another: Python, the distributions and their plugins, the
    programs."""
    yield f"{sys.version} {venv} {stdlib}"
    for path in sorted(Path(sysconfig.get_path("purelib")).glob("*.dist-info")):
        plugins = path / "entry_points.txt"
        yield f"{path.name} {plugins.read_text() if plugins.exists() else ''}"
    for path in _programs():
        yield f"{path} {path.stat().st_mtime_ns}"


def _programs() -> list[Path]:
    """Python, and the programs that tests start."""
    found = [_which(program) for program in INSIDE.split()]
    return sorted({Path(path).resolve() for path in (*found, sys.executable) if path})


def _system_files(stdlib: Path) -> list[Path]:
    """The programs, with every library that they or the standard library's extensions load."""
    binaries = [*_programs(), *stdlib.glob("lib-dynload/*.so")]
    libraries = {Path(path) for path in re.findall(r"(/\S+) \(0x", _do("ldd", *binaries))}
    outside = [path for path in binaries if stdlib not in path.parents]
    named = {path.parent.resolve() / path.name for path in libraries}  # /lib itself is a symbolic link
    whole = named | {path.resolve() for path in libraries} | set(outside)
    return sorted(whole | {Path("/etc/ld.so.cache"), Path("/etc/passwd")})


def _link(one: str, other: str) -> None:
    """A hard link where the disk allows it, else a copy. A symbolic link stays one."""
    try:
        os.link(one, other, follow_symlinks=False)
    except OSError:
        shutil.copy2(one, other, follow_symlinks=False)


def _copy(source: Path, target: Path, *left_out: str) -> None:
    ignore = shutil.ignore_patterns(*left_out)
    shutil.copytree(source, target, symlinks=True, ignore=ignore, copy_function=_link)


# -- one run ------------------------------------------------------------------------------------


def _fill_share(share: Path, parts: Parts, job: Sequence[str]) -> None:
    """The folder that host and guest share: the project as it is now, its places, and the job."""
    project = share.parent / "project"
    shutil.copytree(ROOT, project, symlinks=True, ignore=shutil.ignore_patterns(*LEFT_OUT))
    compileall.compile_dir(project, quiet=2, stripdir=project, prependdir=ROOT)  # what is stale or absent
    with tarfile.open(share / "project.tar", "w") as archive:
        archive.add(project, ".")
    places = {
        "ROOT": ROOT,
        "VENV": Path(sys.prefix),
        "STDLIB": Path(sysconfig.get_path("stdlib")),
        "MODULES": parts.tree / "lib/modules" / parts.version,
    }
    quoted = [f"{name}={shlex.quote(str(path))}" for name, path in places.items()]
    (share / "places.sh").write_text("\n".join(quoted) + "\n")
    variables = {"HOME": "/root", "LANG": "C.UTF-8", "OPENBLAS_NUM_THREADS": "1", "TMPDIR": "/run/tmp"}
    lines = [f"export {name}={value}" for name, value in variables.items()]
    lines += ["mkdir -p $HOME $TMPDIR", f"cd {shlex.quote(str(ROOT))}", shlex.join(job)]
    (share / "job.sh").write_text("\n".join(lines) + "\n")


def _initramfs(folder: Path, parts: Parts) -> Path:
    """The first file system: busybox, the modules that reach the others, and init."""
    top = folder / "initramfs"
    for name in ("bin", "modules", "proc", "dev", "host", "image", "above", "new"):
        (top / name).mkdir(parents=True)
    shutil.copy(INIT, top / "init")
    (top / "init").chmod(0o755)
    shutil.copy(_which("busybox") or "", top / "bin/busybox")
    order: list[str] = []
    for module in FIRST_MODULES:
        output = _do("modprobe", "-d", parts.tree, "-S", parts.version, "--show-depends", module)
        for path in (Path(line.split()[1]) for line in output.splitlines() if line.startswith("insmod ")):
            if path.name not in order:
                order.append(path.name)
                shutil.copy(path, top / "modules" / path.name)
    (top / "modules/order").write_text("\n".join(order) + "\n")
    names = "\n".join(str(path.relative_to(top)) for path in sorted(top.rglob("*"))) + "\n"
    packed = subprocess.run(
        ["cpio", "-o", "-H", "newc", "--quiet"],
        cwd=top,
        input=names.encode(),
        capture_output=True,
        check=True,
    )
    initramfs = folder / "initramfs.gz"
    initramfs.write_bytes(gzip.compress(packed.stdout, 1))
    return initramfs


def _qemu(parts: Parts, initramfs: Path, share: Path) -> list[str]:
    size = parts.image.stat().st_size
    shared = "security_model=none,multidevs=remap"
    # The image is private to the guest (share=off): what it writes there is gone with it.
    memory = f"memory-backend-file,id=image,share=off,mem-path={parts.image},size={size}"
    believed = f"tsc=reliable tsc_early_khz={SPEED * 1_000_000}"
    # fmt: off
    return [
        "qemu-system-x86_64", "-machine", "pc,accel=tcg,nvdimm=on", "-cpu", "max,avx2=off", "-smp", "1",
        "-icount", "shift=0,sleep=off", "-m", f"{MEMORY},slots=1,maxmem=16G",
        "-nodefaults", "-display", "none", "-serial", "stdio", "-no-reboot",
        "-kernel", str(parts.tree / f"boot/vmlinuz-{parts.version}"), "-initrd", str(initramfs),
        "-append", f"console=ttyS0 quiet panic=-1 mitigations=off highres=off {believed}",
        "-virtfs", f"local,path=/,mount_tag=host,readonly=on,{shared}",
        "-virtfs", f"local,path={share},mount_tag=share,{shared}",
        "-object", memory, "-device", "nvdimm,memdev=image",
        "-object", "can-bus,id=bus",
        "-device", "kvaser_pci,canbus=bus", "-device", "kvaser_pci,canbus=bus",
    ]
    # fmt: on


def _boot(command: Sequence[str], limit: float) -> str:
    """Run the machine until it powers itself off, printing its console. "" or what went wrong."""
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as machine:
        assert machine.stdout is not None
        too_long = threading.Timer(limit, machine.kill)
        too_long.start()
        for line in machine.stdout:
            print(line.decode("utf-8", "replace").rstrip(), flush=True)
        in_time = too_long.is_alive()
        too_long.cancel()
    if not in_time:
        return f"it was not done after {limit:.0f} s"
    return "" if machine.returncode == 0 else f"qemu ended with status {machine.returncode}"
