"""An image with a replica's environment: the set-up of `task`, run once by Docker.

A VM that starts from it runs the same set-up again. It holds no certificate, key or secret.
"""

import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fogft.cloud.sky import task
from fogft.disk import make_folder, write_whole
from fogft.errors import SpecError

# What SkyPilot and the set-up need of a container, and would load onto each machine.
_NEEDED = (
    *("bash", "ca-certificates", "curl", "fuse", "openssh-server", "patch", "procps"),
    *("python3", "python3-pip", "python3-venv", "rsync", "sudo", "wget"),
)
_DOCKERFILE = """\
FROM {image}
SHELL ["/bin/bash", "-c"]
RUN apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends {needed} && rm -rf /var/lib/apt/lists/*
COPY fogft /root/.fogft
{workdir}WORKDIR /root/sky_workdir
RUN export HOME=/root && bash /root/.fogft/setup.sh && rm -rf /root/.fogft/setup.sh /root/.fogft/wheel /root/.fogft/replica
"""  # noqa: E501


def write(
    folder: Path, asked: Mapping[str, Any], image: str, wheel: Path, lock: Mapping[str, bytes]
) -> None:
    """Write the context of a build into an empty folder; see `RealCloud.bake`."""
    for key in ("secrets", "file_mounts"):
        if asked.get(key):
            raise SpecError.of_key(
                key,
                "an image cannot be baked with it",
                "put what `setup` needs of it into your own image, and bake from that: `--from`",
            )
    task.refuse_what_cannot_be_honoured(asked)
    ours = folder / "fogft"
    make_folder(ours / "replica")
    shutil.copytree(wheel, ours / "wheel")
    for name, content in lock.items():
        write_whole(ours / "replica" / name, content)
    exports = "".join(
        f"export {name}={shlex.quote(str(value))}\n"
        for name, value in (asked.get("envs") or {}).items()
    )
    write_whole(ours / "setup.sh", exports + task.setup_of(asked, task.read()))
    carried = isinstance(asked.get("workdir"), str)
    if carried:
        try:
            shutil.copytree(asked["workdir"], folder / "workdir", symlinks=True)
        except shutil.Error as error:  # a pipe, or a file that we may not read
            raise SpecError.of_key("workdir", f"cannot be copied: {error.args[0][0][2]}") from error
        write_whole(folder / ".dockerignore", _ignored(Path(asked["workdir"])))
    text = _DOCKERFILE.format(
        image=image, needed=" ".join(_NEEDED),
        workdir="COPY workdir /root/sky_workdir\n" if carried else "",
    )  # fmt: skip
    write_whole(folder / "Dockerfile", text)


def _ignored(workdir: Path) -> str:
    """Return a `.dockerignore` for the folder above, of the files that SkyPilot does not upload."""
    name = ".skyignore" if (workdir / ".skyignore").exists() else ".gitignore"
    text = ""
    for one in sorted(filter(Path.is_file, workdir.rglob(name))):
        at = Path("workdir", one.parent.relative_to(workdir))
        for line in one.read_text(errors="replace").splitlines():
            path = line.strip().removeprefix("!")
            if path and not path.startswith("#"):
                under = f"{at}" if path.startswith("/") else f"{at}/**/"
                path += "**" if path.endswith("/") else ""  # a file of that name is uploaded
                text += ("!" if line.startswith("!") else "") + under + path + "\n"
    return text
