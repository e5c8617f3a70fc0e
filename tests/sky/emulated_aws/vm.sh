#!/bin/bash
# One VM: network, mount and process namespaces of its own over the baked image, with a real sshd
# in the foreground. It ends, with all that runs in it, when this process is killed.
# usage: vm.sh NAME ADDRESS IMAGE HOST_ROOT USER PUBLIC_KEY FIRST HIDDEN...
#   FIRST  commands that root runs at the first boot, as cloud-init does
set -euo pipefail
name=$1 address=$2 image=$3 host_root=$4 user=$5 key=$6 first=$7
shift 7
disk=$image/vm/$name
mkdir -p "$disk/upper" "$disk/work" "$disk/root"
ip link del "v$name" 2>/dev/null || :  # of one that was stopped
ip netns add "$name"
ip link add "v$name" type veth peer name eth0 netns "$name"
ip link set "v$name" master br0 up
ip -n "$name" addr add "$address/16" dev eth0
ip -n "$name" link set eth0 up
ip -n "$name" link set lo up
ip -n "$name" route add default via 10.66.0.1  # the emulation: nothing is forwarded from there
# The outer shell must not be in the way of a kill: exec.
exec ip netns exec "$name" unshare --mount --pid --fork --kill-child --uts \
  bash -euc '
    disk=$1 image=$2 host_root=$3 user=$4 key=$5 address=$6 first=$7
    shift 7
    mount --make-rprivate /
    mount -t overlay overlay \
      -o "lowerdir=$image/layer:$host_root,upperdir=$disk/upper,workdir=$disk/work" "$disk/root"
    cd "$disk/root"
    mount -t proc proc proc
    mount --rbind /dev dev
    for folder in dev/shm tmp run; do mount -t tmpfs tmpfs "$folder"; done
    # What lies on the launching machine is not on a VM.
    for folder in "$@"; do [ ! -d ".$folder" ] || mount -t tmpfs tmpfs ".$folder"; done
    chmod 1777 tmp dev/shm
    mkdir -p run/sshd
    if [ -d "$image/cgroup" ]; then  # it has Docker
      mount -t sysfs sysfs sys
      mount --rbind "$image/cgroup" sys/fs/cgroup
      mkdir -p var/lib/docker
      mount -t tmpfs tmpfs var/lib/docker  # an overlay cannot lie on another one
    fi
    hostname "ip-${address//./-}"
    echo "127.0.0.1 localhost ip-${address//./-}" >etc/hosts
    : >etc/resolv.conf
    install -d -m700 home/ubuntu/.ssh
    echo "$key" >home/ubuntu/.ssh/authorized_keys
    chown -R --reference=home/ubuntu home/ubuntu/.ssh
    if [ "$user" = root ]; then  # it has all that the image has for the other one
      chown -R root:root home/ubuntu/.ssh
      chown root:root home/ubuntu
      mount --bind home/ubuntu root
    fi
    path=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
    docker=
    if [ -d "$image/cgroup" ]; then
      docker="--cgroup-parent=/${image##*/}"
      mkdir -p .old
      pivot_root . .old  # as in `world.sh`
      umount -l .old
    fi
    env -i PATH="$path" chroot . sh -c "$first" >/dev/null 2>&1 || echo "a first command failed"
    if [ -n "$docker" ]; then
      env -i PATH="$path" chroot . dockerd --iptables=false --bridge=none "$docker" \
        --add-runtime here=/usr/local/sbin/runc-here --default-runtime here \
        --insecure-registry 10.66.0.1:5000 >var/log/dockerd.log 2>&1 &
    fi
    # How a VM that ends itself finds AWS. And the niceness of Ray would put it behind all that runs on
    # this machine, not behind what runs on it.
    exec env -i PATH="$path" \
      chroot . /usr/sbin/sshd -D -e -o UsePAM=no -o PidFile=/run/sshd.pid \
      -o "SetEnv=AWS_ENDPOINT_URL=http://10.66.0.1:5566 RAY_worker_niceness=0"
  ' vm "$disk" "$image" "$host_root" "$user" "$key" "$address" "$first" "$@"
