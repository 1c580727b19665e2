#!/bin/busybox sh
# shellcheck shell=dash
# First process of the guest that run_in_guest.sh boots: builds the world CMD sees, runs it, hands back its status.
#
# /          a scratch directory of the host (hostfs, writable): busybox, kernel modules, and these files
#   settings   links=N columns=N rows=N out_tty=0|1 err_tty=0|1, written by the host
#   writable   one host directory a line that CMD may write to
#   command    bash script: the caller's environment, directory and command
#   state      ours: "up SECONDS KERNEL" once CMD can start, "exit N" when it has ended
# /host      the host's root, read-only            /new   the same under an overlay: what CMD sees
#
# tty0 carries kernel messages and our own complaints, tty1 CMD's stdout, tty2 its stderr.

stop() {
    [ -z "$1" ] || echo "guest: $1"
    sync
    poweroff -f
    # Never return: an init that ends panics the kernel, and poweroff needs a moment.
    sleep 60
}

export PATH=/bin
/bin/busybox --install -s /bin
mount -t proc proc /proc
links=1 rows=0 columns=0 out_tty=0 err_tty=0
# shellcheck disable=SC1091  # written by the host for each run
. /settings

for module in overlay can-raw vcan; do
    modprobe "$module" || stop "kernel module $module does not load"
done
# Extras for tests that want them (periodic sending by the kernel, routing and filtering); nothing here depends on them.
modprobe can-bcm || true
modprobe can-gw || true

mount -t hostfs -o ro,/ hostfs /host || stop "the host's file system can't be mounted"
mount -t tmpfs -o mode=755 tmpfs /upper
mkdir /upper/data /upper/work
mount -t overlay -o lowerdir=/host,upperdir=/upper/data,workdir=/upper/work overlay /new || stop "no overlay over the host's file system"

mount -t proc proc /new/proc
mount -t sysfs sysfs /new/sys
mount -t devtmpfs devtmpfs /new/dev
mkdir -p /new/dev/pts /new/dev/shm
mount -t devpts -o ptmxmode=666 devpts /new/dev/pts
mount -t tmpfs -o mode=1777 tmpfs /new/dev/shm
# What udev would make; bash's <(...) and /dev/stdout need them.
ln -sf /proc/self/fd /new/dev/fd
ln -sf /proc/self/fd/0 /new/dev/stdin
ln -sf /proc/self/fd/1 /new/dev/stdout
ln -sf /proc/self/fd/2 /new/dev/stderr

while IFS= read -r dir; do
    mkdir -p "/new$dir"
    mount -t hostfs -o "rw,$dir" hostfs "/new$dir" || stop "$dir can't be mounted for writing"
done </writable

ip link set lo up
i=0
while [ "$i" -lt "$links" ]; do
    # A long queue: with the default a burst of frames ends in ENOBUFS rather than in waiting.
    ip link add "vcan$i" type vcan || stop "vcan$i can't be made"
    ifconfig "vcan$i" txqueuelen 1000 up || stop "vcan$i does not come up"
    i=$((i + 1))
done
# The default receive buffer holds some hundred frames; one CPU and a busy reader need more.
echo 4194304 >/new/proc/sys/net/core/rmem_max
echo 1048576 >/new/proc/sys/net/core/rmem_default

# Raw, so that bytes pass unchanged; held open, so that they stay raw.
exec 8>/new/dev/tty1 9>/new/dev/tty2
for tty in tty1 tty2; do
    stty -F "/new/dev/$tty" raw -echo
    [ "$rows" = 0 ] || stty -F "/new/dev/$tty" rows "$rows" cols "$columns"
done

echo "up $(cut -d' ' -f1 /proc/uptime) $(uname -r)" >/state
sync
# The script comes in as an open file: its directory need not exist in CMD's world.
out_tty=$out_tty err_tty=$err_tty chroot /new /bin/bash /proc/self/fd/7 7</command </new/dev/null
echo "exit $?" >>/state
stop ""
