#!/bin/bash
# Add to the VMs' image a Docker daemon, and beside it the root of a container image as a user would
# have it: plain Debian or Ubuntu, ROS 2 at /opt/ros, no fogft, no Ray of ours but SkyPilot's runtime,
# which it would otherwise load from the network. Needs the network; ends offline.
# usage: bake_container.sh IMAGE VENV      (IMAGE: with `layer`, as `bake.sh` has left it)
set -euo pipefail
image=$1 venv=$2 here=$(cd "$(dirname "$0")" && pwd)
. /etc/os-release
mirror=http://deb.debian.org/debian
[ "$ID" = debian ] || mirror=http://archive.ubuntu.com/ubuntu
mkdir -p "$image/docker-work" "$image/docker-root" "$image/container"
mount -t overlay overlay \
  -o "lowerdir=/,upperdir=$image/layer,workdir=$image/docker-work" "$image/docker-root"
trap 'umount -R -l "$image/docker-root"' EXIT
root=$image/docker-root box=$image/container
mount --rbind /dev "$root/dev"
mount -t proc proc "$root/proc"
mkdir -p "$root/container"
mount --bind "$box" "$root/container"
DEBIAN_FRONTEND=noninteractive chroot "$root" \
  apt-get install -qq -y --no-install-recommends docker.io debootstrap >/dev/null
install -m755 "$here/runc_here.py" "$root/usr/local/sbin/runc-here"
chroot "$root" debootstrap --variant=minbase --include=ca-certificates,curl,fuse,openssh-server,patch,procps,python3,python3-pip,python3-venv,rsync,sudo,wget \
  "$VERSION_CODENAME" /container "$mirror" >/dev/null

cp /etc/resolv.conf "$box/etc/resolv.conf"
cp /etc/ssl/certs/ca-certificates.crt "$box/etc/ssl/certs/ca-certificates.crt"
cp -r "$image/layer/opt/wheelhouse" "$box/opt/wheelhouse"
mkdir -p "$box/root/.local/bin" "$box/root/.aws" "$box/root/.sky" "$box/etc/uv"
install -m755 "$venv/bin/uv" "$box/root/.local/bin/uv"
cp -r "$image/layer/home/ubuntu/.sky/wheels" "$box/root/.sky/wheels"
cp "$image/layer/home/ubuntu/.aws/config" "$box/root/.aws/config"
version=$("$venv/bin/python" -c 'import importlib.metadata as m; print(m.version("skypilot"))')
mount -t proc proc "$root/container/proc"
mount --rbind /dev "$root/container/dev"
chroot "$root/container" env -i HOME=/root PATH=/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8 \
  SSL_CERT_FILE=/etc/ssl/certs/ca-certificates.crt VERSION="$version" bash -euc '
  uv=~/.local/bin/uv
  $uv venv -q --seed ~/skypilot-runtime --python /usr/bin/python3
  VIRTUAL_ENV=~/skypilot-runtime $uv pip install -q "setuptools<70" "ray[default]==2.9.3" \
    "pydantic-core==2.41.1" "click<8.3.0" "skypilot[aws,remote]==$VERSION"
  # ROS 2 as an installation has it: of no use until its setup.bash is sourced.
  ros=/opt/ros/proof
  $uv venv -q --python /usr/bin/python3 $ros
  $uv pip install -q --no-index --find-links /opt/wheelhouse --python $ros/bin/python /opt/wheelhouse/ros_*.whl numpy
  packages=$(echo $ros/lib/python3*/site-packages)
  rm $packages/ros_wheels_bootstrapper.pth
  {
    echo "export ROS_DISTRO=proof PYTHONPATH=$packages"
    echo "export LD_LIBRARY_PATH=$(printf "%s:" $packages/ros_*.libs)$ros/lib"
  } > $ros/setup.bash
  rm -rf ~/.cache/uv
  $uv venv -q /tmp/warm --python /usr/bin/python3
  $uv pip install -q --no-index --find-links /opt/wheelhouse --python /tmp/warm/bin/python /opt/wheelhouse/*.whl
  rm -rf /tmp/warm /opt/wheelhouse/ros_*
  HOME=/tmp/warm ~/skypilot-runtime/bin/python -W ignore - && rm -rf /tmp/warm
' <"$here/warm.py"
printf 'offline = true\n[pip]\nno-index = true\nfind-links = ["/opt/wheelhouse"]\n' >"$box/etc/uv/uv.toml"
cp "$image/layer/etc/pip.conf" "$box/etc/pip.conf"
: >"$box/etc/resolv.conf"
umount -R -l "$root/container/proc" "$root/container/dev"
rm -rf "$box"/var/cache/apt/archives/*.deb "$box"/etc/apt/sources.list*  # apt has all it will need
