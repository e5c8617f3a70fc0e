#!/bin/bash
# Bake what the VMs boot from: a layer over this machine's own root, with sshd, rsync, sudo, a user,
# SkyPilot's runtime and a cache of the wheels that fogft needs. Needs the network; ends offline.
# usage: bake.sh IMAGE VENV      (IMAGE: a folder on a file system of its own, to hold `layer`)
set -euo pipefail
image=$1 venv=$2 here=$(cd "$(dirname "$0")" && pwd) checkout=$(cd "$(dirname "$0")/../../.." && pwd)
version=$("$venv/bin/python" -c 'import importlib.metadata as m; print(m.version("skypilot"))')
mkdir -p "$image/layer" "$image/work" "$image/root"
mount -t overlay overlay -o "lowerdir=/,upperdir=$image/layer,workdir=$image/work" "$image/root"
trap 'umount -R -l "$image/root"' EXIT
mount --rbind /dev "$image/root/dev"
mount -t proc proc "$image/root/proc"
in_image() { chroot "$image/root" "$@"; }

printf '#!/bin/sh\nexit 101\n' >"$image/root/usr/sbin/policy-rc.d"  # apt starts no service
chmod 755 "$image/root/usr/sbin/policy-rc.d"
in_image apt-get update -qq
DEBIAN_FRONTEND=noninteractive in_image apt-get install -qq -y --no-install-recommends \
  openssh-server openssh-client rsync sudo iproute2 python3 python3-venv >/dev/null
in_image useradd -m -s /bin/bash -p '*' ubuntu  # a locked account (`!`) is refused without PAM
echo "ubuntu ALL=(ALL) NOPASSWD:ALL" >"$image/root/etc/sudoers.d/ubuntu"
in_image ssh-keygen -A >/dev/null
install -m755 /bin/true "$image/root/usr/local/bin/systemctl"  # these VMs have no systemd

# Their first process is sshd: when it ends, the machine is down.
printf '#!/bin/sh\nkill -TERM 1\n' >"$image/root/usr/local/bin/shutdown"
chmod 755 "$image/root/usr/local/bin/shutdown"

home=$image/root/home/ubuntu
install -d "$home/.local/bin" "$home/.aws" "$image/root/opt/wheelhouse" "$image/root/etc/uv"
install -m755 "$venv/bin/uv" "$home/.local/bin/uv"
# How a VM finds AWS: by its default route, which ends in the emulation.
printf '[default]\nendpoint_url = http://10.66.0.1:5566\n' >"$home/.aws/config"
in_image chown -R ubuntu:ubuntu /home/ubuntu
in_image su - ubuntu -c "
  set -e
  export SSL_CERT_FILE=/etc/ssl/certs/ca-certificates.crt
  uv=~/.local/bin/uv
  \$uv venv -q --seed ~/skypilot-runtime --python /usr/bin/python3
  VIRTUAL_ENV=~/skypilot-runtime \$uv pip install -q 'setuptools<70' 'ray[default]==2.9.3' \
    'pydantic-core==2.41.1' 'click<8.3.0' 'skypilot[aws,remote]==$version'
  \$uv venv -q --seed --relocatable --system-site-packages --python /usr/bin/python3 ~/sky-user-env
  rm -rf ~/.cache/uv
"
# Compiled once, here, instead of on each VM when it is first imported.
in_image su - ubuntu -c 'HOME=/tmp/warm skypilot-runtime/bin/python -W ignore - && rm -rf /tmp/warm' \
  <"$here/warm.py"
# fogft's own dependencies, as wheels and in uv's cache: a VM's set-up installs them for real,
# by the template's own commands, but has no index to ask.
"$venv/bin/python" "$here/dependencies.py" "$checkout/pyproject.toml" >"$image/requirements.txt"
printf '%s\n' pip setuptools wheel iniconfig==2.0.0 >>"$image/requirements.txt"  # for `setup`
/usr/bin/python3 -m venv "$image/pip"
PIP_CACHE_DIR=${PIP_CACHE_DIR:-$venv/.pip-cache} "$image/pip/bin/pip" wheel -q --use-pep517 -w "$image/root/opt/wheelhouse" -r "$image/requirements.txt"
rm -rf "$image/pip"
printf 'offline = true\n[pip]\nno-index = true\nfind-links = ["/opt/wheelhouse"]\n' \
  >"$image/root/etc/uv/uv.toml"
printf '[global]\nno-index = true\nfind-links = /opt/wheelhouse\n' >"$image/root/etc/pip.conf"
in_image su - ubuntu -c "
  set -e
  ~/.local/bin/uv venv -q /tmp/warm --python /usr/bin/python3
  ~/.local/bin/uv pip install -q --python /tmp/warm/bin/python /opt/wheelhouse/*.whl
  rm -rf /tmp/warm
"
# SkyPilot carries its own wheel to a VM unless this hash says that it is there.
hash=$(HOME=$image/robot "$venv/bin/python" -c \
  'from sky.backends import wheel_utils; print(wheel_utils.build_sky_wheel()[1])')
install -d "$home/.sky/wheels"
echo "$hash" >"$home/.sky/wheels/current_sky_wheel_hash"
in_image chown -R ubuntu:ubuntu /home/ubuntu/.sky
in_image apt-get clean
