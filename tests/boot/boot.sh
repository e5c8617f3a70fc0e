#!/usr/bin/env bash
# Boot systemd in namespaces of its own, again and again until it is powered off.
#
#   boot.sh FOLDER CGROUP KEPT...
#
# Its root is an overlay over this machine's, which is only read; /dev, /run, /tmp and /var are its
# own, /sys and the kernel's settings read-only. What it writes lies in memory, outlives a reboot,
# and is gone with the last process. KEPT are folders that it sees read-only even where they lie in
# /tmp or /var. Run in a mount and a network namespace; CGROUP is a folder of cgroup2 for it alone.
set -euo pipefail
base=$1 cgroup=$2
shift 2
root=$base/root

mount --make-rprivate /
mount -t tmpfs -o mode=755 fogft-boot "$base"
mkdir -p "$base"/{upper,work,root,var/cache,var/lib/systemd,var/log/journal,var/tmp}
ln -s /run "$base/var/run"
chmod 1777 "$base/var/tmp"
mount -t overlay -o "lowerdir=/,upperdir=$base/upper,workdir=$base/work" fogft-boot "$root"
# Only what systemd brings itself is started, nothing that this machine has been told to start.
rm -rf "$root"/etc/systemd/{system,user}/* "$root"/etc/init.d/* "$root"/etc/rc?.d/*
for unit in getty@tty1 console-getty systemd-timesyncd systemd-networkd systemd-resolved; do
    ln -sf /dev/null "$root/etc/systemd/system/$unit.service"
done
: >"$root/etc/fstab"
echo fogft-boot >"$root/etc/hostname"
rm -f "$root/etc/machine-id"
tr -d - </proc/sys/kernel/random/uuid >"$root/etc/machine-id"
ip link set lo up

start() { # as the first process of a PID namespace
    mount --make-rprivate /
    mount -t proc proc "$root/proc"
    mount --bind "$root/proc/sys" "$root/proc/sys"
    mount -o remount,bind,ro "$root/proc/sys"
    [ ! -e "$root/proc/sysrq-trigger" ] || mount --bind /dev/null "$root/proc/sysrq-trigger"
    mount -t sysfs -o ro sysfs "$root/sys"
    mount -t cgroup2 cgroup2 "$root/sys/fs/cgroup"
    mount -t tmpfs -o mode=755 dev "$root/dev"
    local device
    for device in 'null 3' 'zero 5' 'full 7' 'random 8' 'urandom 9'; do
        mknod -m 666 "$root/dev/${device% *}" c 1 "${device#* }"
    done
    mknod -m 666 "$root/dev/tty" c 5 0
    mkdir "$root"/dev/{pts,shm}
    mount -t devpts -o newinstance,ptmxmode=0666,mode=620 devpts "$root/dev/pts"
    mount -t tmpfs -o mode=1777 shm "$root/dev/shm"
    ln -s pts/ptmx "$root/dev/ptmx"
    ln -s /proc/self/fd "$root/dev/fd"
    : >"$root/dev/console"
    mount --bind /dev/null "$root/dev/console"
    mount -t tmpfs -o mode=755 run "$root/run"
    mount -t tmpfs -o mode=1777 tmp "$root/tmp"
    mount --bind "$base/var" "$root/var"
    local kept above
    for kept; do
        mkdir -p "$root$kept"
        above=$(dirname "$kept")
        while [ "$above" != / ]; do # whose home it may be: everybody may pass
            chmod o+x "$root$above"
            above=$(dirname "$above")
        done
        mount --bind "$kept" "$root$kept"
        mount -o remount,bind,ro "$root$kept"
    done
    cd "$root"
    pivot_root . .
    umount -l .
    # Not the clock, the modules, the devices or the log of the machine that it really runs on.
    exec env -i container=fogft PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
        setpriv --bounding-set=-sys_time,-sys_module,-sys_rawio,-syslog,-mknod \
        --inh-caps=-all /usr/lib/systemd/systemd --system --unit=multi-user.target
}
export -f start
export root base

for _ in 1 2 3 4 5 6; do
    ended=0
    # shellcheck disable=SC2016 # for the inner shell
    bash -c 'echo $$ >"$0/cgroup.procs"
        exec unshare --mount --pid --cgroup --ipc --uts --fork --kill-child bash -euc "start \"\$@\"" boot "$@"' \
        "$cgroup" "$@" || ended=$?
    # By SIGINT the kernel tells that it was powered off; else it rebooted, or its power was cut.
    [ $ended != 130 ] || exit 0
done
