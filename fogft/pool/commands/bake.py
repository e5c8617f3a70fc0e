"""``fogft bake``: build an image with a pool file's environment preinstalled.

Not here: the content of the image (`fogft.cloud.port.RealCloud`).
"""

import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path

from fogft.cloud.port import RealCloud
from fogft.errors import CloudError, SpecError
from fogft.pool.commands.composition import make_cloud
from fogft.pool.manager.configuration import absolute, with_build
from fogft.poolfile.file import parse, read_text
from fogft.poolfile.named_clouds import alternatives, cloud_named_by

PLAIN = "ubuntu:24.04"
_DOCKER = "docker:"


def bake(file: Path, tag: str, base: str | None, *, push: bool) -> None:
    """Build an image for a pool file, and push it if asked. Docker's output goes to stderr.

    `base` is the base image; None for the pool file's own image or, without one, plain Ubuntu.
    """
    text = read_text(file)
    spec = parse(text, file=str(file))
    cloud = make_cloud(cloud_named_by(spec, text, file))
    if not isinstance(cloud, RealCloud):
        raise SpecError(f"`{file}` names no real cloud", "the local cloud needs no image")
    task = with_build(absolute(spec.task, file.resolve().parent))
    asked = [one.get("image_id") for _, one in alternatives(task.get("resources") or {})]
    each = [list(one.values()) if isinstance(one, Mapping) else [one] for one in asked]
    named = {str(one) for ids in each for one in ids}
    images = sorted(one.removeprefix(_DOCKER) for one in named if one.startswith(_DOCKER))
    if base is None:
        base = next((image for image in images if image != tag), PLAIN)
    with tempfile.TemporaryDirectory(prefix="fogft-bake-") as folder:
        cloud.bake(task, base, Path(folder))
        _docker("build", "--tag", tag, folder)
    if push:
        _docker("push", tag)


def _docker(*arguments: str) -> None:
    try:
        code = subprocess.run(["docker", *arguments], stdout=2, check=False).returncode
    except OSError as error:
        raise CloudError(f"Docker cannot be started: {error}", "install Docker") from error
    if code:
        raise CloudError(f"`docker {arguments[0]}` failed with status {code}: see above")
