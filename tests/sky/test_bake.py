"""An image that is baked has what the set-up makes, nothing secret, and is never wrong."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from fogft.cloud.sky import bake, task
from fogft.errors import CloudError, SpecError
from fogft.pool.commands import bake as commands
from tests.sky.scene import Scene
from tests.sky.test_task import (  # noqa: F401 - two fixtures
    installed,
    new_vm,
    on_skypilot,
    quick_vm,
    wheel_of,
)

TASK: dict[str, Any] = {
    "setup": "set -e\necho baked $GREETING >> ~/setups\npip install -q userlib==1.0",
    "envs": {"GREETING": "it's\nlong"},
    "run": "serve",
}
FILE = """\
name: planner
resources: {infra: aws, image_id: "docker:lab/ros:1"}
workdir: .
setup: pip install numpy
run: exec python3 serve.py
fogft: {services: [{name: /plan, type: nav_msgs/srv/GetPlan}]}
"""


def carry(home: Path, version: str) -> None:
    """Give a machine the wheel of one version of fogft, and no other."""
    made = home / f"fogft-{version}"
    if not made.exists():
        wheel_of(made, "fogft", version, requires="userlib>=1", extra="rclpy")
    shutil.rmtree(home / ".fogft/wheel", ignore_errors=True)
    shutil.copytree(made, home / ".fogft/wheel")


@pytest.fixture
def image(quick_vm: Path) -> Path:  # noqa: F811
    """A home as on a machine that has booted from a baked image."""
    carry(quick_vm, "0.1.0")
    folder = quick_vm / "context"
    folder.mkdir()
    bake.write(folder, TASK, "lab/ros:1", quick_vm / ".fogft/wheel", {})
    text = (folder / "Dockerfile").read_text()
    (command,) = re.findall(r"^RUN (export HOME.*)$", text, re.MULTILINE)
    shutil.rmtree(quick_vm / ".fogft")
    shutil.copytree(folder / "fogft", quick_vm / ".fogft")
    (quick_vm / ".fogft/setup.sh").write_text(
        (folder / "fogft/setup.sh").read_text().replace("/opt/ros", str(quick_vm / "no-ros"))
    )
    done = on_skypilot(quick_vm, f"true /opt/ros\n{command.replace('/root', str(quick_vm))}")
    assert done.returncode == 0, done.stdout + done.stderr
    return quick_vm


def test_a_machine_takes_from_an_image_what_fits_and_makes_the_rest(
    image: Path, tmp_path_factory: pytest.TempPathFactory
):
    """Its own `setup` always runs: what that installed may have changed since."""
    assert sorted(path.name for path in (image / ".fogft").iterdir()) == [
        *("setup-installed.txt", "there-before.txt", "venv")
    ]
    (image / ".fogft/venv/baked").touch()
    as_baked = shutil.copytree(image, tmp_path_factory.mktemp("image") / "home", symlinks=True)
    for version in ("0.1.0", "0.2.0"):
        shutil.rmtree(image)
        shutil.copytree(as_baked, image, symlinks=True)
        carry(image, version)
        done = on_skypilot(image, f"export GREETING=\n{task.setup_of(TASK, task.read())}")
        assert done.returncode == 0, done.stdout + done.stderr
        assert (image / "setups").read_text().splitlines() == ["baked it's long", "baked"]
        assert (installed(image)["fogft"], installed(image)["userlib"]) == (version, "1.0")
        assert (image / ".fogft/venv/baked").exists() == (version == "0.1.0")


@pytest.mark.parametrize("asked", [{"secrets": {"TOKEN": "t"}}, {"file_mounts": {"~/m": "m"}}])
def test_what_no_image_may_have_is_refused_by_name(tmp_path: Path, asked: dict[str, Any]):
    with pytest.raises(SpecError, match=f"{next(iter(asked))}: an image cannot be baked"):
        bake.write(tmp_path, {**TASK, **asked}, "lab/ros:1", tmp_path, {})


@pytest.fixture
def docker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stand in for Docker: notes how it is called and what is built; it cannot push."""
    program = tmp_path / "bin/docker"
    program.parent.mkdir()
    program.write_text(
        f'#!/bin/sh\necho "$*" >> {tmp_path}/calls\n[ "$1" != push ] || exit 3\n'
        f'for last; do :; done\ncp -r "$last" {tmp_path}/context\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:/usr/bin:/bin")
    scene = Scene(tmp_path)
    (tmp_path / "state/wheels").mkdir()
    monkeypatch.setattr(commands, "make_cloud", lambda name: scene.cloud)
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab/serve.py").write_text("serve")
    (tmp_path / "lab/pool.yaml").write_text(FILE)
    by_region = FILE.replace('"docker:lab/ros:1"', '{us-east-1: "docker:lab/ros:1"}')
    (tmp_path / "lab/by-region.yaml").write_text(by_region)
    return tmp_path


@pytest.mark.parametrize("file", ["pool.yaml", "by-region.yaml"])
@pytest.mark.parametrize(
    ("base", "tag", "found"),
    [(None, "lab/baked:1", "lab/ros:1"), (None, "lab/ros:1", "ubuntu:24.04"),
     ("lab/own:2", "lab/ros:1", "lab/own:2")],
)  # fmt: skip
def test_an_image_is_built_on_the_files_own_but_never_on_itself(
    docker: Path, base: str | None, tag: str, found: str, file: str
):
    commands.bake(docker / f"lab/{file}", tag, base, push=False)
    text = (docker / "context/Dockerfile").read_text()
    assert text.startswith(f"FROM {found}\n")
    assert "\nCOPY workdir /root/sky_workdir\n" in text
    assert (docker / "context/workdir/serve.py").read_text() == "serve"
    (call,) = (docker / "calls").read_text().splitlines()
    assert call.startswith(f"build --tag {tag} ")
    assert not Path(call.split()[-1]).exists(), "the context is left behind"


def test_what_no_vm_gets_no_image_has(docker: Path):
    """SkyPilot leaves it out of a workdir, too; an image is pushed to where others can load it."""
    lines = "# keys\n*.pem\n/secrets/\n\n!ours.pem\n"
    (docker / "lab/.gitignore").write_text("other\n")
    (docker / "lab/.skyignore").write_text(lines)
    commands.bake(docker / "lab/pool.yaml", "lab/baked:1", None, push=False)
    ignored = (docker / "context/.dockerignore").read_text()
    assert ignored == "workdir/**/*.pem\nworkdir/secrets/**\n!workdir/**/ours.pem\n"


def test_what_a_folder_leaves_out_of_itself_no_image_has(docker: Path):
    """SkyPilot reads each folder's `.gitignore`: a virtual environment's leaves out all of it."""
    for name, line in (("conf", "/key\nbuild/\n"), (".venv", "*\n")):
        (docker / "lab" / name).mkdir()
        (docker / "lab" / name / ".gitignore").write_text(line)
    commands.bake(docker / "lab/pool.yaml", "lab/baked:1", None, push=False)
    ignored = (docker / "context/.dockerignore").read_text()
    assert ignored == "workdir/.venv/**/*\nworkdir/conf/key\nworkdir/conf/**/build/**\n"


def test_a_workdir_that_cannot_be_copied_is_told(docker: Path):
    os.mkfifo(docker / "lab/fifo")
    with pytest.raises(SpecError, match="workdir: cannot be copied: `"):
        commands.bake(docker / "lab/pool.yaml", "lab/baked:1", None, push=False)


def test_what_docker_cannot_do_is_told(docker: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(CloudError, match="`docker push` failed with status 3"):
        commands.bake(docker / "lab/pool.yaml", "lab/baked:1", None, push=True)
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(CloudError, match="Docker cannot be started"):
        commands.bake(docker / "lab/pool.yaml", "lab/baked:1", None, push=False)
