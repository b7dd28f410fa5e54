#!/bin/busybox sh
# The first process of the small machine (see machine.py): puts the file systems together, brings the CAN
# modules in, runs the job, writes its exit status to the share and powers off. Whatever fails before the
# job leaves no status behind, and that is a failure. What tests read lies in memory (the image, the project,
# tmpfs): while all wait for the host's files, the guest's clock runs to the next moment somebody waits for.
/bin/busybox --install -s /bin
say() { echo "machine: $*"; }
die() { say "$*"; poweroff -f; }

mount -t proc proc /proc
mount -t devtmpfs dev /dev
told=$(sed -n 's/.*tsc_early_khz=\([0-9]*\)000\>.*/\1/p' /proc/cmdline)
grep -q "^cpu MHz.*: $told\." /proc/cpuinfo || die "this kernel does not believe how fast it is ($told MHz)"
for module in $(cat /modules/order); do
    insmod "/modules/$module" || die "cannot insert $module"
done
mount -t 9p -o trans=virtio,version=9p2000.L,msize=1048576,cache=loose,ro host /host || die "no host files"
mount -t tmpfs tmpfs /above
mkdir /above/upper /above/work
mount -t ext4 -o noatime /dev/pmem0 /image || die "no image"
mount -t overlay -o lowerdir=/image/root:/host,upperdir=/above/upper,workdir=/above/work root /new || die "no root"

mount --move /dev /new/dev
mount --move /proc /new/proc
mount -t sysfs sys /new/sys
mount -t tmpfs tmpfs /new/run
mkdir -p /new/dev/pts /new/dev/shm /new/run/share
mount -t devpts pts /new/dev/pts
mount -t tmpfs shm /new/dev/shm
mount -t 9p -o trans=virtio,version=9p2000.L,msize=1048576 share /new/run/share || die "no share"

. /new/run/share/places.sh # ROOT, VENV, STDLIB, MODULES
mount -t tmpfs tmpfs "/new$ROOT" && tar -xf /new/run/share/project.tar -C "/new$ROOT" || die "no project"
mkdir -p "/new$VENV"
mount --bind /image/venv "/new$VENV" || die "no $VENV"
mount --bind /image/stdlib "/new$STDLIB" || die "no $STDLIB"
mkdir -p /new/lib/modules
ln -sfn "$MODULES" "/new/lib/modules/$(uname -r)"

export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
chroot /new /bin/sh -c 'modprobe -a can can-raw vcan can-gw kvaser_pci && ip link set lo up' || die "no CAN modules"
say "linux $(uname -r) is up after $(cut -d' ' -f1 /new/proc/uptime) s of its own time"
chroot /new /usr/bin/setsid /bin/sh /run/share/job.sh </new/dev/null
status=$?
say "done after $(cut -d' ' -f1 /new/proc/uptime) s of its own time"
echo $status >/new/run/share/status
umount /new/run/share
poweroff -f
