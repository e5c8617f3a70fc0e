#!/bin/bash
# Run a command inside a world of its own: an emulated AWS, a network that leads nowhere else, and a
# root whose every change vanishes. When the command ends, all of it is gone.
# usage (as root): world.sh VENV RESULTS COMMAND...
#   VENV     with skypilot[aws], moto[ec2,server], uv and fogft
#   RESULTS  the one folder that outlives the world
# `IMAGE_CACHE=FILE.tar` keeps the baked image for the next time. With `CONTAINERS=1` the VMs have
# Docker, and there is a registry with an image that has ROS 2.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
if [ "${1:-}" != --inside ]; then
  exec unshare --mount --propagation private "$here/world.sh" --inside "$@"
fi
shift
venv=$1 results=$2
shift 2
image=$(mktemp -d /tmp/fogft-world.XXXXXX)
gone() {
  umount -l "$image"
  rmdir "$image"
  # What is left of containers that were killed with their VM.
  find /sys/fs/cgroup -depth -type d -path "*/${image##*/}*" -exec rmdir {} \; 2>/dev/null || :
}
trap gone EXIT
mount -t tmpfs -o size=14g tmpfs "$image"  # overlays need a file system other than the root's
start=$SECONDS
cache=${IMAGE_CACHE:+$IMAGE_CACHE${CONTAINERS:+.containers}}
if [ -n "$cache" ] && [ -f "$cache" ]; then
  tar -C "$image" --xattrs --xattrs-include='*' -xf "$cache"
else
  "$here/bake.sh" "$image" "$venv"
  [ -z "${CONTAINERS:-}" ] || "$here/bake_container.sh" "$image" "$venv"
  [ -z "$cache" ] || tar -C "$image" --xattrs --xattrs-include='*' -cf "$cache" \
    layer robot ${CONTAINERS:+container}
fi
echo "world: image ready after $((SECONDS - start)) s, $(du -sh "$image/layer" | cut -f1)" >&2

# The launching machine's root: the same layer (it needs ssh and rsync), and what it writes.
mkdir -p "$image/vm" "$image/upper" "$image/upper-work" "$image/root" "$image/host"
mount -t overlay overlay \
  -o "lowerdir=$image/layer:/,upperdir=$image/upper,workdir=$image/upper-work" "$image/root"
root=$image/root
mount --bind / "$image/host"
mount --rbind /dev "$root/dev"
mount -t tmpfs tmpfs "$root/dev/shm"
mount -t tmpfs tmpfs "$root/run"
mkdir -p "$root$image" "$root/robot" "$root$results"
mount --bind "$image" "$root$image"
mount --bind "$image/host" "$root$image/host"
mount --bind "$results" "$root$results"
cp -r "$image/robot/." "$root/robot/"
if [ -n "${CONTAINERS:-}" ]; then
  mkdir "$image/cgroup"
  mount --rbind /sys/fs/cgroup "$root$image/cgroup"
fi

unshare --mount --net --pid --ipc --uts --fork --kill-child bash -euc '
  root=$1 here=$2 venv=$3 image=$4 results=$5
  shift 5
  ip link set lo up
  ip link add br0 type bridge
  ip addr add 10.66.0.1/16 dev br0
  ip addr add 10.66.255.9/16 dev br0  # another one of the launching computer
  ip addr add 169.254.169.254/32 dev br0  # where a VM asks for its metadata
  ip link set br0 up
  mount -t proc proc "$root/proc"
  cd "$root"
  # For Docker a root of its own: what enters a container begins at the root of all mounts.
  if [ -d "$image/cgroup" ]; then
    mkdir -p .old
    pivot_root . .old
    umount -l .old
  fi
  exec chroot . env -i HOME=/robot PATH="$venv/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin" \
    LANG=C.UTF-8 PYTHONPATH= RESULTS="$results" EMULATION="$image" ENFORCED="${ENFORCED:-}" \
    OLD_SKY="${OLD_SKY:-}" \
    HIDDEN="$(printf "%s:" "${here%/tests/*}" "$venv" /root)" \
    "$venv/bin/python" "$here/inside.py" "$@"
' world "$root" "$here" "$venv" "$image" "$results" "$@"
